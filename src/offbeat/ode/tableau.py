"""Runge-Kutta methods as data: a solver is a tableau, an order and a reference."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

from offbeat.errors import InputError
from offbeat.registry import Registry

_TOLERANCE = 1e-12


@dataclass(frozen=True)
class Tableau:
    """The coefficients of an explicit Runge-Kutta method, checked when made.

    Stage i evaluates the field at the time `c[i]` of the step and at the state
    `y + h * sum(a[i][j] * k[j] for j < i)`; the step ends at `y + h * sum(b[i] * k[i])`.

    Args:
        name: in configs and messages.
        order: the error of one step is of order `order + 1`.
        a: row i holds the i weights of the slopes before stage i; the first row is empty.
        b: one weight per stage, of the result.
        c: one time per stage, as a fraction of the step; the first is 0.
        reference: publication of the method.
        b_low: weights of the embedded result of order `order - 1`, whose distance from the result
            estimates the error; None for a method of fixed steps.
        first_same_as_last: the last stage is evaluated at the end of the step, so that its slope
            is the first one of the next step.

    Raises:
        InputError: lengths disagree, a row of `a` does not sum to its `c`, weights do not sum to
            one, or the last stage contradicts `first_same_as_last`.
    """

    name: str
    order: int
    a: tuple[tuple[float, ...], ...]
    b: tuple[float, ...]
    c: tuple[float, ...]
    reference: str
    b_low: tuple[float, ...] | None = None
    first_same_as_last: bool = False

    def __post_init__(self) -> None:
        where = f"tableau {self.name!r}"
        if self.order < 1:
            raise InputError(f"{where} has order {self.order}, expected 1 or more")
        lengths = [len(row) for row in self.a]
        if not self.b or lengths != list(range(self.stages)) or len(self.c) != self.stages:
            raise InputError(
                f"{where} has {self.stages} weights, {len(self.c)} times and rows of {lengths} "
                "coefficients; an explicit method of n stages has n, n and 0, 1, ..., n - 1"
            )
        for i, (row, time) in enumerate(zip(self.a, self.c, strict=True)):
            if abs(math.fsum(row) - time) > _TOLERANCE:
                raise InputError(
                    f"{where}: row {i} of a sums to {math.fsum(row)!r}, expected c[{i}] = {time!r}"
                )
        for label, weights in (("b", self.b), ("b_low", self.b_low)):
            if weights is None:
                continue
            if len(weights) != self.stages or abs(math.fsum(weights) - 1) > _TOLERANCE:
                raise InputError(
                    f"{where}: {label} has {len(weights)} weights that sum to "
                    f"{math.fsum(weights)!r}, expected {self.stages} that sum to 1"
                )
        if self.first_same_as_last and (self.a[-1] != self.b[:-1] or self.b[-1] != 0):
            raise InputError(
                f"{where} has first_same_as_last, but the last row "
                f"of a is {self.a[-1]}, expected b without its last weight, {self.b[:-1]}"
            )

    @property
    def stages(self) -> int:
        """Number of evaluations of the field in a step."""
        return len(self.b)

    @property
    def adaptive(self) -> bool:
        """Whether the method estimates its error, which `solve_adaptive` needs."""
        return self.b_low is not None

    @cached_property
    def error(self) -> tuple[float, ...]:
        """One weight per stage, of the estimated error: `b - b_low`; empty if not adaptive."""
        if self.b_low is None:
            return ()
        return tuple(high - low for high, low in zip(self.b, self.b_low, strict=True))


_EULER = Tableau(
    name="euler",
    order=1,
    a=((),),
    b=(1.0,),
    c=(0.0,),
    reference="Euler, Institutionum calculi integralis I, 1768",
)
_MIDPOINT = Tableau(
    name="midpoint",
    order=2,
    a=((), (1 / 2,)),
    b=(0.0, 1.0),
    c=(0.0, 1 / 2),
    reference="Runge, Math. Annalen 46, 1895",
)
_HEUN = Tableau(
    name="heun",
    order=2,
    a=((), (1.0,)),
    b=(1 / 2, 1 / 2),
    c=(0.0, 1.0),
    reference="Heun, Zeitschrift für Mathematik und Physik 45, 1900",
)
_RK4 = Tableau(
    name="rk4",
    order=4,
    a=((), (1 / 2,), (0.0, 1 / 2), (0.0, 0.0, 1.0)),
    b=(1 / 6, 1 / 3, 1 / 3, 1 / 6),
    c=(0.0, 1 / 2, 1 / 2, 1.0),
    reference="Kutta, Zeitschrift für Mathematik und Physik 46, 1901",
)
_DOPRI5 = Tableau(
    name="dopri5",
    order=5,
    a=(
        (),
        (1 / 5,),
        (3 / 40, 9 / 40),
        (44 / 45, -56 / 15, 32 / 9),
        (19372 / 6561, -25360 / 2187, 64448 / 6561, -212 / 729),
        (9017 / 3168, -355 / 33, 46732 / 5247, 49 / 176, -5103 / 18656),
        (35 / 384, 0.0, 500 / 1113, 125 / 192, -2187 / 6784, 11 / 84),
    ),
    b=(35 / 384, 0.0, 500 / 1113, 125 / 192, -2187 / 6784, 11 / 84, 0.0),
    c=(0.0, 1 / 5, 3 / 10, 4 / 5, 8 / 9, 1.0, 1.0),
    b_low=(5179 / 57600, 0.0, 7571 / 16695, 393 / 640, -92097 / 339200, 187 / 2100, 1 / 40),
    reference="Dormand and Prince, J. Comput. Appl. Math. 6(1), 1980",
    first_same_as_last=True,
)
_TSIT5 = Tableau(
    name="tsit5",
    order=5,
    a=(
        (),
        (0.161,),
        (-0.008480655492356989, 0.335480655492357),
        (2.8971530571054935, -6.359448489975075, 4.3622954328695815),
        (5.325864828439257, -11.748883564062828, 7.4955393428898365, -0.09249506636175525),
        (
            5.86145544294642,
            -12.92096931784711,
            8.159367898576159,
            -0.071584973281401,
            -0.028269050394068383,
        ),
        (
            0.09646076681806523,
            0.01,
            0.4798896504144996,
            1.379008574103742,
            -3.290069515436081,
            2.324710524099774,
        ),
    ),
    b=(
        0.09646076681806523,
        0.01,
        0.4798896504144996,
        1.379008574103742,
        -3.290069515436081,
        2.324710524099774,
        0.0,
    ),
    c=(0.0, 0.161, 0.327, 0.9, 0.9800255409045097, 1.0, 1.0),
    b_low=(
        0.09824077787029101,
        0.010816434459656747,
        0.4720087724042376,
        1.523719581277005,
        -3.872426680888636,
        2.782792630028961,
        -1 / 66,
    ),
    reference="Tsitouras, Comput. Math. Appl. 62(2), 2011",
    first_same_as_last=True,
)

TABLEAUS: Registry[Tableau] = Registry("solver", group="offbeat.solvers")
"""Every method by the name that `ModelConfig.solver` takes."""

for _method in (_EULER, _MIDPOINT, _HEUN, _RK4, _DOPRI5, _TSIT5):
    TABLEAUS.register(_method.name, _method)


def tableau(name: str) -> Tableau:
    """Returns the method of this name.

    Raises:
        InputError: there is none; the message lists the names.
    """
    return TABLEAUS[name]
