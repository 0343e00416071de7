"""Conversion of data sets from and to pandas."""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from typing import Any

import numpy as np

from offbeat.data.arrays import hand_over
from offbeat.data.trajectory import Dataset, Trajectory
from offbeat.errors import InputError, MissingExtraError, one_of


def to_pandas(dataset: Dataset) -> Any:
    """Converts a data set to a data frame.

    A value is NaN where it is not observed, as `from_pandas` reads it. Values that are known and
    masked are lost; units and roles are in the frame's `attrs`.

    Args:
        dataset: the data set.

    Returns:
        A `pandas.DataFrame`; `trajectory` counts from 0, `time` is in seconds.

    Raises:
        InputError: a channel is called `trajectory` or `time`.
        MissingExtraError: pandas is not installed.
    """
    pandas = _pandas()
    for name in ("trajectory", "time"):
        if name in dataset.names:
            raise InputError(f"a channel is called {name!r}, as a column of the frame; rename it")
    values = np.concatenate([np.where(t.observed, t.values, np.nan) for t in dataset])
    frame = pandas.DataFrame(values, columns=list(dataset.names))
    frame.insert(0, "time", np.concatenate([t.times for t in dataset]))
    frame.insert(0, "trajectory", np.repeat(np.arange(len(dataset)), [t.rows for t in dataset]))
    frame.attrs["units"] = dict(zip(dataset.names, dataset.units, strict=True))
    frame.attrs["roles"] = dict(zip(dataset.names, dataset.roles, strict=True))
    return frame


def from_pandas(
    frame: Any,
    *,
    time: str = "time",
    by: str | None = None,
    units: Mapping[str, str] | None = None,
    roles: Mapping[str, str] | None = None,
) -> Dataset:
    """Converts a data frame with a row per time to a data set.

    Args:
        frame: a `pandas.DataFrame`; all columns except `time` and `by` are numeric channels.
        time: column of times: seconds, or time stamps or durations of pandas.
        by: column with the trajectory of each row; by default `trajectory` where there
            is one, else the frame is one trajectory. Trajectories are in the order of their first
            rows.
        units: unit by channel; by default those of `frame.attrs["units"]`, else empty.
        roles: role by channel; by default those of `frame.attrs["roles"]`, else `state`.

    Returns:
        The data set; its times are those of the frame if they are numbers, and count from the
        first row of each trajectory if they are time stamps.

    Raises:
        InputError: a column is missing or holds no numbers, or times do not increase strictly
            within a trajectory.
        MissingExtraError: pandas is not installed.
    """
    _pandas()
    columns = list(frame.columns)
    one_of("column of times", time, columns)
    if by is None and "trajectory" in columns and time != "trajectory":
        by = "trajectory"
    if by is not None:
        one_of("column of trajectories", by, columns)
    names = [name for name in columns if name not in (time, by)]
    described: list[tuple[str, ...]] = []
    for key, given, default in (("units", units, ""), ("roles", roles, "state")):
        for name in given or {}:
            one_of(f"channel in {key}", name, names)
        found = {**frame.attrs.get(key, {}), **(given or {})}
        described.append(tuple(found.get(name, default) for name in names))
    clock, nanoseconds = _clock(frame[time], time)
    try:
        values = frame[names].to_numpy(dtype=np.float64, na_value=np.nan)
    except (TypeError, ValueError) as error:
        raise InputError(f"the channels {names} of the frame must be numbers: {error}") from None
    rows = [np.arange(len(frame))]
    if by is not None:
        rows = list(frame.groupby(by, sort=False, dropna=False).indices.values())
        rows = sorted((np.sort(index) for index in rows), key=lambda index: int(index[0]))
    return Dataset(
        tuple(
            Trajectory.from_arrays(
                clock[index],
                hand_over(values[index]),
                time_unit="ns" if nanoseconds else "s",
                names=tuple(map(str, names)),
                units=described[0],
                roles=described[1],
            )
            for index in rows
        )
    )


def _pandas() -> Any:
    try:
        return importlib.import_module("pandas")
    except ImportError as error:
        raise MissingExtraError(
            f"this needs pandas, which is not installed ({error}); install it with: "
            "pip install pandas"
        ) from None


def _clock(column: Any, name: str) -> tuple[Any, bool]:
    """Times as numbers, and whether they are integer nanoseconds."""
    kind = column.dtype.kind if isinstance(column.dtype, np.dtype) else "M"
    if kind in "iuf":
        return column.to_numpy(dtype=np.float64), False
    try:
        stamps = column.to_numpy(dtype="m8[ns]" if kind == "m" else "M8[ns]")
    except (TypeError, ValueError) as error:
        raise InputError(f"the column {name!r} must hold times: {error}") from None
    if np.isnat(stamps).any():
        raise InputError(f"the column {name!r} has no time in row {int(np.isnat(stamps).argmax())}")
    return stamps.astype(np.int64), True
