"""Cells: the update of the hidden state h by an observation.

A cell is a class with weights and a step. The simplest one overrides `new`:

    class Leaky(Cell):
        def new(self, gates, h):
            return 0.9 * h + 0.1 * torch.tanh(gates)

    register_part("cell", "leaky", Leaky)
    model = make_model("ode_rnn", train, cell="leaky")
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import ClassVar

import torch
from torch import Tensor, nn
from torch.nn.functional import linear

from offbeat.registry import Registry


class Cell(nn.Module):
    """A cell that projects its inputs for all steps at once.

    Args:
        inputs: width of the input: observed values, mask and times since observation.
        hidden_size: units of h.
        innovation: channels of an anchored state, whose innovation (observed value minus
            prediction) is a further input; 0 without one.
        reset_after: a bias inside the reset product, for cells that have it.

    Attributes:
        inputs: (gates, inputs) weights of the input projection.
        bias: (gates,).
        recurrent: (recurrent_gates, hidden) weights of h, or None.
        recurrent_bias: (hidden,) inside the reset product, or None.
        innovation: (gates, channels), or None.
    """

    gates_per_unit: ClassVar[int] = 1
    """Width of the input projection for each unit of h."""
    memory_per_unit: ClassVar[int] = 0
    """Number of memory units for each unit of h."""
    is_recurrent: ClassVar[bool] = True
    """Whether h has recurrent weights; a cell without them overwrites h."""
    takes_reset_after: ClassVar[bool] = False
    """Whether the option `reset_after` applies."""

    def __init__(
        self, inputs: int, hidden_size: int, *, innovation: int = 0, reset_after: bool = False
    ) -> None:
        super().__init__()
        self.hidden_size = hidden_size
        gates = self.gates_per_unit * hidden_size
        self.inputs = nn.Parameter(torch.empty(gates, inputs))
        self.bias = nn.Parameter(torch.zeros(gates))
        self.recurrent = (
            nn.Parameter(torch.empty(gates, hidden_size)) if self.is_recurrent else None
        )
        self.recurrent_bias = nn.Parameter(torch.zeros(hidden_size)) if reset_after else None
        self.innovation = nn.Parameter(torch.empty(gates, innovation)) if innovation else None

    def project(self, inputs: Tensor) -> Tensor:
        """(..., inputs) to (..., gates), for all steps at once."""
        return linear(inputs, self.inputs, self.bias)

    def step(self, gates: Tensor, state: Tensor, update: Tensor) -> Tensor:
        """The state after an observation.

        Args:
            gates: (batch, gates) the projected input.
            state: (batch, hidden + memory) h, and the memory of a cell that has one.
            update: (batch, 1) 1.0 where the cell acts, 0.0 where the state does not change.
        """
        return torch.lerp(state, self.new(gates, state).to(state.dtype), update)

    def new(self, gates: Tensor, state: Tensor) -> Tensor:
        """The state after an observation, where the cell acts; for cells that keep `step`."""
        raise NotImplementedError(f"{type(self).__name__} must define new or step")

    def tensors(self) -> Iterator[Tensor]:
        """All trained tensors: those of the base class in the order of its attributes, then others.

        It is called several times per training step, so it does not walk the module's tree.
        """
        yield from (tensor for tensor in self._parameters.values() if tensor is not None)
        for child in self._modules.values():
            if child is not None:
                yield from child.parameters()

    def _recurrent(self) -> Tensor:
        assert self.recurrent is not None
        return self.recurrent


class Start(Cell):
    """Replaces h by the projection of the input, for models without a recurrent cell."""

    is_recurrent = False

    def new(self, gates: Tensor, state: Tensor) -> Tensor:
        """Returns the projection."""
        return gates


class Elman(Cell):
    """Equation 6: h = tanh(W x + U h)."""

    def new(self, gates: Tensor, state: Tensor) -> Tensor:
        """Equation 6."""
        return torch.tanh(torch.addmm(gates, state, self._recurrent().t()))


class LSTM(Cell):
    """Equations 14-19. Gate order: forget, input, node, output."""

    gates_per_unit = 4
    memory_per_unit = 1

    def new(self, gates: Tensor, state: Tensor) -> Tensor:
        """Equations 14-19."""
        h, c = state[:, : self.hidden_size], state[:, self.hidden_size :]
        forget, insert, node, output = torch.addmm(gates, h, self._recurrent().t()).chunk(4, dim=1)
        c = torch.sigmoid(forget) * c + torch.sigmoid(insert) * torch.tanh(node)
        return torch.cat([torch.sigmoid(output) * torch.tanh(c), c], dim=1)


class GRU(Cell):
    """Equations 20-23, and 29-32 with the inputs of GRU-D. Gate order: update, reset, candidate.

    The reset gate acts before the recurrent product, or with `reset_after` after it, as in
    `torch.nn.GRU`.
    """

    gates_per_unit = 3
    takes_reset_after = True

    def step(self, gates: Tensor, state: Tensor, update: Tensor) -> Tensor:
        """Equations 20-23; the update gate is closed where the cell does not act."""
        n, h, recurrent = self.hidden_size, state, self._recurrent()
        both = torch.sigmoid(torch.addmm(gates[:, : 2 * n], h, recurrent[: 2 * n].t()))
        z, r = both.chunk(2, dim=1)
        if self.recurrent_bias is not None:
            product = torch.addmm(self.recurrent_bias, h, recurrent[2 * n :].t())
            candidate = torch.tanh(gates[:, 2 * n :] + r * product)
        else:
            candidate = torch.tanh(torch.addmm(gates[:, 2 * n :], r * h, recurrent[2 * n :].t()))
        return torch.lerp(h, candidate.to(h.dtype), z * update)  # products may be in bfloat16


CELLS: Registry[type[Cell]] = Registry("cell", group="offbeat.cells")
"""Cells by the name that `ModelConfig.cell` takes; `none` is an alias of `start`."""

for _name, _cell in {"start": Start, "elman": Elman, "lstm": LSTM, "gru": GRU}.items():
    CELLS.register(_name, _cell)
