"""`compare`: compares the models of runs, condition by condition."""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np

from offbeat.comparison.results import Comparison, ConditionResult, PairResult, Summary
from offbeat.comparison.run_files import LAST_VALUE, METRICS, PROVENANCE
from offbeat.comparison.runs import Run, read_runs
from offbeat.comparison.scores import ScoreTable, paired_tables
from offbeat.comparison.statistics.bootstrap import FEWEST_RESAMPLED
from offbeat.comparison.statistics.multiple import holm
from offbeat.comparison.statistics.paired import PairedComparison, paired_comparison
from offbeat.comparison.statistics.ranks import friedman
from offbeat.comparison.statistics.samples import Sample, check_level, equal
from offbeat.comparison.statistics.two_samples import ThesisTest, shapiro_wilk, thesis_test
from offbeat.errors import InputError, one_of

_FEW = 20  # pairs; with fewer, BCa intervals cover the true value less often than stated

Error = Literal["rmse", "mse"]


def compare(
    runs: str | Path | Iterable[str | Path] | Sequence[Run],
    *,
    metric: str = "after_first_observation",
    error: Error = "rmse",
    baseline: str | None = None,
    models: Sequence[str] | None = None,
    alpha: float = 0.05,
    confidence: float = 0.95,
    resamples: int = 9999,
    seed: int = 0,
    shared_repeats: bool = False,
) -> Comparison:
    """Compares models over repeats: which differences are significant, and how large.

    Runs are paired by repeat within a condition; the paired tests decide, with Holm's correction
    over all pairs of all conditions. `docs/statistics.md` lists the assumptions of each test.

    Args:
        runs: from `read_runs`, or paths that it reads: folders of runs, tables.
        metric: `after_first_observation`, `masked`, `after_first_row` or `published`.
        error: compare root mean squared errors (as the thesis does), or mean squared errors.
        baseline: compare every model with this one; by default every model with every other.
            `last_value` is the trivial predictor.
        models: labels of the models to compare, in this order; by default all of them, without
            `last_value`.
        alpha: level of significance.
        confidence: of intervals.
        resamples: of the bootstrap.
        seed: of the bootstrap.
        shared_repeats: leave out repeats that a model lacks, instead of raising an error.

    Raises:
        InputError: too few runs or models, repeats that do not pair, an unknown name, a score that
            is missing, equal values; the message says under which condition.
        FileFormatError: a file is missing or damaged.
    """
    one_of("metric", metric, METRICS)
    one_of("error", error, ("rmse", "mse"))
    check_level("alpha", alpha)
    given: list[Any] = [runs] if isinstance(runs, str | Path) else list(runs)
    known: list[Run] = [run for run in given if isinstance(run, Run)]
    paths = [path for path in given if not isinstance(path, Run)]
    if paths or not known:
        known += read_runs(paths)
    scores = ScoreTable(known, metric, error)
    chosen = list(scores.models if models is None else models)
    if baseline is not None and baseline not in chosen:
        chosen.append(baseline)
    for name in chosen:
        one_of("model", name, [*scores.models, LAST_VALUE])
    if len(set(chosen)) < 2 or len(set(chosen)) < len(chosen):
        raise InputError(
            f"a comparison needs at least two different models, got: {', '.join(chosen)}; "
            f"every run has {LAST_VALUE!r}"
        )
    notes: list[str] = []
    tables = paired_tables(scores, chosen, baseline, shared=shared_repeats, notes=notes)
    notes += _provenance(
        run
        for run in known
        if run.condition in tables
        and run.model in tables[run.condition][1]
        and run.repeat in tables[run.condition][0]
    )
    options = {"confidence": confidence, "resamples": resamples, "seed": seed}
    found = []
    for condition, (repeats, table) in tables.items():
        there = list(table)
        if baseline is None:
            couples = list(itertools.combinations(there, 2))
        else:
            couples = [(name, baseline) for name in there if name != baseline]
        try:
            pairs = [(*two, *_pair(table, two, alpha, options)) for two in couples]
            together = friedman(table, alpha=alpha) if len(there) > 2 else None
        except InputError as failure:
            raise InputError(f"{condition}: {failure}") from None
        found.append(
            (condition, repeats, _summaries(scores, condition, repeats, table), pairs, together)
        )
    every = [pair for *_, pairs, _ in found for pair in pairs]
    t_holm = iter(holm([paired.paired_t.p for _, _, paired, _ in every]))
    w_holm = iter(holm([paired.wilcoxon.p for _, _, paired, _ in every]))
    conditions = []
    for condition, repeats, summaries, pairs, together in found:
        results = [
            _result(first, second, paired, next(t_holm), next(w_holm), rule, alpha)
            for first, second, paired, rule in pairs
        ]
        conditions.append(ConditionResult(condition, repeats, summaries, tuple(results), together))
        _remarks(conditions[-1], scores, len(every), alpha, notes)
    return Comparison(
        metric,
        error,
        baseline,
        alpha,
        confidence,
        resamples,
        seed,
        tuple(conditions),
        tuple(dict.fromkeys(notes)),
    )


