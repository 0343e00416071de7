"""Tables of results as Markdown, between the markers of a document."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from .predictors import ORACLE, ORACLE_TWO_SIDED
from .results import Intervals, Summary
from .scores import BAND, Against

FRONT_PAGE = {
    "forecast 0.5 s": (
        ("last_value",),
        ("constant_velocity",),
        ("kalman_short", "kalman_long", "motion_filter"),
        ("ridge",),
        ("offbeat",),
    ),
    "fill 0.5 s": (
        ("last_value",),
        ("pchip",),
        ("smoother", "motion_smoother"),
        ("ridge_fill",),
        ("offbeat_two_sided",),
    ),
}
"""Tasks of the front page, and what is used for them; the best of several is shown."""


def front_page(summaries: Sequence[Summary]) -> str:
    """A row per task and test part: what people use, and Offbeat, RMSE in scaled units.

    Args:
        summaries: of the logs that have results of Offbeat.
    """
    head = ["", "last value", "constant velocity, or PCHIP", "Kalman", "ridge"]
    head += ["best baseline, in hindsight", "Offbeat"]
    rows = []
    for task, columns in FRONT_PAGE.items():
        for summary in summaries:
            for test in summary.tests:
                title = summary.head["title"].split(":")[0]
                title += f", {test}" if len(summary.tests) > 1 else ""
                errors = [
                    min(
                        (
                            _mean(summary.scaled(test, task, name))
                            for name in names
                            if name in summary.predictors and summary.scaled(test, task, name)
                        ),
                        default=np.nan,
                    )
                    for names in columns
                ]
                name, lowest = _best(summary, test, task, columns[-1][0])
                errors.insert(-1, lowest)
                best = np.nanmin(errors)
                shown = ["" if np.isnan(e) else f"{e:.3g}" for e in errors]
                bold = [f"**{t}**" if e == best else t for t, e in zip(shown, errors, strict=True)]
                bold[-2] += f", {_words(name)}"
                rows.append([f"{task}: {title}", *bold])
    return _table(head, rows)


def _best(summary: Summary, test: str, task: str, like: str) -> tuple[str, float]:
    """The baseline of the lowest error among those with the input of a predictor; its error."""
    errors = {
        name: _mean(each)
        for name in _baselines(summary, like)
        if (each := summary.scaled(test, task, name))
    }
    name = min(errors, key=lambda name: errors[name])
    return name, errors[name]


def _baselines(summary: Summary, like: str) -> list[str]:
    """Baselines with the input of a predictor: the past, or both sides as well."""
    causal = summary.causal(like)
    every = [name for name in summary.predictors if not name.startswith(PRODUCT)]
    return [name for name in every if summary.causal(name) or not causal]


def tables(summary: Summary, *, every: bool = False) -> str:
    """The tables of a log: errors, comparisons and intervals of each test part.

    Args:
        summary: of the log.
        every: also the errors in units, per group of channels.
    """
    parts = []
    for test in summary.tests:
        title = f"{test.capitalize()}: " if len(summary.tests) > 1 else ""
        parts += [f"{title}RMSE, scaled", errors(summary, test), losses(summary, test)]
        if every:
            parts += [f"{title}RMSE in units", groups(summary, test)]
        parts += [
            f"{title}wins / ties / losses",
            comparisons(summary, test, list(summary.predictors) if every else shown(summary, test)),
        ]
        if calibrated := intervals(summary, test):
            more = "; interval score of 95 %" if _has_score(summary, test) else ""
            parts += [
                f"{title}coverage of 50 / 80 / 95 % intervals; CRPS{more}, scaled",
                calibrated,
                misses(summary, test),
            ]
    return "\n\n".join(part for part in parts if part)


def errors(summary: Summary, test: str) -> str:
    """A row per predictor and a column per task: RMSE, scaled; the best in bold, and its groups."""
    asked = summary.tasks(test)
    rows = [["values", *(str(int(summary.counts(test, task).sum())) for task in asked)]]
    best = {
        (task, causal): min(
            (
                _mean(summary.scaled(test, task, name))
                for name in summary.predictors
                if summary.causal(name) == causal and summary.scaled(test, task, name)
            ),
            default=np.nan,
        )
        for task in asked
        for causal in (True, False)
    }
    for name in summary.predictors:
        row = [_label(summary, name)]
        for task in asked:
            each = summary.scaled(test, task, name)
            cell = _spread(each)
            if each and _mean(each) == best[task, summary.causal(name)]:
                cell = f"**{cell}**"
            row.append(cell)
        rows.append(row)
    return _table(["", *asked], rows)


def losses(summary: Summary, test: str) -> str:
    """A line per predictor of Offbeat: tasks in which it loses to the best baseline by over 2 %.

    Args:
        summary: of the log.
        test: name of the test part.

    Returns:
        Ratios of the errors over all channels, means over seeds; empty without Offbeat.
    """
    lines = []
    for name in (name for name in summary.predictors if name.startswith(PRODUCT)):
        lost = []
        for task in summary.tasks(test):
            each = summary.scaled(test, task, name)
            if not each:
                continue
            baseline, lowest = _best(summary, test, task, name)
            if _mean(each) > (1 + BAND) * lowest:
                lost.append(f"{task} {_mean(each) / lowest:.3g} ({_words(baseline)})")
        lines.append(f"- {_label(summary, name)}: {', '.join(lost) or 'none'}")
    head = f"Losses by more than {100 * BAND:.0f} % over all channels, as multiples of the error of"
    return "\n".join([f"{head} the best baseline:", "", *lines]) if lines else ""


def misses(summary: Summary, test: str) -> str:
    """A line per predictor with intervals: how often they are off by more than 3 points.

    Args:
        summary: of the log.
        test: name of the test part.
    """
    lines = []
    for name in summary.predictors:
        off = {
            f"{task}, {100 * float(level):.0f} %": 100 * (covered - float(level))
            for task in summary.tasks(test)
            if (found := summary.intervals(test, task, name))
            for level, covered in found.coverage.items()
            if level in SHOWN_LEVELS
        }
        if not off:
            continue
        narrow = {each: -points for each, points in off.items() if points < -OFF}
        wide = {each: points for each, points in off.items() if points > OFF}
        said = []
        for word, missed in (("narrow", narrow), ("wide", wide)):
            if missed:
                worst = max(missed, key=lambda each: missed[each])
                said.append(f"too {word} in {len(missed)}, most by {missed[worst]:.0f} ({worst})")
        lines.append(f"- {_label(summary, name)}, of {len(off)}: {'; '.join(said) or 'none'}")
    head = f"Intervals whose coverage is off by more than {OFF:.0f} points:"
    return "\n".join([head, "", *lines])


def groups(summary: Summary, test: str) -> str:
    """As `errors`, in the units of groups of channels: a row per group and predictor."""
    asked = summary.tasks(test)
    rows = []
    for group in summary.head["groups"]:
        for name in summary.predictors:
            row = [group, _label(summary, name)]
            for task in asked:
                there = bool(summary.scaled(test, task, name))
                value = summary.grouped(test, task, name)[group] if there else np.nan
                row.append(_number(value))
            rows.append(row)
    return _table(["", "", *asked], rows)


KINDS = ("one step", "fill", "forecast")
"""First words of the names of tasks."""

PRODUCT = "offbeat"
"""Names of the predictors that are not baselines start with it."""


OFF = 3.0
"""Points of coverage by which an interval may be off."""

SHOWN_LEVELS = ("0.5", "0.8", "0.95")
"""Levels of intervals in the tables, as in the files."""


def shown(summary: Summary, test: str) -> list[str]:
    """Offbeat's predictors, and the best baseline with each of both kinds of input."""
    names = []
    for causal in (True, False):
        same = [n for n in summary.predictors if summary.causal(n) == causal]
        means = {
            name: total.geometric_mean
            for name in same
            if not name.startswith(PRODUCT)
            for total in [against(summary, test, name, simple=True)[1]]
            if total
        }
        names += [min(means, key=lambda name: means[name])] if means else []
        names += [name for name in same if name.startswith(PRODUCT)]
    return names


