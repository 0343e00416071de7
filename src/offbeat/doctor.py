"""What is installed and what runs: the first thing to look at when something is odd."""

from __future__ import annotations

import importlib.metadata
import os
import platform
import sys
from typing import Any

from offbeat import __version__
from offbeat.kernels import cpu

CORE = ("torch", "numpy", "pyarrow", "safetensors", "jsonargparse", "matplotlib", "pillow")
EXTRAS = {
    "sim": ("mujoco", "dm_control"),
    "track": ("tensorboard",),
    "ros": ("rosbags",),
    "px4": ("pyulog",),
    "hdf5": ("h5py",),
    "umap": ("umap-learn",),
    "export": ("onnx", "onnxscript", "onnxruntime"),
    "cluster": ("ray", "submitit"),
}


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
        "scan backend": _scan_backend(),
        "instruction sets": ", ".join(cpu.instruction_sets()) or f"none: {cpu.why_not}",
        "MUJOCO_GL": os.environ.get("MUJOCO_GL", "not set"),
    }
    for name in CORE:
        found[name] = _version(name) or "missing"
    for extra, names in EXTRAS.items():
        for name in names:
            found[name] = _version(name) or f"missing; pip install 'offbeat[{extra}]'"
    return found


def _scan_backend() -> str:
    from offbeat.errors import InputError
    from offbeat.kernels import backend

    try:
        name, why = backend()
    except InputError as error:
        return f"none: {error}"
    return f"{name} ({why})"


def _version(name: str) -> str | None:
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return None
