"""Small data sets and models with weights that matter, shared by the tests of the models."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from offbeat import Batch, Dataset, Model, ModelConfig, Trajectory
from offbeat.models.zoo import make_model

SMALL: dict[str, Any] = {
    "hidden_size": 4,
    "decoder_units": (5,),
    "field_units": (6,),
    "typical_gap": 0.3,
}
"""Sizes that keep a test short, and a unit of model time in which a gap moves the state."""

TICK = 1 / 1024
"""Times are multiples of this, so that they stay exact when the clock is shifted."""


def trajectory(
    seed: int, rows: int = 10, *, channels: int = 3, share: float = 0.5, whole_rows: bool = False
) -> Trajectory:
    """Waves at irregular times; all values are known, cells or whole rows are hidden."""
    random = np.random.default_rng([7, seed])
    times = np.cumsum(random.integers(1, 40, rows)) * TICK
    values = np.sin(20 * times[:, None] + np.arange(channels)) + 0.3 * np.arange(channels)
    values += 0.1 * random.normal(size=values.shape)
    shape = (rows, 1) if whole_rows else (rows, channels)
    observed = np.broadcast_to(random.random(shape) < share, values.shape).copy()
    observed[random.random(rows) < 0.2] = False
    return Trajectory(times, values, observed=observed, units=("m",) * channels)


def dataset(count: int = 4, *, seed: int = 0, **options: Any) -> Dataset:
    """Trajectories of different lengths, each at times of its own."""
    rows = options.pop("rows", None)
    lengths = [rows or 7 + (3 * i) % 5 for i in range(count)]
    return Dataset(tuple(trajectory(100 * seed + i, n, **options) for i, n in enumerate(lengths)))


def with_observed(one: Trajectory, observed: Any) -> Trajectory:
    """The trajectory with another mask."""
    mask = np.broadcast_to(np.asarray(observed, dtype=bool), one.values.shape).copy()
    return Trajectory(one.times, one.values, observed=mask, names=one.names, units=one.units)


def draw_weights(model: Model, *, seed: int = 1, std: float = 0.4) -> Model:
    """Draws every parameter, biases too: small initial weights would hide errors."""
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for parameter in model.parameters():
            drawn = torch.randn(parameter.shape, generator=generator, dtype=torch.float64)
            parameter.copy_(std * drawn)
    return model


def small_model(
    name: str | ModelConfig,
    train: Dataset | None = None,
    *,
    dtype: torch.dtype = torch.float64,
    seed: int = 1,
    std: float = 0.4,
    **options: Any,
) -> Model:
    """A model of a few units whose every parameter is drawn from N(0, std^2)."""
    chosen = dict(SMALL)
    if isinstance(name, ModelConfig):
        chosen = {k: v for k, v in SMALL.items() if getattr(name, k) is None}
    model = make_model(name, train or dataset(6, seed=9), **{**chosen, **options})
    return draw_weights(model.to(dtype), seed=seed, std=std)


def with_growing_decays(model: Model) -> Model:
    """Decays that grow with time, as at the start of training: below 0 they get no gradient."""
    with torch.no_grad():
        for part in (model.decay, model.input_decay):
            for parameter in part.parameters() if part is not None else ():
                parameter.abs_().add_(0.1)
    return model


def rows_of(batch: Batch, start: int, stop: int) -> Batch:
    """The rows from `start` up to, not including, `stop`, times unchanged."""
    names = ("times", "values", "mask", "known", "valid")
    return replace(batch, **{name: getattr(batch, name)[:, start:stop] for name in names})


def predictions(model: Model, batch: Batch, **options: Any) -> Tensor:
    """(batch, rows, channels) without a graph, 0 at padding."""
    with torch.no_grad():
        return model(batch, **options).mean * batch.valid[..., None]


def error(got: Tensor, expected: Tensor) -> float:
    """Largest error as a share of the largest entry; elementwise shares mean nothing near 0."""
    assert got.shape == expected.shape
    assert bool(torch.isfinite(expected).all())
    scale = float(expected.abs().max())
    return float((got.double() - expected.double()).abs().max()) / (scale or 1.0)
