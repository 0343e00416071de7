"""Streams and batches of CSV on their way to numbers: lines left out, blanks, stamps."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from offbeat.data.readers.columns import Columns
from offbeat.data.readers.stamps import date_and_time

_AROUND = b" \t\r\n\xef\xbb\xbf"  # blanks, and a byte order mark where files are joined


class Without:
    """A stream of text without some lines."""

    closed = False

    def __init__(self, file: Any, lines: Sequence[bytes]) -> None:
        self.file, self.lines = file, frozenset(lines)

    def read(self, size: int = -1) -> bytes:
        """The next lines, about `size` bytes of them."""
        while lines := self.file.readlines(size if size > 0 else -1):
            kept = (line for line in lines if line.strip(_AROUND) not in self.lines)
            if text := b"".join(kept):
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


def without_units(
    batch: Any,
    units: Mapping[str, str],
    types: Mapping[str, Any],
    missing: Sequence[str],
    decimal: str,
) -> Any:
    """A batch whose texts with a unit after each number are of their types, without it."""
    import pyarrow as pa
    import pyarrow.compute as pc

    nothing = pa.array(missing)
    for name, unit in units.items():
        at = batch.schema.get_field_index(name)
        if at < 0:
            continue
        texts = pc.utf8_trim_whitespace(batch.column(at))
        texts = pc.replace_substring_regex(texts, rf"\s*{re.escape(unit)}$", "")
        if not pa.types.is_string(types[name]):
            texts = pc.replace_substring(texts, decimal, ".")
            texts = pc.if_else(pc.is_in(texts, nothing), pa.scalar(None, pa.string()), texts)
        batch = batch.set_column(at, name, texts.cast(types[name]))
    return batch


def with_count(batches: Iterator[Any], rate_hz: float) -> Iterator[Any]:
    """Batches with a column without a name: nanoseconds of rows at a fixed rate."""
    import pyarrow as pa

    start = 0
    for batch in batches:
        rows = np.arange(start, start + batch.num_rows)
        start += batch.num_rows
        stamps = np.rint(rows * (1e9 / rate_hz)).astype(np.int64)
        yield batch.append_column("", pa.array(stamps))


def without_empty(batch: Any) -> Any:
    """A batch without the rows in which all columns are empty, as spreadsheets write them."""
    import pyarrow as pa
    import pyarrow.compute as pc

    empty = None
    for column in batch.columns:
        if pa.types.is_string(column.type):
            missing = pc.equal(pc.binary_length(pc.utf8_trim_whitespace(column)), 0)
        elif column.null_count:
            missing = pc.is_null(column)
        else:
            return batch
        missing = pc.fill_null(missing, True)
        empty = missing if empty is None else pc.and_(empty, missing)
        if not pc.any(empty).as_py():
            return batch
    return batch if empty is None else batch.filter(pc.invert(empty))
