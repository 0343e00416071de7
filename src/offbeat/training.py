"""Training: `fit`, its log and its checkpoints."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from tqdm import tqdm

from offbeat.config import Recipe, TrainConfig
from offbeat.data.batch import Batch
from offbeat.data.trajectory import Dataset
from offbeat.errors import DivergenceError, InputError
from offbeat.files import writable
from offbeat.metrics import Scores, ScoreSums
from offbeat.models.base import BaseModel
from offbeat.models.checkpoint import save_model
from offbeat.models.zoo import recipe_of
from offbeat.parts.heads import Prediction
from offbeat.run import (
    EpochRecord,
    RunState,
    flat_parameters,
    identity_of,
    resume_run,
    save_run,
    write_log,
)

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
    """

    history: tuple[EpochRecord, ...]
    stopped_early: bool
    folder: Path | None
    recipe: Recipe

    @property
    def steps(self) -> int:
        """Total number of optimizer steps."""
        return self.history[-1].steps if self.history else 0


def fit(
    model: BaseModel,
    train: Dataset,
    validation: Dataset | None = None,
    config: TrainConfig | None = None,
    *,
    out: str | Path | None = None,
    device: str | torch.device | None = None,
    callbacks: Sequence[Callback] = (),
    progress: bool = True,
) -> FitResult:
    """Trains a model in place on one-step-ahead prediction.

    The loss is that of the model's head over the known values of all rows but the first, in scaled
    units. Batches, their order and all random numbers depend only on `config.seed`.

    Args:
        model: trained in place.
        train: the training set; masked values that are known serve as targets.
        validation: scored after each epoch.
        config: fields that are None, or all of them if it is None, follow the model's recipe.
        out: folder for `log.csv`, checkpoints and the final `model`; a run that was stopped there
            is resumed, and ends bit for bit as if it had not been stopped.
        device: such as `cpu` or `cuda`; by default that of the model. The model stays on it.
        callbacks: each is called with the record of an epoch and the model after that epoch; a true
            result stops the training.
        progress: show a progress bar.

    Returns:
        The log, and its folder.

    Raises:
        InputError: data of other channels than the model, no validation set although `patience` or
            `keep="best"` needs one, or `out` holds another run.
        DivergenceError: the loss is no longer finite; the last good checkpoint is kept.
    """
    train = Dataset.of(train)
    validation = None if validation is None else Dataset.of(validation)
    asked = config or TrainConfig()
    if validation is None and (asked.patience is not None or asked.keep == "best"):
        raise InputError("patience and keep='best' need a validation set; got none")
    folder = writable(out, folder=True) if out is not None else None
    if device is not None:
        model.to(_device(device))
    batch = model.batch(train)
    validated = None
    if validation is not None:
        validated = ValidationSet(model, model.batch(validation))
    counts = validated is not None and validated.counted > 0
    recipe = recipe_of(model.name, asked, validated=counts)
    if not counts and (recipe.patience is not None or recipe.keep == "best"):
        if validation is None:
            raise InputError("patience or keep='best' of the recipe needs a validation set")
        raise InputError(
            "no value of the validation set counts: none is known after its channel's first "
            "observation; give a longer validation set, or keep='last' and no patience"
        )
    with flat_parameters(model) as parameters, model.threads():
        state = RunState(parameters, recipe)
        identity: dict[str, Any] = {}
        if folder is not None:
            identity = identity_of(model, recipe, train, validation)
            resume_run(folder, model, state, identity)
            if state.epoch > recipe.epochs:
                raise InputError(
                    f"{folder} holds a run of {state.epoch} epochs already, {recipe.epochs} were "
                    "requested; give another folder"
                )
        return _fit(model, batch, validated, recipe, state, folder, identity, callbacks, progress)


def _device(name: str | torch.device) -> torch.device:
    try:
        device = torch.device(name)
    except RuntimeError:
        raise InputError(f"there is no device {name!r}; give cpu, cuda or cuda:1") from None
    if device.type == "cuda" and not torch.cuda.is_available():
        raise InputError(f"there is no device {name!r} here: torch finds no CUDA; give cpu")
    return device


