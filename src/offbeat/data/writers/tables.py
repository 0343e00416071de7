"""Tables for other programs, as CSV or plain Parquet."""

from __future__ import annotations

import csv
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from offbeat.data.trajectory import Dataset
from offbeat.errors import InputError, one_of
from offbeat.files import atomic_path

_TIME = "time [s]"  # with its unit, which a reader would else find from the numbers


def write_table(path: str | Path, columns: Mapping[str, ArrayLike]) -> None:
    """Writes columns as CSV or Parquet by the suffix of `path`, atomically.

    Floats are written exactly; in CSV a NaN is an empty field.

    Args:
        path: the file, `.csv`, `.parquet` or `.pq`; an existing one is replaced.
        columns: (rows,) numbers, booleans or strings, by name.

    Raises:
        InputError: the suffix is unknown, or columns differ in length or are of another kind.
        OSError: the file cannot be written.
    """
    path = Path(path)
    suffix = one_of("suffix of a table", path.suffix.lower(), (".csv", ".parquet", ".pq"))
    arrays = {name: np.asarray(column) for name, column in columns.items()}
    shapes = {array.shape for array in arrays.values()}
    if len(shapes) != 1 or len(next(iter(shapes))) != 1:
        got = ", ".join(f"{name!r} {array.shape}" for name, array in arrays.items())
        raise InputError(f"columns of a table must share one shape (rows,), got {got or 'none'}")
    for name, array in arrays.items():
        if array.dtype.kind not in "biufU":
            raise InputError(
                f"column {name!r} must hold numbers, booleans or strings, got {array.dtype}"
            )
    with atomic_path(path) as temporary:
        if suffix == ".csv":
            _write_csv(temporary, arrays)
        else:
            import pyarrow as pa
            import pyarrow.parquet as pq

            pq.write_table(pa.table(arrays), temporary, compression="zstd")


def write_dataset(dataset: Dataset, path: str | Path) -> None:
    """Writes a data set as a table: a row per time, columns `trajectory`, `time [s]`, and channels.

    `trajectory` is the label of the trajectory where it has one, else its number. A channel's unit
    follows its name in brackets.

    Args:
        dataset: the data set.
        path: as of `write_table`.

    Raises:
        InputError: as of `write_table`, or a channel has the name of another column.
    """
    named = [
        f"{name} [{unit}]" if unit else name
        for name, unit in zip(dataset.names, dataset.units, strict=True)
    ]
    for i, name in enumerate(named):
        if name in ("trajectory", "time", _TIME, *named[:i]):
            raise InputError(f"two columns would have the name {name!r}; rename the channel")
    labels = dataset.meta.get("labels", ())
    if len(labels) != len(dataset) or len(set(labels)) < len(labels):
        labels = range(len(dataset))
    values = np.concatenate([t.values for t in dataset])
    columns: dict[str, NDArray[Any]] = {
        "trajectory": np.repeat(np.asarray(labels), [t.rows for t in dataset]),
        _TIME: np.concatenate([t.times for t in dataset]),
    }
    write_table(path, columns | {name: values[:, c] for c, name in enumerate(named)})


def _write_csv(path: Path, arrays: Mapping[str, NDArray[Any]]) -> None:
    import pyarrow as pa
    import pyarrow.compute as pc
    import pyarrow.csv as pv

    columns = [_csv_column(array) for array in arrays.values()]
    texts = [column for column in columns if pa.types.is_string(column.type)]
    special = any(pc.any(pc.match_substring_regex(text, '[",\r\n]')).as_py() for text in texts)
    options = pv.WriteOptions(
        include_header=False,  # pyarrow quotes every name
        quoting_style="needed" if special else "none",
    )
    with path.open("w", encoding="utf-8", newline="") as file:
        csv.writer(file, lineterminator="\n").writerow(arrays)
    with path.open("ab") as file:
        pv.write_csv(pa.table(columns, names=list(arrays)), file, options)


def _csv_column(array: NDArray[Any]) -> Any:
    import pyarrow as pa

    if array.dtype.kind != "f":
        return pa.array(array)
    array = array.astype(np.float64)
    if ((array == np.trunc(array)) | np.isnan(array)).all():
        # pyarrow writes 1.0 as 1, and such a column would be read as an integer clock.
        return pa.array([None if x != x else repr(x) for x in array.tolist()], pa.string())
    return pa.array(array, from_pandas=True)  # a NaN becomes a null, which is an empty field
