"""Models that correct a baseline, which is a causal predictor in closed form.

A model with a decoder gives the correction: prediction = base + scale * output. The scale is the
typical error of the base for the channel and the time since its last observation. So the output is
a number of about 1 for any channel and any time, and training starts at 0, with the base itself.

An anchored model predicts the channels, and a gate joins both: prediction = base + gate * (output -
base). The gate, from 0 to 1, is learned per channel and time since observation, together with the
model. Where the base is hard to beat, such as one row after an observation, the gate closes, and
the model is not trained on errors that it cannot reduce.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import AbstractContextManager
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from offbeat.baselines.base import BASELINES, CausalBaseline, Rows, stepped
from offbeat.baselines.errors import CLIPPED, ErrorTable, cells
from offbeat.baselines.history import AgeBins
from offbeat.baselines.stack import Stack
from offbeat.config import ModelConfig, from_mapping
from offbeat.data.batch import Batch
from offbeat.data.trajectory import Dataset
from offbeat.errors import InputError
from offbeat.models.base import BaseModel, DataInfo
from offbeat.models.model import Model
from offbeat.parts.heads import Prediction

GATE = 1.0
"""Logit of a gate at the start of training."""

STACK = "stack"
"""Name of a weighted mean of baselines, which is made of registered ones."""

_ARRAYS = "base/"  # prefix of the arrays of a baseline; names of buffers have no dots
_CHUNK = 256


@dataclass(frozen=True, eq=False)
class CorrectedInputs:
    """A data set in the form that `CorrectedModel.run` takes.

    Attributes:
        inner: the same of the inner model.
        base: (batch, rows, channels) predictions of the base, scaled units.
        at: (batch, rows, channels) int64, position in the table of scales or of gates.
    """

    inner: Any
    base: Tensor
    at: Tensor

    def __len__(self) -> int:
        return len(self.base)

    def take(self, index: Tensor, *, host: Tensor | None = None) -> CorrectedInputs:
        """Some trajectories, trimmed to the longest of them.

        Args:
            index: (batch,) positions, int64.
            host: as of `StepTable.take`.
        """
        inner, index = self.inner.take(index, host=host), index.to(self.base.device)
        base, at = (of[:, : inner.rows].index_select(0, index) for of in (self.base, self.at))
        return CorrectedInputs(inner, base, at)


class CorrectedModel(BaseModel):
    """A model of parts that corrects a fitted causal baseline.

    Args:
        inner: its output is the correction, or, where it is anchored, a prediction.
        base: fitted to data of the same channels, with the model's transforms applied.
        bins: of times since observation.
        scale: (bins + 1, channels) typical errors of the base, in scaled units; the last row is for
            predictions before the first observation of a channel.
    """

    scale: Tensor

    def __init__(self, inner: Model, base: CausalBaseline, bins: AgeBins, scale: Tensor) -> None:
        super().__init__(f"{inner.name}_on_{name_of(base)}", inner.data)
        self.inner, self.base, self.bins = inner, base, bins
        self.register_buffer("scale", scale)
        # Logits of the gates.
        self.gate = nn.Parameter(torch.full_like(scale, GATE)) if inner.config.anchored else None
        # Saved with the weights; the base itself works on arrays.
        for name, array in {**base.arrays(), "bins": bins.edges}.items():
            own = torch.from_numpy(np.array(array))
            self.register_buffer(_ARRAYS + name.replace(".", "/"), own)

    @classmethod
    def of(cls, inner: Model, base: CausalBaseline, tasks: Dataset) -> CorrectedModel:
        """Makes an untrained model, which at first predicts what the base does, or close to it.

        Args:
            inner: untrained; the last layer of its decoder is set to 0.
            base: fitted to tasks.
            tasks: that give the scale; of a base that fits its own tasks closely, other ones.

        Raises:
            InputError: the inner model has no decoder whose last layer can be set to 0.
        """
        if not inner.config.anchored:
            _start_at_zero(inner)
        batch, bins = inner.batch(tasks), AgeBins.of(tasks)
        shape = (len(bins) + 1, inner.channels)
        found = cls(inner, base, bins, torch.ones(shape, dtype=inner.dtype, device=inner.device))
        table = ErrorTable.of(found.predicted_by_base(batch), batch, bins, clipped=CLIPPED)
        found.scale.copy_(table.typical(inner.std.cpu()))
        return found

    @classmethod
    def restored(
        cls, inner: Mapping[str, Any], base: str, data: DataInfo, weights: Mapping[str, Tensor]
    ) -> CorrectedModel:
        """Makes a model of the same parts as one that was saved; its weights are to be loaded.

        Args:
            inner: config of the inner model.
            base: name of the baseline.
            data: properties of the data that it is made for.
            weights: saved, among them the arrays of the baseline.

        Raises:
            InputError: there is no such baseline, or it is not causal.
            KeyError: an array is missing.
        """
        arrays = {
            name.removeprefix(_ARRAYS).replace("/", "."): value.numpy().copy()
            for name, value in weights.items()
            if name.startswith(_ARRAYS)
        }
        bins = AgeBins(arrays.pop("bins"))
        made = (Stack if base == STACK else BASELINES[base])().restore(arrays)
        if not isinstance(made, CausalBaseline):
            raise InputError(f"the baseline {base!r} is not causal and cannot be corrected")
        model = Model(from_mapping(ModelConfig, dict(inner)), data)
        return cls(model, made, bins, weights["scale"].to(model.dtype))

    @property
    def options(self) -> dict[str, Any]:
        """JSON-like description of the parts, saved with the model."""
        return {
            "name": self.inner.name,
            "inner": asdict(self.inner.config),
            "base": name_of(self.base),
        }

    @property
    def dtype(self) -> torch.dtype:
        """That of the inner model."""
        return self.inner.dtype

    @property
    def needs_generator(self) -> bool:
        """Whether a prediction of the inner model draws random numbers."""
        return self.inner.needs_generator

    def expect_silences(self, seconds: float) -> None:
        """See `BaseModel`."""
        super().expect_silences(seconds)
        self.inner.expect_silences(seconds)

    def predicted_by_base(self, batch: Batch) -> Tensor:
        """(batch, rows, channels) predictions of the base from earlier rows, in scaled units."""
        parts = []
        mask = batch.mask & batch.valid[..., None]
        values = self.scaler.original(batch.values.double().cpu().numpy())
        for first in range(0, len(batch), _CHUNK):
            part = slice(first, first + _CHUNK)
            rows = Rows(
                batch.times[part].cpu().numpy(),
                values[part],
                mask[part].cpu().numpy(),
                batch.known[part].cpu().numpy(),
                tuple(batch.valid[part].sum(dim=1).tolist()),
            )
            parts.append(self.scaler.scaled(stepped(self.base, rows)))
        return torch.from_numpy(np.concatenate(parts)).to(batch.values)

    def prepare(self, batch: Batch) -> CorrectedInputs:
        """See `BaseModel`."""
        at = cells(batch, self.bins)
        at = at * self.channels + torch.arange(self.channels, device=at.device)
        return CorrectedInputs(self.inner.prepare(batch), self.predicted_by_base(batch), at)

    def run(
        self, prepared: CorrectedInputs, *, generator: torch.Generator | None = None
    ) -> Prediction:
        """See `BaseModel`."""
        output = self.inner.run(prepared.inner, generator=generator)
        mean = self._joined(prepared.base, output.mean, prepared.at)
        spread = output.scale
        if spread is not None and self.gate is None:
            spread = self.scale.flatten()[prepared.at] * spread
        return Prediction(mean, spread)

    def _joined(self, base: Tensor, output: Tensor, at: Tensor) -> Tensor:
        if self.gate is not None:
            return base + torch.sigmoid(self.gate).flatten()[at] * (output - base)
        return base + self.scale.flatten()[at] * output

    def joined(self, base: Tensor, output: Tensor, age: Tensor) -> Tensor:
        """The prediction from those of the base and the output of the inner model.

        Args:
            base: (..., channels) scaled units.
            output: (..., channels) of the inner model.
            age: (..., channels) s since the last observation of each channel; infinite before it.
        """
        at = torch.where(age.isinf(), len(self.bins), self.bins.of_age(age))
        at = at * self.channels + torch.arange(self.channels, device=at.device)
        return self._joined(base, output, at)

    def forward(self, batch: Batch, *, generator: torch.Generator | None = None) -> Prediction:
        """Predicts every row of a batch from earlier observations.

        Args:
            batch: scaled.
            generator: of random numbers, where the inner model draws any.
        """
        index = torch.arange(len(batch))
        return self.run(self.prepare(batch).take(index), generator=generator)

    def loss(self, prediction: Prediction, target: Tensor, mask: Tensor | None) -> Tensor:
        """The loss of the inner model's head."""
        return self.inner.loss(prediction, target, mask)

    def backend(self) -> tuple[str, str]:
        """That of the inner model."""
        return self.inner.backend()

    def threads(self) -> AbstractContextManager[None]:
        """As of the inner model."""
        return self.inner.threads()


