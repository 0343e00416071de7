"""Ridge regression of values between two observations, on both sides and on other channels."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from offbeat.baselines.base import BASELINES, Array, Baseline, padded
from offbeat.baselines.examples import FOLDS, likeness, some_tasks
from offbeat.baselines.folds import row_folds
from offbeat.baselines.gaps import EACH, OWN, SIZE, Gaps
from offbeat.baselines.held_out import Products
from offbeat.baselines.history import AgeBins, longest_gap, typical_gap
from offbeat.baselines.ridge import Ridge
from offbeat.data.arrays import hand_over
from offbeat.data.trajectory import Dataset, Trajectory

CELLS = 4_000_000
"""Most rows of the tasks that a fit uses, times channels."""

NEAR = 8
"""Most other channels that a fill uses."""

KINDS = 3
"""Of values: others are dense there, others are observed in the gap, none is."""


class _End(Ridge):
    """Fitted to less, for the few values outside all observations."""

    most_states = 15_000
    most_examples = 3_000
    most_inputs = 12


class RidgeFill(Baseline):
    r"""Ridge regression of what a line through the neighbours leaves, of each channel.

    A value between observations at :math:`t_0` and :math:`t_1`, at the fraction :math:`u` of the
    gap of :math:`g` s, is predicted as the line plus a regression on features: with
    :math:`a = u (1 - u)^2` and :math:`b = u^2 (1 - u)`,

    - of the channel itself, :math:`a` and :math:`b` times the slopes over 1 and 2 intervals on
      that side less the slope of the line, as in a cubic Hermite interpolation; times the values
      on both sides; and what a monotone cubic (Fritsch and Butland, 1984) says;
    - of other channels, interpolated where they are not observed: their value, integral and slope,
      each less the line through its values at :math:`t_0` and :math:`t_1`, and :math:`a g` and
      :math:`b g` times the values there; and the slope itself. So a position is filled from a
      velocity, and a velocity from a position.

    Weights differ between channels, bins of :math:`g`, and whether others are observed more densely
    than the channel at the value and its neighbours, or only somewhere in the gap, or nowhere.
    Penalties are chosen on held-out trajectories: first for own features, then for all, of all
    three kinds together, and then of each. No value is further from the line than any was in
    training. Outside all observations of a channel, `Ridge` predicts,
    forwards or backwards.
    """

    causal = False
    flexible = True
    cost = 30.0

    edges: Array  # (bins,) s, of gaps
    near: NDArray[np.int64]  # (channels, others)
    limits: Array  # (2, channels, features)
    weight: Array  # (kinds * bins, channels, features)
    reach: Array = np.full((1, 1), np.inf)  # (kinds * bins, channels) farthest from the line
    forward: Ridge
    backward: Ridge

    def predict(self, dataset: Dataset) -> list[Array]:
        """See `Baseline`. At an observed row, the observed value itself."""
        after = self.forward.predict(dataset)
        before = self.backward.predict(backwards(dataset))
        result: list[Array] = []
        for rows in padded(dataset, SIZE):
            gaps = Gaps(rows, self.mean, self.scale)
            filled = gaps.line * self.scale + self.mean
            reach = np.broadcast_to(self.reach, self.weight.shape[:2])
            for c in range(dataset.channels):
                task, row = gaps.inside(c)
                features = np.clip(self._features(gaps, c, task, row), *self.limits[:, c])
                key = self._key(gaps, c, task, row)
                change = (features * self.weight[key, c]).sum(axis=1)
                # Beyond what was fitted to, a bend is no larger than those that were seen.
                change = np.clip(change, -reach[key, c], reach[key, c])
                filled[task, row, c] += change * self.scale[c]
            filled = np.where(rows.observed, rows.values, filled)
            first = len(result)
            for i, length in enumerate(rows.lengths):
                late, early = after[first + i], before[first + i][::-1]
                outside = np.where(gaps.later[i, :length], filled[i, :length], late)
                result.append(np.where(gaps.earlier[i, :length], outside, early))
        return result

    def estimate(self, tasks: Dataset) -> None:
        """See `Baseline`."""
        self.forward, self.backward = _End(), _End()
        self.forward.fit(tasks)
        self.backward.fit(backwards(tasks))
        some = some_tasks(tasks, CELLS / tasks.channels)  # the first measure the features
        alike = np.argsort(-likeness(some), axis=1, kind="stable")
        self.near = np.ascontiguousarray(alike[:, 1 : NEAR + 1])
        self.edges = 1.02 * AgeBins.of_lengths(2 * typical_gap(tasks), longest_gap(some)).edges
        bins, channels = len(self.edges), tasks.channels
        size = OWN + EACH * self.near.shape[1]
        products = np.zeros((KINDS * bins, channels, FOLDS, size + 1, size + 1))
        counts = np.zeros((KINDS * bins, channels, FOLDS))
        folds = row_folds(some, FOLDS)
        self.limits = np.zeros((2, channels, size))
        self.reach = np.zeros((KINDS * bins, channels))
        measured = np.zeros(channels, dtype=bool)
        first = 0
        for rows in padded(some, SIZE):
            gaps = Gaps(rows, self.mean, self.scale)
            fold = np.zeros(rows.times.shape, dtype=np.int64)
            for i, length in enumerate(rows.lengths):
                fold[i, :length] = folds[first + i]
            first += len(rows.lengths)
            for c in range(channels):
                task, row = gaps.inside(c)
                if not len(task):
                    continue
                features = self._features(gaps, c, task, row)
                if not measured[c]:
                    low, high = np.quantile(features, [0.001, 0.999], axis=0)
                    self.limits[:, c] = low - 0.5 * (high - low), high + 0.5 * (high - low)
                    measured[c] = True
                features = np.clip(features, *self.limits[:, c])
                truth = (rows.values[task, row, c] - self.mean[c]) / self.scale[c]
                both = np.column_stack([features, truth - gaps.line[task, row, c]])
                key = self._key(gaps, c, task, row)
                known = rows.known[task, row, c]
                np.maximum.at(self.reach[:, c], key[known], np.abs(both[known, -1]))
                place = np.where(known, key * FOLDS + fold[task, row], -1)
                for one in np.unique(place[place >= 0]).tolist():
                    some = both[place == one]
                    products[one // FOLDS, c, one % FOLDS] += some.T @ some
                    counts[one // FOLDS, c, one % FOLDS] += len(some)
        self.weight = np.zeros((KINDS * bins, channels, size))
        for b in range(bins):
            for c in range(channels):
                every = range(b, KINDS * bins, bins)
                self.reach[every, c] = self.reach[every, c].max()
                start = _steps(
                    products[every, c].sum(axis=0), counts[every, c].sum(axis=0), np.zeros(size)
                )
                for k in every:
                    self.weight[k, c] = _steps(products[k, c], counts[k, c], start)

    def _key(
        self, gaps: Gaps, c: int, task: NDArray[np.int64], row: NDArray[np.int64]
    ) -> NDArray[np.int64]:
        at = AgeBins(self.edges).of_age(gaps.gap[task, row, c])
        dense = gaps.dense(c, self.near[c], task, row).any(axis=1)
        kind = np.where(dense, 0, np.where(gaps.alone[task, row, c], 2, 1))
        return np.asarray(at + len(self.edges) * kind)

    def _features(
        self, gaps: Gaps, c: int, task: NDArray[np.int64], row: NDArray[np.int64]
    ) -> Array:
        """(values, features) of values between two observations."""
        own = gaps.own(c, task, row, float(self.edges[-1]))
        others = gaps.others(c, self.near[c], task, row, float(self.edges[-1]))
        return np.concatenate([own, others], axis=1)

    def arrays(self) -> dict[str, Array]:
        """See `Baseline`."""
        names = ("edges", "near", "limits", "weight", "reach")
        return {
            **super().arrays(),
            **{name: getattr(self, name) for name in names},
            **{f"forward_{name}": array for name, array in self.forward.arrays().items()},
            **{f"backward_{name}": array for name, array in self.backward.arrays().items()},
        }

    def restore(self, arrays: Mapping[str, Array]) -> RidgeFill:
        """See `Baseline`."""
        own = dict(arrays)
        for side in ("forward", "backward"):
            named = {n: own.pop(n) for n in arrays if n.startswith(f"{side}_")}
            named = {n.removeprefix(f"{side}_"): array for n, array in named.items()}
            setattr(self, side, _End().restore(named))
        super().restore(own)
        return self


def _steps(product: Array, count: Array, start: Array) -> Array:
    """Weights of own features, and of all for what is left, added to those of a start."""
    used, size = count > 0, len(start)
    product, count = product[used], count[used]
    weights = start[:, None].copy()
    if not used.any():
        return start
    products = Products(product[:, :-1, :-1], product[:, :-1, -1:], product[:, -1, -1:], count)
    spread = np.sqrt(np.einsum("fii->i", product)[:-1] / count.sum())
    spread = np.where(spread > 0, spread, 1.0)
    for part in (np.arange(min(OWN, size)), np.arange(size)):
        step = products.left(weights).part(part, spread[part]).solve()
        weights[part] += step / spread[part, None]
    return np.asarray(weights[:, 0])


def backwards(dataset: Dataset) -> Dataset:
    """Every trajectory in reverse: rows at minus their times.

    Args:
        dataset: to reverse.
    """
    return replace(dataset, trajectories=tuple(map(_reversed, dataset)))


def _reversed(t: Trajectory) -> Trajectory:
    return replace(
        t,
        times=hand_over(t.times[-1] - t.times[::-1]),
        values=hand_over(t.values[::-1].copy()),
        observed=hand_over(t.observed[::-1].copy()),
    )


BASELINES.register("ridge_fill", RidgeFill)
