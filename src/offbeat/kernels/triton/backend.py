"""The Triton backend of the scan: what it supports, and the start of its kernels.

What does not depend on the state (projections of the inputs, exponents of decays) is computed by
PyTorch for all rows at once, and so are the gradients of weights, as large products at the end. So
no sum depends on the order in which programs run: results are the same bits in every run.
"""

from __future__ import annotations

import importlib.util
import os
import warnings
from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import accumulate
from threading import RLock
from typing import Any, cast

import torch
from torch import Tensor
from torch.autograd import Function
from torch.autograd.function import once_differentiable
from torch.nn.functional import linear, pad

from offbeat.kernels import reference
from offbeat.kernels.spec import (
    KnownSteps,
    ScanParts,
    ScanSpec,
    StepInputs,
    TableSteps,
    field_tensors,
)
from offbeat.kernels.triton.shape import GATES, MOST_STAGES, Shape
from offbeat.ode import tableau

MEMORY_LIMIT = 512 * 2**20
"""Bytes of activations and their gradients that a launch of the backward kernel stores; more rows
are further launches. It does not change the gradients beyond rounding."""

TRUSTED = 1e-2
"""Largest difference from the reference backend, as a fraction of the largest entry, with which
this backend is used on a GPU; TF32 alone has 1e-3."""


_INTERPRETER = RLock()
"""Triton's interpreter replaces its language for all threads, so they launch one after another."""


def interpreted() -> bool:
    """Whether Triton interprets kernels, on CPU tensors."""
    return os.environ.get("TRITON_INTERPRET", "0").lower() in ("1", "true", "on", "yes")


@lru_cache(maxsize=1)
def _installed() -> bool:
    return importlib.util.find_spec("triton") is not None


def why_not() -> str:
    """The reason if no kernel can run here, else an empty string."""
    if not _installed():
        return "triton is not installed"
    if not torch.cuda.is_available() and not interpreted():
        return "there is no CUDA device, and TRITON_INTERPRET is not 1"
    return ""


def supports(spec: ScanSpec, dtype: torch.dtype, device: torch.device) -> str | None:
    """None if this backend runs scans of a spec, else the reason why not."""
    if spec.cell not in GATES:
        return f"the cell {spec.cell!r} is not one of {', '.join(GATES)}"
    if spec.decoder:
        return "the decoded state is fed back"
    if spec.field and spec.field_kind != "mlp":
        return f"the vector field {spec.field_kind!r} is not mlp"
    if spec.field and tableau(spec.solver).adaptive:
        return f"the solver {spec.solver} chooses its own steps"
    if spec.field and tableau(spec.solver).stages > MOST_STAGES:
        return f"the solver {spec.solver} has more than {MOST_STAGES} stages"
    if spec.field and spec.adjoint:
        return "gradients are computed by the adjoint method"
    if spec.loops:
        return "the scan is traced"
    if device.type != "cuda" and not (device.type == "cpu" and interpreted()):
        return f"the state is on {device}, not on a CUDA device"
    if dtype != torch.float32:
        return f"the state is {dtype}, not float32"
    return None


def precision() -> str:
    """Precision of products: `tf32` where PyTorch uses it, else `ieee`."""
    return "ieee" if torch.get_float32_matmul_precision() == "highest" else "tf32"


