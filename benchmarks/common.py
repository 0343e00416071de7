"""Helpers of the benchmarks: data of the protocol's shape, and a description of the machine."""

from __future__ import annotations

import json
import os
import platform
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np
import torch

import offbeat as ob
from offbeat import kernels
from offbeat.sweeps.provenance import commit, cpu


def synthetic(
    n: int, rows: int, *, observed_fraction: float, channels: int = 14, seed: int = 0
) -> ob.Dataset:
    """Random walks on a grid of 5 ms, whole rows masked: the protocol's shape without MuJoCo."""
    rng = np.random.default_rng(seed)
    made = []
    for _ in range(n):
        values = 0.05 * np.cumsum(rng.normal(size=(rows, channels)), axis=0)
        observed = np.zeros((rows, channels), dtype=bool)
        chosen = rng.choice(rows, max(1, int(rows * observed_fraction)), replace=False)
        observed[chosen] = True
        made.append(ob.Trajectory(np.arange(rows) * 0.005, values, observed))
    return ob.Dataset(tuple(made))


def machine() -> dict[str, Any]:
    """The machine and the versions that a benchmark runs with."""
    found: dict[str, Any] = {
        "cpu": cpu(),
        "cores": os.cpu_count(),
        "load_before": os.getloadavg()[0] if hasattr(os, "getloadavg") else None,
        "torch_threads": torch.get_num_threads(),
        "scan_backend": kernels.backend()[0],
        "python": platform.python_version(),
        "commit": commit(),
    }
    for name in ("offbeat", "torch", "numpy", "jax", "torchdiffeq"):
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found


def kept(path: Path, name: str) -> Any:
    """A named part of the result of an earlier call, or None."""
    return json.loads(path.read_text(encoding="utf-8"))[name] if path.exists() else None


def write(path: str | None, result: dict[str, Any]) -> None:
    """Writes a result as JSON if a path is given."""
    if path is None:
        return
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    Path(path).write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")
