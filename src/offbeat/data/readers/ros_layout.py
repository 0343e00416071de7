"""The places of the numbers in a serialised ROS message, and decoding thousands of them at once.

Messages of one topic usually have one layout: the same length, the same lengths of strings and
sequences. So a layout is found once by parsing one message, and all messages that agree with
it in these lengths are decoded together, as columns of one table of bytes. Nothing is done per
message in Python, and fields that are not selected are not decoded.

The layouts: ROS 1 writes fields one after the other, little endian, strings and sequences after
their length (wiki.ros.org/msg). ROS 2 writes CDR (OMG formal/02-06-51, 9.3): four bytes that say
the byte order, then the same with every number at a multiple of its size, and strings with their
end byte counted.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from offbeat.errors import FileFormatError

Definitions = Mapping[str, tuple[Any, Any]]
"""Fields of each message type, as `rosbags` parses them: name and description of every field."""

WIDEST = 64
"""Longest sequence whose elements become channels by default."""

_BASE, _NAME, _ARRAY = 1, 2, 3  # node types of a field's description; 4 is a sequence
_CODES = {
    "bool": "u1",
    "byte": "u1",
    "char": "u1",
    "int8": "i1",
    "uint8": "u1",
    "int16": "i2",
    "uint16": "u2",
    "int32": "i4",
    "uint32": "u4",
    "int64": "i8",
    "uint64": "u8",
    "float32": "f4",
    "float64": "f8",
}
_TIMES = ("builtin_interfaces/msg/Time", "builtin_interfaces/msg/Duration")
_TRANSFORM = "geometry_msgs/msg/TransformStamped"
_QUATERNION = "geometry_msgs/msg/Quaternion"
_NAMES = ("name", "names", "joint_names")
_LABELS = ("name", "joint_name", "label")  # of a message in a list

# Units from the definitions of the messages, or from REP 103.
_UNITS = {
    "geometry_msgs/msg/Pose": {"position": "m"},
    "geometry_msgs/msg/PointStamped": {"point": "m"},
    "geometry_msgs/msg/Transform": {"translation": "m"},
    "geometry_msgs/msg/Twist": {"linear": "m/s", "angular": "rad/s"},
    "geometry_msgs/msg/Accel": {"linear": "m/s^2", "angular": "rad/s^2"},
    "geometry_msgs/msg/Wrench": {"force": "N", "torque": "N m"},
    "geometry_msgs/msg/Pose2D": {"x": "m", "y": "m", "theta": "rad"},
    "sensor_msgs/msg/Imu": {"angular_velocity": "rad/s", "linear_acceleration": "m/s^2"},
    "sensor_msgs/msg/MagneticField": {"magnetic_field": "T"},
    "sensor_msgs/msg/FluidPressure": {"fluid_pressure": "Pa"},
    "sensor_msgs/msg/Temperature": {"temperature": "degC"},
    "sensor_msgs/msg/Range": {"range": "m", "min_range": "m", "max_range": "m"},
    "sensor_msgs/msg/NavSatFix": {"latitude": "deg", "longitude": "deg", "altitude": "m"},
}


class UnreadableTypeError(FileFormatError):
    """The messages of a topic have fields that can't be read."""


_DEEPEST = 50  # messages in messages
_MOST_MESSAGES = 1000  # of a list whose fields become channels


@dataclass(frozen=True)
class Column:
    """One number of a message: a channel.

    Args:
        name: path of its field, such as `pose.position.x` or `effort[2]`.
        offset: its position in the message, in bytes.
        code: its type as NumPy writes it, such as `<f8`.
        unit: unit from the definition of the message, or empty.
        kind: `angle`, `quaternion` or empty.
    """

    name: str
    offset: int
    code: str
    unit: str = ""
    kind: str = ""


