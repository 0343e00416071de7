"""Logs as programs write them: each kind is read with the right values, or asks in one line."""

from __future__ import annotations

import bz2
import gzip
import json
import lzma
import struct
from datetime import datetime
from decimal import Decimal
from pathlib import Path
from typing import Any

import fuzz
import h5py
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from corpus import logs, tables

from offbeat.cli import app
from offbeat.cli.app import main
from offbeat.cli.common import read_log
from offbeat.data.readers import read
from offbeat.data.trajectory import Trajectory
from offbeat.errors import FileFormatError, InputError, OffbeatError

WRITTEN = [(name, form) for name, kind in tables.KINDS.items() for form in kind.formats]


def notes(dataset):
    return "\n".join(dataset.meta["cleaning"]["notes"])


@pytest.mark.parametrize(("name", "form"), WRITTEN)
def test_a_table_has_the_times_and_values_that_it_means(name, form, tmp_path):
    kind = tables.KINDS[name]
    path = tables.FORMATS[form](tmp_path / "log", kind.columns)
    (trajectory,) = dataset = read(path, **kind.options)
    assert dataset.names == tuple(kind.values)
    expected = tables.TIMES if kind.times is None else kind.times
    assert trajectory.times == pytest.approx(expected, abs=2e-7 if kind.times is None else 1e-9)
    for channel, values in kind.values.items():
        column = trajectory.values[:, dataset.names.index(channel)]
        assert column == pytest.approx(np.asarray(values, dtype=float), abs=1e-9, nan_ok=True)
    assert dict(zip(dataset.names, dataset.units, strict=True)) == {
        n: kind.units.get(n, "") for n in dataset.names
    }
    assert kind.note in notes(dataset)


@pytest.mark.parametrize(
    "columns",
    [
        {"time": pa.array(tables.STEP_NS // 1000 * np.arange(tables.ROWS), pa.time64("us"))},
        {"time": pa.array(20 * np.arange(tables.ROWS, dtype=np.int32), pa.time32("ms"))},
        {"time": pa.array(tables.NS, pa.timestamp("ns"))},
        {"time": pa.array(tables.NS - tables.NS[0], pa.duration("ns"))},
        {
            "date": pa.array([20_000] * tables.ROWS, pa.date32()),
            "time": pa.array(tables.STEP_NS * np.arange(tables.ROWS), pa.time64("ns")),
        },
    ],
    ids=["time64", "time32", "timestamp", "duration", "date32 and time64"],
)
def test_times_of_parquet_know_their_unit(columns, tmp_path):
    pq.write_table(pa.table({**columns, **tables.XY}), tmp_path / "log.parquet")
    dataset = read(tmp_path / "log.parquet")
    assert dataset.names == ("x", "y")
    assert dataset[0].times == pytest.approx(tables.TIMES, abs=1e-12)


def test_dates_of_parquet_are_days(tmp_path):
    columns = {"date": pa.array([20_000, 20_001, 20_003], pa.date32()), "x": [1.0, 2.0, 3.0]}
    pq.write_table(pa.table(columns), tmp_path / "log.parquet")
    dataset = read(tmp_path / "log.parquet", max_gap_s=None, clock_jumps="join")
    assert dataset[0].times.tolist() == [0.0, 86_400.0, 3 * 86_400.0]


@pytest.mark.parametrize("name", tables.TEXTS)
def test_a_text_file_is_read_in_the_form_it_has(name, tmp_path):
    content, options, note = tables.TEXTS[name]
    path = tmp_path / "log.csv"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    (trajectory,) = dataset = read(path, **options)
    assert dataset.names == ("x", "y")
    assert trajectory.times == pytest.approx(tables.TIMES, abs=1e-12)
    assert trajectory.values.tolist() == np.column_stack([tables.X, tables.Y]).tolist()
    assert note in notes(dataset)
    assert dataset.units == (("m", "deg") if "unit" in name else ("", ""))


@pytest.mark.parametrize(("suffix", "pack"), [("gz", gzip), ("bz2", bz2), ("xz", lzma)])
def test_a_compressed_text_has_a_suffix_more(suffix, pack, tmp_path):
    path = tmp_path / f"log.csv.{suffix}"
    packed = pack.compress(("time,x,y\n" + tables.BODY).encode())
    path.write_bytes(packed)
    dataset = read(path)
    assert dataset[0].values[:, 0].tolist() == tables.X.tolist()
    assert read(tmp_path).fingerprint() == dataset.fingerprint()
    path.write_bytes(packed[: len(packed) - 12])
    if suffix == "gz":  # the others hold a single block
        rest = read(path)
        assert 0 < rest[0].rows <= tables.ROWS
        assert "compressed data end early" in notes(rest)


@pytest.mark.parametrize("name", ["a.db3.zstd", "a.bag.gz", "a.zip", "a.parquet.zst", "a.tar"])
def test_another_compressed_file_is_not_called_damaged(name, tmp_path):
    (tmp_path / name).write_bytes(b"\x28\xb5\x2f\xfd")
    with pytest.raises(FileFormatError, match=r"is compressed or an archive.*unpack it with: "):
        read(tmp_path / name)


def test_logs_that_are_joined_are_an_episode_each(tmp_path):
    columns = {"time": 10 * tables.TIMES, **tables.XY}
    text = tables.write_csv(tmp_path / "log", columns).read_text()
    (tmp_path / "log.csv").write_text(3 * text)
    dataset = read(tmp_path / "log.csv")
    assert [trajectory.values[:, 0].tolist() for trajectory in dataset] == 3 * [tables.X.tolist()]
    assert "the header stands again in the middle" in notes(dataset)
    (tmp_path / "log.csv").write_text(2 * text + "later,1,2\n")
    with pytest.raises(FileFormatError, match=f"has 'later' in line {2 * tables.ROWS + 3}"):
        read(tmp_path / "log.csv")


@pytest.mark.parametrize("blank", [" ", "'", "\u2019", "\u00a0", "\u202f"])
def test_thousands_may_be_apart_and_a_minus_that_of_mathematics(blank, tmp_path):
    rows = [f"{i};\u22121{blank}{i:03d}{blank}500.25;{i}" for i in range(40)]
    (tmp_path / "log.csv").write_text("time_ms;x;y\n" + "\n".join(rows) + "\n", encoding="utf-8")
    column = read(tmp_path / "log.csv")[0].values[:, 0]
    assert column.tolist() == [-(1_000_500.25 + 1000 * i) for i in range(40)]


@pytest.mark.parametrize("text", tables.MISSING_TEXTS)
def test_a_marker_of_a_missing_value_is_one_wherever_it_is(text, tmp_path):
    rows = [f"{t:.2f},{x},1" for t, x in zip(tables.TIMES, tables.X, strict=True)]
    for row in (0, 1, tables.ROWS - 1):
        marked = [*rows[:row], f"{tables.TIMES[row]:.2f},{text},1", *rows[row + 1 :]]
        path = tmp_path / "log.csv"
        path.write_text("time,x,y\n" + "\n".join(marked) + "\n")
        dataset = read(path)
        assert np.flatnonzero(np.isnan(dataset[0].values[:, 0])).tolist() == [row]


@pytest.mark.parametrize("name", tables.GROUPS)
def test_a_header_in_several_lines_names_every_channel(name, tmp_path):
    content, options, names, units = tables.GROUPS[name]
    (tmp_path / "log.csv").write_text(content)
    (trajectory,) = dataset = read(tmp_path / "log.csv", **options)
    assert (dataset.names, dataset.units) == (names, units)
    assert trajectory.times == pytest.approx(tables.TIMES, abs=1e-12)
    column = next(i for i, n in enumerate(names) if n.casefold().endswith(".x"))
    assert trajectory.values[:, column].tolist() == tables.X.tolist()
    assert "completed by the lines above it" in notes(dataset)


@pytest.mark.parametrize("words", [("yes", "no"), ("ON", "Off"), ("0x1", "0X0")])
def test_switches_and_hexadecimal_numbers_are_numbers(words, tmp_path):
    rows = [f"{i},{words[i % 2]}" for i in range(40)]
    (tmp_path / "log.csv").write_text("time_ms,c\n" + "\n".join(rows) + "\n")
    dataset = read(tmp_path / "log.csv")
    assert dataset[0].values[:, 0].tolist() == [float(i % 2 == 0) for i in range(40)]
    (tmp_path / "log.csv").write_text("time_ms,c\n" + "\n".join([*rows, "40,auto", "41,7"]) + "\n")
    if words[0] == "0x1":
        with pytest.raises(FileFormatError, match="has 'auto' in line 42"):
            read(tmp_path / "log.csv")
    else:  # a word that is no switch makes it a column of text
        with pytest.raises(FileFormatError, match="no column of numbers besides the time"):
            read(tmp_path / "log.csv")


@pytest.mark.parametrize("scale", [3, 9])
def test_times_of_parquet_may_be_decimals(scale, tmp_path):
    stamps = [Decimal(1_764_000_000) + Decimal(i) / 1000 for i in range(tables.ROWS)]
    columns = {"time": pa.array(stamps, pa.decimal128(19, scale)), **tables.XY}
    pq.write_table(pa.table(columns), tmp_path / "log.parquet")
    dataset = read(tmp_path / "log.parquet")
    assert dataset[0].times.tolist() == [i / 1000 for i in range(tables.ROWS)]
    assert dataset.meta["time_unit"] == "s"


def test_an_index_of_pandas_that_increases_is_the_time_where_no_column_is(tmp_path):
    columns = {"x": tables.X, "__index_level_0__": tables.TIMES}
    pq.write_table(pa.table(columns), tmp_path / "log.parquet")
    dataset = read(tmp_path / "log.parquet")
    assert dataset.names == ("x",)
    assert dataset[0].times == pytest.approx(tables.TIMES)
    assert "index of pandas is taken for the time" in notes(dataset)


def test_times_of_numpy_may_be_a_column(tmp_path):
    matrix = np.column_stack([tables.X, tables.Y])
    np.savez(tmp_path / "log.npz", time=tables.TIMES[:, None], q=matrix)
    dataset = read(tmp_path / "log.npz")
    assert dataset[0].times == pytest.approx(tables.TIMES)
    assert dataset[0].values.tolist() == matrix.tolist()


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("time,x\n" + f"0,{'1' * 30_000}x\n" * 400, "no column of numbers"),
        ("time,x\n" + f"{'1' * 30_000}:0,1\n" * 400, "in line 2, column 'time'"),
        ("time," + ",".join(["x"] * 60_000) + "\n" + "0" + ",1" * 60_000 + "\n", "'x' twice"),
        (
            "time," + ",".join(map(str, range(60_000))) + "\n0" + ",1" * 60_000 + "\n",
            "60001 columns",
        ),
        ("time,x\n0,1\n" + "\n" * 3_000_000 + "1,2\n", "empty lines in a row"),
    ],
    ids=["digits", "digits of a time", "equal names", "columns", "empty lines"],
)
def test_a_hostile_table_is_refused_in_linear_time(content, message, tmp_path):
    (tmp_path / "log.csv").write_text(content)
    with pytest.raises(FileFormatError, match=message), fuzz.time_limit():
        read(tmp_path / "log.csv")


