"""Ways of hiding: exact shares, runs of the length asked for, and nothing else touched."""

from __future__ import annotations

from itertools import groupby

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from model_helpers import dataset

from offbeat import Dataset, InputError, Trajectory
from offbeat.data.masking import mask_out, masked_values, sensors_of


def grid(rows: int, channels: int = 2, *, count: int = 1, gap: float = 0.005) -> Dataset:
    one = Trajectory(
        np.arange(rows) * gap,
        np.arange(rows * channels, dtype=float).reshape(rows, channels),
        names=tuple("abcdefgh"[:channels]),
    )
    return Dataset((one,) * count)


def two_rates(rows: int = 60) -> Dataset:
    """A fast sensor of two channels at every row, a slow one of one channel at every third."""
    values = np.arange(3.0 * rows).reshape(rows, 3)
    values[np.arange(rows) % 3 > 0, 2] = np.nan
    return Dataset((Trajectory(np.arange(rows) * 0.01, values, names=("ax", "ay", "gps")),))


def runs(mask: np.ndarray) -> list[int]:
    """Lengths of the runs of True."""
    return [len(list(group)) for value, group in groupby(mask) if value]


# --- shares ---------------------------------------------------------------------------------------


@given(st.integers(1, 120), st.integers(1, 99), st.integers(1, 12))
def test_bursts_hide_exactly_the_asked_share_of_rows(rows, percent, length):
    keep = rows * percent // 100
    data = grid(rows)
    if keep == 0:
        with pytest.raises(InputError, match="leaves none"):
            mask_out(data, percent / 100, hide="bursts", burst_rows=length)
        return
    wanted = -(-(rows - keep) // length)
    if wanted > keep + 1:
        with pytest.raises(InputError, match="use longer bursts"):
            mask_out(data, percent / 100, hide="bursts", burst_rows=length)
        return
    (one,) = mask_out(data, percent / 100, hide="bursts", burst_rows=length)
    seen = one.observed.any(axis=1)
    assert np.array_equal(one.observed, np.repeat(seen[:, None], 2, axis=1))
    assert int(seen.sum()) == keep
    hidden = runs(~seen)
    assert hidden[:-1] == [length] * (len(hidden) - 1), "all but the last are whole"
    assert not hidden or 1 <= hidden[-1] <= length


@given(st.integers(2, 80), st.integers(5, 95), st.integers(0, 10_000))
def test_cells_keep_exactly_the_asked_share_of_every_channel(rows, percent, seed):
    random = np.random.default_rng(seed)
    values = np.where(random.random((rows, 3)) < 0.6, random.normal(size=(rows, 3)), np.nan)
    data = Dataset((Trajectory(np.arange(rows) * 0.1, values),))
    (one,) = mask_out(data, percent / 100, hide="cells", seed=seed)
    before = data[0].observed.sum(axis=0)
    expected = np.minimum(np.maximum(before * percent // 100, 1), before)
    assert np.array_equal(one.observed.sum(axis=0), expected)


@given(st.integers(10, 80), st.integers(10, 90), st.integers(1, 30), st.integers(0, 1000))
def test_dropout_keeps_exactly_the_asked_share_of_every_sensor(rows, percent, length, seed):
    data = two_rates(rows)
    fraction = percent / 100
    counts = [rows, -(-rows // 3)]
    keep = [max(n * percent // 100, 1) for n in counts]
    too_short = any(-(-(n - k) // length) > k + 1 for n, k in zip(counts, keep, strict=True))
    if too_short:
        with pytest.raises(InputError, match="lie apart"):
            mask_out(data, fraction, hide="dropout", burst_rows=length, seed=seed)
        return
    (one,) = mask_out(data, fraction, hide="dropout", burst_rows=length, seed=seed)
    assert one.observed[:, 0].sum() == keep[0]
    assert np.array_equal(one.observed[:, 0], one.observed[:, 1]), "one sensor, one silence"
    assert one.observed[:, 2].sum() == keep[1]
    gps = one.observed[data[0].observed[:, 2], 2]
    assert all(n == length for n in runs(~gps)[:-1])


@pytest.mark.parametrize("hide", ["rows", "cells", "bursts", "dropout"])
def test_hidden_values_stay_known_and_the_seed_alone_decides(hide):
    data = dataset(4, rows=30)
    first, again, other = (mask_out(data, 0.5, hide=hide, seed=s) for s in (1, 1, 2))
    for a, b, whole in zip(first, again, data, strict=True):
        assert np.array_equal(a.values, whole.values)
        assert np.array_equal(a.observed, b.observed)
        assert not (a.observed & ~whole.observed).any()
        assert np.array_equal(masked_values(a), whole.known & ~a.observed)
    assert any(
        not np.array_equal(a.observed, b.observed) for a, b in zip(first, other, strict=True)
    )


# --- bursts ---------------------------------------------------------------------------------------


def test_a_burst_in_seconds_hides_what_lies_within_that_time():
    random = np.random.default_rng(0)
    times = np.cumsum(random.uniform(0.001, 0.05, 400))
    data = Dataset((Trajectory(times, np.arange(400.0)[:, None]),))
    (one,) = mask_out(data, 0.6, hide="bursts", burst_s=0.2, seed=3)
    seen = one.observed[:, 0]
    assert seen.sum() == 240
    starts = np.flatnonzero(~seen & np.concatenate([[True], seen[:-1]]))
    for start in starts[:-1]:
        inside = (times >= times[start]) & (times < times[start] + 0.2)
        assert not seen[inside].any()
        after = np.flatnonzero(inside)[-1] + 1
        assert after == 400 or seen[after], "a burst ends with its time, and they lie apart"


def test_a_burst_of_50_ms_on_a_grid_of_5_ms_is_10_rows_wherever_it_starts():
    (one,) = mask_out(grid(1000), 0.5, hide="bursts", burst_s=0.05)
    assert runs(~one.observed[:, 0]) == [10] * 50


def test_without_a_length_there_is_one_silence():
    (one,) = mask_out(grid(50), 0.4, hide="bursts", seed=5)
    assert runs(~one.observed[:, 0]) == [30]


def test_bursts_stand_anywhere_with_the_same_probability():
    data = grid(11, 1, count=4000)
    starts = [int(np.argmin(t.observed[:, 0])) for t in mask_out(data, 6 / 11, hide="bursts")]
    counts = np.bincount(starts, minlength=7)
    assert len(counts) == 7
    # Five standard deviations of a binomial count around 4000 / 7.
    assert np.abs(counts - 4000 / 7).max() < 5 * np.sqrt(4000 * 6 / 49)


# --- sensors --------------------------------------------------------------------------------------


def test_channels_with_one_mask_are_one_sensor():
    assert sensors_of(two_rates()) == [["ax", "ay"], ["gps"]]
    assert sensors_of(grid(5, 3)) == [["a"], ["b"], ["c"]]


def test_named_sensors_fall_silent_together_and_the_others_never():
    (one,) = mask_out(
        grid(40, 4), 0.5, hide="dropout", burst_rows=5, sensors=[["d", "a"], ["c"]], seed=1
    )
    assert np.array_equal(one.observed[:, 0], one.observed[:, 3])
    assert not np.array_equal(one.observed[:, 0], one.observed[:, 2])
    assert one.observed[:, 1].all()
    assert one.observed.sum(axis=0).tolist() == [20, 40, 20, 20]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"hide": "row"}, "did you mean 'rows'"),
        ({"burst_rows": 3}, "options of 'bursts' and 'dropout'"),
        ({"hide": "bursts", "burst_rows": 3, "burst_s": 1.0}, "not both"),
        ({"hide": "bursts", "burst_rows": 0}, "at least 1"),
        ({"hide": "bursts", "burst_s": float("inf")}, "positive number of seconds"),
        ({"hide": "cells", "sensors": [["a"]]}, "option of 'dropout'"),
        ({"hide": "dropout", "sensors": [["a"], ["z"]]}, "unknown channel of a sensor 'z'"),
        ({"hide": "dropout", "sensors": [["a"], ["a", "b"]]}, "share no channel"),
        ({"hide": "bursts", "burst_rows": 1}, "use longer bursts"),
    ],
)
def test_what_cannot_be_hidden_so_is_refused(options, message):
    with pytest.raises(InputError, match=message):
        mask_out(grid(20), 0.3, **options)
