"""Random scans, small and large, for tests that compare backends."""

from __future__ import annotations

import copy
import itertools
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import fields, replace
from typing import Any, NamedTuple

import torch
from torch import Tensor

from offbeat.kernels import ScanParts, ScanSpec, StepInputs
from offbeat.kernels.reference import perceptron
from offbeat.parts import CELLS as KINDS

CELLS: dict[str, dict[str, Any]] = {
    "none": {"cell": "none"},
    "start": {"cell": "start"},
    "elman": {"cell": "elman"},
    "lstm": {"cell": "lstm"},
    "gru": {"cell": "gru"},
    "gru, reset after": {"cell": "gru", "reset_after": True},
}
FLOWS: dict[str, dict[str, Any] | None] = {
    "none": None,
    "euler": {"solver": "euler"},
    "euler, several steps": {"solver": "euler", "steps_per_gap": 3},
    "midpoint": {"solver": "midpoint"},
    "midpoint, longest step": {"solver": "midpoint", "max_step": 0.3},
    "heun": {"solver": "heun"},
    "rk4": {"solver": "rk4"},
    "rk4, several steps": {"solver": "rk4", "steps_per_gap": 2, "max_step": 0.4},
    "euler, nodes": {"solver": "euler", "max_step": 0.3, "nodes": True, "decay_span": 4.0},
    "heun, nodes": {"solver": "heun", "max_step": 0.4, "nodes": True, "decay_span": 3.0},
    "none, nodes": {"nodes": True, "decay_span": 4.0, "cell_only": True},
}


class Problem(NamedTuple):
    """A scan, and what its results are multiplied by to make a loss."""

    spec: ScanSpec
    weights: ScanParts
    rows: StepInputs
    state: Tensor
    factors: tuple[Tensor, Tensor]

    def double(self) -> Problem:
        """The same numbers in double precision."""

        def cast(value: Any) -> Any:
            return (
                value.double()
                if isinstance(value, Tensor) and value.dtype.is_floating_point
                else value
            )

        tensors = [t.detach().double().requires_grad_() for t in self.weights.tensors()]
        inputs = {f.name: cast(getattr(self.rows, f.name)) for f in fields(self.rows)}
        return self._replace(
            weights=self.with_weights(tensors),
            rows=StepInputs(**inputs),
            state=self.state.detach().double().requires_grad_(),
            factors=(self.factors[0].double(), self.factors[1].double()),
        )

    def nudged(self, towards: float) -> Problem:
        """A copy whose numbers of the first state are the next ones towards a number."""
        to = torch.full_like(self.state, towards)
        state = torch.nextafter(self.state.detach(), to).requires_grad_()
        tensors = [t.detach().clone().requires_grad_() for t in self.weights.tensors()]
        return self._replace(weights=self.with_weights(tensors), state=state)

    def with_weights(self, tensors: Sequence[Tensor]) -> ScanParts:
        """The parts with other tensors, in the order of `ScanParts.tensors`."""
        left = list(tensors)

        def pairs(old: Any) -> Any:
            return tuple((left.pop(0), left.pop(0)) for _ in old)

        old = self.weights
        cell: Any = copy.copy(old.cell)
        if cell is not None:
            cell._parameters = {
                name: None if value is None else left.pop(0)
                for name, value in cell._parameters.items()
            }
        decay = None if old.decay is None else pairs([0])[0]
        input_decay = None if old.input_decay is None else pairs([0])[0]
        trend = None if old.trend is None else tuple(left.pop(0) for _ in old.trend)
        field: Any = None
        if old.field is not None:
            field = Layered(pairs(old.field.layers), old.field.activation)  # type: ignore[attr-defined]
        return ScanParts(cell, decay, input_decay, trend, field, pairs(old.decoder))  # type: ignore[arg-type]


class Layered:
    """A perceptron of plain tensors."""

    def __init__(self, layers: Any, activation: str) -> None:
        self.layers, self.activation = layers, activation

    def __call__(self, x: Tensor) -> Tensor:
        return perceptron(self.layers, x, self.activation)


