"""Reads and answers lines until the input ends or a signal arrives; no line read is lost."""

from __future__ import annotations

import os
import select
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

LONGEST_LINE = 1 << 20
"""Bytes; a longer line is refused, so that input without newlines cannot fill the memory."""

_CHUNK = 1 << 16
_MOST_AFTER_STOP = 1 << 20


def serve(
    answer: Callable[[bytes], bytes],
    refuse: Callable[[str], bytes],
    *,
    source: int = 0,
    sink: int = 1,
) -> bool:
    """Answers every line of a file descriptor on another one, each as soon as it arrives.

    Returns when the input ends, and on SIGTERM or SIGINT after answering what had arrived; a second
    signal has its usual effect. A last line without a newline is a line where the input ends there;
    after a signal it is one of which a part has arrived, and has no answer.

    Args:
        answer: from a line without its newline to its answer, which may be empty.
        refuse: from the reason why a line was not read to its answer.
        source: file descriptor to read from.
        sink: file descriptor to write to.

    Returns:
        False if the reader of the answers closed the pipe before the end.
    """
    rest, skipping = b"", False
    with _stop_signals() as stop:
        try:
            for chunk in _chunks(source, stop):
                *lines, rest = (rest + chunk).split(b"\n")
                if lines and skipping:
                    lines, skipping = lines[1:], False
                for line in lines:
                    _write(sink, _one(answer, refuse, line))
                if skipping:
                    rest = b""
                elif len(rest) > LONGEST_LINE:
                    _write(sink, refuse(f"a line is longer than {LONGEST_LINE} bytes"))
                    rest, skipping = b"", True
            if rest and not _is_readable(stop):
                _write(sink, _one(answer, refuse, rest))
        except BrokenPipeError:
            return False
    return True


def _is_readable(descriptor: int) -> bool:
    ready, _, _ = select.select([descriptor], [], [], 0)
    return bool(ready)


def _one(answer: Callable[[bytes], bytes], refuse: Callable[[str], bytes], line: bytes) -> bytes:
    if len(line) > LONGEST_LINE:
        return refuse(f"a line is longer than {LONGEST_LINE} bytes")
    return answer(line)


def _chunks(source: int, stop: int) -> Iterator[bytes]:
    """Yields input as it arrives; once `stop` is readable, only what has arrived already."""
    budget = _MOST_AFTER_STOP
    while budget > 0:
        ready, _, _ = select.select([source, stop], [], [])
        if source not in ready:
            return
        chunk = os.read(source, _CHUNK)
        if not chunk:
            return
        yield chunk
        if stop in ready:  # it is never read, so it stays readable
            budget -= len(chunk)


@contextmanager
def _stop_signals() -> Iterator[int]:
    """Yields a file descriptor that is readable from the first SIGTERM or SIGINT on."""
    stop, wake = os.pipe()
    before: dict[int, Any] = {}

    def put_back() -> None:
        for number, handler in before.items():
            signal.signal(number, signal.SIG_DFL if handler is None else handler)

    def handle(number: int, frame: FrameType | None) -> None:
        put_back()
        os.write(wake, b"x")

    try:
        if threading.current_thread() is threading.main_thread():  # other threads get no signals
            for number in (signal.SIGTERM, signal.SIGINT):
                before[number] = signal.signal(number, handle)
        yield stop
    finally:
        put_back()
        os.close(stop)
        os.close(wake)


def _write(sink: int, data: bytes) -> None:
    """Writes all bytes, in as many calls as needed."""
    while data:
        try:
            data = data[os.write(sink, data) :]
        except BlockingIOError:
            select.select([], [sink], [])
