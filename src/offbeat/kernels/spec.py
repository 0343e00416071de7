"""What a scan consists of: its shape, its weights, and one record of row inputs.

A scan carries a state over rows. Whatever does not depend on the state is computed beforehand for
the whole sequence (input projections, decay exponents, gaps) and stands in `ScanRows`; what does
depend on it (innovation, self-feeding, vector field, recurrent product) is named here.

The state of one trajectory is `[x | h | c]`: `anchored` channels, `hidden_size` hidden units, and
as many memory units when the cell is an LSTM.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from torch import Tensor

LARGEST_EXPONENT = 30.0
"""Decay exponents end here: exp(-30) is nothing beside any state, and exp(30) is still finite."""


@dataclass(frozen=True)
class ScanSpec:
    """The shape of a scan.

    Attributes:
        hidden_size: units of h.
        anchored: channels held inside the state; 0 for none.
        cell: `gru`, `elman`, `lstm`, `set` (h becomes the gates, a start value) or `none`.
        reset_after: the GRU's reset gate acts after the recurrent product.
        has_field: a vector field drives (x, h) over each gap.
        activation: nonlinearity between the layers of the vector field.
        solver: name of a tableau.
        steps_per_gap: least number of equal steps of a fixed-step solver over one gap.
        max_step: longest such step, model time; None for no bound.
        rtol: relative tolerance of an adaptive solver.
        atol: absolute tolerance of an adaptive solver.
        adjoint: gradients of the flow by the adjoint method.
    """

    hidden_size: int
    anchored: int = 0
    cell: Literal["none", "set", "elman", "lstm", "gru"] = "gru"
    reset_after: bool = False
    has_field: bool = False
    activation: Literal["tanh", "silu"] = "tanh"
    solver: str = "euler"
    steps_per_gap: int = 1
    max_step: float | None = None
    rtol: float = 1e-4
    atol: float = 1e-6
    adjoint: bool = False

    @property
    def gates(self) -> int:
        """Width of the cell's input projection."""
        factor = {"none": 0, "set": 1, "elman": 1, "lstm": 4, "gru": 3}[self.cell]
        return factor * self.hidden_size

    @property
    def state_size(self) -> int:
        """Units of the whole state."""
        memory = self.hidden_size if self.cell == "lstm" else 0
        return self.anchored + self.hidden_size + memory


Layers = tuple[tuple[Tensor, Tensor], ...]
"""Weight (out, in) and bias (out,) of each layer of a perceptron."""


@dataclass(frozen=True, eq=False)
class ScanWeights:
    """The weights that meet the state inside the scan.

    Gate order: GRU update, reset, candidate; LSTM forget, input, node, output.

    Attributes:
        recurrent: (gates, hidden) or None without a recurrent cell.
        recurrent_bias: (hidden,) bias inside the reset product, with `reset_after` only.
        innovation: (gates, anchored), with an anchored state only.
        field: layers of the vector field; empty without one.
        feed: (gates, channels) projects fed-back predictions, with self-feeding only.
        decoder: layers of the decoder, with self-feeding only.
    """

    recurrent: Tensor | None = None
    recurrent_bias: Tensor | None = None
    innovation: Tensor | None = None
    field: Layers = ()
    feed: Tensor | None = None
    decoder: Layers = ()


@dataclass(frozen=True, eq=False)
class DecayRows:
    """Exponents of the decay of h: over row i's gap, h is multiplied by exp(-(A(1) - applied)).

    A(s) = max(0, (1 - s) start + s end) for s from 0 to 1 over the gap (equation 26 along time).

    Attributes:
        start: (rows, batch, hidden) before the maximum, at the start of the gap.
        end: (rows, batch, hidden) before the maximum, at its end.
        applied: (rows, batch, hidden) what of A the state already carries.
    """

    start: Tensor
    end: Tensor
    applied: Tensor


@dataclass(frozen=True, eq=False)
class ScanRows:
    """What the scan reads at each row; time runs along the first axis.

    Attributes:
        gap: (rows, batch, 1) model time since the row before, saturated.
        update: (rows, batch, 1) 1.0 where the cell acts, else 0.0.
        gates: (rows, batch, gates) input projection, biases included.
        decay: exponents of the decay of h, or None.
        values: (rows, batch, anchored) observed values, 0 elsewhere; anchored only.
        mask: (rows, batch, anchored) 1.0 where observed; anchored only.
        fed_gates: (rows, batch, gates) `gates` without the values' part; self-feeding only.
        fed: one bool per row, True where the cell's input is the decoded state; self-feeding only.
    """

    gap: Tensor
    update: Tensor
    gates: Tensor
    decay: DecayRows | None = None
    values: Tensor | None = None
    mask: Tensor | None = None
    fed_gates: Tensor | None = None
    fed: tuple[bool, ...] = ()
