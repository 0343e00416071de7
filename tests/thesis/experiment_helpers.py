"""A protocol of a second or two, and its numbers as one undisturbed process makes them."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from offbeat.sweeps.engines.base import Ending, Engine, Job, attempt
from thesis.protocol import Protocol
from thesis.record import Record

ROOT = Path(__file__).parents[2]

SMALL = replace(
    Protocol(),
    n_trajectories=24,
    recorded_rows=24,
    window=12,
    observed_fractions=(0.5,),
    hidden_size=3,
    decoder_units=(4,),
    field_units=(4,),
    anchored_hidden_size=3,
    anchored_field_units=(4,),
    epochs_of_curves=3,
    epochs_of_repeats=(2,),
    repeats=2,
)

LONG = replace(SMALL, epochs_of_curves=50)
"""Its runs of experiment 1 last long enough to be killed in the middle."""

ONLY = "experiment=1,model=gru,model=ode_gru_d"


class InThisProcess(Engine):
    """Does each task where it is given; for tests of what does not depend on processes."""

    def __init__(self, capacity: int = 1) -> None:
        self.capacity, self.description = capacity, "this process"
        self.given: list[str] = []
        self._jobs: list[Job] = []

    def submit(self, job: Job) -> None:
        self.given.append(job.name)
        self._jobs.append(job)

    def wait(self, seconds: float) -> list[Ending]:
        job = self._jobs.pop(0)
        return [Ending(job, attempt(job))]

    def stop(self) -> None:
        self._jobs.clear()


def numbers(record: Record) -> dict[str, Any]:
    """All that must be the same however a record came about: no wall time, no date."""
    runs = {
        name: {k: repr(v) for k, v in row.items() if k not in ("seconds", "finished_at")}
        for name, row in record.runs.items()
    }
    curves = {
        name: [{k: repr(v) for k, v in line.items() if k != "seconds"} for line in lines]
        for name, lines in record.curves.items()
    }
    return {"runs": runs, "curves": curves}


def script(protocol: Protocol, out: Path, **options: Any) -> list[str]:
    """A command that reproduces a protocol in a process of its own."""
    changes = {k: v for k, v in asdict(protocol).items() if v != getattr(Protocol(), k)}
    code = (
        "from thesis.protocol import Protocol\n"
        "from thesis.reproduce import reproduce\n"
        "if __name__ == '__main__':\n"
        f"    reproduce(Protocol(**{changes!r}), {str(out)!r}, **{options!r})\n"
    )
    path = out.parent / f"{out.name}.py"
    path.write_text(code, encoding="utf-8")
    return [sys.executable, str(path)]


def wait_until(true: Any, *, seconds: float = 240.0, process: Any = None) -> None:
    """Waits for a condition; fails when it does not come about, or a process ends before."""
    end = time.monotonic() + seconds
    while not true():
        if process is not None and process.poll() is not None:
            raise AssertionError(f"ended with {process.returncode}: {process.stderr.read()}")
        if time.monotonic() > end:
            raise AssertionError(f"not within {seconds} s: {true}")
        time.sleep(0.02)


def start(command: list[str]) -> Any:
    """A process whose standard error can be read, and which finds `thesis` as from the project."""
    path = os.pathsep.join([str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])])
    environment = {**os.environ, "PYTHONPATH": path}
    return subprocess.Popen(command, stderr=subprocess.PIPE, text=True, env=environment)
