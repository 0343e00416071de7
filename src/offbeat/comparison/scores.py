"""Tables of scores by condition, model and repeat, for paired tests."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from offbeat.comparison.run_files import LAST_VALUE
from offbeat.comparison.runs import Run
from offbeat.comparison.statistics.samples import FEWEST, Sample
from offbeat.errors import InputError


class ScoreTable:
    """The scores of runs by condition, model and repeat."""

    def __init__(self, runs: Sequence[Run], metric: str, error: str) -> None:
        self.models = list(dict.fromkeys(run.model for run in runs))
        self.conditions = list(dict.fromkeys(run.condition for run in runs))
        self.draws: dict[str, set[str]] = {c: set() for c in self.conditions}
        self.table: dict[str, dict[str, dict[str, float]]] = {c: {} for c in self.conditions}
        for run in runs:
            of_condition = self.table[run.condition]
            of_model = of_condition.setdefault(run.model, {})
            if run.repeat in of_model:
                raise InputError(
                    f"{run.condition}: {run.model!r} has two runs of {run.repeat}, one of them "
                    f"{run.name}; leave one out"
                )
            self.draws[run.condition].add(run.draw)
            of_model[run.repeat] = self._score(run, run.mse, metric, error)
            if metric in run.last_value_mse:
                value = self._score(run, run.last_value_mse, metric, error)
                trivial = of_condition.setdefault(LAST_VALUE, {})
                before = trivial.setdefault(run.repeat, value)
                if not np.isclose(before, value, rtol=1e-6, atol=0):
                    raise InputError(
                        f"{run.condition}: the runs of {run.repeat} do not share their test part: "
                        f"the last-value predictor scores {value:g} with {run.name} and "
                        f"{before:g} with another run; train them on the same windows and masks"
                    )

    @staticmethod
    def _score(run: Run, values: Mapping[str, float], metric: str, error: str) -> float:
        value = values.get(metric, float("nan"))
        if not (np.isfinite(value) and value >= 0):
            raise InputError(
                f"{run.name} has no {metric} score (got {value}); choose another metric, or leave "
                "the run out"
            )
        return float(value**0.5 if error == "rmse" else value)


def paired_tables(
    scores: ScoreTable,
    chosen: Sequence[str],
    baseline: str | None,
    *,
    shared: bool,
    notes: list[str],
) -> dict[str, tuple[tuple[str, ...], dict[str, Sample]]]:
    """Collects the scores that can be compared.

    Args:
        scores: of all runs.
        chosen: models to compare.
        baseline: model that must be there, or None.
        shared: leave out repeats that a model lacks.
        notes: receives remarks on what was left out.

    Returns:
        Per condition its repeats and, per model, the scores in their order.

    Raises:
        InputError: runs do not pair, or nothing is left.
    """
    found: dict[str, tuple[tuple[str, ...], dict[str, Sample]]] = {}
    reasons = []
    for condition in scores.conditions:
        there = {m: scores.table[condition][m] for m in chosen if m in scores.table[condition]}
        every = list(dict.fromkeys(repeat for runs in there.values() for repeat in runs))
        lacking = {m: [r for r in every if r not in runs] for m, runs in there.items()}
        kept = [r for r in every if all(r in runs for runs in there.values())]
        if len(there) < 2:
            reasons.append(f"{condition}: only {', '.join(there) or 'models that were not chosen'}")
            continue
        if baseline is not None and baseline not in there:
            reasons.append(f"{condition}: the baseline {baseline!r} has no run")
            continue
        if len(kept) < FEWEST:
            runs = ", ".join(f"{m} {len(r)}" for m, r in there.items())
            reasons.append(
                f"{condition}: the models share {len(kept)} repeats, at least {FEWEST} are needed "
                f"(runs per model: {runs})"
            )
            continue
        if any(lacking.values()) and not shared:
            model = next(m for m, missing in lacking.items() if missing)
            raise InputError(
                f"{condition}: runs do not pair, {model!r} lacks {', '.join(lacking[model])}; "
                "train those, or compare the repeats that all models share (shared_repeats)"
            )
        if any(lacking.values()):
            notes.append(
                f"{condition}: {len(every) - len(kept)} repeats left out that a model lacks"
            )
        kept.sort(key=_numbers_last)
        found[condition] = (
            tuple(kept),
            {m: np.array([r[k] for k in kept]) for m, r in there.items()},
        )
    if not found:
        raise InputError(f"nothing to compare: {'; '.join(reasons)}")
    notes += [f"Left out: {reason}" for reason in reasons]
    return found


def _numbers_last(repeat: str) -> tuple[Any, ...]:
    """Sorts `repeat 2` before `repeat 10`."""
    return tuple((int(w) if w.isdigit() else -1, w) for w in repeat.replace("/", " ").split())
