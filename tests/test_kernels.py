"""The backends of the scan: values, gradients, bits, memory."""

from __future__ import annotations

import gc
import itertools
import math
import os
import shutil
import weakref
from dataclasses import replace
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from model_helpers import SMALL, dataset, draw_weights
from scan_problems import (
    CELLS,
    FLOWS,
    Problem,
    assert_same_bits,
    largest_error,
    problem,
    run,
    threads_restored,
)

import offbeat as ob
from offbeat import kernels
from offbeat.kernels import StepInputs, StepTable, cpu, reference, spec
from offbeat.models.zoo import ZOO

needs_cpu = pytest.mark.skipif(
    not cpu.instruction_sets(), reason="the compiled backend was not built"
)
SETS = cpu.instruction_sets() or ["none"]
every_set = pytest.mark.parametrize("name", SETS)
TOLERANCE = {torch.float32: 1e-5, torch.float64: 1e-10}

LEAST = {torch.float32: 1e-2, torch.float64: 1e-3}
"""Size at which a tensor of pure cancellation counts, as a fraction of all tensors' largest entry.

A gradient of a weight is a sum over trajectories and rows, here of n <= 480 terms. Terms as large
as the largest entry L that cancel leave an error of up to n u L, whatever the order of the sum,
where u is half of the spacing of numbers at 1. In double precision n u = 480 x 1.1e-16 = 5e-14, and
1e-3 x 1e-10 = 1e-13 is above it (largest of 792 random problems: 1.2e-6 x 1e-10). In
single precision, 1e-3 x 1e-5 would be 0.17 u, less than a single rounding of one term, which no
order of the sum attains; 1e-2 x 1e-5 is 1.7 u, far below n u. What is larger is allowed only as far
as the reference backend has it, too.
"""


def agree(case: Problem, *, keep: bool = True, strict: bool = True) -> None:
    """Every instruction set runs this very call, or raises; all equal the reference backend.

    Where it is not `strict`, shapes are random, and a tensor may be all cancellation: its largest
    entry counts as at least the fraction `LEAST` of all tensors' largest, and in single precision
    it is enough to be as near to double precision as the reference backend is, times three. Its
    error is the largest of three: of these numbers, and of those whose first state is the next
    number above or below, as one error alone may be small by chance.
    """
    expected = run(reference.scan, case)
    exact = expected
    off = dict.fromkeys(expected, 0.0)
    if not strict and case.state.dtype == torch.float32:
        exact = run(reference.scan, case.double())
        others = (case.nudged(-math.inf), case.nudged(math.inf))
        near = [(run(reference.scan, c), run(reference.scan, c.double())) for c in others]
        near.append((expected, exact))
        off = {
            name: max(float((found[name] - true[name]).abs().max()) for found, true in near)
            for name in expected
        }
    fraction = 0.0 if strict else LEAST[case.state.dtype]
    least = fraction * max(float(v.abs().max()) for v in expected.values())
    allowed = {}
    for name, value in expected.items():
        assert bool(value.isfinite().all()), name
        scale = max(float(exact[name].abs().max()), least)
        allowed[name] = max(TOLERANCE[value.dtype] * scale, 3 * off[name])
    for instruction_set in SETS:
        with pytest.MonkeyPatch.context() as patch:
            if not keep:
                patch.setattr(cpu, "TAPE_LIMIT", 0)
            got = scan_with(instruction_set, case)
        for name, limit in allowed.items():
            found = float((got[name] - exact[name]).abs().max())
            assert found <= limit, (
                f"{name}, {instruction_set}: off by {found:.2g}, allowed {limit:.2g}"
            )


def scan_with(instruction_set: str, case: Problem) -> dict[str, torch.Tensor]:
    """Results and gradients of the compiled backend with one instruction set."""
    return run(lambda *a: cpu.scan(*a, instruction_set), case)


def test_the_compiled_backend_is_there_wherever_it_could_be_built() -> None:
    """The package also installs without a compiler, so a failed build must fail here."""
    compilers = filter(None, (os.environ.get("CXX"), "c++", "g++", "clang++"))
    if not any(shutil.which(compiler) for compiler in compilers):
        pytest.skip("no C++ compiler is here")
    assert cpu.instruction_sets(), cpu.why_not
    assert kernels.backend()[0] == cpu.instruction_sets()[0]


# --- equal to the reference -----------------------------------------------------------------------


