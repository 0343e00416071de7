"""Groups of channels of which one is the derivative of the other: position, velocity, acceleration.

Names and units propose a pair, and data decide: over the same rows, the increments of the position
must be those of the integral of the velocity, times a factor that a conversion of units explains.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from offbeat.baselines.base import Array
from offbeat.data.trajectory import Dataset, Trajectory

SPANS = (1, 4, 16)
"""Observations between the ends of an increment: long ones where short ones are noise."""

ROWS = 20_000
"""Rows of a data set that are looked at, about."""

R2 = {"names": 0.8, "units": 0.9, "": 0.97}
"""Least coefficient of determination of a pair, by what proposes it."""

SLOPE = {"names": 0.2, "units": 0.1, "": 0.05}
"""Largest relative difference of the slope from the factor of the units."""

FACTORS = (1.0, 1e3, 1e-3, 1e2, 1e-2, math.degrees(1), math.radians(1), 2 * math.pi)
"""Factors to expect where units are not known and names agree."""

_KINDS = {
    0: "pos position positions q qpos angle angles pose theta p",
    1: "vel velocity velocities qvel dq qd qdot speed rate rates twist v dot omega",
    2: "acc accel acceleration accelerations qacc ddq qdd qddot a ddot",
}
_KIND = {word: kind for kind, words in _KINDS.items() for word in words.split()}
_SYMBOLS = ("x", "y", "z", "q", "theta", "phi", "psi", "roll", "pitch", "yaw")
_DERIVED = {
    form.format(symbol): (symbol, kind)
    for symbol in _SYMBOLS
    for kind, forms in ((1, ("v{}", "d{}", "{}dot", "{}d")), (2, ("a{}", "dd{}", "{}ddot", "{}dd")))
    for form in forms
}
_FILLERS = {"lin", "linear", "ang", "angular"}

_LENGTHS = {
    "m": ("m", 1.0),
    "mm": ("m", 1e-3),
    "cm": ("m", 1e-2),
    "km": ("m", 1e3),
    "rad": ("rad", 1.0),
    "deg": ("rad", math.radians(1)),
    "°": ("rad", math.radians(1)),
    "degree": ("rad", math.radians(1)),
    "degrees": ("rad", math.radians(1)),
    "rev": ("rad", 2 * math.pi),
}
_TIMES = {"s": 1.0, "sec": 1.0, "min": 60.0, "h": 3600.0}


@dataclass(frozen=True)
class Group:
    """A position and its measured derivatives, or a velocity and its derivative.

    Attributes:
        channels: numbers of the channels, position first.
        factors: units of each channel per unit of the derivative of the first; 1 for the first.
        slopes: of the regression of each pair of neighbours, relative to the expected factor.
        r2: coefficients of determination of the same.
        proposed: what proposed each pair: `names`, `units`, or nothing.
    """

    NUMBERS: ClassVar[int] = 12
    """Length of `numbers`."""

    channels: tuple[int, ...]
    factors: tuple[float, ...]
    slopes: tuple[float, ...]
    r2: tuple[float, ...]
    proposed: tuple[str, ...]

    def numbers(self) -> list[float]:
        """Everything as numbers, padded to three channels; `of` is the inverse."""
        short = 3 - len(self.channels)
        return [
            *self.channels,
            *[-1.0] * short,
            *self.factors,
            *[0.0] * short,
            *(v for pair in (self.slopes, self.r2) for v in (*pair, *[0.0] * short)),
            *(list(R2).index(p) for p in self.proposed),
            *[0.0] * short,
        ]

    @classmethod
    def of(cls, numbers: Array) -> Group:
        """From what `numbers` returned."""
        count = int((numbers[:3] >= 0).sum())
        slopes, r2, proposed = (numbers[k : k + count - 1].tolist() for k in (6, 8, 10))
        return cls(
            tuple(int(c) for c in numbers[:count]),
            tuple(numbers[3 : 3 + count].tolist()),
            tuple(slopes),
            tuple(r2),
            tuple(list(R2)[int(p)] for p in proposed),
        )

    def text(self, names: Sequence[str]) -> str:
        """One line for messages.

        Args:
            names: of all channels.
        """
        parts = [names[self.channels[0]]]
        for channel, slope, r2 in zip(self.channels[1:], self.slopes, self.r2, strict=True):
            parts.append(f"{names[channel]} (slope {slope:.3g}, R2 {r2:.3g})")
        return " <- ".join(parts)


def find_groups(dataset: Dataset) -> list[Group]:
    """Finds the groups of a data set.

    Args:
        dataset: of training; all known values are used.

    Returns:
        Groups that share no channel, in the order of their positions.
    """
    proposals = _proposals(dataset)
    if not proposals:
        return []
    slope, r2 = _regressions(dataset, sorted({x for x, _ in proposals}))
    accepted = []
    for (x, v), (proposed, factors) in proposals.items():
        # Of possible factors, the one that is nearest.
        factor = min(factors, key=lambda f: abs(math.log(max(slope[x, v], 1e-300) / f)))
        off = abs(slope[x, v] / factor - 1.0)
        if r2[x, v] >= R2[proposed] and off <= SLOPE[proposed]:
            accepted.append(((proposed != "names", -r2[x, v]), x, v, factor, proposed))
    below: dict[int, tuple[int, float, str]] = {}
    above: set[int] = set()
    for _, x, v, factor, proposed in sorted(accepted):
        if x not in below and v not in above and not _reaches(below, v, x):
            below[x] = (v, factor, proposed)
            above.add(v)
    return [_group(first, below, slope, r2) for first in sorted(below) if first not in above]


def _reaches(below: dict[int, tuple[int, float, str]], start: int, end: int) -> bool:
    while start in below:
        start = below[start][0]
        if start == end:
            return True
    return False


def _group(first: int, below: dict[int, tuple[int, float, str]], slope: Array, r2: Array) -> Group:
    channels, factors, proposals = [first], [1.0], []
    slopes, found = [], []
    while channels[-1] in below and len(channels) < 3:
        x = channels[-1]
        v, factor, proposed = below[x]
        channels.append(v)
        factors.append(factors[-1] / factor)
        proposals.append(proposed)
        slopes.append(float(slope[x, v] / factor))
        found.append(float(r2[x, v]))
    return Group(tuple(channels), tuple(factors), tuple(slopes), tuple(found), tuple(proposals))


# --- what is proposed -----------------------------------------------------------------------------


def _proposals(dataset: Dataset) -> dict[tuple[int, int], tuple[str, tuple[float, ...]]]:
    """Pairs (position, velocity): what proposes each, and its possible factors."""
    named = [kind_of(name) for name in dataset.names]
    units = [unit_of(unit) for unit in dataset.units]
    states = [i for i, role in enumerate(dataset.roles) if role == "state"]
    found: dict[tuple[int, int], tuple[str, tuple[float, ...]]] = {}
    for x in states:
        for v in states:
            if x == v:
                continue
            by_name = named[x][0] == named[v][0] and named[v][1] == named[x][1] + 1
            before, after = units[x], units[v]
            if before is not None and after is not None:
                if (before[0], before[2] + 1) != (after[0], after[2]):
                    continue
                factor = after[1] / before[1]
                found[x, v] = "names" if by_name else "units", (factor,)
            elif by_name:
                found[x, v] = "names", FACTORS
            elif before is None and after is None and named[x][1] == named[v][1]:
                # Neither names nor units tell: only a very good fit counts.
                found[x, v] = "", (1.0,)
    return found


def kind_of(name: str) -> tuple[tuple[str, ...], int]:
    """What a name says: its stem, and the number of derivatives.

    Args:
        name: such as `joint_1_velocity`, `vx`, `dq3`, `twist.linear.x`.

    Returns:
        Words that are left without those that say a kind; and 0, 1 or 2.
    """
    words = [w.lower() for w in re.findall(r"[A-Z]?[a-z]+|[A-Z]+|\d+", name)]
    # A single letter says a kind only where no longer word does: the a of a_position is a name.
    if any(word in _KIND and len(word) > 1 for word in words):
        kinds = {word: kind for word, kind in _KIND.items() if len(word) > 1}
    else:
        kinds = _KIND
    stem, kind = [], 0
    for word in words:
        if word in _DERIVED and word not in _KIND:
            word, derived = _DERIVED[word]
            kind = max(kind, derived)
        elif word in kinds:
            kind = max(kind, kinds[word])
            continue
        if word not in _FILLERS:
            stem.append(word)
    return tuple(stem), kind


def unit_of(unit: str) -> tuple[str, float, int] | None:
    """Dimension, size and number of time derivatives of a unit; None where it is not known.

    Args:
        unit: such as `m`, `mm/s`, `rad/s^2`, `rpm`.
    """
    text = unit.strip().replace("²", "^2").replace(" ", "").replace("**", "^")
    if not text:
        return None
    if text == "rpm":
        return "rad", 2 * math.pi / 60.0, 1
    if text == "g":
        return "m", 9.80665, 2
    base, _, per = text.partition("/")
    dimension, size = _LENGTHS.get(base, (base, 1.0))
    if not per:
        return dimension, size, 0
    power = re.fullmatch(r"\(?([a-z]+)\^?(\d?)\)?", per)
    if power is None or power[1] not in _TIMES:
        return None
    order = int(power[2] or 1)
    return dimension, size / _TIMES[power[1]] ** order, order


# --- what data say --------------------------------------------------------------------------------


def _regressions(dataset: Dataset, positions: Iterable[int]) -> tuple[Array, Array]:
    """Regresses increments of each channel on those of the integrals of all channels.

    Args:
        dataset: see `find_groups`.
        positions: channels whose increments are explained.

    Returns:
        (channels, channels) slopes and coefficients of determination, of the best span; 0 where
        there are too few increments, or no motion.
    """
    channels = dataset.channels
    sums = np.zeros((len(SPANS), 6, channels, channels))
    for t in _spread(dataset):
        integral, broken = _integrals(t)
        for x in positions:
            rows = np.flatnonzero(t.known[:, x])
            for i, span in enumerate(SPANS):
                first, last = rows[:-span], rows[span:]
                if not len(first):
                    continue
                gap = t.times[last] - t.times[first]
                near = gap <= 2.5 * np.median(gap)
                first, last = first[near], last[near]
                dx = (t.values[last, x] - t.values[first, x])[:, None]
                dv = integral[last] - integral[first]
                whole = broken[last] == broken[first]
                dv, dx = np.where(whole, dv, 0.0), np.where(whole, dx, 0.0)
                terms = (whole, dx, dv, dx * dx, dv * dv, dx * dv)
                for k, term in enumerate(terms):
                    sums[i, k, x] += term.sum(axis=0)
    n, sx, sv, xx, vv, xv = (sums[:, k] for k in range(6))
    many = np.maximum(n, 1)
    var_x, var_v, cov = xx - sx * sx / many, vv - sv * sv / many, xv - sx * sv / many
    moved = (n >= 20) & (var_x > 1e-12 * (xx + 1e-300)) & (var_v > 1e-12 * (vv + 1e-300))
    safe = np.where(moved, var_v, 1.0)
    slope = np.where(moved, cov / safe, 0.0)
    r2 = np.where(moved & (cov > 0), cov * cov / (safe * np.where(moved, var_x, 1.0)), 0.0)
    best = r2.argmax(axis=0)[None]
    return np.take_along_axis(slope, best, 0)[0], np.take_along_axis(r2, best, 0)[0]


def _spread(dataset: Dataset) -> list[Trajectory]:
    """Trajectories of about `ROWS` rows, spread evenly; long ones from their beginning."""
    lengths = np.array([t.rows for t in dataset])
    many = int(np.clip(ROWS / np.minimum(lengths, ROWS).mean(), 1, len(lengths)))
    chosen = np.unique(np.linspace(0, len(lengths) - 1, many).round().astype(int))
    return [dataset[i].slice(0, min(dataset[i].rows, ROWS)) for i in chosen.tolist()]


def _integrals(t: Trajectory) -> tuple[Array, NDArray[np.int64]]:
    """(rows, channels) integrals of linear interpolations, and how often each was interrupted.

    A channel is interrupted where it is not known for more than 2.5 of its typical gaps.
    """
    integral = np.zeros((t.rows, t.channels))
    broken = np.zeros((t.rows, t.channels), dtype=np.int64)
    steps = np.diff(t.times)
    for c in range(t.channels):
        rows = np.flatnonzero(t.known[:, c])
        if len(rows) < 3:
            broken[:, c] = np.arange(t.rows)
            continue
        value = np.interp(t.times, t.times[rows], t.values[rows, c])
        integral[1:, c] = np.cumsum(0.5 * (value[1:] + value[:-1]) * steps)
        gaps = np.diff(t.times[rows])
        long = gaps > 2.5 * np.median(gaps)
        there = np.zeros(t.rows, dtype=bool)
        there[rows[0] : rows[-1] + 1] = True
        for i in np.flatnonzero(long):
            there[rows[i] + 1 : rows[i + 1]] = False
            there[rows[i + 1]] = False
        broken[:, c] = np.cumsum(~there)
    return integral, broken
