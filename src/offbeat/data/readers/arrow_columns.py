"""Columns of Arrow as a table: the part that Parquet, Feather and JSON lines share."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from offbeat.data.cleaning.clocks import NANOSECONDS_PER, state_time_unit, time_column_of
from offbeat.data.memory import require_rows
from offbeat.data.readers.batches import (
    NullValueError,
    clock_of_columns,
    gather_columns,
    is_list,
    is_text,
    line_error,
)
from offbeat.data.readers.columns import Columns, unit_written
from offbeat.data.readers.csv_fields import MISSING, number_in
from offbeat.data.readers.gathered import recordings
from offbeat.data.readers.stamp_columns import columns_in
from offbeat.data.readers.stamps import EXAMPLE, form_in
from offbeat.data.readers.table_options import TableOptions
from offbeat.data.recording import Recording
from offbeat.data.signals import MOST_CHANNELS
from offbeat.errors import FileFormatError, NoLogError

_INDEX = "__index_level_0__"  # name that pandas gives to an unnamed index
_SAMPLE = 1000  # rows from which the meaning of a column is derived

Chunks = Callable[[str], Iterator[Any]]
"""Returns the Arrow arrays of a column."""


class Source(Protocol):
    """A file of columns."""

    @property
    def path(self) -> Path:
        """Of the file."""

    @property
    def format(self) -> str:
        """Its name, for messages."""

    @property
    def schema(self) -> Any:
        """Arrow schema; fields of structs are columns, `pose.x`."""

    @property
    def rows(self) -> int:
        """Their number."""

    def chunks(self, name: str) -> Iterator[Any]:
        """The Arrow arrays of a column."""

    def readers(self, columns: int) -> list[Chunks]:
        """Functions as `chunks` that may be called at once, a thread each."""


@dataclass(frozen=True)
class TableSource:
    """A table of Arrow in memory, with its structs as columns."""

    path: Path
    format: str
    table: Any

    @property
    def schema(self) -> Any:
        """Of the table."""
        return self.table.schema

    @property
    def rows(self) -> int:
        """Of the table."""
        return int(self.table.num_rows)

    def chunks(self, name: str) -> Iterator[Any]:
        """The Arrow arrays of a column."""
        yield from self.table.column(name).chunks

    def readers(self, columns: int) -> list[Chunks]:
        """One: columns of a table are there already."""
        return [self.chunks]


def recordings_of(
    source: Source, options: TableOptions, time_unit: str | None = None
) -> list[Recording]:
    """Recordings from columns of Arrow.

    Args:
        source: the columns.
        options: what they mean.
        time_unit: of the times, or None.

    Raises:
        FileFormatError: there is no time, no channel of numbers, or a column is damaged.
        InputError: an option names an unknown column or unit.
    """
    import pyarrow as pa

    path, schema, chunks, channels = source.path, source.schema, source.chunks, options.channels
    try:
        if channels is None and len(schema.names) > MOST_CHANNELS:
            raise FileFormatError(
                f"{path} has {len(schema.names)} columns, more than {MOST_CHANNELS}; choose "
                "some with channels="
            )
        if channels is None:
            _check_names(path, schema, schema.names)
        index = _index_of_times(schema, chunks) if options.time_column is None else None
        if options.rate_hz is None and index is not None:
            options = replace(options, time_column=index)
        sample = ArrowSample(schema, chunks)
        columns = Columns.of(path, _names(schema, options.time_column), options, sample)
        _check_types(path, schema, columns)
        if not source.rows:
            raise NoLogError(f"{path} has columns and no rows, expected one per time")
        rows = source.rows
        widths = {
            name: _width(path, name, chunks(name))
            for name in columns.channels
            if is_list(schema.field(name).type)
        }
        notes: tuple[str, ...] = ()
        found = False
        kind = schema.field(columns.time).type if columns.time else None
        of_text = columns.time and is_text(kind) and sample.is_text(columns.time)
        form = _form(path, columns, sample, options.day_first) if of_text else None
        shown = ""
        of_clock: Callable[[str], Iterator[Any]] = chunks
        if not columns.time or columns.rest or of_text or _is_day(kind):
            unit = "ns"
        elif pa.types.is_timestamp(kind) or pa.types.is_duration(kind):
            unit = str(schema.field(columns.time).type.unit)
        else:
            numbers = sample.numbers(columns.time)
            time_unit = time_unit or unit_written(schema.names, columns.time)
            unit, notes, found = state_time_unit(time_unit, columns.time, numbers, str(path))
            if pa.types.is_decimal(kind) or is_text(kind):
                shown, unit, of_clock = unit, *_decimals(unit, chunks)
        if index is not None and columns.time == index:
            notes = (*notes, "the index of pandas is taken for the time")
        width = sum(widths.get(name, 1) for name in columns.channels)
        require_rows(path, rows, width)
        if columns.time:
            clock = clock_of_columns(of_clock, columns, form)
        else:
            clock = np.rint(np.arange(rows) * (1e9 / (options.rate_hz or 1.0))).astype(np.int64)
        table = gather_columns(source.readers(len(columns.read)), columns, clock, widths=widths)
    except NullValueError as error:
        raise FileFormatError(
            f"{path} has an empty value in row {error.row}, column {error.column!r}, where every "
            "row needs a value; drop that row"
        ) from None
    except (pa.ArrowException, OSError, UnicodeDecodeError) as error:
        raise damaged(path, source.format, error) from None
    return recordings(path, _spread(columns, widths), unit, notes, table, shown=shown, found=found)


def damaged(path: Path, format: str, error: Exception) -> FileFormatError:
    """The error for a file that Arrow cannot read."""
    what = str(line_error(path, error)).removeprefix(f"{path}: ")
    return FileFormatError(
        f"{path} can't be read as {format}, it is truncated, damaged or of another format "
        f"({what}); copy it again"
    )


@dataclass(frozen=True)
class ArrowSample:
    """The first values of the columns."""

    schema: Any
    chunks: Any
    first: dict[str, Any] = field(default_factory=dict)

    def is_text(self, name: str) -> bool:
        """Whether a column holds anything but numbers, booleans and lists of them."""
        import pyarrow as pa

        kind = self.schema.field(name).type
        kind = kind.value_type if is_list(kind) else kind
        if pa.types.is_dictionary(kind):
            kind = kind.value_type
        numbers = (
            pa.types.is_integer,
            pa.types.is_floating,
            pa.types.is_boolean,
            pa.types.is_decimal,
            pa.types.is_null,
        )
        if is_text(kind):
            known = [text for text in self.texts(name) if text.strip() not in MISSING]
            return not known or any(number_in(text, ".") is None for text in known)
        return not any(fits(kind) for fits in numbers)

    def numbers(self, name: str) -> NDArray[np.float64]:
        """The first numbers of a column, NaN where there is none; empty for others."""
        import pyarrow as pa

        if self.is_text(name) or is_list(self.schema.field(name).type):
            return np.zeros(0)
        if is_text(self.schema.field(name).type):
            found = [number_in(text, ".") for text in self.texts(name)]
            return np.array([np.nan if n is None else n for n in found], dtype=np.float64)
        numbers: NDArray[np.float64] = (
            self._first(name).cast(pa.float64(), safe=False).to_numpy(zero_copy_only=False)
        )
        return numbers

    def texts(self, name: str) -> list[str]:
        """The first values of a column, as texts."""
        import pyarrow as pa

        kind = self.schema.field(name).type
        if pa.types.is_nested(kind) or pa.types.is_binary(kind):
            return []
        return ["" if value is None else str(value) for value in self._first(name).to_pylist()]

    def _first(self, name: str) -> Any:
        if name not in self.first:
            chunk = next((c for c in self.chunks(name) if len(c)), None)
            if chunk is None:
                import pyarrow as pa

                chunk = pa.array([], self.schema.field(name).type)
            self.first[name] = chunk.slice(0, _SAMPLE)
        return self.first[name]


def _names(schema: Any, time_column: str | Sequence[str] | None) -> list[str]:
    """The columns, without the index of pandas unless it is the time."""
    wanted = columns_in(time_column, schema.names) if time_column is not None else ()
    return [name for name in schema.names if name != _INDEX or name in wanted]


def _index_of_times(schema: Any, chunks: Callable[[str], Iterator[Any]]) -> str | None:
    """The index of pandas, if no column is a time, and it holds times or numbers that increase."""
    import pyarrow as pa

    if _INDEX not in schema.names or time_column_of(list(schema.names)) is not None:
        return None
    kind = schema.field(_INDEX).type
    if pa.types.is_timestamp(kind) or pa.types.is_duration(kind):
        return _INDEX
    if not pa.types.is_floating(kind):
        return None
    first = next((c for c in chunks(_INDEX) if len(c)), pa.array([], kind))
    steps = np.diff(first.cast(pa.float64()).to_numpy(zero_copy_only=False))
    return _INDEX if len(steps) and bool((steps >= 0).all()) else None


def _decimals(
    unit: str, chunks: Callable[[str], Iterator[Any]]
) -> tuple[str, Callable[[str], Iterator[Any]]]:
    """The unit of times in decimals once they are converted, and the function that does it."""
    import pyarrow as pa

    places = len(str(NANOSECONDS_PER[unit])) - 1
    exact = NANOSECONDS_PER[unit] == 10**places  # those of minutes, hours and days are not
    kind = pa.decimal128(38, places) if exact else pa.float64()
    return "ns" if exact else unit, lambda name: (c.cast(kind) for c in chunks(name))


def _is_day(kind: Any) -> bool:
    import pyarrow as pa

    return bool(pa.types.is_date(kind) or pa.types.is_time(kind))


def _check_names(path: Path, schema: Any, names: Sequence[str]) -> None:
    if len(set(schema.names)) == len(schema.names):
        return
    for name in names:
        if len(schema.get_all_field_indices(name)) > 1:
            raise FileFormatError(
                f"{path} has the column {name!r} twice; give every column a name of its own, or "
                "choose others with channels="
            )


def _check_types(path: Path, schema: Any, columns: Columns) -> None:
    import pyarrow as pa

    _check_names(path, schema, columns.read)
    for label in (columns.label, columns.key):
        if label is not None and _is_no_label(schema.field(label).type):
            raise FileFormatError(
                f"{path} has {schema.field(label).type} in column {label!r}, expected labels: "
                "texts or numbers; name them with trajectory_column= and channel_column="
            )
    if not columns.time:
        return
    kind = schema.field(columns.time).type
    times = (pa.types.is_timestamp, pa.types.is_duration, pa.types.is_integer, pa.types.is_floating)
    if not any(fits(kind) for fits in (*times, pa.types.is_decimal, _is_day, is_text)):
        raise FileFormatError(
            f"{path} has {kind} in column {columns.time!r}, expected times: numbers, time stamps "
            "or durations; say which column is the time with time_column="
        )


def _form(path: Path, columns: Columns, sample: ArrowSample, day_first: bool | None) -> str:
    """The form of times as texts.

    Raises:
        FileFormatError: the first one is no time.
    """
    texts = sample.texts(columns.time)
    first = next((text for text in texts if text), "")
    form = form_in(map(str.strip, texts), day_first, where=str(path))
    if form is None:
        raise FileFormatError(
            f"{path} has {first[:60]!r} in column {columns.time!r}, expected times: numbers, time "
            f"stamps, durations or texts such as {EXAMPLE}; name the column with time_column="
        )
    return form


def _is_no_label(kind: Any) -> bool:
    import pyarrow as pa

    binary = (pa.types.is_binary, pa.types.is_large_binary, pa.types.is_fixed_size_binary)
    return pa.types.is_nested(kind) or any(fits(kind) for fits in binary)


def _width(path: Path, name: str, chunks: Iterator[Any]) -> int:
    """The length of the lists of a column, by the first chunk that has one."""
    import pyarrow.compute as pc

    for column in chunks:
        lengths = pc.unique(pc.list_value_length(column.drop_null())).to_pylist()
        if len(lengths) > 1:
            raise FileFormatError(
                f"{path} has lists of {len(lengths)} lengths in column {name!r}, expected one "
                "length; choose the columns that are channels with channels="
            )
        if lengths and lengths[0]:
            return int(lengths[0])
    raise FileFormatError(
        f"{path} has no lists with a value in column {name!r}; choose the columns that are "
        "channels with channels="
    )


def _spread(columns: Columns, widths: Mapping[str, int]) -> Columns:
    """Expands columns of lists to a name and a unit per channel."""
    if not widths:
        return columns
    names: list[str] = []
    units: list[str] = []
    for column, name, unit in zip(columns.channels, columns.names, columns.units, strict=True):
        own = [f"{name}.{i}" for i in range(widths[column])] if column in widths else [name]
        names += own
        units += [unit] * len(own)
    return replace(columns, names=tuple(names), units=tuple(units))
