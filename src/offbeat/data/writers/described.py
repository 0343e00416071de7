"""What several writers need of a data set: its clock, labels, rate, and intervals."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from offbeat.data.cleaning.clocks import NANOSECONDS_PER
from offbeat.data.trajectory import ACTION, Dataset, Trajectory
from offbeat.errors import InputError

_LARGEST = 2**63 - 1


def clocks(dataset: Dataset) -> list[NDArray[np.int64]]:
    """(rows,) nanoseconds of each trajectory, on the clock of the log where it is known.

    Args:
        dataset: `clock_start` of its meta is the clock at time 0 of each trajectory, in its
            `time_unit`. Without it, or where it does not fit in an int64, the times count from 0.
    """
    starts = dataset.meta.get("clock_start", ())
    unit = NANOSECONDS_PER.get(str(dataset.meta.get("time_unit", "s")), 10**9)
    known = len(starts) == len(dataset)
    every = []
    for i, trajectory in enumerate(dataset):
        since = np.rint(trajectory.times * 1e9)
        start = starts[i] * unit if known else 0
        start = int(start) if isinstance(start, int) else round(start)
        last = start + int(since[-1])
        fits = -_LARGEST <= start <= _LARGEST and last <= _LARGEST
        every.append(since.astype(np.int64) + (start if fits else 0))
    return every


def labels(dataset: Dataset) -> list[str]:
    """A name per trajectory: its label where all have one and they differ, else its number."""
    given = [str(label) for label in dataset.meta.get("labels", ())]
    if len(given) == len(dataset) == len(set(given)):
        return given
    return [str(i) for i in range(len(dataset))]


def rate_of(dataset: Dataset) -> float:
    """Rows per second, one over the median time between rows; 1 where no trajectory has two."""
    gaps = [np.diff(t.times) for t in dataset if t.rows > 1]
    return float(1 / np.median(np.concatenate(gaps))) if gaps else 1.0


def checked_rate(dataset: Dataset, rate_hz: float | None) -> float:
    """The rate given, or that of the data; whole numbers where it is within 0.1 % of one.

    Raises:
        InputError: it is not above 0.
    """
    rate = rate_of(dataset) if rate_hz is None else rate_hz
    if isinstance(rate, bool) or not 0 < rate < float("inf"):
        raise InputError(f"rate_hz must be a positive number of rows per second, got {rate_hz!r}")
    whole = round(rate)
    return float(whole) if whole and abs(rate - whole) <= 1e-3 * rate else float(rate)


def interval(
    trajectory: Trajectory, level: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
    """(rows, channels) ends of the intervals of an `Answer`, None for values without any.

    Args:
        trajectory: any.
        level: probability of the intervals.
    """
    if getattr(trajectory, "widths", None) is None:
        return None
    ends: tuple[Any, Any] = trajectory.interval(level)  # type: ignore[attr-defined]
    return ends


def states_and_actions(dataset: Dataset) -> tuple[list[int], list[int]]:
    """Positions of the channels that are no actions, and of the actions.

    Raises:
        InputError: there are only actions.
    """
    acted = [i for i, role in enumerate(dataset.roles) if role == ACTION]
    states = [i for i in range(dataset.channels) if i not in acted]
    if not states:
        raise InputError(
            "the data set has only actions, and this format needs observations; give one channel "
            "another role"
        )
    return states, acted


def as_names(dataset: Dataset, index: Sequence[int], prefix: str = "") -> list[str]:
    """Names of channels, without a prefix that readers put before them."""
    return [re.sub(f"^{re.escape(prefix)}(?=.)", "", dataset.names[i]) for i in index]
