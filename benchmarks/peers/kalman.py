"""Kalman smoothers of pykalman and statsmodels."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from math import factorial
from typing import Any

import numpy as np

from .problem import Answer, Answerer, Array, Problem, Series
from .registry import Options

NOISE = 0.01
"""Standard deviation of the measurements of a smoother, scaled."""

ROWS = 52_000
"""Of all groups of channels together, to choose the noise on: about a minute."""

MISSING = 1e9
"""Variance of a missing measurement: pykalman drops a row of which one value is masked."""

Z = 1.6448536269514722
"""Of an interval of 90 %."""


def smoother(problem: Problem, options: Options) -> Answerer:
    """A smoother of pykalman per channel, or per position and velocity, with steps as stamped.

    The order of the derivative that is random, 2 or 3, and its strength are chosen per channel on
    masked validation windows; the width of the intervals is set there as well.

    Args:
        problem: to answer.
        options: not used.
    """
    paired = {i for pair in problem.pairs for i in pair}
    groups = [*problem.pairs, *((i,) for i in range(len(problem.channels)) if i not in paired)]
    count = ROWS // (len(groups) * len(problem.held_out[0].times))
    windows = problem.held_out[:: max(1, len(problem.held_out) // max(count, 1))]
    settings = []
    for group in groups:
        best: tuple[Any, ...] = (np.inf,)
        for order in (2, 3):
            for strength in 10.0 ** np.arange(0, 9, 1.5):
                error, z = _validate(problem, windows, group, order, strength)
                best = min(best, (error, order, strength, z), key=lambda found: found[0])
        settings.append((group, *best[1:]))

    def one(series: Series) -> Answer:
        values, deviation = np.empty_like(series.values), np.empty_like(series.values)
        for group, order, strength, z in settings:
            at = list(group)
            values[:, at], found = smooth(problem, series, group, order, strength)
            deviation[:, at] = found * z
        return Answer(values, values - Z * deviation, values + Z * deviation)

    return lambda task, asked: [one(series) for series in asked]


def _validate(
    problem: Problem, windows: Sequence[Series], group: tuple[int, ...], order: int, strength: float
) -> tuple[float, float]:
    """Mean squared error, scaled, and the factor that makes deviations as large as errors."""
    at, errors, ratios = list(group), [], []
    for series in windows:
        assert series.truth is not None
        hidden = np.isnan(series.values[:, at]) & np.isfinite(series.truth[:, at])
        values, deviation = smooth(problem, series, group, order, strength)
        error = values - series.truth[:, at]
        errors.append((error / problem.scale[at])[hidden])
        ratios.append((error / deviation)[hidden])
    square = float(np.mean(np.concatenate(errors) ** 2))
    return square, float(np.sqrt(np.mean(np.concatenate(ratios) ** 2)))


def smooth(
    problem: Problem, series: Series, group: tuple[int, ...], order: int, strength: float
) -> tuple[Array, Array]:
    """Smooths a channel, or a position and its velocity.

    Args:
        problem: its scale and mean.
        series: to smooth.
        group: positions of the channels.
        order: of the derivative that is white noise.
        strength: its spectral density, scaled.

    Returns:
        (rows, channels of the group) means, and standard deviations.
    """
    from pykalman import KalmanFilter

    at, steps, n = list(group), np.diff(series.times), order
    i, j = np.indices((n, n))
    power = np.maximum(j - i, 0)
    move = np.where(j >= i, steps[:, None, None] ** power, 0.0)
    move /= np.vectorize(factorial)(power)
    last = 2 * n - 1 - i - j
    divisor = np.vectorize(factorial)(n - 1 - i) * np.vectorize(factorial)(n - 1 - j) * last
    noise = strength * steps[:, None, None] ** last / divisor
    # The unit of the state is that of the first channel, which the others are derivatives of.
    unit = problem.scale[at[0]]
    shift = np.where(np.arange(len(at)) == 0, problem.mean[at], 0)
    values = series.values[:, at] - shift
    seen = np.isfinite(values)
    ratio = problem.scale[at] / unit
    variance = np.where(seen, (NOISE * ratio) ** 2, MISSING)
    found = KalmanFilter(
        transition_matrices=move,
        observation_matrices=np.eye(len(at), n),
        transition_covariance=noise,
        observation_covariance=variance[:, :, None] * np.eye(len(at)),
        initial_state_mean=np.zeros(n),
        initial_state_covariance=np.diag(10.0 ** (4 * np.arange(n))),
    ).smooth(np.where(seen, values / unit, 0.0))
    means, covariances = (np.asarray(each) for each in found)
    variances = np.diagonal(covariances, axis1=1, axis2=2)[:, : len(at)]
    deviation = np.sqrt(np.maximum(variances, 1e-18))  # rounding can leave less than 0
    return means[:, : len(at)] * unit + shift, deviation * unit


def local_linear_trend(problem: Problem, options: Options) -> Answerer:
    """A local linear trend of statsmodels per channel; it knows no stamps, so rows are its steps.

    Args:
        problem: to answer.
        options: not used.
    """
    from statsmodels.tsa.statespace.structural import UnobservedComponents

    def model(values: Array) -> Any:
        return UnobservedComponents(values, "local linear trend")

    longest = max(problem.train, key=lambda series: len(series.times))
    scaled = problem.scaled(longest.values[:1000])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of the convergence for channels at rest
        fitted = [model(channel).fit(disp=False).params for channel in scaled.T]

    def one(series: Series, ahead: bool) -> Answer:
        times, known = series.times, problem.scaled(series.values)
        if ahead:  # as many steps as the last row is ahead
            step = np.median(np.diff(times[:-1])) if len(times) > 2 else problem.step_s
            steps = max(round((times[-1] - times[-2]) / step), 1)
            known = np.concatenate([known[-61:-1], np.full((steps, known.shape[1]), np.nan)])
        level, deviation = np.empty_like(known), np.empty_like(known)
        for i, parameters in enumerate(fitted):
            found = model(known[:, i]).smooth(parameters)
            level[:, i] = found.smoothed_state[0]
            variance = found.smoothed_state_cov[0, 0] + parameters[0]
            deviation[:, i] = np.sqrt(np.maximum(variance, 0))
        values = level * problem.scale + problem.mean
        half = Z * deviation * problem.scale
        if ahead:
            values, half = (np.tile(v[-1], (len(times), 1)) for v in (values, half))
        return Answer(values, values - half, values + half)

    return lambda task, asked: [one(series, task.startswith("forecast")) for series in asked]
