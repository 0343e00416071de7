"""`offbeat simulate`."""

from __future__ import annotations

from pathlib import Path

from offbeat.cli.common import say
from offbeat.errors import InputError


def simulate_command(
    out: Path,
    robot: str = "hopper",
    n_trajectories: int = 10_000,
    rows: int = 200,
    seed: int = 0,
    threads: int | None = None,
    json: bool = False,
) -> None:
    """Simulate a robot that falls without control, and write a data set.

    Args:
        out: Parquet file to write.
        robot: hopper, walker, cheetah, humanoid, an MJCF file, or one of Gymnasium, as Hopper-v5.
        n_trajectories: number of trajectories, each from its own random state.
        rows: rows per trajectory; one per physics step, 5 ms for the hopper.
        seed: seed of the initial states; the thesis' protocol uses 123.
        threads: threads of the simulation; by default all cores. The result does not depend on it.
        json: print what was written as JSON.
    """
    from offbeat.data.simulate import simulate
    from offbeat.data.store import save
    from offbeat.files import writable

    if out.suffix != ".parquet":
        raise InputError(f"out must be a .parquet file, got {out}")
    writable(out)
    dataset = simulate(robot, n_trajectories, rows, seed=seed, threads=threads)
    save(dataset, out)
    say({"written": str(out), "meta": dict(dataset.meta)}, f"{out}: {dataset!r}", json)
