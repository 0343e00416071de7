"""Kalman filters and a smoother of single channels, and the search for their parameters."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from offbeat.baselines.base import (
    BASELINES,
    Array,
    Baseline,
    CausalBaseline,
    Rows,
    State,
    padded,
    stepped,
)
from offbeat.baselines.history import AgeBins, History
from offbeat.baselines.kalman import Chains, filtered
from offbeat.baselines.simple import LastValue, Linear
from offbeat.data.trajectory import Dataset

CANDIDATES = 120
"""Random parameters that are tried for every chain."""

ROUNDS = (0.6, 0.3, 0.15)
"""Width, in decades, of the rounds of steps around the best parameters so far."""

STEPS = 12
"""Parameters that are tried per round."""

CELLS = 250_000
"""Most values that the search looks at."""

LONGEST_PIECE = 256
"""Most rows of a trajectory that the search steps through."""

_AT_ONCE = 20_000
"""Candidates times trajectories times chains that are stepped through together."""


# --- what the search looks at ---------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Sample:
    """Rows for a search, with the errors to compare with.

    Attributes:
        rows: trajectories of about `CELLS` values.
        tasks: the same as a data set.
        bins: of the time since observation.
        hot: (channels, batch * rows, bins) 1 where a value is scored, in its bin.
        count: (bins, channels) scored values.
        reference: (bins, channels) mean squared error of the reference.
    """

    rows: Rows
    tasks: Dataset
    bins: AgeBins
    hot: Array
    count: Array
    reference: Array

    def loss(self, errors: Array, at: NDArray[np.bool_], scale: Array) -> Array:
        """Mean over bins of log(MSE / MSE of the reference).

        Args:
            errors: (bins, candidates, channels) mean squared errors.
            at: (bins,) bins that matter.
            scale: (channels,) of the values.

        Returns:
            (candidates, channels).
        """
        floor = 1e-14 * scale**2 + 1e-300
        ratio = np.log((errors + floor) / (self.reference[:, None] + floor))
        count = self.count * at[:, None]
        # A bin with few values is noise, unless there is no other one.
        weight = np.where(count >= 20, 1.0, 1e-6 * (count > 0))
        total = np.maximum(weight.sum(axis=0), 1e-300)
        return np.asarray((ratio * weight[:, None]).sum(axis=0) / total)

    def errors(self, predicted: Array, channel: NDArray[np.int64]) -> Array:
        """Mean squared errors.

        Args:
            predicted: (candidates, batch, rows, chains).
            channel: (chains,) that they predict.

        Returns:
            (bins, candidates, chains).
        """
        squares = (predicted - self.rows.values[:, :, channel]) ** 2
        many = squares.shape[0]
        flat = np.moveaxis(squares, -1, 0).reshape(len(channel), many, -1)
        total = np.moveaxis(flat @ self.hot[channel], -1, 0)  # (bins, chains, candidates)
        mean: Array = total / np.maximum(self.count[:, channel], 1)[..., None]
        return mean.swapaxes(1, 2)


def sampled(tasks: Dataset, *, two_sided: bool, cells: int = CELLS) -> Sample:
    """A part of the tasks, spread evenly over them.

    Args:
        tasks: of `Baseline.fit`.
        two_sided: whether masked values are scored, against linear interpolation; else all values
            after the first observation of their channel are, against the last value.
        cells: most values.
    """
    pieces = [
        t.slice(first, min(first + LONGEST_PIECE, t.rows))
        for t in tasks
        for first in range(0, t.rows, LONGEST_PIECE)
        if first == 0 or t.rows - first > 8
    ]
    rows = max(t.rows for t in pieces)
    many = int(np.clip(cells // (rows * tasks.channels), 4, len(pieces)))
    many = min(many, len(pieces))
    chosen = np.unique(np.linspace(0, len(pieces) - 1, many).round().astype(int))
    part = Dataset(tuple(pieces[i] for i in chosen))
    one = next(padded(part, len(part)))
    machine = LastValue()
    machine.mean = np.zeros(tasks.channels)
    age = stepped(_Age(), one)
    scored = one.known & np.isfinite(age)
    if two_sided:
        scored &= ~one.observed
        line = Linear()
        line.mean = machine.mean
        reference = np.zeros_like(one.values)
        for i, each in enumerate(line.predict(part)):
            reference[i, : len(each)] = each
    else:
        reference = stepped(machine, one)
    bins = AgeBins.of(tasks)
    at = bins.of_age(age)
    hot = ((at[..., None] == np.arange(len(bins))) & scored[..., None]).astype(np.float64)
    hot = np.moveaxis(hot, 2, 0).reshape(tasks.channels, -1, len(bins))
    count = hot.sum(axis=1).T
    made = Sample(one, part, bins, hot, count, np.zeros_like(count))
    errors = made.errors(reference[None], np.arange(tasks.channels))[:, 0]
    return replace(made, reference=errors)


class _Age(LastValue):
    """Reads the time since observation."""

    def read(self, state: State, time: Any) -> Any:
        return History.age(state, time)


# --- the search -----------------------------------------------------------------------------------


def search(
    loss: Callable[[Array], Array], low: Array, high: Array, special: Array, chains: int, seed: int
) -> Array:
    """The best of random parameters, then steps around it; each chain by itself.

    Args:
        loss: of parameters (candidates, parameters, chains), as (candidates, chains).
        low: (parameters,) lower end of the range of random ones; logarithms to base 10.
        high: (parameters,) upper end.
        special: (candidates, parameters) that are tried first; the first wins ties.
        chains: their number.
        seed: of all that is drawn.

    Returns:
        (parameters, chains).
    """
    random = np.random.default_rng(seed)
    drawn = random.uniform(low, high, size=(CANDIDATES - len(special), len(low)))
    tried = np.concatenate([special, drawn])[:, :, None] + np.zeros(chains)
    best: Array = tried[0]
    lowest = np.full(chains, np.inf)
    for width in (None, *ROUNDS):
        if width is not None:
            tried = best + width * random.normal(size=(STEPS, len(low), chains))
        losses = loss(tried)
        losses = np.where(np.isfinite(losses), losses, np.inf)
        first = losses.argmin(axis=0)
        chosen = np.take_along_axis(tried, first[None, None], 0)[0]
        found = np.take_along_axis(losses, first[None], 0)[0]
        best = np.where(found < lowest - 1e-12, chosen, best)
        lowest = np.minimum(lowest, found)
    return best


def in_chunks(chains: int, sample: Sample, count: int) -> list[slice]:
    """Candidates that are tried together, so that their arrays stay in cache."""
    size = max(1, _AT_ONCE // (chains * len(sample.rows.times)))
    return [slice(first, min(first + size, count)) for first in range(0, count, size)]


# --- single channels ------------------------------------------------------------------------------

# log10 of drive and walk, per typical gap and variance of the noise, and of damping per gap.
_LOW = np.array([-5.0, -5.0, -3.5])
_HIGH = np.array([5.0, 4.0, 0.5])
_SPECIAL = np.array(
    [
        [-9.0, 6.0, 0.0],  # last value
        [-9.0, 0.0, 0.0],  # exponential smoothing
        [5.0, -9.0, -4.0],  # constant velocity
        [5.0, -9.0, -1.0],
        [0.0, -9.0, -4.0],  # white acceleration
    ]
)


def single_chains(parameters: Array, gap: Array, longest: float, mean: Array) -> Chains:
    """A chain of order 2 per channel.

    Args:
        parameters: (candidates, 3, channels), or without the first axis.
        gap: (channels,) s, typical gap.
        longest: s, see `Chains`.
        mean: (channels,) of the values.
    """
    batched = parameters.ndim == 3
    drive, walk, damping = 10.0 ** np.moveaxis(parameters, -2, 0)
    if batched:
        drive, walk, damping = (p[:, None] for p in (drive, walk, damping))
    channels = len(gap)
    return Chains(
        channels=np.stack([np.arange(channels), np.full(channels, -1)], axis=1),
        offset=mean,
        unit=np.ones((channels, 2)),
        clock=gap,
        longest=np.full(channels, longest),
        drive=drive,
        walk=walk,
        damping=damping,
        noise=np.stack([np.ones_like(drive), np.ones_like(drive)]),
        prior_mean=np.zeros((2, channels)),
        # Unknown, and stationary.
        prior=np.stack([1e8 * (1 + drive + walk), drive / (2 * np.maximum(damping, 0.02))]),
        variance=np.ones(channels),
    )


def gaps_of(dataset: Dataset) -> Array:
    """(channels,) s, median time between observations of each channel."""
    every = [
        np.concatenate([np.diff(t.times[t.observed[:, c]]) for t in dataset])
        for c in range(dataset.channels)
    ]
    overall = np.concatenate(every)
    other = float(np.median(overall)) if len(overall) else 1.0
    return np.array([np.median(g) if len(g) else other for g in every])


class ChannelKalman(CausalBaseline):
    """A Kalman filter with damped velocity for every channel by itself.

    Attributes:
        chains: what was fitted.
    """

    long: ClassVar[bool] = False
    chains: Chains

    def estimate(self, tasks: Dataset) -> None:
        """See `Baseline`. Lowest mean over the bins of age of log(MSE / MSE of last value)."""
        sample = sampled(tasks, two_sided=False)
        gap, longest = gaps_of(tasks), float(sample.bins.edges[-1])
        every = np.arange(tasks.channels)
        half = (len(sample.bins) + 1) // 2
        at = np.arange(len(sample.bins)) < half
        if self.long and half < len(sample.bins):
            at = ~at

        def loss(tried: Array) -> Array:
            losses = []
            for part in in_chunks(tasks.channels, sample, len(tried)):
                chains = single_chains(tried[part], gap, longest, self.mean)
                errors = sample.errors(filtered(chains, sample.rows)[0], every)
                losses.append(sample.loss(errors, at, self.scale))
            return np.concatenate(losses)

        best = search(loss, _LOW, _HIGH, _SPECIAL, tasks.channels, seed=1)
        self.chains = single_chains(best, gap, longest, self.mean)
        self._scale_variance(sample, at)

    def _scale_variance(self, sample: Sample, at: NDArray[np.bool_]) -> None:
        """Sets the unit of the variances so that they are those of the errors on average."""
        state_errors = filtered(self.chains, sample.rows)[0]
        ratio = self._ratio(sample)
        squares = ratio * (state_errors - sample.rows.values) ** 2
        flat = np.moveaxis(squares, -1, 0).reshape(len(self.mean), 1, -1)
        total = (flat @ sample.hot)[:, 0] * at
        count = (sample.count.T * at).sum(axis=1)
        variance = total.sum(axis=1) / np.maximum(count, 1)
        smallest = 1e-24 * self.scale**2
        self.chains = replace(self.chains, variance=np.maximum(variance, smallest))

    def _ratio(self, sample: Sample) -> Array:
        """(batch, rows, channels) 1 / variance of a measurement, where `variance` is 1."""
        return 1.0 / stepped(_Variance(self.chains), sample.rows)

    def start(self, like: Any) -> State:
        """See `CausalBaseline`."""
        return self.chains.start(like)

    def observe(self, state: State, time: Any, values: Any, mask: Any) -> State:
        """See `CausalBaseline`."""
        return self.chains.observe(state, time, values, mask)

    def read(self, state: State, time: Any) -> Any:
        """See `CausalBaseline`."""
        return self.chains.read(state, time)[0]

    def read_variance(self, state: State, time: Any) -> Any:
        """Variance of what a sensor will measure, given a state; see `read`.

        Returns:
            (batch, channels) squared units.
        """
        return self.chains.read_variance(state, time)[0]

    def arrays(self) -> dict[str, Array]:
        """See `Baseline`."""
        return {**super().arrays(), **self.chains.arrays("chains.")}

    def restore(self, arrays: Mapping[str, Array]) -> Baseline:
        """See `Baseline`."""
        super().restore({name: arrays[name] for name in ("mean", "scale")})
        self.chains = Chains.of(arrays, "chains.")
        return self


class ChannelKalmanLong(ChannelKalman):
    """The same for long times since observation."""

    long = True


class _Variance:
    """Reads the variance of the positions of chains."""

    def __init__(self, chains: Chains) -> None:
        self.start, self.observe, self._chains = chains.start, chains.observe, chains

    def read(self, state: State, time: Any) -> Any:
        return self._chains.read_variance(state, time)[0]


class ChannelSmoother(Baseline):
    """The Rauch-Tung-Striebel smoother of the same filter, with parameters of its own.

    Attributes:
        chains: what was fitted.
    """

    causal = False
    chains: Chains

    def estimate(self, tasks: Dataset) -> None:
        """See `Baseline`. Lowest mean over bins of log(MSE / MSE of linear) of masked values."""
        sample = sampled(tasks, two_sided=True)
        gap, longest = gaps_of(tasks), float(sample.bins.edges[-1])
        every = np.arange(tasks.channels)
        at = np.ones(len(sample.bins), dtype=bool)

        def loss(tried: Array) -> Array:
            losses = []
            for part in in_chunks(tasks.channels, sample, len(tried)):
                chains = single_chains(tried[part], gap, longest, self.mean)
                errors = sample.errors(chains.smooth(sample.rows)[0], every)
                losses.append(sample.loss(errors, at, self.scale))
            return np.concatenate(losses)

        best = search(loss, _LOW, _HIGH, _SPECIAL, tasks.channels, seed=1)
        self.chains = single_chains(best, gap, longest, self.mean)

    def predict(self, dataset: Dataset) -> list[Array]:
        """See `Baseline`."""
        predicted = []
        for rows in padded(dataset):
            for each, length in zip(self.chains.smooth(rows)[0], rows.lengths, strict=True):
                predicted.append(each[:length])
        return predicted

    def arrays(self) -> dict[str, Array]:
        """See `Baseline`."""
        return {**super().arrays(), **self.chains.arrays("chains.")}

    def restore(self, arrays: Mapping[str, Array]) -> Baseline:
        """See `Baseline`."""
        super().restore({name: arrays[name] for name in ("mean", "scale")})
        self.chains = Chains.of(arrays, "chains.")
        return self


BASELINES.register("kalman_short", ChannelKalman)
BASELINES.register("kalman_long", ChannelKalmanLong)
BASELINES.register("smoother", ChannelSmoother)
