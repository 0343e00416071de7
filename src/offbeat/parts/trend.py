"""The damped trend of an anchored state, and the corrections of the gains at its observations.

Over a time d, x and v of a channel become x + v (1 - e) / kappa and e v, with e = exp(-kappa d). At
an observation y they become x + K1' (y - x) and v + K2' (y - x), where

    K1' = sigmoid(logit(K1) + a) = K1 / (K1 + (1 - K1) exp(-a)),    K2' = 2 sigmoid(b) K2

and K1, K2 are the gains of a Kalman filter (`models.gains`). The correction of K1 is exact for
gains of 0 and 1, that of K2 is at most 2. At the start of training a = b = 0 and kappa is the
filter's.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

LARGEST_LOGIT = 30.0
"""Bound of a; exp(30) is finite."""


class Trend(nn.Module):
    """Damping and gains of the channels; at the start those of a Kalman filter.

    Args:
        channels: their number.
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.log_damping = nn.Parameter(torch.zeros(channels))
        self.level = nn.Parameter(torch.zeros(channels))
        self.slope = nn.Parameter(torch.zeros(channels))

    def begin(self, damping: Tensor) -> None:
        """Sets the damping of a filter, and no corrections.

        Args:
            damping: (channels,) per model time, positive.
        """
        with torch.no_grad():
            self.log_damping.copy_(torch.log(damping))
            self.level.zero_()
            self.slope.zero_()

    def weights(self) -> tuple[Tensor, Tensor, Tensor]:
        """Damping, exp(-a) and 2 sigmoid(b), (channels,) each."""
        level = torch.exp(-self.level.clamp(-LARGEST_LOGIT, LARGEST_LOGIT))
        return torch.exp(self.log_damping), level, 2 * torch.sigmoid(self.slope)
