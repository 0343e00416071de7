"""Fills and forecasts: closed forms, what they may look at, and scores on the same cells."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from model_helpers import dataset, small_model, with_observed
from scipy.interpolate import PchipInterpolator

import offbeat as ob
from offbeat.answers.fill_rule import (
    GROUPS,
    SIDES,
    START,
    FillRule,
    NormalEquations,
    _ridge_solution,
    group_of,
)
from offbeat.answers.scoring import ChannelScores, _targets
from offbeat.answers.two_sided import _sides_of, fit_rule, reversed_in_time
from offbeat.baselines import fill, fillers, forecast, forecasters
from offbeat.data.masking import masked_values
from offbeat.data.rows import add_rows, times_at_rate

NAN = float("nan")


def one_channel(times, values, observed) -> ob.Trajectory:
    mask = np.zeros((len(times), 1), dtype=bool)
    mask[observed] = True
    return ob.Trajectory(times, np.asarray(values, dtype=float)[:, None], observed=mask)


def pair_of(data: ob.Dataset, name: str = "anchored_ode_gru_d", **options) -> ob.TwoSided:
    """Two models with drawn weights and a rule with weights of its own in every group."""
    forward = small_model(name, data, seed=1, std=0.2, **options)
    backward = small_model(name, reversed_in_time(data), seed=2, std=0.2, **options)
    random = np.random.default_rng(0)
    weights = random.uniform(-1, 1, (data.channels, len(SIDES), GROUPS, START.shape[1]))
    cells = np.ones((len(SIDES), GROUPS), dtype=int)
    chosen = (("ridge 10",) * len(SIDES),) * data.channels
    return ob.TwoSided(forward, backward, FillRule(0.01, weights, cells, chosen))


def fill_with(weights, trajectory: ob.Trajectory, f, b) -> np.ndarray:
    """What the rule says with one set of weights everywhere; f and b are given."""
    sides = _sides_of(trajectory, np.asarray(f, float), np.asarray(b, float))
    return np.asarray(sides.base + (np.asarray(weights)[sides.side] * sides.terms).sum(axis=2))


# --- trivial predictors ---------------------------------------------------------------------------


@given(st.integers(0, 1000))
def test_a_straight_line_is_interpolated_exactly_by_linear_and_by_pchip(seed):
    random = np.random.default_rng(seed)
    times = np.cumsum(random.integers(1, 50, 20)) / 64
    line = 3 - 2 * times
    seen = np.unique([0, 19, *random.integers(0, 20, 4)])
    one = one_channel(times, line, seen)
    for method in ("linear", "pchip"):
        np.testing.assert_allclose(fill(one, method, [0.0])[:, 0], line, rtol=0, atol=1e-12)


def test_the_last_value_by_hand_and_the_mean_before_it():
    one = one_channel([0, 1, 2, 3, 4], [5, 6, 7, 8, 9], [1, 3])
    assert fill(one, "last_value", [2.5])[:, 0].tolist() == [2.5, 2.5, 6, 6, 8]


def test_interpolation_holds_outside_its_observations():
    one = one_channel([0, 1, 2, 3, 4], [5, 6, 7, 8, 9], [1, 3])
    for method in ("linear", "pchip"):
        np.testing.assert_allclose(fill(one, method, [0.0])[:, 0], [6, 6, 7, 8, 8], atol=1e-12)
    lonely = one_channel([0, 1, 2], [5, 6, 7], [1])
    for method in ("linear", "pchip"):
        assert fill(lonely, method, [0.0])[:, 0].tolist() == [6, 6, 6]


def test_pchip_is_scipys_per_channel_on_the_observed_values():
    (one,) = dataset(1, rows=40)
    got = fill(one, "pchip", [0.0] * 3)
    for channel in range(3):
        seen = one.observed[:, channel]
        curve = PchipInterpolator(one.times[seen], one.values[seen, channel])
        inside = (one.times >= one.times[seen][0]) & (one.times <= one.times[seen][-1])
        np.testing.assert_allclose(got[inside, channel], curve(one.times[inside]), atol=1e-12)


@pytest.mark.parametrize("method", fillers())
def test_a_channel_never_observed_gets_the_training_mean(method):
    (one,) = dataset(1, rows=10)
    blind = with_observed(one, [True, False, True])
    assert fill(blind, method, [1.0, 2.0, 3.0])[:, 1].tolist() == [2.0] * 10


def test_forecasts_by_hand():
    one = one_channel([0.0, 1.0, 2.0, 4.0], [9, 5, 7, 100], [0, 1, 2])
    at = np.array([3.0, 4.5])
    assert forecast(one, at, "last_value", [0.0])[:, 0].tolist() == [7, 7]
    assert forecast(one, at, "constant_velocity", [0.0])[:, 0].tolist() == [9, 12]
    once = one_channel([0.0, 1.0], [9, 5], [0])
    never = one_channel([0.0, 1.0], [9, 5], [])
    for method in forecasters():
        assert forecast(once, at, method, [0.0])[:, 0].tolist() == [9, 9]
        assert forecast(never, at, method, [4.0])[:, 0].tolist() == [4, 4]


# --- the rule -------------------------------------------------------------------------------------


def test_models_that_go_on_straight_give_the_cubic_hermite_interpolation():
    """Exact for any cubic: the start weights with tangents for predictions."""
    times = np.array([0.0, 0.3, 0.5, 1.1, 1.9, 2.0])
    cubic = np.polynomial.Polynomial([1.0, -2.0, 0.7, 3.0])
    one = one_channel(times, cubic(times), [0, 5])
    slope = cubic.deriv()
    f = cubic(0.0) + slope(0.0) * times
    b = cubic(2.0) + slope(2.0) * (times - 2.0)
    got = fill_with(START, one, f[:, None], b[:, None])[1:5, 0]
    np.testing.assert_allclose(got, cubic(times[1:5]), rtol=0, atol=1e-12)


def test_the_rule_contains_linear_interpolation_and_pchip_and_the_last_values():
    (one,) = dataset(1, rows=30)
    random = np.random.default_rng(0)
    f, b = random.normal(size=(2, 30, 3))
    masked = ~one.observed
    observed = [1.0, 0, 0, 0, 0]
    for last, method in (([0, 0, 0, 1.0, 0], "linear"), ([0, 0, 0, 0, 1.0], "pchip")):
        got = fill_with([last, observed, observed], one, f, b)
        expected = fill(one, method, [0.0] * 3)
        np.testing.assert_allclose(got[masked], expected[masked], rtol=0, atol=1e-12)
    # Two predictors that hold what they saw cross-fade along the straight line.
    first = one_channel([0.0, 0.2, 1.0], [3, NAN, 5], [0, 2])
    faded = fill_with(np.zeros((3, 5)), first, [[3], [3], [3]], [[5], [5], [5]])
    np.testing.assert_allclose(faded[1, 0], 3.4, atol=1e-12)


def test_outside_the_observations_there_is_one_side_alone():
    one = one_channel([0.0, 1.0, 2.0], [NAN, 5, NAN], [1])
    got = fill_with(START, one, [[1], [2], [3]], [[10], [20], [30]])
    assert got[:, 0].tolist()[::2] == [10, 3]
    pulled = fill_with([[0] * 5, [0.5, 0, 0, 0, 0], [0.25, 0, 0, 0, 0]], one, [[1], [2], [3]],
                       [[10], [20], [30]])  # fmt: skip
    assert pulled[:, 0].tolist()[::2] == [10 - 0.25 * 5, 3 + 0.5 * 2]
    never = one_channel([0.0, 1.0], [NAN, NAN], [])
    assert fill_with(START, never, [[1], [2]], [[10], [20]])[:, 0].tolist() == [5.5, 11]


@given(st.integers(0, 200), st.floats(0.5, 100))
def test_weights_are_the_least_squares_solution_with_the_ridge_as_extra_rows(seed, ridge):
    random = np.random.default_rng(seed)
    phi, y = random.normal(size=(30, 5)), random.normal(size=30)
    towards = random.normal(size=5)
    got = _ridge_solution(phi.T @ phi, phi.T @ y, 30, ridge, towards)
    root = np.sqrt(ridge * np.diag(phi.T @ phi) / 30)
    rows, right = np.vstack([phi, np.diag(root)]), np.concatenate([y, root * towards])
    expected = np.linalg.lstsq(rows, right, rcond=None)[0]
    np.testing.assert_allclose(got, expected, rtol=1e-8, atol=1e-8)


def test_many_values_of_a_known_rule_give_its_weights_back_per_channel_and_group():
    random = np.random.default_rng(1)
    true = random.uniform(-1, 1, (2, 4, 5))  # channels, groups 0 to 3
    equations = NormalEquations(2, 0.1)
    rows = 40_000
    for _ in range(5):
        terms = random.normal(size=(rows, 2, 5))
        group = random.integers(0, 4, (rows, 2))
        missed = (terms * true[np.arange(2), group]).sum(axis=2)
        side, length = np.zeros((rows, 2), dtype=int), 0.1 * 2.0**group
        equations.add(terms, missed, side, length, np.ones((rows, 2), dtype=bool))
    rule = equations.rule()
    np.testing.assert_allclose(rule.weights[:, 0, :4], true, atol=2e-3)
    assert rule.counts[0, :4].sum() == 5 * 2 * rows
    assert rule.counts[1:].sum() == 0
    assert np.array_equal(rule.weights[0, 1, 0], START[1]), "unseen sides keep the start"
    assert [names[0] for names in rule.chosen] == ["ridge 3"] * 2, "shrunk as little as can be"


@pytest.mark.parametrize(("weight", "name"), [(3, "line"), (4, "pchip")])
def test_a_channel_for_which_the_models_are_noise_gets_the_line_or_the_curve_alone(weight, name):
    random = np.random.default_rng(2)
    equations = NormalEquations(2, 0.1)
    for _ in range(10):
        terms = random.normal(size=(20, 2, 5))
        missed = terms[:, :, weight].copy()
        missed[:, 1] = terms[:, 1] @ [0.5, 0.5, 0.2, 0.3, 0.1]
        missed += 1e-3 * random.normal(size=missed.shape)
        side, length = np.zeros((20, 2), dtype=int), np.full((20, 2), 0.1)
        equations.add(terms, missed, side, length, np.ones((20, 2), dtype=bool))
    rule = equations.rule()
    assert rule.chosen[0][0] == name
    assert rule.weights[0, 0, 0].tolist() == [float(i == weight) for i in range(5)]
    assert rule.chosen[1][0].startswith("ridge")


def test_a_noisy_channel_does_not_choose_for_a_quiet_one():
    """Weights of a channel do not depend on its unit, or on the unit of another."""
    random = np.random.default_rng(3)
    terms, missed = random.normal(size=(4, 50, 2, 5)), random.normal(size=(4, 50, 2))
    rules = []
    for scale in (1.0, 1e4):
        equations = NormalEquations(2, 0.1)
        size = np.array([1.0, scale])
        for k in range(4):
            side, length = np.zeros((50, 2), dtype=int), np.full((50, 2), 0.1)
            ones = np.ones((50, 2), dtype=bool)
            equations.add(terms[k] * size[:, None], missed[k] * size, side, length, ones)
        rules.append(equations.rule())
    assert rules[0].chosen == rules[1].chosen
    np.testing.assert_allclose(rules[0].weights, rules[1].weights, rtol=1e-7, atol=1e-9)


def test_gaps_are_grouped_at_powers_of_two_of_the_unit():
    lengths = np.array([0.0, 0.1, 0.10001, 0.2, 0.4, 0.41, 1e9])
    assert group_of(lengths, 0.1).tolist() == [0, 0, 1, 1, 2, 3, GROUPS - 1]


def test_a_rule_survives_json_to_the_last_bit():
    rule = pair_of(dataset(3)).rule
    again = FillRule.from_dict(json.loads(json.dumps(rule.to_dict())))
    assert again.weights.tobytes() == rule.weights.tobytes()
    assert np.array_equal(again.counts, rule.counts)
    assert (again.gap_unit, again.chosen) == (rule.gap_unit, rule.chosen)


# --- impute ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["anchored_ode_gru_d", "gru_d", "gru"])
@pytest.mark.parametrize("mode", ["causal", "two_sided"])
def test_a_fill_never_uses_the_value_itself_or_another_masked_one(name, mode):
    data = dataset(3, rows=20)
    pair = pair_of(data, name)
    random = np.random.default_rng(5)
    other = ob.Dataset(
        tuple(
            replace(t, values=np.where(t.observed, t.values, 1e3 * random.normal(size=(20, 3))))
            for t in data
        )
    )
    unknown = ob.Dataset(
        tuple(replace(t, values=np.where(t.observed, t.values, NAN)) for t in data)
    )
    first = ob.impute(pair, data, mode=mode)
    for changed in (other, unknown):
        for a, b in zip(first, ob.impute(pair, changed, mode=mode), strict=True):
            assert a.values.tobytes() == b.values.tobytes()


@pytest.mark.parametrize("mode", ["causal", "two_sided"])
def test_what_was_observed_comes_back_and_everything_else_is_filled(mode):
    data = dataset(4)
    filled = ob.impute(pair_of(data), data, mode=mode)
    for one, before in zip(filled, data, strict=True):
        assert np.array_equal(one.observed, before.observed)
        assert np.array_equal(one.values[one.observed], before.values[before.observed])
        assert np.isfinite(one.values).all()
        assert one.units == ("m", "m", "m")


def test_a_causal_fill_is_the_prediction_and_looks_at_the_past_alone():
    data = dataset(2, rows=24)
    pair = pair_of(data)
    filled = ob.impute(pair.forward, data)
    for one, said in zip(filled, ob.predict(pair.forward, data), strict=True):
        assert np.array_equal(one.values[~one.observed], said.values[~one.observed])
    late = ob.Dataset(
        tuple(
            replace(t, values=np.where(np.arange(24)[:, None] >= 12, t.values + 5, t.values))
            for t in data
        )
    )
    two_sided = ob.impute(pair, data), ob.impute(pair, late)
    for i, (a, b) in enumerate(zip(filled, ob.impute(pair.forward, late), strict=True)):
        assert np.array_equal(a.values[:12], b.values[:12])
        assert not np.array_equal(two_sided[0][i].values[:12], two_sided[1][i].values[:12])


def test_filling_backwards_with_the_models_swapped_is_the_same():
    data = dataset(3, rows=25)
    pair = pair_of(data)
    rule = FillRule.start(3, 0.05)
    ahead = ob.impute(ob.TwoSided(pair.forward, pair.backward, rule), data)
    swapped = ob.TwoSided(pair.backward, pair.forward, rule)
    back = reversed_in_time(ob.impute(swapped, reversed_in_time(data)))
    for a, b in zip(ahead, back, strict=True):
        np.testing.assert_allclose(a.values, b.values, rtol=0, atol=1e-10)


def test_time_reversed_twice_is_the_data():
    data = dataset(3)
    for a, b in zip(data, reversed_in_time(reversed_in_time(data)), strict=True):
        assert np.array_equal(a.times - a.times[0], b.times)
        assert np.array_equal(a.values, b.values)
        assert np.array_equal(a.observed, b.observed)


def test_channels_in_another_order_are_filled_alike():
    data = dataset(2)
    pair = pair_of(data)
    turned = data.select(["channel_2", "channel_0", "channel_1"])
    for a, b in zip(ob.impute(pair, data), ob.impute(pair, turned), strict=True):
        assert a.names == b.names
        assert np.array_equal(a.values, b.values)


def test_filling_from_both_sides_needs_a_pair():
    data = dataset(2)
    with pytest.raises(ob.InputError):
        ob.impute(small_model("gru", data), data, mode="two_sided")
    with pytest.raises(ob.InputError):
        ob.impute(small_model("gru", data), data, mode="casual")


# --- the pair: trained, saved, loaded -------------------------------------------------------------


CONFIG = ob.TrainConfig(epochs=2, batch_size=4, optimizer="adam")


def trained(out=None) -> tuple[ob.TwoSided, ob.Dataset]:
    data = ob.mask_out(dataset(8, rows=15, share=2.0), 0.6, mask="values", seed=1)
    train, validation = data[:5], data[5:]
    model = ob.make_model("gru_d", train, hidden_size=3, decoder_units=(4,))
    pair, _, _ = ob.fit_two_sided(model, train, validation, CONFIG, out=out, progress=False)
    return pair, data


def test_the_backward_model_is_one_trained_on_reversed_trajectories():
    pair, data = trained()
    train, validation = (reversed_in_time(part) for part in (data[:5], data[5:]))
    alone = ob.make_model(
        "gru_d", train, hidden_size=3, decoder_units=(4,), scaler=pair.forward.scaler
    )
    ob.fit(alone, train, validation, CONFIG, progress=False)
    for a, b in zip(alone.parameters(), pair.backward.parameters(), strict=True):
        assert a.equal(b)
    again = fit_rule(pair.forward, pair.backward, data[5:])
    assert np.array_equal(again.weights, pair.rule.weights)
    assert again.counts.sum() == sum(int(masked_values(t).sum()) for t in data[5:])


def test_a_two_sided_run_is_loaded_as_it_was_and_goes_on(tmp_path):
    pair, data = trained(tmp_path / "run")
    loaded = ob.load_two_sided(tmp_path / "run")
    expected = ob.impute(pair, data)
    ob.save_two_sided(pair, tmp_path / "copy")
    again, _ = trained(tmp_path / "run")
    for other in (loaded, again, ob.load_two_sided(tmp_path / "copy")):
        for a, b in zip(expected, ob.impute(other, data), strict=True):
            assert a.values.tobytes() == b.values.tobytes()
    forward = ob.load_model(tmp_path / "run")
    assert forward.config == pair.forward.config


@pytest.mark.parametrize("text", ["{", "[]", '{"gap_unit_s": 1}'])
def test_a_damaged_rule_is_named(tmp_path, text):
    pair, _ = trained()
    ob.save_two_sided(pair, tmp_path)
    (tmp_path / "two_sided.json").write_text(text)
    with pytest.raises(ob.FileFormatError):
        ob.load_two_sided(tmp_path)
    (tmp_path / "two_sided.json").unlink()
    with pytest.raises(ob.FileFormatError):
        ob.load_two_sided(tmp_path)


def test_a_rule_can_be_chosen_where_nothing_was_masked():
    data = ob.Dataset(tuple(ob.Trajectory(t.times, t.values) for t in dataset(4, rows=20)))
    forward, backward = small_model("gru", data), small_model("gru", reversed_in_time(data))
    rule = fit_rule(forward, backward, data)
    assert rule.counts.sum() == 4 * 3 * 6, "30 % of 20 cells, of 3 channels, of 4 trajectories"


# --- extrapolate ----------------------------------------------------------------------------------


def test_an_extrapolation_is_a_prediction_after_the_last_row():
    data = dataset(3)
    model = small_model("anchored_ode_gru_d", data)
    ahead = ob.forecast(model, data, [0.05, 0.2])
    asked = [[t.times[-1] + 0.05, t.times[-1] + 0.2] for t in data]
    for a, b in zip(ahead, ob.predict(model, data, times=asked), strict=True):
        assert np.array_equal(a.times, b.times)
        assert np.array_equal(a.values, b.values)
        assert not a.observed.any()
        assert a.known.all()


@pytest.mark.parametrize(
    "horizons",
    [[], [0.0, 1.0], [-1.0], [0.2, 0.1], NAN, [NAN], ["soon"], "0.1", None, True, [[0.1], [0.2]]],
)
def test_horizons_that_are_none_are_refused_in_one_line(horizons):
    data = dataset(2)
    model = small_model("gru", data)
    for answer in (ob.forecast, ob.score_forecast):
        with pytest.raises(ob.InputError) as refused:
            answer(model, data, horizons)
        assert "\n" not in str(refused.value)


def test_one_horizon_is_a_number_and_extrapolate_is_forecast():
    data = dataset(2)
    model = small_model("gru", data)
    assert ob.extrapolate is ob.forecast
    for a, b in zip(ob.forecast(model, data, 0.1), ob.forecast(model, data, [0.1]), strict=True):
        assert np.array_equal(a.values, b.values)


@pytest.mark.parametrize("targets", [0, -1, 2.5, True])
def test_numbers_of_targets_that_are_none_are_refused(targets):
    data = dataset(2, rows=30)
    with pytest.raises(ob.InputError):
        ob.score_forecast(small_model("gru", data), data, 0.1, targets=targets)


# --- scores ---------------------------------------------------------------------------------------


def test_imputation_is_scored_by_its_definition_on_the_same_values_for_all():
    data = dataset(4, rows=20)
    pair = pair_of(data)
    scores = ob.score_imputation(pair, data).scores
    assert list(scores.rmse) == ["causal", "two_sided", "last_value", "linear", "pchip"]
    mean = pair.forward.scaler.original(np.array(pair.forward.statistics.mean))
    fills = {
        "two_sided": [t.values for t in ob.impute(pair, data)],
        "causal": [t.values for t in ob.impute(pair.forward, data)],
        **{m: [fill(t, m, mean) for t in data] for m in fillers()},
    }
    masked = [t.known & ~t.observed for t in data]
    assert scores.counts == tuple(sum(h[:, c].sum() for h in masked) for c in range(3))
    scale = np.abs(pair.forward.scaler.scale) * np.array(pair.forward.statistics.std)
    for name, values in fills.items():
        errors = [
            [(v[h[:, c], c] - t.values[h[:, c], c]) for t, v, h in zip(data, values, masked,
             strict=True)] for c in range(3)
        ]  # fmt: skip
        each = [float(np.sqrt(np.mean(np.concatenate(e) ** 2))) for e in errors]
        assert scores.rmse[name] == pytest.approx(each, rel=1e-12)
        together = np.concatenate(
            [np.concatenate(e) / s for e, s in zip(errors, scale, strict=True)]
        )
        assert scores.overall[name] == pytest.approx(np.sqrt(np.mean(together**2)), rel=1e-12)


def test_groups_of_gaps_partition_the_values_between_observations():
    data = dataset(4, rows=20)
    result = ob.score_imputation(pair_of(data), data)
    inside = 0
    for t in data:
        for c in range(3):
            seen = np.flatnonzero(t.observed[:, c])
            between = np.arange(20)[(~t.observed[:, c])]
            inside += int(((between > seen[0]) & (between < seen[-1])).sum())
    assert sum(sum(s.counts) for _, s in result.inside) == inside


def test_extrapolation_shows_what_was_there_a_horizon_ago_and_nothing_later():
    (one,) = dataset(1, rows=60)
    horizon = 0.1
    tasks = _targets(one, horizon, 1000)
    assert len(tasks) > 30
    for past, at, truth, counted in tasks:
        assert past.times[-1] <= at - horizon + 1e-9
        row = int(np.searchsorted(one.times, at))
        later = one.times[past.rows : row + 1]
        assert (later > at - horizon - 1e-9).all(), "and everything that was there is shown"
        assert np.array_equal(counted[0], past.observed.any(axis=0))
        assert np.array_equal(truth[0], one.values[row])


def test_extrapolation_scores_are_those_of_the_definition():
    data = dataset(3, rows=30)
    model = small_model("anchored_ode_gru_d", data)
    (scores,) = ob.score_forecast(model, data, 0.15, targets=1000)
    errors = {"last_value": [], "anchored_ode_gru_d": []}
    for t in data:
        for row in range(30):
            shown = int((t.times <= t.times[row] - 0.15 + 1e-9).sum())
            if not shown or not t.observed[:shown].any():
                continue
            past = t.slice(0, shown)
            said = ob.predict(model, ob.Dataset((past,)), times=[t.times[row]])[0].values[0]
            for c in range(3):
                seen = np.flatnonzero(past.observed[:, c])
                if len(seen):
                    true = t.values[row, c]
                    errors["last_value"].append((c, past.values[seen[-1], c] - true))
                    errors["anchored_ode_gru_d"].append((c, said[c] - true))
    for name, pairs in errors.items():
        for c in range(3):
            each = np.array([e for channel, e in pairs if channel == c])
            assert scores.counts[c] == len(each)
            assert scores.rmse[name][c] == pytest.approx(np.sqrt((each**2).mean()), rel=1e-9)


def test_targets_are_spread_over_the_trajectory_and_no_more_than_asked_for():
    (one,) = dataset(1, rows=60)
    few = [at for _, at, _, _ in _targets(one, 0.05, 5)]
    every = [at for _, at, _, _ in _targets(one, 0.05, 1000)]
    assert len(few) == 5
    assert (few[0], few[-1]) == (every[0], every[-1])
    with pytest.raises(ob.InputError):
        ob.score_forecast(small_model("gru", dataset(2)), dataset(2), [1e6])


def test_nothing_masked_cannot_be_scored():
    data = ob.Dataset(tuple(ob.Trajectory(t.times, t.values) for t in dataset(2)))
    data = ob.Dataset(tuple(replace(t, units=("m",) * 3) for t in data))
    with pytest.raises(ob.InputError):
        ob.score_imputation(small_model("gru", data), data)


def verdict(model: tuple[float, float], trivial: tuple[float, float]) -> str:
    rmse = {"gru": model, "last_value": trivial}
    overall = {k: float(np.hypot(*v)) for k, v in rmse.items()}
    return ChannelScores(
        "one step ahead", ("knee", "hip"), ("rad", ""), (5, 5), rmse, overall, ("last_value",)
    ).verdict()


def test_a_verdict_names_the_best_predictor_and_the_channels_that_a_trivial_one_wins():
    assert "last_value wins" in verdict((2.0, 2.0), (1.0, 1.0))
    assert "last_value wins" in verdict((1.0, 1.0), (1.0, 1.0)), "a tie"
    mixed = verdict((0.5, 2.0), (3.0, 1.0))
    assert "gru wins" in mixed
    assert "hip" in mixed
    assert "knee" not in mixed


def test_one_step_ahead_scores_stand_in_units_beside_the_last_value():
    data = dataset(4, rows=20)
    model = small_model("gru", data, scaler="standardise")
    evaluation = ob.evaluate(model, data)
    units = evaluation.in_units()
    said = ob.predict(model, data)
    for c in range(3):
        errors = []
        for t, p in zip(data, said, strict=True):
            first = int(np.argmax(t.observed[:, c]))
            errors.append((p.values - t.values)[first + 1 :, c])
        each = np.concatenate(errors)
        assert units.counts[c] == len(each)
        assert units.rmse["gru"][c] == pytest.approx(np.sqrt((each**2).mean()), rel=1e-6)
    table = units.table().splitlines()
    assert table[0].split() == ["channel", "unit", "values", "gru", "last_value"]
    assert table[1].split()[:2] == ["channel_0", "m"]


# --- rows that the log lacks ----------------------------------------------------------------------


@given(st.integers(0, 1000), st.sampled_from([0.5, 3.0, 10.0, 47.0]))
def test_times_at_a_rate_close_every_gap_and_stay_away_from_measured_rows(seed, rate):
    random = np.random.default_rng(seed)
    times = 100 + np.cumsum(random.choice([0.004, 0.1, 0.5, 4.0], 30))
    one = ob.Trajectory(times, np.zeros((30, 1)))
    added = times_at_rate(one, rate)
    steps = (added - times[0]) * rate
    np.testing.assert_allclose(steps, np.round(steps), atol=1e-6)
    if len(added):
        assert np.abs(added[:, None] - times).min() >= 0.5 / rate * (1 - 1e-6)
    every = np.union1d(times, added)
    assert np.diff(every).max() <= 1.5 / rate * (1 + 1e-6)
    assert times_at_rate(add_rows(one, added), rate).size == 0, "nothing is left to add"


def test_a_log_at_the_rate_itself_gets_no_rows():
    one = ob.Trajectory(np.arange(1000) * 0.01, np.zeros((1000, 1)))
    assert len(times_at_rate(one, 100)) == 0
    assert len(times_at_rate(one, 200)) == 999


@pytest.mark.parametrize("mode", ["causal", "two_sided"])
def test_an_outage_of_all_sensors_is_filled_at_a_rate_and_at_times(mode):
    data = dataset(3, rows=40)
    pair = pair_of(data, max_step=0.01)
    times = data[0].times
    cut = ob.Dataset(tuple(replace(t, times=t.times + 2.0 * (t.times > t.times[20])) for t in data))
    plain = ob.impute(pair, cut, mode=mode)
    filled = ob.impute(pair, cut, mode=mode, rate_hz=25)
    for one, was, given_rows in zip(filled, plain, cut, strict=True):
        own = np.isin(one.times, given_rows.times)
        assert own.sum() == given_rows.rows
        inside = (one.times > given_rows.times[20]) & (one.times < given_rows.times[21])
        assert inside.sum() >= 49
        assert not one.observed[~own].any()
        assert np.isfinite(one.values).all()
        seen = was.observed
        assert np.array_equal(one.values[own][seen], was.values[seen])
    asked = times[20] + np.array([0.5, 1.0, 1.5])
    at = ob.impute(pair, cut[:1], mode=mode, times=asked)[0]
    assert np.isin(asked, at.times).all()
    assert at.rows == cut[0].rows + 3


def test_a_causal_fill_at_added_rows_is_the_prediction_there():
    data = dataset(2, rows=30)
    model = small_model("anchored_ode_gru_d", data)
    asked = data[0].times[4] + np.array([0.001, 0.002])
    filled = ob.impute(model, data[:1], times=asked)[0]
    got = filled.values[np.searchsorted(filled.times, asked)]
    np.testing.assert_array_equal(got, ob.predict(model, data[:1], times=asked)[0].values)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"rate_hz": 0}, "rate_hz must be a positive"),
        ({"rate_hz": 1e12}, "use a lower rate"),
        ({"rate_hz": 10, "times": [0.1]}, "not both"),
        ({"times": [0.2, 0.1]}, "increase strictly"),
    ],
)
def test_rows_that_cannot_be_added_are_refused_in_one_line(options, said):
    data = dataset(2, rows=20)
    with pytest.raises(ob.InputError, match=said):
        ob.impute(small_model("anchored_ode_gru_d", data), data, **options)
