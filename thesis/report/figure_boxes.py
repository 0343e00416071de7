"""Box plots of the repeats of experiment 2: figures 3.7 to 3.10."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from offbeat import InputError
from offbeat.plots.style import COLUMN_WIDTH, RC, STYLES, plain_ticks, style_of
from thesis.report import thesis_numbers as thesis
from thesis.report.records import Record
from thesis.report.tables import LAST_VALUE, percent, rmse_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

BEYOND = ("gru_unfed", "gru_d_unfed", "gru_fair", "gru_d_fair", "anchored_ode_gru_d")
"""Models of experiment 2 that the thesis does not have."""


def boxes_figure(record: Record, fraction: float) -> Figure:
    """Test MSE of each repeat as box plots, published and after the first observation.

    Boxes reach from the first to the third quartile with the median inside, whiskers to the
    farthest run within 1.5 times that range; every run is a dot. A diamond with a bar is the
    thesis' mean RMSE plus and minus its standard deviation, squared.

    Args:
        record: its runs of experiment 2.
        fraction: observed fraction of the rows.

    Raises:
        InputError: the record has no run of experiment 2 at this fraction.
    """
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    if not len(record.where(experiment=2, fraction=fraction)):
        raise InputError(
            f"{record.source} has no run of experiment 2 at {percent(fraction)}; box plots need one"
        )
    panels = {
        "published": ("Published scoring", thesis.MODELS),
        "honest": ("After the first observation", (*thesis.MODELS, *BEYOND, LAST_VALUE)),
    }
    with rc_context(RC):
        figure = Figure(figsize=(COLUMN_WIDTH, 4.4), layout="constrained")
        both = figure.subplots(2, height_ratios=[len(models) + 1 for _, models in panels.values()])
        for axes, (scoring, (title, models)) in zip(both, panels.items(), strict=True):
            samples = {m: rmse_of(record, m, fraction, scoring)[1] ** 2 for m in models}
            _boxes(axes, {m: values for m, values in samples.items() if len(values)})
            axes.set_title(title, loc="left")
            if scoring == "honest":  # the models differ by more than a factor here
                axes.set_xscale("log")
                plain_ticks(axes.xaxis, axes.get_xlim(), times=1e3)
            axes.set_xlabel("Test MSE (scaled units, 10\N{SUPERSCRIPT MINUS}\N{SUPERSCRIPT THREE})")
        _thesis_intervals(both[0], fraction, thesis.MODELS)
    return figure


def _boxes(axes: Axes, samples: dict[str, NDArray[np.float64]]) -> None:
    names = list(samples)
    drawn = axes.boxplot(
        list(samples.values()),
        orientation="horizontal",
        positions=range(len(names)),
        widths=0.55,
        patch_artist=True,
        showfliers=False,
    )
    for i, name in enumerate(names):
        colour = style_of(name).colour
        drawn["boxes"][i].set(facecolor=(*_rgb(colour), 0.25), edgecolor=colour)
        drawn["medians"][i].set(color=colour, linewidth=1.8)
        for part in (*drawn["whiskers"][2 * i : 2 * i + 2], *drawn["caps"][2 * i : 2 * i + 2]):
            part.set(color=colour)
        axes.plot(
            samples[name],
            np.full(len(samples[name]), i),
            linestyle="none",
            marker="o",
            markersize=2.2,
            markerfacecolor=colour,
            markeredgewidth=0,
            alpha=0.8,
            zorder=3,
        )
    axes.set_yticks(range(len(names)), [style_of(name).label for name in names])
    axes.set_ylim(len(names) - 0.25, -0.6)  # room for text below a box
    axes.grid(False, axis="y")
    axes.tick_params(axis="y", length=0)
    axes.locator_params(axis="x", nbins=4)
    axes.xaxis.set_major_formatter(lambda value, _: f"{1e3 * value:g}")


def _thesis_intervals(axes: Axes, fraction: float, names: Sequence[str]) -> None:
    at = thesis.FRACTIONS.index(fraction)
    labels = [text.get_text() for text in axes.get_yticklabels()]
    for name in names:
        if style_of(name).label not in labels:
            continue
        mean, spread = thesis.TEST_RMSE[name][at]
        low, high = (mean - spread) ** 2, (mean + spread) ** 2
        axes.errorbar(
            mean**2,
            labels.index(style_of(name).label) + 0.4,
            xerr=[[mean**2 - low], [high - mean**2]],
            fmt="D",
            markersize=3,
            color=STYLES["truth"].colour,
            elinewidth=0.9,
            capsize=1.5,
            label="Thesis, mean ± std, squared",
        )
    handles, texts = axes.get_legend_handles_labels()
    axes.figure.legend(handles[:1], texts[:1], loc="outside lower center")


def _rgb(colour: str) -> tuple[float, float, float]:
    from matplotlib.colors import to_rgb

    return to_rgb(colour)
