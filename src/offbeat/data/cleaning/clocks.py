"""Clocks of logs: units of time, given or detected, and integer nanoseconds.

A clock that counts from 1970 in float64 seconds has steps of 0.24 us, in float32 of 128 s. So
stamps are integers until the start is subtracted, and are converted to seconds afterwards.
"""

from __future__ import annotations

import functools
import re
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from offbeat.data.cleaning.odd_clocks import PACKED, packed
from offbeat.errors import FileFormatError, InputError, one_of

NANOSECONDS_PER = {
    "s": 1_000_000_000,
    "ms": 1_000_000,
    "us": 1_000,
    "100ns": 100,
    "ns": 1,
    "min": 60_000_000_000,
    "h": 3_600_000_000_000,
    "d": 86_400_000_000_000,
}
"""Units of time that a file may count in."""

_SPELLINGS = {
    "s": ("s", "sec", "secs", "second", "seconds"),
    "ms": ("ms", "msec", "msecs", "millis", "millisecond", "milliseconds"),
    "us": ("us", "µs", "μs", "usec", "usecs", "micros", "microsec", "microsecond", "microseconds"),
    "100ns": ("100ns", "100 ns"),
    "ns": ("ns", "nsec", "nsecs", "nanos", "nanosec", "nanosecs", "nanosecond", "nanoseconds"),
    "min": ("min", "mins", "minute", "minutes"),
    "h": ("h", "hr", "hrs", "hour", "hours"),
    "d": ("d", "day", "days"),
}
_UNIT_OF = {spelling: unit for unit, names in _SPELLINGS.items() for spelling in names}

_STEMS = ("time", "t", "timestamp", "stamp", "clock")
_SHORT = ("s", "ms", "us", "100ns", "ns")
_LONG = ("time", "timestamp", "elapsed")  # stems of minutes, hours, days: t_min is a minimum
_SINCE = (  # stems of names that end in a unit
    *("elapsed", "elapsed_time", "uptime", "epoch", "epoch_time", "unix", "unix_time", "utc"),
    *("system_time", "boot_time", "gps_time", "log_time", "device_time", "sensor_time"),
)
_ALONE = ("millis", "micros", "milliseconds", "microseconds", "nanoseconds")
TIME_NAMES = (
    *_STEMS,
    *(f"{stem}_{unit}" for stem in _STEMS for unit in _SHORT),
    *(f"{stem}_{unit}" for stem in _LONG for unit in ("min", "h", "d")),
    *("times", "timestamps", "time_stamp", "datetime", "date_time", "elapsed", "elapsed_time"),
    *("rosbag_timestamp", "ros_time", "header_stamp", "field_header_stamp", "log_time"),
    *("epoch", "unix_time", "unixtime", "utc", "utc_time", "sec", "secs", "seconds", "ts"),
    *("tow", "gps_tow", "time_of_week", "itow", "i_tow", "tout"),
    *("gps_time", "uptime", "zeit", "zeitstempel", "uhrzeit", "x_value", *_ALONE),
)
"""Names of time columns, in any case; the first one in a file is used. Names with a
unit give the unit, as do units in brackets, as in `t [ns]` and `Time (ms)`. A point, a blank or a
capital counts as `_`, so `TimeUS` is `time_us`; `#`, `%` and `_` before a name do not count."""

_BRACKETS = re.compile(r"(.*?)(\s*)(?:\[([^\[\]]*)\]|\(([^()]*)\))")
_WORDS = (
    "s ms us µs μs ns sec secs seconds msec usec nsec min h hr d m mm cm um km in ft rad deg "
    "degree degrees radians ° mrad v mv a ma n nm kn g kg mg hz khz mhz rpm w j pa kpa hpa bar "
    "psi ut µt mt gauss degc degf c k °c °f % pct m/s km/h mph dps count counts lsb px n·m n*m"
)
_UNIT_WORDS = frozenset(_WORDS.split())
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
    """Name and unit of a column: `speed [m/s]` is `("speed", "m/s")`; no unit is empty.

    Without a blank before the bracket, as in `speed(m/s)`, it must hold a known unit: `gyro[0]`,
    `acc(x)` and `f(t)` are names.
    """
    match = _BRACKETS.fullmatch(name.strip())
    if match is None or not match[1]:
        return name.strip(), ""
    unit = (match[3] or match[4] or "").strip()
    if not match[2] and not is_unit(unit):
        return name.strip(), ""
    return match[1], unit