def _fit(
    model: BaseModel,
    batch: Batch,
    validated: ValidationSet | None,
    recipe: Recipe,
    state: RunState,
    folder: Path | None,
    identity: dict[str, Any],
    callbacks: Sequence[Callback],
    progress: bool,
) -> FitResult:
    examples = Examples(model, batch)
    stopped = _stopped(state, recipe)
    writer = _tensorboard(folder, state)
    with _progress_bar(state, recipe, len(batch), progress) as bar:
        while state.epoch < recipe.epochs and not stopped:
            _epoch(model, examples, state, recipe, bar, folder, identity)
            _close_epoch(model, validated, state, recipe)
            record = state.history[-1]
            bar.set_postfix_str(_postfix(record))
            for name, value in asdict(record).items() if writer else ():
                writer.add_scalar(name, value, record.epoch)
            stopped = _stopped(state, recipe)
            if folder is not None:
                save_run(folder, model, state, identity)
                write_log(folder, state.history)
            for callback in callbacks:
                stopped = bool(callback(record, model)) or stopped
    if writer:
        writer.close()
    if recipe.keep == "best" and state.best:
        model.load_state_dict(state.best)
    if folder is not None:
        save_model(model, folder / "model")
    early = stopped and state.epoch < recipe.epochs
    return FitResult(tuple(state.history), early, folder, recipe)


class ValidationSet:
    """A data set that is scored repeatedly; its step inputs are computed once.

    Args:
        model: its scales and statistics give the step inputs.
        batch: scaled by the model's scaler.
        size: trajectories at a time.
    """

    def __init__(self, model: BaseModel, batch: Batch, *, size: int = 500) -> None:
        self.channels = batch.channels
        with torch.no_grad():
            parts = (batch.take(slice(i, i + size)) for i in range(0, len(batch), size))
            self.parts = [(_whole(model.prepare(part)), part) for part in parts]
        empty = ScoreSums(self.channels)
        for _, part in self.parts:
            empty.add(part.values, part)
        self.counted = empty.scores().after_first_observation.count

    def scores(self, model: BaseModel, *, seed: int = 0, gap_unit: float | None = None) -> Scores:
        """Scores a model in its current state.

        Args:
            model: to score.
            seed: of self-feeding.
            gap_unit: s; groups the score by time since observation, as `ScoreSums` does.
        """
        sums = ScoreSums(self.channels, gap_unit=gap_unit)
        with torch.inference_mode():
            for prepared, part in self.parts:
                # One generator for all parts, as if they were one batch.
                generator = torch.Generator().manual_seed(seed) if model.needs_generator else None
                sums.add(model.run(prepared, generator=generator).mean, part)
        return sums.scores()


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


# --- one epoch ------------------------------------------------------------------------------------


class Examples:
    """A training set in memory, with inputs that are computed once for all epochs.

    Args:
        model: its scales and statistics give the step inputs.
        batch: scaled.
    """

    def __init__(self, model: BaseModel, batch: Batch) -> None:
        with torch.no_grad():
            self.prepared = model.prepare(batch)
        # Without the first row: its prediction is a constant.
        self.targets = batch.values[:, 1:].contiguous()
        counted = batch.targets[:, 1:]
        self.counted = None if bool(counted.all()) else counted.to(self.targets.dtype)

    def __len__(self) -> int:
        return len(self.prepared)

    def loss(self, model: BaseModel, index: Tensor, generator: torch.Generator | None) -> Tensor:
        """The model's loss of the one-step-ahead prediction of some trajectories.

        Args:
            model: in its current state.
            index: (batch,) positions of the trajectories.
            generator: of self-feeding.
        """
        index = index.to(self.targets.device)
        whole = model.run(self.prepared.take(index), generator=generator)
        scale = None if whole.scale is None else whole.scale[:, 1:]
        prediction = Prediction(whole.mean[:, 1:], scale)
        rows = prediction.mean.shape[1]
        targets = self.targets.index_select(0, index)[:, :rows]
        mask = None
        if self.counted is not None:
            mask = self.counted.index_select(0, index)[:, :rows]
        elif not rows:
            mask = torch.ones_like(targets)
        return model.loss(prediction, targets, mask)


