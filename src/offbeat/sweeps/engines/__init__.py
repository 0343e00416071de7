"""Engines that run the runs: local processes, a Ray cluster, Slurm."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from offbeat.errors import InputError, one_of
from offbeat.sweeps.engines.base import Engine

ENGINES = ("local", "ray", "slurm")


def engine_named(
    name: str,
    *,
    processes: int | None = None,
    threads: int = 1,
    options: Mapping[str, Any] | None = None,
    folder: Any = None,
) -> Engine:
    """Starts an engine.

    Args:
        name: one of `ENGINES`.
        processes: runs at a time; by default what the machine or the cluster has room for.
        threads: of each run.
        options: for `ray`, arguments of `ray.init`; for `slurm`, of submitit's
            `update_parameters`.
        folder: for the engine's own files.

    Raises:
        InputError: the engine is unknown, or a number is out of bounds.
        MissingExtraError: Ray or submitit is not installed.
    """
    one_of("engine", name, ENGINES)
    for what, number in (("processes", processes), ("threads", threads)):
        if number is not None and number < 1:
            raise InputError(f"{what} must be at least 1, got {number}")
    options = dict(options or {})
    if name == "ray":
        from offbeat.sweeps.engines.ray_cluster import RayEngine

        return RayEngine(processes, threads, options)
    if name == "slurm":
        from offbeat.sweeps.engines.slurm import SlurmEngine

        return SlurmEngine(processes, threads, options, folder)
    if options:
        raise InputError(f"the local engine has no options, got {', '.join(options)}")
    from offbeat.sweeps.engines.local import LocalEngine

    return LocalEngine(processes, threads)
