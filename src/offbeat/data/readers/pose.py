"""Trajectories of poses as text: TUM, and EuRoC files and folders."""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from offbeat.data.cleaning.clocks import (
    NANOSECONDS_PER,
    split_unit,
    state_time_unit,
    time_column_of,
    time_unit_in,
)
from offbeat.data.memory import require_memory
from offbeat.data.readers.batches import NullValueError, gather
from offbeat.data.readers.columns import Columns
from offbeat.data.readers.gathered import recordings
from offbeat.data.readers.table import read_csv
from offbeat.data.recording import Recording, Signal
from offbeat.data.source import require_file
from offbeat.errors import FileFormatError, InputError, one_of

TUM_COLUMNS = ("timestamp", "tx", "ty", "tz", "qx", "qy", "qz", "qw")
"""The eight numbers of a line of TUM: seconds, metres, and a scalar-last quaternion."""

_POSE = {
    **dict.fromkeys(("timestamp", "time", "t", "stamp", "ts", "timestamps"), "timestamp"),
    **{
        f"{start}{axis}": f"t{axis}"
        for start in ("t", "p", "p_", "t_", "pos_", "")
        for axis in "xyz"
    },
    **{f"position_{axis}": f"t{axis}" for axis in "xyz"},
    **{f"{start}{a}": f"q{a}" for start in ("q", "q_", "quat_", "qu", "r") for a in "xyzw"},
    **{f"orientation_{axis}": f"q{axis}" for axis in "xyzw"},
    "i": "qx",
    "j": "qy",
    "k": "qz",
    "w": "qw",
}
"""Words by which headers name the columns of a pose."""

_QUATERNION = {word for word, name in _POSE.items() if name.startswith("q")}

_FIRST_NS, _LAST_NS = 946_684_800 * 10**9, 4_102_444_800 * 10**9  # 2000 and 2100
_LINES = 200  # lines from which the meaning of the numbers is derived
_LONGEST = 10_000  # characters of a line of eight numbers
_OFF_1 = 0.05  # from the length of a quaternion
_COPIES = 3  # copies of a text in memory while it is read

_TUM = Columns("timestamp", None, TUM_COLUMNS[1:], TUM_COLUMNS[1:], ("m",) * 3 + ("",) * 4)


def read_tum(path: str | Path, *, time_unit: str | None = None) -> list[Recording]:
    """Reads a trajectory of poses in the format of the TUM RGB-D benchmark.

    Text without a header: per line `timestamp tx ty tz qx qy qz qw`, in seconds and metres, with
    spaces between; times that count milliseconds or nanoseconds since 1970, as some programs write
    them, are found by their numbers, which is noted. Lines that begin with # are comments. A
    comment that names eight columns in another order, such as `qw` before `qx`, decides about the
    order. Stamps keep every digit to the nanosecond. A last line that is cut off is left out, which
    is noted.

    Source: https://cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats

    Args:
        path: the file, in UTF-8.
        time_unit: of the stamps; by default found by their numbers, else seconds.

    Raises:
        FileFormatError: the file is missing or empty, or a line does not have eight numbers.
        InputError: the unit is unknown.
    """
    import io

    import pyarrow as pa
    import pyarrow.csv as pv

    path = require_file(path)
    size = path.stat().st_size
    require_memory(path, _COPIES * size, f"{size} bytes of text")
    text = path.read_bytes().removeprefix(b"\xef\xbb\xbf")
    text = text.replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    if re.search(rb"[^\n]{%d}" % _LONGEST, text):
        _explain(path)
        raise FileFormatError(f"{path} has a line of more than {_LONGEST} characters")
    text = re.sub(rb"(?m)^[ \t]*(?:#.*)?\n?", b"", text)
    text = re.sub(rb"[ \t]+", b" ", re.sub(rb"(?m)[ \t]+$", b"", text))
    if not text:
        raise FileFormatError(f"{path} has no line of numbers, expected {' '.join(TUM_COLUMNS)}")
    columns = _order(path)
    notes: tuple[str, ...] = ()
    whole, _, last = text.rpartition(b"\n")
    if last and whole and len(last.split()) < len(TUM_COLUMNS):
        text = whole + b"\n"
        notes = ("the file ends in the middle of a line; it is read up to there",)
    if columns != TUM_COLUMNS:
        notes = (*notes, f"the header names the columns {' '.join(columns)}")
    integers = all(line.split(b" ", 1)[0].isdigit() for line in text[:10_000].splitlines())
    for clock in (*([pa.int64()] if integers else []), pa.decimal128(38, 9), pa.float64()):
        try:
            batches = pv.read_csv(
                io.BytesIO(text),
                read_options=pv.ReadOptions(column_names=columns),
                parse_options=pv.ParseOptions(delimiter=" ", quote_char=False),
                convert_options=pv.ConvertOptions(
                    column_types=dict.fromkeys(TUM_COLUMNS, pa.float64()) | {"timestamp": clock},
                    null_values=["nan", "NaN"],
                ),
            ).to_batches()
            table = gather(batches, _TUM, text.count(b"\n") + 1)
            break
        except (pa.ArrowException, OverflowError, NullValueError):
            _explain(path)
    else:
        raise FileFormatError(f"{path} can't be read as TUM text; expected {' '.join(TUM_COLUMNS)}")
    counted = table.clock
    as_number = counted / 1e9 if pa.types.is_decimal(clock) else counted
    stated = state_time_unit(time_unit, "timestamp", as_number[:1000], str(path))
    unit = stated.unit
    if pa.types.is_decimal(clock):  # it counts 1e-9 of the unit
        ticks = NANOSECONDS_PER[unit]
        counted = counted if unit == "s" else np.rint(counted * (ticks / 1e9)).astype(np.int64)
        unit = "ns"
    made = recordings(
        path,
        _TUM,
        unit,
        (*notes, *stated.notes),
        replace(table, clock=counted),
        shown=stated.unit,
        found=stated.found and bool(stated.notes),
    )
    kinds = ("",) * 3 + ("quaternion",) * 4
    return [replace(one, signals=(replace(one.signals[0], kinds=kinds),)) for one in made]


