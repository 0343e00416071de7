"""Clocks that are no plain numbers: digits of dates and times of day, and counters that wrap."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

PACKED = "those of a date or of hours, minutes and seconds"
"""What the digits of a packed time are, for messages."""

_DIGITS = ((100, 60), (100, 60), (100, 24), (100, 32), (100, 13), (10_000, 2101))


def packed(numbers: NDArray[np.float64], name: str) -> str:
    """The first of numbers whose digits are a time, such as 20261124210000 and 210000; or empty.

    Those of hours, minutes and seconds alone are plain numbers, too, unless they pass from 59 to
    100 seconds or minutes, or are named `utc`.
    """
    if len(numbers) < 3 or (numbers < 0).any():
        return ""
    first = f"{numbers[0]:.15g}"
    high = float(numbers.max())
    if 1.9e13 < high < 2.11e13:
        return first if _are_digits(numbers, 6) and (numbers // 1e8 % 100 > 0).all() else ""
    if 1.9e16 < high < 2.11e16:
        return first if _are_digits(numbers // 1000, 6) else ""
    if not 100 < high < 240_000 or not _are_digits(numbers, 3):
        return ""
    seconds = numbers // 10_000 * 3600 + numbers // 100 % 100 * 60 + numbers % 100
    steps, decoded = np.diff(numbers), np.diff(seconds)
    if (decoded < 0).any() or (decoded == 0).all():
        return ""
    usual = float(np.median(decoded))
    passes = (steps - decoded >= 40) & (decoded <= 3 * usual) & (usual < 20)
    named = name.startswith(("utc", "gmt", "hhmmss")) and bool((numbers >= 100).all())
    return first if passes.any() or named else ""


def _are_digits(numbers: NDArray[np.float64], parts: int) -> bool:
    """Whether the digits of numbers are seconds, minutes, hours, days, months and years."""
    rest = numbers
    for base, end in _DIGITS[:parts]:
        if not (rest % base < end).all():
            return False
        rest = rest // base
    return True


_WRAPS = (16, 24, 32)  # bits of counters
_AT_WRAP = 50  # steps from the end, and from the start, of a counter that wraps


def without_wraps(clock: NDArray[Any]) -> tuple[NDArray[Any], str]:
    """A clock of whole numbers that counts on where a counter of 16, 24 or 32 bits wraps.

    It wraps where it falls from the last 50 steps below 2^bits (or 2^(bits - 1), where it is
    signed) to the first 50 above 0 (or -2^(bits - 1)), and the step, modulo 2^bits, is at most
    10 usual ones.

    Args:
        clock: (n,) integers or floats, in the order of the log.

    Returns:
        The clock, and a note; both are as given and empty where it does not wrap.
    """
    numbers = clock.astype(np.float64)
    if len(clock) < 4 or not np.isfinite(numbers).all():
        return clock, ""
    steps = np.diff(numbers)
    falls = np.flatnonzero(steps < 0)
    rises = steps[steps > 0]
    if not len(falls) or not len(rises) or len(falls) > len(rises) // 4:
        return clock, ""
    usual = float(np.median(rises))
    for bits in _WRAPS:
        size = float(2**bits)
        for low in (0.0, -size / 2):
            before, after = numbers[falls], numbers[falls + 1]
            near = (before >= low + size - _AT_WRAP * usual) & (after <= low + _AT_WRAP * usual)
            inside = low <= numbers.min() and numbers.max() < low + size
            if inside and near.all() and (after + size - before <= 10 * usual).all():
                turns = np.zeros(len(clock), dtype=np.int64)
                turns[falls + 1] = 1
                made = clock if clock.dtype.kind == "f" else clock.astype(np.int64)
                made = made + (np.cumsum(turns) * 2**bits).astype(made.dtype)
                times = "once" if len(falls) == 1 else f"{len(falls)} times"
                return (
                    made,
                    f"the clock is a counter of {bits} bits that wraps {times}; it counts on",
                )
    return clock, ""
