"""Weights of several predictors on a simplex, and how far a model may correct their mean.

Both are fitted in closed form to errors on tasks, per channel and kind of value (a *key*: its time
since observation, and how much the channel moves). Values of one task are correlated, so a task
counts once per key, and all of them together count at most as often as independent spans of that
length fit into the data.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

Array = NDArray[np.float64]
Integers = NDArray[np.int64]

POOLED = 6.0
"""Tasks of all channels together that count beside those of a channel."""

WORST = 4.0
"""Largest squared error in the pooled tasks, relative to that of the best predictor."""

STILL = 1.0
"""Tasks in which nothing moves that count beside the others."""

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
    """

    key: Integers
    channel: Integers
    task: Integers
    truth: Array
    predictions: Array
    count: Array
    group: Integers | None = None

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
        return Errors(
            self.key[chosen],
            self.channel[chosen],
            self.task[chosen],
            self.truth[chosen],
            self.predictions[chosen],
            self.count,
            self.group,
        )


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
    """Weights of predictors, at least 0 and of sum 1, with the least squared error.

    The Gram matrix of the errors of a key and channel gets `POOLED` tasks of all channels, and
    `STILL` tasks whose truth is the last value (Wolpert, Stacked generalization, 1992; Breiman,
    Stacked regressions, 1996).

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
    size = errors.keys * channels
    gram = np.empty((size, predictors, predictors))
    still = np.empty_like(gram)
    for j in range(predictors):
        for k in range(j + 1):
            for target, of in ((gram, missed), (still, errors.predictions)):
                product = np.bincount(place, weight * of[:, j] * of[:, k], minlength=size)
                target[:, j, k] = target[:, k, j] = product
    shape = (errors.keys, channels, predictors, predictors)
    many = np.maximum(effective, 1e-12)[..., None, None]
    mean = gram.reshape(shape) / many
    moved = np.bincount(place, weight * errors.truth**2, minlength=size).reshape(shape[:2])
    # In units of what the channel moves, so that they never outweigh what is well predicted.
    mean_still = still.reshape(shape) / np.maximum(moved, 1e-12)[..., None, None]
    # Channels are pooled relative to the error of their best predictor.
    smallest = np.einsum("kcjj->kcj", mean).min(axis=2)
    relative = 1.0 / np.maximum(smallest, 1e-12)[..., None, None]
    seen = (effective > 0)[..., None, None]
    own = np.where(seen, mean * relative, 0.0)
    large = np.einsum("kcjj->kcj", own)
    shrink = np.sqrt(np.minimum(1.0, WORST / np.maximum(large, 1e-12)))
    shared = effective[..., None, None] * own * shrink[..., :, None] * shrink[..., None, :]
    near = _pooled(shared, effective, errors.groups)
    weights = np.empty((errors.keys, channels, predictors))
    for key in range(errors.keys):
        for c in range(channels):
            rest = STILL * mean_still[key, c] if effective[key, c] else 0.0
            prior = POOLED * near[key, c]
            weights[key, c] = on_simplex(effective[key, c] * own[key, c] + prior + rest)
    return weights


def _pooled(shared: Array, effective: Array, groups: Integers) -> Array:
    """Mean Gram matrices of what is like a key and channel: the same shape as `shared`.

    The channel in all kinds of the group, and all channels in this kind, half each; where there is
    neither, all channels of the group; where that is empty, the group before.
    """
    mean = np.zeros_like(shared)
    before = np.zeros(shared.shape[2:])
    for group in range(int(groups.max(initial=0)) + 1):
        keys = np.flatnonzero(groups == group)
        total = effective[keys].sum()
        every = shared[keys].sum(axis=(0, 1)) / total if total else before
        before = every
        for key in keys:
            here = effective[key].sum()
            kind = shared[key].sum(axis=0) / here if here else every
            for c in range(shared.shape[1]):
                own = effective[keys, c].sum()
                channel = shared[keys, c].sum(axis=0) / own if own else every
                mean[key, c] = (kind + channel) / 2
    return mean


def on_simplex(gram: Array) -> Array:
    """The weights w, at least 0 and of sum 1, with the least w' G w.

    Args:
        gram: (predictors, predictors) positive semi-definite.

    Returns:
        (predictors,).
    """
    size = len(gram)
    largest = float(np.trace(gram)) / size
    if not largest > 0:
        return np.full(size, 1.0 / size)
    values, vectors = np.linalg.eigh(gram / largest + 1e-9 * np.eye(size))
    root = np.sqrt(np.maximum(values, 0.0))[:, None] * vectors.T
    # A row of large weight asks for the sum.
    system = np.vstack([root, np.full(size, 1e3)])
    found, _ = nnls(system, np.append(np.zeros(size), 1e3), maxiter=50 * size)
    return np.asarray(found / found.sum())


def gate(errors: Errors, base: Array, model: Array, channels: int) -> Array:
    """How much of the difference of a model from the base improves it: gamma, from 0 to 1.

    The least-squares factor of model - base, drawn to that of all channels of the key by `POOLED`
    tasks, and to 0 by `CAUTION`.

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
    shape = (errors.keys, channels)

    def summed(value: Array) -> Array:
        found = np.bincount(place, weight * value, minlength=shape[0] * shape[1])
        return np.asarray(found.reshape(shape), dtype=np.float64)

    cross, square, least = summed(moved * left), summed(moved**2), summed(left**2)
    many = np.maximum(effective, 1e-12)
    relative = many / np.maximum(least, 1e-9 * many)
    pooled_square = (square * relative).sum(axis=1) + 1e-12
    pooled = np.clip((cross * relative).sum(axis=1) / pooled_square, 0.0, 1.0)[:, None]
    typical = square / many
    top = cross + POOLED * pooled * typical
    below = square + (POOLED + CAUTION) * typical
    gamma = np.where(effective > 0, top / np.maximum(below, 1e-300), 0.0)
    # No least-squares factor is larger (Cauchy and Schwarz): where the model moves much further
    # than the base is wrong, what it says in other channels does not count.
    largest = np.sqrt(least / np.maximum(square, 1e-300))
    return np.asarray(np.clip(np.minimum(gamma, largest), 0.0, 1.0))


def _robust(missed: Array) -> Array:
    """Weights below 1 for values that every predictor misses by far."""
    weights: Array = np.minimum(1.0, OUTLIER / np.maximum(np.abs(missed).min(axis=1), 1e-12)) ** 2
    return weights
