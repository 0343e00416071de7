"""Weights of several predictors on a simplex, and how far a model may correct their mean.

Both are fitted to errors on tasks by least squares, per channel and kind of value (a *key*: its
time since observation, and how much the channel moves). Values of one task are correlated, so a
task counts once per key, and all of them together count at most as often as independent spans of
that length fit into the data.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Integers = NDArray[np.int64]

POOLED = 6.0
"""Tasks of all channels together that count beside those of a channel."""

WORST = 16.0
"""Largest squared error in the pooled tasks, relative to that of the best predictor."""

MANY = 100.0
"""Independent tasks with which the mean squared error decides, and no longer single tasks."""

SELECTED = 2.0
"""Independent tasks with which selection of one predictor counts as much as averaging."""

MOST_SELECTED = 0.9
"""Largest part of selection."""

ROUNDS = 3
"""Least-squares problems that are solved in turn."""

EXACT = 1e-8
"""Mean squared error, in the unit of errors, below which a task is predicted exactly."""

RIDGE = 1e-8
"""Added to a Gram matrix whose mean diagonal is 1."""

CAUTION = 2.0
"""Tasks in which a model has nothing to say that count beside the others."""

FARTHEST = 1e8
"""Largest difference of a model from the base that counts, in units of an error."""

OUTLIER = 20.0
"""Errors of all predictors beyond this multiple of the usual one count less."""


@dataclass(frozen=True, eq=False)
class Errors:
    """Values of tasks with their predictions, one entry each.

    Attributes:
        key: kind of the value.
        channel: its channel.
        task: its task.
        truth: the value, in units of `size` after subtracting `last`.
        predictions: (values, predictors) the same of each prediction.
        count: independent tasks per key, at most.
        group: group of each key; kinds of one group are alike. By default each is its own.
        source: (keys, channels) kind whose results each kind has, where it is another one; see
            `sources`. By default each has its own.
        cluster: (values,) stretch of the data that the value is from; what is true in one need not
            be in the next. None where values are independent.
    """

    key: Integers
    channel: Integers
    task: Integers
    truth: Array
    predictions: Array
    count: Array
    group: Integers | None = None
    source: Integers | None = None
    cluster: Integers | None = None

    @property
    def groups(self) -> Integers:
        """(keys,) group of each key."""
        return np.arange(self.keys) if self.group is None else self.group

    @property
    def keys(self) -> int:
        """Number of kinds of values."""
        return len(self.count)

    def only(self, chosen: NDArray[np.bool_]) -> Errors:
        """Some of the values."""
        return replace(
            self,
            key=self.key[chosen],
            channel=self.channel[chosen],
            task=self.task[chosen],
            truth=self.truth[chosen],
            predictions=self.predictions[chosen],
            cluster=None if self.cluster is None else self.cluster[chosen],
        )

    def placed(self, table: Array) -> Array:
        """A table in which every kind has the results of its `source`.

        Args:
            table: (keys, channels, ...) of each kind by itself.
        """
        if self.source is None:
            return table
        return np.asarray(table[self.source, np.arange(table.shape[1])])


def sources(errors: Errors, measured: Integers) -> Integers:
    """The kind whose weights, gamma and widths each kind and channel has.

    A task masks measured values, so it has none at times since observation below the usual ones of
    its channel. What is known about others, which report more often, does not hold there.

    Args:
        errors: of tasks.
        measured: (keys, channels) the kind of the least time that tasks of the channel have; of
            longer times, the kind itself.

    Returns:
        (keys, channels) that kind, where the channel has fewer than `POOLED` tasks of the other.
    """
    _, effective = task_weights(errors, measured.shape[1])
    own = np.arange(errors.keys)[:, None]
    return np.asarray(np.where(effective < POOLED, measured, own))


def task_weights(errors: Errors, channels: int) -> tuple[Array, Array]:
    """Weight of each value, so that the values of a task sum to one per key and channel.

    Args:
        errors: of all tasks.
        channels: their number.

    Returns:
        (values,) weights, and (keys, channels) effective numbers of tasks.
    """
    tasks = int(errors.task.max(initial=0)) + 1
    code = (errors.key * channels + errors.channel) * tasks + errors.task
    _, place, many = np.unique(code, return_inverse=True, return_counts=True)
    weight = 1.0 / many[place]
    found = np.bincount(
        errors.key * channels + errors.channel, weight, minlength=errors.keys * channels
    ).reshape(errors.keys, channels)
    effective = np.minimum(found, errors.count[:, None])
    shrink = effective / np.maximum(found, 1e-300)
    return weight * shrink[errors.key, errors.channel], effective


def as_if_refitted(
    cross: Errors, other: Errors, flexible: NDArray[np.bool_], channels: int
) -> Errors:
    """Cross-validated errors, made as small as those of fits to all the data are.

    A flexible predictor that was fitted to a part of the data only has larger errors than the one
    that is used. The factor is measured on other tasks: the ratio of its errors to those of the
    predictors that are not flexible, there and in cross-validation, the median over groups of keys
    and channels.

    Args:
        cross: of training tasks; those of flexible predictors come from fits to other tasks.
        other: of tasks that nothing was fitted to, from fits to all training tasks.
        flexible: which predictors are.
        channels: their number.
    """
    if not flexible.any() or flexible.all():
        return cross

    def ratios(errors: Errors) -> Array:
        place = errors.groups[errors.key] * channels + errors.channel
        size = (int(errors.groups.max()) + 1) * channels
        weight, _ = task_weights(errors, channels)
        squares = np.stack(
            [
                np.bincount(place, weight * column**2, minlength=size)
                for column in (errors.predictions - errors.truth[:, None]).T
            ]
        )
        logs = np.log(np.where(squares > 0, squares, np.nan))
        found: Array = logs[flexible] - logs[~flexible].mean(axis=0)
        return found

    change = ratios(other) - ratios(cross)
    predictions = cross.predictions.copy()
    for j, column in zip(np.flatnonzero(flexible), change, strict=True):
        known = column[np.isfinite(column)]
        if len(known):
            factor = np.exp(np.clip(np.median(known), np.log(0.05), 0.0) / 2)
            missed = predictions[:, j] - cross.truth
            predictions[:, j] = cross.truth + factor * missed
    return replace(cross, predictions=predictions)


def simplex_weights(errors: Errors, channels: int) -> Array:
    """Weights of predictors, at least 0 and of sum 1, that have small errors on all tasks.

    The Gram matrix of the errors of a kind and channel gets `POOLED` tasks of similar kinds and of
    all channels (stacking: Wolpert 1992, Breiman 1996). With s the mean squared error of a task,
    what is minimised is the sum of log(1 + s / (f m)) over tasks, with m the mean of s, by
    iteratively reweighted least squares. The factor f grows with the number of independent tasks:
    with few of them, one large motion does not decide; with `MANY` of them and more, this is nearly
    least squares. To the Gram matrix of n tasks a part of `SELECTED` / (`SELECTED` + n) is added of
    the mean of the members' own errors: with few tasks, one member is selected rather than several
    averaged (Q-aggregation: Dai, Rigollet and Zhang 2012, Annals of Statistics 40(3)).

    Args:
        errors: on tasks that the predictors were not fitted to.
        channels: their number.

    Returns:
        (keys, channels, predictors).
    """
    predictors = errors.predictions.shape[1]
    missed = errors.predictions - errors.truth[:, None]
    weight, effective = task_weights(errors, channels)
    weight = weight * _robust(missed)
    place = errors.key * channels + errors.channel
    order = np.argsort(place, kind="stable")
    cells = _Cells.of_values(
        place[order], errors.task[order], weight[order], errors.keys * channels
    )
    missed, shape = missed[order], (errors.keys, channels)
    saturation = _saturation(errors)
    # First as if each task had the best predictor.
    squares = np.min([cells.squares(column) for column in missed.T], axis=0)
    weights = np.empty((*shape, predictors))
    for _ in range(ROUNDS):
        gram = cells.gram(missed, squares, saturation).reshape(*shape, predictors, predictors)
        mean = gram / np.maximum(effective, 1e-12)[..., None, None]
        # Channels are pooled relative to the error of their best predictor.
        smallest = np.einsum("kcjj->kcj", mean).min(axis=2)
        own = mean / np.maximum(smallest, 1e-12)[..., None, None]
        large = np.einsum("kcjj->kcj", own)
        shrink = np.sqrt(np.minimum(1.0, WORST / np.maximum(large, 1e-12)))
        shared = effective[..., None, None] * own * shrink[..., :, None] * shrink[..., None, :]
        near = _pooled(shared, effective, errors.groups)
        for key, channel in np.ndindex(*shape):
            many = float(effective[key, channel])
            total = many * own[key, channel] + POOLED * near[key, channel]
            part = min(SELECTED / (SELECTED + many), MOST_SELECTED)
            weights[key, channel] = on_simplex(total, part)
        mixed = weights.reshape(-1, predictors)[cells.place]
        squares = cells.squares((mixed * missed).sum(axis=1))
    return errors.placed(weights)


@dataclass(frozen=True, eq=False)
class _Cells:
    """Values in the order of their kind and channel, and the tasks in each of those.

    Attributes:
        place: (values,) kind and channel as one number, sorted.
        bounds: (places + 1,) first value of each.
        weight: (values,) of each value.
        task: (values,) number of the task within its place.
        of: (tasks,) place of each task.
        total: (tasks,) sum of the weights of each task.
    """

    place: Integers
    bounds: Integers
    weight: Array
    task: Integers
    of: Integers
    total: Array

    @classmethod
    def of_values(cls, place: Integers, task: Integers, weight: Array, places: int) -> _Cells:
        many = int(task.max(initial=0)) + 1
        codes, number = np.unique(place * many + task, return_inverse=True)
        bounds = np.searchsorted(place, np.arange(places + 1))
        total = np.asarray(np.bincount(number, weight), dtype=np.float64)
        return cls(place, bounds, weight, number, codes // many, total)

    def squares(self, missed: Array) -> Array:
        """(tasks,) mean squared error."""
        total = np.bincount(self.task, self.weight * missed**2)
        return np.asarray(total / np.maximum(self.total, 1e-300))

    def factor(self, squares: Array, saturation: float) -> Array:
        """(tasks,) what a task counts: less where its error is large.

        Args:
            squares: (tasks,) mean squared errors.
            saturation: multiple of its mean at which the influence of a task levels off.
        """
        places = len(self.bounds) - 1
        total = np.bincount(self.of, self.total, minlength=places)
        summed = np.bincount(self.of, self.total * squares, minlength=places)
        mean = (summed / np.maximum(total, 1e-300))[self.of]
        least = saturation * mean + EXACT
        return np.asarray((mean + least) / (squares + least))

    def gram(self, missed: Array, squares: Array, saturation: float) -> Array:
        """(places, predictors, predictors) of errors, a task of large errors counting less.

        Args:
            missed: (values, predictors).
            squares: (tasks,) mean squared error with the weights so far.
            saturation: multiple of its mean at which the influence of a task levels off.
        """
        places, predictors = len(self.bounds) - 1, missed.shape[1]
        factor = self.factor(squares, saturation)
        weight = self.weight * factor[self.task]
        gram = np.zeros((places, predictors, predictors))
        for i in np.flatnonzero(np.diff(self.bounds)):
            values = missed[self.bounds[i] : self.bounds[i + 1]]
            gram[i] = (values * weight[self.bounds[i] : self.bounds[i + 1], None]).T @ values
        return gram


def _saturation(errors: Errors) -> float:
    """Multiple of its mean at which the influence of a task levels off."""
    return float((errors.count.min() / MANY) ** 2)


def _pooled(shared: Array, effective: Array, groups: Integers) -> Array:
    """Mean Gram matrices of what is like a key and channel: the same shape as `shared`.

    All channels in this kind, and the channel in the kinds at the same place of the groups before
    and after, half each. Where there is no value of either, all channels of all these kinds; where
    there is none of those, all channels of the group, or of all groups.
    """
    keys, channels = effective.shape
    mean = np.zeros_like(shared)
    # Place of a kind in its group: it is compared with the kinds at the same place of others.
    place = np.array([int((groups[:k] == groups[k]).sum()) for k in range(keys)])

    def averaged(kinds: Integers, before: Array) -> Array:
        many = effective[kinds].sum()
        return np.asarray(shared[kinds].sum(axis=(0, 1)) / many if many else before)

    anything = averaged(np.arange(keys), np.zeros(shared.shape[2:]))
    for key in range(keys):
        same = np.flatnonzero((place == place[key]) & (np.abs(groups - groups[key]) <= 1))
        group = averaged(np.flatnonzero(groups == groups[key]), anything)
        kind = averaged(np.array([key]), averaged(same, group))
        others = same[same != key] if len(same) > 1 else same
        for channel in range(channels):
            many = effective[others, channel].sum()
            own = shared[others, channel].sum(axis=0) / many if many else kind
            mean[key, channel] = (kind + own) / 2
    return mean


def on_simplex(gram: Array, selected: float = 0.0) -> Array:
    """The weights w, at least 0 and of sum 1, with the least (1 - s) w' G w + s sum_j w_j G_jj.

    Args:
        gram: (predictors, predictors) G, positive semi-definite.
        selected: s, from 0 to below 1.

    Returns:
        (predictors,).
    """
    size = len(gram)
    largest = float(np.trace(gram)) / size
    if not largest > 0:
        return np.full(size, 1.0 / size)
    gram = gram / largest
    values, vectors = np.linalg.eigh(gram + RIDGE * np.eye(size))
    root = np.sqrt(np.maximum(values, RIDGE))
    # |A w + b|^2 with A' A = G and 2 A' b = s / (1 - s) diag(G)
    linear = vectors.T @ np.diag(gram) * (selected / (1 - selected)) / (2 * root)
    # A row of large weight asks for the sum.
    strict = 1e3 * max(1.0, float(np.abs(linear).max()))
    system = np.vstack([root[:, None] * vectors.T, np.full(size, strict)])
    from scipy.optimize import nnls

    found, _ = nnls(system, np.append(-linear, strict), maxiter=50 * size)
    return np.asarray(found / found.sum())


def gate(errors: Errors, base: Array, model: Array, channels: int) -> Array:
    """How much of the difference of a model from the base improves it: gamma, from 0 to 1.

    The least-squares factor of model - base, drawn to that of all channels of the key by `POOLED`
    tasks, and to 0 by `CAUTION`, as that of all channels is. A kind with fewer than `POOLED` tasks
    has the factor of its group. A task of large errors counts less, as in `simplex_weights`. One
    standard error is subtracted: a factor that differs between stretches of the data
    (`Errors.cluster`) is not one of the next stretch.

    Args:
        errors: on tasks that neither the base nor the model was fitted to.
        base: (values,) its predictions, as `Errors.predictions`.
        model: (values,) those of the model.
        channels: their number.

    Returns:
        (keys, channels); 0 where there is no value.
    """
    weight, effective = task_weights(errors, channels)
    moved, left = np.clip(model - base, -FARTHEST, FARTHEST), errors.truth - base
    weight = weight * _robust(left[:, None])
    place = errors.key * channels + errors.channel
    order = np.argsort(place, kind="stable")
    cells = _Cells.of_values(
        place[order], errors.task[order], weight[order], errors.keys * channels
    )
    saturation = _saturation(errors)
    # First as if each task had the better of both.
    squares = np.minimum(cells.squares(left[order]), cells.squares((left - moved)[order]))
    for _ in range(ROUNDS):
        counted = np.empty_like(weight)
        counted[order] = cells.weight * cells.factor(squares, saturation)[cells.task]
        gamma = _factor(errors, counted, effective, moved, left)
        mixed = left - gamma[errors.key, errors.channel] * moved
        squares = cells.squares(mixed[order])
    uncertain = _uncertainty(errors, counted, moved, left, effective.shape)
    return errors.placed(np.maximum(gamma - uncertain, 0.0))


def _factor(errors: Errors, weight: Array, effective: Array, moved: Array, left: Array) -> Array:
    """(keys, channels) the least-squares factor of left on moved, drawn to others and to 0.

    Args:
        errors: of tasks.
        weight: (values,) of the values.
        effective: (keys, channels) numbers of tasks.
        moved: (values,) difference of the model from the base.
        left: (values,) what the base misses.
    """
    shape = effective.shape
    place = errors.key * shape[1] + errors.channel

    def summed(value: Array) -> Array:
        found = np.bincount(place, weight * value, minlength=shape[0] * shape[1])
        return np.asarray(found.reshape(shape), dtype=np.float64)

    cross, square, least = summed(moved * left), summed(moved**2), summed(left**2)
    none = effective == 0
    few = (effective.max(axis=1) < POOLED)[:, None]

    def together(table: Array) -> Array:
        """A kind with few tasks has those of all kinds of its group."""
        every = np.zeros_like(table)
        np.add.at(every, errors.groups, table)
        return np.asarray(np.where(few, every[errors.groups], table))

    # In units of the base's error, kinds and channels count alike.
    many = np.maximum(effective, 1e-12)
    relative = many / np.maximum(least, 1e-9 * many)
    cross, square, least = (together(table * relative) for table in (cross, square, least))
    effective = together(effective)
    many = np.maximum(effective, 1e-12)
    pooled = np.clip(cross.sum(axis=1) / (square.sum(axis=1) + 1e-12), 0.0, 1.0)[:, None]
    total = effective.sum(axis=1)[:, None]
    pooled = pooled * total / (total + CAUTION)
    typical = square / many
    # A factor above 1 from few tasks is chance; it counts as 1 beside the others.
    top = np.minimum(cross, square) + POOLED * pooled * typical
    below = square + (POOLED + CAUTION) * typical
    gamma = np.where(none, 0.0, top / np.maximum(below, 1e-300))
    # No least-squares factor is larger (Cauchy and Schwarz): where the model moves much further
    # than the base is wrong, what it says in other channels does not count.
    largest = np.sqrt(least / np.maximum(square, 1e-300))
    return np.clip(np.minimum(gamma, largest), 0.0, 1.0)


def _uncertainty(
    errors: Errors, weight: Array, moved: Array, left: Array, shape: tuple[int, int]
) -> Array:
    """(keys, channels) standard error of the least-squares factor of left on moved, per group.

    That of clusters (Liang and Zeger 1986, Biometrika 73(1)), whose number n enters as n / (n - 1);
    1 where all values are of one cluster, and 0 without clusters.
    """
    if errors.cluster is None:
        return np.zeros(shape)
    groups, many = int(errors.groups.max()) + 1, int(errors.cluster.max(initial=0)) + 1
    place = (errors.groups[errors.key] * shape[1] + errors.channel) * many + errors.cluster

    def summed(value: Array) -> Array:
        found = np.bincount(place, value, minlength=groups * shape[1] * many)
        return np.asarray(found.reshape(groups, shape[1], many), dtype=np.float64)

    cross, square = summed(weight * moved * left), summed(weight * moved**2)
    total = np.maximum(square.sum(axis=2), 1e-300)
    factor = np.clip(cross.sum(axis=2) / total, 0.0, 1.0)[..., None]
    spread = np.sqrt(((cross - factor * square) ** 2).sum(axis=2)) / total
    seen = (square > 0).sum(axis=2)
    spread = np.where(seen > 1, spread * np.sqrt(seen / np.maximum(seen - 1, 1)), 1.0)
    return np.asarray(spread[errors.groups])


def _robust(missed: Array) -> Array:
    """Weights below 1 for values that every predictor misses by far."""
    weights: Array = np.minimum(1.0, OUTLIER / np.maximum(np.abs(missed).min(axis=1), 1e-12)) ** 2
    return weights
