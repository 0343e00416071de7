"""Figures of errors: of several predictors by task, and by time since the last observation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from offbeat.errors import InputError
from offbeat.plots.style import PAGE_WIDTH, RC, plain_ticks, style_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def by_task(
    errors: Mapping[str, Mapping[str, float]], *, title: str = "", units: str = "scaled units"
) -> Figure:
    """Draws the error of each predictor on a line per task, on a logarithmic axis.

    Args:
        errors: per task, RMSE by predictor; the first predictor is drawn largest.
        title: text above.
        units: of the errors.

    Raises:
        InputError: there is no task, or an error that is not above 0.
    """
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    found = [value for each in errors.values() for value in each.values()]
    if not found or not all(value > 0 and np.isfinite(value) for value in found):
        bad = [value for value in found if not (value > 0 and np.isfinite(value))]
        raise InputError(
            f"got {f'an error of {bad[0]}' if bad else 'no error'}, expected one or more above 0; "
            "leave out what cannot be drawn on a logarithmic axis"
        )
    names = list(dict.fromkeys(name for each in errors.values() for name in each))
    with rc_context(RC):
        figure = Figure(figsize=(PAGE_WIDTH, 1.3 + 0.5 * len(errors)), layout="constrained")
        axes = figure.add_subplot()
        for number, name in reversed(list(enumerate(names))):
            style = style_of(name)
            rows = [(row, e[name]) for row, e in enumerate(errors.values()) if name in e]
            axes.plot(
                [value for _, value in rows],
                [row for row, _ in rows],
                linestyle="none",
                marker=style.marker or "|",
                markersize=11 if number == 0 else 7 if style.marker else 12,
                markeredgewidth=0.8 if style.marker else 2,
                markeredgecolor="white" if style.marker else style.colour,
                color=style.colour,
                label=style.label,
                zorder=10 - number,
            )
        axes.set_yticks(range(len(errors)), list(errors))
        axes.set_ylim(len(errors) - 0.5, -0.5)
        axes.set_xscale("log")
        limits = min(found) / 1.3, max(found) * 1.3
        axes.set_xlim(limits)
        plain_ticks(axes.xaxis, limits)
        axes.tick_params(axis="y", length=0)
        axes.set_xlabel(f"RMSE ({units})")
        if title:
            figure.suptitle(title, fontsize=9.5)
        handles, labels = axes.get_legend_handles_labels()
        figure.legend(handles[::-1], labels[::-1], loc="outside lower center", ncols=4)
    return figure


def by_elapsed(
    elapsed: ArrayLike,
    errors: Mapping[str, ArrayLike],
    *,
    labels: Mapping[str, str] | None = None,
    title: str = "",
    units: str = "scaled units",
    unit: str = "ms",
    highlighted: Sequence[str] = (),
) -> Figure:
    """Draws the error of each predictor by the time since the last observation.

    Args:
        elapsed: (times,) since the last observation.
        errors: per predictor (times,) RMSE.
        labels: of predictors, instead of those of their styles; written at the ends of the lines.
        title: text above.
        units: of the errors.
        unit: of the time.
        highlighted: predictors with thicker lines.

    Raises:
        InputError: there is no predictor, one with another number of errors, or an error that is
            not above 0.
    """
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    at = np.asarray(elapsed, dtype=np.float64)
    lines = {name: np.asarray(values, dtype=np.float64) for name, values in errors.items()}
    if not lines or any(values.shape != at.shape for values in lines.values()):
        got = ", ".join(f"{name}: {values.shape}" for name, values in lines.items()) or "none"
        raise InputError(
            f"got errors of shapes {got}; give {at.size} errors, one per time, for each of one or "
            "more predictors"
        )
    together = np.concatenate(list(lines.values()))
    if not (together > 0).all():
        raise InputError(
            f"got an error of {together.min()}, expected errors above 0; leave out what cannot be "
            "drawn on a logarithmic axis"
        )
    limits = float(together.min()) / 1.15, float(together.max()) * 1.15
    with rc_context(RC):
        figure = Figure(figsize=(PAGE_WIDTH, 3.9), layout="constrained")
        axes = figure.add_subplot()
        for name, values in lines.items():
            style = style_of(name)
            axes.plot(
                at,
                values,
                color=style.colour,
                linestyle=style.dash,
                marker=style.marker,
                linewidth=2.4 if name in highlighted else 1.3,
            )
        axes.set_yscale("log")
        axes.set_ylim(limits)
        plain_ticks(axes.yaxis, limits)
        axes.set_xlabel(f"Time since the last observation ({unit})")
        axes.set_ylabel(f"RMSE ({units})")
        placed = _apart([float(np.log(values[-1])) for values in lines.values()], limits)
        for (name, _), height in zip(lines.items(), placed, strict=True):
            axes.annotate(
                (labels or {}).get(name) or style_of(name).label,
                (at[-1], float(np.exp(height))),
                xytext=(7, 0),
                textcoords="offset points",
                va="center",
                color=style_of(name).colour,
                fontsize=8.5,
                annotation_clip=False,
            )
        if title:
            figure.suptitle(title, fontsize=9.5)
    return figure


def _apart(heights: list[float], limits: tuple[float, float]) -> list[float]:
    """Heights of labels, moved so that none covers another."""
    least = 0.06 * float(np.log(limits[1] / limits[0]))
    placed = np.array(heights)
    order = np.argsort(placed)
    for _ in range(50):
        for low, high in pairwise(order):
            overlap = least - (placed[high] - placed[low])
            if overlap > 0:
                placed[low] -= overlap / 2
                placed[high] += overlap / 2
    return [float(height) for height in placed]