def is_unit(text: str) -> bool:
    """Whether a text is a known unit, or a product, quotient or power of such."""
    if text.casefold() in _UNIT_WORDS:
        return True
    parts = re.split(r"[/*·^\s\d\-+²³⁻¹]+", text.casefold())
    known = [part for part in parts if part]
    return len(parts) > 1 and bool(known) and all(part in _UNIT_WORDS for part in known)


@functools.lru_cache(maxsize=1 << 14)
def folded(name: str) -> str:
    """A column's name without its unit, as it is compared: `%TimeUS`, `time.us` are `time_us`."""
    stem = split_unit(name)[0].lstrip("#%_ \t")
    stem = re.sub(r"(?<=[a-z])(?=[A-Z])", "_", stem)
    return re.sub(r"[\s./:,\-]+", "_", stem).strip("_").casefold()


def time_unit_in(name: str) -> str | None:
    """The unit in the name of a time column (`time_ms`, `t [ns]`, `TimeUS`), or None."""
    unit = split_unit(name)[1]
    if unit:
        return _UNIT_OF.get(unit.casefold())
    stem, _, last = folded(name).rpartition("_")
    if last in ("itow", "tow") and stem in ("", "i") and folded(name) != "tow":
        return "ms"  # of u-blox
    if stem and (last not in ("d", "h", "min") or stem in _LONG):
        return _UNIT_OF.get(last)
    alone = last in ("sec", "secs", "seconds", *_ALONE)
    return _UNIT_OF[last] if alone and not stem else None


def time_column_of(names: Sequence[str]) -> str | None:
    """The time column by its name, or None."""
    stems: dict[str, str] = {}
    for name in names:
        stems.setdefault(folded(name), name)
    for usual in TIME_NAMES:
        if usual in stems:
            return stems[usual]
    for stem, name in stems.items():
        if time_unit_in(name) and (
            stem.split("_")[0] in _STEMS or stem.rpartition("_")[0] in _SINCE
        ):
            return name
    # Such as host_timestamp; many names end in `time` and are durations.
    return next((n for s, n in stems.items() if s.endswith(("_timestamp", "_stamp"))), None)


_LAST = (
    *("time", "timestamp", "stamp", "clock", "clk", "ts", "monotonic", "zeit", "temps", "tiempo"),
    *("tempo", "tijd", "czas", "время", "時間", "时间"),
)


def may_be_time(name: str) -> bool:
    """Whether a name ends like one of times, before its unit: `sim_time`, `ts_ms`."""
    words = folded(name).split("_")
    if len(words) > 1 and words[-1] in _UNIT_OF:
        words.pop()
    return words[-1].endswith(_LAST[:3]) or words[-1] in _LAST


_SPLIT = {"ns": 10**9, "us": 10**6, "ms": 10**3}  # counts of the second column per second
_WEEK = {"s of a week": 1, "ms of a week": 1000}  # as GPS counts: weeks, and what is left of each
_WEEKS = ("week", "gps_week", "gpsweek", "gwk", "gps_wk", "wn", "wno", "week_number", "gps_wn")
_OF_WEEK = (
    *(
        "tow",
        "gps_tow",
        "gpstow",
        "time_of_week",
        "gps_time_of_week",
        "itow",
        "i_tow",
        "gms",
        "sow",
    ),
    *("tow_ms", "tow_s", "gps_tow_ms", "gps_tow_s", "week_ms", "gps_ms", "gps_sow", "week_seconds"),
    *("week_seconds", "seconds_of_week", "gps_seconds", "gps_second", "gps_seconds_of_week"),
)


