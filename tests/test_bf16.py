"""Products in bfloat16 in the compiled backend: values, gradients, bits, trainings."""

from __future__ import annotations

import statistics
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import pytest
import torch
from model_helpers import dataset
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
from test_kernels import BITS, cut
from torch import Tensor
from torch.overrides import TorchFunctionMode

import offbeat as ob
from offbeat import direct, doctor, kernels, training
from offbeat.kernels import cpu, reference

SETS = cpu.bf16_sets() or ["none"]
needs_bf16 = pytest.mark.skipif(
    not cpu.bf16_sets(), reason="this processor has neither AMX nor AVX512-BF16"
)
every_set = pytest.mark.parametrize("name", SETS)
UNIT = 2.0**-24
"""Largest relative error of one operation of float32."""


def rounded(x: Tensor) -> Tensor:
    """The nearest numbers of bfloat16."""
    return x.to(torch.float32).to(torch.bfloat16).to(x.dtype)


# --- one product ----------------------------------------------------------------------------------


@needs_bf16
@every_set
@pytest.mark.parametrize(
    ("rows", "inputs", "outputs"),
    [(1, 1, 1), (5, 33, 17), (33, 64, 100), (100, 31, 257), (777, 14, 5), (40, 1100, 48)],
)
def test_a_product_is_that_of_rounded_operands_with_the_error_of_float32_sums(
    rows: int, inputs: int, outputs: int, name: str
) -> None:
    """A sum of n products of bfloat16, each exact, and its additions in float32, in any order:
    the error is at most 2 n u times the sum of the sizes, where u = 2^-24."""
    generator = torch.Generator().manual_seed(rows)
    x, weight, bias, to_y = (
        torch.randn(*shape, generator=generator)
        for shape in ((rows, inputs), (outputs, inputs), (outputs,), (rows, outputs))
    )
    leaves = [tensor.requires_grad_() for tensor in (weight, x)]
    y = cpu.perceptron(((weight, bias),), x, "tanh", name)
    to_weight, to_x = torch.autograd.grad(y, leaves, to_y)
    x, weight, to_y = (rounded(tensor.detach().double()) for tensor in (x, weight, to_y))
    for got, a, b, start in (
        (y.detach(), x, weight.t(), bias.double()),
        (to_x, to_y, weight, torch.zeros(())),
        (to_weight, to_y.t(), x, torch.zeros(())),
    ):
        n = a.shape[1] + 1
        limit = 2 * n * UNIT * (a.abs() @ b.abs() + start.abs())
        assert bool(((got.double() - (a @ b + start)).abs() <= limit).all())


# --- a scan ---------------------------------------------------------------------------------------


