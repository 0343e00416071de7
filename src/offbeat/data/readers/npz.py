"""NPZ of NumPy: an array of times, and arrays with a row per time."""

from __future__ import annotations

import zipfile
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from offbeat.data.cleaning.clocks import join_stamp, split_unit, state_time_unit, time_column_of
from offbeat.data.memory import require_memory
from offbeat.data.readers.columns import LABEL_NAMES, Columns, TableOptions, stamp_columns
from offbeat.data.readers.gathered import Coded, Coder, Gathered, recordings
from offbeat.data.readers.stamps import date_and_time, form_of, over_midnight, stamps_of
from offbeat.data.recording import Recording
from offbeat.data.signals import MOST_CHANNELS
from offbeat.data.source import require_file
from offbeat.errors import FileFormatError, listed, one_of

_NAMES = ("names", "channels", "columns")
_SPECIAL = (*_NAMES, "units")
_BESIDE = ("roles", "observed", "low", "high", "clock_ns")  # what Offbeat writes beside values
_SAMPLE = 1000
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
            by default found by its name, see `TIME_NAMES`.
        trajectory_column: the array, of shape (rows,), with the trajectory of each row;
            by default found by its name, see `LABEL_NAMES`.
        channels: the channels to read, in this order; by default all.
        without: arrays or channels to leave out.
        time_unit: `s`, `ms`, `us`, `100ns`, `ns`, `min`, `h` or `d`; by default from the array's
            name or type, else detected from the numbers, which is noted, else `s`.
        units: unit of a channel by its name.
        instance_column: the array with the sensor of each row, as in CSV.
        rate_hz: rows per second, for a file without times.

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
    )
    for name, array in arrays.items():
        column = array.shape[1:] == (1,) and len(array) > 1 and time_column in (None, name)
        if column and time_column_of([name]):
            arrays[name] = array[:, 0]
    stamp = stamp_columns(path, list(arrays), options, _NpzSample(arrays), "array")
    shape = arrays[stamp.time].shape if stamp.time else _most_common_length(arrays)
    if len(shape) not in (1, 2) or (stamp.time and arrays[stamp.time].dtype.kind not in "iufmMSU"):
        array = arrays[stamp.time]
        raise FileFormatError(
            f"{path} has times of shape {array.shape} and type {array.dtype} in {stamp.time!r}, "
            "expected numbers of shape (rows,) or (episodes, rows)"
        )
    clock, unit, notes, found = _clock(path, arrays, stamp, shape, options, time_unit)
    beside = [name for name in _BESIDE if written and name in arrays and channels is None]
    rest = {name: array for name, array in arrays.items() if name not in beside}
    table, stated, left = _table(rest, shape, {stamp.time, stamp.rest})
    left += beside
    if not any(array.dtype.kind in "biuf" for array in table.values()):
        others = [f"{name} {array.shape}" for name, array in arrays.items() if name != stamp.time]
        shapes = listed(others) or "nothing"
        raise FileFormatError(
            f"{path} has no array with a row for each of the {shape} times in {stamp.time!r}, "
            f"besides them it has {shapes}"
        )
    if beside:
        notes = (*notes, "masks and intervals are left out")
    elif left:
        notes = (*notes, f"arrays without a row per time are left out: {', '.join(left[:20])}")
    if len(table) > MOST_CHANNELS:
        raise FileFormatError(f"{path} has {len(table)} columns, more than {MOST_CHANNELS}")
    if len(shape) == 2:
        clock, labels, table = _by_episode(clock, table)
        table = {_EPISODE: labels, **table}
        options = replace(options, trajectory_column=_EPISODE)
    options = _with_labels(path, arrays, options, table, shape)
    gone = {n for n in options.without for n in (n, *(f for f in table if f.startswith(f"{n}.")))}
    table = {name: column for name, column in table.items() if name not in gone}
    for name in options.units or {}:
        one_of("channel in units", name, table)
    stamps = [name for name in (stamp.time, stamp.rest) if name]
    if twice := [name for name in stamps if name in table]:
        raise FileFormatError(
            f"{path} has a channel and an array of times with the name {twice[0]!r}; rename one, "
            "or leave it out with without="
        )
    options = replace(
        options,
        units={
            **{split_unit(n)[0]: u for n, u in stated.items() if n in table and u},
            **(options.units or {}),
        },
        time_column=stamps or None,
        without=(),
    )
    times = {name: clock if len(shape) == 2 else arrays[name] for name in stamps}
    sample = _NpzSample({**times, **table})
    columns = Columns.of(path, [*stamps, *table], options, sample)
    columns = replace(columns, left_out=(*columns.left_out, *left, *gone))
    values = np.stack([table[name].astype(np.float64) for name in columns.channels])
    gathered = Gathered(clock, _coded(table, columns.label), _coded(table, columns.key), values.T)
    return recordings(path, columns, unit, notes, gathered, found=found)


