"""Channels that a model learns nothing from: constants, copies, counters, and empty ones."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from offbeat.data.trajectory import ACTION, EXOGENOUS, STATE, Dataset, known_values
from offbeat.data.transforms import Transforms
from offbeat.errors import InputError, listed

_FEWEST = 20  # values of a counter or a copy
_FEW = 3  # distinct values of a copy, fewer than which two switches may agree by chance
_COUNTS = 0.8  # fraction of a counter's steps that are its usual one
_CLOCK = re.compile(r"time|stamp|clock|secs?$|nanos|elapsed", re.IGNORECASE)


@dataclass(frozen=True)
class Redundant:
    """Channels that a model learns nothing from, by what they are.

    Attributes:
        constants: by channel, its only value.
        copies: by channel, the one that has the same values.
        counters: sequence numbers and clocks.
        empty: channels without a value.
    """

    constants: Mapping[str, float] = field(default_factory=dict)
    copies: Mapping[str, str] = field(default_factory=dict)
    counters: tuple[str, ...] = ()
    empty: tuple[str, ...] = ()

    @property
    def names(self) -> tuple[str, ...]:
        """All of them."""
        return (*self.constants, *self.copies, *self.counters, *self.empty)

    def notes(self) -> tuple[str, ...]:
        """A sentence for each kind that there is."""
        copies = [f"{one} (of {of})" for one, of in self.copies.items()]
        said = (
            ("constant, so not learned, and given back as they are", list(self.constants)),
            ("copies, so not learned, and given the answer of the original", copies),
            ("counters or clocks, so not learned and not predicted", list(self.counters)),
            ("without a value, so not learned and not predicted", list(self.empty)),
        )
        return tuple(f"{what}: {listed(names)}" for what, names in said if names)


def find_redundant(dataset: Dataset) -> Redundant:
    """Finds the states and exogenous channels that a model learns nothing from.

    - A constant has a single value in the whole data set. Components of a quaternion are kept.
    - A copy has the values of another channel, in the same order, at times that differ by less than
      a typical step: a topic that was recorded twice. It has at least 20 values, 3 distinct.
    - A counter has integers that increase by the same step in at least 80 % of the cases, and
      otherwise by another one or back to its start; or it has the time of its own rows, in any
      unit, and a name that says so.

    Args:
        dataset: as it is to be trained on.
    """
    fours = Transforms.of(dataset).quaternions
    whole = {name for four in fours for name in four}
    constants: dict[str, float] = {}
    counters, empty = [], []
    groups: dict[bytes, list[int]] = {}
    for c, (name, role) in enumerate(zip(dataset.names, dataset.roles, strict=True)):
        if role == ACTION:
            continue
        known = [known_values(t, c) for t in dataset]
        values = np.concatenate(known)
        if not len(values):
            empty.append(name)
        elif values.min() == values.max():
            if name not in whole:
                constants[name] = float(values[0])
        elif _counts(known) or (_CLOCK.search(name) and _tells_time(dataset, c)):
            counters.append(name)
        elif len(values) >= _FEWEST and name not in whole:
            groups.setdefault(values.tobytes(), []).append(c)
    copies: dict[str, str] = {}
    for group in groups.values():
        group.sort(key=lambda c: dataset.roles[c] != STATE)
        for c in group[1:]:
            if _same_times(dataset, group[0], c):
                copies[dataset.names[c]] = dataset.names[group[0]]
    return Redundant(constants, copies, tuple(counters), tuple(empty))


def leave_out(dataset: Dataset, redundant: Redundant) -> Dataset:
    """The data set without the values of some channels, as a model is trained on it.

    The channels stay, as exogenous ones of which nothing is observed. The `Transforms` of the data
    set, which a model made for it keeps, give the constants and the copies back in every answer.

    Args:
        dataset: in original units.
        redundant: the channels.

    Raises:
        InputError: no state would be left.
    """
    transforms = Transforms(
        constants=redundant.constants,
        copies=redundant.copies,
        ignored=(*redundant.counters, *redundant.empty),
    )
    left = leave_out_of(dataset, transforms)
    if redundant.names and all(role == EXOGENOUS for role in left.roles):
        raise InputError(
            f"there is nothing to learn: {'; '.join(redundant.notes())}; give a log in which "
            "something else changes"
        )
    return left


def leave_out_of(dataset: Dataset, transforms: Transforms) -> Dataset:
    """As `leave_out`, with the channels that the transforms of a model leave out.

    Args:
        dataset: in original units.
        transforms: of the model.
    """
    names = set(transforms.left_out) & set(dataset.names)
    if not names:
        return dataset
    roles = tuple(
        EXOGENOUS if name in names else role
        for name, role in zip(dataset.names, dataset.roles, strict=True)
    )
    marked = replace(dataset, trajectories=tuple(replace(t, roles=roles) for t in dataset))
    out = Transforms(
        constants=transforms.constants, copies=transforms.copies, ignored=transforms.ignored
    )
    return out.apply(marked)


def _counts(known: list[NDArray[np.float64]]) -> bool:
    """Whether the values are integers that increase by a usual step, or go back to a start."""
    steps = np.concatenate([np.diff(values) for values in known])
    if len(steps) < _FEWEST or not all((values == np.rint(values)).all() for values in known):
        return False
    usual = float(np.median(steps))
    same = np.abs(steps - usual) <= 1e-3 * usual  # large ones are rounded
    back = steps <= 0
    wraps = all(  # a step back ends near the lowest value
        (after[np.diff(values) <= 0] <= after.min() + 2 * usual).all()
        for values in known
        if len(after := values[1:])
    )
    return bool(usual > 0 and same.mean() >= _COUNTS and back.mean() < 0.1 and wraps)


def _tells_time(dataset: Dataset, c: int) -> bool:
    """Whether the values are the time of their rows, in some unit, up to half a typical step."""
    compared = 0
    for t in dataset:
        known = ~np.isnan(t.values[:, c])
        times, values = t.times[known], t.values[known, c]
        if len(times) < 3:  # two are on a line whatever they measure
            continue
        compared += len(times)
        if values[-1] <= values[0]:
            return False
        scaled = (values - values[0]) * ((times[-1] - times[0]) / (values[-1] - values[0]))
        if np.abs(scaled - (times - times[0])).max() > 0.5 * float(np.median(np.diff(times))):
            return False
    return compared >= _FEWEST


def _same_times(dataset: Dataset, one: int, other: int) -> bool:
    """Whether two channels with the same values have them at about the same times."""
    distinct: set[float] = set()
    for t in dataset:
        a, b = ~np.isnan(t.values[:, one]), ~np.isnan(t.values[:, other])
        if a.sum() != b.sum() or not np.array_equal(t.values[a, one], t.values[b, other]):
            return False
        times = t.times[a]
        step = float(np.median(np.diff(times))) if len(times) > 1 else 0.0
        if len(times) and np.abs(times - t.times[b]).max() > step:
            return False
        distinct |= set(np.unique(t.values[a, one])[:_FEW].tolist())
    return len(distinct) >= _FEW