def is_tum(path: Path) -> bool:
    """Whether a text holds lines of eight numbers, separated by spaces, that are poses.

    They are if a comment above them names the columns of a pose, or if none names eight others and
    the last four numbers have length 1 in most lines.
    """
    lines = _first_lines(path)
    rows = [line.split() for line in lines if line.strip() and not _is_comment(line)]
    if not rows or _numbers(" ".join(rows[0])) != len(TUM_COLUMNS):
        return False
    order = _order_in(lines)
    if path.suffix.lower() == ".tum" or order is not None:
        return order != ()
    fours = [[float(x) for x in row[4:]] for row in rows if _numbers(" ".join(row)) == 8]
    unit = sum(abs(math.hypot(*four) - 1) < _OFF_1 for four in fours)
    return 4 * unit >= 3 * len(fours)


def _order(path: Path) -> tuple[str, ...]:
    """The columns of a file in its order.

    Raises:
        FileFormatError: a comment names eight columns that are no pose.
    """
    lines = _first_lines(path)
    order = _order_in(lines)
    if order == ():
        named = next(line for line in reversed(lines) if _is_comment(line)).strip()
        raise FileFormatError(
            f"{path} names its columns {named[:100]!r}, expected {' '.join(TUM_COLUMNS)}; read it "
            "with format=csv"
        )
    return TUM_COLUMNS if order is None else order


def _order_in(lines: list[str]) -> tuple[str, ...] | None:
    """The order of the columns that a comment above the numbers names.

    None if no comment names eight columns; empty if they are not those of a pose.
    """
    above = list(itertools.takewhile(lambda line: not line.strip() or _is_comment(line), lines))
    for line in reversed(above):
        words = re.split(r"[\s,;]+", line.strip().lstrip("#% ").strip())
        words = [split_unit(word)[0].casefold() for word in words if word]
        words = [word for word in words if not word.startswith(("[", "("))]
        if len(words) != len(TUM_COLUMNS):
            named = (
                len(words) > 4 and time_column_of(words[:1]) and not set(words[1:]) & _QUATERNION
            )
            if named:
                return ()
            continue
        order = tuple(_POSE.get(word, "") for word in words)
        known = sum(bool(name) for name in order)
        if set(order) == set(TUM_COLUMNS) and order[0] == "timestamp":
            return order
        return () if known < len(order) else None
    return None


def _is_comment(line: str) -> bool:
    return line.lstrip().startswith(("#", "%"))


def _first_lines(path: Path) -> list[str]:
    """The first lines of a text, up to a hundred of numbers; empty if it is no text."""
    found: list[str] = []
    try:
        if not path.is_file():
            return []
        with path.open(encoding="utf-8-sig") as file:
            for _ in range(_LINES):
                line = file.readline(2000)
                if not line:
                    break
                found.append(line)
    except (OSError, UnicodeDecodeError):
        return []
    return found


