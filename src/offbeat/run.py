"""The state of a training run, its checkpoints in a folder, and how it is resumed."""

from __future__ import annotations

import csv
import hashlib
import io
import json
import logging
import math
import os
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from dataclasses import MISSING, asdict, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from offbeat.config import Recipe
from offbeat.data.shards import ShardedDataset
from offbeat.data.trajectory import Dataset
from offbeat.errors import InputError
from offbeat.files import clean, write_text
from offbeat.models.base import BaseModel
from offbeat.models.checkpoint import load_training_state, save_training_state
from offbeat.models.corrected import CorrectedModel
from offbeat.models.foreign import ForeignModel
from offbeat.models.model import Model
from offbeat.models.zoo import COMMON


@dataclass(frozen=True)
class EpochRecord:
    """One row of the log.

    Attributes:
        epoch: counted from 1.
        steps: optimizer steps so far.
        train_mse: mean of the loss over the epoch's batches: by default the MSE in scaled units,
            rows after the first.
        validation_mse: NaN without a validation part.
        validation_after_first_row_mse: the same, all rows but the first.
        validation_published_mse: the same, the thesis' scoring.
        learning_rate: at the end of the epoch.
        seconds: wall time of the epoch.
        validation_score: mean logarithm of the ratio of the MSE to that of the best baseline, see
            `ErrorTable.relative`; NaN without tasks or a relative loss.
    """

    epoch: int
    steps: int
    train_mse: float
    validation_mse: float
    validation_after_first_row_mse: float
    validation_published_mse: float
    learning_rate: float
    seconds: float
    validation_score: float = math.nan


class FlatParameters:
    """All parameters of a model in one tensor, so that an optimizer's step is a few operations.

    Attributes:
        flat: every parameter, in the order of `model.parameters()`; shares their gradients.
    """

    def __init__(self, model: BaseModel) -> None:
        self._own = list(model.parameters())
        flat = torch.cat([p.detach().reshape(-1) for p in self._own])
        self.flat = torch.nn.Parameter(flat)
        self.gradient = torch.zeros_like(flat)
        self.flat.grad = self.gradient
        at = 0
        for p in self._own:
            end = at + p.numel()
            p.data = flat[at:end].view_as(p)
            p.grad = self.gradient[at:end].view_as(p)
            at = end

    def zero_gradient(self) -> None:
        """Sets the gradient to 0 before a step; the backward pass adds to it in place."""
        self.gradient.zero_()

    def release(self) -> None:
        """Restores separate memory for each parameter."""
        for p in self._own:
            p.data = p.data.clone()
            p.grad = None


@contextmanager
def flat_parameters(model: BaseModel) -> Iterator[FlatParameters]:
    """Context manager that stores a model's parameters contiguously during training.

    Args:
        model: to train.
    """
    parameters = FlatParameters(model)
    try:
        yield parameters
    finally:
        parameters.release()


class RunState:
    """The state of a training run without the model, for checkpoints.

    Args:
        parameters: that the optimizer changes.
        recipe: with the optimizer.
    """

    def __init__(self, parameters: FlatParameters, recipe: Recipe) -> None:
        self.parameters = parameters
        self.optimizer = _optimizer(parameters.flat, recipe)
        self.epoch = 0  # epochs done
        self.step = 0  # steps done within the epoch
        self.total_steps = 0
        self.loss_sum = 0.0
        self.seconds = 0.0
        self.history: list[EpochRecord] = []
        self.best_mse = math.inf  # or score, where there is one
        self.best_epoch = 0
        self.rate_factor = 1.0  # of the learning rate; smaller after a divergence
        self.diverged = ""  # what happened, where a training ended so
        self.best: dict[str, Tensor] = {}
        self.direct: Any = None  # of `direct.py`

    def set_rate(self, rate: float) -> None:
        """Sets the learning rate of the steps that follow."""
        for group in self.optimizer.param_groups:
            if isinstance(group["lr"], Tensor):
                group["lr"].fill_(rate)
            else:
                group["lr"] = rate

    def forget_moments(self) -> None:
        """Resets the optimizer; a graph keeps the tensors, so they stay where they are."""
        if self.parameters.flat.device.type == "cpu":
            self.optimizer.state.clear()
            return
        with torch.no_grad():
            for value in self.optimizer.state.get(self.parameters.flat, {}).values():
                value.zero_()


