"""What a peer is given and what it answers. Nothing here holds a value that is scored."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Series:
    """Rows of several channels.

    Attributes:
        times: (rows,) s.
        values: (rows, channels) in original units, NaN where not seen.
        truth: (rows, channels) known values, in windows to fit and validate with; None in tasks.
    """

    times: Array
    values: Array
    truth: Array | None = None


@dataclass(frozen=True, eq=False)
class Answer:
    """Answers to a series.

    Attributes:
        values: (rows, channels) in original units, finite where `Series.values` is NaN.
        low: the same, lower end of an interval of 90 %; None without intervals.
        high: upper end.
    """

    values: Array
    low: Array | None = None
    high: Array | None = None


Answerer = Callable[[str, Sequence[Series]], list[Answer]]
"""Fills every NaN of the series of a task, given its name. In a `forecast` these are in the last
row, and answers to the others do not count."""


@dataclass(frozen=True, eq=False)
class Problem:
    """A log as every peer gets it.

    Attributes:
        log: its name.
        channels: names.
        sensors: positions of the channels that drop out together.
        pairs: positions of a channel and of the one that is its derivative.
        scale: (channels,) one scaled unit, in the unit of each channel.
        mean: (channels,) of the training windows.
        hidden: what fills hide: `dropouts` of 0.5 s per sensor, or `rows`, 70 % of them.
        horizons_s: of the forecasts; none where only fills are asked.
        train: the training part, whole, as logged.
        validation: the validation part, as logged.
        fit: windows of the training part, masked as the fills are, with truth.
        held_out: the same of the validation part.
        asked: series by task. In `forecast` ones the last row is to be predicted from the others.
    """

    log: str
    channels: tuple[str, ...]
    sensors: tuple[tuple[int, ...], ...]
    pairs: tuple[tuple[int, int], ...]
    scale: Array
    mean: Array
    hidden: str
    horizons_s: tuple[float, ...]
    train: tuple[Series, ...]
    validation: tuple[Series, ...]
    fit: tuple[Series, ...]
    held_out: tuple[Series, ...]
    asked: Mapping[str, tuple[Series, ...]]

    @property
    def step_s(self) -> float:
        """Median time between rows of the training part, s."""
        return float(np.median(np.concatenate([np.diff(s.times) for s in self.train])))

    def scaled(self, values: Array) -> Array:
        """Values in units of the scale, from the mean.

        Args:
            values: (rows, channels).
        """
        return np.asarray((values - self.mean) / self.scale)

    def filled(self, values: Array) -> Array:
        """Scaled values, each NaN replaced by the value before; by the mean before the first.

        Args:
            values: (rows, channels).
        """
        scaled = self.scaled(values)
        rows = np.where(np.isfinite(scaled), np.arange(len(scaled))[:, None], -1)
        last = np.maximum.accumulate(rows, axis=0)
        return np.where(last >= 0, np.take_along_axis(scaled, np.maximum(last, 0), axis=0), 0.0)


_HEAD = ("log", "channels", "sensors", "pairs", "hidden", "horizons_s")
_PARTS = ("train", "validation", "fit", "held_out")


def save(problem: Problem, path: Path) -> None:
    """Writes a problem as NPZ; equal problems give equal files.

    Args:
        problem: to write.
        path: of the file.
    """
    head = {name: getattr(problem, name) for name in _HEAD} | {"tasks": list(problem.asked)}
    arrays: dict[str, Any] = {"head": np.array(json.dumps(head))}
    arrays |= {"scale": problem.scale, "mean": problem.mean}
    named = {part: getattr(problem, part) for part in _PARTS} | dict(problem.asked)
    for name, series in named.items():
        arrays[f"{name}|rows"] = np.array([len(s.times) for s in series])
        arrays[f"{name}|times"] = np.concatenate([s.times for s in series])
        arrays[f"{name}|values"] = np.concatenate([s.values for s in series])
        if series[0].truth is not None:
            arrays[f"{name}|truth"] = np.concatenate([s.truth for s in series])
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savez(path, **arrays)


def load(path: Path) -> Problem:
    """Reads what `save` wrote.

    Args:
        path: of the file.
    """
    with np.load(path, allow_pickle=False) as file:
        arrays = {name: file[name] for name in file.files}
    head = json.loads(str(arrays["head"]))
    tasks = head.pop("tasks")

    def series(name: str) -> tuple[Series, ...]:
        ends = np.cumsum(arrays[f"{name}|rows"])[:-1]
        kinds = [key for key in ("times", "values", "truth") if f"{name}|{key}" in arrays]
        cut = [np.split(arrays[f"{name}|{key}"], ends) for key in kinds]
        return tuple(Series(*each) for each in zip(*cut, strict=True))

    return Problem(
        scale=arrays["scale"],
        mean=arrays["mean"],
        asked={task: series(task) for task in tasks},
        **{key: _tuples(value) for key, value in head.items()},
        **{part: series(part) for part in _PARTS},
    )


def digest(path: Path) -> str:
    """Twelve digits that change with anything a peer is given.

    Args:
        path: of a file of `save`.
    """
    found = hashlib.sha256()
    with np.load(path, allow_pickle=False) as file:
        for name in sorted(file.files):
            array = file[name]
            found.update(name.encode() + str(array.shape).encode() + array.tobytes())
    return found.hexdigest()[:12]


def _tuples(value: Any) -> Any:
    return tuple(_tuples(v) for v in value) if isinstance(value, list) else value
