"""The latency of one row of a live stream.

`stream` is the public `Stream.step`: the prediction of a row, then the observation, with clock and
options. `observe` is the observation alone. Messages in the order of time take one compiled call
each; `Python` is the way of all others. `kernel` is the compiled call of an observation alone (step
inputs, projections, decay, dynamics, cell), with its Python binding.

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
from offbeat.stream.engine import Engine
from offbeat.stream.live import LiveStream
from offbeat.stream.stream import info_of

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


class PythonOnly(CpuEngine):
    """The compiled engine, whose messages all go through Python."""

    in_order = Engine.in_order


def streams_of(model: ob.Model, **options: Any) -> tuple[LiveStream, LiveStream]:
    """A stream with compiled messages and one without."""
    info, chosen = info_of(model), ob.StreamOptions(**options)
    compiled, python = (
        LiveStream(engine(model), info, options=chosen, time_unit="s")
        for engine in (CpuEngine, PythonOnly)
    )
    return compiled, python


def measure(name: str, data: ob.Dataset, steps: int) -> dict[str, Any]:
    """Latencies of one model; what is compared takes turns row by row, on the same rows."""
    model = ob.make_model(name, data, seed=0)
    rng = np.random.default_rng(0)
    rows = rng.normal(size=(1000, model.channels))
    rows[rng.random(1000) < 0.7] = np.nan  # 30 % of the rows have values
    gaps = rng.uniform(0.002, 0.02, size=1000)
    mask = ~np.isnan(rows)
    scaled = np.where(mask, rows, 0).astype(np.float32)
    clock = time.perf_counter_ns

    stepped, stepped_python = streams_of(model)
    observed, observed_python = streams_of(model)
    live = CpuEngine(model)._live
    calls = {
        "stream": lambda t, i: stepped.step(t, rows[i]),
        "stream, Python": lambda t, i: stepped_python.step(t, rows[i]),
        "observe": lambda t, i: observed.observe(t, rows[i]),
        "observe, Python": lambda t, i: observed_python.observe(t, rows[i]),
        "kernel": lambda t, i: live.observe(t, scaled[i], mask[i], False),
    }
    taken = {level: np.empty(steps) for level in calls}
    t = 0.0
    for i in range(-500, steps):
        t += float(gaps[i % 1000])
        for level, call in calls.items():
            start = clock()
            call(t, i % 1000)
            if i >= 0:
                taken[level][i] = clock() - start
    result: dict[str, Any] = {level: spread(each) for level, each in taken.items()}
    for level in ("stream", "observe"):
        ratio = taken[f"{level}, Python"] / taken[level]
        result[level]["median_ratio_of_python"] = round(float(np.median(ratio)), 2)
    if stepped.counters != stepped_python.counters or stepped.state() != stepped_python.state():
        raise SystemExit(f"{name}: the two streams differ")
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
    print(f"{'model':20} {'':16} {'median':>9} {'99 %':>9} {'99.9 %':>9}   us")
    for name in options.models:
        found[name] = measure(name, data, options.steps)
        for level, numbers in found[name].items():
            print(
                f"{name:20} {level:16} {numbers['median_us']:9.1f} {numbers['p99_us']:9.1f} "
                f"{numbers['p99_9_us']:9.1f}   x{numbers.get('median_ratio_of_python', 1)}",
                flush=True,
            )
    write(options.json, {"machine": machine(), "options": vars(options), "steps": found})


if __name__ == "__main__":
    main()
