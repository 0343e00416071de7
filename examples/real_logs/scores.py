"""Scores of predictors on tasks, and what they sum up to."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from offbeat import calibration
from offbeat.calibration import CalibrationSums
from offbeat.errors import InputError

from .predictors import Predictor
from .tasks import Task

Array = NDArray[np.float64]

BAND = 0.02
"""Errors closer than this fraction are a tie."""

FLOOR = 1e-9
"""Errors below this many scaled units count as this; channels that never move have error 0."""

LEVELS = np.arange(1, 40) / 40
"""Quantiles that are asked for: steps of 2.5 %."""

INTERVALS = calibration.LEVELS
"""Central intervals that are scored; their ends are among `LEVELS`."""

AGES_S = 0.01
"""s; widths of intervals are kept by time since observation, up to 1, 2, 4, 8, ... times this."""


def score(task: Task, predictor: Predictor, scale: Array) -> dict[str, Any]:
    """Scores a predictor on a task.

    Args:
        task: what is asked.
        predictor: fitted.
        scale: (channels,) one scaled unit in the unit of each channel.

    Returns:
        `rmse_scaled` over all scored values, `rmse` (channels,) in units, NaN where no value of the
        channel is scored, and where the predictor has quantiles what `intervals` returns.

    Raises:
        InputError: a prediction is missing or not finite.
    """
    channel = np.concatenate([np.nonzero(mask)[1] for mask in task.scored])
    truth = _chosen((t.values for t in task.dataset), task)
    predicted = _chosen(predictor.predict(task.dataset), task)
    if not np.isfinite(predicted).all():
        missing = int((~np.isfinite(predicted)).sum())
        raise InputError(
            f"{task.name}: {missing} of {len(predicted)} predictions are not finite numbers"
        )
    squares = ((predicted - truth) / scale[channel]) ** 2
    counts = np.bincount(channel, minlength=len(scale))
    with np.errstate(invalid="ignore"):
        rmse = np.sqrt(np.bincount(channel, squares, minlength=len(scale)) / counts) * scale
    found: dict[str, Any] = {"rmse_scaled": float(np.sqrt(squares.mean())), "rmse": rmse}
    if hasattr(predictor, "quantiles"):
        quantiles = _chosen(predictor.quantiles(task.dataset, LEVELS), task)
        age = _chosen((_elapsed(t.times, t.observed) for t in task.dataset), task)
        found |= intervals(truth / scale[channel], quantiles / scale[channel][:, None], age)
    return found


def counts(task: Task) -> list[int]:
    """Number of scored values of each channel."""
    return [int(n) for n in sum(mask.sum(axis=0) for mask in task.scored)]


def _chosen(values: Iterable[Array], task: Task) -> Array:
    """The scored rows and channels of all trajectories, one after the other."""
    return np.concatenate([v[m] for v, m in zip(values, task.scored, strict=True)])


def _elapsed(times: Array, observed: NDArray[np.bool_]) -> Array:
    """(rows, channels) s since the channel was observed in an earlier row; NaN where it was not."""
    last = np.full(observed.shape, np.nan)
    at = np.where(observed, times[:, None], np.nan)
    last[1:] = np.fmax.accumulate(at, axis=0)[:-1]
    return np.asarray(times[:, None] - last)


def intervals(truth: Array, quantiles: Array, age: Array) -> dict[str, Any]:
    """Coverage and score of central intervals, and the continuous ranked probability score.

    CRPS = 2 int_0^1 (1{y < q(p)} - p) (q(p) - y) dp (Gneiting and Raftery 2007, Journal of the
    American Statistical Association 102), by the trapezoidal rule over `LEVELS`, 0 at both ends.

    Args:
        truth: (values,) scaled.
        quantiles: (values, levels) scaled, at `LEVELS`.
        age: (values,) s since the channel was observed.

    Returns:
        `crps_scaled`; `coverage`, the fraction of the values within each interval, and
        `interval_score_scaled`, by interval; `widths_scaled`, the mean width of intervals of 90 %,
        by the longest time since observation in s.
    """
    above = quantiles - truth[:, None]
    loss = np.where(above > 0, 1 - LEVELS, -LEVELS) * above
    crps = 2 * loss.sum(axis=1) / (len(LEVELS) + 1)
    low, high = (
        np.stack([_at(quantiles, 0.5 + side * wide / 2) for wide in INTERVALS], axis=1)
        for side in (-1, 1)
    )
    sums = CalibrationSums(INTERVALS, age_unit=AGES_S)
    sums.add(truth, low, high, crps, age)
    found = sums.result()
    assert found is not None
    names = [f"{level:g}" for level in found.levels]
    return {
        "crps_scaled": found.crps,
        "coverage": dict(zip(names, found.coverage, strict=True)),
        "interval_score_scaled": dict(zip(names, found.interval_score, strict=True)),
        "widths_scaled": {f"{a.up_to_s:g}": a.width for a in found.by_age},
    }


def _at(quantiles: Array, level: float) -> Array:
    return quantiles[:, int(np.argmin(np.abs(LEVELS - level)))]


@dataclass(frozen=True)
class Against:
    """A predictor against the best of others, per channel and task.

    Attributes:
        wins: channels and tasks with an error more than 2 % below the best other one.
        ties: within 2 %.
        losses: more than 2 % above.
        worst: largest ratio of the errors.
        geometric_mean: of the ratios.
    """

    wins: int
    ties: int
    losses: int
    worst: float
    geometric_mean: float

    @classmethod
    def of(cls, ratios: Array) -> Against:
        """Counts ratios of errors.

        Args:
            ratios: (n,) error / best other error; at least one.
        """
        return cls(
            int((ratios < 1 - BAND).sum()),
            int((np.abs(ratios - 1) <= BAND).sum()),
            int((ratios > 1 + BAND).sum()),
            float(ratios.max()),
            float(np.exp(np.log(ratios).mean())),
        )


def ratios(errors: Mapping[str, Sequence[float]], name: str, others: Iterable[str]) -> Array:
    """Ratios of a predictor's error to the best of others, per channel that is scored.

    Args:
        errors: per predictor (channels,) scaled RMSE on one task.
        name: of the predictor; where it is among the others, no ratio is below 1.
        others: names; those without errors are left out.

    Returns:
        (scored channels,); empty where there is no other.
    """
    against = [errors[other] for other in others if other in errors]
    if not against:
        return np.empty(0)
    best = np.min(np.maximum(against, FLOOR), axis=0)
    own = np.maximum(np.asarray(errors[name]), FLOOR)
    return np.asarray((own / best)[np.isfinite(best)])
