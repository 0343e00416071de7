"""Tasks: windows in which something is hidden, drawn like the questions a predictor is asked."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from offbeat.data.arrays import hand_over
from offbeat.data.masking import sensors_of
from offbeat.data.trajectory import Dataset, Trajectory
from offbeat.errors import InputError, one_of

KINDS = ("logged", "silence", "cut", "burst", "scattered")
"""Kinds of tasks, see `draw_tasks`."""

CAUSAL = {"logged": 0.25, "silence": 0.25, "cut": 0.5}
"""Shares of the kinds for predictions from the past."""

TWO_SIDED = {"silence": 0.5, "burst": 0.25, "scattered": 0.25}
"""Shares of the kinds for fills from both sides."""


@dataclass(frozen=True)
class TaskConfig:
    """How tasks are drawn.

    Attributes:
        horizon_s: s, longest time after the last observation that is asked for.
        gap_s: s, typical time between rows: the shortest one.
        window_s: s, length of a window; by default four horizons, at least 64 typical gaps.
        sensors: names of the channels of each sensor; by default as `sensors_of` finds.
    """

    horizon_s: float
    gap_s: float
    window_s: float | None = None
    sensors: tuple[tuple[str, ...], ...] | None = None

    def __post_init__(self) -> None:
        for name in ("horizon_s", "gap_s"):
            value = getattr(self, name)
            if not 0 < value < math.inf:
                raise InputError(f"{name} must be a positive number of seconds, got {value!r}")

    @property
    def length_s(self) -> float:
        """s, length of a window."""
        if self.window_s is not None:
            return self.window_s
        return max(4 * self.horizon_s, 64 * self.gap_s)


def draw_tasks(
    dataset: Dataset,
    config: TaskConfig,
    count: int,
    *,
    shares: dict[str, float] | None = None,
    seed: int | Sequence[int] = 0,
) -> Dataset:
    """Draws windows anywhere in a data set and hides observed values in them.

    - `logged` hides nothing: each row is predicted from the rows before it.
    - `silence` hides each sensor for 30 % of the time, in runs of log-uniform length.
    - `cut` hides everything from a row on, for a log-uniform time, and ends there.
    - `burst` hides all sensors together, for 30 % of the time, in runs of log-uniform length.
    - `scattered` hides a uniform fraction of the rows, 10 to 70 %, at random.

    Lengths are between 1.5 typical gaps and the horizon. Hidden values stay known.

    Args:
        dataset: to draw from, trajectories by their number of rows.
        config: lengths.
        count: number of tasks.
        shares: of each kind; by default `CAUSAL`.
        seed: of everything that is drawn.

    Returns:
        One trajectory per task, in an order that does not depend on the kind; `origin` is kept, and
        `meta["tasks"]` gives the kind and the source (trajectory, first row) of each.
    """
    random = np.random.default_rng(seed)
    shares = shares or CAUSAL
    for kind in shares:
        one_of("kind of task", kind, KINDS)
    states = np.array([role == "state" for role in dataset.roles])
    sensors = _positions(dataset, config)
    weights = np.array([t.rows for t in dataset], dtype=np.float64)
    sources = random.choice(len(dataset), size=count, p=weights / weights.sum())
    kinds = random.choice(list(shares), size=count, p=np.array(list(shares.values())))
    tasks, notes = [], []
    for source, kind in zip(sources.tolist(), kinds.tolist(), strict=True):
        whole = dataset[source]
        start, stop = _window(whole, config.length_s, random)
        task = _hidden(whole.slice(start, stop), kind, config, sensors, states, random)
        tasks.append(task)
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


def _hidden(
    task: Trajectory,
    kind: str,
    config: TaskConfig,
    sensors: list[NDArray[np.int64]],
    states: NDArray[np.bool_],
    random: np.random.Generator,
) -> Trajectory:
    observed = task.observed.copy()
    if kind == "cut":
        length = _lengths(config, 1, random)[0]
        latest = int(np.searchsorted(task.times, task.times[-1] - length, side="right"))
        first = int(random.integers(1, max(latest, 2)))
        stop = int(np.searchsorted(task.times, task.times[first - 1] + length, side="right"))
        stop = max(stop, min(first + 1, task.rows))
        observed[first:, states] = False
        return replace(task, observed=hand_over(observed)).slice(0, stop)
    if kind == "scattered":
        fraction = random.uniform(0.1, 0.7)
        together = random.random() < 0.5
        draws = random.random((task.rows, 1 if together else task.channels)) < fraction
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
            observed[np.ix_(_runs(task.times, config, random), group)] = False
    return replace(task, observed=hand_over(observed))


def _runs(
    times: NDArray[np.float64], config: TaskConfig, random: np.random.Generator
) -> NDArray[np.bool_]:
    """(rows,) True in runs that cover about 30 % of the time."""
    hidden = np.zeros(len(times), dtype=bool)
    span, covered = times[-1] - times[0], 0.0
    while covered < 0.3 * span:
        length = _lengths(config, 1, random)[0]
        start = random.uniform(times[0] - length, times[-1])
        hidden |= (times >= start) & (times <= start + length)
        covered += length
    return hidden


def _lengths(config: TaskConfig, count: int, random: np.random.Generator) -> NDArray[np.float64]:
    """s, log-uniform from 1.5 typical gaps to the horizon."""
    low, high = 1.5 * config.gap_s, max(config.horizon_s, 2 * config.gap_s)
    return np.exp(random.uniform(np.log(low), np.log(high), size=count))


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
