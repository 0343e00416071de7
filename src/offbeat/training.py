"""Training: `fit`, its log, its checkpoints, and what it does when killed or diverging."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import mse_loss
from tqdm import tqdm

from offbeat.config import TrainConfig
from offbeat.data.batch import Batch
from offbeat.data.trajectory import Dataset
from offbeat.errors import DivergenceError, InputError
from offbeat.files import writable
from offbeat.kernels import StepTable
from offbeat.kernels.cpu import own_threads
from offbeat.metrics import Scores, ScoreSums
from offbeat.models.checkpoint import save_model
from offbeat.models.model import Model
from offbeat.run import (
    EpochRecord,
    RunState,
    flat_parameters,
    identity_of,
    resume_run,
    save_run,
    write_log,
)


@dataclass(frozen=True)
class FitResult:
    """What `fit` did.

    Attributes:
        history: one record per epoch.
        stopped_early: True if `patience` ended the training.
        folder: where log and checkpoints lie, or None.
    """

    history: tuple[EpochRecord, ...]
    stopped_early: bool
    folder: Path | None

    @property
    def steps(self) -> int:
        """Optimizer steps in all."""
        return self.history[-1].steps if self.history else 0


def fit(
    model: Model,
    train: Dataset,
    validation: Dataset | None = None,
    config: TrainConfig | None = None,
    *,
    out: str | Path | None = None,
    progress: bool = True,
) -> FitResult:
    """Trains a model in place on one-step-ahead prediction.

    The loss is the mean squared error over the known cells of all rows but the first, in scaled
    units. Batches, their order and all generator follow from `config.seed` alone.

    Args:
        model: trained in place.
        train: the training part; hidden cells that are known serve as targets.
        validation: scored after each epoch.
        config: by default `TrainConfig()`.
        out: folder for `log.csv`, checkpoints and the final `model`; a run that was stopped there
            goes on where it was, and ends bit for bit as if it had not been stopped.
        progress: show a progress bar.

    Returns:
        The log, and where it lies.

    Raises:
        InputError: data of other channels than the model, or `out` holds another run.
        DivergenceError: the loss left the finite numbers; the last good checkpoint is kept.
    """
    config = config or TrainConfig()
    if validation is None and (config.patience is not None or config.keep == "best"):
        raise InputError("patience and keep='best' need a validation part; got none")
    folder = writable(out, folder=True) if out is not None else None
    batch = model.batch(train)
    validation_set = (
        ValidationSet(model, model.batch(validation)) if validation is not None else None
    )
    with flat_parameters(model) as parameters, threads_for(model):
        return _fit(
            model, batch, validation_set, config, RunState(parameters, config), folder, progress
        )


def _fit(
    model: Model,
    batch: Batch,
    validation_set: ValidationSet | None,
    config: TrainConfig,
    state: RunState,
    folder: Path | None,
    progress: bool,
) -> FitResult:
    identity = identity_of(model, config, batch)
    if folder is not None:
        resume_run(folder, model, state, identity)
        if state.epoch > config.epochs:
            raise InputError(
                f"{folder} holds a run of {state.epoch} epochs already, {config.epochs} were asked "
                "for; give another folder"
            )
    examples = Examples(model, batch)
    stopped = _stopped(state, config)
    writer = _tensorboard(folder, state)
    with _progress_bar(state, config, len(batch), progress) as bar:
        while state.epoch < config.epochs and not stopped:
            _epoch(model, examples, state, config, bar, folder, identity)
            _close_epoch(model, batch, validation_set, state, config)
            record = state.history[-1]
            bar.set_postfix_str(_postfix(record))
            for name, value in asdict(record).items() if writer else ():
                writer.add_scalar(name, value, record.epoch)
            stopped = _stopped(state, config)
            if folder is not None:
                save_run(folder, model, state, identity)
                write_log(folder, state.history)
    if writer:
        writer.close()
    if config.keep == "best" and state.best:
        model.load_state_dict(state.best)
    if folder is not None:
        save_model(model, folder / "model")
    return FitResult(tuple(state.history), stopped and state.epoch < config.epochs, folder)


class ValidationSet:
    """A part that is scored again and again, its facts made once.

    Args:
        model: its scales and statistics make the step inputs.
        batch: scaled by the model's scaler.
        size: trajectories at a time.
    """

    def __init__(self, model: Model, batch: Batch, *, size: int = 500) -> None:
        self.channels = batch.channels
        with torch.no_grad():
            parts = (batch.take(slice(i, i + size)) for i in range(0, len(batch), size))
            self.parts = [(model.step_inputs(part)[0], part) for part in parts]

    def scores(self, model: Model, *, seed: int = 0, gap_unit: float | None = None) -> Scores:
        """Scores a model as it stands.

        Args:
            model: to score.
            seed: of the generator of self-feeding.
            gap_unit: s; groups the honest score by age, as `ScoreSums` does.
        """
        sums = ScoreSums(self.channels, gap_unit=gap_unit)
        with torch.inference_mode():
            for rows, part in self.parts:
                # The same generator for each part, as if they were one batch.
                generator = (
                    torch.Generator().manual_seed(seed) if model.config.self_feeding else None
                )
                sums.add(model.run(rows, generator=generator)[0], part)
        return sums.scores()


def validate(model: Model, batch: Batch, *, seed: int = 0, size: int = 500) -> Scores:
    """Scores a model on a scaled batch, a part at a time.

    Args:
        model: to score.
        batch: scaled by the model's scaler.
        seed: of the generator of self-feeding.
        size: trajectories at a time.
    """
    validation_set = ValidationSet(model, batch, size=size)
    return validation_set.scores(model, seed=seed, gap_unit=model.statistics.median_gap)


# --- one epoch ------------------------------------------------------------------------------------


class Examples:
    """A training part in memory, as a step takes it: nothing is made anew from epoch to epoch.

    Args:
        model: its scales and statistics make the step inputs.
        batch: scaled.
    """

    def __init__(self, model: Model, batch: Batch) -> None:
        with torch.no_grad():
            rows, _ = model.step_inputs(batch)
        self.table = StepTable.of(rows)
        # Flat, and without the first row: long runs of memory are quick to compare.
        self.targets = batch.values[:, 1:].flatten(1).contiguous()
        counted = (batch.known & batch.valid[..., None])[:, 1:].flatten(1)
        self.counted = None if bool(counted.all()) else counted.to(self.targets.dtype)

    def __len__(self) -> int:
        return len(self.table)

    def loss(self, model: Model, index: Tensor, generator: torch.Generator | None) -> Tensor:
        """Mean squared error of the one-step-ahead prediction of some trajectories.

        Args:
            model: as it stands.
            index: (batch,) positions of the trajectories.
            generator: generator of the generator of self-feeding.
        """
        rows = self.table.take(index)
        predictions = model.run(rows, generator=generator)[0].flatten(1)[:, model.channels :]
        cells = predictions.shape[1]
        targets = self.targets.index_select(0, index)[:, :cells]
        if self.counted is None and cells:
            return mse_loss(predictions, targets)
        counted = torch.ones_like(targets)
        if self.counted is not None:
            counted = self.counted.index_select(0, index)[:, :cells]
        return ((predictions - targets).square() * counted).sum() / counted.sum().clamp_min(1)


def _epoch(
    model: Model,
    examples: Examples,
    state: RunState,
    config: TrainConfig,
    bar: Any,
    folder: Path | None,
    identity: dict[str, Any],
) -> None:
    order = np.random.default_rng([config.seed, state.epoch]).permutation(len(examples))
    steps = math.ceil(len(examples) / config.batch_size)
    started = time.perf_counter()
    done_before = state.seconds
    while state.step < steps:
        first = state.step * config.batch_size
        index = torch.from_numpy(order[first : first + config.batch_size])
        loss = train_step(model, examples, index, state, config, total=steps * config.epochs)
        state.loss_sum += loss
        state.step += 1
        state.total_steps += 1
        state.seconds = done_before + time.perf_counter() - started
        bar.update()
        if state.step % 10 == 0:
            mean = state.loss_sum / state.step
            bar.set_description(f"epoch {state.epoch + 1}/{config.epochs} loss {mean:.3g}")
        due = config.checkpoint_every and state.step % config.checkpoint_every == 0
        if folder and due and state.step < steps:
            _check_weights(model, state)
            save_run(folder, model, state, identity)
    state.seconds = done_before + time.perf_counter() - started


@contextmanager
def threads_for(model: Model) -> Iterator[None]:
    """Within a `with` block, the threads go to whatever does the work of training a model.

    Args:
        model: one that the compiled backend runs leaves torch with one thread.
    """
    with own_threads() if model.runs_compiled() else nullcontext():
        yield


def train_step(
    model: Model,
    examples: Examples,
    index: Tensor,
    state: RunState,
    config: TrainConfig,
    *,
    total: int,
) -> float:
    """Takes one optimizer step on some trajectories; returns the loss before it.

    Args:
        model: trained in place.
        examples: of the training part.
        index: (batch,) positions of the trajectories.
        state: optimizer and counters.
        config: learning rate, clipping and the rest.
        total: steps of the whole training, for a schedule.

    Raises:
        DivergenceError: the loss is not finite.
    """
    generator = None
    if model.config.self_feeding:
        seed = np.random.default_rng([config.seed, state.epoch, state.step]).integers(2**62)
        generator = torch.Generator().manual_seed(int(seed))
    loss = examples.loss(model, index, generator)
    value = float(loss.detach())
    if not math.isfinite(value):
        raise DivergenceError(
            f"the loss turned to {value} in epoch {state.epoch + 1}, step {state.step + 1}; the "
            "last good checkpoint is kept: lower the learning rate, or clip gradients (clip_norm)"
        )
    state.parameters.zero_gradient()
    (loss * config.loss_scale).backward()  # type: ignore[no-untyped-call]
    if config.clip_norm is not None:
        torch.nn.utils.clip_grad_norm_([state.parameters.flat], config.clip_norm)
    if config.schedule == "cosine":
        rate = 0.5 * config.learning_rate * (1 + math.cos(math.pi * state.total_steps / total))
        for group in state.optimizer.param_groups:
            group["lr"] = rate
    state.optimizer.step()
    return value


def _close_epoch(
    model: Model,
    batch: Batch,
    validation_set: ValidationSet | None,
    state: RunState,
    config: TrainConfig,
) -> None:
    _check_weights(model, state)
    scores = validation_set.scores(model, seed=config.seed) if validation_set is not None else None
    if (
        scores is not None
        and not math.isfinite(scores.after_first_row.mse)
        and scores.after_first_row.cells
    ):
        raise DivergenceError(
            f"the validation MSE turned to {scores.after_first_row.mse} after epoch {state.epoch + 1}; "
            "the last good checkpoint is kept: lower the learning rate, or clip gradients"
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
        if config.keep == "best":
            state.best = {k: v.detach().clone() for k, v in model.state_dict().items()}
    state.epoch += 1
    state.step, state.loss_sum, state.seconds = 0, 0.0, 0.0


def _check_weights(model: Model, state: RunState) -> None:
    if not all(bool(torch.isfinite(p).all()) for p in model.parameters()):
        raise DivergenceError(
            f"a weight left the finite numbers in epoch {state.epoch + 1}, step {state.step}; the "
            "last good checkpoint is kept: lower the learning rate, or clip gradients (clip_norm)"
        )


def _stopped(state: RunState, config: TrainConfig) -> bool:
    return config.patience is not None and state.epoch - state.best_epoch >= config.patience


# --- what is shown ------------------------------------------------------------------------------


def _tensorboard(folder: Path | None, state: RunState) -> Any:
    if folder is None:
        return None
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError:
        return None
    return SummaryWriter(str(folder / "tensorboard"), purge_step=state.epoch + 1)


@contextmanager
def _progress_bar(
    state: RunState, config: TrainConfig, trajectories: int, show: bool
) -> Iterator[Any]:
    steps = math.ceil(trajectories / config.batch_size)
    bar = tqdm(
        total=steps * config.epochs,
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
