"""Folds of tasks that share no source, and predictions from baselines of the other folds."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from offbeat.baselines.base import BASELINES, Array, Baseline
from offbeat.data.tasks import take_tasks
from offbeat.data.trajectory import Dataset


def folds_of(tasks: Dataset, count: int) -> NDArray[np.int64]:
    """The fold of every task: windows of one source trajectory are in the same fold.

    Where a source has so many of the tasks that the folds would be uneven, it is divided in time,
    by the first rows of its windows.

    Args:
        tasks: of `draw_tasks`, whose `meta["tasks"]` names the sources; of other data sets each
            trajectory is a source.
        count: of folds.

    Returns:
        (tasks,) from 0 to less than `count`.
    """
    source, first = _sources(tasks)
    names, at, many = np.unique(source, return_inverse=True, return_counts=True)
    if len(names) < 2 * count:
        order = np.lexsort((first, source))
        fold = np.empty(len(tasks), dtype=np.int64)
        fold[order] = np.arange(len(tasks)) * count // len(tasks)
        return fold
    fold = np.empty(len(names), dtype=np.int64)
    sizes = np.zeros(count)
    for name in np.argsort(-many, kind="stable"):
        fold[name] = sizes.argmin()
        sizes[fold[name]] += many[name]
    return fold[at]


def row_folds(tasks: Dataset, count: int) -> list[NDArray[np.int64]]:
    """The fold of every row of every task: rows of one time are in the same fold in all windows.

    As `folds_of` where there are many sources; else the sources are divided in blocks of time.

    Args:
        tasks: as of `folds_of`.
        count: of folds.

    Returns:
        Per task (rows,) from 0 to less than `count`.
    """
    source, first = _sources(tasks)
    names, at = np.unique(source, return_inverse=True)
    if len(names) >= 2 * count:
        of_task = folds_of(tasks, count)
        return [np.full(t.rows, f) for t, f in zip(tasks, of_task.tolist(), strict=True)]
    lengths = np.zeros(len(names), dtype=np.int64)
    np.maximum.at(lengths, at, first + np.array([t.rows for t in tasks]))
    before = np.cumsum(lengths) - lengths
    return [
        (start + np.arange(t.rows)) * count // int(lengths.sum())
        for t, start in zip(tasks, (before[at] + first).tolist(), strict=True)
    ]


def _sources(tasks: Dataset) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """(tasks,) source and first row of every task."""
    notes = tasks.meta.get("tasks")
    if notes is None or len(notes) != len(tasks):
        return np.arange(len(tasks)), np.zeros(len(tasks), dtype=np.int64)
    return np.array([note[1] for note in notes]), np.array([note[2] for note in notes])


def cross_fitted(
    baseline: str | type[Baseline], tasks: Dataset, folds: int | NDArray[np.int64] = 3
) -> list[Array]:
    """Predictions of every task by a baseline that was fitted to the tasks of the other folds.

    A flexible baseline predicts the tasks that it was fitted to better than others; these
    predictions have the errors that it makes on new tasks. A single task is in its own fit.

    Args:
        baseline: a name of the registry, or a class.
        tasks: to fit to, and to predict; from `draw_tasks`, or any data set.
        folds: their number, see `folds_of`, or (tasks,) the fold of each.

    Returns:
        Per task (rows, channels), in original units, as of `Baseline.predict`.
    """
    kind = BASELINES[baseline] if isinstance(baseline, str) else baseline
    fold = folds_of(tasks, folds) if isinstance(folds, int) else np.asarray(folds)
    predicted: dict[int, Array] = {}
    for one in np.unique(fold):
        inside = np.flatnonzero(fold == one)
        others = np.flatnonzero(fold != one)
        fitted = kind().fit(take_tasks(tasks, others if len(others) else inside))
        predicted |= dict(zip(inside.tolist(), fitted.predict(tasks.take(inside)), strict=True))
    return [predicted[i] for i in range(len(tasks))]
