"""Learning curves of experiment 1: figures 3.3 to 3.6."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from offbeat import InputError
from offbeat.plots.style import COLUMN_WIDTH, RC, plain_ticks, style_of
from thesis.report import thesis_numbers as thesis
from thesis.report.records import Record
from thesis.report.tables import percent

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_CHOSEN = "#595959"
_CUT = 10
"""Epochs that may lie above a panel, of curves ten times as long."""
_PANELS = {"published": "Published scoring", "honest": "After the first observation"}


def curves_figure(record: Record, fraction: float) -> Figure:
    """Validation MSE by epoch, all models of the thesis, published and after the first observation.

    Hollow markers are the thesis' tables 3.1 to 3.4; a dashed line is the last-value
    predictor, a vertical one the number of epochs that the thesis chose.

    Args:
        record: its runs of experiment 1, with their curves.
        fraction: observed fraction of the rows.

    Raises:
        InputError: the record has no curve of experiment 1 at this fraction.
    """
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    curves = {}
    for model in thesis.MODELS:
        runs = record.where(experiment=1, model=model, fraction=fraction)
        found = [record.curve(str(name)) for name in record.values("run_id", runs)]
        if found and len(found[0]["epoch"]):
            curves[model] = found[0]
    if not curves:
        raise InputError(
            f"{record.source} has no curve of experiment 1 at {percent(fraction)}; learning curves "
            "need one"
        )
    with rc_context(RC):
        figure = Figure(figsize=(COLUMN_WIDTH, 5.2), layout="constrained")
        panels = figure.subplots(2, sharex=True)
        for axes, (scoring, title) in zip(panels, _PANELS.items(), strict=True):
            for model, curve in curves.items():
                style = style_of(model)
                axes.plot(
                    curve["epoch"],
                    curve[f"validation_{scoring}_mse"],
                    color=style.colour,
                    linestyle=style.dash,
                    linewidth=1.0,
                    label=style.label,
                )
            axes.set_yscale("log")
            axes.set_title(title, loc="left")
        _thesis_points(panels[0], fraction)
        chosen = thesis.CHOSEN_EPOCHS[fraction]
        for axes in panels:
            axes.axvline(chosen, color=_CHOSEN, linewidth=0.8, label=f"Thesis' choice, {chosen}")
        rows = record.where(experiment=1, fraction=fraction)
        last, style = record.values("last_value_honest_mse", rows)[0], style_of("last_value")
        panels[1].axhline(
            float(last),
            color=style.colour,
            linestyle=style.dash,
            label=f"{style.label} (test part)",
        )
        for axes, scoring in zip(panels, _PANELS, strict=True):
            axes.set_ylim(top=_top(curves.values(), f"validation_{scoring}_mse"))
            plain_ticks(axes.yaxis, axes.get_ylim())
        figure.supylabel("Validation MSE (scaled units)", fontsize=RC["axes.labelsize"])
        panels[-1].set_xlabel("Epoch")
        panels[-1].set_xlim(left=0)
        handles: dict[str, Artist] = {}
        for axes in panels:
            handles.update(zip(*reversed(axes.get_legend_handles_labels()), strict=True))
        figure.legend(
            list(handles.values()),
            list(handles),
            loc="outside lower center",
            ncols=2,
        )
    return figure


def _top(curves: Iterable[Mapping[str, NDArray[np.float64]]], column: str) -> float | None:
    """Upper limit of a panel; large errors of the first epochs would compress the rest."""
    found = [curve[column] for curve in curves]
    if min(map(len, found)) < 10 * _CUT:
        return None
    return 1.1 * max(float(values[_CUT - 1]) for values in found)


def _thesis_points(axes: Axes, fraction: float) -> None:
    """The thesis' tables as hollow markers, one kind per model."""
    for model, values in thesis.VALIDATION_MSE[fraction].items():
        style = style_of(model)
        axes.plot(
            thesis.EPOCHS,
            values,
            linestyle="none",
            marker=style.marker,
            markersize=4,
            markerfacecolor="none",
            markeredgecolor=style.colour,
            markeredgewidth=1.0,
            zorder=4,
        )
    axes.plot(
        [],
        [],
        linestyle="none",
        marker="o",
        markersize=4,
        markerfacecolor="none",
        markeredgecolor=_CHOSEN,
        label="Thesis, by colour",
    )
