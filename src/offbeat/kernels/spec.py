"""The definition of a scan: its shape, its trained parts, and the inputs of each step.

A scan propagates a state over time steps. The inputs of a step (`StepInputs`) depend on times,
masks and values only. They do not depend on trained parameters, so they are computed once per data
set. All computations with parameters are inside the scan: those independent of the state (the
projection of the inputs, decay exponents, x-hat), and the others (innovation, self-feeding, vector
field, recurrent product).

The state of one trajectory is `[x | v | h | c]`: `anchored` channels, with a `trend` their slopes,
`hidden_size` hidden units, and `memory` further units, which an LSTM needs.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal, Protocol

import torch
from torch import Tensor

LARGEST_EXPONENT = 30.0
"""Upper bound of decay exponents: exp(-30) is negligible, and exp(30) is finite."""

MOST_NODES = 2048
"""Number of solver nodes after an observed row; beyond the last one the state stays as it is."""

TRACKED_NODES = 256
"""Number of steps from node to node before a row that have a gradient. It bounds the memory of a
long silence, over which gradients grow or vanish."""

HIDDEN_LIMIT = 10.0
"""Bound of a hidden unit in a bounded scan."""


@dataclass(frozen=True)
class ScanSpec:
    """The shape of a scan.

    Attributes:
        channels: width of the observed values.
        hidden_size: units of h.
        cell: name of the cell in `parts.CELLS`, such as `gru`; `none` without one.
        gates: width of the cell's input projection.
        memory: units of c.
        anchored: the channels are part of the state, and an observation sets them.
        trend: each anchored channel has a slope. Between observations they follow a damped trend,
            to which each step of the solver is added; an observation moves both by gains.
        reset_after: the GRU's reset gate acts after the recurrent product.
        time_inputs: width of the times since observation that the cell is given; 0 for none.
        field: units of each layer of a perceptron vector field, ends included. A field of another
            kind has its name in `field_kind`, and here only its ends. Empty without a field.
        field_kind: name of the vector field in `parts.FIELDS`.
        activation: nonlinearity between the layers of the vector field.
        solver: name of a tableau.
        steps_per_gap: minimum number of equal steps of a fixed-step solver over one gap.
        max_step: longest such step, model time; None for no bound. With `nodes`, the distance of
            the nodes.
        nodes: the state is propagated from node to node, at multiples of `max_step` after the last
            observed row. A row reads it by a further step from the last node before the row, which
            is not kept. So a row in which nothing is observed changes no bit of the others.
        decay_span: model time between `decay_start` and `decay_end`; with `nodes` only.
        bounded: the vector field and the cell are given values within `StepInputs.low` and `high`
            and hidden units within `HIDDEN_LIMIT`, and no solver step leaves these ranges.
        loops: solver steps are a loop whose length is data, for tracing; reference backend only.
        rtol: relative tolerance of an adaptive solver.
        atol: absolute tolerance of an adaptive solver.
        adjoint: gradients of the vector field's solution by the adjoint method.
        decay: width of the inputs of the decay of h: 0 without one, else the times since
            observation of all channels (equation 26) or one elapsed time (equation 42).
        decay_rows: meaning of a step in which nothing is observed: `continuous`, the exponent grows
            with time; `every_row`, it is applied at each step; `observed_rows`, only where the
            cell acts.
        input_decay: last values decay to the mean (equation 27).
        decoder: units of each layer of the decoder, ends included, with self-feeding only.
    """

    channels: int
    hidden_size: int
    cell: str = "gru"
    gates: int = 0
    memory: int = 0
    anchored: bool = False
    trend: bool = False
    reset_after: bool = False
    time_inputs: int = 0
    field: tuple[int, ...] = ()
    field_kind: str = "mlp"
    activation: Literal["tanh", "silu"] = "tanh"
    solver: str = "euler"
    steps_per_gap: int = 1
    max_step: float | None = None
    nodes: bool = False
    decay_span: float = 1.0
    bounded: bool = False
    loops: bool = False
    rtol: float = 1e-4
    atol: float = 1e-6
    adjoint: bool = False
    decay: int = 0
    decay_rows: Literal["continuous", "every_row", "observed_rows"] = "continuous"
    input_decay: bool = False
    decoder: tuple[int, ...] = ()

    @property
    def anchors(self) -> int:
        """Units of x and v: channels that are part of the state, and their slopes."""
        return (2 if self.trend else 1) * self.channels if self.anchored else 0

    @property
    def state_size(self) -> int:
        """Units of the whole state."""
        return self.anchors + self.hidden_size + self.memory


Layers = tuple[tuple[Tensor, Tensor], ...]
"""Weight (out, in) and bias (out,) of each layer of a perceptron."""


class ScanCell(Protocol):
    """Interface of a cell in a scan; `parts.cells.Cell` is the base class."""

    @property
    def innovation(self) -> Tensor | None:
        """(gates, channels) weights of the innovation of an anchored state, or None."""

    def project(self, inputs: Tensor) -> Tensor:
        """(..., inputs) to (..., gates): the part that does not depend on the state."""

    def step(self, gates: Tensor, state: Tensor, update: Tensor) -> Tensor:
        """The new (h, c) of each row where `update` is 1, exactly the old one where it is 0."""

    def tensors(self) -> Iterator[Tensor]:
        """All trained tensors, in the order of the packed buffer."""


class ScanField(Protocol):
    """Interface of a vector field in a scan."""

    def __call__(self, state: Tensor) -> Tensor:
        """(..., state) to its derivative, of the same shape."""

    def parameters(self) -> Iterator[Any]:
        """All trained tensors."""


@dataclass(frozen=True, eq=False)
class ScanParts:
    """The trained parts of a scan.

    Attributes:
        cell: update of h by an observation; None without one.
        decay: weight (hidden, decay) and bias (hidden,) of the exponents, or None.
        input_decay: weight (channels,) and bias (channels,) of gamma_x, or None.
        trend: damping of the slopes, per model time, and the corrections of the gains (see
            `parts.trend`), (channels,) each and positive, or None.
        field: the vector field, or None.
        decoder: layers of the decoder, with self-feeding only.
    """

    cell: ScanCell | None = None
    decay: tuple[Tensor, Tensor] | None = None
    input_decay: tuple[Tensor, Tensor] | None = None
    trend: tuple[Tensor, Tensor, Tensor] | None = None
    field: ScanField | None = None
    decoder: Layers = ()

    def tensors(self) -> Iterator[Tensor]:
        """All trained tensors, in the order of the packed buffer."""
        if self.cell is not None:
            yield from self.cell.tensors()
        for group in (self.decay, self.input_decay, self.trend):
            if group is not None:
                yield from group
        if self.field is not None:
            yield from field_tensors(self.field)
        for layer in self.decoder:
            yield from layer

    def packed(self) -> Tensor:
        """All trained tensors in one flat buffer; gradients flow through."""
        return torch.cat([tensor.reshape(-1) for tensor in self.tensors()])


def field_tensors(field: ScanField) -> Iterator[Tensor]:
    """All trained tensors of a vector field; those of a perceptron layer by layer."""
    layers = getattr(field, "layers", None)
    if layers is None:
        yield from field.parameters()
        return
    for layer in layers:
        yield from layer


QUANTITIES = (
    "gap",
    "update",
    "updated",
    "values",
    "mask",
    "time_input",
    "decay_start",
    "decay_end",
    "delta",
    "last",
    "first_node",
    "node",
    "commit",
    "level_gain",
    "slope_gain",
)
"""Names of the step inputs, in the order of the compiled code."""


@dataclass(frozen=True)
class KnownSteps:
    """What a loop over the rows must know of a batch, so that it asks no other device for it.

    Bounds do, too: a loop that takes more steps than needed gives the same states.

    Attributes:
        shortest: rows of the shortest trajectory, or fewer.
        whole: per row, the largest number of steps from node to node, or more.
        read: per row, False where no trajectory needs a step from the last node to the row.
    """

    shortest: int
    whole: tuple[int, ...]
    read: tuple[bool, ...]


@dataclass(frozen=True, eq=False)
class StepInputs:
    """The inputs of each step, which do not depend on trained parameters.

    Attributes:
        gap: (batch, rows) model time since the step before, saturated; with nodes, since the last
            node before the row.
        update: (batch, rows) 1.0 where the cell acts, else 0.0.
        values: (batch, rows, channels) observed values, 0 elsewhere.
        mask: (batch, rows, channels) 1.0 where observed, else 0.0.
        time_input: (batch, rows, time_inputs) times since observation for the cell, or None.
        updated: (batch, rows) 1.0 where the cell acted at the step before; with a decay only. With
            nodes, at the last step whose state was kept.
        decay_start: (batch, rows, decay) inputs of the decay at the start of the gap; with nodes,
            right after the last observed row.
        decay_end: (batch, rows, decay) the same at its end; with nodes, `decay_span` later.
        delta: (batch, rows, channels) model time since each channel's last observation, with
            `input_decay` only.
        last: (batch, rows, channels) last value of each channel; with `input_decay` only.
        first_node: (batch, rows) number of the node that the state has reached, counted from the
            last observed row; with `nodes` only, as are the next two.
        node: (batch, rows) number of the last node before the row.
        commit: (batch, rows) 1.0 where the state of the row is kept, which is where something is
            observed; elsewhere the state of the node is.
        level_gain: (batch, rows, channels) part of the innovation that x moves by before its
            correction, from 0, where nothing is observed, to 1; with a `trend` only.
        slope_gain: (batch, rows, channels) the same of v, per model time.
        low: (anchors,) lower bounds of x and v; with `bounded` and `anchored` only.
        high: (anchors,) upper bounds of x and v.
        mean: (channels,) value that last values decay to; with `input_decay` only.
        length: (batch,) int64, rows of each trajectory; later rows are padding and do not change
            the state. None: all rows count.
        fed: one bool per row, True where the decoded state replaces the observed values; with
            self-feeding only.
        known_steps: what a loop over the rows must know; None: it is read from the tensors.
    """

    gap: Tensor
    update: Tensor
    values: Tensor
    mask: Tensor
    time_input: Tensor | None = None
    updated: Tensor | None = None
    decay_start: Tensor | None = None
    decay_end: Tensor | None = None
    delta: Tensor | None = None
    last: Tensor | None = None
    first_node: Tensor | None = None
    node: Tensor | None = None
    commit: Tensor | None = None
    level_gain: Tensor | None = None
    slope_gain: Tensor | None = None
    low: Tensor | None = None
    high: Tensor | None = None
    mean: Tensor | None = None
    length: Tensor | None = None
    fed: tuple[bool, ...] = ()
    known_steps: KnownSteps | None = None

    def __len__(self) -> int:
        return self.gap.shape[0]

    @property
    def rows(self) -> int:
        """Rows of the longest trajectory."""
        return self.gap.shape[1]

    def gathered(self) -> StepInputs:
        """Returns these inputs; `TableSteps` gathers them from a table."""
        return self

    def known(self) -> Iterator[Tensor]:
        """All tensors of numbers that are present."""
        for name in QUANTITIES:
            if (tensor := getattr(self, name)) is not None:
                yield tensor


def _host(rows: StepInputs) -> tuple[Tensor, Tensor, Tensor]:
    """`StepTable.host` of step inputs."""
    count, longest = rows.gap.shape
    lengths = torch.full((count,), longest) if rows.length is None else rows.length.cpu()
    whole = torch.zeros((count, longest), dtype=torch.int64)
    read = torch.ones((count, longest), dtype=torch.bool)
    if rows.node is not None and rows.first_node is not None:
        whole = (rows.node - rows.first_node).long().cpu()
        needed = rows.gap > 0
        if rows.updated is not None:  # after an update, the whole exponent is still to be applied
            needed = needed | ((rows.node == 0) & (rows.updated > 0))
        read = needed.cpu()
    return lengths, whole, read


def _steps(lengths: Tensor, whole: Tensor, read: Tensor, rows: int) -> KnownSteps:
    most, needed = whole[:, :rows].amax(dim=0), read[:, :rows].any(dim=0)
    return KnownSteps(int(lengths.min()), tuple(most.tolist()), tuple(needed.tolist()))


def nodes_before(time: Tensor) -> tuple[Tensor, Tensor]:
    """The last solver node at or before each time.

    Args:
        time: float64, in units of `max_step` after an observed row, at least 0.

    Returns:
        The number of the node, which lies at that time, and the time since then; less than a
        millionth of a step counts as 0. Beyond `MOST_NODES` no time passes.
    """
    time = time.clamp_max(MOST_NODES)
    node = torch.floor(time + 1e-6)
    left = time - node
    return node, torch.where(left < 1e-6, torch.zeros_like(left), left)


@dataclass(frozen=True, eq=False)
class StepTable:
    """The step inputs of many trajectories in one tensor, so that a batch is one gather.

    Attributes:
        table: (trajectories, rows, columns), with contiguous columns.
        places: per input, its name, its columns, and whether it has an axis of units.
        low: as `StepInputs.low`.
        high: as `StepInputs.high`.
        mean: as `StepInputs.mean`.
        length: as `StepInputs.length`.
        host: where the table is on another device, what the CPU knows of it: (trajectories,)
            lengths, (trajectories, rows) steps from node to node, and whether a row is read from
            its node by a further step.
    """

    table: Tensor
    places: tuple[tuple[str, slice, bool], ...]
    low: Tensor | None
    high: Tensor | None
    mean: Tensor | None
    length: Tensor | None
    host: tuple[Tensor, Tensor, Tensor] | None = None

    @classmethod
    def of(cls, rows: StepInputs) -> StepTable:
        """Concatenates step inputs.

        Args:
            rows: of all trajectories.
        """
        given = {name: getattr(rows, name) for name in QUANTITIES}
        places, columns, known, width = [], [], {}, 0
        for name, value in given.items():
            if value is None:
                continue
            if id(value) not in known:  # one tensor can be two inputs
                column = value if value.ndim == 3 else value[..., None]
                known[id(value)] = slice(width, width + column.shape[2])
                columns.append(column)
                width += column.shape[2]
            places.append((name, known[id(value)], value.ndim == 3))
        fixed = (rows.low, rows.high, rows.mean, rows.length)
        host = None if rows.gap.device.type == "cpu" else _host(rows)
        return cls(torch.cat(columns, dim=2), tuple(places), *fixed, host)

    def __len__(self) -> int:
        return len(self.table)

    @cached_property
    def columns(self) -> tuple[tuple[int, int], ...]:
        """First column and number of columns of each of `QUANTITIES`; 0 if missing."""
        where = {name: (at.start, at.stop - at.start) for name, at, _ in self.places}
        return tuple(where.get(name, (0, 0)) for name in QUANTITIES)

    def take(self, index: Tensor, *, host: Tensor | None = None) -> TableSteps:
        """Some trajectories, trimmed to the longest of them.

        Args:
            index: (batch,) positions, int64, on any device.
            host: the same on the CPU, where `index` is not; then nothing waits for the device.
        """
        if host is None and index.device.type == "cpu":
            host = index
        index = index.to(self.table.device)
        length = None if self.length is None else self.length.index_select(0, index)
        if self.host is None or host is None:
            rows = self.table.shape[1] if length is None else int(length.max())
            return TableSteps(self, index, rows, length)
        lengths, whole, read = (each.index_select(0, host) for each in self.host)
        rows = int(lengths.max())
        return TableSteps(self, index, rows, length, known_steps=_steps(lengths, whole, read, rows))

    def take_whole(self, index: Tensor) -> TableSteps:
        """Some trajectories, not trimmed, with the steps of the whole table: of a fixed shape.

        Args:
            index: (batch,) positions, int64, on the device of the table.
        """
        length = None if self.length is None else self.length.index_select(0, index)
        return TableSteps(self, index, self.table.shape[1], length, known_steps=self._steps_of_all)

    @cached_property
    def _steps_of_all(self) -> KnownSteps:
        host = self.host or _host(self.take(torch.arange(len(self))).gathered())
        return _steps(*host, self.table.shape[1])


@dataclass(frozen=True, eq=False)
class TableSteps:
    """Step inputs in a table, which a compiled backend reads directly and others gather.

    Attributes:
        table: the table.
        index: (batch,) positions of the trajectories in it, int64.
        rows: of the longest of them.
        length: (batch,) as `StepInputs.length`.
        fed: as `StepInputs.fed`.
        known_steps: as `StepInputs.known_steps`.
    """

    table: StepTable
    index: Tensor
    rows: int
    length: Tensor | None
    fed: tuple[bool, ...] = ()
    known_steps: KnownSteps | None = None

    def __len__(self) -> int:
        return len(self.index)

    def gathered(self) -> StepInputs:
        """Gathers the rows."""
        table = self.table.table[:, : self.rows].index_select(0, self.index)
        given: dict[str, Any] = {
            name: table[..., at] if units else table[..., at.start]
            for name, at, units in self.table.places
        }
        whole = self.table
        given |= {"low": whole.low, "high": whole.high, "mean": whole.mean}
        given |= {"length": self.length, "fed": self.fed, "known_steps": self.known_steps}
        return StepInputs(**given)

    def known(self) -> Iterator[Tensor]:
        """All tensors of numbers that are present."""
        yield self.table.table
