"""Mutated files of every format, and what reading each ends in; `make fuzz` runs many of them.

    python tests/fuzz.py --mutants 2000 --targets csv ulog

A mutant is made from a target and a number alone, so that an outcome can be repeated. Each ends in
`read` or `refused`, a line of at most 300 printable characters. Anything else is a fault: another
exception, a crash, more than 10 s, or more than 1 GB of memory. One process reads many mutants; one
that crashes or hangs is an outcome, and the next process goes on after it.
"""

from __future__ import annotations

import argparse
import json
import logging
import math
import os
import resource
import select
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import warnings
import zipfile
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from log_writers import OPTIONS, WRITERS

from offbeat import safe_yaml
from offbeat.config import ModelConfig, from_mapping
from offbeat.data.readers import read
from offbeat.data.trajectory import Dataset, Trajectory
from offbeat.errors import InputError, OffbeatError, printable
from offbeat.models.checkpoint import CONFIG, _digest, load_model, save_model
from offbeat.models.zoo import make_model
from offbeat.stream.lines import LineSession
from offbeat.stream.stream import Stream
from offbeat.sweeps.record import Record

SECONDS, MEMORY, CHARACTERS = 10, 1 << 30, 300
"""Limits of a mutant: its time, its memory in bytes, its message. Paths do not count."""

ROUND = 2000
"""Mutants of a target before the next target has its turn."""

STAMPS = 1_700_000_000_123_456_000 + 1000 * np.cumsum(
    np.random.default_rng(0).integers(1000, 30_000, 60)
)
VALUES = np.random.default_rng(1).normal(size=(60, 2))
EXTREMES = (
    *(b"\0", b"\xff", b"\x7f", b"\n", b",", b'"', b"-1", b"1e999", b"nan", b"null", b"true"),
    *(b"[" * 300, b"9" * 400, b"\xff" * 8, b"\0" * 8, b"\xff\xff\xff\x7f", b"..", b"/", b"{}"),
)


@dataclass(frozen=True)
class Target:
    """Something that is read.

    Attributes:
        make: writes a good one into a folder; returns the path to open.
        use: reads it.
    """

    make: Callable[[Path], Path]
    use: Callable[[Path], object]


def model() -> object:
    """A small model."""
    times = np.arange(30) / 10
    walk = Trajectory(times, np.column_stack([np.sin(times), np.cos(times)]), names=("x", "y"))
    return make_model("gru_d", Dataset([walk, walk]), hidden_size=3, decoder_units=(4,))


def make_checkpoint(folder: Path) -> Path:
    save_model(model(), folder / "model")
    return folder / "model"


def make_members(folder: Path) -> Path:
    """The arrays of an NPZ file, each in a file of its own."""
    made = WRITERS["npz"](folder / "walk", STAMPS, VALUES)
    (folder / "members").mkdir()
    with zipfile.ZipFile(made) as file:
        file.extractall(folder / "members")
    made.unlink()
    return folder / "members"


def read_members(path: Path) -> object:
    """Reads an NPZ file whose checksums fit what was changed, as a forger would write it."""
    with zipfile.ZipFile(path.with_suffix(".npz"), "w") as file:
        for member in sorted(path.iterdir()):
            file.write(member, member.name)
    return read(path.with_suffix(".npz"), **OPTIONS.get("npz", {}))


def load_signed(path: Path) -> object:
    """Loads a checkpoint whose config was signed again, as a forger would."""
    try:
        record = json.loads((path / CONFIG).read_text())
        record.pop("config_sha256", None)
        record["config_sha256"] = _digest(record)
        (path / CONFIG).write_text(json.dumps(record))
    except (ValueError, AttributeError, TypeError, RecursionError):
        pass  # it is read as it is
    return load_model(path)


def make_state(folder: Path) -> Path:
    stream = Stream(model())
    for i in range(5):
        stream.observe(i / 10, {"x": 0.1 * i, "y": 1.0})
    (folder / "state.json").write_text(json.dumps(stream.state()))
    return folder / "state.json"


def answer_lines(path: Path) -> object:
    """Gives every line of a file to a stream; it must answer each with one line of JSON."""
    session = LineSession(Stream(model()))
    answers = [session.answer(line) for line in path.read_bytes().split(b"\n")]
    for answer in answers:
        if answer and not isinstance(json.loads(answer), dict):
            raise AssertionError("an answer is no object")
    if session.bad_lines:
        raise InputError("some lines were refused")
    return answers


def restore(path: Path) -> object:
    path.write_bytes(b'{"restore": ' + path.read_bytes().replace(b"\n", b" ") + b"}\n")
    return answer_lines(path)


