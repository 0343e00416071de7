"""Kills commands at random file operations and resumes them; `make torture` does it 200 times.

    python tests/torture.py --kills 200 --commands train sweep

A command runs in a forked process that kills itself (SIGKILL) before or after its n-th operation on
a file below its folder: opening, renaming, removing, making, flushing, or in the middle of a write.
Some are killed again while they resume. The command then runs to its end, and its files must be
those of an undisturbed run, bit for bit: no more of them, no fewer. Times of day and durations are
left out of the comparison.
"""

from __future__ import annotations

import argparse
import csv
import hashlib
import importlib
import io
import json
import os
import resource
import shutil
import signal
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

import offbeat as ob
from offbeat.cli import app
from offbeat.sweeps.engines import base, local

EVENTS = {"open", "os.rename", "os.remove", "os.mkdir", "os.rmdir", "os.chmod", "shutil.rmtree"}
"""Audit events that are operations on a file; `fsync` and writes are counted by themselves."""

TIMED = {"seconds", "finished_at", "began", "seconds_before", "updated", "sessions", "started"}
"""Columns and keys of times and durations, which differ between runs."""

UNCOMPARED = {"status.json", "sessions.json", ".lock"}
"""Files that say how a call went."""


def logs(folder: Path) -> Path:
    """A small log in CSV."""
    times = np.cumsum(np.random.default_rng(0).uniform(0.01, 0.03, 400))
    rows = [f"{t:.4f},{np.sin(3 * t):.6f},{np.cos(2 * t):.6f}" for t in times]
    (folder / "log.csv").write_text("\n".join(["time,x,y", *rows]) + "\n")
    return folder / "log.csv"


def make_data(folder: Path) -> None:
    """The inputs of all commands: a log, a data set, a model."""
    logs(folder)
    times = np.arange(24) / 10
    walks = [
        ob.Trajectory(times, np.column_stack([np.sin(times + i), np.cos(2 * times + i)]))
        for i in range(12)
    ]
    data = ob.mask_out(ob.Dataset(tuple(walks)), 0.5, seed=1)
    ob.save(data, folder / "data.parquet")
    model = ob.make_model("gru_d", data, hidden_size=3, decoder_units=(4,))
    ob.save_model(model, folder / "model")


SMALL = "--model.hidden_size 3 --model.decoder_units [4] --training.epochs 2"
FAST = "--training.batch_size 4 --training.checkpoint_every 1"
COMMANDS = {
    "train": f"train IN/data.parquet OUT/run --model.name gru_d {SMALL} {FAST}",
    "train log": f"train IN/log.csv OUT/run --model.name anchored_ode_gru_d --horizon_s 0.2 "
    f"--model.hidden_size 3 --model.field_units [4] --training.epochs 1 "
    f"--training.tasks_per_epoch 16 --baselines last_value,pchip {FAST}",
    "sweep": f"sweep IN/data.parquet OUT/sweep --models gru,gru_d --repeats 1 --processes 1 "
    f"--training.epochs 1 {FAST}",
    "simulate": "simulate OUT/hopper.parquet --n_trajectories 6 --rows 20 --threads 1",
    "impute": "impute IN/model IN/data.parquet OUT/filled.csv",
}
"""Commands; IN holds their inputs, OUT is empty at first."""


class Inline(base.Engine):
    """Runs the jobs of a sweep in this process, so that their operations are counted, too."""

    def __init__(self, processes: int | None, threads: int) -> None:
        self.capacity, self.description = 1, "1 process of 1 thread"
        self.jobs: list[base.Job] = []

    def submit(self, job: base.Job) -> None:
        self.jobs.append(job)

    def wait(self, seconds: float) -> list[base.Ending]:
        jobs, self.jobs = self.jobs, []
        return [base.Ending(job, base.attempt(job)) for job in jobs]

    def stop(self) -> None:
        self.jobs.clear()


