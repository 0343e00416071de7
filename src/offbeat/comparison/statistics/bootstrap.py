"""Bootstrap intervals: bias-corrected and accelerated (BCa), seeded.

Efron, J. Am. Stat. Assoc. 82 (1987) 171; Efron and Tibshirani, An Introduction to the Bootstrap
(1993), chapter 14. `scipy.stats.bootstrap` is not used, because a ratio has
resamples in which it is not defined, and to give the same draws for a seed in any version.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from offbeat.comparison.statistics.samples import Estimate, Sample, check_level
from offbeat.errors import InputError

FEWEST_RESAMPLED = 5
"""With fewer values the interval is None, because few of the resamples differ."""

_UNDEFINED_FRACTION = 0.01

Statistic = Callable[..., NDArray[np.float64]]
"""Maps one array per sample, each (..., runs), to (...,)."""


def bca(
    statistic: Statistic,
    *samples: Sample,
    paired: bool = True,
    confidence: float = 0.95,
    resamples: int = 9999,
    seed: int = 0,
) -> Estimate:
    """Estimates a statistic of one or more samples, with a BCa bootstrap interval.

    Args:
        statistic: vectorised over leading axes.
        samples: (runs,) each.
        paired: the samples are paired, and pairs are drawn together.
        confidence: of the two-sided interval.
        resamples: number of resamples.
        seed: of the resampling.

    Returns:
        The interval is None with fewer than 5 runs, and where the statistic is undefined in more
        than 1 % of the resamples.

    Raises:
        InputError: levels or counts are out of range, or the statistic of the data is not finite.
    """
    from scipy.special import ndtr, ndtri

    check_level("confidence", confidence)
    if not isinstance(resamples, int) or resamples < 100:
        raise InputError(f"resamples must be an integer of at least 100, got {resamples!r}")
    value = float(statistic(*samples))
    if not np.isfinite(value):
        raise InputError(f"the statistic of the samples is {value}, so it has no interval")
    nothing = Estimate(value, None, None, confidence, "bca_bootstrap")
    if min(len(one) for one in samples) < FEWEST_RESAMPLED:
        return nothing
    random = np.random.default_rng(seed)
    drawn: list[Any] = []
    indices = None
    for one in samples:
        if indices is None or not paired:
            indices = random.integers(0, len(one), (resamples, len(one)))
        drawn.append(one[indices])
    with np.errstate(divide="ignore", invalid="ignore"):
        spread = statistic(*drawn)
    spread = spread[np.isfinite(spread)]
    if len(spread) < (1 - _UNDEFINED_FRACTION) * resamples:
        return nothing
    below = ((spread < value).mean() + (spread <= value).mean()) / 2
    if not 0 < below < 1:  # the value is outside its resamples
        return nothing
    bias, lean = ndtri(below), _acceleration(statistic, samples, paired)
    tail = ndtri((1 - confidence) / 2)
    fractions = [ndtr(bias + (bias + z) / (1 - lean * (bias + z))) for z in (tail, -tail)]
    low, high = np.quantile(spread, fractions)
    return Estimate(value, float(low), float(high), confidence, "bca_bootstrap")


def _acceleration(statistic: Statistic, samples: tuple[Sample, ...], paired: bool) -> float:
    """A sixth of the skewness of the jackknife influence values."""
    groups = [range(len(samples))] if paired else [[i] for i in range(len(samples))]
    cubes = squares = 0.0
    for group in groups:
        count = len(samples[group[0]])
        keep = ~np.eye(count, dtype=bool)
        left = [
            np.stack([one[kept] for kept in keep])
            if i in group
            else np.broadcast_to(one, (count, len(one)))
            for i, one in enumerate(samples)
        ]
        with np.errstate(divide="ignore", invalid="ignore"):
            without = statistic(*left)
        influence = (count - 1) * (without.mean() - without)
        cubes += float((influence**3).sum()) / count**3
        squares += float((influence**2).sum()) / count**2
    lean = cubes / (6 * squares**1.5) if squares > 0 else 0.0
    return lean if np.isfinite(lean) else 0.0
