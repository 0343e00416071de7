"""Imputation of values that were not observed, causal or two-sided."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np

from offbeat.answers.answer import Answer
from offbeat.answers.blend import Blend
from offbeat.answers.fill_rule import FillRule
from offbeat.answers.predict import (
    Times,
    check_any_time,
    predict,
    times_of_each,
    without_exogenous,
)
from offbeat.answers.two_sided import (
    TwoSided,
    fill_two_sided,
    fit_rule,
    reversed_in_time,
)
from offbeat.config import TrainConfig
from offbeat.data.rows import add_rows, times_at_rate
from offbeat.data.source import read_json
from offbeat.data.tasks import TWO_SIDED, draw_tasks
from offbeat.data.trajectory import Dataset
from offbeat.errors import FileFormatError, InputError, one_of
from offbeat.examples import VALIDATION_TASKS, ordered, reference_tasks
from offbeat.files import write_json
from offbeat.models.base import BaseModel, of_channels
from offbeat.models.checkpoint import load_model, save_model
from offbeat.models.corrected import CorrectedModel, refitted
from offbeat.models.model import Model
from offbeat.models.zoo import make_model, recipe_of
from offbeat.training import FitResult, fit

MODES = ("causal", "two_sided")
"""Modes of imputation: from the past alone, or from both sides."""

RULE_FILE = "two_sided.json"
"""File of the rule in a run's folder; the subfolder `backward` is the run of the backward model."""


def impute(
    model: BaseModel | Blend | TwoSided,
    dataset: Dataset,
    *,
    mode: Literal["causal", "two_sided"] | None = None,
    times: Times | None = None,
    rate_hz: float | None = None,
    seed: int = 0,
) -> Dataset:
    """Fills every value that is not observed: masked ones, and those that were never measured.

    A log has no rows where all of its sensors were out. `rate_hz`, or `times`, adds rows there.

    `causal` fills with the model's prediction from what was observed strictly before the row.
    `two_sided` combines it with the prediction of a backward model from the other side, by the rule
    in `offbeat.answers.two_sided`. Neither uses masked values.

    Args:
        model: a trained model, or a pair from `fit_two_sided`.
        dataset: the observed data.
        mode: `causal` or `two_sided`; by default two-sided where the model is a pair.
        times: s, at which a row is added where there is none: one array for all trajectories, or
            one per trajectory, as of `predict`.
        rate_hz: adds rows at this rate, from the first to the last row of each trajectory, where
            no row is within half a period.
        seed: of the generator of self-feeding.

    Returns:
        The trajectories in original units, channels in the order of the model. No value is
        NaN; `observed` is True where it was measured, and False where it was filled.

    Raises:
        InputError: other channels than the model's, two-sided filling with a single model, `times`
            and `rate_hz` together or invalid, or rows to add for a model that cannot predict at
            any time.
    """
    dataset = Dataset.of(dataset)
    forward = model.forward if isinstance(model, TwoSided) else model
    mode = mode or ("causal" if isinstance(model, BaseModel) else "two_sided")
    one_of("mode", mode, MODES)
    if times is not None and rate_hz is not None:
        raise InputError("give times or rate_hz, not both")
    if times is not None or rate_hz is not None:
        check_any_time(forward)
        added = (
            times_of_each(times, len(dataset))
            if times is not None
            else [times_at_rate(t, rate_hz) for t in dataset]  # type: ignore[arg-type]
        )
        rows = (add_rows(t, at) for t, at in zip(dataset, added, strict=True))
        dataset = replace(dataset, trajectories=tuple(rows))
    transforms = forward.transforms
    dataset = of_channels(dataset, forward.names, forward.units)
    applied = transforms.apply(dataset)
    if mode == "causal":
        answers = [t for t in predict(forward, applied, seed=seed) if isinstance(t, Answer)]
    elif isinstance(model, Blend):
        answers = [without_exogenous(a, model.predicted) for a in model.fill(applied, seed=seed)]
    elif isinstance(model, TwoSided):
        answers = [
            Answer(
                t.times,
                np.where(forward.predicted, values, np.nan),  # exogenous channels are not filled
                names=forward.names,
                units=forward.units,
            )
            for t, values in zip(applied, fill_two_sided(model, applied, seed=seed), strict=True)
        ]
    else:
        raise InputError(
            "mode 'two_sided' needs a blend, got a single model; train one with offbeat train, or "
            "fit_blend, or fill with mode 'causal'"
        )
    notes = {**dataset.meta, "filled_by": model_name(model), "filled": mode}
    undone = transforms.undo(Dataset(tuple(answers), notes), dataset)
    filled = []
    for t, given in zip(undone, dataset, strict=True):
        assert isinstance(t, Answer)
        seen = given.observed
        filled.append(
            replace(
                t,
                values=np.where(seen, given.values, t.values),
                observed=seen,
                roles=given.roles,
                origin=given.origin,
                unit=None if t.unit is None else np.where(seen, 0.0, t.unit),
                beyond=None if t.beyond is None else t.beyond & ~seen,
            )
        )
    return Dataset(tuple(filled), notes)


