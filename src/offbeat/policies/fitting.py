"""`fit_policy`: behavioural cloning from demonstrations at uneven times."""

from __future__ import annotations

import logging
import math
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from offbeat.config import ModelConfig, check_count, check_seed
from offbeat.data.batch import Batch
from offbeat.data.drops import Drops
from offbeat.data.scaler import Scaler
from offbeat.data.trajectory import ACTION, Dataset
from offbeat.errors import DivergenceError, InputError, one_of
from offbeat.models.base import BaseModel
from offbeat.models.model import Model
from offbeat.models.zoo import MODELS, make_model
from offbeat.parts.heads import Prediction
from offbeat.policies.policy import Policy
from offbeat.progress import progress_bar
from offbeat.run import flat_parameters

ACTION_HEADS = {"mse": "actions", "nll": "gaussian_actions"}
"""Heads of the losses of actions."""

RISE = 2.0
"""A training goes back where its mean loss is this many times as high as the lowest one."""

RISE_EPOCHS = 5
"""Epochs of these means."""

COMPOSED = {
    "hidden_size": 32,
    "init": "fan_in",
    "field_units": (50, 50),
    "decoder_units": (100, 100),
}
"""Options of models of parts, where no others are given: those of the thesis train slowly here."""


@dataclass(frozen=True)
class CloneConfig:
    """How a policy is cloned.

    Attributes:
        loss: of the actions, scaled to their bounds: `mse`, the mean squared error; or `nll`, the
            negative log-likelihood of a normal distribution, whose mean is the action.
        observation_weight: weight of the error of predicting each observation before it arrives; 0
            trains on actions alone.
        epochs: passes over the demonstrations.
        window: rows of the windows that are trained on; None takes whole demonstrations.
        starts: fraction of the windows that begin where a demonstration does, as every rollout
            does; the others begin anywhere.
        batch_size: windows per step.
        learning_rate: of Adam, at the start; it decays to 0 along a cosine. Where the loss rises to
            twice its lowest value (means of five epochs), the training goes back to the parameters
            of the lowest one, with half the rate.
        clip_norm: gradients are scaled down to this norm.
        seed: of the weights, the windows and what is lost.
    """

    loss: Literal["mse", "nll"] = "mse"
    observation_weight: float = 0.1
    epochs: int = 200
    window: int | None = 50
    starts: float = 0.1
    batch_size: int = 16
    learning_rate: float = 0.01
    clip_norm: float = 1.0
    seed: int = 0

    def __post_init__(self) -> None:
        one_of("loss of actions", self.loss, ACTION_HEADS)
        check_seed(self.seed)
        for name in ("epochs", "batch_size"):
            check_count(name, getattr(self, name))
        if self.window is not None and not (isinstance(self.window, int) and self.window >= 2):
            raise InputError(f"window must be at least 2 rows, got {self.window!r}")
        for name in ("learning_rate", "clip_norm"):
            if not 0 < getattr(self, name) < math.inf:
                raise InputError(f"{name} must be a positive number, got {getattr(self, name)!r}")
        if not 0 <= self.starts <= 1:
            raise InputError(f"starts must be a fraction from 0 to 1, got {self.starts!r}")
        if not 0 <= self.observation_weight < math.inf:
            raise InputError(
                f"observation_weight must be at least 0, got {self.observation_weight!r}"
            )


@dataclass(frozen=True)
class CloneRecord:
    """An epoch of a cloning.

    Attributes:
        epoch: counted from 1.
        loss: mean of the training.
        validation: mean squared error of the actions of the validation demonstrations, with as much
            lost as in training, in units of half the range of each action; NaN without any.
    """

    epoch: int
    loss: float
    validation: float


@dataclass(frozen=True)
class _Rows:
    """Demonstrations as one padded batch."""

    whole: Batch
    lengths: NDArray[np.int64]
    sensors: list[list[int]] | None
    seen: list[int] = field(default_factory=list)


