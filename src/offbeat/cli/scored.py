"""Scores and figures of fills and forecasts, for the subcommands that show them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from offbeat import baselines
from offbeat.answers.blend import Blend
from offbeat.answers.forecast import forecast
from offbeat.answers.impute import impute
from offbeat.answers.scoring import score_forecast, score_imputation, training_mean
from offbeat.calibration import Calibration
from offbeat.data.masking import masked_values
from offbeat.data.trajectory import Dataset, Trajectory
from offbeat.evaluation import Evaluation, evaluate_blend
from offbeat.models.base import BaseModel
from offbeat.plots.answers import answers
from offbeat.plots.calibration import calibration_figure
from offbeat.plots.figures import save


def scored(
    model: BaseModel | Blend,
    dataset: Dataset,
    evaluation: Evaluation | None,
    *,
    horizons: Sequence[float] | None = None,
    seed: int = 0,
    calibration: Path | None = None,
) -> tuple[dict[str, Any], str]:
    """All scores of a model on a data set, as JSON and as text.

    Args:
        model: a trained model, or a blend.
        dataset: its masked values, if any, are imputed and scored.
        evaluation: the model's one-step-ahead scores.
        horizons: s; None scores no forecasts of a model, and those of a blend up to its horizon.
        seed: seed of models that draw random numbers (those trained with --model.self_feeding).
        calibration: file of a figure of the coverage and the widths of intervals.

    Raises:
        InputError: there are no intervals for the figure.
    """
    if isinstance(model, Blend):
        found = evaluate_blend(model, dataset, horizons=horizons, seed=seed)
        if calibration is not None:
            drawn = {s.task: s.calibration for s in found.tasks if s.calibration is not None}
            save(calibration_figure(drawn, title=dataset[0].origin), calibration)
        one_step = {} if evaluation is None else evaluation.to_dict()
        return {**one_step, **found.to_dict()}, found.text()
    assert evaluation is not None
    own = evaluation.scores[model.name].calibration
    if calibration is not None:
        shown = {} if own is None else {"one step ahead": own}
        save(calibration_figure(shown, title=dataset[0].origin), calibration)
    ahead = evaluation.in_units()
    result: dict[str, Any] = {**evaluation.to_dict(), "verdict": ahead.verdict()}
    text = [
        evaluation.table(),
        *_intervals(model, own),
        "",
        "one step ahead, RMSE in the channels' units:",
        ahead.table(),
    ]
    verdicts = [ahead.verdict()]
    if any(masked_values(t).any() for t in dataset):
        imputed = score_imputation(model, dataset, seed=seed)
        result["imputation"] = imputed.to_dict()
        text += ["", "masked values filled, RMSE in the channels' units:", imputed.table()]
        verdicts.append(imputed.verdict())
    if horizons is not None:
        ahead_of = score_forecast(model, dataset, horizons)
        result["extrapolation"] = [
            {"horizon_s": float(h), **s.to_dict()} for h, s in zip(horizons, ahead_of, strict=True)
        ]
        for scores in ahead_of:
            text += ["", f"{scores.task}, RMSE in the channels' units:", scores.table()]
            verdicts.append(scores.verdict())
    return result, "\n".join([*text, "", *verdicts])


def _intervals(model: BaseModel, found: Calibration | None) -> list[str]:
    """A line on the intervals of a model with a Gaussian head."""
    if found is None:
        return []
    covered = ", ".join(
        f"{100 * share:.0f} % of the values in those of {100 * level:.0f} %"
        for level, share in found.shown(found.coverage).items()
    )
    score = found.shown(found.interval_score)[0.95]
    return [
        f"intervals of {model.name}: {covered}; CRPS {found.crps:.4g}, interval score of 95 % "
        f"{score:.4g} (scaled)"
    ]


def fill_figure(
    model: BaseModel | Blend,
    dataset: Dataset,
    path: Path,
    channels: Sequence[str],
    number: int,
    *,
    mode: str | None = None,
    rate_hz: float | None = None,
    seed: int = 0,
) -> None:
    """Plots one trajectory: its masked values, the model's fill and interpolations.

    Args:
        model: a trained model, or a blend.
        dataset: its masked values are plotted as the truth.
        path: the figure.
        channels: to plot.
        number: of the trajectory.
        mode: as of `impute`.
        rate_hz: as of `impute`.
        seed: seed of models that draw random numbers (those trained with --model.self_feeding).
    """
    truth = dataset.select(model.names)[number]
    one = replace(dataset, trajectories=(dataset[number],))
    filled = impute(model, one, mode=mode, rate_hz=rate_hz, seed=seed)  # type: ignore[arg-type]
    drawn = {"last_value": _filled(truth, "last_value", model)}
    drawn |= {name: _filled(truth, name, model) for name in ("linear", "pchip")}
    drawn[str(filled.meta["filled"])] = filled[0]
    save(answers(truth, drawn, channels, title=truth.origin), path)


def forecast_figure(
    model: BaseModel | Blend,
    dataset: Dataset,
    horizons: NDArray[np.float64],
    path: Path,
    channels: Sequence[str],
    number: int,
) -> None:
    """Plots the end of one trajectory, the forecast, and those of the baselines.

    Args:
        model: trained.
        dataset: as it was read.
        horizons: s.
        path: the figure.
        channels: to plot.
        number: of the trajectory.
    """
    truth = dataset.select(model.names)[number]
    one = replace(dataset, trajectories=(dataset[number],))
    ahead = forecast(model, one, horizons)[0]
    mean = training_mean(model)
    drawn: dict[str, Trajectory] = {
        method: Trajectory(
            ahead.times,
            baselines.forecast(truth, ahead.times, method, mean),
            observed=ahead.observed,
            names=ahead.names,
            units=ahead.units,
        )
        for method in baselines.forecasters()
    }
    drawn[model.name] = ahead
    start = int(np.searchsorted(truth.times, truth.times[-1] - 4 * horizons[-1]))
    end = truth.slice(min(start, truth.rows - 1), truth.rows)
    save(answers(end, drawn, channels, title=truth.origin), path)


def _filled(trajectory: Trajectory, method: str, model: BaseModel | Blend) -> Trajectory:
    values = baselines.fill(trajectory, method, training_mean(model))
    return replace(trajectory, values=np.where(trajectory.observed, trajectory.values, values))
