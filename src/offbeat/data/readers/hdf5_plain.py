"""HDF5 of any other layout: arrays beside their times, ALOHA, D4RL, MATLAB 7.3, tables.

ALOHA (github.com/tonyzhaozh/aloha) writes an episode a file: `observations/qpos`, pictures and
`action`. D4RL writes all of them one after the other: `observations`, `actions`, and at the end of
each episode one of `terminals` and `timeouts`. Neither stores times. MATLAB stores the axes of
arrays in reverse order, and each field of a struct in a group.
"""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from offbeat.data.cleaning.clocks import time_column_of
from offbeat.data.readers.groups import rate_of, recordings_of_groups
from offbeat.data.readers.hdf5_file import (
    check_storage,
    leaves_of,
    member,
    refuse_objects,
    texts_in,
    what_is,
)
from offbeat.data.readers.table_options import TableOptions
from offbeat.data.recording import Recording
from offbeat.errors import FileFormatError, listed, one_of

_WIDEST = 1024
_MOST_ARRAYS = 10_000
_EPISODES = re.compile(
    r"(episode|ep|demo|traj|trajectory|rollout|trial|run|recording|session|sequence|seq|take|test)?"
    r"[ _-]?(\d{1,9})",
    re.IGNORECASE,
)
"""Names of groups that hold an episode each."""

_ENDS = ("terminals", "timeouts", "terminal", "timeout", "terminations", "truncations", "dones",
         "done")  # fmt: skip
_BESIDE = (*_ENDS, "rewards", "reward", "next_observations", "infos", "metadata", "discounts")
"""Arrays of D4RL that are no states."""

_LABEL = "episode"


def plain_recordings(
    file: Any,
    path: Path,
    *,
    keys: Sequence[str] | None,
    include_actions: bool,
    rate_hz: float | None,
    time_column: str | Sequence[str] | None,
    time_unit: str | None,
) -> Iterator[Recording]:
    """Recordings of a file that is neither robomimic's nor Minari's.

    Args:
        file: the open file.
        path: its path.
        keys: groups and arrays that are read, by path or name; by default all.
        include_actions: whether actions are read.
        rate_hz: as of `hdf5.recordings`.
        time_column: as of `hdf5.recordings`.
        time_unit: as of `hdf5.recordings`.

    Raises:
        FileFormatError: there are no times and no rate, or no array of numbers.
        InputError: a key is unknown.
    """
    if any("pandas_type" in node.attrs for node in (file, *_groups(file, path))):
        raise FileFormatError(
            f"{path} was written by DataFrame.to_hdf of pandas, which pickles a part of it; write "
            "it with DataFrame.to_parquet"
        )
    root, episodes = _episodes(file, path)
    for name in episodes or ("",):
        leaves, left = _arrays(member(root, name, path) if name else root, path, keys)
        if not include_actions:
            leaves = {n: a for n, a in leaves.items() if _top(n) not in ("action", "actions")}
        if not leaves:
            raise FileFormatError(
                f"{path} holds no array of numbers{f' in {name}' if name else ''}; it has: "
                f"{listed(left) or 'nothing'}"
            )
        rate, note = rate_hz, ""
        if rate_hz is None and time_column is None and not _has_times(leaves):
            rate, note = _rate_in(file, member(root, name, path) if name else root)
        for made in _recordings(path, leaves, left, name, rate, time_column, time_unit):
            yield replace(made, notes=(note, *made.notes[1:])) if note else made


def _recordings(
    path: Path,
    leaves: dict[str, NDArray[Any]],
    left: list[str],
    label: str,
    rate_hz: float | None,
    time_column: str | Sequence[str] | None,
    time_unit: str | None,
) -> Iterator[Recording]:
    """The recordings of one group of episodes."""
    notes: list[str] = []
    learned = any(_top(name) == "observations" for name in leaves)
    if learned:
        labels = _labels(leaves)
        beside = [name for name in leaves if _top(name) in _BESIDE]
        left = [*left, *beside]
        for name in beside:
            del leaves[name]
        if labels is not None:
            leaves[_LABEL] = labels
        short = {name.removeprefix("observations/"): name for name in leaves}
        if len(short) == len(leaves):
            leaves = {name: leaves[full] for name, full in short.items()}
        if rate_hz is None and time_column is None and not _has_times(leaves):
            rate_hz = 1.0
            notes.append(
                "rows are taken to be 1 s apart: the file has no times and no rate; state it with "
                "rate_hz"
            )
    options = TableOptions(time_column=time_column, rate_hz=rate_hz)
    for made in recordings_of_groups(path, leaves, options, time_unit, label=label):
        stated = [n for n in made.notes if not (notes and n.startswith("stamps are row number"))]
        more = [f"left out: {listed(left)}"] if left else []
        yield _replaced(made, (*notes, *stated, *more), left)


def _replaced(made: Recording, notes: tuple[str, ...], left: list[str]) -> Recording:
    gone = [name.partition(" ")[0] for name in left]
    return replace(made, notes=notes, left_out=(*made.left_out, *gone))


def _rate_in(*nodes: Any) -> tuple[float | None, str]:
    """The rate in attributes or single numbers of groups, or of what is in them, and a note."""
    import h5py

    inside = [one for node in nodes for one in node.values() if hasattr(one, "attrs")]
    for node in (*nodes, *inside[:_MOST_ARRAYS]):
        numbers = {
            name: value[()]
            for name, value in (node.items() if isinstance(node, h5py.Group) else ())
            if isinstance(value, h5py.Dataset) and value.size == 1 and value.dtype.kind in "iuf"
        }
        rate, note = rate_of({**numbers, **dict(node.attrs)})
        if rate is not None:
            return rate, note
    return None, ""


