"""Messages in the order of time take a compiled way, which is that of Python to the last bit."""

from __future__ import annotations

import functools
import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from model_helpers import dataset, small_model

from offbeat import Dataset, InputError, Model, Scaler, StreamOptions, kernels
from offbeat.stream.cpu_engine import CpuEngine
from offbeat.stream.engine import Engine
from offbeat.stream.live import LiveStream
from offbeat.stream.stream import info_of

pytestmark = pytest.mark.skipif(
    not kernels.cpu.instruction_sets(), reason="there is no compiled backend"
)
NAMES = ("channel_0", "channel_1", "channel_2")
MODELS: dict[str, dict[str, Any]] = {
    "gru_d": {},
    "gru": {"readout": "last_row"},
    "anchored_ode_gru_d": {"max_step": 0.5},
    "ode_rnn": {"dtype": torch.float32, "clock": "first_row"},
    "anchored_trend": {"dtype": torch.float32},
}


class PythonOnly(CpuEngine):
    """The compiled engine without compiled messages."""

    in_order = Engine.in_order


@functools.cache
def model_of(name: str) -> Model:
    train = dataset(6, seed=9)
    train = Dataset(tuple(replace(one, roles=("state", "state", "exogenous")) for one in train))
    scaler = Scaler("standardise", np.array([0.3, -0.1, 1e3]), np.array([0.7, 1 / 3, -9.0]))
    return small_model(name, train, scaler=scaler, **MODELS[name])


def both(name: str, time_unit: str, **options: Any) -> tuple[LiveStream, LiveStream]:
    model = model_of(name)
    chosen = StreamOptions(**options)
    quick, plain = (
        LiveStream(kind(model), info_of(model), options=chosen, time_unit=time_unit)
        for kind in (CpuEngine, PythonOnly)
    )
    return quick, plain


def answer(call: Any, *args: Any, **options: Any) -> Any:
    """What a call returns or raises, in a form whose equality is that of all bits."""
    try:
        got = call(*args, **options)
    except InputError as error:
        return str(error)
    outcome, predicted = got if isinstance(got, tuple) else (got, None)
    if isinstance(outcome, np.ndarray):
        outcome, predicted = None, outcome
    return outcome, None if predicted is None else (predicted.shape, predicted.tobytes())


good = st.floats(-5, 5) | st.none() | st.sampled_from([1, math.nan, math.inf, 1e308, 10**18, -0.0])
number = good | good | st.sampled_from([10**400, True, "1"])
row = st.lists(good, min_size=3, max_size=3) | st.lists(number, min_size=3, max_size=3)


@st.composite
def values(draw: Any) -> Any:
    """One row in any of the forms that a stream takes, and some that it does not."""
    kind = draw(st.sampled_from(["dict", "list", "tuple", "f64", "f32", "other"]))
    if kind == "other":
        kind = draw(st.sampled_from(["unknown", "i64", "strided", "short"]))
    if kind == "dict":
        return draw(st.dictionaries(st.sampled_from(NAMES), number, max_size=3))
    if kind == "unknown":
        return {NAMES[0]: 1.0, "other": 2.0}
    if kind in ("list", "tuple"):
        return (list if kind == "list" else tuple)(draw(row))
    drawn = draw(st.lists(st.floats(-5, 5) | st.just(math.nan), min_size=3, max_size=3))
    if kind == "short":
        return np.array(drawn[:2])
    if kind == "i64":
        return np.array([1, -2, 3])
    if kind == "strided":
        return np.repeat(drawn, 2)[::2]
    return np.array(drawn, dtype=np.float32 if kind == "f32" else np.float64)


gap = st.sampled_from([0.25, 0.25, 0.5, 1e-3, 0.0, 0.0, 0.05, -0.3, -0.3, -2.0, 3.0, 40.0])
message = st.tuples(
    st.sampled_from(["step"] * 4 + ["observe", "predict", "both", "counters", "reset", "record"]),
    gap,
    st.sampled_from(["float", "int", "numpy"]),
    values(),
    st.none() | st.floats(-1, 4),
)


@settings(max_examples=60)
@given(
    st.sampled_from(sorted(MODELS)),
    st.sampled_from(["s", "ms", "ns"]),
    st.lists(message, max_size=30),
    st.fixed_dictionaries(
        {
            "late": st.sampled_from(["drop", "reorder", "error"]),
            "duplicates": st.sampled_from(["first", "last", "error"]),
            "jump": st.sampled_from(["reset", "continue", "drop"]),
            "jump_ahead_s": st.sampled_from([None, 20.0]),
            "merge_within_s": st.sampled_from([0.0, 0.1]),
            "stale_after_s": st.sampled_from([None, 0.2, 3.0]),
            "long_gap": st.sampled_from(["saturate", "reset"]),
            "long_gap_s": st.sampled_from([None, 0.4]),
            "reorder_rows": st.integers(1, 4),
            "confirm": st.integers(1, 3),
        }
    ),
)
def test_any_messages_have_the_answers_and_the_state_of_the_way_in_python(
    name: str, unit: str, messages: list[Any], options: dict[str, Any]
) -> None:
    quick, plain = both(name, unit, **options)
    ticks = {"s": 1, "ms": 1000, "ns": 10**9}[unit]
    time: float = 7.0
    for kind, ahead, form, sent, now in messages:
        time += ahead
        t: Any = time * ticks
        if form == "int" and ticks > 1:
            t = round(t)
        if form == "numpy":
            t = np.float64(t)
        late = None if now is None else (time + now) * ticks
        calls: list[Any] = {
            "step": [lambda s, t=t, v=sent, n=late: answer(s.step, t, v, now=n)],
            "observe": [lambda s, t=t, v=sent, n=late: answer(s.observe, t, v, now=n)],
            "predict": [lambda s, t=t: answer(s.predict, t)],
            "both": [lambda s, t=t: answer(s.predict, [t, t]), lambda s: s.after(0.5)],
            "counters": [lambda s: s.counters, lambda s: s.time],
            "reset": [lambda s: s.reset()],
            "record": [lambda s: s.restore(s.state())],
        }[kind]
        for call in calls:
            assert call(quick) == call(plain)
    assert quick.counters == plain.counters
    assert quick.state() == plain.state()
    assert quick.time == plain.time


