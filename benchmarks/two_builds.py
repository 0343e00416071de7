"""The training step of two checkouts of Offbeat, in alternation.

    python benchmarks/two_builds.py ../old . --json runs/two_builds.json

Each checkout runs in a separate process, with its `src` on the path and its compiled module
there. The processes take turns: one trains for some steps while the other waits. The script uses
only what all versions since 0.1.0 have.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
from pathlib import Path
from typing import Any

MODELS = ("ode_rnn", "ode_gru_d", "anchored_ode_gru_d", "gru", "gru_d")

WORKER = """
import json, sys, time
from dataclasses import replace
import numpy as np
import torch
import offbeat as ob
from offbeat import kernels

options = json.loads(sys.argv[1])
torch.set_num_threads(options["threads"])
rng = np.random.default_rng(0)

def trajectory():
    values = 0.05 * rng.normal(size=(options["rows"], 14)).cumsum(axis=0)
    observed = np.zeros(values.shape, dtype=bool)
    observed[rng.choice(options["rows"], options["rows"] * 3 // 10, replace=False)] = True
    return ob.Trajectory(np.arange(options["rows"]) * 0.005, values, observed)

data = ob.Dataset(tuple(trajectory() for _ in range(options["batch"] * options["steps"])))
backend = kernels.backend if hasattr(kernels, "backend") else kernels.body  # 0.1.0
print(json.dumps({"version": ob.__version__, "backend": backend()[0]}), flush=True)
for line in sys.stdin:
    name = line.strip()
    thesis = name in ob.THESIS_MODELS
    config = ob.thesis_config(name) if thesis else ob.ModelConfig(name=name)
    if options["units"]:
        units = (options["units"],) * 4
        config = replace(config, hidden_size=options["hidden"], field_units=units)
    make = ob.make_model if hasattr(ob, "make_model") else ob.make  # 0.1.0
    model = make(config, data, seed=0)
    training = ob.train_config(name, epochs=1, batch_size=options["batch"])
    start = time.process_time()
    epoch = ob.fit(model, data, None, training, progress=False).history[-1]
    processor = time.process_time() - start
    seconds = processor if options["clock"] == "processor" else epoch.seconds
    print(1e3 * seconds / options["steps"], epoch.train_mse, flush=True)
"""


class Checkout:
    """A process that trains with one checkout."""

    def __init__(self, root: Path, options: dict[str, Any]) -> None:
        self.process = subprocess.Popen(
            [sys.executable, "-c", WORKER, json.dumps(options)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env={**os.environ, "PYTHONPATH": str(root.resolve() / "src")},
        )
        self.about: dict[str, Any] = {"root": str(root), **json.loads(self._line())}

    def step(self, model: str) -> tuple[float, float]:
        """Milliseconds of one step, and the loss of the epoch."""
        assert self.process.stdin is not None
        self.process.stdin.write(model + "\n")
        self.process.stdin.flush()
        ms, loss = self._line().split()
        return float(ms), float(loss)

    def _line(self) -> str:
        assert self.process.stdout is not None
        return self.process.stdout.readline() or sys.exit("a worker ended; its error is above")


def main() -> None:
    """Prints a table, and writes JSON if a path is given."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("checkouts", nargs=2, type=Path, help="folders that have src/offbeat")
    parser.add_argument("--models", nargs="*", default=list(MODELS))
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--batch", type=int, default=50)
    parser.add_argument("--rows", type=int, default=100)
    parser.add_argument("--hidden", type=int, default=15, help="units, with --units")
    parser.add_argument("--units", type=int, help="of each of four layers of the vector field")
    parser.add_argument("--steps", type=int, default=8, help="training steps per turn")
    parser.add_argument("--turns", type=int, default=15)
    parser.add_argument(
        "--clock",
        choices=["wall", "processor"],
        default="wall",
        help="processor: time of all threads, with the set-up of the training",
    )
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    load = os.getloadavg()[0]
    names = ("threads", "batch", "rows", "hidden", "units", "steps", "clock")
    sizes = {name: getattr(options, name) for name in names}
    both = [Checkout(root, sizes) for root in options.checkouts]
    for checkout in both:
        print(checkout.about)
    result: dict[str, Any] = {"checkouts": [c.about for c in both], "load_before": load, **sizes}
    print(f"{'model':20}{'first, ms':>12}{'second, ms':>12}{'ratio':>8}  same loss")
    for model in options.models:
        turns = [[c.step(model) for c in both] for _ in range(options.turns + 1)][1:]
        first, second = ([turn[i][0] for turn in turns] for i in range(2))
        ratios = [b / a for a, b in zip(first, second, strict=True)]
        result[model] = {
            "median_ms": [statistics.median(first), statistics.median(second)],
            "fastest_ms": [min(first), min(second)],
            "median_ratio": statistics.median(ratios),
            "ratio_of_fastest": min(second) / min(first),
            "same_loss": all(turn[0][1] == turn[1][1] for turn in turns),
        }
        a, b = result[model]["median_ms"]
        ratio, same = result[model]["median_ratio"], result[model]["same_loss"]
        print(f"{model:20}{a:12.2f}{b:12.2f}{ratio:8.3f}  {same}", flush=True)
    if options.json is not None:
        options.json.parent.mkdir(parents=True, exist_ok=True)
        options.json.write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
