"""The tables of a comparison: interquartile means with stratified bootstrap intervals."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import trim_mean

from .rivals import RIVALS

TITLES = {
    "drops": "Trained with frames lost",
    "all drops": "Trained with frames, sensors and bursts lost",
    "no drops": "Trained without losses",
}
RESAMPLED = 2000


def interquartile(scores: NDArray[np.float64], seed: int = 0) -> tuple[float, float, float]:
    """Interquartile mean and its 95 % interval, as Agarwal et al. 2021 (arXiv:2108.13264).

    Trainings are drawn anew for each episode, which is a stratum: all trainings meet the same ones.

    Args:
        scores: (trainings, episodes).
        seed: of the bootstrap.
    """
    random = np.random.default_rng(seed)
    drawn = random.integers(0, len(scores), (RESAMPLED, *scores.shape))
    means = trim_mean(
        scores[drawn, np.arange(scores.shape[1])].reshape(RESAMPLED, -1), 0.25, axis=1
    )
    low, high = np.quantile(means, [0.025, 0.975])
    return float(trim_mean(scores.ravel(), 0.25)), float(low), float(high)


def table(folder: Path, training: str) -> str:
    """A Markdown table of the scores of every rival, 100 the expert and 0 random actions.

    Args:
        folder: of the results.
        training: one of `TITLES`.
    """
    expert, random = (_read(folder / f"{name}.json")["returns"] for name in ("expert", "random"))
    names = list(expert)
    zero, one = np.mean(random[names[0]]), np.mean(expert[names[0]])
    lines = [
        f"| {TITLES[training].lower()} | " + " | ".join(names) + " | trainings | s |",
        "|---" * (len(names) + 3) + "|",
        _line("expert, last value", {k: np.array([v]) for k, v in expert.items()}, zero, one),
    ]
    lines[-1] += " | | |"
    for rival in RIVALS:
        found = [
            r
            for path in sorted(folder.glob("*-*.json"))
            if (r := _read(path))["rival"] == rival and r["training"] == training
        ]
        if not found:
            lines.append(f"| {rival} |" + " not run |" * (len(names) + 2))
            continue
        scores = {k: np.array([r["returns"][k] for r in found]) for k in names}
        seconds = np.mean([r["training_seconds"] for r in found])
        lines.append(f"{_line(rival, scores, zero, one)} | {len(found)} | {seconds:.0f} |")
    return "\n".join(lines)


def _line(name: str, returns: dict[str, Any], zero: float, one: float) -> str:
    entries = []
    for each in returns.values():
        mean, low, high = interquartile(100 * (each - zero) / (one - zero))
        entries.append(f"{mean:.0f}" if len(each) == 1 else f"{mean:.0f} ({low:.0f}–{high:.0f})")
    return f"| {name} | " + " | ".join(entries)


def write(document: Path, folder: Path, robot: str) -> None:
    """Replaces the tables of a robot in a document, between its marks.

    Args:
        document: with `<!-- ROBOT -->` and `<!-- end of ROBOT -->`.
        folder: of the results.
        robot: name of the marks.
    """
    run = {_read(path)["training"] for path in folder.glob("*-*.json")}
    tables = [table(folder, training) for training in TITLES if training in run]
    text = document.read_text(encoding="utf-8")
    before, rest = text.split(f"<!-- {robot} -->")
    _, after = rest.split(f"<!-- end of {robot} -->")
    inside = "\n\n".join(tables)
    document.write_text(
        f"{before}<!-- {robot} -->\n\n{inside}\n\n<!-- end of {robot} -->{after}", encoding="utf-8"
    )


def _read(path: Path) -> dict[str, Any]:
    record: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    return record
