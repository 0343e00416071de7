"""Kalman filters and a smoother of single channels, and what all baselines of chains share."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import ArrayLike, NDArray

from offbeat.baselines.base import (
    BASELINES,
    Array,
    Baseline,
    CausalBaseline,
    State,
    namespace,
    padded,
)
from offbeat.baselines.kalman import NO_LIMIT, Chains
from offbeat.baselines.kalman_search import Sample, in_chunks, search
from offbeat.data.trajectory import Dataset

# log10 of drive and walk, per typical gap and variance of the noise of the position, of damping per
# typical gap, and of the noise of the other states.
_LOW = np.array([-5.0, -5.0, -3.5, -6.0, -6.0])
_HIGH = np.array([5.0, 4.0, 0.5, 6.0, 6.0])
_SPECIAL = np.array(
    [
        [-9.0, 6.0, 0.0, 0.0, 0.0],  # last value
        [-9.0, 0.0, 0.0, 0.0, 0.0],  # exponential smoothing
        [5.0, -9.0, -4.0, 0.0, 0.0],  # constant velocity
        [5.0, -9.0, -1.0, 0.0, 0.0],
        [0.0, -9.0, -4.0, 0.0, 0.0],  # white acceleration, or jerk
    ]
)

LIMITS = (4.0, 8.0, 16.0, 32.0)
"""Limits of innovations that are tried, in standard deviations."""

FREE = 0.01
"""Logarithm of the mean squared error that a limit of innovations may cost."""

_SAMPLES: WeakKeyDictionary[Dataset, dict[bool, Sample]] = WeakKeyDictionary()
"""Samples of single channels, by tasks and whether predictions are causal: baselines share them."""


@dataclass(frozen=True, eq=False)
class Wiring:
    """What of chains is known before the search; fields as of `Chains`."""

    channels: NDArray[np.int64]
    unit: Array
    offset: Array
    prior_mean: Array
    clock: Array
    longest: Array

    @classmethod
    def of(
        cls,
        tasks: Dataset,
        channels: Sequence[Sequence[int]],
        factors: ArrayLike,
        mean: Array,
        scale: Array,
        longest: Array,
    ) -> Wiring:
        """The wiring of chains.

        Args:
            tasks: of `Baseline.fit`.
            channels: of each chain, -1 where none measures a state.
            factors: of each chain and state, units of its channel per unit of the derivative of the
                position's channel.
            mean: (channels,) of the data.
            scale: (channels,) of the data.
            longest: (chains,) s.
        """
        index = np.array(channels, dtype=np.int64)
        clock = np.array([_gap(tasks, row) for row in index])
        # One unit of a state is the spread of the position, per clock and per squared clock.
        unit = scale[index[:, :1]] / clock[:, None] ** np.arange(index.shape[1])
        unit = unit * np.asarray(factors, dtype=np.float64)
        prior = np.where(index >= 0, mean[np.maximum(index, 0)], 0.0) / unit
        prior[:, 0] = 0.0
        return cls(index, unit, mean[index[:, 0]], prior.T, clock, longest)

    def chains(self, parameters: Array) -> Chains:
        """Chains of these parameters.

        Args:
            parameters: (candidates, parameters, chains), or without the first axis.
        """
        tried = 10.0 ** np.moveaxis(parameters, -2, 0)
        if parameters.ndim == 3:
            tried = tried[:, :, None]
        drive, walk, damping = tried[:3]
        order = self.channels.shape[1]
        # The position is unknown, the last state stationary, what is between them loose.
        last = drive / (2.0 * np.maximum(damping, 0.02))
        prior = [1e8 * (1.0 + drive + walk), 2500.0 * last, last]
        return Chains(
            channels=self.channels,
            offset=self.offset,
            unit=self.unit,
            clock=self.clock,
            longest=self.longest,
            drive=drive,
            walk=walk,
            damping=damping,
            noise=np.stack([np.ones_like(drive), *tried[3 : 2 + order]]),
            prior_mean=self.prior_mean,
            prior=np.stack([prior[0], last] if order == 2 else prior),
            variance=np.ones(len(self.channels)),
            limit=np.full((order, len(self.channels)), NO_LIMIT),
        )


def _gap(tasks: Dataset, channels: NDArray[np.int64]) -> float:
    """Median time between rows in which one of the channels is observed, in s."""
    channels = channels[channels >= 0]
    gaps = [np.diff(t.times[t.observed[:, channels].any(axis=1)]) for t in tasks]
    every = np.concatenate(gaps)
    if not len(every):
        every = np.concatenate([np.diff(t.times) for t in tasks])
    return float(np.median(every)) if len(every) else 1.0


def fit_chains(
    wiring: Wiring, sample: Sample, scale: Array, weights: Array
) -> tuple[Chains, Array]:
    """Finds the parameters of chains.

    The lowest mean over bins and channels of log(MSE / MSE of the reference) wins. Then come the
    tightest limits of innovations that cost next to nothing, so that one wild value moves little.

    Args:
        wiring: of the chains.
        sample: of the same chains.
        scale: (channels,) of the data.
        weights: (bins, columns) of the bins, see `Sample.loss`.

    Returns:
        The chains, and the loss of each column of the sample.
    """
    local = replace(wiring, channels=sample.index)
    measured = sample.index >= 0
    spread = np.where(measured, scale[np.maximum(wiring.channels, 0)], 1.0).reshape(-1)

    def column_losses(tried: Array) -> Array:
        name = tried.tobytes()
        if name not in sample.tried:
            sample.tried[name] = sample.errors(local.chains(tried))
        found = sample.loss(sample.tried[name], weights, spread)
        return found.reshape(len(found), *measured.shape)

    def loss(tried: Array) -> Array:
        parts = [column_losses(tried[part]) for part in in_chunks(sample, len(tried))]
        return np.asarray(np.concatenate(parts).mean(axis=-1, where=measured))

    count = sample.index.shape[1] + 2
    best = search(loss, _LOW[:count], _HIGH[:count], _SPECIAL[:, :count], len(measured), seed=1)
    chains = local.chains(best)
    chains = replace(chains, limit=_limits(chains, sample, spread))
    found = replace(wiring.chains(best), limit=chains.limit)
    if not sample.two_sided:
        found = replace(found, variance=_variance(chains, sample, weights))
    return found, sample.loss(sample.errors(chains), weights, spread)[0].reshape(measured.shape)


def _limits(chains: Chains, sample: Sample, spread: Array) -> Array:
    """(order, chains) the tightest limits of innovations that cost next to nothing in every bin.

    Args:
        chains: without limits.
        sample: of the same chains.
        spread: (columns,) of the values.
    """
    usual = _usual_innovations(chains, sample)
    floor = 1e-14 * spread**2 + 1e-300
    counted = sample.weights() > 0.5
    free = sample.errors(chains)[:, 0]
    chosen = chains.limit.copy()
    for times in LIMITS[::-1]:  # a tighter one replaces a wider one
        limit = np.minimum(times * usual, NO_LIMIT)
        errors = sample.errors(replace(chains, limit=limit))[:, 0]
        cost = np.log((errors + floor) / (free + floor))
        most = np.where(counted, cost, -np.inf).max(axis=0).reshape(sample.index.shape)
        allowed = (most <= FREE) | (sample.index < 0)
        chosen = np.where(allowed.all(axis=1), limit, chosen)
    return np.asarray(chosen)


def _usual_innovations(chains: Chains, sample: Sample) -> Array:
    """(order, chains) standard deviation of the innovations, by their 90 % quantile.

    In units of what the filter expects; `NO_LIMIT` where there are none.
    """
    rows = sample.rows
    found: list[list[Array]] = [[] for _ in range(chains.order)]
    state = chains.start(np.zeros((len(rows.times), rows.values.shape[2])))
    for i in range(rows.times.shape[1]):
        time, values, observed = rows.times[:, i], rows.values[:, i], rows.observed[:, i]
        belief = chains.moved(state, time)
        means = chains.in_units(belief.mean, [state[f"seen{j}"] for j in range(chains.order)])
        for j in range(chains.order):
            at = np.maximum(sample.index[:, j], 0)
            missed = (values[:, at] - means[j]) / chains.unit[:, j]
            ratio = np.abs(missed) / np.sqrt(belief.cov[j, j] + chains.noise[j])
            counted = observed[:, at] & (sample.index[:, j] >= 0) & (state["started"] > 0)
            found[j].append(np.where(counted, ratio, np.nan))
        state = chains.committed(state, belief, time, values, observed)
    result = np.full((chains.order, len(chains.channels)), NO_LIMIT)
    for j, parts in enumerate(found):
        every = np.concatenate(parts)
        some = np.isfinite(every).any(axis=0)
        result[j, some] = np.nanquantile(every[:, some], 0.9, axis=0) / 1.645
    return np.where(result > 0, result, NO_LIMIT)


def _variance(chains: Chains, sample: Sample, weights: Array) -> Array:
    """(chains,) unit of the variances, so that they are those of the errors on average."""
    rows = sample.rows
    state = chains.start(np.zeros((len(rows.times), rows.values.shape[2])))
    ratios = np.zeros((1, *rows.values.shape))
    for i in range(rows.times.shape[1]):
        time, values = rows.times[:, i], rows.values[:, i]
        means, variances = chains.read(state, time), chains.read_variance(state, time)
        for j in range(chains.order):
            at = sample.index[:, j]
            used = at >= 0
            error = means[j][:, used] - values[:, at[used]]
            ratios[0, :, i, at[used]] = (error**2 / variances[j][:, used]).T
        state = chains.observe(state, time, values, rows.observed[:, i])
    binned = sample.binned(ratios)[:, 0] * weights
    total, count = (a.reshape(-1, *sample.index.shape).sum(axis=(0, 2)) for a in (binned, weights))
    return np.asarray(np.maximum(total / np.maximum(count, 1e-300), 1e-24))


# --- baselines ------------------------------------------------------------------------------------


class ChainBaseline(Baseline):
    """A baseline of chains that together measure every channel once.

    Attributes:
        banks: chains of one order each.
    """

    cost = 20.0

    banks: tuple[Chains, ...]

    def assembled(self, means: Sequence[Sequence[Any]]) -> Any:
        """States of chains as channels.

        Args:
            means: (..., chains) per bank and state.

        Returns:
            (..., channels).
        """
        parts, channels = [], []
        for bank, each in zip(self.banks, means, strict=True):
            for j, part in enumerate(each):
                used = np.flatnonzero(bank.channels[:, j] >= 0)
                parts.append(part[..., used])
                channels.append(bank.channels[used, j])
        order = np.argsort(np.concatenate(channels))
        return namespace(parts[0]).concatenate(parts, -1)[..., order]

    def arrays(self) -> dict[str, Array]:
        """See `Baseline`."""
        arrays = super().arrays()
        for i, bank in enumerate(self.banks):
            arrays |= bank.arrays(f"bank{i}.")
        return arrays

    def restore(self, arrays: Mapping[str, Array]) -> Baseline:
        """See `Baseline`."""
        super().restore({n: a for n, a in arrays.items() if not n.startswith("bank")})
        count = len({name.split(".")[0] for name in arrays if name.startswith("bank")})
        self.banks = tuple(Chains.of(arrays, f"bank{i}.") for i in range(count))
        return self


class ChainFilter(ChainBaseline, CausalBaseline):
    """A Kalman filter of chains."""

    def start(self, like: Any) -> State:
        """See `CausalBaseline`."""
        return self._joined([bank.start(like) for bank in self.banks])

    def observe(self, state: State, time: Any, values: Any, mask: Any) -> State:
        """See `CausalBaseline`."""
        return self._joined(
            [
                bank.observe(self._own(state, i), time, values, mask)
                for i, bank in enumerate(self.banks)
            ]
        )

    def read(self, state: State, time: Any) -> Any:
        """See `CausalBaseline`."""
        return self.assembled(
            [bank.read(self._own(state, i), time) for i, bank in enumerate(self.banks)]
        )

    def read_variance(self, state: State, time: Any) -> Any:
        """Variance of what a sensor will measure; see `read`.

        Before the first observation of a position, it is the variance of training.

        Returns:
            (batch, channels) in squared units of the channels.
        """
        return self.assembled(
            [bank.read_variance(self._own(state, i), time) for i, bank in enumerate(self.banks)]
        )

    @staticmethod
    def _joined(states: Sequence[State]) -> State:
        return {f"{i}.{name}": v for i, state in enumerate(states) for name, v in state.items()}

    @staticmethod
    def _own(state: State, i: int) -> State:
        start = f"{i}."
        return {n.removeprefix(start): v for n, v in state.items() if n.startswith(start)}


class ChainSmoother(ChainBaseline):
    """A Rauch-Tung-Striebel smoother of chains."""

    causal = False
    cost = 6.0

    def predict(self, dataset: Dataset) -> list[Array]:
        """See `Baseline`. At an observed row, the smoothed value."""
        predicted: list[Array] = []
        for rows in padded(dataset):
            means = self.assembled([bank.smooth(rows) for bank in self.banks])
            predicted += [m[:n] for m, n in zip(means, rows.lengths, strict=True)]
        return predicted


def singles(baseline: ChainBaseline, tasks: Dataset, which: str) -> tuple[Chains, Array]:
    """A chain of order 2 for every channel by itself.

    Args:
        baseline: with `mean`, `scale` and `causal`.
        tasks: of `Baseline.fit`.
        which: bins of the time since observation that matter: `short`, `long` or `all`.

    Returns:
        The chains, and (channels,) their losses, see `fit_chains`.
    """
    channels = [[c, -1] for c in range(tasks.channels)]
    factors = np.ones((tasks.channels, 2))
    samples = _SAMPLES.setdefault(tasks, {})
    if baseline.causal not in samples:
        two_sided = not baseline.causal
        samples[baseline.causal] = Sample.of(tasks, np.array(channels), two_sided=two_sided)
    sample = samples[baseline.causal]
    weights = sample.weights() if which == "all" else sample.halves()[which == "long"]
    wiring = Wiring.of(
        tasks, channels, factors, baseline.mean, baseline.scale, sample.longest(weights)[:, 0]
    )
    chains, losses = fit_chains(wiring, sample, baseline.scale, weights)
    return chains, losses[:, 0]


class KalmanShort(ChainFilter):
    """A Kalman filter with damped velocity per channel, for short times since observation.

    Its parameters have the lowest mean over bins of log(MSE / MSE of the last value) on tasks.
    """

    which: ClassVar[str] = "short"

    def estimate(self, tasks: Dataset) -> None:
        """See `Baseline`."""
        self.banks = (singles(self, tasks, self.which)[0],)


class KalmanLong(KalmanShort):
    """The same for long times since observation."""

    which = "long"


class Smoother(ChainSmoother):
    """The Rauch-Tung-Striebel smoother of the same model, with parameters of its own.

    They have the lowest mean over bins of log(MSE / MSE of a straight line) of masked values.
    """

    def estimate(self, tasks: Dataset) -> None:
        """See `Baseline`."""
        self.banks = (singles(self, tasks, "all")[0],)


BASELINES.register("kalman_short", KalmanShort)
BASELINES.register("kalman_long", KalmanLong)
BASELINES.register("smoother", Smoother)
