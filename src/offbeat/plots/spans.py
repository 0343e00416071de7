"""A figure of what was hidden or lay ahead, with the answers, their bands and the truth."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from offbeat.answers.answer import Answer
from offbeat.data.trajectory import Trajectory
from offbeat.errors import InputError, one_of
from offbeat.plots.style import PAGE_WIDTH, RC, STYLES, style_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_SHADE = "#F0F0F0"
_LEVEL = 0.9


@dataclass(frozen=True, eq=False)
class Span:
    """A stretch of time in which channels were not seen.

    Attributes:
        title: what is asked, above the panels.
        truth: values that are not observed are known in it.
        start: s, of the stretch.
        stop: s, its end.
        answer: of the stretch; with intervals, it has a band.
        others: predictors to compare with, by name, on times of their own.
        margin_s: s, drawn before and, of a fill, after the stretch.
    """

    title: str
    truth: Trajectory
    start: float
    stop: float
    answer: Trajectory
    others: Mapping[str, Trajectory] = field(default_factory=dict)
    margin_s: float = 0.5


def spans(
    columns: Sequence[Span],
    channels: Sequence[Sequence[str]],
    *,
    title: str = "",
    name: str = "blend",
) -> Figure:
    """Draws a column per stretch, and in it a panel per channel.

    Args:
        columns: what was asked.
        channels: names per column, as many in each.
        title: text above the panels.
        name: of the predictor, for its colour and its label.

    Raises:
        InputError: there is no stretch or no channel, or a channel that a trajectory lacks.
    """
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    if not columns or len(columns) != len(channels) or len({len(c) for c in channels}) != 1:
        counts = [len(names) for names in channels]
        raise InputError(
            f"got {len(columns)} columns and channels for {len(channels)} of them, {counts} each; "
            "give a column or more, and the same number of channels for each"
        )
    for column, names in zip(columns, channels, strict=True):
        for channel in names:
            for trajectory in (column.truth, column.answer, *column.others.values()):
                one_of("channel", channel, trajectory.names)
    rows = len(channels[0])
    with rc_context(RC):
        figure = Figure(figsize=(PAGE_WIDTH, 0.9 + 1.5 * rows), layout="constrained")
        panels = figure.subplots(rows, len(columns), sharex="col", squeeze=False)
        for at, (column, names) in enumerate(zip(columns, channels, strict=True)):
            for axes, channel in zip(panels[:, at], names, strict=True):
                _draw(axes, column, channel, name)
            panels[0, at].set_title(column.title, loc="left")
            panels[-1, at].set_xlabel("Time (s)")
        figure.align_ylabels(panels)
        if title:
            figure.suptitle(title, fontsize=9.5)
        shown: dict[str, Any] = {}
        for axes in panels.flat:
            for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
                shown.setdefault(label, handle)
        figure.legend([*shown.values()], [*shown], loc="outside lower center", ncols=4)
    return figure


def _draw(axes: Axes, span: Span, channel: str, name: str) -> None:
    at = span.truth.names.index(channel)
    times, values = span.truth.times, span.truth.values[:, at]
    known = np.isfinite(values)
    first = max(span.start - span.margin_s, float(times[0]))
    last = min(span.stop + span.margin_s, float(times[-1]))
    drawn = [values[known & (times >= first) & (times <= last)]]
    ink = STYLES["truth"].colour
    axes.axvspan(span.start, span.stop, color=_SHADE, linewidth=0, zorder=0)
    inside = known & (times >= span.start) & (times <= span.stop)
    seen = known & span.truth.observed[:, at] & (times >= first) & (times <= last)
    axes.plot(times[inside], values[inside], ".", color="#8A8A8A", markersize=2.4, label="Not seen")
    axes.plot(times[seen], values[seen], ".", color=ink, markersize=2.4, label="Measured")
    for other, trajectory in span.others.items():
        style = style_of(other)
        own, at_other = trajectory.times, trajectory.names.index(channel)
        within = (own >= span.start) & (own <= span.stop)
        line = trajectory.values[within, at_other]
        drawn.append(line)
        axes.plot(own[within], line, color=style.colour, linestyle=style.dash, label=style.label)
    own, at_own, style = span.answer.times, span.answer.names.index(channel), style_of(name)
    within = (own >= span.start) & (own <= span.stop) & ~span.answer.observed[:, at_own]
    if isinstance(span.answer, Answer) and span.answer.widths is not None:
        low, high = (end[within, at_own] for end in span.answer.interval(_LEVEL))
        drawn += [low, high]
        axes.fill_between(
            own[within],
            low,
            high,
            color=style.colour,
            alpha=0.2,
            linewidth=0,
            label=f"{100 * _LEVEL:.0f} % interval",
        )
    line = span.answer.values[within, at_own]
    drawn.append(line)
    axes.plot(own[within], line, color=style.colour, linewidth=1.8, label=style.label, zorder=4)
    unit = span.truth.units[at]
    words = channel.replace("_", " ")
    axes.set_ylabel(f"{words}\n({unit})" if unit else words)
    axes.set_xlim(first, last)
    together = np.concatenate(drawn)
    together = together[np.isfinite(together)]
    if len(together):
        margin = 0.1 * float(np.ptp(together)) or 1.0
        axes.set_ylim(together.min() - margin, together.max() + margin)
