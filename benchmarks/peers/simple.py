"""The last value, a line and PCHIP between observed neighbours."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from .problem import Answer, Answerer, Array, Problem, Series
from .registry import Options


def last_value(problem: Problem, options: Options) -> Answerer:
    """The last observed value; the mean of training before the first.

    Args:
        problem: to answer.
        options: not used.
    """

    def fill(times: Array, seen: Array, values: Array) -> Array:
        at = np.searchsorted(seen, times, side="right") - 1
        return np.where(at >= 0, values[at], np.nan)

    return each_channel(problem, fill)


def linear(problem: Problem, options: Options) -> Answerer:
    """A line between neighbours; the nearest value outside.

    Args:
        problem: to answer.
        options: not used.
    """
    return each_channel(problem, np.interp)


def pchip(problem: Problem, options: Options) -> Answerer:
    """PCHIP between neighbours; the nearest value outside.

    Args:
        problem: to answer.
        options: not used.
    """
    from scipy.interpolate import PchipInterpolator

    def fill(times: Array, seen: Array, values: Array) -> Array:
        if len(seen) < 2:
            return np.interp(times, seen, values)
        return PchipInterpolator(seen, values)(np.clip(times, seen[0], seen[-1]))

    return each_channel(problem, fill)


def each_channel(problem: Problem, fill: Callable[[Array, Array, Array], Array]) -> Answerer:
    """Fills each channel by a function of times, observed times and observed values.

    Args:
        problem: whose mean is taken where nothing is observed, or the function says NaN.
        fill: the function.
    """

    def one(series: Series) -> Answer:
        values = np.tile(problem.mean, (len(series.times), 1))
        for channel in range(values.shape[1]):
            seen = np.isfinite(series.values[:, channel])
            if seen.any():
                found = fill(series.times, series.times[seen], series.values[seen, channel])
                values[:, channel] = np.where(np.isnan(found), problem.mean[channel], found)
        return Answer(values)

    return lambda task, asked: [one(series) for series in asked]
