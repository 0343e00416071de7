"""The robots of the comparison: an environment, an expert, and what is demonstrated."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors.numpy import load_file

from offbeat.data.trajectory import Dataset
from offbeat.policies import CloneConfig, Drops, Policy, fit_policy

from . import pendulum
from .rivals import options_of

HERE = Path(__file__).parent
SHORT: dict[str, Any] = {"starts": 0.1, "decoder_units": (100, 100)}
"""A tenth of the windows from the start, and two layers. The linear experts, and robots "before",
are cloned with windows from anywhere and one layer."""

LONG: dict[str, Any] = {**SHORT, "epochs": 320}
"""Options that experts of two hidden layers are cloned with."""

RATES = {"half_cheetah": 0.003}
"""Learning rates of these other than 0.01, by the validation error."""


@dataclass(frozen=True)
class Robot:
    """An environment with an expert.

    Attributes:
        env: name of the environment.
        expert: (..., observations) to (..., actions).
        bounds: of the actions.
        demonstrations: episodes that are trained on; a fifth as many validate.
        noise: of the actions that are executed in demonstrations.
        dt: s, between steps.
        names: of the observed channels.
        epochs: of a training.
        learning_rate: at its start.
        window: rows of the windows.
        encoders: positions of the angle and the velocity of each joint that is driven.
        starts: fraction of the windows that begin where a demonstration does.
        decoder_units: of the networks but the perceptrons.
    """

    env: str
    expert: Callable[[Any], Any]
    bounds: tuple[float, float]
    demonstrations: int
    noise: float
    dt: float
    names: tuple[str, ...] | None = None
    epochs: int = 150
    learning_rate: float = 0.01
    window: int = 50
    encoders: tuple[tuple[int, int], ...] = ()
    starts: float = 0.0
    decoder_units: tuple[int, ...] = (100,)

    def clone(
        self, name: str, drops: Drops, seed: int, *, train: Dataset, validation: Dataset
    ) -> Policy:
        """A policy of the comparison.

        Args:
            name: of `RIVALS`.
            drops: what training loses.
            seed: of the training.
            train: demonstrations.
            validation: demonstrations that the epoch is chosen by.
        """
        model, options = options_of(name, self.decoder_units)
        config = CloneConfig(
            epochs=self.epochs,
            window=self.window,
            starts=self.starts,
            learning_rate=self.learning_rate,
            seed=seed,
        )
        return fit_policy(
            train,
            model,
            validation=validation,
            bounds=([self.bounds[0]], [self.bounds[1]]),
            drops=drops,
            config=config,
            progress=False,
            **options,
        )


def expert(tensors: dict[str, NDArray[Any]]) -> Callable[[Any], Any]:
    """Observations (..., n) to actions (..., m) between -1 and 1.

    Args:
        tensors: "matrix" and "mean" as `examples.policies.expert` writes them, or "weight_i" and
            "bias_i" of three layers as `examples.policies.sac` does.
    """
    if "matrix" in tensors:
        matrix, mean = tensors["matrix"], tensors["mean"]
        return lambda seen: np.clip((np.asarray(seen) - mean) @ matrix.T, -1.0, 1.0)
    layers = [(tensors[f"weight_{i}"].T, tensors[f"bias_{i}"]) for i in range(3)]

    def act(seen: Any) -> Any:
        inner = np.asarray(seen, np.float32)
        for weight, bias in layers[:-1]:
            inner = np.maximum(inner @ weight + bias, 0.0)
        weight, bias = layers[-1]
        return np.tanh(inner @ weight + bias)

    return act


def robots() -> dict[str, Robot]:
    """Those whose experts are there."""
    found = {
        "pendulum": Robot(
            "Pendulum-v1", pendulum.expert, (-2.0, 2.0), 50, 0.3, 0.05, pendulum.NAMES
        )
    }
    for name, env, dt, joints in (
        ("hopper", "Hopper-v5", 0.008, 3),
        ("half_cheetah", "HalfCheetah-v5", 0.05, 6),
        ("walker2d", "Walker2d-v5", 0.008, 6),
    ):
        for key, file, options in (
            (name, name, {}),
            (f"{name}_sac", f"{name}_sac", {**LONG, "learning_rate": RATES.get(name, 0.01)}),
            (f"{name}_sac_short", f"{name}_sac", SHORT),
            (f"{name}_sac_before", f"{name}_sac", {}),
        ):
            path = HERE / f"{file}.safetensors"
            if path.exists():
                act = expert(load_file(path))
                at = encoders(joints)
                robot = Robot(env, act, (-1.0, 1.0), 40, 0.1, dt, epochs=80, encoders=at)
                found[key] = replace(robot, **options)
    return found


def encoders(joints: int) -> tuple[tuple[int, int], ...]:
    """Of a robot in the plane: its height, its pitch and the angles, then all their velocities.

    Args:
        joints: that are driven.
    """
    return tuple((2 + i, 2 + joints + 3 + i) for i in range(joints))
