"""Units of time, stated or found, and clocks that lose nothing."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from offbeat.data.cleaning.clocks import (
    NANOSECONDS_PER,
    find_time_unit,
    split_unit,
    state_time_unit,
    time_column_of,
    time_unit_in,
    to_nanoseconds,
)
from offbeat.data.readers import read
from offbeat.errors import FileFormatError, InputError

NOW_S = 1_714_564_800  # 2024-05-01 12:00:00 UTC
WINDOWS_S, DOTNET_S = NOW_S + 11_644_473_600, NOW_S + 62_135_596_800


@pytest.mark.parametrize(
    ("name", "unit"),
    [
        ("time_ms", "ms"),
        ("timestamp_us", "us"),
        ("t [ns]", "ns"),
        ("Time (s)", "s"),
        ("#timestamp [ns]", "ns"),
        ("clock_100ns", "100ns"),
        ("time_sec", "s"),
        ("stamp (Milliseconds)", "ms"),
        ("time(ms)", "ms"),
        ("t[us]", "us"),
        ("TimeUS", "us"),
        ("time.ms", "ms"),
        ("time_min", "min"),
        ("Time (h)", "h"),
        ("t_min", None),
        ("time", None),
        ("timestamps", None),
        ("s", None),
        ("wall_clock", None),
    ],
)
def test_the_name_of_a_column_can_say_its_unit(name, unit):
    assert time_unit_in(name) == unit


@pytest.mark.parametrize(
    ("names", "column"),
    [
        (["x", "Time"], "Time"),
        (["t", "time"], "time"),
        (["x", "time_ms"], "time_ms"),
        (["x", "t [ns]"], "t [ns]"),
        (["timestamp_usec", "x"], "timestamp_usec"),
        (["x", "%time"], "%time"),
        (["x", "__time"], "__time"),
        (["x", "rosbagTimestamp"], "rosbagTimestamp"),
        (["x", "timestamps"], "timestamps"),
        (["x", "TimeUS"], "TimeUS"),
        (["remote_timestamp", "x"], "remote_timestamp"),
        (["lifetime", "x"], None),
        (["timeout", "x"], None),
    ],
)
def test_the_column_of_times_is_found_by_its_name(names, column):
    assert time_column_of(names) == column


@pytest.mark.parametrize(
    ("name", "parts"),
    [
        ("speed [m/s]", ("speed", "m/s")),
        ("speed (m/s)", ("speed", "m/s")),
        (" gyro x [rad s^-1] ", ("gyro x", "rad s^-1")),
        ("q_RS_w []", ("q_RS_w", "")),
        ("gyro[0]", ("gyro[0]", "")),
        ("speed[m/s]", ("speed", "m/s")),
        ("angle(deg)", ("angle", "deg")),
        ("rate(rad*s^-1)", ("rate", "rad*s^-1")),
        ("acc(x)", ("acc(x)", "")),
        ("f(t)", ("f(t)", "")),
        ("[m]", ("[m]", "")),
        ("plain", ("plain", "")),
    ],
)
def test_a_unit_is_in_brackets_after_the_name(name, parts):
    assert split_unit(name) == parts


@pytest.mark.parametrize(
    ("first", "step", "unit"),
    [
        (NOW_S, 1, "s"),
        (NOW_S + 0.25, 0.01, "s"),
        (NOW_S * 10**3, 10, "ms"),
        (NOW_S * 10**6, 10_000, "us"),
        (NOW_S * 10**9, 10_000_000, "ns"),
        (NOW_S * 10**7, 100_000, "100ns"),
        (WINDOWS_S * 10**7, 100_000, "100ns"),
        (DOTNET_S * 10**7, 100_000, "100ns"),
        (0, 0.01, "s"),
        (0, 1, "s"),
        (5000, 20, "ms"),
        (5000, 33, "ms"),
        (123_456, 4000, "us"),
        (123_456, 10_000, "us"),
        (123_456, 5_000_000, "ns"),
    ],
)
def test_a_unit_is_found_by_the_numbers_of_a_clock(first, step, unit):
    found, why = find_time_unit(first + step * np.arange(50))
    assert found == unit
    assert bool(why) == (unit != "s" or first > 1e9)


def test_two_rows_say_nothing_of_the_unit():
    assert find_time_unit([0, 500]) == ("s", "")
    assert find_time_unit([]) == ("s", "")
    assert find_time_unit([np.nan]) == ("s", "")


@pytest.mark.parametrize("unit", ["s", "ms", "us", "100ns", "ns"])
def test_every_day_from_2000_to_2100_has_one_unit_alone(unit):
    ticks = 10**9 // NANOSECONDS_PER[unit]
    for day in range(946_684_800, 4_102_444_800, 86_400 * 30):
        assert find_time_unit([day * ticks, day * ticks + 1])[0] == unit


def test_what_is_found_is_noted_and_what_is_stated_is_not():
    clock = NOW_S * 10**6 + 4000 * np.arange(9)
    unit, notes, found = state_time_unit(None, "time", clock, "log.csv")
    assert (unit, found) == ("us", True)
    assert "microseconds since 1970; state it with time_unit" in notes[0]
    assert state_time_unit("us", "time", clock, "log.csv") == ("us", (), False)
    assert state_time_unit(None, "time_us", clock, "log.csv") == ("us", (), False)


def test_a_unit_that_is_given_overrides_the_name_with_a_note():
    unit, notes, found = state_time_unit("us", "time_ms", [0], "log.csv")
    assert (unit, found) == ("us", False)
    assert notes == ("times are read in us, as time_unit says, not as 'time_ms' does",)
    with pytest.raises(InputError, match=r"log.csv: unknown time unit 'y', expected one of: 100ns"):
        state_time_unit("y", "time", [0], "log.csv")


def test_seconds_are_noted_where_whole_numbers_name_no_unit():
    for step in (1, 10):
        unit, notes, found = state_time_unit(None, "time", step * np.arange(9), "log.csv")
        assert (unit, found) == ("s", True)
        assert f"a row every {step} s" in notes[0]
        assert f"if they count ms ({1000 // step} Hz)" in notes[0]
    assert state_time_unit(None, "time", 0.01 * np.arange(9), "log.csv") == ("s", (), True)


@given(st.lists(st.integers(-(2**62) // 100, 2**62 // 100), min_size=1), st.sampled_from(
    ["us", "100ns", "ns"]))  # fmt: skip
def test_integers_keep_every_bit(ticks, unit):
    factor = NANOSECONDS_PER[unit]
    if max(abs(t) for t in ticks) * factor >= 2**62:
        ticks = [t // factor for t in ticks]
    stamps, zero = to_nanoseconds(np.array(ticks), unit)
    assert stamps.tolist() == [t * factor for t in ticks]
    assert zero == 0


@pytest.mark.parametrize("start", [WINDOWS_S * 10**7, DOTNET_S * 10**7])
def test_ticks_since_long_ago_count_from_their_first_row(start):
    stamps, zero = to_nanoseconds(start + np.array([0, 1, 100_000]), "100ns")
    assert stamps.tolist() == [0, 100, 10_000_000]
    assert zero == start


@pytest.mark.parametrize("start", [float(WINDOWS_S * 10**7), float(DOTNET_S * 10**7)])
def test_ticks_in_floats_count_from_their_first_row_where_they_must(start):
    stamps, zero = to_nanoseconds(start + np.array([0.0, 1024.0, 102_400.0]), "100ns")
    assert stamps.tolist() == [0, 102_400, 10_240_000]
    assert zero == start


def test_unsigned_clocks_are_fine_up_to_their_end():
    stamps, zero = to_nanoseconds(np.array([2**64 - 3, 2**64 - 1], dtype=np.uint64), "ns")
    assert (stamps.tolist(), zero) == ([0, 2], 2**64 - 3)


@given(st.lists(st.integers(0, 10**12), min_size=1, max_size=20))
def test_seconds_in_floats_are_the_nearest_nanosecond(ticks):
    stamps, _ = to_nanoseconds(np.array(ticks) / 1e9, "s")
    assert stamps.tolist() == ticks


def test_seconds_since_1970_in_floats_are_as_near_as_a_float_is():
    clock = NOW_S + 0.005 * np.arange(1000)
    stamps, _ = to_nanoseconds(clock, "s")
    exact = NOW_S * 10**9 + 5_000_000 * np.arange(1000)
    assert np.abs(stamps - exact).max() <= np.spacing(float(NOW_S)) * 1e9 / 2 + 1


@pytest.mark.parametrize(
    ("clock", "unit", "message"),
    [
        ([0.0, np.nan], "s", "times must be finite seconds, got nan at row 1"),
        ([0, 2**62], "s", "span more than 292 years"),
        ([0.0, 1e300], "s", "span more than 146 years"),
    ],
)
def test_times_that_no_clock_shows_are_refused(clock, unit, message):
    with pytest.raises(FileFormatError, match=message):
        to_nanoseconds(np.array(clock), unit)


@pytest.mark.parametrize(
    ("start", "meaning"), [(45_000.25, "days since 1900"), (739_000.5, "days since the year 0")]
)
@pytest.mark.parametrize("hz", [1.0, 10.0, 100.0])
def test_days_as_spreadsheets_count_them_are_found(start, meaning, hz, tmp_path):
    """In float64, days since 1900 are exact to 1 us, days since the year 0 to 10 us."""
    seconds = np.arange(300) / hz
    unit, why = find_time_unit(start + seconds / 86_400)
    assert unit == "d"
    assert meaning in why
    rows = [f"{start + t / 86_400:.12f},{np.sin(t):.6f}" for t in seconds]
    (tmp_path / "a.csv").write_text("\n".join(["time,x", *rows]) + "\n")
    assert np.abs(read(tmp_path / "a.csv")[0].times - seconds).max() < 2e-5


def test_seconds_in_the_range_of_days_are_seconds():
    for step in (1e-3, 0.01, 1.0):
        assert find_time_unit(45_000 + step * np.arange(50)) == ("s", "")
    assert find_time_unit(1e-6 * np.arange(50)) == ("s", "")