@needs_cpu
@pytest.mark.parametrize("flow", list(FLOWS))
@pytest.mark.parametrize("cell", list(CELLS))
@settings(max_examples=6, deadline=None)
@given(data=st.data())
def test_the_compiled_backend_equals_the_reference(cell: str, flow: str, data: Any) -> None:
    """Every cell, solver, anchored state and self-feeding, over random shapes, masks and gaps."""
    case = data.draw(problems(cell, flow))
    agree(case, keep=data.draw(st.booleans()), strict=False)


@st.composite
def problems(draw: Any, cell: str, flow: str) -> Problem:
    plain = cell in ("none", "set")
    anchored = cell != "none" and draw(st.booleans())
    return problem(
        seed=draw(st.integers(0, 10**6)),
        batch=draw(st.integers(1, 40)),
        rows=draw(st.integers(1, 12)),
        channels=draw(st.integers(1, 5)),
        hidden=draw(st.integers(1, 9)),
        cell=cell,
        flow=flow,
        anchored=anchored,
        trend=anchored and draw(st.booleans()),
        self_feeding=not anchored and not plain and draw(st.booleans()),
        input_decay=not anchored and cell != "none" and draw(st.booleans()),
        decay=draw(st.sampled_from(["none", "delta", "elapsed"])),
        decay_rows=draw(st.sampled_from(["continuous", "every_row", "observed_rows"])),
        time_inputs=draw(st.sampled_from([0, 1, 3])),
        activation=draw(st.sampled_from(["tanh", "silu"])),
        bounded=draw(st.booleans()),
        padded=draw(st.booleans()),
        dtype=draw(st.sampled_from([torch.float32, torch.float64])),
    )


LARGE = {
    "ODE-GRU-D of the thesis": {
        "cell": "gru", "flow": "euler", "decay": "delta", "decay_rows": "every_row",
        "input_decay": True, "units": (100, 100, 100, 100), "batch": 50, "rows": 100,
    },
    "anchored, batch 257 of 100 rows": {
        "cell": "gru", "flow": "euler", "anchored": True, "activation": "silu", "hidden": 31,
        "units": (37, 41), "batch": 257, "rows": 100, "padded": True,
    },
    "GRU-D that feeds itself": {
        "cell": "gru", "flow": "none", "decay": "delta", "decay_rows": "observed_rows",
        "input_decay": True, "self_feeding": True, "batch": 129, "rows": 101, "padded": True,
    },
    "LSTM, midpoint steps of bounded length": {
        "cell": "lstm", "flow": "midpoint, longest step", "batch": 33, "rows": 63,
        "units": (17, 23), "padded": True, "time_inputs": 1,
    },
    "GRU with the reset after, RK4, decay within the gap": {
        "cell": "gru, reset after", "flow": "rk4, several steps", "decay": "delta", "batch": 65,
        "rows": 50, "units": (19,), "padded": True,
    },
    "anchored, bounded, nodes, decay": {
        "cell": "gru", "flow": "heun, nodes", "anchored": True, "bounded": True, "decay": "delta",
        "activation": "silu", "units": (19, 23), "batch": 67, "rows": 40, "padded": True,
    },
    "a trend, nodes": {
        "cell": "gru", "flow": "euler, nodes", "anchored": True, "trend": True, "bounded": True,
        "activation": "silu", "units": (37, 41), "hidden": 32, "batch": 67, "rows": 100,
        "padded": True,
    },
    "Elman, Heun, one trajectory": {
        "cell": "elman", "flow": "heun", "batch": 1, "rows": 399, "units": (29, 13),
        "time_inputs": 3,
    },
}  # fmt: skip


@needs_cpu
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=["float32", "float64"])
@pytest.mark.parametrize("name", list(LARGE))
def test_the_compiled_backend_equals_the_reference_at_full_size(
    name: str, dtype: torch.dtype
) -> None:
    options: dict[str, Any] = {"channels": 14, "hidden": 15, **LARGE[name]}
    agree(problem(seed=7, dtype=dtype, scale=0.15, **options))


@needs_cpu
@pytest.mark.parametrize("keep", [True, False], ids=["with a tape", "without a tape"])
def test_one_trajectory_may_lie_at_a_node_and_another_between_two(keep: bool) -> None:
    """Together they take one step more than either of them."""
    case = problem(
        seed=5, batch=2, rows=1, channels=2, hidden=3, cell="gru", flow="euler, nodes", units=(4,)
    )
    first = torch.zeros(2, 1)
    rows = replace(
        case.rows, first_node=first, node=first + torch.tensor([[3.0], [0.0]]),
        gap=torch.tensor([[0.0], [0.2]]),
    )  # fmt: skip
    agree(case._replace(rows=rows), keep=keep)


