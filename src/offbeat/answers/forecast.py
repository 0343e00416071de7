"""Going on after the last row."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from offbeat.answers.predict import predict
from offbeat.data.trajectory import Dataset
from offbeat.errors import InputError
from offbeat.models.model import Model


def forecast(model: Model, dataset: Dataset, horizons: ArrayLike) -> Dataset:
    """Predicts what comes after the last row of each trajectory.

    Args:
        model: trained.
        dataset: what was observed.
        horizons: s after the last row, above 0, strictly increasing.

    Returns:
        One trajectory of predictions per trajectory, in original units, on the clock of the data;
        channels in the order of the model, none of them observed.

    Raises:
        InputError: horizons that are not above 0 or do not increase, other channels than the
            model's, or a model that can't be asked for times.
    """
    after = checked_horizons(horizons)
    times = [t.times[-1] + after for t in dataset]
    predicted = predict(model, dataset, times=times)
    unseen = np.zeros((len(after), model.channels), dtype=bool)
    return Dataset(
        tuple(replace(t, observed=unseen) for t in predicted),
        {**predicted.meta, "horizons_s": after.tolist()},
    )


def checked_horizons(horizons: ArrayLike) -> NDArray[np.float64]:
    """Returns horizons as an array.

    Raises:
        InputError: they are not above 0, finite and strictly increasing.
    """
    try:
        after = np.atleast_1d(np.asarray(horizons, dtype=np.float64))
    except (TypeError, ValueError):
        raise InputError(f"horizons must be numbers of seconds, got {horizons!r}") from None
    fine = after.ndim == 1 and len(after) and np.isfinite(after).all() and after[0] > 0
    if not fine or (np.diff(after) <= 0).any():
        raise InputError(
            f"horizons must be seconds above 0 that increase, got {after.tolist()}; "
            "such as [0.1, 0.5, 1.0]"
        )
    return after
