"""The learning curves of `docs/robots.md`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from matplotlib import rc_context
from matplotlib.figure import Figure

from offbeat.plots.figures import save
from offbeat.plots.style import INK, PAGE_WIDTH, RC, plain_ticks

from .models import ABLATIONS, PLANS

LINES = {"ridge": "ridge", "residual_gru": "residual GRU"}
"""Baselines whose test error is drawn as a line."""

_COLOURS = ("#000000", "#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#882255")
_DASHES: tuple[Any, ...] = ("-", (0, (5, 1.5)), (0, (1, 1.2)), (0, (5, 1.2, 1, 1.2)))


def draw(found: dict[str, Any], path: Path) -> bool:
    """Draws validation errors at 30 % by epoch: of long trainings, and of ablations of 40 epochs.

    Args:
        found: from `report.read`.
        path: of the figure.

    Returns:
        Whether there was anything to draw.
    """
    own = found["own"]
    changed = (*ABLATIONS[40][1:], *ABLATIONS[10])
    longer = [name for name in ABLATIONS[40] if name in own]
    parts = [
        ("the large model", (0.006, 0.03), [n for n in PLANS if n in own and n not in changed]),
        ("changed in one thing", (0.005, 0.03), longer if len(longer) > 1 else []),
    ]
    parts = [part for part in parts if part[2]]
    if not parts:
        return False
    with rc_context(RC):
        figure = Figure(figsize=(PAGE_WIDTH, 3.4), layout="constrained")
        panels = figure.subplots(1, len(parts), squeeze=False)[0]
        for panel, (title, limits, names) in zip(panels, parts, strict=True):
            _panel(panel, title, limits, names, own)
        panels[0].set_ylabel("validation RMSE, 30 % observed")
    path.parent.mkdir(parents=True, exist_ok=True)
    save(figure, path)
    return True


def _panel(
    panel: Any, title: str, limits: tuple[float, float], names: list[str], own: dict[str, Any]
) -> None:
    for i, name in enumerate(names):
        for k, run in enumerate(own[name]):
            curve = run["curve"]
            panel.plot(
                range(1, len(curve) + 1),
                curve,
                color=_COLOURS[i % len(_COLOURS)],
                dashes=(None, None) if not i % len(_DASHES) else _DASHES[i % len(_DASHES)][1],
                linewidth=1.4 if not k else 0.8,
                label=None if k else PLANS[name].title.removeprefix("anchored, "),
            )
    panel.set(title=title, xlabel="epoch", yscale="log", ylim=limits, xlim=(0, None))
    plain_ticks(panel.yaxis, limits)
    for name, label in LINES.items():
        runs = own.get(name, [])
        score = runs[0]["scores"].get("0.3") if runs else None
        if score:
            panel.axhline(score["rmse"], color="#7F7F7F", linewidth=0.8, zorder=0)
            where = {"transform": panel.get_yaxis_transform(), "fontsize": 7.5, "color": INK}
            up = "bottom" if name == "ridge" else "top"
            panel.text(0.99, score["rmse"], label, ha="right", va=up, **where)
    panel.legend(loc="lower left", fontsize=7)