def fit_policy(
    demonstrations: Dataset,
    model: str | ModelConfig = "anchored_ode_gru_d",
    *,
    validation: Dataset | None = None,
    bounds: tuple[ArrayLike, ArrayLike] | None = None,
    drops: Drops | None = None,
    sensors: list[list[str]] | None = None,
    config: CloneConfig | None = None,
    progress: bool = True,
    **options: Any,
) -> Policy:
    """Clones a policy from demonstrations, at the times and with the masks that these have.

    Each epoch draws windows of the demonstrations anew, and loses frames, sensors and bursts of
    them, so that the policy learns to act from what is left. The action of a row is a target after
    the observation of that row.

    Args:
        demonstrations: observed channels, and channels with the role `action`.
        model: name of a model, or a config.
        validation: demonstrations by whose actions the best epoch is chosen; by default the last
            one is kept.
        bounds: (actions,) lowest and highest action; by default those of the demonstrations.
        drops: what is lost in training; by default up to 90 % of the frames.
        sensors: names of the channels of each sensor, for `drops.sensors`; by default each channel
            is one.
        config: of the training.
        progress: show a progress bar.
        **options: of the model.

    Returns:
        The policy; `policy.log` has a record per epoch.

    Raises:
        InputError: there are no actions or no observations, bounds are no bounds, or an option is
            unknown.
        DivergenceError: the loss is no longer finite in one of the first five epochs.

    Example:
        >>> policy = fit_policy(demonstrations, "gru_d", drops=Drops(frames=0.8))  # doctest: +SKIP
    """
    demonstrations = Dataset.of(demonstrations)
    config, drops = config or CloneConfig(), drops or Drops()
    acts = np.array([role == ACTION for role in demonstrations.roles])
    if not acts.any() or acts.all():
        raise InputError(
            f"demonstrations need observations and actions, got the channels "
            f"{', '.join(demonstrations.names)} with the roles {', '.join(demonstrations.roles)}; "
            "give those that are actions the role 'action'"
        )
    name = model if isinstance(model, str) else model.name
    if MODELS[name].factory is None and isinstance(model, str):
        options = {"head": ACTION_HEADS[config.loss], **COMPOSED, **options}
    made: BaseModel = make_model(
        model,
        demonstrations,
        scaler=_scaler(demonstrations, acts, bounds),
        seed=config.seed,
        **options,
    )
    policy = Policy(made, window=config.window or 64)
    train = _rows(made, demonstrations, sensors)
    made.expect_silences(_longest_silence(train, drops, config))
    judged = None
    if validation is not None:
        judged = _Validation(made, _rows(made, Dataset.of(validation), sensors), drops, config)
    policy.log = tuple(_fit(made, train, judged, drops, config, progress))
    policy.reset()
    return policy


def _scaler(
    demonstrations: Dataset, acts: NDArray[np.bool_], bounds: tuple[ArrayLike, ArrayLike] | None
) -> Scaler:
    """Standardises observations, and maps the bounds of actions to -1 and 1."""
    standard = Scaler.fit("standardise", demonstrations)
    columns = np.concatenate([t.values[:, acts] for t in demonstrations])
    low, high = np.nanmin(columns, axis=0), np.nanmax(columns, axis=0)
    if bounds is not None:
        given = [np.asarray(bound, dtype=np.float64).reshape(-1) for bound in bounds]
        if len(given) != 2 or any(len(bound) not in (1, acts.sum()) for bound in given):
            raise InputError(f"bounds must be two arrays of {acts.sum()} actions, got {bounds!r}")
        low, high = (np.broadcast_to(bound, low.shape) for bound in given)
        if not (np.isfinite(low).all() and np.isfinite(high).all() and (low < high).all()):
            raise InputError(f"bounds must be finite, the lowest below the highest, got {bounds!r}")
    shift, scale = standard.shift.copy(), standard.scale.copy()
    shift[acts] = (low + high) / 2
    scale[acts] = np.where(high > low, (high - low) / 2, 1.0)
    return Scaler(standard.kind, shift, scale)


def _rows(model: BaseModel, dataset: Dataset, sensors: list[list[str]] | None) -> _Rows:
    whole = model.batch(dataset)
    whole = replace(whole, mask=whole.mask & ~_is_action(model, whole))
    seen = [i for i, role in enumerate(model.roles) if role != ACTION]
    names = [model.names[i] for i in seen]
    groups = None
    if sensors is not None:
        groups = [[names.index(one_of("observation", n, names)) for n in s] for s in sensors]
    return _Rows(whole, whole.valid.sum(dim=1).cpu().numpy(), groups, seen)


