"""Input transforms: angles without wraps, quaternions without sign flips, channels left out.

A model is trained on unwrapped angles and on quaternions that are continuous in sign, without
the marks of missing values, and without channels that it can learn nothing from. `Transforms`
records these channels; it is saved with the model, applied to all inputs of the model, and
undone on its predictions.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from offbeat.data.trajectory import Dataset, Trajectory
from offbeat.errors import InputError

Values = NDArray[np.float64]
Mask = NDArray[np.bool_]

META_KEY = "transforms"
"""Key of `Dataset.meta` with the transforms that were applied to a data set."""

_DEGREES = ("deg", "degree", "degrees", "\N{DEGREE SIGN}")
_UNIT_LENGTH = 1e-12  # a quaternion this close to length 1 is not normalised again
NO_LENGTH = 1e-6
"""A shorter quaternion has no direction."""


def is_angle_unit(unit: str) -> bool:
    """Whether a unit is one of radians or degrees."""
    return unit.casefold() in (*_DEGREES, "rad", "radian", "radians")


def full_turn(unit: str) -> float:
    """A full turn in the unit of an angle channel: 360 for degrees, else 2 pi."""
    return 360.0 if unit.casefold() in _DEGREES else 2 * math.pi


def lowest_of(low: float, high: float, period: float) -> float | None:
    """The lower end of the range that a wrapping angle is recorded in.

    Args:
        low: the lowest value recorded.
        high: the highest value recorded.
        period: a full turn.

    Returns:
        `-period / 2` or 0 if all values are within one turn from there; None if they are in
        neither range.
    """
    for lowest in (-period / 2, 0.0):
        if in_range(low, lowest, period) and in_range(high, lowest, period):
            return lowest
    return None


@dataclass(frozen=True)
class Angle:
    """A channel that is an angle.

    Attributes:
        period: a full turn, in the unit of the channel.
        lowest: lower end of the range that its sensor wraps to, in the unit of the channel; None
            where the recorded data never wrapped.
    """

    period: float
    lowest: float | None = None

    def __post_init__(self) -> None:
        if not (math.isfinite(self.period) and self.period > 0):
            raise InputError(
                f"the period of an angle must be finite and above 0, got {self.period!r}"
            )
        if self.lowest is not None and not math.isfinite(self.lowest):
            raise InputError(f"the lowest value of an angle must be finite, got {self.lowest!r}")


@dataclass(frozen=True)
class Transforms:
    """Transforms of the channels of a data set before they are given to a model.

    Each angle is unwrapped: a step of more than half a turn between two observations is treated as
    a wrap. Each quaternion is scaled to length 1, with the sign nearer to the observation before.
    The result depends only on earlier observations, so a stream and a batch agree. Values that mark
    missing ones are not observed. Channels that are constant, a copy of another one, or ignored are
    not given to the model; its predictions have the constant, the prediction of the other one, or
    none (NaN).

    Attributes:
        angles: the angle channels, by name.
        quaternions: four channel names per quaternion.
        missing: by channel, the values that mark a missing one, such as -999.
        constants: by channel, the value that it always has.
        copies: by channel, the one that it is a copy of.
        ignored: channels that are not given to the model and not predicted, such as counters.

    Raises:
        InputError: a quaternion does not have four channels, or a channel is named twice.
    """

    angles: Mapping[str, Angle] = field(default_factory=dict)
    quaternions: tuple[tuple[str, ...], ...] = ()
    missing: Mapping[str, tuple[float, ...]] = field(default_factory=dict)
    constants: Mapping[str, float] = field(default_factory=dict)
    copies: Mapping[str, str] = field(default_factory=dict)
    ignored: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "angles", dict(self.angles))
        fours = tuple(tuple(four) for four in self.quaternions)
        object.__setattr__(self, "quaternions", fours)
        missing = {name: tuple(values) for name, values in self.missing.items()}
        object.__setattr__(self, "missing", missing)
        object.__setattr__(self, "constants", dict(self.constants))
        object.__setattr__(self, "copies", dict(self.copies))
        object.__setattr__(self, "ignored", tuple(self.ignored))
        for four in fours:
            if len(four) != 4:
                raise InputError(f"a quaternion has four channels, got {list(four)}")
        names = [*self.angles, *(name for four in fours for name in four)]
        if len(set(names)) < len(names):
            twice = next(name for name in names if names.count(name) > 1)
            raise InputError(f"the channel {twice!r} is named twice in the transforms")
        for name, source in self.copies.items():
            if source in self.left_out:
                raise InputError(f"{name!r} is a copy of {source!r}, which is left out itself")

    @property
    def left_out(self) -> tuple[str, ...]:
        """The channels that are not given to the model."""
        return (*self.constants, *self.copies, *self.ignored)

    @property
    def named(self) -> set[str]:
        """The channels that a transform changes or leaves out."""
        fours = {name for four in self.quaternions for name in four}
        return {*self.angles, *fours, *self.missing, *self.left_out}

    @classmethod
    def identity(cls) -> Transforms:
        """Transforms that change nothing."""
        return cls()

    @classmethod
    def of(cls, dataset: Dataset) -> Transforms:
        """The transforms that were applied to a data set, by `apply` or its reader."""
        if META_KEY in dataset.meta:
            found = cls.from_dict(dataset.meta[META_KEY])
        else:
            log = dataset.meta.get("cleaning", {})
            turns, fours = log.get("angles", {}), log.get("quaternions", {})
            units = dict(zip(dataset.names, dataset.units, strict=True))
            angles = {  # data sets of 0.1.0 name the angles that jumped, without their period
                name: {"period": full_turn(units[name])}
                for name in turns.get("turns", {})
                if name in units
            } | turns.get("channels", {})
            found = cls.from_dict({"angles": angles, "quaternions": fours.get("channels", [])})
        return replace(
            found, missing=_merged(found.missing, masked_marks(dataset.meta))
        ).restricted(dataset.names)

    @property
    def is_identity(self) -> bool:
        """Whether the transforms change nothing."""
        return not (self.angles or self.quaternions or self.missing or self.left_out)

    def restricted(self, names: Sequence[str]) -> Transforms:
        """The transforms of these channels only."""
        return Transforms(
            {name: angle for name, angle in self.angles.items() if name in names},
            tuple(four for four in self.quaternions if set(four) <= set(names)),
            {name: values for name, values in self.missing.items() if name in names},
            {name: value for name, value in self.constants.items() if name in names},
            {name: of for name, of in self.copies.items() if {name, of} <= set(names)},
            tuple(name for name in self.ignored if name in names),
        )

    def to_dict(self) -> dict[str, Any]:
        """JSON-like form; kinds of transforms that there are none of are left out."""
        rest: dict[str, Any] = {
            "missing": {name: list(values) for name, values in self.missing.items()},
            "constants": dict(self.constants),
            "copies": dict(self.copies),
            "ignored": list(self.ignored),
        }
        return {
            "angles": {
                name: {"period": angle.period, "lowest": angle.lowest}
                for name, angle in self.angles.items()
            },
            "quaternions": [list(four) for four in self.quaternions],
            **{kind: found for kind, found in rest.items() if found},
        }

    @classmethod
    def from_dict(cls, value: Mapping[str, Any]) -> Transforms:
        """The inverse of `to_dict`.

        Raises:
            InputError: the record is damaged.
        """
        try:
            angles = {str(name): Angle(**angle) for name, angle in value["angles"].items()}
            missing = value.get("missing", {})
            return cls(
                angles,
                tuple(tuple(map(str, four)) for four in value["quaternions"]),
                {str(name): tuple(map(float, marks)) for name, marks in missing.items()},
                {str(name): float(one) for name, one in value.get("constants", {}).items()},
                {str(name): str(of) for name, of in value.get("copies", {}).items()},
                tuple(map(str, value.get("ignored", ()))),
            )
        except (AttributeError, KeyError, TypeError, ValueError) as error:
            raise InputError(
                f"the transforms are damaged ({type(error).__name__}: {error})"
            ) from None

    def apply(self, dataset: Dataset) -> Dataset:
        """Transforms a data set, except for transforms that were already applied.

        Values that are known and not observed follow the observations around them, and change
        nothing else.

        Args:
            dataset: with any of the channels, in original units.

        Returns:
            The data set, with the transforms listed in its `meta`; the same object if nothing
            changes.
        """
        done = Transforms.of(dataset)
        todo = self._without(done).restricted(dataset.names)
        if todo.is_identity:
            return dataset
        both = Transforms(
            {**done.angles, **todo.angles},
            (*done.quaternions, *todo.quaternions),
            _merged(done.missing, todo.missing),
            {**done.constants, **todo.constants},
            {**done.copies, **todo.copies},
            (*done.ignored, *todo.ignored),
        )
        return replace(
            dataset,
            trajectories=tuple(_transformed(t, todo) for t in dataset),
            meta={**dataset.meta, META_KEY: both.to_dict()},
        )

    def undo(self, predicted: Dataset, given: Dataset) -> Dataset:
        """Converts predictions back to the convention of the observed data.

        Angles get the turns of the last observation before them, and are within the range
        of the sensor if all observations before them were. Quaternions have
        length 1. Constants and copies get their values.

        Args:
            predicted: one trajectory of predictions per trajectory given.
            given: the observed data before `apply`.
        """
        if self.is_identity:
            return predicted
        todo = self._without(Transforms.of(given)).restricted(given.names)
        results = []
        for answer, trajectory in zip(predicted, given, strict=True):
            values = answer.values.copy()
            for name, angle in todo.angles.items():
                at = answer.names.index(name)
                values[:, at] = _wrapped_back(values[:, at], answer.times, trajectory, name, angle)
            for four in self.quaternions:
                columns = [answer.names.index(name) for name in four]
                values[:, columns] = unit_quaternions(values[:, columns])
            at_of = answer.names.index
            constants = {at_of(name): value for name, value in self.constants.items()}
            copies = {at_of(name): at_of(of) for name, of in self.copies.items()}
            results.append(replace(answer, values=values).given_back(constants, copies))
        return replace(predicted, trajectories=tuple(results))

    def _without(self, done: Transforms) -> Transforms:
        return Transforms(
            {name: angle for name, angle in self.angles.items() if name not in done.angles},
            tuple(four for four in self.quaternions if four not in done.quaternions),
            {
                name: left
                for name, marks in self.missing.items()
                if (left := tuple(m for m in marks if m not in done.missing.get(name, ())))
            },
            {n: value for n, value in self.constants.items() if n not in done.constants},
            {n: of for n, of in self.copies.items() if n not in done.copies},
            tuple(name for name in self.ignored if name not in done.ignored),
        )


def masked_marks(meta: Mapping[str, Any]) -> dict[str, tuple[float, ...]]:
    """By channel, the values that mark missing ones and were masked in a data set.

    Args:
        meta: of the data set, with what `mask_outliers` or its reader found.
    """
    cleaned = meta.get("cleaning", {}).get("outliers", {})
    found = [*meta.get("outliers", ())]
    if cleaned.get("option") == "mask":
        found += cleaned["found"]
    marks: dict[str, tuple[float, ...]] = {}
    for outliers in found:
        if outliers["kind"] in ("sentinel", "start"):
            marks = _merged(marks, {outliers["name"]: (outliers["value"],)})
    return marks


def _merged(
    some: Mapping[str, tuple[float, ...]], more: Mapping[str, tuple[float, ...]]
) -> dict[str, tuple[float, ...]]:
    return {
        name: tuple(dict.fromkeys((*some.get(name, ()), *more.get(name, ()))))
        for name in {**some, **more}
    }


def _transformed(trajectory: Trajectory, transforms: Transforms) -> Trajectory:
    values, observed = trajectory.values.copy(), trajectory.observed.copy()
    for name, marks in transforms.missing.items():
        c = trajectory.names.index(name)
        values[np.isin(values[:, c], marks), c] = np.nan
    for name in transforms.left_out:
        values[:, trajectory.names.index(name)] = np.nan
    observed &= ~np.isnan(values)
    for name, angle in transforms.angles.items():
        c = trajectory.names.index(name)
        known = ~np.isnan(values[:, c])
        sent, seen = values[known, c], observed[known, c]
        values[known, c] = sent - angle.period * _turns(sent, seen, angle.period)
    for four in transforms.quaternions:
        columns = [trajectory.names.index(name) for name in four]
        values[:, columns], observed[:, columns] = _continuous(
            values[:, columns], observed[:, columns]
        )
    return replace(trajectory, values=values, observed=observed)


def _turns(sent: Values, seen: Mask, period: float) -> Values:
    """(n,) turns to remove from each known value of an angle.

    Observed values follow each other. The others follow the last observation before them through
    the values between, or lead to the first one.
    """
    turns = _counted(sent, period)
    if seen.all() or not seen.any():
        return turns
    at = np.flatnonzero(seen)
    shift = _counted(sent[at], period) - turns[at]
    last = np.maximum(np.searchsorted(at, np.arange(len(sent)), side="right") - 1, 0)
    return turns + shift[last]


def _counted(sent: Values, period: float) -> Values:
    """(n,) turns since the first value, assuming steps of less than half a turn."""
    return np.append(0.0, np.cumsum(np.round(np.diff(sent) / period)))[: len(sent)]


def _continuous(four: Values, observed: Mask) -> tuple[Values, Mask]:
    """(n, 4) a quaternion without sign flips, of length 1, and its observed mask."""
    gone = observed.all(axis=1) & (lengths(four) <= NO_LENGTH)
    four = np.where(gone[:, None], np.nan, four)
    observed = observed & ~gone[:, None]
    complete, empty = observed.all(axis=1), ~observed.any(axis=1)
    unit = unit_quaternions(four)
    at = np.flatnonzero(complete)
    sign = np.ones(len(four))
    if len(at):
        flips = np.cumsum((unit[at][1:] * unit[at][:-1]).sum(axis=1) < 0)
        signs = np.where(np.append(0, flips) % 2 == 1, -1.0, 1.0)
        before = np.searchsorted(at, np.arange(len(four)), side="right") - 1
        last = np.maximum(before, 0)
        # A row observed in part has the sign of the last one observed in full, a masked row the
        # sign that is nearer to it.
        nearer = np.where((unit * unit[at[last]]).sum(axis=1) < 0, -1.0, 1.0)
        sign = np.where(empty, nearer * signs[last], np.where(before < 0, 1.0, signs[last]))
    # The length of a row observed in part is not known.
    scaled = np.asarray(complete | empty)
    return np.where(scaled[:, None], unit, four) * sign[:, None], observed


def _wrapped_back(
    predicted: Values, times: Values, given: Trajectory, name: str, angle: Angle
) -> Values:
    """(rows,) predictions of an angle with the turns of the last observation before each."""
    c = given.names.index(name)
    seen = given.observed[:, c]
    sent = given.values[seen, c]
    last = np.searchsorted(given.times[seen], times, side="left")  # 0: nothing was observed yet
    turns = np.append(0.0, _counted(sent, angle.period))[last]
    back = np.asarray(predicted + angle.period * turns)
    if angle.lowest is None:
        return back
    inside = np.logical_and.accumulate(np.asarray(in_range(sent, angle.lowest, angle.period)))
    wrapped = np.append(True, inside)[last]
    return np.where(wrapped, into_range(back, angle.lowest, angle.period), back)


def in_range(value: Any, lowest: Any, period: Any) -> Any:
    """Whether a value is within a turn from `lowest`, up to rounding in float32."""
    slack = 1e-6 * period
    return (value >= lowest - slack) & (value <= lowest + period + slack)


def into_range(value: Values, lowest: Any, period: Any) -> Values:
    """Values moved by whole turns into [lowest, lowest + period); those inside do not change."""
    return np.asarray(value - period * np.floor((value - lowest) / period))


def lengths(four: Values) -> Values:
    """(n,) the lengths of quaternions (n, 4)."""
    return np.asarray(np.sqrt((four * four).sum(axis=1)))


def unit_quaternions(four: Values) -> Values:
    """(n, 4) scaled to length 1; those of length 1 or 0 do not change."""
    length = lengths(four)
    keep = (np.abs(length - 1) <= _UNIT_LENGTH) | ~(length > NO_LENGTH)
    return four / np.where(keep, 1.0, length)[:, None]
