"""Wall time of a full-size epoch (7,000 trajectories of 100 rows), and where it goes.

python benchmarks/epoch.py --json results/benchmarks/epoch.json
"""

from __future__ import annotations

import argparse
import time
from typing import Any

import torch
from common import machine, synthetic, write

import offbeat as ob
from offbeat.kernels import fused

CALLS = ("scan_forward", "scan_backward", "perceptron_forward", "perceptron_backward")


class Timed:
    """The compiled module, with the time spent in its large calls added up."""

    def __init__(self, module: Any) -> None:
        self.module, self.seconds = module, dict.fromkeys(CALLS, 0.0)

    def __getattr__(self, name: str) -> Any:
        function = getattr(self.module, name)
        if name not in CALLS:
            return function

        def timed(*arguments: Any) -> Any:
            start = time.perf_counter()
            result = function(*arguments)
            self.seconds[name] += time.perf_counter() - start
            return result

        return timed


def measure(name: str, data: ob.Dataset, validation: ob.Dataset) -> dict[str, Any]:
    """One epoch of `fit`, with validation."""
    config = ob.thesis_config(name) if name in ob.THESIS_MODELS else ob.ModelConfig(name=name)
    model = ob.make(config, data, seed=0)
    timed = Timed(fused.compiled)
    fused.compiled = timed
    start = time.perf_counter()
    try:
        result = ob.fit(model, data, validation, ob.train_config(name, epochs=1), progress=False)
    finally:
        fused.compiled = timed.module
    total = time.perf_counter() - start
    kernel = sum(timed.seconds.values())
    steps = result.history[0].seconds
    return {
        "fit_s": round(total, 2),
        "training_steps_s": round(steps, 2),
        "ms_per_step": round(1e3 * steps / result.steps, 2),
        "kernel_s": round(kernel, 2),
        "kernel_share_of_fit": round(kernel / total, 3),
        "calls_s": {name: round(s, 2) for name, s in timed.seconds.items()},
    }


def main() -> None:
    """Measures and prints."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--trajectories", type=int, default=7000)
    parser.add_argument(
        "--models", nargs="*", default=["ode_gru_d", "ode_rnn", "anchored_ode_gru_d", "gru_d"]
    )
    parser.add_argument("--json")
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    data = synthetic(options.trajectories, 100, observed_fraction=0.3)
    validation = synthetic(max(1, options.trajectories * 15 // 70), 100, observed_fraction=0.3)
    found = {}
    for name in options.models:
        found[name] = measure(name, data, validation)
        print(name, found[name], flush=True)
    write(options.json, {"machine": machine(), "options": vars(options), "epochs": found})


if __name__ == "__main__":
    main()
