"""A stream is the batch pass, row by row, for every model; and its record takes it up again."""

from __future__ import annotations

import json
import resource
import tracemalloc
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from model_helpers import dataset, small_model, trajectory, with_observed
from stream_helpers import Recorded, batch_predictions, message
from test_contract import FLOAT32, TOLERANCE, VARIANTS, ZOO, build, dtypes, variants

from offbeat import (
    Dataset,
    DivergenceError,
    InputError,
    Stream,
    StreamOptions,
    Trajectory,
    kernels,
    predict,
)

some = pytest.mark.parametrize(
    "variant", [*ZOO, *(name for name in VARIANTS if name.startswith("thesis"))]
)


def relative(got: Any, expected: Any) -> float:
    """Largest error relative to the largest entry."""
    got, expected = np.asarray(got), np.asarray(expected)
    assert got.shape == expected.shape
    assert np.isfinite(expected).all()
    return float(np.abs(got - expected).max() / np.abs(expected).max())


def streamed(stream: Stream, one: Trajectory, *, rows: range | None = None) -> Any:
    """Each row predicted, then consumed."""
    got = []
    for row in rows or range(one.rows):
        got.append(stream.predict(one.times[row]))
        assert stream.observe(one.times[row], message(one, row)) == "new"
    return np.array(got)


# --- the batch pass -------------------------------------------------------------------------------


@variants
@dtypes
def test_a_stream_predicts_what_the_batch_pass_predicts(variant: str, dtype: torch.dtype) -> None:
    """With rows of some channels and of none."""
    model, one = build(variant, dtype), trajectory(4, 14)
    assert {0, 1, 2} <= set(one.observed.sum(axis=1).tolist())
    expected = batch_predictions(model, one)
    assert relative(streamed(Stream(model), one), expected) < TOLERANCE[dtype]


@some
def test_what_is_asked_between_rows_changes_nothing(variant: str) -> None:
    model, one = build(variant, FLOAT32), trajectory(5, 9)
    plain = streamed(Stream(model), one)
    stream, got = Stream(model), []
    for row in range(one.rows):
        got.append(stream.predict([one.times[row], one.times[row] + 5.0])[0])
        stream.observe(one.times[row], message(one, row))
        stream.predict(one.times[row] + 0.25)
        stream.predict(one.times[row])
    np.testing.assert_allclose(got, plain, rtol=0, atol=1e-6 * np.abs(plain).max())
    assert stream.counters.predictions == 4 * one.rows
    assert np.array_equal(stream.predict(9.0), streamed_to_the_end(model, one).predict(9.0))


def streamed_to_the_end(model: Any, one: Trajectory) -> Stream:
    stream = Stream(model)
    streamed(stream, one)
    return stream


@some
def test_a_prediction_between_rows_is_that_of_a_row_put_there(variant: str) -> None:
    """And the values that come after it change the next one."""
    model, one = build(variant), trajectory(6, 8)
    one = with_observed(one, one.observed | (np.arange(8) == 3)[:, None])
    stream = Stream(model)
    for row in range(one.rows):
        stream.observe(one.times[row], message(one, row))
        asked = one.times[row] + 0.01
        times = np.append(one.times[: row + 1], asked)
        values = np.vstack([one.values[: row + 1], np.full(3, np.nan)])
        seen = np.vstack([one.observed[: row + 1], np.zeros(3, dtype=bool)])
        longer = Trajectory(times, values, observed=seen, names=one.names, units=one.units)
        assert relative(stream.predict(asked), batch_predictions(model, longer)[-1]) < 1e-12


@pytest.mark.parametrize("name", sorted(ZOO))
def test_a_stream_answers_as_predict_does_for_times_after_the_last_row(name: str) -> None:
    data = dataset(1, rows=9)
    model = small_model(name, data)
    asked = data[0].times[-1] + np.array([0.01, 0.05, 3.0])
    stream = streamed_to_the_end(model, data[0])
    each = [predict(model, data, times=[t])[0].values[0] for t in asked]
    assert relative(stream.predict(asked), np.array(each)) < 1e-12


