"""`offbeat demo`."""

from __future__ import annotations

from pathlib import Path

from offbeat.cli.common import say


def demo_command(out: Path = Path("runs/demo"), seed: int = 0, json: bool = False) -> None:
    """Run everything once, small: simulate, hide rows, train five models, score, draw.

    Args:
        out: folder for the table, the figures, the animation and the trained models.
        seed: of windows, hidden rows, split, weights and batches.
        json: print the scores as JSON.
    """
    from offbeat.demo import run_demo

    result = run_demo(out, seed=seed)
    say(result.to_dict(), str(result), json)