def split_stamps(names: Sequence[str]) -> list[tuple[str, str, str]]:
    """Pairs of columns that may hold a stamp together: seconds, the rest, and unit of the rest.

    Such as `sec` and `nanosec`, `stamp.secs` and `stamp.nsecs`, `time_s` and `time_us`; or a week
    of GPS and the time of the week, which may be in either unit.
    """
    wholes: dict[str, str] = {}
    for name in names:
        stem, _, last = folded(name).rpartition("_")
        if _UNIT_OF.get(last) == "s":
            wholes.setdefault(stem, name)
    found = []
    for name in names:
        stem, _, last = folded(name).rpartition("_")
        unit = _UNIT_OF.get(last, "")
        if unit in _SPLIT and stem in wholes:
            found.append((wholes[stem], name, unit))
    weeks = next((name for name in names if folded(name) in _WEEKS), None)
    rest = next((name for name in names if folded(name) in _OF_WEEK), None)
    if weeks is not None and rest is not None:
        found += [(weeks, rest, unit) for unit in _WEEK]
    return found


def is_rest(whole: ArrayLike, rest: ArrayLike, unit: str) -> bool:
    """Whether numbers are whole seconds and, beside them, what is left of each in `unit`."""
    seconds, left = np.asarray(whole, dtype=np.float64), np.asarray(rest, dtype=np.float64)
    if not seconds.size or seconds.shape != left.shape:
        return False
    fits = (seconds == np.floor(seconds)) & (left >= 0)
    if unit in _WEEK:
        fits &= (seconds >= 0) & (seconds < 10_000) & (left < 604_800 * _WEEK[unit])
        return bool(fits.all()) and (unit == "s of a week") == bool(left.max() < 604_800)
    return bool((fits & (left == np.floor(left)) & (left < _SPLIT[unit])).all())


