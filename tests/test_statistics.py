"""Each statistic against a published worked example, a second library, or a closed form.

The numbers of a second library were computed in an environment of its own: statsmodels 0.15.0,
scikit-posthocs 0.17.1, pingouin 0.7.0.
"""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy import stats

from offbeat.comparison.statistics import (
    bartlett,
    bca,
    critical_difference,
    friedman,
    hedges_g,
    holm,
    levene,
    paired_comparison,
    paired_t,
    shapiro_wilk,
    thesis_test,
    two_sample_t,
    welch_t,
    wilcoxon,
)
from offbeat.comparison.statistics.paired import small_sample_correction
from offbeat.errors import InputError

# Weights of eleven men, Shapiro and Wilk (1965), section 5: W = 0.79.
WEIGHTS = [148, 154, 158, 160, 161, 162, 166, 170, 182, 195, 236]

# Extra hours of sleep under two drugs, ten patients: `sleep` of R, Student (1908).
DRUG_1 = [0.7, -1.6, -0.2, -1.2, -0.1, 3.4, 3.7, 0.8, 0.0, 2.0]
DRUG_2 = [1.9, 0.8, 1.1, 0.1, -0.1, 4.4, 5.5, 1.6, 4.6, 3.4]

# Gear diameters, ten batches: GEAR.DAT, NIST/SEMATECH e-Handbook, sections 1.3.5.7 and 1.3.5.10.
GEAR = np.array([
    [1.006, 0.996, 0.998, 1.000, 0.992, 0.993, 1.002, 0.999, 0.994, 1.000],
    [0.998, 1.006, 1.000, 1.002, 0.997, 0.998, 0.996, 1.000, 1.006, 0.988],
    [0.991, 0.987, 0.997, 0.999, 0.995, 0.994, 1.000, 0.999, 0.996, 0.996],
    [1.005, 1.002, 0.994, 1.000, 0.995, 0.994, 0.998, 0.996, 1.002, 0.996],
    [0.998, 0.998, 0.982, 0.990, 1.002, 0.984, 0.996, 0.993, 0.980, 0.996],
    [1.009, 1.013, 1.009, 0.997, 0.988, 1.002, 0.995, 0.998, 0.981, 0.996],
    [0.990, 1.004, 0.996, 1.001, 0.998, 1.000, 1.018, 1.010, 0.996, 1.002],
    [0.998, 1.000, 1.006, 1.000, 1.002, 0.996, 0.998, 0.996, 1.002, 1.006],
    [1.002, 0.998, 0.996, 0.995, 0.996, 1.004, 1.004, 0.998, 0.999, 0.991],
    [0.991, 0.995, 0.984, 0.994, 0.997, 0.997, 0.991, 0.998, 1.004, 0.997],
])  # fmt: skip

# Depression before and after a tranquilizer: R's `?wilcox.test`, Hollander and Wolfe (1973), p. 29.
BEFORE = [1.83, 0.50, 1.62, 2.48, 1.68, 1.88, 1.55, 3.06, 1.30]
AFTER = [0.878, 0.647, 0.598, 2.05, 1.06, 1.29, 1.06, 3.14, 1.29]

# Times to round first base by three methods: R's `?friedman.test`, Hollander and Wolfe, p. 140.
ROUNDING = np.array([
    [5.40, 5.50, 5.55], [5.85, 5.70, 5.75], [5.20, 5.60, 5.50], [5.55, 5.50, 5.40],
    [5.90, 5.85, 5.70], [5.45, 5.55, 5.60], [5.40, 5.40, 5.35], [5.45, 5.50, 5.35],
    [5.25, 5.15, 5.00], [5.85, 5.80, 5.70], [5.25, 5.20, 5.10], [5.65, 5.55, 5.45],
    [5.60, 5.35, 5.45], [5.05, 5.00, 4.95], [5.50, 5.50, 5.40], [5.45, 5.55, 5.50],
    [5.55, 5.55, 5.35], [5.45, 5.50, 5.55], [5.50, 5.45, 5.25], [5.65, 5.60, 5.40],
    [5.70, 5.65, 5.55], [6.30, 6.30, 6.25],
])  # fmt: skip

