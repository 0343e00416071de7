"""Solvers against closed forms, order conditions, torchdiffeq, and each row on its own."""

from __future__ import annotations

import gc
import math
from collections.abc import Callable, Iterator
from functools import cache, partial
from itertools import combinations_with_replacement

import pytest
import torch
import torchdiffeq
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor, nn

from offbeat.errors import DivergenceError, InputError
from offbeat.ode import TABLEAUS, Tableau, solve, solve_adaptive, solve_fixed, tableau
from offbeat.ode.adaptive import adaptive_steps

ALL = sorted(TABLEAUS)
ADAPTIVE = [name for name in ALL if TABLEAUS[name].adaptive]
FLOAT64 = torch.float64
GAPS = torch.tensor([[0.3], [1.0], [2.5], [0.0], [1.7]], dtype=FLOAT64)


def close(got: Tensor, expected: Tensor, tolerance: float) -> bool:
    """Whether the largest error is within a share of the largest entry."""
    return bool((got - expected).abs().max() <= tolerance * expected.abs().max())


class Net(nn.Module):
    """A small field of state and time."""

    def __init__(
        self, size: int = 4, *, hidden: int = 16, seed: int = 0, dtype: torch.dtype = FLOAT64
    ) -> None:
        super().__init__()
        torch.manual_seed(seed)
        layers = nn.Linear(size + 1, hidden), nn.Tanh(), nn.Linear(hidden, size)
        self.body = nn.Sequential(*layers).to(dtype)

    def forward(self, s: Tensor, y: Tensor) -> Tensor:
        return self.body(torch.cat([y, s], dim=1))


def states(batch: int = 5, size: int = 4, seed: int = 1, dtype: torch.dtype = FLOAT64) -> Tensor:
    return torch.randn(batch, size, generator=torch.Generator().manual_seed(seed)).to(dtype)


def counted(field: Callable[[Tensor, Tensor], Tensor]) -> tuple[Callable, list[Tensor]]:
    seen: list[Tensor] = []

    def wrapped(s: Tensor, y: Tensor) -> Tensor:
        seen.append(s)
        return field(s, y)

    return wrapped, seen


# --- the tableaus -----------------------------------------------------------------------------


@cache
def trees(order: int) -> tuple[tuple, ...]:
    """Rooted trees of a number of nodes, each the sorted tuple of its subtrees."""
    return tuple(sorted(set(forests(order - 1, order - 1))))


def forests(nodes: int, largest: int) -> Iterator[tuple]:
    if nodes == 0:
        yield ()
    for first in range(min(nodes, largest), 0, -1):
        for count in range(1, nodes // first + 1):
            for rest in forests(nodes - first * count, first - 1):
                for same in combinations_with_replacement(trees(first), count):
                    yield tuple(sorted((*same, *rest)))


def nodes(tree: tuple) -> int:
    return 1 + sum(nodes(child) for child in tree)


def density(tree: tuple) -> int:
    return nodes(tree) * math.prod(density(child) for child in tree)


def elementary(method: Tableau, tree: tuple) -> list[float]:
    """Weight of the tree at every stage."""
    inner = [elementary(method, child) for child in tree]
    return [
        math.prod(math.fsum(w * v for w, v in zip(row, values, strict=False)) for values in inner)
        for row in method.a
    ]


def residual(method: Tableau, weights: tuple[float, ...], tree: tuple) -> float:
    stages = elementary(method, tree)
    got = math.fsum(b * v for b, v in zip(weights, stages, strict=True))
    return abs(got - 1 / density(tree))


def test_there_are_as_many_rooted_trees_as_is_known():
    assert [len(trees(order)) for order in range(1, 7)] == [1, 1, 2, 4, 9, 20]


@pytest.mark.parametrize("name", ALL)
def test_coefficients_meet_every_order_condition_up_to_the_stated_order_and_no_more(name):
    method = tableau(name)
    for order in range(1, method.order + 1):
        for tree in trees(order):
            assert residual(method, method.b, tree) < 5e-14
            if method.b_low and order < method.order:
                assert residual(method, method.b_low, tree) < 5e-14
    assert max(residual(method, method.b, tree) for tree in trees(method.order + 1)) > 1e-5
    if method.b_low:
        assert max(residual(method, method.b_low, t) for t in trees(method.order)) > 1e-5


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"c": (0.0, 0.4)}, r"row 1 of a sums to 0.5, expected c\[1\] = 0.4"),
        ({"b": (0.0, 0.9)}, "b has 2 weights that sum to 0.9, expected 2 that sum to 1"),
        ({"b_low": (1.0,)}, "b_low has 1 weights"),
        ({"a": ((), (0.25, 0.25))}, r"rows of \[0, 2\] coefficients"),
        ({"order": 0}, "order 0, expected 1 or more"),
        ({"first_same_as_last": True}, "has first_same_as_last"),
    ],
)
def test_a_wrong_tableau_is_refused(change, message):
    right = {"name": "mine", "order": 2, "a": ((), (0.5,)), "b": (0.0, 1.0), "c": (0.0, 0.5)}
    Tableau(**right, reference="none")
    with pytest.raises(InputError, match=message):
        Tableau(**{**right, **change}, reference="none")