def test_a_model_read_from_the_last_row_gives_one_answer_for_all_times() -> None:
    model, one = build("thesis-ode_gru_d"), trajectory(4, 6)
    stream = streamed_to_the_end(model, one)
    got = stream.predict([one.times[-1], one.times[-1] + 0.1, one.times[-1] + 70.0])
    assert np.array_equal(got, got[[0, 0, 0]])


@pytest.mark.parametrize("dtype", ["int64", "float32", "list", "none"])
def test_values_may_come_as_arrays_with_what_was_not_measured_left_empty(dtype: str) -> None:
    model = small_model("gru", dtype=FLOAT32)
    named, arrays = Stream(model), Stream(model)
    named.observe(0.0, {"channel_0": 2.0, "channel_1": 3.0, "channel_2": -1.0})
    whole = [2, 3, -1]
    arrays.observe(0.0, whole if dtype in ("list", "none") else np.array(whole, dtype=dtype))
    if dtype != "int64":
        named.observe(0.5, {"channel_1": 1.5, "channel_2": None})
        part = [None if dtype == "none" else np.nan, 1.5, np.nan]
        arrays.observe(0.5, np.array(part, dtype=dtype) if dtype == "float32" else part)
    assert np.array_equal(named.predict(1.0), arrays.predict(1.0))
    assert named.counters == arrays.counters


def test_nanoseconds_since_1970_are_as_good_as_seconds_since_the_start() -> None:
    model, one = build("anchored_ode_gru_d"), trajectory(4, 12)
    ticks = np.round(one.times * 1e9).astype(np.int64)
    exact = Trajectory.from_arrays(ticks, one.values, observed=one.observed, time_unit="ns",
                          names=one.names, units=one.units)  # fmt: skip
    expected = batch_predictions(model, exact)
    stream, got = Stream(model, time_unit="ns"), []
    start = 1_700_000_000_123_456_789
    for row in range(one.rows):
        t = start + int(ticks[row])
        got.append(stream.predict(np.array([t]))[0] if row % 2 else stream.predict(t))
        stream.observe(np.int64(t) if row % 3 else t, message(one, row))
        assert stream.time == t
    assert relative(got, expected) < 1e-12
    with pytest.raises(InputError):
        stream.observe(float(t + 10**9), {})


def test_a_stream_starts_again_after_a_reset() -> None:
    model, one = build("ode_gru_d-self_feeding", FLOAT32), trajectory(4, 8)
    stream = Stream(model, seed=3)
    first = streamed(stream, one)
    stream.reset()
    assert stream.time is None
    assert np.array_equal(streamed(stream, replace(one, times=one.times - 100.0)), first)
    assert stream.counters.resets == 1
    assert stream.counters.rows == 2 * one.rows
    other = Stream(model, seed=4)
    assert not np.array_equal(streamed(other, one), first), "other generator"


@pytest.mark.parametrize("engine", ["compiled", "reference"])
@pytest.mark.parametrize("predicts", ["the next row", "a time"])
def test_a_state_that_left_the_finite_numbers_is_reset_and_counted(
    predicts: str, engine: str, caplog: pytest.LogCaptureFixture
) -> None:
    """Every valid message is answered, and the first one after a reset as that of a new stream."""
    model = small_model("ode_rnn", activation="silu", std=30.0, dtype=FLOAT32, bounded=False)
    recovered = 0
    with kernels.use("reference" if engine == "reference" else "auto"):
        stream, new = Stream(model), Stream(model)
        for row in range(60):
            t, values = 0.03 * row, [1.0, -1.0, 1.0]
            if predicts == "a time":
                assert stream.observe(t, values) == "new"
                got, expected = stream.predict(t), new.predict(0.0)
            else:
                outcome, got = stream.step(t, values)
                assert outcome == "new"
                expected = new.predict(0.0)
            assert np.isfinite(got).all()
            if stream.recoveries > recovered:
                recovered = stream.recoveries
                assert np.array_equal(got, expected)
    assert stream.counters.rows == 60
    assert 0 < recovered == stream.counters.recoveries < 60
    assert [record for record in caplog.records if "was reset" in record.message]
    assert len(caplog.records) == 1, "it is said once"


