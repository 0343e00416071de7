"""Values that are no measurements: marks of missing values, zeros before the first one, spikes.

What separates them from a measurement that is far out, such as an impact, a contact or a step:

- A *sentinel* is one exact value that software writes where it has none (-999, 65535, 1e30), and
  nothing was measured between it and the others, over at least their whole range.
- *Start-up* values are exact zeros before a channel's first measurement, of a channel that never
  comes near 0 afterwards, by twice its range.
- A *spike* is a row or two, 1000 times as far from the median as every other value of the channel:
  more than a converter of 16 bits resolves beside noise, and more than a measured impact has, which
  rises and decays.

A channel of a few values, such as a switch, a mode or a gripper command, has none of the last two.
What is less certain is *suspect*: it is reported and never masked.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from offbeat.data.arrays import hand_over
from offbeat.data.trajectory import Dataset

Values = NDArray[np.float64]
Mask = NDArray[np.bool_]
Kind = Literal["sentinel", "start", "spike", "suspect"]

_ABSURD = 1e15
"""A larger value is no measurement of a channel whose other values are a million times smaller."""
_NINES = tuple(10.0**k - 1 for k in range(3, 9))
_INTEGER_LIMITS = (2**15 - 1, 2**15, 2**16 - 1, 2**31 - 1, 2**31, 2**32 - 1)
_CODES = np.unique(
    [
        *_NINES,
        *(limit / 10.0**k for limit in _INTEGER_LIMITS for k in range(8)),
        *(10.0**k for k in range(6, 15)),
    ]
)
"""Magnitudes that mark missing values: nines, limits of integers (also scaled), powers of ten."""
_SAME = 1e-7  # relative, of a code that was stored in float32

_FEW = 10  # distinct values of a switch, a mode or a command
_SENTINEL_GAP = 1.0  # ranges of the other values
_START_GAP = 2.0
_START_FRACTION = 0.05
_SPIKE, _SUSPECT_SPIKE = 1000.0, 50.0  # distances of the farthest other value
_SPIKE_FRACTION = 0.001
_SUSPECT_GAP = 10.0
_PLACES = 3  # that are listed
_SAMPLE = 2000


@dataclass(frozen=True)
class Outliers:
    """Values of one channel that are no measurements.

    Attributes:
        name: of the channel.
        kind: `sentinel`, `start` (zeros before the first measurement), `spike`, or `suspect`: not
            certain enough to be masked.
        value: of the sentinel; of spikes, the farthest one.
        count: number of them.
        at: episode, counted from 0, and time in s of the first three.
    """

    name: str
    kind: Kind
    value: float
    count: int
    at: tuple[tuple[int, float], ...]

    @property
    def masked(self) -> bool:
        """Whether `mask_outliers` masks them."""
        return self.kind != "suspect"

    def to_dict(self) -> dict[str, Any]:
        """JSON-like form."""
        return {**asdict(self), "at": [list(place) for place in self.at]}

    @classmethod
    def from_dict(cls, value: Mapping[str, Any]) -> Outliers:
        """The inverse of `to_dict`."""
        at = tuple((int(episode), float(time)) for episode, time in value["at"])
        return cls(value["name"], value["kind"], float(value["value"]), int(value["count"]), at)

    def __str__(self) -> str:
        """A sentence for the user."""
        first = ", ".join(f"{time:.6g} s" for _, time in self.at)
        where = f"at {first}{', ...' if self.count > len(self.at) else ''}"
        if self.at and any(episode != self.at[0][0] for episode, _ in self.at):
            where += f" of episodes {', '.join(str(episode) for episode, _ in self.at)}"
        elif self.at and self.at[0][0]:
            where += f" of episode {self.at[0][0]}"
        times = "1 value" if self.count == 1 else f"{self.count} values"
        said = {
            "sentinel": f"{times} of {self.value:g}, far from all others, mark missing values",
            "start": f"{times} of exactly 0 before the first measurement",
            "spike": f"{times} up to {self.value:.4g}, 1000 times as far out as all others",
            "suspect": f"{times} up to {self.value:.4g}, with none between them and the others, "
            "may be no measurements; they are kept",
        }
        return f"{self.name}: {said[self.kind]} ({where})"


@dataclass(frozen=True, eq=False)
class Found:
    """Values of a channel that are no measurements, as `search` returns them.

    Attributes:
        kind: as of `Outliers`.
        value: as of `Outliers`.
        rows: per episode, (rows,) True where the value is one of them.
    """

    kind: Kind
    value: float
    rows: tuple[Mask, ...]

    def described(self, name: str, times: Sequence[Values]) -> Outliers:
        """The record of a channel.

        Args:
            name: of the channel.
            times: (rows,) s, of each episode.
        """
        places = [
            (episode, float(clock[row]))
            for episode, (mask, clock) in enumerate(zip(self.rows, times, strict=True))
            for row in np.flatnonzero(mask)[:_PLACES]
        ]
        count = sum(int(mask.sum()) for mask in self.rows)
        return Outliers(name, self.kind, self.value, count, tuple(places[:_PLACES]))


def find_outliers(dataset: Dataset) -> tuple[Outliers, ...]:
    """Finds values that are no measurements in the states and exogenous channels.

    Args:
        dataset: in original units. `read` finds those of angles, before it unwraps them.
    """
    return tuple(found for found, _ in _all(dataset))


def mask_outliers(dataset: Dataset) -> Dataset:
    """The data set with values that are no measurements as not known.

    Args:
        dataset: in original units.

    Returns:
        The data set, with the values listed in its `meta["outliers"]`; the same object if there are
        none.
    """
    found = [(outliers, masks) for outliers, masks in _all(dataset) if outliers.masked]
    if not found:
        return dataset
    values = [t.values.copy() for t in dataset]
    for outliers, masks in found:
        c = dataset.names.index(outliers.name)
        for own, mask in zip(values, masks, strict=True):
            own[mask, c] = np.nan
    trajectories = tuple(
        replace(t, values=hand_over(own), observed=hand_over(t.observed & ~np.isnan(own)))
        for t, own in zip(dataset, values, strict=True)
    )
    listed = [outliers.to_dict() for outliers, _ in found]
    before = list(dataset.meta.get("outliers", ()))
    return replace(
        dataset,
        trajectories=trajectories,
        meta={**dataset.meta, "outliers": [*before, *listed]},
    )


def _all(dataset: Dataset) -> Iterable[tuple[Outliers, tuple[Mask, ...]]]:
    times = [t.times for t in dataset]
    for c, (name, role) in enumerate(zip(dataset.names, dataset.roles, strict=True)):
        if role != "action":
            for found in search([t.values[:, c] for t in dataset]):
                yield found.described(name, times), found.rows


def search(columns: Sequence[Values]) -> list[Found]:
    """Finds the values of a channel that are no measurements.

    Args:
        columns: (rows,) its values in each episode, NaN = missing.
    """
    with np.errstate(over="ignore", invalid="ignore"):  # values up to the largest float
        return _search(columns)


def _search(columns: Sequence[Values]) -> list[Found]:
    known = np.concatenate([column[~np.isnan(column)] for column in columns])
    if len(known) < 2 or not _has_a_gap(known):
        return []
    values, counts = np.unique(known, return_counts=True)
    found: list[Found] = []

    def take(kind: Kind, value: float, rows: Iterable[Mask]) -> None:
        found.append(Found(kind, value, tuple(rows)))

    marks = _absurd(values, counts)
    codes = _is_code(values) & ~marks
    other = ~marks & ~codes
    spikes = _spikes(values[other], counts[other], columns, _SPIKE)
    rest = np.setdiff1d(values[other], spikes)
    marks[codes] = _far_codes(values[codes], counts[codes], rest, len(known))
    for value in values[marks]:
        take("sentinel", float(value), (column == value for column in columns))
    if len(spikes):
        take("spike", _farthest(spikes, rest), (np.isin(column, spikes) for column in columns))
    left = np.isin(values, [*rest, *values[codes & ~marks]])
    values, counts = values[left], counts[left]
    start = _start(values, columns, len(known))
    if start is not None:
        take("start", 0.0, start)
        values, counts = values[values != 0], counts[values != 0]
    suspects = _spikes(values, counts, columns, _SUSPECT_SPIKE)
    if not len(suspects):
        suspects = _repeated(values, counts, columns, len(known))
    if len(suspects):
        rest = np.setdiff1d(values, suspects)
        take("suspect", _farthest(suspects, rest), (np.isin(c, suspects) for c in columns))
    return found


def _has_a_gap(known: Values) -> bool:
    """Whether a sample of the values, and the extremes, leave it open that some are far out.

    This is a fast test: all values together have no wider gap, and no smaller range, than a sample.
    """
    sample = known[:: max(len(known) // _SAMPLE, 1)]
    sample = np.sort(np.concatenate([sample, [known.min(), known.max()]]))
    steps = np.diff(sample)
    at = int(np.argmax(steps))
    below, above = sample[at] - sample[0], sample[-1] - sample[at + 1]
    inner = below if at + 1 > len(sample) / 2 else above
    return bool(steps[at] > 0.5 * inner)


def _absurd(values: Values, counts: NDArray[np.int64]) -> Mask:
    large = np.abs(values) >= _ABSURD
    if not large.any() or 2 * counts[large].sum() > counts.sum():
        return np.zeros(len(values), dtype=bool)
    usual = float(np.abs(values[~large]).max()) if not large.all() else np.inf
    return large & (np.abs(values) > 1e6 * usual)


def _is_code(values: Values) -> Mask:
    size = np.abs(values)
    at = np.clip(np.searchsorted(_CODES, size), 1, len(_CODES) - 1)
    nearest = np.minimum(np.abs(_CODES[at] - size), np.abs(_CODES[at - 1] - size))
    return np.asarray(nearest <= _SAME * size) & (size > 0)


def _far_codes(codes: Values, counts: NDArray[np.int64], rest: Values, known: int) -> Mask:
    """Which codes are sentinels: as far from the other values as these range."""
    if not len(rest):
        return np.zeros(len(codes), dtype=bool)
    low, high = rest[0], rest[-1]
    far = np.maximum(low - codes, codes - high) >= _SENTINEL_GAP * (high - low)
    # -999 is no command; 65535 beside 0 may be one.
    nines = (codes < 0) & np.isin(-codes, _NINES) & (codes < low)
    return np.asarray(far & (nines | (len(rest) >= 3)) & (2 * counts <= known))


def _spikes(
    values: Values, counts: NDArray[np.int64], columns: Sequence[Values], factor: float
) -> Values:
    """Distinct values that are `factor` times as far from the median as all others, if isolated."""
    none = values[:0]
    total = int(counts.sum())
    most = min(max(3, int(_SPIKE_FRACTION * total)), total // 20)
    if len(values) < _FEW or most < 1:
        return none
    median = values[np.searchsorted(np.cumsum(counts), total / 2)]
    distance = np.abs(values - median)
    order = np.argsort(distance)[::-1]
    ahead = np.cumsum(counts[order])
    for k in range(min(len(order) - 1, most)):
        if ahead[k] > most:
            break
        nearer = distance[order[k + 1]]
        if nearer > 0 and distance[order[k]] >= factor * nearer:
            found = np.sort(values[order[: k + 1]])
            rest = len(values) - len(found)
            return found if rest >= _FEW and _longest_run(columns, found) <= 2 else none
    return none


def _start(values: Values, columns: Sequence[Values], known: int) -> list[Mask] | None:
    """Leading zeros of each episode, where nothing else of the channel comes near 0."""
    rest = values[values != 0]
    if len(rest) == len(values) or len(rest) < _FEW:
        return None
    if max(rest[0], -rest[-1]) < _START_GAP * (rest[-1] - rest[0]):
        return None
    masks = []
    for column in columns:
        seen = ~np.isnan(column)
        masks.append(seen & (np.cumsum(seen & (column != 0)) == 0))
    leading = sum(int(mask.sum()) for mask in masks)
    zeros = sum(int((column == 0).sum()) for column in columns)
    return masks if leading == zeros and leading <= _START_FRACTION * known else None


def _repeated(
    values: Values, counts: NDArray[np.int64], columns: Sequence[Values], known: int
) -> Values:
    """The lowest or highest value, if it repeats in short runs, far from all others."""
    if len(values) > _FEW:
        for at, rest in ((0, values[1:]), (-1, values[:-1])):
            gap = np.abs(values[at] - rest).min()
            few = 3 <= counts[at] <= 0.3 * known
            if few and gap >= _SUSPECT_GAP * (rest[-1] - rest[0]):
                found = values[[at]]
                if _longest_run(columns, found) <= 3:
                    return found
    return values[:0]


def _longest_run(columns: Sequence[Values], found: Values) -> int:
    """The largest number of consecutive known values that are among the found ones."""
    longest = 0
    for column in columns:
        among = np.isin(column[~np.isnan(column)], found)
        edges = np.flatnonzero(np.diff(np.concatenate([[False], among, [False]]).astype(np.int8)))
        longest = max(longest, int(np.diff(edges)[::2].max(initial=0)))
    return longest


def _farthest(found: Values, rest: Values) -> float:
    middle = float(np.median(rest)) if len(rest) else 0.0
    return float(found[np.argmax(np.abs(found - middle))])
