"""Ridge regression with a penalty chosen on held-out groups."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from offbeat.baselines.base import Array

PENALTIES = (1e-6, 1e-5, 1e-4, 1e-3, 1e-2, 1e-1, 1.0, 10.0)
"""Penalties that are tried, per example, for features in units of their spread."""


def held_out_ridge(
    features: Array,
    targets: Array,
    groups: NDArray[np.int64],
    penalties: tuple[float, ...] = PENALTIES,
) -> Array:
    """Weights of penalised least squares; each target has the penalty that is best on new groups.

    Minimises |y - X w|^2 + examples * penalty * |w|^2 (Hoerl and Kennard, 1970). Each group is
    predicted with weights of the others, and the penalty with the lowest squared error is kept. An
    infinite one, that is zero weights, is always among those that are tried.

    Args:
        features: (examples, features); a column of ones for a constant.
        targets: (examples, targets).
        groups: (examples,) group of each example.
        penalties: to try.

    Returns:
        (features, targets); zeros where there are fewer than two groups.
    """
    parts = []
    for group in np.unique(groups):
        x, y = features[groups == group], targets[groups == group]
        parts.append((x.T @ x, x.T @ y, (y**2).sum(axis=0), len(x)))
    gram = sum(part[0] for part in parts)
    cross = sum(part[1] for part in parts)
    weights = np.zeros((features.shape[1], targets.shape[1]))
    if len(parts) < 2:
        return weights
    errors = np.zeros((len(penalties) + 1, targets.shape[1]))
    for own_gram, own_cross, square, count in parts:
        errors[-1] += square
        for i, penalty in enumerate(penalties):
            w = _solved(gram - own_gram, cross - own_cross, penalty * (len(features) - count))
            errors[i] += square + (w * (own_gram @ w - 2 * own_cross)).sum(axis=0)
    best = errors.argmin(axis=0)
    for i, penalty in enumerate(penalties):
        if (best == i).any():
            weights[:, best == i] = _solved(gram, cross[:, best == i], penalty * len(features))
    return weights


def _solved(gram: Array, cross: Array, penalty: float) -> Array:
    from scipy.linalg import cho_factor, cho_solve

    # Differences of Gram matrices are positive up to rounding errors of their largest entry.
    penalty = max(penalty, 1e-13 * float(np.trace(gram)))
    damped = gram + penalty * np.eye(len(gram))
    solved: Array = cho_solve(cho_factor(damped, check_finite=False), cross, check_finite=False)
    return solved
