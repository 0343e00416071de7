"""Intervals by split conformal prediction: quantiles of errors on data that nothing was fitted to.

The half width of an interval is a quantile of the absolute errors of its kind of value and channel,
times the fourth root of the local scale (Vovk et al., 2005; Lei et al., 2018, locally weighted).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from offbeat.baselines.base import as_kind
from offbeat.baselines.tables import Place
from offbeat.baselines.weights import Errors, task_weights
from offbeat.errors import InputError

Array = NDArray[np.float64]

LEVELS = np.array([0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 0.98])
"""Probabilities of the intervals whose half widths are kept; those between are interpolated."""

FEW = 30.0
"""Independent tasks below which the quantiles of a channel are drawn to those of all channels."""


@dataclass(frozen=True, eq=False)
class HalfWidths:
    """Half widths of intervals, in units of an error.

    Attributes:
        table: (keys, channels, levels) at `LEVELS`.
        count: (keys,) independent tasks that they come from.
    """

    table: Array
    count: Array

    def at(self, place: Place, unit: Any) -> Any:
        """(rows, channels, levels) half widths in original units.

        Args:
            place: (rows, channels) where values are between kinds.
            unit: (rows, channels) unit of their errors, an array or a tensor.
        """
        return place.average(as_kind(self.table, unit)) * unit[..., None]


def fit_half_widths(errors: Errors, predicted: Array, channels: int) -> HalfWidths:
    """Quantiles of absolute errors.

    Args:
        errors: of tasks that the prediction was not fitted to.
        predicted: (values,) the prediction, as `Errors.predictions`.
        channels: their number.
    """
    missed = np.abs(errors.truth - predicted)
    weight, effective = task_weights(errors, channels)
    table = np.full((errors.keys, channels, len(LEVELS)), np.nan)
    pooled = np.full((errors.keys, len(LEVELS)), np.nan)
    order = np.lexsort((missed, errors.channel, errors.key))
    key, channel = errors.key[order], errors.channel[order]
    missed, weight = missed[order], weight[order]
    starts = np.searchsorted(key * channels + channel, np.arange(errors.keys * channels + 1))
    for k in range(errors.keys):
        for c in range(channels):
            own = slice(starts[k * channels + c], starts[k * channels + c + 1])
            if own.stop > own.start:
                table[k, c] = weighted_quantiles(missed[own], weight[own], effective[k, c])
        with np.errstate(divide="ignore", invalid="ignore"):
            logs = np.log(np.maximum(table[k], 1e-12))
            shares = np.where(np.isfinite(logs), effective[k][:, None], 0.0)
            total = shares.sum(axis=0)
            pooled[k] = np.exp(np.where(shares > 0, logs * shares, 0.0).sum(axis=0) / total)
    pooled = _filled(pooled)
    for k in range(errors.keys):
        for c in range(channels):
            own_share = min(effective[k, c] / FEW, 1.0)
            if not np.isfinite(table[k, c]).all():
                table[k, c] = pooled[k]
            elif own_share < 1:
                table[k, c] = table[k, c] ** own_share * pooled[k] ** (1 - own_share)
    table = errors.placed(np.maximum.accumulate(table, axis=2))
    return HalfWidths(table, effective.max(axis=1))


def _filled(pooled: Array) -> Array:
    """Kinds without any value take the quantiles of the kind before, the first ones of the next."""
    for k in range(1, len(pooled)):
        if not np.isfinite(pooled[k]).all():
            pooled[k] = pooled[k - 1]
    for k in range(len(pooled) - 2, -1, -1):
        if not np.isfinite(pooled[k]).all():
            pooled[k] = pooled[k + 1]
    return np.where(np.isfinite(pooled), pooled, 1.0)


def weighted_quantiles(values: Array, weight: Array, count: float) -> Array:
    """Quantiles at `LEVELS` of a sample plus one value to come, for `count` independent ones.

    Args:
        values: sorted.
        weight: of each.
        count: independent values that they are worth; the level is raised by the factor
            (count + 1) / count of split conformal prediction.
    """
    levels = np.minimum(LEVELS * (1 + 1 / max(count, 1.0)), 1.0)
    position = (np.cumsum(weight) - 0.5 * weight) / weight.sum()
    return np.asarray(np.interp(levels, position, values))


def half_width(widths: Array, level: float, levels: Array = LEVELS) -> Array:
    """The half width of an interval of any probability.

    Args:
        widths: (..., levels) at the levels.
        level: from 0 to 0.98.
        levels: increasing.

    Raises:
        InputError: the level is out of that range.
    """
    if not 0 < level <= levels[-1]:
        raise InputError(
            f"the level of an interval must be above 0 and at most {levels[-1]:g}, got {level!r}"
        )
    levels = np.concatenate([[0.0], levels])
    k = int(np.searchsorted(levels, level - 1e-12))
    low = widths[..., k - 2] if k > 1 else 0.0
    part = (level - levels[k - 1]) / (levels[k] - levels[k - 1])
    return np.asarray((1 - part) * low + part * widths[..., k - 1])


def crps(widths: Array, error: Array) -> Array:
    """Continuous ranked probability score of a symmetric distribution given by its intervals.

    The integral of the pinball loss over probabilities (Gneiting and Raftery, 2007), by the
    trapezoid rule over the quantiles at `LEVELS` on both sides and the centre.

    Args:
        widths: (..., levels).
        error: (...) truth minus prediction.

    Returns:
        (...) in the unit of the error.
    """
    tau = np.concatenate([(1 - LEVELS[::-1]) / 2, [0.5], (1 + LEVELS) / 2])
    zero = np.zeros((*widths.shape[:-1], 1))
    quantiles = np.concatenate([-widths[..., ::-1], zero, widths], axis=-1)
    below = error[..., None] < quantiles
    loss = 2 * (error[..., None] - quantiles) * (tau - below)
    # Beyond the outermost quantiles the loss is taken as constant.
    tau, loss = (
        np.concatenate([[0.0], tau, [1.0]]),
        np.concatenate([loss[..., :1], loss, loss[..., -1:]], axis=-1),
    )
    return np.asarray(np.trapezoid(loss, tau, axis=-1))
