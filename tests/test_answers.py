"""Fills and forecasts: closed forms, what they may look at, and scores on the same cells."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from model_helpers import dataset, small_model, with_observed
from scipy.interpolate import PchipInterpolator

import offbeat as ob
from offbeat.answers.both_sides import reversed_in_time
from offbeat.answers.scoring import ChannelScores, _targets
from offbeat.baselines import fill, fillers, forecast, forecasters
from offbeat.calibration import interval_score
from offbeat.data.rows import add_rows, times_at_rate

NAN = float("nan")


def one_channel(times, values, observed) -> ob.Trajectory:
    mask = np.zeros((len(times), 1), dtype=bool)
    mask[observed] = True
    return ob.Trajectory(times, np.asarray(values, dtype=float)[:, None], observed=mask)


def blend_of(data: ob.Dataset, name: str = "anchored_ode_gru_d", **options) -> ob.Blend:
    """Two models with drawn weights, and gamma and weights of its own in every kind of value."""
    forward = small_model(name, data, seed=1, std=0.2, **options)
    backward = small_model(name, reversed_in_time(data), seed=2, std=0.2, **options)
    members = ("last_value", "constant_velocity"), ("linear", "pchip")
    blend = ob.fit_blend(data, data, forward, backward, causal=members[0], two_sided=members[1])
    random = np.random.default_rng(0)
    weights = random.dirichlet(np.ones(3), blend.both.weights.shape[:2])
    both = replace(
        blend.both, weights=weights, gamma=random.uniform(0.2, 1, blend.both.gamma.shape)
    )
    return replace(blend, both=both, gamma=random.uniform(0.2, 1, blend.gamma.shape))


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


# --- impute ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["anchored_ode_gru_d", "gru_d", "gru"])
@pytest.mark.parametrize("mode", ["causal", "two_sided"])
def test_a_fill_never_uses_the_value_itself_or_another_masked_one(name, mode):
    data = dataset(3, rows=20)
    blend = blend_of(data, name)
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
    first = ob.impute(blend, data, mode=mode)
    for changed in (other, unknown):
        for a, b in zip(first, ob.impute(blend, changed, mode=mode), strict=True):
            assert a.values.tobytes() == b.values.tobytes()


@pytest.mark.parametrize("mode", ["causal", "two_sided"])
def test_what_was_observed_comes_back_and_everything_else_is_filled(mode):
    data = dataset(4)
    filled = ob.impute(blend_of(data), data, mode=mode)
    for one, before in zip(filled, data, strict=True):
        assert np.array_equal(one.observed, before.observed)
        assert np.array_equal(one.values[one.observed], before.values[before.observed])
        assert np.isfinite(one.values).all()
        assert one.units == ("m", "m", "m")


def test_a_causal_fill_is_the_prediction_and_looks_at_the_past_alone():
    data = dataset(2, rows=24)
    blend = blend_of(data)
    filled = ob.impute(blend.forward, data)
    for one, said in zip(filled, ob.predict(blend.forward, data), strict=True):
        assert np.array_equal(one.values[~one.observed], said.values[~one.observed])
    late = ob.Dataset(
        tuple(
            replace(t, values=np.where(np.arange(24)[:, None] >= 12, t.values + 5, t.values))
            for t in data
        )
    )
    two_sided = ob.impute(blend, data), ob.impute(blend, late)
    for i, (a, b) in enumerate(zip(filled, ob.impute(blend.forward, late), strict=True)):
        assert np.array_equal(a.values[:12], b.values[:12])
        assert not np.array_equal(two_sided[0][i].values[:12], two_sided[1][i].values[:12])


def test_time_reversed_twice_is_the_data():
    data = dataset(3)
    for a, b in zip(data, reversed_in_time(reversed_in_time(data)), strict=True):
        assert np.array_equal(a.times - a.times[0], b.times)
        assert np.array_equal(a.values, b.values)
        assert np.array_equal(a.observed, b.observed)


def test_channels_in_another_order_are_filled_alike():
    data = dataset(2)
    blend = blend_of(data)
    turned = data.select(["channel_2", "channel_0", "channel_1"])
    for a, b in zip(ob.impute(blend, data), ob.impute(blend, turned), strict=True):
        assert a.names == b.names
        assert np.array_equal(a.values, b.values)


def test_filling_from_both_sides_needs_a_blend():
    data = dataset(2)
    with pytest.raises(ob.InputError):
        ob.impute(small_model("gru", data), data, mode="two_sided")
    with pytest.raises(ob.InputError):
        ob.impute(small_model("gru", data), data, mode="casual")


# --- the backward model ---------------------------------------------------------------------------


def test_the_backward_model_is_one_trained_on_reversed_trajectories():
    data = ob.mask_out(dataset(8, rows=15, share=2.0), 0.6, mask="values", seed=1)
    config = ob.TrainConfig(epochs=2, batch_size=4, optimizer="adam")
    model = ob.make_model("gru_d", data[:5], hidden_size=3, decoder_units=(4,))
    backward, _ = ob.fit_backward(model, data[:5], data[5:], config, progress=False)
    train, validation = (reversed_in_time(part) for part in (data[:5], data[5:]))
    alone = ob.make_model("gru_d", train, hidden_size=3, decoder_units=(4,), scaler=model.scaler)
    ob.fit(alone, train, validation, config, progress=False)
    for a, b in zip(alone.parameters(), backward.parameters(), strict=True):
        assert a.equal(b)


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


@pytest.mark.parametrize("mode", ["causal", "two_sided"])
def test_imputation_is_scored_by_its_definition_on_the_same_values_for_all(mode):
    data = dataset(4, rows=20)
    blend = blend_of(data)
    scores = ob.score_imputation(blend, data, mode=mode).scores
    members = {"causal": ["last_value", "constant_velocity"], "two_sided": ["linear", "pchip"]}
    assert list(scores.rmse) == ["blend", "anchored_ode_gru_d alone", *members[mode]]
    assert scores.trivial == tuple(members[mode])
    filled = ob.impute(blend, data, mode=mode)
    fills = {
        "blend": [t.values for t in filled],
        **{m: [fill(t, m, blend.stack.mean) for t in data] for m in members[mode]},
    }
    masked = [t.known & ~t.observed for t in data]
    assert scores.counts == tuple(sum(h[:, c].sum() for h in masked) for c in range(3))
    scale = np.abs(blend.forward.scaler.scale) * np.array(blend.forward.statistics.std)
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
    for level, share in scores.coverage.items():
        half = [t.half_width(level) for t in filled]
        inside = [
            (np.abs(t.values - v.values) <= w)[h]
            for t, v, w, h in zip(data, filled, half, masked, strict=True)
        ]
        assert share == pytest.approx(np.concatenate(inside).mean())
        each = [
            (interval_score(t.values, *v.interval(level), level) / scale)[h]
            for t, v, h in zip(data, filled, masked, strict=True)
        ]
        assert scores.interval_score[level] == pytest.approx(np.concatenate(each).mean())


def test_groups_of_gaps_partition_the_values_between_observations():
    data = dataset(4, rows=20)
    result = ob.score_imputation(blend_of(data), data)
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
    blend = blend_of(data, max_step=0.01)
    times = data[0].times
    cut = ob.Dataset(tuple(replace(t, times=t.times + 2.0 * (t.times > t.times[20])) for t in data))
    plain = ob.impute(blend, cut, mode=mode)
    filled = ob.impute(blend, cut, mode=mode, rate_hz=25)
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
    at = ob.impute(blend, cut[:1], mode=mode, times=asked)[0]
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
