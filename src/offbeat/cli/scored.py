"""Scores and figures of fills and forecasts, for the subcommands that show them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from offbeat import baselines
from offbeat.answers.forecast import forecast
from offbeat.answers.impute import impute
from offbeat.answers.scoring import score_forecast, score_imputation, training_mean
from offbeat.answers.two_sided import TwoSided
from offbeat.data.masking import masked_values
from offbeat.data.trajectory import Dataset, Trajectory
from offbeat.evaluation import Evaluation
from offbeat.models.base import BaseModel
from offbeat.plots.answers import answers
from offbeat.plots.figures import save


def scored(
    model: BaseModel | TwoSided,
    dataset: Dataset,
    evaluation: Evaluation,
    *,
    horizons: Sequence[float] | None = None,
    seed: int = 0,
) -> tuple[dict[str, Any], str]:
    """All scores of a model on a data set, as JSON and as text.

    Args:
        model: a trained model, or a pair.
        dataset: its masked values, if any, are imputed and scored.
        evaluation: its one-step-ahead scores.
        horizons: s; None scores no forecasts.
        seed: of models with self-feeding.
    """
    ahead = evaluation.in_units()
    result: dict[str, Any] = {**evaluation.to_dict(), "verdict": ahead.verdict()}
    text = [evaluation.table(), "", "one step ahead, RMSE in the channels' units:", ahead.table()]
    verdicts = [ahead.verdict()]
    if any(masked_values(t).any() for t in dataset):
        imputed = score_imputation(model, dataset, seed=seed)
        result["imputation"] = imputed.to_dict()
        text += ["", "masked values filled, RMSE in the channels' units:", imputed.table()]
        verdicts.append(imputed.verdict())
        if isinstance(model, TwoSided):
            fractions = [f"{part:.2f} up to {end:.3g} s" for end, part in model.rule.model_fraction]
            if fractions:
                result["imputation"]["model_fraction"] = model.rule.model_fraction
                text.append(f"weight of the models in the two-sided fill: {', '.join(fractions)}")
    if horizons is not None:
        forward = model.forward if isinstance(model, TwoSided) else model
        ahead_of = score_forecast(forward, dataset, horizons)
        result["extrapolation"] = [
            {"horizon_s": float(h), **s.to_dict()} for h, s in zip(horizons, ahead_of, strict=True)
        ]
        for scores in ahead_of:
            text += ["", f"{scores.task}, RMSE in the channels' units:", scores.table()]
            verdicts.append(scores.verdict())
    return result, "\n".join([*text, "", *verdicts])


def fill_figure(
    model: BaseModel | TwoSided,
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
        model: a trained model, or a pair.
        dataset: its masked values are plotted as the truth.
        path: the figure.
        channels: to plot.
        number: of the trajectory.
        mode: as of `impute`.
        rate_hz: as of `impute`.
        seed: of models with self-feeding.
    """
    forward = model.forward if isinstance(model, TwoSided) else model
    truth = dataset.select(forward.names)[number]
    one = replace(dataset, trajectories=(dataset[number],))
    filled = impute(model, one, mode=mode, rate_hz=rate_hz, seed=seed)  # type: ignore[arg-type]
    drawn = {"last_value": _filled(truth, "last_value", forward)}
    drawn |= {name: _filled(truth, name, forward) for name in ("linear", "pchip")}
    drawn[str(filled.meta["filled"])] = filled[0]
    save(answers(truth, drawn, channels, title=truth.origin), path)


def forecast_figure(
    model: BaseModel,
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
    drawn = {
        method: replace(ahead, values=baselines.forecast(truth, ahead.times, method, mean))
        for method in baselines.forecasters()
    }
    drawn[model.name] = ahead
    start = int(np.searchsorted(truth.times, truth.times[-1] - 4 * horizons[-1]))
    end = truth.slice(min(start, truth.rows - 1), truth.rows)
    save(answers(end, drawn, channels, title=truth.origin), path)


def _filled(trajectory: Trajectory, method: str, model: BaseModel) -> Trajectory:
    values = baselines.fill(trajectory, method, training_mean(model))
    return replace(trajectory, values=np.where(trajectory.observed, trajectory.values, values))
