"""Logs of ArduPilot as text: the lines of a .log, or what `mavlogdump.py` prints of a .bin.

A .log names the fields of each type of message in lines `FMT, type, length, name, format, fields`,
and holds lines `IMU, 1234, 0.1, ...`; `mavlogdump.py` prints `2026-07-28 14:03:02.12: IMU {TimeUS :
1234, GyrX : 0.1}`. Numbers are in their units in both.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np

from offbeat.data.readers.csv_fields import number_in
from offbeat.data.readers.options import Fields, names
from offbeat.data.readers.text import TextFile, start_of
from offbeat.data.signals import MOST_CHANNELS, Recording, Signal
from offbeat.data.source import require_file
from offbeat.errors import FileFormatError, listed, one_of

DEFAULTS = ("IMU", "ATT", "RATE", "BARO", "GPS", "POS", "BAT")
"""Messages that are read by default."""

_CLOCKS = {"TimeUS": 1000, "TimeMS": 1_000_000}  # nanoseconds of a count
_INSTANCES = ("I", "Instance")
_UNITS = {
    "IMU": {"Gyr": "rad/s", "Acc": "m/s2"},
    "ATT": {"Roll": "deg", "Pitch": "deg", "Yaw": "deg", "Des": "deg"},
    "BARO": {"Alt": "m", "Press": "Pa"},
    "BAT": {"Volt": "V", "Curr": "A"},
}
_ANGLES = ("Roll", "Pitch", "Yaw", "DesRoll", "DesPitch", "DesYaw")
_PRINTED = re.compile(r"\d{4}-\d\d-\d\d \d\d:\d\d:\d\d\.\d+: (\w{1,16}) \{(.*)\}\s*")
_FIRST = re.compile(rf"FMT, ?\d+, ?\d+, ?\w+, ?\w*,|{_PRINTED.pattern}")

Message = tuple[str, dict[str, str]]
"""The name of a message, and its fields."""


def recognises(path: Path) -> bool:
    """Whether a file of text begins as a log of ArduPilot."""
    lines = start_of(path).decode("utf-8", "replace").splitlines()
    return any(_FIRST.match(line) for line in lines[:20])


def recordings(
    path: str | Path,
    *,
    topics: Sequence[str] | None = None,
    fields: Sequence[str] | None = None,
) -> Iterator[Recording]:
    """Reads a log of ArduPilot in text: one recording, a signal per message and instance.

    Args:
        path: the file.
        topics: messages to read with all their instances; by default those of the motion.
        fields: fields to read, `GyrX`, or of one message alone, `IMU:GyrX`; by default all numbers.

    Yields:
        The recording, with stamps of the autopilot's clock.

    Raises:
        FileFormatError: the file is no such log, or has none of the messages.
        InputError: a message or field is unknown.
    """
    path = require_file(path)
    asked = names("topics", topics)
    if not recognises(path):
        raise FileFormatError(
            f"{path} can't be read as a log of ArduPilot in text, whose first lines are FMT, ...; "
            "if it is a table of text, name its format with format=csv"
        )
    notes: list[str] = []
    met: dict[str, list[dict[str, str]]] = {}
    for name, values in _messages(path, notes):
        met.setdefault(name, []).append(values)
    timed = {name for name, rows in met.items() if _clock_of(rows[0])}
    for name in asked or ():
        one_of(f"message of {path.name}", name, sorted(timed))
    chosen = list(asked or [name for name in DEFAULTS if name in timed] or sorted(timed))
    left = sorted(timed.difference(chosen))
    if left and asked is None:
        notes.append(f"left out unless chosen with topics=: {listed(left, 8)}")
    pick = Fields(fields, chosen)
    signals = [signal for name in chosen for signal in _signals(name, met[name], pick)]
    pick.check()
    if not signals or sum(len(signal.channels) for signal in signals) > MOST_CHANNELS:
        raise FileFormatError(
            f"{path} holds no messages with numbers and a stamp, {' or '.join(_CLOCKS)}; it has: "
            f"{listed(sorted(met)) or 'none'}"
        )
    unit = "us" if any("TimeUS" in met[name][0] for name in chosen) else "ms"
    yield Recording(tuple(signals), origin=path.name, time_unit=unit, notes=tuple(notes))


def _messages(path: Path, notes: list[str]) -> Iterator[Message]:
    """The messages of a log; a last line that is cut off is left out."""
    fields: dict[str, list[str]] = {}
    waiting: str | None = None
    for number, line in enumerate(TextFile.of(path).lines(), 1):
        if waiting is not None and not line.strip():
            continue
        if waiting is not None:
            raise FileFormatError(f"{path}: {waiting}, expected as many as its FMT line names")
        if match := _PRINTED.fullmatch(line):
            pairs = (part.partition(" : ") for part in match[2].split(", "))
            yield match[1], {name.strip(): value.strip() for name, _, value in pairs}
            continue
        if not line.endswith(("\n", "\r")):
            waiting = f"line {number} has no end"
            continue
        parts = [part.strip() for part in line.rstrip("\r\n").split(",")]
        if parts[0] == "FMT" and len(parts) > 5:
            fields[parts[3]] = parts[5:]
            continue
        known = fields.get(parts[0])
        if known is None:
            continue
        if len(parts) - 1 != len(known):
            if not any(name in known for name in ("Message", "Name")):  # texts may hold commas
                waiting = f"line {number} has {len(parts) - 1} fields of {parts[0]}"
            continue
        yield parts[0], dict(zip(known, parts[1:], strict=True))
    if waiting is not None:
        notes.append("the file ends in the middle of a line; it is read up to there")


def _clock_of(row: Mapping[str, str]) -> str:
    """The field with the stamp of a message, or empty."""
    found = next((name for name in _CLOCKS if name in row), "")
    return found if found and number_in(row[found], ".") is not None else ""


def _signals(name: str, rows: list[dict[str, str]], pick: Fields) -> Iterator[Signal]:
    """A signal per instance of a message."""
    clock = _clock_of(rows[0])
    instance = next((field for field in _INSTANCES if field in rows[0]), None)
    numbers = [
        field
        for field, value in rows[0].items()
        if field not in (clock, instance) and number_in(value, ".") is not None
    ]
    pick.available.update(dict.fromkeys(numbers))
    wanted = pick.of(name)
    kept = [field for field in numbers if wanted is None or wanted(field)]
    of_instance: dict[str, list[dict[str, str]]] = {}
    for row in rows:
        of_instance.setdefault(row.get(instance, "") if instance else "", []).append(row)
    for number, own in of_instance.items() if kept else ():
        stamps = [int(number_in(row.get(clock, ""), ".") or 0) * _CLOCKS[clock] for row in own]
        values = [[_number(row.get(field, "")) for field in kept] for row in own]
        units = [_unit(name, field) for field in kept]
        kinds = ["angle" if name == "ATT" and field in _ANGLES else "" for field in kept]
        title = f"{name}[{number}]" if len(of_instance) > 1 else name
        yield Signal(
            title, np.array(stamps, dtype=np.int64), np.array(values, dtype=np.float64),
            tuple(kept), tuple(units), tuple(kinds),
        )  # fmt: skip


def _number(text: str) -> float:
    number = number_in(text, ".")
    return np.nan if number is None else number


def _unit(name: str, field: str) -> str:
    starts = _UNITS.get(name, {})
    return next((unit for start, unit in starts.items() if field.startswith(start)), "")