def _optimizer(flat: torch.nn.Parameter, recipe: Recipe) -> torch.optim.Optimizer:
    kinds: dict[str, Any] = {
        "adamax": torch.optim.Adamax,
        "adam": torch.optim.Adam,
        "adamw": torch.optim.AdamW,
        "sgd": torch.optim.SGD,
    }
    options: dict[str, Any] = {"lr": recipe.learning_rate, "foreach": True}
    if flat.device.type != "cpu" and recipe.optimizer != "sgd":
        # The count of steps and the rate lie on the device, so that a graph can hold the step.
        options["capturable"] = flat.device.type == "cuda"
    if flat.device.type == "cuda":
        options["lr"] = torch.tensor(recipe.learning_rate, device=flat.device)
    optimizer: torch.optim.Optimizer = kinds[recipe.optimizer]([flat], **options)
    return optimizer


def packed(model: BaseModel, state: RunState) -> dict[str, Any]:
    """Weights and state of a training, to be sent to other ranks.

    Args:
        model: in its current state.
        state: of its training.
    """
    moments = state.optimizer.state.get(state.parameters.flat, {})
    return {
        "weights": {k: v.detach().cpu() for k, v in model.state_dict().items()},
        "moments": {k: torch.as_tensor(v).cpu() for k, v in moments.items()},
        "best": {k: v.cpu() for k, v in state.best.items()},
        "fields": {name: getattr(state, name) for name in _FIELDS},
    }


def unpack(model: BaseModel, state: RunState, given: dict[str, Any]) -> None:
    """Takes what `packed` gave on another rank.

    Args:
        model: gets the weights.
        state: gets the rest.
        given: of the first rank.
    """
    model.load_state_dict(given["weights"])
    device = state.parameters.flat.device
    if given["moments"]:
        state.optimizer.state[state.parameters.flat] = {
            k: v.to(device) if v.ndim or device.type == "cuda" else v
            for k, v in given["moments"].items()
        }
    state.best = given["best"]
    for name, value in given["fields"].items():
        setattr(state, name, value)


_FIELDS = (
    "epoch", "step", "total_steps", "loss_sum", "seconds", "history", "best_mse", "best_epoch",
    "rate_factor", "diverged",
)  # fmt: skip
"""What a state holds besides tensors."""

LOCK = ".lock"
"""File in a run's folder with the id of the process that trains there."""

CONVERTED = "converted"
"""Folder of a run with its logs as data sets, where they are read one by one."""

LADDER = "ladder"
"""Subfolder of the trainings from which `fit_ladder` chooses."""