# AUC of four decision trees, 14 data sets: Demsar (2006), table 6; higher is better there. In the
# row before the last it prints 0.975 twice, and ranks the two 2 and 3: 0.9751 is to say the same.
CLASSIFIERS = ("C4.5", "C4.5+m", "C4.5+cf", "C4.5+m+cf")
AUC = np.array([
    [0.763, 0.768, 0.771, 0.798], [0.599, 0.591, 0.590, 0.569], [0.954, 0.971, 0.968, 0.967],
    [0.628, 0.661, 0.654, 0.657], [0.882, 0.888, 0.886, 0.898], [0.936, 0.931, 0.916, 0.931],
    [0.661, 0.668, 0.609, 0.685], [0.583, 0.583, 0.563, 0.625], [0.775, 0.838, 0.866, 0.875],
    [1.000, 1.000, 1.000, 1.000], [0.940, 0.962, 0.965, 0.962], [0.619, 0.666, 0.614, 0.669],
    [0.972, 0.981, 0.9751, 0.975], [0.957, 0.978, 0.946, 0.970],
])  # fmt: skip

# Spatial test data, Efron and Tibshirani (1993), table 14.1, variable A.
SPATIAL = [
    48, 36, 20, 29, 42, 42, 20, 42, 22, 41, 45, 14, 6,
    0, 33, 28, 34, 4, 32, 24, 47, 41, 24, 26, 30, 41,
]  # fmt: skip


def with_moments(n, means, deviations, correlation=0.0, seed=0):
    """Two samples whose means, standard deviations and correlation are exactly these."""
    raw = np.random.default_rng(seed).standard_normal((n, 2))
    raw -= raw.mean(axis=0)
    white = raw @ np.linalg.inv(np.linalg.cholesky(np.cov(raw.T))).T
    second = correlation * white[:, 0] + math.sqrt(1 - correlation**2) * white[:, 1]
    return means[0] + deviations[0] * white[:, 0], means[1] + deviations[1] * second


# --- independent samples --------------------------------------------------------------------------


def test_shapiro_wilk_gives_the_w_of_the_paper_of_1965():
    found = shapiro_wilk(WEIGHTS)
    assert round(found.statistic, 2) == 0.79
    assert found.p == pytest.approx(0.0067, abs=5e-5)  # R: shapiro.test


def test_bartlett_gives_the_statistic_of_the_nist_handbook():
    found = bartlett(*GEAR)
    assert found.statistic == pytest.approx(20.78580, abs=1e-4)
    assert found.df == (9.0,)
    assert found.p == pytest.approx(0.01364, abs=5e-6)  # chi-squared beyond 20.78587, 9 df


def test_levene_gives_the_statistic_of_the_nist_handbook():
    found = levene(*GEAR)
    assert found.statistic == pytest.approx(1.705910, abs=1e-5)
    assert found.df == (9.0, 90.0)


def test_student_and_welch_give_the_numbers_of_the_sleep_data():
    student, welch = two_sample_t(DRUG_1, DRUG_2), welch_t(DRUG_1, DRUG_2)
    assert student.statistic == pytest.approx(-1.8608, abs=5e-5)
    assert student.df == (18.0,)
    assert student.p == pytest.approx(0.07919, abs=5e-6)
    assert welch.statistic == pytest.approx(-1.8608, abs=5e-5)
    assert welch.df[0] == pytest.approx(17.776, abs=5e-4)
    assert welch.p == pytest.approx(0.07939, abs=5e-6)


