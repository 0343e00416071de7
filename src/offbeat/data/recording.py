"""What a reader hands over, and how it becomes a data set.

A reader of a file format says what stands in the file, as it was logged: a `Recording` per file or
episode, with a `Signal` per sensor, topic or table. Whatever is to be decided about faults of
clocks and sensors is decided here, once for all formats, by `Policies`; `assemble` applies them,
counts what each did, and merges signals of different rates on the union of their stamps.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from offbeat.data.trajectory import SECONDS_PER, Dataset
from offbeat.errors import InputError, one_of

KINDS = ("", "angle", "quaternion")
"""What a channel can be, beyond a number."""


@dataclass(frozen=True, eq=False)
class Signal:
    """What one sensor, topic or table said, as it was logged: faults are still inside.

    Args:
        name: of the topic or table. Channels are called `name.channel` where several signals are
            merged, and `channel` where there is only one.
        stamps: (n,) nanoseconds on the recording's clock, int64, in the order of the log.
        values: (n, channels) float64, NaN = missing. A view of columns that lie one after the
            other in memory (order F) is welcome: nothing is copied without need.
        channels: a name per channel.
        units: a unit per channel, such as `rad/s`; by default empty.
        kinds: per channel `""`, `angle` (rad, or degrees where its unit is `deg`) or `quaternion`
            (four channels in a row are one quaternion); by default `""`. A reader sets what it
            knows.

    Raises:
        InputError: shapes, types or numbers of names disagree.
    """

    name: str
    stamps: NDArray[np.int64]
    values: NDArray[np.float64]
    channels: tuple[str, ...]
    units: tuple[str, ...] = ()
    kinds: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        where = f" of signal {self.name!r}" if self.name else ""
        width = len(self.channels)
        units = tuple(self.units) or ("",) * width
        kinds = tuple(self.kinds) or ("",) * width
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
        if len(units) != width or len(kinds) != width:
            raise InputError(
                f"got {len(units)} units and {len(kinds)} kinds for {width} channels{where}; "
                "give one of each per channel"
            )
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


@dataclass(frozen=True, eq=False)
class Recording:
    """One file or one episode: signals on one clock, before any policy.

    Args:
        signals: what was logged; a signal may be empty.
        label: of the episode, where the file has one.
        origin: where it came from, for messages and reports.
        time_unit: the unit that the file itself counts in, for reports: `s`, `ms`, `us`, `ns` or
            `100ns`.
        notes: what is to be said aloud about how it was read, such as "stamps are row number /
            fps".

    Raises:
        InputError: the unit is unknown.
    """

    signals: tuple[Signal, ...]
    label: str = ""
    origin: str = ""
    time_unit: str = "ns"
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        one_of("time unit", self.time_unit, SECONDS_PER)
        object.__setattr__(self, "signals", tuple(self.signals))
        object.__setattr__(self, "notes", tuple(self.notes))


@dataclass(frozen=True)
class Policies:
    """What is done about the faults of clocks and sensors; each is an option of `read`.

    The defaults lose nothing that was measured and make nothing up. What each of them did is
    counted in `Dataset.meta["report"]`.

    Attributes:
        order: rows whose stamp is lower than one before it: `sort` them in, `drop` them, or
            `refuse` the file.
        duplicates: of the known cells of a channel at one stamp the `last` or `first` one logged,
            their `mean`, or `refuse` the file.
        clock_jumps: where a clock was set back, or forth by more than a day, while it was logged:
            `split` into episodes, `join` as if the rows only lacked order, or `refuse` the file.
        max_gap_s: a longer time without any row is an outage, and splits into episodes. `auto` is
            20 times the 99th percentile of the steps between rows, and at least 1 s; None never
            splits.
        min_rows: an episode that a split leaves with fewer rows than this is left out.
        held: channels of a slower sensor that a faster log repeats: `keep` the repeated values, or
            `mask` them, so that only the first of each run of equal values counts as measured (of
            a run longer than usual, every row at which the sensor's own rate would have it).
        unwrap: whether jumps by a full turn are taken out of channels that are angles.
        angles: more channels that are angles, in radians, or in degrees where their unit is `deg`.
        quaternions: `continuous` (q and -q are one rotation: the sign that is nearer to the row
            before; length 1; one of length 0 is missing) or `keep` them as they are.
        infinite: an infinite cell counts as `missing`, or `refuse` the file.
        start: times count from the `first_row` of each episode, or are those of the recording's
            own `clock`.
        resample_hz: rows at this rate instead of at the stamps; each row holds what was measured
            last since the row before it, and NaN where nothing was. None leaves the stamps alone.

    Raises:
        InputError: a value is none of these.
    """

    order: Literal["sort", "drop", "refuse"] = "sort"
    duplicates: Literal["last", "first", "mean", "refuse"] = "last"
    clock_jumps: Literal["split", "join", "refuse"] = "split"
    max_gap_s: float | Literal["auto"] | None = "auto"
    min_rows: int = 2
    held: Literal["keep", "mask"] = "keep"
    unwrap: bool = True
    angles: tuple[str, ...] = ()
    quaternions: Literal["continuous", "keep"] = "continuous"
    infinite: Literal["missing", "refuse"] = "missing"
    start: Literal["first_row", "clock"] = "first_row"
    resample_hz: float | None = None

    def __post_init__(self) -> None:
        for field, choices in _CHOICES.items():
            one_of(field, getattr(self, field), choices)
        gap, rate = self.max_gap_s, self.resample_hz
        if gap not in ("auto", None) and not (_is_number(gap) and gap > 0):  # type: ignore[operator]
            raise InputError(
                f"max_gap_s must be seconds above 0, 'auto', or None to never split, got {gap!r}"
            )
        if rate is not None and not (_is_number(rate) and 0 < rate <= 1e9):
            raise InputError(
                f"resample_hz must be above 0 and at most 1e9, or None to leave the rows where "
                f"they are, got {rate!r}"
            )
        if isinstance(self.angles, str) or not all(isinstance(a, str) for a in self.angles):
            raise InputError(f"angles must be names of channels, got {self.angles!r}")
        if not isinstance(self.unwrap, bool):
            raise InputError(f"unwrap must be True or False, got {self.unwrap!r}")
        if isinstance(self.min_rows, bool) or not isinstance(self.min_rows, int):
            raise InputError(f"min_rows must be an integer, got {self.min_rows!r}")
        if self.min_rows < 1:
            raise InputError(f"min_rows must be at least 1, got {self.min_rows}")
        object.__setattr__(self, "angles", tuple(self.angles))


_CHOICES: Mapping[str, tuple[str, ...]] = {
    "order": ("sort", "drop", "refuse"),
    "duplicates": ("last", "first", "mean", "refuse"),
    "clock_jumps": ("split", "join", "refuse"),
    "held": ("keep", "mask"),
    "quaternions": ("continuous", "keep"),
    "infinite": ("missing", "refuse"),
    "start": ("first_row", "clock"),
}


def _is_number(value: Any) -> bool:
    return (
        isinstance(value, int | float) and not isinstance(value, bool) and bool(np.isfinite(value))
    )


def assemble(recordings: Iterable[Recording], policies: Policies = Policies()) -> Dataset:  # noqa: B008  # frozen
    """Makes a data set of recordings: merges their signals and applies the policies.

    Args:
        recordings: at least one, with a row each; all are read before anything is returned.
        policies: what to do about faults.

    Returns:
        A trajectory per recording, or several where it was split. `meta` holds `time_unit`, the
        `report` of what each policy did, `labels` (where recordings have them) and `clock_start`
        (what the recording's clock showed at time 0, in `time_unit`, where that was not 0), each
        with an entry per trajectory.

    Raises:
        FileFormatError: a policy refuses, or nothing is left.
        InputError: `angles` names a channel that there is not.
    """
    raise NotImplementedError
