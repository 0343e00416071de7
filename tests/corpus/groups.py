"""Arrays in groups, as programs write HDF5, MATLAB and NumPy files, one generator per kind.

Each returns the path; the values are `tables.X` and `tables.Y` unless it says otherwise.
"""

from __future__ import annotations

import h5py
import numpy as np
from corpus.tables import NS, ROWS, TIMES, X, Y

XY = np.column_stack([X, Y])


def written(path, arrays, attributes=None):
    with h5py.File(path, "w") as file:
        for name, values in arrays.items():
            file[name] = values
        for name, given in (attributes or {}).items():
            attribute, value = given if isinstance(given, tuple) else ("units", given)
            file[name].attrs[attribute] = value
    return path


HDF5 = {
    "times beside a matrix": (
        {"time": TIMES, "q": XY},
        {},
        ("q[0]", "q[1]"),
    ),
    "times and signals in a group": (
        {"log/run/t": TIMES, "log/run/q": XY},
        {},
        ("q[0]", "q[1]"),
    ),
    "times around groups of sensors": (
        {"timestamp": NS, "left/x": X, "right/y": Y},
        {},
        ("left/x", "right/y"),
    ),
    "times of a unit in an attribute": (
        {"clock/time": 20 * np.arange(ROWS), "data/x": X, "data/y": Y},
        {"clock/time": "ms", "data/x": "m"},
        ("data/x", "data/y"),
    ),
    "a stamp in two arrays": (
        {"s/sec": NS // 10**9, "s/nanosec": NS % 10**9, "s/x": X, "s/y": Y},
        {},
        ("x", "y"),
    ),
    "times of text": (
        {"time": np.datetime_as_string(NS.astype("M8[ns]")).astype("S"), "x": X, "y": Y},
        {},
        ("x", "y"),
    ),
    "a table of records": (
        {"log": np.rec.fromarrays([TIMES, X, Y], names=["time", "x", "y"])},
        {},
        ("x", "y"),
    ),
    "a matrix with names of its columns": (
        {"log": np.column_stack([TIMES, XY])},
        {"log": ("columns", ["time", "x", "y"])},
        ("x", "y"),
    ),
    "times whose name ends like one": (
        {"ts_us": (20_000 * np.arange(ROWS)).astype(np.uint64), "x": X, "y": Y},
        {},
        ("x", "y"),
    ),
    "a rate in an attribute": (
        {"data/x": X, "data/y": Y},
        {"data": ("sample_rate", 50)},
        ("x", "y"),
    ),
    "a step in a number": ({"x": X, "y": Y, "dt": 0.02}, {}, ("x", "y")),
    "a column per time": ({"time": TIMES, "q": XY.T}, {}, ("q[0]", "q[1]")),
    "columns of shape (rows, 1)": (
        {"time": TIMES[:, None], "x": X[:, None], "y": Y[:, None]},
        {},
        ("x", "y"),
    ),
}
"""Arrays, attributes (units, or a name and a value), and the channels that hold X and Y."""


def of_kind(path, kind):
    """A file of a kind of `HDF5`."""
    arrays, units, _ = HDF5[kind]
    return written(path, arrays, units)


def two_clocks(path, shift=0.0):
    """Two sensors with a clock of their own each, one 10 ms later."""
    return written(
        path,
        {
            "imu/time": TIMES, "imu/acc": XY,
            "foot/time": TIMES + 0.01 + shift, "foot/load": 10 * X,
        },
    )  # fmt: skip


def aloha(path):
    """An episode of ALOHA: no times, and pictures."""
    return written(
        path,
        {
            "action": 2 * XY,
            "observations/qpos": XY,
            "observations/images/top": np.zeros((ROWS, 4, 5, 3), np.uint8),
            "observations/images/packed": np.zeros((ROWS, 2000), np.uint8),
        },
    )


def d4rl(path, ends=(9, 24)):
    """Episodes one after the other; the last one is not ended."""
    terminals, timeouts = np.zeros(ROWS, bool), np.zeros(ROWS, bool)
    terminals[ends[0]], timeouts[ends[1]] = True, True
    return written(
        path,
        {
            "observations": XY, "actions": 2 * XY[:, :1], "rewards": X, "next_observations": XY,
            "terminals": terminals, "timeouts": timeouts, "infos/qpos": XY,
        },
    )  # fmt: skip


def episodes(path, names):
    """A group per episode, each with its times."""
    return written(
        path,
        {
            f"{name}/{part}": values + (i if part != "time" else 0)
            for i, name in enumerate(names)
            for part, values in (("time", TIMES), ("imu/x", X), ("y", Y))
        },
    )


def matlab_73(path):
    """A file of MATLAB 7.3: text before the first block, axes in reverse order, names of types."""
    with h5py.File(path, "w", userblock_size=512) as file:
        for name, values in (("log/t", TIMES[None, :]), ("log/q", XY.T), ("log/x", X[:, None])):
            file[name] = values
            file[name].attrs["MATLAB_class"] = np.bytes_("double")
        file["log/who"] = np.array([[65], [66]], np.uint16)
        file["log/who"].attrs["MATLAB_class"] = np.bytes_("char")
    raw = bytearray(path.read_bytes())
    raw[:128] = b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(124) + b"\x00\x02IM"
    path.write_bytes(raw)
    return path
