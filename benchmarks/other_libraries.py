"""The models of `training_step.py`, written in eager PyTorch and in JAX.

Both take the weights and the step inputs of the Offbeat model, so that all compute the same loss
(`training_step.py` checks it). Each is written as a careful user of the library would: input
projections, decays and x-hat for all rows at once, then a loop over rows.
"""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import torch

import offbeat as ob
from offbeat.kernels import StepInputs


def weights_of(model: ob.Model) -> dict[str, torch.Tensor]:
    """Copies of a model's weights, by name."""
    return {name: p.detach().clone() for name, p in model.named_parameters()}


def inputs_of(rows: StepInputs, targets: torch.Tensor) -> dict[str, torch.Tensor]:
    """Step inputs and targets with rows first, for a loop over rows."""
    names = ("gap", "update", "values", "mask", "time_input", "decay_end", "last")
    found = {"targets": targets.transpose(0, 1).contiguous()}
    for name in names:
        value = getattr(rows, name)
        if value is not None:
            value = value[..., None] if value.ndim == 2 else value
            found[name] = value.transpose(0, 1).contiguous()
    return found


def loss(xp: Any, model: SimpleNamespace, p: dict[str, Any], f: dict[str, Any]) -> Any:
    """Mean squared error of the one-step-ahead prediction, over rows after the first.

    Args:
        xp: the library: `tanh`, `exp`, `cat`, ..., `propagate` over a gap and `loop` over rows.
        model: sizes and parts of the model, as `shape_of` has them.
        p: weights by name.
        f: step inputs and targets, rows first.
    """
    n, c = model.hidden, model.channels

    def linear(x: Any, name: str) -> Any:
        return x @ p[f"{name}.weight"].T + p[f"{name}.bias"]

    def perceptron(x: Any, name: str, activation: Any) -> Any:
        layers = sum(key.startswith(f"{name}.weights.") for key in p)
        for i in range(layers):
            x = x @ p[f"{name}.weights.{i}"].T + p[f"{name}.biases.{i}"]
            x = activation(x) if i < layers - 1 else x
        return x

    values = f["values"]
    if model.input_decay:
        exponent = p["input_decay.weight"] * f["decay_end"] + p["input_decay.bias"]
        gamma = xp.exp(-xp.positive(exponent))
        decayed = gamma * f["last"] + (1 - gamma) * model.mean
        values = xp.where(f["mask"] > 0, values, decayed)
    parts = [values, f["mask"], *([f["time_input"]] if "time_input" in f else [])]
    rows = {"gate": xp.cat(parts, -1) @ p["cell.inputs"].T + p["cell.bias"]}
    rows |= {name: f[name] for name in ("gap", "update", "values", "mask")}
    if model.decay:
        rows["decay"] = xp.exp(-xp.positive(linear(f["decay_end"], "decay")))
    activation = xp.silu if model.anchored else xp.tanh
    recurrent = p["cell.recurrent"]

    def step(state: Any, row: dict[str, Any]) -> tuple[Any, Any]:
        if model.decay:
            state = state * row["decay"]
        if model.field:
            state = xp.propagate(lambda y: perceptron(y, "field", activation), state, row["gap"])
        before, gate, h = state, row["gate"], state
        if model.anchored:
            x, h = state[:, :c], state[:, c:]
            gate = gate + (row["mask"] * (row["values"] - x)) @ p["cell.innovation"].T
        zr = xp.sigmoid(gate[:, : 2 * n] + h @ recurrent[: 2 * n].T)
        candidate = xp.tanh(gate[:, 2 * n :] + (zr[:, n:] * h) @ recurrent[2 * n :].T)
        h = h + row["update"] * zr[:, :n] * (candidate - h)
        if model.anchored:
            x = xp.where(row["mask"] > 0, row["values"], x)
            h = xp.cat([x, h], -1)
        return h, (before, h)

    batch = f["gap"].shape[1]
    first = xp.zeros((batch, n))
    if model.anchored:
        first = xp.cat([p["start"] + xp.zeros((batch, c)), first], -1)
    before, after = xp.loop(step, first, rows)
    if model.anchored:
        predictions = before[1:, :, :c] * model.std + model.mean
    else:  # from the state after the row before
        predictions = perceptron(after[:-1], "head.decoder", xp.tanh)
    return ((predictions - f["targets"][1:]) ** 2).mean()


