"""Hidden states: over time, per model (figure 2.5), and laid out in a plane."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from offbeat import InputError
from offbeat.plots.style import INK, PAGE_WIDTH, RC, style_of
from thesis.illustrations import StateMap, Trace
from thesis.report.figure_robot import CHANNELS

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_UNITS_SHOWN = 5
"""Hidden units drawn per model: those that move most."""

_SEEN = "#B8B8B8"


def states_figure(trace: Trace) -> Figure:
    """Hidden units of each model along one trajectory, with a line where a row was observed.

    A state is drawn on arrival at a row and after it, so that an update is a vertical step.

    Args:
        trace: of at least one model.

    Raises:
        InputError: there is no model.
    """
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    if not trace.after:
        raise InputError("hidden states need at least one model; got none")
    models = list(trace.after)
    columns = 2 if len(models) > 1 else 1
    lines = -(-len(models) // columns)
    with rc_context(RC):
        figure = Figure(figsize=(PAGE_WIDTH, 0.7 + 1.55 * lines), layout="constrained")
        panels = figure.subplots(lines, columns, sharex=True, squeeze=False).ravel()
        for axes, model in zip(panels, models, strict=False):
            before, after = trace.before[model], trace.after[model]
            times = np.repeat(trace.times, 2)
            path = np.stack([before, after], axis=1).reshape(len(times), -1)
            moved = np.argsort(-np.ptp(after, axis=0), kind="stable")[:_UNITS_SHOWN]
            for seen in trace.times[trace.observed]:
                axes.axvline(seen, color=_SEEN, linewidth=0.6, zorder=0)
            for shade, unit in zip(np.linspace(1.0, 0.5, len(moved)), moved, strict=True):
                axes.plot(
                    times, path[:, unit], color=style_of(model).colour, alpha=shade, linewidth=1.0
                )
            axes.set_title(style_of(model).label, loc="left")
            axes.grid(False)
            axes.margins(x=0.01)
        for axes in panels[len(models) :]:
            axes.set_visible(False)
        for axes in panels[max(0, len(models) - columns) : len(models)]:
            axes.tick_params(labelbottom=True)
        size = RC["axes.labelsize"]
        figure.supxlabel("Time (s)", fontsize=size)
        figure.supylabel("Hidden units (without unit)", fontsize=size)
    return figure


def map_figure(state_map: StateMap) -> Figure:
    """Hidden states of each model in a plane, coloured by a channel of the robot.

    Args:
        state_map: of at least one model.

    Raises:
        InputError: there is no model.
    """
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    if not state_map.places:
        raise InputError("a map of hidden states needs at least one model; got none")
    models = list(state_map.places)
    columns = min(len(models), 4 if len(models) > 6 else 3)
    lines = -(-len(models) // columns)
    side = PAGE_WIDTH / columns
    with rc_context(RC):
        figure = Figure(figsize=(PAGE_WIDTH, 0.6 + lines * (side * 0.9)), layout="constrained")
        panels = figure.subplots(lines, columns, squeeze=False).ravel()
        drawn = None
        for axes, model in zip(panels, models, strict=False):
            x, y = state_map.places[model].T
            drawn = axes.scatter(
                x, y, c=state_map.colour, cmap="cividis", s=2.0, linewidths=0, rasterized=True
            )
            axes.set_title(style_of(model).label, loc="left")
            axes.set(xticks=[], yticks=[])
            axes.grid(False)
            for spine in axes.spines.values():
                spine.set_visible(False)
        for axes in panels[len(models) :]:
            axes.set_visible(False)
        for axes in panels[max(0, len(models) - columns) : len(models)]:
            axes.set_xlabel("UMAP 1")
        for axes in panels[::columns]:
            axes.set_ylabel("UMAP 2")
        unit = f" ({state_map.unit})" if state_map.unit else ""
        if drawn is not None:
            bar = figure.colorbar(drawn, ax=panels.tolist(), shrink=0.7, aspect=30, pad=0.02)
            bar.set_label(f"{CHANNELS.get(state_map.name, state_map.name)}{unit}", color=INK)
            bar.outline.set_visible(False)
    return figure
