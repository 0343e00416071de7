"""Formats that data sets are written in, and a format from outside the package."""

from __future__ import annotations

import json

import numpy as np
import pyarrow.parquet as pq
import pytest

import offbeat as ob
from offbeat.data.writers import WRITERS, register_writer, save
from offbeat.data.writers.tables import write_table


def made(**meta) -> ob.Dataset:
    random = np.random.default_rng(0)
    trajectories = []
    for rows in (5, 3):
        values = random.normal(size=(rows, 2))
        values[1, 0] = np.nan
        times = np.arange(rows) / 8
        trajectories.append(ob.Trajectory(times, values, names=("hip", "knee"), units=("rad", "")))
    return ob.Dataset(tuple(trajectories), meta)


@pytest.mark.parametrize("name", ["walk.csv", "walk.pq"])
@pytest.mark.parametrize("labels", [["a", "b"], None])
def test_a_table_that_is_read_back_has_the_same_times_values_names_and_units(
    tmp_path, name, labels
):
    data = made(**({"labels": labels} if labels else {}))
    save(data, tmp_path / name)
    again = ob.read(tmp_path / name)
    assert again.fingerprint() == data.fingerprint()
    assert again.meta["labels"] == (labels or ["0", "1"])


@pytest.mark.parametrize("step", [10.0, 11.0, 60.0, 3600.0, 86_400.0])
@pytest.mark.parametrize("suffix", ["csv", "pq"])
def test_times_of_any_step_are_read_back_in_seconds(step, suffix, tmp_path):
    slow = ob.Trajectory(step * np.arange(50), np.ones((50, 1)), names=("x",))
    save(ob.Dataset([slow]), tmp_path / f"walk.{suffix}")
    (again,) = ob.read(tmp_path / f"walk.{suffix}", max_gap_s=None, clock_jumps="join")
    assert again.times.tolist() == slow.times.tolist()
    columns = {"trajectory": [0] * 50, "time": slow.times, "x": [1] * 50, "x|observed": [True] * 50}
    write_table(tmp_path / f"filled.{suffix}", columns)
    (again,) = ob.read(tmp_path / f"filled.{suffix}", max_gap_s=None, clock_jumps="join")
    assert again.times.tolist() == slow.times.tolist()


def test_columns_are_called_by_channel_and_unit(tmp_path):
    save(made(), tmp_path / "walk.pq")
    names = pq.read_schema(tmp_path / "walk.pq").names
    assert names == ["trajectory", "time [s]", "hip [rad]", "knee"]


def test_the_suffix_parquet_is_the_own_format(tmp_path):
    masked = ob.mask_out(made(), 0.5)
    save(masked, tmp_path / "walk.parquet")
    assert ob.load(tmp_path / "walk.parquet").fingerprint() == masked.fingerprint()
    save(masked, tmp_path / "walk.data", format="offbeat")
    assert ob.load(tmp_path / "walk.data").fingerprint() == masked.fingerprint()


def test_a_format_of_another_package_is_written_and_read(tmp_path):
    register_writer("rows", lambda data, path: None, suffixes=(".n",))
    try:
        register_writer(
            "rows",
            lambda data, path: path.write_text(str(data[0].rows)),
            suffixes=(".n",),
            replace=True,
        )
        ob.save(made(), tmp_path / "walk.n")
        assert (tmp_path / "walk.n").read_text() == "5"
    finally:
        WRITERS.unregister("rows")


def test_unknown_formats_and_names_that_collide_are_refused(tmp_path):
    with pytest.raises(
        ob.InputError, match=r"suffix '.xls', expected one of: offbeat \(.parquet\)"
    ):
        save(made(), tmp_path / "walk.xls")
    with pytest.raises(ob.InputError, match="did you mean 'csv'"):
        save(made(), tmp_path / "walk", format="cvs")
    clash = ob.Dataset((ob.Trajectory([0.0], [[1.0]], names=("time",)),))
    with pytest.raises(ob.InputError, match="would have the name 'time'"):
        save(clash, tmp_path / "walk.csv")


