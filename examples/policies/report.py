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
        mean, low, high = interquartile(_percent(each, zero, one))
        entries.append(f"{mean:.0f}" if len(each) == 1 else f"{mean:.0f} ({low:.0f}–{high:.0f})")
    return f"| {name} | " + " | ".join(entries)


def draw(folder: Path, path: Path) -> None:
    """Returns against the fraction of lost frames, a panel per training, means and intervals.

    Args:
        folder: of the results.
        path: of the figure.
    """
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    expert, random = (_read(folder / f"{name}.json")["returns"] for name in ("expert", "random"))
    fractions = [name for name in expert if name.endswith("%")]
    lost = [float(name.split()[0]) for name in fractions]
    zero, one = np.mean(random[fractions[0]]), np.mean(expert[fractions[0]])
    records = [_read(each) for each in sorted(folder.glob("*-*.json"))]
    trainings = [t for t in TITLES if any(r["training"] == t for r in records)]
    size = (4.4 * len(trainings) + 2.2, 3.8)
    figure, axes = plt.subplots(1, len(trainings), figsize=size, sharey=True, squeeze=False)
    for axis, training in zip(axes[0], trainings, strict=True):
        held = [interquartile(_percent([expert[name]], zero, one))[0] for name in fractions]
        axis.plot(lost, held, color="black", ls="--", label="expert, last value")
        for i, rival in enumerate(RIVALS):
            some = [r for r in records if (r["rival"], r["training"]) == (rival, training)]
            if not some:
                continue
            each = [
                interquartile(_percent([r["returns"][name] for r in some], zero, one))
                for name in fractions
            ]
            mean, low, high = np.array(each).T
            axis.plot(lost, mean, color=f"C{i}", marker="o", ms=3, label=rival)
            axis.fill_between(lost, low, high, color=f"C{i}", alpha=0.12, lw=0)
        axis.set_title(TITLES[training], fontsize=10)
        axis.set_xlabel("frames lost, %")
        axis.grid(alpha=0.3)
    axes[0, 0].set_ylabel("return, % of the expert")
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="center right", fontsize=8, frameon=False)
    figure.tight_layout(rect=(0, 0, 1 - 2.2 / size[0], 1))
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)
    plt.close(figure)


def _percent(returns: Any, zero: float, one: float) -> NDArray[np.float64]:
    """100 for the expert that sees everything, 0 for random actions."""
    return 100 * (np.asarray(returns) - zero) / (one - zero)


def write(document: Path, folder: Path, robot: str) -> None:
    """Replaces the tables of a robot in a document, between its marks, and draws its figure.

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
    draw(folder, document.parent / "figures" / f"policies_{robot}.png")
    document.write_text(
        f"{before}<!-- {robot} -->\n\n{inside}\n\n<!-- end of {robot} -->{after}", encoding="utf-8"
    )


def _read(path: Path) -> dict[str, Any]:
    record: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    return record
