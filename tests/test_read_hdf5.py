"""HDF5 of robomimic and Minari."""

from __future__ import annotations

import sys

import h5py
import numpy as np
import pytest
import robot_logs as logs
from real_logs import ROOT, shared

from offbeat.data.readers import hdf5, read
from offbeat.errors import FileFormatError, InputError, MissingExtraError

RNG = np.random.default_rng(0)
QUATERNIONS = np.array([[0.0, 0, 0, 1], [0, 0, 1, 0], [0, 1, 0, 0], [1, 0, 0, 0], [0, 0, 0, 1]])


def demo(rows, **more):
    return {
        "actions": RNG.normal(size=(rows, 2)),
        "robot0_eef_pos": RNG.normal(size=(rows, 3)),
        "robot0_eef_quat": np.resize(QUATERNIONS, (rows, 4)),
        "gripper": RNG.normal(size=rows),
        "agentview_image": np.zeros((rows, 8, 8, 3), dtype=np.uint8),
        **more,
    }


@pytest.fixture
def robomimic(tmp_path):
    return logs.write_robomimic(
        tmp_path / "demo.hdf5", [demo(5) for _ in range(11)], masks={"valid": ["demo_10", "demo_2"]}
    )


def refused(path, message, error=FileFormatError, **options):
    with pytest.raises(error, match=message) as caught:
        list(hdf5.recordings(path, **options))
    assert "\n" not in str(caught.value)


class TestRobomimic:
    def test_gives_an_episode_per_demonstration_in_the_order_of_their_numbers(self, robomimic):
        dataset = read(robomimic)
        assert dataset.meta["labels"] == [f"demo_{i}" for i in range(11)]
        with h5py.File(robomimic) as file:
            for i, trajectory in enumerate(dataset):
                there = file[f"data/demo_{i}"]
                expected = np.column_stack([there["obs/gripper"], there["obs/robot0_eef_pos"]])
                assert np.array_equal(trajectory.values[:, :4], expected)
                assert np.array_equal(trajectory.actions, there["actions"])
        assert dataset.names[:2] == ("gripper", "robot0_eef_pos[0]")
        assert [n for n, r in zip(dataset.names, dataset.roles, strict=True) if r == "action"] == [
            "action[0]",
            "action[1]",
        ]

    def test_takes_the_rate_of_the_environment_and_says_so(self, robomimic):
        dataset = read(robomimic)
        assert dataset[0].times.tolist() == [0.0, 0.05, 0.1, 0.15, 0.2]
        assert (
            "row number / 20 Hz, the environment's control_freq"
            in dataset.meta["cleaning"]["notes"][0]
        )
        assert read(robomimic, rate_hz=10)[0].times[1] == 0.1

    def test_marks_quaternions(self, robomimic):
        (signal,) = next(hdf5.recordings(robomimic)).signals
        kinds = dict(zip(signal.channels, signal.kinds, strict=True))
        assert [name for name, kind in kinds.items() if kind] == [
            f"robot0_eef_quat[{i}]" for i in range(4)
        ]

    def test_leaves_pictures_out_and_says_so(self, robomimic):
        notes = next(hdf5.recordings(robomimic)).notes
        assert "left out: agentview_image (8 x 8 x 3)" in notes

    def test_gives_the_observations_and_episodes_that_are_asked_for(self, robomimic):
        dataset = read(robomimic, keys=["gripper"], mask="valid", include_actions=False)
        assert dataset.names == ("gripper",)
        assert dataset.meta["labels"] == ["demo_2", "demo_10"]
        assert dataset[0].actions is None

    def test_lists_what_there_is(self, robomimic):
        refused(robomimic, "unknown key of .*'grip', expected one of: agentview_image, gripper",
                InputError, keys=["grip"])  # fmt: skip
        refused(robomimic, "unknown mask .*'x', expected one of: valid", InputError, mask="x")
        refused(robomimic, "rate_hz must be .* above 0, got 0", InputError, rate_hz=0)

    def test_says_when_no_rate_is_known(self, tmp_path):
        path = logs.write_robomimic(tmp_path / "a.hdf5", [demo(3)], control_freq=None)
        dataset = read(path)
        assert dataset[0].times.tolist() == [0.0, 1.0, 2.0]
        assert "1 s apart" in dataset.meta["cleaning"]["notes"][0]

    def test_takes_stamps_that_are_recorded(self, tmp_path):
        stamps = np.array([5.0, 5.125, 5.5])
        path = logs.write_robomimic(tmp_path / "a.hdf5", [demo(3, timestamp=stamps)])
        dataset = read(path)
        assert dataset[0].times.tolist() == [0.0, 0.125, 0.5]
        assert "timestamp" not in dataset.names

    def test_without_observations_says_how_to_make_them(self, tmp_path):
        path = logs.write_robomimic(tmp_path / "a.hdf5", [{"actions": np.zeros((3, 2))}])
        refused(path, "/data/demo_0 has no obs; extract them.*dataset_states_to_obs")


