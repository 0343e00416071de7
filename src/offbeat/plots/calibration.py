"""A figure of calibration: the coverage of intervals, and their widths."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from offbeat.calibration import BAND, Calibration
from offbeat.errors import InputError
from offbeat.plots.style import PAGE_WIDTH, RC

if TYPE_CHECKING:
    from matplotlib.figure import Figure

COLOURS = (
    *("#000000", "#56B4E9", "#0072B2", "#F0E442", "#E69F00"),
    *("#D55E00", "#CC79A7", "#009E73", "#FFFFFF", "#7F7F7F"),
)
"""Of tasks in their order: the palette of Okabe and Ito (2008), white and grey."""

MARKERS = "osD^vP*XoD"


def calibration_figure(tasks: Mapping[str, Calibration], *, title: str = "") -> Figure:
    """Draws the coverage of intervals against what was asked for, and their widths over time.

    On the diagonal of the left panel, intervals hold as many values as they say. Below it they are
    too narrow, above it too wide. The right panel has the mean width of intervals of 90 %, in units
    of the scale of each channel, by the time since the channel was observed.

    Args:
        tasks: calibration by the name of the task.
        title: text above the panels.

    Raises:
        InputError: there is no task.
    """
    from matplotlib import rc_context
    from matplotlib.figure import Figure
    from matplotlib.ticker import StrMethodFormatter

    if not tasks:
        raise InputError(
            "got no task with intervals to draw; those of a blend have them (offbeat train)"
        )
    with rc_context(RC):
        figure = Figure(figsize=(PAGE_WIDTH, 3.9), layout="constrained")
        left, right = figure.subplots(1, 2)
        left.plot([0, 100], [0, 100], color="#7F7F7F", linestyle=(0, (4, 2)), linewidth=1, zorder=1)
        for i, (name, found) in enumerate(tasks.items()):
            colour = COLOURS[i % len(COLOURS)]
            look: dict[str, Any] = {
                "color": "#1A1A1A" if colour == "#FFFFFF" else colour,
                "markerfacecolor": colour,
                "clip_on": False,
                "marker": MARKERS[i % len(MARKERS)],
                "linewidth": 1.1,
                "markersize": 4.5,
                "markeredgecolor": "#1A1A1A",
                "markeredgewidth": 0.4,
            }
            left.plot(
                [100 * level for level in found.levels],
                [100 * share for share in found.coverage],
                label=name,
                **look,
            )
            aged = [each for each in found.by_age if each.width > 0]
            right.plot([a.up_to_s for a in aged], [a.width for a in aged], **look)
        left.set(xlim=(0, 100), ylim=(0, 100), aspect="equal")
        left.set_xlabel("Asked: level of the interval (%)")
        left.set_ylabel("Got: values within it (%)")
        right.set(xscale="log", yscale="log")
        for axis in (right.xaxis, right.yaxis):
            axis.set_major_formatter(StrMethodFormatter("{x:g}"))
        right.set_xlabel("Time since observation, up to (s)")
        right.set_ylabel(f"Mean width of {100 * BAND:.0f} % intervals (scaled)")
        if title:
            figure.suptitle(title, fontsize=9.5)
        figure.legend(loc="outside lower center", ncols=4)
    return figure