def test_the_thesis_rule_takes_student_where_bartlett_finds_nothing():
    found = thesis_test(DRUG_1, DRUG_2)
    assert found.bartlett.p > 0.05
    assert (found.test, found.chosen) == ("two_sample_t", two_sample_t(DRUG_1, DRUG_2))
    assert (found.equal_variances, found.significant, found.normal) == (True, False, True)
    assert found.shapiro_a == shapiro_wilk(DRUG_1)
    assert found.levene == levene(DRUG_1, DRUG_2)


def test_the_thesis_rule_takes_welch_where_variances_differ():
    narrow = [x / 10 for x in DRUG_1]
    found = thesis_test(narrow, DRUG_2)
    assert found.bartlett.p <= 0.05
    assert (found.test, found.t) == ("welch_t", welch_t(narrow, DRUG_2).statistic)
    assert found.significant == (found.p <= 0.05)


def test_the_thesis_rule_follows_the_equations_of_the_thesis():
    a, b = np.array(DRUG_1), np.array(DRUG_2)
    n, va, vb = 10, a.var(ddof=1), b.var(ddof=1)
    pooled = math.sqrt((va + vb) / 2)  # equation 49
    assert two_sample_t(a, b).statistic == pytest.approx(
        (a.mean() - b.mean()) / (pooled * math.sqrt(2 / n))  # equation 48
    )
    errors = va / n + vb / n  # equation 51, squared
    assert welch_t(a, b).statistic == pytest.approx((a.mean() - b.mean()) / math.sqrt(errors))
    total, k = 2 * n, 2  # equations 54 and 55
    together = ((n - 1) * va + (n - 1) * vb) / (total - k)
    above = (total - k) * math.log(together) - (n - 1) * (math.log(va) + math.log(vb))
    below = 1 + (2 / (n - 1) - 1 / (total - k)) / (3 * (k - 1))
    assert bartlett(a, b).statistic == pytest.approx(above / below)


@pytest.mark.parametrize(
    ("deviations", "means", "published"),
    [
        # ODE-RNN, ODE-GRU-D of table 3.6 to half a unit of the last place; p-values of table 3.8.
        (((0.00105, 0.00115), (0.00095, 0.00105)), (0.0366, 0.0369), {"bartlett": 0.9576}),
        (((0.00125, 0.00135), (0.00035, 0.00045)), (0.0636, 0.0631), {"bartlett": 0.0012}),
        (((0.00075, 0.00085), (0.00035, 0.00045)), (0.0829, 0.0820), {"bartlett": 0.0480}),
        (((0.00055, 0.00065), (0.00035, 0.00045)), (0.1019, 0.1012), {"bartlett": 0.2910}),
    ],
)
def test_bartlett_agrees_with_the_thesis_up_to_the_rounding_of_its_table(
    deviations, means, published
):
    (low_a, high_a), (low_b, high_b) = deviations
    nearest = max(low_a / high_b, 1.0)
    extremes = [
        bartlett(*with_moments(10, means, pair)).p
        for pair in ((high_a, low_b), (nearest * high_b, high_b))
    ]
    if nearest == 1.0:  # rounding allows equal deviations
        extremes[1] = 1.0
    assert min(extremes) <= published["bartlett"] <= max(extremes)


# --- pairs ----------------------------------------------------------------------------------------


def test_the_paired_t_test_gives_the_numbers_of_the_sleep_data():
    found = paired_t(DRUG_1, DRUG_2)
    assert found.statistic == pytest.approx(-4.0621, abs=5e-5)
    assert found.df == (9.0,)
    assert found.p == pytest.approx(0.002833, abs=5e-7)
    interval = paired_comparison(DRUG_1, DRUG_2).difference_t
    assert interval.value == pytest.approx(-1.58)
    assert (interval.low, interval.high) == pytest.approx((-2.4598858, -0.7001142), abs=5e-8)


def test_wilcoxon_gives_the_numbers_of_the_depression_data():
    found = wilcoxon(BEFORE, AFTER)
    assert found.statistic == 5.0  # V = 40 of 45
    assert found.p == pytest.approx(2 * 0.01953, abs=1e-5)  # published one-sided