def test_a_long_line_of_poses_is_refused_before_it_is_taken_apart(tmp_path):
    (tmp_path / "log.tum").write_text("1 2 3 4 5 6 7 8 " * 100_000)
    with pytest.raises(FileFormatError, match=r"in line 1, expected eight numbers"):
        read(tmp_path / "log.tum")
    (tmp_path / "log.tum").write_text("#" * 20_000 + "\n0 1 2 3 0 0 0 1\n")
    with pytest.raises(FileFormatError, match="a line of more than 10000 characters"):
        read(tmp_path / "log.tum")


@pytest.mark.parametrize("empty", [3, 1200])
def test_booleans_are_numbers_wherever_they_begin(empty, tmp_path):
    rows = [f"{i},{'' if i < empty else ('True', 'False')[i % 2]}" for i in range(empty + 50)]
    (tmp_path / "log.csv").write_text("time_ms,contact\n" + "\n".join(rows) + "\n")
    column = read(tmp_path / "log.csv")[0].values[:, 0]
    assert np.isnan(column[:empty]).all()
    assert column[empty:].tolist() == [float(i % 2 == 0) for i in range(empty, empty + 50)]


@pytest.mark.parametrize(
    ("fields", "options", "expected"),
    [
        (('"2,590"', '"3,100.5"'), {}, [2590, 3100.5]),
        (("2,590", "3,100"), {"delimiter": ";", "decimal": ","}, [2.59, 3.1]),
        (("2,590", "3,100"), {"delimiter": ";", "decimal": "."}, [2590, 3100]),
        (("2,590", "3,1"), {"delimiter": ";"}, [2.59, 3.1]),
        (("2.590,5", "3.100,25"), {"delimiter": ";"}, [2590.5, 3100.25]),
    ],
)
def test_a_comma_of_thousands_is_no_decimal_point(fields, options, expected, tmp_path):
    sign = options.get("delimiter", ",")
    text = f"time{sign}x\n0{sign}{fields[0]}\n1{sign}{fields[1]}\n"
    (tmp_path / "log.csv").write_text(text)
    assert read(tmp_path / "log.csv", **options)[0].values[:, 0].tolist() == expected