@dataclass(frozen=True)
class _NpzSample:
    """The first values of arrays."""

    arrays: Mapping[str, NDArray[Any]]

    def is_text(self, name: str) -> bool:
        """Whether an array holds no numbers."""
        return self.arrays[name].dtype.kind not in "biuf"

    def numbers(self, name: str) -> NDArray[np.float64]:
        array = self.arrays[name]
        if array.dtype.kind not in "biuf" or array.ndim != 1:
            return np.zeros(0)
        return array[:_SAMPLE].astype(np.float64)

    def texts(self, name: str) -> list[str]:
        array = self.arrays[name]
        return [str(value) for value in array[:_SAMPLE].tolist()] if array.ndim == 1 else []


def _most_common_length(arrays: Mapping[str, NDArray[Any]]) -> tuple[int, ...]:
    """The length that most arrays of numbers have, the longer one of two as common."""
    lengths = Counter(len(array) for array in arrays.values() if array.ndim in (1, 2))
    return (max(lengths, key=lambda n: (lengths[n], n)),) if lengths else (0,)


def _clock(
    path: Path,
    arrays: Mapping[str, NDArray[Any]],
    stamp: Columns,
    shape: tuple[int, ...],
    options: TableOptions,
    time_unit: str | None,
) -> tuple[NDArray[Any], str, tuple[str, ...], bool]:
    """The times, their unit, notes on it, and whether nothing states it."""
    if not stamp.time:
        rows = np.arange(shape[0])
        return np.rint(rows * (1e9 / (options.rate_hz or 1.0))).astype(np.int64), "ns", (), False
    clock = arrays[stamp.time]
    if clock.dtype.kind in "SU":
        clock = _of_texts(path, stamp, arrays)
        return clock, "ns", (), False
    if stamp.rest is not None and stamp.rest_unit != "date":
        return join_stamp(clock, arrays[stamp.rest], stamp.rest_unit), "ns", (), False
    if clock.dtype.kind in "mM":
        unit = _unit_of_dates(path, clock)
        if np.isnat(clock).any():
            row = int(np.isnat(clock).argmax())
            raise FileFormatError(
                f"{path} has no time in row {row} of {stamp.time!r}; drop that row"
            )
        return clock.astype(np.int64), unit, (), False
    return clock, *state_time_unit(time_unit, stamp.time, np.ravel(clock)[:10_000], str(path))


def _of_texts(path: Path, stamp: Columns, arrays: Mapping[str, NDArray[Any]]) -> NDArray[Any]:
    import pyarrow as pa

    texts = [pa.array([str(t) for t in arrays[n].astype(str).ravel().tolist()])
             for n in (stamp.time, stamp.rest) if n]  # fmt: skip
    first = texts[0][0].as_py() if len(texts[0]) else ""
    form = form_of(first.strip())
    try:
        if form is None:
            raise pa.ArrowInvalid(f"{first[:60]!r} is no time")
        if stamp.rest is not None:
            return np.asarray(date_and_time(texts[0], texts[1], form).cast(pa.int64()))
        clock = np.asarray(stamps_of(texts[0], form).cast(pa.int64()))
    except pa.ArrowException as error:
        raise FileFormatError(
            f"{path} has times of text in {stamp.time!r}, expected numbers or ISO 8601 ({error})"
        ) from None
    return over_midnight(clock) if form == "of day" else clock


