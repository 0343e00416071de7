"""Inference: predictions at any times, in original units."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from offbeat.data.trajectory import Dataset, Trajectory
from offbeat.errors import InputError
from offbeat.models.model import Model


def predict(
    model: Model,
    dataset: Dataset,
    *,
    times: ArrayLike | Sequence[ArrayLike] | None = None,
    seed: int = 0,
    size: int = 500,
) -> Dataset:
    """Predicts each trajectory at asked times, each from what was observed strictly before it.

    Args:
        model: trained.
        dataset: what was observed; hidden cells are not looked at.
        times: s, on the clock of the trajectories, strictly increasing: one array for all, or one
            per trajectory. By default the times of each trajectory's own rows: one step ahead.
        seed: of the generator of self-feeding.
        size: trajectories at a time.

    Returns:
        One trajectory of predictions per trajectory, in original units, at the asked times; its
        channels stand in the order of the model.

    Raises:
        InputError: other channels than the model's, times that do not increase, or a model that
            can't be asked for times (the oddities that `thesis_config` asks for).
    """
    if times is not None:
        _check_askable(model)
    asked = _asked(dataset, times)
    results: list[Trajectory] = []
    for first in range(0, len(dataset), size):
        part = dataset[first : first + size]
        merged = [_merge(t, at) for t, at in zip(part, asked[first : first + size], strict=True)]
        batch = model.batch(Dataset(tuple(t for t, _ in merged)))
        # The same generator for each part, as if they were one batch.
        generator = torch.Generator().manual_seed(seed) if model.config.self_feeding else None
        with torch.inference_mode():
            scaled = model(batch, generator=generator).predictions.double().numpy()
        for (union, rows), trajectory, values in zip(merged, part, scaled, strict=True):
            results.append(
                Trajectory(
                    union.times[rows],
                    model.scaler.original(values[rows]),
                    names=model.names,
                    units=model.units,
                    origin=trajectory.origin,
                )
            )
    return Dataset(tuple(results), {"predicted_by": model.config.name})


def _check_askable(model: Model) -> None:
    """An asked time is a row in which nothing is observed; it must change no other prediction."""
    for field, value, meaning in (
        ("readout", "last_row", "predicts the next row, whenever it comes"),
        ("update_rows", "every", "is changed by every row, and an asked time is one more row"),
        ("decay_rows", "every_row", "decays at every row, and an asked time is one more row"),
        ("time_input", "gap", "looks at the gap since the row before, which an asked time cuts"),
        ("clock", "first_row", "starts at the first row, and an asked time can come before it"),
    ):
        if getattr(model.config, field) == value:
            raise InputError(
                f"a model with {field}={value!r} {meaning}: it can't be asked for times; leave "
                f"times out, or train one with another {field}"
            )
    if model.config.self_feeding:
        raise InputError(
            "a model with self_feeding draws a coin at every row, and an asked time is one more "
            "row: it can't be asked for times; leave times out, or train one without self_feeding"
        )


def _asked(
    dataset: Dataset, times: ArrayLike | Sequence[ArrayLike] | None
) -> list[NDArray[np.float64]]:
    if times is None:
        return [t.times for t in dataset]
    try:
        shared = np.asarray(times, dtype=np.float64)
        each = [shared] * len(dataset) if shared.ndim == 1 else [np.asarray(t) for t in shared]
    except ValueError:  # one array per trajectory, of different lengths
        each = [np.asarray(t, dtype=np.float64) for t in times]  # type: ignore[union-attr]
    if len(each) != len(dataset):
        raise InputError(
            f"got times for {len(each)} trajectories, the data has {len(dataset)}; give one array "
            "for all, or one per trajectory"
        )
    for i, at in enumerate(each):
        if at.ndim == 1 and not len(at):
            raise InputError(f"no time is asked of trajectory {i}; give at least one")
        if at.ndim != 1 or not np.isfinite(at).all() or (np.diff(at) <= 0).any():
            raise InputError(
                f"times asked of trajectory {i} must be finite and increase strictly, got "
                f"{np.array2string(at, threshold=6, separator=', ')}"
            )
    return each


def _merge(
    trajectory: Trajectory, asked: NDArray[np.float64]
) -> tuple[Trajectory, NDArray[np.int64]]:
    """The trajectory with rows added at the asked times, in which nothing is known."""
    union = np.union1d(trajectory.times, asked)
    rows = np.searchsorted(union, asked)
    if len(union) == trajectory.rows:
        return trajectory, rows
    own = np.searchsorted(union, trajectory.times)
    values = np.full((len(union), trajectory.channels), np.nan)
    observed = np.zeros(values.shape, dtype=bool)
    values[own], observed[own] = trajectory.values, trajectory.observed
    merged = replace(trajectory, times=union, values=values, observed=observed)
    return merged, rows
