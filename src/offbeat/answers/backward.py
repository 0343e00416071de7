"""The backward model of a pair: trained on trajectories reversed in time."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from offbeat.answers.both_sides import reversed_in_time
from offbeat.config import TrainConfig
from offbeat.data.tasks import TWO_SIDED
from offbeat.data.trajectory import Dataset
from offbeat.examples import ordered, reference_tasks
from offbeat.models.base import BaseModel
from offbeat.models.corrected import CorrectedModel, refitted
from offbeat.models.model import Model
from offbeat.models.zoo import make_model, recipe_of
from offbeat.training import FitResult, fit


def fit_backward(
    model: BaseModel,
    train: Dataset,
    validation: Dataset | None = None,
    config: TrainConfig | None = None,
    *,
    out: str | Path | None = None,
    seed: int = 0,
    device: str | None = None,
    progress: bool = True,
) -> tuple[BaseModel, FitResult]:
    """Trains a model like another one, but on reversed trajectories.

    With tasks, those are of the kinds that fills from both sides have (`TWO_SIDED`).

    Args:
        model: whose config, transforms and scaler the backward model has.
        train: the training set, in the order of time.
        validation: as of `fit`.
        config: of the training.
        out: as of `fit`.
        seed: of the initial weights.
        device: as of `fit`.
        progress: show a progress bar.

    Returns:
        The backward model, and the log of its training.

    Raises:
        InputError: as `fit`.
        DivergenceError: as `fit`.
    """

    def reversed_part(part: Dataset) -> Dataset:
        # Angles are unwrapped before the reversal, because wraps are detected from the past.
        return reversed_in_time(ordered(model, Dataset.of(part)))

    if config is not None and config.tasks is not None:
        config = replace(config, tasks=replace(config.tasks, shares=TWO_SIDED))
    turned = reversed_part(train)
    inner = model.inner if isinstance(model, CorrectedModel) else model
    kind, options = (
        (inner.config, {})
        if isinstance(inner, Model)
        else (inner.name, getattr(inner, "options", {}))
    )
    back: BaseModel = make_model(kind, turned, scaler=model.scaler, seed=seed, **options)
    back.to(model.dtype)
    if isinstance(model, CorrectedModel) and isinstance(back, Model):
        tasks, others = reference_tasks(turned, recipe_of(model.name, config, validated=False))
        back = CorrectedModel.of(back, refitted(model.base, tasks), others)
    result = fit(
        back,
        turned,
        None if validation is None else reversed_part(validation),
        config,
        out=out,
        device=device,
        progress=progress,
    )
    return back, result
