"""Gradients of an ODE solution by the adjoint method, with memory independent of the steps."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from typing import Any, Protocol

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from offbeat.errors import DivergenceError
from offbeat.ode.fixed import Field, Steps


class TakeSteps(Protocol):
    """Takes the steps of a solver: `fixed_steps` or `adaptive_steps`, its options bound."""

    def __call__(self, field: Field, y: Tensor, duration: Tensor, *, reuse: bool = True) -> Steps:
        """Yields the states after each step, and the fraction of the gap it covered."""
        ...


def solve_adjoint(
    field: Field,
    y: Tensor,
    duration: Tensor,
    take_steps: TakeSteps,
    weights: tuple[float, ...],
    parameters: Sequence[Tensor],
) -> Tensor:
    """Integrates dy/ds = duration * field(s, y), with gradients by the adjoint method.

    The forward pass is not recorded. The backward pass integrates, from s = 1 to 0 with the same
    solver and tolerance, the state y, the adjoint a = dL/dy, and the gradients

        dy/ds = duration * f,    da/ds = -duration * a^T df/dy,
        dL/dtheta = sum over rows of the integral of duration * a^T df/dtheta over s,
        dL/dduration = the integral of a^T f over s.

    This is algorithm 1, equations (36) to (40), of the thesis, with two improvements. The two
    integrals do not affect the step size, because nothing depends on them. And a, in which the
    problem is linear, is integrated as a multiple of its size at the end of the gap, so that the
    absolute tolerance does not depend on the scale of the loss.

    With a solver of fixed steps the gradient is that of the ODE, not of the steps: the two differ
    by the error of the solver.

    Args:
        field: see `Field`; it is evaluated again in the backward pass, so it must not change.
        y: (batch, size) states at the start of the gaps.
        duration: (batch, 1) gap of each row.
        take_steps: takes the steps.
        weights: of the stages of a step, as in `Tableau.b`.
        parameters: tensors that the field closes over, leaves or not, common to all rows or
            with one row per row. Only these, `y` and `duration` get gradients.

    Returns:
        (batch, size) states at the end of the gaps.

    Raises:
        DivergenceError: an adaptive solver could not keep the tolerance, in the forward or backward
            pass.

    References:
        Chen et al., Neural Ordinary Differential Equations, NeurIPS 2018;
        Kidger et al., "Hey, that's not an ODE", ICML 2021 (control of the step size).
    """
    result: Tensor = _Adjoint.apply(  # type: ignore[no-untyped-call]
        field, take_steps, weights, y, duration, *parameters
    )
    return result


class _Adjoint(torch.autograd.Function):
    """Algorithm 1 as one node of the graph."""

    @staticmethod
    def forward(
        ctx: Any,
        field: Field,
        take_steps: TakeSteps,
        weights: tuple[float, ...],
        y: Tensor,
        duration: Tensor,
        *parameters: Tensor,
    ) -> Tensor:
        end = y.clone()  # a node can't return its own input, which is the result for a gap of 0
        for state, _ in take_steps(field, end, duration):
            end = state
        ctx.field, ctx.take_steps, ctx.weights = field, take_steps, weights
        ctx.save_for_backward(end, duration, *parameters)
        return end

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        end, duration, *parameters = ctx.saved_tensors
        _, _, _, _, needs_duration, *needed = ctx.needs_input_grad
        scale = gradient.abs().amax(dim=1, keepdim=True)
        scale = torch.where(scale == 0, 1.0, scale)
        augmented = _Augmented(
            ctx.field,
            ctx.weights,
            duration=duration.detach(),
            scale=scale,
            parameters=[p for p, need in zip(parameters, needed, strict=True) if need],
            needs_duration=needs_duration,
        )
        state = torch.cat([end, gradient / scale], dim=1)
        try:
            for after, taken in ctx.take_steps(augmented, state, duration, reuse=False):
                augmented.integrate(taken)
                state = after
        except DivergenceError as error:
            raise DivergenceError(f"in the backward pass of the adjoint, {error}") from error
        found = iter(augmented.gradients)
        return (
            None,
            None,
            None,
            state[:, end.shape[1] :] * scale,
            augmented.duration_gradient,
            *(next(found) if need else None for need in needed),
        )


class _Augmented:
    """The field of (y, a) over r = 1 - s; keeps the graphs of a step for its integrals.

    Args:
        field: the field of y.
        weights: of the stages of a step.
        duration: (batch, 1) gap of each row.
        scale: (batch, 1) divisor of the adjoint.
        parameters: tensors to compute gradients for.
        needs_duration: whether to compute the gradient of the gap.
    """

    def __init__(
        self,
        field: Field,
        weights: tuple[float, ...],
        *,
        duration: Tensor,
        scale: Tensor,
        parameters: list[Tensor],
        needs_duration: bool,
    ) -> None:
        self.gradients = [torch.zeros_like(p) for p in parameters]
        self.duration_gradient = torch.zeros_like(duration) if needs_duration else None
        self._field = field
        self._weights = weights
        self._duration = duration
        self._scale = scale
        self._parameters = parameters
        # A rejected or repeated step leaves its stages; only the last ones count.
        self._stages: deque[tuple[Tensor, Tensor]] = deque(maxlen=len(weights))

    def __call__(self, r: Tensor, state: Tensor) -> Tensor:
        """Returns d(y, a)/dr (batch, 2 * size), per unit of model time."""
        y, adjoint = state.chunk(2, dim=1)
        with torch.enable_grad():
            y = y.detach().requires_grad_()
            slope = self._field(1 - r, y)
        pulled = None
        if slope.requires_grad:
            (pulled,) = torch.autograd.grad(slope, y, adjoint, retain_graph=True, allow_unused=True)
        self._stages.append((slope, adjoint))
        if pulled is None:  # a field that does not depend on y
            pulled = torch.zeros_like(adjoint)
        return torch.cat([-slope.detach(), pulled], dim=1)

    def integrate(self, taken: Tensor) -> None:
        """Adds to both integrals the step that covered `taken` (batch, 1) of each gap.

        The weight of a row scales its cotangent, so that one product with the Jacobian serves
        parameters common to all rows and parameters with one row per row.
        """
        if not bool(taken.any()):
            return
        slopes, cotangents = [], []
        for weight, (slope, adjoint) in zip(self._weights, self._stages, strict=True):
            if weight == 0:
                continue
            weighted = weight * taken * self._scale * adjoint
            if self.duration_gradient is not None:
                self.duration_gradient += (weighted * slope.detach()).sum(dim=1, keepdim=True)
            if slope.requires_grad:
                slopes.append(slope)
                cotangents.append(weighted * self._duration)
        if not slopes or not self._parameters:
            return
        found = torch.autograd.grad(slopes, self._parameters, cotangents, allow_unused=True)
        for total, part in zip(self.gradients, found, strict=True):
            if part is not None:
                total += part
