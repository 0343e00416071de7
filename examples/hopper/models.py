"""The trained models: what they consist of, and how they are trained."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch

import offbeat as ob
from offbeat.parts import Perceptron
from offbeat.training import FitResult

from .data import PROTOCOL, Hopper


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
    """

    title: str
    drawn_for: float
    fractions: tuple[float, ...]
    model: Mapping[str, Any] = field(default_factory=dict)
    training: Mapping[str, Any] = field(default_factory=dict)
    linear: bool = False
    after: str = ""
    name: str = "anchored_ode_gru_d"


SMALL = {"hidden_size": 32, "field_units": (100, 100, 100)}
LARGE = {"hidden_size": 64, "field_units": (256, 256, 256)}

PLANS = {
    "small_fresh": Plan(
        "anchored, small, fresh windows and masks",
        0.3,
        (0.3, 0.9),
        SMALL,
        {"epochs": 50, "batch_size": 32, "learning_rate": 0.003},
    ),
    "large_fresh": Plan(
        "anchored, large, fresh windows and masks",
        0.3,
        (0.3, 0.9),
        LARGE,
        {"epochs": 40, "batch_size": 32, "learning_rate": 0.003},
        linear=True,
    ),
    "large_fresh_on": Plan(
        "anchored, large, fresh windows and masks, trained on",
        0.3,
        (0.3, 0.9),
        LARGE,
        {"epochs": 12, "batch_size": 32, "learning_rate": 0.0015},
        after="large_fresh",
    ),
    "large_fresh_long": Plan(
        "anchored, large, fresh windows and masks, trained on for longer",
        0.3,
        (0.3, 0.9),
        LARGE,
        {"epochs": 110, "batch_size": 32, "learning_rate": 0.0015},
        after="large_fresh",
    ),
}


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
    redraw, data = None, windows
    if plan.fractions:
        redraw = ob.RedrawConfig(plan.fractions, PROTOCOL.window)
        data = hopper.whole(plan.drawn_for)[0]
    earlier: tuple[FitResult, ...] = ()
    if plan.after:
        folder = out.parent / f"{plan.after}-seed{seed}"
        before, earlier = train(PLANS[plan.after], hopper, folder, seed=seed)
        model.load_state_dict(before.state_dict())
    elif plan.linear:
        start_linear(model, data)
    config = ob.TrainConfig(seed=seed, redraw=redraw, **plan.training)
    result = ob.fit(model, data, validation, config, out=out, progress=False)
    return model, (*earlier, result)


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
