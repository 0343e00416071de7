"""Registered modules: any module with `forward(batch) -> Prediction` as a model.

class Window(torch.nn.Module):
    def __init__(self, data, width=32): ...
    def forward(self, batch): return Prediction(mean)

register_model("window", Window)
model = make_model("window", train, width=64)
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn

from offbeat.data.batch import Batch
from offbeat.errors import InputError
from offbeat.models.base import BaseModel, DataInfo
from offbeat.parts.heads import Prediction


class ForeignModel(BaseModel):
    """A registered module, and the data it is made for.

    Args:
        name: of its registry entry.
        module: its `forward` takes a scaled `Batch` and returns a `Prediction` of its rows, each
            from earlier observations. A method `loss(prediction, target, mask)` of the module
            replaces the mean squared error.
        data: properties of the data that it is made for.
        options: JSON-like arguments of its factory, saved with it.
    """

    def __init__(
        self, name: str, module: nn.Module, data: DataInfo, options: dict[str, Any]
    ) -> None:
        super().__init__(name, data)
        if not isinstance(module, nn.Module):
            raise InputError(
                f"the factory of the model {name!r} gave {type(module).__name__}, expected a "
                "torch.nn.Module with forward(batch) -> Prediction"
            )
        self.module, self.options = module, options

    @property
    def dtype(self) -> torch.dtype:
        """Dtype of the module's parameters; float32 if it has none."""
        return next((p.dtype for p in self.module.parameters()), self.mean.dtype)

    def forward(self, batch: Batch) -> Prediction:
        """The module's prediction.

        Raises:
            InputError: it is not a prediction, or its shape differs from the batch.
        """
        found = self.module(batch)
        mean = getattr(found, "mean", None)
        if not isinstance(mean, Tensor) or mean.shape != batch.values.shape:
            shape = tuple(mean.shape) if isinstance(mean, Tensor) else type(found).__name__
            raise InputError(
                f"the model {self.name!r} gave {shape}, expected a Prediction whose mean has the "
                f"shape (batch, rows, channels) = {tuple(batch.values.shape)}"
            )
        prediction: Prediction = found
        return prediction

    def loss(self, prediction: Prediction, target: Tensor, mask: Tensor | None) -> Tensor:
        """The module's own loss, or the mean squared error."""
        own = getattr(self.module, "loss", None)
        if own is None:
            return super().loss(prediction, target, mask)
        found: Tensor = own(prediction, target, mask)
        return found