class _Product(torch.autograd.Function):
    """x w^T of rounded operands, with gradients of rounded operands."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, weight: Tensor) -> Tensor:
        ctx.save_for_backward(rounded(x), rounded(weight))
        return rounded(x) @ rounded(weight).t()

    @staticmethod
    def backward(ctx: Any, to_y: Tensor) -> tuple[Tensor, Tensor]:  # type: ignore[override]
        x, weight = ctx.saved_tensors
        to_y = rounded(to_y)
        to_x, flat = to_y @ weight, to_y.reshape(-1, to_y.shape[-1])
        return to_x, flat.t() @ x.reshape(-1, x.shape[-1])


class Rounding(TorchFunctionMode):
    """Products of the reference backend have rounded operands, but those of some weights."""

    def __init__(self, exact: tuple[Tensor, ...]) -> None:
        self.exact = exact

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        if func is torch.nn.functional.linear and all(args[1] is not t for t in self.exact):
            return _Product.apply(args[0], args[1]) + args[2]  # type: ignore[no-untyped-call]
        if func is torch.addmm:
            return args[0] + _Product.apply(args[1], args[2].t())  # type: ignore[no-untyped-call]
        return func(*args, **(kwargs or {}))


def scan_with(name: str, case: Problem) -> dict[str, Tensor]:
    return run(lambda *a: cpu.scan(*a, name), case)


@needs_bf16
@every_set
@pytest.mark.parametrize("flow", list(FLOWS))
@pytest.mark.parametrize("cell", list(CELLS))
def test_a_scan_is_that_of_rounded_operands(cell: str, flow: str, name: str) -> None:
    """The reference backend in float64, with operands rounded where the kernel rounds them.

    Both round the same numbers up to errors of float32, so tensors agree as those of float32 do
    (1e-5 of their largest entry) unless such an error crosses the middle between two numbers of
    bfloat16. That happens to few operands of a scan, and reaches all that depends on them: a
    quarter of the tensors must be free of it, and where it happens, it may change a result by no
    more than all roundings of the scan together do.
    """
    errors = []
    for seed in range(3):
        anchored = cell not in ("none", "start") and seed == 1
        case = problem(
            seed=seed,
            batch=(50, 7, 18)[seed],
            rows=6,
            channels=4,
            hidden=(9, 20, 33)[seed],
            units=((7, 5), (40, 35), (33, 70))[seed],
            cell=cell,
            flow=flow,
            anchored=anchored,
            trend=anchored,
            decay=("none", "delta", "elapsed")[seed],
            input_decay=not anchored and cell not in ("none", "start"),
            time_inputs=seed,
            activation="silu" if seed == 2 else "tanh",
            padded=True,
            scale=0.3,
        )
        exact = case.double()
        decay = () if exact.weights.decay is None else exact.weights.decay
        with Rounding(tuple(decay)):
            expected = run(reference.scan, exact)
        plain, got = run(reference.scan, exact), scan_with(name, case)
        own = {key: largest_error(got[key].double(), value) for key, value in expected.items()}
        rounding = max(largest_error(plain[key], value) for key, value in expected.items())
        for key, error in own.items():
            assert error <= 1e-5 + rounding, (seed, key)
        errors += own.values()
    assert statistics.quantiles(errors)[0] <= 1e-5


# --- the same bits --------------------------------------------------------------------------------


@needs_bf16
@every_set
@pytest.mark.parametrize("model", list(BITS))
def test_threads_groups_and_a_tape_change_no_bit(
    model: str, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    case = problem(
        seed=5, batch=150, rows=9, channels=4, hidden=37, units=(40, 70), padded=True, **BITS[model]
    )
    found = []
    with threads_restored():
        for n, group, limit in ((1, 0, 2**25), (2, 0, 2**25), (3, 1, 0), (7, 4, 0)):
            torch.set_num_threads(n)
            monkeypatch.setattr(cpu, "ROWS_AT_ONCE", group)
            monkeypatch.setattr(cpu, "TAPE_LIMIT", limit)
            found.append(scan_with(name, case))
    assert_same_bits(found)


@needs_bf16
@every_set
@pytest.mark.parametrize("model", list(BITS))
def test_batch_mates_padding_and_place_change_no_bit(model: str, name: str) -> None:
    size: Any = {"batch": 37, "rows": 8, "channels": 4, "hidden": 17, "units": (33, 20)}
    case = problem(seed=6, padded=True, **size, **BITS[model])
    rows, state = case.rows, case.state
    assert rows.length is not None
    with torch.no_grad():
        whole = cpu.scan(case.spec, case.weights, rows, state, name)
        for i in range(0, 37, 3):
            n = int(rows.length[i])
            part = cut(rows, slice(i, i + 1), slice(0, n))
            alone = cpu.scan(case.spec, case.weights, part, state[i : i + 1], name)
            for got, expected in zip(alone, whole, strict=True):
                assert torch.equal(got[0], expected[i, :n])
        case = problem(seed=7, **size, **BITS[model])
        whole = cpu.scan(case.spec, case.weights, case.rows, case.state, name)
        for n in range(1, 37):
            part = cut(case.rows, slice(n), slice(None))
            some = cpu.scan(case.spec, case.weights, part, case.state[:n], name)
            for got, expected in zip(some, whole, strict=True):
                assert torch.equal(got, expected[:n]), n


@needs_bf16
@every_set
def test_lanes_without_a_trajectory_give_no_gradient(name: str) -> None:
    """What is not a number in one trajectory does not pass to the gradient of others."""
    generator = torch.Generator().manual_seed(3)
    weight, bias = torch.randn(5, 4, generator=generator), torch.zeros(5)
    x = torch.randn(19, 4, generator=generator)
    x[0] = float("nan")
    weight.requires_grad_()
    y = cpu.perceptron(((weight, bias),), x, "tanh", name)
    assert bool(y[0].isnan().all())
    assert bool(y[1:].isfinite().all())
    alone = cpu.perceptron(((weight, bias),), x[1:], "tanh", name)
    assert torch.equal(alone, y[1:])
    (to_weight,) = torch.autograd.grad(alone.sum(), [weight])
    assert bool(to_weight.isfinite().all())


# --- trainings ------------------------------------------------------------------------------------

CONFIG = ob.TrainConfig(epochs=6, batch_size=8, precision="bf16")


def losses(result: ob.FitResult) -> list[float]:
    return [record.train_mse for record in result.history]


@needs_bf16
@pytest.mark.parametrize("model", ["gru_d", "ode_gru_d", "anchored_trend", "lstm"])
def test_a_training_has_nearly_the_losses_of_float32(model: str, tmp_path: Any) -> None:
    data, later = (
        ob.mask_out(dataset(24), 0.5, seed=0),
        ob.mask_out(dataset(8, seed=7), 0.5, seed=1),
    )
    scores, found, models = {}, {}, {}
    for precision in ("float32", "bf16"):
        models[precision] = made = ob.make_model(model, data, hidden_size=12, seed=3)
        config = replace(CONFIG, precision=precision)
        result = ob.fit(made, data, validation=later, config=config, progress=False)
        found[precision] = losses(result)
        scores[precision] = result.history[-1].validation_mse
        assert result.recipe.precision == precision
    assert found["bf16"] != found["float32"]
    assert found["bf16"] == pytest.approx(found["float32"], rel=0.02)
    assert scores["bf16"] == pytest.approx(scores["float32"], rel=0.02)
    # All but the steps of the training is in float32.
    trained = models["bf16"]
    assert trained.backend()[0] == cpu.instruction_sets()[0]
    ob.save_model(trained, tmp_path / "model")
    read = ob.load_model(tmp_path / "model")
    for one, other in zip(ob.predict(trained, later), ob.predict(read, later), strict=True):
        assert (one.values == other.values).all()


@needs_bf16
def test_steps_with_and_without_autograd_have_the_same_bits(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    data = ob.mask_out(dataset(24), 0.5, seed=0)
    taken: list[bool] = []

    def watched(*args: Any) -> Any:
        step = direct.direct_step(*args)
        taken.append(step is not None)
        return step

    found = []
    for way in (watched, lambda *_: None):
        monkeypatch.setattr(training, "direct_step", way)
        model = ob.make_model("ode_gru_d", data, hidden_size=12, seed=3)
        found.append(losses(ob.fit(model, data, config=CONFIG, progress=False)))
    assert taken
    assert all(taken)
    assert found[0] == found[1]


@needs_bf16
def test_a_training_in_bf16_is_continued_with_the_same_bits(tmp_path: Any) -> None:
    data = ob.mask_out(dataset(24), 0.5, seed=0)
    whole = ob.fit(ob.make_model("ode_gru_d", data, seed=3), data, config=CONFIG, progress=False)
    for epochs in (2, 6):
        model = ob.make_model("ode_gru_d", data, seed=3)
        config = replace(CONFIG, epochs=epochs)
        last = ob.fit(model, data, config=config, out=tmp_path / "run", progress=False)
    assert losses(last) == losses(whole)


# --- what is refused ------------------------------------------------------------------------------


@pytest.fixture
def compiled() -> Iterator[None]:
    if not cpu.instruction_sets():
        pytest.skip("the compiled backend was not built")
    with kernels.use("auto"):
        yield


@pytest.mark.usefixtures("compiled")
def test_a_processor_without_such_products_is_refused_in_one_line(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(cpu, "bf16_sets", list)
    data = dataset(8)
    with pytest.raises(ob.InputError, match=r"'bf16' needs a processor with AVX512-BF16") as error:
        ob.fit(ob.make_model("gru", data), data, config=CONFIG, progress=False)
    assert "\n" not in str(error.value)
    assert doctor.examine()["precision bf16"] == "not on this CPU"
    with pytest.raises(ob.InputError, match="this processor runs"), kernels.use("amx_bf16"):
        pass


@needs_bf16
@pytest.mark.usefixtures("compiled")
def test_a_precision_and_a_selection_that_disagree_are_refused() -> None:
    data = dataset(8)
    model = ob.make_model("gru", data)
    with (
        kernels.use("baseline"),
        pytest.raises(ob.InputError, match=r"'bf16' runs in .*bf16, but .* selects baseline"),
    ):
        ob.fit(model, data, config=CONFIG, progress=False)
    with pytest.raises(ob.InputError, match="for models in float32"):
        ob.fit(ob.make_model("gru", data).double(), data, config=CONFIG, progress=False)
    case = problem(seed=1, batch=2, rows=2, channels=2, hidden=2, cell="gru", flow="none").double()
    with pytest.raises(ob.InputError, match="has float32 alone"):
        scan_with(SETS[0], case)


@needs_bf16
def test_a_name_selects_products_in_bfloat16_and_nothing_else_does() -> None:
    assert not set(cpu.instruction_sets()) & set(SETS)
    assert doctor.examine()["precision bf16"] == ", ".join(SETS)
    for name in SETS:
        with kernels.use(name) as variant:
            assert variant == name
