"""Runs of a sweep that are trained together."""

from __future__ import annotations

import threading
from contextvars import copy_context
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import torch
from model_helpers import SMALL, dataset
from test_sweeps import DATA, MODELS, OPTIONS, numbers

import offbeat as ob
from offbeat import kernels
from offbeat.kernels.triton import backend
from offbeat.sweeps import together as module
from offbeat.sweeps.stacked import StackedModels
from offbeat.sweeps.together import Group, Member, Rendezvous, default_together
from offbeat.training import STEPS


def fitted(
    count: int, *, meet: bool, epochs: tuple[int, ...] = (2, 2, 2), rate: float = 0.01
) -> list[torch.Tensor]:
    """Weights of some trainings that differ in seed, data and epochs."""
    rendezvous, weights = Rendezvous(count), [torch.empty(0)] * count

    def run(i: int) -> None:
        data = dataset(7, seed=i, rows=3)
        model = ob.make_model("gru", data[:5], seed=i, **{**SMALL, "nodes": "rows"})
        config = ob.TrainConfig(epochs=epochs[i], batch_size=2, learning_rate=rate, seed=i)
        if meet:
            STEPS.set(Member(rendezvous, i))
        try:
            ob.fit(model, data[:5], data[5:], config, progress=False)
        finally:
            rendezvous.leave()
        weights[i] = torch.cat([p.detach().flatten() for p in model.parameters()])

    threads = [threading.Thread(target=copy_context().run, args=(run, i)) for i in range(count)]
    for thread in threads:
        thread.start()
        if not meet:
            thread.join()
    for thread in threads:
        thread.join(timeout=120)
    return weights


def counted(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """The number of models of each step that is taken together."""
    sizes: list[int] = []

    class Counted(StackedModels):
        def step(self, indices: Any) -> Any:
            sizes.append(len(indices))
            return super().step(indices)

    monkeypatch.setattr(module, "StackedModels", Counted)
    return sizes


@pytest.mark.parametrize("name", ["cpu", "reference"])
def test_trainings_that_meet_have_the_bits_of_each_alone(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Batches of two and of one; the third training ends before the others."""
    if name == "cpu" and not kernels.cpu.instruction_sets():
        pytest.skip("there is no compiled backend")
    sizes = counted(monkeypatch)
    with kernels.use(name):
        got = fitted(3, meet=True, epochs=(2, 2, 1))
        assert sizes == [3] * 3 + [2] * 3
        expected = fitted(3, meet=False, epochs=(2, 2, 1))
    assert len(sizes) == 6
    for one, other in zip(got, expected, strict=True):
        assert torch.equal(one, other)
    assert not torch.equal(got[0], got[1])


@pytest.mark.skipif(
    bool(backend.why_not()) or not backend.interpreted(), reason="Triton is not here, or on a GPU"
)
def test_trainings_that_meet_are_one_launch_of_the_triton_backend(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    launches: list[int] = []
    monkeypatch.setattr(
        backend,
        "scan_stacked",
        lambda *a, f=backend.scan_stacked: launches.append(len(a[1])) or f(*a),
    )
    with kernels.use("triton"):
        got = fitted(2, meet=True, epochs=(1, 1))
    assert launches.count(2) == 3, "the others are of validations"
    with kernels.use("reference"):
        expected = fitted(2, meet=False, epochs=(1, 1))
    for one, other in zip(got, expected, strict=True):
        assert float((one - other).abs().max()) < 1e-5


def test_a_sweep_of_runs_together_has_the_numbers_of_runs_alone(tmp_path: Path) -> None:
    """Two models of different shapes, so two groups."""
    chosen, options = {k: MODELS[k] for k in ("gru", "wide")}, {**OPTIONS, "repeats": 2}
    alone = ob.sweep(DATA, chosen, out=tmp_path / "alone", **options)
    got = ob.sweep(DATA, chosen, out=tmp_path / "together", together=4, **options)
    assert numbers(got.folder) == numbers(alone.folder)
    assert len(got.record.runs) == 4


@dataclass(frozen=True)
class Stub:
    """A run that notes that it was performed, or fails."""

    name: str
    done: list[str]
    error: Exception | None = None
    threads: int = 1

    def perform(self) -> None:
        if self.error is not None:
            raise self.error
        self.done.append(self.name)


def test_a_run_that_fails_does_not_end_the_others() -> None:
    done: list[str] = []
    diverged, full = ob.DivergenceError("the loss is inf"), OSError("the disk is full")
    runs = [Stub("a", done), Stub("b", done, diverged), Stub("c", done)]
    with pytest.raises(ob.DivergenceError, match="the loss is inf"):
        Group(tuple(runs)).perform()  # type: ignore[arg-type]
    assert sorted(done) == ["a", "c"]
    with pytest.raises(OSError, match="the disk is full"):  # it ends a sweep, the other does not
        Group((*runs, Stub("d", done, full))).perform()  # type: ignore[arg-type]


def test_an_error_of_a_step_reaches_every_run(monkeypatch: pytest.MonkeyPatch) -> None:
    class Broken(StackedModels):
        def step(self, indices: Any) -> Any:
            raise RuntimeError("no launch")

    monkeypatch.setattr(module, "StackedModels", Broken)
    errors: list[str] = []
    monkeypatch.setattr(threading, "excepthook", lambda args: errors.append(str(args.exc_value)))
    fitted(3, meet=True)
    assert errors == ["no launch"] * 3


def test_on_a_cpu_each_run_is_trained_alone_unless_told_otherwise(tmp_path: Path) -> None:
    assert default_together("cpu") == 1
    assert default_together("not a device") == 1
    with pytest.raises(ob.InputError, match="together must be an integer of at least 1, got 0"):
        ob.sweep(DATA, MODELS, out=tmp_path / "out", together=0)
