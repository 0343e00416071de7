"""Writes results into the document: a table per log, and how each peer was run."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from .registry import PEERS

LOGS = ("g1", "lasa", "wrist", "hopper")
"""In the order of the summary."""

_ROOT = Path(__file__).resolve().parents[2]
DOCUMENTS = _ROOT / "docs" / "benchmarks_peers.md", _ROOT / "README.md"


def fill_in(text: str, out: Path) -> str:
    """The document with its tables replaced.

    Args:
        text: of the document; a table is between `<!-- NAME -->` and `<!-- end of NAME -->`.
        out: folder of the results.
    """

    def found(match: re.Match[str]) -> str:
        name = match.group(1)
        whole = {"settings": settings, "summary": summary, "peers": ratios}
        body = whole[name](out) if name in whole else rows(name, out)
        return f"<!-- {name} -->\n\n{body}\n\n<!-- end of {name} -->"

    return re.sub(r"<!-- (\w+) -->.*?<!-- end of \1 -->", found, text, flags=re.DOTALL)


def rows(log: str, out: Path) -> str:
    """The table of a log.

    Args:
        log: name.
        out: folder of the results.
    """
    found = results_of(log, out)
    tasks: list[str] = []
    for result in found.values():
        tasks += [task for task in result.get("scores", {}) if task not in tasks]
    best = {
        task: min(r["scores"][task]["rmse_scaled"] for r in found.values() if _has(r, task))
        for task in tasks
    }
    head = ["", *tasks, "within 90 %: fill; forecasts", "fit, s", "answer, s", "MB", "lines"]
    lines = [_line(head), _line(["---"] * len(head))]
    for name, result in found.items():
        if "error" in result:
            said = result["error"][:80]
            lines.append(_line([PEERS[name].title, f"failed: {said}", *[""] * (len(head) - 2)]))
            continue
        cells = [PEERS[name].title]
        for task in tasks:
            value = result["scores"][task]["rmse_scaled"] if _has(result, task) else None
            shown = "" if value is None else f"{value:.3g}"
            cells.append(f"**{shown}**" if value == best[task] else shown)
        cells += [_coverage(result), f"{result['fit_cpu_s']:.3g}", f"{result['answer_cpu_s']:.3g}"]
        cells += [str(result["peak_mb"]), str(result["lines"])]
        lines.append(_line(cells))
    return "\n".join(lines)


@dataclass(frozen=True)
class Beside:
    """Offbeat beside the best other peer of a task, chosen in hindsight.

    Attributes:
        log: name.
        task: name.
        ours: RMSE of Offbeat, scaled.
        theirs: that of the other peer.
        peer: its name.
    """

    log: str
    task: str
    ours: float
    theirs: float
    peer: str


def beside(out: Path) -> Iterator[Beside]:
    """Every task that Offbeat was asked, in the order of the logs.

    Args:
        out: folder of the results.
    """
    for log in (log for log in LOGS if log in _logs(out)):
        found = dict(results_of(log, out))
        own = found.pop("offbeat", {}).get("scores", {})
        for task, scores in own.items():
            others = {
                name: result["scores"][task]["rmse_scaled"]
                for name, result in found.items()
                if _has(result, task)
            }
            best = min(others, key=lambda name: others[name])
            yield Beside(log, task, scores["rmse_scaled"], others[best], best)


def summary(out: Path) -> str:
    """The table of Offbeat beside the best peer of each task.

    Args:
        out: folder of the results.
    """
    lines = [_line(["", "", "Offbeat", "best of the others", "which", "ratio"]), _line(["---"] * 6)]
    for each in beside(out):
        both = each.ours, each.theirs
        shown = [f"**{v:.3g}**" if v == min(both) else f"{v:.3g}" for v in both]
        ratio = f"{each.ours / each.theirs:.2f}"
        lines.append(_line([each.log, each.task, *shown, PEERS[each.peer].title, ratio]))
    return "\n".join(lines)


def ratios(out: Path) -> str:
    """A row per log for the first page: ratios of `summary`, those of losses in bold, and peers.

    Args:
        out: folder of the results.
    """
    found = list(beside(out))
    tasks = list(dict.fromkeys(_kind(each) for each in found))
    lines = [_line(["", *tasks]), _line(["---"] * (len(tasks) + 1))]
    for log in dict.fromkeys(each.log for each in found):
        cells = dict.fromkeys(tasks, "")
        for each in (each for each in found if each.log == log):
            ratio = f"{each.ours / each.theirs:.2f}"
            shown = f"**{ratio}**" if each.ours > each.theirs else ratio
            cells[_kind(each)] = f"{shown} {PEERS[each.peer].title}"
        lines.append(_line([log, *cells.values()]))
    return "\n".join(lines)


def _kind(each: Beside) -> str:
    return "fill" if each.task.startswith("fill") else each.task


def settings(out: Path) -> str:
    """The table of versions, settings and commands.

    Args:
        out: folder of the results.
    """
    lines = [_line(["", "versions", "what was chosen", "command"]), _line(["---"] * 4)]
    for name, peer in PEERS.items():
        logs = {log: results_of(log, out).get(name) for log in LOGS}
        ran = [result for result in logs.values() if result and "versions" in result]
        if not ran:
            continue
        versions = {
            f"{package} {version}"
            for result in ran
            for package, version in result["versions"].items()
            if package != "python"
        }
        command = re.sub(r"--log \w+", "--log LOG", ran[0]["command"])
        said = [peer.title, ", ".join(sorted(versions)), peer.settings, f"`{command}`"]
        lines.append(_line(said))
    return "\n".join(lines)


def results_of(log: str, out: Path) -> Mapping[str, dict[str, Any]]:
    """Results of seed 0 by peer, in the order of the registry.

    Args:
        log: name.
        out: folder of the results.
    """
    files = {name: out / log / f"{name}.json" for name in PEERS}
    return {
        name: json.loads(path.read_text(encoding="utf-8"))
        for name, path in files.items()
        if path.exists()
    }


def _logs(out: Path) -> list[str]:
    return [path.name for path in out.iterdir() if path.is_dir()] if out.exists() else []


def _has(result: Mapping[str, Any], task: str) -> bool:
    return task in result.get("scores", {})


def _coverage(result: Mapping[str, Any]) -> str:
    """Coverage of the fill, then the mean over forecasts, in percent."""
    each = [
        (task, scores["coverage_90"])
        for task, scores in result["scores"].items()
        if "coverage_90" in scores
    ]
    if not each:
        return ""
    fills = [f"{100 * value:.0f}" for task, value in each if task.startswith("fill")]
    ahead = [value for task, value in each if task.startswith("forecast")]
    return (
        f"{fills[0] if fills else '–'}; {100 * sum(ahead) / len(ahead):.0f}" if ahead else fills[0]
    )


def _line(cells: list[str]) -> str:
    return "| " + " | ".join(cells) + " |"
