"""The Triton backend of the scan, interpreted on the CPU, and compiled for GPUs without one."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import warnings
from dataclasses import replace
from typing import Any

import pytest
import torch
from model_helpers import dataset
from scan_problems import Problem, largest_error, problem, run

import offbeat as ob
from offbeat import kernels
from offbeat.errors import InputError
from offbeat.kernels import reference
from offbeat.kernels.triton import backend
from offbeat.kernels.triton import shape as shapes
from offbeat.kernels.triton.shape import Shape

pytestmark = pytest.mark.skipif(not backend.interpreted(), reason="Triton would need a GPU")
pytest.importorskip("triton")

TOLERANCE = 1e-6
"""Of float32, as a fraction of a tensor's largest entry."""

CASES: dict[str, dict[str, Any]] = {
    "GRU": {"flow": "none", "time_inputs": 1, "rows": 4},
    "GRU-D": {"flow": "none", "decay": "delta", "input_decay": True, "decay_rows": "every_row"},
    "GRU, reset after, exponential decay": {
        "cell": "gru, reset after", "flow": "none", "decay": "elapsed", "padded": True,
    },
    "decays at nodes": {"flow": "none, nodes", "decay": "delta"},
    "ODE-RNN, two blocks": {"flow": "euler", "batch": 19},
    "ODE-GRU-D": {
        "flow": "euler", "decay": "delta", "decay_rows": "observed_rows", "input_decay": True,
    },
    "several steps of a gap": {"flow": "euler, several steps", "decay": "delta", "padded": True},
    "anchored, nodes": {
        "flow": "euler, nodes", "anchored": True, "bounded": True, "activation": "silu",
        "padded": True,
    },
    "decay, Heun, nodes": {"flow": "heun, nodes", "decay": "delta", "bounded": True},
    "trend, nodes": {
        "flow": "euler, nodes", "anchored": True, "trend": True, "bounded": True,
        "activation": "silu",
    },
    "trend without a field": {"flow": "none", "anchored": True, "trend": True},
    "LSTM, RK4": {"cell": "lstm", "flow": "rk4"},
    "Elman, midpoint, longest step": {
        "cell": "elman", "flow": "midpoint, longest step", "decay": "delta",
    },
    "neural ODE": {"cell": "start", "flow": "heun"},
}  # fmt: skip


def small(**options: Any) -> Problem:
    """A scan that is interpreted in about a second."""
    common = {"seed": 3, "batch": 3, "rows": 2, "channels": 2, "hidden": 3, "units": (4,)}
    return problem(**{**common, "cell": "gru", **options})


def agree(case: Problem) -> None:
    """All is as near to double precision as the tolerance, or as the reference backend times 3."""
    expected, got = run(reference.scan, case), run(backend.scan, case)
    for name, exact in run(reference.scan, case.double()).items():
        allowed = max(TOLERANCE, 3 * largest_error(expected[name], exact))
        assert largest_error(got[name], exact) <= allowed, name


@pytest.mark.parametrize("name", list(CASES))
def test_states_and_gradients_equal_the_reference(name):
    agree(small(**CASES[name]))


def test_units_of_more_than_a_tile_equal_the_reference(monkeypatch):
    monkeypatch.setattr(backend, "tiles", lambda *_: (16, 16, 16))
    agree(small(flow="euler", hidden=18, units=(35,), scale=0.2))


def test_the_last_steps_of_a_silence_alone_have_a_gradient(monkeypatch):
    for module in (reference, shapes):
        monkeypatch.setattr(module, "TRACKED_NODES", 2)
    case = small(flow="euler, nodes", decay="delta")
    node = case.rows.first_node + torch.tensor([[5.0, 3.0], [1.0, 2.0], [4.0, 4.0]])
    agree(case._replace(rows=replace(case.rows, node=node)))


def test_rows_of_several_launches_have_the_same_gradients(monkeypatch):
    case = small(flow="euler")
    whole = run(backend.scan, case)
    monkeypatch.setattr(backend, "MEMORY_LIMIT", 1)
    for name, value in run(backend.scan, case).items():
        assert largest_error(value, whole[name]) <= 3e-7, name


def test_runs_of_one_launch_have_the_bits_that_each_has_alone():
    cases = [small(seed=seed, flow="euler", decay="delta") for seed in (1, 2)]
    alone = [run(backend.scan, case) for case in cases]
    leaves = [[*case.weights.tensors(), case.state] for case in cases]
    found = backend.scan_stacked(
        cases[0].spec,
        [case.weights for case in cases],
        [case.rows for case in cases],
        torch.stack([case.state for case in cases]),
    )
    factors = [torch.stack([case.factors[i] for case in cases]) for i in (0, 1)]
    loss = sum((value * factor).sum() for value, factor in zip(found, factors, strict=True))
    gradients = iter(torch.autograd.grad(loss, [leaf for own in leaves for leaf in own]))
    for i, expected in enumerate(alone):
        got = {"before": found[0][i], "after": found[1][i]}
        got |= {f"gradient {n}": next(gradients) for n in range(len(leaves[i]))}
        for name, value in expected.items():
            if name in ("before", "after"):
                assert torch.equal(got[name], value), name
            else:  # products of PyTorch in a batch
                assert largest_error(got[name], value) <= 3e-7, name


