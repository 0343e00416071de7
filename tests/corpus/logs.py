"""Logs of robots as programs write them: bags, HDF5 and LeRobot data sets, one per kind."""

from __future__ import annotations

import json
import struct

import h5py
import numpy as np
import robot_logs as logs
from rosbags.typesys import Stores

S = 10**9
ROWS = 40
TICKS = 20_000_000 * np.arange(ROWS)
START = 1_764_000_000 * S
X = np.round(np.sin(0.3 * np.arange(ROWS)), 6)
BAGS = ("bag", "db3", "mcap")


def write_bag(folder, form, messages, store=None):
    """A bag of (topic, time of receipt, message), in one of its forms."""
    if form == "bag":
        return logs.write_bag1(folder / "log.bag", messages, **({"store": store} if store else {}))
    more = {"store": store} if store else {}
    return logs.write_bag2(folder / "log", messages, mcap=form == "mcap", **more)


def base_store(form):
    return logs.ROS1 if form == "bag" else logs.ROS2


def motor_states(folder, form):
    """A list of messages: the state of each motor."""
    store = logs.custom_store(
        Stores.ROS1_NOETIC if form == "bag" else Stores.ROS2_HUMBLE,
        Motor="uint8 mode\nfloat32 q\nfloat32 dq",
        Low="test_msgs/Motor[3] motor_state\nfloat32[2] foot_force",
    )
    types = store.types
    messages = [
        (
            "/lowstate",
            START + int(t),
            types["test_msgs/msg/Low"](
                [types["test_msgs/msg/Motor"](1, x + m, 10 * x) for m in range(3)],
                np.array([x, -x], dtype=np.float32),
            ),
        )
        for t, x in zip(TICKS, X, strict=True)
    ]
    return write_bag(folder, form, messages, store)


def named_motors(folder, form):
    """A list of messages with names, whose order changes."""
    base = Stores.ROS1_NOETIC if form == "bag" else Stores.ROS2_HUMBLE
    store = logs.custom_store(
        base, Joint="string name\nfloat64 q", Arm="test_msgs/Joint[] joints\nfloat64 v"
    )
    types = store.types
    messages = []
    for i, (t, x) in enumerate(zip(TICKS, X, strict=True)):
        joints = [types["test_msgs/msg/Joint"](n, x + k) for k, n in enumerate(("hip", "knee"))]
        arm = types["test_msgs/msg/Arm"](joints[:: -1 if i % 2 else 1], x)
        messages.append(("/arm", START + int(t), arm))
    return write_bag(folder, form, messages, store)


def poses_in_many_frames(folder, form, frames=200):
    """Poses of two rows a frame, each row 2 s after the one before."""
    store = base_store(form)
    stamps = [START + 2 * S * i for i in range(2 * frames)]
    return write_bag(
        folder,
        form,
        [
            ("/pose", t, logs.pose_message(store, t, [i, 0, 0, 0, 0, 0, 1], f"f{i % frames}"))
            for i, t in enumerate(stamps)
        ],
    )


