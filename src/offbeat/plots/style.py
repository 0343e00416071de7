"""Styles of figures: a label, a colour and a dash per model."""

from __future__ import annotations

import math
import zlib
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Style:
    """How a predictor is drawn in every figure.

    Attributes:
        label: its name in legends and captions.
        colour: hexadecimal, from a palette for colour-blind readers.
        marker: of points.
        dash: line style of matplotlib; distinguishes lines in black and white.
    """

    label: str
    colour: str
    marker: str
    dash: Any = "-"


_DOTTED: Any = (0, (1, 1.2))
_DASHED: Any = (0, (5, 1.5))
_DASH_DOT: Any = (0, (5, 1.2, 1, 1.2))

STYLES: dict[str, Style] = {
    # The palette of Okabe and Ito (2008), then, for rarer models, that of Tol (2021).
    "truth": Style("Truth", "#000000", ""),
    "last_value": Style("Last value", "#7F7F7F", "", (0, (4, 2))),
    "linear": Style("Linear", "#DDAA33", "", _DASHED),
    "pchip": Style("PCHIP", "#004488", "", _DASH_DOT),
    "constant_velocity": Style("Constant velocity", "#BB5566", "", _DOTTED),
    "damped_slope": Style("Damped slope", "#666633", "", _DOTTED),
    "ridge": Style("Ridge regression", "#225522", "", _DASH_DOT),
    "causal": Style("Filled from the past", "#33BBEE", "", _DASHED),
    "two_sided": Style("Filled from both sides", "#CC3311", ""),
    "blend": Style("Blend", "#AA3377", "o"),
    "gru": Style("GRU", "#56B4E9", "o", _DOTTED),
    "gru_d": Style("GRU-D", "#E69F00", "s", _DASH_DOT),
    "ode_rnn": Style("ODE-RNN", "#009E73", "^", _DASHED),
    "ode_gru_d": Style("ODE-GRU-D", "#0072B2", "D", (0, (6, 1.2, 1, 1.2, 1, 1.2))),
    "anchored_ode_gru_d": Style("Anchored ODE-GRU-D", "#D55E00", "o"),
    "anchored_trend": Style("Anchored trend", "#EE3377", "s"),
    "anchored_trend_large": Style("Anchored trend, large", "#0077BB", "^"),
    "anchored_large": Style("Anchored, large", "#994455", "s"),
    "rnn_decay": Style("RNN-Decay", "#AA4499", "v", _DASH_DOT),
    "rnn": Style("RNN", "#DDCC77", "P", _DOTTED),
    "lstm": Style("LSTM", "#332288", "X", _DOTTED),
    "neural_ode": Style("Neural ODE", "#882255", "*", _DASHED),
    "gru_fair": Style("Fair GRU", "#CC79A7", "o", _DOTTED),
    "gru_d_fair": Style("Fair GRU-D", "#999933", "s", _DASH_DOT),
    "gru_unfed": Style("GRU, not self-fed", "#44AA99", "o", _DOTTED),
    "gru_d_unfed": Style("GRU-D, not self-fed", "#CC6677", "s", _DASH_DOT),
}
"""Styles by id of the model, and those of `truth` and `last_value`."""

_OTHERS = ("#117733", "#661100", "#6699CC")


def style_of(name: str) -> Style:
    """The style of a predictor; for other names, one derived from the name."""
    if name in STYLES:
        return STYLES[name]
    return Style(name, _OTHERS[zlib.crc32(name.encode()) % len(_OTHERS)], "o")


COLUMN_WIDTH = 3.5
PAGE_WIDTH = 7.0
"""Widths of figures, one and two columns of a journal, inches."""

INK = "#1A1A1A"
"""Colour of text and axes."""

RC: dict[Any, Any] = {
    "text.color": INK,
    "axes.edgecolor": INK,
    "axes.labelcolor": INK,
    "xtick.color": INK,
    "ytick.color": INK,
    "font.family": "DejaVu Sans",  # included in matplotlib: the same figure on every machine
    "font.size": 9,
    "axes.labelsize": 9,
    "axes.titlesize": 9,
    "axes.linewidth": 0.7,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#E4E4E4",
    "grid.linewidth": 0.6,
    "legend.fontsize": 8.5,
    "legend.frameon": False,
    "legend.handlelength": 2.6,
    "lines.linewidth": 1.4,
    "lines.markersize": 3.6,
    "xtick.direction": "out",
    "ytick.direction": "out",
    "xtick.labelsize": 8.5,
    "ytick.labelsize": 8.5,
    "pdf.fonttype": 42,  # text stays text
    "svg.fonttype": "none",
    "text.parse_math": False,  # names of channels may hold dollar signs
}
"""Settings of matplotlib, applied only while a figure is made or saved."""


def plain_ticks(axis: Any, limits: tuple[float, float], *, times: float = 1.0) -> None:
    """Sets a few plain-number labels on a logarithmic axis, also within one decade.

    Args:
        axis: of matplotlib.
        limits: range of the axis.
        times: factor of the labels, which the name of the axis must state.
    """
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    decades = math.log10(limits[1] / limits[0])
    steps = (1.0,) if decades > 2.5 else (1.0, 2.0, 5.0) if decades > 0.7 else (1, 1.5, 2, 3, 5, 7)
    axis.set_major_locator(LogLocator(subs=steps))
    axis.set_major_formatter(
        FuncFormatter(lambda value, _: f"{times * value:.7f}".rstrip("0").rstrip("."))
    )
    axis.set_minor_formatter(NullFormatter())