@pytest.mark.parametrize("name", sorted(WRITERS))
def test_every_format_keeps_times_values_names_and_units(tmp_path, name):
    writer = WRITERS[name]
    if name in NEEDS:
        pytest.importorskip(NEEDS[name])
    path = tmp_path / ("walk" if writer.is_folder else f"walk{writer.suffixes[0]}")
    save(made(), path, format=name)
    again = ob.read(path)
    assert (again.names, again.units) == (made().names, made().units)
    for a, b in zip(again, made(), strict=True):
        assert a.times.tolist() == b.times.tolist()
        values = b.values.astype(np.float32) if name == "lerobot" else b.values
        assert np.array_equal(a.values, values, equal_nan=True)


NEEDS = {"robomimic": "h5py", "minari": "h5py", "mcap": "mcap"}


def walk(rows=(20, 12)) -> ob.Dataset:
    """Uneven times on a clock, a masked value, a channel that is an action."""
    random = np.random.default_rng(3)
    each = []
    for n in rows:
        values = random.normal(size=(n, 4)).astype(np.float32).astype(np.float64)
        observed = random.random((n, 4)) < 0.7
        each.append(
            ob.Trajectory(
                np.cumsum(random.integers(10, 50, n)) / 1000 - 0.01,
                values,
                observed=observed,
                names=("hip", "knee", "foot", "motor"),
                units=("rad", "rad", "m", "N"),
                roles=("state", "state", "state", "action"),
            )
        )
    starts = [1_700_000_000_123_456_789 + 10**11 * i for i in range(len(rows))]
    return ob.Dataset(tuple(each), {"clock_start": starts, "time_unit": "ns", "source": "walk.bag"})


def stamps(data) -> list[list[int]]:
    starts = data.meta["clock_start"]
    return [
        [start + round(t * 1e9) for t in one.times.tolist()]
        for start, one in zip(starts, data, strict=True)
    ]


class TestLeRobot:
    @pytest.fixture
    def folder(self, tmp_path):
        save(walk(), tmp_path / "walk", rate_hz=30, task="walk a step")
        return tmp_path / "walk"

    def test_its_rows_and_metadata_are_those_of_version_3(self, folder):
        info = json.loads((folder / "meta" / "info.json").read_text())
        assert info["codebase_version"] == "v3.0"
        assert (info["total_episodes"], info["total_frames"], info["fps"]) == (2, 32, 30)
        table = pq.read_table(folder / "data" / "chunk-000" / "file-000.parquet")
        assert set(table.column_names) == set(info["features"])
        assert table["index"].to_pylist() == list(range(32))
        assert table["frame_index"].to_pylist() == [*range(20), *range(12)]
        expected = (np.arange(20) / 30).astype(np.float32)
        assert table["timestamp"].to_numpy()[:20].tolist() == expected.tolist()
        assert table["complementary_info.time_ns"].to_pylist() == [
            stamp for each in stamps(walk()) for stamp in each
        ]
        state = np.concatenate([t.values[:, :3] for t in walk()])
        assert np.array_equal(table["observation.state"].to_pylist(), state)
        masks = np.concatenate([t.observed for t in walk()])
        assert np.array_equal(table["complementary_info.observed"].to_pylist(), masks)
        for name, feature in info["features"].items():
            assert feature["shape"] == [getattr(table.schema.field(name).type, "list_size", 1)]

    def test_its_episodes_say_where_they_are_and_their_statistics(self, folder):
        path = folder / "meta" / "episodes" / "chunk-000" / "file-000.parquet"
        first, second = pq.read_table(path).to_pylist()
        assert (second["dataset_from_index"], second["dataset_to_index"]) == (20, 32)
        assert first["tasks"] == ["walk a step"]
        hip = walk()[1].values[:, 0]
        assert second["stats/observation.state/mean"][0] == pytest.approx(hip.mean(), abs=1e-12)
        assert second["stats/observation.state/q90"][0] == pytest.approx(np.quantile(hip, 0.9))
        whole = json.loads((folder / "meta" / "stats.json").read_text())
        every = np.concatenate([t.values[:, 0] for t in walk()])
        assert whole["observation.state"]["std"][0] == pytest.approx(every.std(), abs=1e-12)
        assert whole["observation.state"]["count"] == [32]

    def test_pandas_reads_its_tasks_by_name_as_lerobot_does(self, folder):
        pandas = pytest.importorskip("pandas")
        tasks = pandas.read_parquet(folder / "meta" / "tasks.parquet")
        assert tasks.loc["walk a step", "task_index"] == 0
        assert tasks.index.name == "task"

    def test_it_is_read_back_on_the_clock_of_the_log_with_its_action(self, folder):
        again = ob.read(folder)
        assert stamps(again) == stamps(walk())
        assert again.names == ("hip", "knee", "foot", "action.motor")
        assert again.roles == walk().roles
        assert np.array_equal(again[0].values, walk()[0].values)
        save(again, folder, rate_hz=30)  # what is there is replaced
        assert ob.read(folder).fingerprint() == again.fingerprint()

    def test_a_folder_of_other_files_is_not_replaced(self, tmp_path):
        (tmp_path / "thesis.tex").write_text("x")
        for name in ("lerobot", "minari"):
            with pytest.raises(ob.InputError, match="holds other files"):
                save(walk(), tmp_path, format=name)
        assert (tmp_path / "thesis.tex").read_text() == "x"