@dataclass
class Row:
    """The values of one message at one time: a row of a signal.

    Args:
        suffix: suffix of the signal's name after the topic: the child frame of a transform.
        columns: the channels.
        stamp: positions of seconds and nanoseconds of the header's stamp; None without a header.
        frames: the frame that the values are in, and the child frame where the message has one.
    """

    suffix: str = ""
    columns: list[Column] = field(default_factory=list)
    stamp: tuple[int, int] | None = None
    frames: tuple[str, ...] = ()


@dataclass(frozen=True)
class Layout:
    """The positions of all fields in messages of one length that agree in some of their bytes.

    Args:
        places: (bytes,) the positions of these bytes.
        expected: (bytes,) the bytes there.
        order: byte order, `<` or `>`.
        rows: the rows of a message; several for a list of transforms.
        skipped: fields that are left out, each with the reason.
        available: fields that can be selected.
    """

    places: NDArray[np.intp]
    expected: NDArray[np.uint8]
    order: str
    rows: tuple[Row, ...]
    skipped: Mapping[str, str]
    available: tuple[str, ...]

    def fits(self, table: NDArray[np.uint8]) -> NDArray[np.bool_]:
        """(messages,) whether each message, a row of bytes, has this layout."""
        return np.asarray((table[:, self.places] == self.expected).all(axis=1))

    def stamps(self, table: NDArray[np.uint8], row: Row) -> NDArray[np.int64] | None:
        """(messages,) header stamps in nanoseconds, or None without a header."""
        if row.stamp is None:
            return None
        seconds: NDArray[np.int64]
        seconds = _numbers(table, row.stamp[0], self.order + "i4", 1)[:, 0].astype(np.int64)
        nanoseconds = _numbers(table, row.stamp[1], self.order + "u4", 1)[:, 0].astype(np.int64)
        stamps: NDArray[np.int64] = seconds * 1_000_000_000 + nanoseconds
        return stamps

    def values(self, table: NDArray[np.uint8], row: Row) -> NDArray[np.float64]:
        """(messages, channels) the numbers, as float64."""
        values = np.empty((len(table), len(row.columns)))
        first = 0
        while first < len(row.columns):  # adjacent numbers are decoded together
            start = row.columns[first]
            size = int(start.code[-1])
            last = first + 1
            while (
                last < len(row.columns)
                and row.columns[last].code == start.code
                and row.columns[last].offset == start.offset + (last - first) * size
            ):
                last += 1
            values[:, first:last] = _numbers(table, start.offset, start.code, last - first)
            first = last
        return values


def _numbers(table: NDArray[np.uint8], offset: int, code: str, count: int) -> NDArray[Any]:
    size = int(code[-1]) * count
    return np.ascontiguousarray(table[:, offset : offset + size]).view(code)


def find_layout(
    message: bytes,
    kind: str,
    definitions: Definitions,
    *,
    cdr: bool,
    wanted: Callable[[str], bool] | None = None,
) -> Layout:
    """Parses one message and records the position of each field.

    Args:
        message: the serialised message.
        kind: its type, such as `sensor_msgs/msg/Imu`.
        definitions: fields of this type and of its nested types.
        cdr: serialised by ROS 2; else by ROS 1.
        wanted: whether a channel of this name is selected. By default all numbers are, except
            covariances, sequences longer than `WIDEST`, lists of messages that are longer or whose
            type does not fix their length, times, and what the header holds.

    Raises:
        FileFormatError: the message does not fit the definition, or a type is not known.
    """
    parser = _Parser(message, definitions, cdr=cdr, wanted=wanted)
    try:
        parser.message(kind, "", Row(), "")
    except (struct.error, UnicodeDecodeError) as error:
        raise FileFormatError(
            f"a message of type {kind} is truncated or damaged ({error})"
        ) from None
    rest = len(message) - parser.base - parser.position
    if rest < 0 or rest > (3 if cdr else 0):
        raise FileFormatError(
            f"a message of {len(message)} bytes does not fit the definition of {kind}, which "
            f"takes {parser.base + parser.position}"
        )
    places = np.array(sorted(parser.agreed), dtype=np.intp)
    return Layout(
        places,
        np.frombuffer(message, np.uint8)[places],
        parser.order,
        tuple(row for row in parser.rows if row.columns),
        parser.skipped,
        tuple(dict.fromkeys(parser.available)),
    )


