"""Models on another device: a stand-in for one, which refuses what an accelerator would refuse."""

from __future__ import annotations

from concurrent.futures import Future
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from model_helpers import dataset, draw_weights
from torch.utils._python_dispatch import TorchDispatchMode, _disable_current_modes
from torch.utils._pytree import tree_flatten, tree_map

import offbeat as ob
from offbeat import captured, devices, training
from offbeat.captured import CapturedStep
from offbeat.kernels import use
from offbeat.models.zoo import recipe_of
from offbeat.run import FlatParameters, RunState, flat_parameters
from offbeat.training import Examples, ValidationSet


class Remote(torch.Tensor):
    """A tensor of the stand-in: its numbers lie on the CPU, where only operations of it go."""

    @staticmethod
    def __new__(cls, numbers: torch.Tensor) -> Remote:
        made = torch.Tensor._make_wrapper_subclass(
            cls, numbers.size(), strides=numbers.stride(), dtype=numbers.dtype, device="meta"
        )
        made.numbers = numbers
        return made

    @classmethod
    def __torch_dispatch__(cls, function: Any, types: Any, args: Any = (), kwargs: Any = None):
        return computed(function, args, kwargs or {})

    def tolist(self) -> Any:
        WAITS.append("tolist")
        return self.numbers.tolist()

    def numpy(self, *_: Any) -> Any:
        raise TypeError("can't convert a tensor of another device to numpy")

    __array__ = numpy


WAITS: list[str] = []
"""What made the CPU wait for the stand-in, or sent it anything, since the list was cleared."""

ALLOWED = ("copy_", "_to_copy", "index", "index_put_", "_index_put_impl_")
"""Operations that take tensors of several devices."""


def computed(function: Any, args: Any, kwargs: Any) -> Any:
    """An operation of the stand-in, or of the CPU if it has no part in it."""
    given = [a for a in tree_flatten((args, kwargs))[0] if isinstance(a, torch.Tensor)]
    remote = [a for a in given if isinstance(a, Remote)]
    name, device = function.__name__.split(".")[0], kwargs.get("device")
    if name not in ALLOWED and remote and any(a.ndim for a in given if not isinstance(a, Remote)):
        raise RuntimeError(f"{function} has tensors of two devices")
    local = {**kwargs, "device": torch.device("cpu")} if device is not None else kwargs
    with _disable_current_modes():
        found = function(
            *tree_map(lambda a: a.numbers if isinstance(a, Remote) else a, args),
            **tree_map(lambda a: a.numbers if isinstance(a, Remote) else a, local),
        )
    stays = bool(remote) if device is None else torch.device(device).type == "meta"
    made = isinstance(found, torch.Tensor) and found.ndim > 0
    crosses = made and name in ("_to_copy", "copy_") and len(remote) + stays == 1
    mixed = name in ALLOWED and remote and len(remote) < sum(a.ndim > 0 for a in given)
    if crosses or mixed or (remote and name == "_local_scalar_dense"):
        WAITS.append(str(function))
    if not stays or name == "_local_scalar_dense":
        return found
    same = {id(a.numbers): a for a in remote}  # of an operation in place

    def wrapped(a: Any) -> Any:
        if not isinstance(a, torch.Tensor):
            return a
        return same[id(a)] if id(a) in same else Remote(a)

    return tree_map(wrapped, found)


class Device(TorchDispatchMode):
    """Within it, the device `meta` is the stand-in."""

    def __torch_dispatch__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None):
        return computed(function, args, kwargs or {})


