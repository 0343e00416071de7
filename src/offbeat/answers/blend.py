"""The blend: one predictor for every task, base + gamma (model - base), with intervals.

The base is a weighted mean of baselines: causal ones (`baselines.stack`) for predictions, causal
fills, forecasts and streams, and those that use both sides (`both_sides`) for fills of a recording.
gamma, from 0 to 1 per channel and kind of value, is how much of the model's difference from the
base improves it on validation data. So the answer is that of simple predictors where a model has
nothing to add, and `gamma` says where that is.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from offbeat.answers.answer import Answer
from offbeat.answers.both_sides import (
    BothSides,
    Filled,
    Sides,
    fit_both_sides,
    gated,
    reversed_in_time,
)
from offbeat.answers.intervals import HalfWidths, fit_half_widths, half_width
from offbeat.baselines.base import BASELINES, Array, as_kind, namespace
from offbeat.baselines.folds import clusters_of
from offbeat.baselines.history import typical_gap
from offbeat.baselines.kalman_groups import MotionFilter
from offbeat.baselines.stack import (
    Stack,
    errors_of,
    fit_stack,
    independent_tasks,
    kinds_of,
    within,
)
from offbeat.baselines.tables import Place
from offbeat.data.tasks import CAUSAL, TWO_SIDED, TaskConfig, draw_tasks
from offbeat.data.trajectory import EXOGENOUS, Dataset
from offbeat.data.transforms import Transforms
from offbeat.models.base import BaseModel, of_channels
from offbeat.progress import Clock
from offbeat.tables import plain

GIVEN_CAUSAL = {"logged": 0.5, "cut": 0.5}
GIVEN_TWO_SIDED = {"logged": 1.0}
"""Shares of tasks for data that has masks of its own."""

FARTHEST = 1e6
"""Observed values are limited to this many deviations from the mean, so that squares are finite."""

LARGEST = 4e6
"""Values in the tasks that are drawn from a part, about, at most."""

_SURE = 0.95
"""Highest level of intervals whose calibration is checked."""

TASKS = 800
"""Tasks that are drawn from the training data and from the validation data, at most."""

FADED = 1.25
"""Multiple of the longest time since observation in training at which a model has no say."""

FEWEST_TASKS = 400
"""Tasks that are drawn of a short log too: regressions learn from where silences begin and end."""


@dataclass(frozen=True, eq=False)
class Blend:
    """A predictor of every task, made of baselines and of one model or two.

    Attributes:
        names: of the channels.
        units: of the channels.
        roles: of the channels.
        transforms: of the channels.
        tasks: how the tasks were drawn that it was fitted to.
        stack: the causal base.
        gamma: (keys, channels) of the forward model's difference from the base.
        widths: of the causal intervals.
        both: what fills from both sides.
        forward: predicts from the past; None for a blend of baselines alone.
        backward: trained on reversed trajectories; None without.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    roles: tuple[str, ...]
    transforms: Transforms
    tasks: TaskConfig
    stack: Stack
    gamma: Array
    widths: HalfWidths
    both: BothSides
    forward: BaseModel | None = None
    backward: BaseModel | None = None

    def __repr__(self) -> str:
        models = [m.name for m in (self.forward, self.backward) if m is not None]
        return (
            f"Blend({self.channels} channels, forecasts up to {self.tasks.horizon_s:g} s, models: "
            f"{', '.join(models) or 'none'}, causal baselines: {', '.join(self.stack.members)})"
        )

    @property
    def name(self) -> str:
        """Its name in tables."""
        return "blend"

    @property
    def channels(self) -> int:
        """Number of channels."""
        return len(self.names)

    @property
    def predicted(self) -> NDArray[np.bool_]:
        """(channels,) True where the channel is predicted; exogenous ones are not."""
        return np.array([role != EXOGENOUS for role in self.roles])

    def causal(self, dataset: Dataset, *, seed: int = 0) -> list[Answer]:
        """Predicts every row from what was observed strictly before it.

        Args:
            dataset: transformed, of these channels in this order; masked values are not used.
            seed: of the generator of self-feeding.
        """
        return Asked(self, dataset, seed).causal

    def corrected(self, base: Any, model: Any, kind: Any) -> tuple[Any, Any]:
        """The causal answer: base + gamma (model - base), within the range of answers.

        This method, `half_widths` and `limited` work on NumPy arrays and on torch tensors.

        Args:
            base: (rows, channels) of the stack.
            model: (rows, channels) of the forward model, or None.
            kind: (rows, channels, 5) of `Keys.read`.

        Returns:
            The answer, and where it is beyond what was trained; see `Answer.beyond`.
        """
        xp = namespace(base)
        age, last, longest = kind[..., 2], kind[..., 3], float(self.stack.keys.bins.edges[-1])
        low, high = as_kind(self.stack.low, base), as_kind(self.stack.high, base)
        beyond = age > longest * (1 + 1e-6)
        values = base
        if model is not None:
            # Beyond the times that it was trained for, a model has less to say, and soon nothing.
            trusted = (FADED - xp.clip(age, 0.0, 1e30) / longest) / (FADED - 1)
            gamma = self.stack.keys.place(kind).average(as_kind(self.gamma, base))
            gamma = gamma * xp.clip(trusted, 0.0, 1.0)
            values = self.stack.bounded(base + gamma * (model - base), last)
        return values, beyond | (values <= low) | (values >= high)

    def half_width(self, kind: Array, level: float) -> Array:
        """(rows, channels) half widths of causal intervals, in original units.

        Args:
            kind: (rows, channels, 5) of `Keys.read`.
            level: probability of the interval.
        """
        return half_width(self.half_widths(kind), level)

    def half_widths(self, kind: Any) -> Any:
        """(rows, channels, levels) half widths at every level of `intervals.LEVELS`.

        Args:
            kind: as of `half_width`.
        """
        return self.widths.at(self.stack.keys.place(kind), self.stack.keys.unit(kind))

    def limited(self, values: Any) -> Any:
        """Values that are finite in all computations: within `FARTHEST` deviations of the mean."""
        mean, reach = self.stack.mean, FARTHEST * self.stack.scale
        low, high = as_kind(mean - reach, values), as_kind(mean + reach, values)
        return namespace(values).clip(values, low, high)

    def fill(self, dataset: Dataset, *, seed: int = 0) -> list[Answer]:
        """Predicts every value that is not observed, from the observations on both sides.

        Args:
            dataset: as of `causal`.
            seed: of the generator of self-feeding.
        """
        return Asked(self, dataset, seed).fills

    def gamma_table(self) -> str:
        """A plain-text table of gamma per channel and time since observation, in motion as usual.

        A value near 0 says that the model adds nothing to the baselines there.
        """
        edges = self.stack.keys.bins.edges
        lines = [["gamma: channel", *(f"to {edge:.3g} s" for edge in edges)]]
        usual = self.gamma[self.stack.keys.usual]
        left_out = set(self.transforms.left_out)
        for c, name in enumerate(self.names):
            if name in left_out:
                continue
            lines.append([name, *(f"{g:.2f}" for g in usual[:, c])])
        return plain(lines)

    def notes(self) -> tuple[str, ...]:
        """Sentences on groups of channels that were found, and on intervals from few data."""
        found = []
        for member in self.stack.members.values():
            if isinstance(member, MotionFilter) and member.has_groups:
                groups = member.describe(self.names).replace("\n", "; ")
                found.append(f"filtered together: {groups}")
        # A level needs as many independent values as make one miss likely.
        needed = 1 / (1 - _SURE)
        counts = self.widths.count[self.stack.keys.usual]
        short = [
            (float(edge), int(count))
            for edge, count in zip(self.stack.keys.bins.edges, counts, strict=False)
            if count < needed
        ]
        if short:
            edge, count = short[-1]
            found.append(
                f"intervals of {100 * _SURE:.0f} % need {needed:.0f} independent spans of the "
                f"validation data; up to {edge:.3g} s after an observation there are {count}, so "
                "they are rough there: record more, or ask for a shorter horizon"
            )
        return tuple(found)

    def save(self, path: str | Path) -> None:
        """Writes the blend and its models to a folder; `load_run` reads it.

        Args:
            path: the folder.
        """
        from offbeat.answers.saved import save_blend

        save_blend(self, path)

    def arrays(self) -> dict[str, Array]:
        """All tables, by name; models are not among them."""
        own = {"gamma": self.gamma, "widths": self.widths.table, "widths_count": self.widths.count}
        own |= {f"stack.{k}": v for k, v in self.stack.arrays().items()}
        return own | {f"both.{k}": v for k, v in self.both.arrays().items()}


