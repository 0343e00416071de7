"""Rows without values, at which a model is asked for its answer."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from offbeat.data.trajectory import Trajectory
from offbeat.errors import InputError

_MOST_ROWS = 20_000_000  # of a trajectory; a longer one is a wrong unit of the rate


def add_rows(trajectory: Trajectory, times: NDArray[np.float64]) -> Trajectory:
    """The trajectory with a row at each of these times; new rows have no values.

    Args:
        trajectory: to extend; its own rows are not changed.
        times: (times,) s, in any order; those of a row that is there add none.
    """
    union = np.union1d(trajectory.times, times)
    if len(union) == trajectory.rows:
        return trajectory
    own = np.searchsorted(union, trajectory.times)
    values = np.full((len(union), trajectory.channels), np.nan)
    observed = np.zeros(values.shape, dtype=bool)
    values[own], observed[own] = trajectory.values, trajectory.observed
    return replace(trajectory, times=union, values=values, observed=observed)


def even_times(trajectory: Trajectory, rate_hz: float) -> NDArray[np.float64]:
    """(times,) s, the first time and the multiples of a period after it, up to the last time.

    Args:
        trajectory: of any number of rows.
        rate_hz: one over the period, above 0.

    Raises:
        InputError: as of `times_at_rate`.
    """
    number = isinstance(rate_hz, int | float) and not isinstance(rate_hz, bool)
    if not (number and 0 < rate_hz < np.inf):
        raise InputError(f"rate_hz must be a positive number of rows per second, got {rate_hz!r}")
    times = trajectory.times
    lasts = float(times[-1] - times[0])
    if lasts * rate_hz > _MOST_ROWS:
        raise InputError(
            f"rate_hz {rate_hz:g} over {lasts:.6g} s gives {lasts * rate_hz:.3g} rows, more than "
            f"{_MOST_ROWS}; use a lower rate, or a shorter log"
        )
    return np.asarray(times[0] + np.arange(int(lasts * rate_hz * (1 + 1e-12)) + 1) / rate_hz)


def times_at_rate(trajectory: Trajectory, rate_hz: float) -> NDArray[np.float64]:
    """(times,) s, multiples of a period after the first row that no row is within half a period of.

    With rows at these times, no two consecutive rows are more than 1.5 periods apart.

    Args:
        trajectory: of any number of rows.
        rate_hz: one over the period, above 0.

    Raises:
        InputError: the rate is not above 0 and finite, or gives more than 20 million rows.
    """
    times, grid = trajectory.times, even_times(trajectory, rate_hz)
    after = np.clip(np.searchsorted(times, grid), 1, max(len(times) - 1, 1))
    nearest = np.minimum(
        np.abs(grid - times[after - 1]), np.abs(times[np.minimum(after, len(times) - 1)] - grid)
    )
    return np.asarray(grid[nearest >= 0.5 / rate_hz * (1 - 1e-9)])