def _has_times(leaves: Mapping[str, NDArray[Any]]) -> bool:
    last = [name.rpartition("/")[2] for name, array in leaves.items() if array.ndim == 1]
    return time_column_of(last) is not None


def _top(name: str) -> str:
    return name.partition("/")[0]


def _labels(leaves: Mapping[str, NDArray[Any]]) -> NDArray[np.int64] | None:
    """The number of the episode of each row, from the marks of their last rows; or None."""
    ends = [array.reshape(-1) != 0 for name, array in leaves.items() if name in _ENDS]
    rows = next(len(array) for name, array in leaves.items() if _top(name) == "observations")
    ends = [end for end in ends if len(end) == rows]
    if not ends:
        return None
    last = np.logical_or.reduce(ends)
    return np.cumsum(np.concatenate([[False], last[:-1]])).astype(np.int64)


def _groups(node: Any, path: Path) -> list[Any]:
    """The groups in a group."""
    import h5py

    found = (member(node, name, path) for name in itertools.islice(node, _MOST_ARRAYS)
             if not name.startswith("#"))  # fmt: skip
    return [inner for inner in found if isinstance(inner, h5py.Group)]


def _episodes(file: Any, path: Path) -> tuple[Any, list[str]]:
    """The group that holds groups of an episode each, and their names; none if there are none."""
    node = file
    for _ in range(5):
        groups = _groups(node, path)
        names = [group.name.rpartition("/")[2] for group in groups]
        matches = [_EPISODES.fullmatch(name) for name in names]
        stems = {match[1] for match in matches if match}
        if groups and all(matches) and len(stems) == 1:
            order = {
                name: int(match[2]) for name, match in zip(names, matches, strict=True) if match
            }
            return node, sorted(names, key=order.__getitem__)
        if len(groups) != 1 or len(node) != 1:
            return file, []
        node = groups[0]
    return file, []


def _arrays(
    node: Any, path: Path, keys: Sequence[str] | None
) -> tuple[dict[str, NDArray[Any]], list[str]]:
    """The arrays of numbers and times below a group, by path, and what is left out."""
    found: dict[str, NDArray[Any]] = {}
    left: list[str] = []
    every = dict(itertools.islice(leaves_of(node, "", path), _MOST_ARRAYS))
    for key in keys or ():
        one_of(f"key of {path.name}", key, {p for name in every for p in _called(name)})
    for name, dataset in every.items():
        last = name.rpartition("/")[2]
        wanted = keys is None or any(key in _called(name) for key in keys)
        if name.startswith("#") or not (wanted or time_column_of([last])):
            continue
        refuse_objects(dataset, path)
        why = _is_left(dataset)
        if why:
            left.append(f"{name} ({why})")
            continue
        check_storage(dataset, path)
        values = _values(dataset)
        if values.dtype.names:
            found |= {f"{name}/{field}": values[field] for field in values.dtype.names}
        elif values.ndim == 2 and (named := _names_of(dataset, values.shape[1])):
            found |= {f"{name}/{n}": values[:, i] for i, n in enumerate(named)}
        else:
            found[_with_unit(name, dataset)] = values
    tops = {_top(name) for name in found}
    if len(tops) == 1 and all("/" in name for name in found):
        (top,) = tops - {"observations", "action", "actions"} or {""}
        found = {name.removeprefix(f"{top}/"): array for name, array in found.items()}
    return found, left


def _is_left(dataset: Any) -> str:
    """Why an array is left out; empty if it may hold channels, or times."""
    kind = dataset.dtype
    fields = kind.names or ()
    numbers = kind.kind in "biuf" or (
        fields and all(kind[field].kind in "biuf" for field in fields)
    )
    text = what_is(dataset) == "text"
    if not dataset.ndim or not (numbers or (text and dataset.ndim == 1)):
        return what_is(dataset)
    if _is_matlab(dataset) and dataset.attrs["MATLAB_class"] in (b"char", "char"):
        return "text"
    sides = dataset.shape[1:]
    width = min(dataset.shape) if _is_matlab(dataset) and sides else math.prod(sides)
    return "" if 0 < width <= _WIDEST and dataset.ndim <= 3 else " x ".join(map(str, sides))


def _values(dataset: Any) -> NDArray[Any]:
    """An array with a row per time."""
    if what_is(dataset) == "text":
        return np.asarray(dataset.asstr(errors="replace")[()]).astype(str)
    values = np.asarray(dataset[()])
    values = values.T if _is_matlab(dataset) else values
    return values.reshape(-1) if values.ndim == 2 and 1 in values.shape else values


def _is_matlab(dataset: Any) -> bool:
    return "MATLAB_class" in dataset.attrs


def _names_of(dataset: Any, width: int) -> list[str]:
    """The names of the columns of a matrix, in one of its attributes; none if it has none."""
    for attribute in ("names", "columns", "channels", "labels", "fields"):
        named = texts_in(dataset, attribute, width)
        if named and len(set(named)) == width and all(named):
            return [name.replace("/", ".") for name in named]
    return []


def _with_unit(name: str, dataset: Any) -> str:
    """A name with the unit in the attribute `units` or `unit`, in brackets."""
    for attribute in ("units", "unit"):
        try:
            unit = dataset.attrs.get(attribute)
        except (OSError, TypeError, ValueError):
            return name
        unit = unit.decode("utf-8", "replace") if isinstance(unit, bytes) else unit
        if isinstance(unit, str) and 0 < len(unit) <= 20 and unit.isprintable():
            return f"{name} [{unit}]"
    return name


def _called(path: str) -> list[str]:
    """What an array is called: its path, those of its groups, and its name."""
    parts = path.split("/")
    return [*("/".join(parts[: i + 1]) for i in range(len(parts))), parts[-1]]
