"""The first noun: a trajectory, checked when it is made, and the data set that holds many."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, overload

import numpy as np
from numpy.typing import ArrayLike, NDArray

from offbeat.errors import InputError, one_of

SECONDS_PER = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "100ns": 1e-7, "ns": 1e-9}
"""Units of time that input may be given in; inside, times are seconds."""


@dataclass(frozen=True, eq=False)
class Trajectory:
    """What was measured over time: rows of channel values at strictly increasing times.

    *Known* and *observed* differ: a cell that `mask_out` hid is known to the score and unseen by the
    model. `values` is NaN where a cell is not known; `observed` says what a model may look at.

    Args:
        times: (rows,) seconds, finite, strictly increasing; stored as float64.
        values: (rows, channels) NaN where not known; stored as float64.
        observed: (rows, channels) bool; by default every known cell.
        actions: (rows, actions) or None; finite.
        names: one unique name per channel; by default `channel_0`, `channel_1`, ...
        units: one unit per channel, such as `rad/s`; by default empty.
        origin: where it came from, for messages and reports.

    Raises:
        InputError: shapes disagree, times are not finite or do not increase, a value is infinite,
            a cell is marked as observed where its value is NaN, or names repeat.
    """

    times: NDArray[np.float64]
    values: NDArray[np.float64]
    observed: NDArray[np.bool_] = None  # type: ignore[assignment]  # filled in below
    actions: NDArray[np.float64] | None = None
    names: tuple[str, ...] = ()
    units: tuple[str, ...] = ()
    origin: str = ""

    def __post_init__(self) -> None:
        where = f" (of {self.origin})" if self.origin else ""
        times = _array(self.times, "times", where)
        values = _array(self.values, "values", where)
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
        names = tuple(self.names) or tuple(f"channel_{i}" for i in range(values.shape[1]))
        units = tuple(self.units) or ("",) * len(names)
        if len(names) != values.shape[1] or len(units) != values.shape[1]:
            raise InputError(
                f"got {len(names)} names and {len(units)} units for {values.shape[1]} "
                f"channels{where}; give one of each per channel"
            )
        if len(set(names)) != len(names):
            twice = next(name for name in names if names.count(name) > 1)
            raise InputError(f"the channel name {twice!r} stands twice{where}; names are unique")
        if np.isinf(values).any():
            row, channel = np.argwhere(np.isinf(values))[0]
            raise InputError(
                f"values{where} are infinite at row {row}, channel {names[channel]!r}; "
                "use NaN for a cell that is not known"
            )
        known = np.isnan(values)
        np.logical_not(known, out=known)
        observed = known if self.observed is None else np.asarray(self.observed)
        if observed.dtype != np.bool_ or observed.shape != values.shape:
            raise InputError(
                f"observed{where} must be bool of shape {values.shape}, as values has, got "
                f"{observed.dtype} of shape {observed.shape}"
            )
        if observed is not known and (observed & ~known).any():
            row, channel = np.argwhere(observed & ~known)[0]
            raise InputError(
                f"observed{where} is True at row {row}, channel {names[channel]!r}, where the "
                "value is NaN; "
                "a cell that is not known can't be observed"
            )
        actions = None if self.actions is None else _array(self.actions, "actions", where)
        if actions is not None and (actions.ndim != 2 or len(actions) != len(times)):
            raise InputError(
                f"actions{where} must have shape ({len(times)}, actions), got {actions.shape}"
            )
        if actions is not None and not np.isfinite(actions).all():
            row = int(np.argwhere(~np.isfinite(actions))[0][0])
            raise InputError(f"actions{where} are not finite at row {row}")
        for name, value in (
            ("times", times),
            ("values", values),
            ("observed", observed),
            ("actions", actions),
            ("names", names),
            ("units", units),
        ):
            if isinstance(value, np.ndarray):
                value = value.view()
                value.flags.writeable = False
            object.__setattr__(self, name, value)

    @classmethod
    def from_arrays(
        cls, times: ArrayLike, values: ArrayLike, *, time_unit: str = "s", **fields: Any
    ) -> Trajectory:
        """Makes a trajectory from times in any unit, integer clocks included.

        Integer clocks (nanoseconds since 1970, say) are first taken relative to the first row, so
        that nothing is lost to rounding.

        Args:
            times: (rows,) in `time_unit`.
            values: (rows, channels) NaN where not known.
            time_unit: one of `s`, `ms`, `us`, `100ns` (ticks of Windows), `ns`.
            **fields: the other fields of `Trajectory`.

        Raises:
            InputError: as `Trajectory`, or an unknown unit.
        """
        factor = SECONDS_PER[one_of("time unit", time_unit, SECONDS_PER)]
        clock = np.asarray(times)
        if clock.dtype.kind in "iu" and clock.size:
            clock = clock.astype(np.int64)
            clock = clock - clock.reshape(-1)[0]
        seconds = np.asarray(clock, dtype=np.float64)
        # Dividing by the exact 1000 rounds once; multiplying by the inexact 0.001 rounds twice.
        seconds = seconds / round(1 / factor)
        return cls(seconds, np.asarray(values, dtype=np.float64), **fields)

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
        """(rows, channels) True where the value is known, observed or hidden."""
        return ~np.isnan(self.values)

    def __repr__(self) -> str:
        share = f"{100 * self.observed.mean():.0f} % observed"
        return (
            f"Trajectory({self.rows} rows, {self.channels} channels, "
            f"{self.times[0]:g} to {self.times[-1]:g} s, {share})"
        )

    def slice(self, start: int, stop: int) -> Trajectory:
        """The rows from `start` up to, not including, `stop`."""
        rows = slice(start, stop)
        return replace(
            self,
            times=self.times[rows],
            values=self.values[rows],
            observed=self.observed[rows],
            actions=None if self.actions is None else self.actions[rows],
        )


def _array(value: ArrayLike, what: str, where: str) -> NDArray[np.float64]:
    try:
        return np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
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
            f"times{where} must increase strictly, got {times[row - 1]!r} at row {row - 1} and "
            f"{times[row]!r} at row {row}; sort the rows and drop repeated times"
        )


@dataclass(frozen=True, eq=False)
class Dataset(Sequence[Trajectory]):
    """Trajectories of the same channels, and what is known of how they were made.

    Args:
        trajectories: at least one, all with the same names and units.
        meta: JSON-like facts that travel with the data: robot, seed, generator versions.

    Raises:
        InputError: there is no trajectory, or channels differ between trajectories.
    """

    trajectories: tuple[Trajectory, ...]
    meta: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        trajectories = tuple(self.trajectories)
        if not trajectories:
            raise InputError("a data set needs at least one trajectory, got none")
        first = trajectories[0]
        for i, other in enumerate(trajectories):
            if other.names != first.names or other.units != first.units:
                raise InputError(
                    f"trajectory {i} has channels {_list(other)}, the first one has "
                    f"{_list(first)}; a data set holds trajectories of the same channels"
                )
            if _width(other.actions) != _width(first.actions):
                raise InputError(
                    f"trajectory {i} has {_width(other.actions)} actions, the first one has "
                    f"{_width(first.actions)}; a data set holds trajectories of the same actions"
                )
        object.__setattr__(self, "trajectories", trajectories)
        object.__setattr__(self, "meta", dict(self.meta))

    @property
    def names(self) -> tuple[str, ...]:
        """Channel names."""
        return self.trajectories[0].names

    @property
    def units(self) -> tuple[str, ...]:
        """Channel units."""
        return self.trajectories[0].units

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

    def fingerprint(self) -> str:
        """SHA-256 of names, times, values and masks: equal for equal data alone."""
        digest = hashlib.sha256("\0".join(self.names).encode())
        for trajectory in self:
            for array in (trajectory.times, trajectory.values, trajectory.observed):
                digest.update(array.tobytes())
        return digest.hexdigest()

    def select(self, names: Sequence[str]) -> Dataset:
        """These channels, in this order.

        Raises:
            InputError: a name is not among the channels.
        """
        order = [self.names.index(one_of("channel", name, self.names)) for name in names]
        chosen = (
            replace(
                t,
                values=t.values[:, order],
                observed=t.observed[:, order],
                names=tuple(t.names[i] for i in order),
                units=tuple(t.units[i] for i in order),
            )
            for t in self
        )
        return replace(self, trajectories=tuple(chosen))

    def __repr__(self) -> str:
        rows = sum(t.rows for t in self)
        share = sum(int(t.observed.sum()) for t in self) / (rows * self.channels)
        return (
            f"Dataset({len(self)} trajectories, {rows} rows, {self.channels} channels, "
            f"{100 * share:.0f} % observed)"
        )


def _width(actions: NDArray[np.float64] | None) -> int:
    return 0 if actions is None else int(actions.shape[1])


def _list(trajectory: Trajectory) -> str:
    pairs = zip(trajectory.names, trajectory.units, strict=True)
    return ", ".join(f"{name} [{unit}]" for name, unit in pairs)
