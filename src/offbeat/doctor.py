"""What is installed and what runs: the first thing to look at when something is odd."""

from __future__ import annotations

import importlib.metadata
import os
import platform
import sys
from typing import Any

from offbeat import __version__

CORE = ("torch", "numpy", "pyarrow", "safetensors", "jsonargparse", "matplotlib", "pillow")
EXTRAS = {"sim": ("mujoco", "dm_control"), "track": ("tensorboard",)}


def examine() -> dict[str, Any]:
    """Versions, threads, scan bodies and extras, as a flat record."""
    import torch

    found: dict[str, Any] = {
        "offbeat": __version__,
        "python": f"{platform.python_version()} ({sys.executable})",
        "platform": platform.platform(),
        "cores": len(os.sched_getaffinity(0))
        if hasattr(os, "sched_getaffinity")
        else os.cpu_count(),
        "torch threads": torch.get_num_threads(),
        "torch CUDA": torch.cuda.is_available(),
        "scan bodies": "written out (GRU, one Euler step), reference (everything)",
        "MUJOCO_GL": os.environ.get("MUJOCO_GL", "not set"),
    }
    for name in CORE:
        found[name] = _version(name) or "missing"
    for extra, names in EXTRAS.items():
        for name in names:
            found[name] = _version(name) or f"missing; pip install 'offbeat[{extra}]'"
    return found


def _version(name: str) -> str | None:
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return None
