"""Training: `fit`, its log, its checkpoints, and what it does when killed or diverging."""

from __future__ import annotations

import csv
import io
import json
import math
import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from tqdm import tqdm

from offbeat.config import TrainConfig
from offbeat.data.batch import Batch
from offbeat.data.trajectory import Dataset
from offbeat.errors import DivergenceError, InputError
from offbeat.files import write_text
from offbeat.models.checkpoint import load_training_state, save_checkpoint, save_training_state
from offbeat.models.recurrence import RecurrentModel
from offbeat.scores import Scores, ScoreSums


@dataclass(frozen=True)
class EpochRecord:
    """One line of the log.

    Attributes:
        epoch: counted from 1.
        steps: optimizer steps so far.
        train_mse: mean over the epoch's batches, scaled units, rows after the first.
        validation_honest_mse: NaN without a validation part.
        validation_rows_1_99_mse: the same, all rows but the first.
        validation_published_mse: the same, the thesis' scoring.
        learning_rate: at the end of the epoch.
        seconds: wall time of the epoch.
    """

    epoch: int
    steps: int
    train_mse: float
    validation_honest_mse: float
    validation_rows_1_99_mse: float
    validation_published_mse: float
    learning_rate: float
    seconds: float


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


class _State:
    """All of a training run that changes; what a checkpoint must hold."""

    def __init__(self, model: RecurrentModel, config: TrainConfig) -> None:
        self.optimizer = _optimizer(model, config)
        self.epoch = 0  # epochs done
        self.step = 0  # steps done within the epoch
        self.total_steps = 0
        self.loss_sum = 0.0
        self.seconds = 0.0
        self.history: list[EpochRecord] = []
        self.best_mse = math.inf
        self.best_epoch = 0
        self.best: dict[str, Tensor] = {}


