"""The latency of one row of a live stream.

`stream` is the public `Stream.step`: the prediction of a row, then the observation, with clock and
options. `observe` is the observation alone. `kernel` is the compiled call of an observation alone
(step inputs, projections, decay, dynamics, cell), with its Python binding.

    python benchmarks/streaming_step.py --json results/benchmarks/streaming_step.json
"""

from __future__ import annotations

import argparse
import time
from typing import Any

import numpy as np
import torch
from common import machine, synthetic, write

import offbeat as ob
from offbeat.stream.cpu_engine import CpuEngine

MODELS = ("gru", "gru_d", "ode_rnn", "ode_gru_d", "anchored_ode_gru_d")


def spread(nanoseconds: np.ndarray) -> dict[str, float]:
    """Median and tail, us."""
    us = nanoseconds / 1e3
    return {
        "median_us": round(float(np.median(us)), 2),
        "p99_us": round(float(np.percentile(us, 99)), 2),
        "p99_9_us": round(float(np.percentile(us, 99.9)), 2),
        "longest_us": round(float(us.max()), 1),
    }


def measure(name: str, data: ob.Dataset, steps: int) -> dict[str, Any]:
    """Latencies of one model."""
    model = ob.make_model(name, data, seed=0)
    rng = np.random.default_rng(0)
    rows = rng.normal(size=(1000, model.channels))
    rows[rng.random(1000) < 0.7] = np.nan  # 30 % of the rows have values
    gaps = rng.uniform(0.002, 0.02, size=1000)
    clock = time.perf_counter_ns

    taken = np.empty(steps)
    result: dict[str, Any] = {}
    for level in ("stream", "observe"):
        stream = ob.Stream(model)
        call = stream.step if level == "stream" else stream.observe
        t = 0.0
        for i in range(-500, steps):
            t += float(gaps[i % 1000])
            start = clock()
            call(t, rows[i % 1000])
            if i >= 0:
                taken[i] = clock() - start
        result[level] = spread(taken)

    if model.backend()[0] != "reference":
        live = CpuEngine(model)._live
        mask = ~np.isnan(rows)
        values = np.where(mask, rows, 0).astype(np.float32)
        t = 0.0
        for i in range(-500, steps):
            t += float(gaps[i % 1000])
            value, observed = values[i % 1000], mask[i % 1000]
            start = clock()
            live.observe(t, value, observed, False)
            if i >= 0:
                taken[i] = clock() - start
        result["kernel"] = spread(taken)
    return result


def main() -> None:
    """Measures and prints."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=100_000)
    parser.add_argument("--models", nargs="*", default=list(MODELS))
    parser.add_argument("--json")
    options = parser.parse_args()
    torch.set_num_threads(1)
    data = synthetic(20, 100, observed_fraction=0.3)
    found = {}
    print(f"{'model':20} {'':8} {'median':>9} {'99 %':>9} {'99.9 %':>9}   us")
    for name in options.models:
        found[name] = measure(name, data, options.steps)
        for level, numbers in found[name].items():
            print(
                f"{name:20} {level:8} {numbers['median_us']:9.1f} {numbers['p99_us']:9.1f} "
                f"{numbers['p99_9_us']:9.1f}",
                flush=True,
            )
    write(options.json, {"machine": machine(), "options": vars(options), "steps": found})


if __name__ == "__main__":
    main()
