"""Trivial predictors that stand beside every fill and every forecast; nothing to train."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from offbeat.data.trajectory import Trajectory
from offbeat.errors import one_of


def fill(trajectory: Trajectory, method: str, mean: Sequence[float]) -> NDArray[np.float64]:
    """Fills each channel on its own from its observed cells; hidden values are not looked at.

    - `last_value` repeats the last observed value; before the first, the training mean.
    - `linear` draws a straight line between neighbours (`numpy.interp`).
    - `pchip` draws the monotone cubic of Fritsch and Butland (1984) through all of them
      (`scipy.interpolate.PchipInterpolator`).

    The last two look ahead; before the first observation and after the last they hold it. Where a
    channel is never observed, all give the training mean.

    Args:
        trajectory: what was observed.
        method: one of `FILLERS`.
        mean: training mean of each channel, in its unit.

    Returns:
        (rows, channels) in original units; at observed cells, what was observed, but for
        `last_value`, which is causal: there it is the value before.
    """
    function = _FILLERS[one_of("trivial predictor", method, FILLERS)]
    filled = np.empty(trajectory.values.shape)
    for channel, expected in enumerate(mean):
        seen = np.flatnonzero(trajectory.observed[:, channel])
        if not len(seen):
            filled[:, channel] = expected
            continue
        times, values = trajectory.times[seen], trajectory.values[seen, channel]
        filled[:, channel] = function(trajectory.times, times, values, expected)
    return filled


def forecast(
    trajectory: Trajectory, times: NDArray[np.float64], method: str, mean: Sequence[float]
) -> NDArray[np.float64]:
    """Goes on after the last observation of each channel.

    - `last_value` holds it.
    - `constant_velocity` goes on along the straight line through the last two.

    Where a channel has been observed once, both hold; where never, both give the training mean.

    Args:
        trajectory: what was observed.
        times: (times,) s, not before the last observation.
        method: one of `FORECASTERS`.
        mean: training mean of each channel, in its unit.

    Returns:
        (times, channels) in original units.
    """
    one_of("trivial predictor", method, FORECASTERS)
    ahead = np.empty((len(times), trajectory.channels))
    for channel, expected in enumerate(mean):
        seen = np.flatnonzero(trajectory.observed[:, channel])[-2:]
        if not len(seen):
            ahead[:, channel] = expected
            continue
        at, values = trajectory.times[seen], trajectory.values[seen, channel]
        ahead[:, channel] = values[-1]
        if method == "constant_velocity" and len(seen) == 2:
            ahead[:, channel] += (values[1] - values[0]) / (at[1] - at[0]) * (times - at[1])
    return ahead


_Array = NDArray[np.float64]


def _last_value(at: _Array, times: _Array, values: _Array, mean: float) -> _Array:
    before = np.searchsorted(times, at) - 1
    return np.where(before >= 0, values[np.maximum(before, 0)], mean)


def _linear(at: _Array, times: _Array, values: _Array, mean: float) -> _Array:
    return np.interp(at, times, values)


def _pchip(at: _Array, times: _Array, values: _Array, mean: float) -> _Array:
    from scipy.interpolate import PchipInterpolator

    if len(times) < 2:
        return np.full(len(at), values[0])
    curve = PchipInterpolator(times - times[0], values)
    return np.asarray(curve(np.clip(at, times[0], times[-1]) - times[0]), dtype=np.float64)


_FILLERS: dict[str, Callable[[_Array, _Array, _Array, float], _Array]] = {
    "last_value": _last_value,
    "linear": _linear,
    "pchip": _pchip,
}

FILLERS = tuple(_FILLERS)
"""What stands beside every imputation."""

FORECASTERS = ("last_value", "constant_velocity")
"""What stands beside every extrapolation."""