_EPISODE = "episode"


def _with_labels(
    path: Path,
    arrays: Mapping[str, NDArray[Any]],
    options: TableOptions,
    table: dict[str, NDArray[Any]],
    shape: tuple[int, ...],
) -> TableOptions:
    """The options with the array of labels, which is checked."""
    label = options.trajectory_column
    if label is None:
        label = next((name for name in arrays if name.casefold() in LABEL_NAMES), None)
    if label is None or label in table:
        return options
    one_of("trajectory_column", label, arrays)
    raise FileFormatError(
        f"{path} has labels of shape {arrays[label].shape} in {label!r}, expected one per time, "
        f"{shape}"
    )


def _coded(table: Mapping[str, NDArray[Any]], name: str | None) -> Coded | None:
    if name is None:
        return None
    coder = Coder()
    coder.add_texts([str(label) for label in table[name].tolist()])
    return coder.done()


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
            f"({' '.join(str(error).split())[:120]}); copy it again"
        ) from None


def _unit_of_dates(path: Path, clock: NDArray[Any]) -> str:
    unit, count = np.datetime_data(clock.dtype)
    if count != 1 or unit not in ("s", "ms", "us", "ns"):
        raise FileFormatError(f"{path} has times of type {clock.dtype}, expected s, ms, us or ns")
    return unit


def _table(
    arrays: Mapping[str, NDArray[Any]], shape: tuple[int, ...], stamp: set[str | None]
) -> tuple[dict[str, NDArray[Any]], dict[str, str], list[str]]:
    """A column per channel and label, units of channels, and the names of the other arrays."""
    axes = len(shape)
    fitting = {
        name: array
        for name, array in arrays.items()
        if name not in stamp
        and array.shape[:axes] == shape
        and (
            (array.dtype.kind in "biuf" and array.ndim <= axes + 1)
            or (array.dtype.kind in "SU" and array.ndim == axes == 1 and name not in _SPECIAL)
        )
    }
    matrices = [name for name, array in fitting.items() if array.ndim == axes + 1]
    table: dict[str, NDArray[Any]] = {}
    stated: dict[str, str] = {}
    used: list[str] = []
    for name, array in fitting.items():
        if array.ndim == axes:
            own, columns = [name], [array]
        else:
            width = array.shape[-1]
            own = [f"{name}.{i}" for i in range(width)]
            columns = [array[..., i] for i in range(width)]
            if len(matrices) == 1:
                texts = {
                    key: [str(text) for text in found.astype(str)]
                    for key in _SPECIAL
                    if (found := arrays.get(key)) is not None
                    and found.dtype.kind in "US"
                    and found.shape == (width,)
                }
                named = next((key for key in _NAMES if key in texts), None)
                own = texts[named] if named else own
                used += [named] if named else []
                if "units" in texts:
                    stated = dict(zip(own, texts["units"], strict=True))
                    used.append("units")
        for channel, column in zip(own, columns, strict=True):
            if channel in table:
                raise FileFormatError(
                    f"there are two channels with the name {channel!r}; rename one"
                )
            table[channel] = column
    left = [n for n in arrays if n not in fitting and n not in used and n not in stamp]
    return table, stated, left


def _by_episode(
    clock: NDArray[Any], table: dict[str, NDArray[Any]]
) -> tuple[NDArray[Any], NDArray[Any], dict[str, NDArray[Any]]]:
    """Joins episodes, without the padding."""
    there = ~np.isnan(clock) if clock.dtype.kind == "f" else np.ones(clock.shape, dtype=bool)
    labels = np.repeat(np.arange(len(clock)), there.sum(axis=1))
    return clock[there], labels, {name: column[there] for name, column in table.items()}