class TestMinari:
    def test_gives_observations_of_one_array(self, tmp_path):
        observations, actions = RNG.normal(size=(4, 3)), RNG.normal(size=(3, 2))
        folder = logs.write_minari(tmp_path / "x-v0", [(observations, actions)])
        dataset = read(folder, rate_hz=50)
        assert dataset.names[:3] == ("observation[0]", "observation[1]", "observation[2]")
        assert np.array_equal(dataset[0].values[:, :3], observations)
        assert dataset[0].times.tolist() == [0.0, 0.02, 0.04, 0.06]
        assert np.array_equal(dataset[0].actions, np.vstack([actions, actions[-1:]]))
        notes = dataset.meta["cleaning"]["notes"]
        assert "the last observation has no action; that of the row before is used" in notes

    @pytest.mark.parametrize("inside", ["", "data", "data/main_data.hdf5"])
    def test_is_read_by_its_folder_or_its_file(self, tmp_path, inside):
        folder = logs.write_minari(tmp_path / "x-v0", [(np.eye(3), np.eye(2))])
        assert read(folder / inside)[0].values[:, :3].tolist() == np.eye(3).tolist()

    def test_may_nest_dictionaries_and_tuples(self, tmp_path):
        goal, state = RNG.normal(size=(3, 2)), RNG.normal(size=(3, 1))
        observations = {"goal": goal, "robot": (state, {"q": state + 1})}
        actions = {"arm": np.ones((2, 1)), "hand": np.zeros((2, 2))}
        folder = logs.write_minari(tmp_path / "x-v0", [(observations, actions)])
        dataset = read(folder)
        assert dataset.names[:4] == ("goal[0]", "goal[1]", "robot/0", "robot/1/q")
        assert np.array_equal(dataset[0].values[:, :4], np.hstack([goal, state, state + 1]))
        assert dataset.names[4:] == ("action.arm[0]", "action.hand[0]", "action.hand[1]")
        assert read(folder, keys=["robot/1"], include_actions=False).names == ("robot/1/q",)

    def test_sorts_episodes_by_their_numbers(self, tmp_path):
        episodes = [(np.full((2, 1), i), np.zeros((1, 1))) for i in range(12)]
        dataset = read(logs.write_minari(tmp_path / "x-v0", episodes))
        assert [t.values[0, 0] for t in dataset] == list(range(12))

    def test_refuses_actions_that_are_too_few(self, tmp_path):
        folder = logs.write_minari(tmp_path / "x-v0", [(np.eye(5), np.eye(2))])
        refused(folder, r"/episode_0 has \[2\] actions for 5 observations.*include_actions=False")
        assert read(folder, actions=False)[0].rows == 5

    def test_written_by_minari_itself_is_read(self):
        rng = np.random.default_rng(0)  # tests/data/README.md
        dataset = read(ROOT / "tests" / "data" / "minari")
        assert dataset.names[:5] == (
            "achieved_goal[0]", "achieved_goal[1]",
            "observation[0]", "observation[1]", "observation[2]",
        )  # fmt: skip
        for trajectory, steps in zip(dataset, (3, 5), strict=True):
            parts = rng.normal(size=(steps + 1, 2)), rng.normal(size=(steps + 1, 3))
            assert np.array_equal(trajectory.values[:, :5], np.hstack(parts))
            assert np.array_equal(trajectory.actions[:-1], rng.normal(size=(steps, 2)))