def _windows(rows: _Rows, drops: Drops, config: CloneConfig, random: np.random.Generator) -> Batch:
    """Windows of all demonstrations, as many as cover them, with what arrives of them."""
    whole = rows.whole
    length = min(config.window or whole.rows, whole.rows)
    each = np.repeat(np.arange(len(whole)), np.ceil(rows.lengths / length).astype(int))
    each = random.permutation(each)
    start = random.integers(0, np.maximum(rows.lengths[each] - length, 0) + 1)
    if config.starts:
        start[random.random(len(start)) < config.starts] = 0
    at = torch.from_numpy(start[:, None] + np.arange(length)).to(whole.times.device)
    index = torch.from_numpy(each).to(at.device)[:, None]
    cut: dict[str, Tensor] = {
        name: getattr(whole, name)[index, at]
        for name in ("times", "values", "mask", "known", "valid")
    }
    cut["times"] = cut["times"] - cut["times"][:, :1]
    if not drops.nothing:
        arrives = drops.draw(
            cut["times"].cpu().numpy(), random, channels=len(rows.seen), sensors=rows.sensors
        )
        cut["mask"][..., rows.seen] &= torch.from_numpy(arrives).to(at.device)
    return replace(whole, **cut)  # type: ignore[arg-type]


def _longest_silence(rows: _Rows, drops: Drops, config: CloneConfig) -> float:
    """s, the longest time since an observation in the windows of an epoch."""
    drawn = _windows(rows, drops, config, np.random.default_rng([config.seed, 1]))
    times, silence = drawn.times.cpu().numpy(), 0.0
    seen = (drawn.mask.any(dim=2) & drawn.valid).cpu().numpy()
    for i in range(len(times)):
        silence = max(silence, float(np.diff(times[i, seen[i]]).max(initial=0.0)))
    return silence


class _Prepared:
    """Windows with their step inputs, which do not depend on trained parameters.

    Args:
        model: that predicts them.
        windows: of an epoch, or of the validation.
    """

    def __init__(self, model: BaseModel, windows: Batch) -> None:
        self.model, self.windows = model, windows
        self.table = model.prepare(windows) if isinstance(model, Model) else None

    def take(self, index: Tensor) -> tuple[Prediction, Batch]:
        """The prediction of some windows, and these windows.

        Args:
            index: (batch,) positions.
        """
        some = self.windows.take(index)
        if self.table is None:
            return self.model(some), some
        assert isinstance(self.model, Model)
        return self.model.run(self.table.take(index)), some


class _Validation:
    """The error of the actions of demonstrations, on windows that are drawn once."""

    def __init__(self, model: BaseModel, rows: _Rows, drops: Drops, config: CloneConfig) -> None:
        windows = _windows(rows, drops, config, np.random.default_rng([config.seed, 2]))
        self.prepared = _Prepared(model, windows)
        self.every = torch.arange(len(windows), device=windows.mask.device)
        self.acts = _is_action(model, windows)

    def error(self) -> float:
        """Mean squared error, scaled units."""
        with torch.inference_mode():
            prediction, windows = self.prepared.take(self.every)
            squared = (prediction.mean - windows.values).square()
            return float(squared[windows.targets & self.acts].mean())


