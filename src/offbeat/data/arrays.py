"""Read-only arrays that records own."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from typing import Any

import numpy as np
from numpy.typing import NDArray

from offbeat.errors import InputError


def frozen(value: Any, dtype: Any) -> NDArray[Any]:
    """Returns a read-only array that nothing else can write to; copies if needed.

    No copy is made of an array that is new (from a list or another dtype) or read-only,
    including the array that owns the memory, such as a slice of a record's array.

    Raises:
        TypeError, ValueError: `value` cannot be converted to `dtype`.
    """
    array = np.asarray(value, dtype=dtype)
    made_here = isinstance(value, list | tuple | np.ndarray) and array is not value
    if not (made_here and array.base is None) and not _is_frozen(array):
        array = array.copy(order="K")
    array.flags.writeable = False
    return array


def hand_over(array: NDArray[Any]) -> NDArray[Any]:
    """Makes an array read-only, so that records made from it need no copy.

    The array and the arrays that it is a view of become read-only. Call it last, on arrays that
    nothing else writes to.
    """
    part: Any = array
    while isinstance(part, np.ndarray):
        part.flags.writeable = False
        part = part.base
    return array


def without_mask(value: Any, what: str) -> Any:
    """A masked array as a plain one: NaN where it is masked; anything else as it is.

    Raises:
        InputError: times or other values without a NaN are masked.
    """
    if not isinstance(value, np.ma.MaskedArray):
        return value
    mask = np.ma.getmaskarray(value)
    if not mask.any():
        return value.data
    if what.startswith("times"):
        raise InputError(f"{what} are masked at row {int(mask.argmax())}; drop that row")
    return np.where(mask, np.nan, value.data.astype(np.float64))


def dates_of(times: Any) -> Any:
    """Dates and durations of pandas and Python as an array of NumPy; other times as they are.

    Those with an offset from UTC are in UTC.

    Raises:
        InputError: they are of several kinds.
    """
    if isinstance(times, np.ndarray) and times.dtype.kind != "O":
        return times
    kind = str(getattr(times, "dtype", ""))  # a DatetimeIndex or a Series is no array of NumPy
    first = next(iter(times), None) if isinstance(times, list | tuple) or kind == "object" else None
    try:
        if kind.startswith(("datetime64", "timedelta64")):
            return np.asarray(times, dtype=f"{kind.partition('[')[0]}[ns]")
        if isinstance(first, datetime):
            naive = [t.astimezone(UTC).replace(tzinfo=None) if t.tzinfo else t for t in times]
            if len({t.tzinfo is None for t in times}) > 1:
                raise ValueError("some have an offset from UTC and some have none")
            return np.array(naive, dtype="datetime64[ns]")
        if isinstance(first, timedelta):
            return np.array(list(times), dtype="timedelta64[ns]")
    except (AttributeError, TypeError, ValueError, OverflowError) as error:
        raise InputError(f"times must all be dates, or all durations: {error}") from None
    return times


def since_first(clock: NDArray[Any]) -> NDArray[np.float64]:
    """Seconds since the first entry of an array of `datetime64` or `timedelta64`.

    Raises:
        InputError: an entry is NaT.
    """
    if np.datetime_data(clock.dtype)[0] in ("Y", "M"):
        if clock.dtype.kind == "m":
            raise InputError(f"times are {clock.dtype}, which differ in length; give them in days")
        clock = clock.astype("datetime64[s]")
    missing = np.isnat(clock)
    if missing.any():
        raise InputError(f"times have NaT at row {int(missing.argmax())}; drop that row")
    if not clock.size:
        return np.zeros(clock.shape)
    ticks = clock - clock.reshape(-1)[0]  # exact, in the unit of the clock
    unit, count = np.datetime_data(ticks.dtype)
    if unit in ("ps", "fs", "as"):
        ticks = ticks.astype("timedelta64[ns]")
        unit, count = "ns", 1
    per_second = {"s": 1, "ms": 10**3, "us": 10**6, "ns": 10**9}.get(unit)
    if per_second is None or count != 1:
        return np.asarray(ticks / np.timedelta64(1, "s"), dtype=np.float64)
    return np.asarray(ticks.astype(np.int64) / per_second, dtype=np.float64)


def _is_frozen(array: NDArray[Any]) -> bool:
    part: Any = array
    while isinstance(part, np.ndarray):
        if part.flags.writeable:
            return False
        part = part.base
    return part is None or isinstance(part, bytes)
