"""The base of every answer: causal baselines, weighted per channel, age and present motion."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from offbeat.baselines.base import (
    BASELINES,
    Array,
    Baseline,
    CausalBaseline,
    Rows,
    State,
    as_index,
    as_kind,
    moments,
    namespace,
    padded,
    stepped,
)
from offbeat.baselines.history import AgeBins, History, others_part, others_seen, usual_gaps
from offbeat.baselines.local_scale import LocalScale
from offbeat.baselines.members import fit_members
from offbeat.baselines.tables import Place
from offbeat.baselines.weights import Errors, as_if_refitted, simplex_weights, sources
from offbeat.data.trajectory import Dataset

ACTIVITY = (-1.5, -0.5)
"""Bounds of log10 of the local scale: a channel rests, moves little, or moves as usual."""

LEVELS = len(ACTIVITY) + 1

ENOUGH = 5
"""Observations of a channel that show how it moves, when errors are measured."""

FEW = 1e-3
"""Weight of the last value beside the members that are used out of the range of training."""

MARGIN = 0.5
"""Answers stay within the range of training, widened by this part of it on both sides."""


@dataclass(frozen=True, eq=False)
class Cells:
    """The values of a data set that are known, flat, with what is known about them beforehand.

    Attributes:
        task: (values,) position of the trajectory.
        row: (values,) its row.
        channel: (values,) its channel.
        key: (values,) kind of the value, see `Keys`.
        place: (values,) where it is between kinds.
        square: (values,) local scale.
        unit: (values,) usual size of an error, in original units.
        last: (values,) last value, or the training mean.
        truth: (values,) in original units.
    """

    task: NDArray[np.int64]
    row: NDArray[np.int64]
    channel: NDArray[np.int64]
    key: NDArray[np.int64]
    place: Place
    square: Array
    unit: Array
    last: Array
    truth: Array

    def pick(self, predicted: Sequence[Array]) -> Array:
        """(values,) of predictions, in units of an error since the last value.

        Args:
            predicted: (rows, channels) per trajectory.
        """
        return (values_at(predicted, self) - self.last) / self.unit


def values_at(predicted: Sequence[Array], cells: Cells) -> Array:
    """(values,) of (rows, channels) per trajectory."""
    starts = np.cumsum([0, *(len(p) for p in predicted)])
    flat = np.concatenate(predicted)
    return np.asarray(flat[starts[cells.task] + cells.row, cells.channel])


class Keys:
    """Kinds of values: the bin of the time since observation, others seen since, present motion.

    Where other channels were observed in the meantime (`others_seen`), as while one sensor is out,
    other predictors are right than where nothing was, as in a forecast: a velocity that is still
    measured gives the position. A value whose channel was never observed before has a kind of its
    own, the last one. Tables are fitted to the values of each kind, and interpolated between kinds
    (`place`), so that answers are continuous in time.

    Attributes:
        bins: of the time since observation.
        local: the present motion.
        each: kinds per bin; half of them where blends of before this distinction are read.
    """

    def __init__(self, bins: AgeBins, local: LocalScale, each: int = 2 * LEVELS) -> None:
        self.bins, self.local, self.each = bins, local, each

    def __len__(self) -> int:
        return len(self.bins) * self.each + 1

    def start(self, like: Any) -> State:
        """See `CausalBaseline`."""
        return self.local.start(like)

    def observe(self, state: State, time: Any, values: Any, mask: Any) -> State:
        """See `CausalBaseline`."""
        return self.local.observe(state, time, values, mask)

    def read(self, state: State, time: Any) -> Any:
        """(batch, channels, 5) kind, local scale, age, last value, and `others_part`."""
        xp = namespace(state["count"])
        age, square = History.age(state, time), state["square"]
        level = 0.0 * square
        for bound in ACTIVITY:
            level = level + (square > 10.0**bound)
        if self.each > LEVELS:
            level = xp.where(others_seen(age), level + LEVELS, level)
        never = xp.isinf(age)
        key = xp.where(never, float(len(self) - 1), self.bins.of_age(age) * self.each + level)
        last = History.last(state, as_kind(self.local.slope.mean, square))
        return xp.stack([key, square, age, last, others_part(age)], -1)

    def place(self, kind: Any) -> Place:
        """Where values are between kinds.

        Args:
            kind: (..., channels, 5) of `read`, an array or a tensor.
        """
        xp, age = namespace(kind), kind[..., 2]
        never = xp.isinf(age)
        at, part = self.bins.between(xp.where(never, 0.0, age))
        key = as_index(kind[..., 0])
        key = xp.where(never, key, at * self.each + (key % self.each) % LEVELS)
        alone = kind[..., 4] if self.each > LEVELS else 0.0 * part
        parts = xp.where(never[..., None], 0.0, xp.stack([part, alone], -1))
        return Place(key, parts, (self.each, LEVELS))

    @property
    def groups(self) -> NDArray[np.int64]:
        """(keys,) group of each kind: its bin of the time since observation."""
        return np.append(np.repeat(np.arange(len(self.bins)), self.each), len(self.bins))

    @property
    def usual(self) -> NDArray[np.int64]:
        """(bins,) the kinds of motion as usual where nothing was observed in the meantime."""
        return np.arange(len(self.bins)) * self.each + LEVELS - 1

    def measured(self, usual: Array) -> NDArray[np.int64]:
        """(keys, channels) the kind of the least time of a channel in tasks, or a longer one.

        After that time, others were observed in the meantime where they report more often.

        Args:
            usual: (channels,) s, gaps of the channels; 0 where they are not known.
        """
        own = np.arange(len(self))[:, None]
        at = self.bins.of_age(usual)
        target = at * self.each + (own % self.each) % LEVELS
        if self.each > LEVELS:
            target = target + LEVELS * others_seen(np.where(usual > 0, usual, np.inf))
        return np.asarray(
            np.where((self.groups[:, None] < at) & (own < len(self) - 1), target, own)
        )

    def ages(self) -> Array:
        """(keys,) s, upper end of the bin; infinite for the last kind."""
        return np.append(np.repeat(self.bins.edges, self.each), np.inf)

    def unit(self, kind: Any) -> Any:
        """(...) typical size of an error, in original units.

        The usual error at that time since observation, times the fourth root of the local scale.

        Args:
            kind: (..., channels, 5) of `read`, an array or a tensor.
        """
        xp, age = namespace(kind), kind[..., 2]
        usual = xp.sqrt(self.local.usual_at(age))
        unit = xp.where(xp.isinf(age), as_kind(self.local.slope.scale, kind), usual)
        return unit * kind[..., 1] ** 0.25

    def cells(self, tasks: Dataset, *, afterwards: bool = False) -> Cells:
        """The known values of tasks.

        Args:
            tasks: masked.
            afterwards: whether the first values of a trajectory, before it is known how it moves,
                have the kinds of those that follow. What is learned of a channel at rest comes
                then from channels at rest alone.
        """
        parts: list[tuple[NDArray[Any], ...]] = []
        first = 0
        for rows in padded(tasks):
            read = stepped(_Afterwards.of(self, rows) if afterwards else self, rows)
            task, row, channel = np.nonzero(rows.known)
            key, square, _, last, _ = np.moveaxis(read[task, row, channel], -1, 0)
            place = self.place(read)[task, row, channel]
            own = place.key, place.part, square, self.unit(read)[task, row, channel], last
            truth = rows.values[task, row, channel]
            parts.append((task + first, row, channel, key.astype(np.int64), *own, truth))
            first += len(rows.lengths)
        flat = [np.concatenate(column) for column in zip(*parts, strict=True)]
        task, row, channel, key, at, part, square, unit, last, truth = flat
        place = Place(at, part, (self.each, LEVELS))
        return Cells(task, row, channel, key, place, square, unit, last, truth)


@dataclass(frozen=True, eq=False)
class _Afterwards:
    """Kinds of trajectories whose present motion is known from the start.

    Attributes:
        keys: of the kinds.
        square: (batch, channels) local scale at the start.
    """

    keys: Keys
    square: Array

    @classmethod
    def of(cls, keys: Keys, rows: Rows) -> _Afterwards:
        """With the local scale after `ENOUGH` observations, or after all."""
        square = stepped(keys.local, rows)
        enough = rows.observed.cumsum(axis=1) >= ENOUGH
        # It is read before a row is observed.
        after = enough.argmax(axis=1) + 1
        after = np.where(enough.any(axis=1), np.minimum(after, square.shape[1] - 1), -1)
        return cls(keys, np.take_along_axis(square, after[:, None], axis=1)[:, 0])

    def start(self, like: Any) -> State:
        return {**self.keys.start(like), "square": self.square}

    def observe(self, state: State, time: Any, values: Any, mask: Any) -> State:
        return self.keys.observe(state, time, values, mask)

    def read(self, state: State, time: Any) -> Any:
        return self.keys.read(state, time)


def independent_tasks(ages: Array, span_s: float, gap_s: float) -> Array:
    """(keys,) most independent tasks of each kind: spans of its length in the data.

    Args:
        ages: (keys,) s; infinite for values before the first observation.
        span_s: s, length of the data.
        gap_s: s, its typical gap.
    """
    lengths = np.where(np.isinf(ages), np.max(ages[np.isfinite(ages)], initial=gap_s), ages)
    return np.asarray(np.maximum(span_s / np.maximum(lengths, gap_s), 1.0))


class Stack(CausalBaseline):
    """Causal baselines, averaged with weights on a simplex.

    Attributes:
        members: fitted baselines by name.
        keys: kinds of values that have weights of their own.
        weights: (keys, channels, members).
        low: (channels,) lowest answer.
        high: (channels,) highest answer.
        reach: (channels,) farthest that an answer outside this range is from the last value.
    """

    flexible = True

    members: dict[str, CausalBaseline]
    keys: Keys
    weights: Array
    low: Array
    high: Array
    reach: Array

    def start(self, like: Any) -> State:
        """See `CausalBaseline`."""
        state = {"keys": self.keys.start(like)}
        return {**state, **{name: member.start(like) for name, member in self.members.items()}}

    def observe(self, state: State, time: Any, values: Any, mask: Any) -> State:
        """See `CausalBaseline`."""
        after = {"keys": self.keys.observe(state["keys"], time, values, mask)}
        for name, member in self.members.items():
            after[name] = member.observe(state[name], time, values, mask)
        return after

    def read(self, state: State, time: Any) -> Any:
        """See `CausalBaseline`."""
        kind = self.keys.read(state["keys"], time)
        each = [member.read(state[name], time) for name, member in self.members.items()]
        return self.mixed(each, kind)

    def mixed(self, each: Sequence[Any], kind: Any) -> Any:
        """The weighted mean of predictions.

        Args:
            each: (..., channels) per member.
            kind: (..., channels, 5) of `Keys.read`.
        """
        weights = self.keys.place(kind).average(as_kind(self.weights, kind))
        xp, last = namespace(kind), kind[..., 3]
        total = located = share = 0.0 * last
        for j, (member, predicted) in enumerate(zip(self.members.values(), each, strict=True)):
            if member.located:
                located = located + weights[..., j] * predicted
            else:
                total = total + weights[..., j] * predicted
                share = share + weights[..., j]
        # A channel that left the range of training, as by a drift, need not come back.
        left = (last < as_kind(self.low, kind)) | (last > as_kind(self.high, kind))
        elsewhere = (total + FEW * last) / (share + FEW)
        return self.bounded(xp.where(left, elsewhere, total + located), last)

    def bounded(self, value: Any, last: Any) -> Any:
        """A value within the range of answers, or as near to the last value as any move was."""
        xp = namespace(value)
        reach = as_kind(self.reach, value)
        low = xp.minimum(as_kind(self.low, value) + 0.0 * last, last - reach)
        high = xp.maximum(as_kind(self.high, value) + 0.0 * last, last + reach)
        return xp.minimum(xp.maximum(value, low), high)

    def predict(self, dataset: Dataset) -> list[Array]:
        """Predicts every row; see `Baseline.predict`."""
        return self.mix([member.predict(dataset) for member in self.members.values()], dataset)

    def mix(self, each: Sequence[Sequence[Array]], dataset: Dataset) -> list[Array]:
        """The weighted mean of the members' predictions of a data set.

        Args:
            each: per member and trajectory (rows, channels).
            dataset: that they predicted.
        """
        kinds = kinds_of(self.keys, dataset)
        return [self.mixed([p[i] for p in each], kind) for i, kind in enumerate(kinds)]

    def arrays(self) -> dict[str, Array]:
        """See `Baseline`."""
        own = {
            **super().arrays(),
            "weights": self.weights,
            "low": self.low,
            "high": self.high,
            "reach": self.reach,
            "edges": self.keys.bins.edges,
        }
        nested = {f"local.{k}": v for k, v in self.keys.local.arrays().items()}
        return {**own, **nested, **arrays_of(self.members)}

    def restore(self, arrays: Mapping[str, Array]) -> Stack:
        """See `Baseline`."""
        own = {k: v for k, v in arrays.items() if "." not in k}
        edges = own.pop("edges")
        super().restore(own)
        local = LocalScale().restore(within(arrays, "local."))
        self.keys = Keys(AgeBins(edges), local, (len(self.weights) - 1) // len(edges))
        self.members = {
            n: m for n, m in members_of(arrays).items() if isinstance(m, CausalBaseline)
        }
        return self


def arrays_of(members: Mapping[str, Baseline]) -> dict[str, Array]:
    """The arrays of fitted baselines, with names that keep their order.

    Args:
        members: by name.
    """
    return {
        f"member.{i:03d}.{name}.{k}": v
        for i, (name, member) in enumerate(members.items())
        for k, v in member.arrays().items()
    }


def members_of(arrays: Mapping[str, Array]) -> dict[str, Baseline]:
    """The inverse of `arrays_of`; other arrays are ignored.

    Args:
        arrays: in any order.
    """
    heads = sorted({".".join(k.split(".")[:3]) for k in arrays if k.startswith("member.")})
    return {
        head.split(".")[2]: BASELINES[head.split(".")[2]]().restore(within(arrays, f"{head}."))
        for head in heads
    }


def within(arrays: Mapping[str, Array], prefix: str) -> dict[str, Array]:
    """The arrays whose names start with a prefix, without it."""
    return {k[len(prefix) :]: v for k, v in arrays.items() if k.startswith(prefix)}


def kinds_of(keys: Keys, dataset: Dataset) -> list[Array]:
    """(rows, channels, 5) per trajectory, as `Keys.read`."""
    return [
        read[:length]
        for rows in padded(dataset)
        for read, length in zip(stepped(keys, rows), rows.lengths, strict=True)
    ]


def fit_stack(
    members: Sequence[str],
    train: Dataset,
    validation: Dataset,
    *,
    span_s: float,
    gap_s: float,
    budget_s: float | None = None,
) -> tuple[Stack, Cells, list[Array], NDArray[np.int64]]:
    """Fits causal baselines to training tasks, and their weights to training and validation tasks.

    Of a flexible baseline, the errors on training tasks are those of a fit to other tasks.

    Args:
        members: names of causal baselines.
        train: tasks of the training data, from `draw_tasks`.
        validation: tasks of other data.
        span_s: s, length of the data that all tasks were drawn from.
        gap_s: s, its typical gap.
        budget_s: s, for the fits; see `fit_members`.

    Returns:
        The stack, the values of the validation tasks (`Keys.cells`, afterwards), the stack's
        predictions of these tasks with weights fitted to the training tasks alone, and (keys,
        channels) `Errors.source`.
    """
    stack = Stack()
    stack.mean, stack.scale = moments(train)
    stack.low, stack.high = bounds(train)
    stack.keys = Keys(AgeBins.of(train), LocalScale().fit(train))
    stack.members = {}
    found = fit_members(members, train, validation, budget_s=budget_s)
    for name, member in found.items():
        assert isinstance(member.baseline, CausalBaseline)
        stack.members[name] = member.baseline
    predicted, later = [m.train for m in found.values()], [m.validation for m in found.values()]
    count = independent_tasks(stack.keys.ages(), span_s, gap_s)
    cells = [stack.keys.cells(tasks, afterwards=True) for tasks in (train, validation)]
    errors = [
        errors_of(c, p, count, stack.keys.groups)
        for c, p in zip(cells, (predicted, later), strict=True)
    ]
    moves = np.where(np.isinf(stack.keys.ages())[cells[0].key], 0.0, cells[0].truth - cells[0].last)
    stack.reach = np.zeros(train.channels)
    np.maximum.at(stack.reach, cells[0].channel, np.abs(moves))
    flexible = np.array([member.flexible for member in stack.members.values()])
    source = sources(errors[0], stack.keys.measured(usual_gaps(train)))
    errors = [replace(e, source=source) for e in errors]
    errors[0] = as_if_refitted(errors[0], errors[1], flexible, train.channels)
    stack.weights = simplex_weights(errors[0], train.channels)
    held_out = stack.mix(later, validation)
    stack.weights = simplex_weights(joined(errors), train.channels)
    return stack, cells[1], held_out, source


def joined(errors: Sequence[Errors]) -> Errors:
    """The errors of several sets of tasks."""
    shift = np.cumsum([0, *(int(e.task.max(initial=-1)) + 1 for e in errors)])
    return replace(
        errors[0],
        key=np.concatenate([e.key for e in errors]),
        channel=np.concatenate([e.channel for e in errors]),
        task=np.concatenate([e.task + s for e, s in zip(errors, shift, strict=False)]),
        truth=np.concatenate([e.truth for e in errors]),
        predictions=np.concatenate([e.predictions for e in errors]),
        cluster=None,
    )


def bounds(dataset: Dataset) -> tuple[Array, Array]:
    """(channels,) lowest and highest answer: the observed range, widened by `MARGIN` of it."""
    low = np.min([np.where(t.observed, t.values, np.inf).min(axis=0) for t in dataset], axis=0)
    high = np.max([np.where(t.observed, t.values, -np.inf).max(axis=0) for t in dataset], axis=0)
    seen = np.isfinite(low)
    margin = MARGIN * np.where(seen, high - low, 0.0)
    return np.where(seen, low - margin, 0.0), np.where(seen, high + margin, 0.0)


def errors_of(
    cells: Cells, predicted: Sequence[Sequence[Array]], count: Array, group: NDArray[np.int64]
) -> Errors:
    """Errors of predictors, for `simplex_weights` and `gate`.

    Args:
        cells: values of tasks.
        predicted: per predictor and trajectory (rows, channels).
        count: (keys,) independent tasks.
        group: (keys,) group of each key.
    """
    return Errors(
        cells.key,
        cells.channel,
        cells.task,
        (cells.truth - cells.last) / cells.unit,
        np.stack([cells.pick(p) for p in predicted], axis=1),
        count,
        group,
    )
