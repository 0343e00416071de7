"""Parts, models and backends from outside the package, each in a few lines."""

from __future__ import annotations

import math
import re
from pathlib import Path

import numpy as np
import pytest
import torch
from model_helpers import dataset, small_model
from torch import Tensor, nn

import offbeat as ob
from offbeat import kernels
from offbeat.kernels import BACKENDS, Backend, reference
from offbeat.models.zoo import MODELS, ModelEntry
from offbeat.parts import CELLS, FIELDS, HEADS, Cell, Head, Perceptron, Prediction

EPOCHS = ob.TrainConfig(epochs=2, batch_size=4)


@pytest.fixture
def entries():
    """Registries as they were, after a test that adds to them."""
    registries = (CELLS, FIELDS, HEADS, MODELS, BACKENDS)
    before = [set(registry) for registry in registries]
    yield
    for registry, names in zip(registries, before, strict=True):
        for name in set(registry) - names:
            registry.unregister(name)


def trained(model, data):
    """Fits a model, and checks that it is scored, saved and asked like any other."""
    result = ob.fit(model, data, data, EPOCHS, progress=False)
    assert len(result.history) == 2
    assert all(math.isfinite(epoch.validation_mse) for epoch in result.history)
    scores = ob.evaluate({"mine": model}, data).scores
    assert scores["mine"].after_first_observation.count > 0
    asked = ob.predict(model, data, times=float(data[0].times[-1]) + 0.01)
    assert asked[0].values.shape == (1, data.channels)
    return result


# --- a cell ---------------------------------------------------------------------------------------


class MinimalGRU(Cell):
    """A gate and a candidate of the input alone (Feng et al. 2024)."""

    gates_per_unit = 2
    is_recurrent = False

    def new(self, gates: Tensor, state: Tensor) -> Tensor:
        z, candidate = gates.chunk(2, dim=1)
        return torch.lerp(state, torch.tanh(candidate), torch.sigmoid(z))


def test_a_cell_is_one_class_and_runs_on_the_reference_backend(entries, tmp_path):
    ob.register_part("cell", "minimal_gru", MinimalGRU)
    data = dataset(8)
    model = ob.make_model("ode_rnn", data, cell="minimal_gru", hidden_size=5)
    name, reason = model.backend()
    assert name == "reference"
    assert "minimal_gru" in reason
    assert set(dict(model.cell.named_parameters())) == {"inputs", "bias"}
    trained(model, data)
    model.save(tmp_path / "model")
    again = ob.load_model(tmp_path / "model")
    batch = model.batch(data)
    assert torch.equal(again(batch).mean, model(batch).mean)
    # Stream equals batch, row by row.
    stream = ob.Stream(model)
    one = data[0]
    rows = ob.predict(model, ob.Dataset((one,)))[0].values
    for i, t in enumerate(one.times):
        assert np.allclose(stream.predict(t), rows[i], atol=1e-5)
        stream.observe(t, np.where(one.observed[i], one.values[i], np.nan))


# --- a vector field -------------------------------------------------------------------------------


class Damped(nn.Module):
    """A perceptron that also decays."""

    def __init__(self, sizes: tuple[int, ...], activation: str) -> None:
        super().__init__()
        self.inner = Perceptron((sizes[0], 8, sizes[-1]), activation)

    def forward(self, state: Tensor) -> Tensor:
        return self.inner(state) - state


def test_a_vector_field_is_one_module(entries):
    ob.register_part("field", "damped", Damped)
    data = dataset(8)
    model = ob.make_model("anchored_ode_gru_d", data, vector_field="damped", solver="rk4")
    assert model.backend()[0] == "reference"
    trained(model, data)
    assert model.field.inner.weights[0].grad is None  # released after training


# --- a head ---------------------------------------------------------------------------------------


class Laplace(Head):
    """The median and a scale, trained on the absolute error."""

    def __init__(self, shape) -> None:
        super().__init__(shape)
        self.out = nn.Linear(shape.hidden_size, 2 * shape.channels)

    def decode(self, state: Tensor) -> Prediction:
        mean, raw = self.out(self.hidden(state)).chunk(2, dim=-1)
        return Prediction(mean, nn.functional.softplus(raw) + 1e-3)

    def loss(self, prediction: Prediction, target: Tensor, mask: Tensor | None) -> Tensor:
        each = torch.log(prediction.scale) + (target - prediction.mean).abs() / prediction.scale
        return each.mean() if mask is None else (each * mask).sum() / mask.sum().clamp_min(1)