def fit(
    model: RecurrentModel,
    train: Dataset,
    validation: Dataset | None = None,
    config: TrainConfig | None = None,
    *,
    out: str | Path | None = None,
    progress: bool = True,
) -> FitResult:
    """Trains a model in place on one-step-ahead prediction.

    The loss is the mean squared error over the known cells of all rows but the first, in scaled
    units. Batches, their order and all coins follow from `config.seed` alone.

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
    folder = Path(out) if out is not None else None
    batch = model.batch(train)
    held_out = model.batch(validation) if validation is not None else None
    state = _State(model, config)
    identity = _identity(model, config, batch)
    if folder is not None:
        _resume(folder, model, state, identity)
        if state.epoch > config.epochs:
            raise InputError(
                f"{folder} holds a run of {state.epoch} epochs already, {config.epochs} were asked "
                "for; give another folder"
            )
    stopped = _stopped(state, config)
    writer = _tensorboard(folder, state)
    with _progress_bar(state, config, len(batch), progress) as bar:
        while state.epoch < config.epochs and not stopped:
            _epoch(model, batch, state, config, bar, folder, identity)
            _close_epoch(model, batch, held_out, state, config)
            record = state.history[-1]
            bar.set_postfix_str(_postfix(record))
            for name, value in asdict(record).items() if writer else ():
                writer.add_scalar(name, value, record.epoch)
            stopped = _stopped(state, config)
            if folder is not None:
                _save(folder, model, state, identity)
                _write_log(folder, state.history)
    if writer:
        writer.close()
    if config.keep == "best" and state.best:
        model.load_state_dict(state.best)
    if folder is not None:
        save_checkpoint(model, folder / "model")
    return FitResult(tuple(state.history), stopped and state.epoch < config.epochs, folder)


def validate(model: RecurrentModel, batch: Batch, *, seed: int = 0, size: int = 500) -> Scores:
    """Scores a model on a scaled batch, a part at a time.

    Args:
        model: to score.
        batch: scaled by the model's scaler.
        seed: of the coins of self-feeding.
        size: trajectories at a time.
    """
    sums = ScoreSums(batch.channels, gap_unit=model.statistics.median_gap)
    with torch.inference_mode():
        for first in range(0, len(batch), size):
            part = batch.take(slice(first, first + size))
            # The same coins for each part, as if they were one batch.
            coins = torch.Generator().manual_seed(seed) if model.config.self_feeding else None
            sums.add(model(part, coins=coins).predictions, part)
    return sums.scores()


# --- one epoch ------------------------------------------------------------------------------------


def _epoch(
    model: RecurrentModel,
    batch: Batch,
    state: _State,
    config: TrainConfig,
    bar: Any,
    folder: Path | None,
    identity: dict[str, Any],
) -> None:
    order = np.random.default_rng([config.seed, state.epoch]).permutation(len(batch))
    steps = math.ceil(len(batch) / config.batch_size)
    started = time.perf_counter()
    done_before = state.seconds
    while state.step < steps:
        first = state.step * config.batch_size
        part = batch.take(torch.from_numpy(order[first : first + config.batch_size]))
        loss = _step(model, part, state, config, total=steps * config.epochs)
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
            _save(folder, model, state, identity)
    state.seconds = done_before + time.perf_counter() - started


def _step(
    model: RecurrentModel, part: Batch, state: _State, config: TrainConfig, *, total: int
) -> float:
    coins = None
    if model.config.self_feeding:
        seed = np.random.default_rng([config.seed, state.epoch, state.step]).integers(2**62)
        coins = torch.Generator().manual_seed(int(seed))
    counted = part.known & part.valid[..., None]
    error = model(part, coins=coins).predictions[:, 1:] - part.values[:, 1:]
    counted = counted[:, 1:]
    loss = (error.square() * counted).sum() / counted.sum().clamp_min(1)
    value = float(loss.detach())
    if not math.isfinite(value):
        raise DivergenceError(
            f"the loss turned to {value} in epoch {state.epoch + 1}, step {state.step + 1}; the "
            "last good checkpoint is kept: lower the learning rate, or clip gradients (clip_norm)"
        )
    state.optimizer.zero_grad(set_to_none=True)
    (loss * config.loss_scale).backward()
    if config.clip_norm is not None:
        torch.nn.utils.clip_grad_norm_(model.parameters(), config.clip_norm, foreach=True)
    if config.schedule == "cosine":
        rate = 0.5 * config.learning_rate * (1 + math.cos(math.pi * state.total_steps / total))
        for group in state.optimizer.param_groups:
            group["lr"] = rate
    state.optimizer.step()
    return value


def _close_epoch(
    model: RecurrentModel,
    batch: Batch,
    held_out: Batch | None,
    state: _State,
    config: TrainConfig,
) -> None:
    _check_weights(model, state)
    scores = validate(model, held_out, seed=config.seed) if held_out is not None else None
    if scores is not None and not math.isfinite(scores.rows_1_99.mse) and scores.rows_1_99.cells:
        raise DivergenceError(
            f"the validation MSE turned to {scores.rows_1_99.mse} after epoch {state.epoch + 1}; "
            "the last good checkpoint is kept: lower the learning rate, or clip gradients"
        )
    nan = math.nan
    record = EpochRecord(
        epoch=state.epoch + 1,
        steps=state.total_steps,
        train_mse=state.loss_sum / state.step,
        validation_honest_mse=scores.honest.mse if scores else nan,
        validation_rows_1_99_mse=scores.rows_1_99.mse if scores else nan,
        validation_published_mse=scores.published.mse if scores else nan,
        learning_rate=float(state.optimizer.param_groups[0]["lr"]),
        seconds=state.seconds,
    )
    state.history.append(record)
    if scores is not None and scores.honest.mse < state.best_mse:
        state.best_mse, state.best_epoch = scores.honest.mse, record.epoch
        if config.keep == "best":
            state.best = {k: v.detach().clone() for k, v in model.state_dict().items()}
    state.epoch += 1
    state.step, state.loss_sum, state.seconds = 0, 0.0, 0.0


def _check_weights(model: RecurrentModel, state: _State) -> None:
    if not all(bool(torch.isfinite(p).all()) for p in model.parameters()):
        raise DivergenceError(
            f"a weight left the finite numbers in epoch {state.epoch + 1}, step {state.step}; the "
            "last good checkpoint is kept: lower the learning rate, or clip gradients (clip_norm)"
        )


def _optimizer(model: RecurrentModel, config: TrainConfig) -> torch.optim.Optimizer:
    kinds: dict[str, Any] = {
        "adamax": torch.optim.Adamax,
        "adam": torch.optim.Adam,
        "adamw": torch.optim.AdamW,
        "sgd": torch.optim.SGD,
    }
    optimizer: torch.optim.Optimizer = kinds[config.optimizer](
        model.parameters(), lr=config.learning_rate, foreach=True
    )
    return optimizer


def _stopped(state: _State, config: TrainConfig) -> bool:
    return config.patience is not None and state.epoch - state.best_epoch >= config.patience


# --- the run's folder -----------------------------------------------------------------------------


def _identity(model: RecurrentModel, config: TrainConfig, batch: Batch) -> dict[str, Any]:
    """What must be the same for a run to go on: anything else would end in other numbers."""
    identity: dict[str, Any] = {
        "model": asdict(model.config),
        "train": asdict(config),
        "trajectories": len(batch),
        "observed_cells": int(batch.mask.sum()),
        "checksum": float(batch.values.double().sum() + batch.times.sum()),
    }
    if config.schedule == "constant":
        identity["train"].pop("epochs")  # such a run can be trained for longer
    plain: dict[str, Any] = json.loads(json.dumps(identity))  # lists for tuples, as it is read back
    return plain


def _save(folder: Path, model: RecurrentModel, state: _State, identity: dict[str, Any]) -> None:
    tensors = {f"best.{k}": v for k, v in state.best.items()}
    for i, parameter in enumerate(model.parameters()):
        for name, value in state.optimizer.state.get(parameter, {}).items():
            tensors[f"optimizer.{i}.{name}"] = torch.as_tensor(value)
    facts = {
        "identity": identity,
        "epoch": state.epoch,
        "step": state.step,
        "total_steps": state.total_steps,
        "loss_sum": state.loss_sum,
        "seconds": state.seconds,
        "best_mse": state.best_mse if math.isfinite(state.best_mse) else None,
        "best_epoch": state.best_epoch,
        "history": [
            {k: None if v != v else v for k, v in asdict(record).items()}
            for record in state.history
        ],
        "torch_threads": torch.get_num_threads(),
    }
    checkpoints = folder / "checkpoints"
    name = f"steps-{state.total_steps:09d}"
    save_training_state(model, tensors, facts, checkpoints / name)
    for old in sorted(checkpoints.glob("steps-*")):
        if old.name != name:
            shutil.rmtree(old)


def _resume(folder: Path, model: RecurrentModel, state: _State, identity: dict[str, Any]) -> None:
    checkpoints = sorted((folder / "checkpoints").glob("steps-*"))
    if not checkpoints:
        return
    weights, tensors, facts = load_training_state(checkpoints[-1])
    for part, now in identity.items():
        if facts["identity"].get(part) != now:
            raise InputError(
                f"{folder} holds a run with another {_difference(facts['identity'].get(part), now)}"
                f" ({part}); give the same, or another folder"
            )
    model.load_state_dict(weights)
    for i, parameter in enumerate(model.parameters()):
        prefix = f"optimizer.{i}."
        values = {k[len(prefix) :]: v for k, v in tensors.items() if k.startswith(prefix)}
        if values:
            state.optimizer.state[parameter] = values
    state.best = {k[len("best.") :]: v for k, v in tensors.items() if k.startswith("best.")}
    for name in ("epoch", "step", "total_steps", "loss_sum", "seconds", "best_epoch"):
        setattr(state, name, facts[name])
    state.best_mse = math.inf if facts["best_mse"] is None else facts["best_mse"]
    for record in facts["history"]:
        fields_: dict[str, Any] = {k: math.nan if v is None else v for k, v in record.items()}
        state.history.append(EpochRecord(**fields_))
    _write_log(folder, state.history)


def _difference(then: Any, now: Any) -> str:
    if isinstance(then, dict) and isinstance(now, dict):
        keys = [k for k in now if then.get(k) != now[k]]
        return ", ".join(f"{k} ({then.get(k)!r} then, {now[k]!r} now)" for k in keys)
    return f"training set ({then!r} then, {now!r} now)"


def _write_log(folder: Path, history: list[EpochRecord]) -> None:
    text = io.StringIO()
    log = csv.writer(text, lineterminator="\n")
    log.writerow([f.name for f in fields(EpochRecord)])
    log.writerows([getattr(record, f.name) for f in fields(EpochRecord)] for record in history)
    write_text(folder / "log.csv", text.getvalue())


def _tensorboard(folder: Path | None, state: _State) -> Any:
    if folder is None:
        return None
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError:
        return None
    return SummaryWriter(str(folder / "tensorboard"), purge_step=state.epoch + 1)


@contextmanager
def _progress_bar(
    state: _State, config: TrainConfig, trajectories: int, show: bool
) -> Iterator[Any]:
    steps = math.ceil(trajectories / config.batch_size)
    bar = tqdm(
        total=steps * config.epochs,
        initial=state.total_steps,
        disable=not show,
        unit="step",
        dynamic_ncols=True,
        mininterval=0.5,
    )
    try:
        yield bar
    finally:
        bar.close()


def _postfix(record: EpochRecord) -> str:
    if math.isnan(record.validation_honest_mse):
        return f"train RMSE {record.train_mse**0.5:.4f}"
    return f"validation RMSE {record.validation_honest_mse**0.5:.4f}"
