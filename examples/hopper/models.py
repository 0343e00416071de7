"""The trained models: what they consist of, and how they are trained."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

import offbeat as ob
from offbeat.data.redraw import redraw
from offbeat.parts import Perceptron
from offbeat.training import FitResult

from .data import PROTOCOL, Hopper
from .direct_gru import DIRECT_GRU


@dataclass(frozen=True)
class Plan:
    """A training of an anchored model.

    Attributes:
        title: in tables.
        drawn_for: fraction whose windows of the thesis give split, scales and validation.
        fractions: that are trained on; empty for the thesis' windows and masks, kept in all epochs.
        model: fields of `ModelConfig`.
        training: fields of `TrainConfig`.
        linear: whether the vector field starts as the linear model of one step.
        after: another plan, whose trained weights are the initial ones; "" for none.
        name: entry of the zoo.
        kept: `windows` or `masks`, which are then drawn once; "" for both anew in each epoch.
    """

    title: str
    drawn_for: float
    fractions: tuple[float, ...]
    model: Mapping[str, Any] = field(default_factory=dict)
    training: Mapping[str, Any] = field(default_factory=dict)
    linear: bool = False
    after: str = ""
    name: str = "anchored_ode_gru_d"
    kept: str = ""


SMALL = {"hidden_size": 32, "field_units": (100, 100, 100)}
LARGE = {"hidden_size": 64, "field_units": (256, 256, 256)}

LONG: dict[str, Any] = {
    "drawn_for": 0.3,
    "fractions": (0.3, 0.9),
    "model": LARGE,
    "training": {"epochs": 40, "batch_size": 32, "learning_rate": 0.003},
}

SHORT: dict[str, Any] = {
    **LONG,
    "training": {"epochs": 10, "batch_size": 32, "learning_rate": 0.003},
    "linear": True,
}
"""The large model for 10 epochs, from which each plan of `ABLATION` differs in one thing."""

_PLAIN = {**SHORT, "linear": False}


def _after(epochs: int) -> dict[str, Any]:
    training = {"epochs": epochs, "batch_size": 32, "learning_rate": 0.0015}
    return {**LONG, "training": training, "after": "large_fresh"}


PLANS = {
    "large_fresh": Plan("anchored, large, 40 epochs", **LONG, linear=True),
    "large_fresh_on": Plan("anchored, large, 52 epochs", **_after(12)),
    "large_fresh_long": Plan("anchored, large, 150 epochs", **_after(110)),
    "short": Plan("the large model for 10 epochs", **SHORT),
    "kept_masks": Plan("masks drawn once", **SHORT, kept="masks"),
    "kept_windows": Plan("windows drawn once", **SHORT, kept="windows"),
    "thesis_windows": Plan(
        "windows and masks of the thesis (30 % alone)", **{**SHORT, "fractions": ()}
    ),
    "no_linear_start": Plan("no linear start", **_PLAIN),
    "trend": Plan("trend and gain, no linear start", **_PLAIN, name="anchored_trend_large"),
    "small": Plan("small", **{**SHORT, "model": SMALL}),
    "direct_gru": Plan("GRU without ODE", **{**_PLAIN, "model": {}, "name": DIRECT_GRU}),
}

_COMPILED = ("kept_masks", "kept_windows", "thesis_windows", "no_linear_start", "trend", "small")
PLANS |= {f"{name}_40": replace(PLANS[name], training={**LONG["training"]}) for name in _COMPILED}

ABLATIONS = {
    10: ("short", *_COMPILED, "direct_gru"),
    40: ("large_fresh", *(f"{name}_40" for name in _COMPILED)),
}
"""By epochs: the large model, and plans that differ from it in one thing."""


def train(
    plan: Plan, hopper: Hopper, out: Path, *, seed: int = 0
) -> tuple[ob.Model, tuple[FitResult, ...]]:
    """Trains a model, or goes on with a training that was stopped.

    Args:
        plan: what to train.
        hopper: the data.
        out: folder of checkpoints and log; that of a plan before it lies beside it.
        seed: of weights, batches, windows and masks.

    Returns:
        The model with the best weights on the validation windows, and the results of `fit`, that of
        the plan before it first.
    """
    windows, validation, _ = hopper.parts(plan.drawn_for)
    model = ob.make_model(plan.name, windows, scaler=hopper.scaler, seed=seed, **plan.model)
    data, drawn = examples(plan, hopper, windows, seed=seed)
    earlier: tuple[FitResult, ...] = ()
    if plan.after:
        folder = out.parent / f"{plan.after}-seed{seed}"
        before, earlier = train(PLANS[plan.after], hopper, folder, seed=seed)
        model.load_state_dict(before.state_dict())
    elif plan.linear:
        start_linear(model, hopper.whole(plan.drawn_for)[0])
    config = ob.TrainConfig(seed=seed, redraw=drawn, **plan.training)
    result = ob.fit(model, data, validation, config, out=out, progress=False)
    return model, (*earlier, result)


def examples(
    plan: Plan, hopper: Hopper, windows: ob.Dataset, *, seed: int = 0
) -> tuple[ob.Dataset, ob.RedrawConfig | None]:
    """What a plan is trained on, and what of it is drawn anew in each epoch.

    Args:
        plan: what to train.
        hopper: the data.
        windows: the training windows of the thesis.
        seed: of masks that are drawn once.
    """
    if not plan.fractions:
        return windows, None
    if plan.kept == "windows":
        unmasked = tuple(replace(t, observed=~np.isnan(t.values)) for t in windows)
        return ob.Dataset(unmasked, windows.meta), ob.RedrawConfig(plan.fractions)
    whole = hopper.whole(plan.drawn_for)[0]
    if plan.kept != "masks":
        return whole, ob.RedrawConfig(plan.fractions, PROTOCOL.window)
    drawn = redraw(ob.Batch.of(whole), ob.RedrawConfig(plan.fractions), seed=seed)
    return drawn.dataset(whole), ob.RedrawConfig((1.0,), PROTOCOL.window)


def start_linear(model: ob.Model, train: ob.Dataset) -> None:
    """Sets the vector field of an anchored model to the linear model of one step.

    The least-squares map from the values of a row to their change until the next one goes through
    pairs of hidden units: silu(a) - silu(-a) = a. All other units start at random and add their
    usual small part. It is a choice of initial weights alone.

    Args:
        model: untrained, with SiLU and hidden layers of at least two units per channel.
        train: complete trajectories, one typical gap between rows.
    """
    field_ = model.field
    if not isinstance(field_, Perceptron) or field_.activation != "silu":
        raise ob.InputError("the vector field must be a perceptron with SiLU between its layers")
    values = ((model.batch(train).values - model.mean) / model.std).double()
    before, after = values[:, :-1].flatten(0, 1), values[:, 1:].flatten(0, 1)
    step = float(model.config.typical_gap or 1)
    inputs = torch.cat([before, torch.ones_like(before[:, :1])], dim=1)
    found = torch.linalg.lstsq(inputs, (after - before) / step).solution.to(model.dtype)
    channels = model.channels
    at = np.arange(channels)
    with torch.no_grad():
        weights, biases = list(field_.weights), list(field_.biases)
        for layer, weight in enumerate(weights[:-1]):
            weight[: 2 * channels] = 0.0
            for sign, row in ((1.0, 2 * at), (-1.0, 2 * at + 1)):
                if layer == 0:
                    weight[row, at] = sign
                else:
                    weight[row, 2 * at], weight[row, 2 * at + 1] = sign, -sign
        weights[-1][:channels, 2 * at] = found[:-1].T
        weights[-1][:channels, 2 * at + 1] = -found[:-1].T
        biases[-1][:channels] = found[-1]
