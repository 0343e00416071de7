"""Parquet of other programs: tables of pandas, Polars, Spark, DuckDB, ...; and Feather."""

from __future__ import annotations

import functools
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from offbeat.data.memory import require_memory
from offbeat.data.readers.arrow_columns import Chunks, TableSource, damaged, recordings_of
from offbeat.data.readers.table_options import TableOptions
from offbeat.data.recording import Recording
from offbeat.data.source import require_file

_ROWS = 1 << 16  # in memory at a time, besides the result
_BUFFER = 1 << 18  # bytes of a column as it is stored, in memory at a time
_THREADS = 4  # columns that are read at once, at most
_MANY = 1 << 20  # minimum number of values per thread
_DEEPEST = 20  # structs in structs


def read_parquet(
    path: str | Path,
    *,
    time_column: str | Sequence[str] | None = None,
    trajectory_column: str | None = None,
    channels: Sequence[str] | None = None,
    without: Sequence[str] = (),
    time_unit: str | None = None,
    units: Mapping[str, str] | None = None,
    channel_column: str | None = None,
    value_column: str | None = None,
    instance_column: str | None = None,
    rate_hz: float | None = None,
    day_first: bool | None = None,
) -> list[Recording]:
    """Reads recordings from Parquet: a row per time, or one per measured value.

    Columns have the same meaning as in CSV. Columns of time stamps, durations, dates or times of
    day have a unit; times may be texts of ISO 8601, too. A column of lists of one length gives a
    channel per element, `name.0`, `name.1`, ... Columns of anything else but numbers are left out,
    which is noted. The file is read 65,536 rows at a time.

    Args:
        path: the file.
        time_column: the column of times, or two that hold the stamp together; by default found by
            its name, such as `time` or `stamp`, or the index of pandas where it holds time stamps.
        trajectory_column: the column with the trajectory of each row; by default found
            by its name, such as `episode`.
        channels: the columns to read as channels, in this order; by default all numbers.
        without: columns to leave out.
        time_unit: `s`, `ms`, `us`, `100ns`, `ns`, `min`, `h` or `d`; by default from the column's
            type or name, else detected from the numbers, which is noted, else `s`.
        units: unit of a channel by its name.
        channel_column: the column with the channel of each value, in the long form.
        value_column: the column of values, in the long form.
        instance_column: the column with the sensor of each row, as in CSV.
        rate_hz: rows per second, for a file without times.
        day_first: of dates such as 07/08/2026, whether the day is before the month; by default
            decided by a number above 12 in the first rows, else asked for.

    Returns:
        A recording per trajectory, in the order of their first rows; null is NaN.

    Raises:
        FileFormatError: the file is missing, empty, truncated, not Parquet, has no time, or no
            channel that is numeric.
        InputError: an option names an unknown column or unit.
    """
    path = require_file(path)
    options = TableOptions(
        time_column=time_column,
        trajectory_column=trajectory_column,
        channels=channels,
        without=without,
        units=units,
        channel_column=channel_column,
        value_column=value_column,
        instance_column=instance_column,
        rate_hz=rate_hz,
        day_first=day_first,
    )
    import pyarrow as pa

    try:
        with ExitStack() as opened:
            return recordings_of(_ParquetSource(path, opened), options, time_unit)
    except (pa.ArrowException, OSError, UnicodeDecodeError) as error:
        raise damaged(path, "Parquet", error) from None