class TestHdf5:
    @pytest.fixture(autouse=True)
    def h5py(self):
        return pytest.importorskip("h5py")

    def test_robomimic_has_a_demonstration_per_trajectory(self, h5py, tmp_path):
        save(walk(), tmp_path / "walk.hdf5", rate_hz=25)
        with h5py.File(tmp_path / "walk.hdf5") as file:
            data = file["data"]
            said = json.loads(data.attrs["env_args"])
            assert said["env_kwargs"]["control_freq"] == 25
            assert (data.attrs["total"], sorted(data)) == (32, ["demo_0", "demo_1"])
            demo = data["demo_1"]
            assert np.array_equal(demo["obs/state"], walk()[1].values[:, :3])
            assert np.array_equal(demo["actions"], walk()[1].values[:, 3:])
            assert np.array_equal(demo["observed"], walk()[1].observed)
            assert demo["time_ns"][()].tolist() == stamps(walk())[1]
            assert demo["dones"][()].tolist() == [0] * 11 + [1]
            assert demo.attrs["num_samples"] == 12

    def test_minari_has_one_action_less_than_observations(self, h5py, tmp_path):
        save(walk(), tmp_path / "walk", format="minari")
        said = json.loads((tmp_path / "walk" / "data" / "metadata.json").read_text())
        assert (said["total_episodes"], said["total_steps"]) == (2, 30)
        assert json.loads(said["observation_space"])["shape"] == [3]
        with h5py.File(tmp_path / "walk" / "data" / "main_data.hdf5") as file:
            episode = file["episode_0"]
            assert episode["observations"].shape == (20, 3)
            assert np.array_equal(episode["actions"], walk()[0].values[:-1, 3:])
            assert episode["infos/time_ns"][()].tolist() == stamps(walk())[0]
            assert episode["truncations"][()].tolist() == [False] * 18 + [True]

    def test_minari_itself_reads_its_folder(self, tmp_path):
        minari = pytest.importorskip("minari")
        save(walk(), tmp_path / "walk", format="minari")
        data = minari.MinariDataset(tmp_path / "walk" / "data")
        first = next(iter(data.iterate_episodes()))
        assert (data.total_steps, first.observations.shape) == (30, (20, 3))

    @pytest.mark.parametrize("name", ["robomimic", "minari"])
    def test_both_are_read_back_with_names_units_roles_and_clock(self, tmp_path, name):
        path = tmp_path / ("walk.hdf5" if name == "robomimic" else "walk")
        save(walk(), path, format=name)
        again = ob.read(path)
        assert (again.names, again.units) == (walk().names, walk().units)
        assert again.roles == walk().roles
        assert stamps(again) == stamps(walk())


