"""Makes the tasks of the logs of `examples.real_logs`, and keeps the hidden values apart."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np

import offbeat as ob
from examples.real_logs import tasks
from examples.real_logs.logs import HORIZONS_S, LOGS, Log
from examples.real_logs.tasks import FILL_SEED, Task

from .problem import Array, Problem, Series, save

FILL_S = 0.5
"""s, length of the dropouts of the fills."""

MASKS = 2
"""Masks of each training and validation window."""


def make(name: str, folder: Path, *, seed: int = 0, quick: bool = False) -> tuple[Path, Path]:
    """Writes what peers are given, and the hidden values, as two NPZ files.

    Args:
        name: of a log of `examples.real_logs`.
        folder: to write to.
        seed: of the masks; 0 has those of `docs/real_logs.md`.
        quick: a small part of the log, for tests.

    Returns:
        The files `inputs.npz` and `truth.npz`.

    Raises:
        MissingLogError: the log is not on this machine.
    """
    log = LOGS[name](quick)
    found = asked(log, seed)
    inputs, truth = paths(folder, name, seed)
    save(problem(log, found, seed), inputs)
    np.savez(truth, **{task.name: np.concatenate(list(_truth(task))) for task in found})
    return inputs, truth


def paths(folder: Path, name: str, seed: int) -> tuple[Path, Path]:
    """The files of a log and a seed.

    Args:
        folder: of the tasks.
        name: of the log.
        seed: of the masks.
    """
    at = folder / name / f"seed{seed}"
    return at / "inputs.npz", at / "truth.npz"


def asked(log: Log, seed: int) -> list[Task]:
    """The tasks on the test part of a log: its fill, and its forecasts.

    Args:
        log: to ask.
        seed: of the masks.
    """
    test = log.tests["test"]
    if log.masked:
        return [tasks.fill(test, log.masked)]
    return [
        tasks.fill_silences(test, FILL_S, log.sensors, seed=FILL_SEED + 100 * seed),
        *(tasks.forecasts(test, h, targets=log.targets) for h in HORIZONS_S),
    ]


def problem(log: Log, found: Iterable[Task], seed: int) -> Problem:
    """What peers are given: hidden values are NaN.

    Args:
        log: its parts.
        found: from `asked`.
        seed: of the masks of the windows to fit and validate with.
    """
    names = list(log.train.names)
    rows = max(t.rows for t in log.tests["test"])
    return Problem(
        log=log.name,
        channels=tuple(names),
        sensors=tuple(tuple(names.index(n) for n in group) for group in log.sensors),
        pairs=tuple(_pairs(names)),
        scale=log.scale,
        mean=log.mean,
        hidden="rows" if log.masked else "dropouts",
        horizons_s=() if log.masked else HORIZONS_S,
        train=tuple(Series(t.times, t.values) for t in log.train),
        validation=tuple(Series(t.times, t.values) for t in log.validation),
        fit=tuple(_masked(log, log.train, rows, seed=10 + 100 * seed)),
        held_out=tuple(_masked(log, log.validation, rows, seed=50 + 100 * seed)),
        asked={task.name: tuple(Series(t.times, _seen(t)) for t in task.dataset) for task in found},
    )


def _masked(log: Log, part: ob.Dataset, rows: int, seed: int) -> Iterable[Series]:
    """Windows as long as those of the tests; where all parts are masked, as they are."""
    if log.masked:
        views = [part]
    else:
        # Windows overlap by half; of a shorter trajectory there is one.
        cut = [
            t.slice(start, start + rows)
            for t in part
            for start in range(0, max(t.rows - rows, 0) + 1, max(rows // 2, 1))
        ]
        windows = ob.Dataset(tuple(cut))
        views = [
            tasks.fill_silences(windows, FILL_S, log.sensors, seed=seed + i).dataset
            for i in range(MASKS)
        ]
    return (Series(t.times, _seen(t), t.values) for view in views for t in view)


def _seen(t: ob.Trajectory) -> Array:
    return np.where(t.observed, t.values, np.nan)


def _truth(task: Task) -> Iterable[Array]:
    """(rows, channels) per trajectory, the values that are scored; NaN elsewhere."""
    for t, scored in zip(task.dataset, task.scored, strict=True):
        yield np.where(scored, t.values, np.nan)


def _pairs(names: list[str]) -> Iterable[tuple[int, int]]:
    """A position and its velocity, where the names say so: x and vx, or a_qpos and a_qvel."""
    for i, name in enumerate(names):
        other = name.replace("qpos", "qvel") if name.endswith("qpos") else f"v{name}"
        if other in names:
            yield i, names.index(other)
