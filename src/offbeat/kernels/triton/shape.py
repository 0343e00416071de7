"""The shape of a scan as the kernels see it: sizes, offsets and choices; fixed at compilation."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

from offbeat.kernels.spec import TRACKED_NODES, ScanSpec
from offbeat.ode import tableau

MOST_STAGES = 4
"""Stages of a tableau that the kernels support."""

GATES = {"none": 0, "start": 1, "elman": 1, "lstm": 4, "gru": 3}
"""Width of the input projection of each cell that the kernels support, per hidden unit."""


@dataclass(frozen=True)
class Shape:
    """Sizes and choices of a scan, a constant of the kernels.

    A state is `[x | v | h | c]`. Its first `D` units are moved by the vector field. A row of
    activations has the input of the vector field, then the output of each layer, `E` units.

    Attributes:
        A: anchored channels.
        X: units of x and v.
        H: hidden units.
        M: memory units.
        CELL: name of the cell.
        RESET_AFTER: as `ScanSpec.reset_after`.
        TREND: as `ScanSpec.trend`.
        FIELD: units of each layer of the vector field, ends included, or empty.
        STAGES: of the tableau.
        SILU: the activation is `silu`, else `tanh`.
        NODES: as `ScanSpec.nodes`.
        MAX_STEP: as `ScanSpec.max_step`, 0 without one.
        SPAN: as `ScanSpec.decay_span`.
        BOUNDED: as `ScanSpec.bounded`.
        DECAY: whether h decays.
        CONTINUOUS: the exponent of a decay grows with time.
        SEVERAL: a row can take several steps, each after its part of the decay.
        BM: trajectories of a program.
        BN: units of a tile of products.
        BK: units that a product sums at once.
        BE: units of a tile of all else.
        PRECISION: of products, `ieee`, `tf32` or `tf32x3`.
        TRACKED: steps from node to node before a row that have a gradient.
    """

    A: int
    X: int
    H: int
    M: int
    CELL: str
    RESET_AFTER: bool
    TREND: bool
    FIELD: tuple[int, ...]
    STAGES: int
    SILU: bool
    NODES: bool
    MAX_STEP: float
    SPAN: float
    BOUNDED: bool
    DECAY: bool
    CONTINUOUS: bool
    SEVERAL: bool
    BM: int
    BN: int
    BK: int
    BE: int
    PRECISION: str
    TRACKED: int

    @classmethod
    def of(
        cls, spec: ScanSpec, tiles: tuple[int, int, int] = (16, 32, 32), precision: str = "ieee"
    ) -> Shape:
        """The shape of a spec.

        Args:
            spec: of the scan.
            tiles: trajectories of a program, units of a tile, and units summed at once.
            precision: of products.
        """
        several = spec.steps_per_gap > 1 or spec.max_step is not None
        return cls(
            A=spec.channels if spec.anchored else 0,
            X=spec.anchors,
            H=spec.hidden_size,
            M=spec.memory,
            CELL=spec.cell,
            RESET_AFTER=spec.reset_after,
            TREND=spec.trend,
            FIELD=spec.field,
            STAGES=tableau(spec.solver).stages if spec.field else 0,
            SILU=spec.activation == "silu",
            NODES=spec.nodes,
            MAX_STEP=float(spec.max_step or 0.0),
            SPAN=float(spec.decay_span),
            BOUNDED=spec.bounded,
            DECAY=bool(spec.decay),
            CONTINUOUS=spec.decay_rows == "continuous",
            SEVERAL=spec.nodes or (bool(spec.field) and several),
            BM=tiles[0],
            BN=tiles[1],
            BK=tiles[2],
            BE=min(tiles[1], 512 // tiles[0]),
            PRECISION=precision,
            TRACKED=TRACKED_NODES,
        )

    # --- units ------------------------------------------------------------------------------------

    @property
    def D(self) -> int:  # noqa: N802
        """Units that the vector field moves."""
        return self.X + self.H

    @property
    def S(self) -> int:  # noqa: N802
        """Units of the state."""
        return self.D + self.M

    @property
    def G(self) -> int:  # noqa: N802
        """Units of the gates."""
        return GATES[self.CELL] * self.H

    @property
    def gates(self) -> int:
        """Gates of a hidden unit."""
        return GATES[self.CELL]

    @property
    def recurrent(self) -> bool:
        """Whether h has recurrent weights."""
        return self.CELL in ("elman", "lstm", "gru")

    @property
    def flow(self) -> bool:
        """Whether there is a vector field."""
        return bool(self.FIELD)

    @property
    def layers(self) -> int:
        """Layers of the vector field."""
        return max(len(self.FIELD) - 1, 0)

    @property
    def E(self) -> int:  # noqa: N802
        """Units of a row of activations."""
        return sum(self.FIELD)

    @property
    def last(self) -> int:
        """Offset of the derivative in a row of activations."""
        return self.E - self.D

    @property
    def clamp_growth(self) -> bool:
        """A decay never increases h."""
        return bool(self.FIELD) or self.NODES

    # --- weights, in one packed buffer ------------------------------------------------------------

    @property
    def w_recurrent(self) -> int:
        """Offset of the recurrent weights (G, H)."""
        return 0

    @property
    def w_reset(self) -> int:
        """Offset of the bias (H,) inside of the reset product."""
        return self.G * self.H if self.recurrent else 0

    @property
    def w_innovation(self) -> int:
        """Offset of the weights (G, A) of the innovation."""
        return self.w_reset + (self.H if self.RESET_AFTER else 0)

    @property
    def w_trend(self) -> int:
        """Offset of damping, odds and factor of the trend, (A,) each."""
        return self.w_innovation + self.G * self.A

    @property
    def w_field(self) -> int:
        """Offset of the vector field, weight and bias of each layer."""
        return self.w_trend + (3 * self.A if self.TREND else 0)

    @property
    def w_size(self) -> int:
        """Weights in all."""
        return self.w_field + sum(out * (into + 1) for into, out in pairwise(self.FIELD))

    def table(self) -> list[list[int]]:
        """Per layer of the vector field its inputs, outputs, and the offsets of weights and x."""
        rows, weights, units = [], self.w_field, 0
        for into, out in pairwise(self.FIELD):
            rows.append([into, out, weights, units])
            weights += out * (into + 1)
            units += into
        return rows

    # --- scratch of a program: offsets of (BM, units) tables, in units ---------------------------

    @property
    def at_y(self) -> int:
        """The state (S)."""
        return 0

    @property
    def at_node(self) -> int:
        """The state of the last node (S), in the backward pass its gradient."""
        return self.S

    @property
    def at_applied(self) -> int:
        """Exponents that were applied (H)."""
        return 2 * self.S

    @property
    def at_innovation(self) -> int:
        """Innovation (A)."""
        return self.at_applied + self.H

    @property
    def at_gate(self) -> int:
        """Activated gates (G)."""
        return self.at_innovation + self.A

    @property
    def at_inner(self) -> int:
        """Input or output of the product of the reset gate (H)."""
        return self.at_gate + self.G

    @property
    def at_acts(self) -> int:
        """Activations of each stage (E), forward; of the recomputed steps, backward."""
        return self.at_inner + self.H

    @property
    def at_to_gate(self) -> int:
        """Gradient of the gates (G)."""
        return self.at_acts + self.STAGES * self.E

    @property
    def at_moved(self) -> int:
        """Gradient of what the solver added (D)."""
        return self.at_to_gate + self.G

    @property
    def at_to_applied(self) -> int:
        """Gradient of exponents that were applied (H)."""
        return self.at_moved + self.D

    @property
    def at_g(self) -> int:
        """Gradient of the state (S)."""
        return self.at_to_applied + self.H

    @property
    def at_tape(self) -> int:
        """States before each step (D), and exponents after it (H)."""
        return self.at_g + self.S

    def scratch(self, places: int = 0) -> int:
        """Numbers of scratch of a program.

        Args:
            places: steps of a row whose states the backward pass keeps; 0 for a forward pass.
        """
        if not places:
            return self.BM * self.at_to_gate
        return self.BM * (self.at_tape + places * (self.D + self.H))
