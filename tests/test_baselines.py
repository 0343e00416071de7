"""Baselines: values with closed forms, and what every baseline of the registry must hold."""

from __future__ import annotations

import numpy as np
import pytest
import torch

import offbeat as ob
from offbeat.baselines import (
    BASELINES,
    AgeBins,
    CausalBaseline,
    DampedSlope,
    base,
    fill,
    fit_baseline,
    forecast,
)

TIMES = np.array([0.0, 1.0, 3.0, 4.0, 6.0])
VALUES = np.array([2.0, 4.0, 7.0, 1.0, 5.0])
SEEN = np.array([True, True, False, True, False])


def one() -> ob.Trajectory:
    return ob.Trajectory(TIMES, VALUES[:, None], observed=SEEN[:, None])


def tasks(seed: int = 0, count: int = 6, channels: int = 3) -> ob.Dataset:
    """Smooth curves at uneven times with values masked at random."""
    random = np.random.default_rng(seed)
    made = []
    for _ in range(count):
        times = np.cumsum(random.uniform(0.5, 1.5, 30)) * 0.01
        phase = random.uniform(0, 6, channels)
        values = np.sin(times[:, None] * np.arange(8, 8 + channels) + phase) + 5
        observed = random.random(values.shape) < 0.7
        observed[20:26] = False
        made.append(ob.Trajectory(times, values, observed=observed))
    return ob.Dataset(tuple(made))


@pytest.mark.parametrize(
    ("method", "expected"),
    [
        ("last_value", [9.0, 2.0, 4.0, 4.0, 1.0]),
        # 2, 4 at 0, 1: slope 2; then 4, 1 at 1, 4: slope -1
        ("constant_velocity", [9.0, 2.0, 8.0, 10.0, -1.0]),
        ("linear", [2.0, 4.0, 2.0, 1.0, 1.0]),
        ("mean", [9.0] * 5),
        # (10 * 9 + sum of the n observed) / (10 + n)
        ("running_mean", [9.0, 92 / 11, 96 / 12, 96 / 12, 97 / 13]),
    ],
)
def test_fills_are_those_computed_by_hand(method, expected):
    assert fill(one(), method, [9.0])[:, 0] == pytest.approx(expected)


@pytest.mark.parametrize(("method", "expected"), [("last_value", 1.0), ("constant_velocity", -2.0)])
def test_forecasts_are_those_computed_by_hand(method, expected):
    assert forecast(one(), np.array([7.0]), method, [9.0])[0, 0] == pytest.approx(expected)


def test_the_factor_of_a_damped_slope_is_the_least_squares_one():
    # y = t up to 2, then 2.5: the line through 1 and 2 says 3, half of that move is right.
    rows = ob.Trajectory(
        np.arange(4.0), [[0.0], [1.0], [2.0], [2.5]], observed=[[True], [True], [True], [False]]
    )
    fitted = fit_baseline("damped_slope", ob.Dataset((rows,)))
    assert isinstance(fitted, DampedSlope)
    # moves 1 (to 2) and 1 (to 2.5), targets 1 and 0.5: factor 0.75
    assert fitted.factor[0, 0] == pytest.approx(0.75)
    assert fitted.predict(ob.Dataset((rows,)))[0][:, 0] == pytest.approx([1.0, 0.0, 1.75, 2.75])


def test_bins_of_age_double():
    bins = AgeBins(np.array([1.5, 3.0, 6.0]))
    assert bins.of_age(np.array([0.1, 1.5, 1.6, 3.1, 99.0, np.inf])).tolist() == [0, 0, 1, 2, 2, 2]


def test_a_baseline_that_uses_the_future_cannot_forecast():
    with pytest.raises(ob.InputError, match="'linear' uses the future"):
        forecast(one(), np.array([7.0]), "linear", [0.0])


# --- every baseline -------------------------------------------------------------------------------


@pytest.fixture(params=list(BASELINES), scope="module")
def fitted(request):
    return fit_baseline(request.param, tasks())


def test_masked_values_are_not_used(fitted):
    data = tasks(seed=1)
    changed = ob.Dataset(
        tuple(
            ob.Trajectory(t.times, np.where(t.observed, t.values, -99.0), observed=t.observed)
            for t in data
        )
    )
    for a, b in zip(fitted.predict(data), fitted.predict(changed), strict=True):
        assert np.array_equal(a, b)
        assert np.isfinite(a).all()


def test_a_channel_that_is_never_observed_gets_a_finite_value(fitted):
    t = tasks(seed=1)[0]
    never = ob.Trajectory(t.times, t.values, observed=np.zeros_like(t.observed))
    assert np.isfinite(fitted.predict(ob.Dataset((never,)))[0]).all()


def test_what_is_saved_predicts_the_same(fitted):
    other = type(fitted)().restore(fitted.arrays())
    data = tasks(seed=1)
    for a, b in zip(fitted.predict(data), other.predict(data), strict=True):
        assert np.array_equal(a, b)


def test_predictions_do_not_depend_on_the_clock_or_on_other_trajectories(fitted):
    data = tasks(seed=1)
    late = ob.Dataset(
        tuple(ob.Trajectory(t.times + 64.0, t.values, observed=t.observed) for t in data)
    )
    together = fitted.predict(data)
    for i, (a, b) in enumerate(zip(together, fitted.predict(late), strict=True)):
        assert a == pytest.approx(b, rel=1e-6, abs=1e-6)
        assert fitted.predict(data[i : i + 1])[0] == pytest.approx(a, rel=1e-9, abs=1e-9)


def test_a_causal_baseline_uses_what_was_observed_strictly_before(fitted):
    if not fitted.causal:
        pytest.skip("uses the future")
    t = tasks(seed=1)[0]
    plain = fitted.predict(ob.Dataset((t,)))[0]
    for row in (0, 7, 19, 29):
        values = t.values.copy()
        values[row:] += 10.0
        later = ob.Trajectory(t.times, values, observed=t.observed)
        assert np.array_equal(fitted.predict(ob.Dataset((later,)))[0][: row + 1], plain[: row + 1])
        # Further times that are asked change nothing.
        some = ob.Dataset((t.slice(0, row + 1),))
        assert np.array_equal(fitted.predict(some)[0], plain[: row + 1])


@pytest.mark.parametrize("count", [1, 3])
def test_rows_that_are_read_together_have_the_bits_of_rows_read_one_by_one(
    fitted, count, monkeypatch
):
    if not fitted.causal:
        pytest.skip("uses the future")
    some = tasks(seed=1, count=count)
    monkeypatch.setattr(base, "READ_AT_ONCE", 1)
    one_by_one = fitted.predict(some)
    for most in (7, 20, 1000):
        monkeypatch.setattr(base, "READ_AT_ONCE", most)
        for a, b in zip(fitted.predict(some), one_by_one, strict=True):
            assert np.array_equal(a, b)


def test_a_causal_baseline_gives_the_same_on_torch_tensors(fitted):
    if not isinstance(fitted, CausalBaseline):
        pytest.skip("uses the future")
    t = tasks(seed=1)[0]
    state = fitted.start(torch.zeros(1, t.channels, dtype=torch.float64))
    for row, expected in enumerate(fitted.predict(ob.Dataset((t,)))[0]):
        time = torch.tensor([[t.times[row] - t.times[0]]])
        assert fitted.read(state, time)[0].numpy() == pytest.approx(expected, rel=1e-9, abs=1e-9)
        values = torch.from_numpy(np.where(t.observed, t.values, 0.0)[None, row])
        state = fitted.observe(state, time, values, torch.tensor(t.observed[None, row]))