_held: ContextVar[frozenset[Path]] = ContextVar("held", default=frozenset())
"""Folders that this thread has locked."""


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Locks the folder of a run for this process, for as long as the block runs.

    The lock of a process that has ended, however it ended, is void, and temporary files that it
    left are removed. Inside of the block, the same thread can lock the folder again. A folder that
    was made for a block which wrote nothing into it, as for bad input, is removed.

    Args:
        folder: of the run; made if it is missing.

    Raises:
        InputError: another training uses it.
    """
    made = not folder.exists()
    folder.mkdir(parents=True, exist_ok=True)
    if folder.resolve() in _held.get():
        yield
        return
    with (folder / LOCK).open("a+", encoding="utf-8") as file:
        if os.name == "posix":
            import fcntl

            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError:
                file.seek(0)
                raise InputError(
                    f"{folder} is in use: process {file.read().strip() or '?'} trains there; wait "
                    "until it ends, or give another folder"
                ) from None
        file.truncate(0)
        file.write(str(os.getpid()))
        file.flush()
        clean(folder)
        token = _held.set(_held.get() | {folder.resolve()})
        try:
            yield
        finally:
            _held.reset(token)
            if made and [path.name for path in folder.iterdir()] == [LOCK]:
                with suppress(OSError):  # where an open file cannot be removed
                    (folder / LOCK).unlink()
                    folder.rmdir()


def identity_of(
    model: BaseModel,
    recipe: Recipe,
    train: Dataset | ShardedDataset,
    validation: Dataset | None,
    baselines: Sequence[Any] | None = None,
) -> dict[str, Any]:
    """The identity of a run, which must be equal to resume it.

    Args:
        model: before the first step.
        recipe: of the training.
        train: the training set.
        validation: the validation set, or None.
        baselines: that the training was given.
    """
    weights = hashlib.sha256()
    for value in model.state_dict().values():
        weights.update(value.detach().cpu().numpy().tobytes())
    options: dict[str, Any] = {}
    if isinstance(model, Model):
        options = asdict(model.config)
    elif isinstance(model, ForeignModel | CorrectedModel):
        options = model.options
    identity: dict[str, Any] = {
        "model": {**options, "name": model.name},
        "training": asdict(recipe),
        "train": _part(train),
        "validation": None if validation is None else _part(validation),
        # These depend on the training set unless they were given.
        "scaler": model.scaler.to_dict(),
        "statistics": model.statistics.to_dict(),
        "initial_weights": weights.hexdigest(),
    }
    if recipe.schedule == "constant":
        identity["training"].pop("epochs")  # such a run can be trained for longer
    if baselines is not None:
        identity["baselines"] = [_predictor(each) for each in baselines]
    # lists in place of tuples, as in the file
    plain: dict[str, Any] = json.loads(json.dumps(identity))
    return plain


def _predictor(predictor: Any) -> dict[str, Any]:
    """The identity of a fitted predictor: its class, and its arrays where it has any."""
    digest = hashlib.sha256()
    for name, array in getattr(predictor, "arrays", dict)().items():
        digest.update(name.encode() + np.ascontiguousarray(array).tobytes())
    return {"kind": type(predictor).__name__, "arrays": digest.hexdigest()}


def _part(dataset: Dataset | ShardedDataset) -> dict[str, Any]:
    """The identity of a data set, from its channels to its fingerprint."""
    channels = [f"{n} [{u}]" for n, u in zip(dataset.names, dataset.units, strict=True)]
    if isinstance(dataset, ShardedDataset):
        return {
            "channels": channels,
            "trajectories": len(dataset),
            "rows": dataset.rows,
            "files": len(dataset.shards),
            "window": dataset.window,
            "cache_mb": dataset.cache_mb,
            "fingerprint": dataset.fingerprint(),
        }
    return {
        "channels": channels,
        "trajectories": len(dataset),
        "rows": sum(t.rows for t in dataset),
        "observed": sum(int(t.observed.sum()) for t in dataset),
        "fingerprint": dataset.fingerprint(),
    }


_WORDS = {
    "model": "the options of the model",
    "training": "the options of the training",
    "scaler": "the scales of the channels",
    "statistics": "the means, scales, gaps or filters of the training set",
    "initial_weights": "the initial weights",
    "train": "the trajectories of the training set",
    "validation": "the trajectories of the validation set",
    "baselines": "the baselines",
}
"""Names of the parts of an identity in messages."""


def save_run(folder: Path, model: BaseModel, state: RunState, identity: dict[str, Any]) -> None:
    """Writes a checkpoint of a run, and then removes the previous one.

    Args:
        folder: of the run.
        model: in its current state.
        state: of its training.
        identity: from `identity_of`.
    """
    tensors = {f"best.{k}": v for k, v in state.best.items()}
    for name, value in state.optimizer.state.get(state.parameters.flat, {}).items():
        tensors[f"optimizer.{name}"] = torch.as_tensor(value)
    record = {
        "identity": identity,
        "epoch": state.epoch,
        "step": state.step,
        "total_steps": state.total_steps,
        "loss_sum": state.loss_sum,
        "seconds": state.seconds,
        "best_mse": state.best_mse if math.isfinite(state.best_mse) else None,
        "best_epoch": state.best_epoch,
        "rate_factor": state.rate_factor,
        "diverged": state.diverged,
        "history": [
            {k: None if v != v else v for k, v in asdict(epoch).items()} for epoch in state.history
        ],
        "torch_threads": torch.get_num_threads(),
        "backend": model.backend()[0],
    }
    checkpoints = folder / "checkpoints"
    name = f"steps-{state.total_steps:09d}"
    save_training_state(model, tensors, record, checkpoints / name)
    for old in sorted(checkpoints.glob("steps-*")):
        if old.name != name:
            shutil.rmtree(old)


def resume_run(folder: Path, model: BaseModel, state: RunState, identity: dict[str, Any]) -> None:
    """Resumes from the last checkpoint of a run, if there is one.

    A run of another backend is resumed with a warning that names both: the bits differ.

    Args:
        folder: of the run.
        model: gets the weights of the checkpoint.
        state: gets the rest.
        identity: from `identity_of`.

    Raises:
        InputError: the checkpoint is of a run with another identity, or the folder contains
            something else.
        FileFormatError: the checkpoint is damaged.
    """
    checkpoints = sorted((folder / "checkpoints").glob("steps-*"))
    if not checkpoints:
        others = {path.name for path in folder.iterdir()} if folder.is_dir() else set()
        if others - {"tensorboard", "checkpoints", LOCK, LADDER, CONVERTED}:
            raise InputError(
                f"{folder} is not empty and holds no run ({', '.join(sorted(others)[:3])}, ...); "
                "give a new folder"
            )
        return
    weights, tensors, kept = load_training_state(checkpoints[-1])
    if "fingerprint" not in kept["identity"]["train"]:
        raise InputError(
            f"{folder} holds a run of Offbeat 0.1, whose checkpoints do not say on which data; its "
            "model can be used, but the run can't be resumed: give another folder"
        )
    for part in _WORDS:
        now = identity.get(part)
        then = _completed(kept["identity"].get(part), now)
        if then != now:
            raise InputError(
                f"{folder} holds another run: {_WORDS[part]} differ{_difference(then, now)}; give "
                "the same as then, or another folder"
            )
    then, now = kept.get("backend"), model.backend()[0]
    if then is not None and then != now:
        logging.getLogger("offbeat").warning(
            "%s was trained with the backend %s, and goes on with %s: the same up to rounding, but "
            "not the same bits as in one go; OFFBEAT_SCAN=%s chooses the first one again",
            folder, then, now, then,
        )  # fmt: skip
    model.load_state_dict(weights)
    for old in checkpoints[:-1]:  # of a process that was killed before it removed them
        shutil.rmtree(old)
    prefix = "optimizer."
    device = state.parameters.flat.device
    moments = {
        # A count of steps, which has no axes, stays with the optimizer's numbers on the CPU.
        k[len(prefix) :]: v.to(device) if v.ndim or device.type == "cuda" else v
        for k, v in tensors.items()
        if k.startswith(prefix)
    }
    if moments:
        state.optimizer.state[state.parameters.flat] = moments
    state.best = {k[len("best.") :]: v for k, v in tensors.items() if k.startswith("best.")}
    for name in ("epoch", "step", "total_steps", "loss_sum", "seconds", "best_epoch"):
        setattr(state, name, kept[name])
    state.rate_factor = kept.get("rate_factor", 1.0)
    state.diverged = kept.get("diverged", "")
    state.best_mse = math.inf if kept["best_mse"] is None else kept["best_mse"]
    for record in kept["history"]:
        fields_: dict[str, Any] = {k: math.nan if v is None else v for k, v in record.items()}
        state.history.append(EpochRecord(**fields_))
    write_log(folder, state.history)


_DEFAULTS: dict[str, Any] = {
    **COMMON,
    **{f.name: f.default for f in fields(Recipe) if f.default is not MISSING},
}
"""What an option stands for that a run does not name, because it is younger than the run."""


def _completed(then: Any, now: Any) -> Any:
    """An identity with the options that later versions added."""
    if not isinstance(then, dict) or not isinstance(now, dict):
        return then
    added = {key: _DEFAULTS[key] for key in now if key not in then and key in _DEFAULTS}
    return {**added, **{key: _completed(value, now.get(key)) for key, value in then.items()}}


def _difference(then: Any, now: Any) -> str:
    """A short description of the difference."""
    if not isinstance(then, dict) or not isinstance(now, dict):
        one_is_missing = then is None or now is None
        return f" ({'none' if then is None else 'one'} then)" if one_is_missing else ""
    keys = [key for key in now if then.get(key) != now[key]]
    if len(keys) == 1 and isinstance(then.get(keys[0]), dict) and isinstance(now[keys[0]], dict):
        return _difference(then[keys[0]], now[keys[0]])
    if "name" in keys:  # for another model, all else differs as well
        keys = ["name"]
    short = [key for key in keys if key != "fingerprint" and not isinstance(now[key], list)]
    if keys == ["fingerprint"]:
        return " (the same size, other values, times, masks or order)"
    if not short:
        return f" ({', '.join(keys)})"
    return f" ({', '.join(f'{key} {then.get(key)!r} then, {now[key]!r} now' for key in short)})"


def write_log(folder: Path, history: list[EpochRecord]) -> None:
    """Writes `log.csv`, a row per epoch.

    Args:
        folder: of the run.
        history: one record per epoch.
    """
    text = io.StringIO()
    log = csv.writer(text, lineterminator="\n")
    log.writerow([f.name for f in fields(EpochRecord)])
    log.writerows([getattr(record, f.name) for f in fields(EpochRecord)] for record in history)
    write_text(folder / "log.csv", text.getvalue())
