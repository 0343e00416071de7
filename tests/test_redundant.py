"""Channels that nothing is learned from: found, not given to the model, and given back."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from model_helpers import small_model

import offbeat as ob
from offbeat.answers.blend import fit_blend
from offbeat.answers.scoring import ChannelScores
from offbeat.data.outliers import mask_outliers
from offbeat.data.redundant import Redundant, find_redundant, leave_out
from offbeat.data.transforms import Transforms

ROWS = 400
TIMES = np.arange(ROWS) / 100
RANDOM = np.random.default_rng(0)
WAVE = np.sin(TIMES) + 0.1 * RANDOM.normal(size=ROWS)
NAN = float("nan")


def dataset(**columns) -> ob.Dataset:
    values = np.column_stack(list(columns.values()))
    return ob.Dataset((ob.Trajectory(TIMES, values, names=tuple(columns)),))


# --- found ----------------------------------------------------------------------------------------

COUNTERS = {
    "from 0": np.arange(ROWS),
    "from anywhere": 81273 + np.arange(ROWS),
    "of 8 bits": np.arange(ROWS) % 256,
    "in steps": 5 * np.arange(ROWS),
    "with lost messages": np.cumsum(RANDOM.choice([1, 1, 1, 1, 1, 1, 1, 1, 1, 2], ROWS)),
    "in ns": 1.7e18 + 1e7 * np.arange(ROWS),
}
NO_COUNTERS = {
    "a wave": WAVE,
    "a count that goes back": np.round(10 * np.sin(TIMES)),
    "ticks of an encoder": np.cumsum(RANDOM.integers(0, 5, ROWS)),
    "an odometer": np.cumsum(RANDOM.choice([1, 2, 3], ROWS)),
    "a level that is drained now and then": np.arange(ROWS) - 35 * (np.arange(ROWS) // 50),
    "a ramp": 0.5 * TIMES,
    "a triangle": np.abs(np.arange(ROWS) % 100 - 50),
    "a step": (TIMES > 2).astype(float),
    "pulses": np.arange(ROWS) % 2,
}


@pytest.mark.parametrize("kind", COUNTERS)
def test_a_counter_is_found(kind):
    assert find_redundant(dataset(x=WAVE, seq=COUNTERS[kind])).counters == ("seq",)


@pytest.mark.parametrize("kind", NO_COUNTERS)
def test_a_measurement_is_no_counter(kind):
    assert find_redundant(dataset(x=WAVE, y=NO_COUNTERS[kind])).names == (
        ("y",) if kind == "a wave" else ()
    )


def test_a_clock_in_any_unit_is_found_by_its_name_and_its_values():
    jitter = 0.001 * RANDOM.uniform(-1, 1, ROWS)
    found = find_redundant(
        dataset(x=WAVE, stamp=1.7e9 + TIMES + jitter, time_ms=1e3 * TIMES, distance=TIMES)
    )
    assert found.counters == ("stamp", "time_ms")
    assert find_redundant(dataset(x=WAVE, time_to_goal=9 - TIMES)).names == ()
    assert find_redundant(dataset(x=WAVE, seconds_elapsed=TIMES)).counters == ("seconds_elapsed",)


def test_a_clock_is_found_although_an_episode_has_a_single_value_of_it():
    whole = dataset(x=WAVE, time_ms=1e3 * TIMES)
    late = np.column_stack((WAVE[:4], [NAN, NAN, NAN, 12.0]))
    one = ob.Trajectory(TIMES[:4], late, names=whole.names)
    assert find_redundant(ob.Dataset((*whole, one))).counters == ("time_ms",)
    two = ob.Trajectory(TIMES[:2], [[0.1, 3.2], [0.7, 9.1]], names=whole.names)
    assert find_redundant(ob.Dataset((two,) * 30)).counters == (), "two are always on a line"


def test_a_copy_is_found_also_where_it_was_logged_a_little_later():
    times = np.sort(np.concatenate([TIMES, TIMES + 0.003]))
    values = np.full((2 * ROWS, 3), NAN)
    values[0::2, 0], values[1::2, 1] = WAVE, WAVE
    values[0::2, 2] = np.cos(TIMES)
    data = ob.Dataset((ob.Trajectory(times, values, names=("a", "b", "c")),))
    assert find_redundant(data) == Redundant(copies={"b": "a"})
    later = np.concatenate([TIMES, TIMES + 0.503])
    order = np.argsort(later)
    moved = np.full((2 * ROWS, 2), NAN)
    moved[:ROWS, 0], moved[ROWS:, 1] = WAVE, WAVE
    late = ob.Dataset((ob.Trajectory(later[order], moved[order], names=("a", "b")),))
    assert find_redundant(late).names == (), "half a second later, it tells something else"


def test_two_switches_that_agree_and_two_constants_are_no_copies():
    switch = (TIMES > 2).astype(float)
    found = find_redundant(dataset(x=WAVE, a=switch, b=switch, c=0 * TIMES, d=0 * TIMES))
    assert found == Redundant(constants={"c": 0.0, "d": 0.0})


def test_a_constant_component_of_a_quaternion_and_an_action_are_kept():
    half = TIMES / 2
    data = dataset(qw=np.cos(half), qx=0 * half, qy=0 * half, qz=np.sin(half), command=0 * half)
    roles = ("state",) * 4 + ("action",)
    data = ob.Dataset(
        (replace(data[0], roles=roles),),
        {"transforms": Transforms({}, (("qw", "qx", "qy", "qz"),)).to_dict()},
    )
    assert find_redundant(data).names == ()


def test_notes_say_what_becomes_of_them():
    found = find_redundant(
        dataset(x=WAVE, y=WAVE, mode=0 * TIMES, seq=np.arange(ROWS), z=WAVE * NAN)
    )
    constant, copy, counter, empty = found.notes()
    assert constant == "constant, so not learned, and given back as they are: mode"
    assert copy == "copies, so not learned, and given the answer of the original: y (of x)"
    assert counter == "counters or clocks, so not learned and not predicted: seq"
    assert empty == "without a value, so not learned and not predicted: z"


def test_a_log_in_which_nothing_changes_is_refused_in_one_line():
    data = dataset(a=0 * TIMES, b=0 * TIMES + 1)
    with pytest.raises(ob.InputError, match=r"nothing to learn: constant.*: a, b; give a log"):
        leave_out(data, find_redundant(data))


# --- left out and given back ----------------------------------------------------------------------


def robot() -> ob.Dataset:
    """Two states of which one has marks of missing values, and a channel of each other kind."""
    height = WAVE.copy()
    height[[30, 31, 200]] = -999.0
    rate = np.cos(TIMES)
    return dataset(
        mode=0 * TIMES + 4,
        height=height,
        rate=rate,
        rate_again=rate,
        seq=np.arange(ROWS),
        broken=WAVE * NAN,
    )


def prepared() -> ob.Dataset:
    masked = mask_outliers(robot())
    return leave_out(masked, find_redundant(masked))


def test_the_channels_stay_and_nothing_of_them_is_observed():
    data = prepared()
    assert data.names == robot().names
    assert data.roles == ("exogenous", "state", "state", *("exogenous",) * 3)
    assert data[0].observed.sum(axis=0).tolist() == [0, ROWS - 3, ROWS, 0, 0, 0]
    transforms = Transforms.of(data)
    assert transforms.missing == {"height": (-999.0,)}
    assert transforms.constants == {"mode": 4.0}
    assert transforms.copies == {"rate_again": "rate"}
    assert transforms.ignored == ("seq", "broken")
    assert Transforms.from_dict(transforms.to_dict()) == transforms
    again = transforms.apply(robot())
    assert np.array_equal(again[0].observed, data[0].observed), "a raw log is treated alike"
    assert transforms.apply(data) is data


@pytest.mark.parametrize("name", ["gru", "gru_d", "anchored_ode_gru_d"])
@pytest.mark.parametrize("scaler", ["standardise", "robust", "min_max", "identity"])
def test_a_model_of_it_takes_the_raw_log_and_gives_constants_and_copies_back(name, scaler):
    model = small_model(name, prepared(), scaler=scaler)
    raw = robot()
    predicted = ob.predict(model, raw)[0]
    ahead = ob.forecast(model, raw, [0.1, 0.2])[0]
    filled = ob.impute(model, raw)[0]
    for answer in (predicted, ahead):
        columns = dict(zip(answer.names, answer.values.T, strict=True))
        assert (columns["mode"] == 4.0).all()
        assert np.array_equal(columns["rate"], columns["rate_again"])
        assert np.isfinite(columns["height"]).all()
        assert np.isnan(columns["seq"]).all()
        assert np.isnan(columns["broken"]).all()
    columns = dict(zip(filled.names, filled.values.T, strict=True))
    assert np.array_equal(columns["seq"], np.arange(ROWS)), "what was measured stays"


def test_statistics_of_channels_without_a_value_are_finite_numbers():
    statistics = small_model("gru", prepared(), scaler="robust").statistics
    json.dumps(statistics.to_dict(), allow_nan=False)
    assert (statistics.low[0], statistics.high[0]) == (0.0, 0.0)
    assert statistics.low[1] < -1 < 1 < statistics.high[1]


def test_what_is_left_out_changes_no_prediction():
    model = small_model("anchored_ode_gru_d", prepared())
    changed = robot()[0].values.copy()
    changed[:, [0, 3, 4]] = 7.0
    changed[200, 1] = NAN  # in place of -999
    other = ob.Dataset((ob.Trajectory(TIMES, changed, names=robot().names),))
    states = [1, 2]
    a, b = (ob.predict(model, data)[0].values[:, states] for data in (robot(), other))
    assert np.array_equal(a, b)


@pytest.mark.parametrize("name", ["gru_d", "anchored_ode_gru_d"])
def test_a_stream_of_raw_messages_is_the_batch(name, tmp_path):
    data = prepared()
    model = small_model(name, data)
    ob.save_model(model, tmp_path / "model")
    model = ob.load_model(tmp_path / "model")
    assert model.transforms == Transforms.of(data)
    raw = robot()
    expected = ob.predict(model, raw)[0].values
    path = tmp_path / "model.onnx"
    ob.export_onnx(model, path)
    for stream in (ob.Stream(model), ob.OnnxStream(path)):
        got = []
        for t, row in zip(raw[0].times, raw[0].values, strict=True):
            got.append(stream.step(float(t), dict(zip(raw.names, row.tolist(), strict=True)))[1])
        np.testing.assert_allclose(np.array(got), expected, rtol=1e-6, atol=1e-6)


def test_training_and_scores_leave_the_channels_out():
    data = prepared()
    train, validation, test = ob.split_in_time(data)
    model = ob.make_model("gru", train, hidden_size=4)
    ob.fit(model, train, validation, ob.TrainConfig(epochs=1), progress=False)
    predictors = ob.evaluate(model, test).to_dict()["predictors"]
    for scores in predictors.values():
        counted = [mse is not None for mse in scores["after_first_row"]["per_channel_mse"]]
        assert counted == [False, True, True, False, False, False]
    table = ob.score_imputation(model, ob.mask_out(test, 0.7, mask="values")).table()
    assert [line.split()[1:3] for line in table.splitlines()[1:7]] == [
        ["-", "0"], ["-", "18"], ["-", "18"], ["-", "0"], ["-", "0"], ["-", "0"],
    ]  # fmt: skip


def test_intervals_of_constants_have_no_width_and_those_of_copies_are_those_of_the_original():
    train, validation, _ = ob.split_in_time(prepared())
    blend = fit_blend(train, validation, count=20)
    raw = robot()
    for answer in (ob.predict(blend, raw)[0], ob.impute(blend, raw, rate_hz=300)[0]):
        low, high = answer.interval(0.9)
        width = dict(zip(answer.names, (high - low).T, strict=True))
        new = ~answer.observed[:, 3]
        assert (width["mode"] == 0).all()
        assert np.array_equal(width["rate_again"][new], width["rate"][new])
        assert (width["height"][~answer.observed[:, 1]] > 0).all()


def test_a_table_of_scores_has_no_row_for_a_channel_without_values():
    rmse = {"model": (0.5, NAN), "mean": (1.0, NAN)}
    overall = {"model": 0.5, "mean": 1.0}
    scores = ChannelScores("fill", ("x", "seq"), ("rad", ""), (5, 0), rmse, overall, ("mean",))
    _, *lines, last = [line.split() for line in scores.short().splitlines()]
    assert lines == [["x", "rad", "5", "0.5", "1", "mean", "0.5"]]
    assert last[-5:] == ["5", "0.5", "1", "mean", "0.5"]
