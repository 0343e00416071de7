"""What a ridge regression is fitted to: states of tasks, and what later rows were."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from offbeat.baselines.base import Array, moments, padded
from offbeat.baselines.folds import row_folds
from offbeat.baselines.history import History
from offbeat.data.tasks import take_tasks
from offbeat.data.trajectory import Dataset

if TYPE_CHECKING:
    from offbeat.baselines.ridge import Ridge

CELLS = 1_000_000
"""Most states of the tasks that a fit uses, times channels."""

FOLDS = 4
"""Groups of source trajectories that penalties are chosen on."""

FURTHEST = 10.0
"""Largest motion of a channel since an observation, in units of its scale."""


@dataclass(frozen=True, eq=False)
class Examples:
    """States of tasks, and what later rows were.

    Attributes:
        features: (states, channels, features) of `Ridge.features`.
        moved: (states, channels, followed).
        fold: (states,) group of trajectories.
        state: (examples,) the state that an example predicts from.
        at: (examples, channels) which weights it uses; -1 where it is no example.
        relative: (examples, channels) age over the middle of its bin.
        change: (examples, channels) since the last observation, in units of the scale.
    """

    features: Array
    moved: Array
    fold: NDArray[np.int64]
    state: NDArray[np.int64]
    at: NDArray[np.int8]
    relative: Array
    change: Array

    def together(self, b: int, most: int) -> list[tuple[list[int], NDArray[np.int64]]]:
        """Channels with the same examples of a bin, and at most so many of these."""
        groups: dict[bytes, list[int]] = {}
        here = self.at == b
        for c in range(here.shape[1]):
            groups.setdefault(np.packbits(here[:, c]).tobytes(), []).append(c)
        found = []
        for group in groups.values():
            rows = np.flatnonzero(here[:, group[0]])
            if len(rows) > most:
                rows = np.sort(np.random.default_rng(b).choice(rows, most, replace=False))
            if len(rows):
                found.append((group, rows))
        return found


def examples_of(baseline: Ridge, tasks: Dataset) -> Examples:
    """Some states before a row; each predicts that row, and two later ones as if cut off.

    The distance of the later ones is log-uniform.
    """
    random = np.random.default_rng(0)
    most = min(baseline.most_states, CELLS / tasks.channels)
    fraction = most / sum(t.rows for t in tasks)
    folds = row_folds(tasks, FOLDS)
    states: list[tuple[NDArray[Any], ...]] = []
    reads: list[tuple[NDArray[Any], ...]] = []
    first = count = 0
    for rows in padded(tasks):
        lengths = np.array(rows.lengths)
        state = baseline.start(np.zeros((len(lengths), tasks.channels)))
        for i in range(int(lengths.max())):
            chosen = np.flatnonzero((random.random(len(lengths)) < fraction) & (i < lengths))
            part = {name: array[chosen] for name, array in state.items()}
            last = History.last(part, baseline.mean)
            features, moved = baseline.features(part), baseline.moved(part)
            fold = np.array([folds[first + k][i] for k in chosen.tolist()], dtype=np.int64)
            states.append((features.astype(np.float32), moved.astype(np.float32), fold))
            longest = lengths[chosen] - 1 - i
            for draw in (np.zeros(len(chosen)), *random.random((2, len(chosen)))):
                to = i + np.minimum(((longest + 2.0) ** draw).astype(int) - 1, longest)
                age = History.age(part, rows.times[chosen, to, None])
                at, relative = baseline.placed(age)
                counted = rows.known[chosen, to] & (relative > 0.2)
                counted &= (age <= baseline.edges[-1]) | np.isinf(age)
                change = (rows.values[chosen, to] - last) / baseline.scale
                reads.append(
                    (
                        count + np.arange(len(chosen)),
                        np.where(counted, at, -1).astype(np.int8),
                        relative.astype(np.float32),
                        np.clip(change, -FURTHEST, FURTHEST).astype(np.float32),
                    )
                )
            count += len(chosen)
            time = rows.times[:, i, None]
            state = baseline.observe(state, time, rows.values[:, i], rows.observed[:, i])
        first += len(lengths)
    return Examples(
        *(np.concatenate(parts) for parts in zip(*states, strict=True)),
        *(np.concatenate(parts) for parts in zip(*reads, strict=True)),
    )


def some_tasks(tasks: Dataset, rows: float) -> Dataset:
    """Tasks in random order, up to a number of rows.

    Args:
        tasks: from `draw_tasks`, or any data set.
        rows: at which the next task is left out.
    """
    order = np.random.default_rng(0).permutation(len(tasks))
    total = np.cumsum([tasks[i].rows for i in order.tolist()])
    return take_tasks(tasks, order[: 1 + int(np.searchsorted(total, rows))])


def likeness(tasks: Dataset) -> Array:
    """How alike the motions of channels are: which channels may predict each other.

    Args:
        tasks: their last values are compared at each row.

    Returns:
        (channels, channels) largest absolute correlation of their changes over four rows, and of
        the change of one and the value of the other, as of a position and its velocity; 2 with
        itself.
    """
    size = tasks.channels
    mean = moments(tasks)[0]
    product = np.zeros((2 * size, 2 * size))
    for t in tasks:
        row = np.maximum.accumulate(np.where(t.observed, np.arange(t.rows)[:, None], 0), axis=0)
        seen = np.logical_or.accumulate(t.observed, axis=0)
        held = np.take_along_axis(np.where(t.observed, t.values - mean, 0.0), row, axis=0)
        moved = np.where(seen[:-4], held[4:] - held[:-4], 0.0)
        both = np.concatenate([moved, held[2 : len(moved) + 2]], axis=1)
        product += both.T @ both
    spread = np.sqrt(np.diag(product))
    spread = np.where(spread > 0, spread, 1.0)
    product = np.abs(product) / spread / spread[:, None]
    cross = product[:size, size:]
    alike = np.maximum(product[:size, :size], np.maximum(cross, cross.T))
    np.fill_diagonal(alike, 2.0)
    return alike
