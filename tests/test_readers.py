"""Reading by suffix and content, CSV in its many forms, and tables written for others."""

from __future__ import annotations

import csv
import inspect

import numpy as np
import pyarrow.parquet as pq
import pytest
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from offbeat.data.cleaning.clocks import TIME_NAMES
from offbeat.data.readers import READERS, read, register_reader
from offbeat.data.readers.csv_fields import MISSING
from offbeat.data.readers.table_options import LABEL_NAMES
from offbeat.data.store import save
from offbeat.data.trajectory import Dataset, Trajectory
from offbeat.data.writers.tables import write_table
from offbeat.errors import FileFormatError, InputError


@pytest.fixture
def csv_file(tmp_path):
    def written(text, name="walk.csv"):
        path = tmp_path / name
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        return path

    return written


def refused(path, message, error=FileFormatError, **options):
    with pytest.raises(error, match=message) as caught:
        read(path, **options)
    assert "\n" not in str(caught.value)


class TestTheRegistry:
    def test_chooses_by_the_suffix_in_any_case(self, csv_file):
        assert len(read(csv_file("time,x\n0,1\n", "WALK.CSV"))) == 1

    def test_reads_what_was_saved(self, tmp_path):
        save(Dataset([Trajectory([0.0, 1.0], [[1.0], [2.0]])]), tmp_path / "walk.parquet")
        assert read(tmp_path / "walk.parquet")[0].values.tolist() == [[1.0], [2.0]]

    def test_takes_the_format_by_name_where_the_suffix_does_not_say_it(self, csv_file):
        assert read(csv_file("time,x\n0,1\n", "walk.log"), format="csv")[0].rows == 1

    def test_names_the_formats_it_knows(self, csv_file):
        refused(csv_file("x", "walk.xyz"), r"'.xyz', expected one of: .parquet .pq .csv ")
        refused(
            csv_file("x"),
            "unknown format 'excel', expected one of: .*csv",
            InputError,
            format="excel",
        )

    def test_names_the_options_of_a_format(self, csv_file, tmp_path):
        refused(csv_file("x"), "did you mean 'time_unit'", InputError, time_units="ms")
        refused(csv_file("x"), "did you mean 'max_gap_s'", InputError, max_gap="1")
        save(Dataset([Trajectory([0.0], [[1.0]])]), tmp_path / "a.parquet")
        refused(tmp_path / "a.parquet", "takes no options, got 'seed'", InputError, seed=1)

    def test_decides_by_the_content_between_readers_of_one_suffix(self, csv_file):
        other = Dataset([Trajectory([0.0], [[42.0]])])
        register_reader(
            "pipe",
            lambda path: other,
            suffixes=(".csv",),
            recognises=lambda path: "|" in path.read_text(),
        )
        try:
            assert read(csv_file("time|x\n0|1\n"))[0].values == [[42.0]]
            assert read(csv_file("time,x\n0,1\n"))[0].values == [[1.0]]
        finally:
            READERS.unregister("pipe")

    def test_refuses_a_name_that_is_taken_and_a_suffix_without_dot(self):
        with pytest.raises(InputError, match="'csv' already"):
            register_reader("csv", lambda path: None, suffixes=(".txt",))
        with pytest.raises(InputError, match="lower case with a dot"):
            register_reader("text", lambda path: None, suffixes=("txt",))

    @pytest.mark.parametrize("name", sorted(READERS))
    def test_has_readers_whose_options_are_keywords_with_defaults(self, name):
        first, *options = inspect.signature(READERS[name].function).parameters.values()
        assert first.name == "path"
        assert all(option.kind is option.KEYWORD_ONLY for option in options)
        assert all(option.default is not option.empty for option in options)

    @pytest.mark.parametrize("name", sorted(READERS))
    @pytest.mark.parametrize(
        ("content", "message"),
        [
            (None, "No such file"),
            (b"", "is empty"),
            (b"version https://git-lfs.github.com/spec/v1\n", "git lfs pull"),
            (b"\xff\xfe\x00\x80" * 9, "can't be read as"),
        ],
    )
    def test_refuses_a_file_without_content_whatever_the_format(
        self, name, content, message, tmp_path
    ):
        path = tmp_path / f"walk{READERS[name].suffixes[0]}"
        if content is not None:
            path.write_bytes(content)
        refused(path, message)


