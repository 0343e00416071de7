"""Data sets on disk: a Parquet file with one row per time, and a schema in its metadata.

The columns are `trajectory` (int32, counted from 0), `time` (float64, seconds), one float64 column
per channel (NaN = not known), and `name|observed` (bool) for the channels in which some known value
is not observed. Any Parquet library reads such a file; the key `offbeat` of its metadata holds the
schema as JSON.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from offbeat.data.arrays import hand_over
from offbeat.data.memory import require_rows
from offbeat.data.schema import METADATA_KEY, Schema
from offbeat.data.source import require_file
from offbeat.data.trajectory import Dataset, Trajectory
from offbeat.errors import FileFormatError, InputError
from offbeat.files import atomic_path

_ROWS_PER_GROUP = 262_144  # bounds the memory used while a data set is written


def save(dataset: Dataset, path: str | Path) -> None:
    """Writes a data set; `load` restores it exactly.

    The file is written atomically.

    Args:
        dataset: the data set; its `meta` must be JSON-like.
        path: the file to write; an existing file is replaced.

    Raises:
        InputError: a channel has the name of another column, or `meta` is not JSON-like.
        OSError: the file can't be written.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    schema = Schema.of(dataset)
    arrow = schema.to_arrow().with_metadata(schema.to_metadata())
    repetitive = ["trajectory", "time"]
    with (
        atomic_path(path) as temporary,
        pq.ParquetWriter(
            temporary,
            arrow,
            compression="zstd",
            use_dictionary=repetitive,
            use_byte_stream_split=schema.stored_as,
            write_statistics=repetitive,
            write_page_checksum=True,
        ) as writer,
    ):
        for columns in _row_groups(dataset, schema):
            writer.write_table(pa.table(columns, schema=arrow))


def load(path: str | Path) -> Dataset:
    """Reads a data set that `save` wrote.

    Args:
        path: the file.

    Returns:
        The data set; its trajectories share the memory of one array.

    Raises:
        FileFormatError: there is no such file, or it is truncated, damaged, not a data set of
            Offbeat, or of a later version of the schema.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    path = require_file(path)
    try:
        with pq.ParquetFile(path, page_checksum_verification=True) as file:
            schema = Schema.from_metadata(file.schema_arrow.metadata, path)
            schema.check_columns(file.schema_arrow, path)
            require_rows(path, schema.rows, len(schema.names), "", copies=2)
            table = file.read()
    except (pa.ArrowException, OSError, UnicodeDecodeError) as error:
        raise FileFormatError(
            f"{path} can't be read as Parquet, it is truncated, damaged or of another format "
            f"({' '.join(str(error).split())[:150]}); copy or simulate it again, or read another "
            "format with offbeat.read"
        ) from None
    return _data_set(table, schema, path)


def holds_data_set(path: str | Path) -> bool:
    """Whether a file is Parquet with Offbeat's schema; never raises for invalid content."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        return METADATA_KEY in (pq.read_schema(path).metadata or {})
    except (pa.ArrowException, OSError, UnicodeDecodeError):
        return False


def _row_groups(dataset: Dataset, schema: Schema) -> Iterator[dict[str, NDArray[Any]]]:
    """Columns of whole trajectories, about `_ROWS_PER_GROUP` rows at a time."""
    channel = {name: i for i, name in enumerate(schema.names)}
    group: list[Trajectory] = []
    start = rows = 0
    for i, trajectory in enumerate(dataset):
        group.append(trajectory)
        rows += trajectory.rows
        if rows < _ROWS_PER_GROUP and i + 1 < len(dataset):
            continue
        counts = [t.rows for t in group]
        columns: dict[str, NDArray[Any]] = {
            "trajectory": np.repeat(np.arange(start, i + 1, dtype=np.int32), counts),
            "time": np.concatenate([t.times for t in group]),
        }
        values = np.concatenate([t.values for t in group])
        columns |= {name: values[:, c] for name, c in channel.items()}
        for name, column in zip(schema.observed, schema.observed_columns, strict=True):
            columns[column] = np.concatenate([t.observed[:, channel[name]] for t in group])
        yield columns
        group, start, rows = [], i + 1, 0


def _data_set(table: Any, schema: Schema, path: Path) -> Dataset:
    for name in ("trajectory", *schema.observed_columns):
        if table.column(name).null_count:
            raise FileFormatError(
                f"{path} has empty values in column {name!r}, where every row needs a value; "
                "it was changed after it was written, write it with save"
            )
    number = table.column("trajectory").to_numpy()
    starts = np.flatnonzero(np.diff(number, prepend=-1))
    if (
        len(number) != schema.rows
        or len(schema.origins) != schema.trajectories
        or not np.array_equal(number[starts], np.arange(schema.trajectories))
    ):
        raise FileFormatError(
            f"{path} holds {len(number)} rows of {len(np.unique(number))} trajectories, its "
            f"schema says {schema.rows} rows of {schema.trajectories}, one after the other; it was "
            "changed after it was written, write it with save"
        )
    times = hand_over(np.array(table.column("time").to_numpy()))
    values = _matrix(table, schema.stored_as)
    observed = None
    if schema.observed:
        observed = ~np.isnan(values)
        for name, column in zip(schema.observed, schema.observed_columns, strict=True):
            observed[:, schema.names.index(name)] = table.column(column).to_numpy()
        hand_over(observed)
    hand_over(values)
    ends = [*starts[1:], len(number)]
    names, units, roles = tuple(schema.names), tuple(schema.units), tuple(schema.roles)
    try:
        trajectories = tuple(
            Trajectory(
                times[start:end],
                values[start:end],
                **({} if observed is None else {"observed": observed[start:end]}),
                names=names,
                units=units,
                roles=roles,
                origin=origin,
            )
            for start, end, origin in zip(starts, ends, schema.origins, strict=True)
        )
        return Dataset(trajectories, schema.meta)
    except InputError as error:
        raise FileFormatError(f"{path} holds an invalid trajectory: {error}") from None


def _matrix(table: Any, columns: Sequence[str]) -> NDArray[np.float64]:
    matrix = np.empty((table.num_rows, len(columns)))
    for c, name in enumerate(columns):
        matrix[:, c] = table.column(name).to_numpy()
    return matrix
