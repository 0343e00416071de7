"""Paired comparisons: both models were trained on the same windows and masks.

The common effect of the draw of windows and masks cancels in the differences. So these
tests, not those of `two_samples`, decide here.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from offbeat.comparison.statistics.bootstrap import bca
from offbeat.comparison.statistics.samples import (
    Estimate,
    Outcome,
    Sample,
    check_level,
    equal,
    pairs,
    sample,
)
from offbeat.comparison.statistics.two_samples import shapiro_wilk
from offbeat.errors import one_of

GForm = Literal["average", "difference", "independent"]

_EXACT_UP_TO = 50


def paired_t(
    a: ArrayLike, b: ArrayLike, *, names: tuple[str, str] = ("first", "second")
) -> Outcome:
    """Student's t test of the differences within pairs, which it assumes to be normal.

    Raises:
        InputError: fewer than 3 pairs, unpaired, not finite, or equal differences.
    """
    from scipy import stats

    first, second = pairs(a, b, names)
    result = stats.ttest_rel(first, second)
    return Outcome("paired_t", float(result.statistic), float(result.pvalue), (float(result.df),))


def wilcoxon(
    a: ArrayLike, b: ArrayLike, *, names: tuple[str, str] = ("first", "second")
) -> Outcome:
    """Wilcoxon's signed-rank test: are the differences symmetric around zero?

    Wilcoxon, Biometrics Bulletin 1 (1945) 80. Pairs without a difference are left out. Up to 50
    pairs p is exact, with ties too, from the distribution over all signs; beyond, `scipy` takes
    the normal approximation. The statistic is the smaller of the two sums of ranks.

    Raises:
        InputError: fewer than 3 pairs, unpaired, not finite, or equal differences.
    """
    from scipy import stats

    first, second = pairs(a, b, names)
    differences = first - second
    differences = differences[differences != 0]
    ranks = stats.rankdata(np.abs(differences))
    positive, total = float(ranks[differences > 0].sum()), float(ranks.sum())
    statistic = min(positive, total - positive)
    if len(differences) > _EXACT_UP_TO:
        p = float(stats.wilcoxon(differences).pvalue)
    else:
        # Number of the 2^n signs that give each sum; ranks are doubled, so that ties are integers.
        doubled = np.rint(2 * ranks).astype(int)
        counts = np.zeros(int(doubled.sum()) + 1)
        counts[0] = 1.0
        for rank in doubled:
            counts[rank:] = counts[rank:] + counts[: len(counts) - rank]
        p = min(1.0, float(2 * counts[: round(2 * statistic) + 1].sum() / counts.sum()))
    return Outcome("wilcoxon", statistic, p)


def small_sample_correction(df: float) -> float:
    """The factor J that corrects the bias of Cohen's d.

    J = Gamma(df / 2) / (sqrt(df / 2) Gamma((df - 1) / 2)), the exact form; Hedges, J. Educ. Stat. 6
    (1981) 107, about 1 - 3 / (4 df - 1).

    Args:
        df: degrees of freedom of the standard deviation, above 1.
    """
    from scipy.special import gammaln

    return float(np.exp(gammaln(df / 2) - gammaln((df - 1) / 2)) / np.sqrt(df / 2))


def hedges_g(
    a: ArrayLike,
    b: ArrayLike,
    *,
    form: GForm = "average",
    confidence: float = 0.95,
    resamples: int = 9999,
    seed: int = 0,
    names: tuple[str, str] = ("first", "second"),
) -> Estimate:
    """Hedges' g: the difference of two means in standard deviations, corrected for few runs.

    Args:
        a: (runs,) of the first model.
        b: (runs,) of the second.
        form: the unit, and whether the runs are paired. `average` (paired): the root of the
            mean of the two variances, Bonett, Psychol. Methods 13 (2008) 99; how large the
            difference is relative to the spread of a model over repeats. `difference` (paired): the
            standard deviation of the differences; how steady the difference is from repeat to
            repeat. `independent`: the pooled standard deviation of unpaired samples. The correction
            J has n - 1 degrees of freedom where paired, else n_a + n_b - 2.
        confidence: of the BCa bootstrap interval.
        resamples: of the bootstrap; pairs are drawn together.
        seed: of the bootstrap.
        names: of the models, for messages.

    Raises:
        InputError: an unknown form, or samples that cannot be compared.
    """
    one_of("form of Hedges' g", form, _D)
    paired = form != "independent"
    if paired:
        first, second = pairs(a, b, names)
    else:
        first, second = sample(a, names[0]), sample(b, names[1])
    if form == "average" and equal(first) and equal(second):
        sample(first, names[0])  # raises an error that names the cause
    df = len(first) - 1 if paired else len(first) + len(second) - 2
    factor, d = small_sample_correction(df), _D[form]
    return bca(
        lambda x, y: factor * d(x, y),
        first,
        second,
        paired=paired,
        confidence=confidence,
        resamples=resamples,
        seed=seed,
    )


def _d_average(a: Sample, b: Sample) -> NDArray[np.float64]:
    unit = np.sqrt((a.var(axis=-1, ddof=1) + b.var(axis=-1, ddof=1)) / 2)
    return np.asarray(_mean_difference(a, b) / unit)


def _d_difference(a: Sample, b: Sample) -> NDArray[np.float64]:
    return np.asarray(_mean_difference(a, b) / (a - b).std(axis=-1, ddof=1))


def _d_independent(a: Sample, b: Sample) -> NDArray[np.float64]:
    n, m = a.shape[-1], b.shape[-1]
    pooled = (n - 1) * a.var(axis=-1, ddof=1) + (m - 1) * b.var(axis=-1, ddof=1)
    return np.asarray(_mean_difference(a, b) / np.sqrt(pooled / (n + m - 2)))


def _mean_difference(a: Sample, b: Sample) -> NDArray[np.float64]:
    return np.asarray(a.mean(axis=-1) - b.mean(axis=-1))


_D: dict[str, Callable[[Sample, Sample], NDArray[np.float64]]] = {
    "average": _d_average,
    "difference": _d_difference,
    "independent": _d_independent,
}


@dataclass(frozen=True)
class PairedComparison:
    """Two models compared within pairs; a difference is the first minus the second.

    Attributes:
        runs: number of pairs.
        mean_a: mean of the first model.
        mean_b: mean of the second.
        difference: mean paired difference, with a BCa bootstrap interval.
        difference_t: the same with Student's interval, which assumes normal differences.
        paired_t: Student's test of the differences.
        wilcoxon: Wilcoxon's signed-rank test.
        wilcoxon_floor: the least p for this number of pairs, 2^(1 - pairs).
        shapiro_differences: Shapiro-Wilk on the differences, the assumption of `paired_t`.
        correlation: Pearson's correlation of the pairs; None where one model's
            values are all equal.
        hedges_g: in units of the models' spread over repeats (form `average`), with interval.
        hedges_gz: in units of the spread of the differences (form `difference`), with interval.
        wins: fraction of the pairs in which the first is lower; a tie counts half.
    """

    runs: int
    mean_a: float
    mean_b: float
    difference: Estimate
    difference_t: Estimate
    paired_t: Outcome
    wilcoxon: Outcome
    wilcoxon_floor: float
    shapiro_differences: Outcome
    correlation: float | None
    hedges_g: Estimate
    hedges_gz: Estimate
    wins: float


def paired_comparison(
    a: ArrayLike,
    b: ArrayLike,
    *,
    confidence: float = 0.95,
    resamples: int = 9999,
    seed: int = 0,
    names: tuple[str, str] = ("first", "second"),
) -> PairedComparison:
    """Compares two models whose runs are paired by position.

    Args:
        a: (runs,) scores of the first model, at least 3; lower is better.
        b: (runs,) scores of the second, in the same repeats.
        confidence: of all intervals.
        resamples: of the bootstrap; with fewer than 5 pairs its intervals are None.
        seed: of the bootstrap.
        names: of the models, for messages.

    Raises:
        InputError: too few runs, unpaired ones, values that are not finite, equal differences.
    """
    from scipy import stats

    check_level("confidence", confidence)
    first, second = pairs(a, b, names)
    differences = first - second
    t = paired_t(first, second, names=names)
    mean, n = float(differences.mean()), len(first)
    half = float(stats.t.ppf((1 + confidence) / 2, n - 1) * differences.std(ddof=1) / np.sqrt(n))
    steady = equal(first) or equal(second)

    def g(form: GForm) -> Estimate:
        return hedges_g(
            first,
            second,
            form=form,
            confidence=confidence,
            resamples=resamples,
            seed=seed,
            names=names,
        )

    return PairedComparison(
        runs=n,
        mean_a=float(first.mean()),
        mean_b=float(second.mean()),
        difference=bca(
            _mean_difference,
            first,
            second,
            confidence=confidence,
            resamples=resamples,
            seed=seed,
        ),
        difference_t=Estimate(mean, mean - half, mean + half, confidence, "student_t"),
        paired_t=t,
        wilcoxon=wilcoxon(first, second, names=names),
        wilcoxon_floor=min(1.0, 2.0 ** (1 - int((differences != 0).sum()))),
        shapiro_differences=shapiro_wilk(differences, name=f"{names[0]} - {names[1]}"),
        correlation=None if steady else float(np.corrcoef(first, second)[0, 1]),
        hedges_g=g("average"),
        hedges_gz=g("difference"),
        wins=float(((first < second) + 0.5 * (first == second)).mean()),
    )
