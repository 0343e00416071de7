"""Windows in rows and seconds; splits by trajectory and by time."""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from itertools import combinations

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from model_helpers import trajectory

from offbeat import (
    Dataset,
    InputError,
    Scaler,
    SplitConfig,
    Trajectory,
    apply_split,
    make_model,
    mask_out,
    split,
    split_in_time,
    windows,
)
from offbeat.data.splits import load_split, save_split, split_in_blocks

NAN = float("nan")


def log(rows: int = 1000, *, gap: float = 0.01, start: int = 0) -> Trajectory:
    """Every value is its row, counted from `start`."""
    return Trajectory(np.arange(rows) * gap, start + np.arange(rows, dtype=float)[:, None])


def numbered(count: int, rows: int) -> Dataset:
    """Every value tells its trajectory and row."""
    return Dataset(
        tuple(
            Trajectory(np.arange(rows) * 0.005 + i, 1000.0 * i + np.arange(rows)[:, None])
            for i in range(count)
        ),
        {"robot": "none"},
    )


def rows_of(data: Dataset) -> list[int]:
    return [int(v) for t in data for v in t.values[:, 0]]


# --- windows --------------------------------------------------------------------------------------


@given(st.integers(1, 200), st.integers(1, 60))
def test_consecutive_windows_lose_no_row_and_are_half_to_one_and_a_half_long(rows, length):
    cut = windows(Dataset((log(rows),)), length, cut="consecutive")
    assert rows_of(cut) == list(range(rows))
    assert all(cut[i].rows == length for i in range(len(cut) - 1))
    last = cut[len(cut) - 1].rows
    assert last == rows or length / 2 <= last < 1.5 * length


def test_windows_in_seconds_have_the_rows_within_that_time():
    times = np.array([0.0, 0.1, 0.15, 0.7, 1.0, 1.2, 5.0, 5.9, 6.0, 6.5])
    data = Dataset((Trajectory(times, np.arange(10.0)[:, None]),))
    cut = windows(data, seconds=1.0, cut="consecutive")
    assert [t.times.tolist() for t in cut] == [
        [0.0, 0.1, 0.15, 0.7],
        [1.0, 1.2],
        [5.0, 5.9],
        [6.0, 6.5],
    ]


@pytest.mark.parametrize("cut", ["one", "random"])
def test_drawn_windows_in_seconds_have_all_the_rows_of_a_grid(cut):
    data = Dataset((log(100, gap=0.005),) * 50)
    drawn = windows(data, seconds=0.1, cut=cut, seed=2)
    assert all(t.rows == 20 for t in drawn)
    starts = {int(t.values[0, 0]) for t in drawn}
    assert min(starts) < 10
    assert max(starts) > 70


def test_random_windows_are_as_many_as_cover_the_trajectory_or_as_asked_for():
    data = Dataset((log(95), log(12)))
    assert len(windows(data, 20, cut="random")) == 5 + 1
    assert len(windows(data, 10, cut="random", count=7)) == 14
    shorter = windows(data, 50, cut="random", count=3)
    assert [t.rows for t in shorter] == [50, 50, 50, 12], "a short one is a window itself"


def test_a_length_is_given_once():
    data = Dataset((log(10),))
    for options in ({}, {"length": 3, "seconds": 1.0}):
        with pytest.raises(InputError, match="one of the two"):
            windows(data, **options)
    with pytest.raises(InputError, match="positive number of seconds"):
        windows(data, seconds=-1.0)
    with pytest.raises(InputError, match="cut 'consecutive'"):
        windows(data, seconds=3.0)


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


def test_windows_follow_from_the_seed_and_keep_masks_and_meta() -> None:
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


# --- by time --------------------------------------------------------------------------------------


def test_a_log_split_in_time_trains_on_its_first_part_and_tests_on_its_last():
    train, validation, test = split_in_time(Dataset((log(1000),)))
    assert rows_of(train) == list(range(700))
    assert rows_of(validation) == list(range(700, 850))
    assert rows_of(test) == list(range(850, 1000))


def test_episodes_in_order_are_one_log_and_the_one_at_a_border_is_cut():
    data = Dataset((log(60), log(30, start=60), log(110, start=90)))
    train, validation, test = split_in_time(data, (0.4, 0.4, 0.2))
    assert [t.rows for t in train] == [60, 20]
    assert [t.rows for t in validation] == [10, 70]
    assert [t.rows for t in test] == [40]
    assert [*rows_of(train), *rows_of(validation), *rows_of(test)] == list(range(200))


@given(st.integers(30, 300), st.integers(5, 40), st.sampled_from(["consecutive", "random"]))
def test_no_window_straddles_and_all_of_training_comes_first(rows, window, cut):
    config = SplitConfig(window=window, cut=cut, by="time", fractions=(0.5, 0.25, 0.25))
    train, validation, test = apply_split(Dataset((log(rows),)), config)
    assert max(rows_of(train)) < min(rows_of(validation))
    assert max(rows_of(validation)) < min(rows_of(test))
    validation_set = [*rows_of(validation), *rows_of(test)]
    assert validation_set == list(range(validation_set[0], rows)), (
        "each row of them once, random or not"
    )
    for part in (train, validation, test):
        for one in part:
            assert np.array_equal(np.diff(one.values[:, 0]), np.ones(one.rows - 1))


