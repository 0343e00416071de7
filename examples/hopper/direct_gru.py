"""A recurrent network without a vector field, of the size of the large anchored model."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn

import offbeat as ob
from offbeat.data.batch import delta

DIRECT_GRU = "direct_gru"
"""Its name for `make_model`."""


class DirectGru(nn.Module):
    """A gated recurrent unit whose output is added to the last value of each channel.

    It takes a step at every row, masked ones included. Its inputs there are the values, 0 where
    they are masked, their changes since the last ones, and the mask. A perceptron on the state and
    on the time since observation at the next row gives the change until there; it starts at 0.

    Args:
        data: properties of the data.
        units: of the recurrent unit.
        read_units: of the hidden layer of the perceptron.
    """

    mean: Tensor
    std: Tensor

    def __init__(self, data: Any, units: int = 192, read_units: int = 256) -> None:
        super().__init__()
        channels = len(data.statistics.mean)
        self.gap = data.statistics.median_gap
        self.register_buffer("mean", torch.tensor(data.statistics.mean))
        self.register_buffer("std", torch.tensor(data.statistics.std))
        self.cell = nn.GRU(3 * channels, units, batch_first=True)
        self.read = nn.Linear(units + channels, read_units)
        self.out = nn.Linear(read_units, channels)
        nn.init.zeros_(self.out.weight)
        nn.init.zeros_(self.out.bias)

    def forward(self, batch: ob.Batch) -> ob.Prediction:
        """The prediction of each row from the rows before it."""
        values = (batch.values - self.mean) / self.std
        mask = batch.mask.to(values.dtype)
        last = ob.last_values(values, batch.mask, before=torch.zeros_like(self.mean))
        states, _ = self.cell(torch.cat([values * mask, (values - last) * mask, mask], dim=2))
        before = torch.cat([torch.zeros_like(states[:, :1]), states[:, :-1]], dim=1)
        since = torch.log1p(delta(batch.times, batch.mask) / self.gap).to(values.dtype)
        layer = nn.functional.silu(self.read(torch.cat([before, since], dim=2)))
        return ob.Prediction(self.mean + self.std * (last + self.out(layer)))


ob.register_model(DIRECT_GRU, DirectGru, replace=True)
