"""The reference backend of the scan, in PyTorch: the loop over rows, written once.

decay -> flow over the gap -> (predictions are read here) -> cell at an observation
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import linear, silu

from offbeat.kernels.spec import (
    LARGEST_EXPONENT,
    Layers,
    ScanSpec,
    ScanWeights,
    StepInputs,
)
from offbeat.ode import Field, solve, tableau


def scan(
    spec: ScanSpec, weights: ScanWeights, rows: StepInputs, state: Tensor
) -> tuple[Tensor, Tensor]:
    """Carries a batch of states over all rows; every combination, as `offbeat.kernels.scan`."""
    before: list[Tensor] = []
    after: list[Tensor] = []
    decays = _decays(spec, weights, rows)
    gates = _gates(spec, weights, rows)
    gaps, updates = rows.gap[..., None].unbind(1), rows.update[..., None].unbind(1)
    shortest = rows.rows if rows.length is None else int(rows.length.min())
    for i, (gap, update, decay) in enumerate(zip(gaps, updates, decays, strict=True)):
        old = state
        gate = gates[:, i] if gates is not None else None
        if rows.fed and rows.fed[i]:
            gate = _fed_gate(spec, weights, rows, state, i)
        state = _carry(spec, weights, gap, decay, state)
        alive = None
        if i >= shortest and rows.length is not None:
            alive = (rows.length > i)[:, None]
            state = torch.where(alive, state, old)
        before.append(state)
        if spec.cell != "none" and gate is not None:
            observed = (rows.values[:, i], rows.mask[:, i]) if spec.anchored else None
            updated = _update(spec, weights, gate, update, observed, state)
            state = updated if alive is None else torch.where(alive, updated, state)
        after.append(state)
    return torch.stack(before, dim=1), torch.stack(after, dim=1)


def perceptron(layers: Layers, x: Tensor, activation: str) -> Tensor:
    """Applies linear layers with a nonlinearity between them, none after the last."""
    nonlinearity = torch.tanh if activation == "tanh" else silu
    for i, (weight, bias) in enumerate(layers):
        x = linear(x, weight, bias)
        if i < len(layers) - 1:
            x = nonlinearity(x)
    return x


# --- what does not depend on the state: for all rows at once --------------------------------------


def _gates(spec: ScanSpec, weights: ScanWeights, rows: StepInputs) -> Tensor | None:
    """(batch, rows, gates) input projection of the cell."""
    if spec.cell == "none":
        return None
    shown = rows.values
    if spec.input_decay:
        shown = _faded(weights, rows)
    return linear(_input(rows, shown, slice(None)), _given(weights.inputs), weights.bias)


def _input(rows: StepInputs, shown: Tensor, at: slice | int) -> Tensor:
    parts = [shown, rows.mask[:, at]]
    if rows.age is not None:
        parts.append(rows.age[:, at])
    return torch.cat(parts, dim=-1)


def _faded(weights: ScanWeights, rows: StepInputs) -> Tensor:
    """x-hat of equation 27: the observed value, or what is left of the last one."""
    if weights.input_decay is None:
        raise ValueError("input_decay needs ScanWeights.input_decay")
    weight, bias = weights.input_decay
    mean = _given(rows.mean)
    gamma = torch.exp(-(weight * _given(rows.delta) + bias).clamp_min(0))
    return torch.where(rows.mask > 0, rows.values, gamma * _given(rows.last) + (1 - gamma) * mean)


@dataclass(frozen=True, eq=False)
class DecayAlongGap:
    """Exponents of the decay of h: over a gap, h is multiplied by exp(-(A(1) - applied)).

    A(s) = max(0, (1 - s) start + s end) for s from 0 to 1 over the gap (equation 26 along time).

    Attributes:
        start: (batch, hidden) before the maximum, at the start of the gap.
        end: (batch, hidden) before the maximum, at its end.
        applied: (batch, hidden) what of A the state already carries.
    """

    start: Tensor
    end: Tensor
    applied: Tensor


Decay = Tensor | DecayAlongGap | None
"""Of one row: the factor of h, or the exponents where they act step by step, or nothing."""


def _decays(spec: ScanSpec, weights: ScanWeights, rows: StepInputs) -> Sequence[Decay]:
    """The decay of each row; where it acts at once, the factors of all rows in one go."""
    if not spec.decay:
        return [None] * rows.rows
    if weights.decay is None:
        raise ValueError("a decay needs ScanWeights.decay")
    end = linear(_given(rows.decay_end), *weights.decay)
    if spec.decay_rows == "continuous":
        start = linear(_given(rows.decay_start), *weights.decay)
        fresh = _given(rows.updated)[..., None] > 0
        applied = torch.where(fresh, 0.0, start.clamp(0, LARGEST_EXPONENT))
    else:
        # The whole exponent again: at each row it compounds over hidden ones.
        if spec.decay_rows == "observed_rows":
            end = end * rows.update[..., None]
        start, applied = end, torch.zeros_like(end)
    several_steps = spec.steps_per_gap > 1 or spec.max_step is not None
    if spec.field and (several_steps or tableau(spec.solver).adaptive):
        each = zip(start.unbind(1), end.unbind(1), applied.unbind(1), strict=True)
        return [DecayAlongGap(*exponents) for exponents in each]
    if not spec.field:
        return torch.exp(applied - _exponent(end)).unbind(1)
    return torch.exp(-_growth(end, applied)).unbind(1)


def _given(tensor: Tensor | None) -> Tensor:
    if tensor is None:
        raise ValueError("the scan's rows or weights lack what its spec asks for")
    return tensor


def _fed_gate(
    spec: ScanSpec, weights: ScanWeights, rows: StepInputs, state: Tensor, i: int
) -> Tensor:
    hidden = state[:, spec.anchors : spec.anchors + spec.hidden_size]
    decoded = perceptron(weights.decoder, hidden, "tanh")
    return linear(_input(rows, decoded, i), _given(weights.inputs), weights.bias)


# --- over the gap ---------------------------------------------------------------------------------


def _carry(
    spec: ScanSpec, weights: ScanWeights, gap: Tensor, decay: Decay, state: Tensor
) -> Tensor:
    """Decay and flow of (x, h) over one gap; the memory of an LSTM stays."""
    if isinstance(decay, Tensor):
        state = _scale_hidden(spec, state, decay)
        decay = None
    if not spec.field:
        return state
    driven = spec.anchors + spec.hidden_size
    memory = state[:, driven:]
    state = state[:, :driven]
    state = _flow(spec, weights, gap, decay, state)
    return torch.cat([state, memory], dim=1) if memory.shape[1] else state


def _flow(
    spec: ScanSpec,
    weights: ScanWeights,
    gap: Tensor,
    decay: DecayAlongGap | None,
    state: Tensor,
) -> Tensor:
    def field(_: Tensor, y: Tensor) -> Tensor:
        return perceptron(weights.field, y, spec.activation)

    scheme = tableau(spec.solver)
    parameters = [p for layer in weights.field for p in layer] if spec.adjoint else None
    if scheme.adaptive and decay is not None:
        return _flow_damped(spec, field, parameters, gap, decay, state)
    steps: int | Tensor = spec.steps_per_gap
    if spec.max_step is not None:
        steps = torch.ceil(gap / spec.max_step - 1e-6).clamp_min(spec.steps_per_gap).long()
    if decay is not None:
        return _flow_split(spec, field, parameters, gap, decay, state, steps)
    return solve(
        field,
        state,
        gap,
        scheme,
        steps=steps,
        rtol=spec.rtol,
        atol=spec.atol,
        adjoint_parameters=parameters,
    )


def _flow_split(
    spec: ScanSpec,
    field: Field,
    parameters: Sequence[Tensor] | None,
    gap: Tensor,
    decay: DecayAlongGap,
    state: Tensor,
    steps: int | Tensor,
) -> Tensor:
    """Equal steps; the decay of each step comes before it (Lie splitting).

    With one step per gap and every row observed this is algorithm 3 of the thesis.
    """
    start, end, applied = decay.start, decay.end, decay.applied
    most = steps if isinstance(steps, int) else int(steps.max())
    for k in range(1, most + 1):
        share = k / steps if isinstance(steps, int) else (k / steps.to(gap)).clamp_max(1.0)
        reached = start + share * (end - start)
        state = _scale_hidden(spec, state, torch.exp(-_growth(reached, applied)))
        applied = torch.maximum(applied, _exponent(reached))
        step = gap / steps
        if not isinstance(steps, int):
            step = torch.where(k <= steps, step, torch.zeros_like(step))
        state = solve(field, state, step, tableau(spec.solver), adjoint_parameters=parameters)
    return state


def _flow_damped(
    spec: ScanSpec,
    field: Field,
    parameters: Sequence[Tensor] | None,
    gap: Tensor,
    decay: DecayAlongGap,
    state: Tensor,
) -> Tensor:
    """The limit of ever shorter split steps, adaptive: h = exp(-E(s)) u, solved for u."""
    start, end, applied = decay.start, decay.end, decay.applied
    state = _scale_hidden(spec, state, torch.exp(-_growth(start, applied)))

    def exponent(s: Tensor) -> Tensor:
        # From `start` itself: the adjoint knows the tensors it is given, not what was made of them.
        return _growth(start + s * (end - start), _exponent(start))

    def damped_field(s: Tensor, u: Tensor) -> Tensor:
        grown = exponent(s)
        h = _scale_hidden(spec, u, torch.exp(-grown))
        return _scale_hidden(spec, field(s, h), torch.exp(grown))

    if parameters is not None:
        parameters = [*parameters, start, end]
    u = solve(
        damped_field,
        state,
        gap,
        tableau(spec.solver),
        rtol=spec.rtol,
        atol=spec.atol,
        adjoint_parameters=parameters,
    )
    return _scale_hidden(spec, u, torch.exp(-exponent(torch.ones_like(gap))))


def _exponent(a: Tensor) -> Tensor:
    """A of `DecayAlongGap`, bounded."""
    return a.clamp(0, LARGEST_EXPONENT)


def _growth(a: Tensor, applied: Tensor) -> Tensor:
    """How far A has grown past what the state carries; never less than 0.

    A decay only ever shrinks: a state that the flow has meanwhile moved is not blown up again.
    """
    return (_exponent(a) - applied).clamp_min(0)


def _scale_hidden(spec: ScanSpec, state: Tensor, factor: Tensor) -> Tensor:
    """Multiplies h, and leaves x and c."""
    if factor.shape == state.shape:
        return state * factor
    first, last = spec.anchors, spec.anchors + spec.hidden_size
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
    x, rest = state[:, : spec.anchors], state[:, spec.anchors :]
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
        product = torch.addmm(_given(weights.recurrent_bias), h, recurrent[2 * n :].t())
        candidate = torch.tanh(gate[:, 2 * n :] + r * product)
    else:
        candidate = torch.tanh(torch.addmm(gate[:, 2 * n :], r * h, recurrent[2 * n :].t()))
    return torch.lerp(h, candidate, z * update)
