"""Table and figure of what `examples.policies.shapes` found."""

from __future__ import annotations

import json
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import wilcoxon

from examples.documents import write_between
from offbeat.comparison.statistics import holm

STARTS = {"seen": "seen start", "unseen": "unseen start", "pushed": "pushed", "lost": "frames lost"}
REFERENCE = "kernel ridge, attracted"
FRACTIONS = (0.3, 1.0)


def _read(folder: Path) -> dict[tuple[str, str, float], dict[str, Any]]:
    """Records by shape, learner and fraction; shapes with all of them alone."""
    records = [json.loads(path.read_text(encoding="utf-8")) for path in folder.glob("*.json")]
    found = {(r["shape"], r["learner"], r["fraction"]): r for r in records}
    learners = {key[1:] for key in found}
    whole = {s for s, *_ in found if all((s, *each) in found for each in learners)}
    return {key: record for key, record in found.items() if key[0] in whole}


def _mean(record: dict[str, Any], start: str, what: str) -> float:
    """Mean over the paths of a kind of start."""
    chosen = [d[what] for name, d in record["distances"].items() if name.startswith(start)]
    return float(np.mean(chosen))


def table(folder: Path) -> str:
    """A Markdown table: medians over the shapes, and how often a learner is nearer than ridge."""
    found = _read(folder)
    shapes = sorted({key[0] for key in found})
    learners = list(dict.fromkeys([REFERENCE, *sorted({key[1] for key in found})]))
    against = _against(found, shapes, learners[1:])
    lines = [
        f"| {len(shapes)} shapes | stamps | "
        + " | ".join(f"{name}: area, Fréchet, DTW" for name in STARTS)
        + " | end | nearer than attracted ridge | s |",
        "|---" * (len(STARTS) + 5) + "|",
    ]
    for learner in learners:
        for fraction in FRACTIONS:
            some = [found[shape, learner, fraction] for shape in shapes]
            entries = []
            for start in STARTS.values():
                area, frechet, warped = (
                    np.median([_mean(r, start, what) for r in some])
                    for what in ("area", "frechet", "dtw")
                )
                entries.append(f"{area:.0f}, {frechet:.1f}, {warped:.1f}")
            end = np.median([_mean(r, "unseen start", "end") for r in some])
            seconds = np.mean([r["training_seconds"] for r in some])
            lines.append(
                f"| {learner} | {100 * fraction:.0f} % | {' | '.join(entries)} | {end:.1f} | "
                f"{against.get((learner, fraction), '')} | {seconds:.0f} |"
            )
    return "\n".join(lines)


def _against(
    found: dict[Any, Any], shapes: list[str], learners: list[str]
) -> dict[tuple[str, float], str]:
    """On how many shapes the DTW distance from the unseen start is less than that of ridge."""
    nearer, p_values = {}, {}
    for learner, fraction in product(learners, FRACTIONS):
        own, other = (
            np.array([_mean(found[s, name, fraction], "unseen start", "dtw") for s in shapes])
            for name in (learner, REFERENCE)
        )
        nearer[learner, fraction] = int((own < other).sum())
        p_values[learner, fraction] = float(wilcoxon(own, other).pvalue)
    corrected = holm(list(p_values.values()))
    return {
        key: f"{count} (p = {p:.2g})"
        for (key, count), p in zip(nearer.items(), corrected, strict=True)
    }


def draw(folder: Path, path: Path, shapes: int = 6) -> None:
    """Paths from the unseen start and after a push, of learners from 30 % of the stamps."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    from examples.lasa import demonstrations

    found = _read(folder)
    names = sorted({key[0] for key in found})[:shapes]
    learners = (REFERENCE, "GRU, gap", "ODE-RNN", "anchored")
    figure, axes = plt.subplots(2, len(names), figsize=(2.3 * len(names), 5.0), squeeze=False)
    for column, shape in enumerate(names):
        data = demonstrations([shape], 5)
        for row, kind in enumerate(("path", "pushed")):
            axis = axes[row, column]
            for demo in list(data)[:5]:
                axis.plot(*demo.values[:, :2].T, color="0.8", lw=1)
            axis.plot(*data[6].values[:, :2].T, color="black", lw=1.5, label="demonstration 7")
            for i, learner in enumerate(learners):
                traced = np.array(found[shape, learner, 0.3][kind])
                axis.plot(*traced.T, color=f"C{i}", lw=1.2, label=learner)
            axis.set_aspect("equal", "datalim")
            axis.set_xticks([])
            axis.set_yticks([])
            axis.set_title(f"{shape}, pushed" if row else shape, fontsize=9)
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="lower center", ncol=len(labels), fontsize=9, frameon=False)
    figure.tight_layout(rect=(0, 0.05, 1, 1))
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)
    plt.close(figure)


def write(document: Path, folder: Path) -> None:
    """Replaces the table in a document, between its marks, and draws the figure beside it."""
    write_between(document, "lasa", table(folder))
    draw(folder, document.parent / "figures" / "lasa_traced.png")