def _pair(
    table: dict[str, Sample], names: tuple[str, str], alpha: float, options: dict[str, Any]
) -> tuple[PairedComparison, ThesisTest]:
    first, second = (table[name] for name in names)
    return (
        paired_comparison(first, second, names=names, **options),
        thesis_test(first, second, alpha=alpha, names=names),
    )


def _result(
    first: str,
    second: str,
    paired: PairedComparison,
    t_holm: float,
    w_holm: float,
    rule: ThesisTest,
    alpha: float,
) -> PairResult:
    better = None
    if t_holm <= alpha:
        better = first if paired.difference.value < 0 else second
    return PairResult(first, second, paired, t_holm, w_holm, rule, better)


def _summaries(
    scores: ScoreTable, condition: str, repeats: Sequence[str], table: dict[str, Sample]
) -> tuple[Summary, ...]:
    shown = dict(table)
    trivial = scores.table[condition].get(LAST_VALUE, {})
    if all(repeat in trivial for repeat in repeats):
        shown.setdefault(LAST_VALUE, np.array([trivial[repeat] for repeat in repeats]))
    rows = [
        Summary(
            name,
            tuple(values.tolist()),
            float(values.mean()),
            float(values.std(ddof=1)),
            float(np.median(values)),
            float(values.min()),
            float(values.max()),
            None if equal(values) else shapiro_wilk(values, name=name),
        )
        for name, values in shown.items()
    ]
    return tuple(sorted(rows, key=lambda row: row.mean))


def _provenance(compared: Iterable[Run]) -> list[str]:
    runs, notes = list(compared), []
    for what in PROVENANCE:
        counts = Counter(run.origin[what] for run in runs if what in run.origin)
        if len(counts) > 1:
            values = ", ".join(f"{value} ({number})" for value, number in counts.most_common())
            notes.append(f"The runs differ in {what.replace('_', ' ')}: {values}")
    return notes


def _remarks(
    result: ConditionResult, scores: ScoreTable, family: int, alpha: float, notes: list[str]
) -> None:
    """Adds notes on the limits that the number of runs sets to the tests."""
    n = len(result.repeats)
    floor = min(1.0, family * 2.0 ** (1 - n))
    if floor > alpha:
        notes.append(
            f"With {n} pairs and {family} comparisons Wilcoxon's adjusted p is at least "
            f"{floor:.3g}: it cannot reach significance here"
        )
    if n < FEWEST_RESAMPLED:
        notes.append(
            f"With {n} pairs there are no bootstrap intervals; {FEWEST_RESAMPLED} are needed"
        )
    elif n < _FEW:
        notes.append(
            f"BCa intervals of {n} pairs are somewhat too short (docs/statistics.md); Student's "
            "interval of the mean difference is in the JSON"
        )
    if len(scores.draws[result.condition]) == 1:
        notes.append(
            f"{result.condition}: all runs share one draw of windows and masks; the results "
            "hold for that draw only"
        )
