"""What holds for every reader, whatever its format: a new one is covered without a new test."""

from __future__ import annotations

import contextlib
import json
import pickle

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from log_writers import OPTIONS, WRITERS
from real_logs import evo, shared

from offbeat.data.readers import OPTIONS as CLEANING
from offbeat.data.readers import READERS, read
from offbeat.data.recording import ReaderOptions, Recording, Signal, assemble
from offbeat.data.trajectory import Dataset
from offbeat.errors import FileFormatError, InputError

START = 1_700_000_000_123_456_000
RNG = np.random.default_rng(0)
STAMPS = START + 1000 * np.cumsum(RNG.integers(1000, 30_000, 150))
VALUES = RNG.normal(size=(150, 2))
TEXT = ("csv", "csv long", "tum", "euroc", "euroc folder")
# Formats of lines and of messages.
UP_TO_THE_CUT = (
    "ardupilot",
    "csv",
    "json",
    "ros_echo",
    "tum",
    "euroc",
    "ros",
    "ulog",
)
SKIPPED = {"offbeat": "a data set of ours is finished: it has no clock and is not cleaned"}


@pytest.fixture(params=sorted(WRITERS))
def variant(request):
    """The name of a reader and a variant of its format."""
    return request.param


@pytest.fixture
def log(variant, tmp_path):
    """The walk, written in a format."""
    return WRITERS[variant](tmp_path / "walk", STAMPS, VALUES)


def read_back(variant, path, **options):
    return read(path, **OPTIONS.get(variant, {}), **options)


def walk_of(dataset):
    """The columns of the walk: the two states that are no constants."""
    (trajectory,) = dataset
    moving = [
        c
        for c, role in enumerate(dataset.roles)
        if role == "state" and np.nanstd(trajectory.values[:, c]) > 0
    ]
    return trajectory.values[:, moving]


def data_files(path):
    """The files of a log, the ones with the data first."""
    files = [path] if path.is_file() else [f for f in path.rglob("*") if f.is_file()]
    return sorted(files, key=lambda file: -file.stat().st_size)


def by_name(variant, log):
    """Names the format of a folder, whose content no longer tells it."""
    return {} if log.is_file() else {"format": variant.split()[0]}


def one_line(error):
    assert "\n" not in str(error.value)
    assert len(str(error.value)) < 700
    return str(error.value)


def test_every_reader_has_a_writer_here():
    assert set(READERS) == {name.split()[0] for name in WRITERS}


def test_the_format_is_found_by_suffix_and_content(variant, log):
    dataset = read_back(variant, log)
    assert dataset.meta.get("format", "offbeat") == variant.split()[0]


def test_every_stamp_and_value_comes_back_to_the_bit(variant, log):
    dataset = read_back(variant, log)
    assert dataset[0].times.tobytes() == ((STAMPS - STAMPS[0]) / 1e9).tobytes()
    assert walk_of(dataset).tobytes("C") == VALUES.tobytes("C")


def test_times_begin_at_0_and_increase_and_names_are_unique(variant, log):
    dataset = read_back(variant, log)
    assert isinstance(dataset, Dataset)
    for trajectory in dataset:
        assert trajectory.times[0] == 0
        assert (np.diff(trajectory.times) > 0).all()
    assert len(set(dataset.names)) == dataset.channels


def test_reading_twice_gives_the_same(variant, log):
    first, second = read_back(variant, log), read_back(variant, log)
    assert first.fingerprint() == second.fingerprint()
    assert dict(first.meta) == dict(second.meta)


def test_meta_can_be_written_as_json(variant, log):
    meta = dict(read_back(variant, log).meta)
    assert json.loads(json.dumps(meta, allow_nan=False)) == meta


def test_a_shift_of_the_clock_changes_nothing_but_its_start(variant, tmp_path):
    one = WRITERS[variant](tmp_path / "one", STAMPS, VALUES)
    other = WRITERS[variant](tmp_path / "two", STAMPS + 7 * 86_400 * 10**9, VALUES)
    assert read_back(variant, one).fingerprint() == read_back(variant, other).fingerprint()


