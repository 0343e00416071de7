"""`learn`: everything from a log to a blend with intervals, in one call."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from offbeat.answers.backward import fit_backward
from offbeat.answers.blend import Blend, by_direction, fit_blend
from offbeat.answers.saved import BACKWARD, save_blend
from offbeat.baselines.base import BASELINES
from offbeat.baselines.history import typical_gap
from offbeat.config import ModelConfig, SplitConfig, TaskConfig, TrainConfig, check_seed
from offbeat.data.masking import masked_values
from offbeat.data.plan import Plan, plan, prepare
from offbeat.data.scaler import Scaler, ScalerKind
from offbeat.data.shards import ShardedDataset
from offbeat.data.splits import apply_split
from offbeat.data.trajectory import Dataset
from offbeat.ladder import CANDIDATES, LadderResult, fit_ladder
from offbeat.models.base import BaseModel
from offbeat.models.zoo import make_model
from offbeat.progress import Clock, busy
from offbeat.training import FitResult, fit

BUDGET_S = 240.0
"""s, default time for the trainings and the blend of a log, on one thread."""

SIMPLE = ("last_value", "mean", "constant_velocity", "damped_slope", "linear", "pchip")
"""Baselines of the blend of a data set as it is: those that are fitted at once."""

GAUSSIAN = (
    "the head 'gaussian' is trained on the likelihood, and its mean is blended; the intervals of "
    "the blend come from errors on validation data, not from the standard deviation of the head"
)
"""Said where a model has a standard deviation of its own."""

_TRAINING_SHARE = 0.6
"""Part of the budget for the trainings; the rest is for baselines, weights and intervals."""

_FORWARD_SHARE = 0.7
"""Part of that for the ladder and the forward model; the rest is for the backward one."""


@dataclass(frozen=True, eq=False)
class Learned:
    """The result of `learn`.

    Attributes:
        blend: answers predictions, fills and forecasts.
        train: training part, prepared.
        validation: validation part.
        test: test part; nothing was fitted to it.
        split: how the parts were made.
        fit: the training of the forward model.
        chosen: what was chosen for the log; None for a data set that is taken as it is.
        notes: sentences on what was chosen, and on what to beware of.
    """

    blend: Blend
    train: Dataset
    validation: Dataset
    test: Dataset
    split: SplitConfig
    fit: FitResult
    chosen: Plan | None
    notes: tuple[str, ...]

    def __repr__(self) -> str:
        parts = (self.blend, self.train, self.validation, self.test, self.fit)
        names = ("blend", "train", "validation", "test", "fit")
        shown = (f"{name}={part!r}" for name, part in zip(names, parts, strict=True))
        return "\n".join(("Learned(", *(f"    {line}," for line in shown), ")", *self.notes))


def learn(
    dataset: Dataset,
    out: str | Path | None = None,
    *,
    horizon_s: float | None = None,
    model: str | ModelConfig | None = None,
    training: TrainConfig | None = None,
    split: SplitConfig | None = None,
    chosen: Plan | None = None,
    as_it_is: bool = False,
    two_sided: bool = True,
    baselines: Sequence[str] | None = None,
    scaler: ScalerKind | Scaler | None = None,
    budget_s: float = BUDGET_S,
    seed: int = 0,
    device: str | None = None,
    progress: bool = True,
) -> Learned:
    """Cleans and splits a log, trains models for what will be asked, and blends them.

    Without further options, sensors, horizon, windows and split are found in the log (see
    `offbeat.data.plan`), a few models are tried and the best on validation is trained forward and
    backward on tasks, and baselines, models and intervals are blended (see `fit_blend`).

    Args:
        dataset: as read.
        out: folder of the run; one that was stopped is resumed.
        horizon_s: s, the longest forecast that will be asked for; by default found in the log.
        model: to train; by default the best of a few is chosen on validation.
        training: options of the training that differ from the recipe.
        split: to be used as it is; by default found in the log.
        chosen: from `plan`, for a data set that is prepared already.
        as_it_is: train on the windows and masks of `split`, instead of tasks that are drawn anew in
            each epoch: for a data set that has masks of its own.
        two_sided: train a backward model, for fills from both sides.
        baselines: names of those in the blend; by default all that are not slow, and `SIMPLE` ones
            for a data set as it is.
        scaler: of the models; by default robust, and standardise for a data set as it is.
        budget_s: s, time for all of it on one thread of this machine, about. The number of epochs
            follows from six tenths of it and from the time of a step; a model that is given is
            trained by its recipe. Baselines that would take longer than the rest are left out,
            unless they are named, and a note says which.
        seed: of the initial weights, and of tasks.
        device: as of `fit`.
        progress: show progress bars.

    Returns:
        The blend, the parts of the data, and notes.

    Raises:
        InputError: nothing can be learned from the data, or an option is out of range.

    Example:
        >>> learned = learn(offbeat.read("arm.csv"), "runs/arm")  # doctest: +SKIP
        >>> offbeat.forecast(learned, log, 0.5)[0].interval(0.9)  # doctest: +SKIP
    """
    dataset = Dataset.of(dataset)
    check_seed(seed)
    if chosen is None and not as_it_is:
        chosen = plan(dataset, horizon_s=horizon_s, split=split, seed=seed)
        dataset = prepare(dataset, chosen)
    if chosen is None or as_it_is:
        split = split or SplitConfig(seed=seed)
        train, validation, test = apply_split(dataset, split)
    else:
        # Tasks are drawn from whole parts; the test part is in windows, as other commands make it.
        split = replace(
            chosen.split,
            observed_fraction=None,
            mask="rows",
            sensors=None,
            burst_rows=None,
            burst_s=None,
        )
        train, validation, _ = apply_split(dataset, chosen.whole)
        test = apply_split(dataset, split)[2]
    tasks = tasks_of(chosen, train, horizon_s)
    blend, fitted, said = train_blend(
        train,
        validation,
        tasks,
        out=out,
        model=model,
        training=training,
        as_it_is=as_it_is,
        two_sided=two_sided,
        baselines=baselines,
        scaler=scaler,
        budget_s=_TRAINING_SHARE * budget_s,
        limit_s=budget_s,
        seed=seed,
        device=device,
        progress=progress,
    )
    notes = (*(() if chosen is None else chosen.notes), *said)
    return Learned(blend, train, validation, test, split, fitted, chosen, notes)


def train_blend(
    train: Dataset,
    validation: Dataset,
    tasks: TaskConfig,
    *,
    out: str | Path | None = None,
    model: str | ModelConfig | None = None,
    training: TrainConfig | None = None,
    as_it_is: bool = False,
    two_sided: bool = True,
    baselines: Sequence[str] | None = None,
    scaler: ScalerKind | Scaler | None = None,
    budget_s: float = BUDGET_S,
    limit_s: float | None = None,
    seed: int = 0,
    device: str | None = None,
    progress: bool = True,
    shards: ShardedDataset | None = None,
) -> tuple[Blend, FitResult, tuple[str, ...]]:
    """Trains models on parts of a data set, and blends them with baselines.

    Args:
        train: training part.
        validation: validation part.
        tasks: what will be asked.
        out: as of `learn`, as are all others.
        model: to train, or None for the best of a few.
        training: options that differ from the recipe.
        as_it_is: train on the trajectories and masks as they are.
        two_sided: train a backward model.
        baselines: names of those in the blend.
        scaler: of the models.
        budget_s: s, for the trainings.
        limit_s: s, for all of it: baselines are left out that would take longer than what the
            trainings leave, or than the part of the limit that is never theirs. None fits all.
        seed: of weights and tasks.
        device: to train on.
        progress: show progress bars.
        shards: what the model is trained on, where `train` is a sample of it; only as it is.

    Returns:
        The blend, the training of the forward model, and sentences on the choice of the model,
        and those of `Blend.notes`.
    """
    folder, started = Path(out) if out is not None else None, Clock()
    kind: Any = scaler or ("standardise" if as_it_is else "robust")
    common: dict[str, Any] = {"device": device, "progress": progress}
    config = training or TrainConfig(seed=seed)
    if not as_it_is:
        config = replace(config, tasks=tasks)
    said: tuple[str, ...] = ()
    forward: BaseModel
    if model is None and not as_it_is:
        result = fit_ladder(
            train,
            validation,
            config,
            candidates=CANDIDATES,
            budget_s=_FORWARD_SHARE * budget_s if two_sided else budget_s,
            out=folder,
            scaler=kind,
            seed=seed,
            **common,
        )
        forward, fitted = result.model, result.fit
        # The backward model takes the rest of the time.
        rate = result.trials[result.chosen].candidate.learning_rate
        config = replace(config, epochs=max(len(fitted.history) // 2, 4), learning_rate=rate)
        said = (_said(result),)
    else:
        whole: Dataset | ShardedDataset = train if shards is None else shards
        forward = make_model(model or "anchored_ode_gru_d", whole, scaler=kind, seed=seed)
        fitted = fit(forward, whole, validation, config, out=folder, **common)
    if getattr(getattr(forward, "config", None), "head", None) == "gaussian":
        said = (*said, GAUSSIAN)
    if fitted.diverged:
        said = (*said, fitted.diverged)
    backward = None
    if two_sided:
        backward, _ = fit_backward(
            forward,
            train,
            validation,
            config,
            out=None if folder is None else folder / BACKWARD,
            seed=seed,
            **common,
        )
    masked = any(masked_values(t).any() for t in train)
    names = SIMPLE if baselines is None and as_it_is else baselines
    members: dict[str, Any] = {} if names is None else by_direction(names)
    left = None
    if limit_s is not None and names is None:
        left = max(limit_s - (Clock() - started), (1 - _TRAINING_SHARE) * limit_s)
    with busy("fitting baselines, weights and intervals", progress):
        blend = fit_blend(
            train,
            validation,
            forward,
            backward,
            tasks=tasks,
            masks_of_data=as_it_is and masked,
            budget_s=left,
            seed=seed,
            **members,
        )
    if folder is not None:
        save_blend(blend, folder)
    return blend, fitted, (*said, *_left_out(blend, left), *blend.notes())


def _left_out(blend: Blend, budget_s: float | None) -> tuple[str, ...]:
    """A sentence on the baselines for which there was no time."""
    if budget_s is None:
        return ()
    fitted = {*blend.stack.members, *blend.both.members}
    out = [name for name, kind in BASELINES.items() if not kind.slow and name not in fitted]
    if not out:
        return ()
    return (
        f"not fitted in the {budget_s:.2g} s that were left for baselines: {', '.join(out)}; a "
        "larger budget (--budget_minutes) has time for them, and --baselines fits those it names",
    )


def _said(result: LadderResult) -> str:
    trials = ", ".join(f"{t.candidate.label} {t.score:.3g}" for t in result.trials)
    return (
        f"models after {result.trial_epochs} epochs, mean log of their MSE by that of the best "
        f"baseline on validation: {trials}; {result.trials[result.chosen].candidate.label} was "
        f"trained further, to {result.score:.3g}"
    )


def tasks_of(chosen: Plan | None, train: Dataset, horizon_s: float | None) -> TaskConfig:
    """What will be asked.

    Args:
        chosen: for the log, or None for a data set as it is.
        train: training part.
        horizon_s: s, as of `learn`.
    """
    if chosen is not None:
        return chosen.tasks
    gap = typical_gap(train)
    longest = max(float(t.times[-1] - t.times[0]) for t in train)
    return TaskConfig(
        horizon_s=horizon_s or max(min(16 * gap, longest / 4), gap),
        gap_s=gap,
        window_s=max(longest, gap),
    )
