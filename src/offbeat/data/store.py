"""Data sets on disk: one Parquet file, one row per time, our schema in its metadata.

Columns, in this order: `trajectory` (int32, counted from 0), `time` (float64, seconds), one float64
column per channel (NaN = not known), `name|observed` (bool) for the channels in which observed and
known differ, `action|0`, `action|1`, ... (float64). Any Parquet library reads such a file; the key
`offbeat` of its metadata holds, as JSON, what columns can't.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from offbeat.data.trajectory import Dataset, Trajectory
from offbeat.errors import FileFormatError, InputError
from offbeat.files import atomic_path

SCHEMA_VERSION = 1
"""Counted up when files are written that an earlier version of this module would misread."""

METADATA_KEY = b"offbeat"
"""Where our schema stands in the metadata of a Parquet file."""

_ROWS_PER_GROUP = 262_144  # bounds the memory beside the data set itself while it is written


@dataclass(frozen=True)
class _Schema:
    """What stands in the metadata: whatever the columns of the file don't say."""

    version: int
    rows: int
    trajectories: int
    names: list[str]
    units: list[str]
    observed: list[str]
    actions: int | None
    origins: list[str]
    meta: dict[str, Any]

    @property
    def columns(self) -> list[str]:
        observed = [f"{name}|observed" for name in self.observed]
        return ["trajectory", "time", *self.names, *observed, *self.action_columns]

    @property
    def action_columns(self) -> list[str]:
        return [f"action|{i}" for i in range(self.actions or 0)]


def save(dataset: Dataset, path: str | Path) -> None:
    """Writes a data set; `load` gives it back to the last bit.

    The file is written under a temporary name and renamed, so a stop in the middle loses nothing.

    Args:
        dataset: the data set; its `meta` must be JSON-like.
        path: the file to write; what stood there is replaced.

    Raises:
        InputError: a channel has the name of another column, some trajectories have other actions
            than others, or `meta` is not JSON-like.
        OSError: the file can't be written.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    schema = _schema_of(dataset)
    arrow = _arrow_fields(schema).with_metadata({METADATA_KEY: _as_json(schema)})
    repetitive = ["trajectory", "time"]
    numbers = [*schema.names, *schema.action_columns]
    with (
        atomic_path(path) as temporary,
        pq.ParquetWriter(
            temporary,
            arrow,
            compression="zstd",
            use_dictionary=repetitive,
            use_byte_stream_split=numbers,
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
        FileFormatError: there is no such file, or it is truncated, damaged, not a data set of ours,
            or of a later version of the schema.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    path = require_file(path)
    try:
        with pq.ParquetFile(path, page_checksum_verification=True) as file:
            schema = _schema_in(file.schema_arrow.metadata, path)
            _check_columns(schema, file.schema_arrow, path)
            table = file.read()
    except (pa.ArrowException, OSError) as error:
        raise FileFormatError(
            f"{path} can't be read as Parquet, it is truncated, damaged or of another format "
            f"({_one_line(error)}); copy or simulate it again"
        ) from None
    return _data_set(table, schema, path)


def holds_data_set(path: str | Path) -> bool:
    """Whether a file is Parquet with our schema in its metadata; never raises for its content."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        return METADATA_KEY in (pq.read_schema(path).metadata or {})
    except (pa.ArrowException, OSError):
        return False


def require_file(path: str | Path) -> Path:
    """Returns the path of a file that is there, is not empty, and is not a stand-in for another.

    Raises:
        FileFormatError: it is missing, a folder, empty, or a Git LFS pointer.
    """
    path = Path(path)
    if path.is_dir():
        raise FileFormatError(f"{path} is a folder, expected a file; name the file inside it")
    try:
        with path.open("rb") as file:
            start = file.read(64)
    except OSError as error:
        raise FileFormatError(
            f"{path} can't be read ({error.strerror}); check the path, working directory is "
            f"{Path.cwd()}"
        ) from None
    if not start:
        raise FileFormatError(f"{path} is empty, expected a data set; write it again")
    if start.startswith(b"version https://git-lfs"):
        raise FileFormatError(
            f"{path} is a Git LFS pointer, not the data; fetch the data with: git lfs pull"
        )
    return path


