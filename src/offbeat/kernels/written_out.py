"""The scan with its backward pass written out, for the combinations that are trained most.

Autograd records some thirty operations per row and adds up each weight's gradient row by row. Here
the forward pass keeps what the backward pass needs in one tensor per quantity, and each weight's
gradient is a single product over all rows at the end: the same values and gradients as the
reference body, somewhat faster (`benchmarks/scan_bodies.py`).
"""

from __future__ import annotations

from typing import Any, cast

import torch
from torch import Tensor
from torch.autograd import Function
from torch.autograd.function import once_differentiable

from offbeat.kernels.reference import decay_factors
from offbeat.kernels.spec import ScanRows, ScanSpec, ScanWeights

_aten = torch.ops.aten


def supports(spec: ScanSpec, rows: ScanRows) -> bool:
    """True for a GRU or a start value, with no vector field or one Euler step per gap.

    Gradients reach weights, gates, decays and the first state; not gaps and observed values.
    """
    one_euler_step = (
        spec.solver == "euler"
        and spec.steps_per_gap == 1
        and spec.max_step is None
        and not spec.adjoint
    )
    data = (rows.gap, rows.values, rows.mask, rows.update)
    return (
        spec.cell in ("gru", "set")
        and not spec.reset_after
        and (one_euler_step or not spec.has_field)
        and not rows.fed
        and not any(t is not None and t.requires_grad for t in data)
    )


def scan(
    spec: ScanSpec, weights: ScanWeights, rows: ScanRows, state: Tensor
) -> tuple[Tensor, Tensor]:
    """Carries a batch of states over all rows; as `reference.scan`, where `supports` is True."""
    result = _WrittenOut.apply(  # type: ignore[no-untyped-call]
        spec,
        rows,
        rows.gates,
        decay_factors(spec, rows),
        state,
        weights.recurrent,
        weights.innovation,
        *(tensor for layer in weights.field for tensor in layer),
    )
    return cast("tuple[Tensor, Tensor]", result)


class _Record:
    """What the forward pass keeps: one tensor (rows, batch, units) per quantity."""

    def __init__(self, spec: ScanSpec, like: Tensor, field: tuple[Tensor, ...]) -> None:
        def empty(units: int) -> Tensor:
            return like.new_empty((*like.shape[:2], units))

        n = spec.hidden_size
        self.start = empty(spec.state_size)  # where the vector field is evaluated
        hidden = [weight.shape[0] for weight in field[:-2:2]]
        self.layers = [empty(units) for units in hidden]
        # SiLU's derivative needs its argument, tanh's only its value.
        self.arguments = [empty(units) for units in hidden] if spec.activation == "silu" else []
        if spec.cell == "gru":
            self.gate, self.reset_h, self.candidate = empty(2 * n), empty(n), empty(n)
        self.innovation = empty(spec.anchored)