class Asked:
    """A blend's answers to a data set, and what they are made of; each is computed when first used.

    Args:
        blend: that is asked.
        dataset: as of `Blend.causal`.
        seed: of the generator of self-feeding.

    Attributes:
        dataset: its values limited as of `Blend.limited`.
    """

    def __init__(self, blend: Blend, dataset: Dataset, seed: int = 0) -> None:
        self.blend, self.seed = blend, seed
        mean, reach = blend.stack.mean, FARTHEST * blend.stack.scale
        if any((np.abs(np.nan_to_num(t.values) - mean) > reach).any() for t in dataset):
            every = (replace(t, values=blend.limited(t.values)) for t in dataset)
            dataset = replace(dataset, trajectories=tuple(every))
        self.dataset = dataset

    @cached_property
    def members(self) -> dict[str, list[Array]]:
        """(rows, channels) per trajectory of each causal baseline."""
        return {name: m.predict(self.dataset) for name, m in self.blend.stack.members.items()}

    @cached_property
    def two_sided_members(self) -> dict[str, list[Array]]:
        """(rows, channels) per trajectory of each baseline of fills from both sides."""
        return {name: m.predict(self.dataset) for name, m in self.blend.both.members.items()}

    @cached_property
    def model(self) -> list[Array] | None:
        """(rows, channels) per trajectory of the forward model, or None without one."""
        return model_rows(self.blend.forward, self.dataset, seed=self.seed)

    @cached_property
    def models(self) -> list[Array] | None:
        """(rows, channels) per trajectory of the models from both sides; see `model_fills`."""
        return _joined_fills(self.model, self.blend.backward, self.dataset, seed=self.seed)

    @cached_property
    def causal(self) -> list[Answer]:
        """See `Blend.causal`."""
        blend, keys = self.blend, self.blend.stack.keys
        answers = []
        for i, kind in enumerate(kinds_of(keys, self.dataset)):
            base = blend.stack.mixed([rows[i] for rows in self.members.values()], kind)
            model = None if self.model is None else self.model[i]
            values, beyond = blend.corrected(base, model, kind)
            place, unit = keys.place(kind), keys.unit(kind)
            answers.append(self._answer(i, values, blend.widths, place, unit, beyond))
        return answers

    @cached_property
    def fills(self) -> list[Answer]:
        """See `Blend.fill`."""
        stack, both, channel = self.blend.stack, self.blend.both, np.arange(self.blend.channels)
        longest = float(both.keys.bins.edges[-1]) * (1 + 1e-6)
        members = list(self.two_sided_members.values())
        filled = both.fill(self.dataset, members, [a.values for a in self.causal], self.models)
        answers = []
        for i, (trajectory, (values, place)) in enumerate(zip(self.dataset, filled, strict=True)):
            sides = Sides.of(trajectory)
            near = np.where(sides.before, trajectory.values[sides.earlier, channel], np.nan)
            near = np.where(sides.before, near, trajectory.values[sides.later, channel])
            near = np.where(sides.before | sides.after, near, stack.mean)
            values = stack.bounded(values, np.nan_to_num(near))
            unit, beyond = both.units[place.key, channel], sides.length > longest
            answers.append(self._answer(i, values, both.widths, place, unit, beyond))
        return answers

    def _answer(
        self,
        i: int,
        values: Array,
        widths: HalfWidths,
        place: Place,
        unit: Array,
        beyond: NDArray[np.bool_],
    ) -> Answer:
        return Answer(
            self.dataset[i].times,
            values,
            names=self.blend.names,
            units=self.blend.units,
            roles=self.blend.roles,
            origin=self.dataset[i].origin,
            widths=widths,
            place=place,
            unit=unit,
            beyond=beyond,
        )