@needs_cpu
@pytest.mark.parametrize("keep", [True, False], ids=["with a tape", "without a tape"])
@pytest.mark.parametrize("decay", ["none", "delta", "trend"])
def test_the_last_steps_of_a_silence_alone_have_a_gradient(decay: str, keep: bool) -> None:
    case = problem(
        seed=5, batch=21, rows=3, channels=2, hidden=3, cell="gru", flow="euler, nodes",
        decay=decay.replace("trend", "none"), bounded=True, anchored=True, trend=decay == "trend",
        units=(4,), scale=0.1, dtype=torch.float64,
    )  # fmt: skip
    assert case.rows.node is not None
    node = case.rows.node.clone()
    node[::3, 1] += spec.TRACKED_NODES + 30
    case = case._replace(rows=replace(case.rows, node=node))
    agree(case, keep=keep)
    rows, commit = case.rows, torch.ones_like(node)
    for far, reached in ((spec.TRACKED_NODES, True), (spec.TRACKED_NODES + 1, False)):
        one = replace(rows, first_node=0 * node, node=0 * node + far, commit=commit)
        before, _ = cpu.scan(case.spec, case.weights, one, case.state)
        (gradient,) = torch.autograd.grad(before[:, 0].sum(), case.state)
        assert bool((gradient != 0).any()) == reached


def assert_gradients_are_finite_differences(case: Problem) -> None:
    spec, weights, rows, state, _ = case
    inputs = (*weights.tensors(), state)

    def function(*tensors: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        return cpu.scan(spec, case.with_weights(tensors[:-1]), rows, tensors[-1])

    assert torch.autograd.gradcheck(function, inputs, atol=1e-7, rtol=1e-5)


@needs_cpu
@pytest.mark.parametrize("cell", [cell for cell in CELLS if cell != "none"])
def test_gradients_equal_finite_differences(cell: str) -> None:
    case = problem(
        seed=3, batch=3, rows=4, channels=2, hidden=3, cell=cell, flow="heun", decay="delta",
        input_decay=True, units=(4,), padded=True, dtype=torch.float64,
    )  # fmt: skip
    assert_gradients_are_finite_differences(case)


@needs_cpu
@pytest.mark.parametrize("flow", ["none", "heun", "rk4, several steps", "euler, nodes"])
@pytest.mark.parametrize("bounded", [True, False])
def test_gradients_of_a_trend_equal_finite_differences(flow: str, bounded: bool) -> None:
    case = problem(
        seed=4, batch=3, rows=4, channels=2, hidden=3, cell="gru", flow=flow, anchored=True,
        trend=True, bounded=bounded, units=(4,), padded=True, dtype=torch.float64,
    )  # fmt: skip
    assert_gradients_are_finite_differences(case)


@needs_cpu
@every_set
@pytest.mark.parametrize("activation", ["tanh", "silu"])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=["float32", "float64"])
@pytest.mark.parametrize(("rows", "sizes"), [(1, (3, 2)), (777, (15, 100, 14)), (65, (5, 9, 7, 3))])
def test_a_compiled_perceptron_equals_the_reference(
    rows: int, sizes: tuple[int, ...], dtype: torch.dtype, activation: str, name: str
) -> None:
    generator = torch.Generator().manual_seed(1)

    def drawn(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64).mul(0.4).to(dtype)

    layers = tuple(
        (drawn(o, i).requires_grad_(), drawn(o).requires_grad_())
        for i, o in itertools.pairwise(sizes)
    )
    x, weight = drawn(rows, sizes[0]).requires_grad_(), drawn(rows, sizes[-1])
    found = []
    for y in (
        cpu.perceptron(layers, x, activation, name),
        reference.perceptron(layers, x, activation),
    ):
        leaves = [x, *(t for layer in layers for t in layer)]
        found.append([y.detach(), *torch.autograd.grad((y * weight).sum(), leaves)])
    for got, expected in zip(*found, strict=True):
        assert largest_error(got, expected) <= TOLERANCE[dtype]


# --- the same bits --------------------------------------------------------------------------------