class TestMcap:
    @pytest.fixture(autouse=True)
    def mcap(self):
        return pytest.importorskip("mcap.reader")

    def test_rows_are_json_with_stamps_masks_and_a_schema(self, mcap, tmp_path):
        save(walk(), tmp_path / "walk.mcap")
        with (tmp_path / "walk.mcap").open("rb") as file:
            reader = mcap.make_reader(file)
            summary = reader.get_summary()
            assert summary.statistics.message_count == 32
            (schema,) = summary.schemas.values()
            assert (schema.name, schema.encoding) == ("offbeat.Row", "jsonschema")
            assert json.loads(schema.data)["x-units"] == list(walk().units)
            found = list(reader.iter_messages(topics=["/offbeat/1"]))
        assert [message.log_time for _, _, message in found] == stamps(walk())[1]
        said = json.loads(found[3][2].data)
        time = said["timestamp"]
        assert time["sec"] * 10**9 + time["nsec"] == found[3][2].log_time
        assert said["values"] == dict(zip(walk().names, walk()[1].values[3].tolist(), strict=True))
        assert list(said["observed"].values()) == walk()[1].observed[3].tolist()

    def test_it_is_read_back_with_names_units_roles_and_clock(self, tmp_path):
        save(walk(), tmp_path / "walk.mcap")
        again = ob.read(tmp_path / "walk.mcap")
        assert (again.names, again.units) == (walk().names, walk().units)
        assert again.roles == walk().roles
        assert stamps(again) == stamps(walk())
        assert again.meta["labels"] == ["0", "1"]
        assert again[1].values.tobytes() == walk()[1].values.tobytes()

    @pytest.mark.parametrize("kind", ["db3", "mcap", "bag"])
    def test_the_messages_of_a_bag_are_repeated_at_other_times(self, mcap, tmp_path, kind):
        logs = pytest.importorskip("robot_logs")
        store = logs.ROS1 if kind == "bag" else logs.ROS2
        start = 1_700_000_000 * 10**9
        messages = []
        for i in range(40):
            at = start + i * 10**7
            joints = logs.joint_message(store, at, ["hip", "knee"], [i / 8, -i / 4])
            pose = logs.pose_message(store, at + 3000, [i, 2, 3, 0, 0, 0, 1], f"frame{i % 3}")
            messages += [("/joints", at, joints), ("/pose", at + 5000, pose)]
        log = tmp_path / ("walk.bag" if kind == "bag" else "walk")
        if kind == "bag":
            logs.write_bag1(log, messages)
        else:
            logs.write_bag2(log, messages, mcap=kind == "mcap")
        data = ob.read(log, topics=["/joints"])
        at = np.array([0.0, 0.005, 0.0175, 0.2])
        asked = ob.Trajectory(at, np.column_stack([at, 2 * at]), names=data.names)
        out = tmp_path / "out.mcap"
        clock = {"clock_start": [start], "time_unit": "ns"}
        save(ob.Dataset((asked,), clock), out, log=log)
        with out.open("rb") as file:
            reader = mcap.make_reader(file)
            summary = reader.get_summary()
            topics = {c.topic: c.message_encoding for c in summary.channels.values()}
            encoding = "ros1" if kind == "bag" else "cdr"
            assert topics == {"/joints": encoding, "/offbeat": encoding}
            found = list(reader.iter_messages(topics=["/joints"]))
        for (schema, _, message), t in zip(found, at, strict=True):
            assert message.log_time == start + round(t * 1e9)
            if kind == "bag":
                assert schema.name == "sensor_msgs/JointState"
                assert schema.encoding == "ros1msg"
                got = store.deserialize_ros1(message.data, "sensor_msgs/msg/JointState")
            else:
                assert (schema.name, schema.encoding) == ("sensor_msgs/msg/JointState", "ros2msg")
                got = store.deserialize_cdr(message.data, "sensor_msgs/msg/JointState")
            assert got.name == ["hip", "knee"]
            assert got.position.tolist() == [t, 2 * t]
            assert got.header.stamp.sec * 10**9 + got.header.stamp.nanosec == message.log_time
        again = ob.read(out)
        assert again[0].values.tolist() == asked.values.tolist()
        assert again.names == data.names
        if kind != "bag":
            rosbags = pytest.importorskip("rosbags.rosbag2")
            with rosbags.Reader(out) as bag:
                found = list(bag.messages())
                (kind,) = [c for c in bag.connections if c.topic == "/offbeat"]
            times = [t for c, t, _ in found if c.topic == "/joints"]
            assert times == [start + round(t * 1e9) for t in at]
            typesys = pytest.importorskip("rosbags.typesys")
            types = typesys.get_typestore(typesys.Stores.EMPTY)
            types.register(typesys.get_types_from_msg(kind.msgdef.data, kind.msgtype))
            last = types.deserialize_cdr(found[-1][2], kind.msgtype)
            assert last.names == list(data.names)
            assert last.values.tolist() == asked.values[-1].tolist()
            assert last.observed.tolist() == [True, True]
            assert len(last.low) == 0

    def test_texts_and_frames_are_those_of_the_message_before(self, tmp_path):
        logs = pytest.importorskip("robot_logs")
        messages = [
            ("/pose", 10**18 + i * 10**7, logs.pose_message(
                logs.ROS2, 10**18 + i * 10**7, [i, 0, 0, 0, 0, 0, 1], "base"))
            for i in range(30)
        ]  # fmt: skip
        log = logs.write_bag2(tmp_path / "walk", messages)
        data = ob.read(log)
        from offbeat.data.writers.ros_messages import messages_like

        (topic,) = messages_like(log, data, [10**18 + np.arange(30) * 10**7 + 1])
        got = logs.ROS2.deserialize_cdr(topic.messages[7][1], "geometry_msgs/msg/PoseStamped")
        assert got.header.frame_id == "base"
        assert got.pose.position.x == 7
        assert got.header.stamp.nanosec == 7 * 10**7 + 1

    def test_a_time_before_0_and_a_damaged_row_are_refused(self, tmp_path, mcap):
        early = ob.Dataset((ob.Trajectory([-1.0, 0.0], [[1.0], [2.0]]),))
        with pytest.raises(ob.InputError, match="no times before 0"):
            save(early, tmp_path / "walk.mcap")
        from mcap.writer import Writer

        with (tmp_path / "bad.mcap").open("wb") as file:
            writer = Writer(file)
            writer.start()
            described = {"x-names": ["x"], "x-units": [""], "x-roles": ["state"]}
            schema = writer.register_schema(
                "offbeat.Row", "jsonschema", json.dumps(described).encode()
            )
            channel = writer.register_channel("/offbeat", "json", schema)
            writer.add_message(channel, 0, b'{"values": {}}', 0)
            writer.finish()
        with pytest.raises(ob.FileFormatError, match="a row of topic /offbeat is damaged"):
            ob.read(tmp_path / "bad.mcap")


