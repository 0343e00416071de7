"""Calls of compiled code without autograd, in buffers that stay from step to step."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import accumulate
from typing import Any

import numpy as np
import torch
from torch import Tensor

from offbeat.kernels import cpu
from offbeat.kernels.spec import ScanSpec, TableSteps


class PackedWeights:
    """Parameters in one buffer, in the order of the compiled code.

    Args:
        parameters: that are views of `flat`.
        flat: all parameters of a model.
        gradient: of the same length.
    """

    def __init__(self, parameters: Sequence[Tensor], flat: Tensor, gradient: Tensor) -> None:
        # (parameters, 3): where each lies in `flat`, where in the buffer, and its length.
        sizes = [p.numel() for p in parameters]
        start, width = flat.data_ptr(), flat.element_size()
        there = [(p.data_ptr() - start) // width for p in parameters]
        here = [0, *accumulate(sizes)]
        self._from = np.array([there, here[:-1], sizes], dtype=np.int64).T.copy()
        self._to = self._from[:, [1, 0, 2]].copy()
        self._flat = flat.detach().numpy()
        self._gradient = gradient.numpy()
        self._buffer = torch.empty(here[-1], dtype=flat.dtype)

    def gather(self) -> Tensor:
        """The buffer, filled with the parameters as they are."""
        cpu.compiled.move_weights(self._buffer.numpy(), self._flat, self._to, False)
        return self._buffer

    def add(self, gradient: Tensor) -> None:
        """Adds a gradient in the order of the buffer to that of the parameters."""
        cpu.compiled.move_weights(self._gradient, gradient.numpy(), self._from, True)


class BufferedScan:
    """The two calls of a scan.

    Args:
        spec: of the scan.
        variant: name of an instruction set.
    """

    def __init__(self, spec: ScanSpec, variant: str) -> None:
        self._spec, self._own, self._variant = spec, cpu.compiled_spec(spec), variant
        self._tape = torch.empty(0)
        self._states = (torch.empty(0), torch.empty(0))

    def forward(self, packed: Tensor, rows: TableSteps, state: Tensor) -> tuple[Tensor, Tensor]:
        """(batch, rows, state_size) states before and after each row, in buffers that stay.

        Args:
            packed: weights.
            rows: step inputs.
            state: (batch, state_size) before the first row.
        """
        shape = (len(rows), rows.rows, self._spec.state_size)
        self._states = before, after = tuple(  # type: ignore[assignment]
            each if each.shape == shape else state.new_empty(shape) for each in self._states
        )
        self._inputs = cpu.compiled_inputs(rows, state.dtype)
        self._packed, self._state, self._rows = packed, state, rows
        size = cpu.tape_size(self._spec, self._variant, self._inputs, state, stays=True)
        if size is not None and self._tape.numel() < size:  # of the longest batch so far
            self._tape = state.new_empty(size)
        self._kept = None if size is None else self._tape[:size].numpy()
        cpu.compiled.scan_forward(
            self._own,
            self._variant,
            packed.numpy(),
            self._inputs,
            state.numpy(),
            before.numpy(),
            after.numpy(),
            self._kept,
            cpu.threads(),
        )
        return before, after

    def backward(self, to_before: Tensor | None, to_after: Tensor | None) -> tuple[Tensor, Tensor]:
        """Gradients of the weights and of the first state, from those of the states."""
        to_packed, to_first = torch.empty_like(self._packed), torch.empty_like(self._state)
        cpu.compiled.scan_backward(
            self._own,
            self._variant,
            self._packed.numpy(),
            self._inputs,
            self._state.numpy(),
            self._states[1].numpy(),
            self._kept,
            None if to_before is None else to_before.numpy(),
            None if to_after is None else to_after.numpy(),
            to_packed.numpy(),
            to_first.numpy(),
            cpu.threads(),
            cpu.ROWS_AT_ONCE,
        )
        return to_packed, to_first


class BufferedPerceptron:
    """The calls of a perceptron with tanh.

    Args:
        sizes: of its layers, inputs first.
        variant: name of an instruction set.
    """

    def __init__(self, sizes: tuple[int, ...], variant: str) -> None:
        self._own, self._variant = cpu.compiled_perceptron(sizes, "tanh"), variant
        self._outputs = sizes[-1]
        self._tape = torch.empty(0)

    def forward(self, packed: Tensor, x: Tensor) -> Tensor:
        """(rows, outputs) of (rows, inputs)."""
        size = cpu.perceptron_tape_size(self._own, self._variant, x)
        if self._tape.numel() != size:
            self._tape = x.new_empty(size)
        y = x.new_empty((len(x), self._outputs))
        self._packed, self._x = packed, x
        cpu.compiled.perceptron_forward(
            self._own,
            self._variant,
            packed.numpy(),
            x.numpy(),
            y.numpy(),
            self._tape.numpy(),
            cpu.threads(),
        )
        return y

    def squares(
        self,
        packed: Tensor,
        states: Tensor,
        first: Tensor | None,
        column: int,
        wanted: tuple[Any, ...],
        squares: Tensor,
        to_states: Any,
    ) -> Tensor:
        """Squared errors of predictions, and gradients of their mean.

        Args:
            packed: weights.
            states: (batch, rows, state_size).
            first: (batch, state_size) the state that row 0 is read from, and row i from that of
                row i - 1; None: each row is read from its own.
            column: of the first input in a state.
            wanted: (trajectories, rows - 1 or more, outputs) targets of the rows after the first;
                (batch,) which trajectories; two factors of the gradients.
            squares: (batch, rows - 1, outputs) set to the squared errors.
            to_states: (batch, rows, state_size) set where the inputs are.

        Returns:
            The gradient of the weights.
        """
        to_packed = torch.empty_like(packed)
        cpu.compiled.perceptron_squares(
            self._own,
            self._variant,
            packed.numpy(),
            states.numpy(),
            None if first is None else first.numpy(),
            column,
            *wanted,
            squares.numpy(),
            to_packed.numpy(),
            to_states,
            cpu.threads(),
        )
        return to_packed

    def backward(self, to_y: Tensor) -> tuple[Tensor, Tensor]:
        """Gradients of the weights and inputs of the newest `forward`."""
        to_packed, to_x = torch.empty_like(self._packed), torch.empty_like(self._x)
        cpu.compiled.perceptron_backward(
            self._own,
            self._variant,
            self._packed.numpy(),
            self._x.numpy(),
            self._tape.numpy(),
            to_y.numpy(),
            to_packed.numpy(),
            to_x.numpy(),
            cpu.threads(),
        )
        return to_packed, to_x
