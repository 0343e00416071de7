"""Gaussian processes and ridge regression of scikit-learn."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from .problem import Answer, Answerer, Array, Problem, Series
from .registry import Options

Z = 1.6448536269514722
"""Of an interval of 90 %."""

LAGS = 10
"""Rows that forecasts of the ridge look at."""

ALPHAS = (0.1, 1.0, 10.0, 100.0, 1000.0)
"""Penalties that are tried, of features in scaled units."""

ALPHAS_OF_KERNELS = (0.01, 0.1, 1.0)
"""The same, with kernels among the features."""


def gaussian_process(problem: Problem, options: Options) -> Answerer:
    """A Gaussian process in time per channel, with a Matern 3/2 kernel and noise.

    Args:
        problem: to answer.
        options: not used.
    """
    from sklearn.gaussian_process import GaussianProcessRegressor
    from sklearn.gaussian_process.kernels import ConstantKernel, Matern, WhiteKernel

    length = 20 * problem.step_s
    start = ConstantKernel(1.0, (1e-3, 1e3)) * Matern(length, (length / 20, length * 50), nu=1.5)
    start += WhiteKernel(1e-3, (1e-8, 1.0))
    windows = problem.fit[:: max(1, len(problem.fit) // 5)][:5]
    kernels = []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # hyperparameters at their bounds, of channels at rest
        for channel in range(len(problem.channels)):
            found = []
            for series in windows:
                seen, x = _seen(problem, series, channel)
                if seen.sum() > 3:
                    fitted = GaussianProcessRegressor(start).fit(series.times[seen, None], x[seen])
                    found.append(fitted.kernel_.theta)
            theta = np.median(found, axis=0) if found else start.theta
            kernels.append(start.clone_with_theta(theta))

    def one(series: Series, rows: slice) -> Answer:
        shape = series.values.shape
        values, half = np.tile(problem.mean, (shape[0], 1)), np.tile(problem.scale, (shape[0], 1))
        for channel, kernel in enumerate(kernels):
            seen, x = _seen(problem, series, channel)
            used = np.flatnonzero(seen)[rows]
            asked = np.flatnonzero(~seen)[-1:] if rows.start else np.flatnonzero(~seen)
            if len(used) and len(asked):
                process = GaussianProcessRegressor(kernel, optimizer=None)
                process.fit(series.times[used, None], x[used])
                mean, deviation = process.predict(series.times[asked, None], return_std=True)
                values[asked, channel] += mean * problem.scale[channel]
                half[asked, channel] = Z * deviation * problem.scale[channel]
        return Answer(values, values - half, values + half)

    def answer(task: str, asked: Sequence[Series]) -> list[Answer]:
        rows = slice(-60, None) if task.startswith("forecast") else slice(None)
        return [one(series, rows) for series in asked]

    return answer


def _seen(problem: Problem, series: Series, channel: int) -> tuple[Any, Array]:
    x = (series.values[:, channel] - problem.mean[channel]) / problem.scale[channel]
    return np.isfinite(x), x


def ridge(problem: Problem, options: Options) -> Answerer:
    """Ridge regressions: one per channel and horizon for forecasts, one per channel for fills.

    Args:
        problem: to answer.
        options: not used.
    """
    channels = len(problem.channels)
    fills = []
    for channel in range(channels):
        parts = [list(_gaps(problem, s, channel)) for s in (problem.fit, problem.held_out)]
        fills.append(_chosen([_stacked(part) for part in parts]))
    ahead = {}
    for horizon in problem.horizons_s:
        train = _pasts(problem, problem.train, horizon, every=3)
        validation = _pasts(problem, problem.validation, horizon, every=2)
        ahead[horizon] = [
            _chosen([(x[ok[:, c]], y[ok[:, c], c]) for x, y, ok in (train, validation)])
            for c in range(channels)
        ]

    def fill(asked: Sequence[Series]) -> list[Answer]:
        # Where there is a neighbour on one side only, the nearest value stays.
        answers = [Answer(_lines(problem, s) * problem.scale + problem.mean) for s in asked]
        for channel in range(channels):
            for features, line, _, at, number in _gaps(problem, asked, channel):
                found = line + fills[channel].predict(features)
                scaled = found * problem.scale[channel] + problem.mean[channel]
                answers[number].values[at, channel] = scaled
        return answers

    def forecast(asked: Sequence[Series]) -> list[Answer]:
        answers = []
        for series in asked:
            past = problem.filled(series.values[:-1])
            gap = series.times[-1] - series.times[-2]
            models = ahead[min(ahead, key=lambda horizon: abs(horizon - gap))]
            features = _features(past)[-1:]
            last = past[-1] + np.array([model.predict(features)[0] for model in models])
            values = np.tile(last * problem.scale + problem.mean, (len(series.times), 1))
            answers.append(Answer(values))
        return answers

    return lambda task, asked: (forecast if task.startswith("forecast") else fill)(asked)


def kernel_ridge(problem: Problem, options: Options) -> Answerer:
    """Ridge regression on the features of `ridge` and on Gaussian kernels of them, for forecasts.

    Args:
        problem: to answer.
        options: seed of the points of the kernels.
    """
    from sklearn.kernel_approximation import Nystroem

    channels, ahead = len(problem.channels), {}
    for horizon in problem.horizons_s:
        every = max(1, sum(len(s.times) for s in problem.train) // 5000)
        x, y, ok = _pasts(problem, problem.train, horizon, every=every)
        held = _pasts(problem, problem.validation, horizon, every=2)
        tried = []
        for gamma in (0.3, 3.0):
            kernels = Nystroem(
                gamma=gamma / x.shape[1],
                n_components=min(300, len(x)),
                random_state=options.seed,
            )
            mapped, held_mapped = kernels.fit_transform(x), kernels.transform(held[0])
            both, held_both = np.hstack([x, mapped]), np.hstack([held[0], held_mapped])
            models, errors = [], []
            for c in range(channels):
                inside = held[2][:, c]
                part = (held_both[inside], held[1][inside, c])
                models.append(_chosen([(both[ok[:, c]], y[ok[:, c], c]), part], ALPHAS_OF_KERNELS))
                errors.append(np.mean((models[-1].predict(part[0]) - part[1]) ** 2))
            tried.append((float(np.mean(errors)), kernels, models))
        ahead[horizon] = min(tried, key=lambda each: each[0])[1:]

    def one(series: Series) -> Answer:
        past = problem.filled(series.values[:-1])
        gap = series.times[-1] - series.times[-2]
        kernels, models = ahead[min(ahead, key=lambda horizon: abs(horizon - gap))]
        features = _features(past)[-1:]
        both = np.hstack([features, kernels.transform(features)])
        last = past[-1] + np.array([model.predict(both)[0] for model in models])
        return Answer(np.tile(last * problem.scale + problem.mean, (len(series.times), 1)))

    return lambda task, asked: [one(series) for series in asked]


def _lines(problem: Problem, series: Series) -> Array:
    """(rows, channels) scaled, with lines between neighbours."""
    scaled = problem.scaled(series.values)
    for channel in scaled.T:
        seen = np.isfinite(channel)
        if seen.any():
            channel[:] = np.interp(series.times, series.times[seen], channel[seen])
    return np.nan_to_num(scaled)


def _features(past: Array) -> Array:
    """(rows, features) the last value of each channel, and earlier ones less the last."""
    padded = np.concatenate([np.repeat(past[:1], LAGS - 1, axis=0), past])
    lags = [padded[LAGS - 1 - k : len(padded) - k] - past for k in range(1, LAGS)]
    return np.concatenate([past, *lags], axis=1)


def _pasts(
    problem: Problem, part: Sequence[Series], horizon: float, *, every: int
) -> tuple[Array, Array, Any]:
    """Features of rows, what follows a horizon later less the last value, and where it is known."""
    found = []
    for series in part:
        filled = problem.filled(series.values)
        target = np.searchsorted(series.times, series.times + horizon * (1 - 1e-9))
        row = np.flatnonzero(target < len(series.times))[::every]
        scaled = problem.scaled(series.values[target[row]])
        found.append((_features(filled)[row], scaled - filled[row]))
    x, y = (np.concatenate(each) for each in zip(*found, strict=True))
    return x, y, np.isfinite(y)


def _gaps(
    problem: Problem, part: Sequence[Series], channel: int
) -> Iterator[tuple[Array, Array, Array, Any, int]]:
    """Rows without a value of a channel, between two that have one.

    Yields, per series: features, the line between the neighbours, the truth less that line (NaN
    without truth), the rows, and the number of the series.
    """
    for number, series in enumerate(part):
        times = series.times
        scaled = problem.scaled(series.values)
        seen = np.isfinite(scaled)
        known = [np.flatnonzero(s) for s in seen.T]
        if len(known[channel]) < 4:
            continue
        others = _lines(problem, series)
        at = np.flatnonzero(~seen[:, channel])
        rows = known[channel]
        after = np.searchsorted(rows, at)
        inside = (after > 1) & (after < len(rows) - 1)
        if not inside.any():
            continue
        at, after = at[inside], after[inside]
        a, b, before, beyond = (rows[after + k] for k in (-1, 0, -2, 1))
        own, span = scaled[:, channel], times[b] - times[a]
        u = (times[at] - times[a]) / span
        line = (1 - u) * own[a] + u * own[b]
        chord = (own[b] - own[a]) / span
        slope_a = (own[a] - own[before]) / (times[a] - times[before]) - chord
        slope_b = (own[beyond] - own[b]) / (times[beyond] - times[b]) - chord
        edges = [slope_a * span * u * (1 - u) ** 2, -slope_b * span * u**2 * (1 - u)]
        # Other channels less the line between the same two rows; one of them may be the derivative
        # or the integral of this one.
        steps = np.diff(times)[:, None]
        area = np.cumsum(np.append(0 * others[:1], steps * (others[1:] + others[:-1]) / 2, 0), 0)
        slopes = np.gradient(others, times, axis=0)
        whole = np.delete(np.concatenate([others, area, slopes], axis=1), channel, axis=1)
        bow = whole[at] - (1 - u)[:, None] * whole[a] - u[:, None] * whole[b]
        features = np.column_stack([*edges, bow])
        truth = np.full(len(at), np.nan)
        if series.truth is not None:
            truth = (series.truth[at, channel] - problem.mean[channel]) / problem.scale[channel]
        yield features, line, truth - line, at, number


def _stacked(gaps: Sequence[tuple[Array, Array, Array, Any, int]]) -> tuple[Array, Array]:
    x, y = (np.concatenate([gap[i] for gap in gaps]) for i in (0, 2))
    return x[np.isfinite(y)], y[np.isfinite(y)]


def _chosen(parts: Sequence[tuple[Array, Array]], alphas: Sequence[float] = ALPHAS) -> Any:
    """The regression of the penalty with the least error on the second part."""
    from sklearn.linear_model import Ridge

    (x, y), (held_x, held_y) = parts
    tried = [Ridge(alpha=alpha, fit_intercept=False).fit(x, y) for alpha in alphas]
    return min(tried, key=lambda model: np.mean((model.predict(held_x) - held_y) ** 2))