def _schema_of(dataset: Dataset) -> _Schema:
    counts = [None if t.actions is None else t.actions.shape[1] for t in dataset]
    if len(set(counts)) > 1:
        other = next(i for i, count in enumerate(counts) if count != counts[0])
        raise InputError(
            f"trajectory {other} has {counts[other] or 'no'} actions, the first one has "
            f"{counts[0] or 'no'}; a file holds trajectories of the same actions"
        )
    differs = np.zeros(dataset.channels, dtype=bool)
    for t in dataset:
        differs |= (t.observed != t.known).any(axis=0)
    schema = _Schema(
        version=SCHEMA_VERSION,
        rows=sum(t.rows for t in dataset),
        trajectories=len(dataset),
        names=list(dataset.names),
        units=list(dataset.units),
        observed=[name for name, yes in zip(dataset.names, differs, strict=True) if yes],
        actions=counts[0],
        origins=[t.origin for t in dataset],
        meta=dict(dataset.meta),
    )
    columns = schema.columns
    if len(set(columns)) < len(columns):
        twice = next(name for name in columns if columns.count(name) > 1)
        raise InputError(
            f"a channel is called {twice!r}, as a column of the file format is; rename the channel"
        )
    return schema


def _as_json(schema: _Schema) -> bytes:
    try:
        text = json.dumps(asdict(schema), allow_nan=False)
    except (TypeError, ValueError) as error:
        raise InputError(
            f"meta of a data set must be JSON-like to be saved ({error}); "
            "keep to strings, finite numbers, booleans, None, lists and dicts"
        ) from None
    if json.loads(text)["meta"] != schema.meta:
        raise InputError(
            "meta of a data set would not come back from a file as it is; "
            "use lists, not tuples, and strings as keys"
        )
    return text.encode()


def _row_groups(dataset: Dataset, schema: _Schema) -> Iterator[dict[str, NDArray[Any]]]:
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
        for name in schema.observed:
            seen = [t.observed[:, channel[name]] for t in group]
            columns[f"{name}|observed"] = np.concatenate(seen)
        if schema.actions:
            actions = np.concatenate([t.actions for t in group if t.actions is not None])
            columns |= {name: actions[:, a] for a, name in enumerate(schema.action_columns)}
        yield columns
        group, start, rows = [], i + 1, 0


def _schema_in(metadata: dict[bytes, bytes] | None, path: Path) -> _Schema:
    text = (metadata or {}).get(METADATA_KEY)
    if text is None:
        raise FileFormatError(
            f"{path} is Parquet, but no data set of Offbeat (no key {METADATA_KEY.decode()!r} in "
            "its metadata); make one with Trajectory.from_arrays, Dataset and save"
        )
    try:
        fields = dict(json.loads(text))
        version = fields["version"]
        schema = None if version > SCHEMA_VERSION else _Schema(**fields)
    except (KeyError, TypeError, ValueError) as error:
        raise FileFormatError(
            f"{path} has a damaged schema in its metadata ({_one_line(error)}); "
            "copy or simulate it again"
        ) from None
    if schema is None:
        raise FileFormatError(
            f"{path} has version {version} of the data set schema, this Offbeat reads up to "
            f"{SCHEMA_VERSION}; install a later one with: pip install --upgrade offbeat"
        )
    return schema


def _arrow_fields(schema: _Schema) -> Any:
    import pyarrow as pa

    types = {"trajectory": pa.int32()}
    types |= {f"{name}|observed": pa.bool_() for name in schema.observed}
    return pa.schema([pa.field(name, types.get(name, pa.float64())) for name in schema.columns])


def _check_columns(schema: _Schema, arrow: Any, path: Path) -> None:
    expected = [f"{field.name} ({field.type})" for field in _arrow_fields(schema)]
    got = [f"{field.name} ({field.type})" for field in arrow]
    if got != expected:
        raise FileFormatError(
            f"{path} has other columns than its schema says: missing "
            f"{_named(set(expected) - set(got))}, unexpected {_named(set(got) - set(expected))}; "
            "it was changed after it was written, write it with save"
        )


def _data_set(table: Any, schema: _Schema, path: Path) -> Dataset:
    counted = ["trajectory", *(f"{name}|observed" for name in schema.observed)]
    if nulls := {name for name in counted if table.column(name).null_count}:
        raise FileFormatError(
            f"{path} has empty cells in {_named(nulls)}, where every row needs one; "
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
    times = table.column("time").to_numpy()
    values = _matrix(table, schema.names)
    observed = None
    if schema.observed:
        observed = ~np.isnan(values)
        for name in schema.observed:
            column = table.column(f"{name}|observed").to_numpy()
            observed[:, schema.names.index(name)] = column
    actions = None
    if schema.actions is not None:
        actions = _matrix(table, schema.action_columns)
    ends = [*starts[1:], len(number)]
    names, units = tuple(schema.names), tuple(schema.units)
    try:
        trajectories = tuple(
            Trajectory(
                times[start:end],
                values[start:end],
                **({} if observed is None else {"observed": observed[start:end]}),
                actions=None if actions is None else actions[start:end],
                names=names,
                units=units,
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


def _named(columns: set[str]) -> str:
    return ", ".join(map(repr, sorted(columns))) or "none"


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())