def read_euroc(path: str | Path, *, sensors: Sequence[str] | None = None) -> list[Recording]:
    """Reads a EuRoC MAV sequence, or one of its files.

    A file is CSV whose header starts with `#timestamp`, in nanoseconds, and has units in brackets.
    A folder holds one sensor per folder, each with its `data.csv`, here or in `mav0`; the sensors
    are merged on the union of their stamps. Those with data that are not numbers (images of a
    camera) are left out, which is noted.

    Source: Burri et al., The EuRoC micro aerial vehicle datasets, IJRR 35(10), 2016.

    Args:
        path: the file, or the folder.
        sensors: the folders to read, such as `imu0`; by default all with numeric data.

    Raises:
        FileFormatError: a file is missing, empty or damaged, or no sensor has numeric data.
        InputError: an unknown sensor is selected.
    """
    path = Path(path)
    if not path.is_dir():
        if sensors is not None:
            raise InputError(f"{path} is the file of one sensor; leave sensors out")
        recording, *others = read_csv(path, time_unit="ns")
        if others:
            raise FileFormatError(f"{path} has a column of trajectories; read it with format=csv")
        signal = recording.signals[0]
        return [replace(recording, signals=(replace(signal, kinds=_kinds(signal.channels)),))]
    files = {file.parent.name: file for file in _data_files(path)}
    chosen = list(files) if sensors is None else [one_of("sensor", s, files) for s in sensors]
    signals: list[Signal] = []
    left: list[str] = []
    notes: list[str] = []
    for sensor in chosen:
        require_file(files[sensor])
        if sensors is None and not _holds_numbers(files[sensor]):
            left.append(sensor)
            continue
        [recording] = read_euroc(files[sensor])
        signals.append(replace(recording.signals[0], name=sensor))
        notes += [f"{sensor}: {note}" for note in recording.notes]
    if not signals:
        raise FileFormatError(f"{path} has no sensor whose data.csv holds numbers, got {left}")
    if left:
        notes.append(f"sensors without numbers are left out: {', '.join(left)}")
    return [Recording(tuple(signals), origin=path.name, time_unit="ns", notes=tuple(notes))]


def is_euroc(path: Path) -> bool:
    """Whether a folder holds sensors of EuRoC, or a CSV has its header and nanoseconds below it."""
    if path.is_dir():
        return any(is_euroc(file) for file in _data_files(path))
    first = next(iter(_first_lines(path)), "")
    if not first.startswith(("#timestamp", "# timestamp")):
        return False
    if time_unit_in(first.partition(",")[0]) is not None:
        return time_unit_in(first.partition(",")[0]) == "ns"
    rows = [line.partition(",")[0].strip() for line in _first_lines(path)[1:] if line.strip()]
    numbers = [row for row in rows if not row.startswith("#")]
    return all(row.isdecimal() and _FIRST_NS <= int(row[:25]) <= _LAST_NS for row in numbers)


def _data_files(folder: Path) -> list[Path]:
    return sorted([*folder.glob("*/data.csv"), *folder.glob("mav0/*/data.csv")])


def _holds_numbers(path: Path) -> bool:
    """Whether the first row of a CSV has only numbers."""
    row = next(iter(_first_lines(path)[1:2]), "").strip()
    return not row or _numbers(row.replace(",", " ")) == len(row.split(","))


def _kinds(channels: Sequence[str]) -> tuple[str, ...]:
    turned = [re.fullmatch(r"q\w*_[wxyz]", channel) is not None for channel in channels]
    return tuple("quaternion" if yes and sum(turned) == 4 else "" for yes in turned)


def _numbers(line: str) -> int:
    """Number of numbers in a line; -1 if it contains anything else."""
    try:
        return len([float(word) for word in line.split()])
    except ValueError:
        return -1


def _explain(path: Path) -> None:
    """Raises an error that names the invalid line, if there is one."""
    try:
        with path.open(encoding="utf-8-sig") as file:
            for number, line in enumerate(iter(lambda: file.readline(10_000), ""), 1):
                text = line.strip()
                if text and not text.startswith("#") and _numbers(text) != len(TUM_COLUMNS):
                    raise FileFormatError(
                        f"{path} has {text[:60]!r} in line {number}, expected eight numbers: "
                        f"{' '.join(TUM_COLUMNS)}"
                    )
                if text.casefold().startswith("nan"):
                    raise FileFormatError(f"{path} has no time in line {number}; drop that row")
    except UnicodeDecodeError as error:
        raise FileFormatError(
            f"{path} can't be read as text ({error}); it must be in UTF-8"
        ) from None
