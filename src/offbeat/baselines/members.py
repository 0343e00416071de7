"""The baselines of a blend, fitted in the time that there is, with their predictions of tasks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from offbeat.baselines.base import BASELINES, Array, Baseline, fit_baseline
from offbeat.baselines.folds import cross_fitted
from offbeat.data.trajectory import Dataset
from offbeat.progress import Clock

ALWAYS = 3.0
"""Cost up to which a baseline is fitted whatever the time, see `Baseline.cost`."""


@dataclass(frozen=True, eq=False)
class Member:
    """A fitted baseline, and what it predicts.

    Attributes:
        baseline: fitted to the training tasks.
        train: per training task (rows, channels), in original units; of a flexible baseline, from
            fits to other tasks.
        validation: the same of the validation tasks.
    """

    baseline: Baseline
    train: list[Array]
    validation: list[Array]


def fit_members(
    names: Sequence[str], train: Dataset, validation: Dataset, *, budget_s: float | None = None
) -> dict[str, Member]:
    """Fits baselines to training tasks, the cheapest first where time is limited.

    How long one will take is estimated from the time that those before it took and from their
    `Baseline.cost`.

    Args:
        names: of baselines.
        train: training tasks.
        validation: other tasks.
        budget_s: s; a baseline that would end later is left out, unless its cost is at most
            `ALWAYS` or there is no cheaper one. None fits all.

    Returns:
        Those that were fitted, in the order of the names.
    """
    found: dict[str, Member] = {}
    started, done = Clock(), 0.0
    for name in sorted(names, key=lambda name: BASELINES[name].cost):
        cost = BASELINES[name].cost
        if budget_s is not None and cost > ALWAYS and found:
            spent = Clock() - started
            if spent * (1 + cost / done) > budget_s:
                continue
        baseline = fit_baseline(name, train)
        predicted = cross_fitted(name, train) if baseline.flexible else baseline.predict(train)
        found[name] = Member(baseline, predicted, baseline.predict(validation))
        done += cost
    return {name: found[name] for name in names if name in found}