class _Parser:
    """Parses one message; `position` counts from the start of its fields."""

    def __init__(
        self,
        message: bytes,
        definitions: Definitions,
        *,
        cdr: bool,
        wanted: Callable[[str], bool] | None,
    ) -> None:
        self.raw = message
        self.definitions = definitions
        self.cdr = cdr
        self.wanted = wanted
        self.base = 4 if cdr else 0
        self.order = "<"
        self.position = 0
        self.agreed: set[int] = set()
        self.rows: list[Row] = []
        self.skipped: dict[str, str] = {}
        self.available: list[str] = []
        self.labels: dict[str, str] = {}  # names of the messages of lists
        if cdr:
            if len(message) < 4 or message[0] != 0 or message[1] > 1:
                raise FileFormatError(
                    f"a message starts with {message[:4].hex(' ')}, expected the CDR of ROS 2 "
                    "(00 00 or 00 01)"
                )
            self.order = "<" if message[1] else ">"
            self.agreed.update((0, 1))

    def message(self, kind: str, path: str, row: Row, unit: str) -> None:
        """Parses the fields of a message; a message that is not a field is a separate row."""
        if kind not in self.definitions:
            raise UnreadableTypeError(f"the message type {kind} is not defined")
        if path.count(".") > _DEEPEST:
            raise UnreadableTypeError(f"messages are nested more than {_DEEPEST} deep")
        start = f"{path}." if path else ""
        if not path:
            self.rows.append(row)
        units = _UNITS.get(kind, {})
        labels: list[str] = []
        sequences: list[tuple[str, int, str, int, str]] = []
        first = len(row.columns)
        for name, description in self.definitions[kind][1]:
            node, what = description
            here = start + name
            unit_here = units.get(name, unit)
            if node == _NAME:
                if what in _TIMES:
                    self._time(what, here, row, stamp=here in ("header.stamp", "stamp"))
                else:
                    self.message(what, here, row, unit_here)
            elif node == _BASE and what[0] not in _CODES:
                is_frame = here in ("header.frame_id", "child_frame_id")
                is_label = name in _LABELS and path.endswith("]")
                text = self._string(what[0], keep=is_frame or is_label)
                if is_label:
                    self.labels[path] = text
                if is_frame and (name == "frame_id" or kind != _TRANSFORM):
                    row.frames = (*row.frames, text)
                if not here.startswith("header."):
                    self.skipped.setdefault(here, "text")
            elif node == _BASE:
                offset, code = self._run(what[0], 1)
                self._take(row, [here], offset, code, unit_here, here)
            else:
                (inner, detail), count = what
                if node != _ARRAY:
                    count = self._length()
                if inner == _NAME:
                    self._messages(detail, here, count, row, fixed=node == _ARRAY)
                elif detail[0] not in _CODES:
                    texts = [self._string(detail[0], keep=name in _NAMES) for _ in range(count)]
                    if name in _NAMES:
                        labels = texts
                    self.skipped.setdefault(here, "text")
                elif count:
                    offset, code = self._run(detail[0], count)
                    sequences.append((here, offset, code, count, unit_here))
        for here, offset, code, count, unit_here in sequences:
            names = [f"{here}[{i}]" for i in range(count)]
            if len(labels) == count and len(set(labels)) == count and all(labels):
                names = [f"{here}.{label}" for label in labels]
            self._take(row, names, offset, code, unit_here, here)
        if kind == _QUATERNION and len(row.columns) - first == 4:
            row.columns[first:] = [
                Column(c.name, c.offset, c.code, "", "quaternion") for c in row.columns[first:]
            ]

    def _messages(self, kind: str, here: str, count: int, row: Row, *, fixed: bool) -> None:
        """Parses a list of messages: separate rows if they are transforms.

        Others have channels `here[0].x`, or `here.hip.x` where all messages of the list have a
        name, as their order may change. A list whose type does not fix its length is left out by
        default, as is one longer than `WIDEST`.
        """
        most = WIDEST * fixed if self.wanted is None else _MOST_MESSAGES
        if kind != _TRANSFORM and count <= most:
            first = len(row.columns)
            for i in range(count):
                self.message(kind, f"{here}[{i}]", row, "")
            labels = {self.labels.get(f"{here}[{i}]", ""): f"{here}[{i}]." for i in range(count)}
            chosen = self.wanted is None or self.wanted(here)
            if len(labels) == count and all(labels) and chosen:
                for label, start in labels.items():
                    row.columns[first:] = [
                        replace(c, name=f"{here}.{label}.{c.name[len(start) :]}")
                        if c.name.startswith(start)
                        else c
                        for c in row.columns[first:]
                    ]
            if count:
                self.available.append(here)
            return
        if kind != _TRANSFORM:
            self.available.append(here)
        for _ in range(count):
            mark, known = len(self.rows), len(self.available)
            own = Row()
            skipped, self.skipped = self.skipped, {}
            self.message(kind, "", own, "")
            self.skipped = skipped
            if kind == _TRANSFORM:
                own.suffix = self._child(own)
            else:
                del self.rows[mark:], self.available[known:]
        if kind != _TRANSFORM:
            self.skipped.setdefault(here, "a list of messages, unless chosen with fields=")

    def _child(self, row: Row) -> str:
        """The child frame of the transform that was just parsed; its bytes must agree."""
        start, stop = self.last_text
        self.agreed.update(range(start, stop))
        return self.raw[start:stop].rstrip(b"\0").decode()

    def _take(
        self, row: Row, names: list[str], offset: int, code: str, unit: str, here: str
    ) -> None:
        self.available.append(here)
        if self.wanted is None:
            if here == "structure_needs_at_least_one_member" or here.startswith("header."):
                return
            if "covariance" in here.rpartition(".")[2]:
                self.skipped.setdefault(here, f"covariance, {len(names)} numbers")
                return
            if len(names) > WIDEST:
                self.skipped.setdefault(here, f"{len(names)} numbers, more than {WIDEST}")
                return
        size = int(code[-1])
        angle = unit == "rad"
        row.columns.extend(
            Column(name, offset + i * size, code, unit, "angle" if angle else "")
            for i, name in enumerate(names)
            if self.wanted is None or self.wanted(name)
        )

    def _time(self, kind: str, here: str, row: Row, *, stamp: bool) -> None:
        seconds, _ = self._run("int32", 1)
        nanoseconds, _ = self._run("uint32", 1)
        if stamp and kind == _TIMES[0]:
            row.stamp = (seconds, nanoseconds)
        else:
            self.skipped.setdefault(here, "a time")

    def _run(self, base: str, count: int) -> tuple[int, str]:
        """Position and type of adjacent numbers."""
        code = _CODES[base]
        size = int(code[-1])
        if self.cdr:
            self.position += -self.position % size
        offset = self.base + self.position
        self.position += size * count
        if offset + size * count > len(self.raw):
            raise struct.error(f"{size * count} bytes expected at {offset} of {len(self.raw)}")
        return offset, self.order + code

    def _length(self) -> int:
        offset, _ = self._run("uint32", 1)
        self.agreed.update(range(offset, offset + 4))
        (length,) = struct.unpack_from(self.order + "I", self.raw, offset)
        if length > len(self.raw):
            raise struct.error(f"a length of {length} at {offset} of {len(self.raw)}")
        return int(length)

    def _string(self, base: str, *, keep: bool = False) -> str:
        if base != "string":
            raise UnreadableTypeError(f"fields of type {base} can't be read")
        length = self._length()
        start = self.base + self.position
        self.position += length
        self.last_text = (start, start + length)
        if not keep:
            return ""
        self.agreed.update(range(start, start + length))
        return self.raw[start : start + length].rstrip(b"\0").decode()