def test_scales_and_statistics_come_from_the_training_part_alone():
    def with_end(value: float) -> Dataset:
        values = np.sin(np.arange(400.0))[:, None]
        values[280:] = value * np.arange(120)[:, None]
        return Dataset((Trajectory(np.arange(400) * 0.01, values),))

    config = SplitConfig(window=40, by="time", observed_fraction=0.5, mask="bursts")
    cut = [apply_split(with_end(v), config)[0] for v in (1.0, 1e6)]
    scalers = [Scaler.fit("standardise", c).to_dict() for c in cut]
    assert scalers[0] == scalers[1]
    models = [make_model("gru", c, hidden_size=3) for c in cut]
    assert models[0].statistics == models[1].statistics


def test_a_log_too_short_for_its_parts_says_what_to_do():
    with pytest.raises(InputError, match="use a longer recording"):
        split_in_time(Dataset((log(5),)))
    with pytest.raises(InputError, match="by='time'"):
        apply_split(Dataset((log(500),)), SplitConfig(window=10))
    with pytest.raises(InputError, match="sum to 1"):
        split_in_time(Dataset((log(50),)), (0.5, 0.2))


# --- in blocks ------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(5))
def test_blocks_of_every_part_are_spread_over_the_log(seed):
    train, validation, test = split_in_blocks(Dataset((log(1000),)), blocks=4, seed=seed)
    assert sorted(rows_of(train) + rows_of(validation) + rows_of(test)) == list(range(1000))
    for part in (validation, test):
        middles = np.array([t.values[:, 0].mean() for t in part])
        assert (middles // 250).tolist() == [0, 1, 2, 3], "one in each quarter"
        assert all(37 <= t.rows <= 38 for t in part)


def test_blocks_follow_from_the_seed_and_are_at_no_regular_places():
    first, again, other = (
        [rows_of(part) for part in split_in_blocks(Dataset((log(1000),)), seed=seed)]
        for seed in (1, 1, 2)
    )
    assert first == again
    assert first[1] != other[1]
    applied = [
        [
            rows_of(part)
            for part in apply_split(Dataset((log(1000),)), SplitConfig(by="blocks", seed=seed))
        ]
        for seed in (1, 2)
    ]
    assert applied == [first, other]
    phases = [
        float(t.values[0, 0]) % 200 / 200
        for seed in range(40)
        for t in split_in_blocks(Dataset((log(1000),)), blocks=5, seed=seed)[1]
    ]
    assert min(phases) < 0.2
    assert max(phases) > 0.7


@given(st.integers(60, 900), st.integers(1, 4), st.floats(0, 0.05), st.integers(1, 4))
def test_training_stays_a_gap_away_and_the_other_parts_lose_no_row(rows, blocks, gap, episodes):
    data = Dataset(tuple(log(rows, start=10_000 * i) for i in range(episodes)))
    train, validation, test = split_in_blocks(data, blocks=blocks, gap_s=gap)
    apart = [[*rows_of(part)] for part in (train, validation, test)]
    total = rows * episodes
    # At an episode's border, a piece of a single row is dropped.
    for own in apart[1:]:
        assert abs(len(own) - 0.15 * total) <= blocks + episodes
    other = np.array(sorted(apart[1] + apart[2]))
    for row in apart[0]:
        near = other[np.abs(other - row) < 1000]  # of its own episode
        assert not len(near) or np.abs(near - row).min() * 0.01 > gap - 1e-9
    assert len(set().union(*apart)) == sum(map(len, apart))


def test_the_number_of_blocks_follows_from_the_length():
    assert [len(split_in_blocks(Dataset((log(rows),)))[1]) for rows in (40, 600, 700, 10_000)] == [
        1, 1, 2, 5,
    ]  # fmt: skip


@given(st.integers(300, 900), st.integers(5, 20), st.sampled_from(["consecutive", "random"]))
def test_no_window_spans_two_blocks(rows, window, cut):
    config = SplitConfig(window=window, cut=cut, by="blocks", gap_s=0.03)
    for part in apply_split(Dataset((log(rows),)), config):
        for one in part:
            assert np.array_equal(np.diff(one.values[:, 0]), np.ones(one.rows - 1))


def test_a_log_too_short_for_blocks_says_what_to_do():
    with pytest.raises(InputError, match="use a longer recording or fewer blocks"):
        split_in_blocks(Dataset((log(8),)))
    with pytest.raises(InputError, match="use a longer recording or fewer blocks"):
        split_in_blocks(Dataset((log(200),)), gap_s=10.0)
    with pytest.raises(InputError, match="three fractions"):
        split_in_blocks(Dataset((log(200),)), (0.5, 0.5))
    with pytest.raises(InputError, match="sum to 1"):
        split_in_blocks(Dataset((log(200),)), (0.5, 0.5, 0.5))


# --- by trajectory --------------------------------------------------------------------------------


def test_all_windows_of_a_trajectory_stand_in_one_part():
    data = Dataset(tuple(log(50 + i, start=1000 * i) for i in range(20)))
    three = apply_split(data, SplitConfig(window=12, cut="consecutive", seed=3))
    sets = [{v // 1000 for v in rows_of(part)} for part in three]
    assert [len(own) for own in sets] == [14, 3, 3]
    assert set.union(*sets) == set(range(20))


@pytest.mark.parametrize("mask", ["rows", "values", "bursts", "dropout"])
def test_fractions_hold_for_a_trajectory_that_is_cut_into_several_windows(mask):
    data = Dataset(tuple(log(100, start=1000 * i) for i in range(10)))
    config = SplitConfig(window=30, cut="consecutive", observed_fraction=0.4, mask=mask)
    for part in apply_split(data, config):
        seen: dict[int, int] = {}
        for one in part:
            owner = int(one.values[0, 0]) // 1000
            seen[owner] = seen.get(owner, 0) + int(one.observed.sum())
        assert set(seen.values()) == {40}


@pytest.mark.parametrize(
    "config",
    [
        SplitConfig(window_s=0.3, by="time", observed_fraction=0.6, mask="values", seed=4),
        SplitConfig(window=20, cut="random", window_count=3, by="time"),
        SplitConfig(window=20, cut="random", by="blocks", blocks=2, gap_s=0.02),
        SplitConfig(
            by="time", observed_fraction=0.5, mask="dropout", burst_s=0.1,
            sensors=[["channel_0"]],
        ),
    ],
)  # fmt: skip
def test_parts_come_back_from_their_file(tmp_path, config):
    data = Dataset((log(300),))
    save_split(tmp_path / "split.json", config, data)
    again = load_split(tmp_path / "split.json", data)
    assert again is not None
    for a, b in zip(apply_split(data, config), again, strict=True):
        assert [t.times.tolist() for t in a] == [t.times.tolist() for t in b]
        assert all(np.array_equal(x.observed, y.observed) for x, y in zip(a, b, strict=True))
    assert load_split(tmp_path / "split.json", Dataset((log(301),))) is None


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"window": 5, "window_s": 1.0}, "window or window_s, not both"),
        ({"cut": "random"}, "needs the length of a window"),
        ({"window": 5, "cut": "two"}, "unknown cut 'two'"),
        ({"window": 5, "window_count": 3}, "option of cut='random'"),
        ({"mask": "burst"}, "did you mean 'bursts'"),
        ({"by": "in_time"}, "trajectory"),
        ({"burst_rows": 3, "burst_s": 1.0}, "not both"),
        ({"window_s": 0.0}, "positive number of seconds"),
        ({"by": "time", "gap_s": 1.0}, "options of by='blocks'"),
        ({"by": "blocks", "blocks": 0}, "blocks must be an integer of at least 1"),
        ({"by": "blocks", "gap_s": -1}, "gap_s must be seconds of at least 0"),
    ],
)
def test_a_config_that_contradicts_itself_is_refused(options, message):
    with pytest.raises(InputError, match=message):
        SplitConfig(**options)


