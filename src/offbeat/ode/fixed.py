"""Runge-Kutta steps, and solvers with a known number of steps over the gap of each row."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import torch
from torch import Tensor

from offbeat.errors import InputError
from offbeat.ode.tableau import Tableau

Field = Callable[[Tensor, Tensor], Tensor]
"""A vector field: `field(s, y)` is dy/dt per unit of model time, (batch, size).

`s` (batch, 1) is the fraction of each row's gap that has passed, from 0 to 1, and `y`
(batch, size) the state. Row b of the result may depend only on row b of the arguments.
"""

Steps = Iterator[tuple[Tensor, Tensor]]
"""The states (batch, size) after each step, with the fraction (batch, 1) of the gap it covered."""


def solve_fixed(
    field: Field,
    y: Tensor,
    duration: Tensor,
    tableau: Tableau,
    steps: int | Tensor = 1,
) -> Tensor:
    """Integrates dy/ds = duration * field(s, y) from s = 0 to 1 in equal steps.

    Gradients flow through the steps. The result isn't checked for overflow.

    Args:
        field: see `Field`.
        y: (batch, size) states at the start of the gaps.
        duration: (batch, 1) gap of each row in model time; a row of duration 0 keeps its state.
        tableau: the method; the embedded result of an adaptive one is not used.
        steps: number of steps of every row, or (batch, 1) integers, one for each row.

    Returns:
        (batch, size) states at the end of the gaps.

    Raises:
        InputError: shapes or types disagree, or there is less than one step.
    """
    check_problem(y, duration)
    steps = _shared(steps, duration)
    if tableau.stages == 1 and isinstance(steps, int) and steps == 1:
        # The common case in training, which must cost no more than the field.
        return torch.addcmul(y, duration, field(torch.zeros_like(duration), y))
    for state, _ in fixed_steps(field, y, duration, tableau, steps):
        y = state
    return y


def fixed_steps(
    field: Field,
    y: Tensor,
    duration: Tensor,
    tableau: Tableau,
    steps: int | Tensor,
    *,
    reuse: bool = True,
) -> Steps:
    """Yields the steps of `solve_fixed`, whose arguments it takes.

    Args:
        field: see `Field`.
        y: (batch, size) states at the start.
        duration: (batch, 1) gap of each row.
        tableau: the method.
        steps: number of steps, or (batch, 1) of them.
        reuse: start a step with the last slope of the previous step, if the method allows it.
    """
    slopes: list[Tensor] = []
    for s, h, moving in _grid(duration, steps):
        known = slopes[-1] if slopes and reuse and tableau.first_same_as_last else None
        stepped, slopes = runge_kutta_step(field, s, h, y, duration, tableau, known)
        y = stepped if moving is None else torch.where(moving, stepped, y)
        yield y, h


def runge_kutta_step(
    field: Field,
    s: Tensor,
    h: Tensor,
    y: Tensor,
    duration: Tensor,
    tableau: Tableau,
    first: Tensor | None = None,
) -> tuple[Tensor, list[Tensor]]:
    """Takes one step with a size per row.

    Args:
        field: see `Field`.
        s: (batch, 1) positions of the rows, as fractions of their gaps.
        h: (batch, 1) step sizes; a row with 0 keeps its state.
        y: (batch, size) states at `s`.
        duration: (batch, 1) gap of each row.
        tableau: the method.
        first: (batch, size) the slope at (s, y), if known.

    Returns:
        (batch, size) states at `s + h`, and the slopes of all stages.
    """
    span = h * duration
    state = y
    slopes = [field(s, y) if first is None else first]
    for weights, time in zip(tableau.a[1:], tableau.c[1:], strict=True):
        state = torch.addcmul(y, span, weighted_sum(slopes, weights))
        slopes.append(field(torch.add(s, h, alpha=time), state))
    if not tableau.first_same_as_last:
        state = torch.addcmul(y, span, weighted_sum(slopes, tableau.b))
    return state, slopes


def weighted_sum(slopes: Sequence[Tensor], weights: Sequence[float]) -> Tensor:
    """Returns the sum of `weights[i] * slopes[i]`.

    Elementwise and in a fixed order: the rounding of a matrix product depends on other rows.
    """
    terms = [(k, w) for k, w in zip(slopes, weights, strict=True) if w != 0]
    if not terms:
        return torch.zeros_like(slopes[0])
    slope, weight = terms[0]
    total = slope if weight == 1 else slope * weight
    for slope, weight in terms[1:]:
        total = torch.add(total, slope, alpha=weight)
    return total


def check_problem(y: Tensor, duration: Tensor) -> None:
    """Raises InputError unless `y` is (batch, size) and `duration` (batch, 1), of one type."""
    if y.ndim != 2 or duration.shape != (y.shape[0], 1):
        raise InputError(
            f"y and duration have shapes {tuple(y.shape)} and {tuple(duration.shape)}, expected "
            "(batch, size) and (batch, 1): one gap per row"
        )
    if y.dtype != duration.dtype:
        raise InputError(
            f"y is {y.dtype} and duration {duration.dtype}; compute gaps in float64, then cast "
            f"them with duration.to({y.dtype})"
        )


def _grid(duration: Tensor, steps: int | Tensor) -> Iterator[tuple[Tensor, Tensor, Tensor | None]]:
    """Yields (batch, 1) start and length of each step, and which rows move (None: all)."""
    steps = _shared(steps, duration)
    s = torch.zeros_like(duration)
    # Lengths are differences of the ends, so that s + h is exactly the end.
    if isinstance(steps, int):
        for i in range(steps):
            end = torch.full_like(duration, (i + 1) / steps)
            yield s, end - s, None
            s = end
        return
    counts = steps.to(duration)
    for i in range(int(steps.max())):
        end = counts.clamp(max=i + 1) / counts
        yield s, end - s, end > s
        s = end


def _shared(steps: int | Tensor, duration: Tensor) -> int | Tensor:
    """Checks `steps`; returns one number if it is equal for all rows."""
    if isinstance(steps, int):
        if steps < 1:
            raise InputError(f"steps is {steps}, expected 1 or more")
        return steps
    if steps.shape != duration.shape or steps.is_floating_point() or steps.is_complex():
        raise InputError(
            f"steps is {steps.dtype} of shape {tuple(steps.shape)}, expected a number or integers "
            f"of shape {tuple(duration.shape)}, one per row"
        )
    if steps.numel() == 0:
        return 1
    fewest, most = (int(bound) for bound in torch.aminmax(steps))
    if fewest < 1:
        raise InputError(
            f"steps is {fewest} for row {int(steps.argmin())}, expected 1 or more, also where the "
            "gap is 0; use steps.clamp(min=1)"
        )
    return most if fewest == most else steps