def tables_of(arrays: Mapping[str, Array]) -> dict[str, Any]:
    """Fields of a blend from `Blend.arrays`."""
    return {
        "gamma": arrays["gamma"],
        "widths": HalfWidths(arrays["widths"], arrays["widths_count"]),
        "stack": Stack().restore(within(arrays, "stack.")),
        "both": BothSides.restored(within(arrays, "both.")),
    }


def fit_blend(
    train: Dataset,
    validation: Dataset,
    model: BaseModel | None = None,
    backward: BaseModel | None = None,
    *,
    tasks: TaskConfig | None = None,
    causal: Sequence[str] | None = None,
    two_sided: Sequence[str] | None = None,
    masks_of_data: bool = False,
    count: int = TASKS,
    budget_s: float | None = None,
    seed: int = 0,
) -> Blend:
    """Fits the base to training and validation data, and gamma and intervals to validation data.

    Args:
        train: what the model was trained on.
        validation: other data.
        model: trained; None for baselines alone.
        backward: trained on reversed trajectories; without one, a fill from both sides uses the
            forward model's causal predictions alone.
        tasks: how tasks are drawn; by default with a horizon of sixteen typical gaps.
        causal: names of the causal baselines; by default all that are registered and
            not slow.
        two_sided: names of the baselines of fills from both sides, likewise.
        masks_of_data: the data has masked values like those that will be asked for, so that no
            others are masked than those after a cut.
        count: tasks that are drawn from each part, at most.
        budget_s: s, time for all of it, about; baselines that would take longer are left out, the
            costly ones first. None fits all.
        seed: of the tasks.

    Raises:
        InputError: the parts have other channels than the model.
    """
    started = Clock()
    train, validation = Dataset.of(train), Dataset.of(validation)
    transforms = model.transforms if model is not None else Transforms.of(train)
    if model is not None:
        train = of_channels(train, model.names, model.units)
        validation = of_channels(validation, model.names, model.units)
    train, validation = transforms.apply(train), transforms.apply(validation)
    gap = typical_gap(train)
    config = tasks or TaskConfig(horizon_s=16 * gap, gap_s=gap)
    span = sum(float(t.times[-1] - t.times[0]) + gap for t in [*train, *validation])
    validation_span = sum(float(t.times[-1] - t.times[0]) + gap for t in validation)

    def drawn(shares: dict[str, float], salt: int) -> list[Dataset]:
        return [
            draw_tasks(
                part,
                config,
                number_of_tasks(part, config, count),
                shares=shares,
                seed=[seed, salt, i],
            )
            for i, part in enumerate((train, validation))
        ]

    before, both = (GIVEN_CAUSAL, GIVEN_TWO_SIDED) if masks_of_data else (CAUSAL, TWO_SIDED)
    usual = {name: kind for name, kind in BASELINES.items() if not kind.slow}
    if causal is None:
        causal = tuple(name for name, kind in usual.items() if kind.causal)
    if two_sided is None:
        two_sided = tuple(name for name, kind in usual.items() if not kind.causal)
    parts = drawn(before, 0)
    half = None if budget_s is None else budget_s / 2
    stack, cells, held_out, source = fit_stack(
        causal, *parts, span_s=span, gap_s=gap, budget_s=half
    )
    models = model_rows(model, parts[1], seed=seed)
    count_of = independent_tasks(stack.keys.ages(), validation_span, gap)
    errors = replace(
        errors_of(cells, [held_out], count_of, stack.keys.groups),
        source=source,
        cluster=clusters_of(parts[1], cells.task, cells.row),
    )
    # Intervals are of the kinds that are known when an answer is given.
    asked = stack.keys.cells(parts[1])
    gamma, answer = gated(
        errors,
        errors.predictions[:, 0],
        None if models is None else cells.pick(models),
        train.channels,
        asked.place,
    )
    unit = cells.unit / asked.unit
    missed = replace(errors, key=asked.key, truth=errors.truth * unit)
    blend = Blend(
        train.names,
        train.units,
        train.roles,
        transforms,
        config,
        stack,
        gamma,
        fit_half_widths(missed, answer * unit, train.channels),
        both=None,  # type: ignore[arg-type]  # below
        forward=model,
        backward=backward,
    )
    sides = [
        Filled(
            part,
            [a.values for a in blend.causal(part, seed=seed)],
            model_fills(model, backward, part, seed=seed),
        )
        for part in drawn(both, 1)
    ]
    left = None if budget_s is None else budget_s - (Clock() - started)
    sided = fit_both_sides(
        two_sided,
        *sides,
        span_s=span,
        validation_span_s=validation_span,
        gap_s=gap,
        budget_s=left,
    )
    return replace(blend, both=sided)


