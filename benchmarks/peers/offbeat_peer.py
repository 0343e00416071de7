"""Offbeat, as `offbeat.learn` trains it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

import offbeat as ob
from offbeat.config import TaskConfig
from offbeat.learning import train_blend

from .problem import Answer, Answerer, Problem, Series
from .registry import Options


def offbeat(problem: Problem, options: Options) -> Answerer:
    """The blend of baselines and models, with intervals.

    Args:
        problem: to answer.
        options: its budget is that of `ob.learn`.
    """

    def dataset(series: Sequence[Series]) -> ob.Dataset:
        return ob.Dataset(
            tuple(
                ob.Trajectory(
                    s.times,
                    s.values if s.truth is None else s.truth,
                    np.isfinite(s.values),
                    names=problem.channels,
                )
                for s in series
            )
        )

    names = [tuple(problem.channels[i] for i in group) for group in problem.sensors]
    horizon_s = max(problem.horizons_s, default=20 * problem.step_s)
    tasks = TaskConfig(horizon_s, problem.step_s, sensors=tuple(names) or None)
    common: dict[str, Any] = {"seed": options.seed, "progress": False}
    if problem.hidden == "rows":  # the training part has masks of its own
        blend, _, _ = train_blend(
            dataset(problem.fit),
            dataset(problem.held_out),
            tasks,
            as_it_is=True,
            training=ob.TrainConfig(epochs=20, seed=options.seed),
            baselines=("pchip", "linear", "motion_smoother", "ridge_fill", "last_value", "ridge"),
            **common,
        )
    else:
        blend, _, _ = train_blend(
            dataset(problem.train),
            dataset(problem.validation),
            tasks,
            budget_s=options.budget_s,  # `ob.learn` counts what it computes
            **common,
        )

    def answer(task: str, asked: Sequence[Series]) -> list[Answer]:
        data = dataset(asked)
        ahead = task.startswith("forecast")
        answers = blend.causal(data) if ahead else blend.fill(data)
        ends = [a.half_width(0.9) for a in answers]
        return [
            Answer(a.values, a.values - half, a.values + half)
            for a, half in zip(answers, ends, strict=True)
        ]

    return answer