def test_wilcoxon_leaves_out_pairs_without_a_difference_and_counts_ties_exactly():
    found = wilcoxon(DRUG_1, DRUG_2)
    assert found.statistic == 0.0
    assert found.p == 2 / 2**9  # nine differences, all of one sign
    assert found.p == pytest.approx(0.003906, abs=5e-7)  # pingouin


@given(
    st.lists(st.integers(-6, 6).filter(bool), min_size=3, max_size=9).filter(
        lambda d: len(set(d)) > 1
    )
)
def test_wilcoxon_equals_the_count_over_all_signs(differences):
    d = np.array(differences, dtype=float)
    ranks = stats.rankdata(np.abs(d))
    signs = np.array(np.meshgrid(*[[0, 1]] * len(d))).reshape(len(d), -1).T
    sums = signs @ ranks
    extreme = min(ranks[d > 0].sum(), ranks[d < 0].sum())
    assert wilcoxon(d, np.zeros(len(d))).p == pytest.approx(min(1, 2 * (sums <= extreme).mean()))


def test_wilcoxon_of_many_pairs_equals_scipy_without_ties():
    random = np.random.default_rng(1)
    for n in (20, 50, 60):
        d = random.standard_normal(n) + 0.2
        assert wilcoxon(d, np.zeros(n)).p == pytest.approx(stats.wilcoxon(d).pvalue, rel=1e-9)


def test_hedges_g_of_unpaired_samples_gives_the_worked_example_of_borenstein():
    """Borenstein, Hedges, Higgins, Rothstein (2009), chapter 4: d = 0.5970, g = 0.5924."""
    a, b = with_moments(50, (103.0, 100.0), (5.5, 4.5))
    found = hedges_g(a, b, form="independent", resamples=100)
    assert found.value == pytest.approx(0.5924, abs=1e-4)


def test_hedges_g_of_pairs_gives_the_worked_example_of_borenstein():
    """The same, matched groups: deviation 7.1005 within, 5.5 of differences; g = 0.4160.

    With equal deviations the book's unit, S_difference / sqrt(2 (1 - r)), is the average one.
    """
    a, b = with_moments(50, (103.0, 100.0), (7.1005, 7.1005), correlation=0.7)
    assert (a - b).std(ddof=1) == pytest.approx(5.5, abs=1e-4)
    assert hedges_g(a, b, resamples=100).value == pytest.approx(0.4160, abs=1e-4)
    z = hedges_g(a, b, form="difference", resamples=100).value
    assert z == pytest.approx(3 / 5.5 * (1 - 3 / (4 * 49 - 1)), abs=1e-4)


def test_hedges_g_is_cohens_d_of_a_second_library_times_the_correction():
    j9 = math.gamma(4.5) / (math.sqrt(4.5) * math.gamma(4.0))
    average = hedges_g(DRUG_1, DRUG_2, resamples=100).value
    assert average == pytest.approx(-0.8321810813495395 * j9, rel=1e-12)  # pingouin, paired
    free = hedges_g(DRUG_1, DRUG_2, form="independent", resamples=100).value
    # pingouin's correction is the approximation 1 - 3 / (4 df - 1).
    assert free == pytest.approx(
        -0.7970185004474464 / (1 - 3 / 71) * small_sample_correction(18), rel=1e-12
    )


def test_the_small_sample_correction_has_its_closed_form_and_its_published_approximation():
    """Hedges (1981): J = Gamma(m / 2) / (sqrt(m / 2) Gamma((m - 1) / 2)), near 1 - 3 / (4m - 1)."""
    assert small_sample_correction(2) == pytest.approx(1 / math.sqrt(math.pi), rel=1e-12)
    assert small_sample_correction(4) == pytest.approx(math.sqrt(2 / math.pi), rel=1e-12)
    for m in (2, 9, 18, 98, 400):
        assert small_sample_correction(m) == pytest.approx(1 - 3 / (4 * m - 1), abs=0.035 / m**2)