def test_gradients_of_one_result_alone_equal_the_reference():
    case = small(flow="none")
    for i in (0, 1):
        each = [
            torch.autograd.grad(scan(*case[:4])[i].square().sum(), case.state)[0]
            for scan in (backend.scan, reference.scan)
        ]
        assert largest_error(*each) <= TOLERANCE


# --- the choice of the backend --------------------------------------------------------------------


def test_a_model_predicts_with_it_if_selected_and_says_so():
    data = ob.mask_out(dataset(2, rows=4), 0.5, seed=0)
    model = ob.make_model("ode_rnn", data, hidden_size=3, field_units=(4,)).float()
    assert model.backend()[0] != "triton", "a model on the CPU never runs interpreted by itself"
    with kernels.use("reference"):
        expected = ob.predict(model, data)
    with kernels.use("triton"):
        assert model.backend() == ("triton", "selected by offbeat.kernels.use")
        got = ob.predict(model, data)
    for a, b in zip(got, expected, strict=True):
        assert largest_error(torch.tensor(a.values), torch.tensor(b.values)) <= TOLERANCE


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        ({"solver": "dopri5"}, "chooses its own steps"),
        ({"gradient": "adjoint"}, "adjoint method"),
        ({"self_feeding": 0.5, "readout": "last_row"}, "fed back"),
    ],
)
def test_what_it_does_not_support_runs_in_the_reference_backend(options, reason):
    model = ob.make_model("ode_rnn", dataset(2, rows=4), hidden_size=3, **options).float()
    with kernels.use("triton"):
        name, why = model.backend()
    assert name == "reference"
    assert why.startswith("triton: ")
    assert reason in why


def test_double_precision_and_other_devices_are_not_supported():
    spec = small(flow="none").spec
    assert "float64" in (backend.supports(spec, torch.float64, torch.device("cpu")) or "")
    assert "meta" in (backend.supports(spec, torch.float32, torch.device("meta")) or "")
    assert backend.supports(spec, torch.float32, torch.device("cuda")) is None


def test_without_a_gpu_and_interpreter_the_error_says_how_to_get_one(monkeypatch):
    monkeypatch.delenv("TRITON_INTERPRET")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with (
        pytest.raises(InputError, match=r"no CUDA device.*TRITON_INTERPRET=1"),
        kernels.use("triton"),
    ):
        pass


def test_a_gpu_with_other_results_than_the_reference_is_not_used(monkeypatch):
    case = small(flow="none")
    assert backend.disagreement(*case[:4]) <= TOLERANCE
    monkeypatch.setattr(backend, "_trusted", {})
    assert backend.distrusted(*case[:4]) == ""
    right = backend.scan
    monkeypatch.setattr(backend, "scan", lambda *a: tuple(1.1 * t for t in right(*a)))
    assert backend.distrusted(*case[:4]) == "", "it is asked once"
    monkeypatch.setattr(backend, "_trusted", {})
    with pytest.warns(UserWarning, match="differ by 0.2"):
        assert "differ by 0.2" in backend.distrusted(*case[:4])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert "differ by 0.2" in backend.distrusted(*case[:4])


# --- compiled -------------------------------------------------------------------------------------


def test_tiles_cover_every_shape_of_the_benchmark():
    for hidden in (15, 64, 256):
        for batch in (50, 512, 4096):
            spec = small(flow="euler", hidden=hidden).spec
            shape = Shape.of(spec, backend.tiles(spec, batch))
            assert shape.BM * shape.BN >= 1024
            assert all(n & (n - 1) == 0 for n in (shape.BM, shape.BN, shape.BK, shape.BE))


def test_compiled_kernels_fit_into_shared_memory_and_registers():
    """The larger of the two kernels, with all parts, at one width.

    `python -m offbeat.kernels.triton.offline` compiles every shape of the benchmark.
    """
    command = "-m offbeat.kernels.triton.offline --json --arch 80 90 --hidden 64"
    command += " --batch 50 --precision ieee tf32 --anchored yes --kernel backward"
    done = subprocess.run(
        [sys.executable, *command.split()],
        capture_output=True,
        text=True,
        check=True,
        env={**os.environ, "TRITON_INTERPRET": "0"},
    )
    found = [json.loads(line) for line in done.stdout.splitlines()]
    assert [one["arch"] for one in found] == [80, 80, 90, 90]
    for one, limit in zip(found, (99, 99, 227, 227), strict=True):
        assert 0 < one["shared"] <= limit * 1024
        assert one["spilled"] == 0
        assert one["registers"] <= 255