def name_of(base: CausalBaseline) -> str:
    """The name of a baseline in the registry.

    Raises:
        InputError: it is not registered, so that a model with it could not be loaded.
    """
    if isinstance(base, Stack):
        return STACK
    for name, kind in BASELINES.items():
        if type(base) is kind:
            return name
    raise InputError(
        f"the baseline {type(base).__name__} is not registered; call "
        "offbeat.baselines.BASELINES.register(name, kind) before a model corrects it"
    )


def refitted(base: CausalBaseline, tasks: Dataset) -> CausalBaseline:
    """A baseline of the same kind, fitted to other data.

    Args:
        base: fitted.
        tasks: of other data.

    Raises:
        InputError: it is a stack, which is fitted to training and validation data together.
    """
    if isinstance(base, Stack):
        raise InputError("a stack of baselines is fitted by fit_stack; give another base")
    other = type(base)().fit(tasks)
    assert isinstance(other, CausalBaseline)
    return other


def _start_at_zero(inner: Model) -> None:
    """Sets the last layer of the decoder to 0."""
    decoder = getattr(inner.head, "decoder", None)
    if decoder is None:
        raise InputError(
            f"the model {inner.name!r} with the head {inner.config.head!r} cannot correct a "
            "baseline: that takes a decoder whose last layer starts at 0, such as that of the head "
            "'point'"
        )
    with torch.no_grad():
        for tensor in decoder.layers[-1]:
            tensor.zero_()
