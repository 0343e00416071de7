"""Baselines of one line: last value, mean, constant velocity, damped slope, line and PCHIP."""

from __future__ import annotations

from typing import Any

import numpy as np

from offbeat.baselines.base import (
    BASELINES,
    Array,
    Baseline,
    CausalBaseline,
    State,
    as_kind,
    channels_of,
    namespace,
    padded,
    stepped,
)
from offbeat.baselines.history import AgeBins, History, filled_bins
from offbeat.data.trajectory import Dataset, Trajectory


class LastValue(CausalBaseline):
    """Repeats the last observed value; before the first one, the training mean."""

    history = History(1)

    def start(self, like: Any) -> State:
        """See `CausalBaseline`."""
        return self.history.start(like)

    def observe(self, state: State, time: Any, values: Any, mask: Any) -> State:
        """See `CausalBaseline`."""
        return self.history.observe(state, time, values, mask)

    def read(self, state: State, time: Any) -> Any:
        """See `CausalBaseline`."""
        return History.last(state, as_kind(self.mean, state["count"]))


class Mean(LastValue):
    """The training mean."""

    located = True

    def read(self, state: State, time: Any) -> Any:
        """See `CausalBaseline`."""
        return 0.0 * state["count"] + as_kind(self.mean, state["count"])


class RunningMean(CausalBaseline):
    """The mean of what was observed in the trajectory, drawn to the training mean.

    The training mean counts as ten observations.
    """

    located = True

    PRIOR = 10.0

    def start(self, like: Any) -> State:
        """See `CausalBaseline`."""
        return {"sum": like, "count": like}

    def observe(self, state: State, time: Any, values: Any, mask: Any) -> State:
        """See `CausalBaseline`."""
        xp = namespace(values)
        seen = xp.where(mask, values - as_kind(self.mean, values), 0.0)
        return {"sum": state["sum"] + seen, "count": state["count"] + mask}

    def read(self, state: State, time: Any) -> Any:
        """See `CausalBaseline`."""
        return as_kind(self.mean, state["sum"]) + state["sum"] / (state["count"] + self.PRIOR)


class ConstantVelocity(LastValue):
    """The straight line through the last two observations; with one of them, its value."""

    history = History(2)

    def read(self, state: State, time: Any) -> Any:
        """See `CausalBaseline`."""
        xp = namespace(state["count"])
        age = xp.where(state["count"] > 1, time - state["times"][..., 0], 0.0)
        return super().read(state, time) + History.slope(state) * age


class DampedSlope(ConstantVelocity):
    """Constant velocity times a factor of the channel and of the time since observation.

    The factor of a bin of `AgeBins` is the least-squares one on the tasks, from 0 to 1.5; between
    the middles of bins it is interpolated.
    """

    edges: Array
    factor: Array  # (bins, channels)

    def estimate(self, tasks: Dataset) -> None:
        """See `Baseline`."""
        bins = AgeBins.of(tasks)
        cross, square, count = (np.zeros((len(bins), tasks.channels)) for _ in range(3))
        channel = np.arange(tasks.channels)
        for rows in padded(tasks):
            last = stepped(_Of(self, LastValue.read), rows)
            line = stepped(_Of(self, ConstantVelocity.read), rows)
            age = stepped(_Of(self, lambda _, state, time: History.age(state, time)), rows)
            counted = rows.known & np.isfinite(age)
            at = bins.of_age(age)
            where = (at[counted], np.broadcast_to(channel, age.shape)[counted])
            move = (line - last)[counted]
            np.add.at(cross, where, move * (rows.values - last)[counted])
            np.add.at(square, where, move**2)
            np.add.at(count, where, 1.0)
        self.edges = bins.edges
        factor = np.clip(cross / np.where(square > 0, square, 1.0), 0.0, 1.5)
        self.factor = filled_bins(factor, count)

    def read(self, state: State, time: Any) -> Any:
        """See `CausalBaseline`."""
        xp = namespace(state["count"])
        last = LastValue.read(self, state, time)
        line = super().read(state, time)
        age = History.age(state, time)
        at, part = AgeBins(self.edges).between(xp.where(xp.isinf(age), 0.0, age))
        factor, channel, end = as_kind(self.factor, line), channels_of(line), len(self.edges) - 1
        further = factor[xp.where(at < end, at + 1, end), channel]
        return last + ((1 - part) * factor[at, channel] + part * further) * (line - last)

    def arrays(self) -> dict[str, Array]:
        """See `Baseline`."""
        return {**super().arrays(), "edges": self.edges, "factor": self.factor}


class Linear(Baseline):
    """A straight line between the observations around; outside all of them, the nearest one."""

    causal = False

    def predict(self, dataset: Dataset) -> list[Array]:
        """See `Baseline`. At an observed row, the line between its neighbours."""
        return [_each_mask(t, self.mean, _line) for t in dataset]


class Pchip(Baseline):
    """The monotone cubic of Fritsch and Butland (1984) through the observations.

    Outside all of them, the nearest one. `scipy.interpolate.PchipInterpolator`.
    """

    causal = False

    def predict(self, dataset: Dataset) -> list[Array]:
        """See `Baseline`. At an observed row, the observed value itself."""
        return [_each_mask(t, self.mean, _pchip) for t in dataset]


def _each_mask(trajectory: Trajectory, mean: Array, curve: Any) -> Array:
    """Interpolates the channels that are observed in the same rows together."""
    predicted = np.empty((trajectory.rows, trajectory.channels))
    observed = trajectory.observed
    _, group = np.unique(np.packbits(observed, axis=0), axis=1, return_inverse=True)
    for g in range(group.max() + 1):
        at = np.flatnonzero(group == g)
        seen = np.flatnonzero(observed[:, at[0]])
        predicted[:, at] = mean[at]
        if len(seen):
            values = trajectory.values[np.ix_(seen, at)]
            predicted[:, at] = curve(trajectory.times, trajectory.times[seen], values)
    return predicted


def _line(at: Array, times: Array, values: Array) -> Array:
    if len(times) < 2:
        return np.repeat(values, len(at), axis=0)
    start = np.clip(np.searchsorted(times, at, side="right") - 1, 0, len(times) - 2)
    part = np.clip((at - times[start]) / (times[start + 1] - times[start]), 0.0, 1.0)[:, None]
    return np.asarray((1 - part) * values[start] + part * values[start + 1])


def _pchip(at: Array, times: Array, values: Array) -> Array:
    from scipy.interpolate import PchipInterpolator

    if len(times) < 2:
        return np.repeat(values, len(at), axis=0)
    curve = PchipInterpolator(times - times[0], values)
    return np.asarray(curve(np.clip(at, times[0], times[-1]) - times[0]), dtype=np.float64)


class _Of:
    """A baseline that reads something else."""

    def __init__(self, baseline: CausalBaseline, read: Any) -> None:
        self.start, self.observe = baseline.start, baseline.observe
        self._baseline, self._read = baseline, read

    def read(self, state: State, time: Any) -> Any:
        return self._read(self._baseline, state, time)


_SIMPLE: dict[str, type[Baseline]] = {
    "last_value": LastValue,
    "mean": Mean,
    "running_mean": RunningMean,
    "constant_velocity": ConstantVelocity,
    "damped_slope": DampedSlope,
    "linear": Linear,
    "pchip": Pchip,
}
for _name, _kind in _SIMPLE.items():
    BASELINES.register(_name, _kind)
