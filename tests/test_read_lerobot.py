"""LeRobot data sets, versions 2.1 and 3.0."""

from __future__ import annotations

import json

import numpy as np
import pyarrow.parquet as pq
import pytest
import robot_logs as logs
from real_logs import ROOT, shared

from offbeat.data.readers import lerobot, read
from offbeat.errors import FileFormatError, InputError

VERSIONS = ["v2.1", "v3.0"]
LENGTHS = (4, 7, 5)


@pytest.fixture(params=VERSIONS)
def write(request, tmp_path):
    def written(episodes=None, **options):
        episodes = episodes or [logs.lerobot_episode(i, n) for i, n in enumerate(LENGTHS)]
        return logs.write_lerobot(tmp_path / "walk", episodes, version=request.param, **options)

    return written


def refused(path, message, error=FileFormatError, **options):
    with pytest.raises(error, match=message) as caught:
        list(lerobot.recordings(path, **options))
    assert "\n" not in str(caught.value)


def with_column(name, dtype, make):
    """Episodes with one more column of one number per row, and the features to say so."""
    episodes = [
        logs.lerobot_episode(i, n) | {name: make(i, np.arange(n))} for i, n in enumerate(LENGTHS)
    ]
    return episodes, logs.FEATURES | {name: {"dtype": dtype, "shape": [1], "names": None}}


class TestADataSet:
    def test_gives_states_and_actions_of_every_episode(self, write):
        dataset = read(write())
        assert [t.rows for t in dataset] == list(LENGTHS)
        assert dataset.names == ("hip", "knee", "ankle", "action.left", "action.right")
        assert dataset.roles == ("state",) * 3 + ("action",) * 2
        assert dataset.meta["labels"] == ["0", "1", "2"]
        for i, trajectory in enumerate(dataset):
            expected = logs.lerobot_episode(i, LENGTHS[i])
            assert np.array_equal(trajectory.values[:, :3], expected["observation.state"])
            assert np.array_equal(trajectory.actions, expected["action"])

    def test_that_does_not_fit_into_memory_is_refused_before_it_is_read(self, write, monkeypatch):
        monkeypatch.setattr("offbeat.data.memory.available_memory", lambda: 1000)
        root = write()
        refused(root, "16 rows x 5 channels, .*; choose episodes= or columns=, or split the file")
        assert len(list(lerobot.recordings(root, episodes=[0]))) == 1

    def test_notes_that_its_stamps_are_made_up(self, write):
        dataset = read(write())
        assert dataset[0].times.tolist() == [0.0, 0.05, 0.1, 0.15]
        notes = dataset.meta["cleaning"]["notes"]
        assert "stamps are row number / 20 fps, no times were recorded" in notes
        assert (
            "left out unless chosen with columns=: observation.images.front (video), next.reward"
            in notes
        )

    def test_takes_the_stamps_of_a_column_of_its_own(self, write):
        episodes, features = with_column(
            "observation.time_ns", "int64", lambda i, n: 1_700_000_000_000_000_000 + 7 * n + n**2
        )
        dataset = read(write(episodes, features=features))
        assert dataset[0].times.tolist() == [0.0, 8e-9, 18e-9, 30e-9]
        assert dataset.meta["cleaning"]["notes"][0] == "stamps are the column 'observation.time_ns'"
        assert dataset.names[:3] == ("hip", "knee", "ankle")

    def test_takes_stamps_that_jitter_in_the_usual_column(self, write):
        jitter = np.array([0.0, 0.004, -0.003, 0.002])
        episodes = [logs.lerobot_episode(0, 4)]
        measured = np.arange(4) / 20 + jitter
        episodes[0]["timestamp"] = measured
        trajectory = read(write(episodes))[0]
        assert trajectory.times == pytest.approx(measured, abs=1e-9)

    def test_takes_no_column_that_is_row_number_by_fps_for_a_clock(self, write):
        episodes, features = with_column("observation.time_ms", "int64", lambda i, n: 50 * n)
        notes = read(write(episodes, features=features)).meta["cleaning"]["notes"]
        assert "stamps are row number / 20 fps, no times were recorded" in notes

    def test_gives_the_columns_and_episodes_that_are_asked_for(self, write):
        path = write()
        dataset = read(path, columns=["next.reward", "observation.state"], episodes=[2, 0])
        assert dataset.names[:4] == (
            "next.reward", "observation.state.hip", "observation.state.knee",
            "observation.state.ankle",
        )  # fmt: skip
        assert [t.rows for t in dataset] == [4, 5]
        assert [t.rows for t in read(path, columns="observation.state", episodes=1)] == [7]
        assert read(path, include_actions=False)[0].actions is None
        # As 0.1.0 called it.
        assert read(path, actions=False)[0].actions is None
        assert read(path, columns=["action"])[0].channels == 2
        assert read(path, time_column="timestamp")[0].times[1] == pytest.approx(0.05)

    def test_lists_what_there_is(self, write):
        path = write()
        refused(
            path, "unknown column 'state', expected one of: action,", InputError, columns=["state"]
        )
        refused(path, "unknown episode '9', expected one of: 0, 1, 2", InputError, episodes=[9])
        refused(path, "unknown time_column 'clock'", InputError, time_column="clock")

    @pytest.mark.parametrize("inside", [".", "meta/info.json"])
    def test_is_found_by_its_folder_or_its_info(self, write, inside):
        assert len(read(write() / inside)) == 3

    def test_is_read_in_part_by_one_of_its_files(self, write):
        path = write()
        (file, *_) = sorted((path / "data").glob("*/*.parquet"))
        dataset = read(file)
        assert [t.rows for t in dataset] == list(LENGTHS[: len(dataset)])
        assert len(dataset) < 3

    def test_has_nan_where_a_number_is_missing(self, write):
        episodes = [logs.lerobot_episode(0, 4)]
        episodes[0]["observation.state"][2, 1] = np.nan
        values = read(write(episodes))[0].values
        assert np.isnan(values).sum() == 1
        assert np.isnan(values[2, 1])

    @pytest.mark.parametrize(
        ("names", "expected"),
        [
            (["a", "b", "c"], ("a", "b", "c")),
            ([["a", "b", "c"]], ("a", "b", "c")),
            ({"motors": ["a", "b", "c"]}, ("a", "b", "c")),
            ({"a": 0, "b": 1, "c": 2}, ("a", "b", "c")),
            (["a", "a", "c"], ("a[0]", "a[1]", "c")),
            (["state"], tuple(f"observation.state[{i}]" for i in range(3))),
            (None, tuple(f"observation.state[{i}]" for i in range(3))),
        ],
    )
    def test_names_channels_as_its_info_does_in_whatever_form(self, write, names, expected):
        state = {"dtype": "float32", "shape": [3], "names": names}
        features = logs.FEATURES | {"observation.state": state}
        assert read(write(features=features)).names[:3] == expected