@pytest.fixture
def remote(monkeypatch):
    """The name of the stand-in."""
    tensor = torch.tensor

    def made(*args: Any, device: Any = None, **options: Any) -> torch.Tensor:
        found = tensor(*args, **options)
        return found if device is None else found.to(device)

    monkeypatch.setattr(torch, "tensor", made)
    monkeypatch.setattr(torch, "inference_mode", torch.no_grad)  # it takes no subclasses
    torch.__future__.set_overwrite_module_params_on_conversion(True)
    with Device():
        yield "meta"
    torch.__future__.set_overwrite_module_params_on_conversion(False)


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("gru", {}),
        ("lstm", {"head": "gaussian"}),
        ("gru_d", {"self_feeding": 0.5}),
        ("ode_rnn", {"solver": "dopri5"}),
        ("ode_gru_d", {"solver": "rk4", "gradient": "adjoint"}),
        ("anchored_ode_gru_d", {}),
        ("anchored_trend", {}),
    ],
)
def test_all_of_a_model_is_computed_on_its_device(name, options, remote, tmp_path):
    data = ob.mask_out(dataset(6), 0.7, seed=0)
    model = ob.make_model(name, data, hidden_size=4, **options).to(remote)
    examples = Examples(model, model.batch(data))
    generator = torch.Generator().manual_seed(0) if model.needs_generator else None
    loss = examples.loss(model, torch.arange(4), generator)
    loss.backward()
    assert all(isinstance(p.grad, Remote) for p in model.parameters())
    scores = ValidationSet(model, model.batch(data)).scores(model)
    predicted = ob.predict(model, data)
    stream = ob.Stream(model)
    stream.observe(0.0, data[0].values[0])
    ahead = stream.predict(0.1)
    model.save(tmp_path / "model")
    local = ob.load_model(tmp_path / "model")
    expected = ob.evaluate({"model": local}, data).scores["model"]
    assert scores.after_first_observation.mse == pytest.approx(
        expected.after_first_observation.mse, rel=1e-4
    )
    for here, there in zip(ob.predict(local, data), predicted, strict=True):
        assert np.allclose(here.values, there.values, atol=1e-4)
    stream = ob.Stream(local)
    stream.observe(0.0, data[0].values[0])
    assert np.allclose(stream.predict(0.1), ahead, atol=1e-4)


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("anchored_trend", {}),
        ("ode_gru_d", {"schedule": "cosine", "clip_norm": 0.1, "loss": "relative"}),
        ("gru", {"redraw": ob.RedrawConfig((0.5, 0.8)), "optimizer": "sgd"}),
    ],
)
def test_a_step_sends_nothing_to_its_device_and_does_not_wait_for_it(
    name, options, remote, monkeypatch, tmp_path
):
    data = dataset(10) if "redraw" in options else ob.mask_out(dataset(10), 0.7, seed=0)
    config = ob.TrainConfig(epochs=2, batch_size=4, seed=3, **options)
    waits, step = [], training._Elsewhere.step

    def counted(self: Any, first: int) -> torch.Tensor:
        WAITS.clear()
        found = step(self, first)
        waits.append(list(WAITS))
        return found

    made = FlatParameters.__init__

    def accumulating(self: Any, model: Any) -> None:
        """The data of a subclass of tensors isn't set, nor a gradient accumulated in place."""
        made(self, model)
        sizes = [each.numel() for each in self._own]
        for each, numbers in zip(self._own, self.flat.numbers.split(sizes), strict=True):
            each.numbers, place = numbers.view(each.shape), each.grad

            def keep(parameter: Any, place: Any = place) -> None:
                place.copy_(parameter.grad)
                parameter.grad = place

            each.register_post_accumulate_grad_hook(keep)

    class Now:
        """An executor without a thread, in which the stand-in would not be one."""

        def __init__(self, _: int) -> None:
            pass

        def submit(self, function: Any, *args: Any) -> Future[Any]:
            done: Future[Any] = Future()
            done.set_result(function(*args))
            return done

        def shutdown(self, **_: Any) -> None:
            pass

    monkeypatch.setattr("offbeat.examples.ThreadPoolExecutor", Now)
    monkeypatch.setattr(FlatParameters, "__init__", accumulating)
    monkeypatch.setattr(training._Elsewhere, "step", counted)
    there = ob.make_model(name, data, hidden_size=4)
    result = ob.fit(there, data, data, config, device=remote, progress=False, out=tmp_path)
    assert len(waits) == 6
    assert not any(waits), waits
    monkeypatch.undo()
    here = ob.make_model(name, data, hidden_size=4)
    expected = ob.fit(here, data, data, config, progress=False)
    for ours, known in zip(result.history, expected.history, strict=True):
        assert ours.train_mse == pytest.approx(known.train_mse, rel=1e-4)
        assert ours.validation_mse == pytest.approx(known.validation_mse, rel=1e-4)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("cuda", "there is no device 'cuda' here: torch finds no CUDA; give cpu or auto"),
        ("cuda:1", "there is no device 'cuda:1' here: torch finds no CUDA; give cpu or auto"),
        ("gpu", "there is no device 'gpu'; give auto, cpu, cuda or cuda:1"),
        ("mps", "the device 'mps' has no float64, which times need; give cpu"),
    ],
)
def test_a_device_that_is_not_there_is_one_clear_line(name, message, monkeypatch, tmp_path):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    data = dataset(3)
    model = ob.make_model("gru", data, hidden_size=2)
    calls: list[Any] = [
        lambda: ob.fit(model, data, device=name),
        lambda: ob.predict(model, data, device=name),
        lambda: ob.forecast(model, data, 0.1, device=name),
        lambda: ob.impute(model, data, device=name),
        lambda: ob.evaluate(model, data, device=name),
        lambda: ob.Stream(model, device=name),
        lambda: ob.sweep(data, ["gru"], out=tmp_path / "sweep", device=name),
    ]
    for call in calls:
        with pytest.raises(ob.InputError) as error:
            call()
        assert str(error.value) == message


