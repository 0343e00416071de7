"""Copies Arrow columns chunk by chunk, with one chunk in memory besides the result."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from offbeat.data.cleaning.clocks import join_stamp
from offbeat.data.readers.columns import Columns
from offbeat.data.readers.csv_fields import MISSING
from offbeat.data.readers.gathered import Coded, Coder, Gathered
from offbeat.data.readers.stamps import date_and_time, over_midnight, stamps_of
from offbeat.errors import FileFormatError


class NullValueError(Exception):
    """A row has no time, or no label of its trajectory or channel."""

    def __init__(self, column: str, row: int) -> None:
        super().__init__(column, row)
        self.column, self.row = column, row


def gather(
    batches: Iterable[Any],
    columns: Columns,
    capacity: int,
) -> Gathered:
    """Copies the needed columns from record batches, one batch at a time.

    Args:
        batches: `pyarrow.RecordBatch`es with the columns `columns.read`.
        columns: description of the columns.
        capacity: at least the number of rows; excess costs only address space.

    Raises:
        NullValueError: a time, label or key is missing.
        FileFormatError: the type of the time column is not supported.
        OverflowError: a time of decimals exceeds an int64 of nanoseconds.
    """
    # In column order, so that each column is filled and read as one block.
    values = np.empty((len(columns.channels), capacity))
    clocks: list[NDArray[Any]] = []
    labels = Coder() if columns.label else None
    keys = Coder() if columns.key else None
    rows = 0
    for batch in batches:
        for name, coder in ((columns.label, labels), (columns.key, keys)):
            if coder is not None and name is not None:
                coder.add(_without_nulls(_text(batch.column(name)), name, rows))
        clocks.append(clock_of(_without_nulls(batch.column(columns.time), columns.time, rows)))
        end = rows + batch.num_rows
        for c, name in enumerate(columns.channels):
            _put(values[c, rows:end], batch.column(name))
        rows = end
    clock = np.concatenate(clocks) if clocks else np.zeros(0, dtype=np.int64)
    return Gathered(
        clock,
        labels.done() if labels else None,
        keys.done() if keys else None,
        values[:, :rows].T,
    )


def with_joined(batches: Iterable[Any], columns: Columns) -> Iterator[Any]:
    """Batches with nanoseconds in place of the whole seconds of a stamp in two columns.

    Raises:
        NullValueError: a part is missing.
        FileFormatError: the parts are no such numbers.
    """
    import pyarrow as pa

    start = 0
    for batch in batches:
        whole, rest = (
            clock_of(_without_nulls(batch.column(name), name, start))
            for name in (columns.time, columns.rest or "")
        )
        start += batch.num_rows
        if not batch.num_rows:
            continue
        stamps = pa.array(join_stamp(whole, rest, columns.rest_unit))
        yield batch.set_column(batch.schema.get_field_index(columns.time), columns.time, stamps)


def gather_columns(
    sources: Sequence[Callable[[str], Iterable[Any]]],
    columns: Columns,
    clock: NDArray[Any],
    *,
    widths: Mapping[str, int] = MappingProxyType({}),
) -> Gathered:
    """Copies columns that can be read one by one, chunk by chunk.

    This uses less memory than batches of all columns, and decoded data stay in the cache.

    Args:
        sources: functions that return the Arrow arrays of a column of the same file; one thread
            each.
        columns: description of the columns.
        clock: (rows,) the times, of `clock_of_columns`.
        widths: number of channels of each column of lists.

    Raises:
        NullValueError, FileFormatError, OverflowError: as `gather`.
    """
    rows = len(clock)
    coded: list[Coded | None] = []
    for name in (columns.label, columns.key):
        coder = Coder()
        for column in _known(map(_text, sources[0](name)), name) if name is not None else ():
            coder.add(column)
        coded.append(coder.done() if name is not None else None)
    first = np.cumsum([0, *(widths.get(name, 1) for name in columns.channels)])
    values = np.empty((first[-1], rows))

    def fill(worker: int) -> None:
        for place in range(worker, len(columns.channels), len(sources)):
            name, start, at = columns.channels[place], 0, first[place]
            for column in sources[worker](name):
                end = start + len(column)
                if name in widths:
                    values[at : first[place + 1], start:end] = _lists(column, name, widths[name])
                else:
                    _put(values[at, start:end], column)
                start = end

    with ThreadPoolExecutor(len(sources)) as pool:
        for _ in pool.map(fill, range(len(sources))):
            pass  # raises the errors of threads
    return Gathered(clock, coded[0], coded[1], values.T)


def clock_of_columns(
    source: Callable[[str], Iterable[Any]], columns: Columns, form: str | None
) -> NDArray[Any]:
    """The times of a table whose columns can be read one by one, as integers or floats.

    Those of texts, dates, times of day and stamps in two columns are nanoseconds.

    Args:
        source: returns the Arrow arrays of a column.
        columns: description of the columns.
        form: of times as text.

    Raises:
        NullValueError: a time is missing.
        FileFormatError: two columns do not hold a stamp.
        ArrowInvalid: a text is no time.
    """
    import pyarrow as pa
    import pyarrow.compute as pc

    chunks = [c for c in _known(source(columns.time), columns.time) if len(c)]
    if not chunks:
        return np.zeros(0, dtype=np.int64)
    kind = chunks[0].type
    if columns.rest is not None:
        others = [c for c in _known(source(columns.rest), columns.rest) if len(c)]
        if columns.rest_unit != "date":
            whole, rest = (np.concatenate([clock_of(c) for c in part]) for part in (chunks, others))
            return join_stamp(whole, rest, columns.rest_unit)
        if not is_text(kind):
            chunks = [pc.strftime(c, "%Y-%m-%d") for c in chunks]
            form = "without"
        both = zip(chunks, map(_text, others), strict=True)
        return np.concatenate([clock_of(date_and_time(d, t, form or "without")) for d, t in both])
    if is_text(kind):
        stamps = [stamps_of(pc.utf8_trim_whitespace(_text(c)), form or "without") for c in chunks]
        clock = np.concatenate([clock_of(c) for c in stamps])
        return over_midnight(clock, form)
    if pa.types.is_date(kind):
        chunks = [c.cast(pa.timestamp("ns")) for c in chunks]
    if pa.types.is_time(kind):
        clock = np.concatenate([clock_of(c.cast(pa.time64("ns"))) for c in chunks])
        return over_midnight(clock)
    return np.concatenate([clock_of(c) for c in chunks])


def is_text(kind: Any) -> bool:
    """Whether an Arrow type is one of texts."""
    import pyarrow as pa

    if pa.types.is_dictionary(kind):
        kind = kind.value_type
    texts = (pa.types.is_string, pa.types.is_large_string, pa.types.is_string_view)
    return any(fits(kind) for fits in texts)


def _known(chunks: Iterable[Any], name: str) -> Iterator[Any]:
    start = 0
    for column in chunks:
        yield _without_nulls(column, name, start)
        start += len(column)


def clock_of(column: Any) -> NDArray[Any]:
    """Integers or floats of an Arrow column of times; decimals are given in nanoseconds.

    A decimal must have as many places as its unit has to a nanosecond (9 for seconds): its digits
    are then nanoseconds.
    """
    import pyarrow as pa

    kind = column.type
    if pa.types.is_timestamp(kind) or pa.types.is_duration(kind) or pa.types.is_time64(kind):
        column = column.cast(pa.int64())
    if pa.types.is_decimal(kind):
        words = np.frombuffer(column.buffers()[1], dtype=np.int64).reshape(-1, 2)
        words = words[column.offset : column.offset + len(column)]
        if (words[:, 1] != words[:, 0] >> 63).any():
            raise OverflowError("a time exceeds an int64 of nanoseconds")
        return words[:, 0]
    return np.asarray(column.to_numpy(zero_copy_only=False))


def _put(out: NDArray[np.float64], column: Any) -> None:
    """Copies a column of numbers, null = NaN."""
    import pyarrow as pa

    if is_text(column.type):
        column = _numbers_of(column)
    if not pa.types.is_float64(column.type):
        column = column.cast(pa.float64(), safe=False)
    if column.null_count == len(column):
        out[:] = np.nan
        return
    known, numbers = column.buffers()
    out[:] = np.frombuffer(numbers, np.float64, len(column), 8 * column.offset)
    if column.null_count:
        bits = np.unpackbits(np.frombuffer(known, np.uint8), bitorder="little")
        out[np.flatnonzero(bits[column.offset :][: len(column)] == 0)] = np.nan


def _numbers_of(column: Any) -> Any:
    """Numbers of a column of texts, null where one is missing.

    Raises:
        FileFormatError: a text is no number.
    """
    import pyarrow as pa
    import pyarrow.compute as pc

    texts = pc.utf8_trim_whitespace(_text(column))
    texts = pc.if_else(pc.is_in(texts, pa.array(MISSING)), pa.scalar(None, pa.string()), texts)
    try:
        return texts.cast(pa.float64())
    except pa.ArrowInvalid as error:
        raise FileFormatError(
            f"numbers as texts, and another text ({' '.join(str(error).split())[:90]}); leave that "
            "column out with without="
        ) from None


def _lists(column: Any, name: str, width: int) -> NDArray[Any]:
    """(width, rows) of a column of lists, null = NaN."""
    import pyarrow.compute as pc

    there = column.is_valid().to_numpy(zero_copy_only=False)
    lists = column.drop_null()
    lengths = pc.list_value_length(lists).to_numpy(zero_copy_only=False)
    if (lengths != width).any():
        raise FileFormatError(
            f"column {name!r} holds lists of {width} values and of {lengths[lengths != width][0]}, "
            "expected one length; choose the columns that are channels with channels="
        )
    flat = np.empty(width * len(lists))
    _put(flat, lists.flatten())
    spread = np.full((width, len(column)), np.nan)
    spread[:, there] = flat.reshape(-1, width).T
    return spread


def _text(column: Any) -> Any:
    import pyarrow as pa

    if pa.types.is_dictionary(column.type):
        column = column.dictionary_decode()
    return column if pa.types.is_string(column.type) else column.cast(pa.string())


def _without_nulls(column: Any, name: str, before: int) -> Any:
    import pyarrow as pa

    empty = column.is_null()
    if pa.types.is_string(column.type):
        import pyarrow.compute as pc

        empty = pc.or_kleene(empty, pc.equal(column, ""))
    flags = empty.fill_null(True).to_numpy(zero_copy_only=False)
    if flags.any():
        raise NullValueError(name, before + int(flags.argmax()))
    return column


def is_list(kind: Any) -> bool:
    """Whether an Arrow type is one of lists."""
    import pyarrow as pa

    lists = (pa.types.is_list, pa.types.is_large_list, pa.types.is_fixed_size_list)
    return any(fits(kind) for fits in lists)


def line_error(path: Path, error: Any) -> FileFormatError:
    """An error of Arrow about a file, in one line."""
    return FileFormatError(f"{path}: {' '.join(str(error).split())[:200]}")
