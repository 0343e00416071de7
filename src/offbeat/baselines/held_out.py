"""Ridge regression with a penalty chosen on held-out groups."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from offbeat.baselines.base import Array

PENALTIES = (1e-6, 1e-5, 1e-4, 1e-3, 1e-2, 1e-1, 1.0, 10.0)
"""Penalties that are tried, per example, for features in units of their spread."""

SMALL = 64
"""Features up to which all penalties are tried in one call, which takes longer for more."""


@dataclass(frozen=True, eq=False)
class Products:
    """What least squares needs of examples, for each group of them.

    Attributes:
        gram: (groups, features, features) of the features.
        cross: (groups, features, targets) of features and targets.
        square: (groups, targets) of the targets.
        count: (groups,) examples.
    """

    gram: Array
    cross: Array
    square: Array
    count: Array

    @classmethod
    def of(cls, features: Array, targets: Array, groups: NDArray[np.int64]) -> Products:
        """The products of examples.

        Args:
            features: (examples, features).
            targets: (examples, targets).
            groups: (examples,) of each example, any integers.
        """
        parts = [(features[groups == g], targets[groups == g]) for g in np.unique(groups)]
        size, count = features.shape[1], targets.shape[1]
        return cls(
            np.array([x.T @ x for x, _ in parts]).reshape(-1, size, size),
            np.array([x.T @ y for x, y in parts]).reshape(-1, size, count),
            np.array([(y**2).sum(axis=0) for _, y in parts]).reshape(-1, count),
            np.array([len(x) for x, _ in parts], dtype=np.float64),
        )

    def solve(self, penalties: tuple[float, ...] = PENALTIES) -> Array:
        """Weights of penalised least squares, each target with its best penalty on new groups.

        Minimises |y - X w|^2 + examples * penalty * |w|^2 (Hoerl and Kennard, 1970). Each group is
        predicted with weights of the others, and the penalty with the lowest squared error is
        kept. An infinite one, that is zero weights, is always among those that are tried.

        Args:
            penalties: to try.

        Returns:
            (features, targets); zeros where there are fewer than two groups.
        """
        gram, cross, count = self.gram.sum(axis=0), self.cross.sum(axis=0), self.count.sum()
        weights = np.zeros_like(cross)
        if len(self.count) < 2:
            return np.asarray(weights)
        if len(gram) <= SMALL:
            errors = self._errors(np.asarray(penalties))
        else:
            errors = self._errors_of_large(penalties)
        best = errors.argmin(axis=0)
        for i, penalty in enumerate(penalties):
            if (best == i).any():
                weights[:, best == i] = _solved(gram, cross[:, best == i], penalty * count)
        return np.asarray(weights)

    def _errors(self, penalties: Array) -> Array:
        """(penalties + 1, targets) squared errors of held-out groups, by one call of LAPACK."""
        gram, cross = self.gram.sum(axis=0) - self.gram, self.cross.sum(axis=0) - self.cross
        damping = (self.count.sum() - self.count)[:, None] * penalties
        # Differences of Gram matrices are positive up to rounding errors of their largest entry.
        damping = np.maximum(damping, 1e-13 * np.einsum("gii->g", gram)[:, None] + 1e-300)
        damped = np.repeat(gram[:, None], len(penalties), axis=1)
        damped.reshape(*damped.shape[:2], -1)[..., :: len(gram[0]) + 1] += damping[..., None]
        w = np.linalg.solve(damped, np.repeat(cross[:, None], len(penalties), axis=1))
        change = (w * (self.gram[:, None] @ w - 2 * self.cross[:, None])).sum(axis=(0, 2))
        return np.asarray(np.append(change, np.zeros((1, cross.shape[2])), 0) + self.square.sum(0))

    def _errors_of_large(self, penalties: tuple[float, ...]) -> Array:
        """The same, one after the other."""
        gram, cross, count = self.gram.sum(axis=0), self.cross.sum(axis=0), self.count.sum()
        errors = np.zeros((len(penalties) + 1, cross.shape[1]))
        for own_gram, own_cross, square, own in zip(
            self.gram, self.cross, self.square, self.count, strict=True
        ):
            errors[-1] += square
            for i, penalty in enumerate(penalties):
                w = _solved(gram - own_gram, cross - own_cross, penalty * (count - own))
                errors[i] += square + (w * (own_gram @ w - 2 * own_cross)).sum(axis=0)
        return errors

    def left(self, weights: Array) -> Products:
        """The products with what weights leave of the targets.

        Args:
            weights: (features, targets).
        """
        fitted = self.gram @ weights
        square = self.square + (weights * (fitted - 2 * self.cross)).sum(axis=1)
        return Products(self.gram, self.cross - fitted, square, self.count)

    def part(self, features: NDArray[np.int64], spread: Array) -> Products:
        """The products with some of the features, in other units.

        Args:
            features: (some,) positions.
            spread: (some,) what they are divided by.
        """
        gram = self.gram[:, features[:, None], features] / (spread[:, None] * spread)
        return Products(gram, self.cross[:, features] / spread[:, None], self.square, self.count)


def held_out_ridge(
    features: Array,
    targets: Array,
    groups: NDArray[np.int64],
    penalties: tuple[float, ...] = PENALTIES,
) -> Array:
    """Ridge regression of examples, see `Products.solve`.

    Args:
        features: (examples, features); a column of ones for a constant.
        targets: (examples, targets).
        groups: (examples,) group of each example.
        penalties: to try.

    Returns:
        (features, targets).
    """
    return Products.of(features, targets, groups).solve(penalties)


def _solved(gram: Array, cross: Array, penalty: float) -> Array:
    from scipy.linalg.lapack import dposv

    # Differences of Gram matrices are positive up to rounding errors of their largest entry.
    penalty = max(penalty, 1e-13 * float(np.trace(gram)), 1e-300)
    damped = gram.copy()
    damped.flat[:: len(gram) + 1] += penalty
    _, solved, failed = dposv(damped, cross)
    if failed:
        return _solved(gram, cross, 10 * penalty)
    return np.asarray(solved, dtype=np.float64)
