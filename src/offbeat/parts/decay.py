"""Decays of h over time, and of the last value to the training mean.

The classes contain the weights. The scan computes the exponents from times since observation.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn.functional import softplus


class TrainableDecay(nn.Module):
    """gamma_h = exp(-max(0, W delta + b)) of equation 26, from times since observation.

    Args:
        channels: number of channels.
        hidden_size: units of h.
    """

    def __init__(self, channels: int, hidden_size: int) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.empty(hidden_size, channels))
        self.bias = nn.Parameter(torch.zeros(hidden_size))

    def weights(self) -> tuple[Tensor, Tensor]:
        """Weight (hidden, channels) and bias (hidden,) of the exponent."""
        return self.weight, self.bias


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

    def weights(self) -> tuple[Tensor, Tensor]:
        """Weight (hidden, 1) and bias (hidden,), which is 0, of the exponent."""
        tau = softplus(self.raw_tau).expand(self.hidden_size)
        return tau[:, None], tau.new_zeros(self.hidden_size)


class InputDecay(nn.Module):
    """x-hat of equation 27: the last value decays to the mean with a diagonal gamma_x.

    Args:
        channels: number of channels.
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.empty(channels))
        self.bias = nn.Parameter(torch.zeros(channels))

    def weights(self) -> tuple[Tensor, Tensor]:
        """Weight (channels,) and bias (channels,) of the exponent of gamma_x."""
        return self.weight, self.bias
