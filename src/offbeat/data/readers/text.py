"""Files of text: their compression, their encoding, and their lines, in bounded memory."""

from __future__ import annotations

import bz2
import codecs
import csv
import gzip
import io
import itertools
import lzma
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any

from offbeat.errors import FileFormatError

LONGEST_LINE = 1 << 24
"""Characters of a line; a longer one is refused before it is read to its end."""

COMPRESSED = (".gz", ".bz2", ".xz")
"""Suffixes after that of a text file which is compressed; the content alone decides."""

_MOST_EMPTY = 100_000
_BLOCK = 1 << 20
_START = 1 << 16  # bytes from which the encoding is derived
_OPENERS: dict[bytes, Any] = {b"\x1f\x8b": gzip.open, b"BZh": bz2.open, b"\xfd7zXZ\0": lzma.open}
_MARKS = {  # byte order marks
    codecs.BOM_UTF8: "utf-8-sig",
    codecs.BOM_UTF16_LE: "utf-16",
    codecs.BOM_UTF16_BE: "utf-16",
}
DAMAGE = (OSError, EOFError, zlib.error, lzma.LZMAError, UnicodeError)
"""Errors of reading a file of text that is damaged."""


@dataclass(frozen=True)
class TextFile:
    """A file of text, which may be compressed by gzip, bzip2 or xz.

    Attributes:
        path: of the file.
        encoding: of its text.
        notes: on an encoding that was assumed.
        end: where bytes of 0 begin, or None; nothing is read from there on.
        cuts: why compressed data ended early, added as it is read.
    """

    path: Path
    encoding: str = "utf-8-sig"
    notes: tuple[str, ...] = ()
    end: int | None = None
    cuts: list[str] = field(default_factory=list)

    @classmethod
    def of(cls, path: Path) -> TextFile:
        """The file with its encoding: UTF-8, UTF-16, with a mark or plain, else Windows-1252.

        Raises:
            FileFormatError: it can't be decompressed, or is no text.
        """
        try:
            with _opened(path, []) as file:
                start = file.read(_START)
        except DAMAGE as error:
            raise no_text(path, error) from None
        for mark, encoding in _MARKS.items():
            if start.startswith(mark):
                text = start.decode(encoding, errors="replace")
                if "\0" in text or "\ufeff" in text[1:] or "\ufffd" in text[:-1]:
                    raise no_text(path, f"it is no {encoding}")
                return cls(path, encoding)
        for encoding, place in (("utf-16-le", 1), ("utf-16-be", 0)):
            if len(start) > 8 and not any(start[place:256:2]) and all(start[1 - place : 256 : 2]):
                return cls(path, encoding, (f"the text is taken for {encoding} without a mark",))
        at = start.find(b"\0")
        if at >= 0 and (start.count(b"\n", 0, at) < 2 or start[at : at + 8].strip(b"\0")):
            raise no_text(path, "it holds bytes of 0")
        try:
            bad, zero = _first_bad_byte(path)
        except DAMAGE as error:
            raise no_text(path, error) from None
        notes: list[str] = []
        if zero is not None:
            notes.append(
                f"there are bytes of 0 from byte {zero} on, as after a loss of power; the text is "
                "read up to there"
            )
        if bad is not None:
            notes.append(
                f"the text is not UTF-8 (byte 0x{bad[1]:02x} at {bad[0]}); it is read as "
                "Windows-1252"
            )
        return cls(path, "utf-8-sig" if bad is None else "cp1252", tuple(notes), end=zero)

    def bytes_from(self, line: int) -> IO[bytes]:
        """A stream of the text in UTF-8, from a line on; the first one is line 1."""
        before = sum(len(text.encode()) for text in itertools.islice(self.lines(), line - 1))
        file = self._file()
        if self.encoding != "utf-8-sig":
            file = io.BufferedReader(_Recoded(file, self.encoding), _BLOCK)
        elif file.peek(3)[:3] == codecs.BOM_UTF8:
            before += 3
        while before > 0:
            before -= len(file.read(min(before, _BLOCK)))
        return file

    def lines(self) -> Iterator[str]:
        """The lines, with their ends.

        Raises:
            FileFormatError: a line is too long, or the text can't be decoded.
        """
        try:
            binary = self._file()
            with io.TextIOWrapper(
                binary, encoding=self.encoding, errors=self._errors, newline=""
            ) as file:
                empty = 0
                while line := file.readline(LONGEST_LINE):
                    empty = empty + 1 if len(line) <= 2 and not line.strip() else 0
                    if empty > _MOST_EMPTY:
                        raise FileFormatError(
                            f"{self.path} has more than {_MOST_EMPTY} empty lines in a row, "
                            "expected a table with a row per line; write it again"
                        )
                    if len(line) == LONGEST_LINE:
                        raise FileFormatError(
                            f"{self.path} has a line of more than {LONGEST_LINE} characters, "
                            "expected a table with a row per line; write it with line ends"
                        )
                    yield line
        except DAMAGE as error:
            raise no_text(self.path, error) from None

    def _file(self) -> io.BufferedReader:
        file = _opened(self.path, self.cuts)
        return file if self.end is None else io.BufferedReader(_UpTo(file, self.end), _BLOCK)

    @property
    def _errors(self) -> str:
        return "replace" if self.encoding == "cp1252" else "strict"

    def rows(self, delimiter: str) -> Iterator[tuple[int, list[str]]]:
        """The number of the last line of each row, and its fields; empty lines are skipped.

        A blank as delimiter stands for any number of blanks and tabs.

        Raises:
            FileFormatError: as `lines`, or a quote is not closed.
        """
        if delimiter == " ":
            for number, line in enumerate(self.lines(), 1):
                if fields := line.split():
                    yield number, fields
            return
        reader = csv.reader(self.lines(), delimiter=delimiter)
        try:
            for fields in reader:
                if fields:
                    yield reader.line_num, fields
        except csv.Error as error:
            raise FileFormatError(
                f"{self.path} can't be read as CSV ({error}); it must be text in UTF-8 with a row "
                "per line"
            ) from None