def test_a_head_is_one_class_and_keeps_the_compiled_scan(entries):
    ob.register_part("head", "laplace", Laplace)
    data = dataset(8)
    model = ob.make_model("gru_d", data, head="laplace", hidden_size=5)
    assert model.backend() == ob.make_model("gru_d", data).backend()
    trained(model, data)
    output = model(model.batch(data))
    assert bool((output.scale > 0).all())


@pytest.mark.parametrize("name", ["gru", "anchored_ode_gru_d"])
def test_the_gaussian_head_minimises_the_likelihood_of_torch(name):
    data = dataset(6)
    model = small_model(name, data, head="gaussian")
    batch = model.batch(data)
    output = model(batch)
    mask = batch.targets.to(output.mean.dtype)
    expected = nn.functional.gaussian_nll_loss(
        output.mean, batch.values, output.scale.square(), reduction="none", eps=0.0
    )
    got = model.loss(output, batch.values, mask)
    assert torch.allclose(got, (expected * mask).sum() / mask.sum(), rtol=1e-12)
    assert torch.allclose(model.loss(output, batch.values, None), expected.mean(), rtol=1e-12)


def test_a_gaussian_head_learns_the_noise_that_is_there():
    """Constant channels plus noise of known size: the scale must come out."""
    random = np.random.default_rng(0)
    sizes = np.array([0.1, 2.0])
    data = ob.Dataset(
        tuple(
            ob.Trajectory(0.1 * np.arange(40), 5.0 + sizes * random.normal(size=(40, 2)))
            for _ in range(60)
        )
    )
    model = ob.make_model("gru", data, head="gaussian", hidden_size=4, decoder_units=(8,))
    recipe = ob.TrainConfig(epochs=40, optimizer="adam", learning_rate=0.01)
    ob.fit(model, data, config=recipe, progress=False)
    with torch.no_grad():
        scale = model(model.batch(data)).scale[:, 5:] * torch.tensor(model.scaler.scale)
    assert scale.mean(dim=(0, 1)).numpy() == pytest.approx(sizes, rel=0.15)


# --- a model of one's own -------------------------------------------------------------------------


class LastAndSlope(nn.Module):
    """The last observed value, and a learned multiple of a linear map of it."""

    def __init__(self, data, width: int = 4) -> None:
        super().__init__()
        self.mean = torch.tensor(data.statistics.mean)
        self.map = nn.Sequential(
            nn.Linear(data.channels, width), nn.Tanh(), nn.Linear(width, data.channels)
        )

    def forward(self, batch) -> Prediction:
        last = ob.last_values(batch.values, batch.mask, before=self.mean.to(batch.values))
        return Prediction(last + self.map(last))


def test_a_model_of_ones_own_is_fitted_scored_saved_and_streamed(entries, tmp_path):
    ob.register_model("last_and_slope", LastAndSlope, recipe={"learning_rate": 0.01})
    assert "last_and_slope" in ob.list_models()
    data = dataset(8)
    model = ob.make_model("last_and_slope", data, width=3)
    result = trained(model, data)
    assert (result.recipe.optimizer, result.recipe.learning_rate) == ("adam", 0.01)
    model.save(tmp_path / "model")
    again = ob.load_model(tmp_path / "model")
    batch = model.batch(data)
    assert torch.equal(again(batch).mean, model(batch).mean)
    stream = ob.Stream(again)
    one = data[0]
    for t, values, seen in zip(one.times, one.values, one.observed, strict=True):
        stream.observe(t, np.where(seen, values, np.nan))
    ahead = float(one.times[-1]) + 0.01
    expected = ob.predict(again, ob.Dataset((one,)), times=ahead)[0].values[0]
    assert np.allclose(stream.predict(ahead), expected, atol=1e-5)
    MODELS.unregister("last_and_slope")
    with pytest.raises(ob.InputError, match="register_model"):
        ob.load_model(tmp_path / "model")


def test_the_example_of_the_architecture_page_runs(entries, capsys):
    page = (Path(__file__).parents[1] / "docs" / "architecture.md").read_text(encoding="utf-8")
    (block,) = re.findall(r"^```python\n(.*?)^```$", page, re.DOTALL | re.MULTILINE)
    assert len(block.splitlines()) <= 40
    scope: dict[str, object] = {}
    exec(compile(block, "docs/architecture.md", "exec"), scope)
    assert "last_and_slope" in capsys.readouterr().out
    assert scope["ahead"][0].values.shape == (1, 1)