class TestCsv:
    def test_is_a_header_and_a_row_per_time(self, csv_file):
        dataset = read(csv_file("time,hip,knee\n0.5,1,2\n0.75,-3e-5,\n"), units={"hip": "rad"})
        assert (dataset.names, dataset.units) == (("hip", "knee"), ("rad", ""))
        assert dataset[0].times.tolist() == [0.0, 0.25]
        assert np.array_equal(dataset[0].values, [[1, 2], [-3e-5, np.nan]], equal_nan=True)
        assert dataset[0].observed.tolist() == [[True, True], [True, False]]
        assert [dataset.meta[key] for key in ("source", "format", "time_unit", "clock_start")] == [
            "walk.csv",
            "csv",
            "s",
            [0.5],
        ]

    def test_may_come_with_a_byte_order_mark_spaces_and_carriage_returns(self, csv_file):
        dataset = read(csv_file(b"\xef\xbb\xbfTime, hip\r\n0.5, 1\r\n\r\n1.5,2\r\n"))
        assert dataset.names == ("hip",)
        assert dataset[0].times.tolist() == [0.0, 1.0]

    def test_may_have_other_delimiters_and_quotes(self, csv_file):
        dataset = read(csv_file('time;"a;b"\n0.5;"1"\n'), delimiter=";")
        assert dataset.names == ("a;b",)
        assert dataset[0].values == [[1.0]]

    @pytest.mark.parametrize("cell", MISSING)
    def test_has_ways_to_say_that_a_value_is_not_known(self, csv_file, cell):
        assert np.isnan(read(csv_file(f"time,x,y\n0,{cell},1\n"))[0].values[0, 0])

    @pytest.mark.parametrize("name", [*TIME_NAMES, "Timestamp", "TIME_MS"])
    def test_has_its_times_in_a_column_of_a_usual_name(self, csv_file, name):
        dataset = read(csv_file(f"x,{name}\n1,0\n2,500\n"), clock_jumps="join")
        per_unit = {"s": 500.0, "ms": 0.5, "us": 0.0005, "100ns": 5e-5, "ns": 5e-7}
        per_unit |= {"min": 30_000.0, "h": 1_800_000.0, "d": 43_200_000.0}
        per_unit |= {"millis": 0.5, "micros": 0.0005, "milliseconds": 0.5, "microseconds": 0.0005}
        per_unit |= {"nanoseconds": 5e-7, "itow": 0.5}
        name_of = {"i_tow": "itow"}.get(name, name)
        seconds = per_unit.get(name_of.lower().rpartition("_")[2], 500.0)
        assert dataset[0].times.tolist() == [0.0, seconds]
        assert dataset.names == ("x",)

    def test_has_its_times_in_the_column_that_is_asked_for(self, csv_file):
        text = "time,tick,x\n9.5,0.5,1\n9.5,2,1\n"
        dataset = read(csv_file(text), time_column="tick", time_unit="ms")
        assert dataset[0].times.tolist() == [0.0, 0.0015]
        assert dataset.meta["clock_start"] == [0.5]
        assert dataset.names == ("time", "x")

    @pytest.mark.parametrize("name", [*LABEL_NAMES, "Episode"])
    def test_may_hold_trajectories_that_take_turns(self, csv_file, name):
        text = f"{name},time,x\nb,0.5,1\na,7.0,2\nb,1.5,3\n"
        first, second = dataset = read(csv_file(text))
        assert first.times.tolist() == [0.0, 1.0]
        assert first.values.tolist() == [[1.0], [3.0]]
        assert second.times.tolist() == [0.0]
        assert dataset.meta["clock_start"] == [0.5, 7]
        assert first.origin == f"walk.csv, {name} b"
        assert dataset.meta["labels"] == ["b", "a"]

    def test_gives_the_channels_asked_for_in_their_order(self, csv_file):
        text = 'time,note,x,y\n0,"fell,\nthen rose",1,2\n1,,3,4\n'
        dataset = read(csv_file(text), channels=["y", "x"])
        assert dataset.names == ("y", "x")
        assert dataset[0].values.tolist() == [[2.0, 1.0], [4.0, 3.0]]

    def test_keeps_every_bit_of_an_integer_clock(self, csv_file):
        start = 1_700_000_000_123_456_789
        text = (
            f"episode,time_ns,x\n1,{start},0\n1,{start + 1},0\n2,{start + 7},0\n2,{start + 9},0\n"
        )
        dataset = read(csv_file(text))
        assert [t.times.tolist() for t in dataset] == [[0.0, 1e-9], [0.0, 2e-9]]
        assert dataset.meta["clock_start"] == [start, start + 7]

    @pytest.mark.parametrize(
        ("text", "message"),
        [
            ("\n\n", "must name its columns in line 1, got empty lines alone"),
            ("hip,knee\n0,1\n", "no column of times.*got 'hip', 'knee'; name one"),
            ("time\n0\n", "no channels, only the columns 'time'"),
            ("time,x,x\n0,1,2\n", "the column name 'x' twice"),
            ("time,,x\n0,1,2\n", "no name for column 1"),
            ("time,x\n", "a header and no rows"),
            ("time,x\n0,1\n\n1,two\n", "'two' in line 4, column 'x', expected a number"),
            ("time,x\n0,1\n1,1_0\n", "'1_0' in line 3, column 'x', expected a number"),
            ("time,x\n2024-05-32,1\n", "'2024-05-32' in line 2, column 'time', expected a number"),
            ("time,x\n0,1\n1\n", "1 fields in line 3, expected 2, one per column"),
            ("time,x\n0,1\n1,2,3\n", "3 fields in line 3, expected 2"),
            ("time,x\n0,1\n,2\n", "no time in line 3, column 'time'"),
            ("time,x\ninf,1\n", "times.*must be finite seconds"),
            ("time,episode,x\n0,,1\n", "empty field in line 2, column 'episode'"),
            (b"time,caf\0\n0,1\n", "text in UTF-8"),
        ],
    )
    def test_says_in_one_line_what_is_wrong_and_where(self, csv_file, text, message):
        refused(csv_file(text), message)

    @pytest.mark.parametrize(
        ("options", "message"),
        [
            ({"time_column": "tick"}, "unknown time_column 'tick', expected one of: time, x"),
            ({"trajectory_column": "run"}, "unknown trajectory_column 'run'"),
            ({"channels": ["y"]}, "unknown channel 'y'"),
            ({"units": {"y": "m"}}, "unknown channel in units 'y'"),
            ({"time_unit": "y"}, "unknown time unit 'y', expected one of: 100ns, d, h, min, ms, "),
            ({"delimiter": ""}, "delimiter must be one ASCII character"),
            ({"delimiter": '"'}, "no quote or line end"),
        ],
    )
    def test_refuses_options_that_do_not_fit(self, csv_file, options, message):
        refused(csv_file("time,x\n0,1\n"), message, InputError, **options)