def test_npz_holds_masks_and_is_read_back_without_them(tmp_path):
    save(walk(), tmp_path / "walk.npz")
    with np.load(tmp_path / "walk.npz", allow_pickle=False) as file:
        assert np.array_equal(file["observed"], np.concatenate([t.observed for t in walk()]))
        assert file["roles"].tolist() == list(walk().roles)
    again = ob.read(tmp_path / "walk.npz")
    assert again.names == walk().names
    assert stamps(again) == stamps(walk())
    chosen = ob.read(tmp_path / "walk.npz", channels=["observed.1"])
    assert chosen[0].values[:, 0].tolist() == walk()[0].observed[:, 1].tolist()


def test_npz_is_read_back_with_names_that_look_like_units_and_in_seconds(tmp_path):
    times, values = 60.0 * np.arange(30), np.arange(60.0).reshape(30, 2)
    names = ("x [m]", "y")
    walk = ob.Dataset([ob.Trajectory(times, values, names=names, units=("", "deg"))])
    save(walk, tmp_path / "walk.npz")
    again = ob.read(tmp_path / "walk.npz")
    assert (again.names, again.units) == (("x", "y"), ("m", "deg"))
    assert again[0].times.tolist() == times.tolist()
    assert again[0].values.tolist() == values.tolist()
    time = ob.Trajectory(times, values, names=("time", "y"))
    save(ob.Dataset([time]), tmp_path / "walk.npz")
    with pytest.raises(ob.FileFormatError, match="an array of times with the name 'time'"):
        ob.read(tmp_path / "walk.npz")


def test_values_beyond_float32_are_not_written_as_lerobot(tmp_path):
    walk = ob.Trajectory([0.0, 1.0], [[1e300], [0.0]], names=("x",))
    with pytest.raises(ob.InputError, match=r"channel 'x' has values beyond 3.4e38"):
        save(ob.Dataset([walk]), tmp_path / "walk", format="lerobot")
    assert list(tmp_path.iterdir()) == []


def test_options_of_a_format_are_checked(tmp_path):
    with pytest.raises(ob.InputError, match="takes no options, got 'rate_hz'"):
        save(walk(), tmp_path / "walk.csv", rate_hz=3)
    with pytest.raises(ob.InputError, match=r"unknown option of the format lerobot 'fps'"):
        save(walk(), tmp_path / "walk", fps=3)
    with pytest.raises(ob.InputError, match="rate_hz must be a positive number"):
        save(walk(), tmp_path / "walk", rate_hz=-3)
    acted = walk().select(["motor"])
    with pytest.raises(ob.InputError, match="only actions"):
        save(acted, tmp_path / "walk")
    assert not list(tmp_path.iterdir())
