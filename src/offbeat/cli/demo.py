"""`offbeat demo`."""

from __future__ import annotations

from pathlib import Path

from offbeat.cli.common import say


def demo_command(out: Path = Path("runs/demo"), seed: int = 0, json: bool = False) -> None:
    """Fill the dropouts of an arm and predict a hopper, with models trained now and trained before.

    Args:
        out: folder for the scores, the figures, the animations and the trained models.
        seed: seed of windows, masks, splits, weights, batches and tasks.
        json: print the scores as JSON.
    """
    from offbeat.demo import run_demo

    result = run_demo(out, seed=seed)
    say(result.to_dict(), str(result), json)
