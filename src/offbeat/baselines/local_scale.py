"""How much each channel moves at present, compared to how much it usually does."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from offbeat.baselines.base import Array, State, as_kind, namespace, padded, stepped
from offbeat.baselines.history import AgeBins, History, filled_bins
from offbeat.baselines.simple import DampedSlope
from offbeat.data.trajectory import Dataset

FORGET = 0.08
"""Weight of the newest error in the running mean."""

JUMP = 25.0
"""Largest new error, as a multiple of the mean so far or of the usual one."""

LARGEST = 1e4
SMALLEST = 1e-6

PASSES = 2
"""Times that the usual start is measured; the first time starts at 1."""


class LocalScale:
    """A running mean of squared errors one observation ahead, relative to those of training.

    Each observation is predicted by a damped slope; its squared error, divided by the mean one at
    that time since observation, enters a mean that forgets. The result is 1 where a channel moves
    as it usually does, near 0 where it rests. Before there is an error, it is the median of
    training: in a log that mostly rests, a trajectory is taken to rest until it moves.

    Attributes:
        slope: the predictor.
        middle: (bins,) mean logarithm of the times since observation in each bin.
        usual: (bins, channels) mean squared error of training, in squared units.
        median: (channels,) median of the running mean in training.
    """

    slope: DampedSlope
    middle: Array
    usual: Array
    median: Array

    def fit(self, tasks: Dataset) -> LocalScale:
        """Fits to tasks; returns itself.

        Args:
            tasks: as of `Baseline.fit`.
        """
        self.slope = DampedSlope()
        self.slope.fit(tasks)
        bins = AgeBins(self.slope.edges)
        total = np.zeros((len(bins), tasks.channels))
        count, logs = np.zeros_like(total), np.zeros(len(bins))
        channel = np.arange(tasks.channels)
        for rows in padded(tasks):
            predicted = stepped(self.slope, rows)
            age = stepped(_Age(self.slope), rows)
            counted = rows.known & np.isfinite(age)
            where = (bins.of_age(age)[counted], np.broadcast_to(channel, age.shape)[counted])
            np.add.at(total, where, (rows.values - predicted)[counted] ** 2)
            np.add.at(count, where, 1.0)
            np.add.at(logs, where[0], np.log(np.maximum(age[counted], 1e-300)))
        mean = filled_bins(total / np.maximum(count, 1), count)
        many = count.sum(axis=1)
        self.middle = np.where(many > 0, logs / np.maximum(many, 1), np.log(bins.middle))
        floor = 1e-12 * self.slope.scale**2
        self.usual = np.maximum(mean, floor)
        self.median = np.ones(tasks.channels)
        for _ in range(PASSES):
            self.median = self._median(tasks)
        return self

    def _median(self, tasks: Dataset) -> Array:
        """(channels,) median of the running mean where it has an error; 1 where it never has."""
        found: list[list[Array]] = [[] for _ in range(tasks.channels)]
        for rows in padded(tasks):
            square, seen = np.moveaxis(stepped(_Square(self), rows), -1, 0)
            for channel, squares in enumerate(found):
                counted = rows.known[..., channel] & (seen[..., channel] > 0)
                squares.append(square[..., channel][counted])
        every = (np.concatenate(squares) for squares in found)
        return np.array([np.median(squares) if len(squares) else 1.0 for squares in every])

    def start(self, like: Any) -> State:
        """See `CausalBaseline`."""
        square = like + as_kind(self.median, like)
        return {**self.slope.start(like), "square": square, "seen": like}

    def observe(self, state: State, time: Any, values: Any, mask: Any) -> State:
        """See `CausalBaseline`."""
        xp = namespace(values)
        predicted = self.slope.read(state, time)
        usual = self.usual_at(History.age(state, time))
        # A single wild value does not make the next hundred rows look like motion.
        most = JUMP * xp.clip(state["square"], 1.0, LARGEST)
        error = xp.minimum((values - predicted) ** 2 / usual, most)
        counted = mask & (state["count"] > 1)
        weight = xp.clip(1.0 / (state["seen"] + 2.0), FORGET, 1.0)
        square = state["square"] + weight * (error - state["square"])
        square = xp.clip(square, SMALLEST, LARGEST)
        after = self.slope.observe(state, time, values, mask)
        return {
            **after,
            "square": xp.where(counted, square, state["square"]),
            "seen": state["seen"] + counted,
        }

    def usual_at(self, age: Any) -> Any:
        """Usual squared error at a time since observation, log-linear between the bins' middles.

        Args:
            age: (..., channels) s; infinite before the first observation.

        Returns:
            (..., channels) in squared units.
        """
        xp = namespace(age)
        bins = AgeBins(self.slope.edges)
        logs = as_kind(np.log(self.usual), age)
        channel = np.arange(len(self.usual[0])) if xp is np else xp.arange(len(self.usual[0]))
        if len(bins) == 1:
            return xp.exp(logs[0]) + 0.0 * xp.where(xp.isinf(age), 0.0, age)
        middle = as_kind(self.middle, age)
        last = float(self.middle[-1]) + 0.7
        place = xp.clip(xp.log(xp.clip(age, 1e-300, 1e300)), float(self.middle[0]), last)
        at = 0.0 * place
        for edge in self.middle[1:-1]:
            at = at + (place > float(edge))
        at = at.astype(np.int64) if xp is np else at.long()
        part = (place - middle[at]) / (middle[at + 1] - middle[at])
        return xp.exp((1 - part) * logs[at, channel] + part * logs[at + 1, channel])

    def read(self, state: State, time: Any) -> Any:
        """(batch, channels) squared size of the present motion, 1 where it is as usual."""
        return state["square"]

    def arrays(self) -> dict[str, Array]:
        """See `Baseline`."""
        own = {"usual": self.usual, "middle": self.middle, "median": self.median}
        return {**self.slope.arrays(), **own}

    def restore(self, arrays: Mapping[str, Array]) -> LocalScale:
        """See `Baseline`."""
        self.usual, self.middle = np.asarray(arrays["usual"]), np.asarray(arrays["middle"])
        # Blends of before 1.0 started at 1.
        self.median = np.asarray(arrays.get("median", np.ones(self.usual.shape[1])))
        own = ("usual", "middle", "median")
        self.slope = DampedSlope()
        self.slope.restore({k: v for k, v in arrays.items() if k not in own})
        return self


class _Square:
    """Reads the running mean, and how many errors are in it."""

    def __init__(self, of: LocalScale) -> None:
        self.start, self.observe = of.start, of.observe

    def read(self, state: State, time: Any) -> Any:
        return np.stack([state["square"], state["seen"]], -1)


class _Age:
    """Reads the time since each channel's last observation."""

    def __init__(self, of: Any) -> None:
        self.start, self.observe = of.start, of.observe

    def read(self, state: State, time: Any) -> Any:
        return History.age(state, time)
