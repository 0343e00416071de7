"""A CSV file: its columns as numbers, by pyarrow."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass, field, replace
from typing import Any

from numpy.typing import NDArray

from offbeat.data.cleaning.clocks import NANOSECONDS_PER, split_unit
from offbeat.data.memory import require_rows
from offbeat.data.readers.batches import NullValueError, gather, line_error, with_joined
from offbeat.data.readers.columns import Columns
from offbeat.data.readers.csv_fields import (
    Converter,
    unit_of_fields,
)
from offbeat.data.readers.csv_layout import is_comment
from offbeat.data.readers.csv_lines import CsvLines, CsvSample
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
    over_midnight,
    with_stamps,
)
from offbeat.data.readers.text import DAMAGE, no_text
from offbeat.errors import NoLogError, listed

_BLOCK = 1 << 20  # bytes of text in memory at a time
_TAIL = 1 << 12  # last bytes, from which a cut is found


@dataclass(frozen=True)
class CsvFile(CsvLines):
    """A CSV file, read by pyarrow, and line by line to locate errors.

    Attributes:
        notes: on what was found while it was read.
        odd: rows with another number of fields.
        tail: the last bytes.
    """

    notes: list[str] = field(default_factory=list)
    odd: list[str] = field(default_factory=list)
    tail: list[bytes] = field(default_factory=lambda: [b""])

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
                    self.explain(header, columns, sample)
                    raise line_error(self.path, error) from None
                attempts = again
                continue
            except DAMAGE as error:
                raise no_text(self.path, error) from None
            except NullValueError as error:
                raise self.empty(error, columns) from None
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
        for number, fields in self.rows():
            last = number
            if len(fields) != len(header):
                line, count = number, len(fields)
        if line == last and count < len(header) and not self.ends_a_line():
            self.notes.append(f"the file ends in the middle of line {line}; it is read up to there")
            return
        raise self.wrong_count(line, count, header)

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
            self.explain(header, columns, sample)
            raise self.bad_field(header, columns, converter.bad[texts[0]].row, texts[0], sample)
        for c, bad in converter.bad.items():
            if c in texts:
                continue
            last = len(table.clock) - 1
            if bad.count == 1 and bad.row == last and not self.ends_a_line():
                self.notes.append(
                    "the file ends in the middle of a number; its last row is left out"
                )
                return columns, _without_last(table)
            raise self.bad_field(header, columns, bad.row, c, sample)
        if not texts:
            return columns, table
        kept = [c for c in range(len(columns.channels)) if c not in texts]
        gone = [columns.channels[c] for c in texts]
        values = table.values[:, kept]
        return (
            columns.only(kept, [f"columns of text are left out: {listed(gone, 6, quoted=True)}"]),
            Gathered(table.clock, table.labels, table.keys, values),
        )

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


def _replaced(table: Gathered, clock: NDArray[Any]) -> Gathered:
    return Gathered(clock, table.labels, table.keys, table.values)


def _without_last(table: Gathered) -> Gathered:
    labels, keys = (
        None if coded is None else Coded(coded.codes[:-1], coded.texts)
        for coded in (table.labels, table.keys)
    )
    return Gathered(table.clock[:-1], labels, keys, table.values[:-1])
