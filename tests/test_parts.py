"""Windows in rows and seconds, and logs that are split in time."""

from __future__ import annotations

from dataclasses import asdict

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from offbeat import (
    Dataset,
    InputError,
    Scaler,
    SplitConfig,
    Trajectory,
    apply_split,
    make_model,
    split_in_time,
    windows,
)
from offbeat.data.splits import load_split, save_split


def log(rows: int = 1000, *, gap: float = 0.01, start: int = 0) -> Trajectory:
    """Every value is its row, counted from `start`."""
    return Trajectory(np.arange(rows) * gap, start + np.arange(rows, dtype=float)[:, None])


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


def test_windows_in_seconds_hold_the_rows_within_that_time():
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


# --- in time --------------------------------------------------------------------------------------


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
    config = SplitConfig(window=window, cut=cut, split="in_time", fractions=(0.5, 0.25, 0.25))
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

    config = SplitConfig(window=40, split="in_time", observed_fraction=0.5, hide="bursts")
    cut = [apply_split(with_end(v), config)[0] for v in (1.0, 1e6)]
    scalers = [Scaler.fit("standardise", c).to_dict() for c in cut]
    assert scalers[0] == scalers[1]
    models = [make_model("gru", c, hidden_size=3) for c in cut]
    assert models[0].statistics == models[1].statistics


def test_a_log_too_short_for_its_parts_says_what_to_do():
    with pytest.raises(InputError, match="use a longer log"):
        split_in_time(Dataset((log(5),)))
    with pytest.raises(InputError, match="split='in_time'"):
        apply_split(Dataset((log(500),)), SplitConfig(window=10))
    with pytest.raises(InputError, match="sum to 1"):
        split_in_time(Dataset((log(50),)), (0.5, 0.2))


# --- by trajectory --------------------------------------------------------------------------------


def test_all_windows_of_a_trajectory_stand_in_one_part():
    data = Dataset(tuple(log(50 + i, start=1000 * i) for i in range(20)))
    three = apply_split(data, SplitConfig(window=12, cut="consecutive", seed=3))
    owners = [{v // 1000 for v in rows_of(part)} for part in three]
    assert [len(o) for o in owners] == [14, 3, 3]
    assert set.union(*owners) == set(range(20))


@pytest.mark.parametrize("hide", ["rows", "cells", "bursts", "dropout"])
def test_shares_hold_for_a_trajectory_that_is_cut_into_several_windows(hide):
    data = Dataset(tuple(log(100, start=1000 * i) for i in range(10)))
    config = SplitConfig(window=30, cut="consecutive", observed_fraction=0.4, hide=hide)
    for part in apply_split(data, config):
        seen: dict[int, int] = {}
        for one in part:
            owner = int(one.values[0, 0]) // 1000
            seen[owner] = seen.get(owner, 0) + int(one.observed.sum())
        assert set(seen.values()) == {40}


@pytest.mark.parametrize(
    "config",
    [
        SplitConfig(window_s=0.3, split="in_time", observed_fraction=0.6, hide="cells", seed=4),
        SplitConfig(window=20, cut="random", window_count=3, split="in_time"),
        SplitConfig(
            split="in_time", observed_fraction=0.5, hide="dropout", burst_s=0.1,
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
        ({"hide": "burst"}, "did you mean 'bursts'"),
        ({"split": "time"}, "in_time"),
        ({"burst_rows": 3, "burst_s": 1.0}, "not both"),
        ({"window_s": 0.0}, "positive number of seconds"),
    ],
)
def test_a_config_that_contradicts_itself_is_refused(options, message):
    with pytest.raises(InputError, match=message):
        SplitConfig(**options)


def test_a_config_is_plain_data():
    config = SplitConfig(hide="dropout", sensors=[["a", "b"], ["c"]])
    assert config.sensors == (("a", "b"), ("c",))
    assert SplitConfig(**asdict(config)) == config
