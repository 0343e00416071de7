"""One walk in every format that the project reads: what writes it, for the tests of readers.

A format of a new reader needs an entry here, or in `SAME_WALK` of `robot_logs`; the contract suite
then covers it without a new test.
"""

from __future__ import annotations

import csv
import json

import numpy as np
import pyarrow as pa
import pyarrow.feather as feather
import pyarrow.parquet as pq
from scipy.io import savemat

from offbeat.data.store import save
from offbeat.data.trajectory import Dataset, Trajectory
from offbeat.data.writers import save as save_as


def text_of(value):
    """A cell of CSV: empty where nothing is known."""
    return "" if np.isnan(value) else repr(float(value))


def write_csv(path, stamps, values):
    with path.with_suffix(".csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["time_ns", "hip", "knee"])
        writer.writerows([t, *map(text_of, row)] for t, row in zip(stamps, values, strict=True))
    return path.with_suffix(".csv")


def write_long_csv(path, stamps, values):
    with path.with_suffix(".tsv").open("w", newline="") as file:
        writer = csv.writer(file, delimiter="\t")
        writer.writerow(["t [ns]", "channel", "value"])
        for t, row in zip(stamps, values, strict=True):
            writer.writerows(
                [t, name, text_of(x)] for name, x in zip(("hip", "knee"), row, strict=True)
            )
    return path.with_suffix(".tsv")


def write_parquet(path, stamps, values):
    columns = {"timestamp": pa.array(stamps, pa.timestamp("ns")), "hip": values[:, 0]}
    pq.write_table(pa.table(columns | {"knee": values[:, 1]}), path.with_suffix(".parquet"))
    return path.with_suffix(".parquet")


def write_long_parquet(path, stamps, values):
    names = pa.array(["hip", "knee"] * len(stamps)).dictionary_encode()
    columns = {"time_ns": np.repeat(stamps, 2), "sensor": names, "value": values.ravel()}
    pq.write_table(pa.table(columns), path.with_suffix(".pq"))
    return path.with_suffix(".pq")


def write_npz(path, stamps, values):
    np.savez(path.with_suffix(".npz"), time_ns=stamps, joints=values, names=["hip", "knee"])
    return path.with_suffix(".npz")


def write_feather(path, stamps, values):
    columns = {"time_ns": stamps, "hip": values[:, 0], "knee": values[:, 1]}
    feather.write_feather(pa.table(columns), path.with_suffix(".feather"))
    return path.with_suffix(".feather")


def write_json(path, stamps, values):
    lines = [
        json.dumps({"time_ns": int(t), "hip": number_of(x), "knee": number_of(y)})
        for t, (x, y) in zip(stamps, values, strict=True)
    ]
    path.with_suffix(".jsonl").write_text("\n".join(lines) + "\n")
    return path.with_suffix(".jsonl")


def write_ros_echo(path, stamps, values):
    """As `ros2 topic echo` prints a stamp and a list, and NaN where nothing is known."""
    messages = [
        f"header:\n  stamp:\n    sec: {int(t) // 10**9}\n    nanosec: {int(t) % 10**9}\n"
        f"  frame_id: base\nname:\n- hip\n- knee\nposition:\n- {x!r}\n- {y!r}\n---\n"
        for t, (x, y) in zip(stamps, values.tolist(), strict=True)
    ]
    path.with_suffix(".yaml").write_text("".join(messages))
    return path.with_suffix(".yaml")


def number_of(value):
    """A number of JSON: null where nothing is known."""
    return None if np.isnan(value) else float(value)


def write_mat(path, stamps, values):
    arrays = {"time_ns": np.asarray(stamps), "hip": values[:, 0], "knee": values[:, 1]}
    savemat(path.with_suffix(".mat"), {"walk": arrays})
    return path.with_suffix(".mat")


def write_ardupilot(path, stamps, values):
    """A log in text, whose stamps are in microseconds."""
    lines = ["FMT, 1, 20, WALK, Qff, TimeUS,hip,knee"]
    lines += [
        f"WALK, {t // 1000}, {float(x)!r}, {float(y)!r}"
        for t, (x, y) in zip(stamps, values, strict=True)
    ]
    path.with_suffix(".log").write_text("\n".join(lines) + "\n")
    return path.with_suffix(".log")


def write_plain_hdf5(path, stamps, values):
    """Arrays beside their times, in a group."""
    import h5py

    with h5py.File(path.with_suffix(".h5"), "w") as file:
        file["walk/time_ns"] = np.asarray(stamps)
        file["walk/joints"] = values
        file["walk/joints"].attrs["names"] = ["hip", "knee"]
    return path.with_suffix(".h5")


def write_tum(path, stamps, values):
    """Poses whose first two coordinates are the walk."""
    lines = ["# timestamp tx ty tz qx qy qz qw"]
    for t, (x, y) in zip(stamps, values, strict=True):
        lines.append(f"{t // 10**9}.{t % 10**9:09d} {float(x)!r} {float(y)!r} 0 0 0 0 1")
    path.with_suffix(".tum").write_text("\n".join(lines) + "\n")
    return path.with_suffix(".tum")


def write_euroc_file(path, stamps, values):
    header = "#timestamp [ns],hip [rad],knee [rad]"
    rows = (f"{t},{x!r},{y!r}" for t, (x, y) in zip(stamps, values.tolist(), strict=True))
    path.with_suffix(".csv").write_text("\n".join([header, *rows]) + "\n")
    return path.with_suffix(".csv")


def write_euroc_folder(path, stamps, values):
    (path / "mav0" / "imu0").mkdir(parents=True)
    write_euroc_file(path / "mav0" / "imu0" / "data", stamps, values)
    return path


def write_own(path, stamps, values):
    times = (np.asarray(stamps) - stamps[0]) / 1e9
    save(Dataset([Trajectory(times, values, names=("hip", "knee"))]), path.with_suffix(".parquet"))
    return path.with_suffix(".parquet")


def written(format, suffix):
    """What writes the walk with a writer of ours, on its clock."""

    def write(path, stamps, values):
        path = path.with_suffix(suffix)
        times = (np.asarray(stamps) - stamps[0]) / 1e9
        walk = Trajectory(times, values, names=("hip", "knee"))
        clock = {"clock_start": [int(stamps[0])], "time_unit": "ns"}
        save_as(Dataset([walk], clock), path, format=format)
        return path

    return write


WRITERS = {
    "offbeat": write_own,
    "csv": write_csv,
    "csv long": write_long_csv,
    "parquet": write_parquet,
    "parquet long": write_long_parquet,
    "npz": write_npz,
    "npz written": written("npz", ".npz"),
    "feather": write_feather,
    "json": write_json,
    "ros_echo": write_ros_echo,
    "mat": write_mat,
    "ardupilot": write_ardupilot,
    "tum": write_tum,
    "euroc": write_euroc_file,
    "euroc folder": write_euroc_folder,
}
"""By name of the reader and variant: writes stamps (n,), nanoseconds, and values (n, 2)."""

OPTIONS = {}
"""Options that a variant needs to be read."""

try:
    import robot_logs
except ImportError:
    pass
else:
    WRITERS |= robot_logs.SAME_WALK
    WRITERS["hdf5 plain"] = write_plain_hdf5
    WRITERS["hdf5 robomimic written"] = written("robomimic", ".hdf5")
    WRITERS["hdf5 minari written"] = written("minari", "")
    WRITERS["ros mcap written"] = written("mcap", ".mcap")
    OPTIONS |= robot_logs.SAME_WALK_OPTIONS
