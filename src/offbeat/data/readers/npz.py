"""NPZ of NumPy: an array of times, and arrays with a row per time."""

from __future__ import annotations

import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from offbeat.data.cleaning.clocks import state_time_unit, time_column_of
from offbeat.data.memory import require_memory
from offbeat.data.readers.columns import LABEL_NAMES, Coder, Columns, Gathered, listed, recordings
from offbeat.data.recording import Recording
from offbeat.data.source import require_file
from offbeat.errors import FileFormatError, one_of

_NAMES, _UNITS = ("names", "channels", "columns"), ("units",)


def read_npz(
    path: str | Path,
    *,
    time_column: str | None = None,
    trajectory_column: str | None = None,
    channels: Sequence[str] | None = None,
    time_unit: str | None = None,
    units: Mapping[str, str] | None = None,
) -> list[Recording]:
    """Reads recordings from an NPZ file; nothing in it is unpickled.

    The times have shape (rows,), and every other array of numbers whose first axis is as long gives
    channels: an array of shape (rows,) gives its name, the columns of one of shape (rows, k) are
    `array.0`, `array.1`, ..., or named by an array `names` of k texts if there is one matrix;
    `units` is used in the same way. Or times have shape (episodes, rows), and the others one axis
    more; rows whose time is NaN are padding. Other arrays are left out, which is noted.

    Args:
        path: the file.
        time_column: the array of times; by default found by its name, see `TIME_NAMES`.
        trajectory_column: the array, of shape (rows,), with the trajectory of each row;
            by default found by its name, see `LABEL_NAMES`.
        channels: the channels to read, in this order; by default all.
        time_unit: `s`, `ms`, `us`, `100ns` or `ns`; by default from the array's name or type,
            else detected from the numbers, which is noted, else `s`.
        units: unit of a channel by its name.

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
    time = (
        time_column_of(list(arrays))
        if time_column is None
        else one_of("time_column", time_column, arrays)
    )
    if time is None:
        raise FileFormatError(
            f"{path} has no array of times: one must be called time, t, timestamp, ... got "
            f"{listed(list(arrays))}; say which one with time_column="
        )
    clock = arrays.pop(time)
    if clock.ndim not in (1, 2) or clock.dtype.kind not in "iufmM":
        raise FileFormatError(
            f"{path} has times of shape {clock.shape} and type {clock.dtype} in {time!r}, expected "
            "numbers of shape (rows,) or (episodes, rows)"
        )
    label = trajectory_column
    if label is not None:
        one_of("trajectory_column", label, arrays)
    elif clock.ndim == 1:
        label = next((name for name in arrays if name.casefold() in LABEL_NAMES), None)
    labels = _labels(path, arrays.pop(label), label, clock) if label is not None else None
    notes: tuple[str, ...] = ()
    if clock.dtype.kind in "mM":
        unit = _unit_of_dates(path, clock)
        if np.isnat(clock).any():
            row = int(np.isnat(clock).argmax())
            raise FileFormatError(f"{path} has no time in row {row} of {time!r}; drop that row")
        clock = clock.astype(np.int64)
    else:
        unit, notes = state_time_unit(time_unit, time, np.ravel(clock)[:10_000], str(path))
    names, stated, columns, left = _channels(arrays, clock.shape)
    if not columns:
        shapes = ", ".join(f"{name!r} {array.shape}" for name, array in arrays.items()) or "nothing"
        raise FileFormatError(
            f"{path} has no array with a row for each of the {clock.shape} times in {time!r}, "
            f"besides them it has {shapes}"
        )
    if left:
        notes = (*notes, f"arrays without a row per time are left out: {', '.join(left)}")
    if channels is not None:
        order = [names.index(one_of("channel", name, names)) for name in dict.fromkeys(channels)]
        names, stated = [names[i] for i in order], [stated[i] for i in order]
        columns = [columns[i] for i in order]
    for name in units or {}:
        one_of("channel in units", name, names)
    given = dict(units or {})
    values = np.stack([column.astype(np.float64) for column in columns])
    if clock.ndim == 2:
        clock, labels, values = _by_episode(clock, values)
    described = Columns(
        time,
        label or ("episode" if labels else None),
        tuple(names),
        tuple(names),
        tuple(given.get(name, unit) for name, unit in zip(names, stated, strict=True)),
    )
    coded = None
    if labels is not None:
        coder = Coder()
        coder.add_texts(labels)
        coded = coder.done()
    return recordings(
        path, described, unit, notes, Gathered(clock, coded, None, values.reshape(len(names), -1).T)
    )


def _check_size(path: Path) -> None:
    """Raises an error if the unpacked arrays and the values made from them do not fit."""
    try:
        with zipfile.ZipFile(path) as file:
            size = sum(member.file_size for member in file.infolist())
    except (zipfile.BadZipFile, OSError):
        return  # reading it raises an error
    require_memory(path, 2 * size, f"{size} bytes of arrays")


def _load(path: Path) -> dict[str, NDArray[Any]]:
    try:
        # NumPy does not close a file that it cannot read.
        with path.open("rb") as opened:
            file = np.load(opened, allow_pickle=False)
            if not isinstance(file, np.lib.npyio.NpzFile):
                raise FileFormatError(f"{path} holds one array, expected an NPZ with several")
            with file:
                arrays = {name: file[name] for name in file.files}
        for name, array in arrays.items():
            if not isinstance(array, np.ndarray):
                raise FileFormatError(
                    f"{path} holds {name!r}, which is no array of NumPy; write it with np.savez"
                )
        return arrays
    except (ValueError, EOFError, OSError, zipfile.BadZipFile, KeyError, MemoryError) as error:
        if isinstance(error, FileFormatError):
            raise
        if "allow_pickle" in str(error) and zipfile.is_zipfile(path):
            raise FileFormatError(
                f"{path} holds pickled Python objects, which can run any code when they are "
                "loaded; Offbeat never does; save arrays of numbers and texts"
            ) from None
        raise FileFormatError(
            f"{path} can't be read as NPZ, it is truncated, damaged or of another format "
            f"({' '.join(str(error).split())}); copy it again"
        ) from None


def _labels(path: Path, array: NDArray[Any], name: str | None, clock: NDArray[Any]) -> list[str]:
    if array.shape != clock.shape or clock.ndim != 1:
        raise FileFormatError(
            f"{path} has labels of shape {array.shape} in {name!r}, expected one per time, "
            f"{clock.shape}"
        )
    return [str(label) for label in array.tolist()]


def _unit_of_dates(path: Path, clock: NDArray[Any]) -> str:
    unit, count = np.datetime_data(clock.dtype)
    if count != 1 or unit not in ("s", "ms", "us", "ns"):
        raise FileFormatError(f"{path} has times of type {clock.dtype}, expected s, ms, us or ns")
    return unit


def _channels(
    arrays: dict[str, NDArray[Any]], shape: tuple[int, ...]
) -> tuple[list[str], list[str], list[NDArray[Any]], list[str]]:
    """Names, units and columns of the channels, and the names of the other arrays."""
    axes = len(shape)
    fitting = {
        name: array
        for name, array in arrays.items()
        if array.dtype.kind in "biuf" and array.shape[:axes] == shape and array.ndim <= axes + 1
    }
    matrices = [name for name, array in fitting.items() if array.ndim == axes + 1]
    names: list[str] = []
    units: list[str] = []
    columns: list[NDArray[Any]] = []
    used: list[str] = []
    for name, array in fitting.items():
        if array.ndim == axes:
            own, own_units = [name], [""]
            columns.append(array)
        else:
            width = array.shape[-1]
            own, own_units = [f"{name}.{i}" for i in range(width)], [""] * width
            for texts, usual in ((own, _NAMES), (own_units, _UNITS)):
                for key in usual:
                    array_of_texts = arrays.get(key)
                    if (
                        array_of_texts is not None
                        and len(matrices) == 1
                        and array_of_texts.dtype.kind in "US"
                        and array_of_texts.shape == (width,)
                    ):
                        texts[:] = [str(text) for text in array_of_texts.astype(str)]
                        used.append(key)
                        break
            columns += [array[..., i] for i in range(width)]
        names += own
        units += own_units
    left = [name for name in arrays if name not in fitting and name not in used]
    return names, units, columns, left


def _by_episode(
    clock: NDArray[Any], values: NDArray[np.float64]
) -> tuple[NDArray[Any], list[str], NDArray[np.float64]]:
    """Joins episodes, without the padding."""
    there = ~np.isnan(clock) if clock.dtype.kind == "f" else np.ones(clock.shape, dtype=bool)
    labels = np.repeat(np.arange(len(clock)), there.sum(axis=1))
    return clock[there], [str(label) for label in labels.tolist()], values[:, there]
