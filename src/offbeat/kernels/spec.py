"""What a scan consists of: its shape, its weights, and one record of what is known of each row.

A scan carries a state over rows. The facts of a row (`StepInputs`) follow from times, masks and
values alone; no weight has touched them, so they are made once for a data set. Everything that a
weight touches happens inside the scan: what does not depend on the state (input projection, decay
exponents, x-hat), and what does (innovation, self-feeding, vector field, recurrent product).

The state of one trajectory is `[x | h | c]`: `anchored` channels, `hidden_size` hidden units, and
as many memory units when the cell is an LSTM.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

import torch
from torch import Tensor

LARGEST_EXPONENT = 30.0
"""Decay exponents end here: exp(-30) is nothing beside any state, and exp(30) is still finite."""


@dataclass(frozen=True)
class ScanSpec:
    """The shape of a scan.

    Attributes:
        channels: width of the observed values.
        hidden_size: units of h.
        anchored: the channels are held inside the state, and an observation sets them.
        cell: `gru`, `elman`, `lstm`, `set` (h becomes the input's projection, a start value) or
            `none`.
        reset_after: the GRU's reset gate acts after the recurrent product.
        ages: width of what tells the cell how old its knowledge is; 0 for nothing.
        field: units of each layer of the vector field, ends included; empty without one.
        activation: nonlinearity between the layers of the vector field.
        solver: name of a tableau.
        steps_per_gap: least number of equal steps of a fixed-step solver over one gap.
        max_step: longest such step, model time; None for no bound.
        rtol: relative tolerance of an adaptive solver.
        atol: absolute tolerance of an adaptive solver.
        adjoint: gradients of the flow by the adjoint method.
        decay: width of what the decay of h is made from: 0 without one, else the ages of all
            channels (equation 26) or one elapsed time (equation 42).
        decay_rows: meaning of a row in which nothing is observed: `continuous`, the exponent grows
            along time; `every_row`, it acts again at each row; `observed_rows`, only where the
            cell acts.
        input_decay: last values fade to the mean (equation 27).
        decoder: units of each layer of the decoder, ends included, with self-feeding only.
    """

    channels: int
    hidden_size: int
    anchored: bool = False
    cell: Literal["none", "set", "elman", "lstm", "gru"] = "gru"
    reset_after: bool = False
    ages: int = 0
    field: tuple[int, ...] = ()
    activation: Literal["tanh", "silu"] = "tanh"
    solver: str = "euler"
    steps_per_gap: int = 1
    max_step: float | None = None
    rtol: float = 1e-4
    atol: float = 1e-6
    adjoint: bool = False
    decay: int = 0
    decay_rows: Literal["continuous", "every_row", "observed_rows"] = "continuous"
    input_decay: bool = False
    decoder: tuple[int, ...] = ()

    @property
    def gates(self) -> int:
        """Width of the cell's input projection."""
        factor = {"none": 0, "set": 1, "elman": 1, "lstm": 4, "gru": 3}[self.cell]
        return factor * self.hidden_size

    @property
    def anchors(self) -> int:
        """Channels held inside the state."""
        return self.channels if self.anchored else 0

    @property
    def state_size(self) -> int:
        """Units of the whole state."""
        memory = self.hidden_size if self.cell == "lstm" else 0
        return self.anchors + self.hidden_size + memory


Layers = tuple[tuple[Tensor, Tensor], ...]
"""Weight (out, in) and bias (out,) of each layer of a perceptron."""


@dataclass(frozen=True, eq=False)
class ScanWeights:
    """The weights of a scan.

    Gate order: GRU update, reset, candidate; LSTM forget, input, node, output.

    Attributes:
        inputs: (gates, 2 channels + ages) of values, mask and ages; None without a cell.
        bias: (gates,).
        recurrent: (gates, hidden); None without a recurrent cell.
        recurrent_bias: (hidden,) inside the reset product, with `reset_after` only.
        innovation: (gates, channels), with an anchored state only.
        decay: weight (hidden, decay) and bias (hidden,) of the exponents, or None.
        input_decay: weight (channels,) and bias (channels,) of gamma_x, or None.
        field: layers of the vector field; empty without one.
        decoder: layers of the decoder, with self-feeding only.
    """

    inputs: Tensor | None = None
    bias: Tensor | None = None
    recurrent: Tensor | None = None
    recurrent_bias: Tensor | None = None
    innovation: Tensor | None = None
    decay: tuple[Tensor, Tensor] | None = None
    input_decay: tuple[Tensor, Tensor] | None = None
    field: Layers = ()
    decoder: Layers = ()

    def tensors(self) -> Iterator[Tensor]:
        """All weights that there are, in the order of the packed buffer."""
        for tensor in (
            self.inputs,
            self.bias,
            self.recurrent,
            self.recurrent_bias,
            self.innovation,
        ):
            if tensor is not None:
                yield tensor
        for pair in (self.decay, self.input_decay):
            if pair is not None:
                yield from pair
        for layers in (self.field, self.decoder):
            for layer in layers:
                yield from layer

    def packed(self) -> Tensor:
        """All weights in one flat buffer; gradients flow through."""
        return torch.cat([tensor.reshape(-1) for tensor in self.tensors()])


QUANTITIES = (
    "gap",
    "update",
    "updated",
    "values",
    "mask",
    "age",
    "decay_start",
    "decay_end",
    "delta",
    "last",
)
"""What can be known of each row of each trajectory, in the order of the compiled code."""


@dataclass(frozen=True, eq=False)
class StepInputs:
    """What is known of each row; no weight has touched it.

    Attributes:
        gap: (batch, rows) model time since the row before, saturated.
        update: (batch, rows) 1.0 where the cell acts, else 0.0.
        values: (batch, rows, channels) observed values, 0 elsewhere.
        mask: (batch, rows, channels) 1.0 where observed, else 0.0.
        age: (batch, rows, ages) how old the cell's knowledge is, or None.
        updated: (batch, rows) 1.0 where the cell acted at the row before; with a decay only.
        decay_start: (batch, rows, decay) what the decay is made from, at the start of the gap.
        decay_end: (batch, rows, decay) the same at its end.
        delta: (batch, rows, channels) model time since each channel's last observation; with
            `input_decay` only.
        last: (batch, rows, channels) last value of each channel; with `input_decay` only.
        mean: (channels,) what a value fades to; with `input_decay` only.
        length: (batch,) int64, rows of each trajectory; later rows are padding and leave the state
            as it is. None: all rows count.
        fed: one bool per row, True where the decoded state stands for the observed values; with
            self-feeding only.
    """

    gap: Tensor
    update: Tensor
    values: Tensor
    mask: Tensor
    age: Tensor | None = None
    updated: Tensor | None = None
    decay_start: Tensor | None = None
    decay_end: Tensor | None = None
    delta: Tensor | None = None
    last: Tensor | None = None
    mean: Tensor | None = None
    length: Tensor | None = None
    fed: tuple[bool, ...] = ()

    def __len__(self) -> int:
        return self.gap.shape[0]

    @property
    def rows(self) -> int:
        """Rows of the longest trajectory."""
        return self.gap.shape[1]

    def gathered(self) -> StepInputs:
        """These rows; `TableSteps` has them in a table."""
        return self

    def known(self) -> Iterator[Tensor]:
        """All tensors of numbers that there are."""
        for fact in QUANTITIES:
            if (tensor := getattr(self, fact)) is not None:
                yield tensor


@dataclass(frozen=True, eq=False)
class StepTable:
    """The facts of many trajectories side by side in one tensor, so that a batch is one gather.

    Attributes:
        table: (trajectories, rows, columns), the columns in one piece.
        places: of each fact: its name, its columns, and whether it has an axis of units.
        mean: as `StepInputs.mean`.
        length: as `StepInputs.length`.
    """

    table: Tensor
    places: tuple[tuple[str, slice, bool], ...]
    mean: Tensor | None
    length: Tensor | None

    @classmethod
    def of(cls, rows: StepInputs) -> StepTable:
        """Puts facts side by side.

        Args:
            rows: of all trajectories.
        """
        facts = {name: getattr(rows, name) for name in QUANTITIES}
        places, columns, known, width = [], [], {}, 0
        for name, value in facts.items():
            if value is None:
                continue
            if id(value) not in known:  # one tensor may stand for two facts
                column = value if value.ndim == 3 else value[..., None]
                known[id(value)] = slice(width, width + column.shape[2])
                columns.append(column)
                width += column.shape[2]
            places.append((name, known[id(value)], value.ndim == 3))
        return cls(torch.cat(columns, dim=2), tuple(places), rows.mean, rows.length)

    def __len__(self) -> int:
        return len(self.table)

    @cached_property
    def columns(self) -> tuple[tuple[int, int], ...]:
        """First column and number of columns of each of `QUANTITIES`; of what is missing, none."""
        where = {name: (at.start, at.stop - at.start) for name, at, _ in self.places}
        return tuple(where.get(name, (0, 0)) for name in QUANTITIES)

    def take(self, index: Tensor) -> TableSteps:
        """Some trajectories, trimmed to the longest of them.

        Args:
            index: (batch,) positions, int64.
        """
        length = None if self.length is None else self.length.index_select(0, index)
        rows = self.table.shape[1] if length is None else int(length.max())
        return TableSteps(self, index, rows, length)


@dataclass(frozen=True, eq=False)
class TableSteps:
    """Rows that lie in a table: the compiled backend reads them there, others have them gathered.

    Attributes:
        table: has the rows.
        index: (batch,) positions of the trajectories in it, int64.
        rows: of the longest of them.
        length: (batch,) as `StepInputs.length`.
        fed: as `StepInputs.fed`.
    """

    table: StepTable
    index: Tensor
    rows: int
    length: Tensor | None
    fed: tuple[bool, ...] = ()

    def __len__(self) -> int:
        return len(self.index)

    def gathered(self) -> StepInputs:
        """The rows, side by side."""
        table = self.table.table[:, : self.rows].index_select(0, self.index)
        facts: dict[str, Any] = {
            name: table[..., at] if units else table[..., at.start]
            for name, at, units in self.table.places
        }
        return StepInputs(**facts, mean=self.table.mean, length=self.length, fed=self.fed)

    def known(self) -> Iterator[Tensor]:
        """All tensors of numbers that there are."""
        yield self.table.table
