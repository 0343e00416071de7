"""Scalers: their formulas, exact round trips, and what is refused."""

from __future__ import annotations

import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from model_helpers import dataset
from scipy.stats.mstats import winsorize

from offbeat import Dataset, InputError, Scaler, Trajectory, make_model
from offbeat.data.scaler import clipped

NAN = float("nan")
KINDS = ("standardise", "robust", "min_max", "divide_by_max", "identity")


def observed_values(data: Dataset, channel: int) -> list[float]:
    return [
        float(one.values[row, channel])
        for one in data
        for row in range(one.rows)
        if one.observed[row, channel]
    ]


@pytest.mark.parametrize("kind", KINDS)
def test_a_scaler_is_its_formula_over_the_observed_values(kind: str) -> None:
    data = dataset(5)
    scaler = Scaler.fit(kind, data)
    for channel in range(3):
        values = np.array(observed_values(data, channel))
        shift, scale = {
            "standardise": (values.mean(), values.std()),
            "robust": (np.median(values), values.std()),  # 98 of 100 is all of a few values
            "min_max": (values.min(), values.max() - values.min()),
            "divide_by_max": (values.min(), values.max()),
            "identity": (0.0, 1.0),
        }[kind]
        x = np.array([0.3, -2.0, 7.0])
        got = scaler.scaled(np.repeat(x[:, None], 3, axis=1))[:, channel]
        assert got == pytest.approx((x - shift) / scale, rel=1e-12)


@pytest.mark.parametrize("kind", KINDS)
def test_a_scaler_does_not_see_masked_or_unknown_values(kind: str) -> None:
    data = dataset(5)
    changed = Dataset(
        tuple(
            Trajectory(
                t.times, np.where(t.observed, t.values, v), observed=t.observed, units=t.units
            )
            for t, v in zip(data, [1e6, -1e6, NAN, NAN, 0.0], strict=True)
        )
    )
    a, b = Scaler.fit(kind, data), Scaler.fit(kind, changed)
    assert np.array_equal(a.shift, b.shift)
    assert np.array_equal(a.scale, b.scale)


@pytest.mark.parametrize("kind", KINDS)
def test_scaled_and_original_are_inverse(kind: str) -> None:
    data = dataset(5)
    scaler = Scaler.fit(kind, data)
    values = data[0].values
    np.testing.assert_allclose(scaler.original(scaler.scaled(values)), values, rtol=0, atol=1e-14)
    assert np.isnan(scaler.scaled(np.full((1, 3), NAN))).all()


def test_divide_by_max_over_everything_is_the_normalisation_of_the_thesis() -> None:
    data = dataset(5, share=2.0)
    data = Dataset(tuple(Trajectory(t.times, t.values) for t in data))
    everything = np.concatenate([t.values for t in data])
    scaler = Scaler.fit("divide_by_max", data)
    low, high = everything.min(axis=0), everything.max(axis=0)
    for one in data:
        assert np.array_equal(scaler.scaled(one.values), (one.values - low) / high)


@pytest.mark.parametrize("kind", KINDS)
def test_a_channel_that_is_never_observed_is_named(kind: str) -> None:
    values = np.ones((4, 2)) * np.arange(1, 5)[:, None]
    observed = np.ones((4, 2), dtype=bool)
    observed[:, 1] = False
    data = Dataset((Trajectory(np.arange(4.0), values, observed=observed, names=("a", "knee")),))
    with pytest.raises(InputError, match="knee"):
        Scaler.fit(kind, data)


@pytest.mark.parametrize("kind", ["standardise", "robust", "min_max"])
@pytest.mark.parametrize("value", [0.0, 0.1, -3.7, 1e9])
def test_a_channel_that_never_moves_keeps_its_size(kind: str, value: float) -> None:
    data = Dataset((Trajectory(np.arange(30.0), np.full((30, 1), value)),))
    scaler = Scaler.fit(kind, data)
    assert scaler.scale.tolist() == [1.0]
    assert scaler.shift == pytest.approx([value])


def one_column(values: np.ndarray) -> Dataset:
    return Dataset((Trajectory(np.arange(float(len(values))), values[:, None]),))


