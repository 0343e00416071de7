"""Figures of journal size, without the global state of pyplot."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, Protocol

import numpy as np

from offbeat.data.trajectory import Trajectory
from offbeat.errors import InputError, one_of, printable
from offbeat.files import atomic_path
from offbeat.plots.style import RC, STYLES, style_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_WIDTH = 7.0  # inches, two columns of a journal
_METADATA = {".png": {"Software": None}, ".pdf": {"CreationDate": None}, ".svg": {"Date": None}}


class LoggedEpoch(Protocol):
    """The fields of a training log's row that a figure reads."""

    @property
    def epoch(self) -> int:
        """Counted from 1."""

    @property
    def steps(self) -> int:
        """Optimizer steps so far."""

    @property
    def validation_mse(self) -> float:
        """Validation error in scaled units."""


def learning_curves(
    histories: Mapping[str, Sequence[LoggedEpoch]],
    *,
    last_value_rmse: float | None = None,
    x: Literal["epochs", "steps"] = "epochs",
    units: str = "scaled units",
) -> Figure:
    """Draws the validation error of each model while it trains, on a logarithmic axis.

    Args:
        histories: per model its training log, one entry per epoch.
        last_value_rmse: RMSE of the last-value predictor on the same validation part,
            drawn as a dashed horizontal line.
        x: count `epochs` or optimizer `steps`.
        units: of the error, for the label of the axis.

    Raises:
        InputError: there is no model, or a log is empty.
    """
    from matplotlib import rc_context
    from matplotlib.figure import Figure
    from matplotlib.ticker import LogLocator, MaxNLocator, NullFormatter, StrMethodFormatter

    one_of("x axis", x, ("epochs", "steps"))
    empty = [name for name, history in histories.items() if not history]
    if empty or not histories:
        what = f"the log of {empty[0]!r} is empty" if empty else "got no training logs"
        raise InputError(f"learning curves need at least one epoch per model; {what}")
    with rc_context(RC):
        figure = Figure(figsize=(_WIDTH, 3.6), layout="constrained")
        axes = figure.add_subplot()
        # Sorted by final value, as in the table.
        for name in sorted(histories, key=lambda n: histories[n][-1].validation_mse):
            history, style = histories[name], style_of(name)
            axes.plot(
                [entry.epoch if x == "epochs" else entry.steps for entry in history],
                [entry.validation_mse**0.5 for entry in history],
                color=style.colour,
                linestyle=style.dash,
                marker=style.marker,
                label=style.label,
            )
        if last_value_rmse is not None:
            style = style_of("last_value")
            axes.axhline(
                last_value_rmse, color=style.colour, linestyle=style.dash, label=style.label
            )
        axes.set_yscale("log")
        axes.set_xlim(left=0)
        axes.set_xlabel("Epoch" if x == "epochs" else "Optimizer steps")
        axes.set_ylabel(f"Validation RMSE ({units})")
        axes.xaxis.set_major_locator(MaxNLocator("auto", integer=True, steps=[1, 2, 5, 10]))
        # Errors seldom span a decade: label 1, 2, 3 and 5 of each.
        axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 3.0, 5.0)))
        axes.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
        axes.yaxis.set_minor_formatter(NullFormatter())
        figure.legend(loc="outside right upper")
    return figure


def predictions(
    truth: Trajectory,
    predictions: Mapping[str, Trajectory],
    channels: Sequence[str],
    *,
    title: str = "",
) -> Figure:
    """Draws channels over time: the truth, its observed values, and predictions of models.

    A panel shows the full range of the truth and of the predictions after the channel's first
    observation; earlier predictions may be outside.

    Args:
        truth: with its observed values marked.
        predictions: per model, a trajectory of the same channels on the same clock.
        channels: names of the channels to draw, one panel each.
        title: text above the panels.

    Raises:
        InputError: no channel is given, or one that a trajectory lacks.
    """
    return channel_panels(_channel, truth, predictions, channels, title=title, height=1.45)


