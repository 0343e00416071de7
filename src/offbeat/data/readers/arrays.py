"""Arrays of NumPy by name, as a table: the part that NPZ, MATLAB and plain HDF5 share."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from offbeat.data.cleaning.clocks import join_stamp, split_unit, state_time_unit, time_column_of
from offbeat.data.readers.columns import Columns
from offbeat.data.readers.gathered import Coded, Coder, Gathered, recordings
from offbeat.data.readers.stamp_columns import Stamp, stamp_columns
from offbeat.data.readers.stamps import date_and_time, form_in, over_midnight, stamps_of
from offbeat.data.readers.table_options import LABEL_NAMES, TableOptions
from offbeat.data.recording import Recording
from offbeat.data.signals import MOST_CHANNELS
from offbeat.errors import FileFormatError, listed, one_of

_NAMES = ("names", "channels", "columns")
_SPECIAL = (*_NAMES, "units")
_SAMPLE = 1000
_EPISODE = "episode"
_LARGEST_MATRIX = 36  # numbers of a matrix per row


def recordings_of(
    path: Path,
    arrays: Mapping[str, NDArray[Any]],
    options: TableOptions,
    time_unit: str | None = None,
    *,
    beside: Sequence[str] = (),
) -> list[Recording]:
    """Recordings from arrays with a row per time.

    Args:
        path: the file, for messages.
        arrays: by name; the times have shape (rows,), or (episodes, rows).
        options: what they mean.
        time_unit: of the times, or None.
        beside: names of arrays that are left out, as masks of other channels.

    Raises:
        FileFormatError: there are no times, or no array with a row per time.
        InputError: an option names an unknown array or unit.
    """
    arrays, channels = dict(arrays), options.channels
    turned: list[str] = []
    for name, array in arrays.items():
        column = array.shape[1:] == (1,) and len(array) > 1 and options.time_column in (None, name)
        if column and time_column_of([name]):
            arrays[name] = array[:, 0]
    stamp = stamp_columns(path, list(arrays), options, ArraySample(arrays), "array")
    shape = arrays[stamp.time].shape if stamp.time else _most_common_length(arrays)
    if len(shape) not in (1, 2) or (stamp.time and arrays[stamp.time].dtype.kind not in "iufmMSU"):
        array = arrays[stamp.time]
        raise FileFormatError(
            f"{path} has times of shape {array.shape} and type {array.dtype} in {stamp.time!r}, "
            "expected numbers of shape (rows,) or (episodes, rows)"
        )
    for name, array in arrays.items():
        if len(shape) == 1 and name != stamp.time and array.shape[1:] == shape != array.shape[:1]:
            arrays[name] = array.T
            turned.append(name)
    clock, unit, notes, found = _clock(path, arrays, stamp, shape, options, time_unit)
    beside = [name for name in beside if name in arrays and channels is None]
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
    if turned:
        notes = (*notes, f"arrays with a column per time are turned: {listed(turned, quoted=True)}")
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
    sample = ArraySample({**times, **table})
    columns = Columns.of(path, [*stamps, *table], options, sample)
    columns = replace(
        columns,
        left_out=(*columns.left_out, *left, *gone),
        notes=tuple(dict.fromkeys((*stamp.notes, *columns.notes))),
    )
    values = np.stack([table[name].astype(np.float64) for name in columns.channels])
    gathered = Gathered(clock, _coded(table, columns.label), _coded(table, columns.key), values.T)
    return recordings(path, columns, unit, notes, gathered, found=found)


@dataclass(frozen=True)
class ArraySample:
    """The first values of arrays."""

    arrays: Mapping[str, NDArray[Any]]

    def is_text(self, name: str) -> bool:
        """Whether an array holds no numbers."""
        return self.arrays[name].dtype.kind not in "biuf"

    def numbers(self, name: str) -> NDArray[np.float64]:
        """The first numbers of an array of shape (rows,); empty for others."""
        array = self.arrays[name]
        if array.dtype.kind not in "biuf" or array.ndim != 1:
            return np.zeros(0)
        return array[:_SAMPLE].astype(np.float64)

    def texts(self, name: str) -> list[str]:
        """The first values of an array of shape (rows,), as texts."""
        array = self.arrays[name]
        return [str(value) for value in array[:_SAMPLE].tolist()] if array.ndim == 1 else []


def _most_common_length(arrays: Mapping[str, NDArray[Any]]) -> tuple[int, ...]:
    """The length that most arrays of numbers have, the longer one of two as common."""
    lengths = Counter(len(array) for array in arrays.values() if array.ndim in (1, 2))
    return (max(lengths, key=lambda n: (lengths[n], n)),) if lengths else (0,)


def _clock(
    path: Path,
    arrays: Mapping[str, NDArray[Any]],
    stamp: Stamp,
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
        clock = _of_texts(path, stamp, arrays, options.day_first)
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


def _of_texts(
    path: Path, stamp: Stamp, arrays: Mapping[str, NDArray[Any]], day_first: bool | None
) -> NDArray[Any]:
    import pyarrow as pa

    texts = [pa.array([str(t) for t in arrays[n].astype(str).ravel().tolist()])
             for n in (stamp.time, stamp.rest) if n]  # fmt: skip
    first = texts[0][0].as_py() if len(texts[0]) else ""
    form = form_in(
        (text.strip() for text in texts[0].slice(0, _SAMPLE).to_pylist()),
        day_first,
        where=str(path),
    )
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
    return over_midnight(clock, form)


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
            or (array.dtype.kind in "biuf" and array.ndim == axes + 2 and _is_small(array, axes))
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
        elif array.ndim == axes + 2:
            places = list(np.ndindex(array.shape[axes:]))
            own = [f"{name}.{i}.{j}" for i, j in places]
            columns = [array[..., i, j] for i, j in places]
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


def _is_small(array: NDArray[Any], axes: int) -> bool:
    """Whether each row is a small matrix, as of a rotation or a covariance, and no picture."""
    return 0 < int(np.prod(array.shape[axes:])) <= _LARGEST_MATRIX


def _by_episode(
    clock: NDArray[Any], table: dict[str, NDArray[Any]]
) -> tuple[NDArray[Any], NDArray[Any], dict[str, NDArray[Any]]]:
    """Joins episodes, without the padding."""
    there = ~np.isnan(clock) if clock.dtype.kind == "f" else np.ones(clock.shape, dtype=bool)
    labels = np.repeat(np.arange(len(clock)), there.sum(axis=1))
    return clock[there], labels, {name: column[there] for name, column in table.items()}