def shape_of(model: ob.Model) -> SimpleNamespace:
    """The sizes and parts of a model that `loss` depends on."""
    return SimpleNamespace(
        channels=model.channels,
        hidden=model.hidden_size,
        anchored=model.spec.anchored,
        field=bool(model.spec.field),
        decay=bool(model.spec.decay),
        input_decay=model.spec.input_decay,
        mean=model.mean,
        std=model.std,
    )


# --- eager PyTorch --------------------------------------------------------------------------------


def torch_library(*, torchdiffeq: bool) -> SimpleNamespace:
    """Eager PyTorch; a gap is an Euler step of torchdiffeq, or one written by hand."""

    def by_library(field: Any, y: Any, gap: Any) -> Any:
        from torchdiffeq import odeint

        # torchdiffeq takes one time grid for the batch: from 0 to 1, in units of each gap.
        times = torch.tensor([0.0, 1.0])
        return odeint(lambda _, state: gap * field(state), y, times, method="euler")[-1]

    def loop(step: Any, state: Any, rows: dict[str, Any]) -> Any:
        outputs = []
        for i in range(len(rows["gap"])):
            state, output = step(state, {name: value[i] for name, value in rows.items()})
            outputs.append(output)
        return tuple(torch.stack(each) for each in zip(*outputs, strict=True))

    return SimpleNamespace(
        tanh=torch.tanh,
        sigmoid=torch.sigmoid,
        silu=torch.nn.functional.silu,
        exp=torch.exp,
        positive=torch.relu,
        cat=torch.cat,
        where=torch.where,
        zeros=torch.zeros,
        propagate=by_library if torchdiffeq else lambda field, y, gap: y + gap * field(y),
        loop=loop,
    )


class TorchStep:
    """A training step of eager PyTorch with its own Adamax."""

    def __init__(self, model: ob.Model, inputs: dict[str, torch.Tensor]) -> None:
        self.weights = {k: v.requires_grad_() for k, v in weights_of(model).items()}
        self.shape, self.inputs = shape_of(model), inputs
        self.xp = torch_library(torchdiffeq=bool(model.spec.field))
        self.optimizer = torch.optim.Adamax(list(self.weights.values()), lr=1e-3)

    def __call__(self) -> float:
        """One step; the loss before it."""
        value = loss(self.xp, self.shape, self.weights, self.inputs)
        self.optimizer.zero_grad()
        value.backward()
        self.optimizer.step()
        return float(value.detach())


class JaxStep:
    """A training step of JAX: one jitted function, a `lax.scan` over rows, Adamax inside."""

    def __init__(self, model: ob.Model, inputs: dict[str, torch.Tensor]) -> None:
        import jax
        from jax import lax
        from jax import numpy as jnp

        xp = SimpleNamespace(
            tanh=jnp.tanh,
            sigmoid=jax.nn.sigmoid,
            silu=jax.nn.silu,
            exp=jnp.exp,
            positive=jax.nn.relu,
            cat=lambda parts, axis: jnp.concatenate(parts, axis),
            where=jnp.where,
            zeros=jnp.zeros,
            propagate=lambda field, y, gap: y + gap * field(y),
            loop=lambda step, state, rows: lax.scan(step, state, rows)[1],
        )
        shape = shape_of(model)
        shape.mean, shape.std = jnp.asarray(shape.mean.numpy()), jnp.asarray(shape.std.numpy())
        self.inputs = {k: jnp.asarray(v.numpy()) for k, v in inputs.items()}
        self.weights = {k: jnp.asarray(v.numpy()) for k, v in weights_of(model).items()}
        zeros = {k: jnp.zeros_like(v) for k, v in self.weights.items()}
        self.moments = (zeros, zeros, jnp.zeros(()))

        def step(p: Any, moments: Any, f: Any) -> Any:
            value, gradient = jax.value_and_grad(lambda q: loss(xp, shape, q, f))(p)
            first, largest, t = moments
            t = t + 1
            first = jax.tree.map(lambda m, g: 0.9 * m + 0.1 * g, first, gradient)
            largest = jax.tree.map(
                lambda u, g: jnp.maximum(0.999 * u, jnp.abs(g) + 1e-8), largest, gradient
            )
            rate = 1e-3 / (1 - 0.9**t)
            p = jax.tree.map(lambda w, m, u: w - rate * m / u, p, first, largest)
            return value, p, (first, largest, t)

        self.step = jax.jit(step)

    def __call__(self) -> float:
        """One step; the loss before it."""
        value, self.weights, self.moments = self.step(self.weights, self.moments, self.inputs)
        return float(value)
