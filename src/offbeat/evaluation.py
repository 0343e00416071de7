"""Evaluation: scores of models, blends and simple predictors, on the same values."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, overload

import torch

from offbeat import tables
from offbeat.answers.blend import TASKS, Asked, Blend, number_of_tasks
from offbeat.answers.predict import HasBlend, answering, predicts_any_time
from offbeat.answers.scoring import (
    ChannelScores,
    prepared,
    score_forecast,
    score_imputation,
    score_one_step,
)
from offbeat.data.batch import last_index
from offbeat.data.masking import masked_values
from offbeat.data.tasks import TWO_SIDED, draw_tasks
from offbeat.data.trajectory import Dataset
from offbeat.devices import placed
from offbeat.errors import InputError
from offbeat.metrics import Scores, ScoreSums, last_value_predictions, table
from offbeat.models.base import BaseModel
from offbeat.training import validate

LAST_VALUE = "last_value"
"""Name of the predictor that repeats the last observed value; it is in every table."""


@dataclass(frozen=True)
class Evaluation:
    """Scores by predictor; `last_value` is always among them.

    Attributes:
        scores: by predictor, in scaled units.
        names: channel names.
        units: channel units.
        scaler: kind of the scaled units: `standardise`, `divide_by_max`, ...
        channel_scale: per channel, one scaled unit in the channel's unit.
        trajectories: number of scored trajectories.
        channel_counts: per channel, the number of scored values.
    """

    scores: Mapping[str, Scores]
    names: tuple[str, ...]
    units: tuple[str, ...]
    scaler: str
    channel_scale: tuple[float, ...]
    trajectories: int
    channel_counts: tuple[int, ...]

    def __repr__(self) -> str:
        return self.table()

    def table(self, *, notes: Mapping[str, str] | None = None) -> str:
        """A plain-text table of RMSE in scaled units, best first."""
        return table(self.scores, notes=notes)

    def channel_rmse(self, predictor: str) -> dict[str, float]:
        """RMSE after the first observation of each channel, in the channel's own unit."""
        mse = self.scores[predictor].after_first_observation.per_channel
        scales = zip(self.names, mse, self.channel_scale, strict=True)
        return {name: value**0.5 * abs(scale) for name, value, scale in scales}

    def in_units(self) -> ChannelScores:
        """RMSE after the first observation of every predictor, per channel in its unit."""
        return ChannelScores(
            "one step ahead",
            self.names,
            self.units,
            self.channel_counts,
            {name: tuple(self.channel_rmse(name).values()) for name in self.scores},
            {name: scores.after_first_observation.rmse for name, scores in self.scores.items()},
            (LAST_VALUE,),
        )

    def to_dict(self) -> dict[str, Any]:
        """JSON-like form, with the RMSE of each channel in its own unit."""
        return {
            "scaler": self.scaler,
            "trajectories": self.trajectories,
            "channels": dict(zip(self.names, self.units, strict=True)),
            "predictors": {
                name: {
                    **scores.to_dict(),
                    "rmse_in_units": {
                        k: None if v != v else v for k, v in self.channel_rmse(name).items()
                    },
                }
                for name, scores in self.scores.items()
            },
        }


@dataclass(frozen=True)
class BlendEvaluation:
    """Scores of a blend on every task, beside its model and all its baselines.

    Attributes:
        blend: that was scored.
        tasks: scores of one step ahead, of causal and two-sided fills, and of each horizon; the
            first predictor of each is the blend.
    """

    blend: Blend
    tasks: tuple[ChannelScores, ...]

    def __repr__(self) -> str:
        return "\n".join([self.table(), "", *self.verdicts()])

    def table(self) -> str:
        """A row per task: scaled RMSE of the blend, of its model and of the best baseline.

        The interval score is that of 95 %.
        """
        head = ["task, scaled RMSE", "blend", "model", "best baseline", "", "in 50, 80, 95 %"]
        lines = [[*head, "CRPS", "interval score"]]
        for scores in self.tasks:
            own, *others = scores.rmse
            model = next((name for name in others if name not in scores.trivial), None)
            best, who = min((scores.overall[p], p) for p in scores.trivial)
            covered = scores.coverage or {}
            lines.append(
                [
                    scores.task,
                    f"{scores.overall[own]:.4g}",
                    "-" if model is None else f"{scores.overall[model]:.4g}",
                    f"{best:.4g}",
                    who,
                    " ".join(f"{100 * share:.0f}" for share in covered.values()),
                    "-" if scores.crps is None else f"{scores.crps:.3g}",
                    "-" if scores.interval_score is None else f"{scores.interval_score[0.95]:.3g}",
                ]
            )
        return tables.plain(lines, left=(0, 4))

    def verdicts(self) -> list[str]:
        """A sentence on each task: what wins, and in which channels a baseline does."""
        return [scores.verdict() for scores in self.tasks]

    def text(self) -> str:
        """All tables: the overview, each task per channel, and the weight of the model."""
        lines = [self.table()]
        for scores in self.tasks:
            lines += ["", f"{scores.task}, RMSE in the channels' units:", scores.short()]
        if self.blend.forward is not None:
            lines += ["", "weight of the model in the answer, by time since observation:"]
            lines.append(self.blend.gamma_table())
        return "\n".join([*lines, "", *self.verdicts()])

    def to_dict(self) -> dict[str, Any]:
        """JSON-like form."""
        blend = self.blend
        return {
            "tasks": [scores.to_dict() for scores in self.tasks],
            "gamma": {
                "edges_s": blend.stack.keys.bins.edges.tolist(),
                "channels": dict(zip(blend.names, blend.gamma.T.tolist(), strict=True)),
            },
        }


