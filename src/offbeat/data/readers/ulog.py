"""PX4 flight logs (ULog), through `pyulog`: every topic with its own stamps.

The format: docs.px4.io, "ULog File Format". A log that was cut off, for example by a power failure,
is read up to there, and the cut is noted; so are dropouts, which the autopilot logs itself.
"""

from __future__ import annotations

import contextlib
import io
from collections.abc import Container, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from offbeat.data.readers.options import Fields, below, names
from offbeat.data.signals import Recording, Signal
from offbeat.data.source import require_file
from offbeat.errors import FileFormatError, listed, one_of, require

SUFFIXES = (".ulg", ".ulog")

DEFAULTS = {
    "sensor_combined": ("gyro_rad", "accelerometer_m_s2", "magnetometer_ga", "baro_alt_meter"),
    "vehicle_attitude": ("rollspeed", "pitchspeed", "yawspeed", "q"),
    "vehicle_angular_velocity": ("xyz",),
    "vehicle_local_position": ("x", "y", "z", "vx", "vy", "vz"),
}
"""Topics and fields that are read by default: the motion of the vehicle."""

_LATEST_US = 2**53  # 285 years; a later stamp is damaged

# From the definitions of PX4's messages.
_UNITS = {
    "sensor_combined": {
        "gyro_rad": "rad/s",
        "accelerometer_m_s2": "m/s^2",
        "magnetometer_ga": "G",
        "baro_alt_meter": "m",
    },
    "sensor_gyro": dict.fromkeys("xyz", "rad/s"),
    "sensor_accel": dict.fromkeys("xyz", "m/s^2"),
    "vehicle_angular_velocity": {"xyz": "rad/s"},
    "vehicle_acceleration": {"xyz": "m/s^2"},
    "vehicle_attitude": dict.fromkeys(("rollspeed", "pitchspeed", "yawspeed"), "rad/s"),
    "vehicle_local_position": {
        **dict.fromkeys("xyz", "m"),
        **dict.fromkeys(("vx", "vy", "vz"), "m/s"),
        **dict.fromkeys(("ax", "ay", "az"), "m/s^2"),
        "heading": "rad",
    },
    "vehicle_attitude_setpoint": dict.fromkeys(("roll_body", "pitch_body", "yaw_body"), "rad"),
    "vehicle_rates_setpoint": dict.fromkeys(("roll", "pitch", "yaw"), "rad/s"),
}
_QUATERNIONS = ("q", "q_d", "delta_q_reset", "q_offset")


def recordings(
    path: str | Path,
    *,
    topics: Sequence[str] | None = None,
    fields: Sequence[str] | None = None,
) -> Iterator[Recording]:
    """Reads a ULog: one recording, a signal per topic and instance.

    Args:
        path: the file.
        topics: topics to read with all their instances (`sensor_accel`), or with one
            (`sensor_accel:1`); by default those of the motion.
        fields: fields to read, such as `q` (with all its elements) or `gyro_rad[0]`, or, of one
            topic alone, `vehicle_attitude:q`; by default all numbers of the topics that were asked
            for, except further stamps.

    Yields:
        The recording, with stamps of the autopilot's clock.

    Raises:
        FileFormatError: the file is not ULog, is cut off before any data, or has none of the
            topics.
        InputError: a topic, instance or field is unknown.
        MissingExtraError: `pyulog` is not installed.
    """
    require("pyulog", "px4")
    path = require_file(path)
    named = names("topics", topics)
    asked = None if named is None else dict(_instance(topic) for topic in named)
    wanted = _Wanted(DEFAULTS if asked is None else asked)
    log, notes = _parsed(path, wanted)
    there: dict[str, list[Any]] = {}
    for data in sorted(log.data_list, key=lambda d: d.multi_id):
        there.setdefault(data.name, []).append(data)
    if asked is None:
        chosen = {name: there[name] for name in DEFAULTS if name in there}
        left = sorted(wanted.seen - chosen.keys())
        if not chosen:
            raise FileFormatError(
                f"{path} holds none of the topics that are read by default "
                f"({', '.join(DEFAULTS)}); choose with topics= from: "
                f"{listed(left) or 'none'}"
            )
        if left:
            more = f" and {len(left) - 8} more" if len(left) > 8 else ""
            notes.append(f"left out unless chosen with topics=: {', '.join(left[:8])}{more}")
    else:
        chosen = {}
        for name, instance in asked.items():
            one_of(f"topic of {path.name}", name, wanted.seen)
            chosen[name] = [d for d in there.get(name, []) if instance in (None, d.multi_id)]
            if instance is not None and not chosen[name]:
                one_of(f"instance of {name}", str(instance), _instances(there.get(name, [])))
            if not chosen[name]:
                raise FileFormatError(f"{path}: nothing was logged to topic {name}; leave it out")
    pick = Fields(fields, chosen)
    signals = [
        signal
        for instances in chosen.values()
        for data in instances
        if (signal := _signal(data, _fields(data, pick, asked=bool(asked)), notes)) is not None
    ]
    pick.check()
    if not signals:
        raise FileFormatError(
            f"{path} holds no numbers in {listed(list(chosen))}; choose with topics="
        )
    yield Recording(tuple(signals), origin=path.name, time_unit="us", notes=tuple(notes))


