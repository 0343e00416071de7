"""MATLAB: MAT-files of versions 4 to 7 through SciPy, and 7.3, which is HDF5."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from offbeat.data.cleaning.clocks import time_column_of
from offbeat.data.memory import require_memory
from offbeat.data.readers import hdf5
from offbeat.data.readers.groups import rate_of, recordings_of_groups
from offbeat.data.readers.table_options import TableOptions
from offbeat.data.recording import Recording
from offbeat.data.source import require_file
from offbeat.errors import FileFormatError, listed

_DEEPEST = 20
_WIDEST = 1024
_RATIO = 2000  # the most of compression
_CLASSES = ("opaque", "object", "function")  # of MATLAB, which SciPy can't read


def recognises(path: Path) -> bool:
    """Whether a file is of MATLAB, of a version before 7.3."""
    return path.suffix.lower() == ".mat" and not hdf5.recognises(path)


def read_mat(
    path: str | Path,
    *,
    time_column: str | Sequence[str] | None = None,
    time_unit: str | None = None,
    rate_hz: float | None = None,
) -> list[Recording]:
    """Reads recordings from a MAT-file: arrays in variables and in fields of structs.

    Args:
        path: the file.
        time_column: array of the times, or its path, `log/t`; by default found by its name.
        time_unit: of the times; by default from their name, else detected.
        rate_hz: rows per second, for a file without times.

    Returns:
        Recordings; a matrix has a row per time, or a column per time, and a channel `q[0]` for each
        of the others.

    Raises:
        FileFormatError: the file is damaged, holds objects alone, or has no times.
        InputError: an option names an unknown array or unit.
    """
    path = require_file(path)
    options = TableOptions(time_column=time_column, rate_hz=rate_hz)
    values, left = _load(path)
    episodes = [v for v in values.values() if isinstance(v, list | np.ndarray) and _are_structs(v)]
    if len(episodes) == 1:
        return [
            one
            for i, part in enumerate(episodes[0])
            for one in _recordings(path, part, list(left), options, time_unit, str(i))
        ]
    return _recordings(path, values, left, options, time_unit)


def _are_structs(values: Any) -> bool:
    return len(values) > 0 and all(isinstance(value, dict) for value in values)


def _recordings(
    path: Path,
    values: dict[str, Any],
    left: list[str],
    options: TableOptions,
    time_unit: str | None,
    label: str = "",
) -> list[Recording]:
    """The recordings of the variables of a file, or of a struct that is an episode."""
    leaves: dict[str, NDArray[Any]] = {}
    numbers: dict[str, Any] = {}
    for name, array in _leaves(values):
        fits = isinstance(array, np.ndarray) and array.dtype.kind in "biuf" and 0 < array.ndim <= 2
        fits = fits or (isinstance(array, np.ndarray) and array.dtype.kind in "SU")
        if fits and (array.ndim < 2 or min(array.shape) <= _WIDEST):
            leaves[name] = array
        else:
            numbers[name] = array
            left.append(name)
    if not leaves:
        raise FileFormatError(
            f"{path} holds no array of numbers; it has: {listed(left) or 'nothing'}; objects such "
            "as timeseries and table must be saved as arrays: t = x.Time; y = x.Data"
        )
    last = [name.rpartition("/")[2] for name in leaves]
    if options.rate_hz is None and options.time_column is None and time_column_of(last) is None:
        rate, note = rate_of({k: v for k, v in numbers.items() if isinstance(v, int | float)})
        options = replace(options, rate_hz=rate)
        made = recordings_of_groups(path, leaves, options, time_unit, left=left, label=label)
        return [replace(one, notes=(note, *one.notes[1:])) if note else one for one in made]
    return recordings_of_groups(path, leaves, options, time_unit, left=left, label=label)


def _load(path: Path) -> tuple[dict[str, Any], list[str]]:
    """The variables of a file, and the names of those that are objects."""
    from scipy.io import loadmat, whosmat

    try:
        listed_ = whosmat(path)
        size = path.stat().st_size
        need = 16 * sum(math.prod(map(abs, shape)) for _, shape, _ in listed_)
        if need > (1 << 26) and need > _RATIO * size:
            raise FileFormatError(
                f"{path} says that it holds {need // 16} numbers, far more than its {size} bytes "
                "can; copy it again"
            )
        require_memory(path, need, f"{need // 16} numbers")
        names = [name for name, _, kind in listed_ if kind not in _CLASSES and name]
        left = [name for name, _, kind in listed_ if kind in _CLASSES or not name]
        return loadmat(path, variable_names=names, simplify_cells=True), left
    except FileFormatError:
        raise
    except Exception as error:  # of SciPy about damaged files: of any kind
        raise FileFormatError(
            f"{path} can't be read as a MAT-file, it is truncated, damaged or of another format "
            f"({type(error).__name__}: {' '.join(str(error).split())[:100]}); copy it again"
        ) from None


def _leaves(values: Any, name: str = "", depth: int = 0) -> Iterator[tuple[str, Any]]:
    """The arrays in structs, by path."""
    if not isinstance(values, dict) or depth > _DEEPEST:
        yield name, np.asarray(values) if isinstance(values, np.ndarray) else values
        return
    for key, inner in values.items():
        if not key.startswith("__"):
            yield from _leaves(inner, f"{name}/{key}" if name else key, depth + 1)
