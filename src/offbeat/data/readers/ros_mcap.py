"""MCAP files with messages of ROS, record by record in the order of the file.

The format: mcap.dev/spec. Memory does not grow with the file. A file that was cut off, as by a loss
of power, is read up to the cut. Topics of other encodings, such as JSON, do not get in the way.
"""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import BinaryIO

from offbeat.errors import require

MAGIC = b"\x89MCAP0\r\n"
LARGEST_CHUNK = 1 << 30
"""Bytes of a chunk once it is decompressed; programs write a few MiB."""

_HEADER, _FOOTER, _SCHEMA, _CHANNEL, _MESSAGE, _CHUNK, _CHUNK_INDEX = 1, 2, 3, 4, 5, 6, 8
_LARGEST_RECORD = 1 << 30  # bytes of any other record
_U2, _U4, _U8 = (struct.Struct(code) for code in ("<H", "<I", "<Q"))
_RECORD = struct.Struct("<BQ")


class CutError(ValueError):
    """A record ends after the end of the file."""


@dataclass(frozen=True)
class Channel:
    """A topic of an MCAP file.

    Attributes:
        id: number that messages refer to.
        topic: its name.
        encoding: of its messages, such as `cdr`, `ros1`, `json`.
        kind: type of its messages; empty without a schema.
        form: encoding of the definition, such as `ros2msg`; empty without a schema.
        definition: of that type.
    """

    id: int
    topic: str
    encoding: str
    kind: str
    form: str
    definition: str


class Mcap:
    """An open MCAP file.

    Args:
        file: opened for reading bytes.

    Attributes:
        channels: by number.
        cut: whether the file ends before its end record.

    Raises:
        ValueError: it is damaged, or no MCAP.
    """

    def __init__(self, file: BinaryIO) -> None:
        self.file = file
        self.size = os.fstat(file.fileno()).st_size
        self.channels: dict[int, Channel] = {}
        self.cut = False
        self._schemas: dict[int, tuple[str, str, str]] = {}
        self._inside: dict[int, frozenset[int]] = {}  # channels of the chunk at a position
        file.seek(0)
        if file.read(len(MAGIC)) != MAGIC:
            raise ValueError("it does not start as an MCAP does")
        summary = self._summary()
        if summary:
            self._read_summary(summary)
        if not self.channels:
            for _ in self.messages(set()):
                pass
            if self.cut and not self.channels:
                raise ValueError("it is cut off before any topic")

    def _summary(self) -> int:
        """Position of the summary; 0 without one."""
        start = max(self.size - 37, 0)
        self.file.seek(start)
        end = self.file.read(37)
        if len(end) < 37 or not end.endswith(MAGIC) or end[0] != _FOOTER:
            self.cut = True
            return 0
        (summary,) = _U8.unpack_from(end, 9)
        return summary if len(MAGIC) < summary < start else 0

    def _read_summary(self, position: int) -> None:
        for code, data in self._records(position):
            if code == _CHUNK_INDEX:
                (start,) = _U8.unpack_from(data, 16)
                (length,) = _U4.unpack_from(data, 32)
                offsets = data[36 : 36 + length]
                inside = (number for number, _ in struct.iter_unpack("<HQ", offsets))
                self._inside[start] = frozenset(inside)
            elif code == _FOOTER:
                return
            else:
                self._describe(code, data)

    def messages(self, ids: set[int]) -> Iterator[tuple[int, int, bytes]]:
        """Yields id of the channel, time of receipt in nanoseconds and message.

        Raises:
            ValueError: the file is damaged.
        """
        try:
            for code, data in self._records(len(MAGIC), ids):
                if code == _CHUNK:
                    for inner, part in _parsed(_decompressed(data)):
                        if inner == _MESSAGE:
                            yield from _message(part, ids)
                        else:
                            self._describe(inner, part)
                elif code == _MESSAGE:
                    yield from _message(data, ids)
                elif code == _FOOTER:
                    return
                else:
                    self._describe(code, data)
        except CutError:
            if not self.cut:
                raise

    def _records(self, position: int, ids: set[int] | None = None) -> Iterator[tuple[int, bytes]]:
        """Opcodes and contents of the records from a position on, without unneeded chunks."""
        while position < self.size:
            self.file.seek(position)
            start = self.file.read(_RECORD.size)
            if len(start) < _RECORD.size:
                raise CutError("it ends in the middle of a record")
            code, length = _RECORD.unpack(start)
            begin, position = position, position + _RECORD.size + length
            if position > self.size:
                raise CutError("it ends in the middle of a record")
            if code == _CHUNK and ids is not None and begin in self._inside:
                if not ids & self._inside[begin]:
                    continue
            elif code != _CHUNK and length > _LARGEST_RECORD:
                raise ValueError(f"a record has {length} bytes")
            if code in (_HEADER, _FOOTER, _SCHEMA, _CHANNEL, _MESSAGE, _CHUNK, _CHUNK_INDEX):
                yield code, self.file.read(length)

    def _describe(self, code: int, data: bytes) -> None:
        """Keeps a schema or a channel."""
        if code == _SCHEMA:
            (number,) = _U2.unpack_from(data)
            name, at = _text(data, 2)
            form, at = _text(data, at)
            definition, _ = _text(data, at)
            self._schemas[number] = (name, form, definition)
        elif code == _CHANNEL:
            (number,) = _U2.unpack_from(data)
            (schema,) = _U2.unpack_from(data, 2)
            topic, at = _text(data, 4)
            encoding, _ = _text(data, at)
            described = self._schemas.get(schema, ("", "", ""))
            self.channels.setdefault(number, Channel(number, topic, encoding, *described))


