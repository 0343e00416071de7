"""The last observations of every channel, and times since observation in bins."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from offbeat.baselines.base import Array, State, as_kind, namespace
from offbeat.data.trajectory import Dataset, Trajectory

LONGEST_BIN = 24
"""Most bins of times since observation."""

OTHERS = 0.55
"""Others are still observed where the newest value is younger by this factor."""

SURELY, HARDLY = 0.45, 0.65
"""The same factor where they surely are, and above which they are not."""


class History:
    """The last observations of every channel, newest first.

    The state has `times` and `values` of shape (batch, channels, depth), 0 where there was none
    yet, and `count` (batch, channels) of the observations so far, at most the depth.

    Args:
        depth: observations that are kept.
    """

    def __init__(self, depth: int) -> None:
        self.depth = depth

    def start(self, like: Any) -> State:
        """No observation yet."""
        empty = namespace(like).stack([like] * self.depth, -1)
        return {"times": empty, "values": empty, "count": like}

    def observe(self, state: State, time: Any, values: Any, mask: Any) -> State:
        """The state after a row; see `CausalBaseline.observe`."""
        xp = namespace(values)
        at = mask[..., None]
        time = (time + 0.0 * values)[..., None]
        times = xp.concatenate([time, state["times"][..., :-1]], -1)
        kept = xp.concatenate([values[..., None], state["values"][..., :-1]], -1)
        return {
            "times": xp.where(at, times, state["times"]),
            "values": xp.where(at, kept, state["values"]),
            "count": xp.clip(state["count"] + mask, 0, self.depth),
        }

    @staticmethod
    def age(state: State, time: Any) -> Any:
        """(batch, channels) s since the last observation; infinite before the first one."""
        xp = namespace(state["count"])
        since = time - state["times"][..., 0]
        return xp.where(state["count"] > 0, since, np.inf)

    @staticmethod
    def last(state: State, before: Any) -> Any:
        """(batch, channels) the last value, or `before` where there was none."""
        xp = namespace(state["count"])
        return xp.where(state["count"] > 0, state["values"][..., 0], before)

    @staticmethod
    def slope(state: State, back: int = 1) -> Any:
        """(batch, channels) slope over the last `back` + 1 observations, or over those there are.

        Args:
            state: of a history deeper than `back`.
            back: number of intervals.

        Returns:
            Per s; 0 where there are fewer than two observations.
        """
        xp = namespace(state["count"])
        rise = span = 0.0 * state["count"]
        for k in range(1, back + 1):
            there = state["count"] > k
            rise = xp.where(there, state["values"][..., 0] - state["values"][..., k], rise)
            span = xp.where(there, state["times"][..., 0] - state["times"][..., k], span)
        return rise / xp.where(span > 0, span, 1.0)


@dataclass(frozen=True)
class AgeBins:
    """Bins of the time since observation: up to 1.5 typical gaps, then doubling.

    Attributes:
        edges: (bins,) s, upper end of each bin; increasing. Ages beyond the last one are in the
            last bin.
    """

    edges: Array

    @classmethod
    def of(cls, tasks: Dataset) -> AgeBins:
        """The bins of the ages that occur in tasks.

        Args:
            tasks: as of `Baseline.fit`.
        """
        ages = longest_ages(tasks)
        usual = float(np.quantile(ages, 0.95)) if len(ages) else 0.0
        return cls.of_lengths(typical_gap(tasks), usual, max(ages, default=0.0))

    @classmethod
    def of_lengths(cls, gap: float, usual: float, longest: float | None = None) -> AgeBins:
        """Bins up to a length.

        Args:
            gap: s, typical one.
            usual: s; the last bin has at least the upper half of the lengths up to this.
            longest: s, end of the last bin; by default `usual`.
        """
        longest = usual if longest is None else max(usual, longest)
        ratio = max(usual / (1.5 * gap), 1.0)
        count = int(np.clip(np.round(np.log2(ratio)), 0, LONGEST_BIN))
        steps = np.arange(count + 1) / max(count, 1)
        # A little longer, so that rounding never decides about multiples of the gap.
        edges = 1.02 * 1.5 * gap * ratio**steps
        edges[-1] = max(edges[-1], longest)
        return cls(np.asarray(edges))

    def __len__(self) -> int:
        return len(self.edges)

    def between(self, age: Any) -> tuple[Any, Any]:
        """The bin whose middle is at or before each age, and how far it is on the way to the next.

        Args:
            age: (...) s, finite.

        Returns:
            (...) int64, and (...) from 0 to 1, linear in the logarithm of the age; ages before the
            first middle and beyond the last one are at these.
        """
        xp = namespace(age)
        place = 0.0 * age
        if len(self) == 1:
            return self.of_age(age), place
        logs = np.log(self.middle)
        place = place + xp.log(xp.clip(age, 1e-30, 1e30))
        at = xp.zeros_like(place)
        for middle in logs[1:-1]:
            at = at + (place > float(middle))
        at = at.astype(np.int64) if xp is np else at.long()
        start, width = as_kind(logs[:-1], place)[at], as_kind(np.diff(logs), place)[at]
        return at, xp.clip((place - start) / width, 0.0, 1.0)

    @property
    def middle(self) -> Array:
        """(bins,) s, a typical age of each bin."""
        return np.concatenate([self.edges[:1] / 1.5, np.sqrt(self.edges[1:] * self.edges[:-1])])

    def of_age(self, age: Any) -> Any:
        """The bin of each age, int64, of the same shape."""
        xp = namespace(age)
        found = xp.zeros_like(age)
        for edge in self.edges[:-1]:
            found = found + (age > float(edge))
        return found.astype(np.int64) if xp is np else found.long()


def typical_gap(dataset: Dataset) -> float:
    """Median time between consecutive observations of a channel, over all channels, in s."""
    every = np.concatenate([_steps(t)[2] for t in dataset])
    if not len(every):
        every = np.concatenate([np.diff(t.times) for t in dataset])
    return float(np.median(every)) if len(every) else 1.0


def longest_gap(dataset: Dataset) -> float:
    """Longest time between observations of a channel on both sides of a hidden value, in s."""
    longest = 0.0
    for t in dataset:
        _, rows, steps = _steps(t)
        longest = max(longest, float(steps[rows > 1].max(initial=0.0)))
    return longest


def _steps(t: Trajectory) -> tuple[NDArray[np.int64], NDArray[np.int64], Array]:
    """Channel, rows and s between each two observations of a channel that follow one another."""
    channel, row = np.nonzero(t.observed.T)
    same = channel[1:] == channel[:-1]
    return channel[1:][same], np.diff(row)[same], np.diff(t.times[row])[same]


def others_seen(age: Any) -> Any:
    """Whether other channels were observed while one was not: its outage is not one of all.

    Args:
        age: (..., channels) s since the last observation of each channel.

    Returns:
        (..., channels) True where the newest observation of all channels is younger than `OTHERS`
        of the age.
    """
    return namespace(age).amin(age, -1)[..., None] < OTHERS * age


def others_part(age: Any) -> Any:
    """How far an outage is one of a single channel: `others_seen` without a jump, from 0 to 1.

    Args:
        age: as of `others_seen`.
    """
    xp = namespace(age)
    age = xp.clip(age, 1e-12, 1e30)
    newest = xp.amin(age, -1)[..., None]
    return xp.clip((HARDLY * age - newest) / ((HARDLY - SURELY) * age), 0.0, 1.0)


def usual_gaps(dataset: Dataset) -> Array:
    """(channels,) usual time between known values of each channel, in s; 0 where there is none.

    The lower quartile, as values of a log may be missing.

    Args:
        dataset: masked values count.
    """
    usual = np.zeros(dataset.channels)
    for c in range(dataset.channels):
        gaps = np.concatenate([np.diff(t.times[t.known[:, c]]) for t in dataset])
        if len(gaps):
            usual[c] = np.quantile(gaps, 0.25)
    return usual


def filled_bins(table: Array, count: Array) -> Array:
    """A table whose bins without values have those of the bin before, the first ones of the next.

    Args:
        table: (bins, channels) of `AgeBins`.
        count: (bins, channels) values that each entry comes from.
    """
    many = len(table)
    at = np.where(count > 0, np.arange(many)[:, None], -1)
    before = np.maximum.accumulate(at, axis=0)
    after = np.minimum.accumulate(np.where(at >= 0, at, many - 1)[::-1], axis=0)[::-1]
    return np.take_along_axis(table, np.where(before >= 0, before, after), axis=0)


def longest_ages(dataset: Dataset) -> list[float]:
    """Longest time from an observation of a channel to a later known value, per trajectory, in s.

    Args:
        dataset: trajectories without such a value are left out.
    """
    found = []
    for t in dataset:
        times = np.where(t.observed, t.times[:, None], -np.inf)
        before = np.vstack([np.full((1, t.channels), -np.inf), times[:-1]])
        age = t.times[:, None] - np.maximum.accumulate(before, axis=0)
        age = age[t.known & np.isfinite(age)]
        if len(age):
            found.append(float(age.max()))
    return found


def longest_age(dataset: Dataset) -> float:
    """Longest time from an observation of a channel to a later known value, in s."""
    return max(longest_ages(dataset), default=0.0)
