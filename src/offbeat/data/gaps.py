"""The usual time between rows, where sensors may report almost at once."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from offbeat.data.trajectory import Trajectory

_AT_ONCE = 0.05
"""Rows are nearer than sensors ever report where their median gap is below this fraction of the
median step of the fastest channel."""


def usual_gap(gap: float, fastest: float) -> float:
    """The time between rows that a model counts in, in s.

    Two sensors that report within microseconds of each other give rows whose median gap is these
    microseconds, in which nothing moves. The step of the fastest channel is taken then.

    Args:
        gap: s, median time between rows.
        fastest: s, smallest median time between two observations of a channel; 0 if unknown.
    """
    return fastest if gap < _AT_ONCE * fastest else gap


def fastest_step(
    times: NDArray[np.float64], of: NDArray[np.int64], observed: NDArray[np.bool_]
) -> float:
    """Smallest median time between two observations of a channel, in s; 0 without any two.

    Args:
        times: (rows,) s, of all trajectories, one after the other.
        of: (rows,) the trajectory of each row.
        observed: (rows, channels).
    """
    found = [
        float(np.median(steps))
        for mask in observed.T
        if len(steps := np.diff(times[mask])[np.diff(of[mask]) == 0])
    ]
    return min(found, default=0.0)


def fastest_step_of(trajectories: Iterable[Trajectory]) -> float:
    """As `fastest_step`, of all channels of some trajectories."""
    each = list(trajectories)
    return fastest_step(
        np.concatenate([t.times for t in each]),
        np.repeat(np.arange(len(each)), [t.rows for t in each]),
        np.concatenate([t.observed for t in each]),
    )