COLUMN_NAMES = st.text(
    st.characters(codec="utf-8", exclude_categories=["Cc", "Zs", "Zl", "Zp"]), min_size=1
).filter(lambda name: name.casefold() not in (*TIME_NAMES, *LABEL_NAMES))


@given(
    ticks=st.lists(st.integers(-(10**15), 10**15), min_size=1, max_size=8, unique=True),
    names=st.lists(COLUMN_NAMES, min_size=1, max_size=3, unique=True),
    data=st.data(),
)
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_a_written_csv_is_read_back_to_the_bit(ticks, names, data, tmp_path):
    finite = st.floats(allow_infinity=False)
    values = data.draw(hnp.arrays(np.float64, (len(ticks), len(names)), elements=finite))
    times = np.sort(ticks) / 1e9  # whole nanoseconds, as a float64 of seconds holds them
    path = tmp_path / "table.csv"
    write_table(path, {"time": times, **dict(zip(names, values.T, strict=True))})
    back = read(path, time_unit="s", start="clock", clock_jumps="join", quaternions="keep")[0]
    assert back.names == tuple(names)
    assert back.times.tobytes() == times.tobytes()
    assert np.isnan(back.values).tolist() == np.isnan(values).tolist()
    assert np.nan_to_num(back.values).tobytes() == np.nan_to_num(values).tobytes()


