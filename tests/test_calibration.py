"""Interval score, coverage and CRPS: closed forms, properties, and another library."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import scoringrules
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import norm

import offbeat as ob
from offbeat.answers.blend import model_rows
from offbeat.calibration import (
    COVERED,
    LEVELS,
    Calibration,
    CalibrationSums,
    interval_score,
    normal_crps,
    normal_half_widths,
)
from offbeat.data.batch import Batch, last_index
from offbeat.learning import GAUSSIAN
from offbeat.metrics import ScoreSums
from offbeat.plots.calibration import calibration_figure

NUMBERS = st.floats(-1e3, 1e3)


@given(NUMBERS, NUMBERS, st.floats(0, 1e3), st.floats(0.01, 0.99))
def test_the_interval_score_is_that_of_another_library(truth, low, width, level):
    expected = scoringrules.interval_score(truth, low, low + width, 1 - level, backend="numpy")
    assert interval_score(truth, low, low + width, level) == pytest.approx(float(expected))


def test_the_interval_score_by_hand():
    # width 2, and outside by 1 and by 0.5 times 2 / 0.2
    assert interval_score([1.0, 3.0, -0.5], 0.0, 2.0, 0.8) == pytest.approx([2.0, 12.0, 7.0])


@given(NUMBERS, NUMBERS, st.floats(0, 1e3), st.floats(0.01, 0.99), NUMBERS, st.floats(0.01, 100))
def test_the_interval_score_moves_with_the_data_and_has_its_unit(
    truth, low, width, level, shift, factor
):
    score = interval_score(truth, low, low + width, level)
    moved = (shift + factor * np.array([truth, low, low + width])).tolist()
    # Where the truth is beside an end, rounding of the moved numbers is all that is left.
    assert interval_score(*moved, level) == pytest.approx(factor * score, rel=1e-6, abs=1e-7)
    assert score >= (low + width) - low


@pytest.mark.parametrize("level", [0.5, 0.8, 0.95])
def test_the_expected_interval_score_is_lowest_at_the_true_quantiles(level):
    y = norm.ppf((np.arange(20_000) + 0.5) / 20_000)
    half = norm.ppf((1 + level) / 2)

    def expected(low, high):
        return interval_score(y, low, high, level).mean()

    # closed form: 2 / alpha times twice the density at the quantile
    assert expected(-half, half) == pytest.approx(4 * norm.pdf(half) / (1 - level), rel=2e-3)
    for low, high in ((-0.9, 0.9), (-1.1, 1.1), (-0.9, 1.1), (-1.1, 0.9)):
        assert expected(low * half, high * half) > expected(-half, half)


@given(NUMBERS, st.floats(0.1, 100))
def test_the_crps_of_a_normal_distribution_is_that_of_another_library(error, scale):
    expected = scoringrules.crps_normal(error, 0.0, scale, backend="numpy")
    assert normal_crps(error, scale) == pytest.approx(float(expected))


def added(parts, **options):
    """Normal predictions of standard normal values, added part by part."""
    sums = CalibrationSums(**options)
    for truth, scale, age in parts:
        half = normal_half_widths(scale)
        sums.add(truth, -half, half, normal_crps(truth, scale), age)
    return sums.result()


def test_a_right_distribution_covers_what_it_says_and_a_narrow_one_less():
    y = norm.ppf((np.arange(10_000) + 0.5) / 10_000)
    age = np.full(len(y), np.nan)
    right, narrow = (added([(y, np.full(len(y), s), age)], age_unit=1.0) for s in (1.0, 0.5))
    assert right.coverage == pytest.approx(LEVELS, abs=1e-3)
    assert all(n < r for n, r in zip(narrow.coverage, right.coverage, strict=True))
    assert narrow.crps > right.crps
    assert right.crps == pytest.approx(1 / math.sqrt(math.pi), rel=1e-3)
    assert narrow.interval_score[-1] > right.interval_score[-1]
    assert right.by_age == ()


@given(st.lists(st.integers(1, 9), min_size=1, max_size=6), st.integers(0, 1000))
def test_it_does_not_matter_in_which_parts_values_are_added(sizes, seed):
    random = np.random.default_rng(seed)
    count = sum(sizes)
    y, scale, age = random.normal(size=count), random.uniform(0.1, 3, count), random.random(count)
    ends = np.cumsum(sizes)[:-1]
    parts = zip(*(np.split(a, ends) for a in (y, scale, age)), strict=True)
    found, whole = added(parts, age_unit=0.1), added([(y, scale, age)], age_unit=0.1)
    assert found.count == whole.count == count
    for name in ("coverage", "interval_score", "crps"):
        assert getattr(found, name) == pytest.approx(getattr(whole, name))
    assert sum(each.count for each in whole.by_age) == count
    each = [(a.up_to_s, a.count) for a in whole.by_age]
    assert each == [(a.up_to_s, a.count) for a in found.by_age]


def test_widths_are_kept_by_time_since_observation():
    y, scale = np.zeros(5), np.array([1.0, 1.0, 2.0, 4.0, 9.0])
    found = added([(y, scale, np.array([0.1, 0.2, 0.3, 0.4, np.nan]))], age_unit=0.1)
    assert [a.up_to_s for a in found.by_age] == pytest.approx([0.1, 0.2, 0.4])
    wide = 2 * norm.ppf(0.95)
    assert [a.width for a in found.by_age] == pytest.approx([wide, wide, 3 * wide])
    assert [a.coverage for a in found.by_age] == [1.0, 1.0, 1.0]


def test_nothing_added_has_no_calibration():
    assert CalibrationSums().result() is None


def test_a_prediction_with_a_scale_is_scored_as_a_distribution_after_the_first_observation():
    values = np.array([[1.0], [2.0], [4.0], [7.0]])
    seen = np.array([[False], [True], [False], [False]])
    batch = Batch.of([ob.Trajectory(np.arange(4) * 0.1, values, seen)], dtype=torch.float64)
    mean, scale = torch.full((1, 4, 1), 3.0), torch.full((1, 4, 1), 2.0)
    sums = ScoreSums(1, gap_unit=0.1)
    sums.add(mean, batch, scale)
    scores = sums.scores()
    error = np.array([1.0, 4.0])  # of the rows after the first observation
    assert scores.calibration.count == 2
    expected = scoringrules.crps_normal(error, 0.0, 2.0, backend="numpy").mean()
    assert scores.calibration.crps == pytest.approx(expected)
    assert scores.calibration.shown(scores.calibration.coverage) == {0.5: 0.5, 0.8: 0.5, 0.95: 0.5}
    assert set(scores.to_dict()["interval_score_scaled"]) == {f"{level:g}" for level in COVERED}
    assert [a.count for a in scores.calibration.by_age] == [1, 1]
    plain = ScoreSums(1)
    plain.add(mean, batch)
    assert plain.scores().calibration is None
    assert "coverage" not in plain.scores().to_dict()


def test_the_figure_shows_what_was_asked_and_what_was_got():
    y = norm.ppf((np.arange(1000) + 0.5) / 1000)
    ages = np.repeat([0.1, 0.4], 500)
    found = added([(y, np.ones(1000), ages)], age_unit=0.1)
    figure = calibration_figure({"one step": found, "forecast": found}, title="a log")
    left, right = figure.axes
    drawn = {line.get_label(): line for line in left.lines}
    assert {"one step", "forecast"} <= set(drawn)
    assert drawn["forecast"].get_ydata() == pytest.approx(100 * np.array(found.coverage))
    assert right.lines[0].get_xdata() == pytest.approx([0.1, 0.4])
    with pytest.raises(ob.InputError, match="no task with intervals"):
        calibration_figure({})


def test_a_calibration_is_json_with_the_levels_that_are_shown():
    same = tuple(LEVELS)
    found = Calibration(3, LEVELS, same, same, 0.5).to_dict()
    assert found["coverage"] == {"0.5": 0.5, "0.8": 0.8, "0.95": 0.95}
    assert found["crps_scaled"] == 0.5


@pytest.mark.parametrize("as_it_is", [True, False])
def test_a_model_with_a_gaussian_head_is_blended_by_its_mean_and_scored_by_itself(as_it_is):
    times = 0.02 * np.arange(400)
    random = np.random.default_rng(0)
    values = np.stack([np.sin(3 * times), np.cos(2 * times)], axis=1)
    values += 0.1 * random.normal(size=values.shape)
    log = ob.Dataset((ob.Trajectory(times, values),))
    learned = ob.learn(
        log,
        model=ob.ModelConfig(head="gaussian", hidden_size=4, field_units=(6,)),
        training=ob.TrainConfig(epochs=1, tasks_per_epoch=None if as_it_is else 16),
        split=ob.SplitConfig(by="time", window=40, cut="consecutive") if as_it_is else None,
        as_it_is=as_it_is,
        two_sided=False,
        baselines=["last_value", "constant_velocity", "linear"],
        progress=False,
    )
    assert GAUSSIAN in learned.notes
    blend = learned.blend
    batch = blend.forward.batch(learned.test)
    found = blend.forward(batch)
    assert (found.scale > 0).all()
    alone = replace(blend, gamma=np.ones_like(blend.gamma))
    answers, rows = alone.causal(learned.test), model_rows(blend.forward, learned.test)
    within = [~a.beyond & seen(t) for a, t in zip(answers, learned.test, strict=True)]
    answered = np.concatenate([a.values[w] for a, w in zip(answers, within, strict=True)])
    means = np.concatenate([m[w] for m, w in zip(rows, within, strict=True)])
    assert len(means) > 50
    assert answered == pytest.approx(means)
    answer = blend.causal(learned.test)[0]
    half = answer.half_widths()
    assert half == pytest.approx(blend.widths.at(answer.place, answer.unit)), "conformal"
    own = ob.evaluate(blend.forward, learned.test).scores[blend.forward.name].calibration
    mean, scale, known = found.mean, found.scale, batch.targets & (last_index(batch.mask) >= 0)
    error, spread = ((a[known]).detach().numpy() for a in (batch.values - mean, scale))
    expected = scoringrules.crps_normal(error, 0.0, spread, backend="numpy").mean()
    assert own.crps == pytest.approx(float(expected), rel=1e-5)


def seen(trajectory):
    """(rows, channels) whether a channel was observed in an earlier row."""
    found = np.zeros_like(trajectory.observed)
    found[1:] = np.logical_or.accumulate(trajectory.observed, axis=0)[:-1]
    return found
