"""Windows, splits, hidden rows and scales."""

from __future__ import annotations

import json
from decimal import Decimal
from itertools import combinations

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from model_helpers import dataset, trajectory

from offbeat import Dataset, InputError, Scaler, Trajectory, split, windows
from offbeat.data.masking import mask_out

NAN = float("nan")
KINDS = ("standardise", "min_max", "divide_by_max", "identity")


def numbered(count: int, rows: int) -> Dataset:
    """Every value tells its trajectory and row."""
    return Dataset(
        tuple(
            Trajectory(np.arange(rows) * 0.005 + i, 1000.0 * i + np.arange(rows)[:, None])
            for i in range(count)
        ),
        {"robot": "none"},
    )


# --- windows --------------------------------------------------------------------------------------


def test_a_window_is_consecutive_rows_of_its_own_trajectory() -> None:
    data = numbered(20, 30)
    for i, (window, whole) in enumerate(zip(windows(data, 12, seed=3), data, strict=True)):
        start = int(window.values[0, 0]) - 1000 * i
        assert np.array_equal(window.values, whole.values[start : start + 12])
        assert np.array_equal(window.times, whole.times[start : start + 12])


def test_starts_of_windows_are_uniform_from_0_to_rows_minus_length() -> None:
    data = numbered(6000, 9)
    starts = [int(w.values[0, 0]) % 1000 for w in windows(data, 5, seed=1)]
    counts = np.bincount(starts)
    assert len(counts) == 5
    # Five standard deviations of a binomial count around 1200.
    assert np.abs(counts - 1200).max() < 5 * np.sqrt(6000 * 0.2 * 0.8)


def test_windows_follow_from_the_seed_and_keep_masks_and_facts() -> None:
    data = mask_out(numbered(30, 20), 0.5)
    first, again, other = (windows(data, 10, seed=s) for s in (1, 1, 2))
    assert all(np.array_equal(a.times, b.times) for a, b in zip(first, again, strict=True))
    assert any(not np.array_equal(a.times, b.times) for a, b in zip(first, other, strict=True))
    for window, whole in zip(first, data, strict=True):
        rows = np.searchsorted(whole.times, window.times)
        assert np.array_equal(window.observed, whole.observed[rows])
    assert first.meta["robot"] == "none"
    assert first.meta["window"] == 10


def test_a_window_of_all_rows_is_the_trajectory() -> None:
    data = numbered(2, 7)
    for window, whole in zip(windows(data, 7), data, strict=True):
        assert np.array_equal(window.values, whole.values)


@pytest.mark.parametrize("length", [0, -1, 8])
def test_a_window_that_does_not_fit_is_refused(length: int) -> None:
    with pytest.raises(InputError, match="use a length from 1 to 7"):
        windows(numbered(2, 7), length)


# --- split ----------------------------------------------------------------------------------------