def tiles(spec: ScanSpec, trajectories: int, precision: str = "ieee") -> tuple[int, int, int]:
    """Trajectories of a program, units of a tile, and units that are summed at once.

    Args:
        spec: of the scan.
        trajectories: of all runs.
        precision: of products.
    """
    if precision != "ieee":  # products need more registers, so that wider tiles spill
        return 16, 32 if spec.anchored else 64, 16
    widest = max(spec.hidden_size, spec.anchors, *spec.field, 16)
    down = 16 if trajectories < 2048 else 32
    across = 1 << (widest - 1).bit_length()
    return down, min(max(across, 64), 2048 // down), 16  # as many as fit into registers


def unsupported(parts: ScanParts, inputs: StepInputs | TableSteps, state: Tensor) -> str | None:
    """None if this backend runs a scan of a supported spec, else the reason why not."""
    if torch.is_autocast_enabled(state.device.type):
        return "products are in another precision by autocast"
    given = (*parts.tensors(), *inputs.known())
    if any(t.dtype != state.dtype or t.device != state.device for t in given):
        return "trained parts, inputs and state differ in type or device"
    if any(t.requires_grad for t in inputs.known()):
        return "a gradient with respect to the step inputs is needed"
    return None


def scan(
    spec: ScanSpec, parts: ScanParts, inputs: StepInputs | TableSteps, state: Tensor
) -> tuple[Tensor, Tensor]:
    """Propagates a batch of states over all steps; see `offbeat.kernels.scan`."""
    before, after = scan_stacked(spec, [parts], [inputs.gathered()], state[None])
    return before[0], after[0]


_trusted: dict[tuple[ScanSpec, torch.device], str] = {}


def distrusted(
    spec: ScanSpec, parts: ScanParts, inputs: StepInputs | TableSteps, state: Tensor
) -> str:
    """The reason if results on this device differ from the reference backend's, else "".

    The first scan of a spec on a GPU is computed by both, with gradients.
    """
    key = (spec, state.device)
    if key not in _trusted:
        _trusted[key] = ""
        error = disagreement(spec, parts, inputs.gathered(), state)
        if not error <= TRUSTED:
            _trusted[key] = f"results on {state.device} differ by {error:.2g} from the reference"
            warnings.warn(f"the triton backend is not used: {_trusted[key]}", stacklevel=2)
    return _trusted[key]


def refused(
    spec: ScanSpec, parts: ScanParts, inputs: StepInputs | TableSteps, state: Tensor
) -> str:
    """The reason why a scan of a supported spec does not run in this backend, else "".

    On the CPU, where kernels are interpreted, results are not compared.
    """
    reason = unsupported(parts, inputs, state)
    if reason or state.device.type == "cpu":
        return reason or ""
    return distrusted(spec, parts, inputs, state)


def disagreement(spec: ScanSpec, parts: ScanParts, inputs: StepInputs, state: Tensor) -> float:
    """The largest difference from the reference backend in states and gradients.

    As a fraction of the largest entry of each tensor.

    Args:
        spec: see `offbeat.kernels.scan`; so are the others.
        parts: their gradients are not changed.
        inputs: see there.
        state: see there.
    """
    leaves = [t for t in parts.tensors() if t.requires_grad]
    found = []
    with torch.enable_grad():
        start = state.detach().requires_grad_()
        for backend in (scan, reference.scan):
            before, after = backend(spec, parts, inputs, start)
            loss = before.square().mean() + after.square().mean()
            gradients = torch.autograd.grad(loss, [start, *leaves], allow_unused=True)
            zero = [torch.zeros_like(t) for t in (start, *leaves)]
            each = zip(gradients, zero, strict=True)
            found.append(
                [before.detach(), after.detach(), *(z if g is None else g for g, z in each)]
            )
    pairs = zip(*found, strict=True)
    errors = [(a - b).abs().max() / b.abs().max().clamp_min(1e-20) for a, b in pairs]
    return float(torch.stack(errors).max())


def scan_stacked(
    spec: ScanSpec, parts: Sequence[ScanParts], inputs: Sequence[StepInputs], state: Tensor
) -> tuple[Tensor, Tensor]:
    """Propagates the states of several models of one spec in one launch.

    Args:
        spec: of all models.
        parts: of each model.
        inputs: of each model, of equal numbers of trajectories and rows.
        state: (runs, batch, state_size) before the first step.

    Returns:
        Two tensors (runs, batch, rows, state_size), as of `offbeat.kernels.scan`.

    Raises:
        RuntimeError: this backend cannot run these scans.
    """
    for one, rows in zip(parts, inputs, strict=True):
        reason = supports(spec, state.dtype, state.device) or unsupported(one, rows, state)
        if reason:
            raise RuntimeError(f"the triton backend cannot run this scan: {reason}")
    products = precision()
    shape = Shape.of(spec, tiles(spec, state.shape[0] * state.shape[1], products), products)
    each = [_Operands.of(spec, one, rows) for one, rows in zip(parts, inputs, strict=True)]
    operands = each[0] if len(each) == 1 else _Operands.stacked(each)
    packed = torch.stack([_packed(shape, one, state) for one in parts])
    known = inputs[0].known_steps if len(inputs) == 1 else None
    plan = _Plan.of(spec, shape, operands, len(parts), known)
    empty = state.new_zeros(1)
    gates, start, end = (
        empty if t is None else t.contiguous()
        for t in (operands.gates, operands.start, operands.end)
    )
    result = _Scan.apply(plan, gates, start, end, packed, state.contiguous())  # type: ignore[no-untyped-call]
    return cast("tuple[Tensor, Tensor]", result)


# --- what the kernels are given -------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Operands:
    """What the kernels read per row, of one run or several; padding changes no state.

    Attributes:
        lanes: (runs, batch, rows, 8), see `forward.scan_forward`.
        values: (runs, batch, rows, channels), with an anchored state only; so are the next three.
        mask: 1.0 where observed.
        level: gains of the level, with a trend only.
        slope: gains of the slope, with a trend only.
        gates: (runs, batch, rows, gates) input projection of the cell, or None.
        start: (runs, batch, rows, hidden) exponents at the start of the gap, or None.
        end: the same at its end.
        bounds: (2, driven) of a bounded scan, or None.
        reads: (runs, batch, rows) whether a step from the last node to the row is needed.
    """

    lanes: Tensor
    values: Tensor | None
    mask: Tensor | None
    level: Tensor | None
    slope: Tensor | None
    gates: Tensor | None
    start: Tensor | None
    end: Tensor | None
    bounds: Tensor | None
    reads: Tensor

    @classmethod
    def of(cls, spec: ScanSpec, parts: ScanParts, inputs: StepInputs) -> _Operands:
        gap, update, none = inputs.gap, inputs.update, torch.zeros_like(inputs.gap)
        updated = none if inputs.updated is None else inputs.updated
        first, node, commit = none, torch.ones_like(gap), none
        if spec.nodes:
            first, node, commit = (
                reference._given(t) for t in (inputs.first_node, inputs.node, inputs.commit)
            )
        elif spec.field:
            node = node * spec.steps_per_gap
            if spec.max_step is not None:
                node = torch.ceil(gap / spec.max_step - 1e-6).clamp_min(spec.steps_per_gap)
        reads = gap > 0
        if spec.decay:  # after an update, the whole exponent is still to be applied
            reads = reads | ((node == 0) & (updated > 0))
        lanes = torch.stack([gap, update, updated, first, node, commit, none, none], dim=-1)
        values, mask = (inputs.values, inputs.mask) if spec.anchored else (None, None)
        start = end = None
        if spec.decay:
            assert parts.decay is not None
            end = linear(reference._given(inputs.decay_end), *parts.decay)
            if spec.decay_rows == "observed_rows":
                end = end * update[..., None]
            start = end
            if spec.decay_rows == "continuous":
                start = linear(reference._given(inputs.decay_start), *parts.decay)
        if inputs.length is not None:
            there = torch.arange(inputs.rows, device=gap.device) < inputs.length[:, None]
            valid = there.to(gap.dtype)[..., None]
            lanes, reads = lanes * valid, reads & there
            if not spec.nodes:
                lanes[..., 4] += 1 - valid[..., 0]
            mask = None if mask is None else mask * valid
            start, end = (None if t is None else t * valid for t in (start, end))
        bounds = None
        if spec.bounded:
            dynamics = reference._Dynamics.of(replace(spec, field=()), parts, inputs)
            assert dynamics.low is not None
            assert dynamics.high is not None
            bounds = torch.stack([dynamics.low, dynamics.high])
        given = {
            "lanes": lanes,
            "values": values,
            "mask": mask,
            "level": inputs.level_gain,
            "slope": inputs.slope_gain,
            "gates": reference._gates(spec, parts, inputs),
            "start": start,
            "end": end,
            "reads": reads,
        }
        each: dict[str, Any] = {n: None if t is None else t[None] for n, t in given.items()}
        return cls(**each, bounds=bounds)

    @classmethod
    def stacked(cls, runs: Sequence[_Operands]) -> _Operands:
        """The operands of several runs, of equal bounds."""

        def cat(name: str) -> Any:
            each = [getattr(run, name) for run in runs]
            return None if each[0] is None else torch.cat(each)

        names = ("lanes", "values", "mask", "level", "slope", "gates", "start", "end", "reads")
        return cls(**{name: cat(name) for name in names}, bounds=runs[0].bounds)


def _packed(shape: Shape, parts: ScanParts, like: Tensor) -> Tensor:
    """The weights of a scan, but those of its projections, in one buffer."""
    each: list[Tensor] = []
    cell: Any = parts.cell
    if cell is not None:
        if shape.recurrent:
            each.append(cell.recurrent)
        if shape.RESET_AFTER:
            each.append(cell.recurrent_bias)
        if shape.A:
            given = cell.innovation
            each.append(like.new_zeros(shape.G * shape.A) if given is None else given)
    if shape.TREND:
        each.extend(parts.trend or ())
    if shape.FIELD and parts.field is not None:
        each.extend(field_tensors(parts.field))
    if not each:
        return like.new_zeros(1)
    return torch.cat([tensor.reshape(-1) for tensor in each])


@dataclass(frozen=True, eq=False)
class _Plan:
    """The launch of a scan.

    Attributes:
        shape: of the kernels.
        operands: what they read.
        runs: models.
        batch: trajectories of each.
        rows: of each.
        steps: (blocks of a run, rows, 2) int32, as of `forward.scan_forward`.
        slots: (blocks of a run, rows) int64, number of tracked steps before those of a row.
        until: number of tracked steps of a run before each row, and in all.
        places: most steps of a row that the backward pass keeps.
        layers: table of the vector field's layers.
        tab: weights of the solver's stages.
        bounds: of the state.
    """

    shape: Shape
    operands: _Operands
    runs: int
    batch: int
    rows: int
    steps: Tensor
    slots: Tensor
    until: list[int]
    places: int
    layers: Tensor
    tab: Tensor
    bounds: Tensor

    @classmethod
    def of(
        cls,
        spec: ScanSpec,
        shape: Shape,
        operands: _Operands,
        runs: int,
        known: KnownSteps | None,
    ) -> _Plan:
        lanes = operands.lanes
        _, batch, rows, _ = lanes.shape
        blocks = -(-batch // shape.BM)
        device = lanes.device

        def most(each: Tensor) -> Tensor:
            """(blocks, rows) the largest of a block, in any run."""
            padded = pad(each, (0, 0, 0, blocks * shape.BM - batch))
            return padded.view(runs, blocks, shape.BM, rows).amax(dim=(0, 2))

        tracked: list[int]
        reads = torch.zeros(blocks, rows, device=device)
        if spec.nodes:
            whole = most(lanes[..., 4] - lanes[..., 3])
            if spec.max_step is None:
                whole = torch.zeros_like(whole)
            reads = most(operands.reads.to(lanes.dtype))
        elif spec.field and spec.max_step is not None:
            whole = most(lanes[..., 4])
        else:
            each = spec.steps_per_gap if spec.field else int(bool(spec.decay or spec.trend))
            whole = torch.full((blocks, rows), float(each), device=device)
        steps = torch.stack([whole, reads], dim=-1).to(torch.int32)
        if spec.max_step is None:
            tracked = [spec.steps_per_gap] * rows
        elif spec.nodes and known is not None:
            each_row = zip(known.whole, known.read, strict=True)
            tracked = [min(n, shape.TRACKED) + read for n, read in each_row]
        else:  # the CPU waits for the device
            limit = shape.TRACKED if spec.nodes else torch.inf
            tracked = (whole.clamp_max(limit) + reads).amax(dim=0).int().tolist()
        slots, layers, tab = _constants(shape, spec.solver, tuple(tracked), blocks, device)
        bounds = operands.bounds
        if bounds is None:
            bounds = torch.zeros(1, device=device)
        return cls(
            shape,
            operands,
            runs,
            batch,
            rows,
            steps,
            slots,
            [0, *accumulate(blocks * n for n in tracked)],
            1 + max(tracked, default=0),
            layers,
            tab,
            bounds.contiguous(),
        )

    @property
    def programs(self) -> int:
        """Programs of a launch."""
        return self.runs * -(-self.batch // self.shape.BM)

    def given(self, gates: Tensor, start: Tensor, end: Tensor, state: Tensor) -> list[Tensor]:
        """The first arguments of both kernels."""
        own = self.operands
        inputs = (own.lanes, own.values, own.mask, own.level, own.slope)
        some = [own.lanes if t is None else t.contiguous() for t in inputs]
        return [*some, gates, start, end, state]

    def groups(self) -> list[tuple[int, int]]:
        """Rows of each launch of the backward kernel, from the first to the one after the last."""
        shape = self.shape
        size = 8 * self.runs * shape.STAGES * shape.BM * shape.E
        found, last = [], self.rows
        while last > 0:
            first = last - 1
            while first > 0 and (self.until[last] - self.until[first - 1]) * size <= MEMORY_LIMIT:
                first -= 1
            found.append((first, last))
            last = first
        return found


@lru_cache(maxsize=64)
def _constants(
    shape: Shape, solver: str, tracked: tuple[int, ...], blocks: int, device: torch.device
) -> tuple[Tensor, Tensor, Tensor]:
    """`slots`, `layers` and `tab` of a plan; copied to the device once."""
    before = torch.tensor([0, *accumulate(tracked)][:-1])
    each = torch.tensor(tracked)
    slots = before * blocks + torch.arange(blocks)[:, None] * each
    layers = torch.tensor(shape.table() or [[0, 0, 0, 0]], dtype=torch.int32)
    tab = torch.zeros(20)
    if shape.flow:
        scheme = tableau(solver)
        for j, row in enumerate(scheme.a):
            tab[4 * j : 4 * j + j] = torch.tensor(row)
        tab[16 : 16 + scheme.stages] = torch.tensor(scheme.b)
    return slots.to(device), layers.to(device), tab.to(device)


# --- the kernels ----------------------------------------------------------------------------------


def options(shape: Shape) -> dict[str, Any]:
    """How the kernels are compiled.

    Args:
        shape: of the scan.
    """
    return {
        "num_warps": 8,
        "num_stages": 1,
        "maxnreg": 255,  # else the assembler can aim at fewer, and spill
        "enable_fp_fusion": True,
    }


def _on(device: torch.device) -> AbstractContextManager[Any]:
    if device.type == "cuda":
        return torch.cuda.device(device)
    return _INTERPRETER if interpreted() else nullcontext()


class _Scan(Function):
    @staticmethod
    def forward(
        ctx: Any,
        plan: _Plan,
        gates: Tensor,
        start: Tensor,
        end: Tensor,
        packed: Tensor,
        state: Tensor,
    ) -> tuple[Tensor, Tensor]:
        from offbeat.kernels.triton.forward import scan_forward

        shape = plan.shape
        before = state.new_empty((plan.runs, plan.batch, plan.rows, shape.S))
        after = torch.empty_like(before)
        scratch = state.new_zeros(plan.programs * shape.scratch())
        with _on(state.device):
            scan_forward[(plan.programs,)](
                *plan.given(gates, start, end, state), before, after,
                packed, plan.bounds, plan.layers, plan.tab, plan.steps, scratch,
                plan.batch, plan.rows, c=shape, **options(shape),
            )  # fmt: skip
        ctx.plan = plan
        ctx.save_for_backward(gates, start, end, packed, state, before, after)
        ctx.set_materialize_grads(False)
        return before, after

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, to_before: Tensor | None, to_after: Tensor | None) -> tuple[Any, ...]:
        from offbeat.kernels.triton.backward import scan_backward

        plan: _Plan = ctx.plan
        shape = plan.shape
        gates, start, end, packed, state, before, after = ctx.saved_tensors
        g = torch.zeros_like(state)
        to_gates, to_start, to_end = (torch.zeros_like(t) for t in (gates, start, end))
        to_product = torch.zeros_like(before[..., : shape.H] if shape.CELL == "gru" else state)
        sums = state.new_zeros((plan.runs, plan.batch, 3 * shape.A))
        scratch = state.new_zeros(plan.programs * shape.scratch(plan.places))
        to_packed = torch.zeros_like(packed)
        none = before.new_zeros(1)
        groups = plan.groups()
        slots = max(plan.until[last] - plan.until[first] for first, last in groups)
        kept = (plan.runs, slots * bool(shape.FIELD), shape.STAGES * shape.BM, shape.E)
        acts, deltas = state.new_empty(kept), state.new_empty(kept)
        with _on(state.device):
            for first, last in groups:
                deltas.zero_(), acts.zero_()
                scan_backward[(plan.programs,)](
                    *plan.given(gates, start, end, state), before, after,
                    packed, plan.bounds, plan.layers, plan.tab, plan.steps, scratch,
                    plan.batch, plan.rows,
                    none if to_before is None else to_before.contiguous(),
                    none if to_after is None else to_after.contiguous(),
                    g, to_gates, to_product, to_start, to_end, sums,
                    acts, deltas, plan.slots - plan.until[first], slots, first, last, plan.places,
                    HAS_BEFORE=to_before is not None, HAS_AFTER=to_after is not None, c=shape,
                    **options(shape),
                )  # fmt: skip
                _field_gradient(shape, to_packed, acts, deltas)
        _cell_gradient(plan, to_packed, before, to_gates, to_product)
        if shape.TREND:
            at = shape.w_trend
            to_packed[:, at : at + 3 * shape.A] = sums.sum(dim=1)
        if plan.shape.DECAY and not shape.CONTINUOUS:  # one tensor was both
            to_start, to_end = torch.zeros_like(to_start), to_end + to_start
        return None, to_gates, to_start, to_end, to_packed, g


def _field_gradient(shape: Shape, to_packed: Tensor, acts: Tensor, deltas: Tensor) -> None:
    """Adds the gradients of the vector field's weights."""
    if not shape.FIELD:
        return
    runs = len(acts)
    x, g = acts.view(runs, -1, shape.E), deltas.view(runs, -1, shape.E)
    for into, out, weight, at in shape.table():
        to_out = g[..., at + into : at + into + out]
        found = to_out.transpose(1, 2) @ x[..., at : at + into]
        to_packed[:, weight : weight + into * out] += found.reshape(runs, -1)
        bias = weight + into * out
        to_packed[:, bias : bias + out] += to_out.sum(dim=1)


def _cell_gradient(
    plan: _Plan, to_packed: Tensor, before: Tensor, to_gates: Tensor, to_product: Tensor
) -> None:
    """Stores the gradients of the cell's recurrent weights and of the innovation's."""
    shape, runs = plan.shape, plan.runs
    if not shape.G:
        return
    g = to_gates.reshape(runs, -1, shape.G).transpose(1, 2)
    h = before[..., shape.X : shape.D].reshape(runs, -1, shape.H)
    recurrent = to_packed[:, : shape.w_reset].view(runs, -1, shape.H) if shape.recurrent else None
    if shape.CELL == "gru":
        assert recurrent is not None
        product = to_product.reshape(runs, -1, shape.H)
        recurrent[:, : 2 * shape.H] = g[:, : 2 * shape.H] @ h
        if shape.RESET_AFTER:
            recurrent[:, 2 * shape.H :] = product.transpose(1, 2) @ h
            to_packed[:, shape.w_reset : shape.w_innovation] = product.sum(dim=1)
        else:
            recurrent[:, 2 * shape.H :] = g[:, 2 * shape.H :] @ product
    elif recurrent is not None:
        recurrent.copy_(g @ h)
    if not shape.A:
        return
    value, x = plan.operands.values, before[..., : shape.A]
    assert value is not None
    if shape.BOUNDED:
        low, high = plan.bounds[:, : shape.A]
        value, x = torch.clamp(value, low, high), torch.clamp(x, low, high)
    assert plan.operands.mask is not None
    innovation = (plan.operands.mask * (value - x)).reshape(runs, -1, shape.A)
    at = slice(shape.w_innovation, shape.w_innovation + shape.G * shape.A)
    to_packed[:, at] = (g @ innovation).reshape(runs, -1)
