"""Names, units, roles and kinds of the channels of all recordings together."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np

from offbeat.data.cleaning.channels import find_quaternions
from offbeat.data.cleaning.options import ReaderOptions
from offbeat.data.signals import MOST_CHANNELS, Recording, Signal
from offbeat.data.transforms import full_turn, is_angle_unit
from offbeat.errors import FileFormatError, InputError, listed, one_of

_ANGLE_UNIT = re.compile(r"(?:^|[_.\s\-/])(deg|degrees?|rad|radians?)$")


@dataclass(frozen=True)
class Channels:
    """The channels of all recordings, in order of first appearance."""

    names: tuple[str, ...]
    units: tuple[str, ...]
    roles: tuple[str, ...]
    columns: dict[tuple[str, str], int]  # by signal and channel
    angles: dict[int, float]  # full turn of each, in its unit
    quaternions: tuple[tuple[int, ...], ...]
    degrees: dict[str, bool] = field(default_factory=dict)  # of angles that state no unit

    @classmethod
    def of(cls, recordings: list[Recording], options: ReaderOptions) -> Channels:
        """Collects the channels, and finds quaternions that readers did not mark.

        Raises:
            FileFormatError: there is no channel, names repeat, or units disagree.
            InputError: `channels`, `without` or `angles` names an unknown channel.
        """
        if not recordings:
            raise FileFormatError("there are no recordings to read; check the file")
        columns: dict[tuple[str, str], int] = {}
        units: list[str] = []
        kinds: list[str] = []
        roles: list[str] = []
        looked_at: set[str] = set()
        degrees: dict[str, bool] = {}
        for signal in (signal for recording in recordings for signal in recording.signals):
            for channel, unit, kind, role in zip(
                signal.channels, signal.units, signal.kinds, signal.roles, strict=True
            ):
                at = columns.setdefault((signal.name, channel), len(columns))
                if at == len(units):
                    units.append(unit)
                    kinds.append(kind)
                    roles.append(role)
                units[at] = units[at] or unit
                kinds[at] = kinds[at] or kind
                if unit not in ("", units[at]):
                    raise FileFormatError(
                        f"channel {channel!r} of signal {signal.name!r} is in {units[at]!r} here "
                        f"and in {unit!r} there; read the recordings one by one"
                    )
            if len(signal.stamps) and signal.name not in looked_at:
                looked_at.add(signal.name)
                if "quaternion" not in signal.kinds:
                    for first in find_quaternions(signal.channels, signal.values.T):
                        for channel in signal.channels[first : first + 4]:
                            kinds[columns[signal.name, channel]] = "quaternion"
        several = len({signal for signal, _ in columns}) > 1
        names = tuple(f"{s}.{c}" if several and s else c for s, c in columns)
        place = {name: i for i, name in enumerate(names)}
        if len(place) < len(names):
            twice = next(name for i, name in enumerate(names) if place[name] != i)
            raise FileFormatError(f"two channels have the name {twice!r}; names must be unique")
        if not names:
            raise FileFormatError("there is no channel to read, only times")
        if len(names) > MOST_CHANNELS:
            raise FileFormatError(
                f"there are {len(names)} channels, more than {MOST_CHANNELS} that can be read at "
                "once; choose some with channels="
            )

        def known(what: str, name: str) -> int:
            return place[name if name in place else one_of(what, name, names)]

        for option, role in (("actions", "action"), ("exogenous", "exogenous")):
            for name in getattr(options, option):
                roles[known(f"channel in {option}", name)] = role
        for name, unit in (options.units or {}).items():
            units[known("channel in units", name)] = unit
        for name in options.angles:
            at = known("channel in angles", name)
            kinds[at] = "angle"
            named = _ANGLE_UNIT.search(name.casefold())
            if not units[at] and named:
                units[at] = named[1][:3]
            elif not units[at]:
                degrees[name] = _is_in_degrees(name, columns, at, recordings)
                units[at] = "deg" if degrees[name] else ""
            elif not is_angle_unit(units[at]):
                raise InputError(
                    f"the angle {name!r} is in {units[at]!r}, expected rad or deg, so that its "
                    "jumps by a turn are known; convert it, or take it out of angles"
                )
        gone = {name for recording in recordings for name in recording.left_out}
        left_out: set[str] = set()
        for name in options.without:
            inside = [n for n in names if n == name or n.startswith((f"{name}.", f"{name}["))]
            if not inside and name not in gone:
                one_of("channel in without", name, names)
            left_out.update(inside)
        chosen = tuple(name for name in options.channels or names if name not in left_out)
        if not chosen:
            raise InputError(
                f"there are no channels but those to be left out: {listed(list(names))}"
            )
        kept = {known("channel", name): i for i, name in enumerate(chosen)}
        fours = [at for at, kind in enumerate(kinds) if kind == "quaternion"]
        whole = [fours[i : i + 4] for i in range(0, len(fours), 4)]
        return cls(
            chosen,
            tuple(units[at] for at in kept),
            tuple(roles[at] for at in kept),
            {key: kept[at] for key, at in columns.items() if at in kept},
            {
                kept[at]: full_turn(units[at])
                for at, kind in enumerate(kinds)
                if kind == "angle" and at in kept
            },
            tuple(
                tuple(kept[at] for at in four)
                for four in whole
                if options.quaternions == "continuous"
                and all(at in kept and roles[at] != "action" for at in four)
            ),
            degrees,
        )

    def keep(self, signal: Signal) -> Signal | None:
        """The signal with the channels that are kept, or None."""
        at = [i for i, name in enumerate(signal.channels) if (signal.name, name) in self.columns]
        if len(at) == len(signal.channels):
            return signal
        names = tuple(signal.channels[i] for i in at)
        return Signal(signal.name, signal.stamps, signal.values[:, at], names) if at else None

    def names_of(self, columns: Iterable[int]) -> tuple[str, ...]:
        """The names of some columns."""
        return tuple(self.names[c] for c in columns)


def _is_in_degrees(
    name: str, columns: dict[tuple[str, str], int], at: int, recordings: list[Recording]
) -> bool:
    """Whether an angle that states no unit is in degrees, by its range and its jumps.

    Values within 2 pi of 0 are radians. Wider ones are degrees if they are within 360 of 0 and
    jump by more than 180.

    Raises:
        InputError: it may be either.
    """
    values = [
        signal.values[:, i][~np.isnan(signal.values[:, i])]
        for recording in recordings
        for signal in recording.signals
        for i, channel in enumerate(signal.channels)
        if columns[signal.name, channel] == at
    ]
    low = min((float(v.min()) for v in values if v.size), default=0.0)
    high = max((float(v.max()) for v in values if v.size), default=0.0)
    turn = 2 * math.pi * 1.001
    if -turn <= low and high <= turn:
        return False
    jumps = any(bool((np.abs(np.diff(v)) > 180).any()) for v in values)
    if jumps and low >= -360.5 and high <= 360.5:
        return True
    raise InputError(
        f"the angle {name!r} has no unit, and values from {low:.4g} to {high:.4g} may be rad or "
        f"deg; state it with units={{{name}: deg}}"
    )
