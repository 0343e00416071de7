"""What the data looks like: frames of the robot (figure 3.1) and two channels (figure 3.2)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from offbeat import InputError
from offbeat.errors import one_of
from offbeat.plots.animation import stills
from offbeat.plots.style import PAGE_WIDTH, RC
from thesis.illustrations import Illustrations

if TYPE_CHECKING:
    from matplotlib.figure import Figure

CHANNELS = {"rootz_qpos": "Height of the torso", "knee_qpos": "Angle of the knee"}
"""Channels of figure 3.2, and what they are."""


def frames_figure(illustrations: Illustrations, *, trajectory: int = 0, frames: int = 8) -> Figure:
    """The simulated robot at even times along one recording; the camera follows the torso.

    Args:
        illustrations: hold the recording.
        trajectory: which one.
        frames: how many.

    Raises:
        MissingExtraError: mujoco is not installed, or nothing can render here.
    """
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    values = illustrations.recordings[trajectory]
    rows = np.linspace(0, len(values) - 1, frames).round().astype(int)
    positions = [i for i, name in enumerate(illustrations.names) if name.endswith("_qpos")]
    pictures = stills(illustrations.robot, values[rows][:, positions])
    columns = -(-frames // 2)
    with rc_context(RC):
        figure = Figure(figsize=(PAGE_WIDTH, 3.4), layout="constrained")
        panels = figure.subplots(2, columns, squeeze=False).ravel()
        for axes in panels:
            axes.set_axis_off()
        for axes, row, picture in zip(panels, rows, pictures, strict=False):
            axes.imshow(picture)
            axes.set_title(f"t = {1e3 * illustrations.times[row]:.0f} ms")
    return figure


def channels_figure(
    illustrations: Illustrations, channels: Sequence[str] = tuple(CHANNELS)
) -> Figure:
    """Two channels over time, a line per recording.

    Args:
        illustrations: hold the recordings.
        channels: names of two of its channels.

    Raises:
        InputError: not two channels, or one that the recordings lack.
    """
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    if len(channels) != 2:
        raise InputError(f"figure 3.2 shows 2 channels, got {len(channels)}")
    with rc_context(RC):
        figure = Figure(figsize=(PAGE_WIDTH, 2.5), layout="constrained")
        for axes, name in zip(figure.subplots(1, 2), channels, strict=True):
            channel = illustrations.names.index(one_of("channel", name, illustrations.names))
            recordings = illustrations.recordings[:, :, channel]
            shades = _shades(len(recordings))
            for values, shade in zip(recordings, shades, strict=True):
                axes.plot(illustrations.times, values, color=shade, linewidth=1.0)
            unit = illustrations.units[channel]
            shown = CHANNELS.get(name, name)
            axes.set_ylabel(f"{shown} ({unit})" if unit else shown)
            axes.set_xlabel("Time (s)")
            axes.margins(x=0.01)
    return figure


def _shades(count: int) -> list[tuple[float, ...]]:
    """Steps of one map that is safe for the colour-blind: trajectories have no names."""
    from matplotlib import colormaps

    return [tuple(colormaps["viridis"](x)) for x in np.linspace(0.0, 0.9, count)]
