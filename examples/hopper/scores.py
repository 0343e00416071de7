"""Scores after the first observation, and where the squared error is."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

import offbeat as ob

from .data import switches

Array = NDArray[np.float64]

AGES = (1, 2, 3, 4, 6, 8, 12, 99)
"""Upper ends, in rows, of the bins of time since observation."""


class Questions:
    """What is asked of every predictor at one observed fraction.

    Args:
        test: windows of equal length, whole rows masked, every value known.
        scaler: gives the units of the scores.
    """

    def __init__(self, test: ob.Dataset, scaler: ob.Scaler) -> None:
        self.test = test
        self.truth = scaler.scaled(np.stack([t.values for t in test]))
        observed = np.stack([t.observed.any(axis=1) for t in test])
        row = np.arange(observed.shape[1])
        at = np.maximum.accumulate(np.where(observed, row, -1), axis=1)
        before = np.concatenate([np.full((len(at), 1), -1), at[:, :-1]], axis=1)
        self.counted = before >= 0
        self.age = np.where(self.counted, row - before, 0)
        switch = switches(test)
        total = np.cumsum(switch, axis=1)
        at = np.maximum(before, 0)
        first: NDArray[np.int64] = np.take_along_axis(total - switch, at, axis=1)
        self.switched = total > first
        """(trajectories, rows) whether there is a switch from the last observed row to this one."""

    def score(self, predicted: Array) -> dict[str, Any]:
        """The scores of a predictor.

        Args:
            predicted: (trajectories, rows, channels) scaled, each row from the rows before it.

        Returns:
            RMSE after the first observation, in all and by time since observation; the fractions of
            the rows that are `switched` and of their squared error; the fraction of the squared
            error in the worst hundredth of the rows; and the RMSE of positions and velocities.
        """
        square = (predicted - self.truth) ** 2
        rows = square.mean(axis=2)[self.counted]
        switched, age = self.switched[self.counted], self.age[self.counted]
        low = np.concatenate([[0], AGES[:-1]])
        of_age = [(age > a) & (age <= b) for a, b in zip(low, AGES, strict=True)]
        worst = np.sort(rows)[::-1][: max(len(rows) // 100, 1)]
        half, total = square.shape[2] // 2, rows.sum() or 1.0
        return {
            "rmse": _root(rows),
            "rows": len(rows),
            "by_age": [_root(rows[some]) for some in of_age],
            "rows_by_age": [int(some.sum()) for some in of_age],
            "error_by_age": [float(rows[some].sum() / total) for some in of_age],
            "near_switch_rows": float(switched.mean()),
            "near_switch_error": float(rows[switched].sum() / total),
            "rmse_elsewhere": _root(rows[~switched]),
            "worst_hundredth": float(worst.sum() / total),
            "rmse_positions": _root(square[..., :half].mean(axis=2)[self.counted]),
            "rmse_velocities": _root(square[..., half:].mean(axis=2)[self.counted]),
        }


def _root(squares: Array) -> float | None:
    return float(f"{np.sqrt(squares.mean()):.8g}") if len(squares) else None


def predictions(model: ob.Model, test: ob.Dataset, *, size: int = 250) -> Array:
    """The one-step-ahead predictions of a model in its scaled units.

    Args:
        model: trained.
        test: windows of equal length.
        size: windows at a time.
    """
    import torch

    batch = model.batch(test)
    with torch.inference_mode():
        parts = [
            model(batch.take(slice(first, first + size))).mean.double().numpy()
            for first in range(0, len(batch), size)
        ]
    return np.concatenate(parts)


def baseline_predictions(fitted: Any, test: ob.Dataset, scaler: ob.Scaler) -> Array:
    """The same of a fitted baseline.

    Args:
        fitted: a `Baseline`.
        test: windows of equal length.
        scaler: of the scores.
    """
    return scaler.scaled(np.stack(fitted.predict(test)))


def record(rows: list[Mapping[str, str]], model: str, fraction: float) -> dict[str, Any]:
    """What `results/thesis/record.csv` says of a model at a fraction.

    Args:
        rows: of the record.
        model: label of the thesis' protocol.
        fraction: observed part of the rows.

    Returns:
        RMSE after the first observation of repeat 0 and of all repeats, and minutes of a training.
    """
    found = [
        row
        for row in rows
        if (row["experiment"], row["model"]) == ("2", model)
        and float(row["observed_fraction"]) == fraction
    ]
    each = [float(row["honest_mse"]) ** 0.5 for row in found]
    first = next(r for r, row in zip(each, found, strict=True) if row["repeat"] == "0")
    return {
        "rmse": first,
        "all": each,
        "minutes": float(np.mean([float(row["seconds"]) for row in found])) / 60,
        "epochs": int(found[0]["epochs"]),
    }