@given(
    start=st.integers(-(2**62), 2**62),
    ticks=st.lists(st.integers(1, 2**53), max_size=8, unique=True),
)
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_an_integer_clock_is_read_as_the_exact_ticks_since_its_start(start, ticks, tmp_path):
    ticks = [0, *sorted(ticks)]
    seconds = [tick / 10**9 for tick in ticks]
    assume(len(set(seconds)) == len(ticks))
    clock = np.array(ticks, dtype=np.int64) + start
    write_table(tmp_path / "clock.csv", {"time_ns": clock, "x": np.zeros(len(ticks))})
    read_back = read(tmp_path / "clock.csv", clock_jumps="join")
    assert read_back[0].times.tolist() == seconds


class TestWrittenTables:
    COLUMNS = {  # noqa: RUF012
        "label": np.array(["a", 'b"c', "d,e"]),
        "row": np.arange(3),
        "x": np.array([0.1, np.nan, 1e-300]),
        "short": np.array([0.1, 0.2, 0.3], dtype=np.float32),
        "whole": np.array([1.0, 2.0, np.nan]),
        "hidden": np.array([True, False, True]),
    }

    def test_are_csv_that_python_reads(self, tmp_path):
        write_table(tmp_path / "table.csv", self.COLUMNS)
        with (tmp_path / "table.csv").open(newline="") as file:
            header, *rows = csv.reader(file)
        assert header == list(self.COLUMNS)
        assert [row[0] for row in rows] == ["a", 'b"c', "d,e"]
        assert [row[2] for row in rows] == ["0.1", "", "1e-300"]
        assert [float(row[3]) for row in rows] == self.COLUMNS["short"].tolist()
        assert [row[4] for row in rows] == ["1.0", "2.0", ""]

    def test_have_quotes_only_where_a_text_needs_them(self, tmp_path):
        write_table(tmp_path / "table.csv", {"time": [1.0, 2.0], "label": ["a", "b"]})
        assert (tmp_path / "table.csv").read_text() == "time,label\n1.0,a\n2.0,b\n"

    def test_are_plain_parquet_by_the_suffix(self, tmp_path):
        write_table(tmp_path / "table.parquet", self.COLUMNS)
        table = pq.read_table(tmp_path / "table.parquet")
        assert table.column_names == list(self.COLUMNS)
        assert table.column("short").to_numpy().tobytes() == self.COLUMNS["short"].tobytes()

    @pytest.mark.parametrize(
        ("name", "columns", "message"),
        [
            ("table.xls", {"x": [1.0]}, "unknown suffix of a table '.xls', expected one of: .csv"),
            ("table.csv", {}, "got none"),
            ("table.csv", {"x": [1.0], "y": [1.0, 2.0]}, r"one shape \(rows,\), got 'x' \(1,\)"),
            ("table.csv", {"x": [[1.0]]}, r"got 'x' \(1, 1\)"),
            ("table.csv", {"x": [1j]}, "must hold numbers, booleans or strings, got complex128"),
        ],
    )
    def test_are_refused_before_anything_is_written(self, tmp_path, name, columns, message):
        with pytest.raises(InputError, match=message):
            write_table(tmp_path / name, columns)
        assert not list(tmp_path.iterdir())
