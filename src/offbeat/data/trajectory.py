"""Trajectories, and data sets of trajectories."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, overload

import numpy as np
from numpy.typing import ArrayLike, NDArray

from offbeat.data.arrays import dates_of, frozen, hand_over, since_first, without_mask
from offbeat.errors import InputError, one_of

SECONDS_PER = {
    "s": 1.0,
    "ms": 1e-3,
    "us": 1e-6,
    "100ns": 1e-7,
    "ns": 1e-9,
    "min": 60.0,
    "h": 3600.0,
    "d": 86_400.0,
}
"""Units of input times; internally, times are in seconds."""

STATE, ACTION, EXOGENOUS = ROLES = ("state", "action", "exogenous")
"""Roles of channels: a `state` is observed and predicted; an `action` is given, or
predicted and fed back; an `exogenous` channel is observed and never predicted."""


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Values of several channels at strictly increasing times, one row per time.

    A value is *known* where it is not NaN. It is *observed* where a model may use it: `mask_out`
    leaves values known, so that predictions can be scored, and marks them as not observed.

    A trajectory owns its arrays: they are copied, and read-only. Arrays that are read-only already,
    down to the array that owns the memory, are not copied.

    Args:
        times: (rows,) seconds, finite, strictly increasing; stored as float64. A `timedelta64` is
            converted; a `datetime64` is refused, `from_arrays` takes it.
        values: (rows, channels) NaN where not known; stored as float64. What a masked array masks
            is not known.
        observed: (rows, channels) bool; by default every known value.
        names: one unique name per channel; by default `channel_0`, `channel_1`, ...
        units: one unit per channel, such as `rad/s`; by default empty.
        roles: one of `ROLES` per channel; by default `state`.
        origin: source, for messages and reports.

    Raises:
        InputError: shapes disagree, times are not finite or do not increase, a value is infinite,
            a value is marked as observed and is NaN, names repeat, or a role is unknown.
    """

    times: NDArray[np.float64]
    values: NDArray[np.float64]
    observed: NDArray[np.bool_] = None  # type: ignore[assignment]  # filled in below
    names: tuple[str, ...] = ()
    units: tuple[str, ...] = ()
    roles: tuple[str, ...] = ()
    origin: str = ""

    def __post_init__(self) -> None:
        where = f" (of {self.origin})" if self.origin else ""
        times = _array(_seconds(self.times, where), "times", where)
        values = _array(without_mask(self.values, "values"), "values", where)
        if times.ndim != 1:
            raise InputError(f"times{where} must have shape (rows,), got shape {times.shape}")
        if values.ndim != 2 or len(values) != len(times):
            raise InputError(
                f"values{where} must have shape (rows, channels) with {len(times)} rows, as times "
                f"has, got shape {values.shape}"
            )
        if len(times) == 0 or values.shape[1] == 0:
            raise InputError(
                f"the trajectory{where} is empty: {len(times)} rows, {values.shape[1]} channels; "
                "it needs at least one of each, leave it out"
            )
        _check_times(times, where)
        names, units, roles = _described(self, values.shape[1], where)
        if np.isinf(values).any():
            row, channel = np.argwhere(np.isinf(values))[0]
            raise InputError(
                f"values{where} are infinite at row {row}, channel {names[channel]!r}; "
                "use NaN for a value that is not known"
            )
        known = np.isnan(values)
        np.logical_not(known, out=known)
        if self.observed is None:
            observed = hand_over(known)
        else:
            observed = np.asarray(self.observed)
            if observed.dtype != np.bool_ or observed.shape != values.shape:
                raise InputError(
                    f"observed{where} must be bool of shape {values.shape}, as values has, got "
                    f"{observed.dtype} of shape {observed.shape}"
                )
            observed = frozen(self.observed, np.bool_)
            if (observed & ~known).any():
                row, channel = np.argwhere(observed & ~known)[0]
                raise InputError(
                    f"observed{where} is True at row {row}, channel {names[channel]!r}, where the "
                    "value is NaN; a value that is not known cannot be observed"
                )
        for name, value in (
            ("times", times),
            ("values", values),
            ("observed", observed),
            ("names", names),
            ("units", units),
            ("roles", roles),
        ):
            object.__setattr__(self, name, value)

    @classmethod
    def from_arrays(
        cls, times: ArrayLike, values: ArrayLike, *, time_unit: str = "s", **fields: Any
    ) -> Trajectory:
        """Makes a trajectory from times in any unit, integer clocks included.

        The first time of an integer clock, such as nanoseconds since 1970, is subtracted before
        the clock becomes float64, which avoids rounding errors.

        Args:
            times: (rows,) in `time_unit`; or `datetime64` or `timedelta64`, or dates or durations
                of pandas or Python, which have a unit of their own and count from the first row.
            values: (rows, channels) NaN where not known, or masked.
            time_unit: one of `s`, `ms`, `us`, `100ns` (ticks of Windows), `ns`, `min`, `h`, `d`.
            **fields: the other fields of `Trajectory`.

        Raises:
            InputError: as `Trajectory`, or an unknown unit.
        """
        factor = SECONDS_PER[one_of("time unit", time_unit, SECONDS_PER)]
        clock = np.asarray(dates_of(without_mask(times, "times")))
        if clock.dtype.kind in "mM":
            return cls(since_first(clock), values, **fields)  # type: ignore[arg-type]
        if clock.dtype.kind in "iu" and clock.size:
            clock = clock.astype(np.int64)
            clock = clock - clock.reshape(-1)[0]
        seconds = _array(clock, "times", "")
        # Dividing by the exact 1000 rounds once; multiplying by the inexact 0.001 rounds twice.
        seconds = seconds * factor if factor > 1 else seconds / round(1 / factor)
        return cls(seconds, values, **fields)  # type: ignore[arg-type]

    @property
    def rows(self) -> int:
        """Number of rows."""
        return len(self.times)

    @property
    def channels(self) -> int:
        """Number of channels."""
        return int(self.values.shape[1])

    @property
    def known(self) -> NDArray[np.bool_]:
        """(rows, channels) True where the value is known, observed or masked."""
        return ~np.isnan(self.values)

    @property
    def actions(self) -> NDArray[np.float64] | None:
        """(rows, actions) values of the channels with the role `action`; None without any."""
        chosen = [i for i, role in enumerate(self.roles) if role == "action"]
        return self.values[:, chosen] if chosen else None

    def __repr__(self) -> str:
        return (
            f"{type(self).__name__}({self.rows} rows, {self.channels} channels, "
            f"{self.times[0]:g} to {self.times[-1]:g} s, "
            f"{100 * self.observed.mean():.0f} % observed)"
        )

    def slice(self, start: int, stop: int) -> Trajectory:
        """The rows from `start` up to, not including, `stop`."""
        rows = slice(start, stop)
        return replace(
            self,
            times=self.times[rows],
            values=self.values[rows],
            observed=self.observed[rows],
        )

    def select(self, index: Sequence[int]) -> Trajectory:
        """The channels at these positions, in this order."""
        order = list(index)
        return replace(
            self,
            values=hand_over(self.values[:, order]),
            observed=hand_over(self.observed[:, order]),
            names=tuple(self.names[i] for i in order),
            units=tuple(self.units[i] for i in order),
            roles=tuple(self.roles[i] for i in order),
        )

    def given_back(self, constants: Mapping[int, float], copies: Mapping[int, int]) -> Trajectory:
        """The trajectory with the values of channels that a model was not given.

        Args:
            constants: position of a channel, and its value.
            copies: position of a channel, and of the one that it is a copy of.
        """
        if not constants and not copies:
            return self
        values = self.values.copy()
        for channel, constant in constants.items():
            values[:, channel] = constant
        for channel, source in copies.items():
            values[:, channel] = values[:, source]
        return replace(self, values=hand_over(values))


