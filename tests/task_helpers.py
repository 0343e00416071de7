"""Trajectories and tasks of a second or two, shared by the tests of trainings on tasks."""

from __future__ import annotations

import numpy as np
import torch

import offbeat as ob
from offbeat.config import TaskConfig

TASKS = TaskConfig(horizon_s=0.5, gap_s=0.05, window_s=2.0)
SMALL = {"hidden_size": 4, "field_units": (8,), "decoder_units": (8,)}


def swings(n: int = 6, rows: int = 120, seed: int = 0) -> ob.Dataset:
    """Two pendulums and a quiet channel of noise, every 50 ms, all observed but a few values."""
    random = np.random.default_rng(seed)
    trajectories = []
    for _ in range(n):
        times = 0.05 * np.arange(rows) + random.uniform(0, 10)
        phase = random.uniform(0, 2 * np.pi, 2)
        values = np.stack(
            [
                np.sin(3 * times + phase[0]),
                np.cos(5 * times + phase[1]),
                0.01 * random.normal(size=rows),
            ],
            axis=1,
        )
        observed = random.random(values.shape) < 0.9
        trajectories.append(ob.Trajectory(times, values, observed, names=("a", "b", "c")))
    return ob.Dataset(tuple(trajectories))


TRAIN, VALIDATION = swings(6, seed=1), swings(3, seed=2)


def weights(model: ob.Model) -> dict[str, torch.Tensor]:
    return {name: value.clone() for name, value in model.state_dict().items()}


def same(a: dict[str, torch.Tensor], b: dict[str, torch.Tensor]) -> bool:
    return a.keys() == b.keys() and all(torch.equal(a[k], b[k]) for k in a)
