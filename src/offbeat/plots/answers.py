"""A figure of fills and forecasts with observed and masked values."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from offbeat.answers.answer import Answer
from offbeat.data.masking import masked_values
from offbeat.data.trajectory import Trajectory
from offbeat.plots.figures import channel_panels
from offbeat.plots.style import STYLES, style_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

LONGEST_LABEL = 24
"""Characters of a channel's name and unit that fit beside a panel; longer ones go above it."""


def answers(
    truth: Trajectory,
    answered: Mapping[str, Trajectory],
    channels: Sequence[str],
    *,
    title: str = "",
) -> Figure:
    """Draws channels over time: observed values, masked values, and the predictions of both.

    A predictor is drawn where its `observed` is False; its values where something was measured
    are not drawn. Lines break at observed values. Answers with intervals have a band of 90 %.

    Args:
        truth: observed values are black, known and masked values are hollow.
        answered: per predictor, a trajectory on the same clock.
        channels: names of the channels to draw, one panel each.
        title: text above the panels.

    Raises:
        InputError: no channel is given, or one that a trajectory lacks.
    """
    return channel_panels(_channel, truth, answered, channels, title=title, height=1.6)


def _channel(axes: Axes, truth: Trajectory, answered: Mapping[str, Trajectory], name: str) -> None:
    channel = truth.names.index(name)
    masked = masked_values(truth)[:, channel]
    seen = truth.observed[:, channel]
    drawn = [truth.values[seen | masked, channel]]
    black = STYLES["truth"].colour
    for model, trajectory in answered.items():
        at, style = trajectory.names.index(name), style_of(model)
        times, values = _with_ends(trajectory, at, truth, channel)
        drawn.append(trajectory.values[~trajectory.observed[:, at], at])
        if isinstance(trajectory, Answer) and trajectory.widths is not None:
            low, high = (end[:, at] for end in trajectory.interval(0.9))
            hidden = ~trajectory.observed[:, at]
            drawn += [low[hidden], high[hidden]]
            axes.fill_between(
                trajectory.times,
                np.where(hidden, low, np.nan),
                np.where(hidden, high, np.nan),
                color=style.colour,
                alpha=0.18,
                linewidth=0,
                zorder=1,
            )
        axes.plot(
            times,
            values,
            color=style.colour,
            linestyle=style.dash,
            linewidth=1.2,
            marker="." if trajectory.rows == 1 else "",
            label=style.label,
            zorder=3,
        )
    if masked.any():
        axes.plot(
            truth.times[masked],
            truth.values[masked, channel],
            linestyle="none",
            marker="o",
            markersize=3.4,
            markerfacecolor="white",
            markeredgecolor="#7F7F7F",
            markeredgewidth=0.8,
            label="Masked truth",
            zorder=2,
        )
    axes.plot(
        truth.times[seen],
        truth.values[seen, channel],
        linestyle="none",
        marker="o",
        markersize=2.6,
        color=black,
        label="Observed",
        zorder=4,
    )
    unit = truth.units[channel]
    label = f"{name} ({unit})" if unit else name
    if len(label) <= LONGEST_LABEL:
        axes.set_ylabel(label)
    else:  # such as a field of a topic, which does not fit along the axis
        axes.set_title(label, loc="left", fontsize=8.5)
    axes.margins(x=0.01)
    together = np.concatenate(drawn)
    together = together[np.isfinite(together)]
    if len(together):
        margin = 0.08 * float(np.ptp(together)) or 1.0
        axes.set_ylim(together.min() - margin, together.max() + margin)


def _with_ends(
    trajectory: Trajectory, at: int, truth: Trajectory, channel: int
) -> tuple[np.ndarray, np.ndarray]:
    """The line of a predictor: its values, joined to the observed values next to them."""
    times, values = trajectory.times, trajectory.values[:, at].copy()
    filled = ~trajectory.observed[:, at]
    beside = np.zeros(len(filled), dtype=bool)
    beside[1:] |= filled[:-1]
    beside[:-1] |= filled[1:]
    values[~(filled | beside)] = np.nan
    seen = np.flatnonzero(truth.observed[:, channel])
    if filled.all() and len(seen) and times[0] > truth.times[seen[-1]]:  # a forecast
        last = seen[-1]
        times = np.concatenate([truth.times[last : last + 1], times])
        values = np.concatenate([truth.values[last : last + 1, channel], values])
    return times, values