def channel_panels(
    draw: Callable[[Axes, Trajectory, Mapping[str, Trajectory], str], None],
    truth: Trajectory,
    predicted: Mapping[str, Trajectory],
    channels: Sequence[str],
    *,
    title: str,
    height: float,
) -> Figure:
    """Draws a panel per channel, with one legend.

    Args:
        draw: draws a channel, by its name, into the axes of its panel.
        truth: passed to `draw`.
        predicted: passed to `draw`.
        channels: names of the channels to draw.
        title: text above the panels.
        height: of a panel, in inches.

    Raises:
        InputError: no channel is given, or one that a trajectory lacks.
    """
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    if not channels:
        raise InputError(f"name at least one channel to draw, of: {', '.join(truth.names)}")
    for trajectory in (truth, *predicted.values()):
        for name in channels:
            one_of("channel", name, trajectory.names)
    with rc_context(RC):
        figure = Figure(figsize=(_WIDTH, 0.9 + height * len(channels)), layout="constrained")
        panels = figure.subplots(len(channels), sharex=True, squeeze=False)[:, 0]
        for axes, name in zip(panels, channels, strict=True):
            draw(axes, truth, predicted, name)
        panels[-1].set_xlabel("Time (s)")
        figure.align_ylabels(panels)
        if title:
            figure.suptitle(title, fontsize=9.5)
        shown: dict[str, Any] = {}  # a panel may lack what another one has
        for axes in panels:
            for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
                shown.setdefault(label, handle)
        figure.legend([*shown.values()], [*shown], loc="outside lower center", ncols=4)
    return figure


def _channel(
    axes: Axes, truth: Trajectory, predictions: Mapping[str, Trajectory], name: str
) -> None:
    channel = truth.names.index(name)
    observed = truth.observed[:, channel]
    first_seen = truth.times[observed][0] if observed.any() else -np.inf
    counted = [truth.values[:, channel]]
    black = STYLES["truth"]
    axes.plot(
        truth.times, truth.values[:, channel], color=black.colour, linewidth=1.8, label=black.label
    )
    for model, predicted in predictions.items():
        style = style_of(model)
        values = predicted.values[:, predicted.names.index(name)]
        counted.append(values[predicted.times > first_seen])
        axes.plot(
            predicted.times,
            values,
            color=style.colour,
            linestyle=style.dash,
            linewidth=1.1,
            label=style.label,
        )
    axes.plot(
        truth.times[observed],
        truth.values[observed, channel],
        linestyle="none",
        marker="o",
        markersize=4,
        markerfacecolor="white",
        markeredgecolor=black.colour,
        markeredgewidth=0.9,
        label="Observed",
        zorder=4,
    )
    unit = truth.units[channel]
    axes.set_ylabel(f"{name} ({unit})" if unit else name)
    axes.margins(x=0.01)
    together = np.concatenate(counted)
    if not np.isnan(together).all():
        low, high = np.nanmin(together), np.nanmax(together)
        margin = 0.08 * (high - low) or 1.0
        axes.set_ylim(low - margin, high + margin)


def save(figure: Figure, path: str | Path) -> Path:
    """Writes a figure atomically, in the format of the suffix of `path`.

    The same figure gives the same bytes; no dates are written.

    Args:
        figure: to write.
        path: ends in `.png` (200 dots per inch), `.pdf` or `.svg`.

    Raises:
        InputError: another suffix.
    """
    from matplotlib import rc_context
    from matplotlib.text import Text

    path = Path(path)
    suffix = one_of("suffix of a figure", path.suffix.lower(), _METADATA)
    for text in figure.findobj(Text):  # names in files may hold any character
        if not text.get_text().isprintable():
            text.set_text(printable(text.get_text()))
    with rc_context(RC), atomic_path(path) as temporary:
        figure.savefig(temporary, format=suffix[1:], dpi=200, metadata=_METADATA[suffix])
    return path
