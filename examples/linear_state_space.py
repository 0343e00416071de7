"""A linear state-space network of unevenly spaced rows: the LRU with the times of S5.

The layer is the linear recurrent unit of Orvieto et al. 2023 (arXiv:2303.06349). Over a gap its
eigenvalues are raised to the power of the gap, as S5 has it (Smith et al. 2023, arXiv:2208.04933).
"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn


class LRU(nn.Module):
    """A diagonal complex recurrence: h' = lambda^gap h + gamma B x, read as Re(C h) + D x.

    Args:
        width: of x and of what is read.
        states: number of complex states.
        radius: smallest and largest |lambda| at the start.
        phase: largest angle of lambda at the start, rad.
    """

    def __init__(
        self,
        width: int,
        states: int,
        *,
        radius: tuple[float, float] = (0.4, 0.99),
        phase: float = math.pi / 5,
    ) -> None:
        super().__init__()
        low, high = radius
        squared = low**2 + torch.rand(states) * (high**2 - low**2)
        self.log_decay = nn.Parameter(torch.log(-0.5 * torch.log(squared)))
        self.log_angle = nn.Parameter(torch.log(phase * torch.rand(states).clamp_min(1e-3)))
        self.b = nn.Parameter(torch.randn(width, states, 2) / (2 * width) ** 0.5)
        self.c = nn.Parameter(torch.randn(states, width, 2) / states**0.5)
        self.d = nn.Parameter(torch.randn(width))

    def forward(self, x: Tensor, gaps: Tensor) -> Tensor:
        """(batch, rows, width) of x, and of gaps (batch, rows) before each row."""
        decay, angle = self.log_decay.exp(), self.log_angle.exp()
        kept = torch.exp(gaps[..., None] * torch.complex(-decay, angle))
        gamma = (-torch.expm1(-2 * decay)).sqrt()
        given = gamma * (x.to(kept.dtype) @ torch.view_as_complex(self.b))
        state, states = torch.zeros_like(given[:, 0]), []
        for old, new in zip(kept.unbind(1), given.unbind(1), strict=True):
            state = old * state + new
            states.append(state)
        read = (torch.stack(states, dim=1) @ torch.view_as_complex(self.c)).real
        return read + self.d * x


class LRUNetwork(nn.Module):
    """Layers of LRUs, each with a norm before, a gated unit behind, and what came in added.

    Args:
        inputs: width of the rows.
        width: of the layers.
        layers: number of them.
    """

    def __init__(self, inputs: int, width: int = 64, layers: int = 2) -> None:
        super().__init__()
        self.encode = nn.Linear(inputs, width)
        self.norms = nn.ModuleList(nn.LayerNorm(width) for _ in range(layers))
        self.units = nn.ModuleList(LRU(width, width) for _ in range(layers))
        self.gates = nn.ModuleList(nn.Linear(width, 2 * width) for _ in range(layers))

    def forward(self, rows: Tensor, gaps: Tensor) -> Tensor:
        """(batch, rows, width) from rows (batch, rows, inputs) and gaps (batch, rows)."""
        x = self.encode(rows)
        for norm, unit, gate in zip(self.norms, self.units, self.gates, strict=True):
            value, opened = gate(nn.functional.gelu(unit(norm(x), gaps))).chunk(2, dim=-1)
            x = x + value * torch.sigmoid(opened)
        return x