class _ParquetSource:
    """The columns of a Parquet file; a struct gives one per field, `pose.x`."""

    format = "Parquet"

    def __init__(self, path: Path, opened: ExitStack) -> None:
        self.path, self._opened = path, opened
        self._file = self._open()
        self.schema = flat(self._file.schema_arrow)
        self.rows = self._file.metadata.num_rows

    def _open(self, **more: Any) -> Any:
        import pyarrow.parquet as pq

        # Otherwise a whole row group, which can be the whole file, is in memory.
        file = pq.ParquetFile(self.path, pre_buffer=False, buffer_size=_BUFFER, **more)
        return self._opened.enter_context(file)

    def chunks(self, name: str) -> Iterator[Any]:
        """The Arrow arrays of a column."""
        return self._read(self._file, name)

    def _read(self, file: Any, name: str) -> Iterator[Any]:
        for batch in file.iter_batches(_ROWS, columns=[name], use_threads=False):
            yield _leaf(batch)

    def readers(self, columns: int) -> list[Chunks]:
        """Functions as `chunks`, each with a file of its own."""
        import pyarrow as pa

        count = min(_THREADS, pa.cpu_count(), self.rows * columns // _MANY)
        files = [self._file]
        while len(files) < count:
            files.append(self._open(metadata=self._file.metadata))
        return [functools.partial(self._read, file) for file in files]


def flat(schema: Any) -> Any:
    """A schema in which each field of a struct is a column, `pose.x`."""
    import pyarrow as pa

    def leaves(field: Any, name: str, depth: int) -> Iterator[Any]:
        if not pa.types.is_struct(field.type) or depth > _DEEPEST:
            yield field.with_name(name)
            return
        for i in range(field.type.num_fields):
            inner = field.type.field(i)
            yield from leaves(inner, f"{name}.{inner.name}", depth + 1)

    return pa.schema([leaf for field in schema for leaf in leaves(field, field.name, 0)])


def _leaf(batch: Any) -> Any:
    """A column of a batch that has one, which may be a field of structs."""
    import pyarrow as pa
    import pyarrow.compute as pc

    column = batch.column(0)
    while pa.types.is_struct(column.type):
        column = pc.struct_field(column, [0])
    return column


def read_feather(
    path: str | Path,
    *,
    time_column: str | Sequence[str] | None = None,
    trajectory_column: str | None = None,
    channels: Sequence[str] | None = None,
    without: Sequence[str] = (),
    time_unit: str | None = None,
    units: Mapping[str, str] | None = None,
    channel_column: str | None = None,
    value_column: str | None = None,
    instance_column: str | None = None,
    rate_hz: float | None = None,
    day_first: bool | None = None,
) -> list[Recording]:
    """Reads recordings from Feather, a file of Arrow, or a stream of Arrow.

    Columns have the same meaning as in Parquet.

    Args:
        path: the file.
        time_column: as of `read_parquet`.
        trajectory_column: as of `read_parquet`.
        channels: as of `read_parquet`.
        without: as of `read_parquet`.
        time_unit: as of `read_parquet`.
        units: as of `read_parquet`.
        channel_column: as of `read_parquet`.
        value_column: as of `read_parquet`.
        instance_column: as of `read_parquet`.
        rate_hz: as of `read_parquet`.
        day_first: as of `read_parquet`.

    Returns:
        A recording per trajectory, in the order of their first rows; null is NaN.

    Raises:
        FileFormatError: the file is missing, empty, truncated, not Arrow, has no time, or no
            channel that is numeric.
        InputError: an option names an unknown column or unit.
    """
    import pyarrow as pa

    path = require_file(path)
    options = TableOptions(
        time_column=time_column,
        trajectory_column=trajectory_column,
        channels=channels,
        without=without,
        units=units,
        channel_column=channel_column,
        value_column=value_column,
        instance_column=instance_column,
        rate_hz=rate_hz,
        day_first=day_first,
    )
    require_memory(path, path.stat().st_size, f"{path.stat().st_size} bytes of columns")
    try:
        with pa.memory_map(str(path)) as file:
            return recordings_of(TableSource(path, "Arrow", _flat_table(file)), options, time_unit)
    except (pa.ArrowException, OSError, UnicodeDecodeError, ValueError) as error:
        raise damaged(path, "Arrow", error) from None


def _flat_table(file: Any) -> Any:
    """The table of a file or a stream of Arrow, whose offsets are checked."""
    import pyarrow as pa

    try:
        reader = pa.ipc.open_file(file)
    except pa.ArrowInvalid:
        file.seek(0)
        reader = pa.ipc.open_stream(file)
    table = reader.read_all()
    table.validate(full=True)
    for _ in range(_DEEPEST):
        if not any(pa.types.is_struct(field.type) for field in table.schema):
            break
        table = table.flatten()
    return table