def make_lines(folder: Path) -> Path:
    lines = [{"t": i / 10, "values": {"x": 0.5, "y": None}} for i in range(4)]
    lines += [{"predict": [0.5, 0.9]}, {"counters": True}, {"state": True}, {"reset": True}]
    (folder / "lines.jsonl").write_text("\n".join(map(json.dumps, lines)))
    return folder / "lines.jsonl"


def make_yaml(folder: Path) -> Path:
    text = "name: gru\nhidden_size: 8\ndecoder_units: [10, 4]\nself_feeding: 0.5\nsolver: euler\n"
    (folder / "config.yaml").write_text(text)
    return folder / "config.yaml"


def load_yaml(path: Path) -> object:
    try:
        values = safe_yaml.load(path.read_text(encoding="utf-8"))
    except (safe_yaml.yaml.YAMLError, ValueError) as error:
        raise InputError(" ".join(str(error).split())[:200]) from None
    return from_mapping(ModelConfig, values) if isinstance(values, dict) else None


class Runs(Record):
    """A record of runs with a column of each type."""

    RUN_COLUMNS = {"run_id": str, "repeat": int, "mse": float}  # noqa: RUF012
    CURVE_COLUMNS = {"run_id": str, "epoch": int, "mse": float}  # noqa: RUF012
    LOG_COLUMNS = {"epoch": "epoch", "mse": "mse"}  # noqa: RUF012


def make_record(folder: Path) -> Path:
    rows = {f"r{i}": {"run_id": f"r{i}", "repeat": i, "mse": 0.5 * i} for i in range(5)}
    curves = {name: ({"run_id": name, "epoch": 1, "mse": 0.1},) for name in rows}
    Runs(rows, curves).write(folder)
    for file in folder.glob("*.parquet"):
        file.unlink()  # the same is in the text beside it
    return folder


def of_format(name: str) -> Target:
    """A format of `log_writers`, by its name there."""
    options = OPTIONS.get(name, {})
    return Target(
        lambda folder: WRITERS[name](folder / "walk", STAMPS, VALUES),
        lambda path: read(path, format=name.split()[0], **options),
    )


TARGETS = {name: of_format(name) for name in WRITERS}
TARGETS |= {
    "npz zipped again": Target(make_members, read_members),
    "checkpoint": Target(make_checkpoint, load_model),
    "checkpoint signed again": Target(make_checkpoint, load_signed),
    "stream state": Target(make_state, restore),
    "stream lines": Target(make_lines, answer_lines),
    "config": Target(make_yaml, load_yaml),
    "record": Target(make_record, Runs.read),
}
"""What is mutated, by name."""


def mutate(data: bytes, random: np.random.Generator) -> bytes:
    """A mutant of a file: one to four changes."""
    for _ in range(random.integers(1, 5)):
        at = int(random.integers(0, len(data) + 1))
        length = int(random.integers(1, 1 + min(64, len(data) or 1)))
        kind = random.integers(0, 8)
        if kind == 0 and data:  # a bit
            at = min(at, len(data) - 1)
            data = data[:at] + bytes([data[at] ^ 1 << random.integers(0, 8)]) + data[at + 1 :]
        elif kind == 1:
            data = data[:at] + data[at + length :]
        elif kind == 2:
            data = data[:at] + data[at : at + length] + data[at:]
        elif kind == 3:
            data = data[:at] + random.bytes(length) + data[at + length :]
        elif kind == 4:
            data = data[:at]
        elif kind == 5:
            new = EXTREMES[random.integers(0, len(EXTREMES))]
            data = data[:at] + new + data[at + len(new) :]
        elif kind == 6:
            data = data[:at] + EXTREMES[random.integers(0, len(EXTREMES))] + data[at:]
        else:
            other = int(random.integers(0, len(data) + 1))
            data = data[:at] + data[other : other + length] + data[at + length :]
    return data


@contextmanager
def time_limit() -> Iterator[None]:
    """Raises `TimeoutError` after the limit of a mutant, in time of the processor."""

    def late(*_: object) -> None:
        raise TimeoutError

    before = signal.signal(signal.SIGPROF, late)
    signal.setitimer(signal.ITIMER_PROF, SECONDS)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.signal(signal.SIGPROF, before)


