"""Whether validation and test part are like the training part: range, spread and motion."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from offbeat.data.scaler import clipped
from offbeat.data.trajectory import STATE, Dataset, known_values
from offbeat.errors import listed

_FEWEST = 20  # values of a channel that are compared
_LAG = 10  # values, over which motion is measured
_OUTSIDE = 0.1  # fraction of the values beyond the training range
_MARGIN = 0.1  # of the training range
_MOTION = 5.0
_SPREAD = 3.0

Values = NDArray[np.float64]


def differences(train: Dataset, validation: Dataset, test: Dataset) -> tuple[str, ...]:
    """Sentences on how the validation and the test part differ from the training part.

    Per state, with at least 20 known values in both:

    - range: more than 10 % of the values are beyond that of training by a tenth of it;
    - motion: the mean change over 10 values is 5 times smaller or larger;
    - spread: the standard deviation of the inner 98 % is 3 times smaller or larger.

    Where half of the channels or more move less, the part is at rest. A channel is named once, for
    the first of: range, motion, spread.

    Args:
        train: the training part.
        validation: the validation part.
        test: the test part.
    """
    notes: list[str] = []
    for name, part in (("validation", validation), ("test", test)):
        notes += _sentences(name, *_compared(train, part))
    return tuple(notes)


def unlikeness(train: Dataset, validation: Dataset, test: Dataset) -> int:
    """A count of the differences; twice where the training part lacks what another one has.

    Args:
        train: the training part.
        validation: the validation part.
        test: the test part.
    """
    weights = {"range": 2, "more motion": 2, "more spread": 2, "less motion": 1, "less spread": 1}
    return sum(
        weights[kind] * len(names)
        for part in (validation, test)
        for kind, names in _compared(train, part)[0].items()
    )


def _compared(train: Dataset, part: Dataset) -> tuple[dict[str, list[str]], int]:
    """The states that differ, by kind, and the number of those compared."""
    found: dict[str, list[str]] = {}
    compared = 0
    for c, role in enumerate(train.roles):
        if role != STATE:
            continue
        kind = _difference(_columns(train, c), _columns(part, c))
        compared += kind is not None
        if kind:
            found.setdefault(kind, []).append(train.names[c])
    return found, compared


def _columns(dataset: Dataset, c: int) -> list[Values]:
    return [known_values(t, c) for t in dataset]


def _difference(own: Sequence[Values], other: Sequence[Values]) -> str | None:
    """What differs; empty if nothing does, and None if there are too few values."""
    a, b = np.concatenate(own), np.concatenate(other)
    if min(len(a), len(b)) < _FEWEST:
        return None
    low, high = float(a.min()), float(a.max())
    margin = _MARGIN * (high - low)
    if ((b < low - margin) | (b > high + margin)).mean() > _OUTSIDE:
        return "range"
    for kind, before, after, factor in (
        ("motion", _motion(own), _motion(other), _MOTION),
        ("spread", float(clipped(a).std()), float(clipped(b).std()), _SPREAD),
    ):
        if factor * after < before:
            return f"less {kind}"
        if after > factor * before:
            return f"more {kind}"
    return ""


def _motion(columns: Sequence[Values]) -> float:
    """Mean change over 10 values."""
    steps = [np.abs(column[_LAG:] - column[:-_LAG]) for column in columns if len(column) > _LAG]
    return float(np.concatenate(steps).mean()) if steps else 0.0


def _sentences(part: str, found: dict[str, list[str]], compared: int) -> list[str]:
    less = found.get("less motion", [])
    if less and 2 * len(less) >= compared:
        said = [
            f"the {part} part is at rest: {_who(less, 'change')} less than a fifth as much as in "
            "training, so its scores say little about motion; record more, or split differently"
        ]
    else:
        said = [
            f"in the {part} part, {_who(less, 'change')} less than a fifth as much as in training; "
            "its scores of that are those of a sensor at rest"
        ] * bool(less)
    for kind, verb, what in (
        ("range", "leave", "the range of the training part; predictions there are extrapolations"),
        ("more motion", "change", "more than 5 times as much as in training; errors are larger"),
        ("less spread", "vary", "less than a third as much as in training; scores are flattered"),
        ("more spread", "vary", "more than 3 times as much as in training; errors are larger"),
    ):
        if names := found.get(kind):
            said.append(f"in the {part} part, {_who(names, verb)} {what}")
    return said


def _who(names: list[str], verb: str) -> str:
    """Names and the verb in their number."""
    one = {"change": "changes", "leave": "leaves", "vary": "varies"}[verb]
    return f"{listed(names)} {one if len(names) == 1 else verb}"