def test_a_paired_comparison_holds_every_number():
    found = paired_comparison(DRUG_1, DRUG_2, resamples=999, names=("one", "two"))
    assert found.runs == 10
    assert (found.mean_a, found.mean_b) == pytest.approx((0.75, 2.33))
    assert found.paired_t == paired_t(DRUG_1, DRUG_2)
    assert found.wilcoxon == wilcoxon(DRUG_1, DRUG_2)
    assert found.wilcoxon_floor == 2.0**-8
    assert found.correlation == pytest.approx(0.7952, abs=5e-5)  # R: cor
    assert found.wins == 0.95
    assert found.difference.low < -1.58 < found.difference.high
    assert found.difference.method == "bca_bootstrap"
    assert found.hedges_g == hedges_g(DRUG_1, DRUG_2, resamples=999)
    assert found.hedges_gz == hedges_g(DRUG_1, DRUG_2, form="difference", resamples=999)
    assert found == paired_comparison(DRUG_1, DRUG_2, resamples=999), "seeded"
    assert found != paired_comparison(DRUG_1, DRUG_2, resamples=999, seed=1)


@settings(max_examples=25)
@given(arrays(float, (8, 2), elements=st.floats(0.01, 1.0)).filter(
    lambda x: np.ptp(x[:, 0] - x[:, 1]) > 1e-3 and min(x.std(axis=0)) > 1e-3
))  # fmt: skip
def test_turning_a_pair_around_turns_every_sign_and_leaves_every_p(x):
    one = paired_comparison(x[:, 0], x[:, 1], resamples=200)
    two = paired_comparison(x[:, 1], x[:, 0], resamples=200)
    for name in ("paired_t", "wilcoxon"):
        assert getattr(one, name).p == pytest.approx(getattr(two, name).p, rel=1e-6)
    assert one.difference.value == pytest.approx(-two.difference.value)
    assert one.hedges_g.value == pytest.approx(-two.hedges_g.value)
    assert one.wins == pytest.approx(1 - two.wins)


def test_what_both_models_share_in_a_repeat_hides_a_difference_only_from_unpaired_tests():
    random = np.random.default_rng(0)
    shared = random.normal(0.1, 0.003, 10)
    a = shared + random.normal(0.0, 0.0002, 10)
    b = shared + 0.0007 + random.normal(0.0, 0.0002, 10)
    assert thesis_test(a, b).p > 0.3
    assert paired_t(a, b).p < 1e-3
    assert wilcoxon(a, b).p < 0.01


# --- bootstrap ------------------------------------------------------------------------------------


def variance(x):
    return ((x - x.mean(axis=-1, keepdims=True)) ** 2).mean(axis=-1)


def test_the_bca_interval_gives_the_published_one_of_efron_and_tibshirani():
    """Table 14.2: 90 % BCa of the variance of A is (115.8, 259.6), from 2000 resamples.

    Either end has a Monte Carlo error of some 1 % there; ours, from 40,000, much less.
    """
    found = bca(variance, np.array(SPATIAL, dtype=float), confidence=0.9, resamples=40_000)
    assert found.value == pytest.approx(171.5, abs=0.05)
    assert (found.low, found.high) == pytest.approx((115.8, 259.6), rel=0.02)


@pytest.mark.parametrize("confidence", [0.8, 0.95])
def test_the_bca_interval_equals_that_of_scipy_for_the_same_draws(confidence):
    a, b = np.array(DRUG_1), np.array(DRUG_2)

    def difference(x, y, axis=-1):
        return x.mean(axis=axis) - 1.1 * y.mean(axis=axis)

    ours = bca(difference, a, b, confidence=confidence, resamples=999, seed=3)
    theirs = stats.bootstrap(
        (a, b),
        difference,
        paired=True,
        vectorized=True,
        n_resamples=999,
        confidence_level=confidence,
        random_state=np.random.default_rng(3),
    ).confidence_interval
    assert (ours.low, ours.high) == pytest.approx((theirs.low, theirs.high), rel=1e-12)


