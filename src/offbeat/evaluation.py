"""Evaluation: scores of models and of the last value, on the same values."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch

from offbeat.answers.scoring import ChannelScores
from offbeat.data.batch import last_index
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


def evaluate(
    models: BaseModel | Mapping[str, BaseModel],
    dataset: Dataset,
    *,
    seed: int = 0,
    device: str | torch.device | None = None,
) -> Evaluation:
    """Scores one-step-ahead predictions of one or more models, and of the last observed value.

    Args:
        models: one model, or several by name; several must have the same scaler and training means.
        dataset: masked values that are known are scored too.
        seed: of self-feeding.
        device: that the models are computed on, as of `fit`, and moved back from; by default their
            own.

    Raises:
        InputError: the data has other channels than a model, or models score in other units.
    """
    dataset = Dataset.of(dataset)
    if isinstance(models, BaseModel):
        models = {models.name: models}
    if not models or LAST_VALUE in models:
        raise InputError(f"give at least one model, none of them named {LAST_VALUE!r}")
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
