"""Latency and memory of a live stream, compared with the exported step on onnxruntime.

    python benchmarks/stream_live.py
    python benchmarks/stream_live.py --steps 10000000 --models anchored_ode_gru_d --json

A step is one message of 14 channels, of which 30 % have values, at uneven times, with the default
options: `observe`, then `predict` 10 ms ahead. One thread; the models have the sizes of the zoo and
initial weights.
"""

from __future__ import annotations

import argparse
import gc
import json
import resource
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch

import offbeat as ob
from offbeat import kernels
from offbeat.stream.live import LiveStream

MODELS = ("gru", "gru_d", "ode_rnn", "ode_gru_d", "anchored_ode_gru_d")
CHANNELS = 14
WARM_UP = 1000


def training_set(seed: int = 0) -> ob.Dataset:
    """Random walks on a 5 ms grid, from which scales and gaps are measured."""
    random = np.random.default_rng(seed)
    walks = random.normal(size=(20, 100, CHANNELS)).cumsum(axis=1)
    return ob.mask_out(
        ob.Dataset(tuple(ob.Trajectory(0.005 * np.arange(100), w) for w in walks)), 0.3
    )


def messages(count: int, seed: int = 1) -> tuple[Any, Any]:
    """Gaps in ns and partly observed rows, used cyclically."""
    random = np.random.default_rng(seed)
    values = random.normal(size=(count, CHANNELS))
    values[random.random(values.shape) > 0.3] = np.nan
    return random.integers(1_000_000, 20_000_000, count), values


def resident_mib() -> float:
    """Resident memory of this process now."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize() / 2**20


def measure(stream: LiveStream, steps: int) -> dict[str, Any]:
    """Runs a stream; latencies in us."""
    gaps, rows = messages(4096)
    taken = np.full((2, steps), -1, dtype=np.int64)  # filled, so that it is resident
    clock, t, before = time.perf_counter_ns, 1_700_000_000_000_000_000, 0.0
    for i in range(-WARM_UP, steps):
        if i == 0:
            gc.collect()
            before = resident_mib()
        t += int(gaps[i % 4096])
        row = rows[i % 4096]
        began = clock()
        stream.observe(t, row)
        observed = clock()
        stream.predict(t + 10_000_000)
        ended = clock()
        if i >= 0:
            taken[0, i], taken[1, i] = observed - began, ended - observed
    gc.collect()
    after = resident_mib()
    result: dict[str, Any] = {
        name: {
            "median_us": float(np.median(each)) / 1000,
            "p999_us": float(np.quantile(each, 0.999)) / 1000,
            "longest_us": float(each.max()) / 1000,
        }
        for name, each in (("observe", taken[0]), ("predict", taken[1]), ("step", taken.sum(0)))
    }
    return result | {"steps": steps, "resident_mib_before": before, "resident_mib_after": after}


def engines(name: str, folder: str) -> dict[str, Callable[[], LiveStream]]:
    """Constructors of both kinds of stream."""
    model = ob.make_model(name, training_set())
    path = Path(folder) / f"{name}.onnx"

    def onnx() -> LiveStream:
        ob.export_onnx(model, path)
        return ob.OnnxStream(path, time_unit="ns")

    return {"offbeat": lambda: ob.Stream(model, time_unit="ns"), "onnx": onnx}


def main() -> None:
    """Prints a table, or JSON."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--steps", type=int, default=100_000)
    parser.add_argument("--models", nargs="+", default=MODELS, choices=MODELS)
    parser.add_argument("--engines", nargs="+", default=("offbeat", "onnx"))
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    torch.set_num_threads(1)
    results: dict[str, Any] = {
        "backend": kernels.backend()[0],
        "steps": options.steps,
        "models": {},
    }
    with tempfile.TemporaryDirectory() as folder:
        for name in options.models:
            made = engines(name, folder)
            results["models"][name] = {
                engine: measure(made[engine](), options.steps) for engine in options.engines
            }
    if options.json:
        print(json.dumps(results, indent=2))
        return
    print(f"{options.steps} steps; scan backend: {results['backend']}\n")
    print(
        "| model | engine | observe, median | 99.9 % | predict, median | 99.9 % | "
        "resident MiB, start | end |"
    )
    print("|---|---|---|---|---|---|---|---|")
    for name, each in results["models"].items():
        for engine, said in each.items():
            times = [said[k][q] for k in ("observe", "predict") for q in ("median_us", "p999_us")]
            memory = [said["resident_mib_before"], said["resident_mib_after"]]
            cells = [*(f"{us:.0f} us" for us in times), *(f"{mib:.1f}" for mib in memory)]
            print(f"| {name} | {engine} | {' | '.join(cells)} |")


if __name__ == "__main__":
    main()
