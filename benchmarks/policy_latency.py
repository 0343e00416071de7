"""Latency of an action: `Policy.act` with and without an observation, and one step in ONNX.

    python benchmarks/policy_latency.py --json results/benchmarks/policy_latency.json

Policies have the sizes of Hopper, 11 observations and 3 actions, and are hardly trained. Calls of
all kinds take turns, so that they meet the same load.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
from common import machine, write

import offbeat as ob
from offbeat.policies import CloneConfig, OnnxPolicy, Policy, export_policy, fit_policy

MODELS = ("gru", "gru_d", "ode_rnn", "ode_gru_d", "anchored_ode_gru_d")
OBSERVATIONS, ACTIONS, ROBOTS, DT = 11, 3, 20, 0.008


def cloned(name: str) -> Policy:
    """A policy that was trained for an epoch on random demonstrations."""
    random = np.random.default_rng(0)
    roles = ("state",) * OBSERVATIONS + ("action",) * ACTIONS
    shown = [
        ob.Trajectory(np.arange(50) * DT, random.normal(size=(50, len(roles))), roles=roles)
        for _ in range(4)
    ]
    config = CloneConfig(epochs=1)
    return fit_policy(ob.Dataset(tuple(shown)), name, config=config, progress=False)


def seconds(calls: int) -> dict[str, dict[str, float]]:
    """Median and 99th percentile of each kind of call, in microseconds, by model."""
    seen = np.random.default_rng(1).normal(size=(ROBOTS, OBSERVATIONS))
    makers: dict[str, dict[str, Any]] = {}
    with tempfile.TemporaryDirectory() as folder:
        for name in MODELS:
            policy, many = cloned(name), None
            many = Policy(policy.model)
            many.reset(ROBOTS)
            path = Path(folder) / f"{name}.onnx"
            export_policy(policy, path)
            onnx, asked = OnnxPolicy(path), Policy(policy.model)
            asked.act(0.0, seen[0])
            makers[name] = {
                "observed": lambda t, p=policy: p.act(t, seen[0]),
                "nothing observed": lambda t, p=asked: p.act(t),
                f"{ROBOTS} robots": lambda t, p=many: p.act(t, seen),
                "ONNX": lambda t, p=onnx: p.act(t, seen[0]),
            }
        taken: dict[tuple[str, str], list[float]] = {}
        for call in range(calls):
            for name, kinds in makers.items():
                for kind, act in kinds.items():
                    began = time.perf_counter()
                    act((call + 1) * DT)
                    taken.setdefault((name, kind), []).append(time.perf_counter() - began)
    found: dict[str, dict[str, float]] = {}
    for (name, kind), each in taken.items():
        median, high = 1e6 * np.quantile(each[20:], [0.5, 0.99])
        found.setdefault(name, {})[f"{kind}, median us"] = round(float(median), 1)
        found[name][f"{kind}, 99 % us"] = round(float(high), 1)
    return found


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--calls", type=int, default=1000)
    parser.add_argument("--json")
    asked = parser.parse_args()
    torch.set_num_threads(1)
    found = seconds(asked.calls)
    for name, each in found.items():
        print(name, each)
    write(asked.json, {"machine": machine(), "calls": asked.calls, "latency": found})


if __name__ == "__main__":
    main()