class TestDamage:
    def test_a_pointer_of_git_lfs_says_so(self, write):
        path = write()
        (file, *_) = sorted((path / "data").glob("*/*.parquet"))
        file.write_text("version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 130\n")
        refused(path, "is a Git LFS pointer.*git lfs pull")

    def test_a_truncated_file_costs_one_line(self, write):
        path = write()
        (file, *_) = sorted((path / "data").glob("*/*.parquet"))
        file.write_bytes(file.read_bytes()[:-20])
        refused(path, "can't be read as Parquet, it is truncated")

    def test_a_missing_file_is_named(self, write):
        path = write()
        (file, *_) = sorted((path / "data").glob("*/*.parquet"))
        file.unlink()
        refused(path, f"{file.name} can't be read \\(No such file")

    def test_rows_that_are_missing_are_counted(self, write):
        path = write()
        (file, *_) = sorted((path / "data").glob("*/*.parquet"))
        pq.write_table(pq.read_table(file).slice(1), file)
        refused(path, "holds 3 rows of episode 0, expected 4")

    def test_a_column_that_info_promises_is_missed(self, write):
        features = logs.FEATURES | {"observation.force": logs.FEATURES["next.reward"]}
        refused(write(features=features), "no column 'observation.force'")

    def test_numbers_that_are_too_few_are_counted(self, write):
        state = {"dtype": "float32", "shape": [4], "names": None}
        features = logs.FEATURES | {"observation.state": state}
        refused(
            write(features=features), "numbers in column 'observation.state', expected 4 in each"
        )

    @pytest.mark.parametrize(
        ("change", "message"),
        [
            ({"codebase_version": "v1.6"}, "of version v1.6, expected v2.0, v2.1 or v3.0"),
            ({"fps": 0}, "says 0 fps"),
            ({"features": None}, "not the info.json of a LeRobot data set"),
            ({"data_path": "data/{shard}.parquet"}, "'data/{shard}.parquet' can't be filled"),
        ],
    )
    def test_an_info_that_can_not_be_is_refused(self, write, change, message):
        path = write()
        info = json.loads((path / "meta/info.json").read_text())
        (path / "meta/info.json").write_text(json.dumps(info | change))
        refused(path, message)

    def test_version_3_without_its_list_of_episodes_is_refused(self, tmp_path):
        episodes = [logs.lerobot_episode(0, 4)]
        path = logs.write_lerobot(tmp_path / "a", episodes, version="v3.0")
        (path / "meta/episodes/chunk-000/file-000.parquet").unlink()
        refused(path, "holds no Parquet files.*finalize")

    def test_another_folder_is_no_data_set(self, tmp_path):
        (tmp_path / "x.txt").write_text("x")
        assert not lerobot.recognises(tmp_path)
        refused(tmp_path, "not a LeRobot data set: there is no meta/info.json")