def test_a_row_at_which_an_adaptive_solver_gives_up_is_the_first_of_a_reset_state() -> None:
    model = small_model("ode_rnn", dtype=FLOAT32)
    with kernels.use("reference"):
        stream, new = Stream(model), Stream(model)
    observe, times = stream._engine.observe, []

    def gives_up(time: float, *row: Any) -> None:
        times.append(time)
        if time == 2.0 and times.count(2.0) == 1:
            raise DivergenceError("no step is small enough")
        observe(time, *row)

    stream._engine.observe = gives_up  # type: ignore[method-assign]
    for row in range(4):
        assert stream.observe(float(row), [1.0, -1.0, 1.0]) == "new"
    for row in (2, 3):
        new.observe(float(row), [1.0, -1.0, 1.0])
    assert np.array_equal(stream.predict(3.5), new.predict(3.5))
    assert stream.counters.recoveries == 1
    assert stream.counters.rows == 4


@pytest.mark.parametrize("name", ["gru_d", "ode_rnn", "anchored_ode_gru_d"])
def test_an_action_is_predicted_at_the_newest_row_from_what_was_observed_there(name: str) -> None:
    """And it is an input from the next row on, as in the batch pass."""
    roles = ("state", "state", "action")
    data = Dataset(tuple(replace(one, roles=roles) for one in dataset(3, rows=14)))
    model, one = small_model(name, data), data[1]
    expected = batch_predictions(model, one)
    stream, before, after = Stream(model), [], []
    for row in range(one.rows):
        said = message(one, row)
        action = said.pop("channel_2", None)
        before.append(stream.predict(one.times[row]))
        stream.observe(one.times[row], said)
        after.append(stream.predict(one.times[row]))
        stream.observe(one.times[row], {"channel_2": action})
    assert relative(np.array(before)[:, :2], expected[:, :2]) < 1e-12
    assert relative(np.array(after)[:, 2], expected[:, 2]) < 1e-12
    again = Stream(model)
    again.restore(json.loads(json.dumps(stream.state())))
    assert np.array_equal(again.predict(9.0), stream.predict(9.0))


@pytest.mark.parametrize(
    "options", [{"head": "gaussian"}, {"head": "gaussian", "solver": "dopri5"}]
)
def test_any_head_is_streamed(options: dict[str, Any]) -> None:
    model, one = small_model("ode_rnn", **options), trajectory(4, 14)
    assert relative(streamed(Stream(model), one), batch_predictions(model, one)) < 1e-12


# --- its record -----------------------------------------------------------------------------------


@variants
def test_a_restored_stream_goes_on_bit_for_bit(variant: str) -> None:
    model, one = build(variant, FLOAT32), trajectory(4, 12)
    stream = Stream(model, late="reorder", reorder_rows=3)
    streamed(stream, one, rows=range(7))
    text = json.dumps(stream.state(), allow_nan=False)
    again = Stream(build(variant, FLOAT32), late="reorder", reorder_rows=3)
    again.restore(json.loads(text))
    assert json.dumps(again.state()) == text
    assert again.counters == stream.counters
    # A late row and one that joins the newest, then the rest.
    for live in (stream, again):
        live.observe(one.times[5] + 1e-4, {"channel_2": 0.3})
        live.observe(one.times[6], {"channel_0": 0.1, "channel_1": 0.2, "channel_2": 0.4})
    ends = [streamed(live, one, rows=range(7, 12)) for live in (stream, again)]
    assert np.array_equal(*ends)
    assert json.dumps(again.state()) == json.dumps(stream.state())


def test_a_record_keeps_what_is_pending_and_the_clock() -> None:
    stream = Recorded(time_unit="ns", confirm=3)
    start = 1_700_000_000_123_456_789
    stream.observe(start, [1, 2, 3])
    stream.observe(start - 10**10, [4, 5, 6])
    again = Recorded(time_unit="ns", confirm=3)
    again.restore(json.loads(json.dumps(stream.state())))
    assert (again.pending, again.time) == (1, start)
    assert again.observe(start - 10**10 + 5, [7, 8, 9]) == "pending"
    assert again.observe(start - 10**10 + 6, [7, 8, 9]) == "jumped"
    assert [values for _, values in again.rows] == [(4, 5, 6), (7, 8, 9), (7, 8, 9)]