def _message(data: bytes, ids: set[int]) -> Iterator[tuple[int, int, bytes]]:
    if len(data) < 22:
        raise ValueError("a message is too short")
    (number,) = _U2.unpack_from(data)
    if number in ids:
        (received,) = _U8.unpack_from(data, 6)
        yield number, received if received < 2**63 else 0, data[22:]


def _parsed(chunk: bytes) -> Iterator[tuple[int, bytes]]:
    """The records in a chunk."""
    position = 0
    while position < len(chunk):
        if position + _RECORD.size > len(chunk):
            raise ValueError("a chunk ends in the middle of a record")
        code, length = _RECORD.unpack_from(chunk, position)
        position += _RECORD.size
        if position + length > len(chunk):
            raise ValueError("a chunk ends in the middle of a record")
        yield code, chunk[position : position + length]
        position += length


def _text(data: bytes, at: int) -> tuple[str, int]:
    """A text after its length, and the position after it."""
    (length,) = _U4.unpack_from(data, at)
    end = at + 4 + length
    if end > len(data):
        raise ValueError("a text is longer than its record")
    return data[at + 4 : end].decode(errors="replace"), end


def _decompressed(data: bytes) -> bytes:
    """The records of a chunk record."""
    (size,) = _U8.unpack_from(data, 16)
    compression, at = _text(data, 28)
    (length,) = _U8.unpack_from(data, at)
    packed = data[at + 8 : at + 8 + length]
    if size > LARGEST_CHUNK or len(packed) != length:
        raise ValueError(f"a chunk has {size} bytes, {len(packed)} of {length} compressed")
    chunk = decompressed(packed, compression, size)
    if len(chunk) != size:
        raise ValueError(f"a chunk has {len(chunk)} bytes, expected {size}")
    (checksum,) = _U4.unpack_from(data, 24)
    if checksum and zlib.crc32(chunk) != checksum:
        raise ValueError("the checksum of a chunk does not match")
    return chunk


def decompressed(data: bytes, compression: str, size: int) -> bytes:
    """At most `size` + 1 bytes of compressed data.

    Raises:
        ValueError: the compression is not known.
        MissingExtraError: its library is not installed.
    """
    make: Callable[[], object]
    if compression in ("", "none"):
        return data
    if compression == "bz2":
        import bz2

        return bz2.BZ2Decompressor().decompress(data, max_length=size + 1)
    if compression == "lz4":
        make = require("lz4.frame", "ros").LZ4FrameDecompressor
    elif compression == "zstd":
        try:
            make = require("compression.zstd", "ros").ZstdDecompressor
        except ImportError:
            make = require("backports.zstd", "ros").ZstdDecompressor
    else:
        raise ValueError(f"compression {compression[:40]!r} is not known")
    found: bytes = make().decompress(data, max_length=size + 1)  # type: ignore[attr-defined]
    return found
