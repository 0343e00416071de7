"""Logs of robots that tests write, one function per format, and where real ones may lie."""

from __future__ import annotations

import json
import struct

import h5py
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

ROS1 = get_typestore(Stores.ROS1_NOETIC)
ROS1.register(
    get_types_from_msg("geometry_msgs/TransformStamped[] transforms", "tf2_msgs/msg/TFMessage")
)
ROS2 = get_typestore(Stores.ROS2_HUMBLE)


def stamp(types, nanoseconds):
    """A time as ROS holds it."""
    return types["builtin_interfaces/msg/Time"](*divmod(int(nanoseconds), 10**9))


def header(store, nanoseconds, frame="base"):
    """A header; ROS 1 counts them, too."""
    types = store.types
    first = () if store is ROS2 else (0,)
    return types["std_msgs/msg/Header"](*first, stamp(types, nanoseconds), frame)


def pose_message(store, nanoseconds, numbers, frame="base"):
    """A PoseStamped of 7 numbers."""
    types = store.types
    return types["geometry_msgs/msg/PoseStamped"](
        header(store, nanoseconds, frame),
        types["geometry_msgs/msg/Pose"](
            types["geometry_msgs/msg/Point"](*map(float, numbers[:3])),
            types["geometry_msgs/msg/Quaternion"](*map(float, numbers[3:])),
        ),
    )


def joint_message(store, nanoseconds, names, position, velocity=()):
    """A JointState."""
    return store.types["sensor_msgs/msg/JointState"](
        header(store, nanoseconds),
        list(names),
        np.array(position, dtype=np.float64),
        np.array(velocity, dtype=np.float64),
        np.array([], dtype=np.float64),
    )


def write_bag1(path, messages, *, compression=None, store=ROS1):
    """A ROS 1 bag of (topic, time of receipt, message)."""
    writer = Writer1(path)
    if compression:
        writer.set_compression(compression)
    with writer:
        connections = {}
        for topic, received, message in messages:
            kind = message.__msgtype__
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=store)
            writer.write(connections[topic], received, store.serialize_ros1(message, kind))
    return path


def write_bag2(path, messages, *, mcap=False, store=ROS2, little_endian=True):
    """The folder of a ROS 2 bag of (topic, time of receipt, message)."""
    plugin = StoragePlugin.MCAP if mcap else StoragePlugin.SQLITE3
    with Writer2(path, version=9, storage_plugin=plugin) as writer:
        connections = {}
        for topic, received, message in messages:
            kind = message.__msgtype__
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=store)
            raw = store.serialize_cdr(message, kind, little_endian=little_endian)
            writer.write(connections[topic], received, raw)
    return path


def custom_store(base, **definitions):
    """A typestore with message types of our own, `Name=text`, as `test_msgs/msg/Name`."""
    store = get_typestore(base)
    parsed = {}
    for name, text in definitions.items():
        parsed |= get_types_from_msg(text, f"test_msgs/msg/{name}")
    store.register(parsed)
    return store


_ULOG_CODES = {
    "uint64_t": "Q", "int64_t": "q", "uint32_t": "I", "int32_t": "i", "uint16_t": "H",
    "uint8_t": "B", "int8_t": "b", "float": "f", "double": "d", "bool": "?", "char": "c",
}  # fmt: skip


def _ulog_message(kind, payload):
    return struct.pack("<HB", len(payload), ord(kind)) + payload


def ulog_bytes(formats, rows, *, start_us=1_000, dropouts=()):
    """A ULog, as docs.px4.io defines it.

    Args:
        formats: {topic: "uint64_t timestamp;float x;"}.
        rows: (topic, instance, (values, ...)) in the order of the log.
        start_us: stamp of the header.
        dropouts: {position in rows: milliseconds}.
    """
    out = [b"ULog\x01\x12\x35\x01", struct.pack("<Q", start_us)]
    out.append(_ulog_message("B", bytes(40)))
    packers = {}
    for topic, text in formats.items():
        out.append(_ulog_message("F", f"{topic}:{text}".encode()))
        code = ""
        fields = text.rstrip(";").split(";")
        if fields[-1].split()[1].startswith("_padding"):
            fields.pop()  # at the end of a message it is not logged
        for field in fields:
            base, _, count = field.split()[0].partition("[")
            code += (count.rstrip("]") or "1") + _ULOG_CODES[base]
        packers[topic] = struct.Struct("<" + code)
    numbers = {}
    for topic, instance, _ in rows:
        if (topic, instance) not in numbers:
            number = numbers[topic, instance] = len(numbers)
            out.append(_ulog_message("A", struct.pack("<BH", instance, number) + topic.encode()))
    for i, (topic, instance, values) in enumerate(rows):
        if i in dict(dropouts):
            out.append(_ulog_message("O", struct.pack("<H", dict(dropouts)[i])))
        number = struct.pack("<H", numbers[topic, instance])
        out.append(_ulog_message("D", number + packers[topic].pack(*values)))
    return b"".join(out)


