"""CSV, read as a data set: a header, then one row per time, or one per measured value."""

from __future__ import annotations

import csv
import itertools
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from offbeat.data.cleaning.clocks import NANOSECONDS_PER, state_time_unit
from offbeat.data.memory import require_rows
from offbeat.data.readers.batches import NullValueError, gather, line_error
from offbeat.data.readers.columns import Columns, Gathered, listed, recordings
from offbeat.data.readers.stamps import expected_after, form_of, with_stamps
from offbeat.data.recording import Recording
from offbeat.data.source import require_file
from offbeat.errors import FileFormatError, InputError, one_of

MISSING = ("", "NaN", "nan", "NA", "N/A", "n/a", "#N/A", "<NA>", "null", "NULL", "None")
"""Fields whose value is not known."""

DELIMITERS = (",", ";", "\t")
"""Tried in this order on the header, where none is given."""

_BLANK = tuple(" " * n for n in range(1, 33))  # fields of padding only
_BOOLEANS = ("true", "false", "True", "False", "TRUE", "FALSE")
_COMMA = re.compile(r"[+-]?\d+,\d+")
_SAMPLE = 1000  # lines from which the type of a column is derived
_BLOCK = 1 << 20  # bytes of text in memory at a time


def read_csv(
    path: str | Path,
    *,
    time_column: str | None = None,
    trajectory_column: str | None = None,
    channels: Sequence[str] | None = None,
    time_unit: str | None = None,
    units: Mapping[str, str] | None = None,
    delimiter: str | None = None,
    channel_column: str | None = None,
    value_column: str | None = None,
    decimal: str = ".",
) -> list[Recording]:
    """Reads recordings from CSV: a header, then one row per time, or one per measured value.

    A first column without a name that counts the rows, as pandas writes it, is left out. A unit in
    brackets after a name, as in `speed [m/s]`, is the channel's unit and no part of its name.
    Times keep every digit down to the nanosecond, as numbers and as texts of ISO 8601, whose clock
    counts nanoseconds since 1970 (in UTC if they have an offset). The file is read a mebibyte
    at a time.

    Args:
        path: the file, in UTF-8.
        time_column: the column of times; by default found by its name, see `TIME_NAMES`.
        trajectory_column: the column with the trajectory of each row, as a number or
            any text; by default found by its name, see `LABEL_NAMES`. Without one, the file is one
            trajectory.
        channels: the columns to read as channels (in the long form: their names in the column of
            channels), in this order; by default all.
        time_unit: `s`, `ms`, `us`, `100ns` or `ns`; by default from the column's name, else
            detected from the numbers, which is noted, else `s`. Times of ISO 8601 need none.
        units: unit of a channel by its name.
        delimiter: the character between two fields; by default a comma, or the semicolon or tab
            that the header has instead.
        channel_column: the column with the channel of each value, in the long form; by
            default used if the table has only a time, a `channel` and a `value`.
        value_column: the column of values, in the long form.
        decimal: the decimal separator of numbers, `.` or `,`.

    Returns:
        A recording per trajectory, in the order of their first rows; a field that is empty, or
        another of `MISSING`, is NaN.

    Raises:
        FileFormatError: the file is missing or empty, its header or a row is invalid, or
            a field is not a number.
        InputError: an option names an unknown column or unit.
    """
    if delimiter is not None and (
        len(delimiter) != 1 or not delimiter.isascii() or delimiter in '"\r\n'
    ):
        raise InputError(
            f"delimiter must be one ASCII character, no quote or line end, got {delimiter!r}"
        )
    one_of("decimal", decimal, (".", ","))
    file = _CsvFile(require_file(path), delimiter or ",", decimal)
    if delimiter is None:
        file = file.with_delimiter_of_header()
    header = file.header()
    sample = file.sample(header)
    columns = Columns.of(
        file.path,
        [name for name in header if name],
        time_column=time_column,
        trajectory_column=trajectory_column,
        channels=channels,
        units=units,
        channel_column=channel_column,
        value_column=value_column,
    )
    unit = "ns"
    notes: tuple[str, ...] = ()
    if form_of(_first_time(sample, columns)) is None:
        found = [file.number(field) for field in sample[columns.time]]
        numbers = [number for number in found if number is not None]
        unit, notes = state_time_unit(time_unit, columns.time, numbers, str(file.path))
    if not header[0]:
        notes = (*notes, "the first column has no name and counts the rows; it is left out")
    if not header[-1]:
        notes = (
            *notes,
            "the last column has no name and no field in the first lines; it is left out",
        )
    table, counted_in = file.columns(header, sample, columns, unit)
    return recordings(file.path, columns, counted_in, notes, table, shown=unit)


