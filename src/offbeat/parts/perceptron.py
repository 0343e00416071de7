"""The perceptrons of a model (vector field, decoder) and the weights of its cell."""

from __future__ import annotations

from itertools import pairwise

import torch
from torch import Tensor, nn

from offbeat.kernels import Layers, perceptron


class Perceptron(nn.Module):
    """Linear layers with a nonlinearity between them, none after the last.

    Args:
        sizes: units of input, hidden layers and output.
        activation: `tanh` or `silu`.
    """

    def __init__(self, sizes: tuple[int, ...], activation: str) -> None:
        super().__init__()
        self.activation = activation
        pairs = list(pairwise(sizes))
        self.weights = nn.ParameterList(torch.empty(out, into) for into, out in pairs)
        self.biases = nn.ParameterList(torch.zeros(out) for _, out in pairs)

    @property
    def layers(self) -> Layers:
        """Weight and bias of each layer."""
        return tuple(zip(self.weights, self.biases, strict=True))

    def forward(self, x: Tensor) -> Tensor:
        """(..., inputs) to (..., outputs)."""
        return perceptron(self.layers, x, self.activation)


class Cell(nn.Module):
    """The weights of a cell: of its inputs, of the hidden state, of the innovation.

    Args:
        gates: width of the input projection.
        inputs: width of the input.
        hidden_size: units of h; 0 leaves out the recurrent weights (a start value, no cell).
        innovation: channels of the innovation; 0 for none.
        reset_after: a bias inside the reset product, as `torch.nn.GRU` has.
    """

    def __init__(
        self,
        gates: int,
        inputs: int,
        *,
        hidden_size: int,
        innovation: int = 0,
        reset_after: bool = False,
    ) -> None:
        super().__init__()
        self.inputs = nn.Parameter(torch.empty(gates, inputs))
        self.bias = nn.Parameter(torch.zeros(gates))
        self.recurrent = nn.Parameter(torch.empty(gates, hidden_size)) if hidden_size else None
        self.recurrent_bias = nn.Parameter(torch.zeros(hidden_size)) if reset_after else None
        self.innovation = nn.Parameter(torch.empty(gates, innovation)) if innovation else None


def initialise(module: nn.Module, *, init: str, generator: torch.Generator) -> None:
    """Draws all weights; biases stay 0.

    Args:
        module: its two-dimensional parameters are (out, in) weights; one-dimensional ones named
            `bias` or `biases` are left alone.
        init: `normal`, N(0, 0.1^2), or `fan_in`, N(0, 1/fan-in).
        generator: of the draw.
    """
    for name, parameter in module.named_parameters():
        if "bias" in name:
            continue
        std = 0.1 if init == "normal" or parameter.ndim < 2 else parameter.shape[1] ** -0.5
        with torch.no_grad():
            parameter.normal_(0.0, std, generator=generator)
