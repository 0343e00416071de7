"""Decay parts: how h fades with time, and how a last value fades to the mean."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn.functional import linear, softplus

from offbeat.kernels import LARGEST_EXPONENT, DecayRows
from offbeat.models.ages import Ages


class TrainableDecay(nn.Module):
    """gamma_h = exp(-max(0, W delta + b)) of equation 26, from the ages of all channels.

    Args:
        channels: number of channels.
        hidden_size: units of h.
    """

    def __init__(self, channels: int, hidden_size: int) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.empty(hidden_size, channels))
        self.bias = nn.Parameter(torch.zeros(hidden_size))

    def exponents(self, ages: Ages, unit: float) -> tuple[Tensor, Tensor]:
        """(batch, rows, hidden) exponents at the start and the end of each row's gap."""
        dtype = self.weight.dtype
        start, end = ((d / unit).to(dtype) for d in (ages.delta_before, ages.delta))
        return linear(start, self.weight, self.bias), linear(end, self.weight, self.bias)


class ExponentialDecay(nn.Module):
    """exp(-tau elapsed) of equations 42 and 43, tau above 0 through softplus.

    Args:
        hidden_size: units of h.
        scalar: one tau for all units, as in algorithm 3, instead of one each.
    """

    def __init__(self, hidden_size: int, *, scalar: bool = False) -> None:
        super().__init__()
        self.hidden_size = hidden_size
        self.raw_tau = nn.Parameter(torch.empty(1 if scalar else hidden_size))

    def exponents(self, ages: Ages, unit: float) -> tuple[Tensor, Tensor]:
        """(batch, rows, hidden) exponents at the start and the end of each row's gap."""
        tau = softplus(self.raw_tau).expand(self.hidden_size)
        start, end = (
            (e / unit).to(tau.dtype)[..., None] * tau for e in (ages.elapsed_before, ages.elapsed)
        )
        return start, end


class InputDecay(nn.Module):
    """x-hat of equation 27: the last value, fading to the mean with a diagonal gamma_x.

    Args:
        channels: number of channels.
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.empty(channels))
        self.bias = nn.Parameter(torch.zeros(channels))

    def forward(
        self, values: Tensor, mask: Tensor, ages: Ages, mean: Tensor, unit: float
    ) -> Tensor:
        """(batch, rows, channels) the observed value, or what is left of the last one."""
        delta = (ages.delta / unit).to(values.dtype)
        gamma = torch.exp(-(self.weight * delta + self.bias).clamp_min(0))
        return torch.where(mask, values, gamma * ages.last + (1 - gamma) * mean)


Decay = TrainableDecay | ExponentialDecay


def decay_rows(
    decay: Decay, ages: Ages, unit: float, *, rows: str, update: Tensor, updated: Tensor
) -> DecayRows:
    """Exponents as the scan takes them, for one of the three meanings of a hidden row.

    Args:
        decay: the part that knows the exponents.
        ages: at each row.
        unit: s per unit of model time.
        rows: `continuous`, `every_row` or `observed_rows`, as in `ModelConfig.decay_rows`.
        update: (batch, rows) bool, True where the cell acts.
        updated: (batch, rows) bool, True where it acted at the row before.
    """
    start, end = decay.exponents(ages, unit)
    if rows == "every_row" and isinstance(decay, TrainableDecay):
        # The whole exponent of the cumulative age again at each row: it compounds.
        start, applied = end, torch.zeros_like(end)
    elif rows == "observed_rows":
        end = torch.where(update[..., None], end, 0.0)
        start, applied = end, torch.zeros_like(end)
    else:
        applied = torch.where(updated[..., None], 0.0, start.clamp(0, LARGEST_EXPONENT))
    time_first = (t.transpose(0, 1).contiguous() for t in (start, end, applied))
    return DecayRows(*time_first)