def against(
    summary: Summary, test: str, name: str, *, simple: bool
) -> tuple[list[Against | None], Against | None]:
    """A predictor against the best of others per channel and task, in hindsight on the test.

    Args:
        summary: of the log.
        test: name of the test part.
        name: of the predictor.
        simple: against `ORACLE` or `ORACLE_TWO_SIDED`, else against all baselines.

    Returns:
        By kind of task in the order of `KINDS`, and over all; None where nothing can be compared.
    """
    causal = summary.causal(name)
    oracle = ORACLE if causal else ORACLE_TWO_SIDED
    others = oracle if simple else _baselines(summary, name)
    ratios = {task: summary.ratios(test, task, name, others) for task in summary.tasks(test)}
    found = [
        np.concatenate([np.empty(0), *(r for task, r in ratios.items() if task.startswith(kind))])
        for kind in KINDS
    ]
    every = np.concatenate(found)
    by_kind = [Against.of(each) if len(each) else None for each in found]
    return by_kind, Against.of(every) if len(every) else None


def comparisons(summary: Summary, test: str, names: Sequence[str]) -> str:
    """Predictors against the best simple one, and against the best baseline.

    Args:
        summary: of the log.
        test: name of the test part.
        names: of the predictors.
    """
    there = [any(task.startswith(kind) for task in summary.tasks(test)) for kind in KINDS]
    rows = []
    for simple in (True, False):
        for name in names:
            by_kind, total = against(summary, test, name, simple=simple)
            if total is None:
                continue
            cells = [
                f"{each.wins} / {each.ties} / {each.losses}" if each else "" for each in by_kind
            ]
            rows.append(
                [
                    _label(summary, name),
                    "simple" if simple else "baseline",
                    *(cell for cell, kind in zip(cells, there, strict=True) if kind),
                    _number(total.worst),
                    _number(total.geometric_mean),
                ]
            )
    kinds = [kind for kind, asked in zip(KINDS, there, strict=True) if asked]
    return _table(["", "against the best", *kinds, "worst ratio", "geometric mean"], rows)


