"""A training step with each body of the scan, in alternation in one process.

    python benchmarks/scan_bodies.py

Batch 50, 100 rows, 14 channels, 30 % of the rows observed, one thread: forward, backward, Adamax.
"""

from __future__ import annotations

import argparse
import json
import statistics
import time

import numpy as np
import torch

import offbeat as ob
from offbeat.kernels import reference, written_out
from offbeat.models import recurrence

MODELS = ("gru", "gru_d", "ode_rnn", "ode_gru_d", "anchored_ode_gru_d")
BODIES = {"reference": reference.scan, "written_out": written_out.scan}


def rows_of(seed: int = 0) -> ob.Dataset:
    """Fifty random walks on a 5 ms grid, 30 % of the rows observed."""
    random = np.random.default_rng(seed)
    times = 0.005 * np.arange(100)
    walks = random.normal(size=(50, 100, 14)).cumsum(axis=1)
    return ob.thin(ob.Dataset(tuple(ob.Trajectory(times, walk) for walk in walks)), 0.3)


def milliseconds(name: str, repeats: int) -> dict[str, float]:
    """Median time of a step per body; the bodies take turns."""
    data = rows_of()
    model = ob.make(name, data)
    batch = model.batch(data)
    optimizer = torch.optim.Adamax(model.parameters(), foreach=True)
    taken: dict[str, list[float]] = {body: [] for body in BODIES}
    for repeat in range(repeats + 3):
        for body, scan in BODIES.items():
            recurrence.scan = scan  # type: ignore[assignment]
            started = time.perf_counter()
            loss = (model(batch).predictions - batch.values).square().mean()
            optimizer.zero_grad(set_to_none=True)
            loss.backward()
            optimizer.step()
            if repeat >= 3:
                taken[body].append(1e3 * (time.perf_counter() - started))
    return {body: statistics.median(times) for body, times in taken.items()}


def main() -> None:
    """Prints a table, or JSON."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=15)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    torch.set_num_threads(1)
    results = {name: milliseconds(name, options.repeats) for name in MODELS}
    if options.json:
        print(json.dumps(results, indent=2))
        return
    print("| model | reference, ms | written out, ms | ratio |\n|---|---|---|---|")
    for name, times in results.items():
        slow, fast = times["reference"], times["written_out"]
        print(f"| {name} | {slow:.0f} | {fast:.0f} | {slow / fast:.2f} |")


if __name__ == "__main__":
    main()
