"""Folds of tasks that share no source, and predictions from baselines of the other folds."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from offbeat.baselines.base import BASELINES, Array, Baseline
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


def clusters_of(
    tasks: Dataset, task: NDArray[np.int64], row: NDArray[np.int64], count: int = 8
) -> NDArray[np.int64]:
    """(values,) the fold of values of tasks, see `row_folds`.

    Args:
        tasks: as of `folds_of`.
        task: (values,) position of their task.
        row: (values,) row in it.
        count: of folds.
    """
    starts = np.cumsum([0, *(t.rows for t in tasks)])
    return np.asarray(np.concatenate(row_folds(tasks, count))[starts[task] + row])


def _sources(tasks: Dataset) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """(tasks,) source and first row of every task."""
    notes = tasks.meta.get("tasks")
    if notes is None or len(notes) != len(tasks):
        return np.arange(len(tasks)), np.zeros(len(tasks), dtype=np.int64)
    return np.array([note[1] for note in notes]), np.array([note[2] for note in notes])


def cross_fitted(
    baseline: str | type[Baseline], tasks: Dataset, folds: int | NDArray[np.int64] = 3
) -> list[Array]:
    """Predictions of every task by a baseline that was fitted to other data.

    A flexible baseline predicts the data that it was fitted to better than other data; these
    predictions have the errors that it makes on new data. Where there are few sources, their
    windows overlap: each row is predicted by a fit to what the windows have outside of its block of
    time (`row_folds`). Data of a single row is in its own fit.

    Args:
        baseline: a name of the registry, or a class.
        tasks: to fit to, and to predict; from `draw_tasks`, or any data set.
        folds: their number, see `row_folds`, or (tasks,) the fold of each.

    Returns:
        Per task (rows, channels), in original units, as of `Baseline.predict`.
    """
    kind = BASELINES[baseline] if isinstance(baseline, str) else baseline
    if isinstance(folds, int):
        fold = row_folds(tasks, folds)
    else:
        fold = [np.full(t.rows, f) for t, f in zip(tasks, np.asarray(folds), strict=True)]
    predicted = [np.zeros_like(t.values) for t in tasks]
    for one in np.unique(np.concatenate(fold)):
        inside = np.flatnonzero([(f == one).any() for f in fold])
        fitted = kind().fit(_outside(tasks, [f != one for f in fold]))
        for i, rows in zip(inside.tolist(), fitted.predict(tasks.take(inside)), strict=True):
            predicted[i] = np.where((fold[i] == one)[:, None], rows, predicted[i])
    return predicted


def _outside(tasks: Dataset, kept: Sequence[NDArray[np.bool_]]) -> Dataset:
    """The stretches of tasks whose rows are kept, with at least two; all tasks without any."""
    source, first = _sources(tasks)
    parts, notes = [], []
    for i, (t, keep) in enumerate(zip(tasks, kept, strict=True)):
        ends = np.flatnonzero(np.diff(np.concatenate([[False], keep, [False]]).astype(int)))
        for start, stop in ends.reshape(-1, 2).tolist():
            if stop - start > 1:
                parts.append(t if stop - start == t.rows else t.slice(start, stop))
                notes.append(["", int(source[i]), int(first[i]) + start])
    return Dataset(tuple(parts), {**tasks.meta, "tasks": notes}) if parts else tasks