def test_an_unknown_solver_gets_the_choices_and_the_nearest():
    with pytest.raises(InputError, match=r"unknown solver 'dopri'.*tsit5; did you mean 'dopri5'"):
        tableau("dopri")


# --- closed forms -----------------------------------------------------------------------------


def logistic() -> tuple[Callable, Tensor, Tensor]:
    y = torch.rand(5, 3, generator=torch.Generator().manual_seed(2), dtype=FLOAT64) + 0.2
    exact = 1 / (1 + (1 / y - 1) * torch.exp(-GAPS))
    return (lambda s, y: y * (1 - y)), y, exact


def swing() -> tuple[Callable, Tensor, Tensor]:
    """dy/dt = y cos t with t = s * gap, so that a wrong s or gap of a row shows."""
    y = states(size=3)
    return (lambda s, y: y * torch.cos(s * GAPS)), y, y * torch.exp(torch.sin(GAPS))


@pytest.mark.parametrize("problem", [logistic, swing])
@pytest.mark.parametrize("name", ALL)
def test_the_measured_order_is_the_stated_one(name, problem):
    field, y, exact = problem()
    method = tableau(name)
    coarse, fine = ((solve_fixed(field, y, GAPS, method, n) - exact).norm() for n in (32, 64))
    assert float(torch.log2(coarse / fine)) == pytest.approx(method.order, abs=0.2)


@pytest.mark.parametrize("problem", [logistic, swing])
@pytest.mark.parametrize("name", ADAPTIVE)
def test_the_error_of_an_adaptive_solver_is_proportional_to_the_tolerance(name, problem):
    field, y, exact = problem()
    tolerances = [1e-4, 1e-6, 1e-8, 1e-10]
    errors = [
        float((solve_adaptive(field, y, GAPS, tableau(name), rtol=t, atol=t) - exact).abs().max())
        for t in tolerances
    ]
    assert all(error < 10 * t for error, t in zip(errors, tolerances, strict=True))
    slope = math.log10(errors[0] / errors[-1]) / 6
    assert 0.75 < slope < 1.25


@pytest.mark.parametrize("name", ADAPTIVE)
def test_a_short_gap_costs_one_step(name):
    field, seen = counted(Net(dtype=torch.float32))
    y = states(dtype=torch.float32)
    solve(field, y, torch.full((5, 1), 0.01), tableau(name))
    assert len(seen) == tableau(name).stages


