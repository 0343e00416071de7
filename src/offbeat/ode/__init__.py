"""Solvers of ordinary differential equations in which every row of a batch has its own gap."""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor

from offbeat.ode.adaptive import adaptive_steps, solve_adaptive
from offbeat.ode.adjoint import solve_adjoint
from offbeat.ode.fixed import Field, Steps, check_problem, fixed_steps, solve_fixed
from offbeat.ode.tableau import TABLEAUS, Tableau, tableau

__all__ = [
    "TABLEAUS",
    "Field",
    "Tableau",
    "solve",
    "solve_adaptive",
    "solve_fixed",
    "tableau",
]


def solve(
    field: Field,
    y: Tensor,
    duration: Tensor,
    tableau: Tableau,
    *,
    steps: int | Tensor = 1,
    rtol: float = 1e-4,
    atol: float = 1e-6,
    adjoint_parameters: Sequence[Tensor] | None = None,
) -> Tensor:
    """Integrates dy/ds = duration * field(s, y) from s = 0 to 1, each row over its own gap.

    Args:
        field: `field(s, y)` is dy/dt per unit of model time, (batch, size), where `s` (batch, 1) is
            the fraction of the gap that has passed and `y` (batch, size) the state. It is always
            called with the whole batch, and must not mix its rows.
        y: (batch, size) states at the start of the gaps.
        duration: (batch, 1) gap of each row in model time; a row of duration 0 keeps its state.
        tableau: the method; an adaptive one steps within the tolerance, any other in equal steps.
        steps: equal steps of every row, or (batch, 1) integers; unused by adaptive methods.
        rtol: tolerance relative to the state; used by adaptive methods only.
        atol: tolerance in the units of the state; used by adaptive methods only.
        adjoint_parameters: if given, gradients come from the adjoint method (`solve_adjoint`), and
            only for `y`, `duration` and these tensors, which the field closes over. Otherwise they
            flow through the steps, to everything.

    Returns:
        (batch, size) states at the end of the gaps.

    Raises:
        InputError: shapes or types disagree, or an option is out of its range.
        DivergenceError: an adaptive method could not keep the tolerance.
    """
    if adjoint_parameters is None:
        if tableau.adaptive:
            return solve_adaptive(field, y, duration, tableau, rtol=rtol, atol=atol)
        return solve_fixed(field, y, duration, tableau, steps)
    check_problem(y, duration)

    def take_steps(field: Field, y: Tensor, duration: Tensor, *, reuse: bool = True) -> Steps:
        if tableau.adaptive:
            return adaptive_steps(field, y, duration, tableau, rtol=rtol, atol=atol, reuse=reuse)
        return fixed_steps(field, y, duration, tableau, steps, reuse=reuse)

    return solve_adjoint(field, y, duration, take_steps, tableau.b, adjoint_parameters)