def owners(part: Dataset) -> list[int]:
    return [int(t.values[0, 0]) // 1000 for t in part]


@pytest.mark.parametrize(("count", "sizes"), [(100, (70, 15, 15)), (20, (14, 3, 3))])
def test_a_split_is_70_15_15_by_trajectory_without_overlap(
    count: int, sizes: tuple[int, ...]
) -> None:
    parts = split(numbered(count, 2), seed=5)
    assert tuple(len(p) for p in parts) == sizes
    sets = [set(owners(p)) for p in parts]
    assert all(not a & b for a, b in combinations(sets, 2))
    assert set.union(*sets) == set(range(count))
    assert sum(map(len, sets)) == count


def test_a_split_of_10000_has_the_sizes_of_the_thesis() -> None:
    one = trajectory(0, 2)
    assert [len(p) for p in split(Dataset((one,) * 10_000))] == [7000, 1500, 1500]


def test_a_split_follows_from_the_seed() -> None:
    data = numbered(40, 2)
    first, again, other = ([owners(p) for p in split(data, seed=s)] for s in (1, 1, 2))
    assert first == again
    assert first != other


@given(st.integers(1, 200), st.lists(st.integers(1, 9), min_size=1, max_size=5))
def test_parts_of_any_fractions_share_out_all_trajectories(count: int, shares: list[int]) -> None:
    fractions = [s / sum(shares) for s in shares]
    assume(min(fractions) * count > 1)
    parts = split(Dataset((trajectory(0, 2),) * count), fractions)
    assert sum(len(p) for p in parts) == count
    for part, share in zip(parts, fractions, strict=True):
        assert abs(len(part) - share * count) <= 1


@pytest.mark.parametrize(
    "fractions", [(0.7, 0.2), (0.7, 0.3, 0.0), (1.2, -0.2), (NAN, 0.5), (), (0.5, float("inf"))]
)
def test_fractions_that_do_not_share_out_the_whole_are_refused(
    fractions: tuple[float, ...],
) -> None:
    with pytest.raises(InputError, match="positive and sum to 1"):
        split(numbered(10, 2), fractions)


def test_a_split_into_more_parts_than_trajectories_is_refused() -> None:
    with pytest.raises(InputError, match="too few"):
        split(numbered(2, 2))


# --- thin -----------------------------------------------------------------------------------------


@given(st.integers(1, 400), st.integers(1, 1000))
def test_exactly_the_asked_share_of_rows_stays_observed(rows: int, thousandths: int) -> None:
    fraction = thousandths / 1000
    expected = int(Decimal(thousandths) / 1000 * rows)
    data = Dataset((trajectory(0, rows, share=1.0, whole_rows=True),))
    full = Dataset((Trajectory(data[0].times, data[0].values),))
    if expected == 0:
        with pytest.raises(InputError, match="leaves none"):
            mask_out(full, fraction)
        return
    assert int(mask_out(full, fraction)[0].observed.any(axis=1).sum()) == expected


@pytest.mark.parametrize("fraction", [0.9, 0.7, 0.5, 0.3])
def test_the_fractions_of_the_thesis_keep_int_100_p_whole_rows(fraction: float) -> None:
    data = numbered(5, 100)
    data = Dataset(tuple(Trajectory(t.times, np.repeat(t.values, 3, axis=1)) for t in data))
    for one in mask_out(data, fraction, seed=1):
        assert one.observed.all(axis=1).sum() == int(100 * fraction)
        assert np.array_equal(one.observed.all(axis=1), one.observed.any(axis=1))


def test_hidden_cells_stay_known_and_nothing_else_changes() -> None:
    data = numbered(3, 40)
    for masked, whole in zip(mask_out(data, 0.3, seed=2), data, strict=True):
        assert np.array_equal(masked.values, whole.values)
        assert np.array_equal(masked.times, whole.times)
        assert masked.known.all()
    assert not np.array_equal(*(mask_out(data, 0.3, seed=2)[i].observed for i in (0, 1)))


def test_thinning_keeps_masks_per_channel_and_counts_observed_rows_alone() -> None:
    data = dataset(5, rows=40)
    for masked, whole in zip(mask_out(data, 0.5, seed=4), data, strict=True):
        rows = masked.observed.any(axis=1)
        assert rows.sum() == whole.observed.any(axis=1).sum() // 2
        assert np.array_equal(masked.observed[rows], whole.observed[rows])


def test_every_row_is_as_likely_to_stay() -> None:
    data = Dataset((numbered(1, 10)[0],) * 3000)
    counts = sum(t.observed[:, 0].astype(int) for t in mask_out(data, 0.3, seed=0))
    # Five standard deviations of a binomial count around 900.
    assert np.abs(counts - 900).max() < 5 * np.sqrt(3000 * 0.3 * 0.7)


def test_thinning_follows_from_the_seed_and_is_told_in_the_facts() -> None:
    data = numbered(3, 50)
    first, again, other = (mask_out(data, 0.5, seed=s) for s in (1, 1, 2))
    masks = [np.stack([t.observed for t in d]) for d in (first, again, other)]
    assert np.array_equal(masks[0], masks[1])
    assert not np.array_equal(masks[0], masks[2])
    assert first.meta["observed_fraction"] == 0.5
    assert first.meta["robot"] == "none"


@pytest.mark.parametrize("fraction", [0, 0.0, 1.2, -0.3, NAN, float("inf")])
def test_a_fraction_outside_0_to_1_is_refused(fraction: float) -> None:
    with pytest.raises(InputError, match="above 0 and at most 1"):
        mask_out(numbered(2, 10), fraction)


def test_a_trajectory_too_short_to_keep_a_row_is_refused() -> None:
    with pytest.raises(InputError, match="of the 3 observed rows of trajectory 0 leaves none"):
        mask_out(numbered(2, 3), 0.3)
    hidden = Trajectory([0.0, 1.0], [[1.0], [2.0]], observed=np.zeros((2, 1), dtype=bool))
    with pytest.raises(InputError, match="of the 0 observed rows of trajectory 0 leaves none"):
        mask_out(Dataset((hidden,)), 1.0)


# --- scalers --------------------------------------------------------------------------------------


def observed_values(data: Dataset, channel: int) -> list[float]:
    return [
        float(one.values[row, channel])
        for one in data
        for row in range(one.rows)
        if one.observed[row, channel]
    ]


@pytest.mark.parametrize("kind", KINDS)
def test_a_scaler_is_its_formula_over_the_observed_cells(kind: str) -> None:
    data = dataset(5)
    scaler = Scaler.fit(kind, data)
    for channel in range(3):
        cells = np.array(observed_values(data, channel))
        shift, scale = {
            "standardise": (cells.mean(), cells.std()),
            "min_max": (cells.min(), cells.max() - cells.min()),
            "divide_by_max": (cells.min(), cells.max()),
            "identity": (0.0, 1.0),
        }[kind]
        x = np.array([0.3, -2.0, 7.0])
        got = scaler.scaled(np.repeat(x[:, None], 3, axis=1))[:, channel]
        assert got == pytest.approx((x - shift) / scale, rel=1e-12)


@pytest.mark.parametrize("kind", KINDS)
def test_a_scaler_does_not_see_hidden_or_unknown_cells(kind: str) -> None:
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


@pytest.mark.parametrize("kind", ["standardise", "min_max"])
@pytest.mark.parametrize("value", [0.0, 0.1, -3.7, 1e9])
def test_a_channel_that_never_moves_keeps_its_size(kind: str, value: float) -> None:
    data = Dataset((Trajectory(np.arange(30.0), np.full((30, 1), value)),))
    scaler = Scaler.fit(kind, data)
    assert scaler.scale.tolist() == [1.0]
    assert scaler.shift == pytest.approx([value])


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
