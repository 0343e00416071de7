"""HDF5 of robomimic and of Minari, through `h5py`: a recording per episode.

robomimic (robomimic.github.io, "Dataset structure"): `data/demo_0/obs/<name>` and
`data/demo_0/actions`, the environment as JSON in the attribute `env_args` of `data`, named subsets
under `mask`. Minari (minari.farama.org, "Dataset standards"): `episode_0/observations`, one row
longer than `episode_0/actions`, nested where the space is a dictionary or a tuple; the environment
as JSON in `metadata.json` in the same folder, or in an attribute of it. Neither stores times.

Only arrays of numbers are read; pickled data are refused.
"""

from __future__ import annotations

import itertools
import json
import math
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from offbeat.data.cleaning.clocks import (
    split_stamps,
    state_time_unit,
    time_column_of,
    to_nanoseconds,
)
from offbeat.data.cleaning.odd_clocks import without_wraps
from offbeat.data.cleaning.options import is_number
from offbeat.data.readers.hdf5_file import (
    check_storage,
    leaves_of,
    member,
    opened,
    refuse_objects,
    superblock_at,
    texts_in,
    what_is,
)
from offbeat.data.readers.hdf5_plain import plain_recordings
from offbeat.data.readers.hdf5_times import clock_of, times_of
from offbeat.data.readers.options import names
from offbeat.data.signals import Recording, Signal
from offbeat.data.source import require_file
from offbeat.errors import FileFormatError, InputError, listed, one_of, require

SUFFIXES = (".hdf5", ".h5", ".hdf", ".mat")

WIDEST = 1024
"""Arrays with at least this many numbers per row are treated as images or maps, and left out."""

_MOST_ARRAYS = 10_000
_EPISODE = re.compile(r"(?:demo|episode)_(\d+)")
_MAIN = ("data/main_data.hdf5", "main_data.hdf5")


def recognises(path: Path) -> bool:
    """Whether a file has the signature of HDF5, or a folder is a data set of Minari."""
    if path.is_dir():
        return any((path / name).is_file() for name in _MAIN)
    return superblock_at(path) is not None