@pytest.mark.parametrize("name", sorted(MODELS))
def test_messages_in_order_do_not_reach_python(name: str, monkeypatch: Any) -> None:
    """New rows, rows in two messages and late ones; integers since 1970 too."""
    quick, plain = both(name, "ns")
    start = 1_700_000_000_123_456_789
    assert quick.observe(start, [0.5, None, 2.0]) == plain.observe(start, [0.5, None, 2.0])
    expected = []
    for i in range(1, 9):
        at = start + i * 10**7
        for t, sent in ((at, {NAMES[0]: i / 7}), (at, {NAMES[1]: -1.5}), (at - 1, [0.0, 1.0, 2.0])):
            expected.append((answer(plain.step, t, sent), answer(plain.predict, at + 5)))
    outcomes = [outcome for (outcome, _), _ in expected]
    assert outcomes == ["new", "merged", "late"] * 8
    monkeypatch.setattr(quick, "_place", None)
    monkeypatch.setattr(quick, "_predict", None)
    got = []
    for i in range(1, 9):
        at = start + i * 10**7
        for t, sent in ((at, {NAMES[0]: i / 7}), (at, {NAMES[1]: -1.5}), (at - 1, [0.0, 1.0, 2.0])):
            got.append((answer(quick.step, t, sent), answer(quick.predict, at + 5)))
    assert got == expected
    assert quick.state() == plain.state()


@pytest.mark.parametrize(
    ("options", "messages", "outcomes"),
    [
        ({"duplicates": "last"}, [(0.1, 1.0), (0.1, 2.0)], ["new", "merged"]),
        ({"duplicates": "first"}, [(0.1, 1.0), (0.1, 2.0)], ["new", "duplicate"]),
        ({"merge_within_s": 0.1}, [(0.2, None), (0.15, 2.0)], ["new", "merged"]),
        ({"stale_after_s": 0.3}, [(1.0, 1.0), (0.8, 1.0), (0.2, 1.0)], ["new", "late", "stale"]),
        ({"long_gap_s": 0.3}, [(0.2, 1.0), (0.6, 1.0)], ["new", "new"]),
        ({"long_gap_s": 0.3, "long_gap": "reset"}, [(0.2, 1.0), (0.6, 1.0)], ["new", "new"]),
        ({"jump_back_s": 0.3, "confirm": 1}, [(0.9, 1.0), (0.5, 1.0)], ["new", "jumped"]),
        ({"jump_ahead_s": 0.3, "confirm": 1}, [(0.2, 1.0), (0.9, 1.0)], ["new", "jumped"]),
        ({"late": "reorder"}, [(0.2, 1.0), (0.1, 1.0), (0.3, 1.0)], ["new", "reordered", "new"]),
    ],
)
def test_each_option_acts_as_in_python(
    options: dict[str, Any], messages: list[tuple[float, float | None]], outcomes: list[str]
) -> None:
    quick, plain = both("anchored_ode_gru_d", "s", **options)
    for stream in (quick, plain):
        assert stream.observe(0.0, {NAMES[0]: 0.5}) == "new"
    for (t, value), outcome in zip(messages, outcomes, strict=True):
        got = answer(quick.step, t, {NAMES[0]: value})
        assert got[0] == outcome
        assert got == answer(plain.step, t, {NAMES[0]: value})
    assert quick.counters == plain.counters
    assert quick.state() == plain.state()


def test_a_state_that_left_the_finite_numbers_is_reset_in_either_way() -> None:
    quick, plain = both("gru_d", "s")
    for stream in (quick, plain):
        stream.observe(0.0, [1.0, 2.0, 3.0])
        record = stream.state()
        record["history"]["state"]["state"] = {
            **record["history"]["state"]["state"],
            "base64": "AAAAAAAA+H8AAAAAAAD4fwAAAAAAAPh/AAAAAAAA+H8=",  # NaN
        }
        stream.restore(record)
    for t in (0.1, 0.2, 0.3):
        assert answer(quick.step, t, [1.0, 2.0, 3.0]) == answer(plain.step, t, [1.0, 2.0, 3.0])
    assert quick.counters == plain.counters
    assert quick.counters.recoveries == 1
    assert quick.state() == plain.state()
