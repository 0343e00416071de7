"""The reference body of the scan, in PyTorch: the loop over rows, written once.

    decay -> flow over the gap -> (predictions are read here) -> cell at an observation
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor

from offbeat.kernels.spec import (
    LARGEST_EXPONENT,
    DecayRows,
    Layers,
    ScanRows,
    ScanSpec,
    ScanWeights,
)
from offbeat.solvers import solve, tableau

def scan(
    spec: ScanSpec, weights: ScanWeights, rows: ScanRows, state: Tensor
) -> tuple[Tensor, Tensor]:
    """Carries a batch of states over all rows.

    Args:
        spec: the shape of the scan.
        weights: what meets the state.
        rows: what is read at each row.
        state: (batch, state_size) before the first row.

    Returns:
        Two tensors (rows, batch, state_size): the state carried to each row, before anything is
        observed there, and the state after the row.
    """
    before: list[Tensor] = []
    after: list[Tensor] = []
    decays = _unbind_decay(rows.decay, len(rows.gap))
    gates, updates, gaps = rows.gates.unbind(), rows.update.unbind(), rows.gap.unbind()
    for i, (gap, gate, update, decay) in enumerate(zip(gaps, gates, updates, decays, strict=True)):
        if rows.fed and rows.fed[i]:
            gate = _fed_gate(spec, weights, rows, state, i)
        state = _carry(spec, weights, gap, decay, state)
        before.append(state)
        if spec.cell != "none":
            observed = None
            if rows.values is not None and rows.mask is not None:
                observed = (rows.values[i], rows.mask[i])
            state = _update(spec, weights, gate, update, observed, state)
        after.append(state)
    return torch.stack(before), torch.stack(after)


def perceptron(layers: Layers, x: Tensor, activation: str) -> Tensor:
    """Applies linear layers with a nonlinearity between them, none after the last."""
    nonlinearity = torch.tanh if activation == "tanh" else F.silu
    for i, (weight, bias) in enumerate(layers):
        x = F.linear(x, weight, bias)
        if i < len(layers) - 1:
            x = nonlinearity(x)
    return x


def _unbind_decay(
    decay: DecayRows | None, rows: int
) -> Sequence[tuple[Tensor, Tensor, Tensor] | None]:
    if decay is None:
        return [None] * rows
    return list(
        zip(decay.start.unbind(), decay.end.unbind(), decay.applied.unbind(), strict=True)
    )


def _fed_gate(
    spec: ScanSpec, weights: ScanWeights, rows: ScanRows, state: Tensor, i: int
) -> Tensor:
    if weights.feed is None or rows.fed_gates is None:
        raise ValueError("self-feeding needs ScanWeights.feed and ScanRows.fed_gates")
    hidden = state[:, spec.anchored : spec.anchored + spec.hidden_size]
    decoded = perceptron(weights.decoder, hidden, "tanh")
    return rows.fed_gates[i] + F.linear(decoded, weights.feed)


# --- over the gap ---------------------------------------------------------------------------------


def _carry(
    spec: ScanSpec,
    weights: ScanWeights,
    gap: Tensor,
    decay: tuple[Tensor, Tensor, Tensor] | None,
    state: Tensor,
) -> Tensor:
    """Decay and flow of (x, h) over one gap; the memory of an LSTM stays."""
    if not spec.has_field:
        if decay is None:
            return state
        _, end, applied = decay
        return _damp(spec, state, _exponent(end) - applied)
    driven = spec.anchored + spec.hidden_size
    memory = state[:, driven:]
    state = state[:, :driven]

    def field(_: Tensor, y: Tensor) -> Tensor:
        return perceptron(weights.field, y, spec.activation)

    parameters = [p for layer in weights.field for p in layer] if spec.adjoint else None
    if tableau(spec.solver).adaptive:
        state = _flow_adaptive(spec, field, parameters, gap, decay, state)
    else:
        state = _flow_fixed(spec, field, parameters, gap, decay, state)
    return torch.cat([state, memory], dim=1) if memory.shape[1] else state


def _flow_fixed(spec, field, parameters, gap, decay, state):  # type: ignore[no-untyped-def]
    """Equal steps; the decay of each step comes before it (Lie splitting).

    With one step per gap and every row observed this is algorithm 3 of the thesis.
    """
    scheme = tableau(spec.solver)
    steps: int | Tensor = spec.steps_per_gap
    if spec.max_step is not None:
        steps = torch.ceil(gap / spec.max_step - 1e-6).clamp_min(spec.steps_per_gap).long()
    if decay is None:
        return solve(field, state, gap, scheme, steps=steps, adjoint_parameters=parameters)
    start, end, applied = decay
    most = steps if isinstance(steps, int) else int(steps.max())
    for k in range(1, most + 1):
        share = k / steps if isinstance(steps, int) else (k / steps).clamp_max(1.0).to(gap.dtype)
        reached = _exponent(end if most == 1 else start + share * (end - start))
        # Only ever downwards: a state that the flow has meanwhile moved is not blown up again.
        state = _damp(spec, state, (reached - applied).clamp_min(0))
        applied = torch.maximum(applied, reached)
        step = gap / steps
        if not isinstance(steps, int):
            step = torch.where(k <= steps, step, torch.zeros_like(step))
        state = solve(field, state, step, scheme, adjoint_parameters=parameters)
    return state


def _flow_adaptive(spec, field, parameters, gap, decay, state):  # type: ignore[no-untyped-def]
    """The limit of ever shorter split steps: h = exp(-E(s)) u, solved for u."""
    options = {"rtol": spec.rtol, "atol": spec.atol}
    scheme = tableau(spec.solver)
    if decay is None:
        return solve(field, state, gap, scheme, adjoint_parameters=parameters, **options)
    start, end, applied = decay
    at_start = _exponent(start)
    state = _damp(spec, state, (at_start - applied).clamp_min(0))

    def exponent(s: Tensor) -> Tensor:
        return (_exponent(start + s * (end - start)) - at_start).clamp_min(0)

    def damped_field(s: Tensor, u: Tensor) -> Tensor:
        grown = exponent(s)
        return _damp(spec, field(s, _damp(spec, u, grown)), -grown)

    if parameters is not None:
        parameters = [*parameters, start, end]
    state = solve(damped_field, state, gap, scheme, adjoint_parameters=parameters, **options)
    return _damp(spec, state, exponent(torch.ones_like(gap)))


def _exponent(a: Tensor) -> Tensor:
    return a.clamp(0, LARGEST_EXPONENT)


def _damp(spec: ScanSpec, state: Tensor, exponent: Tensor) -> Tensor:
    """Multiplies h by exp(-exponent), and leaves x and c."""
    factor = torch.exp(-exponent)
    if factor.shape == state.shape:
        return state * factor
    first, last = spec.anchored, spec.anchored + spec.hidden_size
    parts = [state[:, :first], state[:, first:last] * factor, state[:, last:]]
    return torch.cat(parts, dim=1)


# --- at an observation ----------------------------------------------------------------------------


def _update(
    spec: ScanSpec,
    weights: ScanWeights,
    gate: Tensor,
    update: Tensor,
    observed: tuple[Tensor, Tensor] | None,
    state: Tensor,
) -> Tensor:
    if observed is None:
        return _cell(spec, weights, gate, update, state)
    x, rest = state[:, : spec.anchored], state[:, spec.anchored :]
    value, mask = observed
    if weights.innovation is not None:
        gate = torch.addmm(gate, mask * (value - x), weights.innovation.t())
    rest = _cell(spec, weights, gate, update, rest)
    return torch.cat([torch.lerp(x, value, mask), rest], dim=1)


def _cell(
    spec: ScanSpec, weights: ScanWeights, gate: Tensor, update: Tensor, state: Tensor
) -> Tensor:
    """The new (h, c) where `update` is 1; exactly the old one where it is 0."""
    if spec.cell == "set":
        return torch.lerp(state, gate, update)
    if weights.recurrent is None:
        raise ValueError(f"the cell {spec.cell!r} needs ScanWeights.recurrent")
    n = spec.hidden_size
    h = state[:, :n]
    recurrent = weights.recurrent
    if spec.cell == "elman":  # equation 6
        return torch.lerp(h, torch.tanh(torch.addmm(gate, h, recurrent.t())), update)
    if spec.cell == "lstm":  # equations 14-19
        forget, insert, node, output = torch.addmm(gate, h, recurrent.t()).chunk(4, dim=1)
        c = torch.sigmoid(forget) * state[:, n:] + torch.sigmoid(insert) * torch.tanh(node)
        new = torch.cat([torch.sigmoid(output) * torch.tanh(c), c], dim=1)
        return torch.lerp(state, new, update)
    # equations 20-23, and 29-32 with the gates of GRU-D
    z, r = torch.sigmoid(torch.addmm(gate[:, : 2 * n], h, recurrent[: 2 * n].t())).chunk(2, dim=1)
    if spec.reset_after:
        product = torch.addmm(weights.recurrent_bias, h, recurrent[2 * n :].t())  # type: ignore[arg-type]
        candidate = torch.tanh(gate[:, 2 * n :] + r * product)
    else:
        candidate = torch.tanh(torch.addmm(gate[:, 2 * n :], r * h, recurrent[2 * n :].t()))
    return torch.lerp(h, candidate, z * update)