def _instance(topic: str) -> tuple[str, int | None]:
    name, _, number = topic.rpartition(":")
    return (name, int(number)) if name and number.isdecimal() else (topic, None)


def _instances(data: list[Any]) -> list[str]:
    return [str(d.multi_id) for d in data]


class _Wanted(Container[str]):
    """The topics to read, for `pyulog`; records all topics in the log."""

    def __init__(self, names: Container[str]) -> None:
        self.names = names
        self.seen: set[str] = set()

    def __contains__(self, name: object) -> bool:
        self.seen.add(str(name))
        return name in self.names


class _Watched(io.BufferedReader):
    """A file that records whether it ends in the middle of a message."""

    cut = False

    def read(self, size: int | None = -1) -> bytes:
        data = super().read(size)
        # A complete log ends where the next header, of 3 bytes, would start.
        if size is not None and len(data) < size and (data or size != 3):
            self.cut = True
        return data


def _parsed(path: Path, wanted: _Wanted) -> tuple[Any, list[str]]:
    """The log, and notes on it."""
    from pyulog import ULog

    printed = io.StringIO()
    file = _Watched(io.FileIO(path))
    try:
        with contextlib.redirect_stdout(printed):  # it prints errors
            log = ULog(file, wanted)
    except Exception as error:
        file.close()
        what = " ".join(str(error).split())[:120] or type(error).__name__
        raise FileFormatError(
            f"{path} can't be read as a ULog, it is truncated, damaged or of another format "
            f"({what}); copy it from the vehicle again"
        ) from None
    if not wanted.seen:
        raise FileFormatError(
            f"{path} is cut off before any data, after {path.stat().st_size} bytes; copy it from "
            "the vehicle again"
        )
    notes = []
    if log.file_corruption:
        lines = printed.getvalue().splitlines()
        why = f" ({lines[0]})" if lines else ""
        notes.append(f"the file is damaged{why}; readable parts are read")
    elif file.cut:
        seconds = (log.last_timestamp - log.start_timestamp) / 1e6
        notes.append(
            f"the file is cut off in the middle of a message, as by a power failure; the part "
            f"before it is read, {seconds:.3f} s"
        )
    if log.dropouts:
        longest = max(log.dropouts, key=lambda d: d.duration)
        notes.append(
            f"the autopilot logged {len(log.dropouts)} dropouts, "
            f"{sum(d.duration for d in log.dropouts)} ms in total, the longest of "
            f"{longest.duration} ms at {(longest.timestamp - log.start_timestamp) / 1e6:.3f} s"
        )
    return log, notes


def _fields(data: Any, fields: Fields, *, asked: bool) -> list[str]:
    """The selected fields of a topic, in the order of the log."""
    numbers = [f.field_name for f in data.field_data if f.type_str != "char"]
    fields.available.update(dict.fromkeys(name.partition("[")[0] for name in numbers))
    wanted = fields.of(data.name)
    if wanted is not None:
        return [name for name in numbers if wanted(name)]
    if not asked:
        return [n for n in numbers if any(below(n, path) for path in DEFAULTS[data.name])]
    return [n for n in numbers if "timestamp" not in n and "_padding" not in n]


def _signal(data: Any, names: list[str], notes: list[str]) -> Signal | None:
    if not names:
        return None
    title = data.name if data.multi_id == 0 else f"{data.name}_{data.multi_id}"
    clock: NDArray[np.uint64] = data.data["timestamp"]
    good = clock <= _LATEST_US
    if not good.all():
        notes.append(f"{title}: {int((~good).sum())} rows with a damaged stamp are left out")
    values = np.empty((int(good.sum()), len(names)), order="F")
    for column, name in enumerate(names):
        values[:, column] = data.data[name][good]
    units = _UNITS.get(data.name, {})
    bases = [name.partition("[")[0] for name in names]
    kinds = []
    for base in bases:
        whole = base.rpartition(".")[2] in _QUATERNIONS and bases.count(base) == 4
        angle = units.get(base) == "rad"
        kinds.append("quaternion" if whole else "angle" if angle else "")
    return Signal(
        title,
        clock[good].astype(np.int64) * 1000,
        values,
        tuple(names),
        tuple(units.get(base, "") for base in bases),
        tuple(kinds),
    )