def test_decimal_commas_stand_beside_columns_of_words(tmp_path):
    rows = [f"0,{i:02d};{i}.500,25;{'yes' if i % 2 else 'no'};AUTO\n" for i in range(1, 40)]
    (tmp_path / "log.csv").write_text("Zeit;x;ok;mode\n" + "".join(rows))
    dataset = read(tmp_path / "log.csv")
    assert dataset.names == ("x", "ok")
    assert dataset[0].times == pytest.approx(np.arange(39) / 100)
    assert dataset[0].values[:2].tolist() == [[1500.25, 1.0], [2500.25, 0.0]]


def test_a_comma_that_may_be_either_is_asked_for_wherever_it_comes(tmp_path):
    rows = "".join(f"{i};{i}\n" for i in range(1500))
    (tmp_path / "log.csv").write_text("time;x\n" + rows + "1500;2,590\n")
    with pytest.raises(FileFormatError, match=r"has '2,590' in line 1502.*decimal=','"):
        read(tmp_path / "log.csv")
    assert read(tmp_path / "log.csv", decimal=",")[0].values[-1, 0] == 2.59
    assert read(tmp_path / "log.csv", decimal=".")[0].values[-1, 0] == 2590


@pytest.mark.parametrize("name", ["trial", "rollout", "episode_id"])
def test_a_trial_is_a_trajectory(name, tmp_path):
    columns = {name: np.repeat([4, 5], tables.ROWS), "time": np.tile(tables.TIMES, 2)}
    path = tables.write_csv(tmp_path / "log", {**columns, "x": np.tile(tables.X, 2)})
    dataset = read(path)
    assert dataset.meta["labels"] == ["4", "5"]
    assert [t.values[:, 0].tolist() for t in dataset] == 2 * [tables.X.tolist()]


def test_a_comma_that_may_be_either_is_asked_for(tmp_path):
    (tmp_path / "log.csv").write_text("time;x\n0;2,590\n1;3,100\n")
    with pytest.raises(InputError, match=r"such as '2,590'.*decimal=',' or decimal='.'"):
        read(tmp_path / "log.csv")
    (tmp_path / "log.csv").write_text('time,x\n0,"0,590"\n1,"2,590"\n')
    with pytest.raises(FileFormatError, match=r"has '0,590' in line 2.*decimal=','"):
        read(tmp_path / "log.csv")


@pytest.mark.parametrize("name", tables.REFUSED)
@pytest.mark.parametrize("form", tables.FORMATS)
def test_a_table_that_needs_a_choice_asks_for_it_in_one_line(name, form, tmp_path):
    columns, options, message = tables.REFUSED[name]
    path = tables.FORMATS[form](tmp_path / "log", columns)
    with pytest.raises(OffbeatError, match=message) as error:
        read(path, **options)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("name", ["index", "id", "I"])