def by_direction(names: Sequence[str]) -> dict[str, tuple[str, ...]]:
    """Baselines as the arguments `causal` and `two_sided` of `fit_blend`.

    Args:
        names: of baselines; `last_value` is added where no causal one, and `linear` where none that
            uses both sides is among them.

    Raises:
        InputError: there is no baseline of a name.
    """
    causal = tuple(name for name in names if BASELINES[name].causal) or ("last_value",)
    both = tuple(name for name in names if not BASELINES[name].causal) or ("linear",)
    return {"causal": causal, "two_sided": both}


def number_of_tasks(part: Dataset, config: TaskConfig, most: int) -> int:
    """Tasks that cover a part about four times, from `FEWEST_TASKS` to `most`; fewer of large ones.

    Args:
        part: that they are drawn from.
        config: how.
        most: largest number.
    """
    span = sum(float(t.times[-1] - t.times[0]) for t in part)
    rows = sum(t.rows for t in part)
    values = rows * part.channels * min(config.length_s / max(span, 1e-12), 1.0)
    wanted = np.clip(4 * span / config.length_s, min(FEWEST_TASKS, most), most)
    return int(max(min(wanted, LARGEST / max(values, 1.0)), min(30, most)))


def model_rows(
    model: BaseModel | None, dataset: Dataset, *, seed: int = 0, size: int = 500
) -> list[Array] | None:
    """A model's predictions of every row, in original units; None without a model.

    Args:
        model: trained.
        dataset: transformed, in the order of the model's channels.
        seed: of the generator of self-feeding.
        size: trajectories per batch.
    """
    if model is None:
        return None
    results = []
    for first in range(0, len(dataset), size):
        part = dataset[first : first + size]
        drawn = {"generator": torch.Generator().manual_seed(seed)} if model.needs_generator else {}
        with torch.inference_mode():
            scaled = model(model.batch(part), **drawn).mean.double().cpu().numpy()
        results += [
            model.scaler.original(values[: t.rows]) for t, values in zip(part, scaled, strict=True)
        ]
    return results


def model_fills(
    forward: BaseModel | None, backward: BaseModel | None, dataset: Dataset, *, seed: int = 0
) -> list[Array] | None:
    """The fills of both models joined, or those of the forward model; None without models."""
    return _joined_fills(model_rows(forward, dataset, seed=seed), backward, dataset, seed=seed)


def _joined_fills(
    ahead: list[Array] | None, backward: BaseModel | None, dataset: Dataset, *, seed: int
) -> list[Array] | None:
    if ahead is None or backward is None:
        return ahead
    back = model_rows(backward, reversed_in_time(dataset), seed=seed)
    assert back is not None
    return [
        Sides.of(t).joined(np.where(t.observed, t.values, 0.0), f, b[::-1])
        for t, f, b in zip(dataset, ahead, back, strict=True)
    ]
