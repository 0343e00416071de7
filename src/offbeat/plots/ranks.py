"""The critical-difference diagram: average ranks of models, and groups that do not differ."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from offbeat.comparison.statistics.ranks import FriedmanResult
from offbeat.errors import InputError
from offbeat.plots.style import RC, style_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_WIDTH = 7.0  # inches, two columns of a journal
_LINE, _BAR = 0.21, 0.11  # inches, between labels and between bars
_ABOVE, _TITLE, _BELOW = 0.62, 0.22, 0.2  # inches, for the critical difference, title, note
_LETTER = 0.078  # inches, about the width of one
_INK, _GREY = "#1A1A1A", "#7F7F7F"


def ranks_figure(results: FriedmanResult | Mapping[str, FriedmanResult]) -> Figure:
    """Draws average ranks on a line, the best at the left, one panel per result.

    Demsar (2006), figure 1. A grey bar joins models that do not differ significantly by Nemenyi's
    test; the bar at the top shows the critical difference.

    Args:
        results: of `friedman`, one or several by title.

    Raises:
        InputError: there is nothing to draw.
    """
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    panels = {"": results} if isinstance(results, FriedmanResult) else dict(results)
    if not panels:
        raise InputError(
            "a diagram of ranks needs at least one result of Friedman's test, got none"
        )
    heights = [_height(result) + _TITLE * bool(title) for title, result in panels.items()]
    halves = [_halves(result) for result in panels.values()]
    ends = (max(_room(h[0]) for h in halves), _WIDTH - max(_room(h[1]) for h in halves))
    with rc_context(RC):
        figure = Figure(figsize=(_WIDTH, sum(heights)))
        top = sum(heights)
        for (title, result), height in zip(panels.items(), heights, strict=True):
            top -= height
            axes = figure.add_axes((0.0, top / sum(heights), 1.0, height / sum(heights)))
            _panel(axes, title, result, height, ends)
    return figure


def _height(result: FriedmanResult) -> float:
    rows = (len(result.names) + 1) // 2
    return _ABOVE + _BAR * len(result.groups) + _LINE * (rows + 0.5) + _BELOW


def _panel(
    axes: Axes, title: str, result: FriedmanResult, height: float, ends: tuple[float, float]
) -> None:
    """Draws in inches: the origin is the lower left corner of the panel."""
    axes.set_xlim(0, _WIDTH)
    axes.set_ylim(0, height)
    axes.axis("off")
    models, ranks = len(result.names), result.ranks
    names, half = list(ranks), len(_halves(result)[0])
    left, right = ends
    line = height - _ABOVE - _TITLE * bool(title)

    def x(rank: float) -> float:
        return left + (rank - 1) / (models - 1) * (right - left)

    axes.plot((left, right), (line, line), color=_INK, linewidth=0.9, solid_capstyle="butt")
    for rank in range(1, models + 1):
        axes.plot((x(rank), x(rank)), (line, line + 0.06), color=_INK, linewidth=0.9)
        axes.text(x(rank), line + 0.09, str(rank), ha="center", va="bottom", color=_INK)
    # The bar is as long as the critical difference; the axis is at least as long.
    bar = (left, min(x(1 + result.critical_difference), right))
    axes.plot(bar, (line + 0.34,) * 2, color=_INK, linewidth=1.4, marker="|", label="_difference")
    axes.text(
        (bar[0] + bar[1]) / 2,
        line + 0.38,
        f"CD = {result.critical_difference:.2f}",
        ha="center",
        va="bottom",
        color=_INK,
        fontsize=8,
    )
    axes.text(0.12, height - 0.06, title, ha="left", va="top", color=_INK)
    what = f"Mean rank over {result.blocks} repeats (1 is best)"
    axes.text((left + right) / 2, 0.06, what, ha="center", va="bottom", color=_GREY, fontsize=8)
    for i, group in enumerate(result.groups):
        y = line - _BAR * (i + 1)
        span = [x(ranks[group[0]]) - 0.04, x(ranks[group[-1]]) + 0.04]
        axes.plot(span, (y, y), color=_GREY, linewidth=3.2, solid_capstyle="butt", label="_group")
    first = line - _BAR * len(result.groups) - _LINE
    for place, name in enumerate(names):
        at_left = place < half
        row = place if at_left else models - 1 - place
        y, style = first - _LINE * row, style_of(name)
        end = left - 0.12 if at_left else right + 0.12
        axes.plot(
            (x(ranks[name]), x(ranks[name]), end), (line, y, y), color=style.colour, linewidth=1.2
        )
        axes.plot(
            x(ranks[name]),
            line,
            linestyle="none",
            marker=style.marker or "o",
            markersize=5,
            color=style.colour,
            label=name,
            zorder=4,
        )
        parts = [style.label, f"{ranks[name]:.2f}"]
        axes.text(
            end + (-0.05 if at_left else 0.05),
            y,
            "  ".join(parts if at_left else parts[::-1]),
            ha="right" if at_left else "left",
            va="center",
            color=_INK,
        )


def _halves(result: FriedmanResult) -> tuple[list[str], list[str]]:
    """Labels at the left and at the right, each from the best to the worst."""
    labels = [style_of(name).label for name in result.ranks]
    half = (len(labels) + 1) // 2
    return labels[:half], labels[half:]


def _room(labels: list[str]) -> float:
    """Width of the labels in inches."""
    return min(max(1.1, 0.75 + _LETTER * max(map(len, labels))), 2.9)