def outcome(name: str, number: int, good: Path) -> str:
    """What a mutant ends in: `read`, `refused`, or a fault.

    Args:
        name: of the target.
        number: of the mutant.
        good: a folder with an unchanged one, from `Target.make`.
    """
    random = np.random.default_rng([number, *name.encode()])
    with tempfile.TemporaryDirectory() as folder:
        shutil.copytree(good, folder, dirs_exist_ok=True)
        path = Path(folder) / json.loads((good / ".path").read_text())
        (Path(folder) / ".path").unlink()
        files = sorted(f for f in Path(folder).rglob("*") if f.is_file())
        file = files[random.integers(0, len(files))]
        file.write_bytes(mutate(file.read_bytes(), random))
        used = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
        try:
            with time_limit():
                TARGETS[name].use(path)
            said = "read"
        except OffbeatError as error:
            text = str(error).replace(str(folder), "")
            fine = len(text) <= CHARACTERS and "\n" not in text and printable(text) == text
            said = "refused" if fine else f"message: {text[:100]!r}"
        except TimeoutError:
            said = "hang"
        except Exception as error:
            said = f"{type(error).__name__}: {' '.join(str(error).split())[:100]}"
        if resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 - used > MEMORY:
            said = "memory"
    return said


def prepared(name: str, folder: Path) -> Path:
    """A folder with a good file of a target, and the path to open in it."""
    folder.mkdir(parents=True)
    path = TARGETS[name].make(folder)
    (folder / ".path").write_text(json.dumps(str(path.relative_to(folder))))
    return folder


def outcomes(name: str, numbers: range, good: Path) -> Iterator[tuple[int, str]]:
    """Numbers of mutants, and what each ends in."""
    logging.disable(logging.WARNING)
    try:
        for number in numbers:
            yield number, outcome(name, number, good)
    finally:
        logging.disable(logging.NOTSET)


def _in_processes(name: str, numbers: range, good: Path) -> Iterator[tuple[int, str]]:
    """As `outcomes`, in a process of its own, so that a crash is an outcome, and a hang in C."""
    start = numbers.start
    while start < numbers.stop:
        command = [sys.executable, __file__, "--work", name, str(good), str(start)]
        process = subprocess.Popen(
            [*command, str(numbers.stop)], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL
        )
        assert process.stdout is not None
        hangs = False
        while start < numbers.stop:
            # the first line comes after the imports, and the machine may be busy
            hangs = not select.select([process.stdout], [], [], 30 * SECONDS)[0]
            line = b"" if hangs else process.stdout.readline()
            if not line:
                break
            if line.startswith(b"["):
                number, said = json.loads(line)
                start = number + 1
                yield number, said
        if start < numbers.stop:
            process.kill()
            code = process.wait()
            if code == 1 and not hangs:
                raise RuntimeError(f"this fails by itself: {command}")
            yield start, "hang" if hangs else f"crash, exit code {code}"
            start += 1
        process.wait()


def _work(name: str, numbers: range, good: Path) -> None:
    """Prints the outcomes, with an address space that ends above the limit of memory.

    Warnings of NumPy are errors: they would be more lines.
    """
    warnings.simplefilter("error")
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    most = pages * resource.getpagesize() + 4 * MEMORY
    resource.setrlimit(resource.RLIMIT_AS, (most, most))
    for found in outcomes(name, numbers, good):
        os.write(1, json.dumps(found).encode() + b"\n")


def main() -> int:
    """Runs mutants of all targets; returns 1 if any ends in a fault."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--mutants", type=int, default=1000, help="of each target")
    parser.add_argument("--first", type=int, default=0, help="number of the first one")
    parser.add_argument("--minutes", type=float, default=math.inf, help="stop after this time")
    parser.add_argument("--targets", nargs="+", choices=TARGETS, default=list(TARGETS))
    parser.add_argument("--work", nargs=4, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.work:
        name, good, start, stop = options.work
        _work(name, range(int(start), int(stop)), Path(good))
        return 0
    classes: dict[str, Counter[str]] = {name: Counter() for name in options.targets}
    spent: Counter[str] = Counter()
    began, stop = time.monotonic(), options.first + options.mutants
    with tempfile.TemporaryDirectory() as folder:
        good = {name: prepared(name, Path(folder) / name) for name in options.targets}
        for first in range(options.first, stop, ROUND):
            for name in options.targets:
                start = time.monotonic()
                if start - began > 60 * options.minutes:
                    continue
                for number, said in _in_processes(
                    name, range(first, min(first + ROUND, stop)), good[name]
                ):
                    classes[name][said if said in ("read", "refused") else "fault"] += 1
                    if said not in ("read", "refused"):
                        print(f"{name} {number}: {said}", flush=True)
                spent[name] += time.monotonic() - start
                count = classes[name].total()
                rate = count / spent[name]
                print(f"{name}: {count} mutants, {rate:.0f}/s, {dict(classes[name])}", flush=True)
    every = sum(classes.values(), Counter())
    print(f"all: {every.total()} mutants, {dict(every)}")
    return int(every["fault"] > 0)


if __name__ == "__main__":
    sys.exit(main())
