"""Faults of channels: values held on a faster grid, angles that wrap, quaternions that flip."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Values = NDArray[np.float64]

HELD_SHARE = 0.5
"""Share of rows that repeat the value before them, from which on a channel can be held."""

_LONGEST_RUN = 64  # runs are counted up to this length, and longer ones as this long
_FEWEST_RUNS = 10
_QUATERNION = re.compile(r"(.*?)(?:^|[._\s\-/]|(?<=q)|(?<=quat)|(?<=quaternion))([wxyz])")
_ROTATION = re.compile(r"q$|quat|orient|rotation|attitude|(^|[._\s\-/])q", re.IGNORECASE)


@dataclass(frozen=True)
class Runs:
    """How long a channel stays at one value, counted over its known cells.

    Attributes:
        cells: known cells that have one before them.
        repeats: those that repeat the value of the one before.
        lengths: (64,) runs of equal values by length, from 1; the last counts the longer ones, too.
    """

    cells: int
    repeats: int
    lengths: NDArray[np.int64]

    def __add__(self, other: Runs) -> Runs:
        return Runs(
            self.cells + other.cells, self.repeats + other.repeats, self.lengths + other.lengths
        )

    @property
    def share(self) -> float:
        """Share of the cells that repeat the one before."""
        return self.repeats / self.cells if self.cells else 0.0

    @property
    def held(self) -> int:
        """Rows per value of a slower sensor that a faster log repeats; 0 where it is none.

        Held is a channel at least half of whose cells repeat the one before, in 10 runs or more
        whose usual (median) length is 2 or more. One that rests at a value has long runs between
        changes at every row, and is not held; a constant has one run.
        """
        runs = int(self.lengths.sum())
        if self.share < HELD_SHARE or runs < _FEWEST_RUNS:
            return 0
        middle = int(np.searchsorted(np.cumsum(self.lengths), runs / 2)) + 1
        return middle if middle >= 2 else 0


def count_runs(column: Values) -> Runs:
    """Runs of equal values among the known cells of a channel, but for the last, which is cut off."""
    known = column[~np.isnan(column)]
    if len(known) < 2:
        return Runs(0, 0, np.zeros(_LONGEST_RUN, dtype=np.int64))
    changes = np.flatnonzero(known[1:] != known[:-1]) + 1
    lengths = np.minimum(np.diff(changes, prepend=0), _LONGEST_RUN)
    counted = np.bincount(lengths, minlength=_LONGEST_RUN + 1)[1:]
    return Runs(len(known) - 1, len(known) - 1 - len(changes), counted)


def measured_anew(column: Values, held: int) -> NDArray[np.bool_]:
    """Where a held channel was measured: at each change, and every `held` rows while it rests.

    Args:
        column: (n,) NaN = missing.
        held: rows per value.

    Returns:
        (n,) True at known cells that are no repeats.
    """
    at = np.flatnonzero(~np.isnan(column))
    fresh = np.zeros(len(column), dtype=bool)
    if len(at):
        known = column[at]
        new = np.append(True, known[1:] != known[:-1])
        starts = np.flatnonzero(new)
        since = np.arange(len(at)) - np.repeat(starts, np.diff(np.append(starts, len(at))))
        fresh[at] = since % held == 0
    return fresh


def unwrap(column: Values, period: float) -> int:
    """Takes jumps by more than half a turn out of an angle, in place; says how many there were."""
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
class Mended:
    """What was done to the rows of a quaternion.

    Attributes:
        flipped: rows whose sign follows the row before, and did not.
        renormalised: rows whose length was off 1 by more than 0.001.
        dropped: rows of length 0, or with some but not all of four cells, which are missing now.
    """

    flipped: int
    renormalised: int
    dropped: int


def mend_quaternion(four: Values) -> Mended:
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
    return Mended(
        int((sign < 0).sum()),
        int((np.abs(norm[whole] - 1) > 1e-3).sum()),
        int((some & ~whole).sum()),
    )


def find_quaternions(names: Sequence[str], columns: Iterable[Values]) -> list[int]:
    """First columns of four in a row that are a quaternion by their names and their length.

    Names end in w, x, y, z or x, y, z, w after one stem that speaks of a rotation (`qx`, `q_w`,
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
