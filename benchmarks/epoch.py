"""Wall time of a full-size epoch (7,000 trajectories; 1,500 to validate) and of its compiled calls.

python benchmarks/epoch.py --json results/benchmarks/epoch.json
"""

from __future__ import annotations

import argparse
import itertools
import statistics
import time
from typing import Any

import torch
from common import machine, synthetic, write

import offbeat as ob
from offbeat import training
from offbeat.kernels import cpu

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


def measure(name: str, data: ob.Dataset, validation: ob.Dataset, epochs: int) -> dict[str, Any]:
    """Wall time of an epoch with its validation, and the time of it within the compiled calls, s.

    Medians over the epochs of one training, without the first, which also warms caches up.
    """
    config = ob.thesis_config(name) if name in ob.THESIS_MODELS else ob.ModelConfig(name=name)
    model = ob.make_model(config, data, seed=0)
    options = ob.train_config(name, epochs=epochs)
    timed = Timed(cpu.compiled)
    ends: list[dict[str, float]] = []
    close = training._close_epoch

    def closed(*arguments: Any) -> None:
        close(*arguments)
        ends.append({"wall": time.perf_counter(), **timed.seconds})

    cpu.compiled, training._close_epoch = timed, closed
    began = time.perf_counter()
    try:
        ob.fit(model, data, validation, options, progress=False)
    finally:
        cpu.compiled, training._close_epoch = timed.module, close
    spent = [{k: b[k] - a[k] for k in a} for a, b in itertools.pairwise(ends)]
    each = {key: statistics.median(epoch[key] for epoch in spent) for key in spent[0]}
    fractions = [sum(epoch[call] for call in CALLS) / epoch["wall"] for epoch in spent]
    return {
        "epoch_s": round(each["wall"], 2),
        "kernel_s": round(sum(each[call] for call in CALLS), 2),
        "kernel_fraction": round(statistics.median(fractions), 3),
        "first_epoch_and_preparation_s": round(ends[0]["wall"] - began, 2),
        "calls_s": {call: round(each[call], 2) for call in CALLS},
    }


def main() -> None:
    """Measures and prints."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--trajectories", type=int, default=7000)
    parser.add_argument("--epochs", type=int, default=5, help="of each training, at least 2")
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
        found[name] = measure(name, data, validation, options.epochs)
        print(name, found[name], flush=True)
    write(options.json, {"machine": machine(), "options": vars(options), "epochs": found})


if __name__ == "__main__":
    main()
