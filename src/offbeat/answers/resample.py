"""A log on an even grid, its gaps filled by a model or by the best simple fill."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from offbeat import baselines
from offbeat.answers.answer import Answer
from offbeat.answers.blend import Blend, fit_blend
from offbeat.answers.impute import impute
from offbeat.answers.predict import Answering
from offbeat.config import check_seed
from offbeat.data.plan import CHOSEN, plan, prepare
from offbeat.data.rows import add_rows, even_times
from offbeat.data.splits import apply_split
from offbeat.data.trajectory import EXOGENOUS, Dataset, Trajectory
from offbeat.errors import InputError

CAUSAL = ("last_value", "mean", "constant_velocity")
TWO_SIDED = ("linear", "pchip", "smoother")
"""Baselines of a fill without a model: those that are fitted in seconds."""

ALONE = "pchip"
"""Fills a log that is too short to fit anything to."""

_TASKS = 200  # drawn from each part, to weigh the baselines


def resample(
    dataset: Dataset | Trajectory,
    rate_hz: float,
    model: Answering | None = None,
    *,
    seed: int = 0,
) -> Dataset:
    """A data set at even times, in which every value is known.

    The times of each trajectory are its first one and the multiples of a period after it, up to its
    last one. Values are those of `impute`: of a blend from both sides. A value is `observed` where
    its channel was measured within half a period of its time, else it fills a gap.

    Without a model, a blend of line, PCHIP and Kalman smoother is fitted to the data set itself
    (`fit_simple_fill`). A data set that is too short for this is filled by PCHIP, without
    intervals. Before the first observation of a channel its first value is held, and
    exogenous channels, which are not predicted, hold their last one.

    Args:
        dataset: what was observed.
        rate_hz: rows per second.
        model: a blend, the result of `learn`, or a trained model; None for the best simple fill.
        seed: of the generator of self-feeding, and of the tasks that the simple fill is fitted to.

    Returns:
        A trajectory per trajectory, in original units; its channels are in the order of the model.
        `meta["filled_by"]` says what filled it.

    Raises:
        InputError: the rate is not above 0 or gives too many rows, other channels than the model's,
            or a model that cannot predict at any time.

    Example:
        >>> even = offbeat.resample(offbeat.read("arm.bag"), 30)  # doctest: +SKIP
    """
    dataset = Dataset.of(dataset)
    check_seed(seed)
    grids = [even_times(t, rate_hz) for t in dataset]
    by = None
    if model is None:
        try:
            model = fit_simple_fill(dataset, seed=seed)
            by = describe(model)
        except InputError as error:
            by = f"{ALONE} ({error})"
    if model is None:
        mean = _means(dataset)
        filled = [_alone(t, at, mean) for t, at in zip(dataset, grids, strict=True)]
    else:
        made = impute(model, dataset, times=grids, seed=seed)
        by = by or str(made.meta["filled_by"])
        dataset = dataset.select(made.names)
        filled = [
            _rows_at(t, np.searchsorted(t.times, at)) for t, at in zip(made, grids, strict=True)
        ]
    half = 0.5 / rate_hz * (1 + 1e-9)
    even = [
        replace(_held(t, given), observed=_near(given, t.times, half))
        for t, given in zip(filled, dataset, strict=True)
    ]
    notes = {**dataset.meta, "rate_hz": float(rate_hz), "filled_by": by}
    return Dataset(tuple(even), notes)


def fit_simple_fill(dataset: Dataset, *, seed: int = 0) -> Blend:
    """A blend of `CAUSAL` and `TWO_SIDED` baselines, fitted to a data set without a model.

    Parts of the data are masked as in training, and the baselines are weighed by their errors
    there, per channel and length of a gap. So are the intervals.

    Args:
        dataset: as read.
        seed: of the parts and of what is masked.

    Raises:
        InputError: the data set is too short, or nothing in it changes.
    """
    chosen = plan(dataset, known=CHOSEN if "cleaning" in dataset.meta else (), seed=seed)
    train, validation, _ = apply_split(prepare(dataset, chosen), chosen.whole)
    return fit_blend(
        train,
        validation,
        tasks=chosen.tasks,
        causal=CAUSAL,
        two_sided=TWO_SIDED,
        count=_TASKS,
        seed=seed,
    )


def describe(blend: Blend) -> str:
    """The baselines that fill gaps in a blend, with their mean weights, the heaviest first."""
    weights = blend.both.weights.mean(axis=(0, 1))
    named = sorted(zip(weights, [*blend.both.members, "causal"], strict=True), reverse=True)
    shown = ", ".join(f"{name} {100 * weight:.0f} %" for weight, name in named if weight >= 0.005)
    return f"blend of {shown}"


def _means(dataset: Dataset) -> NDArray[np.float64]:
    """(channels,) means of the observed values; 0 where there is none."""
    count = np.sum([t.observed.sum(axis=0) for t in dataset], axis=0)
    total = np.sum([np.where(t.observed, t.values, 0.0).sum(axis=0) for t in dataset], axis=0)
    return np.asarray(total / np.maximum(count, 1))


def _alone(
    trajectory: Trajectory, at: NDArray[np.float64], mean: NDArray[np.float64]
) -> Trajectory:
    """PCHIP at some times; a value that was observed at one of them is kept."""
    merged = add_rows(trajectory, at)
    values = np.where(merged.observed, merged.values, baselines.fill(merged, ALONE, mean.tolist()))
    filled = replace(merged, values=values)
    return _rows_at(filled, np.searchsorted(filled.times, at))


def _rows_at(trajectory: Trajectory, rows: NDArray[np.intp]) -> Trajectory:
    if isinstance(trajectory, Answer):
        return trajectory.rows_at(rows)
    return replace(
        trajectory,
        times=trajectory.times[rows],
        values=trajectory.values[rows],
        observed=trajectory.observed[rows],
    )


def _near(trajectory: Trajectory, times: NDArray[np.float64], half: float) -> NDArray[np.bool_]:
    """(times, channels) whether a channel was observed within `half` s of each time."""
    found = np.zeros((len(times), trajectory.channels), dtype=bool)
    for c in range(trajectory.channels):
        own = trajectory.times[trajectory.observed[:, c]]
        first = np.searchsorted(own, times - half)
        found[:, c] = np.searchsorted(own, times + half, side="right") > first
    return found


def _held(filled: Trajectory, given: Trajectory) -> Trajectory:
    """The trajectory with observed values held where nothing else is known.

    Before the first observation of a channel this is its first value; an exogenous channel, which
    is not predicted, holds its last one.
    """
    values = filled.values.copy()
    for c, role in enumerate(given.roles):
        seen = np.flatnonzero(given.observed[:, c])
        if not len(seen):
            continue
        last = np.searchsorted(given.times[seen], filled.times, side="right") - 1
        held = (last < 0) | np.isnan(values[:, c]) | (role == EXOGENOUS)
        values[held, c] = given.values[seen[np.maximum(last[held], 0)], c]
    return replace(filled, values=values)
