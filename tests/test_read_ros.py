"""Bags of ROS 1 and ROS 2, compared with `rosbags`."""

from __future__ import annotations

import sqlite3
import sys
import tracemalloc
from contextlib import suppress

import numpy as np
import pytest
import robot_logs as logs
from hypothesis import given, settings
from hypothesis import strategies as st
from real_logs import evo
from rosbags.highlevel import AnyReader
from rosbags.rosbag1 import Writer as Writer1
from rosbags.typesys import Stores

from offbeat.data.readers import read, ros
from offbeat.data.readers.ros_layout import find_layout
from offbeat.errors import FileFormatError, InputError, MissingExtraError

S = 10**9
FORMATS = ["bag", "db3", "mcap"]


@pytest.fixture(params=FORMATS)
def write(request, tmp_path):
    """Writes messages in one of the formats; `store` has the types to make them of."""

    def written(messages, name="log"):
        if request.param == "bag":
            return logs.write_bag1(tmp_path / f"{name}.bag", messages)
        folder = tmp_path / f"{name}_{request.param}"
        return logs.write_bag2(folder, messages, mcap=request.param == "mcap")

    written.store = logs.ROS1 if request.param == "bag" else logs.ROS2
    return written


def one(path, **options):
    (recording,) = ros.recordings(path, **options)
    return recording


def refused(path, message, error=FileFormatError, **options):
    with pytest.raises(error, match=message) as caught:
        one(path, **options)
    assert "\n" not in str(caught.value)


def first_record(mcap, code):
    """Start and end of the content of the first record of a kind."""
    at = 8
    while mcap[at : at + 1] != code:
        at += 9 + int.from_bytes(mcap[at + 1 : at + 9], "little")
    return at + 9, at + 9 + int.from_bytes(mcap[at + 1 : at + 9], "little")


def poses(store, n, *, topic="/pose", start=5 * S, late=3_000_000):
    rng = np.random.default_rng(n)
    numbers = rng.normal(size=(n, 7))
    stamps = start + np.cumsum(rng.integers(1, 10**8, n))
    messages = [
        (topic, int(t) + late, logs.pose_message(store, t, row))
        for t, row in zip(stamps, numbers, strict=True)
    ]
    return stamps, numbers, messages


