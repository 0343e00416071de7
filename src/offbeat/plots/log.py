"""A figure of a log: when each channel was measured, and the time between rows."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from offbeat.data.inspection import Inspection
from offbeat.data.trajectory import SECONDS_PER, Dataset
from offbeat.errors import printable
from offbeat.plots.style import RC

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_WIDTH = 7.0  # inches, two columns of a journal
_BINS = 1400
_MOST_LANES = 40
_USUAL = 1.5  # a time between values is a gap above this many median ones
_MARKED, _MOST_MARKS = 3.0, 50  # the longest gaps above this many median ones are marked
_MEASURED, _REPEATED, _GAP = "#0072B2", "#E69F00", "#D55E00"


@dataclass(frozen=True)
class _Lane:
    """Channels that are always measured together, drawn as one."""

    channels: tuple[int, ...]
    repeated: bool


def log(dataset: Dataset, inspection: Inspection, *, title: str = "") -> Figure:
    """Draws when each channel was measured, and the time between rows.

    Above, a lane per channel, or per group of channels that are always measured together: full
    colour where the channel reports at its rate, white where it does not report for 1.5 times
    its median step. Its 50 longest gaps of more than 3 median steps are marked, because they may be
    narrower than a pixel. Episodes are at their times on the recording's clock, with
    their outages marked, or one after the other if they have no common clock.

    Below, the longest time between two rows in each of 1400 equal intervals.

    Args:
        dataset: the inspected data set.
        inspection: of the data set.
        title: text above the panels.
    """
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    lanes = _lanes(dataset, inspection)
    more = len(lanes) - _MOST_LANES
    lanes = lanes[:_MOST_LANES]
    starts, one_clock = _starts(dataset)
    ends = starts + np.array([t.times[-1] - t.times[0] for t in dataset])
    with rc_context(RC):
        height = 0.26 * len(lanes) + 0.35
        figure = Figure(figsize=(_WIDTH, height + 1.9), layout="constrained")
        above, below = figure.subplots(2, 1, sharex=True, height_ratios=[height, 1.1])
        edges = np.linspace(0.0, max(float(ends.max()), 1e-9), _BINS + 1)
        for row, lane in enumerate(lanes):
            _draw_lane(above, row, lane, dataset, inspection, starts, edges)
        _mark_episodes(above, dataset, starts, ends, one_clock)
        above.set_ylim(len(lanes) - 0.5, -0.5)
        above.set_yticks(range(len(lanes)), [_label(lane, dataset) for lane in lanes])
        above.tick_params(axis="y", length=0)
        above.grid(visible=False)
        above.spines["left"].set_visible(False)
        if more > 0:
            above.set_title(f"{more} more are not drawn", loc="right", fontsize=8)
        _legend(figure, lanes, one_clock and len(dataset) > 1)
        _draw_steps(below, dataset, starts, edges)
        below.set_xlabel(
            "Time on the recording's clock (s)" if one_clock else "Time, episodes in a row (s)"
        )
        below.set_xlim(edges[0], edges[-1])
        if title:
            figure.suptitle(title, fontsize=9.5)
    return figure


def _lanes(dataset: Dataset, inspection: Inspection) -> list[_Lane]:
    together: dict[tuple[bytes, bool], list[int]] = {}
    for c, channel in enumerate(inspection.channels):
        mask = b"".join(np.packbits(t.known[:, c]).tobytes() for t in dataset)
        together.setdefault((mask, bool(channel.rows_per_value)), []).append(c)
    return [_Lane(tuple(channels), repeated) for (_, repeated), channels in together.items()]


def _label(lane: _Lane, dataset: Dataset) -> str:
    first = _short(dataset.names[lane.channels[0]])
    if len(lane.channels) == 1:
        return first
    if len(lane.channels) == 2:
        return f"{first}, {_short(dataset.names[lane.channels[1]])}"
    return f"{first} and {len(lane.channels) - 1} more"


def _short(name: str, most: int = 30) -> str:
    name = printable(name)
    return name if len(name) <= most else f"\N{HORIZONTAL ELLIPSIS}{name[-most + 1 :]}"


def _starts(dataset: Dataset) -> tuple[NDArray[np.float64], bool]:
    """The start of each episode on the axis, and whether all are on one clock.

    They are if their start clocks increase, and the episodes do not fill
    less than a tenth of the time that they span.
    """
    durations = np.array([t.times[-1] - t.times[0] for t in dataset])
    clocks = dataset.meta.get("clock_start", [])
    unit = SECONDS_PER[str(dataset.meta.get("time_unit", "s"))]
    if len(clocks) == len(dataset) and "labels" not in dataset.meta:
        first = clocks[0]  # exact subtraction of integers of nanoseconds
        starts = np.array([float(clock - first) * unit for clock in clocks])
        apart = (np.diff(starts) >= durations[:-1]).all()
        if apart and durations.sum() >= 0.1 * (starts[-1] + durations[-1]):
            return starts, True
    if len(dataset) == 1:
        return np.zeros(1), True
    between = 0.1 * float(np.median(durations))
    return np.concatenate([[0.0], np.cumsum(durations[:-1] + between)]), False


def _draw_lane(
    axes: Axes,
    row: int,
    lane: _Lane,
    dataset: Dataset,
    inspection: Inspection,
    starts: NDArray[np.float64],
    edges: NDArray[np.float64],
) -> None:
    channel = inspection.channels[lane.channels[0]]
    if channel.rate_hz is None:
        axes.text(
            0.5,
            row,
            "never measured",
            transform=axes.get_yaxis_transform(),
            fontsize=7.5,
            ha="center",
            va="center",
            color=_GAP,
        )
    else:
        fraction = _covered(dataset, lane.channels[0], 1 / channel.rate_hz, starts, edges)
        image = np.ones((1, _BINS, 4))
        image[0, :, :3] = _rgb(_REPEATED if lane.repeated else _MEASURED)
        image[0, :, 3] = fraction
        axes.imshow(
            image,
            extent=(edges[0], edges[-1], row + 0.36, row - 0.36),
            aspect="auto",
            interpolation="none",
        )
        gaps = _marks(dataset, lane.channels[0], 1 / channel.rate_hz, starts)
        axes.vlines(gaps, row - 0.46, row + 0.46, color=_GAP, linewidth=0.7)
    rate = "" if channel.rate_hz is None else f"{channel.rate_hz:.3g} Hz, "
    gap = "" if channel.longest_gap_s is None else f", gap {channel.longest_gap_s:.2g} s"
    axes.text(
        1.01,
        row,
        f"{rate}{100 * channel.missing:.0f} % missing{gap}",
        fontsize=7,
        transform=axes.get_yaxis_transform(),
        va="center",
    )


def _covered(
    dataset: Dataset,
    channel: int,
    step: float,
    starts: NDArray[np.float64],
    edges: NDArray[np.float64],
) -> NDArray[np.float64]:
    """(bins,) fraction of each bin in which the channel reports at its rate."""
    total = np.zeros(len(edges) - 1)
    width = edges[1] - edges[0]
    for trajectory, start in zip(dataset, starts, strict=True):
        at = trajectory.times[~np.isnan(trajectory.values[:, channel])]
        if not len(at):
            continue
        at = at - trajectory.times[0] + start
        steps = np.diff(at)
        # A value covers the time up to the next one; before a gap, one step.
        lasts = np.append(np.where(steps <= _USUAL * step, steps, np.minimum(steps, step)), 0.0)
        ends = at + lasts
        points = np.column_stack([at, ends]).ravel()
        sums = np.column_stack([np.append(0.0, np.cumsum(lasts)[:-1]), np.cumsum(lasts)]).ravel()
        total += np.diff(np.interp(edges, points, sums))
        # A single value in a bin is visible too.
        place = np.clip(np.searchsorted(edges, at, side="right") - 1, 0, len(total) - 1)
        np.maximum.at(total, place, 0.25 * width)
    fraction: NDArray[np.float64] = np.clip(total / width, 0.0, 1.0)
    return fraction


def _marks(
    dataset: Dataset, channel: int, step: float, starts: NDArray[np.float64]
) -> NDArray[np.float64]:
    """The starts of the longest gaps on the axis."""
    begins, lengths = [], []
    for trajectory, start in zip(dataset, starts, strict=True):
        at = trajectory.times[~np.isnan(trajectory.values[:, channel])]
        steps = np.diff(at)
        long = steps > _MARKED * step
        begins.append(at[:-1][long] - trajectory.times[0] + start)
        lengths.append(steps[long])
    order = np.argsort(-np.concatenate(lengths), kind="stable")[:_MOST_MARKS]
    return np.asarray(np.concatenate(begins)[order])


def _mark_episodes(
    axes: Axes,
    dataset: Dataset,
    starts: NDArray[np.float64],
    ends: NDArray[np.float64],
    one_clock: bool,
) -> None:
    for i in range(1, len(dataset)):
        if one_clock:
            axes.axvspan(ends[i - 1], starts[i], color=_GAP, alpha=0.18, linewidth=0)
        elif len(dataset) <= 60:
            axes.axvline((ends[i - 1] + starts[i]) / 2, color="#999999", linewidth=0.5)


def _draw_steps(
    axes: Axes, dataset: Dataset, starts: NDArray[np.float64], edges: NDArray[np.float64]
) -> None:
    from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

    longest = np.full(len(edges) - 1, np.nan)
    for trajectory, start in zip(dataset, starts, strict=True):
        if trajectory.rows < 2:
            continue
        at = trajectory.times - trajectory.times[0] + start
        place = np.clip(np.searchsorted(edges, at[1:], side="right") - 1, 0, len(longest) - 1)
        steps = np.diff(at)
        np.fmax.at(longest, place, steps)
    middles = (edges[1:] + edges[:-1]) / 2
    there = ~np.isnan(longest)
    axes.plot(
        middles[there],
        longest[there],
        linestyle="none",
        marker=".",
        markersize=2.2,
        color="#333333",
        rasterized=True,
    )
    if there.any():
        axes.set_yscale("log")
        axes.set_ylim(np.nanmin(longest) / 1.6, np.nanmax(longest) * 1.6)
        axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axes.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
        axes.yaxis.set_minor_formatter(NullFormatter())
    axes.set_ylabel("Longest step\nbetween rows (s)", fontsize=8)


def _legend(figure: Figure, lanes: list[_Lane], outages: bool) -> None:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    shown: list[Any] = []
    if any(not lane.repeated for lane in lanes):
        shown.append(Patch(color=_MEASURED, label="measured"))
    if any(lane.repeated for lane in lanes):
        shown.append(Patch(color=_REPEATED, label="measured, values repeated"))
    shown.append(Patch(facecolor="white", edgecolor="#999999", linewidth=0.6, label="not measured"))
    shown.append(Line2D([], [], color=_GAP, linewidth=0.9, label="a long gap begins"))
    if outages:
        shown.append(Patch(color=_GAP, alpha=0.18, label="outage, between episodes"))
    figure.legend(handles=shown, loc="outside lower center", ncols=min(len(shown), 4), fontsize=8)


def _rgb(colour: str) -> tuple[float, float, float]:
    red, green, blue = (int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5))
    return red, green, blue
