"""Progress of a sweep: a line on the terminal and a status file."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from offbeat.files import write_json
from offbeat.sweeps.plan import Run
from offbeat.sweeps.record import Row

_EVERY_S = 5.0


def seconds_left(
    waiting: Sequence[Run],
    running: Mapping[Run, int],
    finished: Sequence[Row],
    *,
    capacity: int,
) -> float | None:
    """Estimates the remaining wall time from the cost of an epoch of each model so far.

    Args:
        waiting: runs that have not started.
        running: runs in progress, each with its finished epochs.
        finished: rows of the record that were made here.
        capacity: runs at a time.

    Returns:
        Seconds, or None before any run has finished.
    """
    seconds: dict[str, float] = {}
    epochs: dict[str, int] = {}
    for row in finished:
        seconds[row["model"]] = seconds.get(row["model"], 0.0) + row["seconds"]
        epochs[row["model"]] = epochs.get(row["model"], 0) + row["epochs"]
    if not seconds:
        return None
    usual = sum(seconds.values()) / sum(epochs.values())

    def cost(run: Run, done: int) -> float:
        known = run.model in seconds
        each = seconds[run.model] / epochs[run.model] if known else usual
        return each * max(0, run.epochs - done)

    total = sum(cost(run, 0) for run in waiting) + sum(cost(r, n) for r, n in running.items())
    at_a_time = max(1, min(capacity, len(waiting) + len(running)))
    longest = max((cost(run, n) for run, n in running.items()), default=0.0)
    return max(total / at_a_time, longest)


def duration(seconds: float | None) -> str:
    """A duration in words."""
    if seconds is None:
        return "unknown"
    minutes = round(seconds / 60)
    if minutes < 1:
        return f"{seconds:.0f} s"
    return f"{minutes} min" if minutes < 60 else f"{minutes // 60} h {minutes % 60:02d} min"


class Progress:
    """Shows the progress and writes it to a file.

    Args:
        path: of the status file (JSON).
        show: print to standard error: a line that updates on a terminal, else a line per run.
    """

    def __init__(self, path: Path, *, show: bool) -> None:
        self.path, self.show = path, show
        self._line = show and sys.stderr.isatty()
        self._last = -_EVERY_S
        self._width = 0

    def say(self, text: str) -> None:
        """Prints a separate line."""
        if self.show:
            self._clear()
            print(text, file=sys.stderr, flush=True)

    def due(self) -> bool:
        """Whether the next update is due."""
        return time.monotonic() - self._last >= _EVERY_S

    def update(
        self,
        *,
        done: int,
        total: int,
        left: float | None,
        running: Mapping[Run, int],
        more: Mapping[str, Any],
    ) -> None:
        """Shows the progress and writes it to the status file.

        Args:
            done: runs finished.
            total: runs in all.
            left: s, or None where it is not known yet.
            running: runs in progress with their finished epochs.
            more: additional entries of the status file.
        """
        self._last = time.monotonic()
        write_json(
            self.path,
            {
                "runs_done": done,
                "runs_total": total,
                "seconds_left": left,
                "running": [
                    {"run_id": run.run_id, "epoch": epoch, "epochs": run.epochs}
                    for run, epoch in running.items()
                ],
                "updated_at": datetime.now(UTC).isoformat(timespec="seconds"),
                "pid": os.getpid(),
                **more,
            },
        )
        if self._line:
            names = ", ".join(f"{run.run_id} {n}/{run.epochs}" for run, n in running.items())
            text = f"{done}/{total} runs, left: {duration(left)}; {names}"[: _columns() - 1]
            self._clear()
            print(text, end="", file=sys.stderr, flush=True)
            self._width = len(text)

    def close(self) -> None:
        """Ends the line."""
        self._clear()

    def _clear(self) -> None:
        if self._width:
            print("\r" + " " * self._width + "\r", end="", file=sys.stderr, flush=True)
            self._width = 0


def _columns() -> int:
    try:
        return os.get_terminal_size(sys.stderr.fileno()).columns
    except OSError:
        return 80