def _described(
    trajectory: Trajectory, channels: int, where: str
) -> tuple[tuple[str, ...], tuple[str, ...], tuple[str, ...]]:
    """Name, unit and role of each channel, checked."""
    names = tuple(trajectory.names) or tuple(f"channel_{i}" for i in range(channels))
    units = tuple(trajectory.units) or ("",) * channels
    roles = tuple(trajectory.roles) or ("state",) * channels
    if not len(names) == len(units) == len(roles) == channels:
        raise InputError(
            f"got {len(names)} names, {len(units)} units and {len(roles)} roles for {channels} "
            f"channels{where}; give one of each per channel"
        )
    if len(set(names)) != len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise InputError(f"two channels{where} have the name {twice!r}; names must be unique")
    for role in roles:
        one_of("role of a channel", role, ROLES)
    return names, units, roles


def _seconds(times: Any, where: str) -> Any:
    """Times without a mask or a unit of NumPy."""
    times = dates_of(without_mask(times, f"times{where}"))
    kind = times.dtype.kind if isinstance(times, np.ndarray) else ""
    if kind == "M":
        raise InputError(
            f"times{where} are {times.dtype}, expected seconds; Trajectory.from_arrays takes dates"
        )
    return times / np.timedelta64(1, "s") if kind == "m" else times


