"""Masks: exact fractions, runs of the length asked for, and nothing else changed."""

from __future__ import annotations

from dataclasses import replace
from decimal import Decimal
from itertools import groupby

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from model_helpers import dataset, trajectory

from offbeat import Dataset, InputError, Trajectory
from offbeat.data.masking import mask_out, masked_values, sensors_of

NAN = float("nan")


def grid(rows: int, channels: int = 2, *, count: int = 1, gap: float = 0.005) -> Dataset:
    one = Trajectory(
        np.arange(rows) * gap,
        np.arange(rows * channels, dtype=float).reshape(rows, channels),
        names=tuple("abcdefgh"[:channels]),
    )
    return Dataset((one,) * count)


def numbered(count: int, rows: int) -> Dataset:
    """Every value tells its trajectory and row."""
    return Dataset(
        tuple(
            Trajectory(np.arange(rows) * 0.005 + i, 1000.0 * i + np.arange(rows)[:, None])
            for i in range(count)
        ),
        {"robot": "none"},
    )


def two_rates(rows: int = 60) -> Dataset:
    """A fast sensor of two channels at every row, a slow one of one channel at every third."""
    values = np.arange(3.0 * rows).reshape(rows, 3)
    values[np.arange(rows) % 3 > 0, 2] = np.nan
    return Dataset((Trajectory(np.arange(rows) * 0.01, values, names=("ax", "ay", "gps")),))


def runs(mask: np.ndarray) -> list[int]:
    """Lengths of the runs of True."""
    return [len(list(group)) for value, group in groupby(mask) if value]


# --- fractions ------------------------------------------------------------------------------------