@overload
def evaluate(
    models: BaseModel | Mapping[str, BaseModel],
    dataset: Dataset,
    *,
    horizons: None = None,
    seed: int = 0,
    device: str | torch.device | None = None,
) -> Evaluation: ...
@overload
def evaluate(
    models: Blend | HasBlend,
    dataset: Dataset,
    *,
    horizons: Sequence[float] | None = None,
    seed: int = 0,
    device: str | torch.device | None = None,
) -> BlendEvaluation: ...
def evaluate(
    models: BaseModel | Mapping[str, BaseModel] | Blend | HasBlend,
    dataset: Dataset,
    *,
    horizons: Sequence[float] | None = None,
    seed: int = 0,
    device: str | torch.device | None = None,
) -> Evaluation | BlendEvaluation:
    """Scores one-step-ahead predictions of models, or every task of a blend.

    Models are compared with the last observed value. A blend is compared with its model and all
    its baselines, one step ahead, in fills of masked values and in forecasts; see `evaluate_blend`.

    Args:
        models: one model, or several by name, which must have the same scaler and training means;
            or a blend, or the result of `learn`.
        dataset: masked values that are known are scored too.
        horizons: s, of the forecasts of a blend.
        seed: of self-feeding, and of what is masked for a blend.
        device: that the models are computed on, as of `fit`, and moved back from; by default their
            own.

    Returns:
        Scores in scaled units and in the units of the channels.

    Raises:
        InputError: the data has other channels than a model, models score in other units, or
            horizons are given for a model; `score_forecast` scores its forecasts.
    """
    dataset = Dataset.of(dataset)
    if not isinstance(models, BaseModel | Mapping):
        blend = answering(models)
        assert isinstance(blend, Blend)
        with placed(blend, device, batch=min(500, len(dataset))):
            return evaluate_blend(blend, dataset, horizons=horizons, seed=seed)
    if horizons is not None:
        raise InputError(
            "horizons are of a blend; score the forecasts of a model with "
            "offbeat.answers.scoring.score_forecast"
        )
    if isinstance(models, BaseModel):
        models = {models.name: models}
    if not models or LAST_VALUE in models:
        raise InputError(f"give at least one model, none of them named {LAST_VALUE!r}")
    for name, model in models.items():
        if not isinstance(model, BaseModel):
            raise InputError(
                f"expected a trained model as {name!r}, got {type(model).__name__}; a blend is "
                "evaluated alone, as evaluate(blend, dataset)"
            )
    first = next(iter(models.values()))
    for name, model in models.items():
        same = (
            model.scaler.to_dict() == first.scaler.to_dict()
            and model.statistics.mean == first.statistics.mean
        )
        if not same:
            raise InputError(
                f"{name!r} scores in other units than {next(iter(models))!r}: their scalers or "
                "training means differ; train both on the same data, or evaluate them separately"
            )
    batch = first.batch(dataset)
    counted = batch.targets & (last_index(batch.mask) >= 0)
    trivial = ScoreSums(batch.channels, gap_unit=first.statistics.median_gap)
    trivial.add(last_value_predictions(batch, first.mean), batch)
    scores = {}
    for name, model in models.items():
        with placed(model, device, batch=min(500, len(batch))):
            scores[name] = validate(model, batch.to(model.device), seed=seed)
    return Evaluation(
        {**scores, LAST_VALUE: trivial.scores()},
        first.names,
        first.units,
        first.scaler.kind,
        tuple(first.scaler.scale.tolist()),
        len(dataset),
        tuple(counted.sum(dim=(0, 1)).tolist()),
    )


def evaluate_blend(
    blend: Blend,
    dataset: Dataset,
    *,
    horizons: Sequence[float] | None = None,
    seed: int = 0,
) -> BlendEvaluation:
    """Scores all tasks of a blend, on the same values as its model and its baselines.

    Args:
        blend: fitted.
        dataset: its masked values are filled and scored; where nothing is masked, silences are
            drawn as in training.
        horizons: s; by default parts of the longest one that the blend was fitted for, as long as
            the data, where it predicts at any time.
        seed: of the tasks, and of self-feeding.

    Returns:
        Scores in scaled units and in the units of the channels.

    Raises:
        InputError: the data has other channels than the blend, or horizons do not fit.
    """
    dataset = Dataset.of(dataset)
    asked = Asked(blend, prepared(blend, dataset), seed)
    tasks = [score_one_step(blend, dataset, seed=seed, asked=asked)]
    masked = dataset
    if not any(masked_values(t).any() for t in dataset):
        count = number_of_tasks(dataset, blend.tasks, TASKS)
        masked = draw_tasks(dataset, blend.tasks, count, shares=TWO_SIDED, seed=[seed, 2])
        asked = Asked(blend, prepared(blend, masked), seed)
    fills = [
        score_imputation(blend, masked, mode=mode, seed=seed, asked=asked)
        for mode in ("causal", "two_sided")
    ]
    tasks += [fill.scores for fill in fills]
    after = horizons
    if after is None:
        longest = max(float(t.times[-1] - t.times[0]) for t in dataset)
        after = [h for h in default_horizons(blend) if h < longest]
    if len(after) and (horizons is not None or predicts_any_time(blend)):
        tasks += score_forecast(blend, dataset, after)
    return BlendEvaluation(blend, tuple(tasks))


def default_horizons(blend: Blend) -> list[float]:
    """s, horizons at which a blend is scored: parts of the longest one that it was made for."""
    return [float(f"{part * blend.tasks.horizon_s:.2g}") for part in (0.1, 0.2, 0.5, 1.0)]
