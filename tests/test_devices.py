"""Models on another device: a stand-in for one, which refuses what an accelerator would refuse."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from model_helpers import dataset
from torch.utils._python_dispatch import TorchDispatchMode, _disable_current_modes
from torch.utils._pytree import tree_flatten, tree_map

import offbeat as ob
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
        return self.numbers.tolist()

    def numpy(self, *_: Any) -> Any:
        raise TypeError("can't convert a tensor of another device to numpy")

    __array__ = numpy


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