@pytest.mark.parametrize("size", [150, 1000, 20_000])
@pytest.mark.parametrize("wild", [-999.0, 1e30, 65535.0])
def test_a_few_wild_values_do_not_change_a_robust_scale(size: int, wild: float) -> None:
    clean = np.random.default_rng(size).normal(20.0, 3.0, size)
    dirty = clean.copy()
    dirty[np.linspace(5, size - 5, min(7, max(2, size // 100))).astype(int)] = wild
    own, other = (Scaler.fit("robust", one_column(values)) for values in (clean, dirty))
    assert own.scale == pytest.approx([clean.std()], rel=0.15)
    assert other.scale == pytest.approx(own.scale, rel=0.1)
    assert other.shift == pytest.approx(own.shift, abs=0.2)
    plain = Scaler.fit("standardise", one_column(dirty))
    assert plain.scale[0] > 5 * own.scale[0], "the other kind is what the wild values make it"


def test_clipped_values_are_scipys_winsorised_ones() -> None:
    values = np.random.default_rng(0).standard_t(2, 1000)
    np.testing.assert_array_equal(clipped(values), winsorize(values, limits=(0.01, 0.01)))


@pytest.mark.parametrize("on", [0.5, 0.02, 0.002, 0.0005])
def test_a_switch_keeps_its_scale_however_rarely_it_is_on(on: float) -> None:
    values = np.zeros(4000)
    values[: round(on * 4000)] = 1.0
    scaler = Scaler.fit("robust", one_column(np.random.default_rng(1).permutation(values)))
    assert scaler.scale == pytest.approx([values.std()])
    assert scaler.shift == pytest.approx([np.median(values)])


def test_a_model_on_a_robust_scale_has_robust_statistics_and_others_keep_theirs() -> None:
    values = np.random.default_rng(3).normal(20.0, 3.0, 1000)
    values[::143] = -999.0
    data = one_column(values)
    robust = make_model("gru", data, scaler="robust").statistics
    assert robust.mean == pytest.approx([0.0], abs=0.1)
    assert robust.std == pytest.approx([1.0], rel=0.01)
    standard = make_model("gru", data).statistics
    scaled = (values - values.mean()) / values.std()
    assert standard.mean == pytest.approx([scaled.mean()], abs=1e-6)
    assert standard.std == pytest.approx([scaled.std()], rel=1e-6)


def test_a_maximum_of_0_cannot_be_divided_by() -> None:
    data = Dataset((Trajectory([0.0, 1.0], [[-1.0], [0.0]]),))
    with pytest.raises(InputError, match="use 'min_max' instead"):
        Scaler.fit("divide_by_max", data)


@given(st.lists(st.floats(-1e300, 1e300), min_size=1, max_size=4))
def test_a_scaler_survives_json_to_the_last_bit(numbers: list[float]) -> None:
    values = np.array(numbers)
    scaler = Scaler("min_max", values, np.where(values == 0, 1.0, values))
    again = Scaler.from_dict(json.loads(json.dumps(scaler.to_dict())))
    assert again.kind == scaler.kind
    assert again.shift.tobytes() == scaler.shift.tobytes()
    assert again.scale.tobytes() == scaler.scale.tobytes()


@pytest.mark.parametrize(
    ("shift", "scale", "message"),
    [
        ([0.0, 1.0], [1.0], "one shape"),
        ([0.0], [0.0], "scale not zero"),
        ([NAN], [1.0], "finite"),
        ([0.0], [float("inf")], "finite"),
    ],
)
def test_a_scale_that_cannot_be_undone_is_refused(
    shift: list[float], scale: list[float], message: str
) -> None:
    with pytest.raises(InputError, match=message):
        Scaler("min_max", np.array(shift), np.array(scale))


def test_an_unknown_scaler_is_refused_with_the_choices() -> None:
    with pytest.raises(InputError, match=r"unknown scaler 'standardize'.*did you mean"):
        Scaler.fit("standardize", dataset(2))


def test_a_scaler_owns_its_arrays() -> None:
    shift, scale = np.zeros(2), np.ones(2)
    scaler = Scaler("min_max", shift, scale)
    scale[0] = 0
    assert scaler.scale.tolist() == [1.0, 1.0]
    for array in (scaler.shift, scaler.scale):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 0