def test_the_bca_interval_of_unpaired_samples_equals_that_of_scipy():
    a, b = np.array(DRUG_1), np.array(DRUG_2[:7])

    def ratio(x, y, axis=-1):
        return x.std(axis=axis) / y.std(axis=axis)

    ours = bca(ratio, a, b, paired=False, resamples=20_000, seed=3)
    theirs = stats.bootstrap(
        (a, b),
        ratio,
        vectorized=True,
        n_resamples=20_000,
        random_state=np.random.default_rng(7),
    )
    expected = theirs.confidence_interval
    assert (ours.low, ours.high) == pytest.approx((expected.low, expected.high), rel=0.05)


def test_few_pairs_have_no_bootstrap_interval_and_five_have_one():
    few = paired_comparison(DRUG_1[:4], DRUG_2[:4])
    assert (few.difference.low, few.hedges_g.high) == (None, None)
    assert few.difference_t.low < few.difference_t.value < few.difference_t.high
    assert paired_comparison(DRUG_1[:6], DRUG_2[:6], resamples=500).hedges_gz.low is not None


def test_the_intervals_cover_the_truth_about_as_often_as_they_say():
    """90 % intervals of the mean paired difference of 20 normal pairs, 300 times."""
    random = np.random.default_rng(5)
    hits = 0
    for _ in range(300):
        found = bca(lambda x: x.mean(axis=-1), random.normal(1.0, 2.0, 20), confidence=0.9,
                    resamples=400)  # fmt: skip
        hits += found.low <= 1.0 <= found.high
    # Between chance alone (0.9 +- 3 x 0.017) and what few resamples and 20 runs take away.
    assert 0.82 <= hits / 300 <= 0.95


# --- several tests --------------------------------------------------------------------------------


def test_holm_equals_a_second_library():
    p = [0.01, 0.04, 0.03, 0.005, 0.8, 0.04, 1e-5]
    expected = (0.05, 0.12, 0.12, 0.03, 0.8, 0.12, 7e-5)  # statsmodels: multipletests
    assert holm(p) == pytest.approx(expected, rel=1e-12)
    assert holm([0.3]) == (0.3,)


@given(st.lists(st.floats(0, 1), min_size=1, max_size=12))
def test_holm_never_lowers_a_p_and_keeps_the_order(p):
    adjusted = holm(p)
    assert all(before <= after <= 1 for before, after in zip(p, adjusted, strict=True))
    order = np.argsort(p, kind="stable")
    assert (np.diff(np.array(adjusted)[order]) >= 0).all()
    assert min(adjusted) == pytest.approx(min(1.0, len(p) * min(p)))


@pytest.mark.parametrize("bad", [[], [0.5, 1.1], [0.5, math.nan], [-0.1]])
def test_holm_refuses_what_is_no_p_value(bad):
    with pytest.raises(InputError, match="numbers from 0 to 1"):
        holm(bad)


# --- more than two models -------------------------------------------------------------------------


def test_friedman_gives_the_numbers_of_the_rounding_times():
    found = friedman(dict(zip(("out", "narrow", "wide"), ROUNDING.T, strict=True)))
    assert found.statistic == pytest.approx(11.143, abs=5e-4)
    assert found.friedman.df == (2.0,)
    assert found.p == pytest.approx(0.003805, abs=5e-7)
    assert list(found.ranks) == ["wide", "narrow", "out"]


