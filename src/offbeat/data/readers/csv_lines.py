"""The lines of a CSV file: its header, its first fields, and the lines that errors are about."""

from __future__ import annotations

import itertools
import re
from collections import deque
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from offbeat.data.cleaning.clocks import time_column_of
from offbeat.data.readers.batches import NullValueError
from offbeat.data.readers.columns import Columns
from offbeat.data.readers.csv_fields import (
    BOOLEANS,
    GROUPED_BY_POINTS,
    SWITCHES,
    number_in,
    without_unit,
)
from offbeat.data.readers.csv_layout import CsvLayout, is_comment
from offbeat.data.readers.stamps import expected_after, fits_form, form_in, form_of
from offbeat.data.readers.text import TextFile
from offbeat.errors import FileFormatError, InputError, listed

_COMMA = re.compile(r"[+-]?\d+,\d+")
_GROUPED = re.compile(r"[+-]?[1-9]\d{0,2},\d{3}")
_SAMPLE = 1000  # lines from which the meaning of a column is derived


@dataclass(frozen=True)
class CsvSample:
    """The fields of the first lines, by column.

    Attributes:
        fields: stripped, by column.
        file: that they are from.
    """

    fields: Mapping[str, list[str]]
    file: CsvLines

    def texts(self, name: str) -> list[str]:
        """The fields of a column, empty where they are missing."""
        return ["" if f in self.file.missing else f for f in self.fields.get(name, [])]

    def is_text(self, name: str) -> bool:
        """Whether most of its known fields are neither numbers nor booleans."""
        known = [f for f in self.fields[name] if f and f not in self.file.missing]
        words = [f for f in known if self.file.number(f) is None and f not in BOOLEANS]
        if len(words) == len(known) and all(f.casefold() in SWITCHES for f in words):
            return False
        return 2 * len(words) > len(known)

    def numbers(self, name: str) -> NDArray[np.float64]:
        """The known numbers of a column; empty if a field is none."""
        found = [self.file.number(f) for f in self.fields[name] if f not in self.file.missing]
        if any(number is None for number in found):
            return np.zeros(0)
        return np.array(found, dtype=np.float64)

    def form_of(self, name: str) -> str | None:
        """The form of times as text, by the first one."""
        return form_in(self.texts(name), self.file.day_first, where=str(self.file.path))


