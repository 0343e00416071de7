"""A CSV file: its columns as numbers, by pyarrow, and line by line to locate errors."""

from __future__ import annotations

import itertools
import re
from collections import deque
from collections.abc import Iterator, Mapping
from contextlib import closing
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from offbeat.data.cleaning.clocks import NANOSECONDS_PER, split_unit, time_column_of
from offbeat.data.memory import require_rows
from offbeat.data.readers.batches import NullValueError, gather, line_error, with_joined
from offbeat.data.readers.columns import Columns
from offbeat.data.readers.csv_fields import (
    BOOLEANS,
    GROUPED_BY_POINTS,
    SWITCHES,
    Converter,
    number_in,
    unit_of_fields,
    without_unit,
)
from offbeat.data.readers.csv_layout import CsvLayout, is_comment
from offbeat.data.readers.csv_streams import (
    Spaced,
    Without,
    with_count,
    with_dates,
    without_empty,
    without_units,
)
from offbeat.data.readers.gathered import Coded, Gathered
from offbeat.data.readers.stamps import (
    expected_after,
    fits_form,
    form_in,
    form_of,
    over_midnight,
    with_stamps,
)
from offbeat.data.readers.text import DAMAGE, TextFile, no_text
from offbeat.errors import FileFormatError, InputError, NoLogError, listed

_COMMA = re.compile(r"[+-]?\d+,\d+")
_GROUPED = re.compile(r"[+-]?[1-9]\d{0,2},\d{3}")
_SAMPLE = 1000  # lines from which the meaning of a column is derived
_BLOCK = 1 << 20  # bytes of text in memory at a time
_TAIL = 1 << 12  # last bytes, from which a cut is found


@dataclass(frozen=True)
class CsvSample:
    """The fields of the first lines, by column.

    Attributes:
        fields: stripped, by column.
        file: that they are from.
    """

    fields: Mapping[str, list[str]]
    file: CsvFile

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
        return form_in(self.texts(name), self.file.day_first)