BITS = {
    "anchored": {"cell": "gru", "flow": "euler", "anchored": True, "activation": "silu"},
    "trend": {"cell": "gru", "flow": "euler", "anchored": True, "trend": True},
    "lstm": {"cell": "lstm", "flow": "rk4, several steps", "decay": "delta"},
    "gru_d": {"cell": "gru", "flow": "none", "decay": "delta", "input_decay": True},
    "bounded steps": {"cell": "gru", "flow": "midpoint, longest step", "decay": "elapsed"},
}


@needs_cpu
@every_set
@pytest.mark.parametrize("model", list(BITS))
def test_the_number_of_threads_changes_no_bit(model: str, name: str) -> None:
    case = problem(seed=5, batch=150, rows=9, channels=4, hidden=7, padded=True, **BITS[model])
    found = []
    with threads_restored():
        for n in (1, 2, 3, 7):
            torch.set_num_threads(n)
            found.append(scan_with(name, case))
    assert_same_bits(found)


@needs_cpu
@every_set
@pytest.mark.parametrize("model", list(BITS))
def test_batch_mates_padding_and_place_change_no_bit_of_a_trajectory(model: str, name: str) -> None:
    case = problem(seed=6, batch=37, rows=12, channels=4, hidden=7, padded=True, **BITS[model])
    spec, weights, rows, state, _ = case
    assert rows.length is not None
    with torch.no_grad():
        whole = cpu.scan(spec, weights, rows, state, name)
        for i in (0, 5, 36):
            n = int(rows.length[i])
            alone = cpu.scan(
                spec, weights, cut(rows, slice(i, i + 1), slice(0, n)), state[i : i + 1], name
            )
            for got, expected in zip(alone, whole, strict=True):
                assert torch.equal(got[0], expected[i, :n])


@needs_cpu
@every_set
@pytest.mark.parametrize("model", list(BITS))
def test_batches_of_any_width_have_the_same_bits(model: str, name: str) -> None:
    case = problem(seed=7, batch=21, rows=5, channels=4, hidden=7, **BITS[model])
    with torch.no_grad():
        whole = cpu.scan(*case[:4], name)
        for n in range(1, 21):
            rows = cut(case.rows, slice(n), slice(None))
            part = cpu.scan(case.spec, case.weights, rows, case.state[:n], name)
            for got, expected in zip(part, whole, strict=True):
                assert torch.equal(got, expected[:n]), n


@needs_cpu
@pytest.mark.parametrize("batch", [1, 2, 3, 4, 5, 9, 12, 17, 18, 19, 20, 21, 36, 50])
def test_narrow_blocks_have_the_gradients_of_the_reference(batch: int) -> None:
    for options in BITS.values():
        case = problem(seed=9, batch=batch, rows=6, channels=4, hidden=9, **options)
        agree(case, strict=False)


@needs_cpu
@every_set
@pytest.mark.parametrize("activation", ["tanh", "silu"])
@pytest.mark.parametrize("shifted", [True, False], ids=["of the row before", "of the row"])
def test_squares_of_a_perceptron_have_the_gradients_of_autograd(
    name: str, activation: str, shifted: bool
) -> None:
    draw = torch.Generator().manual_seed(3)
    batch, rows, width, column, sizes = 11, 13, 9, 2, (5, 17, 3)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(shape, generator=draw, dtype=torch.float64)

    states, first = (
        normal(*shape).requires_grad_() for shape in ((batch, rows, width), (1, width))
    )
    layers = [
        (normal(b, a).requires_grad_(), normal(b).requires_grad_())
        for a, b in itertools.pairwise(sizes)
    ]
    targets, index = normal(20, rows + 4, 3), torch.randperm(20, generator=draw)[:batch]
    start = first.expand(batch, width)
    read = torch.cat([start[:, None], states[:, :-1]], 1) if shifted else states
    x = read[..., column : column + sizes[0]]
    act = {"tanh": torch.tanh, "silu": torch.nn.functional.silu}[activation]
    for i, (weight, bias) in enumerate(layers):
        x = torch.nn.functional.linear(act(x) if i else x, weight, bias)
    loss = torch.nn.functional.mse_loss(x[:, 1:], targets[index][:, : rows - 1])
    trained = [t for layer in layers for t in layer]
    expected = torch.autograd.grad(2.5 * loss, [states, *trained])
    packed = torch.cat([t.detach().reshape(-1) for t in trained])
    squares, to_packed = torch.empty(batch, rows - 1, 3).double(), torch.empty_like(packed)
    to_states = torch.zeros_like(states)
    cpu.compiled.perceptron_squares(
        cpu.compiled_perceptron(sizes, activation), name, packed.numpy(),
        states.detach().numpy(), start.detach().contiguous().numpy() if shifted else None, column,
        targets.numpy(), index.numpy(), 2 / x[:, 1:].numel(), 2.5, squares.numpy(),
        to_packed.numpy(), to_states.numpy(), 2,
    )  # fmt: skip
    torch.testing.assert_close(squares.mean(), loss, rtol=1e-12, atol=0)
    torch.testing.assert_close(to_states, expected[0], rtol=1e-12, atol=1e-14)
    gradient = torch.cat([g.reshape(-1) for g in expected[1:]])
    torch.testing.assert_close(to_packed, gradient, rtol=1e-12, atol=1e-14)


