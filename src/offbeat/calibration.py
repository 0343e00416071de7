"""Scores of predicted distributions: coverage and interval score, and the CRPS of them all.

There is one accumulator, `CalibrationSums`, for intervals from wherever they come: those of a blend
(`answers.intervals`), those of a model with a Gaussian head, or quantiles of any other predictor.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

COVERED = (0.5, 0.8, 0.95)
"""Levels of the intervals whose scores are shown."""

LEVELS = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95)
"""Levels of the intervals that are scored; they include `COVERED`."""

BAND = 0.9
"""Level of the intervals whose widths are kept by the time since observation."""


def interval_score(truth: ArrayLike, low: ArrayLike, high: ArrayLike, level: float) -> Array:
    r"""The interval score, its width and a penalty for what is outside; lower is better.

    :math:`(u - l) + \frac{2}{\alpha} \max(l - y, 0) + \frac{2}{\alpha} \max(y - u, 0)` with
    :math:`\alpha = 1 - level` (Winkler 1972; Gneiting and Raftery 2007, equation 43). Its
    expectation is lowest at the quantiles of :math:`\alpha / 2` and :math:`1 - \alpha / 2`.

    Args:
        truth: (...) what was to be predicted.
        low: (...) lower end of the interval.
        high: (...) upper end.
        level: probability of the interval, from 0 to less than 1.

    Returns:
        (...) in the unit of the truth.
    """
    y, lower, upper = (np.asarray(a, dtype=np.float64) for a in (truth, low, high))
    outside = np.maximum(lower - y, 0.0) + np.maximum(y - upper, 0.0)
    return np.asarray(upper - lower + 2.0 / (1.0 - level) * outside)


def normal_half_widths(scale: ArrayLike, levels: Sequence[float] = LEVELS) -> Array:
    """(..., levels) half widths of the central intervals of normal distributions.

    Args:
        scale: (...) standard deviations.
        levels: probabilities of the intervals.
    """
    import torch

    wide = torch.special.ndtri(torch.tensor((1.0 + np.asarray(levels)) / 2.0)).numpy()
    return np.asarray(np.asarray(scale, dtype=np.float64)[..., None] * wide)


def normal_crps(error: ArrayLike, scale: ArrayLike) -> Array:
    """(...) CRPS of normal distributions (Gneiting and Raftery 2007, equation 21).

    Args:
        error: (...) truth minus mean.
        scale: (...) standard deviations, above 0.
    """
    import torch

    sigma = np.asarray(scale, dtype=np.float64)
    z = np.asarray(error, dtype=np.float64) / sigma
    density = np.exp(-0.5 * z**2) / math.sqrt(2.0 * math.pi)
    within = torch.special.erf(torch.tensor(z / math.sqrt(2.0))).numpy()
    return np.asarray(sigma * (z * within + 2.0 * density - math.pi**-0.5))


@dataclass(frozen=True)
class AgeCalibration:
    """The intervals of `BAND` of values whose channel was last observed at similar times before.

    Attributes:
        up_to_s: s, longest time since observation.
        count: number of values.
        coverage: fraction of the values within their interval.
        width: mean width of the intervals, in units of the scale.
    """

    up_to_s: float
    count: int
    coverage: float
    width: float


@dataclass(frozen=True)
class Calibration:
    """How well intervals fit the values that they were predicted for, in units of a scale.

    Attributes:
        count: number of values.
        levels: probabilities of the intervals.
        coverage: per level, the fraction of the values within their interval.
        interval_score: per level, the mean of `interval_score`.
        crps: mean continuous ranked probability score.
        by_age: by the time since observation, shortest first; empty where times are unknown.
    """

    count: int
    levels: tuple[float, ...]
    coverage: tuple[float, ...]
    interval_score: tuple[float, ...]
    crps: float
    by_age: tuple[AgeCalibration, ...] = ()

    def shown(self, scores: Sequence[float]) -> dict[float, float]:
        """Scores at the levels of `COVERED`.

        Args:
            scores: per level, `coverage` or `interval_score`.
        """
        return {level: scores[self.levels.index(level)] for level in COVERED}

    def to_dict(self) -> dict[str, Any]:
        """JSON-like form, with the levels of `COVERED`."""

        def named(scores: Sequence[float]) -> Mapping[str, float]:
            return {f"{level:g}": value for level, value in self.shown(scores).items()}

        return {
            "coverage": named(self.coverage),
            "interval_score_scaled": named(self.interval_score),
            "crps_scaled": self.crps,
        }


class CalibrationSums:
    """Accumulates scores of predicted distributions, in units of a scale.

    Args:
        levels: probabilities of the intervals, `COVERED` and `BAND` among them.
        age_unit: s; times since observation are grouped at 1, 2, 4, 8, ... times this.
    """

    def __init__(self, levels: Sequence[float] = LEVELS, *, age_unit: float | None = None) -> None:
        self.levels, self.age_unit = tuple(levels), age_unit
        self._band = self.levels.index(BAND)
        self._count, self._crps = 0, 0.0
        self._inside, self._score = np.zeros(len(levels)), np.zeros(len(levels))
        self._ages: dict[int, NDArray[np.float64]] = {}

    def add(
        self, truth: Array, low: Array, high: Array, crps: Array, age: Array | None = None
    ) -> None:
        """Adds values and what was predicted for them.

        Args:
            truth: (values,) in units of the scale, as are all others.
            low: (values, levels) lower ends of the intervals.
            high: (values, levels) upper ends.
            crps: (values,) continuous ranked probability scores.
            age: (values,) s since the channel was observed; not finite where it was not.
        """
        inside = (low <= truth[:, None]) & (truth[:, None] <= high)
        self._count += len(truth)
        self._crps += float(crps.sum())
        self._inside += inside.sum(axis=0)
        for i, level in enumerate(self.levels):
            self._score[i] += interval_score(truth, low[:, i], high[:, i], level).sum()
        if age is None or self.age_unit is None:
            return
        known = np.isfinite(age)
        group = np.ceil(np.log2(np.maximum(age[known] / self.age_unit, 1.0)) - 1e-6).astype(int)
        width = (high - low)[known, self._band]
        for k in np.unique(group).tolist():
            at = group == k
            sums = np.array([at.sum(), inside[known, self._band][at].sum(), width[at].sum()])
            self._ages[k] = self._ages.get(k, 0.0) + sums

    def result(self) -> Calibration | None:
        """The scores of all values added so far; None without any."""
        if not self._count:
            return None
        by_age = tuple(
            AgeCalibration((self.age_unit or 0.0) * 2.0**k, int(n), inside / n, width / n)
            for k, (n, inside, width) in sorted((k, a.tolist()) for k, a in self._ages.items())
        )
        return Calibration(
            self._count,
            self.levels,
            tuple((self._inside / self._count).tolist()),
            tuple((self._score / self._count).tolist()),
            self._crps / self._count,
            by_age,
        )