def _fit(
    model: BaseModel,
    rows: _Rows,
    judged: _Validation | None,
    drops: Drops,
    config: CloneConfig,
    progress: bool,
) -> Iterator[CloneRecord]:
    windows = int(np.ceil(rows.lengths / min(config.window or 10**9, rows.whole.rows)).sum())
    steps = math.ceil(windows / config.batch_size)
    total = config.epochs * steps
    best, kept = math.inf, None
    with ExitStack() as stack:
        parameters = stack.enter_context(flat_parameters(model))
        stack.enter_context(model.threads())
        bar = stack.enter_context(
            progress_bar(total=total, desc="cloning", unit="step", show=progress)
        )
        optimizer = torch.optim.Adam([parameters.flat], foreach=True)
        highest, retreat = config.learning_rate, _Retreat(parameters.flat, config.loss)
        for epoch in range(config.epochs):
            random = np.random.default_rng([config.seed, 3, epoch])
            prepared = _Prepared(model, _windows(rows, drops, config, random))
            order = torch.arange(len(prepared.windows), device=rows.whole.mask.device)
            losses = []
            for step, some in enumerate(torch.split(order, config.batch_size), epoch * steps):
                loss = _loss(model, *prepared.take(some), config.observation_weight)
                losses.append(float(loss.detach()))
                if not math.isfinite(losses[-1]):
                    break
                parameters.zero_gradient()
                loss.backward()  # type: ignore[no-untyped-call]
                torch.nn.utils.clip_grad_norm_([parameters.flat], config.clip_norm)
                for group in optimizer.param_groups:
                    rate = 0.5 * (1 + math.cos(math.pi * step / total))
                    group["lr"] = highest * rate
                optimizer.step()
                bar.update()
            if retreat.rose(float(np.mean(losses))):
                highest /= 2
                optimizer = torch.optim.Adam([parameters.flat], foreach=True)
            error = math.nan if judged is None else judged.error()
            bar.set_postfix_str(f"loss {np.mean(losses):.4f}, validation {error:.4f}")
            if error < best:
                best, kept = error, {k: v.detach().clone() for k, v in model.state_dict().items()}
            yield CloneRecord(epoch + 1, float(np.mean(losses)), error)
    if kept is not None:
        model.load_state_dict(kept)


class _Retreat:
    """Goes back to the parameters of the lowest loss where the loss rises, as after a long step.

    Args:
        flat: the parameters.
        kind: of the loss.
    """

    def __init__(self, flat: Tensor, kind: str) -> None:
        self.flat, self.kind, self.epoch = flat, kind, 0
        self.levels: list[float] = []
        self.began = flat.detach().clone()
        self.lowest, self.kept_at = math.inf, 0
        self.kept: Tensor | None = None

    def rose(self, loss: float) -> bool:
        """Whether the loss rose, so that the parameters are those of an earlier epoch again.

        Args:
            loss: mean of an epoch.
        """
        self.epoch += 1
        level = loss
        if self.kind == "nll":  # of a variance: log s
            level = math.exp(min(2 * loss, 700.0))
        self.levels = [*self.levels[1 - RISE_EPOCHS :], level]
        if math.isfinite(loss):
            mean = sum(self.levels) / RISE_EPOCHS if len(self.levels) == RISE_EPOCHS else 0.0
            if 0 < mean < self.lowest:
                # The loss of an epoch shows that it began well, not that it ended well.
                self.lowest, self.kept, self.kept_at = mean, self.began, self.epoch - 1
            if mean <= RISE * self.lowest:
                self.began = self.flat.detach().clone()
                return False
        if self.kept is None:
            raise DivergenceError(
                f"the loss is {loss} in epoch {self.epoch}; lower the learning rate"
            )
        logging.getLogger("offbeat").warning(
            "the loss of the cloning rose to %.3g in epoch %d: going back to epoch %d, with half "
            "the learning rate",
            loss,
            self.epoch,
            self.kept_at,
        )
        with torch.no_grad():
            self.flat.copy_(self.kept)
        self.began, self.levels = self.kept, []
        return True


def _is_action(model: BaseModel, batch: Batch) -> Tensor:
    """(channels,) bool, on the device of a batch."""
    return torch.tensor([role == ACTION for role in model.roles], device=batch.mask.device)


def _loss(model: BaseModel, prediction: Prediction, batch: Batch, weight: float) -> Tensor:
    """Of actions at their rows, and of observations before they arrive."""
    acts = _is_action(model, batch)
    wanted, target = batch.targets, batch.values
    loss = model.loss(prediction, target, (wanted & acts).to(target.dtype))
    if weight:
        states = wanted & ~acts
        states[:, 0] = False  # nothing is known before the first row
        loss = loss + weight * model.loss(prediction, target, states.to(target.dtype))
    return loss
