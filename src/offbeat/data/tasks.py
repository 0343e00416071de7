"""Tasks: windows in which something is hidden, drawn like the questions a predictor is asked."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from offbeat.config import TaskConfig
from offbeat.data.arrays import hand_over
from offbeat.data.masking import sensors_of
from offbeat.data.trajectory import Dataset, Trajectory
from offbeat.errors import one_of

__all__ = ["CAUSAL", "KINDS", "TWO_SIDED", "TaskConfig", "draw_tasks", "take_tasks"]

KINDS = ("logged", "silence", "cut", "burst", "scattered")
"""Kinds of tasks, see `draw_tasks`."""

CAUSAL = {"logged": 0.25, "silence": 0.25, "cut": 0.5}
"""Shares of the kinds for predictions from the past."""

TWO_SIDED = {"silence": 0.5, "burst": 0.25, "scattered": 0.25}
"""Shares of the kinds for fills from both sides."""


def draw_tasks(
    dataset: Dataset,
    config: TaskConfig,
    count: int,
    *,
    shares: Mapping[str, float] | None = None,
    seed: int | Sequence[int] = 0,
) -> Dataset:
    """Draws windows anywhere in a data set and hides observed values in them.

    - `logged` hides nothing: each row is predicted from the rows before it.
    - `silence` hides each sensor for 30 % of the time, in runs of log-uniform length.
    - `cut` hides everything from a row on, for a log-uniform time, and ends there.
    - `burst` hides all sensors together, for 30 % of the time, in runs of log-uniform length.
    - `scattered` hides a uniform fraction of the rows, 10 to 70 %, at random.

    Lengths are between 1.5 typical gaps and 1.1 horizons. Hidden values stay known.

    Args:
        dataset: to draw from, trajectories by their number of rows.
        config: lengths.
        count: number of tasks.
        shares: of each kind; by default those of `config`, else `CAUSAL`.
        seed: of everything that is drawn.

    Returns:
        One trajectory per task, in an order that does not depend on the kind; `origin` is kept, and
        `meta["tasks"]` gives the kind and the source (trajectory, first row) of each.
    """
    random = np.random.default_rng(seed)
    shares = shares or config.shares or CAUSAL
    for kind in shares:
        one_of("kind of task", kind, KINDS)
    states = np.array([role == "state" for role in dataset.roles])
    sensors = _positions(dataset, config)
    weights = np.array([t.rows for t in dataset], dtype=np.float64)
    sources = random.choice(len(dataset), size=count, p=weights / weights.sum())
    fractions = np.array(list(shares.values()))
    kinds = random.choice(list(shares), size=count, p=fractions / fractions.sum())
    tasks, notes = [], []
    for source, kind in zip(sources.tolist(), kinds.tolist(), strict=True):
        whole = dataset[source]
        start, stop = _window(whole, config.length_s, random)
        times, observed = whole.times[start:stop], whole.observed[start:stop].copy()
        rows = _hide(times, observed, kind, config, sensors, states, random)
        kept = slice(start, start + rows)
        tasks.append(
            replace(
                whole,
                times=whole.times[kept],
                values=whole.values[kept],
                observed=hand_over(observed)[:rows],
            )
        )
        notes.append([kind, source, start])
    return Dataset(tuple(tasks), {**dataset.meta, "tasks": notes})


def _positions(dataset: Dataset, config: TaskConfig) -> list[NDArray[np.int64]]:
    groups = config.sensors or sensors_of(dataset)
    return [np.array([dataset.names.index(n) for n in group]) for group in groups]


def _window(t: Trajectory, length_s: float, random: np.random.Generator) -> tuple[int, int]:
    """First row and end of a window; the whole trajectory where it is not longer."""
    last = np.searchsorted(t.times, t.times[-1] - length_s, side="right")
    start = int(random.integers(0, last + 1)) if last > 0 else 0
    stop = int(np.searchsorted(t.times, t.times[start] + length_s, side="right"))
    return start, max(stop, min(start + 2, t.rows))


def _hide(
    times: NDArray[np.float64],
    observed: NDArray[np.bool_],
    kind: str,
    config: TaskConfig,
    sensors: list[NDArray[np.int64]],
    states: NDArray[np.bool_],
    random: np.random.Generator,
) -> int:
    """Hides values of a window in place; returns the number of its rows that the task has."""
    rows = len(times)
    if kind == "cut":
        length = _length(config, random)
        latest = int(np.searchsorted(times, times[-1] - length, side="right"))
        first = int(random.integers(1, max(latest, 2)))
        stop = int(np.searchsorted(times, times[first - 1] + length, side="right"))
        observed[first:, states] = False
        return max(stop, min(first + 1, rows))
    if kind == "scattered":
        fraction = random.uniform(0.1, 0.7)
        together = random.random() < 0.5
        draws = random.random((rows, 1 if together else len(states))) < fraction
        observed &= ~(draws & states)
    if kind in ("silence", "burst"):
        groups = sensors if kind == "silence" else [np.flatnonzero(states)]
        if kind == "silence" and len(groups) > 8 and random.random() < 0.5:
            # Many sensors: half of the time, some of them fail together.
            order = random.permutation(len(groups))
            groups = [
                np.concatenate([groups[i] for i in part]) for part in np.array_split(order, 4)
            ]
        for group in groups:
            group = group[states[group]]
            observed[np.ix_(_runs(times, config, random), group)] = False
    return rows


def _runs(
    times: NDArray[np.float64], config: TaskConfig, random: np.random.Generator
) -> NDArray[np.bool_]:
    """(rows,) True in runs that cover about 30 % of the time."""
    hidden = np.zeros(len(times), dtype=bool)
    span, covered = times[-1] - times[0], 0.0
    while covered < 0.3 * span:
        length = _length(config, random)
        start = random.uniform(times[0] - length, times[-1])
        hidden |= (times >= start) & (times <= start + length)
        covered += length
    return hidden


def _length(config: TaskConfig, random: np.random.Generator) -> float:
    """s, log-uniform from 1.5 typical gaps to 1.1 horizons, so that the horizon is inside."""
    low, high = 1.5 * config.gap_s, max(1.1 * config.horizon_s, 2 * config.gap_s)
    return float(np.exp(random.uniform(np.log(low), np.log(high))))


def take_tasks(tasks: Dataset, index: Sequence[int] | NDArray[np.int64]) -> Dataset:
    """Some of the tasks that `draw_tasks` drew, with what it noted about them.

    Args:
        tasks: drawn.
        index: positions.
    """
    taken, notes = tasks.take(index), tasks.meta.get("tasks")
    if notes is None:
        return taken
    return replace(taken, meta={**taken.meta, "tasks": [notes[int(i)] for i in index]})