def join_stamp(whole: NDArray[Any], rest: NDArray[Any], unit: str) -> NDArray[np.int64]:
    """Integer nanoseconds of a stamp in two columns.

    Args:
        whole: (n,) seconds.
        rest: (n,) what is left of each, in `unit`.
        unit: `ns`, `us`, `ms`, or one of a week; the stamp then counts from the first week of GPS.

    Raises:
        FileFormatError: they are no such numbers.
    """
    if unit in _WEEK and is_rest(whole, rest, unit):
        within = np.rint(np.asarray(rest) * (1e9 / _WEEK[unit])).astype(np.int64)
        return np.asarray(whole).astype(np.int64) * (604_800 * 10**9) + within
    if not is_rest(whole, rest, unit):
        raise FileFormatError(
            "a stamp in two columns must be whole seconds, and from 0 to "
            f"{_SPLIT.get(unit, 604_800) - 1} {unit}; name the column of the time with time_column"
        )
    seconds, left = np.asarray(whole).astype(np.int64), np.asarray(rest).astype(np.int64)
    if int(np.abs(seconds).max()) >= 2**63 // 10**9:
        raise FileFormatError("times in seconds exceed 292 years; name the column of the time")
    return seconds * 10**9 + left * (10**9 // _SPLIT[unit])


def find_time_unit(clock: ArrayLike) -> tuple[str, str]:
    """Detects the unit of a clock from its numbers.

    A clock that shows a date from 2000 to 2100 is in the only unit that fits its numbers:
    seconds, milliseconds, microseconds, nanoseconds or ticks of 100 ns since 1970, or ticks since
    1601 (Windows) or the year 1 (.NET), unless its median step would then be longer than 1000 s
    and no whole number of minutes: a counter of microseconds passes such numbers after a quarter of
    an hour. A clock with another
    origin is in seconds, unless its median step would then be longer than 10 s and three steps or
    more agree. Then it is in the unit, of `ms`, `us` and `ns`, with the rate closest to 100 Hz.
    Days since 1970, 1900 (Excel), the year 0 (MATLAB) or noon of 1 January 4713 BC (Julian) from
    2000 to 2100 are days, where seconds would be more than 50,000 rows a second.

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
    steps = np.diff(numbers)
    steps = steps[steps > 0]
    step = float(np.median(steps)) if len(steps) >= 3 else 0.0
    for meaning, (unit, before) in _EPOCHS.items():
        per_second = 10**9 / NANOSECONDS_PER[unit]
        seconds = middle / per_second - before
        slow = step > _SLOWEST_EPOCH_S * per_second
        hourly = step >= 3600 * per_second and bool((steps % (60 * per_second) == 0).all())
        if _FIRST_YEAR <= seconds <= _LAST_YEAR and (not slow or hourly):
            return unit, f"numbers near {middle:.3g} are {meaning}"
    if not step:
        return "s", ""
    if step < _FASTEST_S:
        for meaning, (first, last) in _DAYS.items():
            if first <= middle <= last:
                return "d", f"numbers near {middle:.6g}, {step:.2g} apart, are {meaning}"
    if step <= _SLOWEST_S:
        return "s", ""
    rates = {unit: 1e9 / NANOSECONDS_PER[unit] / step for unit in ("ms", "us", "ns")}
    unit = min(rates, key=lambda u: abs(np.log(rates[u] / _TYPICAL_HZ)))
    return (
        unit,
        f"a median step of {step:g} would be a row every {step:g} s, not {rates[unit]:g} Hz",
    )


_DAYS = {
    "days since 1970": (10957.0, 36526.0),
    "days since 1900": (36526.0, 73051.0),
    "days since the year 0": (730486.0, 767011.0),
    "days since 4713 BC": (2451544.0, 2488070.0),
}
"""Days of 2000 and 2100 as R, Excel, MATLAB and astronomers count them."""

_FASTEST_S = 2e-5
_SLOWEST_EPOCH_S = 1000.0
_SLOW_S = 0.5  # a row per this time or longer is noted, where no unit is stated


class TimeUnit(NamedTuple):
    """The unit of a clock.

    Attributes:
        unit: one of `NANOSECONDS_PER`.
        notes: on a unit that was found or assumed, or that is not the one of the name.
        found: whether nothing states the unit: it was found from the numbers, or assumed.
    """

    unit: str
    notes: tuple[str, ...]
    found: bool = False


def state_time_unit(given: str | None, name: str, clock: ArrayLike, where: str) -> TimeUnit:
    """The unit of a clock: as given, else from its name, else detected from its numbers.

    Args:
        given: the option `time_unit`, or None.
        name: of the column, which may contain a unit.
        clock: (n,) some of its numbers.
        where: the file, for messages.

    Raises:
        InputError: the given unit is unknown.
    """
    named = time_unit_in(name)
    if given is not None:
        try:
            one_of("time unit", given, NANOSECONDS_PER)
        except InputError as error:
            raise InputError(f"{where}: {error}") from None
        if named not in (None, given):
            return TimeUnit(
                given, (f"times are read in {given}, as time_unit says, not as {name!r} does",)
            )
        return TimeUnit(given, ())
    numbers = np.asarray(clock, dtype=np.float64)
    numbers = numbers[np.isfinite(numbers)]
    steps = np.diff(numbers)
    steps = steps[steps > 0]
    step = float(np.median(steps)) if len(steps) >= 3 else 0.0
    if named is not None:
        seconds = step * NANOSECONDS_PER[named] / 1e9
        if not seconds or _FASTEST_S <= seconds * 1.001 <= _SLOWEST_EPOCH_S:
            return TimeUnit(named, ())
        return TimeUnit(
            named,
            (
                f"times are read in {named}, as {name!r} says: a row every {seconds:.3g} s; if "
                "they are not, state their unit with time_unit",
            ),
        )
    if digits := packed(numbers, folded(name)):
        raise FileFormatError(
            f"{where} has times such as {digits} in {name!r}, whose digits are {PACKED}; write "
            "them as 2026-11-24T21:00:00 or 21:00:00, or give time_unit= if they are plain numbers"
        )
    unit, why = find_time_unit(clock)
    if why:
        return TimeUnit(
            unit, (f"time is taken to be in {unit}: {why}; state it with time_unit",), True
        )
    whole = step > 0 and bool((steps == np.floor(steps)).all())
    if whole or step >= _SLOW_S:
        return TimeUnit(
            unit,
            (
                f"time is taken to be in s, a row every {step:g} s: {name!r} "
                f"{'holds whole numbers and ' * whole}names no unit; if they count ms "
                f"({1000 / step:.4g} Hz), or anything else, state it with time_unit",
            ),
            True,
        )
    if 0 < step < _FASTEST_S:
        return TimeUnit(
            unit,
            (
                f"time is taken to be in s, a row every {step:.3g} s: {name!r} names no unit; if "
                "they count days, or anything else, state it with time_unit",
            ),
            True,
        )
    return TimeUnit(unit, (), True)


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