def recordings(
    path: str | Path,
    *,
    keys: Sequence[str] | None = None,
    include_actions: bool = True,
    mask: str | None = None,
    rate_hz: float | None = None,
    time_column: str | Sequence[str] | None = None,
    time_unit: str | None = None,
) -> Iterator[Recording]:
    """Reads HDF5 of robomimic or Minari: a recording per episode, in the order of their numbers.

    Args:
        path: the file, or the folder of a Minari data set.
        keys: the observations to read, such as `robot0_eef_pos`, or `achieved_goal` in Minari; by
            default all numeric ones except images.
        include_actions: whether actions are read; their channels have the role `action`.
        mask: robomimic's name of a subset of the episodes, such as `train`.
        rate_hz: rows per second. By default that of the environment, if the file has it; else
            rows are assumed to be 1 s apart, which is noted.
        time_column: array of the times, among the observations or beside them, such as
            `timestamps`, or two that hold the stamp together, as `[sec, nanosec]`; by default found
            by their names, such as `time` or `stamp`.
        time_unit: unit of those times; by default from their name, else detected.

    Yields:
        Recordings; an observation `<name>_quat` of four numbers is a quaternion.

    Raises:
        FileFormatError: the file is truncated, damaged, of another layout, or holds pickled
            objects where numbers are expected.
        InputError: a key or a mask is unknown, or the rate is not above 0.
        MissingExtraError: `h5py` is not installed.
    """
    require("h5py", "hdf5")
    keys = names("keys", keys)
    if rate_hz is not None and not (is_number(rate_hz) and 0 < rate_hz <= 1e9):
        raise InputError(f"rate_hz must be rows per second, above 0, got {rate_hz!r}")
    if not isinstance(include_actions, bool):
        raise InputError(f"include_actions must be True or False, got {include_actions!r}")
    if time_column is not None and rate_hz is not None:
        raise InputError("give time_column or rate_hz, not both")
    path = Path(path)
    if path.is_dir():
        inside = [path / name for name in _MAIN if (path / name).is_file()]
        if not inside:
            raise FileFormatError(f"{path} holds no {_MAIN[0]}, expected a data set of Minari")
        path = inside[0]
    path = require_file(path)
    with opened(path) as file:
        below = any(map(_EPISODE.fullmatch, _names_in(file, "data")))
        root = file["data"] if below else file
        robomimic = below or any(
            "obs" in _names_in(root, name) for name in root if _EPISODE.fullmatch(name)
        )
        episodes = sorted(
            (name for name in root if _EPISODE.fullmatch(name)),
            key=lambda name: int(name.rpartition("_")[2]),
        )
        if mask is None and (not episodes or not (robomimic or _are_learned(root, episodes))):
            yield from plain_recordings(
                file, path, keys=keys, include_actions=include_actions, rate_hz=rate_hz,
                time_column=time_column, time_unit=time_unit,
            )  # fmt: skip
            return
        if mask is not None:
            episodes = _masked(file, mask, episodes, path)
        rate, notes = _rate(root, path, rate_hz, robomimic=robomimic)
        timed: dict[bool, str] = {}
        for name in episodes:
            observations = _observations(root[name], path, robomimic=robomimic)
            made = _episode(
                root[name], observations, path, notes,
                keys=keys, actions=include_actions, rate=rate,
                time_column=time_column, time_unit=time_unit, given_rate=rate_hz is not None,
            )  # fmt: skip
            if made.signals:
                timed.setdefault(
                    any(n.startswith("stamps are the array") for n in made.notes), name
                )
            if len(timed) > 1:
                raise FileFormatError(
                    f"{path} has times in {timed[True]} and none in {timed[False]}; state rate_hz= "
                    "for all, or leave out those without times"
                )
            yield made


_TIMED = ("stamps are the array", "stamps are joined")  # notes of episodes that have times


def _names_in(node: Any, name: str) -> list[str]:
    """The names in a group of a group; none if it is no group."""
    import h5py

    inner = node.get(name)
    return list(inner) if isinstance(inner, h5py.Group) else []


def _are_learned(root: Any, episodes: list[str]) -> bool:
    """Whether groups are episodes of Minari, which have observations or actions."""
    return any({"observations", "actions"} & {*_names_in(root, name)} for name in episodes[:2])


def _masked(file: Any, mask: str, names: list[str], path: Path) -> list[str]:
    masks = list(file["mask"]) if "mask" in file else []
    if not masks:
        raise InputError(f"{path} has no masks, leave mask out")
    listed = file["mask"][one_of(f"mask of {path.name}", mask, masks)]
    check_storage(listed, path)
    if listed.dtype.kind not in "SO":
        raise FileFormatError(f"{path}: the mask {mask!r} holds {listed.dtype}, expected names")
    chosen = {text.decode() if isinstance(text, bytes) else str(text) for text in listed[()]}
    return [name for name in names if name in chosen]


def _rate(
    root: Any, path: Path, given: float | None, *, robomimic: bool
) -> tuple[float, tuple[str, ...]]:
    """Rows per second, and a note on them."""
    if given is not None:
        return given, (f"stamps are row number / {given:g} Hz, as rate_hz says",)
    layout = "robomimic" if robomimic else "Minari"
    found = _control_hz(root) if robomimic else None
    if found is not None:
        return found, (
            f"stamps are row number / {found:g} Hz, the environment's control_freq; {layout} "
            "stores no times",
        )
    return 1.0, (
        f"rows are taken to be 1 s apart: {layout} stores no times, and {path.name} has no "
        "rate; state it with rate_hz",
    )


