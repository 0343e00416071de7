"""The reference backend of the scan, in PyTorch: the loop over steps, written once.

decay -> dynamics over the gap -> (predictions are read here) -> cell at an observation
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import linear, silu

from offbeat.kernels.spec import (
    LARGEST_EXPONENT,
    Layers,
    ScanCell,
    ScanParts,
    ScanSpec,
    StepInputs,
    field_tensors,
)
from offbeat.ode import Field, solve, tableau

ACTIVATIONS: dict[str, Callable[[Tensor], Tensor]] = {"tanh": torch.tanh, "silu": silu}
"""Nonlinearities by name."""


def scan(
    spec: ScanSpec, parts: ScanParts, inputs: StepInputs, state: Tensor
) -> tuple[Tensor, Tensor]:
    """Propagates a batch of states over all steps, for any spec; see `offbeat.kernels.scan`."""
    before: list[Tensor] = []
    after: list[Tensor] = []
    decays = _decays(spec, parts, inputs)
    gates = _gates(spec, parts, inputs)
    each_gate = [None] * inputs.rows if gates is None else gates.unbind(1)
    gaps, updates = inputs.gap[..., None].unbind(1), inputs.update[..., None].unbind(1)
    shortest = inputs.rows if inputs.length is None else int(inputs.length.min())
    steps = zip(gaps, updates, decays, each_gate, strict=True)
    for i, (gap, update, decay, gate) in enumerate(steps):
        old = state
        if inputs.fed and inputs.fed[i]:
            gate = _fed_gate(spec, parts, inputs, state, i)
        state = _propagate(spec, parts, gap, decay, state)
        valid = None
        if i >= shortest and inputs.length is not None:
            valid = (inputs.length > i)[:, None]
            state = torch.where(valid, state, old)
        before.append(state)
        if parts.cell is not None and gate is not None:
            observed = (inputs.values[:, i], inputs.mask[:, i]) if spec.anchored else None
            updated = _update(spec, parts.cell, gate, update, observed, state)
            state = updated if valid is None else torch.where(valid, updated, state)
        after.append(state)
    return torch.stack(before, dim=1), torch.stack(after, dim=1)


def perceptron(layers: Layers, x: Tensor, activation: str) -> Tensor:
    """Applies linear layers with a nonlinearity between them, none after the last.

    Args:
        layers: weights and biases.
        x: (..., inputs).
        activation: name of the nonlinearity.

    Returns:
        (..., outputs).
    """
    nonlinearity = ACTIVATIONS[activation]
    for i, (weight, bias) in enumerate(layers):
        x = linear(x, weight, bias)
        if i < len(layers) - 1:
            x = nonlinearity(x)
    return x


# --- what does not depend on the state: for all steps at once -------------------------------------


def _gates(spec: ScanSpec, parts: ScanParts, inputs: StepInputs) -> Tensor | None:
    """(batch, rows, gates) input projection of the cell."""
    if parts.cell is None:
        return None
    shown = _decayed(parts, inputs) if spec.input_decay else inputs.values
    return parts.cell.project(_input(inputs, shown, slice(None)))


def _input(inputs: StepInputs, shown: Tensor, at: slice | int) -> Tensor:
    each = [shown, inputs.mask[:, at]]
    if inputs.time_input is not None:
        each.append(inputs.time_input[:, at])
    return torch.cat(each, dim=-1)


def _decayed(parts: ScanParts, inputs: StepInputs) -> Tensor:
    """x-hat of equation 27: the observed value, or the decayed last one."""
    if parts.input_decay is None:
        raise ValueError("input_decay needs ScanParts.input_decay")
    weight, bias = parts.input_decay
    mean = _given(inputs.mean)
    gamma = torch.exp(-(weight * _given(inputs.delta) + bias).clamp_min(0.0))
    x_hat = gamma * _given(inputs.last) + (1 - gamma) * mean
    return torch.where(inputs.mask > 0, inputs.values, x_hat)


@dataclass(frozen=True, eq=False)
class DecayAlongGap:
    """Exponents of the decay of h: over a gap, h is multiplied by exp(-(A(1) - applied)).

    A(s) = max(0, (1 - s) start + s end) for s from 0 to 1 over the gap (equation 26 along time).

    Attributes:
        start: (batch, hidden) before the maximum, at the start of the gap.
        end: (batch, hidden) before the maximum, at its end.
        applied: (batch, hidden) the part of A that has already been applied to the state.
    """

    start: Tensor
    end: Tensor
    applied: Tensor


Decay = Tensor | DecayAlongGap | None
"""Decay of a row: the factor of h, or exponents that are applied in each solver step, or None."""


def _decays(spec: ScanSpec, parts: ScanParts, inputs: StepInputs) -> Sequence[Decay]:
    """The decay of each row; factors are computed for all rows at once."""
    if not spec.decay:
        return [None] * inputs.rows
    if parts.decay is None:
        raise ValueError("a decay needs ScanParts.decay")
    end = linear(_given(inputs.decay_end), *parts.decay)
    if spec.decay_rows == "continuous":
        start = linear(_given(inputs.decay_start), *parts.decay)
        fresh = _given(inputs.updated)[..., None] > 0
        applied = torch.where(fresh, 0.0, start.clamp(0.0, LARGEST_EXPONENT))
    else:
        # The whole exponent at each step: it compounds over unobserved ones.
        if spec.decay_rows == "observed_rows":
            end = end * inputs.update[..., None]
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
        raise ValueError("the scan's inputs or parts lack a tensor that its spec needs")
    return tensor


def _fed_gate(
    spec: ScanSpec, parts: ScanParts, inputs: StepInputs, state: Tensor, i: int
) -> Tensor:
    assert parts.cell is not None
    hidden = state[:, spec.anchors : spec.anchors + spec.hidden_size]
    decoded = perceptron(parts.decoder, hidden, "tanh")
    return parts.cell.project(_input(inputs, decoded, i))


# --- over the gap ---------------------------------------------------------------------------------


def _propagate(
    spec: ScanSpec, parts: ScanParts, gap: Tensor, decay: Decay, state: Tensor
) -> Tensor:
    """Decay and dynamics of (x, h) over one gap; the memory of a cell does not change."""
    if isinstance(decay, Tensor):
        state = _scale_hidden(spec, state, decay)
        decay = None
    if not spec.field:
        return state
    driven = spec.anchors + spec.hidden_size
    memory = state[:, driven:]
    state = state[:, :driven]
    state = _solve(spec, parts, gap, decay, state)
    return torch.cat([state, memory], dim=1) if memory.shape[1] else state


def _solve(
    spec: ScanSpec,
    parts: ScanParts,
    gap: Tensor,
    decay: DecayAlongGap | None,
    state: Tensor,
) -> Tensor:
    vector_field = parts.field
    if vector_field is None:
        raise ValueError("a vector field needs ScanParts.field")

    def field(_: Tensor, y: Tensor) -> Tensor:
        return vector_field(y)

    scheme = tableau(spec.solver)
    parameters = list(field_tensors(vector_field)) if spec.adjoint else None
    if scheme.adaptive and decay is not None:
        return _solve_damped(spec, field, parameters, gap, decay, state)
    steps: int | Tensor = spec.steps_per_gap
    if spec.max_step is not None:
        steps = torch.ceil(gap / spec.max_step - 1e-6).clamp_min(spec.steps_per_gap).long()
    if decay is not None:
        return _solve_split(spec, field, parameters, gap, decay, state, steps)
    return solve(
        field,
        state,
        gap,
        scheme,
        steps=steps,
        most_steps=spec.most_steps,
        rtol=spec.rtol,
        atol=spec.atol,
        adjoint_parameters=parameters,
    )


def _solve_split(
    spec: ScanSpec,
    field: Field,
    parameters: Sequence[Tensor] | None,
    gap: Tensor,
    decay: DecayAlongGap,
    state: Tensor,
    steps: int | Tensor,
) -> Tensor:
    """Equal steps, each after its decay (Lie splitting).

    With one step per gap and every row observed this is algorithm 3 of the thesis.
    """
    start, end, applied = decay.start, decay.end, decay.applied
    most = steps if isinstance(steps, int) else spec.most_steps or int(steps.max())
    for k in range(1, most + 1):
        part = k / steps if isinstance(steps, int) else (k / steps.to(gap)).clamp_max(1.0)
        reached = start + part * (end - start)
        state = _scale_hidden(spec, state, torch.exp(-_growth(reached, applied)))
        applied = torch.maximum(applied, _exponent(reached))
        step = gap / steps
        if not isinstance(steps, int):
            step = torch.where(k <= steps, step, torch.zeros_like(step))
        state = solve(field, state, step, tableau(spec.solver), adjoint_parameters=parameters)
    return state


def _solve_damped(
    spec: ScanSpec,
    field: Field,
    parameters: Sequence[Tensor] | None,
    gap: Tensor,
    decay: DecayAlongGap,
    state: Tensor,
) -> Tensor:
    """The limit of short split steps, adaptive: h = exp(-E(s)) u, solved for u."""
    start, end, applied = decay.start, decay.end, decay.applied
    state = _scale_hidden(spec, state, torch.exp(-_growth(start, applied)))

    def exponent(s: Tensor) -> Tensor:
        # From `start` itself: the adjoint takes gradients for the tensors that it is given.
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
    return a.clamp(0.0, LARGEST_EXPONENT)


def _growth(a: Tensor, applied: Tensor) -> Tensor:
    """The growth of A beyond the part applied to the state; at least 0.

    A decay never increases the state, even if the flow changes it in between.
    """
    return (_exponent(a) - applied).clamp_min(0.0)


def _scale_hidden(spec: ScanSpec, state: Tensor, factor: Tensor) -> Tensor:
    """Multiplies h by a factor; does not change x and c."""
    if factor.shape == state.shape:
        return state * factor
    first, last = spec.anchors, spec.anchors + spec.hidden_size
    parts = [state[:, :first], state[:, first:last] * factor, state[:, last:]]
    return torch.cat(parts, dim=1)


# --- at an observation ----------------------------------------------------------------------------


def _update(
    spec: ScanSpec,
    cell: ScanCell,
    gate: Tensor,
    update: Tensor,
    observed: tuple[Tensor, Tensor] | None,
    state: Tensor,
) -> Tensor:
    """The state after an observation; x of an anchored state takes the observed values."""
    if observed is None:
        return cell.step(gate, state, update)
    x, rest = state[:, : spec.anchors], state[:, spec.anchors :]
    value, mask = observed
    if cell.innovation is not None:
        gate = torch.addmm(gate, mask * (value - x), cell.innovation.t())
    rest = cell.step(gate, rest, update)
    return torch.cat([torch.lerp(x, value, mask), rest], dim=1)
