"""Runs one peer on one log in a process of its own, which never opens the hidden values."""

from __future__ import annotations

import json
import os
import platform
import resource
import time
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from .problem import Answer, Answerer, Problem, load
from .registry import PEERS, Options


def work(name: str, inputs: Path, out: Path, options: Options) -> None:
    """Fits a peer and writes its answers, and what they cost.

    Args:
        name: of the peer.
        inputs: file of the problem.
        out: folder of `answers.npz` and `cost.json`.
        options: of the peer.
    """
    peer = PEERS[name]
    load_before = os.getloadavg()[0]
    clocks = [_clock()]
    fit = peer.load()
    problem = load(inputs)
    clocks.append(_clock())
    answerer = fit(problem, options)
    clocks.append(_clock())
    arrays: dict[str, Any] = {}
    for task in problem.asked:
        if task.split()[0] in peer.tasks:
            arrays |= answers(problem, task, answerer)
    clocks.append(_clock())
    np.savez(out / "answers.npz", **arrays)
    cpu, wall = (np.diff(np.array(clocks), axis=0).round(3).T).tolist()
    cost = {
        "fit_cpu_s": cpu[1],
        "fit_wall_s": wall[1],
        "answer_cpu_s": cpu[2],
        "answer_wall_s": wall[2],
        "peak_mb": round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024),
        "load": [load_before, os.getloadavg()[0]],
        "versions": {"python": platform.python_version()} | {p: version(p) for p in peer.packages},
    }
    (out / "cost.json").write_text(json.dumps(cost), encoding="utf-8")


def answers(problem: Problem, task: str, answerer: Answerer) -> dict[str, Any]:
    """The answers to a task as arrays.

    Args:
        problem: of the task.
        task: name.
        answerer: asked.

    Returns:
        `TASK`, and `TASK|low`, `TASK|high` with intervals: rows of all series, one after the other.
    """
    found: list[Answer] = answerer(task, problem.asked[task])
    arrays = {task: np.concatenate([a.values for a in found])}
    if found[0].low is not None:
        arrays[f"{task}|low"] = np.concatenate([a.low for a in found])
        arrays[f"{task}|high"] = np.concatenate([a.high for a in found])
    return arrays


def _clock() -> tuple[float, float]:
    return time.process_time(), time.perf_counter()