def test_a_record_with_more_rows_than_are_kept_gives_the_newest() -> None:
    stream, fewer = Recorded(late="reorder", reorder_rows=5), Recorded(late="reorder",
                                                                       reorder_rows=2)  # fmt: skip
    for row in range(5):
        stream.observe(0.1 * row, [row, row, row])
    fewer.restore(stream.state())
    assert fewer.rows == stream.rows
    assert fewer.observe(0.15, [7, 7, 7]) == "late"
    assert fewer.observe(0.35, [7, 7, 7]) == "reordered"


def damaged(record: dict[str, Any], path: list[Any], value: Any) -> dict[str, Any]:
    copy: Any = json.loads(json.dumps(record))
    at = copy
    for key in path[:-1]:
        at = at[key]
    if value is KeyError:
        del at[path[-1]]
    else:
        at[path[-1]] = value
    return copy  # type: ignore[no-any-return]


@pytest.mark.parametrize(
    ("path", "value"),
    [
        (["format"], "other"),
        (["version"], 99),
        (["model"], "0" * 64),
        (["time_unit"], "ms"),
        (["history"], KeyError),
        (["history", "rows", 0, "time"], None),
        (["history", "rows", 0, "values"], "zzz"),
        (["history", "rows", 0, "before", "state", "base64"], "zzz"),
        (["history", "rows", 0, "before", "state", "base64"], "AAAA"),
        (["history", "state", "last", "dtype"], "<f8"),
        (["history", "state", "last", "shape"], [3, 1]),
        (["history", "state", "last"], KeyError),
        (["origin"], "then"),
        (["seen"], float("nan")),
        (["pending"], 3),
        (["counters", "rows"], "many"),
        (["counters", "rows"], KeyError),
    ],
)
def test_a_damaged_record_is_refused_and_changes_nothing(path: list[Any], value: Any) -> None:
    model, one = small_model("gru_d", dtype=FLOAT32), trajectory(4, 6)
    stream = streamed_to_the_end(model, one)
    before = json.dumps(stream.state())
    with pytest.raises(InputError):
        stream.restore(damaged(json.loads(before), path, value))
    assert json.dumps(stream.state()) == before


def test_a_record_of_other_weights_is_refused() -> None:
    one = trajectory(4, 4)
    stream = streamed_to_the_end(small_model("gru", seed=1), one)
    with pytest.raises(InputError):
        Stream(small_model("gru", seed=2)).restore(stream.state())


# --- what is refused ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("t", "values"),
    [
        (1.0, {"channel_3": 1.0}),
        (1.0, {"channel_1": "1.0"}),
        (1.0, {"channel_1": True}),
        (1.0, [1.0, 2.0]),
        (1.0, [1.0, 2.0, "x"]),
        (1.0, [1.0, None, {}]),
        (1.0, "abc"),
        (float("nan"), {}),
        (float("inf"), {}),
        ("now", {}),
        (True, {}),
        (None, {}),
        (10**400, {}),
    ],
)
def test_a_message_that_says_nothing_is_refused_and_changes_nothing(t: Any, values: Any) -> None:
    model = small_model("gru", dtype=FLOAT32)
    stream = Stream(model)
    stream.observe(0.0, [1.0, 2.0, 3.0])
    before = json.dumps(stream.state())
    with pytest.raises(InputError):
        stream.observe(t, values)
    assert json.dumps(stream.state()) == before


@pytest.mark.parametrize("t", [-0.1, [0.3, -0.1], float("nan"), "x", [[0.5]]])
def test_a_time_that_cannot_be_asked_for_is_refused(t: Any) -> None:
    stream = Stream(small_model("gru"))
    stream.observe(0.0, [1.0, 2.0, 3.0])
    with pytest.raises(InputError):
        stream.predict(t)
    assert stream.predict([]).shape == (0, 3)


