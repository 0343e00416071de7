"""Comparison of the spread of two models over repeats."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from offbeat.comparison.statistics.bootstrap import bca
from offbeat.comparison.statistics.samples import (
    Estimate,
    Outcome,
    Sample,
    check_level,
    pairs,
    sample,
)
from offbeat.comparison.statistics.two_samples import bartlett, levene


@dataclass(frozen=True)
class SpreadComparison:
    """The spread of two models over runs; with a ratio below 1 the first varies less.

    Attributes:
        std_a: standard deviation of the first model, with n - 1.
        std_b: of the second.
        ratio: std_a / std_b, with a BCa bootstrap interval.
        ratio_f: the same with the interval of the F distribution, for independent normal samples.
        f_test: F test of equal variances of independent normal samples.
        bartlett: the same by Bartlett's test.
        levene: the same by Levene's test, which is less sensitive to deviations from normality.
        pitman_morgan: the test for pairs, which decides where runs share windows and masks; None
            where they are not paired.
    """

    std_a: float
    std_b: float
    ratio: Estimate
    ratio_f: Estimate
    f_test: Outcome
    bartlett: Outcome
    levene: Outcome
    pitman_morgan: Outcome | None


def spread_comparison(
    a: ArrayLike,
    b: ArrayLike,
    *,
    paired: bool = True,
    confidence: float = 0.95,
    resamples: int = 9999,
    seed: int = 0,
    names: tuple[str, str] = ("first", "second"),
) -> SpreadComparison:
    """Compares the standard deviations of two models.

    Args:
        a: (runs,) scores of the first model, at least 3.
        b: (runs,) scores of the second.
        paired: the samples are paired by position.
        confidence: of the intervals.
        resamples: of the bootstrap; with fewer than 5 runs its interval is None.
        seed: of the bootstrap.
        names: of the models, for messages.

    Raises:
        InputError: samples that cannot be tested, or that do not pair.
    """
    from scipy import stats

    check_level("confidence", confidence)
    first, second = sample(a, names[0]), sample(b, names[1])
    together = pitman_morgan(first, second, names=names) if paired else None
    std_a, std_b = float(first.std(ddof=1)), float(second.std(ddof=1))
    df = (len(first) - 1.0, len(second) - 1.0)
    f = (std_a / std_b) ** 2
    tail = (1 - confidence) / 2
    low, high = (float(np.sqrt(f / stats.f.ppf(q, *df))) for q in (1 - tail, tail))
    return SpreadComparison(
        std_a,
        std_b,
        bca(
            _ratio,
            first,
            second,
            paired=paired,
            confidence=confidence,
            resamples=resamples,
            seed=seed,
        ),
        Estimate(std_a / std_b, low, high, confidence, "f"),
        Outcome("f_test", f, float(min(1.0, 2 * min(stats.f.cdf(f, *df), stats.f.sf(f, *df)))), df),
        bartlett(first, second, names=names),
        levene(first, second, names=names),
        together,
    )


def pitman_morgan(
    a: ArrayLike, b: ArrayLike, *, names: tuple[str, str] = ("first", "second")
) -> Outcome:
    """Tests whether two normal samples of pairs have equal variances.

    They do if sums and differences of the pairs are uncorrelated: Pitman, Biometrika 31 (1939)
    9; Morgan, ibid. 13. With a positive statistic the first varies more.

    Raises:
        InputError: samples that cannot be tested, or that do not pair.
    """
    from scipy import stats

    first, second = pairs(a, b, names)
    sums = sample(first + second, f"{names[0]} + {names[1]}")
    r = float(stats.pearsonr(sums, first - second).statistic)
    df = len(first) - 2.0
    t = r * np.sqrt(df / max(1 - r**2, np.finfo(float).tiny))
    return Outcome("pitman_morgan", float(t), float(2 * stats.t.sf(abs(t), df)), (df,))


def _ratio(a: Sample, b: Sample) -> NDArray[np.float64]:
    return np.asarray(a.std(axis=-1, ddof=1) / b.std(axis=-1, ddof=1))
