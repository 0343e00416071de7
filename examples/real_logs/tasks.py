"""Tasks: a masked data set, and which of its masked values are scored."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

import offbeat as ob
from offbeat.data.masking import masked_values

FILL_SEED = 4
"""Of the masks of the fills, as published since 0.1.0."""


@dataclass(frozen=True, eq=False)
class Task:
    """Values to predict.

    A causal predictor predicts each of them from observations strictly before its row. A two-sided
    one uses all other observations; it takes part where there are observations after the value.

    Attributes:
        name: such as `one step`, `fill 0.5 s`, `forecast 1 s`.
        dataset: predictors see its observed values only.
        scored: per trajectory (rows, channels), True where the prediction is scored; known.
        two_sided: whether two-sided predictors take part.
    """

    name: str
    dataset: ob.Dataset
    scored: tuple[NDArray[np.bool_], ...]
    two_sided: bool = False


def one_step(dataset: ob.Dataset) -> Task:
    """Each known value after the first observation of its channel, from the rows before.

    Args:
        dataset: as logged, or masked.
    """
    scored = tuple(t.known & _seen_before(t.observed) for t in dataset)
    return Task("one step", dataset, scored)


def fill(masked: ob.Dataset, name: str) -> Task:
    """All masked values.

    Args:
        masked: from `mask_out`.
        name: of the task.
    """
    return Task(name, masked, tuple(masked_values(t) for t in masked), two_sided=True)


def fill_silences(
    dataset: ob.Dataset,
    silence_s: float,
    sensors: Sequence[Sequence[str]],
    *,
    seed: int = FILL_SEED,
) -> Task:
    """30 % of each sensor, masked in independent dropouts of this length.

    Args:
        dataset: as logged.
        silence_s: s, length of a dropout.
        sensors: names of the channels of each sensor.
        seed: of the masks.
    """
    masked = ob.mask_out(
        dataset, 0.7, mask="dropout", burst_s=silence_s, sensors=sensors, seed=seed
    )
    return fill(masked, f"fill {silence_s:g} s")


def forecasts(dataset: ob.Dataset, horizon_s: float, *, targets: int = 12) -> Task:
    """Rows to predict from the rows up to the horizon before them.

    For a row at time t, a trajectory ends in the last row up to t - horizon_s, followed by the row
    at t, in which nothing is observed. Its known values count whose channel was observed before.

    Args:
        dataset: as logged.
        horizon_s: s.
        targets: rows per trajectory, evenly spaced among those that can be scored.

    Raises:
        ValueError: no trajectory is longer than the horizon.
    """
    cut: list[ob.Trajectory] = []
    for t in dataset:
        # With a tolerance: 0.1 s are three steps at 30 Hz.
        ends = np.searchsorted(t.times, t.times - horizon_s * (1 - 1e-9), side="right")
        seen = np.logical_or.accumulate(t.observed, axis=0)
        counted = t.known & seen[np.maximum(ends - 1, 0)] & (ends > 0)[:, None]
        possible = np.flatnonzero(counted.any(axis=1))
        if not len(possible):
            continue
        spread = np.linspace(0, len(possible) - 1, min(targets, len(possible)))
        for row in possible[np.unique(np.rint(spread).astype(int))]:
            rows = np.append(np.arange(ends[row]), row)
            values, observed = t.values[rows], t.observed[rows]
            values[-1] = np.where(counted[row], values[-1], np.nan)
            observed[-1] = False
            cut.append(replace(t, times=t.times[rows], values=values, observed=observed))
    if not cut:
        raise ValueError(f"no trajectory is longer than the horizon of {horizon_s:g} s")
    scored = [np.zeros((t.rows, t.channels), dtype=bool) for t in cut]
    for mask, t in zip(scored, cut, strict=True):
        mask[-1] = t.known[-1]
    return Task(f"forecast {horizon_s:g} s", ob.Dataset(tuple(cut), dataset.meta), tuple(scored))


def _seen_before(observed: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """(rows, channels) whether the channel was observed in an earlier row."""
    seen = np.zeros_like(observed)
    seen[1:] = np.logical_or.accumulate(observed, axis=0)[:-1]
    return seen
