"""The figures of a log: a trajectory with fills, and the calibration of intervals."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

import offbeat as ob
from offbeat.baselines import fit_baseline
from offbeat.calibration import AgeCalibration, Calibration
from offbeat.plots.answers import answers
from offbeat.plots.calibration import calibration_figure
from offbeat.plots.figures import save

from .logs import Log
from .predictors import Blended, Predictor

if TYPE_CHECKING:
    from .results import Summary

WITH_INTERVALS = ("offbeat", "offbeat_blend")
"""Predictors with intervals; the first one whose scores are there is drawn."""


def draw(log: Log, fitted: Mapping[str, Predictor], path: Path) -> None:
    """Draws one test trajectory with dropouts: the truth, PCHIP and the fills of a model.

    Fills from both sides have a band of 90 % where the predictor has intervals.

    Args:
        log: the longest fill of its first test part is drawn.
        fitted: a causal predictor, a two-sided one, or both of one name.
        path: of the figure; its folder is made if it is missing.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    fills = [task for task in next(iter(log.asked.values())) if task.two_sided]
    part = fills[-1].dataset
    one = ob.Dataset((part[min(log.drawn_from, len(part) - 1)],))
    truth = one[0]
    shown: dict[str, Predictor] = {"pchip": fit_baseline("pchip", log.training_windows)}
    for predictor in fitted.values():
        shown.setdefault("causal" if predictor.causal else "two_sided", predictor)
    filled: dict[str, ob.Trajectory] = {}
    for name, predictor in shown.items():
        banded = isinstance(predictor, Blended) and not predictor.causal
        like = predictor.answers(one)[0] if banded else truth
        values = np.where(truth.observed, truth.values, predictor.predict(one)[0])
        filled[name] = replace(like, values=values, observed=truth.observed)
    save(answers(truth, filled, log.drawn, title=truth.origin), path)


def draw_calibration(summary: Summary, test: str, path: Path) -> bool:
    """Draws the coverage and the widths of the intervals of each task of a test part.

    Args:
        summary: of the log.
        test: name of the test part.
        path: of the figure.

    Returns:
        Whether there was a predictor with intervals.
    """
    tasks = {}
    for name in WITH_INTERVALS:
        for task in summary.tasks(test):
            for suffix, label in (("", task), ("_two_sided", f"{task}, both sides")):
                if name + suffix not in summary.predictors:
                    continue
                found = summary.intervals(test, task, name + suffix)
                if found is None or not found.score:
                    continue
                n = int(summary.counts(test, task).sum())
                ages = (AgeCalibration(float(age), 0, np.nan, w) for age, w in found.widths.items())
                tasks[label] = Calibration(
                    n,
                    tuple(map(float, found.coverage)),
                    tuple(found.coverage.values()),
                    tuple(found.score.values()),
                    found.crps,
                    tuple(ages),
                )
        if tasks:
            break
    if tasks:
        path.parent.mkdir(parents=True, exist_ok=True)
        save(calibration_figure(tasks, title=summary.head["title"]), path)
    return bool(tasks)