def transforms(folder, form, parents=("odom", "map")):
    """A child frame of two parents, in turns: 100 m ahead in the second."""
    store = base_store(form)
    types = store.types
    made = []
    for i, (t, x) in enumerate(zip(TICKS, X, strict=True)):
        parent = parents[i % 2]
        transform = types["geometry_msgs/msg/TransformStamped"](
            logs.header(store, START + int(t), parent),
            "base_link",
            types["geometry_msgs/msg/Transform"](
                types["geometry_msgs/msg/Vector3"](x + 100 * (parent == "map"), 0.0, 0.0),
                types["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0),
            ),
        )
        made.append(("/tf", START + int(t), types["tf2_msgs/msg/TFMessage"]([transform])))
    return write_bag(folder, form, made)


def poses_in_two_frames(folder, form):
    """Poses whose frame changes in the middle."""
    store = base_store(form)
    return write_bag(
        folder,
        form,
        [
            (
                "/pose",
                START + int(t),
                logs.pose_message(
                    store, START + int(t), [x, 0, 0, 0, 0, 0, 1], "odom" if i < 20 else "map"
                ),
            )
            for i, (t, x) in enumerate(zip(TICKS, X, strict=True))
        ],
    )


def clocks_apart(folder, form, *, still=False):
    """Two topics on header clocks that never meet: one counts from when its device was started.

    Or, with `still`, one whose stamps never change.
    """
    store = base_store(form)
    messages = []
    for t, x in zip(TICKS, X, strict=True):
        received = START + int(t)
        other = START if still else 5 * S + int(t)
        for topic, stamp in (("/imu", START + int(t)), ("/uptime", other)):
            message = logs.pose_message(store, stamp, [x, 0, 0, 0, 0, 0, 1])
            messages.append((topic, received, message))
    return write_bag(folder, form, messages)


def with_a_foreign_topic(folder, form):
    """A topic of a type that can't be read beside one of numbers."""
    base = Stores.ROS1_NOETIC if form == "bag" else Stores.ROS2_HUMBLE
    store = logs.custom_store(base, Wide="float64 wide_x", Plain="float64 x")
    types = store.types
    messages = [
        (topic, START + int(t), types[f"test_msgs/msg/{kind}"](x))
        for t, x in zip(TICKS, X, strict=True)
        for topic, kind in (("/x", "Plain"), ("/wide", "Wide"))
    ]
    path = write_bag(folder, form, messages, store)
    files = [path] if path.is_file() else [f for f in path.iterdir() if f.suffix != ".yaml"]
    for file in files:  # the definition says that it holds a text of wide characters
        raw = bytearray(file.read_bytes().replace(b"float64 wide_x", b"wstring wide_x"))
        if form == "mcap":
            content = raw.index(b"\x06", 40) + 9
            raw[content + 24 : content + 28] = bytes(4)  # no checksum
        file.write_bytes(raw)
    return path


def robomimic(path, *, empty=False, times=None):
    """Two demonstrations of robomimic; one may have no rows, and times may be beside them."""
    with h5py.File(path, "w") as file:
        data = file.create_group("data")
        for i in range(3):
            rows = 0 if empty and i == 1 else ROWS
            demo = data.create_group(f"demo_{i}")
            demo["actions"] = np.zeros((rows, 2))
            demo["obs/eef"] = np.column_stack([X, X + 1])[:rows]
            if times is not None:
                demo[times] = (TICKS / S)[:rows]
    return path


def lerobot(folder, version, *, zero_stamps=False):
    """Features whose names begin like those of actions, tasks and texts."""
    names = ("task_space_position", "actions_executed", "language_level")
    episodes = []
    for i in range(2):
        episode = logs.lerobot_episode(i, ROWS)
        for k, name in enumerate(names):
            episode[name] = (X + k).astype(np.float32)
        episode["complementary_info.force"] = X.astype(np.float32)
        if zero_stamps:
            episode["timestamp"] = np.zeros(ROWS, dtype=np.float32)
        episodes.append(episode)
    number = {"dtype": "float32", "shape": [1], "names": None}
    features = {**logs.FEATURES, **dict.fromkeys((*names, "complementary_info.force"), number)}
    return logs.write_lerobot(folder, episodes, version=version, features=features)


def changed_info(folder, **changes):
    """Changes the metadata of a LeRobot data set."""
    path = folder / "meta" / "info.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), **changes}))
    return folder


def _record(code, content):
    return struct.pack("<BQ", code, len(content)) + content


def _text(text):
    return struct.pack("<I", len(text.encode())) + text.encode()


def write_mcap(path, topics, *, profile="", end=True):
    """An MCAP file without chunks.

    Args:
        path: of the file.
        topics: {name: (encoding, type, encoding of the definition, definition, messages)}; messages
            are (time of receipt, bytes).
        profile: in the header.
        end: whether it has an end, or was cut off.
    """
    magic = b"\x89MCAP0\r\n"
    out = [magic, _record(1, _text(profile) + _text("tests"))]
    for i, (topic, (encoding, kind, form, definition, _)) in enumerate(topics.items(), 1):
        schema = struct.pack("<H", i) + _text(kind) + _text(form) + _text(definition)
        out.append(_record(3, schema))
        channel = struct.pack("<HH", i, i) + _text(topic) + _text(encoding) + struct.pack("<I", 0)
        out.append(_record(4, channel))
    for i, (*_, messages) in enumerate(topics.values(), 1):
        for k, (received, message) in enumerate(messages):
            head = struct.pack("<HIQQ", i, k, received, received)
            out.append(_record(5, head + message))
    if end:
        out += [_record(15, bytes(4)), _record(2, bytes(20)), magic]
    path.write_bytes(b"".join(out))
    return path


def mcap_of_ros1(path, profile):
    """Numbers of ROS 1 in an MCAP file, beside a topic of JSON."""
    numbers = [(START + int(t), struct.pack("<d", x)) for t, x in zip(TICKS, X, strict=True)]
    texts = [(START + int(t), b'{"x": 1}') for t in TICKS]
    topics = {
        "/x": ("ros1", "std_msgs/Float64", "ros1msg", "float64 data", numbers),
        "/json": ("json", "thing", "jsonschema", '{"type": "object"}', texts),
        "/bytes": ("protobuf", "pkg.Thing", "protobuf", "\x01\x02", texts),
    }
    return write_mcap(path, topics, profile=profile)
