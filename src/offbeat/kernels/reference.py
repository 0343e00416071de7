"""The reference body of the scan, in PyTorch: the loop over rows, written once.

decay -> flow over the gap -> (predictions are read here) -> cell at an observation
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import cast

import torch
from torch import Tensor
from torch.nn.functional import linear, silu

from offbeat.kernels.spec import (
    LARGEST_EXPONENT,
    Layers,
    ScanRows,
    ScanSpec,
    ScanWeights,
)
from offbeat.solvers import Field, solve, tableau


def scan(
    spec: ScanSpec, weights: ScanWeights, rows: ScanRows, state: Tensor
) -> tuple[Tensor, Tensor]:
    """Carries a batch of states over all rows; every combination, as `offbeat.kernels.scan`."""
    before: list[Tensor] = []
    after: list[Tensor] = []
    decays = _decays(spec, rows)
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
    nonlinearity = torch.tanh if activation == "tanh" else silu
    for i, (weight, bias) in enumerate(layers):
        x = linear(x, weight, bias)
        if i < len(layers) - 1:
            x = nonlinearity(x)
    return x


Decay = Tensor | tuple[Tensor, Tensor, Tensor] | None
"""Of one row: the factor of h, or (start, end, applied) where it acts step by step, or nothing."""


def decay_factors(spec: ScanSpec, rows: ScanRows) -> Tensor | None:
    """(rows, batch, hidden) what h is multiplied by at each row, for a decay that acts at once."""
    if rows.decay is None:
        return None
    if not spec.has_field:
        return torch.exp(rows.decay.applied - _exponent(rows.decay.end))
    return torch.exp(-_growth(rows.decay.end, rows.decay.applied))


def _decays(spec: ScanSpec, rows: ScanRows) -> Sequence[Decay]:
    """The decay of each row; where it acts at once, the factors of all rows in one go."""
    if rows.decay is None:
        return [None] * len(rows.gap)
    several_steps = spec.steps_per_gap > 1 or spec.max_step is not None
    if spec.has_field and (several_steps or tableau(spec.solver).adaptive):
        parts = (rows.decay.start, rows.decay.end, rows.decay.applied)
        return list(zip(*(part.unbind() for part in parts), strict=True))
    return cast(Tensor, decay_factors(spec, rows)).unbind()


def _fed_gate(
    spec: ScanSpec, weights: ScanWeights, rows: ScanRows, state: Tensor, i: int
) -> Tensor:
    if weights.feed is None or rows.fed_gates is None:
        raise ValueError("self-feeding needs ScanWeights.feed and ScanRows.fed_gates")
    hidden = state[:, spec.anchored : spec.anchored + spec.hidden_size]
    decoded = perceptron(weights.decoder, hidden, "tanh")
    return rows.fed_gates[i] + linear(decoded, weights.feed)


# --- over the gap ---------------------------------------------------------------------------------


def _carry(
    spec: ScanSpec, weights: ScanWeights, gap: Tensor, decay: Decay, state: Tensor
) -> Tensor:
    """Decay and flow of (x, h) over one gap; the memory of an LSTM stays."""
    if isinstance(decay, Tensor):
        state = _scale_hidden(spec, state, decay)
        decay = None
    if not spec.has_field:
        return state
    driven = spec.anchored + spec.hidden_size
    memory = state[:, driven:]
    state = state[:, :driven]
    state = _flow(spec, weights, gap, decay, state)
    return torch.cat([state, memory], dim=1) if memory.shape[1] else state


def _flow(
    spec: ScanSpec,
    weights: ScanWeights,
    gap: Tensor,
    decay: tuple[Tensor, Tensor, Tensor] | None,
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
    decay: tuple[Tensor, Tensor, Tensor],
    state: Tensor,
    steps: int | Tensor,
) -> Tensor:
    """Equal steps; the decay of each step comes before it (Lie splitting).

    With one step per gap and every row observed this is algorithm 3 of the thesis.
    """
    start, end, applied = decay
    most = steps if isinstance(steps, int) else int(steps.max())
    for k in range(1, most + 1):
        share = k / steps if isinstance(steps, int) else (k / steps).clamp_max(1.0).to(gap.dtype)
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
    decay: tuple[Tensor, Tensor, Tensor],
    state: Tensor,
) -> Tensor:
    """The limit of ever shorter split steps, adaptive: h = exp(-E(s)) u, solved for u."""
    start, end, applied = decay
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
    """A of `DecayRows`, bounded."""
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
