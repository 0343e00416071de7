"""Clocks of logs: units of time, given or detected, and integer nanoseconds.

A clock that counts from 1970 in float64 seconds has steps of 0.24 us, in float32 of 128 s. So
stamps are integers until the start is subtracted, and are converted to seconds afterwards.
"""

from __future__ import annotations

import re
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from offbeat.errors import FileFormatError, InputError, one_of

NANOSECONDS_PER = {"s": 1_000_000_000, "ms": 1_000_000, "us": 1_000, "100ns": 100, "ns": 1}
"""Units of time that a file may count in."""

_SPELLINGS = {
    "s": ("s", "sec", "secs", "second", "seconds"),
    "ms": ("ms", "msec", "millis", "millisecond", "milliseconds"),
    "us": ("us", "µs", "usec", "micros", "microsecond", "microseconds"),
    "100ns": ("100ns", "100 ns"),
    "ns": ("ns", "nsec", "nanos", "nanosecond", "nanoseconds"),
}
_UNIT_OF = {spelling: unit for unit, names in _SPELLINGS.items() for spelling in names}

_STEMS = ("time", "t", "timestamp", "stamp", "clock")
TIME_NAMES = (*_STEMS, *(f"{stem}_{unit}" for stem in _STEMS for unit in NANOSECONDS_PER))
"""Names of time columns, in any case; the first one in a file is used. Names with a
unit give the unit, as do units in brackets, as in `t [ns]` and `Time (ms)`."""

_BRACKETS = re.compile(r"(.*?)\s+(?:\[([^\[\]]*)\]|\(([^()]*)\))")
_FIRST_YEAR, _LAST_YEAR = 946_684_800, 4_102_444_800  # 2000 and 2100, in seconds since 1970
_EPOCHS = {  # units of clocks, and seconds from the clock's zero to 1970
    "seconds since 1970": ("s", 0),
    "milliseconds since 1970": ("ms", 0),
    "microseconds since 1970": ("us", 0),
    "ticks of 100 ns since 1970": ("100ns", 0),
    "nanoseconds since 1970": ("ns", 0),
    "ticks of 100 ns since 1601": ("100ns", 11_644_473_600),
    "ticks of 100 ns since the year 1": ("100ns", 62_135_596_800),
}
_SLOWEST_S = 10.0  # if the median step in seconds is longer, another unit is assumed
_TYPICAL_HZ = 100.0


def split_unit(name: str) -> tuple[str, str]:
    """Name and unit of a column: `speed [m/s]` is `("speed", "m/s")`; no unit is empty."""
    match = _BRACKETS.fullmatch(name.strip())
    if match is None or not match[1]:
        return name.strip(), ""
    return match[1], (match[2] or match[3] or "").strip()


def time_unit_in(name: str) -> str | None:
    """The unit in the name of a time column (`time_ms`, `t [ns]`), or None."""
    stem, unit = split_unit(name)
    text = unit.casefold() or stem.casefold().rpartition("_")[2]
    return _UNIT_OF.get(text) if unit or "_" in stem else None


def time_column_of(names: list[str]) -> str | None:
    """The time column by its name, or None."""
    stems = {name: split_unit(name)[0].casefold().lstrip("#").strip() for name in names}
    for usual in TIME_NAMES:
        for name, stem in stems.items():
            if stem == usual:
                return name
    spelt = (n for n, stem in stems.items() if time_unit_in(n) and stem.split("_")[0] in _STEMS)
    return next(spelt, None)


