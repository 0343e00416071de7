"""Convergence and spread: curves and samples whose answer is known."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from offbeat.comparison.statistics import (
    bartlett,
    convergence,
    enough_epochs,
    levene,
    pitman_morgan,
    settling,
    spread_comparison,
)
from offbeat.errors import InputError

A = [0.7, -1.6, -0.2, -1.2, -0.1, 3.4, 3.7, 0.8, 0.0, 2.0]
B = [1.9, 0.8, 1.1, 0.1, -0.1, 4.4, 5.5, 1.6, 4.6, 3.4]


def decay(epochs, time, floor=1.0, start=9.0):
    """floor + start exp(-epoch / time)."""
    return floor + start * np.exp(-np.arange(1, epochs + 1) / time)


# --- curves ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("time", [5.0, 10.0, 20.0])
def test_an_exponential_curve_settles_when_its_exponential_has_become_small(time):
    """1 + 9 exp(-e / T) falls to 1.05 of its end at e = T ln(9 / 0.05), for an end of 1."""
    found = settling(decay(400, time))
    assert found.settled == found.reached == math.ceil(time * math.log(9 / 0.05))
    assert found.final == pytest.approx(1.0, abs=1e-6)
    assert found.epochs == 400


def test_a_curve_that_leaves_again_has_reached_but_not_settled():
    found = settling([9, 1.04, 5, 1.0, 1.051, 1.05, 0.9, 1.0])
    assert (found.reached, found.settled) == (2, 6)
    assert (found.lowest, found.lowest_epoch, found.final) == (0.9, 7, 1.0)


def test_a_curve_below_its_end_from_the_start_settles_at_once():
    assert (settling([1.0, 1.0]).settled, settling([0.5, 1.0]).settled) == (1, 1)


def test_a_looser_tolerance_settles_no_later():
    curve = decay(100, 15) * (1 + 0.02 * np.sin(np.arange(100)))
    settled = [settling(curve, tolerance=t).settled for t in (0.01, 0.05, 0.2)]
    assert settled == sorted(settled, reverse=True)
    assert settled[0] > settled[2]


def test_the_trend_is_the_relative_change_per_epoch():
    assert settling(3 * 0.985 ** np.arange(50)).trend == pytest.approx(-0.015, rel=1e-9)
    assert settling(np.ones(50)).trend == pytest.approx(0.0, abs=1e-12)
    assert math.isnan(settling([1.0, 2.0]).trend)


def test_the_roughness_is_the_spread_of_the_steps_and_a_smooth_fall_has_none():
    assert settling(0.9 ** np.arange(40)).roughness == pytest.approx(0.0, abs=1e-12)
    jumps = np.where(np.arange(400) % 2, 1.1, 1.0)
    n = 199  # steps of the second half, all plus or minus log 1.1
    expected = math.log(1.1) * math.sqrt(n / (n - 1) * (1 - 1 / n**2))
    assert settling(jumps).roughness == pytest.approx(expected, rel=1e-9)


def test_the_final_value_may_be_a_mean_of_last_epochs():
    found = settling([4.0, 3.0, 1.2, 0.8], final_over=2)
    assert found.final == pytest.approx(1.0)
    assert (found.reached, found.settled) == (4, 4)


@given(st.lists(st.floats(1e-3, 1e3), min_size=1, max_size=30), st.floats(1e-3, 1e3))
def test_settling_does_not_depend_on_the_unit_and_its_epochs_are_in_order(curve, unit):
    found, scaled = settling(curve), settling(np.array(curve) * unit, tolerance=0.05)
    assert 1 <= found.reached <= found.settled <= len(curve)
    assert scaled.lowest == pytest.approx(found.lowest * unit)
    tail = np.array(curve[found.settled - 1 :])
    assert (tail <= 1.05 * curve[-1]).all()
    assert found.settled == 1 or curve[found.settled - 2] > 1.05 * curve[-1]


def test_convergence_gathers_the_curves_of_a_model():
    times = [4.0, 5.0, 6.0, 7.0, 20.0, 9.0]
    found = convergence([decay(300, t) for t in times])
    epochs = [math.ceil(t * math.log(180)) for t in times]
    assert [one.settled for one in found.curves] == epochs
    assert found.settled.value == found.reached.value == pytest.approx(np.mean(epochs))
    assert found.settled.low < np.mean(epochs) < found.settled.high
    assert found.median == np.median(epochs)
    assert convergence([decay(300, 5.0)]).settled.low is None


def test_epochs_are_enough_where_every_curve_has_settled_by_then():
    curves = [decay(300, 5.0), decay(300, 12.0)]
    needed = math.ceil(12 * math.log(180))  # 63
    assert not enough_epochs(curves, 50).follows
    assert enough_epochs(curves, 50).enough == (True, False)
    assert enough_epochs(curves, 75).follows
    found = enough_epochs(curves, 50)
    assert found.needed == needed
    assert found.ratios == pytest.approx((1 + 9 * math.exp(-10), 1 + 9 * math.exp(-50 / 12)))


@pytest.mark.parametrize(
    ("call", "said"),
    [
        (lambda: settling([]), r"one error per epoch, got shape \(0,\)"),
        (lambda: settling([1.0, math.nan]), "holds nan after epoch 2, expected positive errors"),
        (lambda: settling([1.0, 0.0]), "holds 0.0 after epoch 2"),
        (lambda: settling([1.0], final_over=2), "from 1 to the 1 epochs of the curve, got 2"),
        (lambda: settling([1.0], tolerance=5), "tolerance must be between 0 and 1, got 5"),
        (lambda: convergence([]), "got no curves"),
        (lambda: enough_epochs([], 5), "got no curves"),
        (lambda: enough_epochs([[3.0, 2.0, 1.0]], 3), "must be below the 3 of the shortest curve"),
    ],
)
def test_curves_that_cannot_be_measured_are_refused(call, said):
    with pytest.raises(InputError, match=said):
        call()


# --- spread ---------------------------------------------------------------------------------------


def scaled(n, deviation, seed):
    raw = np.random.default_rng(seed).standard_normal(n)
    return deviation * (raw - raw.mean()) / raw.std(ddof=1)


def test_the_f_test_gives_the_worked_example_of_the_nist_handbook():
    """Section 1.3.5.9, ceramic strength: s = 65.54909 and 61.85425 of 240 each; F = 1.123037."""
    found = spread_comparison(scaled(240, 65.54909, 0), scaled(240, 61.85425, 1), resamples=200)
    assert found.f_test.statistic == pytest.approx(1.123037, abs=1e-6)
    assert found.f_test.df == (239.0, 239.0)
    assert found.f_test.p > 0.05
    # The critical values there, 0.7756 and 1.2894, are the ends of the interval of the ratio.
    ends = (1.123037 / found.ratio_f.high**2, 1.123037 / found.ratio_f.low**2)
    assert ends == pytest.approx((0.7756, 1.2894), abs=5e-5)


def test_the_ratio_of_deviations_has_the_interval_of_the_f_distribution():
    found = spread_comparison(A, B, resamples=999)
    ratio = np.std(A, ddof=1) / np.std(B, ddof=1)
    assert found.ratio.value == found.ratio_f.value == pytest.approx(ratio)
    # F(9, 9) at 97.5 % is 4.026 in printed tables.
    ends = (ratio / math.sqrt(4.026), ratio * math.sqrt(4.026))
    assert (found.ratio_f.low, found.ratio_f.high) == pytest.approx(ends, rel=1e-4)
    assert found.ratio.low < ratio < found.ratio.high
    assert (found.std_a, found.std_b) == pytest.approx((np.std(A, ddof=1), np.std(B, ddof=1)))
    assert (found.bartlett, found.levene) == (bartlett(A, B), levene(A, B))


def test_the_bootstrap_interval_of_the_ratio_equals_that_of_scipy():
    found = spread_comparison(A, B, resamples=999, seed=2)
    theirs = stats.bootstrap(
        (np.array(A), np.array(B)),
        lambda x, y, axis: x.std(axis=axis, ddof=1) / y.std(axis=axis, ddof=1),
        paired=True,
        vectorized=True,
        n_resamples=999,
        random_state=np.random.default_rng(2),
    ).confidence_interval
    assert (found.ratio.low, found.ratio.high) == pytest.approx((theirs.low, theirs.high))


def test_pitman_morgan_has_its_closed_form():
    """Morgan (1939): t = (F - 1) sqrt(n - 2) / (2 sqrt(F (1 - r^2))), F the ratio of variances."""
    f, r, n = np.var(A, ddof=1) / np.var(B, ddof=1), np.corrcoef(A, B)[0, 1], len(A)
    found = pitman_morgan(A, B)
    expected = (f - 1) * math.sqrt(n - 2) / (2 * math.sqrt(f * (1 - r**2)))
    assert found.statistic == pytest.approx(expected, rel=1e-9)
    assert found.df == (8.0,)
    assert found.p == pytest.approx(2 * stats.t.sf(abs(expected), 8))
    assert spread_comparison(A, B, resamples=200).pitman_morgan == found
    assert spread_comparison(A, B, paired=False, resamples=200).pitman_morgan is None


def test_a_difference_in_spread_that_pairs_show_is_hidden_from_unpaired_tests():
    random = np.random.default_rng(3)
    shared = random.standard_normal(12)
    a, b = 1.3 * shared, shared + 0.05 * random.standard_normal(12)
    found = spread_comparison(a, b, resamples=200)
    assert found.f_test.p > 0.3
    assert found.pitman_morgan.p < 1e-4
    assert found.pitman_morgan.statistic > 0


def test_runs_that_do_not_pair_have_a_spread_only_where_they_need_not():
    with pytest.raises(InputError, match="has 10 runs and 'second' 9"):
        spread_comparison(A, B[:9])
    assert spread_comparison(A, B[:9], paired=False, resamples=200).f_test.df == (9.0, 8.0)
    with pytest.raises(InputError, match="all 3 values of 'first' are equal"):
        spread_comparison([1.0, 1.0, 1.0], [1.0, 2.0, 4.0])