class _WrittenOut(Function):
    @staticmethod
    def forward(
        ctx: Any,
        spec: ScanSpec,
        rows: ScanRows,
        gates: Tensor,
        factor: Tensor | None,
        state: Tensor,
        recurrent: Tensor | None,
        innovation: Tensor | None,
        *field: Tensor,
    ) -> tuple[Tensor, Tensor]:
        record = _Record(spec, gates, field)
        befores, afters = torch.empty_like(record.start), torch.empty_like(record.start)
        n, a = spec.hidden_size, spec.anchored
        pairs = [(w.t(), b) for w, b in zip(field[::2], field[1::2], strict=True)]
        first_state = state
        for i in range(len(gates)):
            start, before, after = record.start[i], befores[i], afters[i]
            start.copy_(state)
            if factor is not None:
                start[:, a:].mul_(factor[i])
            if pairs:
                x = _field(record, i, start, pairs)
                torch.addcmul(start, rows.gap[i], x, out=before)
            else:
                before.copy_(start)
            h, gate, update = before[:, a:], gates[i], rows.update[i]
            if a:
                mask, value = cast(Tensor, rows.mask)[i], cast(Tensor, rows.values)[i]
                torch.sub(value, before[:, :a], out=record.innovation[i]).mul_(mask)
                gate = torch.addmm(gate, record.innovation[i], cast(Tensor, innovation).t())
                after[:, :a] = torch.lerp(before[:, :a], value, mask)
            if spec.cell == "set":
                after[:, a:] = torch.lerp(h, gate, update)
            else:
                weight = cast(Tensor, recurrent)
                zr, reset_h, candidate = record.gate[i], record.reset_h[i], record.candidate[i]
                torch.addmm(gate[:, : 2 * n], h, weight[: 2 * n].t(), out=zr).sigmoid_()
                torch.mul(zr[:, n:], h, out=reset_h)
                torch.addmm(gate[:, 2 * n :], reset_h, weight[2 * n :].t(), out=candidate).tanh_()
                after[:, a:] = torch.lerp(h, candidate, zr[:, :n] * update)
            state = after
        ctx.spec, ctx.rows, ctx.record = spec, rows, record
        # What is returned must be kept this way: as attributes it would never be freed.
        ctx.save_for_backward(befores, afters, factor, first_state, recurrent, innovation, *field)
        return befores, afters

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, to_before: Tensor, to_after: Tensor) -> tuple[Any, ...]:
        spec, rows, record = ctx.spec, ctx.rows, ctx.record
        befores, afters, factor, first_state, recurrent, innovation, *field = ctx.saved_tensors
        n, a = spec.hidden_size, spec.anchored
        weights = field[::2]
        to_gates = torch.empty_like(rows.gates)
        to_start = torch.empty_like(record.start)
        to_layers = [torch.empty_like(t) for t in record.layers]
        if field:
            to_layers.append(torch.empty_like(record.start))
        grad = torch.zeros_like(first_state)
        for i in reversed(range(len(to_gates))):
            grad = grad + to_after[i]
            h, update = befores[i, :, a:], rows.update[i]
            to_h, to_gate = grad[:, a:], to_gates[i]
            if spec.cell == "set":
                torch.mul(to_h, update, out=to_gate)
                to_h = to_h - to_gate
            else:
                to_h = _gru_backward(record, i, n, h, update, recurrent, to_h, to_gate)
            total = to_start[i]
            if a:
                mask = rows.mask[i]
                to_e = to_gate @ innovation
                torch.sub(grad[:, :a], mask * (grad[:, :a] + to_e), out=total[:, :a])
                total[:, a:] = to_h
                total += to_before[i]
            else:
                torch.add(to_h, to_before[i], out=total)
            if field:
                _field_backward(record, i, spec.activation, rows.gap[i], weights, to_layers, total)
            grad = total
            if factor is not None:
                grad = total.clone()
                grad[:, a:].mul_(factor[i])
        to_factor = None
        if factor is not None:
            previous = torch.cat([first_state[None], afters[:-1]])
            to_factor = (to_start * previous)[..., a:]
        inputs = [record.start, *record.layers]
        to_field = [
            gradient
            for to_layer, x in zip(to_layers, inputs, strict=False)
            for gradient in (_product(to_layer, x), to_layer.sum(dim=(0, 1)))
        ]
        to_recurrent = None
        if spec.cell == "gru":
            gated, candidates = to_gates[..., : 2 * n], to_gates[..., 2 * n :]
            to_recurrent = torch.cat(
                [_product(gated, befores[..., a:]), _product(candidates, record.reset_h)]
            )
        to_innovation = _product(to_gates, record.innovation) if a else None
        return (None, None, to_gates, to_factor, grad, to_recurrent, to_innovation, *to_field)


def _field(record: _Record, i: int, x: Tensor, layers: list[tuple[Tensor, Tensor]]) -> Tensor:
    for k, (weight, bias) in enumerate(layers[:-1]):
        out = record.layers[k][i]
        if record.arguments:
            _aten.silu.out(torch.addmm(bias, x, weight, out=record.arguments[k][i]), out=out)
        else:
            torch.addmm(bias, x, weight, out=out).tanh_()
        x = out
    weight, bias = layers[-1]
    return torch.addmm(bias, x, weight)


def _field_backward(
    record: _Record,
    i: int,
    activation: str,
    gap: Tensor,
    weights: list[Tensor],
    to_layers: list[Tensor],
    total: Tensor,
) -> None:
    """Adds to `total`, the gradient of the state after the step, what came through the field."""
    to_out = torch.mul(total, gap, out=to_layers[-1][i])
    for k in reversed(range(len(weights) - 1)):
        to_value = to_out @ weights[k + 1]
        to_out = to_layers[k][i]
        if activation == "silu":
            _aten.silu_backward.grad_input(to_value, record.arguments[k][i], grad_input=to_out)
        else:
            _aten.tanh_backward.grad_input(to_value, record.layers[k][i], grad_input=to_out)
    total.addmm_(to_out, weights[0])


def _gru_backward(
    record: _Record,
    i: int,
    n: int,
    h: Tensor,
    update: Tensor,
    recurrent: Tensor,
    to_new: Tensor,
    to_gate: Tensor,
) -> Tensor:
    """Fills the gradient of the gates; returns the one of h."""
    zr, candidate = record.gate[i], record.candidate[i]
    share = zr[:, :n] * update
    to_candidate = to_gate[:, 2 * n :]
    to_candidate.copy_(_aten.tanh_backward(to_new * share, candidate))
    to_reset_h = to_candidate @ recurrent[2 * n :]
    to_zr = torch.cat([to_new * (candidate - h) * update, to_reset_h * h], dim=1)
    to_gate[:, : 2 * n] = _aten.sigmoid_backward(to_zr, zr)
    to_h = torch.addcmul(to_new - to_new * share, to_reset_h, zr[:, n:])
    return to_h.addmm_(to_gate[:, : 2 * n], recurrent[: 2 * n])


def _product(to_out: Tensor, x: Tensor) -> Tensor:
    """(out, in) gradient of a weight: the sum over rows and batch, in one product."""
    return to_out.reshape(-1, to_out.shape[-1]).t() @ x.reshape(-1, x.shape[-1])
