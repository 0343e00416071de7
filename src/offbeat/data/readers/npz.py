"""NPZ of NumPy: an array of times, and arrays with a row per time; and NPY of named fields."""

from __future__ import annotations

import zipfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from offbeat.data.memory import require_memory
from offbeat.data.readers.arrays import recordings_of
from offbeat.data.readers.table_options import TableOptions
from offbeat.data.recording import Recording
from offbeat.data.source import require_file, starts_with
from offbeat.errors import FileFormatError

_BESIDE = ("roles", "observed", "low", "high", "clock_ns")  # what Offbeat writes beside values
_MOST_ARRAYS = 10_000


def read_npz(
    path: str | Path,
    *,
    time_column: str | Sequence[str] | None = None,
    trajectory_column: str | None = None,
    channels: Sequence[str] | None = None,
    without: Sequence[str] = (),
    time_unit: str | None = None,
    units: Mapping[str, str] | None = None,
    instance_column: str | None = None,
    rate_hz: float | None = None,
    day_first: bool | None = None,
) -> list[Recording]:
    """Reads recordings from an NPZ file; nothing in it is unpickled.

    The times have shape (rows,), and every other array of numbers whose first axis is as long gives
    channels: an array of shape (rows,) gives its name, the columns of one of shape (rows, k) are
    `array.0`, `array.1`, ..., or named by an array `names` of k texts if there is one matrix;
    `units` is used in the same way. Or times have shape (episodes, rows), and the others one axis
    more; rows whose time is NaN are padding. Times of shape (rows, 1) count as (rows,). Other
    arrays are left out, which is noted.

    Args:
        path: the file.
        time_column: the array of times, or two that hold the stamp together, as `[sec, nanosec]`;
            by default found by its name, such as `time` or `stamp`.
        trajectory_column: the array, of shape (rows,), with the trajectory of each row;
            by default found by its name, such as `episode`.
        channels: the channels to read, in this order; by default all.
        without: arrays or channels to leave out.
        time_unit: `s`, `ms`, `us`, `100ns`, `ns`, `min`, `h` or `d`; by default from the array's
            name or type, else detected from the numbers, which is noted, else `s`.
        units: unit of a channel by its name.
        instance_column: the array with the sensor of each row, as in CSV.
        rate_hz: rows per second, for a file without times.
        day_first: of dates such as 07/08/2026, whether the day is before the month; by default
            decided by a number above 12 in the first rows, else asked for.

    Returns:
        A recording per trajectory.

    Raises:
        FileFormatError: the file is missing, empty, truncated, not NPZ, or has pickled objects; it
            has no times, or no array with a row per time.
        InputError: an option names an unknown array or unit.
    """
    path = require_file(path)
    _check_size(path)
    arrays = _load(path)
    written = {"values", "observed", "names"} <= arrays.keys()  # by Offbeat
    if written and "clock_ns" in arrays and time_column is None:
        arrays["time_ns"] = arrays.pop("clock_ns")  # exact, while `time` counts from the first row
        arrays.pop("time", None)
    if written and "time" in arrays and time_column in (None, "time"):
        time_unit = time_unit or "s"
    options = TableOptions(
        time_column=time_column,
        trajectory_column=trajectory_column,
        channels=channels,
        without=without,
        units=units,
        instance_column=instance_column,
        rate_hz=rate_hz,
        day_first=day_first,
    )
    return recordings_of(path, arrays, options, time_unit, beside=_BESIDE if written else ())


def _check_size(path: Path) -> None:
    """Raises an error if the unpacked arrays and the values made from them do not fit."""
    try:
        with zipfile.ZipFile(path) as file:
            members = file.infolist()
            size = sum(member.file_size for member in members)
    except (zipfile.BadZipFile, OSError, ValueError, NotImplementedError):
        return  # reading it raises an error
    if len(members) > _MOST_ARRAYS:
        raise FileFormatError(
            f"{path} holds {len(members)} arrays, more than {_MOST_ARRAYS}; save matrices with a "
            "column per channel"
        )
    require_memory(path, 2 * size, f"{size} bytes of arrays")


def _spread(path: Path, name: str, array: Any) -> Iterator[tuple[str, Any]]:
    """An array, or those of its fields."""
    if isinstance(array, np.ndarray) and array.dtype.names:
        yield from ((f"{name}.{field}", part) for field, part in _fields(path, array).items())
    else:
        yield name, array


def _fields(path: Path, array: NDArray[Any]) -> dict[str, NDArray[Any]]:
    """The fields of a structured array, as arrays by name."""
    names = array.dtype.names
    if not names:
        raise FileFormatError(
            f"{path} holds one array of shape {array.shape} without names; write named ones with "
            "np.savez(file, time=..., x=...)"
        )
    found: dict[str, NDArray[Any]] = {}
    for name in names:
        part = array[name]
        inner = _fields(path, part) if part.dtype.names else {}
        found |= {f"{name}.{n}": a for n, a in inner.items()} or {name: part}
    return found


def _load(path: Path) -> dict[str, NDArray[Any]]:
    try:
        # NumPy does not close a file that it cannot read.
        with path.open("rb") as opened:
            file = np.load(opened, allow_pickle=False)
            if isinstance(file, np.ndarray):
                return _fields(path, file)
            with file:
                arrays = {name: file[name] for name in file.files}
            arrays = {n: a for name, array in arrays.items() for n, a in _spread(path, name, array)}
        for name, array in arrays.items():
            if not isinstance(array, np.ndarray):
                raise FileFormatError(
                    f"{path} holds {name!r}, which is no array of NumPy; write it with np.savez"
                )
        return arrays
    except (ValueError, EOFError, OSError, zipfile.BadZipFile, KeyError, MemoryError) as error:
        if isinstance(error, FileFormatError):
            raise
        if "allow_pickle" in str(error) and (
            zipfile.is_zipfile(path) or starts_with(path, b"\x93NUMPY")
        ):
            raise FileFormatError(
                f"{path} holds pickled Python objects, which can run any code when they are "
                "loaded; Offbeat never does; save arrays of numbers and texts"
            ) from None
        raise FileFormatError(
            f"{path} can't be read as NPZ, it is truncated, damaged or of another format "
            f"({' '.join(str(error).split())[:120]}); copy it again"
        ) from None
