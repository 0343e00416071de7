"""Predictions at any times, in original units."""

from __future__ import annotations

import reprlib
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from offbeat.config import check_seed
from offbeat.data.trajectory import Dataset, Trajectory
from offbeat.errors import InputError
from offbeat.models.base import BaseModel
from offbeat.models.model import Model

Times = ArrayLike | Sequence[ArrayLike]


def predict(
    model: BaseModel,
    dataset: Dataset,
    *,
    times: Times | None = None,
    seed: int = 0,
    size: int = 500,
) -> Dataset:
    """Predicts each trajectory at any times, from observations strictly before each time.

    The model's input transforms are applied to the data and undone on the predictions: an angle
    that was given wrapped is predicted wrapped. A registered model gets each requested time as a
    row in which nothing is observed.

    Args:
        model: trained.
        dataset: what was observed; masked values are not used.
        times: s, on the clock of the trajectories, strictly increasing: one time or one array for
            all trajectories, or one array per trajectory. By default the times of each
            trajectory's own rows: one step ahead.
        seed: of the generator of self-feeding.
        size: trajectories per batch.

    Returns:
        One trajectory of predictions per trajectory, in original units, at the requested times;
        its channels are in the order of the model. Exogenous channels, which are not predicted, are
        NaN.

    Raises:
        InputError: other channels than the model's, times that are not finite numbers in
            increasing order, or a model that cannot predict at any time (see
            `thesis_config`).
    """
    dataset = Dataset.of(dataset)
    check_seed(seed)
    if isinstance(size, bool) or not isinstance(size, int) or size < 1:
        raise InputError(f"size must be a number of trajectories of at least 1, got {size!r}")
    if times is not None:
        check_any_time(model)
    asked = [t.times for t in dataset] if times is None else times_of_each(times, len(dataset))
    transforms = model.transforms
    applied = transforms.apply(dataset)
    results: list[Trajectory] = []
    for first in range(0, len(dataset), size):
        part = applied[first : first + size]
        merged = [
            _with_rows_at(t, at) for t, at in zip(part, asked[first : first + size], strict=True)
        ]
        batch = model.batch(replace(part, trajectories=tuple(t for t, _ in merged)))
        # One generator for all parts, as if they were one batch.
        drawn = {"generator": torch.Generator().manual_seed(seed)} if model.needs_generator else {}
        with torch.inference_mode():
            scaled = model(batch, **drawn).mean.double().cpu().numpy()
        for (union, rows), trajectory, values in zip(merged, part, scaled, strict=True):
            results.append(
                Trajectory(
                    union.times[rows],
                    np.where(model.predicted, model.scaler.original(values[rows]), np.nan),
                    names=model.names,
                    units=model.units,
                    roles=model.roles,
                    origin=trajectory.origin,
                )
            )
    return transforms.undo(Dataset(tuple(results), {"predicted_by": model.name}), dataset)


def in_model_order(model: BaseModel, dataset: Dataset) -> Dataset:
    """The data set with its channels in the order of the model; unchanged if the channels differ.

    Actions that the model does not know are left out.
    """
    dataset = dataset.without_actions_but(model.names)
    same = set(dataset.names) == set(model.names)
    return dataset.select(model.names) if same and dataset.names != model.names else dataset


def increasing_seconds(value: ArrayLike, what: str) -> NDArray[np.float64]:
    """Returns one number or several, in s, as an array.

    Args:
        value: a number, or a list or array of numbers.
        what: name of the value, for the message.

    Raises:
        InputError: it is not a number or list; it is empty, not finite, or not increasing.
    """
    try:
        array = np.atleast_1d(np.asarray(value))
    except (TypeError, ValueError):  # lists of different lengths
        array = np.empty((0, 0))
    if array.ndim == 1 and (array.dtype.kind in "iuf" or not array.size):
        seconds = array.astype(np.float64)
        if len(seconds) and np.isfinite(seconds).all() and (np.diff(seconds) > 0).all():
            return seconds
    raise InputError(
        f"{what} must be one number of seconds or several that are finite and increase strictly, "
        f"got {' '.join(reprlib.repr(value).split())}; give them such as 0.5 or [0.1, 0.5]"
    )


def times_of_each(times: Times, count: int) -> list[NDArray[np.float64]]:
    """(times,) s of each trajectory.

    Args:
        times: one time or one array for all trajectories, or one array per trajectory.
        count: number of trajectories.

    Raises:
        InputError: they are not finite numbers in increasing order, or of another count.
    """
    if hasattr(times, "__array__"):
        times = np.atleast_1d(np.asarray(times))
    nested = isinstance(times, list | tuple | np.ndarray) and any(np.ndim(t) for t in times)
    if not nested:
        return [increasing_seconds(times, "times")] * count  # type: ignore[arg-type]
    each: list[ArrayLike] = list(times)  # type: ignore[arg-type]
    if len(each) != count:
        raise InputError(
            f"got times for {len(each)} trajectories, the data has {count}; give one array for "
            "all, or one per trajectory"
        )
    return [increasing_seconds(at, f"times of trajectory {i}") for i, at in enumerate(each)]


def check_any_time(model: BaseModel) -> None:
    """Checks that a row in which nothing is observed changes no other prediction.

    Args:
        model: trained or not.

    Raises:
        InputError: it would change one.
    """
    if not isinstance(model, Model):
        return
    for field, value, meaning in (
        ("readout", "last_row", "predicts the same for any time"),
        ("update_rows", "every", "is changed by every row, and a requested time is one more row"),
        ("decay_rows", "every_row", "decays at every row, and a requested time is one more row"),
        ("time_input", "gap", "uses the gap since the row before, which a requested time splits"),
        ("clock", "first_row", "starts at the first row, and a requested time can be before it"),
        ("self_feeding", True, "draws a random number at every row, also at a requested time"),
    ):
        found = getattr(model.config, field)
        if found == value or (value is True and found):
            raise InputError(
                f"a model with {field}={found!r} {meaning}: it can't predict at other times than "
                f"those of its rows; leave times out, or train one with another {field}"
            )


def _with_rows_at(
    trajectory: Trajectory, times: NDArray[np.float64]
) -> tuple[Trajectory, NDArray[np.int64]]:
    """The trajectory with a row at each of the times (new ones empty), and their indices."""
    union = np.union1d(trajectory.times, times)
    rows = np.searchsorted(union, times)
    if len(union) == trajectory.rows:
        return trajectory, rows
    own = np.searchsorted(union, trajectory.times)
    values = np.full((len(union), trajectory.channels), np.nan)
    observed = np.zeros(values.shape, dtype=bool)
    values[own], observed[own] = trajectory.values, trajectory.observed
    merged = replace(trajectory, times=union, values=values, observed=observed)
    return merged, rows