class TestABag:
    def test_gives_numbers_under_their_header_stamps(self, write):
        stamps, numbers, messages = poses(write.store, 50)
        recording = one(write(messages))
        (signal,) = recording.signals
        assert signal.name == "/pose"
        assert signal.stamps.tolist() == stamps.tolist()
        assert signal.values.tobytes("C") == numbers.tobytes()
        assert signal.channels[:4] == (
            "pose.position.x", "pose.position.y", "pose.position.z", "pose.orientation.x",
        )  # fmt: skip
        assert signal.units == ("m", "m", "m", "", "", "", "")
        assert signal.kinds == ("",) * 3 + ("quaternion",) * 4
        assert recording.time_unit == "ns"

    def test_becomes_a_data_set_on_the_union_of_stamps(self, write):
        store = write.store
        messages = [
            ("/a", 1 * S, logs.joint_message(store, 1 * S, ["hip"], [0.5])),
            ("/b", 2 * S, logs.joint_message(store, 2 * S, ["knee"], [1.5])),
            ("/a", 3 * S, logs.joint_message(store, 3 * S, ["hip"], [2.5])),
        ]
        (trajectory,) = read(write(messages), max_gap_s=None)
        assert trajectory.times.tolist() == [0.0, 1.0, 2.0]
        assert trajectory.names == ("/a.position.hip", "/b.position.knee")
        assert np.array_equal(
            trajectory.values, [[0.5, np.nan], [np.nan, 1.5], [2.5, np.nan]], equal_nan=True
        )

    def test_gives_the_topics_and_fields_that_are_asked_for(self, write):
        _, numbers, messages = poses(write.store, 4)
        _, _, others = poses(write.store, 4, topic="/other")
        path = write(messages + others)
        assert [s.name for s in one(path).signals] == ["/pose", "/other"]
        (signal,) = one(path, topics=["/pose"], fields=["pose.position.z"]).signals
        assert signal.channels == ("pose.position.z",)
        assert signal.values[:, 0].tolist() == numbers[:, 2].tolist()
        (signal,) = one(path, topics="/other", fields="pose.position.x").signals
        assert (signal.name, signal.channels) == ("/other", ("pose.position.x",))
        some = one(path, fields=["/pose:pose.position", "pose.orientation.x"])
        assert [s.channels[-1] for s in some.signals] == ["pose.orientation.x"] * 2
        assert [len(s.channels) for s in some.signals] == [4, 1]
        assert set(some.signals[0].kinds) == {""}  # a part of a quaternion is none

    def test_says_which_topics_and_fields_there_are(self, write):
        path = write(poses(write.store, 2)[2])
        refused(
            path, "unknown topic of .* '/pos', expected one of: /pose", InputError, topics=["/pos"]
        )
        refused(
            path, "unknown field 'twist', expected .*pose.position.x", InputError, fields=["twist"]
        )
        refused(path, "'/q', expected one of: /pose", InputError, fields=["/q:pose"])
        refused(path, r"topics must be one name or more, got \[\]", InputError, topics=[])
        refused(path, "unknown stamps 'gps'", InputError, stamps="gps")

    def test_takes_the_time_of_receipt_where_there_is_no_header_stamp(self, write):
        types = write.store.types
        vector = types["geometry_msgs/msg/Vector3"]
        twist = types["geometry_msgs/msg/Twist"](vector(1.0, 2.0, 3.0), vector(4.0, 5.0, 6.0))
        recording = one(write([("/cmd", 7 * S + 1, twist), ("/cmd", 9 * S, twist)]))
        (signal,) = recording.signals
        assert signal.stamps.tolist() == [7 * S + 1, 9 * S]
        assert signal.units == ("m/s",) * 3 + ("rad/s",) * 3
        assert any("times of receipt" in note and "/cmd" in note for note in recording.notes)

    def test_takes_the_time_of_receipt_where_it_is_asked_for_or_headers_are_empty(self, write):
        _, _, messages = poses(write.store, 3)
        received = [t for _, t, _ in messages]
        path = write(messages)
        assert one(path, stamps="receive").signals[0].stamps.tolist() == received
        empty = [("/e", t, logs.pose_message(write.store, 0, np.zeros(7))) for t in received]
        assert one(write(empty, "empty")).signals[0].stamps.tolist() == received

    def test_does_not_mix_two_clocks(self, write):
        _, _, messages = poses(write.store, 3, start=0)  # a simulator's clock
        messages = [(topic, t + 1_700_000_000 * S, m) for topic, t, m in messages]
        types = write.store.types
        point = types["geometry_msgs/msg/Point"](1.0, 2.0, 3.0)
        start = messages[0][1]
        recording = one(write([*messages, ("/bare", start + 5, point)]))
        assert all(s.stamps[0] >= start for s in recording.signals)
        assert any("no time in common" in note and "/bare" in note for note in recording.notes)

    def test_names_sequences_by_the_names_in_the_message_even_when_these_change(self, write):
        store = write.store
        messages = [
            ("/j", 1 * S, logs.joint_message(store, 1 * S, ["a", "b"], [1, 2], [3, 4])),
            ("/j", 2 * S, logs.joint_message(store, 2 * S, ["g"], [5])),
            ("/j", 3 * S, logs.joint_message(store, 3 * S, ["b", "a"], [7, 6])),
            ("/j", 4 * S, logs.joint_message(store, 4 * S, ["a", "b"], [8, 9], [0, 1])),
        ]
        (signal,) = one(write(messages)).signals
        assert signal.stamps.tolist() == [1 * S, 2 * S, 3 * S, 4 * S]
        by_name = dict(zip(signal.channels, signal.values.T.tolist(), strict=True))
        nan = pytest.approx(np.nan, nan_ok=True)
        assert by_name == {
            "position.a": [1, nan, 6, 8],
            "position.b": [2, nan, 7, 9],
            "position.g": [nan, 5, nan, nan],
            "velocity.a": [3, nan, nan, 0],
            "velocity.b": [4, nan, nan, 1],
        }

    def test_makes_a_signal_of_each_transform(self, write):
        types = write.store.types

        def transform(t, child, x):
            return types["geometry_msgs/msg/TransformStamped"](
                logs.header(write.store, t),
                child,
                types["geometry_msgs/msg/Transform"](
                    types["geometry_msgs/msg/Vector3"](x, 0.0, 0.0),
                    types["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0),
                ),
            )

        kind = types["tf2_msgs/msg/TFMessage"]
        messages = [
            ("/tf", 10 * S, kind([transform(1 * S, "arm", 1.0), transform(2 * S, "leg", 2.0)])),
            ("/tf", 11 * S, kind([transform(3 * S, "leg", 3.0)])),
            ("/tf", 12 * S, kind([transform(4 * S, "leg", 4.0), transform(5 * S, "arm", 5.0)])),
        ]
        signals = {s.name: s for s in one(write(messages)).signals}
        assert signals["/tf/arm"].stamps.tolist() == [1 * S, 5 * S]
        assert signals["/tf/leg"].stamps.tolist() == [2 * S, 3 * S, 4 * S]
        assert signals["/tf/leg"].values[:, 0].tolist() == [2.0, 3.0, 4.0]
        assert signals["/tf/leg"].units[0] == "m"

    def test_leaves_out_text_pictures_and_what_is_too_wide_and_says_so(self, write):
        types = write.store.types
        picture = types["sensor_msgs/msg/Image"](
            logs.header(write.store, S), 2, 2, "mono8", 0, 2, np.zeros(4, dtype=np.uint8)
        )
        odometry = types["nav_msgs/msg/Odometry"]
        pose = logs.pose_message(write.store, S, np.ones(7)).pose
        vector = types["geometry_msgs/msg/Vector3"](0.0, 0.0, 0.0)
        message = odometry(
            logs.header(write.store, S),
            "child",
            types["geometry_msgs/msg/PoseWithCovariance"](pose, np.zeros(36)),
            types["geometry_msgs/msg/TwistWithCovariance"](
                types["geometry_msgs/msg/Twist"](vector, vector), np.zeros(36)
            ),
        )
        path = write([("/camera", S, picture), ("/odom", S, message)])
        recording = one(path)
        (signal,) = recording.signals
        assert (signal.name, len(signal.channels)) == ("/odom", 13)
        said = "; ".join(recording.notes)
        assert "topics=: /camera (sensor_msgs/msg/Image)" in said
        assert "child_frame_id (text)" in said
        assert "pose.covariance (covariance, 36 numbers)" in said
        asked = one(path, topics=["/odom"], fields=["twist.covariance"]).signals[0]
        assert asked.channels[35] == "twist.covariance[35]"

    def test_is_read_in_batches_without_effect_on_the_result(self, write, monkeypatch):
        messages = sorted(
            poses(write.store, 40)[2] + poses(write.store, 31, topic="/b")[2],
            key=lambda m: m[1],
        )
        path = write(messages)
        whole = one(path)
        monkeypatch.setattr(ros, "_WAITING_BYTES", 1000)
        parts = one(path)
        for a, b in zip(whole.signals, parts.signals, strict=True):
            assert a.stamps.tobytes() == b.stamps.tobytes()
            assert a.values.tobytes() == b.values.tobytes()

    def test_without_the_extra_says_which_one(self, write, monkeypatch):
        path = write(poses(write.store, 2)[2])
        monkeypatch.setitem(sys.modules, "rosbags", None)
        refused(path, r"offbeat\[ros\]", MissingExtraError)


class TestOtherWaysToWriteABag:
    @pytest.mark.parametrize("compression", list(Writer1.CompressionFormat))
    def test_chunks_of_ros1_may_be_compressed(self, tmp_path, compression):
        _, numbers, messages = poses(logs.ROS1, 20)
        path = logs.write_bag1(tmp_path / "a.bag", messages, compression=compression)
        assert one(path).signals[0].values.tobytes("C") == numbers.tobytes()

    def test_messages_of_ros2_may_be_big_endian(self, tmp_path):
        stamps, numbers, messages = poses(logs.ROS2, 20)
        path = logs.write_bag2(tmp_path / "a", messages, little_endian=False)
        (signal,) = one(path).signals
        assert signal.values.tobytes("C") == numbers.tobytes()
        assert signal.stamps.tolist() == stamps.tolist()

    def test_the_storage_file_alone_is_enough(self, tmp_path):
        _, numbers, messages = poses(logs.ROS2, 5)
        for mcap in (False, True):
            folder = logs.write_bag2(tmp_path / f"m{mcap}", messages, mcap=mcap)
            (file,) = [f for f in folder.iterdir() if f.suffix in (".db3", ".mcap")]
            assert ros.recognises(file)
            assert one(file).signals[0].values.tobytes("C") == numbers.tobytes()

    def test_definitions_that_a_db3_lacks_come_from_the_typestore(self, tmp_path):
        _, numbers, messages = poses(logs.ROS2, 5)
        folder = logs.write_bag2(tmp_path / "bare", messages)
        with sqlite3.connect(folder / "bare.db3") as base:
            base.execute("DELETE FROM message_definitions")
        base.close()
        recording = one(folder)
        assert recording.signals[0].values.tobytes("C") == numbers.tobytes()
        assert any("typestore latest" in note for note in recording.notes)
        assert one(folder, typestore="ros2_foxy").signals[0].values.shape == (5, 7)
        refused(folder, "unknown typestore 'melodic'", InputError, typestore="melodic")

    def test_a_type_that_nobody_defines_is_named(self, tmp_path):
        store = logs.custom_store(Stores.ROS2_HUMBLE, Own="float64 x")
        own = store.types["test_msgs/msg/Own"](1.0)
        folder = logs.write_bag2(
            tmp_path / "bare", [("/own", S, own), *poses(logs.ROS2, 2)[2]], store=store
        )
        with sqlite3.connect(folder / "bare.db3") as base:
            base.execute("DELETE FROM message_definitions")
        base.close()
        refused(
            folder,
            "message type test_msgs/msg/Own of topic /own is defined neither in the bag "
            "nor in the typestore 'latest'.*typestore=, one of: latest, ros2_",
            topics=["/own"],
        )
        recording = one(folder)  # not asked for, it costs a note
        assert [s.name for s in recording.signals] == ["/pose"]
        assert any(note.startswith("/own is left out") for note in recording.notes)

    def test_a_message_that_does_not_fit_its_definition_is_refused(self, tmp_path):
        messages = poses(logs.ROS2, 2)[2]
        folder = logs.write_bag2(tmp_path / "bad", messages)
        with sqlite3.connect(folder / "bad.db3") as base:
            longer = [
                (raw + bytes(8), i) for i, raw in base.execute("SELECT id, data FROM messages")
            ]
            base.executemany("UPDATE messages SET data = ? WHERE id = ?", longer)
        base.close()
        refused(folder, "topic /pose: a message of .* does not fit the definition")

    def test_a_bag_that_says_nothing_in_numbers_lists_its_topics(self, tmp_path):
        text = logs.ROS1.types["std_msgs/msg/String"]("hello")
        path = logs.write_bag1(tmp_path / "t.bag", [("/text", S, text)])
        refused(path, r"holds no numbers in /text; it has the topics /text \(std_msgs/msg/String\)")


class TestDamage:
    @pytest.mark.parametrize("kind", FORMATS)
    def test_a_truncated_file_costs_one_line(self, tmp_path, kind):
        if kind == "bag":
            path = logs.write_bag1(tmp_path / "a.bag", poses(logs.ROS1, 300)[2])
        else:
            folder = logs.write_bag2(tmp_path / "a", poses(logs.ROS2, 300)[2], mcap=kind == "mcap")
            path = folder / f"a.{kind}"
        whole = path.read_bytes()
        for length in (1, 14, 200, len(whole) // 2, len(whole) - 10):
            path.write_bytes(whole[:length])
            if kind == "mcap" and length == len(whole) - 10:  # without the end of its index
                dataset = read(path)
                assert sum(t.rows for t in dataset) == 300
                assert "a.mcap is cut off" in dataset.meta["cleaning"]["notes"][0]
                continue
            refused(path, "can't be read|does not fit|cut short")

    def test_an_mcap_that_is_cut_off_is_read_up_to_there(self, tmp_path):
        folder = logs.write_bag2(tmp_path / "a", poses(logs.ROS2, 300)[2], mcap=True)
        path = folder / "a.mcap"
        whole = path.read_bytes()
        end = first_record(whole, b"\x06")[1]  # of the only chunk
        path.write_bytes(whole[:end])
        assert sum(t.rows for t in read(path)) == 300
        path.write_bytes(whole[: end // 2])
        refused(path, "it is cut off before any topic")

    def test_a_chunk_of_mcap_whose_checksum_does_not_match_is_refused(self, tmp_path):
        folder = logs.write_bag2(tmp_path / "a", poses(logs.ROS2, 300)[2], mcap=True)
        path = folder / "a.mcap"
        raw = bytearray(path.read_bytes())
        raw[first_record(raw, b"\x06")[0] + 24] ^= 1  # of its checksum
        path.write_bytes(raw)
        refused(path, "checksum of a chunk does not match")

    def test_a_bag_whose_recording_was_cut_off_says_how_to_repair_it(self, tmp_path):
        path = logs.write_bag1(tmp_path / "a.bag", poses(logs.ROS1, 3)[2])
        raw = bytearray(path.read_bytes())
        at = raw.index(b"index_pos=") + 10
        raw[at : at + 8] = bytes(8)
        path.write_bytes(raw)
        refused(path, "it has no index, the recording was cut off.*rosbag reindex")

    @pytest.mark.parametrize("suffix", [".bag", ".db3", ".mcap"])
    def test_a_pointer_of_git_lfs_says_so(self, tmp_path, suffix):
        path = tmp_path / f"a{suffix}"
        path.write_text("version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 130\n")
        assert not ros.recognises(path)
        refused(path, "git lfs pull")

    def test_damaged_bytes_are_read_or_cost_one_line(self, tmp_path):
        path = logs.write_bag1(tmp_path / "a.bag", poses(logs.ROS1, 30)[2])
        whole = path.read_bytes()
        rng = np.random.default_rng(0)
        said = []
        for _ in range(60):
            raw = bytearray(whole)
            for at in rng.integers(0, len(raw), 8):
                raw[at] ^= int(rng.integers(1, 256))
            path.write_bytes(raw)
            with suppress(FileFormatError):
                one(path)
                continue
            said.append(path)
        assert len(said) > 10  # any other error has ended the test


def test_memory_does_not_grow_with_the_messages_that_nobody_asked_for(tmp_path):
    picture = logs.ROS1.types["sensor_msgs/msg/Image"]
    pixels = np.zeros(500_000, dtype=np.uint8)
    messages = []
    for i, (topic, t, message) in enumerate(poses(logs.ROS1, 60)[2]):
        image = picture(logs.header(logs.ROS1, t), 500, 1000, "mono8", 0, 1000, pixels)
        messages += [(topic, t, message), ("/camera", t + i, image)]
    path = logs.write_bag1(tmp_path / "big.bag", messages)
    assert path.stat().st_size > 30_000_000
    one(path)  # imports and caches
    tracemalloc.start()
    one(path)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 8_000_000


BASES = [
    "bool",
    "int8",
    "uint8",
    "int16",
    "uint16",
    "int32",
    "uint32",
    "int64",
    "float32",
    "float64",
]


@st.composite
def definitions(draw, depth=2):
    """Fields of a message: (type, suffix, values), where a type may be another such list."""
    fields = []
    for _ in range(draw(st.integers(1, 4))):
        kinds = [*BASES, "string", *(["inner"] if depth else [])]
        kind = draw(st.sampled_from(kinds))
        size = draw(st.sampled_from(["", "[]", f"[{draw(st.integers(1, 3))}]"]))
        count = draw(st.integers(0, 4)) if size == "[]" else int(size.strip("[]") or 1)
        inner = draw(definitions(depth=depth - 1)) if kind == "inner" else None
        fields.append((kind, size, count, inner))
    return fields


def build(fields, name, parsed, seed):
    """The text of a definition, and (path, value) of each number; values are written in `fill`."""
    lines = []
    for i, (kind, size, _, inner) in enumerate(fields):
        if kind == "inner":
            build(inner, f"{name}x{i}", parsed, seed)
            kind = f"test_msgs/{name}x{i}"
        lines.append(f"{kind}{size} f{i}")
    parsed[name] = "\n".join(lines)


def fill(fields, name, store, rng, path="", *, numbers):
    values = []
    for i, (kind, size, count, inner) in enumerate(fields):
        here = f"{path}f{i}"
        made = []
        for k in range(count):
            if kind == "inner":
                # A list of messages of any length is left out, its numbers are no channels.
                kept = numbers if size != "[]" else []
                at = f"{here}[{k}]." if size else f"{here}."
                made.append(fill(inner, f"{name}x{i}", store, rng, at, numbers=kept))
            elif kind == "string":
                made.append("x" * int(rng.integers(0, 6)))
            else:
                dtype = np.dtype(kind)
                value = rng.integers(0, 2 if kind == "bool" else 100)
                made.append(dtype.type(value))
                numbers.append((here + (f"[{k}]" if size else ""), float(value)))
        if not size:
            values.append(made[0])
        elif kind in ("inner", "string"):
            values.append(made)
        else:
            values.append(np.array(made, dtype=kind))
    return store.types[f"test_msgs/msg/{name}"](*values)


@given(fields=definitions(), seed=st.integers(0, 999), cdr=st.booleans(), little=st.booleans())
@settings(max_examples=60)
def test_a_layout_finds_every_number_of_any_message(fields, seed, cdr, little):
    texts = {}
    build(fields, "M", texts, seed)
    store = logs.custom_store(Stores.EMPTY, **texts)
    numbers = []
    message = fill(fields, "M", store, np.random.default_rng(seed), numbers=numbers)
    kind = "test_msgs/msg/M"
    if cdr:
        raw = bytes(store.serialize_cdr(message, kind, little_endian=little))
    else:
        raw = bytes(store.serialize_ros1(message, kind))
    layout = find_layout(raw, kind, store.fielddefs, cdr=cdr)
    table = np.frombuffer(raw, np.uint8)[None]
    assert layout.fits(table).all()
    found = {
        column.name: value
        for row in layout.rows
        for column, value in zip(row.columns, layout.values(table, row)[0], strict=True)
    }
    assert found == dict(numbers)
    for length in range(0, len(raw), 3):  # every way to cut it short is found
        with pytest.raises(FileFormatError):
            find_layout(raw[:length], kind, store.fielddefs, cdr=cdr)


@pytest.mark.parametrize(
    ("name", "topics"),
    [
        ("data/ROS_example.bag", ["groundtruth", "ORB-SLAM", "S-PTAM"]),
        ("data/nav2_turtlebot.mcap", ["/odom", "/amcl_pose"]),
    ],
)
def test_logs_of_other_programs_read_as_rosbags_reads_them(name, topics):
    path = evo(name)
    expected = {topic: ([], []) for topic in topics}
    with AnyReader([path]) as reader:
        for topic in topics:  # one by one, for chunks that alternate make rosbags slow
            connections = [c for c in reader.connections if c.topic == topic]
            for connection, _, raw in reader.messages(connections):
                message = reader.deserialize(raw, connection.msgtype)
                pose = getattr(message.pose, "pose", message.pose)
                p, q, at = pose.position, pose.orientation, message.header.stamp
                expected[topic][0].append(at.sec * S + at.nanosec)
                expected[topic][1].append((p.x, p.y, p.z, q.x, q.y, q.z, q.w))
    fields = ["pose.position", "pose.orientation", "pose.pose.position", "pose.pose.orientation"]
    fields = [f for f in fields if f.count("pose.pose") == name.endswith("mcap")]
    recording = one(path, topics=topics, fields=fields)
    assert {s.name for s in recording.signals} == set(topics)
    for signal in recording.signals:
        stamps, values = expected[signal.name]
        order = np.argsort(signal.stamps, kind="stable")  # rosbags sorts, we keep the log's order
        again = np.argsort(stamps, kind="stable")
        assert signal.stamps[order].tolist() == np.array(stamps)[again].tolist()
        assert np.array_equal(signal.values[order], np.array(values)[again])


@pytest.mark.parametrize("name", ["data/tf_example.bag", "data/tf_example"])
def test_transforms_of_other_programs_are_read(name):
    (trajectory,) = read(evo(name))
    assert trajectory.rows == 517
    assert trajectory.names[0] == "transform.translation.x"
    lengths = np.linalg.norm(trajectory.values[:, 3:], axis=1)
    assert np.allclose(lengths, 1, atol=1e-12)