class TestDamage:
    def test_objects_that_need_unpickling_are_refused(self, tmp_path):
        opaque = np.array([np.void(b"\x80\x04K\x01.")] * 3, dtype="V5")
        path = logs.write_robomimic(tmp_path / "opaque.hdf5", [demo(3, opaque=opaque)])
        refused(path, "/data/demo_0/obs/opaque holds objects.*unpickled")
        path = tmp_path / "ragged.hdf5"
        logs.write_robomimic(path, [demo(3)])
        with h5py.File(path, "a") as file:  # as PyTables stores pickles
            ragged = file.create_dataset(
                "data/demo_0/obs/ragged", (3,), dtype=h5py.vlen_dtype(np.uint8)
            )
            ragged.attrs["PSEUDOATOM"] = "object"
        refused(path, "/obs/ragged holds objects.*unpickled")
        assert next(hdf5.recordings(path, keys=["gripper"])).signals[0].channels[:1] == ("gripper",)

    def test_pickled_actions_are_refused(self, tmp_path):
        values = np.array([np.void(b"\x80\x04K\x01.")] * 3, dtype="V5")
        path = logs.write_robomimic(tmp_path / "a.hdf5", [demo(3, actions=values)])
        refused(path, "/data/demo_0/actions holds objects.*unpickled")

    @pytest.mark.parametrize(
        ("values", "dtype", "said"),
        [
            (["a", "b", "c"], h5py.string_dtype(), "say (text)"),
            ([b"a", b"b", b"c"], "S1", "say (text)"),
            (np.zeros(3), [("a", "f8"), ("b", "f8")], "say (records)"),
            ([np.zeros(i, np.uint8) for i in range(3)], h5py.vlen_dtype(np.uint8), "say (lists)"),
        ],
    )
    def test_what_is_no_array_of_numbers_is_left_out(self, tmp_path, values, dtype, said):
        path = logs.write_robomimic(tmp_path / "a.hdf5", [demo(3)])
        with h5py.File(path, "a") as file:
            place = file.create_dataset("data/demo_0/obs/say", (3,), dtype=dtype)
            for i in range(3):
                place[i] = values[i]
        assert any(said in note for note in next(hdf5.recordings(path)).notes)

    def test_a_truncated_file_costs_one_line(self, robomimic):
        whole = robomimic.read_bytes()
        for length in (1, 8, 100, len(whole) // 2, len(whole) - 1):
            robomimic.write_bytes(whole[:length])
            refused(robomimic, "can't be read as HDF5, it is truncated")

    def test_rows_that_differ_are_refused(self, tmp_path):
        path = logs.write_robomimic(tmp_path / "a.hdf5", [demo(3, short=np.zeros(2))])
        refused(path, "observations of /data/demo_0 differ in their rows: gripper 3, .*short 2")

    def test_another_layout_is_named(self, tmp_path):
        path = tmp_path / "a.h5"
        with h5py.File(path, "w") as file:
            file["points"] = np.zeros(3)
        refused(path, "has no array of times .* got .points.")

    def test_a_pointer_of_git_lfs_says_so(self, tmp_path):
        path = tmp_path / "a.hdf5"
        path.write_text("version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 130\n")
        assert not hdf5.recognises(path)
        refused(path, "git lfs pull")

    def test_without_the_extra_says_which_one(self, robomimic, monkeypatch):
        monkeypatch.setitem(sys.modules, "h5py", None)
        refused(robomimic, r"offbeat\[hdf5\]", MissingExtraError)


def test_a_file_of_robomimic_itself_is_read():
    path = shared("robomimic", "test.hdf5")
    dataset = read(path)
    assert dataset[0].actions is not None
    assert dataset.meta["labels"][0] == "demo_0"


@pytest.mark.filterwarnings("ignore")
def test_a_data_set_that_minari_wrote_is_read(tmp_path, monkeypatch):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    minari = pytest.importorskip("minari")
    spaces = pytest.importorskip("gymnasium").spaces
    from minari.data_collector.episode_buffer import EpisodeBuffer

    random = np.random.default_rng(0)
    observed = [random.normal(size=(n + 1, 4)).astype(np.float32) for n in (20, 21)]
    acted = [random.normal(size=(n, 2)).astype(np.float32) for n in (20, 21)]
    buffers = [
        EpisodeBuffer(
            id=i,
            observations=list(observed[i]),
            actions=list(acted[i]),
            rewards=[0.0] * len(acted[i]),
            terminations=[False] * len(acted[i]),
            truncations=[False] * (len(acted[i]) - 1) + [True],
            infos={},
        )
        for i in range(2)
    ]
    minari.create_dataset_from_buffers(
        "walk/test-v0",
        buffers,
        observation_space=spaces.Box(-10, 10, (4,), np.float32),
        action_space=spaces.Box(-10, 10, (2,), np.float32),
        data_format="hdf5",
    )
    dataset = read(tmp_path / "walk" / "test-v0", rate_hz=20)
    assert [t.rows for t in dataset] == [21, 22]
    for trajectory, values in zip(dataset, observed, strict=True):
        np.testing.assert_array_equal(trajectory.values[:, :4], values.astype(np.float64))
        np.testing.assert_allclose(np.diff(trajectory.times), 0.05)


STAMPS_NS = 1_700_000_000_990_000_000 + np.array([0, 20, 40, 70, 90]) * 10**6
WHOLE, REST = STAMPS_NS // 10**9, STAMPS_NS % 10**9


class TestAStampInTwoArrays:
    @pytest.mark.parametrize(
        ("one", "two", "rest"),
        [
            ("sec", "nanosec", REST),
            ("stamp.secs", "stamp.nsecs", REST),
            ("header_stamp_sec", "header_stamp_nanosec", REST),
            ("time_s", "time_us", REST // 1000),
        ],
    )
    @pytest.mark.parametrize("given", [False, True])
    def test_is_joined_to_the_nanosecond_and_is_no_channel(self, one, two, rest, given, tmp_path):
        path = logs.write_robomimic(tmp_path / "a.hdf5", [demo(5, **{one: WHOLE, two: rest})])
        dataset = read(path, **({"time_column": [one, two]} if given else {}))
        assert np.array_equal(np.rint(dataset[0].times * 1e9), STAMPS_NS - STAMPS_NS[0])
        assert not {one, two} & set(dataset.names)
        assert any(f"joined from the arrays '{one}', '{two}'" in n
                   for n in dataset.meta["cleaning"]["notes"])  # fmt: skip

    def test_is_a_channel_where_the_numbers_are_no_stamp(self, tmp_path):
        more = {"lap_s": np.array([1.5, 2.5, 3.5, 4.5, 5.5]), "lap_ms": np.arange(5.0)}
        path = logs.write_robomimic(tmp_path / "a.hdf5", [demo(5, **more)])
        assert {"lap_s", "lap_ms"} <= set(read(path, rate_hz=10.0).names)

    def test_is_refused_by_name_where_it_is_not_clear(self, tmp_path):
        two = {"a_sec": WHOLE, "a_nanosec": REST, "b_sec": WHOLE, "b_nanosec": REST}
        path = logs.write_robomimic(tmp_path / "a.hdf5", [demo(5, **two)])
        refused(path, r"has several stamps, each in two arrays: \[a_sec, a_nanosec\], \[b_sec")
        dataset = read(path, time_column=["b_sec", "b_nanosec"])
        assert dataset[0].times[-1] == pytest.approx(0.09)
        assert not [name for name in dataset.names if "sec" in name]
        refused(path, "must name one array, or two", InputError, time_column=["a_sec", "b_sec"])

    def test_of_text_or_in_two_columns_of_an_array_is_refused_by_name(self, tmp_path):
        texts = np.array([f"2026-01-01T00:00:0{i}" for i in range(5)], dtype="S")
        for name, value, said in (
            ("timestamp", texts, "times as text in /data/demo_0/obs/timestamp"),
            ("stamp", np.column_stack([WHOLE, REST]), "a stamp in the two columns of /data/demo_0"),
        ):
            path = logs.write_robomimic(tmp_path / f"{name}.hdf5", [demo(5, **{name: value})])
            refused(path, said)
            assert read(path, rate_hz=5.0)[0].times[-1] == pytest.approx(0.8)


def test_a_heap_of_texts_in_which_hdf5_would_loop_for_ever_is_refused(tmp_path):
    path = tmp_path / "a.hdf5"
    with h5py.File(path, "w") as file:
        file.create_group("data").attrs["env_args"] = "{}" * 20  # a text of any length: in a heap
    data = bytearray(path.read_bytes())
    start = data.index(b"GCOL")
    data[start + 16 : start + 32] = bytes(16)  # a free space of 0 bytes
    path.write_bytes(data)
    refused(path, "a heap of its texts has a free space of 0 bytes")
