"""Tables for other programs: columns of equal length, written as CSV or plain Parquet.

Data sets that Offbeat reads back are written by `offbeat.data.store`.
"""

from __future__ import annotations

import csv
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from offbeat.errors import InputError, one_of
from offbeat.files import atomic_path


def write_table(path: str | Path, columns: Mapping[str, ArrayLike]) -> None:
    """Writes columns as CSV or Parquet, by the suffix of `path`; whole or not at all.

    Floats are written to the last bit; in CSV a NaN is an empty cell.

    Args:
        path: the file, `.csv` or `.parquet`; what stood there is replaced.
        columns: (rows,) numbers, booleans or strings, by name.

    Raises:
        InputError: the suffix is unknown, or columns differ in length or are of another kind.
        OSError: the file can't be written.
    """
    path = Path(path)
    suffix = one_of("suffix of a table", path.suffix.lower(), (".csv", ".parquet"))
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


def _write_csv(path: Path, arrays: Mapping[str, NDArray[Any]]) -> None:
    import pyarrow as pa
    import pyarrow.compute as pc
    import pyarrow.csv as pv

    columns = [_csv_column(array) for array in arrays.values()]
    texts = [column for column in columns if pa.types.is_string(column.type)]
    special = any(pc.any(pc.match_substring_regex(text, '[",\r\n]')).as_py() for text in texts)
    options = pv.WriteOptions(
        include_header=False,  # pyarrow's has every name in quotes
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
        # pyarrow writes 1.0 as 1, and a column of those would read as an integer clock.
        return pa.array([None if x != x else repr(x) for x in array.tolist()], pa.string())
    return pa.array(array, from_pandas=True)  # a NaN becomes a null, which is an empty cell
