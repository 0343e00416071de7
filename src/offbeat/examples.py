"""What a model is trained and validated on: trajectories as they are, or tasks drawn from them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import huber_loss

from offbeat.baselines import AgeBins, Baseline, fit_baseline
from offbeat.baselines.errors import CLIPPED, ErrorTable, cells
from offbeat.config import Recipe, RedrawConfig, TaskConfig
from offbeat.data.batch import Batch
from offbeat.data.redraw import Redrawn, redraw
from offbeat.data.tasks import draw_tasks
from offbeat.data.trajectory import EXOGENOUS, Dataset
from offbeat.kernels import StepTable
from offbeat.metrics import Scores, ScoreSums
from offbeat.models.base import BaseModel, of_channels
from offbeat.models.corrected import CorrectedInputs
from offbeat.parts.heads import Prediction

REFERENCE_TASKS = 600
"""Tasks that baselines are fitted to, and as many others that give their errors."""

VALIDATION_TASKS = 300
"""Tasks of validation, the same in every epoch."""

MOST_VALUES = 2**24
"""Values of the tasks of an epoch, at most: the number of tasks is lower where windows are long."""

HUBER = 3.0
"""Errors beyond this multiple of the typical one count linearly in the relative loss."""

UNITS = ("last_value", "mean", "running_mean", "constant_velocity", "damped_slope")
"""Baselines whose errors are the units of the relative loss, where no others are given."""

AHEAD = 8
"""Batches whose inputs are computed together, where windows and masks are drawn anew: the work is a
few array operations, and one at a time pays their start-up and cold caches in each step."""

# Streams of random numbers; those of the epochs are (seed, _EPOCHS, epoch).
_FITTED, _MEASURED, _VALIDATED, _EPOCHS = range(4)


def ordered(model: BaseModel, dataset: Dataset) -> Dataset:
    """A data set with the channels in the order of a model, and its input transforms applied.

    Args:
        model: of the same channels.
        dataset: to train, validate or fit on.
    """
    return model.transforms.apply(of_channels(dataset, model.names, model.units))


def number_of_tasks(dataset: Dataset, config: TaskConfig, most: int) -> int:
    """The number of tasks that are drawn at a time, so that memory is bounded.

    Args:
        dataset: that they are drawn from.
        config: with the length of a window.
        most: at most so many.

    Returns:
        `most`, or as many as have `MOST_VALUES` values, but not fewer than 64.
    """
    rows = max(int(np.searchsorted(t.times, t.times[0] + config.length_s)) for t in dataset)
    return min(most, max(64, MOST_VALUES // (max(rows, 1) * dataset.channels)))


@dataclass(frozen=True, eq=False)
class Reference:
    """The best baselines: their typical errors are the units of the relative loss.

    Attributes:
        baselines: fitted to tasks of the training set.
        errors: of the best of them in each cell, on other tasks of the training set.
        typical: (bins + 1, channels) typical errors, scaled units, positive.
        weights: (bins + 1, channels) of errors in the loss.
    """

    baselines: tuple[Baseline, ...]
    errors: ErrorTable
    typical: Tensor
    weights: Tensor

    @property
    def bins(self) -> AgeBins:
        """Bins of times since observation."""
        return self.errors.bins

    @classmethod
    def of(cls, baselines: Sequence[Baseline], model: BaseModel, tasks: Dataset) -> Reference:
        """Measures fitted baselines.

        Args:
            baselines: at least one.
            model: that is to be trained; its scales are used.
            tasks: that the baselines were not fitted to, `ordered`.
        """
        batch, bins = model.batch(tasks), AgeBins.of(tasks)
        errors = ErrorTable.best(
            ErrorTable.of(scaled(each, model, tasks, batch), batch, bins, clipped=CLIPPED)
            for each in baselines
        )
        typical = errors.typical(model.std.cpu())
        return cls(tuple(baselines), errors, typical, errors.weights())


def fitted_baselines(tasks: Dataset) -> tuple[Baseline, ...]:
    """The baselines of `UNITS`, fitted to tasks."""
    return tuple(fit_baseline(name, tasks) for name in UNITS)


def reference_tasks(train: Dataset, recipe: Recipe) -> tuple[Dataset, Dataset]:
    """The tasks that baselines are fitted to, and those on which their errors are measured.

    Args:
        train: the training set, `ordered`.
        recipe: with the tasks, or the windows and masks to draw; with neither, the trajectories
            are both.
    """
    if recipe.redraw is not None:
        some, whole = _some(train)
        first, second = (
            redraw(whole, recipe.redraw, seed=[recipe.seed, stream]).dataset(some)
            for stream in (_FITTED, _MEASURED)
        )
        return first, second
    if recipe.tasks is None:
        return train, train
    fitted, measured = (
        draw_tasks(
            train,
            recipe.tasks,
            number_of_tasks(train, recipe.tasks, REFERENCE_TASKS),
            seed=[recipe.seed, stream],
        )
        for stream in (_FITTED, _MEASURED)
    )
    return fitted, measured


def _some(train: Dataset) -> tuple[Dataset, Batch]:
    """At most `REFERENCE_TASKS` trajectories, spread evenly over a data set."""
    count = min(len(train), REFERENCE_TASKS)
    some = train.take(np.linspace(0, len(train) - 1, count).astype(np.int64))
    return some, Batch.of(some)


def longest_silence(train: Dataset, config: RedrawConfig, *, seed: int) -> float:
    """s, the longest time since the last observed row in some windows and masks of a training.

    Args:
        train: the training set, `ordered`.
        config: how they are drawn.
        seed: of the training.
    """
    some, whole = _some(train)
    drawn = redraw(whole, config, seed=[seed, _MEASURED]).dataset(some)
    silence = 0.0
    for trajectory in drawn:
        seen = np.flatnonzero(trajectory.observed.any(axis=1))
        times = np.append(trajectory.times[seen], trajectory.times[-1])
        silence = max(silence, float(np.diff(times).max(initial=0.0)))
    return silence


def scaled(baseline: Baseline, model: BaseModel, dataset: Dataset, batch: Batch) -> Tensor:
    """The predictions of a baseline in the scaled units of a model.

    Args:
        baseline: fitted.
        model: whose scaler is used.
        dataset: `ordered`.
        batch: of the same trajectories.

    Returns:
        (batch, rows, channels), 0 in padding.
    """
    values = np.zeros(batch.values.shape)
    for row, predicted in zip(values, baseline.predict(dataset), strict=True):
        row[: len(predicted)] = model.scaler.scaled(predicted)
    return torch.from_numpy(values).to(batch.values)


class Examples:
    """Trajectories in memory, with inputs that are computed once.

    Args:
        model: its scales and statistics give the step inputs.
        batch: scaled.
        reference: of the relative loss; None for that of the model's head.
        all_count: whether every value of the batch is known to be a target.
    """

    def __init__(
        self,
        model: BaseModel,
        batch: Batch,
        *,
        reference: Reference | None = None,
        all_count: bool = False,
    ) -> None:
        with torch.no_grad():
            self.prepared = model.prepare(batch)
        # Without the first row: its prediction is a constant.
        self.targets = batch.values[:, 1:].contiguous()
        self.counted = self.typical = None
        if reference is not None or not all_count:
            counted = batch.targets[:, 1:]
            self.counted = None if bool(counted.all()) else counted.to(self.targets.dtype)
        if reference is not None:
            at = cells(batch, reference.bins)[:, 1:]
            channel = torch.arange(batch.channels, device=at.device)
            self.typical = reference.typical.to(self.targets)[at, channel]
            self.counted = reference.weights.to(self.targets)[at, channel] * counted

    def __len__(self) -> int:
        return len(self.prepared)

    def loss(
        self,
        model: BaseModel,
        index: Tensor,
        generator: torch.Generator | None,
        *,
        host: Tensor | None = None,
        whole: bool = False,
    ) -> Tensor:
        """The model's loss of the one-step-ahead prediction of some trajectories.

        Args:
            model: in its current state.
            index: (batch,) positions of the trajectories.
            generator: of self-feeding.
            host: `index` on the CPU, where it lies on the device: then nothing waits for that.
            whole: do not trim to the longest of them, so that shapes are those of any other batch.
        """
        taken: Any
        if whole:
            taken = self.prepared.take_whole(index)  # type: ignore[attr-defined]
        elif host is not None and isinstance(self.prepared, StepTable | Batch | CorrectedInputs):
            taken = self.prepared.take(index, host=host)
        else:
            taken = self.prepared.take(index)
        return self.loss_of(model, model.run(taken, generator=generator), index)

    def loss_of(self, model: BaseModel, whole: Prediction, index: Tensor) -> Tensor:
        """The model's loss of a prediction of some trajectories.

        Args:
            model: whose loss it is.
            whole: (batch, rows, channels) prediction, the first row included.
            index: (batch,) positions of the trajectories.
        """
        index = index.to(self.targets.device)
        scale = None if whole.scale is None else whole.scale[:, 1:]
        prediction = Prediction(whole.mean[:, 1:], scale)
        rows = prediction.mean.shape[1]
        targets = self.targets.index_select(0, index)[:, :rows]
        mask = None
        if self.counted is not None:
            mask = self.counted.index_select(0, index)[:, :rows]
        elif not rows:
            mask = torch.ones_like(targets)
        if self.typical is None or prediction.scale is not None:
            return model.loss(prediction, targets, mask)
        typical = self.typical.index_select(0, index)[:, :rows]
        return relative_loss(prediction.mean, targets, typical, mask)

    def weighed(
        self,
        model: BaseModel,
        index: Tensor,
        generator: torch.Generator | None,
        *,
        host: Tensor | None = None,
    ) -> tuple[Tensor, Tensor]:
        """The loss, and how many values it is the mean of, or the sum of their weights.

        Args:
            model: in its current state.
            index: (batch,) positions of the trajectories.
            generator: of self-feeding.
            host: as of `loss`.
        """
        return self.loss(model, index, generator, host=host), self.count(index)

    def count(self, index: Tensor) -> Tensor:
        """How many values count in some trajectories, or the sum of their weights.

        Args:
            index: (batch,) positions of the trajectories.
        """
        if self.counted is None:
            return self.targets.new_tensor(len(index) * self.targets[0].numel())
        return self.counted.index_select(0, index.to(self.counted.device)).sum()


class RedrawnExamples:
    """The windows and masks of an epoch; their inputs are computed for `AHEAD` batches at a time.

    Args:
        drawn: windows and masks.
        order: (trajectories,) their positions in the order in which the epoch takes them.
        reference: of the relative loss; None for that of the model's head.
    """

    def __init__(
        self, drawn: Redrawn, order: Tensor, *, reference: Reference | None = None
    ) -> None:
        self._drawn, self._order, self._reference = drawn, order, reference
        self._turn = torch.argsort(order)
        self._all_count = drawn.whole.complete and EXOGENOUS not in drawn.whole.roles
        self._some: Examples | None = None
        self._turns = range(0)

    def __len__(self) -> int:
        return len(self._drawn)

    def loss(self, model: BaseModel, index: Tensor, generator: torch.Generator | None) -> Tensor:
        """As that of `Examples`."""
        some, at = self._with_inputs(model, index)
        return some.loss(model, at, generator)

    def weighed(
        self, model: BaseModel, index: Tensor, generator: torch.Generator | None
    ) -> tuple[Tensor, Tensor]:
        """As that of `Examples`."""
        some, at = self._with_inputs(model, index)
        return some.weighed(model, at, generator)

    def _with_inputs(self, model: BaseModel, index: Tensor) -> tuple[Examples, Tensor]:
        """Examples with these trajectories, and their positions there."""
        turn = self._turn[index.cpu()]
        first, last = int(turn.min()), int(turn.max())
        if last - first >= len(index):  # not in the order of the epoch
            return self._examples(model, index), torch.arange(len(index))
        if self._some is None or first not in self._turns or last not in self._turns:
            self._turns = range(first, min(first + AHEAD * len(index), len(self)))
            self._some = self._examples(model, self._order[first : self._turns.stop])
        return self._some, turn - self._turns.start

    def _examples(self, model: BaseModel, index: Tensor) -> Examples:
        batch = self._drawn.take(index)
        return Examples(model, batch, reference=self._reference, all_count=self._all_count)

    def prepared(self, model: BaseModel) -> Examples:
        """The same with the inputs of all windows, for a device with the memory for them.

        Args:
            model: its scales and statistics give the step inputs.
        """
        return self._examples(model, torch.arange(len(self)))


def relative_loss(mean: Tensor, targets: Tensor, typical: Tensor, weights: Tensor | None) -> Tensor:
    """Weighted mean of Huber's loss of the errors in units of typical ones.

    Args:
        mean: (batch, rows, channels) predictions.
        targets: (batch, rows, channels).
        typical: (batch, rows, channels) typical errors.
        weights: (batch, rows, channels); 0 where the target does not count. None: all count alike.

    Returns:
        The mean squared relative error, where no error is beyond `HUBER` typical ones.
    """
    each = 2 * huber_loss(mean / typical, targets / typical, reduction="none", delta=HUBER)
    if weights is None:
        return each.mean()
    return (each * weights).sum() / weights.sum().clamp_min(1e-12)


def order_of(seed: int, epoch: int, count: int) -> NDArray[np.int64]:
    """(count,) positions in the order in which an epoch takes them.

    Args:
        seed: of the training.
        epoch: counted from 0.
        count: of trajectories or tasks.
    """
    return np.random.default_rng([seed, epoch]).permutation(count)


class TrainingSet:
    """The examples of every epoch: the trajectories, or what is drawn anew.

    Tasks, or windows and masks, of the next epoch are drawn in a thread while the model is trained
    on those of this one.

    Args:
        model: that is trained.
        train: the training set, `ordered`.
        recipe: with the tasks and the seed.
        reference: of the relative loss; None for that of the model's head.
    """

    def __init__(
        self,
        model: BaseModel,
        train: Dataset,
        recipe: Recipe,
        *,
        reference: Reference | None = None,
    ) -> None:
        self._model, self._train, self._recipe = model, train, recipe
        self._reference = reference
        self._next: tuple[int, Future[Examples | RedrawnExamples]] | None = None
        drawn = recipe.tasks is not None or recipe.redraw is not None
        self._same = None if drawn else self._examples(train)
        self._whole = None if recipe.redraw is None else model.batch(train)
        self._drawer = ThreadPoolExecutor(1) if drawn else None

    def __len__(self) -> int:
        if self._same is not None:
            return len(self._same)
        if self._whole is not None:
            return len(self._whole)
        assert self._recipe.tasks is not None
        return number_of_tasks(self._train, self._recipe.tasks, self._recipe.tasks_per_epoch)

    def epoch(self, epoch: int) -> Examples | RedrawnExamples:
        """The examples of an epoch, the same whenever they are asked for.

        Args:
            epoch: counted from 0.
        """
        if self._same is not None:
            return self._same
        assert self._drawer is not None
        if self._next is not None and self._next[0] == epoch:
            examples = self._next[1].result()
        else:
            examples = self._drawn(epoch)
        if epoch + 1 < self._recipe.epochs:
            self._next = epoch + 1, self._drawer.submit(self._drawn, epoch + 1)
        return examples

    def close(self) -> None:
        """Ends the thread."""
        if self._drawer is not None:
            self._drawer.shutdown(cancel_futures=True)

    def _drawn(self, epoch: int) -> Examples | RedrawnExamples:
        recipe = self._recipe
        seed = [recipe.seed, _EPOCHS, epoch]
        if self._whole is not None and recipe.redraw is not None:
            drawn = redraw(self._whole, recipe.redraw, seed=seed)
            order = torch.from_numpy(order_of(recipe.seed, epoch, len(drawn)))
            examples = RedrawnExamples(drawn, order, reference=self._reference)
            # Elsewhere a step must not wait for the CPU, which inputs of a batch would make it do.
            return examples if self._model.device.type == "cpu" else examples.prepared(self._model)
        assert recipe.tasks is not None
        return self._examples(draw_tasks(self._train, recipe.tasks, len(self), seed=seed))

    def _examples(self, tasks: Dataset) -> Examples:
        return Examples(self._model, self._model.batch(tasks), reference=self._reference)


@dataclass(frozen=True)
class Validation:
    """Scores of a model on the validation set.

    Attributes:
        scores: in scaled units.
        relative: mean over bins of time since observation and channels of the logarithm of the
            ratio of the MSE to that of the best baseline; NaN without a reference.
    """

    scores: Scores
    relative: float


class ValidationSet:
    """A data set that is scored repeatedly; its step inputs are computed once.

    Args:
        model: its scales and statistics give the step inputs.
        batch: scaled by the model's scaler.
        size: trajectories at a time.
    """

    def __init__(
        self,
        model: BaseModel,
        batch: Batch,
        *,
        size: int = 500,
        terms: tuple[Tensor, Tensor] | None = None,
    ) -> None:
        self.channels = batch.channels
        self._whole, self._terms, self._size = batch, terms, size
        self._reference: tuple[Reference, ErrorTable] | None = None
        with torch.no_grad():
            parts = (batch.take(slice(i, i + size)) for i in range(0, len(batch), size))
            self.parts = [(_whole(model.prepare(part)), part) for part in parts]
        empty = ScoreSums(self.channels)
        for _, part in self.parts:
            empty.add(part.values, part)
        self.counted = empty.scores().after_first_observation.count

    @classmethod
    def of(
        cls,
        model: BaseModel,
        validation: Dataset,
        recipe: Recipe,
        *,
        reference: Reference | None = None,
    ) -> ValidationSet:
        """The validation set of a training: trajectories as they are, or tasks drawn once.

        Args:
            model: that is trained.
            validation: trajectories, `ordered`.
            recipe: with the tasks and the seed.
            reference: of the relative score; None for none.
        """
        tasks = validation
        if recipe.tasks is not None:
            count = number_of_tasks(validation, recipe.tasks, VALIDATION_TASKS)
            tasks = draw_tasks(validation, recipe.tasks, count, seed=[recipe.seed, _VALIDATED])
        batch = model.batch(tasks)
        found = cls(model, batch)
        if reference is not None:
            best = ErrorTable.best(
                ErrorTable.of(scaled(each, model, tasks, batch), batch, reference.bins)
                for each in reference.baselines
            )
            found._reference = reference, best
        return found

    def scores(self, model: BaseModel, *, seed: int = 0, gap_unit: float | None = None) -> Scores:
        """Scores a model in its current state.

        Args:
            model: to score.
            seed: of self-feeding.
            gap_unit: s; groups the score by time since observation, as `ScoreSums` does.
        """
        return self._scored(model, seed, gap_unit)[0]

    def judge(self, model: BaseModel, *, seed: int = 0) -> Validation:
        """Scores a model in its current state, also relative to the best baseline.

        Args:
            model: to score.
            seed: of self-feeding.
        """
        scores, means = self._scored(model, seed, None)
        if self._reference is None:
            return Validation(scores, math.nan)
        reference, best = self._reference
        whole = torch.zeros_like(self._whole.values)
        for i, mean in enumerate(means):
            first = i * self._size
            whole[first : first + len(mean), : mean.shape[1]] = mean
        own = ErrorTable.of(whole, self._whole, reference.bins)
        return Validation(scores, own.relative(best, reference.typical))

    def _scored(
        self, model: BaseModel, seed: int, gap_unit: float | None
    ) -> tuple[Scores, list[Tensor]]:
        sums = ScoreSums(self.channels, gap_unit=gap_unit)
        means = []
        with torch.inference_mode():
            for prepared, part in self.parts:
                # One generator for all parts, as if they were one batch.
                generator = torch.Generator().manual_seed(seed) if model.needs_generator else None
                found: Prediction = model.run(prepared, generator=generator)
                sums.add(found.mean, part, found.scale)
                means.append(found.mean)
        return sums.scores(), means


def _whole(prepared: Any) -> Any:
    return prepared.take(torch.arange(len(prepared)))


def validate(model: BaseModel, batch: Batch, *, seed: int = 0, size: int = 500) -> Scores:
    """Scores a model on a scaled batch, in parts.

    Args:
        model: to score.
        batch: scaled by the model's scaler.
        seed: of self-feeding.
        size: trajectories at a time.
    """
    validated = ValidationSet(model, batch, size=size)
    return validated.scores(model, seed=seed, gap_unit=model.statistics.median_gap)