def test_a_column_that_counts_is_no_instance(name, tmp_path):
    times = tables.TIMES.copy()
    times[5] = times[4]
    for numbers in (np.arange(tables.ROWS), np.arange(tables.ROWS) // 20):
        columns = {"time": times, name: numbers, "x": tables.X}
        assert read(tables.write_csv(tmp_path / "log", columns)).names == (name, "x")


def test_rows_that_would_be_lost_are_merged_when_asked(tmp_path):
    path = tables.write_csv(tmp_path / "log", {"time": [0, 0, 1, 1, 2, 2], "x": range(6)})
    for choice, expected in (("last", [1, 3, 5]), ("first", [0, 2, 4]), ("mean", [0.5, 2.5, 4.5])):
        assert read(path, duplicates=choice)[0].values[:, 0].tolist() == expected


@pytest.mark.parametrize("header", ["x", "x,y"])
def test_without_times_a_row_without_a_value_is_a_row(header, tmp_path):
    rest = "," * header.count(",")
    rows = [f"{i}{rest}" if i % 5 else rest for i in range(40)]
    (tmp_path / "log.csv").write_text("\n".join([header, *rows, ""]))
    (trajectory,) = read(tmp_path / "log.csv", rate_hz=10)
    column = trajectory.values[:, 0]
    assert column.tolist() == pytest.approx(
        [i if i % 5 else np.nan for i in range(40)], nan_ok=True
    )
    assert trajectory.times == pytest.approx(np.arange(40) / 10)


@pytest.mark.parametrize("step", [3600, 86_400])
def test_hours_since_1970_are_in_seconds(step, tmp_path):
    path = tables.write_csv(
        tmp_path / "log", {"time": 1_764_000_000 + step * np.arange(30), "x": range(30)}
    )
    dataset = read(path, max_gap_s=None, clock_jumps="join")
    assert dataset.meta["time_unit"] == "s"


def test_a_minimum_is_no_part_of_a_time(tmp_path):
    columns = {"seconds": tables.TIMES, "min": tables.X, "max": tables.Y}
    assert read(tables.write_csv(tmp_path / "log", columns)).names == ("min", "max")


def test_equal_rows_of_one_stamp_lose_nothing(tmp_path):
    twice = {"time": np.repeat(tables.TIMES, 2), "x": np.repeat(tables.X, 2)}
    assert read(tables.write_csv(tmp_path / "log", twice))[0].values[:, 0].tolist() == (
        tables.X.tolist()
    )
    parts = {"time": twice["time"], "x": twice["x"].copy(), "y": np.repeat(tables.Y, 2)}
    parts["x"][::2], parts["y"][1::2] = np.nan, np.nan
    dataset = read(tables.write_csv(tmp_path / "log", parts))
    assert dataset[0].values.tolist() == np.column_stack([tables.X, tables.Y]).tolist()


def test_a_clock_that_is_reset_before_its_end_does_not_wrap(tmp_path):
    for last in (2**16 - 2000, 2**15):
        stamps = [*(last - 20 * np.arange(40)[::-1]), *(20 * np.arange(40))]
        path = tables.write_csv(tmp_path / "log", {"time_ms": stamps, "x": range(80)})
        dataset = read(path)
        assert [trajectory.rows for trajectory in dataset] == [40, 40]
        assert "wraps" not in notes(dataset)


class TestAFolder:
    def test_of_logs_may_hold_files_about_them(self, tmp_path):
        self.write(tmp_path, ["a"], [{"time": tables.TIMES, **tables.XY}])
        alone = read(tmp_path)
        assert "files are read" not in notes(alone)
        (tmp_path / "README.txt").write_text("Walks of a robot, see the paper.\n")
        (tmp_path / "License.txt").write_text("MIT")
        (tmp_path / "meta.json").write_text("{}")
        assert read(tmp_path).fingerprint() == alone.fingerprint()

    def write(self, tmp_path, names, columns):
        for i, name in enumerate(names):
            own = {n: np.asarray(v) + i if n != "time" else v for n, v in columns[i].items()}
            tables.write_csv(tmp_path / name, own)
        return tmp_path

    def test_of_files_with_the_same_channels_holds_an_episode_in_each(self, tmp_path):
        names = [f"ep{i}" for i in (0, 1, 2, 10)]
        folder = self.write(tmp_path, names, [{"time": tables.TIMES, **tables.XY}] * 4)
        for path in (folder, [folder / f"{name}.csv" for name in names]):
            dataset = read(path)
            assert dataset.meta["labels"] == names  # 2 before 10
            for i, trajectory in enumerate(dataset):
                assert trajectory.values[:, 0] == pytest.approx(tables.X + i)
        assert "4 files are read as episodes" in notes(dataset)

    def test_of_files_with_different_channels_is_merged_by_their_times(self, tmp_path):
        late = tables.TIMES + 0.005
        columns = [{"time": tables.TIMES, "gyro": tables.X}, {"time": late, "speed": tables.Y}]
        folder = self.write(tmp_path, ["imu", "odom"], columns)
        (trajectory,) = dataset = read(folder, start="clock")
        assert dataset.names == ("imu.gyro", "odom.speed")
        assert trajectory.times == pytest.approx(np.sort([*tables.TIMES, *late]))
        assert trajectory.values[::2, 0] == pytest.approx(tables.X)
        assert trajectory.values[1::2, 1] == pytest.approx(tables.Y + 1)
        assert np.isnan(trajectory.values[1::2, 0]).all()
        assert len(read(folder, files="episodes")) == 2

    def test_of_sensors_of_one_time_is_merged_although_they_share_channels(self, tmp_path):
        # As of a phone: x, y and z of each sensor, on a clock since 1970.
        start = 1_741_767_242_000_000_000
        stamps = start + (1e9 * tables.TIMES).astype(np.int64)
        axes = [{"time": stamps + i, **tables.XY} for i in range(2)]
        folder = self.write(tmp_path, ["Gyroscope", "Accelerometer"], axes)
        (trajectory,) = dataset = read(folder)
        assert dataset.names == ("Accelerometer.x", "Accelerometer.y", "Gyroscope.x", "Gyroscope.y")
        assert trajectory.values[::2, 2] == pytest.approx(tables.X)
        assert trajectory.values[1::2, 0] == pytest.approx(tables.X + 1)

    @pytest.mark.parametrize(
        ("names", "shift"),
        [
            (["robot_1", "robot_2"], 0),  # names that a number tells from each other
            (["left", "right"], 3600 * 10**9),  # one after the other
            (["left", "right"], -1_741_767_242 * 10**9),  # each counts from its own start
        ],
    )
    def test_of_one_kind_of_file_is_read_as_episodes(self, tmp_path, names, shift):
        start = 1_741_767_242_000_000_000 + min(shift, 0)
        stamps = start + (1e9 * tables.TIMES).astype(np.int64)
        columns = [{"time": stamps + i * max(shift, 0), **tables.XY} for i in range(2)]
        assert len(read(self.write(tmp_path, names, columns))) == 2

    def test_leaves_out_tables_without_rows_or_times_and_says_so(self, tmp_path):
        columns = [{"time": tables.TIMES, **tables.XY}] * 2
        folder = self.write(tmp_path, ["a1", "a2"], columns)
        (folder / "Annotation.csv").write_text("time,text\n")
        about = "version,device,recording time\n3,phone,2025-03-12_08-14-02\n"
        (folder / "Metadata.csv").write_text(about)
        dataset = read(folder)
        assert dataset.meta["labels"] == ["a1", "a2"]
        assert "left out: Annotation.csv, Metadata.csv" in notes(dataset)
        with pytest.raises(FileFormatError, match="a header and no rows"):  # asked for by name
            read([folder / "a1.csv", folder / "Annotation.csv"])
        (tmp_path / "b").mkdir()
        (tmp_path / "b" / "a.csv").write_text("version,device\n3,phone\n")
        with pytest.raises(FileFormatError, match="no column of times"):
            read(tmp_path / "b")

    def test_of_several_formats_asks_for_one(self, tmp_path):
        columns = {"time": tables.TIMES, **tables.XY}
        tables.write_csv(tmp_path / "a", columns)
        tables.write_npz(tmp_path / "b", columns)
        with pytest.raises(FileFormatError, match="several formats, csv, npz; name one"):
            read(tmp_path)
        assert len(read(tmp_path, format="csv")) == 1


@pytest.mark.parametrize("form", logs.BAGS)
class TestABag:
    def test_with_a_list_of_messages_has_a_channel_per_element_that_is_chosen(self, form, tmp_path):
        path = logs.motor_states(tmp_path, form)
        dataset = read(path, fields=["motor_state"])
        assert dataset.names == tuple(
            f"motor_state[{i}].{n}" for i in range(3) for n in ("mode", "q", "dq")
        )
        for i in range(3):
            column = dataset[0].values[:, dataset.names.index(f"motor_state[{i}].q")]
            assert column == pytest.approx(logs.X + i, abs=1e-6)
        assert read(path, fields=["motor_state[1].q"]).names == ("motor_state[1].q",)
        # Its type fixes its length, so all of it is read by default.
        assert read(path).names == (*dataset.names, "foot_force[0]", "foot_force[1]")

    def test_with_a_list_of_named_messages_goes_by_their_names(self, form, tmp_path):
        path = logs.named_motors(tmp_path, form)
        dataset = read(path, fields=["joints"])
        assert sorted(dataset.names) == ["joints.hip.q", "joints.knee.q"]
        for k, name in enumerate(("joints.hip.q", "joints.knee.q")):
            column = dataset[0].values[:, dataset.names.index(name)]
            assert column == pytest.approx(logs.X + k)
        assert read(path, fields=["joints[0].q"]).names == ("joints[0].q",)
        assert read(path).names == ("v",)
        assert "joints (a list of messages, unless chosen" in notes(read(path))

    def test_whose_frame_changes_all_the_time_is_one_signal_in_the_order_of_receipt(
        self, form, tmp_path
    ):
        dataset = read(logs.poses_in_many_frames(tmp_path, form))
        (trajectory,) = dataset
        assert trajectory.values[:, 0].tolist() == list(range(400))
        assert dataset.meta["cleaning"]["order"]["late"] == 0
        assert "the frame changes between 200" in notes(dataset)

    def test_with_a_frame_of_two_parents_has_a_signal_for_each(self, form, tmp_path):
        (trajectory,) = dataset = read(logs.transforms(tmp_path, form))
        for start, parent, ahead in ((0, "odom", 0.0), (1, "map", 100.0)):
            at = dataset.names.index(f"/tf/{parent}/base_link.transform.translation.x")
            column = trajectory.values[:, at]
            assert column[start::2] == pytest.approx(logs.X[start::2] + ahead)
            assert np.isnan(column[1 - start :: 2]).all()
        assert "/tf/base_link is given in several frames (map, odom)" in notes(dataset)

    def test_with_one_parent_names_no_frame(self, form, tmp_path):
        dataset = read(logs.transforms(tmp_path, form, ("odom", "odom")))
        assert dataset.names[0] == "transform.translation.x"

    def test_whose_frame_changes_has_a_signal_for_each(self, form, tmp_path):
        (trajectory,) = dataset = read(logs.poses_in_two_frames(tmp_path, form))
        odom, world = (
            trajectory.values[:, dataset.names.index(f"/pose/{frame}.pose.position.x")]
            for frame in ("odom", "map")
        )
        assert odom[:20] == pytest.approx(logs.X[:20])
        assert world[20:] == pytest.approx(logs.X[20:])
        assert np.isnan(odom[20:]).all()
        assert np.isnan(world[:20]).all()

    def test_whose_header_clocks_never_meet_takes_the_times_of_receipt(self, form, tmp_path):
        (trajectory,) = dataset = read(logs.clocks_apart(tmp_path, form))
        assert trajectory.times == pytest.approx(logs.TICKS / 1e9)
        assert trajectory.known.all()
        assert "the headers of /uptime and of /imu have no time in common" in notes(dataset)

    def test_whose_header_stamps_stand_still_takes_the_times_of_receipt(self, form, tmp_path):
        (trajectory,) = dataset = read(logs.clocks_apart(tmp_path, form, still=True))
        assert trajectory.rows == logs.ROWS
        assert trajectory.times == pytest.approx(logs.TICKS / 1e9)
        assert "header stamps repeat, and times of receipt are taken, in /uptime" in notes(dataset)

    def test_with_a_topic_that_cannot_be_read_has_the_others(self, form, tmp_path):
        path = logs.with_a_foreign_topic(tmp_path, form)
        for options in ({}, {"topics": ["/x"]}):
            assert read(path, **options)[0].values[:, 0] == pytest.approx(logs.X)
        assert "/wide is left out" in notes(read(path))
        with pytest.raises(FileFormatError, match=r"topic /wide.*wstring"):
            read(path, topics=["/wide"])

    def test_of_a_folder_without_its_metadata_is_read(self, form, tmp_path):
        path = logs.poses_in_two_frames(tmp_path, form)
        whole = read(path)
        if form != "bag":
            (path / "metadata.yaml").unlink()
            assert read(path).fingerprint() == whole.fingerprint()


class TestMcap:
    @pytest.mark.parametrize("profile", ["", "ros1", "ros2", "px4"])
    def test_of_any_profile_has_the_topics_of_ros(self, profile, tmp_path):
        path = logs.mcap_of_ros1(tmp_path / "log.mcap", profile)
        for options in ({}, {"topics": ["/x"]}):
            dataset = read(path, **options)
            assert dataset.names == ("data",)
            assert dataset[0].values[:, 0].tolist() == logs.X.tolist()
            assert dataset[0].times == pytest.approx(logs.TICKS / 1e9)
            for topic in ("/json (json", "/bytes (protobuf"):
                assert topic in notes(dataset)
        with pytest.raises(FileFormatError, match="only the messages of ROS can be read"):
            read(path, topics=["/json"])

    @pytest.mark.parametrize("cut", [1, 20, 45, 400, 4000])
    def test_that_is_cut_off_anywhere_is_read_up_to_there(self, cut, tmp_path):
        path = logs.mcap_of_ros1(tmp_path / "log.mcap", "ros1")
        whole = path.read_bytes()
        path.write_bytes(whole[:-cut])
        dataset = read(path)
        rows = dataset[0].rows
        assert rows == logs.ROWS or cut > 3000
        assert dataset[0].values[:, 0].tolist() == logs.X[:rows].tolist()
        assert "log.mcap is cut off" in notes(dataset)

    def test_of_a_chunk_that_would_fill_the_memory_is_refused(self, tmp_path):
        path = tmp_path / "log.mcap"
        chunk = struct.pack("<QQQI", 0, 0, 2**40, 0) + struct.pack("<I", 0) + struct.pack("<Q", 0)
        head = struct.pack("<BQ", 1, 8) + bytes(8)
        end = struct.pack("<BQ", 2, 20) + bytes(20)
        body = struct.pack("<BQ", 6, len(chunk)) + chunk
        path.write_bytes(b"\x89MCAP0\r\n" + head + body + end + b"\x89MCAP0\r\n")
        with pytest.raises(FileFormatError, match="a chunk has 1099511627776 bytes"):
            read(path)


def test_clocks_of_a_table_that_never_meet_are_noted(tmp_path):
    times = tables.TIMES.tolist()
    long = {
        "time": [*times, *(1_764_000_000 + t for t in times)],
        "channel": ["gyro"] * tables.ROWS + ["gps"] * tables.ROWS,
        "value": [*tables.X, *tables.Y],
    }
    for write in (tables.write_csv, tables.write_parquet):
        dataset = read(write(tmp_path / "log", long), time_unit="s")
        assert "the clocks of gyro and of gps have no time in common" in notes(dataset)
        assert [trajectory.rows for trajectory in dataset] == [tables.ROWS, tables.ROWS]


class TestHdf5:
    @pytest.mark.parametrize("name", ["timestamps", "obs/timestamps", "obs/time", "stamp"])
    def test_has_the_times_that_stand_beside_its_observations(self, name, tmp_path):
        path = logs.robomimic(tmp_path / "log.hdf5", times=name)
        options = [{}, {"time_column": name.removeprefix("obs/")}]
        for given in options:
            dataset = read(path, **given)
            assert dataset[0].times == pytest.approx(logs.TICKS / 1e9)
            assert dataset.names == ("eef[0]", "eef[1]", "action[0]", "action[1]")
        with pytest.raises(
            InputError, match="unknown time_column 'when', expected one of: actions"
        ):
            read(path, time_column="when")

    def test_counts_in_the_unit_that_its_times_have_as_an_attribute(self, tmp_path):
        path = logs.robomimic(tmp_path / "log.hdf5", times="time")
        with h5py.File(path, "a") as file:
            for demo in file["data"].values():
                demo["time"].attrs["units"] = "ms"
        assert read(path)[0].times == pytest.approx(logs.TICKS / 1e12)

    def test_counts_on_where_its_counter_wraps(self, tmp_path):
        path = logs.robomimic(tmp_path / "log.hdf5", times="time_us")
        with h5py.File(path, "a") as file:
            for demo in file["data"].values():
                stamps = (2**32 - 300_000 + logs.TICKS // 1000) % 2**32
                del demo["time_us"]
                demo["time_us"] = stamps.astype(np.uint32)
        dataset = read(path)
        assert dataset[0].times == pytest.approx(logs.TICKS / 1e9)
        assert "a counter of 32 bits that wraps once" in notes(dataset)

    def test_with_times_in_some_demonstrations_alone_is_refused(self, tmp_path):
        path = logs.robomimic(tmp_path / "log.hdf5", times="time")
        with h5py.File(path, "a") as file:
            del file["data/demo_1/time"]
        with pytest.raises(FileFormatError, match="has times in demo_0 and none in demo_1"):
            read(path)
        assert read(path, rate_hz=50)[1].times == pytest.approx(logs.TICKS / 1e9)

    def test_leaves_out_an_empty_demonstration_and_says_so(self, tmp_path):
        dataset = read(logs.robomimic(tmp_path / "log.hdf5", empty=True))
        assert dataset.meta["labels"] == ["demo_0", "demo_2"]
        assert "demo_1 has no rows and is left out" in notes(dataset)
        assert dataset.meta["time_unit"] == "s"

    def test_with_a_filter_that_is_not_installed_names_it(self, tmp_path, monkeypatch):
        path = tmp_path / "log.hdf5"
        with h5py.File(path, "w") as file:
            values = np.zeros((40, 2))
            file.create_dataset("data/demo_0/obs/x", data=values, compression="gzip")
            file["data/demo_0/actions"] = values
        assert read(path)[0].rows == 40
        monkeypatch.setattr(h5py.h5z, "filter_avail", lambda code: False)
        with pytest.raises(FileFormatError, match="filter 'deflate', which is not installed"):
            read(path)

    def test_of_data_in_another_file_is_refused(self, tmp_path):
        logs.robomimic(tmp_path / "other.hdf5")
        path = tmp_path / "log.hdf5"
        with h5py.File(path, "w") as file:
            file["data/demo_0/actions"] = np.zeros((40, 2))
            file["data/demo_0/obs/x"] = h5py.ExternalLink("other.hdf5", "data/demo_0/obs/eef")
        with pytest.raises(FileFormatError, match="is a link to another file"):
            read(path)

    def test_of_a_shape_that_no_file_holds_is_refused(self, tmp_path):
        path = tmp_path / "log.hdf5"
        with h5py.File(path, "w") as file:
            file.create_dataset("data/demo_0/obs/x", (10**11, 2), "f8", chunks=(1024, 2))
            file["data/demo_0/actions"] = np.zeros((40, 2))
        with pytest.raises(FileFormatError, match="far more than the file of"):
            read(path)


@pytest.mark.parametrize("version", ["v2.1", "v3.0"])
class TestLeRobot:
    def test_reads_features_whose_names_only_begin_like_others(self, version, tmp_path):
        dataset = read(logs.lerobot(tmp_path / "set", version))
        for k, name in enumerate(("task_space_position", "actions_executed", "language_level")):
            column = dataset[0].values[:, dataset.names.index(name)]
            assert column == pytest.approx(logs.X + k, abs=1e-6)
            assert dataset.roles[dataset.names.index(name)] == "state"
        assert "next.reward, complementary_info.force" in notes(dataset)

    def test_names_the_times_that_it_does_not_use(self, version, tmp_path):
        number = {"dtype": "float64", "shape": [1], "names": None}
        episodes = [logs.logs.lerobot_episode(i, logs.ROWS) for i in range(2)]
        features = dict(logs.logs.FEATURES)
        for name, shift in (("observation.cam.timestamp", 0.001), ("observation.imu.time", 0.002)):
            features[name] = number
            for episode in episodes:
                jitter = shift * np.sin(np.arange(logs.ROWS))
                episode[name] = np.arange(logs.ROWS) / 20 + jitter
        logs.logs.write_lerobot(tmp_path / "set", episodes, version=version, features=features)
        dataset = read(tmp_path / "set")
        assert "stamps are the column 'observation.cam.timestamp'" in notes(dataset)
        assert "further times are left out: observation.imu.time;" in notes(dataset)
        other = read(tmp_path / "set", time_column="observation.imu.time")
        assert "stamps are the column 'observation.imu.time'" in notes(other)

    def test_refuses_stamps_that_are_all_0(self, version, tmp_path):
        path = logs.lerobot(tmp_path / "set", version, zero_stamps=True)
        with pytest.raises(FileFormatError, match="rows have the time stamp of another row"):
            read(path)

    @pytest.mark.parametrize(
        ("changes", "message"),
        [
            ({"data_path": "../outside.parquet"}, "expected one inside of"),
            ({"data_path": "/etc/passwd"}, "expected one inside of"),
            ({"data_path": "data/\0.parquet"}, "expected one inside of"),
            ({"data_path": "{episode_index:999999999d}"}, "has the pattern"),
            ({"data_path": "{episode_index.__class__}"}, "has the pattern"),
            ({"chunks_size": 0}, "0 in a folder, expected some"),
            ({"chunks_size": -1}, "-1 in a folder"),
            ({"total_episodes": -1}, "-1 episodes"),
            ({"fps": float("inf")}, "says inf fps"),
            ({"features": {"x": {"dtype": "float32", "shape": [-3]}}}, "has shape"),
            ({"features": {"x": {"dtype": "float32", "shape": [10**30]}}}, "has shape"),
            ({"features": {"x": {"dtype": "float32", "shape": "abc"}}}, "not the info.json"),
            ({"features": [1]}, "not the info.json"),
        ],
    )
    def test_stays_inside_its_folder_and_refuses_sizes_that_cannot_be(
        self, version, changes, message, tmp_path
    ):
        path = logs.changed_info(logs.lerobot(tmp_path / "set", version), **changes)
        with pytest.raises(FileFormatError, match=message) as error:
            read(path)
        assert "\n" not in str(error.value)
        assert str(error.value).isprintable()


def test_a_million_million_episodes_are_those_on_disk(tmp_path):
    path = logs.changed_info(logs.lerobot(tmp_path / "set", "v2.1"), total_episodes=10**12)
    assert len(read(path)) == 2  # as episodes.jsonl says
    (path / "meta" / "episodes.jsonl").unlink()
    with pytest.raises(FileFormatError, match="says 1000000000000 episodes, and there are 2 files"):
        read(path)


def test_a_last_number_that_may_be_cut_off_is_noted(tmp_path):
    (tmp_path / "log.csv").write_text(("time,x,y\n" + tables.BODY)[:-6])
    assert "without a line end after" in notes(read(tmp_path / "log.csv"))


@pytest.mark.parametrize(("name", "step"), [("s", 1), ("ms", 1000), ("us", 10**6), ("ns", 10**9)])
@pytest.mark.parametrize("suffix", [".tum", ".txt"])
def test_poses_have_the_unit_of_time_that_their_numbers_show(name, step, suffix, tmp_path):
    stamps = [1_764_000_000 * step + i * step // 50 for i in range(20)]
    if name == "s":
        stamps = [f"1764000000.{i * 2:02d}0000007" for i in range(20)]
    (tmp_path / f"log{suffix}").write_text("".join(f"{t} 1 2 3 0 0 0 1\n" for t in stamps))
    dataset = read(tmp_path / f"log{suffix}")
    assert dataset[0].times == pytest.approx(np.arange(20) / 50, abs=1e-9)
    assert dataset.meta["time_unit"] == name
    assert f"taken to be in {name}: numbers near" in notes(dataset)
    slow = read(tmp_path / f"log{suffix}", time_unit="ms" if name == "s" else "s", max_gap_s=None,
                clock_jumps="join")  # fmt: skip
    assert slow[0].times[1] == pytest.approx(2e-5 if name == "s" else step / 50)


def test_a_csv_of_euroc_counts_nanoseconds_since_1970(tmp_path):
    for step, unit in ((10**9, "ns"), (10**6, "us"), (1000, "ms")):
        stamps = [1_764_000_000 * step + i * step // 50 for i in range(20)]
        (tmp_path / "log.csv").write_text("#timestamp,x\n" + "".join(f"{t},1\n" for t in stamps))
        dataset = read(tmp_path / "log.csv")
        assert dataset.meta["format"] == ("euroc" if unit == "ns" else "csv")
        assert dataset.meta["time_unit"] == unit
        assert dataset[0].times == pytest.approx(np.arange(20) / 50, abs=1e-9)


IMU = "#stamp wx wy wz ax ay az host\n"
POSE = "# timestamp tx ty tz qw qx qy qz\n"


def test_eight_numbers_are_a_pose_only_by_their_header_or_their_quaternion(tmp_path):
    path = tmp_path / "log.txt"
    rows = (f"{t} {x} 0 0 0.5 0 9.81 {t}\n" for t, x in zip(tables.TIMES, tables.X, strict=True))
    path.write_text(IMU + "".join(rows))
    dataset = read(path)
    assert dataset.meta["format"] == "csv"
    assert dataset.names == ("wx", "wy", "wz", "ax", "ay", "az", "host")
    assert (dataset[0].values[:, 5] == 9.81).all()
    path.write_text(POSE + "0 1 2 3 1 0 0 0\n1 4 5 6 0.6 0.8 0 0\n")
    dataset = read(path)
    assert dataset.meta["format"] == "tum"
    assert dataset.names[3:] == ("qx", "qy", "qz", "qw")
    assert dataset[0].values[:, 3:].tolist() == [[0, 0, 0, 1], [0.8, 0, 0, 0.6]]
    path.write_text("0 1 2 3 4 5 6 7\n1 4 5 6 7 8 9 1\n")
    with pytest.raises(FileFormatError, match=r"has no header.*column_names="):
        read(path)
    path.write_text(POSE.replace("qw qx qy qz", "a b c d") + "0 1 2 3 4 5 6 7\n")
    with pytest.raises(FileFormatError, match=r"names its columns .* read it with format=csv"):
        read(path, format="tum")


T0 = np.datetime64("2025-11-24T12:00", "ns")


class TestArraysOfNumPy:
    @pytest.mark.parametrize("unit", ["s", "ms", "us", "ns"])
    def test_of_dates_and_durations_keep_their_unit(self, unit):
        steps = np.arange(5) * np.timedelta64(20_000_000_000, "ns").astype(f"m8[{unit}]")
        for clock in (T0.astype(f"M8[{unit}]") + steps, steps + steps[1]):
            trajectory = Trajectory.from_arrays(clock, np.zeros((5, 1)))
            assert trajectory.times.tolist() == [0.0, 20.0, 40.0, 60.0, 80.0]

    def test_of_dates_lose_no_nanosecond(self):
        clock = T0 + np.array([0, 1, 3], "m8[ns]")
        assert Trajectory.from_arrays(clock, np.zeros((3, 1))).times.tolist() == [0, 1e-9, 3e-9]

    def test_of_minutes_and_days_are_in_seconds(self):
        for unit, seconds in (("m", 60), ("h", 3600), ("D", 86_400)):
            clock = np.arange(3).astype(f"m8[{unit}]")
            times = Trajectory.from_arrays(clock, np.zeros((3, 1))).times
            assert times.tolist() == [0, seconds, 2 * seconds]

    def test_of_durations_are_seconds_in_a_trajectory_and_dates_are_refused(self):
        durations = np.array([10, 30], "m8[ms]")
        assert Trajectory(durations, [[1.0], [2.0]]).times.tolist() == [0.01, 0.03]
        with pytest.raises(InputError, match=r"expected seconds; Trajectory.from_arrays"):
            Trajectory(T0 + durations, [[1.0], [2.0]])

    def test_with_nat_or_masked_times_are_refused(self):
        with pytest.raises(InputError, match="NaT at row 1"):
            Trajectory.from_arrays(np.array(["2025-01-01", "NaT"], "M8[s]"), [[1.0], [2.0]])
        with pytest.raises(InputError, match="times are masked at row 1"):
            Trajectory(np.ma.array([0.0, 1.0], mask=[False, True]), [[1.0], [2.0]])

    @pytest.mark.parametrize("zone", [None, "Europe/Berlin"])
    def test_of_pandas_and_python_keep_their_unit(self, zone):
        pandas = pytest.importorskip("pandas")
        dates = pandas.DatetimeIndex(T0 + np.arange(5) * np.timedelta64(20, "ms"), tz=zone)
        values = np.zeros((5, 1))
        for clock in (dates, pandas.Series(dates), list(dates), dates.to_pydatetime().tolist()):
            times = Trajectory.from_arrays(clock, values).times
            assert times.tolist() == [0.0, 0.02, 0.04, 0.06, 0.08]
            with pytest.raises(InputError, match=r"from_arrays takes dates"):
                Trajectory(clock, values)
        steps = dates - dates[0]
        for clock in (steps, pandas.Series(steps), list(steps), steps.to_pytimedelta().tolist()):
            for trajectory in (Trajectory(clock, values), Trajectory.from_arrays(clock, values)):
                assert trajectory.times.tolist() == [0.0, 0.02, 0.04, 0.06, 0.08]

    @pytest.mark.parametrize(
        ("times", "values", "message"),
        [
            (np.arange(2) + 0j, [[1.0], [2.0]], "times are complex128, expected real numbers"),
            ([0.0, 1.0], np.array([[T0], [T0]]), r"values are datetime64\[ns\], expected real"),
            (["a", "b"], [[1.0], [2.0]], "times must be numbers"),
            ([datetime(2025, 1, 1), 3], [[1.0], [2.0]], "times must all be dates"),
            (np.arange(2).astype("m8[M]"), [[1.0], [2.0]], "which differ in length"),
        ],
    )
    def test_that_are_no_times_or_values_are_refused(self, times, values, message):
        with pytest.raises(InputError, match=message):
            Trajectory.from_arrays(times, values)

    def test_that_are_masked_hold_nothing_there(self):
        values = np.ma.array([[1, 2], [3, 4]], mask=[[False, True], [False, False]])
        for trajectory in (
            Trajectory([0.0, 1.0], values),
            Trajectory.from_arrays([0, 1], values, time_unit="s"),
        ):
            assert trajectory.observed.tolist() == [[True, False], [True, True]]
            assert np.isnan(trajectory.values[0, 1])

    def test_in_a_stream_keep_their_mask_and_need_a_plain_time(self):
        model, other = fuzz.model(), fuzz.model()
        masked, plain = fuzz.Stream(model), fuzz.Stream(other)
        masked.observe(0.0, np.ma.array([0.5, 9.0], mask=[False, True]))
        plain.observe(0.0, [0.5, np.nan])
        assert masked.predict(0.1).tolist() == plain.predict(0.1).tolist()
        for time in (T0, np.timedelta64(5, "ms")):
            with pytest.raises(InputError, match="a time must be a number in s"):
                masked.observe(time, [0.5, 1.0])


def test_other_logs_are_read_in_the_unit_that_the_run_found(tmp_path):
    """Steps of 20 are milliseconds; those of 1 alone would be taken for seconds."""
    slow = {"time": 20 * np.arange(200), "x": np.sin(np.arange(200) / 9)}
    fast = {"time": np.arange(200), "x": slow["x"]}
    named = {"time_s": 0.02 * np.arange(200), "x": slow["x"]}
    paths = {name: tables.write_csv(tmp_path / name, columns)
            for name, columns in (("slow", slow), ("fast", fast), ("named", named))}  # fmt: skip
    run = tmp_path / "run"
    small = ["--model.name=gru", "--model.hidden_size=2", "--training.epochs=1"]
    assert main(["train", str(paths["slow"]), str(run), *small]) == 0
    assert read_log(paths["slow"], None, run=run)[0].times[-1] == pytest.approx(3.98)
    assert read_log(paths["fast"], None, run=run)[0].times[-1] == pytest.approx(0.199)
    assert read_log(paths["fast"], {"time_unit": "s"}, run=run)[0].times[-1] == 199
    assert read_log(paths["named"], None, run=run)[0].times[-1] == pytest.approx(3.98)
    assert read(paths["fast"])[0].times[-1] == 199


def test_other_logs_have_the_unit_of_an_angle_that_the_run_found(tmp_path):
    wide = {"time": 0.02 * np.arange(200), "yaw": 7.0 * np.arange(200) % 360}
    narrow = {"time": 0.02 * np.arange(200), "yaw": np.sin(np.arange(200))}
    (tmp_path / "reader.json").write_text(
        '{"angles": ["yaw"], "found": {"time_unit": "s", "units": {"yaw": "deg"}}}'
    )
    for name, columns in (("wide", wide), ("narrow", narrow)):
        dataset = read_log(tables.write_csv(tmp_path / name, columns), None, run=tmp_path)
        assert dataset.units == ("deg",)


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({"time_column": "sec,nanosec"}, {"time_column": ["sec", "nanosec"]}),
        ({"time_column": "[sec, nanosec]"}, {"time_column": ["sec", "nanosec"]}),
        ({"time_column": "time(ms)"}, {"time_column": "time(ms)"}),
        ({"angles": "yaw"}, {"angles": ("yaw",)}),
        ({"topics": "/x"}, {"topics": ["/x"]}),
        ({"without": "a,b"}, {"without": ("a", "b")}),
        ({"missing": "-999"}, {"missing": ["-999"]}),
        ({"missing": "-999,lost"}, {"missing": ["-999", "lost"]}),
        ({"units": "{yaw: deg}"}, {"units": {"yaw": "deg"}}),
        ({"files": "merge"}, {"files": "merge"}),
        ({"column_names": "[t, x y]"}, {"column_names": ["t", "x y"]}),
        ({"rate_hz": "50"}, {"rate_hz": 50}),
    ],
)
def test_options_of_readers_are_typed_on_the_command_line(options, expected, monkeypatch):
    given = {}
    monkeypatch.setitem(app.COMMANDS, "inspect", inspect_with(given))
    words = [f"--reader.{name}={value}" for name, value in options.items()]
    assert main(["inspect", "log.csv", *words]) == 0
    plain = {n: list(v) if isinstance(v, tuple) else v for n, v in given["reader"].items()}
    assert plain == {n: list(v) if isinstance(v, tuple) else v for n, v in expected.items()}


@pytest.mark.parametrize(
    "names",
    [["left speed"], ["null", "yes", "on", "x"], ["a,b", "1e3", "x: y"], ["a'b", "#c", "~"]],
)
def test_names_in_the_command_of_inspect_are_read_as_they_are(names, tmp_path, capsys):
    columns = {name: tables.X + i for i, name in enumerate(names)}
    path = tmp_path / "log.csv"
    header = ",".join(f'"{name}"' for name in ("time", *names, "kept"))
    rows = zip(tables.TIMES, *columns.values(), tables.Y, strict=True)
    path.write_text("\n".join([header, *(",".join(map(str, row)) for row in rows)]) + "\n")
    assert main(["inspect", str(path), f"--reader.actions={json.dumps(names)}", "--json"]) == 0
    command = json.loads(capsys.readouterr().out)["advice"]["command"]
    given = [word for word in command if word.startswith("--reader.actions=")]
    assert main(["inspect", str(path), *given, "--json"]) == 0
    told = json.loads(capsys.readouterr().out)["channels"]
    assert [c["name"] for c in told if c["role"] == "action"] == names


def inspect_with(given):
    """A command that keeps the options it is called with."""

    def command(data: Path, reader: dict[str, Any] | None = None) -> None:
        """Inspect.

        Args:
            data: the log.
            reader: how it is read.
        """
        given.update(reader=reader)

    return command