@dataclass(frozen=True)
class CsvLines:
    """A CSV file, line by line.

    Attributes:
        text: the file.
        layout: where its table is.
        decimal: the decimal separator; None where it is not known yet.
        missing: fields whose value is not known.
        thousands: whether a comma may separate thousands where the point is the decimal separator.
        repeated: lines of a header, and of units below it, that stand in the middle, too.
        day_first: of dates such as 07/08/2026, whether the day is before the month, or None.
        units: of columns whose fields have one after each number.
    """

    text: TextFile
    layout: CsvLayout
    decimal: str | None
    missing: tuple[str, ...]
    thousands: bool = True
    repeated: tuple[str, ...] = ()
    day_first: bool | None = None
    units: Mapping[str, str] = field(default_factory=dict)

    @property
    def path(self) -> Path:
        """Of the file."""
        return self.text.path

    def header(self) -> tuple[list[str], list[str]]:
        """The column names, unique, empty where a column is left out; and notes."""
        names = list(self.layout.names)
        notes = list(self.layout.notes)
        if not names[0] or names[0] == "Unnamed: 0":
            first = [fields[0].strip() for _, fields in itertools.islice(self.rows(), _SAMPLE)]
            names[0] = ""
            if not any(first) and len(names) > 1:
                notes.append("the first column has no name and no field in the first lines; it is "
                             "left out")  # fmt: skip
            elif _counts(first):
                notes.append("the first column has no name and counts the rows; it is left out")
            elif first and not time_column_of(names[1:]) and all(map(_is_time, first)):
                names[0] = "time"
                notes.append("the first column has no name; it is taken for the time")
            else:
                self._refuse(names, "no name for column 0")
        if not names[-1] and len(names) > 1:
            if any(f.strip() for _, fields in self.first_rows() for f in fields[len(names) - 1 :]):
                self._refuse(names, f"no name for column {len(names) - 1}")
            notes.append(
                "the last column has no name and no field in the first lines; it is left out"
            )
        met: set[str] = set()
        for i, name in enumerate(names):
            if not name and 0 < i < len(names) - 1:
                self._refuse(names, f"no name for column {i}")
            if name in met and name:
                self._refuse(names, f"the column name {name!r} twice")
            met.add(name)
        return names, notes

    def _refuse(self, names: list[str], problem: str) -> None:
        raise FileFormatError(
            f"{self.path} has {problem} in its header, got {listed(names, quoted=True)}; "
            "give every column a name of its own"
        )

    def first_rows(self) -> Iterator[tuple[int, list[str]]]:
        """Line numbers and fields of the first rows."""
        return itertools.islice(self.rows(), _SAMPLE)

    def sample(self, header: list[str]) -> CsvSample:
        """The fields of the first lines."""
        whole = [fields for _, fields in self.first_rows() if len(fields) == len(header)]
        columns = zip(*whole, strict=True) if whole else [()] * len(header)
        fields = {
            n: [without_unit(f.strip(), self.units.get(n, "")) for f in c]
            for n, c in zip(header, columns, strict=True)
        }
        return CsvSample(fields, self)

    def decimal_of(self, sample: CsvSample) -> tuple[str, list[str]]:
        """The decimal separator of the first lines, and a note where it is the comma.

        It is empty where they have neither points nor commas, and it is taken for the point.
        """
        if self.layout.delimiter == ",":
            return ".", []
        fields = [f for column in sample.fields.values() for f in column]
        commas = any(_COMMA.fullmatch(f) or GROUPED_BY_POINTS.fullmatch(f) for f in fields)
        points = any("." in f and number_in(f, ".") is not None for f in fields)
        if not commas or points:
            return ("." if commas or points else ""), []
        plain = [f for f in fields if _COMMA.fullmatch(f)]
        if plain and all(_GROUPED.fullmatch(f) for f in plain):
            first = next(f for f in fields if _COMMA.fullmatch(f))
            raise InputError(
                f"{self.path} has numbers such as {first!r}, whose comma may be a decimal point or "
                "separate thousands; say which with decimal=',' or decimal='.'"
            )
        return ",", ["commas in numbers are taken for decimal points (decimal='.' says otherwise)"]

    def number(self, text: str) -> float | None:
        """The number in a field, or None."""
        return number_in(text, self.decimal or ".")

    def rows(self) -> Iterator[tuple[int, list[str]]]:
        """Line numbers and fields of the rows, without comments."""
        for line, fields in self.text.rows(self.layout.delimiter):
            odd = len(fields) != len(self.layout.names)
            if self.repeated and [f.strip("\ufeff ") for f in fields] in self._fields_of_header:
                continue
            if line < self.layout.first or (odd and is_comment(fields[0])):
                continue
            if any(map(str.strip, fields)):
                yield line, fields

    def row(self, row: int) -> tuple[int, list[str]]:
        """The line in which a row of data ends, and its fields."""
        width = len(self.layout.names)
        whole = (found for found in self.rows() if len(found[1]) == width)
        return next(found for i, found in enumerate(whole) if i == row)

    def ends_a_line(self) -> bool:
        """Whether the last line has an end."""
        last = deque(self.text.lines(), maxlen=1)
        return bool(last) and last[0].endswith(("\n", "\r"))

    @property
    def _fields_of_header(self) -> list[list[str]]:
        return [[f.strip() for f in line.split(self.layout.delimiter)] for line in self.repeated]

    def wrong_count(self, line: int, count: int, header: list[str]) -> FileFormatError:
        """The error for a row with another number of fields."""
        return FileFormatError(
            f"{self.path} has {count} fields in line {line}, expected {len(header)}, "
            f"one per column: {listed(header, quoted=True)}"
        )

    def bad_field(
        self, header: list[str], columns: Columns, row: int, channel: int, sample: CsvSample
    ) -> FileFormatError:
        """The error for a field of a channel that is no number."""
        name = columns.channels[channel]
        line, fields = self.row(row)
        got = fields[header.index(name)]
        comma = _COMMA.fullmatch(got.strip()) and self.decimal != ","
        known = [f for f in sample.fields[name] if f and f not in self.missing]
        if known and all(f in BOOLEANS for f in known):
            expected = f"one of {', '.join(BOOLEANS)}"
        elif name in self.units:
            expected = f"a number and {self.units[name]}, as in the rows before"
        elif comma:
            expected = "a number; if its comma is a decimal point, say so with decimal=','"
        else:
            expected = (
                "a number; if it means a missing value, name it with missing=, or leave the column "
                "out with without="
            )
        return FileFormatError(
            f"{self.path} has {got[:60]!r} in line {line}, column {name!r}, expected {expected}"
        )

    def empty(self, error: NullValueError, columns: Columns) -> FileFormatError:
        """The error for a row without a time or a label."""
        line, _ = self.row(error.row)
        if error.column in (columns.time, columns.rest):
            return FileFormatError(
                f"{self.path} has no time in line {line}, column {error.column!r}; drop that row"
            )
        what = "trajectory" if error.column == columns.label else "channel"
        return FileFormatError(
            f"{self.path} has an empty field in line {line}, column {error.column!r}; every row "
            f"must say which {what} it belongs to"
        )

    def explain(self, header: list[str], columns: Columns, sample: CsvSample) -> None:
        """Raises an error that names the invalid line and column of times, if found."""
        first = next((f for f in sample.fields.get(columns.time, []) if f not in self.missing), "")
        form = form_in(sample.texts(columns.time), self.day_first) if columns.time else None
        for line, fields in self.rows():
            if len(fields) != len(header):
                raise self.wrong_count(line, len(fields), header)
            for name, got in zip(header, fields, strict=True):
                text = without_unit(got.strip(), self.units.get(name, ""))
                if not name or name not in (columns.time, columns.rest):
                    continue
                if not text or text in self.missing:
                    raise FileFormatError(
                        f"{self.path} has no time in line {line}, column {name!r}; drop that row"
                    )
                number = self.number(text)
                if form is None and number is None and _COMMA.fullmatch(text):
                    expected = "a number; if its comma is a decimal point, say so with decimal=','"
                elif columns.rest is not None:
                    fits = form_of(text) is not None if form else number is not None
                    expected = "" if fits else "a part of a time, as in the rows before"
                else:
                    fits = number is not None if form is None else fits_form(text, form)
                    expected = "" if fits else expected_after(first)
                if expected:
                    raise FileFormatError(
                        f"{self.path} has {got[:60]!r} in line {line}, column {name!r}, expected "
                        f"{expected}"
                    )


def _is_time(text: str) -> bool:
    return form_of(text) is not None or number_in(text, ".") is not None


def _counts(fields: list[str]) -> bool:
    """Whether fields count rows, from any number on."""
    first = int(fields[0]) if fields and fields[0].isdecimal() else 0
    return fields == [str(first + i) for i in range(len(fields))]
