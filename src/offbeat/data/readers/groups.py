"""Arrays in groups of groups, as plain HDF5 and MATLAB have them: a signal per clock."""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from offbeat.data.cleaning.clocks import may_be_time, split_stamps, split_unit, time_column_of
from offbeat.data.readers.arrays import recordings_of
from offbeat.data.readers.stamp_columns import columns_in
from offbeat.data.readers.table_options import TableOptions
from offbeat.data.recording import Recording
from offbeat.data.signals import Signal
from offbeat.errors import FileFormatError, NoLogError, listed, one_of

_QUATERNIONS = ("_quat", "/quat", "_quaternion", "/quaternion", "orientation_xyzw")

Leaves = Mapping[str, NDArray[Any]]
"""Arrays by path, such as `imu/acc`."""


def recordings_of_groups(
    path: Path,
    leaves: Leaves,
    options: TableOptions,
    time_unit: str | None = None,
    *,
    label: str = "",
    left: Sequence[str] = (),
) -> list[Recording]:
    """Recordings from arrays in groups.

    An array belongs to the times in its own group, else to those of the nearest group around it, if
    they are as long as it is; else to the only times of the file that are. The arrays of each array
    of times are a signal, named by the group of the times.

    Args:
        path: the file, for messages.
        leaves: the arrays; of a matrix, each column is a channel, `acc[0]`.
        options: `time_column` may be a path, or a name in every group.
        time_unit: of the times, or None.
        label: of the episode.
        left: names of what is left out already.

    Raises:
        FileFormatError: there are no times, or clocks that never meet.
        InputError: an option names an unknown array or unit.
    """
    if options.rate_hz is not None:
        rows = Counter(len(a) for a in leaves.values() if a.dtype.kind in "biuf")
        most = max(rows, key=lambda n: (rows[n], n), default=0)
        kept = {name: a for name, a in leaves.items() if len(a) == most}
        made = recordings_of(path, _columns(kept), options)
        return _noted(path, made, [*left, *(n for n in leaves if n not in kept)], label)
    clocks = _clocks(path, leaves, options.time_column)
    rows_of = {rows for rows, _ in clocks.values()}
    leaves, turned = _turned(leaves, rows_of)
    of_clock: dict[str, dict[str, NDArray[Any]]] = {group: {} for group in clocks}
    left = list(left)
    for name, array in leaves.items():
        group = _clock_of(name, array, clocks)
        if group is None:
            left.append(name)
        else:
            of_clock[group][name.removeprefix(f"{group}/") if group else name] = array
    parts = {g: a for g, a in of_clock.items() if len(a) > len(clocks[g][1])}
    if not parts:
        raise FileFormatError(
            f"{path} has no array with a row for each of the times in "
            f"{listed([_joined(g, n) for g in clocks for n in clocks[g][1]], quoted=True)}; it "
            f"has {listed([f'{n} {a.shape}' for n, a in leaves.items()])}"
        )
    parsed = {}
    for group, arrays in parts.items():
        chosen = replace(options, time_column=list(clocks[group][1]))
        parsed[group] = recordings_of(path, _columns(arrays), chosen, time_unit)
    made = next(iter(parsed.values())) if len(parsed) == 1 else [_merged(path, parsed)]
    return _noted(path, made, left, label, turned)


def _turned(leaves: Leaves, rows: set[int]) -> tuple[Leaves, list[str]]:
    """The arrays with a row per time, and the names of those that had a column per time."""
    turned = [
        name
        for name, array in leaves.items()
        if array.ndim == 2 and len(array) not in rows and array.shape[1] in rows
    ]
    return {n: array.T if n in turned else array for n, array in leaves.items()}, turned


def _joined(group: str, name: str) -> str:
    return f"{group}/{name}" if group else name


def _clocks(path: Path, leaves: Leaves, given: Any) -> dict[str, tuple[int, tuple[str, ...]]]:
    """The groups that have times: their number, and the names of one array or two."""
    of_group: dict[str, list[str]] = {}
    for name, array in leaves.items():
        if array.ndim == 1:
            group, _, last = name.rpartition("/")
            of_group.setdefault(group, []).append(last)
    if isinstance(given, str) and given in leaves:
        group, _, last = given.rpartition("/")
        return {group: (len(leaves[given]), (last,))}
    found: dict[str, tuple[int, tuple[str, ...]]] = {}
    for group, names in of_group.items():
        if given is not None:
            parts = columns_in(given, names)
            stamp = parts if set(parts) <= set(names) else ()
        else:
            usual = time_column_of(names)
            pairs = split_stamps(names)
            pair = next((p[:2] for p in pairs if usual in p[:2] or usual is None), None)
            stamp = pair or ((usual,) if usual is not None else ())
        if stamp:
            found[group] = (len(leaves[_joined(group, stamp[0])]), tuple(stamp))
    if not found and given is None:  # one that is named like a time, and increases
        for group, names in of_group.items():
            likely = [n for n in names if may_be_time(n) and _grows(leaves[_joined(group, n)])]
            if len(likely) == 1:
                found[group] = (len(leaves[_joined(group, likely[0])]), (likely[0],))
    if not found and given is not None:
        one_of("time_column", str(given), list(leaves))
    if not found:
        raise NoLogError(
            f"{path} has no array of times (called time, t, timestamp, ...), got "
            f"{listed(list(leaves), 12, quoted=True)}; name one with time_column=, or give "
            "rate_hz="
        )
    return found


