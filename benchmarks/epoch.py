"""Wall time of a full-size epoch (7,000 trajectories; 1,500 to validate), and where it goes.

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


def run(name: str, data: ob.Dataset, validation: ob.Dataset, epochs: int) -> dict[str, float]:
    """Wall time of a training, and the time within the compiled calls, s."""
    config = ob.thesis_config(name) if name in ob.THESIS_MODELS else ob.ModelConfig(name=name)
    model = ob.make(config, data, seed=0)
    training = ob.train_config(name, epochs=epochs)
    timed = Timed(fused.compiled)
    fused.compiled = timed
    start = time.perf_counter()
    try:
        ob.fit(model, data, validation, training, progress=False)
    finally:
        fused.compiled = timed.module
    return {"wall": time.perf_counter() - start, **timed.seconds}


def measure(name: str, data: ob.Dataset, validation: ob.Dataset) -> dict[str, Any]:
    """An epoch with its validation: the difference of trainings of one and of three epochs."""
    short, long = (run(name, data, validation, epochs) for epochs in (1, 3))
    each = {key: (long[key] - short[key]) / 2 for key in short}
    kernel = sum(each[call] for call in CALLS)
    return {
        "epoch_s": round(each["wall"], 2),
        "kernel_s": round(kernel, 2),
        "kernel_share": round(kernel / each["wall"], 3),
        "once_per_training_s": round(short["wall"] - each["wall"], 2),
        "calls_s": {call: round(each[call], 2) for call in CALLS},
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
