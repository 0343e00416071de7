"""Several models that are trained together."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from model_helpers import SMALL, dataset

import offbeat as ob
from offbeat import kernels
from offbeat.errors import InputError
from offbeat.kernels.triton import backend
from offbeat.models.zoo import recipe_of
from offbeat.run import FlatParameters, RunState
from offbeat.sweeps.stacked import StackedModels
from offbeat.training import Examples, train_step

pytest.importorskip("triton")


def runs(count: int, name: str = "gru"):
    """Models, examples and states of a few runs that differ in seed and data."""
    made = []
    for seed in range(count):
        data = dataset(4, seed=seed, rows=3)
        model = ob.make_model(name, data, seed=seed, **{**SMALL, "nodes": "rows"})
        recipe = recipe_of(name, ob.TrainConfig(clip_norm=0.5), validated=False)
        state = RunState(FlatParameters(model), recipe)
        made.append((model, Examples(model, model.batch(data)), state))
    return *(list(each) for each in zip(*made, strict=True)), recipe


@pytest.mark.skipif(not backend.interpreted(), reason="Triton would need a GPU")
@pytest.mark.parametrize("name", ["triton", "reference"])
def test_models_that_are_trained_together_end_where_each_ends_alone(name, monkeypatch):
    models, examples, states, recipe = runs(2)
    alone, own, optimizers, _ = runs(2)
    launches = []
    monkeypatch.setattr(
        backend,
        "scan_stacked",
        lambda *a, f=backend.scan_stacked: launches.append(len(a[1])) or f(*a),
    )
    together = StackedModels(models, examples, states, recipe)
    for index in (torch.tensor([0, 2]), torch.tensor([1, 3])):
        with kernels.use(name):
            losses = together.step([index, index])
        with kernels.use("reference"):
            for i, (model, data, state) in enumerate(zip(alone, own, optimizers, strict=True)):
                loss = train_step(model, data, index, state, recipe, total=2)
                assert float(losses[i]) == pytest.approx(loss, rel=1e-5)
    assert launches == ([2, 2] if name == "triton" else [])
    for one, other in zip(models, alone, strict=True):
        for got, expected in zip(one.parameters(), other.parameters(), strict=True):
            assert torch.allclose(got, expected, atol=1e-5)
    first, second = (torch.cat([p.flatten() for p in m.parameters()]) for m in models)
    assert not torch.equal(first, second)


def test_a_rival_of_the_benchmark_has_our_loss_where_first_observations_differ(monkeypatch):
    pytest.importorskip("torchdiffeq")
    monkeypatch.syspath_prepend(str(Path(__file__).parents[1] / "benchmarks"))
    from common import synthetic
    from other_libraries import TorchStep, inputs_of

    data = synthetic(4, 5, observed_fraction=0.5)
    options = {**SMALL, "nodes": "rows", "bounded": False}
    model = ob.make_model("anchored_ode_gru_d", data, **options).float()
    batch = model.batch(data)
    rows = model.step_inputs(batch)[0]
    assert (rows.gap.amax(dim=0) > rows.gap.amin(dim=0)).any()
    expected = float(Examples(model, batch).loss(model, torch.arange(len(data)), None).detach())
    step = TorchStep(model, inputs_of(rows, batch.values))
    assert step() == pytest.approx(expected, rel=1e-5)


def test_models_of_other_shapes_are_refused():
    models, examples, states, recipe = runs(1)
    others, more, their_states, _ = runs(1, "rnn")
    with pytest.raises(InputError, match="one spec"):
        StackedModels(models + others, examples + more, states + their_states, recipe)
    with pytest.raises(InputError, match="got 0 models"):
        StackedModels([], [], [], recipe)
    models, examples, states, recipe = runs(2)
    together = StackedModels(models, examples, states, recipe)
    with pytest.raises(InputError, match="got 1 batches for 2 models"):
        together.step([torch.tensor([0])])
    with pytest.raises(InputError, match="have 1 x 3, 2 x 3 trajectories x rows"):
        together.step([torch.tensor([0]), torch.tensor([0, 1])])


@pytest.mark.skipif(not backend.interpreted(), reason="Triton would need a GPU")
def test_the_benchmark_runs_without_a_gpu_and_with_torch_and_numpy_alone(tmp_path):
    script = Path(__file__).parents[1] / "benchmarks" / "gpu.py"
    arguments = [str(script), "--dry", "--models", "gru", "--json", str(tmp_path / "gpu.json")]
    code = f"""
import runpy, sys
for name in ("pyarrow", "jsonargparse", "matplotlib", "scipy", "yaml"):
    sys.modules[name] = None
sys.argv = {arguments}
sys.path.insert(0, {str(script.parent)!r})
runpy.run_path(sys.argv[0], run_name="__main__")
"""
    subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, timeout=200)
    found = json.loads((tmp_path / "gpu.json").read_text())
    (step,) = found["steps"]
    losses = {name: times["loss"] for name, times in step["times"].items()}
    assert {"Offbeat, triton", "Offbeat, reference", "eager torch"} <= set(losses)
    assert losses["Offbeat, triton"] == pytest.approx(losses["Offbeat, reference"], rel=1e-6)
    assert losses["eager torch"] == pytest.approx(losses["Offbeat, reference"], rel=1e-5)
    assert 0 < found["accuracy"]["gru"]["triton"] < 1e-6
    assert [one["runs"] for one in found["stacked"]] == [1, 2]