def test_a_device_beyond_those_there_are_is_refused(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    with pytest.raises(ob.InputError, match="'cuda:2' here: there is cuda:0 to cuda:1"):
        devices.device_of("cuda:2")
    assert devices.device_of("cuda:1") == torch.device("cuda", 1)


def test_auto_takes_a_gpu_for_large_batches_alone(monkeypatch):
    model = ob.make_model("ode_gru_d", dataset(3), hidden_size=64)
    assert devices.preferred(model, batch=4096)[0].type == "cpu"
    assert "no CUDA" in devices.examined()
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "current_device", lambda: 1)
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda _: "a card")
    monkeypatch.setattr(torch, "get_num_threads", lambda: 2)
    assert devices.resolved("auto", model, batch=1) == torch.device("cpu")
    chosen, why = devices.preferred(model, batch=4096)
    assert chosen == torch.device("cuda", 1)
    assert "a card" in why
    assert devices.resolved("auto", torch.nn.Linear(1, 1)) == torch.device("cuda", 1)
    assert "a card" in devices.examined()


def test_answers_on_a_device_leave_the_model_where_it_was(remote):
    data = ob.mask_out(dataset(3), 0.7, seed=0)
    model = ob.make_model("gru", data, hidden_size=3)
    expected = ob.predict(model, data)
    there = ob.predict(model, data, device=remote)
    assert model.device == torch.device("cpu")
    assert not any(isinstance(p, Remote) for p in model.parameters())
    for ours, known in zip(there, expected, strict=True):
        assert np.allclose(ours.values, known.values, atol=1e-5)
    scores = ob.evaluate(model, data, device=remote).scores["gru"]
    known = ob.evaluate(model, data).scores["gru"]
    assert scores.after_first_row.mse == pytest.approx(known.after_first_row.mse, rel=1e-5)


def stepped(model: Any, examples: Examples, state: RunState, recipe: Any, batches: Any) -> Any:
    """Losses of steps one by one, with a rate that changes."""
    elsewhere = training._Elsewhere(
        model, examples, state, recipe, np.arange(len(examples)), steps=len(batches)
    )
    losses = []
    for i, batch in enumerate(batches):
        state.set_rate(0.01 / (1 + i))
        losses.append(elsewhere._whole(batch))
    return losses