def test_a_config_is_plain_data():
    config = SplitConfig(mask="dropout", sensors=[["a", "b"], ["c"]])
    assert config.sensors == (("a", "b"), ("c",))
    assert SplitConfig(**asdict(config)) == config


OLD = {
    "window": None, "window_s": 0.3, "cut": "consecutive", "window_count": None,
    "observed_fraction": 0.6, "hide": "cells", "burst_rows": None, "burst_s": None,
    "sensors": None, "split": "in_time", "fractions": [0.7, 0.15, 0.15], "seed": 4,
}  # fmt: skip


def test_the_split_of_a_run_of_offbeat_0_1_0_comes_back(tmp_path):
    data = Dataset((log(300),))
    old = {**OLD, "data": data.fingerprint(version=1)}
    (tmp_path / "parts.json").write_text(json.dumps(old))
    config = SplitConfig(
        window_s=0.3, cut="consecutive", observed_fraction=0.6, mask="values", by="time", seed=4
    )
    parts = load_split(tmp_path / "split.json", data)
    assert parts is not None
    for a, b in zip(apply_split(data, config), parts, strict=True):
        assert all(np.array_equal(x.values, y.values) for x, y in zip(a, b, strict=True))
        assert all(np.array_equal(x.observed, y.observed) for x, y in zip(a, b, strict=True))
    assert load_split(tmp_path / "split.json", Dataset((log(301),))) is None


def test_a_split_is_bound_to_units_and_roles(tmp_path):
    data = Dataset((log(300),))
    save_split(tmp_path / "split.json", SplitConfig(by="time"), data)
    for fields in ({"units": ("m",)}, {"roles": ("exogenous",)}):
        other = Dataset((replace(data[0], **fields),))
        assert load_split(tmp_path / "split.json", other) is None