def _control_hz(root: Any) -> float | None:
    try:
        rate = json.loads(root.attrs["env_args"])["env_kwargs"]["control_freq"]
    except (KeyError, TypeError, ValueError, RecursionError, OSError):
        return None
    return float(rate) if is_number(rate) and 0 < rate <= 1e9 else None


def _observations(episode: Any, path: Path, *, robomimic: bool) -> Any:
    inside = "obs" if robomimic else "observations"
    if inside not in episode:
        why = (
            "extract them from its states with robomimic's dataset_states_to_obs.py"
            if robomimic
            else "write it with Minari again"
        )
        raise FileFormatError(f"{path}: {episode.name} has no {inside}; {why}")
    return episode[inside]


def _episode(
    episode: Any,
    observations: Any,
    path: Path,
    notes: tuple[str, ...],
    *,
    keys: Sequence[str] | None,
    actions: bool,
    rate: float,
    time_column: str | Sequence[str] | None,
    time_unit: str | None,
    given_rate: bool,
) -> Recording:
    leaves = dict(itertools.islice(leaves_of(observations, "", path), _MOST_ARRAYS))
    times = {} if given_rate else times_of(episode, leaves, path, time_column)
    if keys is not None:
        known = {name for leaf in leaves for name in _prefixes(leaf)}
        for key in keys:
            one_of(f"key of {path.name}", key, known)
    left: list[str] = []
    arrays: dict[str, NDArray[np.float64]] = {}
    clock: tuple[str, NDArray[Any]] | None = None
    if times:
        clock, time_unit = clock_of(times, path, time_unit)
    whole = [name for name, dataset in leaves.items() if dataset.dtype.kind in "iu"]
    in_pairs = {name for one, two, _ in split_stamps(whole) for name in (one, two)}
    for name, dataset in leaves.items():
        chosen = keys is not None and any(key in keys for key in _prefixes(name))
        if keys is not None and not chosen:
            continue
        if name in times and not chosen:
            continue
        refuse_objects(dataset, path)
        width = math.prod(dataset.shape[1:]) if dataset.shape else 0
        if dataset.dtype.kind not in "biuf" or not dataset.ndim:
            left.append(f"{name} ({what_is(dataset)})")
        elif not chosen and (width > WIDEST or dataset.ndim > 3):
            left.append(f"{name} ({' x '.join(map(str, dataset.shape[1:]))})")
        elif width == 1 and not chosen and (name in in_pairs or time_column_of([name])):
            left.append(f"{name} (a time)")
        elif width:
            check_storage(dataset, path)
            arrays[name] = np.asarray(dataset[()], dtype=np.float64).reshape(len(dataset), width)
    if not arrays:
        raise FileFormatError(
            f"{path}: {episode.name} holds no observations that are numbers; it has: "
            f"{listed(list(leaves)) or 'none'}"
        )
    rows = {name: len(values) for name, values in arrays.items()}
    if len(set(rows.values())) > 1 or (clock and len(clock[1]) not in rows.values()):
        raise FileFormatError(
            f"{path}: observations of {episode.name} differ in their rows: "
            + listed([f"{name} {n}" for name, n in rows.items()])
        )
    n = next(iter(rows.values()))
    label = episode.name.rpartition("/")[2]
    if not n:
        return Recording((), label, f"{path.name}, {label}",
                         notes=(f"{label} has no rows and is left out",))  # fmt: skip
    found = False
    if clock:
        unit, more, found = state_time_unit(
            time_unit, clock[0] if len(times) == 1 else "", clock[1], str(path)
        )
        numbers, wraps = without_wraps(clock[1])
        more = (*more, wraps) if wraps else more
        try:
            stamps, zero = to_nanoseconds(numbers, unit)
        except FileFormatError as error:
            raise FileFormatError(f"{path}: {clock[0]!r} of {label}: {error}") from None
        joined = len(times) == 2
        what = (
            f"joined from the arrays {listed([*times], quoted=True)}"
            if joined
            else f"the array {clock[0]!r}"
        )
        notes = (f"stamps are {what}", *more)
    else:
        unit, zero = "s", 0
        stamps = np.rint(np.arange(n) * (1e9 / rate)).astype(np.int64)
    if left:
        notes = (*notes, f"left out: {', '.join(left)}")
    called = {name: _names(name, values.shape[1], leaves[name]) for name, values in arrays.items()}
    units = [unit for name, names in called.items() for unit in _units(leaves[name], len(names))]
    kinds = [kind for name, channels in called.items() for kind in _kinds(name, channels)]
    parts = list(arrays.values())
    states = [channel for channels in called.values() for channel in channels]
    acted: list[str] = []
    if actions:
        values, acted, acted_units, more = _actions(episode, path, n)
        parts += values
        units += acted_units
        notes = (*notes, *more)
    signal = Signal(
        "",
        stamps,
        np.hstack(parts),
        (*states, *acted),
        units=tuple(units),
        kinds=(*kinds, *[""] * len(acted)),
        roles=("state",) * len(states) + ("action",) * len(acted),
    )
    return Recording(
        (signal,),
        label=label,
        origin=f"{path.name}, {label}",
        time_unit=unit,
        notes=notes,
        clock_zero=zero,
        unit_found=found,
        left_out=tuple(name.partition(" ")[0] for name in left),
    )