@pytest.mark.parametrize("name", ADAPTIVE)
def test_a_first_step_that_overflows_is_refused_and_the_gradient_stays_finite(name):
    y = torch.tensor([[3.0], [0.5]], requires_grad=True)
    gaps = torch.tensor([[300.0], [0.01]], requires_grad=True)
    options = {"rtol": 1e-5, "atol": 1e-6}
    end = solve_adaptive(lambda s, y: -(y**5), y, gaps, tableau(name), **options)
    exact = (y**-4 + 4 * gaps) ** -0.25
    assert close(end, exact, 1e-4)
    for got, expected in zip(
        torch.autograd.grad(end.log().sum(), [y, gaps]),
        torch.autograd.grad(exact.log().sum(), [y, gaps]),
        strict=True,
    ):
        assert torch.allclose(got, expected, rtol=2e-3)


# Methods that are not in the registry: one without a shared stage, one of order 3.
HEUN_EULER = Tableau(
    name="heun_euler",
    order=2,
    a=((), (1.0,)),
    b=(1 / 2, 1 / 2),
    c=(0.0, 1.0),
    b_low=(1.0, 0.0),
    reference="Heun with the step of Euler embedded",
)
BOSH3 = Tableau(
    name="bosh3",
    order=3,
    a=((), (1 / 2,), (0.0, 3 / 4), (2 / 9, 1 / 3, 4 / 9)),
    b=(2 / 9, 1 / 3, 4 / 9, 0.0),
    c=(0.0, 1 / 2, 3 / 4, 1.0),
    b_low=(7 / 24, 1 / 4, 1 / 3, 1 / 8),
    reference="Bogacki and Shampine, Appl. Math. Lett. 2(4), 1989",
    first_same_as_last=True,
)


@pytest.mark.parametrize("method", [HEUN_EULER, BOSH3], ids=lambda method: method.name)
@pytest.mark.parametrize("adjoint", [False, True])
def test_a_new_method_is_its_tableau_and_nothing_else(method, adjoint):
    field, y, exact = swing()
    y.requires_grad_()
    parameters = [] if adjoint else None
    end = solve(field, y, GAPS, method, rtol=1e-5, atol=1e-5, adjoint_parameters=parameters)
    assert close(end, exact, 1e-4)
    (gradient,) = torch.autograd.grad(end.sum(), y)
    assert close(gradient, torch.exp(torch.sin(GAPS)).expand(5, 3), 1e-3)


# --- another library --------------------------------------------------------------------------


def by_torchdiffeq(field: Callable, y: Tensor, gaps: Tensor, **options) -> Tensor:
    """Each row alone, in model time."""
    rows = []
    for row, gap in zip(y, gaps[:, 0], strict=True):
        if gap == 0:
            rows.append(row)
            continue
        one = lambda t, y, gap=gap: field((t / gap).reshape(1, 1), y)  # noqa: E731
        times = torch.stack([torch.zeros_like(gap), gap])
        if "steps" in options:
            step = {"step_size": float(gap / options["steps"])}
            end = torchdiffeq.odeint(one, row[None], times, method=options["method"], options=step)
        else:
            end = torchdiffeq.odeint(one, row[None], times, **options)
        rows.append(end[-1, 0])
    return torch.stack(rows)


@pytest.mark.parametrize(
    ("name", "theirs"), [("euler", "euler"), ("midpoint", "midpoint"), ("heun", "heun2")]
)
def test_fixed_steps_equal_torchdiffeq_on_each_row(name, theirs):
    net, y = Net(), states()
    for steps in (1, 4):
        got = solve_fixed(net, y, GAPS, tableau(name), steps)
        assert close(got, by_torchdiffeq(net, y, GAPS, method=theirs, steps=steps), 1e-13)


def test_rk4_and_their_three_eighths_rule_agree_once_converged():
    net, y = Net(), states()
    got = solve_fixed(net, y, GAPS, tableau("rk4"), 100)
    assert close(got, by_torchdiffeq(net, y, GAPS, method="rk4", steps=100), 1e-8)


@pytest.mark.parametrize("name", ADAPTIVE)
def test_adaptive_solvers_equal_torchdiffeq_on_each_row(name):
    net, y = Net(), states()
    got = solve(net, y, 4 * GAPS, tableau(name), rtol=1e-9, atol=1e-9)
    assert close(got, by_torchdiffeq(net, y, 4 * GAPS, method="dopri5", rtol=1e-9, atol=1e-9), 1e-8)


