"""Conversion of data sets from and to pandas."""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from typing import Any

import numpy as np

from offbeat.data.arrays import hand_over
from offbeat.data.trajectory import Dataset, Trajectory
from offbeat.data.writers.described import interval
from offbeat.errors import InputError, MissingExtraError, one_of

_BESIDE = ("observed", "low", "high", "beyond")


def to_pandas(
    dataset: Dataset | Trajectory, *, masks: bool = False, level: float | None = None
) -> Any:
    """Converts a data set, or one trajectory, to a data frame.

    A value is NaN where it is not observed, as `from_pandas` reads it, and values that are known
    and masked are lost; with `masks` all known values are kept. Units and roles are in the frame's
    `attrs`. pandas converts further: `to_pandas(trajectory).to_xarray()` is a data set of xarray
    with the coordinate `time`.

    Args:
        dataset: a data set, or a trajectory.
        masks: add a column `name|observed` per channel, True where it is observed.
        level: probability of the intervals of answers, whose ends are then columns `name|low` and
            `name|high`.

    Returns:
        A `pandas.DataFrame`. Of a data set it has a row per time, `trajectory` counts from 0, and
        `time` is in seconds. Of a trajectory, the index is `time`, in seconds.

    Raises:
        InputError: a channel has the name of another column, or there are no intervals.
        MissingExtraError: pandas is not installed.

    Example:
        >>> frames = [offbeat.to_pandas(one, masks=True) for one in log]  # doctest: +SKIP
    """
    pandas = _pandas()
    alone = isinstance(dataset, Trajectory)
    dataset = Dataset.of(dataset)
    values = [t.values if masks else np.where(t.observed, t.values, np.nan) for t in dataset]
    columns: dict[str, Any] = (
        {}
        if alone
        else {"trajectory": np.repeat(np.arange(len(dataset)), [t.rows for t in dataset])}
    )
    columns["time"] = np.concatenate([t.times for t in dataset])
    tables = {"": np.concatenate(values)}
    if masks:
        tables["|observed"] = np.concatenate([t.observed for t in dataset])
    if level is not None:
        ends = [_interval(t, level) for t in dataset]
        tables["|low"], tables["|high"] = (np.concatenate(side) for side in zip(*ends, strict=True))
    for ending, table in tables.items():
        for c, name in enumerate(dataset.names):
            if name + ending in columns:
                raise InputError(
                    f"a channel is called {name + ending!r}, as another column of the frame; "
                    "rename it"
                )
            columns[name + ending] = table[:, c]
    frame = pandas.DataFrame(columns)
    frame.attrs["units"] = dict(zip(dataset.names, dataset.units, strict=True))
    frame.attrs["roles"] = dict(zip(dataset.names, dataset.roles, strict=True))
    return frame.set_index("time") if alone else frame


def from_pandas(
    frame: Any,
    *,
    time: str = "time",
    by: str | None = None,
    units: Mapping[str, str] | None = None,
    roles: Mapping[str, str] | None = None,
) -> Dataset:
    """Converts data frames with a row per time to a data set.

    A column `name|observed` beside the channel `name` is its mask, as `to_pandas` writes it;
    columns `name|low`, `name|high` and `name|beyond` are left out.

    Args:
        frame: a `pandas.DataFrame`; all columns except `time` and `by` are numeric channels. Or a
            list of them, a trajectory each.
        time: column of times, or name of the index: seconds, or time stamps or durations of pandas.
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
    if isinstance(frame, list | tuple):
        parts = [from_pandas(f, time=time, by=by, units=units, roles=roles) for f in frame]
        return Dataset(tuple(t for part in parts for t in part))
    columns = list(frame.columns)
    if time not in columns and frame.index.name == time:
        attrs = frame.attrs
        frame = frame.reset_index()
        frame.attrs = attrs
        columns = list(frame.columns)
    one_of("column of times", time, map(str, columns))
    if by is None and "trajectory" in columns and time != "trajectory":
        by = "trajectory"
    if by is not None:
        one_of("column of trajectories", by, map(str, columns))
    beside = {f"{name}|{what}" for name in columns for what in _BESIDE}
    names = [name for name in columns if name not in (time, by) and str(name) not in beside]
    described: list[tuple[str, ...]] = []
    for key, given, default in (("units", units, ""), ("roles", roles, "state")):
        for name in given or {}:
            one_of(f"channel in {key}", name, map(str, names))
        found = {**frame.attrs.get(key, {}), **(given or {})}
        described.append(tuple(found.get(name, default) for name in names))
    clock, nanoseconds = _clock(frame[time], time)
    try:
        values = frame[names].to_numpy(dtype=np.float64, na_value=np.nan)
    except (TypeError, ValueError) as error:
        raise InputError(f"the channels {names} of the frame must be numbers: {error}") from None
    observed = ~np.isnan(values)
    for c, name in enumerate(names):
        if f"{name}|observed" in columns:
            observed[:, c] &= frame[f"{name}|observed"].to_numpy(dtype=bool)
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
                observed=hand_over(observed[index]),
                names=tuple(map(str, names)),
                units=described[0],
                roles=described[1],
            )
            for index in rows
        )
    )


def _interval(trajectory: Trajectory, level: float) -> tuple[Any, Any]:
    ends = interval(trajectory, level)
    if ends is None:
        raise InputError(
            "level is given, and these values have no intervals: they are no answers of a blend; "
            "leave it out"
        )
    return ends


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
