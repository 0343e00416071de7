"""The figure of a log."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

import offbeat as ob
from offbeat.baselines import fit_baseline
from offbeat.plots.answers import answers
from offbeat.plots.figures import save

from .logs import Log
from .predictors import Predictor


def draw(log: Log, fitted: Mapping[str, Predictor], path: Path) -> None:
    """Draws one test trajectory with dropouts: the truth, PCHIP and the fills of a model.

    Args:
        log: the longest fill of its first test part is drawn.
        fitted: a causal predictor, a two-sided one, or one of each.
        path: of the figure; its folder is made if it is missing.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    fills = [task for task in next(iter(log.asked.values())) if task.two_sided]
    part = fills[-1].dataset
    one = ob.Dataset((part[min(log.drawn_from, len(part) - 1)],))
    truth = one[0]
    shown: dict[str, Predictor] = {"pchip": fit_baseline("pchip", log.training_windows)}
    shown |= {"causal" if p.causal else "two_sided": p for p in fitted.values()}
    filled = {
        name: replace(
            truth, values=np.where(truth.observed, truth.values, predictor.predict(one)[0])
        )
        for name, predictor in shown.items()
    }
    save(answers(truth, filled, log.drawn, title=truth.origin), path)
