"""Options of the cleaning of recordings."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from offbeat.errors import InputError, one_of


@dataclass(frozen=True)
class ReaderOptions:
    """Options of the cleaning of recordings; each field is an option of `read`.

    With the defaults, no measured value is removed or invented. `Dataset.meta["cleaning"]`
    counts what each option did.

    Attributes:
        channels: names of the channels to keep, as in a data set of all channels, in this
            order; None keeps all. Rows in which none of them was logged are not read.
        without: names of channels to leave out, or of what several belong to: `pose` leaves out
            `pose.position.x`, and `q` leaves out `q[0]`.
        actions: names of channels to give the role `action`, in addition to those that the format
            marks. An action applies until the next logged one, and its values are not cleaned.
        exogenous: names of channels to give the role `exogenous`.
        order: rows whose time stamp is lower than one before it: `sort` them, `drop` them, or
            `refuse` the file.
        duplicates: of several known values of a channel at one time stamp, keep the `last` or the
            `first` one logged, or their `mean`, or `refuse` the file. `auto` keeps the last one,
            and refuses a file in which more than one row in 20 would lose a value: its time stamps
            are not those of its rows, or several sensors share them.
        clock_jumps: where a clock was set back, or forward by more than a day, while it was logged:
            `split` into episodes, `join` as if rows were out of order, or `refuse` the file.
        max_gap_s: s, a longer time without any row is an outage, where episodes are split. `auto`
            is 20 times the 95th percentile of the steps between rows, and at least 1 s; None never
            splits.
        min_rows: an episode that a split leaves with fewer rows than this is left out.
        repeated: channels of a slower sensor whose values are logged repeatedly at a higher rate:
            `keep` the repeated values, or `mask` them, so that only the first of each run of equal
            values counts as measured (of a run longer than usual, one value per period of the
            sensor).
        unwrap: whether jumps by a full turn are removed from channels that are angles.
        angles: names of more channels that are angles, in radians, or in degrees where their unit
            is `deg`.
        quaternions: `continuous` gives each row the sign that is nearer to the row before (q and -q
            are one rotation) and length 1, and treats one of length 0 as missing; `keep` does not
            change them.
        units: unit of a channel by its name, in place of what the file says.
        missing: numbers that stand for a value that is not known, such as -999.
        infinite: treat an infinite value as `missing`, or `refuse` the file.
        outliers: values that are no measurements, such as -999 or 1e30 far from all others, zeros
            before the first measurement, and spikes (see `offbeat.data.outliers`): `keep` them, or
            `mask` them, so that they are missing. `offbeat train` masks them by default.
        start: times start at the `first_row` of each episode, or are those of the recording's
            own `clock`.
        resample_hz: rows at this rate instead of at the time stamps; each row has the last values
            since the row before it, and NaN where there was none. None does not resample.

    Raises:
        InputError: a value is invalid.
    """

    channels: tuple[str, ...] | None = None
    without: tuple[str, ...] = ()
    actions: tuple[str, ...] = ()
    exogenous: tuple[str, ...] = ()
    order: Literal["sort", "drop", "refuse"] = "sort"
    duplicates: Literal["auto", "last", "first", "mean", "refuse"] = "auto"
    clock_jumps: Literal["split", "join", "refuse"] = "split"
    max_gap_s: float | Literal["auto"] | None = "auto"
    min_rows: int = 2
    repeated: Literal["keep", "mask"] = "keep"
    unwrap: bool = True
    angles: tuple[str, ...] = ()
    quaternions: Literal["continuous", "keep"] = "continuous"
    units: Mapping[str, str] | None = None
    missing: tuple[str | float, ...] = ()
    infinite: Literal["missing", "refuse"] = "missing"
    outliers: Literal["keep", "mask"] = "keep"
    start: Literal["first_row", "clock"] = "first_row"
    resample_hz: float | None = None

    def __post_init__(self) -> None:
        for name, choices in _CHOICES.items():
            one_of(name, getattr(self, name), choices)
        gap, rate = self.max_gap_s, self.resample_hz
        if gap not in ("auto", None) and not (is_number(gap) and gap > 0):  # type: ignore[operator]
            raise InputError(
                f"max_gap_s must be seconds above 0, 'auto', or None to never split, got {gap!r}"
            )
        if rate is not None and not (is_number(rate) and 0 < rate <= 1e9):
            raise InputError(
                f"resample_hz must be above 0 and at most 1e9, or None to leave the rows where "
                f"they are, got {rate!r}"
            )
        for name, names in (
            ("channels", self.channels),
            ("without", self.without),
            ("actions", self.actions),
            ("exogenous", self.exogenous),
            ("angles", self.angles),
        ):
            if names is None:
                continue
            if (
                isinstance(names, str | Mapping)
                or not isinstance(names, Iterable)
                or not all(isinstance(one, str) for one in names)
            ):
                raise InputError(f"{name} must be names of channels, got {names!r}")
            object.__setattr__(self, name, tuple(dict.fromkeys(names)))
        object.__setattr__(self, "missing", _numbers(self.missing))
        units = {} if self.units is None else self.units
        if not isinstance(units, Mapping) or not all(
            isinstance(text, str) for pair in units.items() for text in pair
        ):
            raise InputError(f"units must map names of channels to units, got {units!r}")
        if self.channels == ():
            raise InputError("channels must name at least one channel, or be None to keep all")
        if not isinstance(self.unwrap, bool):
            raise InputError(f"unwrap must be True or False, got {self.unwrap!r}")
        if isinstance(self.min_rows, bool) or not isinstance(self.min_rows, int):
            raise InputError(f"min_rows must be an integer, got {self.min_rows!r}")
        if self.min_rows < 1:
            raise InputError(f"min_rows must be at least 1, got {self.min_rows}")


_CHOICES: Mapping[str, tuple[str, ...]] = {
    "order": ("sort", "drop", "refuse"),
    "duplicates": ("auto", "last", "first", "mean", "refuse"),
    "clock_jumps": ("split", "join", "refuse"),
    "repeated": ("keep", "mask"),
    "quaternions": ("continuous", "keep"),
    "infinite": ("missing", "refuse"),
    "outliers": ("keep", "mask"),
    "start": ("first_row", "clock"),
}


def is_number(value: Any) -> bool:
    """Whether a value is a finite number, and no boolean."""
    if isinstance(value, bool) or not isinstance(value, int | float | np.integer | np.floating):
        return False
    try:
        return math.isfinite(value)
    except OverflowError:
        return False


def _numbers(given: Any) -> tuple[float, ...]:
    """The numbers of the option `missing`, which may be given as texts.

    Raises:
        InputError: it is something else.
    """
    listed = (given,) if isinstance(given, str | float | int) else given
    if isinstance(listed, Mapping) or not isinstance(listed, Iterable):
        raise InputError(f"missing must be numbers such as -999, got {given!r}")
    found: list[float] = []
    for one in listed:
        try:
            found.append(float(one))
        except (OverflowError, TypeError, ValueError):
            raise InputError(
                f"missing must be numbers such as -999, got {one!r}; texts are an option of CSV"
            ) from None
    return tuple(found)