def _epoch(
    model: BaseModel,
    examples: Examples,
    state: RunState,
    recipe: Recipe,
    bar: Any,
    folder: Path | None,
    identity: dict[str, Any],
) -> None:
    order = np.random.default_rng([recipe.seed, state.epoch]).permutation(len(examples))
    steps = math.ceil(len(examples) / recipe.batch_size)
    started = time.perf_counter()
    done_before = state.seconds
    while state.step < steps:
        first = state.step * recipe.batch_size
        index = torch.from_numpy(order[first : first + recipe.batch_size])
        loss = train_step(model, examples, index, state, recipe, total=steps * recipe.epochs)
        state.loss_sum += loss
        state.step += 1
        state.total_steps += 1
        state.seconds = done_before + time.perf_counter() - started
        bar.update()
        if state.step % 10 == 0:
            mean = state.loss_sum / state.step
            bar.set_description(f"epoch {state.epoch + 1}/{recipe.epochs} loss {mean:.3g}")
        due = recipe.checkpoint_every and state.step % recipe.checkpoint_every == 0
        if folder and due and state.step < steps:
            _check_weights(model, state)
            save_run(folder, model, state, identity)
    state.seconds = done_before + time.perf_counter() - started


def train_step(
    model: BaseModel,
    examples: Examples,
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
    generator = None
    if model.needs_generator:
        seed = np.random.default_rng([recipe.seed, state.epoch, state.step]).integers(2**62)
        generator = torch.Generator().manual_seed(int(seed))
    loss = examples.loss(model, index, generator)
    value = float(loss.detach())
    if not math.isfinite(value):
        raise DivergenceError(
            f"the loss is {value} in epoch {state.epoch + 1}, step {state.step + 1}; the "
            "last good checkpoint is kept: lower the learning rate, or clip gradients (clip_norm)"
        )
    state.parameters.zero_gradient()
    (loss * recipe.loss_scale).backward()  # type: ignore[no-untyped-call]
    if recipe.clip_norm is not None:
        torch.nn.utils.clip_grad_norm_([state.parameters.flat], recipe.clip_norm)
    if recipe.schedule == "cosine":
        rate = 0.5 * recipe.learning_rate * (1 + math.cos(math.pi * state.total_steps / total))
        for group in state.optimizer.param_groups:
            group["lr"] = rate
    state.optimizer.step()
    return value


def _close_epoch(
    model: BaseModel,
    validated: ValidationSet | None,
    state: RunState,
    recipe: Recipe,
) -> None:
    _check_weights(model, state)
    scores = validated.scores(model, seed=recipe.seed) if validated is not None else None
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
    )
    state.history.append(record)
    if scores is not None and scores.after_first_observation.mse < state.best_mse:
        state.best_mse, state.best_epoch = scores.after_first_observation.mse, record.epoch
        if recipe.keep == "best":
            state.best = {k: v.detach().clone() for k, v in model.state_dict().items()}
    state.epoch += 1
    state.step, state.loss_sum, state.seconds = 0, 0.0, 0.0


def _check_weights(model: BaseModel, state: RunState) -> None:
    if not all(bool(torch.isfinite(p).all()) for p in model.parameters()):
        raise DivergenceError(
            f"a weight is not finite in epoch {state.epoch + 1}, step {state.step}; the "
            "last good checkpoint is kept: lower the learning rate, or clip gradients (clip_norm)"
        )


def _stopped(state: RunState, recipe: Recipe) -> bool:
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
    bar = tqdm(
        total=steps * recipe.epochs,
        initial=state.total_steps,
        disable=None if show else True,  # None: where standard error is no terminal
        unit="step",
        dynamic_ncols=True,
        mininterval=0.5,
    )
    try:
        yield bar
    finally:
        bar.close()


def _postfix(record: EpochRecord) -> str:
    if math.isnan(record.validation_mse):
        return f"train RMSE {record.train_mse**0.5:.4f}"
    return f"validation RMSE {record.validation_mse**0.5:.4f}"