# --- rows don't know of each other ------------------------------------------------------------


def wild(rates: Tensor, y: Tensor) -> Tensor:
    return -rates * y + torch.sin(3 * y)


@pytest.mark.parametrize("dtype", [torch.float32, FLOAT64])
@pytest.mark.parametrize("name", ALL)
@settings(max_examples=15, deadline=None, derandomize=True)
@given(
    rows=st.lists(
        st.tuples(
            st.sampled_from([0.0, 1e-6, 0.01, 0.7, 5.0]),
            st.sampled_from([0.0, 0.1, 3.0, 60.0]),
            st.integers(0, 9),
        ),
        min_size=2,
        max_size=7,
    )
)
def test_batch_mates_never_matter(name, dtype, rows):
    gaps = torch.tensor([[row[0]] for row in rows], dtype=dtype)
    rates = torch.tensor([[row[1]] for row in rows], dtype=dtype)
    y = torch.cat([states(1, 3, seed=row[2], dtype=dtype) for row in rows])
    options = {"rtol": 1e-4, "atol": 1e-6, "steps": 1}
    together = solve(lambda s, y: wild(rates, y), y, gaps, tableau(name), **options)
    for i in range(len(rows)):
        one = slice(i, i + 1)
        alone = solve(
            lambda s, y, rate=rates[one]: wild(rate, y), y[one], gaps[one], tableau(name), **options
        )
        assert close(together[one], alone, 1e-6 if dtype == torch.float32 else 1e-12)


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float32, 1e-6), (FLOAT64, 1e-12)])
@pytest.mark.parametrize("name", ADAPTIVE)
def test_batch_mates_never_matter_to_a_network_either(name, dtype, tolerance):
    net = Net(dtype=dtype)
    y = states(257, dtype=dtype)
    gaps = torch.logspace(-4, 1, 257, dtype=dtype)[:, None]
    with torch.no_grad():
        together = solve(net, y, gaps, tableau(name))
        for i in range(0, 257, 8):
            alone = solve(net, y[i : i + 1], gaps[i : i + 1], tableau(name))
            assert close(together[i : i + 1], alone, tolerance)


@pytest.mark.parametrize("name", ALL)
def test_a_number_of_steps_per_row_equals_separate_calls(name):
    net, y = Net(), states()
    steps = torch.tensor([[1], [4], [2], [3], [7]])
    together = solve_fixed(net, y, GAPS, tableau(name), steps)
    for i, count in enumerate(steps[:, 0].tolist()):
        one = slice(i, i + 1)
        alone = solve_fixed(net, y[one], GAPS[one], tableau(name), count)
        assert close(together[one], alone, 1e-14)
    same = solve_fixed(net, y, GAPS, tableau(name), torch.full((5, 1), 3))
    assert torch.equal(same, solve_fixed(net, y, GAPS, tableau(name), 3))


@pytest.mark.parametrize("name", ALL)
def test_a_field_is_asked_about_the_gap_only_with_one_time_per_row(name):
    field, seen = counted(Net())
    for steps in (3, torch.tensor([[1], [4], [2], [3], [7]])):
        solve(field, states(), 9 * GAPS, tableau(name), steps=steps)
    assert all(s.shape == (5, 1) and s.min() >= 0 and s.max() <= 1 for s in seen)


def test_accepted_steps_of_a_row_sum_to_its_gap_exactly():
    taken = torch.zeros_like(GAPS)
    method = tableau("dopri5")
    for _, part in adaptive_steps(Net(), states(), 30 * GAPS, method, rtol=1e-9, atol=1e-9):
        taken += part
    assert torch.equal(taken, (GAPS > 0).to(FLOAT64))


