"""A figure as SVG that follows the reader's choice of a light or a dark page."""

from __future__ import annotations

import base64
import html
import io
from typing import TYPE_CHECKING

from offbeat.plots.style import RC

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Matplotlib writes colours into style attributes, in lower case. Models keep their colours.
_DARK = {
    "#ffffff": "#14171b",  # paper
    "#1a1a1a": "#e6e6e6",  # ink
    "#000000": "#e6e6e6",
    "#e4e4e4": "#333940",  # grid
    "#b8b8b8": "#5a626b",
    "#595959": "#b3b3b3",
}


def dark_style() -> str:
    """The style element that a dark page needs."""
    rules = []
    for light, dark in _DARK.items():
        rules += [
            f'[style*="{part}: {light}"]{{{part}:{dark} !important}}' for part in ("fill", "stroke")
        ]
    return f"<style>@media (prefers-color-scheme: dark){{{''.join(rules)}}}</style>"


def to_svg(figure: Figure, name: str) -> str:
    """The figure as SVG; text is drawn as paths, so that it looks the same everywhere.

    Args:
        figure: to draw.
        name: from which identifiers inside follow: the same figure gives the same bytes.
    """
    from matplotlib import rc_context

    buffer = io.BytesIO()
    with rc_context({**RC, "svg.fonttype": "path", "svg.hashsalt": name}):
        figure.savefig(buffer, format="svg", metadata={"Date": None}, dpi=200)
    text = buffer.getvalue().decode("utf-8")
    start = text.index("<svg")
    end = text.index(">", start) + 1
    return text[start:end] + dark_style() + text[end:]


def image(figure: Figure, name: str, alt: str) -> str:
    """A self-contained `img` element of the figure."""
    data = base64.b64encode(to_svg(figure, name).encode("utf-8")).decode("ascii")
    width, height = (round(96 * inches) for inches in figure.get_size_inches())
    return (
        f'<img alt="{html.escape(alt, quote=True)}" width="{width}" height="{height}" '
        f'decoding="async" src="data:image/svg+xml;base64,{data}">'
    )