def _grows(array: NDArray[Any]) -> bool:
    numbers = array.dtype.kind in "iuf" and len(array) > 1
    return numbers and bool((np.diff(array[:1000].astype(np.float64)) > 0).all())


def _clock_of(
    name: str, array: NDArray[Any], clocks: Mapping[str, tuple[int, tuple[str, ...]]]
) -> str | None:
    """The group whose times an array has."""
    group = name
    while group:
        group = group.rpartition("/")[0]
        if group in clocks and clocks[group][0] == len(array):
            return group
    fitting = [group for group, (rows, _) in clocks.items() if rows == len(array)]
    return fitting[0] if len(fitting) == 1 else None


def _columns(arrays: Leaves) -> dict[str, NDArray[Any]]:
    """A column per channel: those of a matrix are numbered."""
    found: dict[str, NDArray[Any]] = {}
    for name, array in arrays.items():
        if array.ndim == 1:
            found[name] = array
            continue
        short, unit = split_unit(name)
        unit = f" [{unit}]" if unit else ""
        for i, column in enumerate(array.reshape(len(array), -1).T):
            found[f"{short}[{i}]{unit}"] = column
    return found


def _merged(path: Path, parsed: Mapping[str, list[Recording]]) -> Recording:
    """One recording of several clocks, each with a signal."""
    for group, made in parsed.items():
        if len(made) != 1:
            raise FileFormatError(
                f"{path} holds {len(made)} episodes in {group!r} and other clocks beside them; "
                "choose one part with keys="
            )
    ones = {group: made[0] for group, made in parsed.items()}
    spans = {
        group: (one.signals[0].stamps.min(), one.signals[0].stamps.max())
        for group, one in ones.items()
        if len(one.signals[0].stamps)
    }
    for (a, (low, high)), (b, (low_b, high_b)) in itertools.combinations(spans.items(), 2):
        if low > high_b or low_b > high:
            raise FileFormatError(
                f"{path} has clocks that never meet, in {a!r} and {b!r}; choose one with keys=, or "
                "name a common clock with time_column="
            )
    if len({one.clock_zero for one in ones.values()}) > 1:
        raise FileFormatError(f"{path} has clocks of different zeros; choose one with keys=")
    first = next(iter(ones.values()))
    units = {one.time_unit for one in ones.values()}
    return replace(
        first,
        signals=tuple(
            replace(signal, name=group.replace("/", "."))
            for group, one in ones.items()
            for signal in one.signals
        ),
        time_unit=first.time_unit if len(units) == 1 else "ns",
        notes=tuple(dict.fromkeys(note for one in ones.values() for note in one.notes)),
        unit_found=any(one.unit_found for one in ones.values()),
        left_out=tuple(name for one in ones.values() for name in one.left_out),
    )


def _noted(
    path: Path,
    made: list[Recording],
    left: list[str],
    label: str,
    turned: Sequence[str] = (),
) -> list[Recording]:
    """Recordings with actions, a label, and a note on what was left out."""
    why = "they are no numbers, or no times have as many rows"
    notes = [f"left out, as {why}: {listed(left)}"] if left else []
    if turned:
        notes.append(f"arrays with a column per time are turned: {listed(turned, quoted=True)}")
    return [
        replace(
            one,
            signals=tuple(map(_with_kinds, one.signals)),
            label="/".join(filter(None, (label, one.label))),
            origin=f"{path.name}, {label}" if label else one.origin,
            notes=(*one.notes, *notes),
            left_out=(*one.left_out, *left),
        )
        for one in made
    ]


_SLOWEST_HZ = 1e-3  # a smaller one is no rate: the number is something else
RATES = ("rate_hz", "rate", "sample_rate", "sampling_rate", "sampling_frequency", "fs", "hz",
         "fps", "frequency", "control_freq")  # fmt: skip
STEPS = ("dt", "timestep", "time_step", "sample_time", "sampling_time", "ts")
"""Names of numbers that say how many rows a second there are, or how many seconds a step takes."""


def rate_of(numbers: Mapping[str, Any]) -> tuple[float | None, str]:
    """The rate in single numbers by name, and a note on it; None if they say none."""
    for name, value in numbers.items():
        number = np.asarray(value)
        if number.size != 1 or number.dtype.kind not in "iuf":
            continue
        found = float(number.reshape(()))
        last = name.rpartition("/")[2].casefold()
        rate = found if last in RATES else 1 / found if last in STEPS and found > 0 else 0.0
        if _SLOWEST_HZ <= rate <= 1e9:
            return rate, f"stamps are row number / {rate:g} Hz, as {name!r} says"
    return None, ""


def _with_kinds(signal: Signal) -> Signal:
    """A signal whose channels of actions have that role, and those of quaternions that kind."""
    bases = [name.rpartition("[")[0] for name in signal.channels]
    kinds = tuple(
        "quaternion" if bases.count(base) == 4 and base.endswith(_QUATERNIONS) else kind
        for base, kind in zip(bases, signal.kinds, strict=True)
    )
    signal = replace(signal, kinds=kinds)
    first = [name.replace("[", "/").replace(".", "/").split("/")[0] for name in signal.channels]
    roles = tuple("action" if name in ("action", "actions") else "state" for name in first)
    return replace(signal, roles=roles)
