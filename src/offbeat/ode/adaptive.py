"""Adaptive Runge-Kutta solvers with a step size per row."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from offbeat.errors import DivergenceError, InputError
from offbeat.ode.fixed import Field, Steps, check_problem, runge_kutta_step, weighted_sum
from offbeat.ode.tableau import TABLEAUS, Tableau

MAX_STEPS = 10_000
"""Maximum number of steps per gap, including rejected ones."""

_SAFETY = 0.9
_SHRINK, _GROW = 0.2, 10.0
_LEAST_ERROR = 1e-10
_LEAST_PREVIOUS = 1e-4
"""Lower bounds of errors, so that a single very small error does not affect the controller."""
_SNAP = 1e-2
"""A step is extended to the end of the gap if less than this fraction of it would remain."""


def solve_adaptive(
    field: Field,
    y: Tensor,
    duration: Tensor,
    tableau: Tableau,
    *,
    rtol: float,
    atol: float,
    max_steps: int = MAX_STEPS,
) -> Tensor:
    """Integrates dy/ds = duration * field(s, y) from s = 0 to 1 within a tolerance.

    Each row has its own steps, controlled by the error of that row: the root mean square over its
    states of error / (atol + rtol * |state|) stays below 1 in every step. The field is always
    evaluated on the whole batch, because it may use tensors with one row per row of the batch.

    The first step tried is the whole gap: most gaps are short, and need only one step of
    `tableau.stages` evaluations. A row whose gap is 0 keeps its state exactly; if all gaps
    are 0 the field isn't evaluated, unless the gaps themselves require gradients. Gradients flow
    through the accepted steps; the step sizes are constants.

    Args:
        field: see `Field`.
        y: (batch, size) states at the start of the gaps.
        duration: (batch, 1) gap of each row in model time.
        tableau: a method with an embedded error estimate.
        rtol: tolerance relative to the state.
        atol: tolerance in the units of the state.
        max_steps: maximum number of steps, including rejected ones.

    Returns:
        (batch, size) states at the end of the gaps.

    Raises:
        InputError: shapes or types disagree, tolerances are not positive, or the method has no
            error estimate.
        DivergenceError: a row ran out of steps, or its step size became too small.

    References:
        Hairer, Norsett and Wanner, Solving Ordinary Differential Equations I, 1993, II.4;
        Gustafsson, ACM Trans. Math. Softw. 17(4), 1991 (the controller).
    """
    check_problem(y, duration)
    for state, _ in adaptive_steps(
        field, y, duration, tableau, rtol=rtol, atol=atol, max_steps=max_steps
    ):
        y = state
    return y


def adaptive_steps(
    field: Field,
    y: Tensor,
    duration: Tensor,
    tableau: Tableau,
    *,
    rtol: float,
    atol: float,
    max_steps: int = MAX_STEPS,
    reuse: bool = True,
) -> Steps:
    """Yields the steps of `solve_adaptive`; rows with a rejected step cover 0 of their gap.

    Args:
        field: see `Field`.
        y: (batch, size) states at the start.
        duration: (batch, 1) gap of each row.
        tableau: a method with an embedded error estimate.
        rtol: relative tolerance.
        atol: absolute tolerance.
        max_steps: maximum number of steps.
        reuse: start a step with the last slope of the previous step, if the method allows it.
    """
    _check(tableau, rtol, atol)
    reuse = reuse and tableau.first_same_as_last
    # The gradient of a gap of 0 is the slope there, which needs a step.
    active = torch.full_like(duration, duration.requires_grad, dtype=torch.bool) | (duration != 0)
    if not bool(active.any()):
        return
    gap = duration.detach()
    s, end = torch.zeros_like(gap), torch.ones_like(gap)
    h = active.to(gap)
    least = torch.finfo(gap.dtype).eps ** 2
    controller = _Controller(gap, tableau.order)
    first: Tensor | None = None
    for tried in range(1, max_steps + 1):
        stepped, slopes = runge_kutta_step(field, s, h, y, duration, tableau, first)
        error = _error_norm(slopes, y, stepped, h * gap, tableau, rtol, atol)
        accepted = active & (error <= 1)
        taken = h * accepted
        if bool(accepted.all()):
            y, first = stepped, slopes[-1]
        elif bool(accepted.any()):
            if not bool(error.isfinite().all()):
                # Infinite slopes of a rejected row would make its zero gradient NaN.
                stepped, slopes = runge_kutta_step(field, s, taken, y, duration, tableau, first)
            y = torch.where(accepted, stepped, y)
            first = torch.where(accepted, slopes[-1], slopes[0])
        else:
            first = slopes[0]
        if not reuse:
            first = None
        yield y, taken
        s = torch.where(accepted, end, s)
        active = active & (s < 1)
        if not bool(active.any()):
            return
        size = controller.next_size(h, error, accepted)
        end = s + size
        end = torch.where(end + _SNAP * size >= 1, 1.0, end)
        # The difference is exact, so that the steps of a row sum exactly to its gap.
        h = torch.where(active, end - s, 0.0)
        # A slope that is not finite at the current state remains so for any step size.
        finite = (slopes[0] * gap).isfinite().all(dim=1, keepdim=True)
        stuck = active & ~(finite & (h > least))
        if bool(stuck.any()):
            why = "even the smallest step misses the tolerance: the vector field jumps or overflows"
            raise _divergence(field, y, gap, s, stuck, tried, tableau, why)
    raise _divergence(field, y, gap, s, active, max_steps, tableau, "the tolerance needs more")


class _Controller:
    """Chooses the next step of every row by the PI controller of Gustafsson.

    Args:
        gap: (batch, 1) for the shape and type of the state.
        order: order of the method; the estimated error of a step of size h is of order h^order.
    """

    def __init__(self, gap: Tensor, order: int) -> None:
        self._previous = torch.full_like(gap, _LEAST_PREVIOUS)
        self._grow = torch.full_like(gap, _GROW)
        self._order = order

    def next_size(self, h: Tensor, error: Tensor, accepted: Tensor) -> Tensor:
        """Returns (batch, 1) sizes of the next steps after steps of size `h` with these errors."""
        error = error.nan_to_num(nan=torch.inf, posinf=torch.inf).clamp(min=_LEAST_ERROR)
        beta = 0.2 / self._order
        onward = error ** (0.75 * beta - 1 / self._order) * self._previous**beta
        again = error ** (-1 / self._order)
        factor = _SAFETY * torch.where(accepted, onward, again)
        factor = factor.clamp(min=_SHRINK).minimum(self._grow)
        self._previous = torch.where(accepted, error, self._previous).clamp(min=_LEAST_PREVIOUS)
        self._grow = torch.where(accepted, _GROW, 1.0)  # no growth directly after a rejection
        return h * factor


@torch.no_grad()
def _error_norm(
    slopes: list[Tensor],
    before: Tensor,
    after: Tensor,
    span: Tensor,
    tableau: Tableau,
    rtol: float,
    atol: float,
) -> Tensor:
    """Returns (batch, 1) the error of a step as a multiple of the tolerance."""
    scale = torch.maximum(before.abs(), after.abs()).mul_(rtol).add_(atol)
    error = weighted_sum(slopes, tableau.error).mul(span).div_(scale)
    norm: Tensor = torch.linalg.vector_norm(error, dim=1, keepdim=True)
    return norm / math.sqrt(before.shape[1])


def _check(tableau: Tableau, rtol: float, atol: float) -> None:
    if not tableau.adaptive:
        choices = ", ".join(name for name, method in TABLEAUS.items() if method.adaptive)
        raise InputError(
            f"{tableau.name!r} does not estimate its error, expected one of: {choices}; "
            "or use solve_fixed"
        )
    if not (rtol >= 0 and atol > 0):
        raise InputError(
            f"rtol is {rtol} and atol {atol}, expected rtol of 0 or more and atol above 0"
        )


@torch.no_grad()
def _divergence(
    field: Field,
    y: Tensor,
    gap: Tensor,
    s: Tensor,
    rows: Tensor,
    tried: int,
    tableau: Tableau,
    why: str,
) -> DivergenceError:
    row = int(rows.int().argmax())
    where = (
        f"{tableau.name} stopped in row {row} after {tried} steps, {100 * float(s[row]):.3g} % "
        f"into its gap of {float(gap[row]):.6g}"
    )
    for what, value in (("gap", gap), ("state", y), ("vector field", field(s, y))):
        if not bool(value[row].isfinite().all()):
            return DivergenceError(
                f"{where}: the {what} is not finite there; look for NaN in the input and for "
                "weights that have grown too large"
            )
    return DivergenceError(
        f"{where}: {why}; use a looser tolerance, a shorter longest gap, or a solver of fixed steps"
    )