def test_friedman_and_nemenyi_give_the_worked_example_of_demsar():
    """Demsar (2006), section 3.2.2: ranks 3.143, 2.000, 2.893, 1.964; 9.28; CD 1.25 and 1.12."""
    scores = dict(zip(CLASSIFIERS, (1 - AUC).T, strict=True))
    found = friedman(scores)
    assert found.blocks == 14
    assert found.average_ranks == pytest.approx((3.143, 2.000, 2.893, 1.964), abs=5e-4)
    # The paper's chi-squared is without the correction for ties.
    squares = sum(rank**2 for rank in found.average_ranks)
    assert 12 * 14 / (4 * 5) * (squares - 4 * 5**2 / 4) == pytest.approx(9.28, abs=5e-3)
    assert found.statistic == pytest.approx(10.228346, abs=5e-7)  # pingouin, with it
    assert found.p == pytest.approx(0.016722, abs=5e-7)
    assert found.critical_difference == pytest.approx(1.25, abs=5e-3)
    # 2.291 sqrt(20 / 84) is 1.118 to the paper's 1.12.
    assert friedman(scores, alpha=0.1).critical_difference == pytest.approx(1.12, abs=5e-3)


def test_nemenyis_p_values_equal_a_second_library():
    found = friedman(dict(zip(CLASSIFIERS, (1 - AUC).T, strict=True)))
    expected = [  # scikit-posthocs: posthoc_nemenyi_friedman
        [1.0, 0.08867270928888271, 0.9561771752218107, 0.07418479506874454],
        [0.08867270928888271, 1.0, 0.2592280701547286, 0.999859449385133],
        [0.9561771752218107, 0.2592280701547286, 1.0, 0.22669688602641525],
        [0.07418479506874454, 0.999859449385133, 0.22669688602641525, 1.0],
    ]
    np.testing.assert_allclose(found.nemenyi_p, expected, rtol=1e-6)


@pytest.mark.parametrize(
    ("alpha", "quantiles"),
    [
        (0.05, (1.960, 2.343, 2.569, 2.728, 2.850, 2.949, 3.031, 3.102, 3.164)),
        (0.10, (1.645, 2.052, 2.291, 2.459, 2.589, 2.693, 2.780, 2.855, 2.920)),
    ],
)
def test_the_critical_values_are_those_of_demsars_table_5(alpha, quantiles):
    for models, q in enumerate(quantiles, start=2):
        found = critical_difference(models, 6, alpha=alpha) / math.sqrt(models * (models + 1) / 36)
        assert found == pytest.approx(q, abs=1.1e-3), models


def test_iman_davenport_follows_from_friedmans_chi_squared():
    found = friedman(dict(zip(("out", "narrow", "wide"), ROUNDING.T, strict=True)))
    n, k, x = 22, 3, found.statistic
    assert found.iman_davenport.statistic == pytest.approx((n - 1) * x / (n * (k - 1) - x))
    assert found.iman_davenport.df == (2.0, 42.0)
    assert found.iman_davenport.p == pytest.approx(
        stats.f.sf(found.iman_davenport.statistic, 2, 42)
    )


def test_models_that_rank_alike_in_every_block_have_no_finite_f():
    scores = {name: np.arange(12.0) + i for i, name in enumerate("abc")}
    found = friedman(scores)
    assert found.iman_davenport is None
    assert found.statistic == pytest.approx(12 * 2)
    assert found.average_ranks == (1.0, 2.0, 3.0)


def test_groups_are_the_maximal_runs_that_nothing_tells_apart():
    """Average ranks 1.5, 1.5, 3.25, 3.75 over 8 blocks; the critical difference is 1.66."""
    rows = [[1, 2, 3, 4]] * 3 + [[2, 1, 3, 4]] * 3 + [[1, 2, 4, 3], [2, 1, 4, 3]]
    found = friedman(dict(zip("abcd", np.array(rows, float).T, strict=True)))
    assert found.critical_difference == pytest.approx(2.569 * math.sqrt(20 / 48), abs=1e-3)
    assert found.groups == (("a", "b"), ("c", "d"))
    three_blocks = friedman(dict(zip("abcd", np.array(rows[1:4], float).T, strict=True)))
    assert three_blocks.critical_difference == pytest.approx(2.569 * math.sqrt(20 / 18), abs=1e-3)
    assert three_blocks.groups == (("a", "b", "c", "d"),)


