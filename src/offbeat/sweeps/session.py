"""A session of a sweep: sends tasks to an engine and adds finished runs to the record."""

from __future__ import annotations

import json
import math
import time
from collections import deque
from collections.abc import Iterable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from offbeat.errors import DivergenceError, OffbeatError
from offbeat.files import write_json
from offbeat.sweeps.engines.base import Engine
from offbeat.sweeps.plan import Run
from offbeat.sweeps.progress import Progress, duration, seconds_left
from offbeat.sweeps.provenance import cpu
from offbeat.sweeps.record import SESSIONS, Group, Record
from offbeat.sweeps.task import Task

_ATTEMPTS = 3

WAITS = 10.0
"""The record is written again after this many times the time that writing it took."""


class Session:
    """One session: sends tasks to an engine and writes the record after each run.

    Args:
        out: folder of the record.
        engine: runs the tasks.
        shown: reports the progress.
        record: the runs that are finished.
        order: names of all runs, in the order of the record.
        here: group of the runs that this process would make.
    """

    def __init__(
        self,
        out: Path,
        engine: Engine,
        shown: Progress,
        record: Record,
        order: tuple[str, ...],
        here: Group,
    ) -> None:
        self.out, self.engine, self.shown, self.record = out, engine, shown, record
        self.order, self.here = order, here
        self.asked: tuple[Run, ...] = ()
        self.deadline: float | None = None
        self.running: dict[str, Task] = {}
        self.waiting: deque[Task] = deque()
        self.attempts: dict[str, int] = {}
        self.diverged: list[str] = []
        self.groups = {*record.groups(), here}
        self.session = _SessionFile(out, engine.description)
        self._written_at, self._write_s, self._unwritten = -math.inf, 0.0, False

    def run(
        self, tasks: Iterable[Task], *, asked: Iterable[Run], deadline: float | None = None
    ) -> Record:
        """Performs the tasks; returns the record with all that succeeded.

        Args:
            tasks: in the order in which to start them.
            asked: requested runs, including finished ones.
            deadline: on the monotonic clock, s; stop then, in the middle of runs.

        Raises:
            DivergenceError: a training diverged; all others are finished.
            OffbeatError: a run failed otherwise, or lost its process three times.
        """
        self.waiting.extend(tasks)
        self.asked, self.deadline = tuple(asked), deadline
        try:
            while (self.waiting or self.running) and not self._over():
                while self.waiting and len(self.running) < self.engine.capacity:
                    task = self.waiting.popleft()
                    self.running[task.name] = task
                    self.engine.submit(task)
                for ending in self.engine.wait(self._patience()):
                    task = self.running.pop(ending.job.name)
                    if ending.lost:
                        self._again(task)
                    elif ending.failure is None:
                        self._finished(task)
                    elif ending.failure.diverged:
                        self.diverged.append(ending.failure.message)
                        self.shown.say(ending.failure.message)
                    else:
                        raise OffbeatError(
                            f"{ending.failure.message}; finished runs are kept, the same command "
                            "resumes once this is fixed"
                        )
                self._show()
            if self.running:
                names = ", ".join(self.running)
                self.shown.say(f"the time is over; the next call resumes: {names}")
        finally:
            self.engine.stop()
            self._write(now=True)
            self.running.clear()
            self._show(now=True)
            self.shown.close()
        if self.diverged:
            raise DivergenceError(
                f"{len(self.diverged)} of the runs diverged, all other requested ones are "
                f"done; the first: {self.diverged[0]}"
            )
        return self.record

    def _over(self) -> bool:
        return self.deadline is not None and time.monotonic() >= self.deadline

    def _patience(self) -> float:
        left = 1.0 if self.deadline is None else self.deadline - time.monotonic()
        return min(1.0, max(0.0, left))

    def _again(self, task: Task) -> None:
        name = task.name
        self.attempts[name] = self.attempts.get(name, 0) + 1
        if self.attempts[name] >= _ATTEMPTS:
            raise OffbeatError(
                f"the process of {name} was killed {_ATTEMPTS} times, perhaps for lack of memory; "
                "finished runs are kept: run the same command with fewer processes"
            )
        self.shown.say(f"the process of {name} was killed; another one resumes it")
        self.waiting.appendleft(task)

    def _finished(self, task: Task) -> None:
        row = task.result()
        if row is None:
            raise OffbeatError(
                f"{task.folder} has no result although the run ended; the workers must see "
                "the same folder as this process"
            )
        self.record = self.record.with_run(row, task.curve()).in_order(self.order)
        self._unwritten = True
        self._write()
        self.session.update(row["run_id"])
        group = self.record.group_of(row)
        if group not in self.groups:
            self.groups.add(group)
            self.shown.say(
                f"warning: {task.name} was made differently from this process: "
                f"{self.record.group_text(group, self.here)}; the record marks it"
            )
        scoring = next(iter(self.record.SCORINGS))
        rmse, trivial = (row[f"{which}{scoring}_mse"] ** 0.5 for which in ("", "last_value_"))
        self.shown.say(
            f"[{self._done()}/{len(self.asked)}] {task.name}: test RMSE {rmse:.4f}, last value "
            f"{trivial:.4f}, {duration(row['seconds'])}; left: {duration(self._left())}"
        )

    def _write(self, *, now: bool = False) -> None:
        """Writes the record, in no more than about a tenth of the time: it grows with each run.

        What is not written yet is in the folders of the runs, where the next call finds it.
        """
        began = time.monotonic()
        if self._unwritten and (now or began - self._written_at >= WAITS * self._write_s):
            self.record.write(self.out)
            self._written_at = time.monotonic()
            self._write_s, self._unwritten = self._written_at - began, False

    def _done(self) -> int:
        return sum(run.run_id in self.record.runs for run in self.asked)

    def _left(self) -> float | None:
        mine = [row for row in self.record.runs.values() if self.record.group_of(row) == self.here]
        waiting = [task.run for task in self.waiting]
        return seconds_left(waiting, self._epochs(), mine, capacity=self.engine.capacity)

    def _epochs(self) -> dict[Run, int]:
        return {task.run: len(task.curve()) for task in self.running.values()}

    def _show(self, *, now: bool = False) -> None:
        if not (now or self.shown.due()):
            return
        self.session.update()
        self.shown.update(
            done=self._done(),
            total=len(self.asked),
            left=self._left(),
            running=self._epochs(),
            more={"engine": self.engine.description, "diverged": self.diverged},
        )


class _SessionFile:
    """The runs and the duration of a call: the last entry of `sessions.json`.

    It is updated all the time, so that a killed call is counted up to its end.
    """

    def __init__(self, folder: Path, engine: str) -> None:
        self.path = folder / "sessions.json"
        self.before = read_sessions(folder)
        self.began = time.monotonic()
        self.line: dict[str, Any] = {
            "began_at": datetime.now(UTC).isoformat(timespec="seconds"),
            "seconds": 0.0,
            "engine": engine,
            "cpu": cpu(),
            "runs": [],
        }

    def update(self, run_id: str | None = None) -> None:
        if run_id:
            self.line["runs"].append(run_id)
        self.line["seconds"] = round(time.monotonic() - self.began, 1)
        write_json(self.path, [*self.before, self.line])


def read_sessions(folder: Path) -> list[dict[str, Any]]:
    """Reads when the calls that made a record began, their durations and their runs."""
    for name in SESSIONS:
        try:
            return list(json.loads((folder / f"{name}.json").read_text(encoding="utf-8")))
        except (OSError, ValueError, TypeError):
            continue
    return []
