"""Baselines: values with closed forms, and the inputs of each baseline."""

from __future__ import annotations

import numpy as np
import pytest

import offbeat as ob
from offbeat.baselines import BASELINES, Baseline, fill, fillers, forecast, forecasters

TIMES = np.array([0.0, 1.0, 3.0, 4.0, 6.0])
VALUES = np.array([2.0, 4.0, 7.0, 1.0, 5.0])
SEEN = np.array([True, True, False, True, False])


def one() -> ob.Trajectory:
    return ob.Trajectory(TIMES, VALUES[:, None], observed=SEEN[:, None])


@pytest.mark.parametrize(
    ("method", "expected"),
    [
        ("last_value", [9.0, 2.0, 4.0, 4.0, 1.0]),
        # 2, 4 at 0, 1: slope 2; then 4, 1 at 1, 4: slope -1
        ("constant_velocity", [9.0, 2.0, 8.0, 10.0, -1.0]),
        ("linear", [2.0, 4.0, 2.0, 1.0, 1.0]),
    ],
)
def test_fills_are_those_computed_by_hand(method, expected):
    assert fill(one(), method, [9.0])[:, 0] == pytest.approx(expected)


@pytest.mark.parametrize(("method", "expected"), [("last_value", 1.0), ("constant_velocity", -2.0)])
def test_forecasts_are_those_computed_by_hand(method, expected):
    assert forecast(one(), np.array([7.0]), method, [9.0])[0, 0] == pytest.approx(expected)


@pytest.mark.parametrize("name", [name for name, b in BASELINES.items() if b.causal])
def test_a_causal_baseline_uses_what_was_observed_strictly_before(name):
    plain = fill(one(), name, [9.0])[:, 0]
    for row in range(len(TIMES)):
        values = VALUES.copy()
        values[row:] += 10.0
        later = ob.Trajectory(TIMES, values[:, None], observed=SEEN[:, None])
        assert np.array_equal(fill(later, name, [9.0])[: row + 1, 0], plain[: row + 1])


@pytest.mark.parametrize("name", list(BASELINES))
def test_a_channel_that_was_never_observed_gets_its_mean(name):
    never = ob.Trajectory(TIMES, VALUES[:, None], observed=np.zeros((5, 1), dtype=bool))
    assert (fill(never, name, [9.0]) == 9.0).all()


def test_a_baseline_that_uses_the_future_cannot_forecast():
    with pytest.raises(ob.InputError, match="'linear' uses the future"):
        forecast(one(), np.array([7.0]), "linear", [0.0])
    with pytest.raises(ob.InputError, match="must be causal"):
        Baseline(lambda at, times, values, mean: at, causal=False, forecasts=True)


def test_a_baseline_from_outside_stands_beside_the_others():
    BASELINES.register("zero", Baseline(lambda at, *_: np.zeros(len(at)), True, forecasts=True))
    try:
        assert "zero" in fillers()
        assert "zero" in forecasters()
        assert (forecast(one(), np.array([7.0]), "zero", [9.0]) == 0).all()
    finally:
        BASELINES.unregister("zero")
