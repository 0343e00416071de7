"""Tables and curves of what `examples.experiment_3` found."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from examples.documents import write_between
from offbeat.comparison.statistics import holm, paired_t

PREDICTORS = (
    *("last value", "ridge", "residual GRU", "GRU", "GRU-D", "ODE-RNN", "ODE-GRU-D", "anchored"),
)
PAIRS = (
    ("ODE-GRU-D", "ODE-RNN"),
    ("ODE-GRU-D", "GRU-D"),
    *(("anchored", name) for name in PREDICTORS[:-1]),
)
"""A difference is the first minus the second."""
FEWEST = 3  # pairs that a test needs
ROBOTS = ("walker", "cheetah", "humanoid")


@dataclass(frozen=True, order=True)
class Setting:
    """What is predicted: a robot, the rows of a window, and the fraction of them observed."""

    place: int
    rows: int
    hidden: float

    @property
    def name(self) -> str:
        """As `walker, 100 rows, 90 %`."""
        return f"{ROBOTS[self.place]}, {self.rows} rows, {100 * (1 - self.hidden):.0f} %"


Found = dict[Setting, dict[str, dict[int, dict[str, Any]]]]


def read(folder: Path) -> Found:
    """Records by setting, predictor and repeat.

    Args:
        folder: of the results.
    """
    found: Found = {}
    for path in sorted(folder.glob("*.json")):
        one = json.loads(path.read_text(encoding="utf-8"))
        setting = Setting(ROBOTS.index(one["robot"]), one["rows"], round(1 - one["fraction"], 2))
        found.setdefault(setting, {}).setdefault(one["predictor"], {})[one["repeat"]] = one
    return dict(sorted(found.items()))


def errors(found: Found) -> str:
    """A Markdown table: mean RMSE of the repeats, and their standard deviation."""
    lines = [_head("RMSE", [*PREDICTORS, "trajectories", "epochs", "repeats"])]
    for setting, each in found.items():
        means = {name: np.mean(_rmse(own)) for name, own in each.items()}
        best = min(means, key=lambda name: means[name])
        entries = [_error(_rmse(each.get(name, {})), name == best) for name in PREDICTORS]
        first = next(iter(next(iter(each.values())).values()))
        counts = sorted({len(own) for own in each.values()})
        entries += [f"{first['trajectories']:,}", f"{first['epochs']}"]
        entries.append(" to ".join(f"{c}" for c in dict.fromkeys((counts[0], counts[-1]))))
        lines.append(_line(setting.name, entries))
    return "\n".join(lines)


def tests(found: Found) -> str:
    """A Markdown table: differences in percent of the second error, and p of the paired t test.

    Holm's correction is over all tests of the table.
    """
    cells: dict[tuple[Setting, int], tuple[float, int, int]] = {}
    p_values: dict[tuple[Setting, int], float] = {}
    for setting, each in found.items():
        for i, (one, other) in enumerate(PAIRS):
            repeats = sorted(each.get(one, {}).keys() & each.get(other, {}).keys())
            if not repeats:
                continue
            a, b = (
                np.array([each[name][repeat]["rmse"] for repeat in repeats])
                for name in (one, other)
            )
            change = 100 * (a.mean() / b.mean() - 1)
            cells[setting, i] = float(change), int((a < b).sum()), len(a)
            if len(a) >= FEWEST:
                p_values[setting, i] = paired_t(a, b).p
    corrected = dict(zip(p_values, holm(list(p_values.values())) if p_values else (), strict=True))
    lines = [_head("difference (p)", [f"{one} − {other}" for one, other in PAIRS])]
    for setting in found:
        entries = []
        for i in range(len(PAIRS)):
            if (setting, i) not in cells:
                entries.append("not run")
                continue
            change, ahead, count = cells[setting, i]
            p = corrected.get((setting, i))
            end = f"{ahead} of {count}" if p is None else f"{p:.2g}"
            entries.append(f"{round(change, 1) + 0.0:+.1f} % ({end})".replace("-", "−", 1))
        lines.append(_line(setting.name, entries))
    return "\n".join(lines)


def costs(found: Found) -> str:
    """A Markdown table: processor time of an epoch of 1,000 windows, or of fitting a baseline."""
    lines = [_head("s per epoch of 1,000 windows", [*PREDICTORS[3:], *PREDICTORS[1:3]])]
    for place, rows in sorted({(s.place, s.rows) for s in found}):
        settings = [s for s in found if (s.place, s.rows) == (place, rows)]
        entries = []
        for name in (*PREDICTORS[3:], *PREDICTORS[1:3]):
            some = [r for s in settings for r in found[s].get(name, {}).values()]
            per = [
                1000 * r["seconds"] / r["trajectories"] / (r["epochs"] if "curve" in r else 1)
                for r in some
            ]
            entries.append(f"{np.median(per):.2g}" if per else "not run")
        lines.append(_line(f"{ROBOTS[place]}, {rows} rows", entries))
    return "\n".join(lines)


def draw(found: Found, path: Path) -> None:
    """Validation RMSE by epoch, a panel per setting, the mean over the repeats.

    Args:
        found: of `read`.
        path: of the figure.
    """
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt
    from matplotlib.ticker import LogLocator

    across = min(4, len(found))
    down = -(-len(found) // across)
    size = (3.0 * across, 2.6 * down + 0.5)
    figure, axes = plt.subplots(down, across, figsize=size, squeeze=False, layout="constrained")
    for axis in axes.flat[len(found) :]:
        axis.set_visible(False)
    for axis, (setting, each) in zip(axes.flat, found.items(), strict=False):
        for i, name in enumerate(PREDICTORS[3:]):
            curves = [own["curve"] for own in each.get(name, {}).values()]
            if curves:
                mean = np.mean(curves, axis=0)
                axis.plot(np.arange(1, len(mean) + 1), mean, color=f"C{i}", label=name)
        axis.set_title(setting.name, fontsize=9)
        axis.set_yscale("log")
        axis.yaxis.set_minor_locator(LogLocator(subs=(2, 3, 4, 5, 6, 8)))
        for each_axis in (axis.yaxis.set_major_formatter, axis.yaxis.set_minor_formatter):
            each_axis("{x:g}")
        axis.grid(alpha=0.3, which="both")
    for axis in axes[-1]:
        axis.set_xlabel("epoch")
    for axis in axes[:, 0]:
        axis.set_ylabel("validation RMSE")
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncol=len(labels), frameon=False)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)
    plt.close(figure)


def write(document: Path, folder: Path) -> None:
    """Replaces the tables in a document, between their marks, and draws the curves beside it.

    Args:
        document: with `<!-- experiment 3 -->` and `<!-- end of experiment 3 -->`.
        folder: of the results.
    """
    found = read(folder)
    write_between(
        document, "experiment 3", "\n\n".join([errors(found), tests(found), costs(found)])
    )
    draw(found, document.parent / "figures" / "experiment_3_curves.png")


def _rmse(own: dict[int, dict[str, Any]]) -> list[float]:
    return [record["rmse"] for record in own.values()]


def _error(rmse: list[float], best: bool) -> str:
    if not rmse:
        return "not run"
    text = f"{np.mean(rmse):.4f}"
    text = f"**{text}**" if best else text
    return text if len(rmse) == 1 else f"{text} ± {np.std(rmse, ddof=1):.4f}"


def _head(first: str, names: list[str]) -> str:
    return f"| {first} | {' | '.join(names)} |\n" + "|---" * (1 + len(names)) + "|"


def _line(first: str, entries: list[str]) -> str:
    return f"| {first} | {' | '.join(entries)} |"