def test_the_clock_at_the_start_is_kept_to_the_tick(variant, log):
    if variant in SKIPPED:
        pytest.skip(SKIPPED[variant])
    meta = read_back(variant, log).meta
    ticks = {"ns": 10**9, "us": 10**6, "s": 1}[meta["time_unit"]]
    if ticks > 1:
        assert meta["clock_start"] == [int(STAMPS[0]) * ticks // 10**9]
    else:
        assert meta["clock_start"] == pytest.approx([STAMPS[0] / 1e9], rel=1e-15)


def test_nan_is_a_value_that_is_not_known(variant, tmp_path):
    values = VALUES.copy()
    values[5, 1] = values[9, 0] = np.nan
    dataset = read_back(variant, WRITERS[variant](tmp_path / "walk", STAMPS, values))
    assert np.array_equal(np.isnan(walk_of(dataset)), np.isnan(values))
    assert np.array_equal(dataset[0].observed, ~np.isnan(dataset[0].values))


def test_late_and_repeated_stamps_are_cleaned_and_counted(variant, tmp_path):
    if variant in SKIPPED or variant.endswith("written"):
        pytest.skip(SKIPPED.get(variant, "a data set of ours has no late rows"))
    stamps = STAMPS.copy()
    stamps[[10, 11]] = stamps[[11, 10]]
    stamps[20] = stamps[19]
    dataset = read_back(variant, WRITERS[variant](tmp_path / "walk", stamps, VALUES))
    order = np.argsort(stamps, kind="stable")
    kept = np.delete(order, 19)
    assert dataset[0].times.tolist() == ((stamps[kept] - stamps[0]) / 1e9).tolist()
    assert walk_of(dataset).tobytes("C") == VALUES[kept].tobytes("C")
    channels = 2 if variant in ("csv long", "parquet long") else 1
    assert dataset.meta["cleaning"]["order"]["late"] == channels
    assert dataset.meta["cleaning"]["duplicates"]["rows"] == channels


def test_an_outage_begins_a_new_episode(variant, tmp_path):
    if variant in SKIPPED:
        pytest.skip(SKIPPED[variant])
    stamps = STAMPS + np.where(np.arange(150) < 60, 0, 12 * 10**9)
    path = WRITERS[variant](tmp_path / "walk", stamps, VALUES)
    first, second = dataset = read_back(variant, path)
    assert (first.rows, second.rows) == (60, 90)
    assert second.times[0] == 0
    outage = (stamps[60] - stamps[59]) / 1e9
    assert dataset.meta["cleaning"]["outages"]["longest_s"] == outage
    assert dataset.meta["cleaning"]["episodes"] == [{"episode": 1, "outage_before_s": outage}]
    assert read_back(variant, path, max_gap_s=None)[0].rows == 150


def test_a_channel_can_be_left_out(variant, log):
    if variant in SKIPPED:
        pytest.skip(SKIPPED[variant])
    dataset = read_back(variant, log)
    left = dataset.names[0]
    rest = read_back(variant, log, without=[left])
    assert rest.names == dataset.names[1:]
    assert rest[0].values.tobytes() == dataset[0].values[:, 1:].tobytes()


def test_all_channels_of_one_field_can_be_left_out():
    names = ("q[0]", "q[1]", "pose.x", "pose.y", "posed")
    signal = Signal("", np.arange(3), np.zeros((3, 5)), names)
    for without, left in ((["q"], names[2:]), (["pose"], (*names[:2], "posed"))):
        assert assemble([Recording((signal,))], ReaderOptions(without=without)).names == left
    with pytest.raises(InputError, match="unknown channel in without 'po'"):
        assemble([Recording((signal,))], ReaderOptions(without=["po"]))


def test_a_git_lfs_pointer_is_called_one(variant, log):
    data_files(log)[0].write_bytes(
        b"version https://git-lfs.github.com/spec/v1\noid sha256:" + b"0" * 64 + b"\nsize 9\n"
    )
    with pytest.raises(FileFormatError, match=r"Git LFS pointer, .* git lfs pull") as error:
        read_back(variant, log, **by_name(variant, log))
    one_line(error)


def test_pickled_content_is_refused_and_never_loaded(variant, log, tmp_path):
    class Bomb:
        def __reduce__(self):
            return (open, (str(tmp_path / "loaded"), "w"))

    for file in data_files(log):
        file.write_bytes(pickle.dumps(Bomb()))
    with pytest.raises(FileFormatError, match="pickled") as error:
        read_back(variant, log, **by_name(variant, log))
    one_line(error)
    assert not (tmp_path / "loaded").exists()


def test_a_truncated_file_is_an_error_of_one_line_or_reads_up_to_the_cut(variant, log):
    """Text that ends at the end of a number, and a log of messages, lose their end alone."""
    whole = read_back(variant, log)
    file = data_files(log)[0]
    content = file.read_bytes()
    if variant in TEXT:
        end = content.rindex(b"\t" if variant == "csv long" else b" " if variant == "tum" else b",")
        file.write_bytes(content[:end])
    else:
        file.write_bytes(content[: len(content) * 6 // 10 - 9])
    if variant.split()[0] not in UP_TO_THE_CUT:
        with pytest.raises(FileFormatError) as error:
            read_back(variant, log)
        one_line(error)
        return
    with contextlib.suppress(FileFormatError):
        rest = read_back(variant, log)
        assert rest.meta["cleaning"]["notes"] != whole.meta["cleaning"]["notes"]  # it is noted
        lost = 0 if variant == "csv long" else 1  # of the last row, one of two values
        assert 0 < rest[0].rows <= whole[0].rows - lost


def test_a_missing_and_an_empty_file_are_errors_of_one_line(variant, log):
    with pytest.raises(FileFormatError, match="No such file") as error:
        read(log.with_name(f"none{log.suffix}"))
    one_line(error)
    data_files(log)[0].write_bytes(b"")
    with pytest.raises(FileFormatError, match="is empty") as error:
        read_back(variant, log, **by_name(variant, log))
    one_line(error)


def test_an_unknown_option_is_answered_with_those_there_are(variant, log):
    reader = READERS[variant.split()[0]]
    with pytest.raises(InputError) as error:
        read_back(variant, log, no_such_option=1)
    said = one_line(error)
    options = reader.options
    assert all(option in said for option in options) if options else "no options" in said
    assert set(CLEANING) <= set(options) or not reader.cleaning


@pytest.mark.parametrize(
    ("parts", "rows", "channels"),
    [
        (("data", "freiburg1_xyz-groundtruth.txt"), 3000, 7),
        (("data", "fr2_desk_ORB.txt"), 2893, 7),
        (("data", "georeferenced.tum"), 1000, 7),
        (("data", "V102_groundtruth.csv"), 16_702, 16),
    ],
)
def test_files_of_other_programs_have_the_rows_that_their_lines_say(parts, rows, channels):
    path = evo(*parts)
    lines = [x for x in path.read_text().splitlines() if x.strip() and not x.startswith("#")]
    stamps = {line.replace(",", " ").split()[0] for line in lines}
    dataset = read(path)
    assert (sum(t.rows for t in dataset), dataset.channels) == (rows, channels)
    assert len(stamps) == rows
    first = [float(cell) for cell in lines[0].replace(",", " ").split()[1:]]
    assert dataset[0].values[0] == pytest.approx(first, abs=2e-4)  # quaternions have length 1 now


def test_a_real_folder_of_parquet_files_of_another_program_reads_file_by_file():
    path = shared("unitree_g1_lerobot_v21", "data", "chunk-000", "episode_000000.parquet")
    dataset = read(path, format="parquet", time_column="timestamp")
    assert dataset[0].rows == 479
    assert dataset.names[:2] == ("observation.state.0", "observation.state.1")
    assert np.diff(dataset[0].times) == pytest.approx(1 / 30, abs=1e-6)


def test_a_table_of_pandas_reads_with_its_index_of_times(tmp_path):
    """pandas stores an index without a name in a column of its own, and counts rows in CSV."""
    times = np.datetime64("2024-05-01T12:00", "ns") + 20_000_000 * np.arange(4)
    table = pa.table({"x": [1.0, None, 3.0, 4.0], "__index_level_0__": times})
    pq.write_table(table, tmp_path / "walk.parquet")
    (tmp_path / "walk.csv").write_text(",time,x\n0,0.0,1.0\n1,0.02,\n2,0.04,3.0\n3,0.06,4.0\n")
    for name in ("walk.parquet", "walk.csv"):
        dataset = read(tmp_path / name)
        assert dataset.names == ("x",)
        assert dataset[0].times.tolist() == [0.0, 0.02, 0.04, 0.06]
        assert dataset[0].observed[:, 0].tolist() == [True, False, True, True]