def start_of(path: Path) -> bytes:
    """The first bytes of a file, decompressed; empty if it can't be read."""
    try:
        if not path.is_file():  # a pipe or a device may never end
            return b""
        with _opened(path, []) as file:
            return file.read(_START)
    except DAMAGE:
        return b""


def no_text(path: Path, why: object) -> FileFormatError:
    """The error for a file that is no text."""
    return FileFormatError(
        f"{path} can't be read as CSV or other text ({' '.join(str(why).split())}); it must be "
        "text in UTF-8, and may be compressed by gzip"
    )


def _opener(path: Path) -> Any:
    with path.open("rb") as file:
        start = file.read(8)
    return next((o for magic, o in _OPENERS.items() if start.startswith(magic)), open)


def _opened(path: Path, cuts: list[str]) -> io.BufferedReader:
    opener = _opener(path)
    if opener is open:
        return path.open("rb")
    return io.BufferedReader(_UpToTheCut(opener(path, "rb"), cuts), _BLOCK)


def _first_bad_byte(path: Path) -> tuple[tuple[int, int] | None, int | None]:
    """Place and value of the first byte that is not UTF-8, and the place of the first one of 0."""
    decoder = codecs.getincrementaldecoder("utf-8")()
    bad: tuple[int, int] | None = None
    place = 0
    with _opened(path, []) as file:
        while block := file.read(_BLOCK):
            zero = block.find(b"\0")
            block = block if zero < 0 else block[:zero]
            waiting = len(decoder.getstate()[0])
            if bad is None and (waiting or not block.isascii()):
                try:
                    decoder.decode(block)
                except UnicodeDecodeError as error:
                    bad = (place - waiting + error.start, error.object[error.start])
            if zero >= 0:
                return bad, place + zero
            place += len(block)
    return bad, None


class _UpTo(io.RawIOBase):
    """The first bytes of a file."""

    def __init__(self, file: IO[bytes], end: int) -> None:
        self.file, self.left = file, end

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: Any) -> int:
        part = self.file.read(min(len(buffer), self.left))
        self.left -= len(part)
        buffer[: len(part)] = part
        return len(part)

    def close(self) -> None:
        self.file.close()
        super().close()


class _UpToTheCut(io.RawIOBase):
    """Decompressed bytes; data that end early are read up to there."""

    def __init__(self, file: IO[bytes], cuts: list[str]) -> None:
        self.file, self.cuts, self.started = file, cuts, False

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: Any) -> int:
        try:
            part = self.file.read1(len(buffer))  # type: ignore[attr-defined]
        except DAMAGE as error:
            if not self.started:
                raise
            if str(error) not in self.cuts:
                self.cuts.append(str(error))
            part = b""
        self.started |= bool(part)
        buffer[: len(part)] = part
        return len(part)

    def close(self) -> None:
        self.file.close()
        super().close()


class _Recoded(io.RawIOBase):
    """A stream of bytes in another encoding, in UTF-8."""

    def __init__(self, file: IO[bytes], encoding: str) -> None:
        self.file = file
        errors = "replace" if encoding == "cp1252" else "strict"
        self.decoder = codecs.getincrementaldecoder(encoding)(errors)
        self.waiting = b""

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: Any) -> int:
        while not self.waiting:
            block = self.file.read(len(buffer))
            self.waiting = self.decoder.decode(block, not block).encode()
            if not block:
                break
        part, self.waiting = self.waiting[: len(buffer)], self.waiting[len(buffer) :]
        buffer[: len(part)] = part
        return len(part)

    def close(self) -> None:
        self.file.close()
        super().close()