def _array(value: ArrayLike, what: str, where: str) -> NDArray[np.float64]:
    kind = getattr(getattr(value, "dtype", None), "kind", "")
    if kind and kind in "mMc":
        raise InputError(f"{what}{where} are {value.dtype}, expected real numbers")  # type: ignore[union-attr]
    try:
        return frozen(value, np.float64)
    except (TypeError, ValueError, RuntimeError) as error:
        raise InputError(f"{what}{where} must be numbers: {error}") from None


def _check_times(times: NDArray[np.float64], where: str) -> None:
    bad = ~np.isfinite(times)
    if bad.any():
        row = int(bad.argmax())
        raise InputError(
            f"times{where} must be finite seconds, got {times[row]} at row {row}; drop that row"
        )
    late = np.diff(times) <= 0
    if late.any():
        row = int(late.argmax()) + 1
        raise InputError(
            f"times{where} must increase strictly, got {float(times[row - 1])} at row "
            f"{row - 1} and {float(times[row])} at row {row}; sort the rows and drop repeated times"
        )


@dataclass(frozen=True, eq=False)
class Dataset(Sequence[Trajectory]):
    """Trajectories of the same channels, with metadata.

    Args:
        trajectories: at least one, all with the same names, units and roles.
        meta: JSON-like information that is kept with the data: robot, seed, generator versions.

    Raises:
        InputError: there is no trajectory, or channels differ between trajectories.
    """

    trajectories: tuple[Trajectory, ...]
    meta: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        given: Any = self.trajectories
        trajectories: tuple[Trajectory, ...]
        trajectories = (given,) if isinstance(given, Trajectory) else tuple(given)
        if not trajectories:
            raise InputError("a data set needs at least one trajectory, got none")
        first = trajectories[0]
        for i, other in enumerate(trajectories):
            if _channels(other) != _channels(first):
                raise InputError(
                    f"trajectory {i} has channels {_list(other)}, the first one has "
                    f"{_list(first)}; a data set holds trajectories of the same channels"
                )
        object.__setattr__(self, "trajectories", trajectories)
        object.__setattr__(self, "meta", dict(self.meta))

    @classmethod
    def of(cls, data: Dataset | Trajectory | Sequence[Trajectory]) -> Dataset:
        """A data set as it is, or one of a trajectory or several.

        Args:
            data: what a function that works on data sets was given.

        Raises:
            InputError: it is something else.
        """
        if isinstance(data, Dataset):
            return data
        if isinstance(data, Trajectory):
            return cls((data,))
        if isinstance(data, list | tuple) and all(isinstance(one, Trajectory) for one in data):
            return cls(tuple(data))
        if hasattr(data, "parts"):  # a folder
            raise InputError(
                "a folder of Parquet files is taken by make_model and fit alone; other functions "
                "take its parts: for part in data.parts()"
            )
        raise InputError(
            f"expected a Dataset, a Trajectory or a list of them, got {type(data).__name__}; "
            "offbeat.read gives a data set of a file, offbeat.from_pandas of a DataFrame, "
            "offbeat.Trajectory(times, values) is one of arrays"
        )

    @staticmethod
    def open(folder: str | Path, *, window: int | None = None, cache_mb: float = 256.0) -> Any:
        """Opens a folder of Parquet files without reading their values.

        `make_model` and `fit` take the result in place of a training set: scales and statistics are
        measured in one pass, and windows are read group by group, at most `cache_mb` of them at a
        time. `parts` gives the data set of each file, and `sample` some windows in memory.

        Args:
            folder: with files that `save` or `offbeat.data.shards.save_shards` wrote, of the same
                channels.
            window: rows of a window; None for whole trajectories.
            cache_mb: MB of windows in memory at a time, about.

        Returns:
            A `ShardedDataset`.

        Raises:
            FileFormatError: there is no such file, one is damaged, or channels differ.
            InputError: an option is out of range.
        """
        from offbeat.data.shards import ShardedDataset

        return ShardedDataset.open(folder, window=window, cache_mb=cache_mb)

    @property
    def names(self) -> tuple[str, ...]:
        """Channel names."""
        return self.trajectories[0].names

    @property
    def units(self) -> tuple[str, ...]:
        """Channel units."""
        return self.trajectories[0].units

    @property
    def roles(self) -> tuple[str, ...]:
        """Channel roles, see `ROLES`."""
        return self.trajectories[0].roles

    @property
    def channels(self) -> int:
        """Number of channels."""
        return len(self.names)

    def __len__(self) -> int:
        return len(self.trajectories)

    def __iter__(self) -> Iterator[Trajectory]:
        return iter(self.trajectories)

    @overload
    def __getitem__(self, index: int) -> Trajectory: ...
    @overload
    def __getitem__(self, index: slice) -> Dataset: ...
    def __getitem__(self, index: int | slice) -> Trajectory | Dataset:
        if isinstance(index, slice):
            return replace(self, trajectories=self.trajectories[index])
        return self.trajectories[index]

    def take(self, index: Sequence[int] | NDArray[np.int64]) -> Dataset:
        """The trajectories at these positions, in this order."""
        return replace(self, trajectories=tuple(self.trajectories[int(i)] for i in index))

    def fingerprint(self, version: int = 2) -> str:
        """SHA-256 of names, units, roles, times, values and masks: equal only for equal data.

        Args:
            version: 1 gives the fingerprint of Offbeat 0.1.0, which leaves out units and actions.
        """
        described, dataset = json.dumps([self.names, self.units, self.roles]), self
        if version == 1:
            dataset = self.without_actions_but(())
            described = "\0".join(dataset.names)
        digest = hashlib.sha256(described.encode())
        for trajectory in dataset:
            for array in (trajectory.times, trajectory.values, trajectory.observed):
                digest.update(array.tobytes())
        return digest.hexdigest()

    def select(self, names: Sequence[str]) -> Dataset:
        """These channels, in this order.

        Raises:
            InputError: a name is not among the channels.
        """
        order = [self.names.index(one_of("channel", name, self.names)) for name in names]
        return replace(self, trajectories=tuple(t.select(order) for t in self))

    def without_actions_but(self, names: Sequence[str]) -> Dataset:
        """The data set without the actions that are not among these channels."""
        kept = [
            name
            for name, role in zip(self.names, self.roles, strict=True)
            if role != "action" or name in names
        ]
        return self if len(kept) in (0, self.channels) else self.select(kept)

    def __repr__(self) -> str:
        rows = sum(t.rows for t in self)
        observed = sum(int(t.observed.sum()) for t in self) / (rows * self.channels)
        return (
            f"Dataset({len(self)} trajectories, {rows} rows, {self.channels} channels, "
            f"{100 * observed:.0f} % observed)"
        )


def known_values(trajectory: Trajectory, channel: int) -> NDArray[np.float64]:
    """(known,) the known values of one channel, in the order of time.

    Args:
        trajectory: any.
        channel: its position.
    """
    column = trajectory.values[:, channel]
    return column[~np.isnan(column)]


def _channels(trajectory: Trajectory) -> tuple[tuple[str, ...], ...]:
    return trajectory.names, trajectory.units, trajectory.roles


def _list(trajectory: Trajectory) -> str:
    """Channels with their units, and their roles where these are not `state`, for messages."""
    return ", ".join(
        f"{name} [{unit}]" + (f" ({role})" if role != "state" else "")
        for name, unit, role in zip(*_channels(trajectory), strict=True)
    )