@given(st.integers(1, 120), st.integers(1, 99), st.integers(1, 12))
def test_bursts_mask_exactly_the_asked_fraction_of_rows(rows, percent, length):
    keep = rows * percent // 100
    data = grid(rows)
    if keep == 0:
        with pytest.raises(InputError, match="leaves none"):
            mask_out(data, percent / 100, mask="bursts", burst_rows=length)
        return
    wanted = -(-(rows - keep) // length)
    if wanted > keep + 1:
        with pytest.raises(InputError, match="use longer bursts"):
            mask_out(data, percent / 100, mask="bursts", burst_rows=length)
        return
    (one,) = mask_out(data, percent / 100, mask="bursts", burst_rows=length)
    seen = one.observed.any(axis=1)
    assert np.array_equal(one.observed, np.repeat(seen[:, None], 2, axis=1))
    assert int(seen.sum()) == keep
    found = runs(~seen)
    assert found[:-1] == [length] * (len(found) - 1), "all but the last are whole"
    assert not found or 1 <= found[-1] <= length


@given(st.integers(2, 80), st.integers(5, 95), st.integers(0, 10_000))
def test_values_keep_exactly_the_asked_fraction_of_every_channel(rows, percent, seed):
    random = np.random.default_rng(seed)
    values = np.where(random.random((rows, 3)) < 0.6, random.normal(size=(rows, 3)), np.nan)
    data = Dataset((Trajectory(np.arange(rows) * 0.1, values),))
    (one,) = mask_out(data, percent / 100, mask="values", seed=seed)
    before = data[0].observed.sum(axis=0)
    expected = np.minimum(np.maximum(before * percent // 100, 1), before)
    assert np.array_equal(one.observed.sum(axis=0), expected)


@given(st.integers(10, 80), st.integers(10, 90), st.integers(1, 30), st.integers(0, 1000))
def test_dropout_keeps_exactly_the_asked_fraction_of_every_sensor(rows, percent, length, seed):
    data = two_rates(rows)
    fraction = percent / 100
    counts = [rows, -(-rows // 3)]
    keep = [max(n * percent // 100, 1) for n in counts]
    too_short = any(-(-(n - k) // length) > k + 1 for n, k in zip(counts, keep, strict=True))
    if too_short:
        with pytest.raises(InputError, match="be apart"):
            mask_out(data, fraction, mask="dropout", burst_rows=length, seed=seed)
        return
    (one,) = mask_out(data, fraction, mask="dropout", burst_rows=length, seed=seed)
    assert one.observed[:, 0].sum() == keep[0]
    assert np.array_equal(one.observed[:, 0], one.observed[:, 1]), "one sensor, one run"
    assert one.observed[:, 2].sum() == keep[1]
    gps = one.observed[data[0].observed[:, 2], 2]
    assert all(n == length for n in runs(~gps)[:-1])


@pytest.mark.parametrize("mask", ["rows", "values", "bursts", "dropout"])
def test_masked_values_stay_known_and_the_seed_alone_decides(mask):
    data = dataset(4, rows=30)
    first, again, other = (mask_out(data, 0.5, mask=mask, seed=s) for s in (1, 1, 2))
    for a, b, whole in zip(first, again, data, strict=True):
        assert np.array_equal(a.values, whole.values)
        assert np.array_equal(a.observed, b.observed)
        assert not (a.observed & ~whole.observed).any()
        assert np.array_equal(masked_values(a), whole.known & ~a.observed)
    assert any(
        not np.array_equal(a.observed, b.observed) for a, b in zip(first, other, strict=True)
    )


# --- bursts ---------------------------------------------------------------------------------------


def test_a_burst_in_seconds_masks_what_lies_within_that_time():
    random = np.random.default_rng(0)
    times = np.cumsum(random.uniform(0.001, 0.05, 400))
    data = Dataset((Trajectory(times, np.arange(400.0)[:, None]),))
    (one,) = mask_out(data, 0.6, mask="bursts", burst_s=0.2, seed=3)
    seen = one.observed[:, 0]
    assert seen.sum() == 240
    starts = np.flatnonzero(~seen & np.concatenate([[True], seen[:-1]]))
    for start in starts[:-1]:
        inside = (times >= times[start]) & (times < times[start] + 0.2)
        assert not seen[inside].any()
        after = np.flatnonzero(inside)[-1] + 1
        assert after == 400 or seen[after], "a burst ends with its time, and they lie apart"


def test_a_burst_of_50_ms_on_a_grid_of_5_ms_is_10_rows_wherever_it_starts():
    (one,) = mask_out(grid(1000), 0.5, mask="bursts", burst_s=0.05)
    assert runs(~one.observed[:, 0]) == [10] * 50


def test_without_a_length_there_is_one_run():
    (one,) = mask_out(grid(50), 0.4, mask="bursts", seed=5)
    assert runs(~one.observed[:, 0]) == [30]


def test_bursts_stand_anywhere_with_the_same_probability():
    data = grid(11, 1, count=4000)
    starts = [int(np.argmin(t.observed[:, 0])) for t in mask_out(data, 6 / 11, mask="bursts")]
    counts = np.bincount(starts, minlength=7)
    assert len(counts) == 7
    # Five standard deviations of a binomial count around 4000 / 7.
    assert np.abs(counts - 4000 / 7).max() < 5 * np.sqrt(4000 * 6 / 49)


# --- rows -----------------------------------------------------------------------------------------


@given(st.integers(1, 400), st.integers(1, 1000))
def test_exactly_the_asked_fraction_of_rows_stays_observed(rows: int, thousandths: int) -> None:
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


def test_masked_values_stay_known_and_nothing_else_changes() -> None:
    data = numbered(3, 40)
    for masked, whole in zip(mask_out(data, 0.3, seed=2), data, strict=True):
        assert np.array_equal(masked.values, whole.values)
        assert np.array_equal(masked.times, whole.times)
        assert masked.known.all()
    assert not np.array_equal(*(mask_out(data, 0.3, seed=2)[i].observed for i in (0, 1)))


def test_masking_keeps_masks_per_channel_and_counts_observed_rows_alone() -> None:
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


def test_masking_follows_from_the_seed_and_is_told_in_the_meta() -> None:
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
    masked = Trajectory([0.0, 1.0], [[1.0], [2.0]], observed=np.zeros((2, 1), dtype=bool))
    with pytest.raises(InputError, match="of the 0 observed rows of trajectory 0 leaves none"):
        mask_out(Dataset((masked,)), 1.0)


# --- sensors --------------------------------------------------------------------------------------


def test_channels_with_one_mask_are_one_sensor():
    assert sensors_of(two_rates()) == [["ax", "ay"], ["gps"]]
    assert sensors_of(grid(5, 3)) == [["a"], ["b"], ["c"]]


def test_named_sensors_drop_out_together_and_the_others_never():
    (one,) = mask_out(
        grid(40, 4), 0.5, mask="dropout", burst_rows=5, sensors=[["d", "a"], ["c"]], seed=1
    )
    assert np.array_equal(one.observed[:, 0], one.observed[:, 3])
    assert not np.array_equal(one.observed[:, 0], one.observed[:, 2])
    assert one.observed[:, 1].all()
    assert one.observed.sum(axis=0).tolist() == [20, 40, 20, 20]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"mask": "row"}, "did you mean 'rows'"),
        ({"burst_rows": 3}, "options of the masks 'bursts' and 'dropout'"),
        ({"mask": "bursts", "burst_rows": 3, "burst_s": 1.0}, "not both"),
        ({"mask": "bursts", "burst_rows": 0}, "at least 1"),
        ({"mask": "bursts", "burst_s": float("inf")}, "positive number of seconds"),
        ({"mask": "values", "sensors": [["a"]]}, "option of the mask 'dropout'"),
        ({"mask": "dropout", "sensors": [["a"], ["z"]]}, "unknown channel of a sensor 'z'"),
        ({"mask": "dropout", "sensors": [["a"], ["a", "b"]]}, "share no channel"),
        ({"mask": "bursts", "burst_rows": 1}, "use longer bursts"),
    ],
)
def test_what_cannot_be_masked_so_is_refused(options, message):
    with pytest.raises(InputError, match=message):
        mask_out(grid(20), 0.3, **options)


@pytest.mark.parametrize("mask", ["rows", "values", "bursts", "dropout"])
def test_states_alone_are_masked_and_count(mask):
    (one,) = grid(40, 3)
    (masked,) = mask_out(
        Dataset((replace(one, roles=("state", "action", "exogenous")),)), 0.5, mask=mask
    )
    assert masked.observed.sum(axis=0).tolist() == [20, 40, 40]
    with pytest.raises(InputError, match="no channel has the role 'state'"):
        mask_out(Dataset((replace(one, roles=("action",) * 3),)), 0.5, mask=mask)
