"""`offbeat demo`."""

from __future__ import annotations

from pathlib import Path

from offbeat.cli.common import say


def demo_command(out: Path = Path("runs/demo"), seed: int = 0, json: bool = False) -> None:
    """Run every step once, small: simulate, mask rows, train five models, score, plot.

    Args:
        out: folder for the table, the figures, the animations and the trained models.
        seed: of windows, masks, split, weights and batches.
        json: print the scores as JSON.
    """
    from offbeat.demo import run_demo

    result = run_demo(out, seed=seed)
    say(result.to_dict(), str(result), json)