# --- gaps of zero -----------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", [torch.float32, FLOAT64])
@pytest.mark.parametrize("name", ALL)
@pytest.mark.parametrize("adjoint", [False, True])
def test_a_gap_of_zero_keeps_the_state_to_the_last_bit(name, dtype, adjoint):
    net, y = Net(dtype=dtype), states(dtype=dtype)
    gaps = 3 * GAPS.to(dtype)
    parameters = list(net.parameters()) if adjoint else None
    for steps in (2, torch.tensor([[1], [4], [2], [3], [7]])):
        end = solve(net, y, gaps, tableau(name), steps=steps, adjoint_parameters=parameters)
        assert torch.equal(end[3], y[3])
        assert not torch.equal(end[0], y[0])


@pytest.mark.parametrize("name", ADAPTIVE)
def test_a_batch_of_zero_gaps_or_of_no_rows_costs_no_evaluation(name):
    field, seen = counted(Net())
    assert torch.equal(solve(field, states(), 0 * GAPS, tableau(name)), states())
    assert solve(field, states()[:0], GAPS[:0], tableau(name)).shape == (0, 4)
    assert not seen


@pytest.mark.parametrize("name", ALL)
@pytest.mark.parametrize("adjoint", [False, True])
def test_the_gradient_of_a_zero_gap_is_the_slope_there(name, adjoint):
    field = lambda s, y: y**2  # noqa: E731
    y, gaps = states(), torch.zeros(5, 1, dtype=FLOAT64, requires_grad=True)
    end = solve(field, y, gaps, tableau(name), adjoint_parameters=[] if adjoint else None)
    assert torch.equal(end, y)
    (gradient,) = torch.autograd.grad(end.sum(), gaps)
    assert close(gradient, (y**2).sum(dim=1, keepdim=True), 1e-14)


# --- gradients --------------------------------------------------------------------------------


def gradients(
    net: Net, method: str, *, gaps: Tensor = GAPS, scale: float = 1.0, adjoint: bool, **options
) -> list[Tensor]:
    """Of a loss with respect to the states, the gaps and all weights."""
    y = states().requires_grad_()
    gaps = gaps.clone().requires_grad_()
    weights = list(net.parameters())
    end = solve(
        net, y, gaps, tableau(method), adjoint_parameters=weights if adjoint else None, **options
    )
    return list(torch.autograd.grad(scale * torch.sin(end).sum(), [y, gaps, *weights]))


def assert_close(got: list[Tensor], expected: list[Tensor], tolerance: float) -> None:
    assert len(got) == len(expected)
    for one, other in zip(got, expected, strict=True):
        assert close(one, other, tolerance)


@pytest.mark.parametrize("name", ALL)
@pytest.mark.parametrize("steps", [1, 3, torch.tensor([[1], [2], [4], [1], [2]])], ids=str)
def test_gradients_through_the_steps_pass_gradcheck(name, steps):
    net = Net(size=2, hidden=3, seed=3)
    # Gaps of one step each: the step sizes of longer ones are constants only for autograd.
    gaps = 0.05 * GAPS + 0.01
    options = {"steps": steps, "rtol": 1e-4, "atol": 1e-6}

    def function(y: Tensor, gaps: Tensor, *_: Tensor) -> Tensor:
        return solve(net, y, gaps, tableau(name), **options)

    y, gaps = states(5, 2).requires_grad_(), gaps.requires_grad_()
    assert torch.autograd.gradcheck(function, (y, gaps, *net.parameters()))


@pytest.mark.parametrize("name", ALL)
def test_the_adjoint_agrees_with_backpropagation_through_a_fine_solver(name):
    net = Net(seed=5)
    gaps = GAPS + 0.2
    expected = gradients(net, "rk4", gaps=gaps, adjoint=False, steps=60)
    steps, tolerance = {"euler": (600, 1e-2), "midpoint": (60, 1e-3), "heun": (60, 1e-3)}.get(
        name, (60, 1e-6)
    )
    for adjoint in (True, False):
        options = {"steps": steps, "rtol": 1e-8, "atol": 1e-8, "adjoint": adjoint}
        assert_close(gradients(net, name, gaps=gaps, **options), expected, tolerance)


