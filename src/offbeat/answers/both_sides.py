"""Fills from both sides: baselines that use the future, and two models joined.

A forward model predicts f(t) from what was observed before t, a backward model, trained on
trajectories reversed in time, b(t) from what was observed after it. Between two observations of a
channel, x0 at t0 and x1 at t1, with s = (t - t0) / (t1 - t0) and the errors at the other ends
r_f = x1 - f(t1) and r_b = x0 - b(t0), they are joined as

    (1 - s) f + s b + s (1 - s) ((r_f + r_b) / 2 + (1/2 - s) (r_b - r_f)),

which is the cubic Hermite interpolation with their slopes where both continue straight. After the
last observation the model's fill is f, before the first one b.

The fill is base + gamma (model - base), as everywhere; here the base is a weighted mean of the
baselines that use both sides and of the causal answer.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from offbeat.answers.intervals import HalfWidths, fit_half_widths
from offbeat.baselines.base import Array, Baseline, fit_baseline
from offbeat.baselines.folds import clusters_of
from offbeat.baselines.history import AgeBins, filled_bins, usual_gaps
from offbeat.baselines.members import fit_members
from offbeat.baselines.stack import (
    ACTIVITY,
    LEVELS,
    arrays_of,
    independent_tasks,
    joined,
    members_of,
    within,
)
from offbeat.baselines.tables import Place
from offbeat.baselines.weights import Errors, as_if_refitted, gate, simplex_weights, sources
from offbeat.data.masking import masked_values
from offbeat.data.trajectory import Dataset, Trajectory

EDGE = 0.15
"""Values with s (1 - s) below this are near the edge of their gap."""

NEAR, FAR = 0.1, 0.2
"""Answers change from those near the edge to those in the middle between these."""

INTERVALS = 3
"""Observed intervals on each side of a gap that say how much a channel moves."""


@dataclass(frozen=True, eq=False)
class Sides:
    """Where each value of a trajectory is between the observations of its channel.

    All arrays have shape (rows, channels).

    Attributes:
        before: whether there is an earlier observation.
        after: whether there is a later one.
        earlier: row of the last one before, 0 where there is none.
        later: row of the first one after, the last row where there is none.
        length: s, between both; outside, to the nearest one; 0 where there is none.
        place: s in the module's equations; 0 outside.
    """

    before: NDArray[np.bool_]
    after: NDArray[np.bool_]
    earlier: NDArray[np.int64]
    later: NDArray[np.int64]
    length: Array
    place: Array

    @classmethod
    def of(cls, trajectory: Trajectory) -> Sides:
        """The place of each value that is not observed; observed ones lie between themselves."""
        observed, times = trajectory.observed, trajectory.times[:, None]
        rows = np.arange(trajectory.rows)[:, None]
        earlier = np.maximum.accumulate(np.where(observed, rows, -1), axis=0)
        later = np.minimum.accumulate(np.where(observed, rows, trajectory.rows)[::-1], axis=0)[::-1]
        before, after = earlier >= 0, later < trajectory.rows
        earlier, later = np.maximum(earlier, 0), np.minimum(later, trajectory.rows - 1)
        start, end = trajectory.times[earlier], trajectory.times[later]
        between = before & after & ~observed
        length = np.where(between, end - start, 0.0)
        place = np.where(between, (times - start) / np.where(between, length, 1.0), 0.0)
        length = np.where(before & ~after, times - start, length)
        length = np.where(after & ~before, end - times, length)
        return cls(before, after, earlier, later, length, place)

    def joined(self, values: Array, forward: Array, backward: Array) -> Array:
        """(rows, channels) the two models joined; see the module.

        Args:
            values: of the trajectory; only observed ones are used.
            forward: predictions from the past.
            backward: predictions from the future.
        """
        channel = np.arange(values.shape[1])
        s = self.place
        missed_ahead = values[self.later, channel] - forward[self.later, channel]
        missed_back = values[self.earlier, channel] - backward[self.earlier, channel]
        inside = (
            (1 - s) * forward
            + s * backward
            + s
            * (1 - s)
            * (0.5 * (missed_ahead + missed_back) + (0.5 - s) * (missed_back - missed_ahead))
        )
        both, none = self.before & self.after, ~(self.before | self.after)
        alone = np.where(self.before, forward, backward)
        return np.where(both, inside, np.where(none, (forward + backward) / 2, alone))


@dataclass(frozen=True, eq=False)
class SideMotion:
    """How much a channel moves around a gap, compared to how much it usually does.

    Attributes:
        gap: (channels,) s, usual gaps.
        slope: (channels,) usual squared slope over `INTERVALS` observed intervals on each side.
        rise: (bins, channels) usual squared difference of the observations around a gap.
    """

    gap: Array
    slope: Array
    rise: Array

    @classmethod
    def of(cls, tasks: Dataset, bins: AgeBins) -> SideMotion:
        """The usual motion around the masked values of tasks.

        Args:
            tasks: of training.
            bins: of lengths.
        """
        gap = usual_gaps(tasks)
        slope, slopes = np.zeros(tasks.channels), np.zeros(tasks.channels)
        rise, rises = np.zeros((len(bins), tasks.channels)), np.zeros((len(bins), tasks.channels))
        for t in tasks:
            masked, sides = masked_values(t), Sides.of(t)
            near = _squared_slopes(t, gap)
            counted = masked & np.isfinite(near)
            slope += np.where(counted, near, 0.0).sum(axis=0)
            slopes += counted.sum(axis=0)
            row, channel = np.nonzero(masked & sides.before & sides.after)
            at = bins.of_age(sides.length[row, channel]), channel
            np.add.at(rise, at, _rises(t, sides)[row, channel] ** 2)
            np.add.at(rises, at, 1.0)
        return cls(
            gap,
            slope / np.maximum(slopes, 1),
            filled_bins(rise / np.maximum(rises, 1), rises),
        )

    def level(self, trajectory: Trajectory, sides: Sides, at: NDArray[np.int64]) -> Array:
        """(rows, channels) 0 where a channel rests, up to `LEVELS` - 1 where it moves as usual.

        Args:
            trajectory: whose observed values are used.
            sides: of the same.
            at: (rows, channels) bins of the lengths.
        """
        channel = np.arange(trajectory.channels)
        near = _squared_slopes(trajectory, self.gap)
        near = np.where(np.isfinite(near), near, self.slope) / np.maximum(self.slope, 1e-300)
        rise = _rises(trajectory, sides) ** 2 / np.maximum(self.rise[at, channel], 1e-300)
        moved = np.maximum(near, np.where(sides.before & sides.after, rise, 0.0))
        return np.asarray(sum(moved > 10.0**bound for bound in ACTIVITY))


def _rises(trajectory: Trajectory, sides: Sides) -> Array:
    channel = np.arange(trajectory.channels)
    values = np.where(trajectory.observed, trajectory.values, 0.0)
    return np.asarray(values[sides.later, channel] - values[sides.earlier, channel])


def _squared_slopes(trajectory: Trajectory, gap: Array) -> Array:
    """(rows, channels) mean squared slope of the observed intervals around; NaN without any.

    Args:
        trajectory: whose observed values are used.
        gap: (channels,) s, below which intervals are taken as that long.
    """
    found = np.full(trajectory.values.shape, np.nan)
    for c in range(trajectory.channels):
        seen = np.flatnonzero(trajectory.observed[:, c])
        if len(seen) < 2:
            continue
        steps = np.maximum(np.diff(trajectory.times[seen]), max(gap[c], 1e-12))
        squares = (np.diff(trajectory.values[seen, c]) / steps) ** 2
        total = np.append(0.0, np.cumsum(squares))
        last = len(squares)
        # The interval that a value is in counts for neither side.
        before = np.searchsorted(seen, np.arange(trajectory.rows), side="right") - 1
        start = np.clip(before - INTERVALS, 0, last), np.clip(before + 1, 0, last)
        end = np.clip(before, 0, last), np.clip(before + 1 + INTERVALS, 0, last)
        many = sum(e - s for s, e in zip(start, end, strict=True))
        every = sum(total[e] - total[s] for s, e in zip(start, end, strict=True))
        found[:, c] = np.where(many > 0, every / np.maximum(many, 1), np.nan)
    return found


@dataclass(frozen=True, eq=False)
class SideKeys:
    """Kinds of values: length of the gap, near its edge or not, or outside, the time to it; motion.

    Attributes:
        bins: of lengths.
        motion: around the gap; None does not tell kinds of motion from one another.
    """

    bins: AgeBins
    motion: SideMotion | None = None

    @property
    def levels(self) -> int:
        """Kinds of motion."""
        return 1 if self.motion is None else LEVELS

    def __len__(self) -> int:
        return 4 * len(self.bins) * self.levels + 1

    def of(self, trajectory: Trajectory) -> NDArray[np.int64]:
        """(rows, channels) kinds of the values that are not observed.

        Args:
            trajectory: whose observed values are used.
        """
        sides = Sides.of(trajectory)
        at, many = self.bins.of_age(sides.length), len(self.bins)
        middle = sides.place * (1 - sides.place) >= EDGE
        key = np.where(middle, at + many, at)
        key = np.where(sides.before & ~sides.after, at + 2 * many, key)
        key = np.where(sides.after & ~sides.before, at + 3 * many, key)
        if self.motion is not None:
            key = key * self.levels + self.motion.level(trajectory, sides, at)
        return np.where(sides.before | sides.after, key, len(self) - 1).astype(np.int64)

    def place(self, trajectory: Trajectory) -> Place:
        """(rows, channels) where the values are between kinds.

        Args:
            trajectory: as of `of`.
        """
        sides, many, key = Sides.of(trajectory), len(self.bins), self.of(trajectory)
        at, part = self.bins.between(sides.length)
        at = np.where(sides.before & ~sides.after, at + 2 * many, at)
        at = np.where(sides.after & ~sides.before, at + 3 * many, at)
        near = sides.before | sides.after
        middle = np.clip((sides.place * (1 - sides.place) - NEAR) / (FAR - NEAR), 0.0, 1.0)
        middle = np.where(sides.before & sides.after, middle, 0.0)
        key = np.where(near, at * self.levels + key % self.levels, key)
        parts = np.where(near[..., None], np.stack([part, middle], axis=-1), 0.0)
        return Place(key, parts, (self.levels, many * self.levels))

    @property
    def groups(self) -> NDArray[np.int64]:
        """(keys,) group of each kind: a length between observations, or one outside them."""
        many = len(self.bins)
        inside, outside = np.arange(many), many + np.arange(many)
        every = np.concatenate([inside, inside, outside, outside])
        return np.append(np.repeat(every, self.levels), 2 * many)

    def measured(self, usual: Array) -> NDArray[np.int64]:
        """(keys, channels) the kind of the least length of a channel in tasks, or a longer one.

        A task masks a value between two others, so the shortest gap of a channel in tasks is two
        usual ones, and a value in it is as far from its edges as can be.

        Args:
            usual: (channels,) s, gaps of the channels.
        """
        many = len(self.bins)
        own, level = np.divmod(np.arange(len(self))[:, None], self.levels)
        at = own % many
        gap, outside = self.bins.of_age(2 * usual), self.bins.of_age(usual)
        found = np.where(own >= 2 * many, own + np.maximum(outside - at, 0), own)
        middle = many + np.maximum(at, gap)
        found = np.where((own < many) & (at <= gap) | (own < 2 * many) & (at < gap), middle, found)
        found = found * self.levels + level
        found[-1] = len(self) - 1
        return np.asarray(found)

    def lengths(self) -> Array:
        """(keys,) s."""
        return np.append(np.repeat(np.tile(self.bins.edges, 4), self.levels), np.inf)

    def arrays(self) -> dict[str, Array]:
        """What is saved."""
        motion = self.motion
        kept = {} if motion is None else {n: getattr(motion, n) for n in ("gap", "slope", "rise")}
        return {"edges": self.bins.edges, **{f"motion.{name}": a for name, a in kept.items()}}

    @classmethod
    def restored(cls, arrays: Mapping[str, Array]) -> SideKeys:
        """The inverse of `arrays`; files of before have no motion."""
        kept = within(arrays, "motion.")
        return cls(AgeBins(arrays["edges"]), SideMotion(**kept) if kept else None)


@dataclass(frozen=True, eq=False)
class BothSides:
    """Everything that fills from both sides.

    Attributes:
        members: fitted baselines by name.
        keys: kinds of values.
        weights: (keys, channels, members + 1) of the members and of the causal answer, the last.
        gamma: (keys, channels) of the models' difference from the base.
        widths: of the intervals.
        units: (keys, channels) usual size of an error, in original units.
    """

    members: Mapping[str, Baseline]
    keys: SideKeys
    weights: Array
    gamma: Array
    widths: HalfWidths
    units: Array

    def fill(
        self,
        dataset: Dataset,
        members: Sequence[Sequence[Array]],
        causal: Sequence[Array],
        models: Sequence[Array] | None,
    ) -> list[tuple[Array, Place]]:
        """Fills, and where the values are between kinds.

        Args:
            dataset: in the units and the order of the channels of training.
            members: per member and trajectory (rows, channels) predictions.
            causal: per trajectory (rows, channels) answers from the past.
            models: the same of `model_fills`, or None without models.
        """
        every = [*members, causal]
        filled = []
        for i, trajectory in enumerate(dataset):
            place = self.keys.place(trajectory)
            weights = place.average(self.weights)
            base = sum(weights[..., j] * predicted[i] for j, predicted in enumerate(every))
            values = np.asarray(base)
            if models is not None:
                values = values + place.average(self.gamma) * (models[i] - values)
            filled.append((values, place))
        return filled

    def arrays(self) -> dict[str, Array]:
        """What is saved."""
        return {
            **arrays_of(self.members),
            **self.keys.arrays(),
            "weights": self.weights,
            "gamma": self.gamma,
            "widths": self.widths.table,
            "widths_count": self.widths.count,
            "units": self.units,
        }

    @classmethod
    def restored(cls, arrays: Mapping[str, Array]) -> BothSides:
        """The inverse of `arrays`."""
        return cls(
            members_of(arrays),
            SideKeys.restored(arrays),
            arrays["weights"],
            arrays["gamma"],
            HalfWidths(arrays["widths"], arrays["widths_count"]),
            arrays["units"],
        )


@dataclass(frozen=True, eq=False)
class Filled:
    """Tasks of fills and what was predicted of them.

    Attributes:
        tasks: from `draw_tasks`.
        causal: per trajectory (rows, channels) answers from the past.
        models: the same of `model_fills`, or None.
    """

    tasks: Dataset
    causal: Sequence[Array]
    models: Sequence[Array] | None


def fit_both_sides(
    members: Sequence[str],
    train: Filled,
    validation: Filled,
    *,
    span_s: float,
    validation_span_s: float,
    gap_s: float,
    budget_s: float | None = None,
) -> BothSides:
    """Fits weights to training and validation tasks, gamma and intervals to validation tasks.

    Args:
        members: names of baselines.
        train: tasks of the training data.
        validation: tasks of other data.
        span_s: s, length of all the data.
        validation_span_s: s, length of the validation data.
        gap_s: s, its typical gap.
        budget_s: s, for the fits; see `fit_members`.
    """
    channels = train.tasks.channels
    lengths = longest_lengths(train.tasks)
    usual = float(np.quantile(lengths, 0.95)) if lengths else gap_s
    bins = AgeBins.of_lengths(gap_s, usual, max(lengths, default=gap_s))
    keys = SideKeys(bins, SideMotion.of(train.tasks, bins))
    found = fit_members(members, train.tasks, validation.tasks, budget_s=budget_s)
    fitted = {name: member.baseline for name, member in found.items()}
    predicted, later = [m.train for m in found.values()], [m.validation for m in found.values()]
    count = independent_tasks(keys.lengths(), span_s, gap_s)
    reference = fit_baseline("linear", train.tasks)
    scale = reference.scale
    units = np.broadcast_to(scale, (len(keys), channels)).copy()
    flat = [
        _errors(part.tasks, keys, units, reference, [*p, list(part.causal)], part.models, count)
        for part, p in ((train, predicted), (validation, later))
    ]
    source = sources(flat[0][0], keys.measured(usual_gaps(train.tasks)))
    flat = [(replace(errors, source=source), models, place) for errors, models, place in flat]
    bends = np.array([*(member.flexible for member in fitted.values()), False])
    cross = as_if_refitted(flat[0][0], flat[1][0], bends, channels)
    first = simplex_weights(cross, channels)
    weights = simplex_weights(joined([cross, flat[1][0]]), channels)
    errors, models, place = flat[1]
    errors = replace(errors, count=independent_tasks(keys.lengths(), validation_span_s, gap_s))
    held_out = (place.average(first, errors.channel) * errors.predictions).sum(axis=1)
    gamma, answer = gated(errors, held_out, models, channels, place)
    widths = fit_half_widths(errors, answer, channels)
    return BothSides(fitted, keys, weights, gamma, widths, units)


def gated(
    errors: Errors, held_out: Array, models: Array | None, channels: int, place: Place
) -> tuple[Array, Array]:
    """Gamma of a model, and answers for the intervals with gamma from the other half of the tasks.

    Args:
        errors: of validation tasks.
        held_out: (values,) base with weights that were not fitted to them.
        models: (values,) the model, or None.
        channels: their number.
        place: (values,) where they are between kinds.

    Returns:
        (keys, channels), and (values,).
    """
    if models is None:
        return np.zeros((errors.keys, channels)), held_out
    gamma = gate(errors, held_out, models, channels)
    answer = held_out.copy()
    half = errors.task % 2
    for k in (0, 1):
        fit, use = half != k, half == k
        if fit.any():
            part = gate(errors.only(fit), held_out[fit], models[fit], channels)
            own = place[use].average(part, errors.channel[use])
            answer[use] += own * (models[use] - held_out[use])
    return gamma, answer


def longest_lengths(tasks: Dataset) -> list[float]:
    """The longest length of a gap with masked values, per trajectory, in s."""
    found = []
    for trajectory in tasks:
        masked = masked_values(trajectory)
        if masked.any():
            found.append(float(Sides.of(trajectory).length[masked].max()))
    return found


def _errors(
    tasks: Dataset,
    keys: SideKeys,
    units: Array,
    reference: Baseline,
    predicted: Sequence[Sequence[Array]],
    models: Sequence[Array] | None,
    count: Array,
) -> tuple[Errors, Array | None, Place]:
    columns: dict[str, list[NDArray[Any]]] = {
        n: [] for n in ("key", "channel", "task", "truth", "model", "at", "part", "row")
    }
    each: list[Array] = []
    for i, (trajectory, line) in enumerate(zip(tasks, reference.predict(tasks), strict=True)):
        row, channel = np.nonzero(masked_values(trajectory))
        key = keys.of(trajectory)[row, channel]
        unit, zero = units[key, channel], line[row, channel]
        place = keys.place(trajectory)[row, channel]
        columns["key"].append(key)
        columns["at"].append(place.key)
        columns["part"].append(place.part)
        columns["channel"].append(channel)
        columns["task"].append(np.full(len(row), i))
        columns["row"].append(row)
        columns["truth"].append((trajectory.values[row, channel] - zero) / unit)
        each.append(np.stack([(p[i][row, channel] - zero) / unit for p in predicted], axis=1))
        if models is not None:
            columns["model"].append((models[i][row, channel] - zero) / unit)
    flat = {name: np.concatenate(parts) for name, parts in columns.items() if parts}
    errors = Errors(
        flat["key"],
        flat["channel"],
        flat["task"],
        flat["truth"],
        np.concatenate(each),
        count,
        keys.groups,
        cluster=clusters_of(tasks, flat["task"], flat["row"]),
    )
    step = (keys.levels, len(keys.bins) * keys.levels)
    return errors, flat.get("model"), Place(flat["at"], flat["part"], step)


def reversed_in_time(dataset: Dataset) -> Dataset:
    """Each trajectory from its end to its start, times counted from its last row.

    Args:
        dataset: any trajectories; values are not changed, not even the signs of velocities.
    """
    return replace(
        dataset,
        trajectories=tuple(
            replace(
                t,
                times=t.times[-1] - t.times[::-1],
                values=t.values[::-1],
                observed=t.observed[::-1],
            )
            for t in dataset
        ),
    )