def find_time_unit(clock: ArrayLike) -> tuple[str, str]:
    """Detects the unit of a clock from its numbers.

    A clock that shows a date from 2000 to 2100 is in the only unit that fits its numbers:
    seconds, milliseconds, microseconds, nanoseconds or ticks of 100 ns since 1970, or ticks since
    1601 (Windows) or the year 1 (.NET). A clock with another origin is in seconds, unless
    its median step would then be longer than 10 s and three steps or more agree. Then it is in the
    unit, of `ms`, `us` and `ns`, with the rate closest to 100 Hz.

    Args:
        clock: (n,) numbers, in the order of the log.

    Returns:
        The unit, and the reason for messages; the reason is empty where seconds are assumed
        by default.
    """
    numbers = np.asarray(clock, dtype=np.float64)
    numbers = numbers[np.isfinite(numbers)]
    if not numbers.size:
        return "s", ""
    middle = float(np.median(numbers))
    for meaning, (unit, before) in _EPOCHS.items():
        seconds = middle / (10**9 / NANOSECONDS_PER[unit]) - before
        if _FIRST_YEAR <= seconds <= _LAST_YEAR:
            return unit, f"numbers near {middle:.3g} are {meaning}"
    steps = np.diff(numbers)
    steps = steps[steps > 0]
    if len(steps) < 3 or np.median(steps) <= _SLOWEST_S:
        return "s", ""
    step = float(np.median(steps))
    rates = {unit: 1e9 / NANOSECONDS_PER[unit] / step for unit in ("ms", "us", "ns")}
    unit = min(rates, key=lambda u: abs(np.log(rates[u] / _TYPICAL_HZ)))
    return (
        unit,
        f"a median step of {step:g} would be a row every {step:g} s, not {rates[unit]:g} Hz",
    )


def state_time_unit(
    given: str | None, name: str, clock: ArrayLike, where: str
) -> tuple[str, tuple[str, ...]]:
    """The unit of a clock: as given, else from its name, else detected from its numbers.

    Args:
        given: the option `time_unit`, or None.
        name: of the column, which may contain a unit.
        clock: (n,) some of its numbers.
        where: the file, for messages.

    Returns:
        The unit, and notes on a detected unit.

    Raises:
        InputError: the given unit is unknown, or the name has another one.
    """
    named = time_unit_in(name)
    if given is not None:
        one_of("time unit", given, NANOSECONDS_PER)
        if named not in (None, given):
            raise InputError(
                f"{where}: the column {name!r} says that times are in {named}, time_unit says "
                f"{given}; leave time_unit out, or rename the column"
            )
        return given, ()
    if named is not None:
        return named, ()
    found, why = find_time_unit(clock)
    if not why:
        return found, ()
    return found, (f"time is taken to be in {found}: {why}; state it with time_unit",)


def to_nanoseconds(clock: NDArray[Any], unit: str) -> tuple[NDArray[np.int64], int]:
    """Integer nanoseconds of a clock, and what the clock shows at nanosecond 0.

    Integers are exact. Floats are rounded to whole nanoseconds, after their whole part at the
    start is subtracted. The second result is 0 unless nanoseconds since the clock's own zero
    exceed an int64, as for ticks of 100 ns since 1601.

    Args:
        clock: (n,) integers or floats, in `unit`.
        unit: one of `NANOSECONDS_PER`.

    Raises:
        FileFormatError: a time is not finite, or the times span more than 292 years, 146 in floats.
    """
    factor = NANOSECONDS_PER[one_of("time unit", unit, NANOSECONDS_PER)]
    clock = np.asarray(clock)
    if not clock.size:
        return np.zeros(0, dtype=np.int64), 0
    zero = 0
    if clock.dtype.kind in "iu":
        low, high = int(clock.min()), int(clock.max())
        if max(abs(low), abs(high)) * factor >= 2**63:
            zero = int(clock[0])
            if max(abs(low - zero), abs(high - zero)) * factor >= 2**63:
                raise FileFormatError(
                    f"times from {low} to {high} {unit} span more than 292 years; give the unit "
                    "that they are in with time_unit"
                )
            clock = clock - clock.dtype.type(zero)
        stamps = clock.astype(np.int64, copy=False)
        return stamps if factor == 1 else stamps * factor, zero
    floats = clock.astype(np.float64)
    bad = ~np.isfinite(floats)
    if bad.any():
        row = int(bad.argmax())
        raise FileFormatError(
            f"times must be finite seconds, got {floats[row]} at row {row}; drop that row"
        )
    whole = float(np.floor(floats[0]))
    least, most = float(floats.min()), float(floats.max())
    if max(abs(least - whole), abs(most - whole)) * factor >= 2.0**62:
        raise FileFormatError(
            f"times from {least:g} to {most:g} {unit} span more than 146 years; give the unit that "
            "they are in with time_unit"
        )
    since = np.rint((floats - whole) * factor).astype(np.int64)
    if max(abs(least), abs(most)) * factor >= 2.0**62:
        return since, int(whole)
    return since + int(whole) * factor, 0
