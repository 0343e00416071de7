"""How the cost of a scan, forward and backward, grows with its sizes.

Each sweep changes one size and keeps the rest at the protocol's (batch 50, 100 rows, 14 channels,
hidden 15, a vector field of four layers of 100 units). The points of a sweep take turns. A cost in
proportion to the size has `per_unit` 1 everywhere.

    python benchmarks/scaling.py --json results/benchmarks/scaling.json

`--figure` draws the sweeps, and what `shards.py` and `runs_and_ranks.py` measured.
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from collections.abc import Callable
from pathlib import Path
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


CLOCKS = {"wall": time.perf_counter, "processor": time.process_time}


def in_turn(
    steps: dict[Any, Callable[[], None]], repeats: int, clock: Callable[[], float]
) -> dict[Any, float]:
    """Median time of each step, ms; the steps take turns."""
    for step in steps.values():
        step()
    times: dict[Any, list[float]] = {key: [] for key in steps}
    for _ in range(repeats):
        for key, step in steps.items():
            start = clock()
            step()
            times[key].append(1e3 * (clock() - start))
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


LABELS = {
    "rows": "rows of a trajectory",
    "batch": "trajectories of a batch",
    "hidden": "hidden units",
    "units": "units per layer of the field",
}


def draw(sweeps: dict[str, Any], shards: Path, together: Path, figure_path: str) -> None:
    """A panel for each size, beside a cost in proportion to it from the first point on."""
    from matplotlib.figure import Figure
    from matplotlib.ticker import LogLocator

    figure = Figure(figsize=(12, 5.4), layout="constrained")
    panels = figure.subplots(2, 4).ravel()
    panels[-1].axis("off")

    def panel(axes: Any, sizes: list[float], costs: list[float], label: str, unit: str) -> None:
        axes.loglog(sizes, costs, "o-", label="measured")
        proportional = [costs[0] * x / sizes[0] for x in sizes]
        axes.loglog(sizes, proportional, ":", color="0.6", label="in proportion")
        axes.set(xlabel=label, ylabel=unit)
        axes.set_xticks(sizes, [f"{x:g}" for x in sizes])
        axes.minorticks_off()
        axes.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axes.yaxis.set_major_formatter("{x:g}")

    for axes, (what, label) in zip(panels, LABELS.items(), strict=False):
        points = sweeps[what]
        costs = [point["ms"] for point in points.values()]
        panel(axes, [float(v) for v in points], costs, label, "loss and gradient, ms")
    if shards.exists():
        read = json.loads(shards.read_text(encoding="utf-8"))["sizes"]
        costs = [each["epoch_cpu_s"] for each in read.values()]
        panel(panels[4], [float(v) for v in read], costs, "data set in shards, GB", "an epoch, s")
    if together.exists():
        read = json.loads(together.read_text(encoding="utf-8"))
        costs = list(read["runs"].values())
        panel(panels[5], [float(n) for n in read["runs"]], costs, "runs of a sweep", "the sweep, s")
        for batch, times in read["ranks"].items():
            ranks = {int(k.split()[0]): v for k, v in times.items() if k.endswith("ranks")}
            panels[6].loglog(list(ranks), list(ranks.values()), "o-", label=f"batch {batch}")
            ideal = [times["1 ranks"] / n for n in ranks]
            panels[6].loglog(list(ranks), ideal, ":", color="0.6")
        panels[6].set(xlabel="ranks of a training", ylabel="an epoch, s")
        panels[6].set_xticks(list(ranks), [str(n) for n in ranks])
        panels[6].minorticks_off()
        panels[6].yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        panels[6].yaxis.set_major_formatter("{x:g}")
        panels[6].legend(frameon=False)
    panels[0].legend(frameon=False)
    figure.savefig(figure_path, dpi=150)


def main() -> None:
    """Measures and prints."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--model", default="ode_gru_d")
    parser.add_argument(
        "--clock",
        choices=list(CLOCKS),
        default="wall",
        help="processor: time of all threads, for a busy machine",
    )
    parser.add_argument("--json")
    parser.add_argument("--figure")
    parser.add_argument("--shards", type=Path, default=Path("results/benchmarks/shards.json"))
    parser.add_argument(
        "--together", type=Path, default=Path("results/benchmarks/runs_and_ranks.json")
    )
    options = parser.parse_args()
    clock = CLOCKS[options.clock]
    torch.set_num_threads(options.threads)
    found: dict[str, Any] = {}
    for what, values in SWEEPS.items():
        times = in_turn(
            {v: point(options.model, **{what: v}) for v in values}, options.repeats, clock
        )
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
        clock,
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
        clock,
    )
    found["inner activations"] = times
    print(f"inner activations: {times}")
    # "at the end": one product of all activations and gradients, after all rows.
    ways = {f"every {n} rows": under(step, ROWS_AT_ONCE=n) for n in (1, 2, 4, 8, 16, 32)}
    ways["at the end"] = under(step, ROWS_AT_ONCE=BASE["rows"])
    times = in_turn(ways, options.repeats, clock)
    found["weight gradients added"] = times
    print(f"weight gradients added: {times}")
    if options.figure:
        draw(found, options.shards, options.together, options.figure)
    used = {k: v for k, v in vars(options).items() if k not in ("shards", "together")}
    write(options.json, {"machine": machine(), "options": used, "sweeps": found})


if __name__ == "__main__":
    main()
