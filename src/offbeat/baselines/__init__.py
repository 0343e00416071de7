"""Baselines: predictors in closed form, for every task that a model is asked."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from offbeat.baselines.base import (
    BASELINES,
    Array,
    Baseline,
    CausalBaseline,
    causal_baselines,
    checked_causal,
    fit_baseline,
)
from offbeat.baselines.folds import cross_fitted, folds_of
from offbeat.baselines.groups import Group, find_groups
from offbeat.baselines.history import AgeBins, History
from offbeat.baselines.kalman_channels import KalmanLong, KalmanShort, Smoother
from offbeat.baselines.kalman_groups import MotionFilter, MotionSmoother
from offbeat.baselines.kernel_ridge import KernelRidge
from offbeat.baselines.residual_gru import ResidualGru
from offbeat.baselines.ridge import Ridge
from offbeat.baselines.ridge_fill import RidgeFill
from offbeat.baselines.simple import (
    ConstantVelocity,
    DampedSlope,
    LastValue,
    Linear,
    Mean,
    Pchip,
    RunningMean,
)
from offbeat.data.rows import add_rows
from offbeat.data.trajectory import Dataset, Trajectory

__all__ = [
    "BASELINES",
    "AgeBins",
    "Baseline",
    "CausalBaseline",
    "ConstantVelocity",
    "DampedSlope",
    "Group",
    "History",
    "KalmanLong",
    "KalmanShort",
    "KernelRidge",
    "LastValue",
    "Linear",
    "Mean",
    "MotionFilter",
    "MotionSmoother",
    "Pchip",
    "ResidualGru",
    "Ridge",
    "RidgeFill",
    "RunningMean",
    "Smoother",
    "causal_baselines",
    "cross_fitted",
    "fill",
    "fillers",
    "find_groups",
    "fit_baseline",
    "folds_of",
    "forecast",
    "forecasters",
]


def fillers() -> tuple[str, ...]:
    """Names of the baselines of fills that need no training."""
    return ("last_value", "linear", "pchip")


def forecasters() -> tuple[str, ...]:
    """Names of the baselines of forecasts that need no training."""
    return ("last_value", "constant_velocity")


def fill(trajectory: Trajectory, method: str, mean: Sequence[float]) -> Array:
    """Fills a trajectory by a baseline that needs no training.

    Args:
        trajectory: the observed trajectory; masked values are not used.
        method: name of a baseline.
        mean: training mean of each channel, in its unit.

    Returns:
        (rows, channels) in original units.

    Raises:
        InputError: there is no such baseline.
    """
    baseline = BASELINES[method]()
    baseline.mean = np.asarray(mean, dtype=np.float64)
    return baseline.predict(Dataset((trajectory,)))[0]


def forecast(trajectory: Trajectory, times: Array, method: str, mean: Sequence[float]) -> Array:
    """Predicts after the last row by a baseline that needs no training.

    Args:
        trajectory: the observed trajectory.
        times: (times,) s, after the last observation.
        method: name of a causal baseline.
        mean: training mean of each channel, in its unit.

    Returns:
        (times, channels) in original units.

    Raises:
        InputError: there is no such baseline, or it is not causal.
    """
    checked_causal(method)
    extended = add_rows(trajectory, times)
    return fill(extended, method, mean)[np.searchsorted(extended.times, times)]
