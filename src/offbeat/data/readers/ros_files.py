"""Containers of ROS messages: bags of ROS 1 and, through `rosbags`, those of ROS 2.

A bag of ROS 1 (format 2.0, wiki.ros.org/Bags/Format/2.0) is read here, chunk by chunk in the order
of the file: every chunk with a chosen topic is decompressed once, and no
index of all messages is built, so memory does not grow with the bag.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, BinaryIO

from offbeat.data.readers.ros_mcap import LARGEST_CHUNK, Mcap, decompressed
from offbeat.data.source import require_file
from offbeat.errors import FileFormatError, OffbeatError, require


@dataclass(frozen=True)
class Connection:
    """A connection of a bag: a topic and the type of its messages.

    Args:
        id: number that messages refer to.
        topic: name of the topic.
        kind: type of its messages, such as `sensor_msgs/msg/Imu`.
        encoding: how they are serialised, `ros1`, `cdr` or another.
        form: language of the definition, `msg`, `idl` or empty.
        definition: text that defines the type; empty if the bag has none.
    """

    id: int
    topic: str
    kind: str
    encoding: str
    form: str
    definition: str

    def parsed(self) -> dict[str, Any]:
        """Fields of each message type in the definition, parsed by `rosbags`."""
        from rosbags.typesys import get_types_from_idl, get_types_from_msg

        if self.form == "msg":
            return dict(get_types_from_msg(self.definition, self.kind))
        parsed: dict[str, Any] = {}
        if self.form == "idl":
            rule = "=" * 80 + "\n"  # the line above the name of each file in it
            if not self.definition.startswith(f"{rule}IDL: "):
                return dict(get_types_from_idl(self.definition))
            for part in self.definition.split(rule)[1:]:
                parsed |= get_types_from_idl(part.partition("\n")[2])
        return parsed


@dataclass(frozen=True)
class Bag:
    """An open bag.

    Args:
        connections: of the bag.
        messages: takes ids of connections; yields the id, the time of receipt in
            nanoseconds and the serialised message.
        notes: on a file that was cut off.
    """

    connections: tuple[Connection, ...]
    messages: Callable[[set[int]], Iterator[tuple[int, int, bytes]]]
    notes: tuple[str, ...] = ()


@contextmanager
def open_bag(path: Path) -> Iterator[Bag]:
    """Opens a bag of ROS 1 or ROS 2.

    Raises:
        FileFormatError: it is truncated, damaged or of another format.
        MissingExtraError: `rosbags` is not installed.
    """
    require("rosbags", "ros")
    if path.suffix.lower() == ".bag":
        with path.open("rb") as file:
            with explained(path):
                bag = _Bag1(file)

            def messages(ids: set[int]) -> Iterator[tuple[int, int, bytes]]:
                with explained(path):
                    yield from bag.messages(ids)

            yield Bag(tuple(bag.connections.values()), messages)
        return
    inside = [path]
    if path.is_dir():
        inside = sorted(p for form in ("*.db3", "*.mcap") for p in path.glob(form))
        packed = sorted(path.glob("*.zstd"))
        if not inside and not packed:
            raise FileFormatError(f"{path} holds no .db3 and no .mcap file, expected a ROS 2 bag")
        if packed or (inside[0].suffix == ".db3" and (path / "metadata.yaml").is_file()):
            yield from _open_ros2(path, inside)
            return
    opened = [_open_mcap(p) if p.suffix.lower() == ".mcap" else _open_ros2(p, [p]) for p in inside]
    with ExitStack() as stack:
        bags = [stack.enter_context(contextmanager(lambda made=made: made)()) for made in opened]
        yield bags[0] if len(bags) == 1 else _together(bags)


def _together(bags: list[Bag]) -> Bag:
    """The files of one bag, one after the other, as one."""
    connections: list[Connection] = []
    starts: list[int] = []
    for bag in bags:
        starts.append(len(connections))
        connections += [replace(c, id=len(connections) + i) for i, c in enumerate(bag.connections)]

    def messages(ids: set[int]) -> Iterator[tuple[int, int, bytes]]:
        for start, bag in zip(starts, bags, strict=True):
            new = {c.id: start + i for i, c in enumerate(bag.connections) if start + i in ids}
            for number, received, message in bag.messages(set(new)):
                yield new[number], received, message

    notes = tuple(dict.fromkeys(note for bag in bags for note in bag.notes))
    return Bag(tuple(connections), messages, notes)


def _open_mcap(path: Path) -> Iterator[Bag]:
    with require_file(path).open("rb") as file:
        with explained(path):
            mcap = Mcap(file)
        forms = {"ros2msg": "msg", "ros1msg": "msg", "ros2idl": "idl", "omgidl": "idl", "": ""}

        def messages(ids: set[int]) -> Iterator[tuple[int, int, bytes]]:
            with explained(path):
                yield from mcap.messages(ids)

        note = f"{path.name} is cut off, as by a loss of power; the part before the cut is read"
        yield Bag(
            tuple(
                Connection(
                    c.id,
                    c.topic,
                    _full_name(c.kind),
                    # A definition in another language is not one of ROS.
                    c.encoding if c.form in forms else f"{c.encoding} with {c.form}",
                    forms.get(c.form, ""),
                    c.definition,
                )
                for c in mcap.channels.values()
            ),
            messages,
            (note,) if mcap.cut else (),
        )


def _full_name(kind: str) -> str:
    """The type of a message in the form of ROS 2: `std_msgs/Header` is `std_msgs/msg/Header`."""
    package, _, name = kind.rpartition("/")
    return f"{package.removesuffix('/msg')}/msg/{name}" if package else kind


def _open_ros2(path: Path, inside: list[Path]) -> Iterator[Bag]:
    from rosbags.interfaces import MessageDefinitionFormat
    from rosbags.rosbag2 import Reader

    forms = {MessageDefinitionFormat.MSG: "msg", MessageDefinitionFormat.IDL: "idl"}
    with explained(path):
        for file in inside:
            _check_length(require_file(file))
        reader = Reader(path)
        try:
            reader.open()
        except KeyError as error:
            raise FileFormatError(
                f"{path} holds messages that are defined in {error}, expected those of ROS 2 "
                "(ros2msg, ros2idl); convert it, or read the bag it was made from"
            ) from None
    connections: dict[int, Any] = {c.id: c for c in reader.connections}

    def messages(ids: set[int]) -> Iterator[tuple[int, int, bytes]]:
        with explained(path):
            for connection, received, message in reader.messages([connections[i] for i in ids]):
                yield connection.id, received, message

    try:
        yield Bag(
            tuple(
                Connection(
                    c.id,
                    c.topic,
                    c.msgtype,
                    c.ext.serialization_format,
                    forms.get(c.msgdef.format, ""),
                    c.msgdef.data,
                )
                for c in connections.values()
            ),
            messages,
        )
    finally:
        reader.close()


def _check_length(path: Path) -> None:
    """Raises an error for a truncated SQLite file, which SQLite detects only at its end."""
    with path.open("rb") as file:
        start = file.read(100)  # the header: sqlite.org/fileformat.html, section 1.3
    if len(start) < 100 or not start.startswith(b"SQLite format 3"):
        return
    page = int.from_bytes(start[16:18], "big")
    pages = int.from_bytes(start[28:32], "big")
    valid = start[24:28] == start[92:96]
    size = path.stat().st_size
    if valid and size < pages * (65536 if page == 1 else page):
        raise ValueError(f"it has {size} of {pages * page} bytes")


@contextmanager
def explained(path: Path) -> Iterator[None]:
    """Converts errors about a damaged file to one line."""
    try:
        yield
    except FileFormatError as error:
        if str(path) in str(error):
            raise
        raise FileFormatError(f"{path}: {error}") from None
    except OffbeatError:
        raise
    except Exception as error:
        what = " ".join(str(error).split())[:90] or type(error).__name__
        repair = "rosbag reindex" if path.suffix.lower() == ".bag" else "ros2 bag reindex"
        raise FileFormatError(
            f"{path} can't be read as a ROS bag, it is truncated, damaged or of another format "
            f"({what}); copy it again, or repair it with: {repair}"
        ) from None


_U4 = struct.Struct("<I").unpack_from
_TIME = struct.Struct("<II").unpack_from
_MESSAGE, _BAG, _CHUNK, _CONNECTION = 2, 3, 5, 7
_SHORT = "it ends in the middle of a record"


class _Bag1:
    """A bag of ROS 1: its connections, and the positions of its chunks."""

    def __init__(self, file: BinaryIO) -> None:
        self.file = file
        self.size = os.fstat(file.fileno()).st_size
        magic = file.readline(16)
        if magic != b"#ROSBAG V2.0\n":
            raise ValueError(f"it starts with {magic!r}, not with '#ROSBAG V2.0'")
        header, _ = self._record()
        if header.get(b"encryptor"):
            raise ValueError("it is encrypted")
        (index,) = struct.unpack("<Q", header[b"index_pos"])
        if index == 0:
            raise ValueError("it has no index, the recording was cut off")
        self.start = file.tell()
        self.connections: dict[int, Connection] = {}
        self.chunks: dict[int, set[int]] = {}
        file.seek(index)
        while file.tell() < self.size:
            header, data = self._record()
            if header[b"op"][0] == _CONNECTION:
                self._connect(header, data)
            else:  # what is in a chunk
                (chunk,) = struct.unpack("<Q", header[b"chunk_pos"])
                self.chunks[chunk] = {number for number, _ in struct.iter_unpack("<II", data)}

        if (
            len(self.connections) != _U4(self._first[b"conn_count"])[0]
            or len(self.chunks) != _U4(self._first[b"chunk_count"])[0]
        ):
            raise ValueError("its index is not complete")

    def _record(self) -> tuple[Mapping[bytes, bytes], bytes]:
        header = _fields(self._sized())
        if header[b"op"][0] == _BAG:
            self._first = header
        return header, self._sized()

    def _sized(self) -> bytes:
        length = self.file.read(4)
        if len(length) < 4 or self.file.tell() + _U4(length)[0] > self.size:
            raise ValueError(_SHORT)
        return self.file.read(_U4(length)[0])

    def _connect(self, header: Mapping[bytes, bytes], data: bytes) -> None:
        (number,) = _U4(header[b"conn"])
        described = _fields(data)
        self.connections[number] = Connection(
            number,
            header[b"topic"].decode(),
            _full_name(described[b"type"].decode()),
            "ros1",
            "msg",
            described[b"message_definition"].decode(errors="replace"),
        )

    def messages(self, ids: set[int]) -> Iterator[tuple[int, int, bytes]]:
        """Yields id of the connection, time of receipt and message, in the order of the file."""
        for position in sorted(p for p, inside in self.chunks.items() if inside & ids):
            self.file.seek(position)
            header, data = self._record()
            if header[b"op"][0] != _CHUNK:
                raise ValueError(f"there is no chunk at {position}")
            size = _U4(header[b"size"])[0]
            if size > LARGEST_CHUNK:
                raise ValueError(f"the chunk at {position} has {size} bytes")
            chunk = decompressed(data, header[b"compression"].decode(), size)
            if len(chunk) != size:
                raise ValueError(f"the chunk at {position} is not complete")
            yield from _of_chunk(chunk, ids)


def _of_chunk(chunk: bytes, ids: set[int]) -> Iterator[tuple[int, int, bytes]]:
    """The messages of a chunk. Headers of one length mostly differ in number and time alone."""
    shapes: dict[int, tuple[bytes, int, int]] = {}
    position, size = 0, len(chunk)
    while position < size:
        head = position + 4
        end = head + _U4(chunk, position)[0]
        start = end + 4
        position = start + _U4(chunk, end)[0]
        if position > size:
            raise ValueError(_SHORT)
        header = chunk[head:end]
        shape = shapes.get(end - head)
        if shape is None or shape[0] != _without(header, shape[1], shape[2]):
            fields = _fields(header)
            if fields[b"op"][0] != _MESSAGE:
                continue
            at, when = header.index(b"conn=") + 5, header.index(b"time=") + 5
            shape = (_without(header, at, when), at, when)
            shapes[end - head] = shape
        number = _U4(header, shape[1])[0]
        if number in ids:
            seconds, nanoseconds = _TIME(header, shape[2])
            yield number, seconds * 1_000_000_000 + nanoseconds, chunk[start:position]


def _without(header: bytes, at: int, when: int) -> bytes:
    """A header without its number and time, which come in either order."""
    if at < when:
        return header[:at] + header[at + 4 : when] + header[when + 8 :]
    return header[:when] + header[when + 8 : at] + header[at + 4 :]


def _fields(header: bytes) -> dict[bytes, bytes]:
    """Fields of a header: each a length, a name, `=` and a value."""
    fields, position = {}, 0
    while position < len(header):
        (length,) = _U4(header, position)
        name, equals, value = header[position + 4 : position + 4 + length].partition(b"=")
        position += 4 + length
        if not equals or position > len(header):
            raise ValueError("a header is damaged")
        fields[name] = value
    return fields