def model_name(model: BaseModel | Blend | TwoSided) -> str:
    """Name in tables and files."""
    return model.forward.name if isinstance(model, TwoSided) else model.name


def fit_two_sided(
    model: BaseModel,
    train: Dataset,
    validation: Dataset,
    config: TrainConfig | None = None,
    *,
    out: str | Path | None = None,
    seed: int = 0,
    device: str | None = None,
    progress: bool = True,
) -> tuple[TwoSided, FitResult, FitResult]:
    """Trains a model, a second one on reversed trajectories, and the rule that combines them.

    Args:
        model: trained in place, as by `fit`; the backward model has its config and scaler.
        train: the training set.
        validation: scored after each epoch; the rule is fitted to its masked values.
        config: of both trainings; by default `TrainConfig()`.
        out: folder of the run; the backward model's is `backward` inside it. A run that was stopped
            is resumed.
        seed: of the initial weights of the backward model.
        device: as of `fit`, for both models.
        progress: show progress bars.

    Returns:
        The pair, and the logs of the forward and the backward training.

    Raises:
        InputError: as `fit`.
        DivergenceError: as `fit`.
    """
    folder = Path(out) if out is not None else None
    shown = {"device": device, "progress": progress}
    ahead = fit(model, train, validation, config, out=folder, **shown)  # type: ignore[arg-type]
    back, backwards = fit_backward(
        model,
        train,
        validation,
        config,
        out=folder / "backward" if folder is not None else None,
        seed=seed,
        **shown,  # type: ignore[arg-type]
    )
    masked = ordered(model, Dataset.of(validation))
    if config is not None and config.tasks is not None:
        masked = draw_tasks(masked, config.tasks, VALIDATION_TASKS, shares=TWO_SIDED, seed=seed)
    pair = TwoSided(model, back, fit_rule(model, back, masked, seed=seed))
    if folder is not None:
        write_json(folder / RULE_FILE, pair.rule.to_dict())
    return pair, ahead, backwards


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


def save_two_sided(pair: TwoSided, path: str | Path) -> None:
    """Writes a pair to a folder: `model`, `backward/model` and the rule.

    Args:
        pair: to write.
        path: the folder; `load_two_sided` and, for the forward model, `load_model` read it.
    """
    path = Path(path)
    save_model(pair.forward, path / "model")
    save_model(pair.backward, path / "backward" / "model")
    write_json(path / RULE_FILE, pair.rule.to_dict())


def load_two_sided(path: str | Path) -> TwoSided:
    """Reads a pair that `save_two_sided` or a two-sided training wrote.

    Args:
        path: the folder.

    Raises:
        FileFormatError: a model or the rule is missing or damaged.
    """
    path = Path(path)
    if not (path / RULE_FILE).is_file():
        raise FileFormatError(
            f"{path} has no {RULE_FILE}: it is not a two-sided run; train with --two_sided true"
        )
    try:
        rule = FillRule.from_dict(read_json(path / RULE_FILE))
        return TwoSided(load_model(path), load_model(path / "backward"), rule)
    except FileFormatError:
        raise
    except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError) as error:
        raise FileFormatError(
            f"{path / RULE_FILE} is damaged ({error}); the same training writes it again"
        ) from None


def load_run(path: str | Path) -> BaseModel | Blend | TwoSided:
    """Reads the model of a folder, or the pair where the run is two-sided.

    Args:
        path: folder of a run or of a checkpoint.

    Raises:
        FileFormatError: as `load_model` and `load_two_sided`.
    """
    from offbeat.answers.saved import load_predictor

    two_sided = (Path(path) / RULE_FILE).is_file()
    return load_two_sided(path) if two_sided else load_predictor(path)
