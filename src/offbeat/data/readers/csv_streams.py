"""Streams and batches of CSV on their way to numbers: lines left out, blanks, stamps."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from offbeat.data.readers.columns import Columns
from offbeat.data.readers.stamps import date_and_time


class Without:
    """A stream of text without some line."""

    closed = False

    def __init__(self, file: Any, line: bytes) -> None:
        self.file, self.line = file, line

    def read(self, size: int = -1) -> bytes:
        """The next lines, about `size` bytes of them."""
        while lines := self.file.readlines(size if size > 0 else -1):
            if text := b"".join(line for line in lines if line.strip() != self.line):
                return text
        return b""

    def close(self) -> None:
        """Closes the file."""
        self.file.close()


class Spaced:
    """A stream of text with one blank between fields, and no comments."""

    closed = False

    def __init__(self, file: Any) -> None:
        self.file = file

    def read(self, size: int = -1) -> bytes:
        """The next lines, about `size` bytes of them."""
        while lines := self.file.readlines(size if size > 0 else -1):
            text = b"".join(
                b" ".join(line.split()) + b"\n"
                for line in lines
                if line.strip() and not line.lstrip().startswith((b"#", b"%", b"//"))
            )
            if text:
                return text
        return b""

    def close(self) -> None:
        """Closes the file."""
        self.file.close()


def with_dates(batches: Iterator[Any], columns: Columns, form: str) -> Iterator[Any]:
    """Batches with nanoseconds in place of a date and a time of day."""
    for batch in batches:
        stamps = date_and_time(batch.column(columns.time), batch.column(columns.rest), form)
        yield batch.set_column(batch.schema.get_field_index(columns.time), columns.time, stamps)


def with_count(batches: Iterator[Any], rate_hz: float) -> Iterator[Any]:
    """Batches with a column without a name: nanoseconds of rows at a fixed rate."""
    import pyarrow as pa

    start = 0
    for batch in batches:
        rows = np.arange(start, start + batch.num_rows)
        start += batch.num_rows
        stamps = np.rint(rows * (1e9 / rate_hz)).astype(np.int64)
        yield batch.append_column("", pa.array(stamps))