@pytest.mark.parametrize("name", ["rk4", *ADAPTIVE])
def test_the_adjoint_passes_gradcheck(name):
    net = Net(size=2, hidden=3, seed=3)
    options = {"steps": 20, "rtol": 1e-8, "atol": 1e-10, "adjoint_parameters": [*net.parameters()]}

    def function(y: Tensor, gaps: Tensor, *_: Tensor) -> Tensor:
        return solve(net, y, gaps, tableau(name), **options)

    y, gaps = states(3, 2).requires_grad_(), GAPS[:3].clone().requires_grad_()
    assert torch.autograd.gradcheck(function, (y, gaps, *net.parameters()))


def test_the_adjoint_equals_that_of_torchdiffeq():
    net = Net(seed=4)
    got = gradients(net, "dopri5", adjoint=True, rtol=1e-9, atol=1e-9)
    y = states().requires_grad_()
    total = torch.zeros((), dtype=FLOAT64)
    for row, gap in zip(y, GAPS[:, 0], strict=True):
        if gap == 0:
            total = total + torch.sin(row).sum()
            continue
        end = torchdiffeq.odeint_adjoint(
            lambda t, y, gap=gap: net((t / gap).reshape(1, 1), y),
            row[None],
            torch.stack([torch.zeros_like(gap), gap]),
            method="dopri5",
            rtol=1e-9,
            atol=1e-9,
            adjoint_params=tuple(net.parameters()),
        )[-1]
        total = total + torch.sin(end).sum()
    expected = torch.autograd.grad(total, [y, *net.parameters()])
    assert_close([got[0], *got[2:]], list(expected), 1e-7)


@pytest.mark.parametrize("name", ["rk4", "dopri5"])
def test_the_adjoint_reaches_tensors_with_a_row_per_row_that_are_not_leaves(name):
    net, options = Net(seed=6), {"steps": 50, "rtol": 1e-8, "atol": 1e-8}
    raw = states(5, 1, seed=8).requires_grad_()
    found = []
    for adjoint in (False, True):
        rates = nn.functional.softplus(raw) * GAPS.sqrt()
        field = partial(lambda s, y, rates: net(s, y) - rates * y, rates=rates)
        parameters = [*net.parameters(), rates] if adjoint else None
        end = solve(field, states(), GAPS, tableau(name), adjoint_parameters=parameters, **options)
        end = solve(field, end, GAPS, tableau(name), adjoint_parameters=parameters, **options)
        found.append(list(torch.autograd.grad(end.square().sum(), [raw, *net.parameters()])))
    assert_close(found[1], found[0], 1e-6)


@pytest.mark.parametrize("name", ["midpoint", "tsit5"])
def test_the_adjoint_keeps_rows_apart(name):
    net, gaps = Net(seed=7), torch.tensor([[0.01], [4.0], [0.5], [0.0], [30.0]], dtype=FLOAT64)
    options = {"steps": 10, "adjoint_parameters": list(net.parameters())}

    def ends(rows: slice) -> tuple[Tensor, Tensor]:
        y = states()[rows].requires_grad_()
        end = solve(net, y, gaps[rows], tableau(name), **options)
        return torch.autograd.grad(end.sum(), [y, *net.parameters()])

    together = ends(slice(None))
    alone = [ends(slice(i, i + 1)) for i in range(5)]
    for i in range(5):
        assert close(together[0][i], alone[i][0][0], 1e-12)
    for j in range(1, len(together)):
        assert close(together[j], torch.stack([one[j] for one in alone]).sum(dim=0), 1e-11)


@pytest.mark.parametrize("name", ["rk4", "dopri5"])
def test_the_adjoint_of_a_tiny_loss_is_as_exact_as_that_of_a_large_one(name):
    net, options = Net(), {"adjoint": True, "gaps": 5 * GAPS, "rtol": 1e-3, "atol": 1e-3}
    large, tiny = gradients(net, name, **options), gradients(net, name, scale=2.0**-60, **options)
    assert_close([2.0**60 * one for one in tiny], large, 1e-13)