@dataclass(frozen=True)
class _CsvFile:
    """A CSV file, read by pyarrow, and line by line to locate errors."""

    path: Path
    delimiter: str
    decimal: str

    def with_delimiter_of_header(self) -> _CsvFile:
        """The same file, with the delimiter of its header."""
        _, fields = next(self._lines(), (0, [""]))
        if len(fields) == 1:
            for delimiter in DELIMITERS[1:]:
                if delimiter in fields[0]:
                    return replace(self, delimiter=delimiter)
        return self

    def header(self) -> list[str]:
        """The column names, stripped; unique; empty where one counts rows or ends all lines."""
        line, fields = next(self._lines(), (0, []))
        names = [field.strip() for field in fields]
        if line != 1:
            got = f"a header that ends in line {line}" if line else "empty lines alone"
            raise FileFormatError(
                f"{self.path} must name its columns in line 1, got {got}; correct its first line"
            )
        names[0] = names[0].removeprefix("#").strip()
        if names[0] == "Unnamed: 0":
            names[0] = ""
        for i, name in enumerate(names):
            unnamed = (i == 0 and self._counts_rows()) or (
                i == len(names) - 1 and self._is_empty(i)
            )
            if (name in names[:i] and name) or not (name or unnamed):
                problem = f"the column name {name!r} twice" if name else f"no name for column {i}"
                raise FileFormatError(
                    f"{self.path} has {problem} in its first line, got {listed(names)}; "
                    "give every column a name of its own"
                )
        return names

    def _counts_rows(self) -> bool:
        fields = [line[0] for _, line in itertools.islice(self._lines(), 1, _SAMPLE)]
        first = int(fields[0]) if fields and fields[0].isdecimal() else 0
        return fields == [str(first + i) for i in range(len(fields))]

    def _is_empty(self, place: int) -> bool:
        """Whether a column is empty in the first lines."""
        lines = itertools.islice(self._lines(), 1, _SAMPLE)
        return not any(field.strip() for _, fields in lines for field in fields[place:])

    def sample(self, header: list[str]) -> dict[str, list[str]]:
        """The fields of the first lines, by column."""
        lines = [fields for _, fields in itertools.islice(self._lines(), 1, _SAMPLE)]
        whole = [fields for fields in lines if len(fields) == len(header)]
        return {name: [fields[i].strip() for fields in whole] for i, name in enumerate(header)}

    def columns(
        self, header: list[str], sample: dict[str, list[str]], columns: Columns, unit: str
    ) -> tuple[Gathered, str]:
        """The needed columns, and the unit of the clock."""
        import pyarrow as pa

        types = {name: _type_of(sample[name]) for name in columns.channels}
        types |= {name: pa.string() for name in (columns.label, columns.key) if name}
        places = len(str(NANOSECONDS_PER[unit])) - 1
        clocks = [pa.int64(), pa.decimal128(38, places), pa.float64()]
        if not all(
            field.isascii() and field.lstrip("+-").isdecimal() for field in sample[columns.time]
        ):
            clocks = clocks[1:]
        form = form_of(_first_time(sample, columns))
        if form is not None:
            clocks = [pa.string()]
        lines = self._count_lines()
        if lines < 2:
            raise FileFormatError(f"{self.path} has a header and no rows, expected one per time")
        require_rows(self.path, lines - 1, len(columns.channels))
        for clock in clocks:
            batches = self._batches(header, columns, types | {columns.time: clock})
            if form is not None:
                batches = with_stamps(batches, columns.time, form, MISSING)
            try:
                table = gather(batches, columns, lines)
            except (pa.ArrowException, OverflowError) as error:
                at = f"In CSV column #{header.index(columns.time)}:"
                if clock is clocks[-1] or (at not in str(error) and clock is not clocks[0]):
                    self._explain(header, columns, sample)
                    raise line_error(self.path, error) from None
                continue
            except NullValueError as error:
                raise self._empty(error, columns) from None
            if not len(table.clock):
                raise FileFormatError(
                    f"{self.path} has a header and no rows, expected one per time"
                )
            return table, "ns" if pa.types.is_decimal(clock) else unit
        raise AssertionError("the last clock raises or returns")

    def _batches(self, header: list[str], columns: Columns, types: dict[str, Any]) -> Iterator[Any]:
        import pyarrow.csv as pv

        names = [name or "" for name in header]
        with pv.open_csv(
            self.path,
            read_options=pv.ReadOptions(column_names=names, skip_rows=1, block_size=_BLOCK),
            parse_options=pv.ParseOptions(delimiter=self.delimiter, newlines_in_values=True),
            convert_options=pv.ConvertOptions(
                column_types=types,
                include_columns=columns.read,
                null_values=(*MISSING, *_BLANK),
                decimal_point=self.decimal,
            ),
        ) as reader:
            yield from reader

    def _count_lines(self) -> int:
        """Number of lines including the header, an upper bound of the number of rows."""
        ends = returns = 0
        last = b""
        with self.path.open("rb") as file:
            while block := file.read(_BLOCK):
                ends += block.count(b"\n")
                returns += block.count(b"\r") if not ends else 0
                last = block[-1:]
        return max(ends, returns) + (last not in b"\r\n")

    def line_of(self, row: int) -> int:
        """The line in which a row of data ends; the header is line 1."""
        return next(line for i, (line, _) in enumerate(self._lines()) if i == row + 1)

    def _empty(self, error: NullValueError, columns: Columns) -> FileFormatError:
        line = self.line_of(error.row)
        if error.column == columns.time:
            return FileFormatError(
                f"{self.path} has no time in line {line}, column {error.column!r}; drop that row"
            )
        what = "trajectory" if error.column == columns.label else "channel"
        return FileFormatError(
            f"{self.path} has an empty field in line {line}, column {error.column!r}; every row "
            f"must say which {what} it belongs to"
        )

    def _explain(self, header: list[str], columns: Columns, sample: dict[str, list[str]]) -> None:
        """Raises an error that names the invalid line and column, if found."""
        first = _first_time(sample, columns)
        form = form_of(first)
        truths = [name for name in columns.channels if _holds_booleans(sample[name])]
        for line, fields in self._lines():
            if len(fields) != len(header):
                raise FileFormatError(
                    f"{self.path} has {len(fields)} fields in line {line}, expected {len(header)}, "
                    f"one per column: {listed(header)}"
                )
            for name, field in zip(header, fields, strict=True):
                if line == 1 or name not in columns.read or field in MISSING or not field.strip():
                    continue
                number = self.number(field)
                comma = number is None and self.decimal == "." and _COMMA.fullmatch(field.strip())
                if name in (columns.time, *columns.channels) and comma:
                    expected = "a number; if its comma is a decimal point, say so with decimal=','"
                elif name == columns.time:
                    fits = number is not None if form is None else form_of(field.strip()) == form
                    expected = "" if fits else expected_after(first)
                elif name in truths:
                    expected = "" if field in _BOOLEANS else f"one of {', '.join(_BOOLEANS)}"
                elif name in columns.channels and number is None:
                    expected = "a number; choose the columns that are channels with channels="
                else:
                    continue
                if expected:
                    raise FileFormatError(
                        f"{self.path} has {field!r} in line {line}, column {name!r}, expected "
                        f"{expected}"
                    )

    def number(self, field: str) -> float | None:
        """The number in a field, or None."""
        if self.decimal != ".":
            field = field.replace(".", "?").replace(self.decimal, ".")
        try:
            number = float(field)
        except ValueError:
            return None
        # Python allows _ between digits, and digits of other scripts; CSV does not.
        return number if field.isascii() and "_" not in field else None

    def _lines(self) -> Iterator[tuple[int, list[str]]]:
        """Line numbers and fields, header included; empty lines are skipped, as pyarrow does."""
        try:
            with self.path.open(encoding="utf-8-sig", newline="") as file:
                reader = csv.reader(file, delimiter=self.delimiter)
                for fields in reader:
                    if fields:
                        yield reader.line_num, fields
        except (UnicodeDecodeError, csv.Error) as error:
            raise FileFormatError(
                f"{self.path} can't be read as CSV ({error}); it must be text in UTF-8"
            ) from None


def _first_time(sample: dict[str, list[str]], columns: Columns) -> str:
    """The first non-empty field of the clock, or an empty one."""
    return next((field for field in sample[columns.time] if field not in MISSING), "")


def _type_of(fields: list[str]) -> Any:
    """The Arrow type of a channel by its first fields: booleans by name, else numbers."""
    import pyarrow as pa

    return pa.bool_() if _holds_booleans(fields) else pa.float64()


def _holds_booleans(fields: list[str]) -> bool:
    known = [field for field in fields if field not in MISSING]
    return bool(known) and all(field in _BOOLEANS for field in known)