def test_the_same_seed_makes_the_same_model_of_ones_own(entries):
    ob.register_model("last_and_slope", LastAndSlope)
    data = dataset(4)
    first, again, other = (ob.make_model("last_and_slope", data, seed=s) for s in (1, 1, 2))
    assert torch.equal(first.module.map[0].weight, again.module.map[0].weight)
    assert not torch.equal(first.module.map[0].weight, other.module.map[0].weight)


def test_a_forward_that_gives_no_prediction_is_refused_in_one_line(entries):
    class Wrong(nn.Module):
        def __init__(self, data) -> None:
            super().__init__()

        def forward(self, batch):
            return batch.values

    ob.register_model("wrong", Wrong)
    with pytest.raises(ob.InputError, match=r"'wrong' gave .* expected a Prediction whose mean"):
        ob.evaluate(ob.make_model("wrong", dataset(3)), dataset(3))


def test_a_recipe_is_completed_and_asks_for_the_validation_set_that_it_needs(entries):
    MODELS.register("bare", ModelEntry(factory=LastAndSlope))  # as an entry point can give it
    data = dataset(4)
    recipe = ob.fit(ob.make_model("bare", data), data, config=EPOCHS, progress=False).recipe
    assert (recipe.optimizer, recipe.epochs, recipe.keep) == ("adam", 2, "last")
    ob.register_model("patient", LastAndSlope, recipe={"patience": 2})
    with pytest.raises(ob.InputError, match=r"patience .* needs a validation set"):
        ob.fit(ob.make_model("patient", data), data, config=EPOCHS, progress=False)


def test_a_choice_of_parts_is_a_model_too(entries):
    ob.register_model("slow_lstm", {"cell": "lstm", "decay": "vector", "hidden_size": 3})
    model = ob.make_model("slow_lstm", dataset(4))
    assert (model.config.cell, model.config.decay, model.spec.hidden_size) == ("lstm", "vector", 3)


# --- a backend ------------------------------------------------------------------------------------


def test_a_backend_is_one_entry_and_says_what_it_supports(entries):
    calls = []

    def supports(spec, dtype, device):
        return None if spec.cell == "gru" and dtype == torch.float64 else "float64 GRUs alone"

    def scan(spec, parts, inputs, state, variant):
        calls.append(variant)
        return reference.scan(spec, parts, inputs.gathered(), state)

    data = dataset(3)
    gru, lstm = small_model("gru", data), small_model("lstm", data)
    expected = gru(gru.batch(data)).mean
    ob.register_backend(Backend("counting", supports, scan))
    assert gru.backend()[0] == "counting"
    assert lstm.backend()[0] != "counting"
    got = gru(gru.batch(data)).mean
    assert calls == ["counting"]
    assert torch.allclose(got, expected, rtol=1e-12, atol=1e-14)
    with kernels.use("reference"):
        assert gru.backend()[0] == "reference"


def test_a_model_that_its_backend_cannot_run_says_what_runs():
    """0.1.0 recorded the instruction set of the processor although the reference ran."""
    model = ob.make_model("ode_rnn", dataset(4), solver="dopri5")
    name, reason = model.backend()
    assert name == "reference"
    assert "dopri5" in reason or "not built" in reason


# --- names that are not there ---------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"cell": "grru"}, "unknown cell 'grru'.*did you mean 'gru'"),
        ({"vector_field": "mpl"}, "unknown vector field 'mpl'.*did you mean 'mlp'"),
        ({"head": "gauss"}, "unknown head 'gauss'.*did you mean 'gaussian'"),
    ],
)
def test_an_unknown_part_lists_the_choices(options, message):
    with pytest.raises(ob.InputError, match=message):
        ob.make_model("ode_rnn", dataset(4), **options)


def test_what_is_neither_a_model_nor_a_part_is_refused_when_it_is_registered():
    with pytest.raises(ob.InputError, match=r"a model must be a class.*got 3"):
        ob.register_model("three", 3)
    with pytest.raises(ob.InputError, match="a part must be a class, got 3"):
        ob.register_part("head", "three", 3)


def test_an_unknown_kind_of_part_lists_the_kinds():
    with pytest.raises(ob.InputError, match=r"unknown kind of part 'sell'.*cell"):
        ob.register_part("sell", "x", Cell)
