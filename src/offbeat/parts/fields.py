"""Vector fields: the derivative of the state between observations (equation 36)."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import pairwise

import torch
from torch import Tensor, nn

from offbeat.kernels.reference import perceptron
from offbeat.kernels.spec import Layers
from offbeat.registry import Registry


class Perceptron(nn.Module):
    """Linear layers with a nonlinearity between them, none after the last.

    Args:
        sizes: units of input, hidden layers and output.
        activation: `tanh` or `silu`.

    Attributes:
        unit: (outputs,) that the outputs are in units of, or None. It is no weight and not saved.
    """

    unit: Tensor | None

    def __init__(self, sizes: tuple[int, ...], activation: str) -> None:
        super().__init__()
        self.activation = activation
        self.register_buffer("unit", None, persistent=False)
        pairs = list(pairwise(sizes))
        self.weights = nn.ParameterList(torch.empty(out, into) for into, out in pairs)
        self.biases = nn.ParameterList(torch.zeros(out) for _, out in pairs)

    @property
    def layers(self) -> Layers:
        """Weight and bias of each layer, those of the last one times the unit."""
        layers = tuple(zip(self.weights, self.biases, strict=True))
        if self.unit is None:
            return layers
        weight, bias = layers[-1]
        return (*layers[:-1], (weight * self.unit[:, None], bias * self.unit))

    def forward(self, x: Tensor) -> Tensor:
        """(..., inputs) to (..., outputs)."""
        return perceptron(self.layers, x, self.activation)

    def of_scan(self) -> Perceptron | LayeredField:
        """The same for one scan: itself, or, with a unit, layers that are computed once."""
        return self if self.unit is None else LayeredField(self.layers, self.activation)


@dataclass(frozen=True, eq=False)
class LayeredField:
    """A perceptron of given tensors.

    Attributes:
        layers: weight and bias of each.
        activation: as of `Perceptron`.
    """

    layers: Layers
    activation: str

    def __call__(self, x: Tensor) -> Tensor:
        """(..., inputs) to (..., outputs)."""
        return perceptron(self.layers, x, self.activation)

    def parameters(self) -> Iterator[Tensor]:
        """All tensors, layer by layer."""
        for layer in self.layers:
            yield from layer


FIELDS: Registry[Callable[..., nn.Module]] = Registry("vector field", group="offbeat.fields")
"""Vector fields by the name that `ModelConfig.vector_field` takes.

An entry is called with `sizes` (units of each layer, ends included) and `activation`, and gives a
module that maps (batch, sizes[0]) to a derivative of the same shape.
"""

FIELDS.register("mlp", Perceptron)
