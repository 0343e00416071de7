"""Models that correct another predictor: prediction = base + scale * output of the model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from offbeat.baselines.errors import ErrorTable, cells
from offbeat.baselines.history import AgeBins
from offbeat.data.batch import Batch
from offbeat.data.trajectory import Dataset
from offbeat.errors import InputError
from offbeat.models.base import BaseModel
from offbeat.models.model import Model
from offbeat.parts.heads import Prediction

Array = NDArray[np.float64]


class Base(Protocol):
    """A predictor that a model corrects, such as a fitted causal baseline."""

    def predict(self, dataset: Dataset) -> list[Array]:
        """(rows, channels) per trajectory, in original units, from what was observed before."""


@dataclass(frozen=True, eq=False)
class Correction:
    """A base, and the scale of its errors, which is the unit of a model's output.

    Attributes:
        base: the predictor that is corrected.
        bins: of times since observation.
        scale: (bins + 1, channels) typical error of the base, in scaled units of the model; its
            last row is for predictions before the first observation of a channel.
    """

    base: Base
    bins: AgeBins
    scale: Tensor

    @classmethod
    def of(cls, base: Base, model: BaseModel, tasks: Dataset, bins: AgeBins) -> Correction:
        """Measures the errors of a base.

        Args:
            base: fitted.
            model: whose channels, transforms and scales are used.
            tasks: of training, with the model's transforms applied.
            bins: of times since observation.
        """
        batch = model.batch(tasks)
        table = ErrorTable.of(scaled(base, model, tasks, batch), batch, bins, clipped=0.995)
        return cls(base, bins, table.typical(model.std.cpu()).to(model.device))

    def terms(self, model: BaseModel, dataset: Dataset, batch: Batch) -> tuple[Tensor, Tensor]:
        """The base and the scale of every row.

        Args:
            model: that corrects.
            dataset: with the model's transforms applied.
            batch: of the same trajectories.

        Returns:
            (batch, rows, channels) each, in scaled units of the model.
        """
        at = cells(batch, self.bins)
        scale = self.scale.to(batch.values)[at, torch.arange(batch.channels, device=at.device)]
        return scaled(self.base, model, dataset, batch), scale

    def predict(self, model: BaseModel, dataset: Dataset) -> list[Array]:
        """Predicts every row from what was observed before it.

        Args:
            model: trained with this correction.
            dataset: with the model's transforms applied; masked values are not used.

        Returns:
            (rows, channels) per trajectory, in original units.
        """
        found: list[Array] = []
        for first in range(0, len(dataset), 256):
            part = dataset[first : first + 256]
            batch = model.batch(part)
            with torch.inference_mode():
                output: Prediction = model(batch)
                mean = corrected(output, *self.terms(model, part, batch)).mean
            values = model.scaler.original(mean.double().cpu().numpy())
            found += [each[: t.rows] for each, t in zip(values, part, strict=True)]
        return found


def corrected(output: Prediction, base: Tensor, scale: Tensor) -> Prediction:
    """The prediction of a model that corrects a base.

    Args:
        output: of the model.
        base: (batch, rows, channels) scaled units.
        scale: (batch, rows, channels) scaled units.
    """
    spread = None if output.scale is None else scale * output.scale
    return Prediction(base + scale * output.mean, spread)


def scaled(base: Base, model: BaseModel, dataset: Dataset, batch: Batch) -> Tensor:
    """The predictions of a predictor in the scaled units of a model.

    Args:
        base: fitted.
        model: whose scaler is used.
        dataset: of the model's channels, with its transforms applied.
        batch: of the same trajectories.

    Returns:
        (batch, rows, channels), 0 in padding.
    """
    values = np.zeros(batch.values.shape)
    for row, predicted in zip(values, base.predict(dataset), strict=True):
        row[: len(predicted)] = model.scaler.scaled(predicted)
    return torch.from_numpy(values).to(batch.values)


def start_at_base(model: BaseModel) -> None:
    """Sets the last layer of a model's decoder to 0, so that it corrects nothing yet.

    Args:
        model: of parts, with the decoder of its own that an anchored one does not have.

    Raises:
        InputError: it is another model.
    """
    layers: Sequence[tuple[Tensor, Tensor]] = ()
    if isinstance(model, Model) and not model.config.anchored:
        layers = model.head.layers or getattr(getattr(model.head, "decoder", None), "layers", ())
    if not layers:
        raise InputError(
            f"the model {model.name!r} cannot correct a base: it needs a decoder whose last layer "
            "can start at 0; take one of parts that is not anchored, such as gru or ode_gru_d"
        )
    with torch.no_grad():
        for tensor in layers[-1]:
            tensor.zero_()