def problem(
    *,
    seed: int,
    batch: int,
    rows: int,
    channels: int,
    hidden: int,
    cell: str,
    flow: str,
    anchored: bool = False,
    trend: bool = False,
    self_feeding: bool = False,
    input_decay: bool = False,
    decay: str = "none",
    decay_rows: str = "continuous",
    time_inputs: int = 0,
    activation: str = "tanh",
    units: tuple[int, ...] = (7, 5),
    padded: bool = False,
    bounded: bool = False,
    scale: float = 0.5,
    dtype: torch.dtype = torch.float32,
) -> Problem:
    """A scan with random weights; about half of the values are observed, some gaps are 0."""
    generator = torch.Generator().manual_seed(seed)
    anchors = (2 if trend else 1) * channels if anchored else 0
    driven = hidden + anchors
    features = {"none": 0, "delta": channels, "elapsed": 1}[decay]
    flow_options = dict(FLOWS[flow] or {})
    no_field = FLOWS[flow] is None or flow_options.pop("cell_only", False)
    nodes = bool(flow_options.get("nodes"))
    if nodes:
        decay_rows = "continuous"
    if cell == "none" and no_field and not features:
        features = 1  # a scan of nothing at all has no weights
    has_cell = cell != "none"
    kind = KINDS[CELLS[cell]["cell"]] if has_cell else None
    gates = kind.gates_per_unit * hidden if kind else 0
    spec = ScanSpec(
        channels=channels,
        hidden_size=hidden,
        gates=gates,
        memory=kind.memory_per_unit * hidden if kind else 0,
        anchored=anchored,
        trend=trend and anchored,
        time_inputs=time_inputs if has_cell else 0,
        field=() if no_field else (driven, *units, driven),
        bounded=bounded,
        activation=activation,  # type: ignore[arg-type]
        decay=features,
        decay_rows=decay_rows,  # type: ignore[arg-type]
        input_decay=input_decay,
        decoder=(hidden, 6, channels) if self_feeding else (),
        **{**CELLS[cell], **flow_options},
    )

    def normal(*shape: int, by: float = scale) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64).mul(by).to(dtype)

    def uniform(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator, dtype=torch.float64).to(dtype)

    def weight(*shape: int) -> Tensor:
        return normal(*shape).requires_grad_()

    def positive(*shape: int, by: float = 1.0) -> Tensor:
        return (by * uniform(*shape) + 0.01).requires_grad_()

    def layers(sizes: tuple[int, ...]) -> tuple[tuple[Tensor, Tensor], ...]:
        return tuple((weight(o, i), weight(o)) for i, o in itertools.pairwise(sizes))

    part: Any = None
    if kind is not None:
        part = kind(
            2 * channels + time_inputs,
            hidden,
            innovation=channels if anchored else 0,
            reset_after=spec.reset_after,
        ).to(dtype)
        with torch.no_grad():
            for tensor in part.tensors():
                tensor.copy_(normal(*tensor.shape))
    parts = ScanParts(
        cell=part,
        decay=(weight(hidden, features), weight(hidden)) if features else None,
        input_decay=(weight(channels), weight(channels)) if input_decay else None,
        trend=(positive(channels, by=3.0), positive(channels), positive(channels))
        if spec.trend
        else None,
        field=Layered(layers(spec.field), activation) if spec.field else None,  # type: ignore[arg-type]
        decoder=layers(spec.decoder),
    )
    mask = (uniform(batch, rows, channels) < 0.6) & (uniform(batch, rows, 1) < 0.7)
    mask = mask.to(dtype)
    update = (mask.sum(dim=2) > 0).to(dtype)
    gap = uniform(batch, rows)
    gap[uniform(batch, rows) < 0.1] = 0
    start = 2 * uniform(batch, rows, features) if features else None
    length = None
    if padded:
        length = torch.randint(1, rows + 1, (batch,), generator=generator)
    given = StepInputs(
        gap=gap,
        update=update,
        values=normal(batch, rows, channels, by=1.0) * mask,
        mask=mask,
        time_input=uniform(batch, rows, time_inputs) if time_inputs and has_cell else None,
        updated=torch.cat([torch.zeros(batch, 1, dtype=dtype), update[:, :-1]], dim=1)
        if features
        else None,
        decay_start=start,
        decay_end=None if start is None else start + uniform(*start.shape),
        delta=uniform(batch, rows, channels) if input_decay else None,
        last=normal(batch, rows, channels, by=1.0) if input_decay else None,
        mean=normal(channels) if input_decay else None,
        length=length,
        low=-0.3 - uniform(anchors) if bounded and anchored else None,
        high=0.3 + uniform(anchors) if bounded and anchored else None,
        fed=tuple(bool(b) for b in uniform(rows) < 0.5) if self_feeding else (),
    )
    if spec.trend:
        gains = [mask * uniform(batch, rows, channels) for _ in range(2)]
        gains[0][uniform(batch, rows, channels) < 0.2] = 1.0
        given = replace(given, level_gain=gains[0] * mask, slope_gain=gains[1])
    if nodes:
        first, node = (2 * uniform(batch, rows)).floor(), (3 * uniform(batch, rows)).floor()
        far = uniform(batch, rows) < 0.02
        first = torch.where(far, first + 40, first) * bool(spec.field)
        node = first + node * bool(spec.field)
        commit = torch.maximum(update, (uniform(batch, rows) < 0.2).to(dtype))
        given = replace(given, first_node=first, node=node, commit=commit)
    state = normal(batch, spec.state_size).requires_grad_()
    factors = tuple(normal(batch, rows, spec.state_size, by=1.0) for _ in range(2))
    return Problem(spec, parts, given, state, factors)  # type: ignore[arg-type]


def run(scan: Callable[..., tuple[Tensor, Tensor]], case: Problem) -> dict[str, Tensor]:
    """Both results of a scan, and the gradient of each weight and of the first state."""
    before, after = scan(case.spec, case.weights, case.rows, case.state)
    leaves = [*case.weights.tensors(), case.state]
    loss = (before * case.factors[0]).sum() + (after * case.factors[1]).sum()
    found = torch.autograd.grad(loss, leaves, allow_unused=True)
    result = {"before": before.detach(), "after": after.detach()}
    for i, (gradient, leaf) in enumerate(zip(found, leaves, strict=True)):
        result[f"gradient {i}"] = torch.zeros_like(leaf) if gradient is None else gradient
    return result


def largest_error(got: Tensor, expected: Tensor) -> float:
    """The largest error, as a fraction of the largest entry."""
    if not expected.numel():
        return 0.0
    scale = float(expected.abs().max())
    return float((got - expected).abs().max()) / (scale if scale > 0 else 1.0)


@contextmanager
def threads_restored() -> Iterator[None]:
    """Context manager after which torch has as many threads as before."""
    threads = torch.get_num_threads()
    try:
        yield
    finally:
        torch.set_num_threads(threads)


def assert_same_bits(found: Sequence[dict[str, Tensor]]) -> None:
    """Asserts that results of scans are equal to the last bit."""
    for other in found[1:]:
        for key, value in found[0].items():
            assert torch.equal(other[key], value), key