@pytest.mark.parametrize("name", ["anchored_ode_gru_d", "gru_d", "ode_rnn"])
def test_recorded_steps_are_the_steps_one_by_one(name):
    data = ob.mask_out(dataset(9), 0.6, seed=0)
    recipe = recipe_of(name, ob.TrainConfig(batch_size=4, clip_norm=0.5), validated=False)
    batches = [torch.tensor(b) for b in ([0, 3, 5, 8], [1, 2, 4, 6], [7, 5, 3, 1])]
    found = []
    with use("reference"):
        for recorded in (False, True):
            model = draw_weights(ob.make_model(name, data, hidden_size=4))
            examples = Examples(model, model.batch(data))
            with flat_parameters(model) as parameters:
                state = RunState(parameters, recipe)
                if not recorded:
                    losses = stepped(model, examples, state, recipe, batches)
                    # Whole rows give the loss of trimmed ones.
                    assert torch.allclose(
                        examples.loss(model, batches[0], None),
                        examples.loss(model, batches[0], None, whole=True),
                        rtol=1e-5,
                    )
                else:
                    one = training._Elsewhere(model, examples, state, recipe, np.arange(9), steps=3)
                    before = parameters.flat.detach().clone()
                    made = CapturedStep(
                        examples, state, recipe, one._whole, batch=4, record=lambda body: body
                    )
                    assert torch.equal(parameters.flat, before)
                    losses = []
                    for i, batch in enumerate(batches):
                        state.set_rate(0.01 / (1 + i))
                        losses.append(made(batch))
                found.append((torch.stack(losses), parameters.flat.detach().clone()))
    assert torch.equal(found[0][0], found[1][0])
    assert torch.equal(found[0][1], found[1][1])
    assert len(set(found[0][0].tolist())) == 3


def test_known_bounds_of_steps_change_no_bit_of_the_states():
    data = ob.mask_out(dataset(6), 0.5, seed=1)
    model = draw_weights(ob.make_model("ode_gru_d", data, hidden_size=4))
    table, some = model.prepare(model.batch(data)), torch.tensor([0, 4, 2])
    with use("reference"), torch.no_grad():
        trimmed, whole = model.run(table.take(some)), model.run(table.take_whole(some))
    rows = trimmed.mean.shape[1]
    for i, length in enumerate(table.length[some].tolist()):
        assert torch.equal(whole.after[i, :length], trimmed.after[i, :length])
    assert rows < whole.mean.shape[1]


def test_what_cannot_be_recorded_has_a_reason(monkeypatch):
    data = ob.mask_out(dataset(4), 0.7, seed=0)
    recipe = recipe_of("gru", ob.TrainConfig(), validated=False)

    def reason(name: str, steps: int = 100, **options: Any) -> str | None:
        model = ob.make_model(name, data, hidden_size=2, **options)
        examples = Examples(model, model.batch(data))
        monkeypatch.setattr(type(model), "device", torch.device("cuda"))
        found = captured.unsupported(model, examples, recipe, steps)
        monkeypatch.undo()
        return found

    assert reason("ode_gru_d") is None
    assert "adaptive" in reason("ode_gru_d", solver="dopri5")
    assert "self-feeding" in reason("gru_d", self_feeding=0.5)
    assert "too few" in reason("gru", steps=3)
    monkeypatch.setenv("OFFBEAT_CUDA_GRAPH", "0")
    model = ob.make_model("gru", data, hidden_size=2)
    assert captured.unsupported(model, None, recipe, 100) == "OFFBEAT_CUDA_GRAPH=0"


@pytest.mark.parametrize("name", ["lstm", "ode_gru_d", "anchored_trend"])
def test_the_reference_backend_has_precisions_by_autocast(name):
    data = ob.mask_out(dataset(8), 0.7, seed=0)
    config = ob.TrainConfig(epochs=2, batch_size=4, precision="bf16")
    losses = {}
    for precision in ("float32", "bf16"):
        model = ob.make_model(name, data, hidden_size=4)
        with use("reference"):
            chosen = replace(config, precision=precision)
            result = ob.fit(model, data, config=chosen, progress=False)
        losses[precision] = result.history[-1].train_mse
        assert result.recipe.precision == precision
    assert losses["bf16"] != losses["float32"]
    assert losses["bf16"] == pytest.approx(losses["float32"], rel=0.02)
    if model.backend()[0] != "reference":
        config = replace(config, precision="tf32")
        with pytest.raises(ob.InputError, match="'tf32' is one of GPUs"):
            ob.fit(model, data, config=config, progress=False)
