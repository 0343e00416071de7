"""Forecasts: predictions after the last row."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from offbeat.answers.predict import Answering, answering, increasing_seconds, predict
from offbeat.data.trajectory import Dataset
from offbeat.errors import InputError


def forecast(
    model: Answering,
    dataset: Dataset,
    horizons: ArrayLike,
    *,
    device: str | torch.device | None = None,
) -> Dataset:
    """Predicts each trajectory after its last row.

    Args:
        model: a trained model, or a blend or the result of `learn`, whose forecasts have intervals.
        dataset: the observed data.
        horizons: s after the last row: one number, or several that increase strictly, above 0.
        device: that the model is computed on, as of `fit`, and moved back from; by default its own.

    Returns:
        One trajectory of predictions per trajectory, in original units, on the clock of the data;
        channels in the order of the model, none of them observed.

    Raises:
        InputError: horizons that are not above 0 or do not increase, other channels than the
            model's, or a model that cannot predict at any time.
    """
    model, dataset = answering(model), Dataset.of(dataset)
    after = checked_horizons(horizons)
    times = [t.times[-1] + after for t in dataset]
    predicted = predict(model, dataset, times=times, device=device)
    unseen = np.zeros((len(after), model.channels), dtype=bool)
    return Dataset(
        tuple(replace(t, observed=unseen) for t in predicted),
        {**predicted.meta, "horizons_s": after.tolist()},
    )


extrapolate = forecast
"""The name of `forecast` in 0.1, kept as an alias."""


def checked_horizons(horizons: ArrayLike) -> NDArray[np.float64]:
    """Returns horizons as an array.

    Raises:
        InputError: they are not above 0, finite and strictly increasing.
    """
    after = increasing_seconds(horizons, "horizons")
    if after[0] <= 0:
        raise InputError(
            f"horizons must be above 0 s, got {after[0]:g}; a forecast starts after the last row"
        )
    return after
