"""Anomalies of clocks: rows out of order, repeated time stamps, clock jumps, outages."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

Stamps = NDArray[np.int64]
Values = NDArray[np.float64]

_DAY = 86_400 * 10**9
_SECOND = 10**9
_FEW_STEPS = 20
_LATE_ROWS = 10  # a step back that lasts longer than this is not a late row


@dataclass(frozen=True, eq=False)
class Disorder:
    """Anomalies of the order of time stamps.

    Attributes:
        late: stamps that are lower than an earlier one.
        duplicates: stamps that occur in several rows.
    """

    late: Stamps
    duplicates: Stamps

    @property
    def any(self) -> bool:
        """Whether there is an anomaly."""
        return len(self.late) + len(self.duplicates) > 0


_IN_ORDER = Disorder(np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64))


def disorder(stamps: Stamps) -> Disorder:
    """Finds late rows and repeated stamps."""
    if (np.diff(stamps) > 0).all():
        return _IN_ORDER
    ordered = np.sort(stamps)
    return Disorder(
        stamps[stamps < np.maximum.accumulate(stamps)], ordered[1:][np.diff(ordered) == 0]
    )


def clock_jumps(stamps: Stamps) -> Stamps:
    """Finds rows at which the clock was set back, or forward by more than a day (and 20 steps).

    A step back counts if it is longer than a second and than 20 median steps, and if none of the
    next 10 rows reaches the old clock again; otherwise the row is late. If more than 1 row in
    100 steps back in this way, the rows are out of order, and no clock was set.
    """
    steps = np.diff(stamps)
    if not len(steps) or ((steps >= 0) & (steps <= _DAY)).all():
        return np.zeros(0, dtype=np.int64)
    forward = steps[steps > 0]
    usual = int(np.median(forward)) if len(forward) else 0
    back = np.flatnonzero(steps < -max(_SECOND, 20 * usual)) + 1
    if len(back) > max(3, len(stamps) // 100):
        back = back[:0]
    after = np.minimum(back[:, None] + np.arange(1, _LATE_ROWS + 1), len(stamps) - 1)
    stays = (stamps[after] < stamps[back - 1][:, None]).all(axis=1)
    # After the last row there is nothing to compare with.
    back = back[stays & (back < len(stamps) - 1)]
    far = max(_DAY, 20 * usual)
    ahead = np.flatnonzero(steps > far) + 1
    # A forward step from a late stamp does not count.
    reached = np.maximum.accumulate(stamps)
    ahead = ahead[stamps[ahead] - reached[ahead - 1] > far]
    return np.union1d(back, ahead)


def in_order(
    stamps: Stamps, values: Values, choice: Literal["sort", "drop", "refuse"]
) -> tuple[Stamps, Values]:
    """Sorts or drops late rows; `refuse` is left to the caller."""
    if (np.diff(stamps) >= 0).all():
        return stamps, values
    if choice == "drop":
        kept = stamps >= np.maximum.accumulate(stamps)
        return stamps[kept], values[kept]
    order = np.argsort(stamps, kind="stable")
    return stamps[order], values[order]


def one_row_per_stamp(
    stamps: Stamps, values: Values, choice: Literal["auto", "last", "first", "mean", "refuse"]
) -> tuple[Stamps, Values]:
    """Merges the rows of each stamp, per channel, over known values."""
    starts = np.flatnonzero(np.diff(stamps, prepend=stamps[:1] - 1) != 0)
    if len(starts) == len(stamps):
        return stamps, values
    return stamps[starts], merge_rows(values, starts, choice)


def rows_that_differ(stamps: Stamps, values: Values) -> int:
    """Number of rows with a known value other than the last one of their stamp.

    Args:
        stamps: (n,) in order.
        values: (n, channels) NaN = missing.
    """
    equal = np.diff(stamps) == 0
    shared = np.append(equal, False) | np.append(False, equal)  # not alone with its stamp
    stamps, values = stamps[shared], values[shared]
    if not len(stamps):
        return 0
    starts = np.flatnonzero(np.diff(stamps, prepend=stamps[:1] - 1) != 0)
    group = np.repeat(np.arange(len(starts)), np.diff(np.append(starts, len(stamps))))
    differ = np.zeros(len(stamps), dtype=bool)
    for c in range(values.shape[1]):  # column by column, to save memory
        column = values[:, c]
        last = merge_rows(column[:, None], starts, "last")[group, 0]
        differ |= ~np.isnan(column) & (column != last)
    return int(differ.sum())


def merge_rows(
    values: Values,
    starts: NDArray[np.int64],
    choice: Literal["auto", "last", "first", "mean", "refuse"],
) -> Values:
    """One row per group of rows: the `last` or `first` known value per channel, or the `mean`.

    Args:
        values: (n, channels) NaN = missing.
        starts: (groups,) first row of each group, increasing from 0.
        choice: which; `auto` and `refuse` count as `last`.

    Returns:
        (groups, channels).
    """
    merged = np.empty((len(starts), values.shape[1]), order="F")
    rows = np.arange(len(values))
    for c in range(values.shape[1]):  # column by column, to save memory
        column = values[:, c]
        known = ~np.isnan(column)
        if choice == "mean":
            total = np.add.reduceat(np.where(known, column, 0.0), starts)
            count = np.add.reduceat(known.astype(np.int64), starts)
            merged[:, c] = np.where(count > 0, total / np.maximum(count, 1), np.nan)
        elif choice == "first":
            at = np.minimum.reduceat(np.where(known, rows, len(values) - 1), starts)
            own = known[at] & (at < np.append(starts[1:], len(values)))
            merged[:, c] = np.where(own, column[at], np.nan)
        else:
            at = np.maximum.reduceat(np.where(known, rows, -1), starts)
            merged[:, c] = np.where(at >= 0, column[at], np.nan)
    return merged


def union(signals: list[tuple[Stamps, Values, list[int]]], channels: int) -> tuple[Stamps, Values]:
    """Merges signals on the union of their stamps; values that a signal lacks at a stamp are NaN.

    Args:
        signals: stamps that increase strictly, values, and the channel of each column.
        channels: total number of channels.

    Returns:
        (rows,) stamps and (rows, channels) values; the arrays of a single signal are not copied.
    """
    if len(signals) == 1:
        stamps, values, columns = signals[0]
        if columns == list(range(channels)):
            return stamps, values
    stamps = signals[0][0]
    for others, _, _ in signals[1:]:
        if len(others) != len(stamps) or not np.array_equal(others, stamps):
            stamps = np.unique(np.concatenate([s for s, _, _ in signals]))
            break
    merged = np.full((len(stamps), channels), np.nan, order="F")
    for own, values, columns in signals:
        rows: Any = slice(None) if len(own) == len(stamps) else np.searchsorted(stamps, own)
        for c, column in enumerate(columns):
            merged[rows, column] = values[:, c]
    return stamps, merged


def longest_allowed(stamps: Stamps, max_gap_s: float | Literal["auto"] | None) -> int | None:
    """Nanoseconds above which a step is an outage; None for no limit.

    `auto` is 20 times the 95th percentile of the steps without the longest one, and at least 1 s;
    with fewer than 20 steps there is no outage.
    """
    if max_gap_s is None:
        return None
    if max_gap_s != "auto":
        return round(min(float(max_gap_s) * 1e9, 2.0**62))
    steps = np.diff(stamps)
    if len(steps) < _FEW_STEPS:
        return None
    rank = min(math.ceil(0.95 * (len(steps) - 1)), len(steps) - 2)
    return max(_SECOND, 20 * int(np.partition(steps, rank)[rank]))
