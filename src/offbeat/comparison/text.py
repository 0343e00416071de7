"""Renders a comparison as text, Markdown, LaTeX and JSON."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any

from offbeat import tables
from offbeat.comparison.results import Comparison, ConditionResult, PairResult
from offbeat.comparison.run_files import LAST_VALUE
from offbeat.comparison.statistics.ranks import FriedmanResult
from offbeat.comparison.statistics.samples import Estimate

CAVEAT = (
    "The thesis' rule assumes independent runs. Those of one repeat share windows and "
    "masks, so the paired tests decide."
)

_TESTS = {"two_sample_t": "two-sample t", "welch_t": "Welch"}


@dataclass(frozen=True)
class Grid:
    """A table of strings.

    Attributes:
        title: a sentence.
        head: headings of the columns.
        rows: each with one string per column.
    """

    title: str
    head: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


def text(comparison: Comparison) -> str:
    """Tables in plain text."""
    parts = [_heading(comparison)]
    for condition in comparison.conditions:
        parts.append(f"{condition.condition}\n{'-' * len(condition.condition)}")
        parts += [_plain_grid(grid) for grid in grids(comparison, condition)]
        parts += [_ranks(condition.friedman)] if condition.friedman else []
    return "\n\n".join([*parts, "\n".join(_notes(comparison))])


def markdown(comparison: Comparison) -> str:
    """Tables in Markdown."""
    parts = [_heading(comparison)]
    for condition in comparison.conditions:
        parts.append(f"## {tables.escape_markdown(condition.condition)}")
        parts += [
            f"{grid.title}\n\n{tables.markdown(grid.head, grid.rows, right=True)}"
            for grid in grids(comparison, condition)
        ]
        parts += [_ranks(condition.friedman)] if condition.friedman else []
    return "\n\n".join([*parts, "\n".join(f"- {note}" for note in _notes(comparison))]) + "\n"


def latex(comparison: Comparison) -> str:
    """`table` environments for the package booktabs."""
    parts = [f"% {_heading(comparison)}"]
    for condition in comparison.conditions:
        for grid in grids(comparison, condition):
            rows = [[tables.escape_latex(text) for text in row] for row in grid.rows]
            caption = f"{condition.condition}. {grid.title}"
            parts.append(tables.latex(grid.head, [("", rows)], caption=caption))
        parts += [tables.escape_latex(_ranks(condition.friedman))] if condition.friedman else []
    return "\n\n".join([*parts, *map(tables.escape_latex, _notes(comparison))]) + "\n"


def to_dict(comparison: Comparison) -> dict[str, Any]:
    """JSON-like form of every number; null where there is none."""
    result: dict[str, Any] = _jsonable(asdict(comparison))
    result["family"] = comparison.family
    for entries, condition in zip(result["conditions"], comparison.conditions, strict=True):
        for entry, pair in zip(entries["pairs"], condition.pairs, strict=True):
            entry["thesis"] |= {
                "test": pair.thesis.test,
                "normal": pair.thesis.normal,
                "equal_variances": pair.thesis.equal_variances,
                "significant": pair.thesis.significant,
            }
    return result


def grids(comparison: Comparison, condition: ConditionResult) -> tuple[Grid, Grid, Grid]:
    """The three tables of one condition: models, paired tests, the thesis' rule."""
    unit = comparison.error.upper()
    percent = f"{100 * comparison.confidence:g} %"
    ranks = condition.friedman.ranks if condition.friedman else {}
    models = Grid(
        f"{unit} over {len(condition.repeats)} repeats",
        ("model", "mean", "std", "median", "min", "max", "Shapiro-Wilk p", "mean rank"),
        tuple(
            (
                row.model,
                *(_number(v) for v in (row.mean, row.std, row.median, row.minimum, row.maximum)),
                _p(row.shapiro.p) if row.shapiro else "-",
                f"{ranks[row.model]:.2f}" if row.model in ranks else "-",
            )
            for row in condition.summaries
        ),
    )
    paired = Grid(
        f"Paired tests; differences are first minus second, below 0 the first is better; {percent} "
        "BCa intervals",
        (
            "pair",
            "mean difference",
            "Hedges' g",
            "Shapiro p",
            "paired t p",
            "Holm",
            "Wilcoxon p",
            "Holm",
            "finding",
        ),
        tuple(
            (
                f"{pair.first} - {pair.second}",
                _estimate(pair.paired.difference),
                _estimate(pair.paired.hedges_g, digits=3),
                _p(pair.paired.shapiro_differences.p),
                _p(pair.paired.paired_t.p),
                _p(pair.paired_t_holm),
                _p(pair.paired.wilcoxon.p),
                _p(pair.wilcoxon_holm),
                _finding(pair),
            )
            for pair in condition.pairs
        ),
    )
    rule = Grid(
        "The thesis' rule",
        ("pair", "Bartlett p", "Levene p", "test", "t", "p", "significant"),
        tuple(
            (
                f"{pair.first} - {pair.second}",
                _p(pair.thesis.bartlett.p),
                _p(pair.thesis.levene.p),
                _TESTS[pair.thesis.test],
                f"{pair.thesis.t:.3f}",
                _p(pair.thesis.p),
                ("yes" if pair.thesis.significant else "no")
                + ("" if pair.thesis.normal else ", but not normal"),
            )
            for pair in condition.pairs
        ),
    )
    return models, paired, rule


def _heading(comparison: Comparison) -> str:
    against = f", against {comparison.baseline}" if comparison.baseline else ""
    return (
        f"{comparison.metric} {comparison.error.upper()} on the test part, in scaled units"
        f"{against}; alpha {comparison.alpha:g}, Holm's correction over {comparison.family} "
        f"{'pair' if comparison.family == 1 else 'pairs'}"
    )


def _notes(comparison: Comparison) -> list[str]:
    forms = (
        "Hedges' g is in units of the models' spread over repeats (the root of the mean variance)."
    )
    trivial = any(row.model == LAST_VALUE for c in comparison.conditions for row in c.summaries)
    said = [f"{LAST_VALUE} repeats the last observed value."] if trivial else []
    return [*comparison.notes, CAVEAT, forms, *said]


def _ranks(found: FriedmanResult) -> str:
    groups = "; ".join(", ".join(group) for group in found.groups) or "none"
    return (
        f"Friedman: chi-squared {found.statistic:.3f} ({found.friedman.df[0]:g} df), p "
        f"{_p(found.p)}, over {found.blocks} repeats. Nemenyi: critical difference of mean ranks "
        f"{found.critical_difference:.2f}; not significantly different: {groups}."
    )


def _finding(pair: PairResult) -> str:
    if pair.better is None:
        return "no significant difference"
    return f"{pair.better} is better"


def _plain_grid(grid: Grid) -> str:
    return f"{grid.title}:\n{tables.plain([grid.head, *grid.rows])}"


def _number(value: float, digits: int = 4) -> str:
    return f"{value:.{digits}g}"


def _estimate(estimate: Estimate, digits: int = 4) -> str:
    value = _number(estimate.value, digits)
    if estimate.low is None or estimate.high is None:
        return value
    return f"{value} [{_number(estimate.low, digits)}, {_number(estimate.high, digits)}]"


def _p(p: float) -> str:
    return "<0.0001" if p < 1e-4 else f"{p:.4f}"


def _jsonable(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _jsonable(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [_jsonable(one) for one in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value
