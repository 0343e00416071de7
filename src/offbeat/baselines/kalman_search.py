"""The search for the parameters of Kalman filters and smoothers, each chain by itself."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from offbeat.baselines.base import Array, Rows
from offbeat.baselines.history import AgeBins
from offbeat.baselines.kalman import Chains, Memory
from offbeat.data.trajectory import Dataset, Trajectory

CANDIDATES = 120
"""Random parameters that are tried for every chain."""

ROUNDS = (0.6, 0.3, 0.15)
"""Width, in decades, of the rounds of steps around the best parameters so far."""

STEPS = 12
"""Parameters that are tried per round."""

SEGMENT = 96
"""Most rows that are stepped through from one start."""

CELLS = 120_000
"""Most rows of all chains together that a search steps through."""

FEW = 20
"""Values below which the error of a bin is noise."""

_AT_ONCE = 20_000
"""Candidates times segments times chains that are stepped through together."""

_KEPT = np.zeros(1_000_000, dtype=bool)
_KEPT[[round(1.4**k) for k in range(40)]] = True

_Segment = tuple[Trajectory, NDArray[np.int64]]
"""A trajectory and some of its rows."""


@dataclass(frozen=True, eq=False)
class Scored:
    """Values that are scored, by state, then by chain, then by bin.

    Attributes:
        place: (scored,) of the values in an array (segments, rows, columns), flattened.
        starts: (groups,) number of the first value of each column and bin that has any.
        column: (groups,) its column.
        bin: (groups,) its bin.
        ends: (order + 1,) number of the first value of each state, and of all values.
        count: (bins, columns) values.
    """

    place: NDArray[np.int64]
    starts: NDArray[np.int64]
    column: NDArray[np.int64]
    bin: NDArray[np.int64]
    ends: NDArray[np.int64]
    count: Array

    @classmethod
    def of(
        cls, kind: NDArray[np.int64], scored: NDArray[np.bool_], bins: int, order: int
    ) -> Scored:
        """The values of an array that are scored.

        Args:
            kind: (segments, rows, columns) bin of each.
            scored: (segments, rows, columns).
            bins: their number.
            order: states of a chain.
        """
        place = np.flatnonzero(scored)
        columns = scored.shape[2]
        column, kinds = place % columns, kind.reshape(-1)[place]
        sorting = np.lexsort((kinds, column // order, column % order))
        place, column, kinds = place[sorting], column[sorting], kinds[sorting]
        new = np.ones(len(place), dtype=bool)
        new[1:] = (np.diff(column) != 0) | (np.diff(kinds) != 0)
        starts = np.flatnonzero(new)
        count = np.zeros((bins, columns))
        np.add.at(count, (kinds, column), 1.0)
        ends = np.searchsorted(column % order, np.arange(order + 1))
        return cls(place, starts, column[starts], kinds[starts], ends, count)

    def of_state(
        self, j: int, chains: int, order: int
    ) -> tuple[slice, NDArray[np.int64], NDArray[np.int64]]:
        """Numbers of the values of a state, their place in (segments, rows, chains), their chain.

        Args:
            j: number of the state.
            chains: their number.
            order: states of a chain.
        """
        own = slice(int(self.ends[j]), int(self.ends[j + 1]))
        row, column = np.divmod(self.place[own], chains * order)
        chain = column // order
        return own, row * chains + chain, chain

    def means(self, squares: Array) -> Array:
        """Means over the scored values of each bin.

        Args:
            squares: (candidates, scored).

        Returns:
            (bins, candidates, columns).
        """
        found = np.zeros((*self.count.shape, len(squares)))
        if len(self.starts):
            total = np.add.reduceat(squares, self.starts, axis=1)
            found[self.bin, self.column] = total.T
        mean: Array = found / np.maximum(self.count, 1)[..., None]
        return mean.swapaxes(1, 2)


@dataclass(frozen=True, eq=False)
class Sample:
    """Rows for a search: every chain has its own, those where one of its channels is known.

    Attributes:
        rows: segments; times are (segments, rows, chains), and the channel of state j of chain c
            is order * c + j.
        index: (chains, order) those numbers, -1 where no channel measures a state.
        bins: of the time since observation.
        scored: the values that are scored.
        gaps: (segments, rows, chains) s since the row before, as the filter or smoother needs it.
        count: (bins, columns) scored values.
        reference: (bins, columns) mean squared error of the last value, or of a straight line.
        two_sided: whether masked values are scored, given all others; else all values are that
            follow an observation of their channel, given what was observed before.
        memory: that all calls of `errors` use.
        tried: errors of parameters that were tried, by their bytes: searches with other weights
            begin with the same ones.
    """

    rows: Rows
    index: NDArray[np.int64]
    bins: AgeBins
    scored: Scored
    gaps: Array
    count: Array
    reference: Array
    two_sided: bool
    memory: Memory = field(default_factory=Memory)
    tried: dict[bytes, Array] = field(default_factory=dict)

    @classmethod
    def of(
        cls, tasks: Dataset, channels: NDArray[np.int64], *, two_sided: bool, cells: int = CELLS
    ) -> Sample:
        """Draws segments from tasks, spread evenly over those in which something is masked.

        Args:
            tasks: of `Baseline.fit`.
            channels: (chains, order) as of `Chains`.
            two_sided: see the attribute.
            cells: most rows of all chains together.
        """
        chains, order = channels.shape
        most = int(np.clip(cells // (SEGMENT * chains), 16, 256))
        drawn = [_segments(tasks, row[row >= 0], most) for row in channels]
        count = max(len(d) for d in drawn)
        rows = max(len(at) for d in drawn for _, at in d)
        columns = chains * order
        times = np.zeros((count, rows, chains))
        values, reference, age = (np.zeros((count, rows, columns)) for _ in range(3))
        observed, scored = (np.zeros(values.shape, dtype=bool) for _ in range(2))
        for c, segments in enumerate(drawn):
            for s, (t, at) in enumerate(segments):
                n = len(at)
                times[s, :n, c] = t.times[at] - t.times[at[0]]
                times[s, n:, c] = times[s, n - 1, c]
                for j in np.flatnonzero(channels[c] >= 0):
                    k = c * order + j
                    y, seen = t.values[at, channels[c, j]], t.observed[at, channels[c, j]]
                    known = ~np.isnan(y)
                    values[s, :n, k] = np.where(known, y, 0.0)
                    observed[s, :n, k] = seen
                    age[s, :n, k], last = _since(times[s, :n, c], y, seen)
                    if two_sided and seen.any():
                        last = np.interp(times[s, :n, c], times[s, :n, c][seen], y[seen])
                    reference[s, :n, k] = last
                    scored[s, :n, k] = known & np.isfinite(age[s, :n, k])
        if two_sided:
            scored &= ~observed
        bins = AgeBins.of(tasks)
        index = np.where(channels >= 0, np.arange(columns).reshape(chains, order), -1)
        found = Scored.of(bins.of_age(age), scored, len(bins), order)
        gaps = np.diff(times, axis=1, prepend=times[:, :1])
        if not two_sided:
            some = np.asarray(observed.reshape(count, rows, chains, order).any(axis=3))
            started = np.logical_or.accumulate(some, axis=1)
            gaps[:, 1:] *= started[:, :-1]
        made = cls(
            Rows(times, values, observed, scored, (rows,) * count),
            index,
            bins,
            found,
            gaps,
            found.count,
            np.zeros((len(bins), columns)),
            two_sided,
        )
        made.reference[:] = made.binned((reference - values)[None] ** 2)[:, 0]
        return made

    def binned(self, squares: Array) -> Array:
        """Means over the scored values of each bin.

        Args:
            squares: (candidates, segments, rows, columns).

        Returns:
            (bins, candidates, columns).
        """
        return self.scored.means(squares.reshape(len(squares), -1)[:, self.scored.place])

    def errors(self, chains: Chains) -> Array:
        """Mean squared errors of what chains predict: (bins, candidates, columns)."""
        predict = chains.smoothed if self.two_sided else chains.predicted
        means = predict(self.rows, self.gaps, self.memory)
        if means[0].ndim == 3:
            means = [m[None] for m in means]
        squares = np.empty((len(means[0]), len(self.scored.place)))
        truth = self.rows.values.reshape(-1)[self.scored.place]
        for j, mean in enumerate(means):
            own, place, chain = self.scored.of_state(j, *self.index.shape)
            unit, offset = chains.unit[chain, j], chains.offset[chain] if j == 0 else 0.0
            missed = mean.reshape(len(mean), -1)[:, place]
            missed *= unit
            missed += offset - truth[own]
            np.square(missed, out=squares[:, own])
        return self.scored.means(squares)

    def halves(self) -> tuple[Array, Array]:
        """(bins, columns) weights of the bins of short and of long times since observation.

        Bins are halved per channel, among those with enough values; the middle one counts as short.
        """
        enough = self.weights()
        number = np.cumsum(enough > 0.5, axis=0)
        short = enough * (number <= (number[-1] + 1) // 2)
        long = enough * (number > (number[-1] + 1) // 2)
        return short, np.where(long.sum(axis=0) > 0, long, enough)

    def weights(self) -> Array:
        """(bins, columns) weights of all bins: 1, or next to none where there are few values."""
        return np.where(self.count >= FEW, 1.0, 1e-6 * (self.count > 0))

    def longest(self, weights: Array) -> Array:
        """(chains, order) s, upper end of the last bin that counts.

        Args:
            weights: (bins, columns).
        """
        last = np.max((weights > 0.5) * np.arange(1, len(weights) + 1)[:, None], axis=0)
        return np.asarray(self.bins.edges[last - 1].reshape(self.index.shape))

    def loss(self, errors: Array, weights: Array, scale: Array) -> Array:
        """Mean over bins of log(MSE / MSE of the reference).

        Args:
            errors: (bins, candidates, columns).
            weights: (bins, columns).
            scale: (columns,) spread of the values.

        Returns:
            (candidates, columns).
        """
        floor = 1e-14 * scale**2 + 1e-300
        ratio = np.log((errors + floor) / (self.reference[:, None] + floor))
        total = np.maximum(weights.sum(axis=0), 1e-300)
        return np.asarray((ratio * weights[:, None]).sum(axis=0) / total)


def _segments(tasks: Dataset, channels: NDArray[np.int64], most: int) -> list[_Segment]:
    """Trajectories and their rows; those with masked values first, spread evenly over the tasks."""
    masked: list[_Segment] = []
    logged: list[_Segment] = []
    for t in tasks:
        at = _thinned(t, channels)
        # From the end: that is where forecasts are.
        for stop in range(len(at), 0, -SEGMENT):
            rows = at[max(stop - SEGMENT, 0) : stop]
            seen = t.observed[rows[:, None], channels]
            if len(rows) >= 3 and seen.any():
                (logged if seen.all() else masked).append((t, rows))
    chosen = [_evenly(masked, most)]
    chosen.append(_evenly(logged, most - len(chosen[0])))
    found = [segment for part in chosen for segment in part]
    return found or [(tasks[0], np.arange(min(tasks[0].rows, SEGMENT)))]


def _evenly(every: Sequence[_Segment], most: int) -> list[_Segment]:
    if len(every) <= most:
        return list(every)
    return [every[i] for i in np.linspace(0, len(every) - 1, most).round().astype(int)]


def _thinned(t: Trajectory, channels: NDArray[np.int64]) -> NDArray[np.int64]:
    """Rows in which one of the channels is known; in long outages, ever fewer of them."""
    at = np.flatnonzero(~np.isnan(t.values[:, channels]).all(axis=1))
    seen = np.asarray(t.observed[:, channels].any(axis=1))[at]
    place = np.arange(len(at))
    since = np.minimum(place - np.maximum.accumulate(np.where(seen, place, -1)), len(_KEPT) - 1)
    return np.asarray(at[seen | _KEPT[since]])


def _since(times: Array, values: Array, seen: NDArray[np.bool_]) -> tuple[Array, Array]:
    """Time since the last observation before each row, infinite before the first; its value."""
    place = np.arange(len(times))
    last = np.maximum.accumulate(np.where(seen, place, -1))
    before = np.concatenate([[-1], last[:-1]])
    age = np.where(before >= 0, times - times[before], np.inf)
    return age, np.where(before >= 0, values[before], 0.0)


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


def in_chunks(sample: Sample, count: int) -> list[slice]:
    """Candidates that are tried together, so that their arrays stay in cache."""
    size = max(1, _AT_ONCE // (len(sample.index) * len(sample.rows.times)))
    return [slice(first, min(first + size, count)) for first in range(0, count, size)]