def test_the_adjoint_of_a_field_without_state_or_without_gradient_is_known():
    y, gaps = states().requires_grad_(), GAPS.clone().requires_grad_()
    unused = torch.ones(3, dtype=FLOAT64, requires_grad=True)
    field = lambda s, y: (2 * s).expand_as(y)  # noqa: E731
    end = solve(field, y, gaps, tableau("dopri5"), adjoint_parameters=[unused])
    assert close(end, (y + gaps).detach(), 1e-14)
    got = torch.autograd.grad(end.sum(), [y, gaps, unused])
    expected = [torch.ones_like(y), torch.full_like(gaps, 4.0), torch.zeros_like(unused)]
    assert_close(list(got), expected, 1e-14)


def test_the_adjoint_can_be_asked_twice_and_notices_changed_weights():
    net = Net()
    weights = list(net.parameters())
    y = states().requires_grad_()
    end = solve(net, y, GAPS, tableau("dopri5"), adjoint_parameters=weights).sum()
    first = torch.autograd.grad(end, [y, *weights], retain_graph=True)
    second = torch.autograd.grad(end, [y, *weights], retain_graph=True)
    assert all(torch.equal(a, b) for a, b in zip(first, second, strict=True))
    with torch.no_grad():
        weights[0].mul_(2)
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        torch.autograd.grad(end, y)


@pytest.mark.parametrize("name", ["euler", "rk4", "dopri5"])
def test_the_adjoint_works_without_gradients_and_with_frozen_weights(name):
    net = Net(dtype=torch.float32).requires_grad_(False)
    y = states(dtype=torch.float32)
    gaps = GAPS.float()
    parameters = list(net.parameters())
    plain = solve(net, y, gaps, tableau(name))
    assert torch.equal(solve(net, y, gaps, tableau(name), adjoint_parameters=parameters), plain)
    y.requires_grad_()
    solve(net, y, gaps, tableau(name), adjoint_parameters=parameters).sum().backward()
    assert y.grad is not None
    with torch.no_grad():
        got = solve(net, y, gaps, tableau(name), adjoint_parameters=parameters)
    assert torch.equal(got, plain)


class Kept:
    """A tensor that autograd saved, and how many there are and were at most."""

    alive = most = 0

    def __init__(self, value: Tensor) -> None:
        self.value = value.detach()  # a saved output would hold its own node
        Kept.alive += 1
        Kept.most = max(Kept.most, Kept.alive)

    def __del__(self) -> None:
        Kept.alive -= 1


def most_kept(*, adjoint: bool, **options) -> tuple[int, int]:
    """Largest number of saved tensors after the forward pass, and at any time."""
    gc.collect()
    Kept.alive = Kept.most = 0
    net = Net()
    weights = list(net.parameters())
    with torch.autograd.graph.saved_tensors_hooks(Kept, lambda kept: kept.value):
        end = solve(net, states(), GAPS, adjoint_parameters=weights if adjoint else None, **options)
        forward = Kept.alive
        end.sum().backward()
    return forward, Kept.most


def test_the_memory_of_the_adjoint_does_not_grow_with_the_steps():
    few = most_kept(adjoint=True, tableau=tableau("rk4"), steps=2)
    many = most_kept(adjoint=True, tableau=tableau("rk4"), steps=64)
    assert few == many
    assert few[0] == 2 + len(list(Net().parameters()))
    loose = most_kept(adjoint=True, tableau=tableau("dopri5"), rtol=1e-6, atol=1e-6)
    tight = most_kept(adjoint=True, tableau=tableau("dopri5"), rtol=1e-10, atol=1e-10)
    assert loose == tight
    through = [most_kept(adjoint=False, tableau=tableau("rk4"), steps=n)[0] for n in (2, 64)]
    assert through[1] > 20 * through[0]


# --- what goes wrong --------------------------------------------------------------------------


