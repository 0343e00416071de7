"""The tables of a comparison: interquartile means with stratified bootstrap intervals."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from examples.documents import write_between

from . import paired
from .rivals import RIVALS
from .scores import by_seed, interquartile, percent, read, records

TITLES = {
    "drops": "Trained with frames lost",
    "all drops": "Trained with frames, sensors and bursts lost",
    "no drops": "Trained without losses",
}


def table(folder: Path, training: str) -> str:
    """A Markdown table of the scores of every rival, 100 the expert and 0 random actions.

    Args:
        folder: of the results.
        training: one of `TITLES`.
    """
    expert = read(folder / "expert.json")["returns"]
    names = list(expert)
    lines = [
        f"| {TITLES[training].lower()} | " + " | ".join(names) + " | trainings | s |",
        "|---" * (len(names) + 3) + "|",
        _line(folder, "expert, last value", {k: [v] for k, v in expert.items()}),
    ]
    lines[-1] += " | | |"
    every = records(folder)
    for rival in RIVALS:
        found = [r for r in every if (r["rival"], r["training"]) == (rival, training)]
        if not found:
            lines.append(f"| {rival} |" + " not run |" * (len(names) + 2))
            continue
        returns = {k: [r["returns"][k] for r in found if k in r["returns"]] for k in names}
        seconds = np.mean([r["training_seconds"] for r in found])
        lines.append(f"{_line(folder, rival, returns)} | {len(found)} | {seconds:.0f} |")
    return "\n".join(lines)


def _line(folder: Path, name: str, returns: dict[str, Any]) -> str:
    entries = []
    for each in returns.values():
        mean, low, high = (round(x) for x in interquartile(percent(folder, each)))
        entries.append(f"{mean}" if len(each) == 1 else f"{mean} ({low}–{high})")
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

    expert = read(folder / "expert.json")["returns"]
    fractions = [name for name in expert if name.endswith("%")]
    lost = [float(name.split()[0]) for name in fractions]
    every = records(folder)
    trainings = [t for t in TITLES if any(r["training"] == t for r in every)]
    size = (4.4 * len(trainings) + 2.2, 3.8)
    figure, axes = plt.subplots(1, len(trainings), figsize=size, sharey=True, squeeze=False)
    for axis, training in zip(axes[0], trainings, strict=True):
        held = [interquartile(percent(folder, [expert[name]]))[0] for name in fractions]
        axis.plot(lost, held, color="black", ls="--", label="expert, last value")
        for i, rival in enumerate(RIVALS):
            some = [r for r in every if (r["rival"], r["training"]) == (rival, training)]
            if not some:
                continue
            each = [
                interquartile(percent(folder, [r["returns"][name] for r in some]))
                for name in fractions
            ]
            mean, low, high = np.array(each).T
            width = 2.5 if rival == "anchored" else 1.2
            axis.plot(lost, mean, color=f"C{i}", marker="o", ms=3, lw=width, label=rival)
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


def lengths(results: Path) -> str:
    """A Markdown table: what the length and the rate of a training do to the anchored model.

    Args:
        results: with a folder per robot and length.
    """
    lines = [
        "| robot | epochs | rate | trainings | validation | anchored, 0 % | 70 % | each "
        "| next, 70 % |",
        "|---" * 9 + "|",
    ]
    rows = []
    for folder in results.glob("*_sac*"):
        scores = {c: by_seed(folder, "all drops", c) for c in ("0 %", "70 %")}
        if folder.name.endswith("before") or "anchored" not in scores["70 %"]:
            continue
        trained = [r for r in records(folder) if r["rival"] == "anchored"]
        trained = [r for r in trained if r["training"] == "all drops"]
        record, error = trained[0], np.mean([r["validation"] for r in trained])
        means = {
            name: interquartile(np.array(list(each.values())))
            for name, each in scores["70 %"].items()
        }
        best = max((name for name in means if name != "anchored"), key=lambda n: means[n][0])
        own = scores["70 %"]["anchored"]
        nothing = interquartile(np.array(list(scores["0 %"]["anchored"].values())))[0]
        mean, low, high = means["anchored"]
        each = ", ".join(f"{interquartile(own[seed][None])[0]:.0f}" for seed in sorted(own))
        robot, epochs = folder.name.split("_sac")[0], record.get("epochs", 80)
        rate = record.get("learning_rate", 0.01)
        line = (
            f"| {robot} | {epochs} | {rate} | {len(own)} | {error:.4f} | {nothing:.0f} "
            f"| {mean:.0f} ({low:.0f}–{high:.0f}) | {each} | {best}, {means[best][0]:.0f} |"
        )
        rows.append(((robot, epochs, -rate), line))
    return "\n".join([*lines, *(line for _, line in sorted(rows))])


def write(document: Path, folder: Path, robot: str) -> None:
    """Replaces the tables of a robot in a document, between its marks, and draws its figure.

    Args:
        document: with `<!-- ROBOT -->` and `<!-- end of ROBOT -->`.
        folder: of the results.
        robot: name of the marks.
    """
    run = {record["training"] for record in records(folder)}
    tables = [table(folder, training) for training in TITLES if training in run]
    with_losses = next(training for training in TITLES if training in run)
    tables.append(paired.table(folder, with_losses, "70 %"))
    draw(folder, document.parent / "figures" / f"policies_{robot}.png")
    write_between(document, robot, "\n\n".join(tables))
