"""Results of readers: a recording per file or episode, a signal per sensor, as logged."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from offbeat.data.cleaning.clocks import NANOSECONDS_PER
from offbeat.data.trajectory import ROLES
from offbeat.errors import InputError, one_of

KINDS = ("", "angle", "quaternion")
"""Kinds of channels."""

MOST_CHANNELS = 20_000
"""Channels of a data set; a file with more is refused before it is read."""


@dataclass(frozen=True, eq=False)
class Signal:
    """The values of one sensor, topic or table, as they were logged.

    Its arrays become those of trajectories, and read-only.

    Args:
        name: of the topic or table. Channels are called `name.channel` where several signals are
            merged, and `channel` where there is only one.
        stamps: (n,) nanoseconds on the recording's clock, int64, in the order of the log.
        values: (n, channels) float64, NaN = missing. A view of columns that lie one after the
            other in memory (order F) avoids a copy.
        channels: a name per channel.
        units: a unit per channel, such as `rad/s`; by default empty.
        kinds: per channel `""`, `angle` (rad, or degrees where its unit is `deg`) or `quaternion`
            (four channels in a row are one quaternion); by default `""`. A reader sets the kinds
            that it knows.
        roles: one of `ROLES` per channel; by default `state`. A channel with the role `action`
            keeps its last value until the next logged one.

    Raises:
        InputError: shapes, types or numbers of names disagree.
    """

    name: str
    stamps: NDArray[np.int64]
    values: NDArray[np.float64]
    channels: tuple[str, ...]
    units: tuple[str, ...] = ()
    kinds: tuple[str, ...] = ()
    roles: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        where = f" of signal {self.name!r}" if self.name else ""
        width = len(self.channels)
        units = tuple(self.units) or ("",) * width
        kinds = tuple(self.kinds) or ("",) * width
        roles = tuple(self.roles) or ("state",) * width
        if self.stamps.dtype != np.int64 or self.stamps.ndim != 1:
            raise InputError(
                f"stamps{where} must be int64 nanoseconds of shape (n,), got {self.stamps.dtype} "
                f"of shape {self.stamps.shape}"
            )
        if self.values.dtype != np.float64 or self.values.shape != (len(self.stamps), width):
            raise InputError(
                f"values{where} must be float64 of shape {(len(self.stamps), width)}, a row per "
                f"stamp and a column per channel, got {self.values.dtype} of shape "
                f"{self.values.shape}"
            )
        if not len(units) == len(kinds) == len(roles) == width:
            raise InputError(
                f"got {len(units)} units, {len(kinds)} kinds and {len(roles)} roles for {width} "
                f"channels{where}; give one of each per channel"
            )
        for role in roles:
            one_of("role of a channel", role, ROLES)
        for kind in kinds:
            one_of("kind of channel", kind, KINDS)
        if kinds.count("quaternion") % 4:
            raise InputError(
                f"{kinds.count('quaternion')} channels{where} are called quaternion; four in a "
                "row make one"
            )
        object.__setattr__(self, "channels", tuple(self.channels))
        object.__setattr__(self, "units", units)
        object.__setattr__(self, "kinds", kinds)
        object.__setattr__(self, "roles", roles)


@dataclass(frozen=True, eq=False)
class Recording:
    """One file or one episode: signals on one clock, as they were logged.

    Args:
        signals: what was logged; a signal may be empty.
        label: of the episode, where the file has one.
        origin: source, for messages and reports.
        time_unit: unit of times in the file, for reports: `s`, `ms`, `us`, `ns` or
            `100ns`.
        notes: assumptions and omissions of the reader, such as "stamps are row number / fps".
        clock_zero: the file's clock at stamp 0, in `time_unit`, if the stamps do not
            count from the clock's own zero because that would exceed an int64.
        unit_found: whether nothing in the file states `time_unit`: the reader found it from the
            numbers, or assumed it.
        left_out: names of what the file has and the reader left out, which the option `without`
            may name.

    Raises:
        InputError: the unit is unknown.
    """

    signals: tuple[Signal, ...]
    label: str = ""
    origin: str = ""
    time_unit: str = "ns"
    notes: tuple[str, ...] = ()
    clock_zero: int = 0
    unit_found: bool = False
    left_out: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        one_of("time unit", self.time_unit, NANOSECONDS_PER)
        object.__setattr__(self, "signals", tuple(self.signals))
        object.__setattr__(self, "notes", tuple(self.notes))
