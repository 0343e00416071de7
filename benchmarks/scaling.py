"""How the cost of a scan, forward and backward, grows with its sizes.

Each sweep changes one size and keeps the rest at the protocol's (batch 50, 100 rows, 14 channels,
hidden 15, a vector field of four layers of 100 units). The points of a sweep take turns. A cost in
proportion to the size has `per_unit` 1 everywhere.

    python benchmarks/scaling.py --json results/benchmarks/scaling.json
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from common import machine, synthetic, write

import offbeat as ob
from offbeat.kernels import cpu
from offbeat.training import Examples

BASE: dict[str, Any] = {"batch": 50, "rows": 100, "hidden": 15, "units": 100, "observed": 0.3}
SWEEPS: dict[str, list[Any]] = {
    "rows": [25, 50, 100, 200, 400],
    "batch": [16, 32, 64, 128, 256],
    "hidden": [15, 32, 64, 128],
    "units": [50, 100, 200, 400],
    "observed": [0.1, 0.3, 0.5, 0.9],
}


def ragged(n: int, rows: int, seed: int = 0) -> ob.Dataset:
    """Trajectories with different times, whose union has hundreds of rows."""
    rng = np.random.default_rng(seed)
    made = []
    for _ in range(n):
        times = np.sort(rng.choice(rows * 20, rows, replace=False)) * 0.00025
        made.append(ob.Trajectory(times, 0.05 * rng.normal(size=(rows, 14)).cumsum(axis=0)))
    return ob.Dataset(tuple(made))


def step_of(data: ob.Dataset, name: str, **options: Any) -> Callable[[], None]:
    """Loss and its gradient for a whole data set as one batch."""
    model = ob.make_model(ob.thesis_config(name, **options), data, seed=0)
    examples = Examples(model, model.batch(data))
    index = torch.arange(len(examples))

    def step() -> None:
        with model.threads():
            model.zero_grad()
            examples.loss(model, index, None).backward()

    return step


def point(name: str, **changed: Any) -> Callable[[], None]:
    """A step at one point of a sweep."""
    size = {**BASE, **changed}
    data = synthetic(size["batch"], size["rows"], observed_fraction=size["observed"])
    units = (size["units"],) * 4
    return step_of(data, name, hidden_size=size["hidden"], field_units=units)


def in_turn(steps: dict[Any, Callable[[], None]], repeats: int) -> dict[Any, float]:
    """Median time of each step, ms; the steps take turns."""
    for step in steps.values():
        step()
    times: dict[Any, list[float]] = {key: [] for key in steps}
    for _ in range(repeats):
        for key, step in steps.items():
            start = time.perf_counter()
            step()
            times[key].append(1e3 * (time.perf_counter() - start))
    return {key: statistics.median(each) for key, each in times.items()}


def under(step: Callable[[], None], **settings: int) -> Callable[[], None]:
    """The same step under other settings of the compiled backend: `TAPE_LIMIT`, `ROWS_AT_ONCE`."""

    def changed() -> None:
        kept = {name: getattr(cpu, name) for name in settings}
        try:
            for name, value in settings.items():
                setattr(cpu, name, value)
            step()
        finally:
            for name, value in kept.items():
                setattr(cpu, name, value)

    return changed


def main() -> None:
    """Measures and prints."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--model", default="ode_gru_d")
    parser.add_argument("--json")
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    found: dict[str, Any] = {}
    for what, values in SWEEPS.items():
        times = in_turn({v: point(options.model, **{what: v}) for v in values}, options.repeats)
        first = times[values[0]] / float(values[0])
        found[what] = {
            str(v): {"ms": round(ms, 2), "per_unit": round(ms / float(v) / first, 2)}
            for v, ms in times.items()
        }
        for v, ms in times.items():
            print(f"{what:10} {v!s:>6} {ms:9.1f} ms   per unit x{ms / float(v) / first:.2f}")
    own = ragged(50, 30)
    union = len(np.unique(np.concatenate([t.times for t in own])))
    times = in_turn(
        {
            "30 rows on one grid": point(options.model, rows=30),
            "30 rows at different times": step_of(own, options.model),
        },
        options.repeats,
    )
    found["different times"] = {"rows of the union": union, **times}
    print(f"different times: {times}, rows of the union: {union}")
    step = point(options.model)
    times = in_turn(
        {
            "stored": under(step, TAPE_LIMIT=2**60),
            "recomputed": under(step, TAPE_LIMIT=0),
        },
        options.repeats,
    )
    found["inner activations"] = times
    print(f"inner activations: {times}")
    # "at the end": one product of all activations and gradients, after all rows.
    ways = {f"every {n} rows": under(step, ROWS_AT_ONCE=n) for n in (1, 2, 4, 8, 16, 32)}
    ways["at the end"] = under(step, ROWS_AT_ONCE=BASE["rows"])
    times = in_turn(ways, options.repeats)
    found["weight gradients added"] = times
    print(f"weight gradients added: {times}")
    write(options.json, {"machine": machine(), "options": vars(options), "sweeps": found})


if __name__ == "__main__":
    main()