@pytest.mark.parametrize("name", ADAPTIVE)
@pytest.mark.parametrize("adjoint", [False, True])
def test_a_field_that_turns_to_nan_stops_with_the_row_and_the_gap(name, adjoint):
    def field(s: Tensor, y: Tensor) -> Tensor:
        return torch.where((s > 0.5) & (GAPS == 2.5), torch.nan, -y)

    parameters = [] if adjoint else None
    with pytest.raises(
        DivergenceError,
        match=rf"{name} stopped in row 2 after \d+ steps, 50 % into its gap of 2.5: even the "
        "smallest step misses the tolerance",
    ):
        solve(field, states(), GAPS, tableau(name), adjoint_parameters=parameters)


def test_a_state_a_gap_or_a_field_that_is_not_finite_is_named():
    method, broken = tableau("dopri5"), states()
    broken[1, 2] = torch.nan
    with pytest.raises(DivergenceError, match=r"row 1 .*the state is not finite there"):
        solve(Net(), broken, GAPS, method)
    with pytest.raises(DivergenceError, match=r"row 0 .*the vector field is not finite there"):
        solve(lambda s, y: y / 0, states(), GAPS, method)
    gaps = GAPS.clone()
    gaps[4] = torch.inf
    with pytest.raises(DivergenceError, match=r"row 4 .*gap of inf: the gap is not finite"):
        solve(Net(), states(), gaps, method)


def test_too_many_steps_stop_with_the_number_and_the_fix():
    rates = torch.tensor([[1.0], [1e6]], dtype=FLOAT64)
    with pytest.raises(
        DivergenceError,
        match=r"row 1 after 50 steps, .* of 1: the tolerance needs more; use a looser "
        "tolerance, a shorter longest gap, or a solver of fixed steps",
    ):
        solve_adaptive(
            lambda s, y: -rates * y,
            states(2),
            torch.ones(2, 1, dtype=FLOAT64),
            tableau("dopri5"),
            rtol=1e-6,
            atol=1e-6,
            max_steps=50,
        )


def test_a_failure_on_the_way_back_says_so():
    class Trap(torch.autograd.Function):
        @staticmethod
        def forward(ctx, y):
            return -y

        @staticmethod
        def backward(ctx, gradient):
            return gradient * torch.nan

    y = states().requires_grad_()
    end = solve(lambda s, y: Trap.apply(y), y, GAPS, tableau("dopri5"), adjoint_parameters=[])
    with pytest.raises(DivergenceError, match="backward pass of the adjoint, dopri5 stopped in"):
        end.sum().backward()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"duration": GAPS[:, 0]}, r"shapes \(5, 4\) and \(5,\), expected .*one gap per row"),
        ({"duration": GAPS[:1]}, r"shapes \(5, 4\) and \(1, 1\)"),
        ({"duration": GAPS.float()}, r"duration torch.float32.*duration.to\(torch.float64\)"),
        ({"steps": 0}, "steps is 0, expected 1 or more"),
        ({"steps": torch.tensor([[1], [2], [0], [1], [1]])}, r"0 for row 2, .*clamp\(min=1\)"),
        ({"steps": torch.ones(5, 1)}, "expected a number or integers of shape"),
        ({"steps": torch.ones(5, dtype=torch.int64)}, r"of shape \(5, 1\), one per row"),
        ({"tableau": tableau("tsit5"), "atol": 0.0}, "atol above 0"),
        ({"tableau": tableau("tsit5"), "rtol": math.nan}, "rtol is nan"),
    ],
)
@pytest.mark.parametrize("adjoint", [False, True])
def test_wrong_arguments_say_what_is_expected(arguments, message, adjoint):
    right = {"y": states(), "duration": GAPS, "tableau": tableau("rk4")}
    parameters = [] if adjoint else None
    with pytest.raises(InputError, match=message):
        solve(Net(), **{**right, **arguments}, adjoint_parameters=parameters)


def test_a_method_without_error_estimate_is_no_adaptive_solver():
    with pytest.raises(InputError, match=r"'rk4' does not estimate .* one of: dopri5, tsit5; or"):
        solve_adaptive(Net(), states(), GAPS, tableau("rk4"), rtol=1e-4, atol=1e-6)