def _prefixes(path: str) -> Iterator[str]:
    parts = path.split("/")
    for i in range(len(parts)):
        yield "/".join(parts[: i + 1])


def _names(name: str, width: int, array: Any) -> list[str]:
    """The names of an array's columns: those in its attribute `names`, else numbers."""
    given = texts_in(array, "names", width)
    if given is not None and len(set(given)) == width and all(given):
        return given
    if not name:  # all observations are one array
        return [f"observation[{i}]" for i in range(width)]
    return [name] if width == 1 else [f"{name}[{i}]" for i in range(width)]


def _units(array: Any, width: int) -> list[str]:
    """The units of an array's columns, in its attribute `units`; else empty."""
    return texts_in(array, "units", width) or [""] * width


def _kinds(name: str, channels: list[str]) -> list[str]:
    whole = len(channels) == 4 and name.endswith(("_quat", "/quat", "_quaternion"))
    return ["quaternion" if whole else ""] * len(channels)


def _actions(
    episode: Any, path: Path, rows: int
) -> tuple[list[NDArray[np.float64]], list[str], list[str], tuple[str, ...]]:
    """Values, names and units of the actions, one per row of the observations, and notes."""
    if "actions" not in episode:
        return [], [], [], ("there are no actions",)
    parts: list[NDArray[np.float64]] = []
    channels: list[str] = []
    units: list[str] = []
    for name, dataset in leaves_of(member(episode, "actions", path), "", path):
        refuse_objects(dataset, path)
        check_storage(dataset, path)
        if dataset.dtype.kind not in "biuf" or not dataset.ndim:
            return [], [], [], (f"actions are left out, they hold {what_is(dataset)}",)
        values = np.asarray(dataset[()], dtype=np.float64)
        parts.append(values.reshape(len(values), math.prod(values.shape[1:])))
        start, width = f"action.{name}" if name else "action", parts[-1].shape[1]
        given = texts_in(dataset, "names", width)
        channels += given or [f"{start}[{i}]" for i in range(width)]
        units += _units(dataset, width)
    if not parts or len({len(part) for part in parts}) > 1 or len(parts[0]) not in (rows, rows - 1):
        raise FileFormatError(
            f"{path}: {episode.name} has {[len(part) for part in parts]} actions for {rows} "
            "observations, expected as many or one less; read it without, with "
            "include_actions=False"
        )
    if len(parts[0]) == rows or rows == 1:
        return (parts, channels, units, ()) if len(parts[0]) else ([], [], [], ())
    last = [np.vstack([part, part[-1:]]) for part in parts]
    return (
        last,
        channels,
        units,
        ("the last observation has no action; that of the row before is used",),
    )
