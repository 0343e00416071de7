"""Reading ROS bags, compared with rosbags alone: iteration, and iteration with deserialisation.

    python benchmarks/ros_reader.py [BAG ...] [--messages 30000] [--json]

Without a bag, one of each format is written: two thirds IMU messages, one third joint states of 12
joints. All topics are read. The readers take turns; CPU seconds, medians.
"""

from __future__ import annotations

import argparse
import importlib.metadata
import json
import platform
import statistics
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.highlevel import AnyReader
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore

from offbeat.data.readers import read, ros

JOINTS = 12


def messages(store: Any, count: int) -> Iterator[tuple[str, int, Any]]:
    """Topic, stamp and message: an IMU at 200 Hz and joints at 100 Hz."""
    types = store.types
    first = (0,) if store.fielddefs["std_msgs/msg/Header"][1][0][0] == "seq" else ()
    random = np.random.default_rng(0)
    vector, quaternion = types["geometry_msgs/msg/Vector3"], types["geometry_msgs/msg/Quaternion"]
    names = [f"joint_{i}" for i in range(JOINTS)]
    for i in range(count):
        stamp = 1_700_000_000_000_000_000 + i * 3_333_333
        time_of = types["builtin_interfaces/msg/Time"](*divmod(stamp, 10**9))
        header = types["std_msgs/msg/Header"](*first, time_of, "base_link")
        x = random.normal(size=36)
        if i % 3:
            spread = np.zeros(9)
            turn, rate, push = quaternion(*x[:4]), vector(*x[4:7]), vector(*x[7:10])
            yield (
                "/imu",
                stamp,
                types["sensor_msgs/msg/Imu"](header, turn, spread, rate, spread, push, spread),
            )
        else:
            yield (
                "/joint_states",
                stamp,
                types["sensor_msgs/msg/JointState"](
                    header, names, x[:JOINTS], x[JOINTS : 2 * JOINTS], x[2 * JOINTS :]
                ),
            )


def write(folder: Path, count: int) -> list[Path]:
    """A bag of ROS 1, one of ROS 2 in SQLite and one in MCAP."""
    made = []
    for name in ("log.bag", "log_db3", "log_mcap"):
        path = folder / name
        ros1 = name.endswith(".bag")
        store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)
        plugin = StoragePlugin.MCAP if "mcap" in name else StoragePlugin.SQLITE3
        writer: Any = Writer1(path) if ros1 else Writer2(path, version=9, storage_plugin=plugin)
        serialise = store.serialize_ros1 if ros1 else store.serialize_cdr
        with writer:
            connections: dict[str, Any] = {}
            for topic, stamp, message in messages(store, count):
                kind = message.__msgtype__
                if topic not in connections:
                    connections[topic] = writer.add_connection(topic, kind, typestore=store)
                writer.write(connections[topic], stamp, serialise(message, kind))
        made.append(path)
    return made


def iterate(path: Path) -> None:
    """Every message as bytes."""
    with AnyReader([path]) as reader:
        for _ in reader.messages():
            pass


def deserialise(path: Path) -> None:
    """Every message as an object."""
    with AnyReader([path]) as reader:
        for connection, _, raw in reader.messages():
            reader.deserialize(raw, connection.msgtype)


WAYS: dict[str, Callable[[Path], Any]] = {
    "rosbags_bytes": iterate,
    "rosbags_objects": deserialise,
    "recordings": lambda path: list(ros.recordings(path)),
    "read": lambda path: read(path, max_gap_s=None),
}
"""`recordings` is the reader alone; `read` makes a data set of its result."""


def measure(path: Path, repeats: int) -> dict[str, float]:
    """Median CPU seconds of each way; they take turns."""
    taken: dict[str, list[float]] = {name: [] for name in WAYS}
    for repeat in range(repeats + 1):
        for name, way in WAYS.items():
            started = time.process_time()
            way(path)
            if repeat:
                taken[name].append(time.process_time() - started)
    return {name: statistics.median(seconds) for name, seconds in taken.items()}


def main() -> None:
    """Prints a table, or JSON."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("bags", nargs="*", type=Path)
    parser.add_argument("--messages", type=int, default=30_000)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        paths = options.bags or write(Path(folder), options.messages)
        seconds = {path.name: measure(path, options.repeats) for path in paths}
    if options.json:
        versions = {p: importlib.metadata.version(p) for p in ("rosbags", "numpy")}
        about = {"python": platform.python_version(), "machine": platform.machine(), **versions}
        print(json.dumps({"cpu_seconds": seconds, "repeats": options.repeats, **about}))
        return
    print(f"{'':20}" + "".join(f"{name:>17}" for name in WAYS) + "  objects / recordings")
    for name, row in seconds.items():
        ratio = row["rosbags_objects"] / row["recordings"]
        print(f"{name:20}" + "".join(f"{row[way]:17.3f}" for way in WAYS) + f"{ratio:22.1f}")


if __name__ == "__main__":
    main()