def test_a_set_of_a_real_robot_is_read():
    path = shared("unitree_g1_lerobot_v21")
    dataset = read(path)
    assert (len(dataset), dataset.roles.count("state")) == (100, 26)
    assert sum(t.rows for t in dataset) == 35_965
    assert dataset.names[0] == "kLeftShoulderPitch"
    table = pq.read_table(path / "data/chunk-000/episode_000042.parquet")
    state = np.array(table.column("observation.state").to_pylist())
    assert np.array_equal(dataset[42].values[:, :26], state)
    assert np.array_equal(dataset[42].actions, np.array(table.column("action").to_pylist()))


def test_a_set_that_lerobot_wrote_itself_is_read():
    rng = np.random.default_rng(0)  # tests/data/README.md
    dataset = read(ROOT / "tests" / "data" / "lerobot_v3")
    assert dataset.names == ("hip", "knee", "ankle", "action.left", "action.right")
    assert [t.rows for t in dataset] == [6, 9]
    for trajectory in dataset:
        for values, actions in zip(trajectory.values, trajectory.actions, strict=True):
            assert values[:3].tolist() == rng.normal(size=3).astype(np.float32).tolist()
            assert actions.tolist() == rng.normal(size=2).astype(np.float32).tolist()
    assert dataset[1].times.tolist() == (np.arange(9) / 10).tolist()


NS = [1_700_000_000_990_000_000 + np.cumsum([0, *range(1, n)]) * 7_000_001 for n in LENGTHS]


def with_pair(one, two, rest):
    episodes = [
        logs.lerobot_episode(i, n) | {one: NS[i] // 10**9, two: rest(NS[i])}
        for i, n in enumerate(LENGTHS)
    ]
    kind = {"dtype": "int64", "shape": [1], "names": None}
    return episodes, {one: kind, two: kind}


@pytest.mark.parametrize("given", [False, True])
@pytest.mark.parametrize(
    ("one", "two", "rest"),
    [
        ("sec", "nanosec", lambda ns: ns % 10**9),
        ("observation.stamp.secs", "observation.stamp.nsecs", lambda ns: ns % 10**9),
    ],
)
def test_a_stamp_in_two_columns_is_joined_and_is_no_channel(write, one, two, rest, given):
    episodes, more = with_pair(one, two, rest)
    options = {"time_column": [one, two]} if given else {}
    dataset = read(write(episodes, features=logs.FEATURES | more), **options)
    for trajectory, ns in zip(dataset, NS, strict=True):
        assert np.array_equal(np.rint(trajectory.times * 1e9), ns - ns[0])
    assert dataset.names == ("hip", "knee", "ankle", "action.left", "action.right")


def test_several_stamps_in_two_columns_are_refused_by_name(write):
    episodes, more = with_pair("a_sec", "a_nanosec", lambda ns: ns % 10**9)
    others, again = with_pair("b_sec", "b_nanosec", lambda ns: ns % 10**9)
    both = [one | other for one, other in zip(episodes, others, strict=True)]
    root = write(both, features=logs.FEATURES | more | again)
    refused(root, r"has several stamps, each in two columns: \[a_sec, a_nanosec\], \[b_sec")
    dataset = read(root, time_column=["b_sec", "b_nanosec"])
    assert dataset.names == ("hip", "knee", "ankle", "action.left", "action.right")
    assert np.array_equal(np.rint(dataset[1].times * 1e9), NS[1] - NS[1][0])
    refused(root, "must name one column, or two", InputError, time_column=["a_sec", "b_sec"])