@needs_cpu
@every_set
def test_when_gradients_of_weights_are_added_changes_no_bit(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    case = problem(seed=5, batch=21, rows=40, channels=4, hidden=7, **BITS["bounded steps"])
    expected = scan_with(name, case)
    for rows in (1, 3, 40):
        monkeypatch.setattr(cpu, "ROWS_AT_ONCE", rows)
        for key, value in scan_with(name, case).items():
            assert torch.equal(value, expected[key]), (rows, key)


@needs_cpu
@every_set
@pytest.mark.parametrize("model", list(BITS))
def test_rows_of_a_table_have_the_bits_of_rows_that_are_gathered(model: str, name: str) -> None:
    case = problem(seed=4, batch=30, rows=12, channels=4, hidden=7, padded=True, **BITS[model])
    picked = StepTable.of(case.rows).take(torch.tensor([29, 3, 3, 17, 0]))
    at, rows = picked.index, picked.rows
    in_place = case._replace(
        rows=picked,
        state=case.state[at].detach().requires_grad_(),
        factors=tuple(factor[at, :rows] for factor in case.factors),
    )
    gathered = in_place._replace(rows=picked.gathered())
    expected = scan_with(name, gathered)
    for key, value in scan_with(name, in_place).items():
        assert torch.equal(value, expected[key]), key


@needs_cpu
@every_set
@pytest.mark.parametrize("model", list(BITS))
def test_row_by_row_gives_the_bits_of_the_whole_sequence(model: str, name: str) -> None:
    case = problem(seed=8, batch=19, rows=11, channels=4, hidden=7, **BITS[model])
    spec, weights, rows, state, _ = case
    with torch.no_grad():
        before, after = cpu.scan(spec, weights, rows, state, name)
        for i in range(rows.rows):
            part = cut(rows, slice(None), slice(i, i + 1))
            one_before, one_after = cpu.scan(spec, weights, part, state, name)
            assert torch.equal(one_before[:, 0], before[:, i])
            assert torch.equal(one_after[:, 0], after[:, i])
            state = one_after[:, 0]


def cut(rows: StepInputs, lanes: slice, at: slice) -> StepInputs:
    """Some rows of some trajectories; none of them is padding."""
    changed: dict[str, Any] = {"length": None}
    for name in ("gap", "update", "values", "mask", "time_input", "updated", "decay_start",
                 "decay_end",
                 "delta", "last", "level_gain", "slope_gain"):  # fmt: skip
        value = getattr(rows, name)
        changed[name] = None if value is None else value[lanes, at]
    return replace(rows, **changed)


@needs_cpu
def test_padding_receives_no_gradient_and_gives_none() -> None:
    case = problem(seed=9, batch=21, rows=10, channels=3, hidden=5, cell="gru", flow="euler",
                   decay="delta", padded=True)  # fmt: skip
    length = case.rows.length
    assert length is not None
    assert int(length.min()) < 10
    padding = torch.arange(10) >= length[:, None]
    wild = replace(
        case.rows,
        values=torch.where(padding[..., None], float("nan"), case.rows.values),
        gap=torch.where(padding, 1e30, case.rows.gap),
    )
    expected = run(cpu.scan, case)
    got = run(cpu.scan, case._replace(rows=wild))
    for key, value in expected.items():
        assert torch.equal(got[key], value), key


# --- what it takes and refuses --------------------------------------------------------------------


@needs_cpu
def test_arrays_are_taken_as_they_are_or_refused() -> None:
    """A silent copy of another type or stride would be slow, and wrong where it is written to."""
    case = problem(seed=1, batch=2, rows=3, channels=2, hidden=3, cell="gru", flow="euler")
    good = {
        "gap": case.rows.gap.numpy(), "update": case.rows.update.numpy(), "updated": None,
        "values": case.rows.values.numpy(), "mask": case.rows.mask.numpy(), "time_input": None,
        "decay_start": None, "decay_end": None, "delta": None, "last": None, "mean": None,
        "use_prediction": None, "length": None,
    }  # fmt: skip
    make = cpu.compiled.StepInputs_f32
    make(**good)
    with pytest.raises(TypeError):
        make(**{**good, "values": good["values"].astype("float64")})
    with pytest.raises(TypeError):
        make(**{**good, "gap": good["gap"].astype("int32")})
    with pytest.raises(TypeError):
        make(**{**good, "length": case.rows.gap[:, 0].numpy()})


@needs_cpu
@pytest.mark.parametrize(
    ("options", "why"),
    [
        ({"solver": "dopri5"}, "chooses its own steps"),
        ({"gradient": "adjoint"}, "adjoint"),
        ({"field_units": (3,) * 17}, "more than 16 layers"),
    ],
)
def test_what_the_compiled_backend_cannot_run_goes_to_the_reference(
    options: dict[str, Any], why: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    model, batch = made("ode_rnn", options)
    rows, _ = model.step_inputs(batch)
    state = model.empty_state(len(batch)).state
    assert why in cpu.unsupported(model.spec, model.scan_parts(), rows, state)
    with pytest.raises(RuntimeError, match=why):
        cpu.scan(model.spec, model.scan_parts(), rows, state)
    monkeypatch.setattr(cpu, "scan", lambda *_: pytest.fail("the wrong backend ran"))
    model(batch)


@needs_cpu
@pytest.mark.parametrize("name", sorted(ZOO))
def test_every_model_of_the_zoo_runs_in_the_compiled_backend(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(reference, "scan", lambda *_: pytest.fail("the wrong backend ran"))
    model, batch = made(name, {})
    model(batch).mean.sum().backward()
    monkeypatch.undo()
    with kernels.use("reference"):
        monkeypatch.setattr(cpu, "scan", lambda *_: pytest.fail("the wrong backend ran"))
        model(batch)


def test_observed_values_that_need_a_gradient_go_to_the_reference_and_get_one() -> None:
    model, batch = made("anchored_ode_gru_d", {})
    batch = replace(batch, values=batch.values.clone().requires_grad_())
    model(batch).mean.sum().backward()
    gradient = batch.values.grad
    assert gradient is not None
    assert bool((gradient[batch.mask] != 0).any())
    assert bool((gradient[~batch.mask] == 0).all()), "masked values reach no prediction"


def test_a_backend_that_cannot_run_here_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ob.InputError, match="scan backend 'cuda'"), kernels.use("cuda"):
        pass
    monkeypatch.setenv("OFFBEAT_SCAN", "reference")
    assert kernels.backend() == ("reference", "selected by OFFBEAT_SCAN")
    monkeypatch.setenv("OFFBEAT_SCAN", "avx2")
    monkeypatch.setattr(cpu, "instruction_sets", list)
    with pytest.raises(ob.InputError, match="was not built"):
        kernels.backend()


def test_without_the_compiled_module_everything_runs_in_the_reference(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(cpu, "compiled", None)
    monkeypatch.setattr(cpu, "why_not", "no module")
    assert kernels.backend() == ("reference", "cpu: it was not built (no module)")
    model, batch = made("ode_gru_d", {})
    assert bool(model(batch).mean.isfinite().all())


# --- memory ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["gru_d", "ode_gru_d", "anchored_ode_gru_d"])
def test_what_a_step_records_is_freed_with_it(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """A record that its own outputs kept alive would take the memory of every step in turn."""
    model, batch = made(name, {})
    rows, _ = model.step_inputs(batch)
    kept = weakref.ref(rows.gap)
    predictions = model.run(rows).mean
    predictions.sum().backward()
    del rows
    assert kept() is not None
    del predictions, _
    gc.collect()
    assert kept() is None


def made(name: str, options: dict[str, Any]) -> tuple[ob.Model, ob.Batch]:
    data = dataset(5, seed=3)
    model = draw_weights(ob.make_model(name, data, **{**SMALL, **options}))
    return model, model.batch(data)
