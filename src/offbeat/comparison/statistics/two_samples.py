"""Tests of independent samples, and the thesis' rule for choosing one.

Runs that share windows and masks are not independent: see `paired` for the tests that decide.
`scipy.stats` is imported when a test runs, because that takes seconds.
"""

from __future__ import annotations

from dataclasses import dataclass

from numpy.typing import ArrayLike

from offbeat.comparison.statistics.samples import Outcome, Sample, check_level, sample
from offbeat.errors import InputError


def shapiro_wilk(values: ArrayLike, *, name: str = "sample") -> Outcome:
    """Tests whether a sample is drawn from a normal distribution.

    Shapiro and Wilk, Biometrika 52 (1965) 591; p by Royston, Applied Statistics 44 (1995) 547.
    The thesis' equation 52.

    Args:
        values: (runs,), at least 3, not all equal.
        name: of the sample, for messages.

    Raises:
        InputError: too few values, not finite, or all equal.
    """
    from scipy import stats

    statistic, p = stats.shapiro(sample(values, name))
    return Outcome("shapiro_wilk", float(statistic), float(p))


def bartlett(*samples: ArrayLike, names: tuple[str, ...] | None = None) -> Outcome:
    """Tests whether normal samples have equal variances.

    Bartlett, Proc. R. Soc. A 160 (1937) 268. The thesis' equations 53 to 55. It is sensitive to
    deviations from the normal distribution; `levene` is less so.

    Args:
        samples: two or more of shape (runs,), independent of each other.
        names: of the samples, for messages.

    Raises:
        InputError: fewer than two samples, or one that cannot be tested.
    """
    from scipy import stats

    checked = _several(samples, names)
    statistic, p = stats.bartlett(*checked)
    return Outcome("bartlett", float(statistic), float(p), (len(checked) - 1.0,))


def levene(*samples: ArrayLike, names: tuple[str, ...] | None = None) -> Outcome:
    """Tests whether samples have equal variances, by absolute deviations from the medians.

    Levene's test in the form of Brown and Forsythe, J. Am. Stat. Assoc. 69 (1974) 364, which is
    also NIST's.

    Args:
        samples: two or more of shape (runs,), independent of each other.
        names: of the samples, for messages.

    Raises:
        InputError: fewer than two samples, or one that cannot be tested.
    """
    from scipy import stats

    checked = _several(samples, names)
    statistic, p = stats.levene(*checked, center="median")
    k, total = len(checked), sum(len(one) for one in checked)
    return Outcome("levene", float(statistic), float(p), (k - 1.0, float(total - k)))


def two_sample_t(
    a: ArrayLike, b: ArrayLike, *, names: tuple[str, str] = ("first", "second")
) -> Outcome:
    """Student's t test of two independent normal samples of equal variance.

    The thesis' equations 46 to 49.

    Raises:
        InputError: a sample that cannot be tested.
    """
    from scipy import stats

    first, second = _several((a, b), names)
    result = stats.ttest_ind(first, second)
    return Outcome("two_sample_t", float(result.statistic), float(result.pvalue), (result.df,))


def welch_t(a: ArrayLike, b: ArrayLike, *, names: tuple[str, str] = ("first", "second")) -> Outcome:
    """Welch's t test of two independent normal samples; their variances may differ.

    Welch, Biometrika 34 (1947) 28. The thesis' equations 50 and 51.

    Raises:
        InputError: a sample that cannot be tested.
    """
    from scipy import stats

    first, second = _several((a, b), names)
    result = stats.ttest_ind(first, second, equal_var=False)
    return Outcome("welch_t", float(result.statistic), float(result.pvalue), (float(result.df),))


@dataclass(frozen=True)
class ThesisTest:
    """The thesis' rule (section 3.4) applied to two samples.

    Shapiro-Wilk on each sample, Bartlett on the pair, then the two-sample t test if Bartlett's
    p > alpha, else Welch's. It assumes independent samples.

    Attributes:
        shapiro_a: of the first sample.
        shapiro_b: of the second.
        bartlett: of both.
        levene: of both, in addition to the rule; less sensitive to samples that are not normal.
        chosen: the t test that the rule selects: its name is `two_sample_t` or `welch_t`.
        alpha: level of significance of every step.
    """

    shapiro_a: Outcome
    shapiro_b: Outcome
    bartlett: Outcome
    levene: Outcome
    chosen: Outcome
    alpha: float

    @property
    def test(self) -> str:
        """`two_sample_t` or `welch_t`."""
        return self.chosen.name

    @property
    def t(self) -> float:
        """The statistic of the chosen test; negative where the first mean is the lower."""
        return self.chosen.statistic

    @property
    def p(self) -> float:
        """The p-value of the chosen test."""
        return self.chosen.p

    @property
    def normal(self) -> bool:
        """Whether neither sample differs significantly from a normal one, as the rule assumes."""
        return min(self.shapiro_a.p, self.shapiro_b.p) > self.alpha

    @property
    def equal_variances(self) -> bool:
        """Whether Bartlett's test finds no significant difference of the variances."""
        return self.bartlett.p > self.alpha

    @property
    def significant(self) -> bool:
        """Whether the chosen test rejects equal means: p is at most alpha."""
        return self.p <= self.alpha


def thesis_test(
    a: ArrayLike,
    b: ArrayLike,
    *,
    alpha: float = 0.05,
    names: tuple[str, str] = ("first", "second"),
) -> ThesisTest:
    """Compares two samples as the thesis does (section 3.4, equations 46 to 55).

    Args:
        a: (runs,) scores of the first model, at least 3.
        b: (runs,) scores of the second; its number of runs may differ.
        alpha: level of significance.
        names: of the models, for messages.

    Raises:
        InputError: too few runs, values that are not finite, or a sample without spread.
    """
    check_level("alpha", alpha)
    equality = bartlett(a, b, names=names)
    choose = two_sample_t if equality.p > alpha else welch_t
    return ThesisTest(
        shapiro_wilk(a, name=names[0]),
        shapiro_wilk(b, name=names[1]),
        equality,
        levene(a, b, names=names),
        choose(a, b, names=names),
        alpha,
    )


def _several(samples: tuple[ArrayLike, ...], names: tuple[str, ...] | None) -> list[Sample]:
    if len(samples) < 2:
        raise InputError(f"expected at least 2 samples, got {len(samples)}")
    known = names or tuple(f"sample {i + 1}" for i in range(len(samples)))
    return [sample(one, name) for one, name in zip(samples, known, strict=True)]
