"""The times of an episode of HDF5: an array that is named like one, or two."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from offbeat.data.cleaning.clocks import (
    is_rest,
    join_stamp,
    split_stamps,
    time_column_of,
    time_unit_in,
)
from offbeat.data.readers.hdf5_file import check_storage, member
from offbeat.data.readers.stamp_columns import columns_in
from offbeat.errors import FileFormatError, InputError, listed, one_of


def times_of(
    episode: Any, leaves: Mapping[str, Any], path: Path, given: str | Sequence[str] | None
) -> dict[str, Any]:
    """The array of times by its name, or the two that hold the stamp together.

    It is the one given, else one that is named like a time.

    Raises:
        FileFormatError: the times are texts, or several pairs of arrays hold a stamp.
        InputError: the one given is unknown.
    """
    import h5py

    beside = {
        name: array
        for group in (episode, episode.get("infos", ()))
        for name in (group if isinstance(group, h5py.Group) else ())
        if isinstance(array := member(group, name, path), h5py.Dataset)
    }
    known = {**beside, **leaves}
    usual = [name for name, array in known.items() if array.shape[1:] in ((), (1,)) and array.ndim]
    pairs = _pairs({name: known[name] for name in usual}, path)
    if given is not None:
        parts = columns_in(given, list(known))
        for part in parts:
            one_of("time_column", part, known)
        if len(parts) == 2 and parts in pairs:
            return {part: known[part] for part in parts}
        if len(parts) != 1:
            raise InputError(
                f"{path}: time_column must name one array, or two with whole seconds and what is "
                f"left of each in ns, us or ms, got {listed(parts, quoted=True)}"
            )
        name = parts[0]
    else:
        name = time_column_of(usual) or ""
        together = [pair for pair in pairs if name in pair or not name]
        if len(together) > 1:
            shown = listed([f"[{one}, {two}]" for one, two in together], 3)
            raise FileFormatError(
                f"{path} has several stamps, each in two arrays: {shown}; say which one is the "
                "time with time_column="
            )
        if together:
            return {part: known[part] for part in together[0]}
    wide = [n for n, array in known.items() if array.shape[1:] == (2,) and time_column_of([n])]
    if not name and wide:
        raise FileFormatError(
            f"{path} has a stamp in the two columns of {known[wide[0]].name}; write it as one "
            "array of seconds or integer nanoseconds, or state rate_hz="
        )
    if not name:
        return {}
    if known[name].dtype.kind in "SOU" and known[name].ndim == 1:
        raise FileFormatError(
            f"{path} has times as text in {known[name].name}, expected numbers; write them as "
            "seconds or integer nanoseconds, or state rate_hz="
        )
    array = known[name]
    if (
        array.dtype.kind not in "iuf"
        or array.ndim not in (1, 2)
        or array.shape[1:] not in ((), (1,))
    ):
        if given is None:
            return {}
        raise FileFormatError(
            f"{path}: {array.name} has shape {array.shape} and type {array.dtype}, expected times"
        )
    return {name: array}


def _pairs(arrays: Mapping[str, Any], path: Path) -> list[tuple[str, str]]:
    """Pairs of arrays that hold a stamp together, as `sec` and `nanosec`."""
    found = []
    for one, two, unit in split_stamps(list(arrays)):
        both = arrays[one], arrays[two]
        if all(array.dtype.kind in "iuf" for array in both):
            for array in both:
                check_storage(array, path)
            whole, rest = (array[()].reshape(-1) for array in both)
            if is_rest(whole, rest, unit):
                found.append((one, two))
    return found


def clock_of(
    times: Mapping[str, Any], path: Path, unit: str | None
) -> tuple[tuple[str, NDArray[Any]], str | None]:
    """The name and the numbers of a clock, and their unit where it is known."""
    for array in times.values():
        check_storage(array, path)
    first, *rest = times
    if not rest:
        stated = times[first].attrs.get("units", times[first].attrs.get("unit", ""))
        stated = stated.decode("utf-8", "replace") if isinstance(stated, bytes) else stated
        return (first, times[first][()].reshape(-1)), unit or time_unit_in(f"t [{stated!s:.20}]")
    (_, _, of_rest), *_ = (
        pair for pair in split_stamps([*times]) if [*pair[:2]] == [first, rest[0]]
    )
    whole, left = (array[()].reshape(-1) for array in times.values())
    return (first, join_stamp(whole, left, of_rest)), "ns"
