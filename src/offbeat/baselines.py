"""Baselines: simple predictors of fills and forecasts, without training."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from offbeat.data.trajectory import Trajectory
from offbeat.errors import InputError
from offbeat.registry import Registry

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Baseline:
    """A predictor of one channel from its own observations.

    Attributes:
        predict: (at, times, values, mean) to the values at the times `at`, from observations
            `values` at `times` (at least one) and the training mean of the channel. A causal
            baseline uses observations strictly before each of `at`.
        causal: whether it uses only the past.
        fills: whether it is a baseline of fills.
        forecasts: whether it is a baseline of forecasts; it must be causal.
    """

    predict: Callable[[Array, Array, Array, float], Array]
    causal: bool
    fills: bool = True
    forecasts: bool = False

    def __post_init__(self) -> None:
        if self.forecasts and not self.causal:
            raise InputError("a baseline that forecasts must be causal")


BASELINES: Registry[Baseline] = Registry("baseline", group="offbeat.baselines")
"""Baselines by name."""


def fillers() -> tuple[str, ...]:
    """Names of the baselines of fills."""
    return tuple(name for name, baseline in BASELINES.items() if baseline.fills)


def forecasters() -> tuple[str, ...]:
    """Names of the baselines of forecasts."""
    return tuple(name for name, baseline in BASELINES.items() if baseline.forecasts)


def fill(trajectory: Trajectory, method: str, mean: Sequence[float]) -> Array:
    """Fills each channel on its own from its observations; masked values are not used.

    - `last_value` repeats the last observed value; before the first, the training mean.
    - `linear` is a straight line between neighbours (`numpy.interp`).
    - `pchip` is the monotone cubic of Fritsch and Butland (1984) through all of them
      (`scipy.interpolate.PchipInterpolator`).

    The last two use the future; before the first observation and after the last they are constant.
    For a channel that is never observed, all give the training mean.

    Args:
        trajectory: the observed trajectory.
        method: name of a baseline.
        mean: training mean of each channel, in its unit.

    Returns:
        (rows, channels) in original units. At an observed row, an interpolation gives the observed
        value, and a causal baseline its prediction from earlier observations.

    Raises:
        InputError: there is no such baseline.
    """
    return _predicted(trajectory, trajectory.times, method, mean)


def forecast(trajectory: Trajectory, times: Array, method: str, mean: Sequence[float]) -> Array:
    """Predicts after the last observation of each channel.

    - `last_value` repeats it.
    - `constant_velocity` is the straight line through the last two; with one, it repeats that.

    For a channel that is never observed, both give the training mean.

    Args:
        trajectory: the observed trajectory.
        times: (times,) s, after the last observation.
        method: name of a causal baseline.
        mean: training mean of each channel, in its unit.

    Returns:
        (times, channels) in original units.

    Raises:
        InputError: there is no such baseline, or it is not causal.
    """
    if not BASELINES[method].causal:
        raise InputError(
            f"the baseline {method!r} uses the future and cannot forecast; choose one of "
            f"{', '.join(forecasters())}"
        )
    return _predicted(trajectory, times, method, mean)


def _predicted(trajectory: Trajectory, at: Array, method: str, mean: Sequence[float]) -> Array:
    baseline = BASELINES[method]
    predicted = np.empty((len(at), trajectory.channels))
    for channel, expected in enumerate(mean):
        seen = np.flatnonzero(trajectory.observed[:, channel])
        if not len(seen):
            predicted[:, channel] = expected
            continue
        times, values = trajectory.times[seen], trajectory.values[seen, channel]
        predicted[:, channel] = baseline.predict(at, times, values, float(expected))
    return predicted


def _last_value(at: Array, times: Array, values: Array, mean: float) -> Array:
    before = np.searchsorted(times, at) - 1
    return np.where(before >= 0, values[np.maximum(before, 0)], mean)


def _constant_velocity(at: Array, times: Array, values: Array, mean: float) -> Array:
    last = _last_value(at, times, values, mean)
    if len(times) < 2:
        return last
    before = np.searchsorted(times, at) - 1
    end = np.maximum(before, 1)
    slope = (values[end] - values[end - 1]) / (times[end] - times[end - 1])
    return np.where(before >= 1, last + slope * (at - times[end]), last)


def _linear(at: Array, times: Array, values: Array, mean: float) -> Array:
    return np.interp(at, times, values)


def _pchip(at: Array, times: Array, values: Array, mean: float) -> Array:
    from scipy.interpolate import PchipInterpolator

    if len(times) < 2:
        return np.full(len(at), values[0])
    curve = PchipInterpolator(times - times[0], values)
    return np.asarray(curve(np.clip(at, times[0], times[-1]) - times[0]), dtype=np.float64)


BASELINES.register("last_value", Baseline(_last_value, causal=True, forecasts=True))
BASELINES.register(
    "constant_velocity", Baseline(_constant_velocity, causal=True, fills=False, forecasts=True)
)
BASELINES.register("linear", Baseline(_linear, causal=False))
BASELINES.register("pchip", Baseline(_pchip, causal=False))