@dataclass(frozen=True)
class CsvFile:
    """A CSV file, read by pyarrow, and line by line to locate errors.

    Attributes:
        text: the file.
        layout: where its table is.
        decimal: the decimal separator; None where it is not known yet.
        missing: fields whose value is not known.
        thousands: whether a comma may separate thousands where the point is the decimal separator.
        notes: on what was found while it was read.
        odd: rows with another number of fields.
        tail: the last bytes.
        repeated: lines of a header, and of units below it, that stand in the middle, too.
        day_first: of dates such as 07/08/2026, whether the day is before the month, or None.
        units: of columns whose fields have one after each number.
    """

    text: TextFile
    layout: CsvLayout
    decimal: str | None
    missing: tuple[str, ...]
    thousands: bool = True
    notes: list[str] = field(default_factory=list)
    odd: list[str] = field(default_factory=list)
    tail: list[bytes] = field(default_factory=lambda: [b""])
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
            first = [fields[0].strip() for _, fields in itertools.islice(self._rows(), _SAMPLE)]
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
            if any(f.strip() for _, fields in self._first() for f in fields[len(names) - 1 :]):
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

    def _first(self) -> Iterator[tuple[int, list[str]]]:
        return itertools.islice(self._rows(), _SAMPLE)

    def sample(self, header: list[str]) -> CsvSample:
        """The fields of the first lines."""
        whole = [fields for _, fields in self._first() if len(fields) == len(header)]
        columns = zip(*whole, strict=True) if whole else [()] * len(header)
        fields = {
            n: [without_unit(f.strip(), self.units.get(n, "")) for f in c]
            for n, c in zip(header, columns, strict=True)
        }
        return CsvSample(fields, self)

    def with_units(self, header: list[str]) -> tuple[CsvFile, list[str]]:
        """The file with the units in its fields, and the header with them in brackets."""
        sample = self.sample(header)
        found: dict[str, str] = {}
        names = list(header)
        for i, name in enumerate(header):
            known = [f for f in sample.fields[name] if f not in self.missing]
            unit = unit_of_fields(known) if name and known and sample.is_text(name) else ""
            if unit:
                names[i] = name if split_unit(name)[1] else f"{name} [{unit}]"
                found[names[i]] = unit
        if found:
            self.notes.append(f"numbers have a unit in each field: {listed([*found], quoted=True)}")
        return replace(self, units=found), names

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

    def columns(
        self,
        header: list[str],
        sample: CsvSample,
        columns: Columns,
        unit: str,
        rate_hz: float | None,
    ) -> tuple[Columns, Gathered, str]:
        """The columns with numbers, their values, and the unit of the clock."""
        import pyarrow as pa

        lines = self._count_lines()
        if not lines:
            raise NoLogError(f"{self.path} has a header and no rows, expected one per time")
        require_rows(self.path, lines, len(columns.channels))
        clocks = self._clock_types(sample, columns, unit)
        form = sample.form_of(columns.time) if columns.time and columns.rest is None else None
        numbers = all(
            self.number(f) is not None or f in self.missing
            for name in columns.channels
            for f in sample.fields[name][:20]
        )
        attempts = [(clock, numbers_only) for numbers_only in (True, False) for clock in clocks]
        if not numbers:
            attempts = attempts[len(clocks) :]
        while attempts:
            clock, numbers_only = attempts.pop(0)
            texts = [name for name in (columns.label, columns.key) if name]
            types = dict.fromkeys(texts, pa.string())
            types |= dict.fromkeys(columns.channels, pa.float64() if numbers_only else pa.string())
            if columns.rest_unit == "date":
                types |= {columns.time: pa.string(), columns.rest: pa.string()}
            elif columns.rest is not None:
                types |= {columns.time: pa.float64(), columns.rest: pa.float64()}
            elif columns.time:
                types[columns.time] = clock
            converter = Converter(columns, self.missing, self.decimal or ".", self.thousands)
            try:
                batches = self._batches(header, columns, types)
                if form is not None:
                    batches = with_stamps(batches, columns.time, form, self.missing)
                elif columns.rest_unit == "date":
                    batches = with_dates(
                        batches, columns, sample.form_of(columns.time) or "without"
                    )
                elif columns.rest is not None:
                    batches = with_joined(batches, columns)
                elif not columns.time:
                    batches = with_count(batches, rate_hz or 1.0)
                if not numbers_only:
                    batches = converter.converted(batches)
                table = gather(batches, columns, lines)
            except (pa.ArrowException, OverflowError) as error:
                again = self._next(str(error), header, columns, clock, attempts, numbers_only)
                if not again and not self.repeated and (repeated := self._header_again()):
                    file = replace(self, repeated=repeated)
                    file.notes.append(
                        "the header stands again in the middle, as in logs that are joined; those "
                        "lines are left out"
                    )
                    return file.columns(header, sample, columns, unit, rate_hz)
                if not again:
                    self._explain(header, columns, sample)
                    raise line_error(self.path, error) from None
                attempts = again
                continue
            except DAMAGE as error:
                raise no_text(self.path, error) from None
            except NullValueError as error:
                raise self._empty(error, columns) from None
            self._check_odd(header, columns)
            self._note_short_end(header, sample)
            if not len(table.clock):
                raise NoLogError(f"{self.path} has a header and no rows, expected one per time")
            columns, table = self._usable(header, sample, columns, table, converter)
            if form is not None:
                table = _replaced(table, over_midnight(table.clock, form))
            return columns, table, "ns" if pa.types.is_decimal(clock) else unit
        raise AssertionError("the last attempt raises or returns")

    def _clock_types(self, sample: CsvSample, columns: Columns, unit: str) -> list[Any]:
        """Arrow types to read the clock as, the most exact one first."""
        import pyarrow as pa

        if columns.rest or not columns.time:
            return [pa.int64()]
        if sample.form_of(columns.time) is not None:
            return [pa.string()]
        fields = sample.fields[columns.time]
        per_tick = NANOSECONDS_PER[unit]
        places = len(str(per_tick)) - 1
        clocks = [pa.int64(), pa.decimal128(38, places), pa.float64()]
        if per_tick != 10**places:  # minutes, hours and days are no powers of ten
            del clocks[1]
        if not all(field.isascii() and field.lstrip("+-").isdecimal() for field in fields):
            del clocks[0]
        return clocks

    def _next(
        self,
        error: str,
        header: list[str],
        columns: Columns,
        clock: Any,
        attempts: list[tuple[Any, bool]],
        numbers_only: bool,
    ) -> list[tuple[Any, bool]]:
        """The attempts that are left after an error: with the next clock, or with texts."""
        of_clock = bool(columns.time) and f"In CSV column #{header.index(columns.time)}:" in error
        if "In CSV column #" not in error and "decimal" not in error and "overflow" not in error:
            of_clock = of_clock or not numbers_only
        if of_clock or not numbers_only:
            left = [a for a in attempts if a[1] == numbers_only and a[0] != clock]
            tail = [a for a in attempts if a[1] != numbers_only and a[0] != clock]
            return [*left, *tail] if left else []
        return [(clock, False), *(a for a in attempts if not a[1] and a[0] != clock)]

    def _batches(self, header: list[str], columns: Columns, types: dict[str, Any]) -> Iterator[Any]:
        import pyarrow as pa
        import pyarrow.csv as pv

        self.odd.clear()
        read_as = types | {name: pa.string() for name in self.units if name in types}
        nothing = [*self.missing, *(" " * n for n in range(1, 33))]
        delimiter = self.layout.delimiter
        with (
            closing(self._stream()) as stream,
            pv.open_csv(
                stream,
                read_options=pv.ReadOptions(
                    column_names=[name or "" for name in header], block_size=_BLOCK
                ),
                parse_options=pv.ParseOptions(
                    delimiter=delimiter,
                    newlines_in_values=delimiter != " ",
                    # Without times, a row counts, also one without a value.
                    ignore_empty_lines=bool(columns.time) or len(header) > 1,
                    quote_char=False if delimiter == " " else '"',
                    invalid_row_handler=self._on_odd_row,
                ),
                convert_options=pv.ConvertOptions(
                    column_types=read_as,
                    include_columns=columns.read,
                    null_values=nothing,
                    strings_can_be_null=False,
                    decimal_point=self.decimal or ".",
                ),
            ) as reader,
        ):
            for batch in reader:
                kept = without_empty(batch) if columns.time else batch
                yield without_units(kept, self.units, types, nothing, self.decimal or ".")

    def _stream(self) -> Any:
        file = self.text.bytes_from(self.layout.first)
        if self.repeated:
            return Without(file, [line.encode() for line in self.repeated])
        return file if self.layout.delimiter != " " else Spaced(file)

    def _header_again(self) -> tuple[str, ...]:
        """The lines of the header, if they stand in the file again; else none."""
        if not self.layout.line or self.layout.delimiter == " ":
            return ()
        lines = (line.strip().removeprefix("\ufeff") for line in self.text.lines())
        head = tuple(itertools.islice(lines, self.layout.line - 1, self.layout.first - 1))
        return tuple(line for line in head if line) if head and head[0] in lines else ()

    def _on_odd_row(self, row: Any) -> str:
        """Skips comments and, provisionally, one row with another number of fields."""
        if is_comment(row.text) or not row.text.strip():
            return "skip"
        self.odd.append(row.text)
        return "skip" if len(self.odd) == 1 else "error"

    def _check_odd(self, header: list[str], columns: Columns) -> None:
        """Notes a row that the end of the file cuts off; another odd row is an error."""
        if not self.odd:
            return
        last = line = 0
        count = len(header)
        for number, fields in self._rows():
            last = number
            if len(fields) != len(header):
                line, count = number, len(fields)
        if line == last and count < len(header) and not self._ends_a_line():
            self.notes.append(f"the file ends in the middle of line {line}; it is read up to there")
            return
        raise self._wrong_count(line, count, header)

    def _wrong_count(self, line: int, count: int, header: list[str]) -> FileFormatError:
        return FileFormatError(
            f"{self.path} has {count} fields in line {line}, expected {len(header)}, "
            f"one per column: {listed(header, quoted=True)}"
        )

    def _ends_a_line(self) -> bool:
        last = deque(self.text.lines(), maxlen=1)
        return bool(last) and last[0].endswith(("\n", "\r"))

    def _usable(
        self,
        header: list[str],
        sample: CsvSample,
        columns: Columns,
        table: Gathered,
        converter: Converter,
    ) -> tuple[Columns, Gathered]:
        """The table without columns that turned out to hold texts.

        Raises:
            FileFormatError: a field of a column of numbers is none.
        """
        texts = converter.texts()
        if len(texts) == len(columns.channels) and texts:
            self._explain(header, columns, sample)
            raise self._bad_field(header, columns, converter.bad[texts[0]].row, texts[0], sample)
        for c, bad in converter.bad.items():
            if c in texts:
                continue
            last = len(table.clock) - 1
            if bad.count == 1 and bad.row == last and not self._ends_a_line():
                self.notes.append(
                    "the file ends in the middle of a number; its last row is left out"
                )
                return columns, _without_last(table)
            raise self._bad_field(header, columns, bad.row, c, sample)
        if not texts:
            return columns, table
        kept = [c for c in range(len(columns.channels)) if c not in texts]
        gone = [columns.channels[c] for c in texts]
        values = table.values[:, kept]
        return (
            columns.only(kept, [f"columns of text are left out: {listed(gone, 6, quoted=True)}"]),
            Gathered(table.clock, table.labels, table.keys, values),
        )

    def _bad_field(
        self, header: list[str], columns: Columns, row: int, channel: int, sample: CsvSample
    ) -> FileFormatError:
        name = columns.channels[channel]
        line, fields = self._row(row)
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

    @property
    def _fields_of_header(self) -> list[list[str]]:
        return [[f.strip() for f in line.split(self.layout.delimiter)] for line in self.repeated]

    def _count_lines(self) -> int:
        """Number of lines from the first row on, an upper bound of the number of rows."""
        ends = returns = 0
        tail = b""
        try:
            with self.text.bytes_from(self.layout.first) as file:
                while block := file.read(_BLOCK):
                    ends += block.count(b"\n")
                    if b"\r" in block:
                        returns += block.count(b"\r") - block.count(b"\r\n")
                    tail = (tail + block)[-_TAIL:]
        except DAMAGE as error:
            raise no_text(self.path, error) from None
        self.tail[:] = [tail]
        return ends + returns + (tail[-1:] not in b"\r\n")

    def _note_short_end(self, header: list[str], sample: CsvSample) -> None:
        """Notes a last number that may be cut off: without a line end, and shorter than others."""
        line = self.tail[0].decode("utf-8", "replace").splitlines()[-1:]
        if not line or self.tail[0].endswith((b"\n", b"\r")):
            return
        fields = line[0].split() if self.layout.delimiter == " " else (
            line[0].split(self.layout.delimiter)
        )  # fmt: skip
        others = sorted(len(f) for f in sample.fields[header[-1]][:-1])
        short = len(fields) == len(header) and others
        if short and len(fields[-1].strip()) < others[len(others) // 10]:
            self.notes.append(
                f"the file ends without a line end after {fields[-1].strip()[:40]!r}, which may be "
                "cut off"
            )

    def _row(self, row: int) -> tuple[int, list[str]]:
        """The line in which a row of data ends, and its fields."""
        width = len(self.layout.names)
        whole = (found for found in self._rows() if len(found[1]) == width)
        return next(found for i, found in enumerate(whole) if i == row)

    def _empty(self, error: NullValueError, columns: Columns) -> FileFormatError:
        line, _ = self._row(error.row)
        if error.column in (columns.time, columns.rest):
            return FileFormatError(
                f"{self.path} has no time in line {line}, column {error.column!r}; drop that row"
            )
        what = "trajectory" if error.column == columns.label else "channel"
        return FileFormatError(
            f"{self.path} has an empty field in line {line}, column {error.column!r}; every row "
            f"must say which {what} it belongs to"
        )

    def _explain(self, header: list[str], columns: Columns, sample: CsvSample) -> None:
        """Raises an error that names the invalid line and column of times, if found."""
        first = next((f for f in sample.fields.get(columns.time, []) if f not in self.missing), "")
        form = form_in(sample.texts(columns.time), self.day_first) if columns.time else None
        for line, fields in self._rows():
            if len(fields) != len(header):
                raise self._wrong_count(line, len(fields), header)
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

    def number(self, text: str) -> float | None:
        """The number in a field, or None."""
        return number_in(text, self.decimal or ".")

    def _rows(self) -> Iterator[tuple[int, list[str]]]:
        """Line numbers and fields of the rows, without comments."""
        for line, fields in self.text.rows(self.layout.delimiter):
            odd = len(fields) != len(self.layout.names)
            if self.repeated and [f.strip("\ufeff ") for f in fields] in self._fields_of_header:
                continue
            if line < self.layout.first or (odd and is_comment(fields[0])):
                continue
            if any(map(str.strip, fields)):
                yield line, fields


def _is_time(text: str) -> bool:
    return form_of(text) is not None or number_in(text, ".") is not None


def _counts(fields: list[str]) -> bool:
    """Whether fields count rows, from any number on."""
    first = int(fields[0]) if fields and fields[0].isdecimal() else 0
    return fields == [str(first + i) for i in range(len(fields))]


def _replaced(table: Gathered, clock: NDArray[Any]) -> Gathered:
    return Gathered(clock, table.labels, table.keys, table.values)


def _without_last(table: Gathered) -> Gathered:
    labels, keys = (
        None if coded is None else Coded(coded.codes[:-1], coded.texts)
        for coded in (table.labels, table.keys)
    )
    return Gathered(table.clock[:-1], labels, keys, table.values[:-1])
