"""Corrections for multiple tests."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from offbeat.errors import InputError


def holm(p_values: ArrayLike) -> tuple[float, ...]:
    """Adjusts the p-values of a family of tests; controls the family-wise error rate.

    Holm, Scand. J. Stat. 6 (1979) 65. The tests need not be independent.

    Args:
        p_values: (tests,), each from 0 to 1.

    Returns:
        (tests,) adjusted, in the order given; compare each with alpha.

    Raises:
        InputError: not a list of numbers from 0 to 1.
    """
    p = np.asarray(p_values, dtype=np.float64)
    if p.ndim != 1 or not len(p) or not ((p >= 0) & (p <= 1)).all():
        raise InputError(f"p-values must be a list of numbers from 0 to 1, got {p_values!r}")
    order = np.argsort(p, kind="stable")
    steps = np.maximum.accumulate((len(p) - np.arange(len(p))) * p[order])
    adjusted = np.empty(len(p))
    adjusted[order] = np.minimum(steps, 1.0)
    return tuple(adjusted.tolist())
