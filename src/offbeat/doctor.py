"""Information on the installation, to diagnose problems."""

from __future__ import annotations

import importlib.metadata
import os
import platform
import re
import sys
from typing import Any

from offbeat import __version__
from offbeat.kernels import cpu

FOR_DEVELOPERS = ("test", "bench")
"""Extras that users do not need."""


NEEDED_FOR = {
    "jsonargparse": "the commands need it",
    "matplotlib": "figures need it",
    "pillow": "moving pictures need it",
    "pyarrow": "reading and writing files of data needs it",
    "pyyaml": "the commands and the configs of sweeps need it",
    "scipy": "blends of `learn`, PCHIP, ridge regression and the tests of `compare` need it",
    "tqdm": "without it no progress is shown",
}
"""What works only with a dependency. All else, from `make_model` to `Stream`, needs torch, NumPy
and safetensors alone; a machine with a GPU often has no others."""


def examine() -> dict[str, Any]:
    """Versions, threads, scan backends and optional packages, by name."""
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
        "device auto": _device(),
        "scan backend": _scan_backend(),
        "instruction sets": ", ".join(cpu.instruction_sets()) or f"none: {cpu.why_not}",
        "precision bf16": ", ".join(cpu.bf16_sets()) or "not on this CPU",
        "MUJOCO_GL": os.environ.get("MUJOCO_GL", "not set"),
    }
    for name, extra in dependencies() or [(name, "") for name in NEEDED_FOR]:
        fix = f"; pip install 'offbeat[{extra}]'" if extra else ""
        fix = fix or (f"; {NEEDED_FOR[name]}" if name in NEEDED_FOR else "")
        found[name] = _version(name) or f"missing{fix}"
    return found


def dependencies() -> list[tuple[str, str]]:
    """Every dependency, with the extra that installs it, or an empty string.

    These are the dependencies of the installed package; none if it is not installed.
    """
    try:
        declared = importlib.metadata.requires("offbeat") or []
    except importlib.metadata.PackageNotFoundError:
        return []
    found: dict[str, str] = {}
    for text in declared:
        named, asked = re.match(r"[\w.-]+", text), re.search(r"extra == ['\"]([^'\"]+)", text)
        extra = asked[1] if asked else ""
        if named and named[0] != "offbeat" and extra not in FOR_DEVELOPERS:
            found.setdefault(named[0], extra)
    return list(found.items())


def _scan_backend() -> str:
    from offbeat.errors import InputError
    from offbeat.kernels import backend

    try:
        name, why = backend()
    except InputError as error:
        return f"none: {error}"
    return f"{name} ({why})"


def _device() -> str:
    from offbeat.devices import examined

    return examined()


def _version(name: str) -> str | None:
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return None