def intervals(summary: Summary, test: str) -> str:
    """Coverage of 50, 80 and 95 % intervals, in percent, CRPS, and the score of 95 % intervals.

    Args:
        summary: of the log.
        test: name of the test part.

    Returns:
        A row per predictor and a column per task; empty without intervals.
    """
    rows = []
    for name in summary.predictors:
        each = [summary.intervals(test, task, name) for task in summary.tasks(test)]
        if any(each):
            rows.append([_label(summary, name), *map(_calibration, each)])
    return _table(["", *summary.tasks(test)], rows) if rows else ""


def _has_score(summary: Summary, test: str) -> bool:
    """Whether a predictor has interval scores; results before 0.2.0 was finished have none."""
    found = (summary.intervals(test, t, n) for n in summary.predictors for t in summary.tasks(test))
    return any(each is not None and each.score for each in found)


def _calibration(found: Intervals | None) -> str:
    if found is None:
        return ""
    covered = " / ".join(f"{100 * found.coverage[level]:.0f}" for level in SHOWN_LEVELS)
    score = f"; {_number(found.score['0.95'])}" if found.score else ""
    return f"{covered}; {_number(found.crps)}{score}"


def _label(summary: Summary, name: str) -> str:
    return _words(name) if summary.causal(name) else f"{_words(name)} (both sides)"


def _words(name: str) -> str:
    words = name.removesuffix("_two_sided").replace("_", " ")
    for word, proper in (("pchip", "PCHIP"), ("offbeat", "Offbeat"), ("kalman", "Kalman")):
        words = words.replace(word, proper)
    return words


def _mean(each: Sequence[float]) -> float:
    return float(np.mean(each))


def _spread(each: Sequence[float]) -> str:
    """Mean, and half of the range where there are several."""
    if not each:
        return ""
    half = (max(each) - min(each)) / 2
    shown = _number(_mean(each))
    return shown if len(each) == 1 else f"{shown} ± {half:.1g}"


def _number(value: float) -> str:
    return "" if value != value else f"{value:.3g}"


def _table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)