class Killer:
    """Counts operations on files below a folder; kills the process at one of them.

    Args:
        folder: whose files count.
        at: number of the operation, from 1; 0 kills at none.
    """

    def __init__(self, folder: Path, at: int) -> None:
        self.folder, self.at, self.count = str(folder), at, 0
        sys.addaudithook(self.hook)
        fsync, write_bytes = os.fsync, Path.write_bytes

        def synced(handle: int) -> None:
            self.operation()
            fsync(handle)
            self.operation()

        def halved(path: Path, data: bytes) -> int:
            if self.folder in str(path) and self.count + 1 == self.at:
                write_bytes(path, data[: len(data) // 2])
                self.operation()
            self.operation()
            return write_bytes(path, data)

        def halved_text(path: Path, text: str, encoding: str = "utf-8", **_: Any) -> int:
            return halved(path, text.encode(encoding))

        os.fsync, Path.write_bytes, Path.write_text = synced, halved, halved_text  # type: ignore

    def hook(self, event: str, given: tuple[Any, ...]) -> None:
        if event in EVENTS and isinstance(given[0], str | Path) and self.folder in str(given[0]):
            self.operation()

    def operation(self) -> None:
        self.count += 1
        if self.count == self.at:
            os.kill(os.getpid(), signal.SIGKILL)


def run(
    command: str, inputs: Path, out: Path, *, at: int = 0, before: Callable[[], None] | None = None
) -> tuple[int, int, str]:
    """Runs a command in a forked process.

    Args:
        command: of `COMMANDS`.
        inputs: folder of the inputs.
        out: folder of the results.
        at: operation at which it is killed; 0 for none.
        before: called in that process, before the command.

    Returns:
        The exit code, negative for a signal; the number of operations; what it said on standard
        error.
    """
    arguments = [
        part.replace("IN/", f"{inputs}/").replace("OUT/", f"{out}/")
        for part in COMMANDS[command].split()
    ]
    read, write = os.pipe()
    said = Path(tempfile.mkstemp()[1])
    child = os.fork()
    if not child:
        code = 70
        try:
            with said.open("w") as errors, Path(os.devnull).open("w") as nowhere:
                os.dup2(errors.fileno(), 2)
                os.dup2(nowhere.fileno(), 1)
                local.LocalEngine = Inline  # type: ignore[misc, assignment]
                sys.modules["tensorboard"] = None  # type: ignore[assignment]  # slow, and timed
                if before is not None:
                    before()
                killer = Killer(out, at)
                code = app.main(arguments)
                sent = json.dumps([killer.count, list(sys.modules)])
                os.write(write, sent.encode())
        finally:
            sys.stderr.flush()
            os._exit(code)
    os.close(write)
    with os.fdopen(read) as pipe:
        count, modules = json.loads(pipe.read() or "[0, []]")
    _, status = os.waitpid(child, 0)
    text = said.read_text()
    said.unlink()
    for name in modules:  # so that the next process need not import them
        if name not in sys.modules and not name.startswith(("torch", "__")):
            with suppress(Exception):
                importlib.import_module(name)
    return os.waitstatus_to_exitcode(status), count, text


def content(path: Path) -> str:
    """A digest of a file without times of day and durations."""
    data = path.read_bytes()
    if path.suffix == ".csv":
        rows = list(csv.DictReader(io.StringIO(data.decode())))
        kept = [{k: v for k, v in row.items() if k not in TIMED} for row in rows]
        data = json.dumps(kept).encode()
    elif path.suffix == ".json":
        data = json.dumps(_untimed(json.loads(data))).encode()
    elif path.name in ("record.parquet", "curves.parquet"):
        import pyarrow.parquet as pq

        table = pq.read_table(path)
        data = repr(table.drop_columns([c for c in table.column_names if c in TIMED]).to_pydict())
        data = data.encode()
    return hashlib.sha256(data).hexdigest()


def _untimed(value: Any) -> Any:
    if isinstance(value, dict):  # a digest covers the durations of the training
        left = TIMED | {"config_sha256"}
        return {k: _untimed(v) for k, v in value.items() if k not in left}
    return [_untimed(v) for v in value] if isinstance(value, list) else value


def results(folder: Path) -> dict[str, str]:
    """All files below a folder by their relative names, each with its content."""
    found = (file for file in folder.rglob("*") if file.is_file())
    return {
        str(file.relative_to(folder)): "" if file.name in UNCOMPARED else content(file)
        for file in found
    }


def settle(folder: Path) -> None:
    """Makes what was left look older, as it is when a person comes back."""
    for path in folder.rglob(".*"):
        os.utime(path, (0, 0))


def difference(found: dict[str, str], expected: dict[str, str]) -> str:
    """What differs between two results; empty if nothing does."""
    lines = [f"left over: {name}" for name in sorted(found.keys() - expected.keys())]
    lines += [f"missing: {name}" for name in sorted(expected.keys() - found.keys())]
    both = sorted(found.keys() & expected.keys())
    lines += [f"differs: {name}" for name in both if found[name] != expected[name]]
    return "; ".join(lines)


def trial(
    command: str,
    inputs: Path,
    out: Path,
    expected: dict[str, str],
    operations: int,
    random: np.random.Generator,
) -> str:
    """Kills a command once or twice, resumes it, and compares; `same`, or what is wrong."""
    kills = []
    for _ in range(1 + int(random.integers(3) == 0)):
        at = int(random.integers(1, operations + 1))
        code, _, text = run(command, inputs, out, at=at)
        kills.append(at)
        if code not in (0, -signal.SIGKILL):
            return f"exit code {code} after kills at {kills[:-1]}: {text[-300:]}"
        settle(out)
    code, _, text = run(command, inputs, out)
    if code:
        return f"exit code {code} after kills at {kills}: {text[-300:]}"
    wrong = difference(results(out), expected)
    return f"{wrong} after kills at {kills}" if wrong else "same"


def torture(command: str, kills: int, folder: Path, *, seed: int = 0) -> Counter[str]:
    """Counts of what killing and resuming a command ended in.

    Args:
        command: of `COMMANDS`.
        kills: number of trials.
        folder: to work in.
        seed: of the operations.
    """
    inputs, whole = folder / "in", folder / "whole"
    if not inputs.exists():
        inputs.mkdir()
        child = os.fork()  # torch must not compute in the process that is forked
        if not child:
            make_data(inputs)
            os._exit(0)
        assert os.waitpid(child, 0)[1] == 0
    shutil.rmtree(whole, ignore_errors=True)
    whole.mkdir()
    code, operations, text = run(command, inputs, whole)
    assert code == 0, text
    expected = results(whole)
    shutil.rmtree(whole)
    found: Counter[str] = Counter()
    for number in range(kills):
        whole.mkdir()  # of the same name: configs hold it
        random = np.random.default_rng([seed, number, *command.encode()])
        found[trial(command, inputs, whole, expected, operations, random)] += 1
        shutil.rmtree(whole)
    return found


def full_disk(left: int) -> Callable[[], None]:
    """For `before`: no file may grow beyond `left` bytes, as on a disk that is nearly full."""

    def limit() -> None:
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (left, left))

    return limit


def main() -> int:
    """Tortures all commands; returns 1 if anything is wrong."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=200, help="in all")
    parser.add_argument("--commands", nargs="+", choices=COMMANDS, default=list(COMMANDS))
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    wrong = 0
    with tempfile.TemporaryDirectory() as folder:
        for i, command in enumerate(options.commands):
            kills = (options.kills + i) // len(options.commands)
            began = time.monotonic()
            found = torture(command, kills, Path(folder), seed=options.seed)
            wrong += kills - found["same"]
            print(f"{command}: {kills} trials in {time.monotonic() - began:.0f} s", flush=True)
            for said, count in found.most_common():
                print(f"  {count} x {said}", flush=True)
    return int(wrong > 0)


if __name__ == "__main__":
    sys.exit(main())
