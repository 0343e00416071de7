"""Training: `fit`, its log and its checkpoints."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager
from contextvars import ContextVar
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from offbeat.baselines import Baseline
from offbeat.captured import CapturedStep, autocast, captured, check_precision, products
from offbeat.config import Recipe, TrainConfig
from offbeat.data.shards import ShardedDataset
from offbeat.data.trajectory import Dataset
from offbeat.devices import resolved
from offbeat.direct import direct_step
from offbeat.distributed import Ranks, current, device_here, is_first, on_first
from offbeat.errors import DivergenceError, InputError
from offbeat.examples import (
    REFERENCE_TASKS,
    Examples,
    RedrawnExamples,
    Reference,
    TrainingSet,
    ValidationSet,
    fitted_baselines,
    longest_silence,
    order_of,
    ordered,
    reference_tasks,
    validate,
)
from offbeat.files import writable
from offbeat.models.base import BaseModel
from offbeat.models.checkpoint import save_model
from offbeat.models.zoo import recipe_of
from offbeat.progress import progress_bar
from offbeat.run import (
    EpochRecord,
    RunState,
    flat_parameters,
    identity_of,
    locked,
    packed,
    resume_run,
    save_run,
    unpack,
    write_log,
)
from offbeat.sharded import ShardedEpoch, ShardedTrainingSet, check_trainable

__all__ = ["Callback", "Examples", "FitResult", "ValidationSet", "fit", "train_step", "validate"]

AnyExamples = Examples | RedrawnExamples | ShardedEpoch

READ_EVERY = 10
"""Steps after which losses of another device than the CPU are read, and the progress is shown."""

Callback = Callable[[EpochRecord, BaseModel], bool | None]
"""Called after each epoch; a true result stops the training."""


@dataclass(frozen=True)
class FitResult:
    """The result of `fit`.

    Attributes:
        history: one record per epoch.
        stopped_early: True if `patience` or a callback ended the training.
        folder: of log and checkpoints, or None.
        recipe: training configuration that was used.
        best_epoch: of the lowest validation error; 0 if none was better than any other.
        diverged: what happened, where the training diverged and ended with its best weights; else
            empty.
    """

    history: tuple[EpochRecord, ...]
    stopped_early: bool
    folder: Path | None
    recipe: Recipe
    best_epoch: int = 0
    diverged: str = ""

    def __repr__(self) -> str:
        best = f", best epoch {self.best_epoch}" if self.best_epoch else ""
        score = self.validation_score
        scored = "" if math.isnan(score) else f", validation score {score:.4g}"
        stopped = ", stopped early" if self.stopped_early else ""
        return (
            f"FitResult({len(self.history)} epochs, {self.steps} steps{best}{scored}{stopped}"
            f"{', diverged' if self.diverged else ''})"
        )

    @property
    def validation_score(self) -> float:
        """The best validation score; NaN if there is none."""
        scores = [r.validation_score for r in self.history if not math.isnan(r.validation_score)]
        return min(scores, default=math.nan)

    @property
    def steps(self) -> int:
        """Total number of optimizer steps."""
        return self.history[-1].steps if self.history else 0


def fit(
    model: BaseModel,
    train: Dataset | ShardedDataset,
    validation: Dataset | None = None,
    config: TrainConfig | None = None,
    *,
    out: str | Path | None = None,
    baselines: Sequence[Baseline] | None = None,
    device: str | torch.device | None = None,
    callbacks: Sequence[Callback] = (),
    progress: bool = True,
) -> FitResult:
    """Trains a model in place on one-step-ahead prediction, or on tasks.

    By default the loss is that of the model's head over the known values of all rows but the first,
    in scaled units. With `config.tasks`, each epoch draws windows and masks anew (see `draw_tasks`)
    and the loss is relative: the error of each value is divided by that of the best baseline for
    its channel and its time since observation. With `config.redraw`, each epoch draws a window of
    each trajectory and masks its values anew (see `redraw`); all else is as without. Batches, their
    order and all random numbers depend only on `config.seed`.

    Within `offbeat.distributed.group`, it is one training by all ranks: each takes its part of
    every batch, and the first one writes `out`.

    Where the loss or a weight turns infinite or NaN and the best weights are kept, the training
    resumes from these, once, at half the learning rate, and ends with them if it diverges again.

    Args:
        model: trained in place.
        train: the training set; masked values that are known serve as targets. With tasks or
            redraw, whole trajectories. A folder of `Dataset.open` is read group by group; the
            baselines of a relative loss are fitted to a sample of it.
        validation: scored after each epoch; with tasks, on tasks that are drawn from it once.
        config: fields that are None, or all of them if it is None, follow the model's recipe.
        out: folder for `log.csv`, checkpoints and the final `model`; a run that was stopped there
            is resumed, and ends bit for bit as if it had not been stopped.
        baselines: causal ones, fitted to training data; the best of their errors are the units of
            the relative loss and score. By default those of `examples.UNITS` are fitted to tasks.
        device: `cpu`, `cuda`, `cuda:1`, or `auto` for a GPU where the model and its batches gain
            from it (see `offbeat.devices.preferred`); by default that of the model. The model
            stays on it.
        callbacks: each is called with the record of an epoch and the model after that epoch; a true
            result stops the training.
        progress: show a progress bar.

    Returns:
        The log, and its folder.

    Raises:
        InputError: data of other channels than the model, no validation set although `patience` or
            `keep="best"` needs one, or `out` holds another run or is used by one.
        DivergenceError: the loss is no longer finite and no best weights are kept; the last good
            checkpoint is.
    """
    if not isinstance(model, BaseModel):
        raise InputError(
            f"expected a model of make_model or load_model, got {type(model).__name__}; "
            "offbeat.make_model('gru', train) makes one"
        )
    sharded: ShardedDataset | None = None
    if isinstance(train, ShardedDataset):
        sharded, whole = train, train.sample(REFERENCE_TASKS)
    else:
        train = whole = Dataset.of(train)
    validation = None if validation is None else Dataset.of(validation)
    asked = config or TrainConfig()
    if validation is None and (asked.patience is not None or asked.keep == "best"):
        raise InputError("patience and keep='best' need a validation set; got none")
    folder = writable(out, folder=True) if out is not None and is_first() else None
    progress = progress and is_first()
    if device is not None:
        size = recipe_of(model.name, asked, validated=validation is not None).batch_size
        there = device_here(device) if isinstance(device, str) else device
        model.to(resolved(there, model, batch=size))
    if asked.tasks is not None:
        model.expect_silences(asked.tasks.horizon_s)
    trained_on = ordered(model, whole)
    if asked.redraw is not None:
        model.expect_silences(longest_silence(trained_on, asked.redraw, seed=asked.seed))
    recipe = recipe_of(model.name, asked, validated=validation is not None)
    if sharded is not None:
        check_trainable(sharded, recipe)
    reference = None
    if recipe.relative:
        fitted_to, measured_on = reference_tasks(trained_on, recipe)
        known = fitted_baselines(fitted_to) if baselines is None else baselines
        reference = Reference.of(known, model, measured_on)
    validated = None
    if validation is not None:
        own = ordered(model, validation)
        validated = ValidationSet.of(model, own, recipe, reference=reference)
    counts = validated is not None and validated.counted > 0
    check_precision(model, asked.precision or "float32")
    recipe = recipe_of(model.name, asked, validated=counts)
    if not counts and (recipe.patience is not None or recipe.keep == "best"):
        if validation is None:
            raise InputError("patience or keep='best' of the recipe needs a validation set")
        raise InputError(
            "no value of the validation set counts: none is known after its channel's first "
            "observation; give a longer validation set, or keep='last' and no patience"
        )
    with ExitStack() as stack:
        if folder is not None or current() is not None:
            on_first(lambda: _lock(stack, folder))
        units = reference if recipe.loss == "relative" else None
        examples: TrainingSet | ShardedTrainingSet
        if sharded is None:
            examples = TrainingSet(model, trained_on, recipe, reference=units)
        else:
            examples = ShardedTrainingSet(model, sharded, recipe, reference=units)
        stack.enter_context(closing(examples))
        parameters = stack.enter_context(flat_parameters(model))
        stack.enter_context(model.threads())
        state = RunState(parameters, recipe)
        identity: dict[str, Any] = {}

        def resume() -> Any:
            if folder is not None:
                identity.update(identity_of(model, recipe, train, validation, baselines))
                resume_run(folder, model, state, identity)
                if state.epoch > recipe.epochs:
                    raise InputError(
                        f"{folder} holds a run of {state.epoch} epochs already, {recipe.epochs} "
                        "were requested; give another folder"
                    )
            return packed(model, state) if current() is not None else None

        given = on_first(resume)
        if not is_first():
            unpack(model, state, given)
        run = (recipe, state, folder, identity, callbacks, progress)
        return _fit(model, examples, validated, *run)


def _lock(stack: ExitStack, folder: Path | None) -> None:
    if folder is not None:
        stack.enter_context(locked(folder))


def _fit(
    model: BaseModel,
    training_set: TrainingSet | ShardedTrainingSet,
    validated: ValidationSet | None,
    recipe: Recipe,
    state: RunState,
    folder: Path | None,
    identity: dict[str, Any],
    callbacks: Sequence[Callback],
    progress: bool,
) -> FitResult:
    stopped = _stopped(state, recipe)
    writer = _tensorboard(folder, state)
    with _progress_bar(state, recipe, len(training_set), progress) as bar:
        while state.epoch < recipe.epochs and not stopped:
            try:
                examples = training_set.epoch(state.epoch)
                with products(model, recipe.precision):
                    _epoch(model, examples, state, recipe, bar, folder, identity)
                _close_epoch(model, validated, state, recipe)
            except DivergenceError as error:
                stopped = _recover(model, state, recipe, error)
                if folder is not None:
                    save_run(folder, model, state, identity)
                continue
            record = state.history[-1]
            bar.set_postfix_str(_postfix(record))
            for name, value in asdict(record).items() if writer else ():
                writer.add_scalar(name, value, record.epoch)
            stopped = _stopped(state, recipe)
            if folder is not None:
                save_run(folder, model, state, identity)
                write_log(folder, state.history)
            if callbacks:
                stopped = on_first(partial(_told, callbacks, record, model)) or stopped
    if writer:
        writer.close()
    if recipe.keep == "best" and state.best:
        model.load_state_dict(state.best)
    if folder is not None:
        save_model(model, folder / "model")
    early = stopped and state.epoch < recipe.epochs
    return FitResult(
        tuple(state.history), early, folder, recipe, state.best_epoch, diverged=state.diverged
    )


def _told(callbacks: Sequence[Callback], record: EpochRecord, model: BaseModel) -> bool:
    """Calls all callbacks; True if one of them stops the training."""
    told = [bool(callback(record, model)) for callback in callbacks]
    return any(told)


def _recover(model: BaseModel, state: RunState, recipe: Recipe, error: DivergenceError) -> bool:
    """Restores the best weights after a divergence; True if it was the second one.

    Raises:
        DivergenceError: no best weights are kept.
    """
    if not state.best:
        raise error
    model.load_state_dict(state.best)
    state.forget_moments()
    state.total_steps -= state.step
    state.step, state.loss_sum, state.seconds = 0, 0.0, 0.0
    if state.rate_factor < 1:
        state.diverged = (
            f"the training diverged twice (epoch {state.epoch + 1}), also at half the learning "
            f"rate; it ends with the weights of epoch {state.best_epoch}, the best ones on the "
            "validation set: lower the learning rate, or clip gradients (clip_norm)"
        )
        return True
    state.rate_factor = 0.5
    return False


class StepTaker(Protocol):
    """Takes the steps of a training; see `offbeat.sweeps.together`."""

    def takes(self, model: BaseModel, examples: AnyExamples) -> bool:
        """Whether it takes those of this training."""

    def step(
        self,
        model: BaseModel,
        examples: AnyExamples,
        index: Tensor,
        state: RunState,
        recipe: Recipe,
    ) -> Tensor:
        """Takes a step; returns the loss before it."""


STEPS: ContextVar[StepTaker | None] = ContextVar("offbeat_steps", default=None)
"""What takes the steps of the trainings in this context; None: each training its own."""


# --- one epoch ------------------------------------------------------------------------------------


def _epoch(
    model: BaseModel,
    examples: AnyExamples,
    state: RunState,
    recipe: Recipe,
    bar: Any,
    folder: Path | None,
    identity: dict[str, Any],
) -> None:
    if isinstance(examples, ShardedEpoch):  # it has an order of its own
        order = np.arange(len(examples))
    else:
        order = order_of(recipe.seed, state.epoch, len(examples))
    steps = math.ceil(len(examples) / recipe.batch_size)
    losses, taker = _Losses(state), STEPS.get()
    if taker is not None and not taker.takes(model, examples):
        taker = None
    elsewhere = _Elsewhere(model, examples, state, recipe, order, 0 if taker else steps)
    started = time.perf_counter()
    done_before = state.seconds
    while state.step < steps:
        first = state.step * recipe.batch_size
        if taker is not None:
            index = torch.from_numpy(order[first : first + recipe.batch_size])
            _set_rate(state, recipe, steps * recipe.epochs)
            losses.add(taker.step(model, examples, index, state, recipe))
        elif elsewhere.used:
            losses.add(elsewhere.step(first))
        else:
            index = torch.from_numpy(order[first : first + recipe.batch_size])
            loss = train_step(model, examples, index, state, recipe, total=steps * recipe.epochs)
            state.loss_sum += loss
        state.step += 1
        state.total_steps += 1
        state.seconds = done_before + time.perf_counter() - started
        bar.update()
        due = recipe.checkpoint_every and state.step % recipe.checkpoint_every == 0
        if state.step % READ_EVERY == 0 or state.step == steps or due:
            losses.read()
            mean = state.loss_sum / state.step
            bar.set_description(f"epoch {state.epoch + 1}/{recipe.epochs} loss {mean:.3g}")
        if folder and due and state.step < steps:
            _check_weights(model, state)
            save_run(folder, model, state, identity)
    state.seconds = done_before + time.perf_counter() - started


def train_step(
    model: BaseModel,
    examples: AnyExamples,
    index: Tensor,
    state: RunState,
    recipe: Recipe,
    *,
    total: int,
) -> float:
    """Takes one optimizer step on some trajectories; returns the loss before it.

    Args:
        model: trained in place.
        examples: of the training part.
        index: (batch,) positions of the trajectories.
        state: optimizer and counters.
        recipe: learning rate, clipping and the rest.
        total: steps of the whole training, for a schedule.

    Raises:
        DivergenceError: the loss is not finite.
    """
    ranks = current()
    if ranks is not None:
        _set_rate(state, recipe, total)
        value = float(_descend_together(ranks, model, examples, index, state, recipe))
        _check_loss(value, state.epoch, state.step)
        direct = direct_step(model, examples, state, recipe)
        direct.descend() if direct is not None else state.optimizer.step()
        return value
    if (direct := direct_step(model, examples, state, recipe)) is not None:
        value = direct.loss(index)
        _check_loss(value, state.epoch, state.step)
        _set_rate(state, recipe, total)
        direct.backward()
        _clip(state, recipe)
        direct.descend()
        return value
    with autocast(model, recipe.precision):
        loss = examples.loss(model, index, _generator(model, state, recipe))
    value = float(loss.detach())
    _check_loss(value, state.epoch, state.step)
    _set_rate(state, recipe, total)
    _descend(loss, state, recipe)
    return value


def _generator(model: BaseModel, state: RunState, recipe: Recipe) -> torch.Generator | None:
    """The generator of a step, on the CPU on every device, so that its numbers are the same."""
    if not model.needs_generator:
        return None
    seed = np.random.default_rng([recipe.seed, state.epoch, state.step]).integers(2**62)
    return torch.Generator().manual_seed(int(seed))


def _check_loss(value: float, epoch: int, step: int) -> None:
    if not math.isfinite(value):
        raise DivergenceError(
            f"the loss is {value} in epoch {epoch + 1}, step {step + 1}; the "
            "last good checkpoint is kept: lower the learning rate, or clip gradients (clip_norm)"
        )


def _set_rate(state: RunState, recipe: Recipe, total: int) -> None:
    """Sets the learning rate of the next step."""
    if recipe.schedule == "cosine":
        rate = 0.5 * recipe.learning_rate * (1 + math.cos(math.pi * state.total_steps / total))
        state.set_rate(state.rate_factor * rate)
    elif state.rate_factor < 1:
        state.set_rate(state.rate_factor * recipe.learning_rate)


def _descend(loss: Tensor, state: RunState, recipe: Recipe) -> None:
    """Backward pass, clipping and the step of the optimizer."""
    state.parameters.zero_gradient()
    (loss * recipe.loss_scale).backward()  # type: ignore[no-untyped-call]
    _clip(state, recipe)
    state.optimizer.step()


def _clip(state: RunState, recipe: Recipe) -> None:
    if recipe.clip_norm is not None:
        torch.nn.utils.clip_grad_norm_([state.parameters.flat], recipe.clip_norm)


def _descend_together(
    ranks: Ranks,
    model: BaseModel,
    examples: AnyExamples,
    index: Tensor,
    state: RunState,
    recipe: Recipe,
    *,
    host: Tensor | None = None,
) -> Tensor:
    """The gradient of a batch, of which each rank takes its part; returns the loss of the batch.

    The step of the optimizer is left to the caller.
    """
    state.parameters.zero_gradient()
    own = ranks.share(index)
    loss = count = state.parameters.flat.new_zeros(())
    if len(own) and (direct := direct_step(model, examples, state, recipe)) is not None:
        assert isinstance(examples, Examples)
        loss, count = loss.new_tensor(direct.loss(own)), examples.count(own)
        direct.backward()
    elif len(own):
        generator = _generator(model, state, recipe)
        with autocast(model, recipe.precision):
            if host is None:
                loss, count = examples.weighed(model, own, generator)
            else:
                assert isinstance(examples, Examples)
                loss, count = examples.weighed(model, own, generator, host=ranks.share(host))
        (loss * recipe.loss_scale).backward()  # type: ignore[no-untyped-call]
    whole = ranks.reduce(state.parameters.gradient, loss, count)
    _clip(state, recipe)
    return whole


class _Losses:
    """Losses of steps that lie on another device: read together, so that steps don't wait.

    A loss that is not finite is found when it is read; the weights are those of later steps then.
    """

    def __init__(self, state: RunState) -> None:
        self._state, self._open = state, list[Tensor]()

    def add(self, loss: Tensor) -> None:
        """Takes the loss of a step."""
        self._open.append(loss)

    def read(self) -> None:
        """Reads the open losses and adds them to the sum of the epoch.

        Raises:
            DivergenceError: one is not finite.
        """
        if not self._open:
            return
        values = torch.stack(self._open).double().tolist()
        self._open.clear()
        for i, value in enumerate(values):
            _check_loss(value, self._state.epoch, self._state.step - len(values) + i)
            self._state.loss_sum += value


class _Elsewhere:
    """The steps of an epoch on another device than the CPU: no transfer and no wait within a step.

    The order of the trajectories, the same as on the CPU, is sent there once.
    """

    def __init__(
        self,
        model: BaseModel,
        examples: AnyExamples,
        state: RunState,
        recipe: Recipe,
        order: NDArray[np.int64],
        steps: int,
    ) -> None:
        self.used = steps > 0 and model.device.type != "cpu" and isinstance(examples, Examples)
        self._model, self._examples, self._state = model, examples, state
        self._recipe, self._total = recipe, steps * recipe.epochs
        self._captured: CapturedStep | None = None
        if not self.used:
            return
        self._here = torch.from_numpy(order)
        self._there = self._here.to(model.device)
        _set_rate(state, recipe, self._total)
        self._captured = captured(
            model, examples, state, recipe, self._whole, steps=steps - state.step
        )

    def step(self, first: int) -> Tensor:
        """The step on the batch that begins at `first`; returns its loss, on the device."""
        batch = slice(first, first + self._recipe.batch_size)
        index = self._there[batch]
        _set_rate(self._state, self._recipe, self._total)
        if self._captured is not None and len(index) == self._captured.batch:
            return self._captured(index)
        return self._eager(index, self._here[batch])

    def _eager(self, index: Tensor, host: Tensor | None, whole: bool = False) -> Tensor:
        assert isinstance(self._examples, Examples)
        if (ranks := current()) is not None:
            loss = _descend_together(
                ranks,
                self._model,
                self._examples,
                index,
                self._state,
                self._recipe,
                host=host,
            )
            self._state.optimizer.step()
            return loss
        generator = _generator(self._model, self._state, self._recipe)
        with autocast(self._model, self._recipe.precision):
            loss = self._examples.loss(self._model, index, generator, host=host, whole=whole)
        _descend(loss, self._state, self._recipe)
        return loss.detach()

    def _whole(self, index: Tensor) -> Tensor:
        return self._eager(index, None, whole=True)


def _close_epoch(
    model: BaseModel,
    validated: ValidationSet | None,
    state: RunState,
    recipe: Recipe,
) -> None:
    _check_weights(model, state)
    # On the first rank alone, so that all ranks stop at the same epoch.
    found = None
    if validated is not None:
        found = on_first(lambda: validated.judge(model, seed=recipe.seed))
    scores = found.scores if found is not None else None
    if (
        scores is not None
        and not math.isfinite(scores.after_first_row.mse)
        and scores.after_first_row.count
    ):
        raise DivergenceError(
            f"the validation MSE is {scores.after_first_row.mse} after epoch "
            f"{state.epoch + 1}; the last good checkpoint is kept: lower the learning rate, or "
            "clip gradients"
        )
    nan = math.nan
    record = EpochRecord(
        epoch=state.epoch + 1,
        steps=state.total_steps,
        train_mse=state.loss_sum / state.step,
        validation_mse=scores.after_first_observation.mse if scores else nan,
        validation_after_first_row_mse=scores.after_first_row.mse if scores else nan,
        validation_published_mse=scores.published.mse if scores else nan,
        learning_rate=float(state.optimizer.param_groups[0]["lr"]),
        seconds=state.seconds,
        validation_score=found.relative if found else nan,
    )
    state.history.append(record)
    error = record.validation_score if recipe.relative else record.validation_mse
    if error < state.best_mse:
        state.best_mse, state.best_epoch = error, record.epoch
        if recipe.keep == "best":
            state.best = {k: v.detach().clone() for k, v in model.state_dict().items()}
    state.epoch += 1
    state.step, state.loss_sum, state.seconds = 0, 0.0, 0.0


def _check_weights(model: BaseModel, state: RunState) -> None:
    if not bool(torch.isfinite(state.parameters.flat).all()):
        raise DivergenceError(
            f"a weight is not finite in epoch {state.epoch + 1}, step {state.step}; the "
            "last good checkpoint is kept: lower the learning rate, or clip gradients (clip_norm)"
        )


def _stopped(state: RunState, recipe: Recipe) -> bool:
    if state.diverged:
        return True
    return recipe.patience is not None and state.epoch - state.best_epoch >= recipe.patience


# --- progress -----------------------------------------------------------------------------------


def _tensorboard(folder: Path | None, state: RunState) -> Any:
    if folder is None:
        return None
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError:
        return None
    return SummaryWriter(str(folder / "tensorboard"), purge_step=state.epoch + 1)


@contextmanager
def _progress_bar(state: RunState, recipe: Recipe, trajectories: int, show: bool) -> Iterator[Any]:
    steps = math.ceil(trajectories / recipe.batch_size)
    bar = progress_bar(
        total=steps * recipe.epochs,
        initial=state.total_steps,
        show=show,
        unit="step",
        dynamic_ncols=True,
        mininterval=0.5,
    )
    try:
        yield bar
    finally:
        bar.close()


def _postfix(record: EpochRecord) -> str:
    if not math.isnan(record.validation_score):
        return f"validation error / best baseline {math.exp(record.validation_score / 2):.3f}"
    if math.isnan(record.validation_mse):
        return f"train RMSE {record.train_mse**0.5:.4f}"
    return f"validation RMSE {record.validation_mse**0.5:.4f}"