def write_robomimic(path, demos, *, control_freq=20, masks=()):
    """HDF5 of robomimic: a dictionary per demonstration, of observations and `actions`."""
    with h5py.File(path, "w") as file:
        data = file.create_group("data")
        data.attrs["total"] = sum(len(demo["actions"]) for demo in demos)
        if control_freq is not None:
            said = {"env_name": "Lift", "type": 1, "env_kwargs": {"control_freq": control_freq}}
            data.attrs["env_args"] = json.dumps(said)
        for i, demo in enumerate(demos):
            group = data.create_group(f"demo_{i}")
            group.attrs["num_samples"] = len(demo["actions"])
            for name, values in demo.items():
                group.create_dataset(name if name == "actions" else f"obs/{name}", data=values)
        for name, listed in dict(masks).items():
            file.create_dataset(f"mask/{name}", data=np.array(listed, dtype="S"))
    return path


def write_minari(folder, episodes, *, data_format="hdf5"):
    """The folder of a Minari data set: (observations, actions) per episode, either nested."""

    def put(group, name, values):
        if isinstance(values, dict):
            for key, inner in values.items():
                put(group.require_group(name), key, inner)
        elif isinstance(values, tuple):
            put(group, name, {f"_index_{i}": inner for i, inner in enumerate(values)})
        else:
            group.create_dataset(name, data=values)

    (folder / "data").mkdir(parents=True)
    said = {"total_episodes": len(episodes), "data_format": data_format, "dataset_id": "own/x-v0"}
    (folder / "data" / "metadata.json").write_text(json.dumps(said))
    with h5py.File(folder / "data" / "main_data.hdf5", "w", track_order=True) as file:
        for i, (observations, actions) in enumerate(episodes):
            group = file.create_group(f"episode_{i}")
            group.attrs["id"], group.attrs["total_steps"] = i, 0
            put(group, "observations", observations)
            put(group, "actions", actions)
            group.create_dataset("rewards", data=np.zeros(3))
            group.create_dataset("infos", data=["{}"] * 3, dtype=h5py.string_dtype())
    return folder


FEATURES = {
    "observation.state": {"dtype": "float32", "shape": [3], "names": ["hip", "knee", "ankle"]},
    "action": {"dtype": "float32", "shape": [2], "names": {"motors": ["left", "right"]}},
    "observation.images.front": {
        "dtype": "video", "shape": [48, 64, 3], "names": ["height", "width", "channel"],
    },
    "next.reward": {"dtype": "float32", "shape": [1], "names": None},
    "timestamp": {"dtype": "float32", "shape": [1], "names": None},
    "frame_index": {"dtype": "int64", "shape": [1], "names": None},
    "episode_index": {"dtype": "int64", "shape": [1], "names": None},
    "index": {"dtype": "int64", "shape": [1], "names": None},
    "task_index": {"dtype": "int64", "shape": [1], "names": None},
}  # fmt: skip
"""Features as LeRobot writes them into `info.json`."""


def lerobot_episode(number, rows, *, fps=20, seed=0, start=0):
    """The columns of one episode."""
    rng = np.random.default_rng([seed, number])
    return {
        "observation.state": rng.normal(size=(rows, 3)).astype(np.float32),
        "action": rng.normal(size=(rows, 2)).astype(np.float32),
        "next.reward": np.zeros(rows, dtype=np.float32),
        "timestamp": (np.arange(rows) / fps).astype(np.float32),
        "frame_index": np.arange(rows),
        "episode_index": np.full(rows, number),
        "index": start + np.arange(rows),
        "task_index": np.zeros(rows, dtype=np.int64),
    }


def _table(episodes):
    columns = {}
    for name in episodes[0]:
        values = np.concatenate([episode[name] for episode in episodes])
        columns[name] = list(values) if values.ndim > 1 else values
    return pa.table(columns)


