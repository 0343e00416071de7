"""The reference backend of the scan, in PyTorch: the loop over steps, written once.

decay -> dynamics over the gap -> (predictions are read here) -> cell at an observation
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from math import factorial
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import linear, silu

from offbeat.kernels.spec import (
    HIDDEN_LIMIT,
    LARGEST_EXPONENT,
    TRACKED_NODES,
    Layers,
    ScanCell,
    ScanParts,
    ScanSpec,
    StepInputs,
    field_tensors,
)
from offbeat.ode import Field, solve, tableau

TERMS = 14
"""Terms of a power series, up to 0.5, to the precision of float64."""

ACTIVATIONS: dict[str, Callable[[Tensor], Tensor]] = {"tanh": torch.tanh, "silu": silu}
"""Nonlinearities by name."""


def scan(
    spec: ScanSpec, parts: ScanParts, inputs: StepInputs, state: Tensor
) -> tuple[Tensor, Tensor]:
    """Propagates a batch of states over all steps, for any spec; see `offbeat.kernels.scan`."""
    before: list[Tensor] = []
    after: list[Tensor] = []
    dynamics = _Dynamics.of(spec, parts, inputs)
    nodes = _Nodes.of(spec, parts, inputs) if spec.nodes else None
    decays = _decays(spec, parts, inputs) if nodes is None else [None] * inputs.rows
    gates = _gates(spec, parts, inputs)
    each_gate = [None] * inputs.rows if gates is None else gates.unbind(1)
    gaps, updates = inputs.gap[..., None].unbind(1), inputs.update[..., None].unbind(1)
    known = inputs.known_steps
    shortest = inputs.rows
    if inputs.length is not None:
        shortest = int(inputs.length.min()) if known is None else known.shortest
    steps = zip(gaps, updates, decays, each_gate, strict=True)
    for i, (gap, update, decay, gate) in enumerate(steps):
        old = state
        if inputs.fed and inputs.fed[i]:
            gate = _fed_gate(spec, parts, inputs, state, i)
        if nodes is None:
            arrived = _propagate(dynamics, gap, decay, state)
        else:
            state, arrived = nodes.propagate(dynamics, i, state)
        valid = None
        if i >= shortest and inputs.length is not None:
            valid = (inputs.length > i)[:, None]
            arrived, state = torch.where(valid, arrived, old), torch.where(valid, state, old)
        before.append(arrived)
        updated = arrived
        if parts.cell is not None and gate is not None:
            observed = _Observed.of(spec, inputs, i) if spec.anchored else None
            updated = _update(dynamics, parts.cell, gate, update, observed, arrived)
            updated = updated if valid is None else torch.where(valid, updated, arrived)
        state = updated if nodes is None else torch.where(nodes.commit[i], updated, state)
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
    if inputs.low is not None and inputs.high is not None:
        each = spec.channels
        shown = torch.clamp(shown, inputs.low[:each], inputs.high[:each])
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


@dataclass(frozen=True, eq=False)
class _Dynamics:
    """The vector field of a scan, and the range that it keeps the state in.

    Attributes:
        spec: of the scan.
        field: the vector field of (x, h), or None.
        parameters: for the adjoint method, else None.
        low: (driven,) lower bounds of (x, h), or None.
        high: (driven,) upper bounds.
        numbers: the constants of a step as tensors, for tracing: the exporter rounds numbers inside
            of a loop to single precision.
        trend: the tensors of `ScanParts.trend`, or None.
        series: coefficients of (1 - exp(-z)) / z around 0, as numbers or tensors.
    """

    spec: ScanSpec
    field: Field | None
    parameters: Sequence[Tensor] | None
    low: Tensor | None
    high: Tensor | None
    numbers: Mapping[float, Tensor]
    trend: tuple[Tensor, Tensor, Tensor] | None = None
    series: Sequence[Any] = ()

    @classmethod
    def of(cls, spec: ScanSpec, parts: ScanParts, inputs: StepInputs) -> _Dynamics:
        low = high = None
        if spec.bounded:
            hidden = inputs.gap.new_full((spec.hidden_size,), HIDDEN_LIMIT)
            low, high = -hidden, hidden
            if spec.anchored:
                low = torch.cat([_given(inputs.low), low])
                high = torch.cat([_given(inputs.high), high])
        trend = parts.trend if spec.trend else None
        series: Sequence[Any] = [(-1.0) ** m / factorial(m + 1) for m in range(TERMS)]
        if spec.loops:
            series = [torch.tensor(c, dtype=torch.float64) for c in series]
        if not spec.field:
            return cls(spec, None, None, low, high, {}, trend, series)
        vector_field = parts.field
        if vector_field is None:
            raise ValueError("a vector field needs ScanParts.field")

        # An adaptive solver integrates the trend with the field, so that its error is controlled.
        within = trend if tableau(spec.solver).adaptive else None

        def field(_: Tensor, y: Tensor) -> Tensor:
            moved = y
            if low is not None and high is not None:
                y = _clamped(y, low, high)
            slope = vector_field(y)
            if within is None:
                return slope
            v = moved[:, spec.channels : spec.anchors]
            along = [v, -within[0] * v, torch.zeros_like(moved[:, spec.anchors :])]
            return slope + torch.cat(along, dim=1)

        parameters = None
        if spec.adjoint:
            parameters = [*field_tensors(vector_field), *(within or ())[:1]]
        numbers = {}
        if spec.loops:
            scheme = tableau(spec.solver)
            each = {w for row in (*scheme.a, scheme.b) for w in row}
            numbers = {w: torch.tensor(w, dtype=torch.float64) for w in each}
        return cls(spec, field, parameters, low, high, numbers, trend, series)

    def along_trend(self, state: Tensor, span: Tensor) -> Tensor:
        """The state after a damped trend over (batch, 1) `span`; x does not leave its range.

        The steps are split (Lie), exactly for the trend alone.
        """
        if self.trend is None or (self.field and tableau(self.spec.solver).adaptive):
            return state
        n, damping = self.spec.channels, self.trend[0]
        x, v = state[:, :n], state[:, n : 2 * n]
        z = damping * span
        kept, near = torch.exp(-z), z < 0.5
        close: Any = self.series[-1]
        for c in reversed(self.series[:-1]):
            close = close * torch.where(near, z, 0.0) + c
        far = (1.0 - kept) / torch.where(near, 1.0, z)
        moved = x + span * torch.where(near, close, far) * v
        if self.low is not None and self.high is not None:
            moved = _stopped(x, moved, self.low[:n], self.high[:n])
        return torch.cat([moved, kept * v, state[:, 2 * n :]], dim=1)

    def step(self, state: Tensor, span: Tensor) -> Tensor:
        """One step of the solver, or as many as an adaptive one needs, of (batch, 1) `span`."""
        state = self.along_trend(state, span)
        if self.field is None:
            return state
        spec = self.spec
        if spec.loops:
            return self.within(state, self._traced_step(self.field, state, span))
        moved = solve(
            self.field,
            state,
            span,
            tableau(spec.solver),
            rtol=spec.rtol,
            atol=spec.atol,
            adjoint_parameters=self.parameters,
        )
        return self.within(state, moved)

    def _traced_step(self, field: Field, y: Tensor, span: Tensor) -> Tensor:
        """One step with weights from `numbers`."""
        scheme = tableau(self.spec.solver)
        slopes: list[Tensor] = []
        for weights in (*scheme.a, scheme.b):
            state = y
            for slope, weight in zip(slopes, weights, strict=True):
                if weight != 0:
                    state = state + span * (slope * self.numbers[weight])
            if len(slopes) == len(scheme.b):
                break
            slopes.append(field(span, state))
        return state

    def within(self, state: Tensor, moved: Tensor) -> Tensor:
        """`moved`, stopped where it leaves the range; outside of it, it can only move back."""
        if self.low is None or self.high is None:
            return moved
        return _stopped(state, moved, self.low, self.high)


def _stopped(old: Tensor, moved: Tensor, low: Tensor, high: Tensor) -> Tensor:
    least = torch.where(old < low, old, low)
    most = torch.where(old > high, old, high)
    moved = torch.where(moved < least, least, moved)
    return torch.where(moved > most, most, moved)


def _clamped(y: Tensor, low: Tensor, high: Tensor) -> Tensor:
    """`y` within its range, with no gradient at and beyond its ends."""
    inside = (y > low) & (y < high)
    return torch.where(inside, y, torch.clamp(y.detach(), low, high))


@dataclass(frozen=True, eq=False)
class _Nodes:
    """The steps to each row over the nodes of the solver, and from the last of them to the row.

    Attributes:
        first: per row (batch, 1) the number of the node that the state has reached.
        last: per row (batch, 1) the number of the last node before the row.
        rest: per row (batch, 1) model time from there to the row.
        whole: per row the largest number of steps from node to node.
        read: per row whether a step from the last node to the row is needed.
        commit: per row (batch, 1) True where the state of the row is kept.
        decay: per row the exponents, or None: at the last observed row, `decay_span` later
            (batch, hidden), and (batch, 1) 1.0 where the cell acted at that row.
    """

    first: Sequence[Tensor]
    last: Sequence[Tensor]
    rest: Sequence[Tensor]
    whole: Sequence[int]
    read: Sequence[bool]
    commit: Sequence[Tensor]
    decay: Sequence[tuple[Tensor, Tensor, Tensor]] | None

    @classmethod
    def of(cls, spec: ScanSpec, parts: ScanParts, inputs: StepInputs) -> _Nodes:
        first, last, commit = (
            _given(tensor)[..., None] for tensor in (inputs.first_node, inputs.node, inputs.commit)
        )
        decay = None
        if spec.decay:
            if parts.decay is None:
                raise ValueError("a decay needs ScanParts.decay")
            start = linear(_given(inputs.decay_start), *parts.decay)
            end = linear(_given(inputs.decay_end), *parts.decay)
            fresh = _given(inputs.updated)[..., None]
            each = zip(start.unbind(1), end.unbind(1), fresh.unbind(1), strict=True)
            decay = list(each)
        whole: Sequence[int] = [0] * inputs.rows
        read: Sequence[bool] = [True] * inputs.rows
        if inputs.known_steps is not None and spec.max_step is not None:
            whole, read = inputs.known_steps.whole, inputs.known_steps.read
        elif spec.max_step is not None and not spec.loops:
            whole = [int(n) for n in (last - first).amax(dim=(0, 2)).tolist()]
            needed = inputs.gap > 0
            if spec.decay:  # after an update, the whole exponent is still to be applied
                needed = needed | ((_given(inputs.node) == 0) & (_given(inputs.updated) > 0))
            read = needed.any(dim=0).tolist()
        return cls(
            first.unbind(1),
            last.unbind(1),
            inputs.gap[..., None].unbind(1),
            whole,
            read,
            (commit > 0).unbind(1),
            decay,
        )

    def propagate(self, dynamics: _Dynamics, i: int, state: Tensor) -> tuple[Tensor, Tensor]:
        """The state of the last node before row `i`, and the state at the row."""
        spec, first, last = dynamics.spec, self.first[i], self.last[i]
        driven = spec.anchors + spec.hidden_size
        memory, y = state[:, driven:], state[:, :driven]
        decay = None if self.decay is None else self.decay[i]
        applied = None if decay is None else _applied(spec, *decay, first)
        length = torch.ones_like(first) * (spec.max_step or 1.0)
        unit = torch.ones_like(first) * spec.decay_span
        none = torch.zeros_like(first)

        def step(node: Tensor, y: Tensor, *applied: Tensor) -> tuple[Tensor, ...]:
            active = node < last
            if self.whole[i] > TRACKED_NODES:
                cut = (last - node == TRACKED_NODES) & (node > first)
                y = torch.where(cut, y.detach(), y)
                applied = tuple(torch.where(cut, each.detach(), each) for each in applied)
            span = torch.where(active, length, none)
            if decay is not None:
                since = (node + 1) * length / unit
                reached = _exponent(decay[0] + since * (decay[1] - decay[0]))
                grown = torch.where(active, (reached - applied[0]).clamp_min(0.0), 0.0)
                y = _scale_hidden(spec, y, torch.exp(-grown))
                reached = torch.where(active, torch.maximum(applied[0], reached), applied[0])
                applied = (reached,)
            return (node + 1, dynamics.step(y, span), *applied)

        carried: tuple[Tensor, ...] = (first, y) if applied is None else (first, y, applied)
        if spec.loops:
            carried = _while(lambda node, *_: (node < last).any(), step, carried)
        for _ in range(self.whole[i]):
            carried = step(*carried)
        node_state, applied = carried[1], carried[2] if decay is not None else None
        if not self.read[i]:
            arrived = node_state
        elif decay is None:
            arrived = dynamics.step(node_state, self.rest[i])
        else:
            assert applied is not None
            arrived = self._read(dynamics, i, node_state, decay, applied)
        if memory.shape[1]:
            node_state = torch.cat([node_state, memory], dim=1)
            arrived = torch.cat([arrived, memory], dim=1)
        return node_state, arrived

    def _read(
        self,
        dynamics: _Dynamics,
        i: int,
        y: Tensor,
        decay: tuple[Tensor, Tensor, Tensor],
        applied: Tensor,
    ) -> Tensor:
        """The step from the last node to row `i` with its decay."""
        spec, rest = dynamics.spec, self.rest[i]
        start, end, _ = decay
        reached = _along(spec, start, end, self.last[i], rest)
        if spec.field and tableau(spec.solver).adaptive:
            # The adjoint takes gradients for both ends, so one must not be computed from the other.
            along = DecayAlongGap(start.clone(), reached, applied)
            return _solve_damped(dynamics, rest, along, y)
        y = _scale_hidden(spec, y, torch.exp(-_growth(reached, applied)))
        return dynamics.step(y, rest)


def _along(spec: ScanSpec, start: Tensor, end: Tensor, node: Tensor, rest: Tensor) -> Tensor:
    """The exponent `rest` after a node, before the maximum."""
    since = node * (spec.max_step or 1.0) + rest
    return start + since / spec.decay_span * (end - start)


def _applied(spec: ScanSpec, start: Tensor, end: Tensor, fresh: Tensor, node: Tensor) -> Tensor:
    """The part of the exponent that has been applied to the state of a node.

    It is the largest exponent of the nodes so far: of the last one if it grows, else of the first.
    After an update of the cell, nothing of it has been applied.
    """
    none = torch.zeros_like(node)
    last = _along(spec, start, end, node, none)
    first = torch.where(fresh > 0, _along(spec, start, end, none + 1, none), start)
    along = torch.where(end >= start, last, first)
    before = torch.where(fresh > 0, torch.zeros_like(start), _exponent(start))
    return torch.where(node > 0, _exponent(along), before)


def _while(
    condition: Callable[..., Tensor],
    step: Callable[..., tuple[Tensor, ...]],
    carried: tuple[Tensor, ...],
) -> tuple[Tensor, ...]:
    """A loop that the exporter keeps as a loop."""
    if torch.compiler.is_exporting():
        from torch._higher_order_ops.while_loop import while_loop

        # Export would make the sizes inside of the loop variables.
        with torch._dynamo.config.patch(
            assume_static_by_default=True, automatic_dynamic_shapes=False
        ):
            found: tuple[Tensor, ...] = while_loop(condition, step, carried)  # type: ignore[no-untyped-call]
            return found
    while bool(condition(*carried)):
        carried = step(*carried)
    return carried


def _propagate(dynamics: _Dynamics, gap: Tensor, decay: Decay, state: Tensor) -> Tensor:
    """Decay and dynamics of (x, h) over one gap; the memory of a cell does not change."""
    spec = dynamics.spec
    if isinstance(decay, Tensor):
        state = _scale_hidden(spec, state, decay)
        decay = None
    if not spec.field:
        return dynamics.along_trend(state, gap)
    driven = spec.anchors + spec.hidden_size
    memory = state[:, driven:]
    state = _solve(dynamics, gap, decay, state[:, :driven])
    return torch.cat([state, memory], dim=1) if memory.shape[1] else state


def _solve(dynamics: _Dynamics, gap: Tensor, decay: DecayAlongGap | None, state: Tensor) -> Tensor:
    spec = dynamics.spec
    if tableau(spec.solver).adaptive:
        if decay is not None:
            return _solve_damped(dynamics, gap, decay, state)
        return dynamics.step(state, gap)
    steps: int | Tensor = spec.steps_per_gap
    if spec.max_step is not None:
        steps = torch.ceil(gap / spec.max_step - 1e-6).clamp_min(spec.steps_per_gap).long()
    if decay is not None or spec.bounded or spec.loops or spec.trend:
        return _solve_split(dynamics, gap, decay, state, steps)
    assert dynamics.field is not None
    return solve(
        dynamics.field,
        state,
        gap,
        tableau(spec.solver),
        steps=steps,
        adjoint_parameters=dynamics.parameters,
    )


def _solve_split(
    dynamics: _Dynamics,
    gap: Tensor,
    decay: DecayAlongGap | None,
    state: Tensor,
    steps: int | Tensor,
) -> Tensor:
    """Equal steps, each after its decay (Lie splitting).

    With one step per gap and every row observed this is algorithm 3 of the thesis.
    """
    spec = dynamics.spec
    counts = steps.to(gap) if isinstance(steps, Tensor) else torch.full_like(gap, steps)
    length = gap / counts

    def step(done: Tensor, y: Tensor, *applied: Tensor) -> tuple[Tensor, ...]:
        if decay is not None:
            part = ((done + 1) / counts).clamp_max(1.0)
            reached = decay.start + part * (decay.end - decay.start)
            y = _scale_hidden(spec, y, torch.exp(-_growth(reached, applied[0])))
            applied = (torch.maximum(applied[0], _exponent(reached)),)
        span = torch.where(done < counts, length, torch.zeros_like(length))
        return (done + 1, dynamics.step(y, span), *applied)

    done = torch.zeros_like(gap)
    carried: tuple[Tensor, ...] = (done, state)
    if decay is not None:
        carried = (done, state, decay.applied)
    if spec.loops and isinstance(steps, Tensor):
        return _while(lambda done, *_: (done < counts).any(), step, carried)[1]
    for _ in range(int(counts.max()) if isinstance(steps, Tensor) else steps):
        carried = step(*carried)
    return carried[1]


def _solve_damped(dynamics: _Dynamics, gap: Tensor, decay: DecayAlongGap, state: Tensor) -> Tensor:
    """The limit of short split steps, adaptive: h = exp(-E(s)) u, solved for u."""
    spec, field, parameters = dynamics.spec, dynamics.field, dynamics.parameters
    assert field is not None
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
    moved = _scale_hidden(spec, u, torch.exp(-exponent(torch.ones_like(gap))))
    return dynamics.within(state, moved)


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


@dataclass(frozen=True, eq=False)
class _Observed:
    """The observation of an anchored state at a row; fields as of `StepInputs`."""

    value: Tensor
    mask: Tensor
    level_gain: Tensor | None
    slope_gain: Tensor | None

    @classmethod
    def of(cls, spec: ScanSpec, inputs: StepInputs, i: int) -> _Observed:
        gains = (None, None)
        if spec.trend:
            gains = _given(inputs.level_gain)[:, i], _given(inputs.slope_gain)[:, i]  # type: ignore[assignment]
        return cls(inputs.values[:, i], inputs.mask[:, i], *gains)


def _update(
    dynamics: _Dynamics,
    cell: ScanCell,
    gate: Tensor,
    update: Tensor,
    observed: _Observed | None,
    state: Tensor,
) -> Tensor:
    """The state after an observation; x of an anchored state takes the observed values.

    With a trend, x and v move by gains. Where x or the value is out of range, x takes the value.
    """
    if observed is None:
        return cell.step(gate, state, update)
    n, anchors = dynamics.spec.channels, dynamics.spec.anchors
    x, rest = state[:, :n], state[:, anchors:]
    value, mask = observed.value, observed.mask
    shown, expected, outside = value, x, None
    if dynamics.low is not None and dynamics.high is not None:
        low, high = dynamics.low[:n], dynamics.high[:n]
        shown, expected = torch.clamp(value, low, high), _clamped(x, low, high)
        outside = (mask > 0) & ((shown != value) | (expected != x))
    innovation = mask * (shown - expected)
    if cell.innovation is not None:
        gate = torch.addmm(gate, innovation, cell.innovation.t())
    rest = cell.step(gate, rest, update)
    if dynamics.trend is None:
        return torch.cat([torch.lerp(x, value, mask), rest], dim=1)
    _, odds, factor = dynamics.trend
    gain = _given(observed.level_gain)
    gain = gain / (gain + (1.0 - gain) * odds)
    if outside is not None:
        gain = torch.where(outside, 1.0, gain)
    v = state[:, n:anchors] + _given(observed.slope_gain) * factor * innovation
    return torch.cat([gain * value + (1.0 - gain) * x, v, rest], dim=1)
