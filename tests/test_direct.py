"""Steps without autograd have the bits of those with it."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from model_helpers import dataset, draw_weights

import offbeat as ob
from offbeat import direct, kernels
from offbeat.config import Recipe
from offbeat.direct import DirectStep, unsupported
from offbeat.models.zoo import recipe_of
from offbeat.run import RunState, flat_parameters
from offbeat.training import Examples, train_step

pytestmark = pytest.mark.skipif(
    not kernels.cpu.instruction_sets(), reason="there is no compiled backend"
)
MODELS: dict[str, ob.ModelConfig] = {
    "gru": ob.thesis_config("gru"),  # read after the last row
    "gru_d": ob.thesis_config("gru_d"),
    "ode_rnn": ob.thesis_config("ode_rnn"),
    "lstm": ob.ModelConfig(name="lstm"),
    "anchored": ob.ModelConfig(name="anchored_ode_gru_d"),
    "anchored, rows": ob.ModelConfig(name="anchored_ode_gru_d", nodes="rows", bounded=False),
}
BATCHES = ([0, 3, 5, 8], [1, 2, 4, 6], [7, 5, 3, 1], [2, 8], [0, 3, 5, 8])


def trained(
    config: ob.ModelConfig,
    recipe: Recipe,
    *,
    autograd: bool,
    dtype: torch.dtype = torch.float32,
    rows: int | None = None,
    **options: Any,
) -> tuple[list[float], torch.Tensor]:
    """Losses of some steps, and the weights after them."""
    data = ob.mask_out(dataset(9, rows=rows), 0.6, seed=0)
    model = draw_weights(ob.make_model(config, data, hidden_size=4).to(dtype))
    examples = Examples(model, model.batch(data), **options)
    with flat_parameters(model) as parameters:
        state = RunState(parameters, recipe)
        if autograd:
            state.direct = (model, examples, None)
        losses = [
            train_step(model, examples, torch.tensor(b), state, recipe, total=9) for b in BATCHES
        ]
        assert isinstance(state.direct[2], DirectStep) != autograd
        return losses, parameters.flat.detach().clone()


@pytest.mark.parametrize("name", sorted(MODELS))
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("rows", [None, 12])
def test_steps_have_the_bits_of_autograd(name: str, dtype: torch.dtype, rows: int | None) -> None:
    """Of trajectories of one length, where all values count, and of several."""
    config = MODELS[name]
    chosen = ob.TrainConfig(batch_size=4, clip_norm=0.5, learning_rate=0.05)
    recipe = recipe_of(config.name, chosen, validated=False)
    options: dict[str, Any] = {"dtype": dtype, "rows": rows, "all_count": rows is not None}
    losses, weights = trained(config, recipe, autograd=False, **options)
    expected_losses, expected = trained(config, recipe, autograd=True, **options)
    assert losses == expected_losses
    assert torch.equal(weights, expected)
    assert len(set(losses)) == len(BATCHES)


def test_a_module_without_squares_gives_the_same_bits(monkeypatch: pytest.MonkeyPatch) -> None:
    recipe = recipe_of("gru", ob.TrainConfig(), validated=False)
    found = []
    for has_squares in (True, False):
        monkeypatch.setattr(direct, "_has_squares", lambda has=has_squares: has)
        found.append(trained(MODELS["gru"], recipe, autograd=False, rows=12, all_count=True))
    assert found[0][0] == found[1][0]
    assert torch.equal(found[0][1], found[1][1])


def test_activations_that_are_kept_or_computed_again_give_the_same_bits(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Batches of several sizes share the memory of the largest one."""
    recipe = recipe_of("ode_rnn", ob.TrainConfig(), validated=False)
    sizes, found = [], []

    def watched(*args: Any, **options: Any) -> int | None:
        sizes.append(size := tape_size(*args, **options))
        return size

    tape_size = kernels.cpu.tape_size
    monkeypatch.setattr(kernels.cpu, "tape_size", watched)
    for limit, kept in ((0, 0), (0, 2**29), (2**25, 0)):
        monkeypatch.setattr(kernels.cpu, "TAPE_LIMIT", limit)
        monkeypatch.setattr(kernels.cpu, "KEPT_TAPE_LIMIT", kept)
        found.append(trained(MODELS["ode_rnn"], recipe, autograd=False))
    n = len(BATCHES)
    assert sizes[:n] == [None] * n
    assert None not in sizes[n:]
    for losses, weights in found[1:]:
        assert losses == found[0][0]
        assert torch.equal(weights, found[0][1])


def test_a_whole_training_has_the_bits_of_autograd(monkeypatch: pytest.MonkeyPatch) -> None:
    data = ob.mask_out(dataset(12), 0.6, seed=0)
    train, validation = data[:9], data[9:]
    weights, taken = [], []
    for reason in (None, "the test asks for autograd"):
        if reason:
            monkeypatch.setattr(direct, "unsupported", lambda *_, reason=reason: reason)
        model = ob.make_model("gru_d", train, hidden_size=4, seed=0)
        config = ob.TrainConfig(epochs=3, batch_size=4)
        with monkeypatch.context() as patch:
            calls: list[int] = []
            loss = DirectStep.loss
            patch.setattr(DirectStep, "loss", lambda *a, c=calls, f=loss: c.append(1) or f(*a))
            ob.fit(model, train, validation, config, progress=False)
        taken.append(len(calls))
        weights.append(torch.cat([p.detach().reshape(-1) for p in model.parameters()]))
    assert torch.equal(*weights)
    assert taken == [9, 0]


@pytest.mark.parametrize(
    ("config", "reason"),
    [
        (ob.ModelConfig(name="gru", head="gaussian"), "point head"),
        (ob.ModelConfig(name="anchored_trend"), "computes weights from parameters"),
        (ob.ModelConfig(name="ode_rnn", solver="dopri5"), "its scan runs in reference"),
        (ob.ModelConfig(name="gru", self_feeding=0.5), "self-feeding"),
    ],
)
def test_other_models_are_trained_with_autograd(config: ob.ModelConfig, reason: str) -> None:
    data = dataset(9)
    model = ob.make_model(config, data, hidden_size=4)
    recipe = recipe_of(config.name, ob.TrainConfig(), validated=False)
    found = unsupported(model, Examples(model, model.batch(data)), recipe)
    assert found is not None
    assert reason in found


def test_another_backend_is_not_overruled() -> None:
    data = dataset(9)
    model = ob.make_model("gru", data, hidden_size=4)
    examples = Examples(model, model.batch(data))
    recipe = recipe_of("gru", ob.TrainConfig(), validated=False)
    with flat_parameters(model) as parameters:
        state = RunState(parameters, recipe)
        assert direct.direct_step(model, examples, state, recipe) is not None
        with kernels.use("reference"):
            assert direct.direct_step(model, examples, state, recipe) is None
        assert direct.direct_step(model, examples, state, recipe) is not None


def test_a_loss_that_is_not_finite_changes_no_weight() -> None:
    data = dataset(9)
    model = ob.make_model("gru", data, hidden_size=4)
    examples = Examples(model, model.batch(data))
    examples.targets[3, 1, 0] = np.inf
    recipe = recipe_of("gru", ob.TrainConfig(), validated=False)
    with flat_parameters(model) as parameters:
        state, before = RunState(parameters, recipe), parameters.flat.detach().clone()
        with pytest.raises(ob.DivergenceError, match="the loss is inf"):
            train_step(model, examples, torch.arange(9), state, recipe, total=1)
        assert torch.equal(parameters.flat, before)
