"""A headless Chromium, driven over a pipe: no driver, no socket, nothing to install but itself."""

import base64
import contextlib
import json
import os
import shutil
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

NAMES = ("chromium", "chromium-browser", "google-chrome", "chrome")
_FLAGS = (
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-dev-shm-usage",
    "--hide-scrollbars",
    "--remote-debugging-pipe",
)


def chromium():
    """The path of a Chromium, or None; `OFFBEAT_CHROMIUM` names another one."""
    named = os.environ.get("OFFBEAT_CHROMIUM")
    return named or next((found for name in NAMES if (found := shutil.which(name))), None)


class Page:
    """One tab."""

    def __init__(self, send, events):
        self._send, self.events = send, events

    def call(self, method, **parameters):
        """Calls a method of the DevTools protocol."""
        return self._send(method, parameters)

    def open(self, path, *, width=1280, height=900, dark=False, seconds=120):
        """Opens a file at a size of window, and waits until it is loaded."""
        self.call("Page.enable")
        self.call("Network.enable")
        self.call("Log.enable")
        self.call("Runtime.enable")
        self.call(
            "Emulation.setDeviceMetricsOverride",
            width=width,
            height=height,
            deviceScaleFactor=1,
            mobile=width < 600,
        )
        scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
        self.call("Emulation.setEmulatedMedia", features=[scheme])
        self.call("Page.navigate", url=Path(path).resolve().as_uri())
        deadline = time.monotonic() + seconds
        while not any(event["method"] == "Page.loadEventFired" for event in self.events):
            assert time.monotonic() < deadline, "the page did not load"
            self.evaluate("1")
            time.sleep(0.05)

    def evaluate(self, expression):
        """The value of an expression on the page, waited for."""
        answer = self.call(
            "Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True
        )
        assert "exceptionDetails" not in answer, answer
        return answer["result"].get("value")

    def requests(self):
        """Addresses that the page has asked for, `data:` left out."""
        asked = [
            event["params"]["request"]["url"]
            for event in self.events
            if event["method"] == "Network.requestWillBeSent"
        ]
        return [url for url in asked if not url.startswith("data:")]

    def complaints(self):
        """What the browser has logged."""
        return [
            event["params"]["entry"]["text"]
            for event in self.events
            if event["method"] == "Log.entryAdded"
        ]

    def screenshot(self, path, *, full=False):
        """Writes what is seen, or the whole page, as PNG."""
        answer = self.call("Page.captureScreenshot", captureBeyondViewport=full)
        Path(path).write_bytes(base64.b64decode(answer["data"]))


@contextlib.contextmanager
def tab(profile) -> Iterator[Page]:
    """Starts a browser with a profile of its own, and ends it."""
    down_read, down_write = os.pipe()
    up_read, up_write = os.pipe()

    def place():  # the browser reads from 3 and writes to 4
        read, write = os.dup(down_read), os.dup(up_write)
        os.dup2(read, 3)
        os.dup2(write, 4)

    process = subprocess.Popen(
        [chromium(), *_FLAGS, f"--user-data-dir={profile}", "about:blank"],
        preexec_fn=place,
        close_fds=False,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    os.close(down_read)
    os.close(up_write)
    try:
        with os.fdopen(down_write, "wb") as out, os.fdopen(up_read, "rb") as answers:
            yield _attach(out, answers)
    finally:
        process.terminate()
        process.wait(timeout=30)


def _attach(out, answers):
    events, state = [], {"id": 0, "rest": b"", "session": None}

    def read():
        while b"\0" not in state["rest"]:
            data = os.read(answers.fileno(), 1 << 20)
            assert data, "the browser has ended"
            state["rest"] += data
        message, _, state["rest"] = state["rest"].partition(b"\0")
        return json.loads(message)

    def send(method, parameters):
        state["id"] += 1
        message = {"id": state["id"], "method": method, "params": parameters}
        if state["session"]:
            message["sessionId"] = state["session"]
        out.write(json.dumps(message).encode() + b"\0")
        out.flush()
        while True:
            answer = read()
            if answer.get("id") == state["id"]:
                assert "error" not in answer, (method, answer)
                return answer["result"]
            if "method" in answer:
                events.append(answer)

    targets = send("Target.getTargets", {})["targetInfos"]
    target = next(t["targetId"] for t in targets if t["type"] == "page")
    attached = send("Target.attachToTarget", {"targetId": target, "flatten": True})
    state["session"] = attached["sessionId"]
    return Page(send, events)
