"""Anomalies of channels: repeated values, angles that wrap, quaternions that change sign."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Values = NDArray[np.float64]

REPEATED_FRACTION = 0.5
"""Minimum fraction of values that equal the previous one, for a channel with repeated values."""

_FEWEST_RUNS = 10
_LONG_RUN, _FEW_VALUES = 10, 10  # of a switch or a set point
_BLOCK = 1 << 14  # rows that fit in the cache
_QUATERNION = re.compile(r"(.*?)(?:^|[._\s\-/]|(?<=q)|(?<=quat)|(?<=quaternion))([wxyz])")
_ROTATION = re.compile(r"q$|quat|orient|rotation|attitude|(^|[._\s\-/])q", re.IGNORECASE)


@dataclass(frozen=True)
class Repeats:
    """The repetition of a slower sensor's values by a faster recording.

    Attributes:
        fraction: of its known values that equal the one before.
        rows_per_value: the usual (median) length of its runs of equal values, 2 or more.
    """

    fraction: float
    rows_per_value: int


def find_repeats(columns: Sequence[Values]) -> Repeats | None:
    """Finds whether a channel repeats the values of a slower sensor.

    It does if at least half of its known values equal the previous one, in 10 runs of equal values
    or more whose median length is 2 or more. A channel that is constant at times and otherwise
    changes at every row has mostly runs of one value and does not count, nor does a constant
    channel, or a switch or a set point: few values, each for more than 10 rows.

    Args:
        columns: (rows,) its values in each episode, NaN = missing.
    """
    if _changes_mostly(columns):
        return None
    columns = [_known(column) for column in columns]
    pairs = sum(len(column) - 1 for column in columns if len(column))
    repeats = sum(int(np.count_nonzero(column[1:] == column[:-1])) for column in columns)
    if not pairs or repeats < REPEATED_FRACTION * pairs:
        return None
    lengths: list[NDArray[np.int64]] = []
    for column in columns:
        if len(column):
            changes = np.flatnonzero(column[1:] != column[:-1]) + 1
            lengths.append(np.diff(changes, prepend=0))  # not the last run, which may be longer
    runs = np.concatenate(lengths)
    if len(runs) < _FEWEST_RUNS:
        return None
    usual = int(np.median(runs))
    if usual > _LONG_RUN:
        distinct = len(np.unique(np.concatenate(columns)))
        if distinct <= max(_FEW_VALUES, len(runs) // 10):
            return None
    return Repeats(repeats / pairs, usual) if usual >= 2 else None


def _changes_mostly(columns: Sequence[Values]) -> bool:
    """Whether a subset of the rows rules out that enough values equal the previous one.

    This is a fast test: two consecutive known values that differ are a change.
    """
    enough = (1 - REPEATED_FRACTION) * sum(len(column) - 1 for column in columns if len(column))
    changes = 0
    for column in columns:
        for start in range(0, len(column) - 1, _BLOCK):
            block = column[start : start + _BLOCK + 1]
            changes += int(np.count_nonzero(block[1:] > block[:-1]))
            changes += int(np.count_nonzero(block[1:] < block[:-1]))
            if changes > enough:
                return True
    return False


def _known(column: Values) -> Values:
    missing = np.isnan(column)
    return column[~missing] if missing.any() else column


def new_values(column: Values, rows_per_value: int) -> NDArray[np.bool_]:
    """Marks new values of a slower sensor: each change, and one per period while it is constant.

    Args:
        column: (n,) NaN = missing.
        rows_per_value: usual length of its runs of equal values.

    Returns:
        (n,) True at known values that are new.
    """
    at = np.flatnonzero(~np.isnan(column))
    fresh = np.zeros(len(column), dtype=bool)
    if len(at):
        known = column[at]
        new = np.append(True, known[1:] != known[:-1])
        starts = np.flatnonzero(new)
        since = np.arange(len(at)) - np.repeat(starts, np.diff(np.append(starts, len(at))))
        fresh[at] = since % rows_per_value == 0
    return fresh


def unwrap(column: Values, period: float) -> int:
    """Removes jumps by more than half a turn from an angle, in place; returns their number."""
    known = ~np.isnan(column)
    angles = column[known]
    if len(angles) < 2:
        return 0
    turns = np.round(np.diff(angles) / period)
    jumps = int(np.count_nonzero(turns))
    if jumps:
        column[known] = angles - period * np.append(0.0, np.cumsum(turns))
    return jumps


@dataclass(frozen=True)
class QuaternionChanges:
    """Counts of changes to the rows of a quaternion.

    Attributes:
        flipped: rows whose sign was changed to that of the row before.
        renormalised: rows whose length differed from 1 by more than 0.001.
        dropped: rows of length 0, or with one to three of the four values missing; all are NaN now.
    """

    flipped: int
    renormalised: int
    dropped: int


def make_continuous(four: Values) -> QuaternionChanges:
    """Makes a quaternion continuous in sign and of length 1, in place.

    Args:
        four: (n, 4) NaN = missing.
    """
    norm = np.sqrt((four * four).sum(axis=1))
    whole = norm > 1e-6  # False at NaN
    some = ~np.isnan(four).all(axis=1)
    four[some & ~whole] = np.nan
    unit = four[whole] / norm[whole, None]
    turned = (unit[1:] * unit[:-1]).sum(axis=1) < 0
    sign = np.where(np.append(0, np.cumsum(turned)) % 2 == 1, -1.0, 1.0)[: len(unit)]
    four[whole] = unit * sign[:, None]
    return QuaternionChanges(
        int((sign < 0).sum()),
        int((np.abs(norm[whole] - 1) > 1e-3).sum()),
        int((some & ~whole).sum()),
    )


def find_quaternions(names: Sequence[str], columns: Iterable[Values]) -> list[int]:
    """First columns of quaternions, which are found by their names and lengths.

    Names end in w, x, y, z or x, y, z, w after one stem that names a rotation (`qx`, `q_w`,
    `orientation.z`); three rows in four, where all are known, have a length within 0.05 of 1.

    Args:
        names: of channels.
        columns: (n,) values of each channel, in the same order.
    """
    parts = [_QUATERNION.fullmatch(name.casefold()) for name in names]
    columns = list(columns)
    found: list[int] = []
    for first in range(len(names) - 3):
        four = parts[first : first + 4]
        if (found and first < found[-1] + 4) or any(part is None for part in four):
            continue
        stems = {part[1] for part in four if part}
        letters = "".join(part[2] for part in four if part)
        if len(stems) > 1 or letters not in ("wxyz", "xyzw"):
            continue
        if not _ROTATION.search(next(iter(stems))):
            continue
        norm = np.sqrt(sum(column**2 for column in columns[first : first + 4]))
        norm = norm[~np.isnan(norm)]
        if len(norm) and (np.abs(norm - 1) < 0.05).mean() >= 0.75:
            found.append(first)
    return found