def test_values_that_are_not_finite_or_too_large_were_not_measured() -> None:
    model = small_model("anchored_ode_gru_d", dtype=FLOAT32)
    clean, dirty = Stream(model), Stream(model)
    for row, bad in enumerate([float("inf"), -float("inf"), 1e300, -1e39, 10**400]):
        clean.observe(0.1 * row, {"channel_0": 1.0})
        dirty.observe(0.1 * row, {"channel_0": 1.0, "channel_1": bad})
    assert np.array_equal(clean.predict(1.0), dirty.predict(1.0))
    assert dirty.counters.not_finite == 5
    assert clean.counters.not_finite == 0


@pytest.mark.parametrize(
    "options",
    [
        {"late": "ignore"}, {"jump": "x"}, {"duplicates": "x"}, {"long_gap": "x"},
        {"merge_within_s": -1.0}, {"merge_within_s": float("nan")}, {"merge_within_s": "1"},
        {"reorder_rows": 0}, {"reorder_rows": 1.5}, {"confirm": 0}, {"confirm": True},
        {"jump_back_s": 0.0}, {"jump_back_s": None}, {"jump_ahead_s": float("inf")},
        {"stale_after_s": -1.0}, {"long_gap_s": 0.0}, {"merge_within_s": 2.0},
        {"unknown": 1},
    ],
)  # fmt: skip
def test_an_option_out_of_its_range_is_refused(options: dict[str, Any]) -> None:
    with pytest.raises(InputError):
        Stream(small_model("gru"), **options)


def test_options_may_come_as_one_record_with_some_replaced() -> None:
    options = StreamOptions(late="reorder", confirm=7)
    stream = Stream(small_model("gru"), options=options, reorder_rows=4)
    assert stream.options == StreamOptions(late="reorder", confirm=7, reorder_rows=4)
    with pytest.raises(InputError):
        Stream(small_model("gru"), time_unit="h")


def test_replacing_a_jump_by_the_median_gap_needs_jumps_longer_than_that() -> None:
    with pytest.raises(InputError):
        Recorded(jump="continue", jump_ahead_s=0.05)


# --- memory ---------------------------------------------------------------------------------------


def test_memory_stays_as_it_is_over_tens_of_thousands_of_messages_of_every_kind() -> None:
    stream = Recorded(late="reorder", reorder_rows=8, confirm=4)
    stream.recorder.observe = lambda time, values, mask: None  # type: ignore[method-assign]

    def live(start: int, stop: int) -> None:
        for i in range(start, stop):
            t = 0.01 * i
            stream.observe(t, {"a": 1.0})
            stream.observe(t, {"b": 2.0})
            if i % 7 == 0:
                stream.observe(t - 0.015, {"c": 3.0})
            if i % 11 == 0:
                stream.observe(t - 50.0, {"c": 3.0})
            if i % 1000 == 0:
                stream.reset()
            stream.predict(t + 1.0)

    live(0, 2000)
    tracemalloc.start()
    try:
        live(2000, 4000)
        before = tracemalloc.get_traced_memory()[0]
        live(4000, 20_000)
        after = tracemalloc.get_traced_memory()[0]
    finally:
        tracemalloc.stop()
    assert stream.counters.messages > 40_000
    assert after - before < 20_000


@pytest.mark.slow
def test_the_memory_of_the_process_stays_as_it_is_over_twenty_thousand_steps() -> None:
    model = small_model("gru_d", dtype=FLOAT32)
    stream = Stream(model)
    values = np.array([1.0, np.nan, 0.5])

    def resident() -> int:
        return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize()

    def live(start: int, stop: int) -> None:
        for i in range(start, stop):
            stream.observe(0.01 * i, values)

    live(0, 5000)
    before = resident()
    live(5000, 20_000)
    assert resident() - before < 2 * 2**20


@pytest.mark.parametrize("values", [[True, 1.0, 2.0], (1.0, False, 2.0), {"x": True}])
def test_true_and_false_are_no_measurements(values: Any) -> None:
    stream = Stream(small_model("gru"))
    named = dict.fromkeys(stream.names[:1], True) if isinstance(values, dict) else values
    with pytest.raises(InputError, match="True"):
        stream.observe(0.0, named)
    assert stream.counters.messages == 0