def write_lerobot(folder, episodes, *, version="v2.1", features=FEATURES, fps=20, per_file=2):
    """A LeRobot data set of version 2.1 (a file per episode) or 3.0 (several in each)."""
    packed = version.startswith("v3")
    info = {
        "codebase_version": version,
        "robot_type": "own",
        "total_episodes": len(episodes),
        "total_frames": sum(len(e["timestamp"]) for e in episodes),
        "chunks_size": 1000,
        "fps": fps,
        "splits": {"train": f"0:{len(episodes)}"},
        "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
        if packed
        else "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet",
        "features": features,
    }
    (folder / "meta").mkdir(parents=True)
    (folder / "data" / "chunk-000").mkdir(parents=True)
    (folder / "meta" / "info.json").write_text(json.dumps(info))
    said = []
    start = 0
    for i, episode in enumerate(episodes):
        rows = len(episode["timestamp"])
        said.append(
            {
                "episode_index": i,
                "tasks": ["walk"],
                "length": rows,
                "data/chunk_index": 0,
                "data/file_index": i // per_file,
                "dataset_from_index": start,
                "dataset_to_index": start + rows,
            }
        )
        start += rows
    if packed:
        (folder / "meta" / "episodes" / "chunk-000").mkdir(parents=True)
        pq.write_table(
            pa.Table.from_pylist(said), folder / "meta/episodes/chunk-000/file-000.parquet"
        )
        for k in range(0, len(episodes), per_file):
            path = folder / f"data/chunk-000/file-{k // per_file:03d}.parquet"
            pq.write_table(_table(episodes[k : k + per_file]), path)
    else:
        lines = [{k: s[k] for k in ("episode_index", "tasks", "length")} for s in said]
        text = "".join(json.dumps(line) + "\n" for line in lines)
        (folder / "meta" / "episodes.jsonl").write_text(text)
        for i, episode in enumerate(episodes):
            pq.write_table(_table([episode]), folder / f"data/chunk-000/episode_{i:06d}.parquet")
    return folder


def _joints(store, stamps, values):
    received = int(min(stamps)) + 10**6 * np.arange(len(stamps))  # in the order of the log
    return [
        ("/joints", int(r), joint_message(store, t, ["hip", "knee"], row))
        for r, t, row in zip(received, stamps, values, strict=True)
    ]


def _write_own_clock(path, stamps, values, version):
    episode = lerobot_episode(0, len(stamps)) | {
        "observation.state": values,
        "observation.time_ns": stamps,
    }
    features = FEATURES | {
        "observation.state": {"dtype": "float64", "shape": [2], "names": ["hip", "knee"]},
        "observation.time_ns": {"dtype": "int64", "shape": [1], "names": None},
    }
    return write_lerobot(path, [episode], version=version, features=features)


def _write_ulog(path, stamps, values):
    formats = {"joints": "uint64_t timestamp;double hip;double knee;"}
    rows = [("joints", 0, (int(t) // 1000, *row)) for t, row in zip(stamps, values, strict=True)]
    path = path.with_suffix(".ulg")
    path.write_bytes(ulog_bytes(formats, rows, start_us=int(stamps[0]) // 1000))
    return path


SAME_WALK = {
    "ros bag": lambda path, t, x: write_bag1(path.with_suffix(".bag"), _joints(ROS1, t, x)),
    "ros db3": lambda path, t, x: write_bag2(path, _joints(ROS2, t, x)),
    "ros mcap": lambda path, t, x: write_bag2(path, _joints(ROS2, t, x), mcap=True),
    "ulog": _write_ulog,
    "lerobot v2.1": lambda path, t, x: _write_own_clock(path, t, x, "v2.1"),
    "lerobot v3.0": lambda path, t, x: _write_own_clock(path, t, x, "v3.0"),
    "hdf5 robomimic": lambda path, t, x: write_robomimic(
        path.with_suffix(".hdf5"),
        [{"actions": np.zeros((len(t), 1)), "joints": x, "time_ns": t}],
    ),
    "hdf5 minari": lambda path, t, x: write_minari(
        path, [({"joints": x, "time_ns": t}, np.zeros((len(t) - 1, 1)))]
    ),
}
"""Per format, what writes stamps (n,), nanoseconds in whole microseconds, and values (n, 2)."""

SAME_WALK_OPTIONS = {"ulog": {"topics": ["joints"]}}
"""Options that a format needs to read it."""