# --- what is refused ------------------------------------------------------------------------------

PAIRED = [paired_comparison, paired_t, wilcoxon, hedges_g]
UNPAIRED = [thesis_test, two_sample_t, welch_t, bartlett, levene]


@pytest.mark.parametrize("test", PAIRED + UNPAIRED)
@pytest.mark.parametrize(
    ("a", "b", "said"),
    [
        ([1.0, 2.0], [3.0, 4.0], "has 2 runs, a comparison needs at least 3; train more repeats"),
        ([1.0, 2.0, math.nan], [3.0, 4.0, 6.0], "holds nan at place 2; leave that run out"),
        ([1.0, 2.0, 4.0], [3.0, math.inf, 6.0], "holds inf at place 1"),
        ([[1.0, 2.0, 4.0]], [3.0, 4.0, 6.0], r"shape \(runs,\), got shape \(1, 3\)"),
        (["x", "y", "z"], [3.0, 4.0, 6.0], "must be a list of numbers"),
        ([2.0, 2.0, 2.0], [2.0, 2.0, 2.0], "there is no spread"),
    ],
)
def test_what_cannot_be_tested_is_refused_in_one_line(test, a, b, said):
    with pytest.raises(InputError, match=said) as error:
        test(a, b)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("test", PAIRED)
def test_runs_that_do_not_pair_and_pairs_that_differ_alike_are_refused(test):
    with pytest.raises(InputError, match="'one' has 3 runs and 'two' 4: a paired test needs both"):
        test([1.0, 2.0, 4.0], [1.0, 2.0, 3.0, 4.0], names=("one", "two"))
    with pytest.raises(InputError, match=r"differ by the same -0\.1 in all 3 pairs"):
        test([0.1, 0.2, 0.4], [0.2, 0.3, 0.5])


@pytest.mark.parametrize("test", UNPAIRED[:3])
def test_a_sample_without_spread_is_named(test):
    with pytest.raises(InputError, match="all 3 values of 'two' are equal"):
        test([0.1, 0.2, 0.4], [0.3, 0.3, 0.3], names=("one", "two"))


@pytest.mark.parametrize(
    ("scores", "said"),
    [
        ({"a": [1, 2, 3], "b": [1, 2, 3]}, "at least 3 models, got 2"),
        ({"a": [1, 2, 3], "b": [1, 2, 3], "c": [1, 2]}, "'c' has 2 runs"),
        ({"a": [1, 2, 3], "b": [1, 2, 3], "c": [1, 2, 3, 4]}, "every model in every repeat"),
        ({name: [1, 2, 3] for name in "abc"}, "all 3 models score equally in each of 3 repeats"),
        ({"a": [1, 2, math.nan], "b": [1, 2, 3], "c": [1, 2, 4]}, "'a' holds nan at place 2"),
    ],
)
def test_friedman_refuses_what_cannot_be_ranked(scores, said):
    with pytest.raises(InputError, match=said):
        friedman(scores)


@pytest.mark.parametrize(
    ("call", "said"),
    [
        (lambda: thesis_test(DRUG_1, DRUG_2, alpha=5), "alpha must be between 0 and 1, got 5"),
        (lambda: paired_comparison(DRUG_1, DRUG_2, confidence=95), "confidence must be between"),
        (lambda: hedges_g(DRUG_1, DRUG_2, form="paired"), "unknown form of Hedges' g 'paired'"),
        (lambda: hedges_g(DRUG_1, DRUG_2, resamples=10), "at least 100, got 10"),
        (lambda: critical_difference(1, 10), "expected at least 2 of each"),
        (lambda: bartlett(DRUG_1), "at least 2 samples, got 1"),
    ],
)
def test_levels_and_counts_out_of_range_are_refused(call, said):
    with pytest.raises(InputError, match=said):
        call()
