"""A Ray cluster: a running one, or a local one."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from offbeat.data.simulate import available_cores
from offbeat.errors import InputError, require
from offbeat.sweeps.engines.base import Ending, Engine, Job, attempt


class RayEngine(Engine):
    """Runs jobs on Ray; its workers keep the data in memory between jobs.

    Connects to the cluster that the environment names (`RAY_ADDRESS`) or that runs on this machine;
    where there is none, it starts a local one and ends it with the sweep.

    Args:
        processes: runs at a time; by default as many as the cluster's cores allow.
        threads: of each run.
        options: arguments of `ray.init`, `address` above all; and `gpus_per_run`, such as 0.25 for
            four runs on each GPU, of which a run sees its own alone. By default none is reserved.

    Raises:
        InputError: no cluster answers, or there are too few GPUs for one run.
    """

    def __init__(self, processes: int | None, threads: int, options: Mapping[str, Any]) -> None:
        self._ray: Any = require("ray", "cluster")
        options = dict(options)
        gpus = options.pop("gpus_per_run", 0)
        if isinstance(gpus, bool) or not isinstance(gpus, int | float) or not gpus >= 0:
            raise InputError(f"gpus_per_run must be a number of at least 0, got {gpus!r}")
        self._jobs: dict[Any, Job] = {}
        self._started = not self._ray.is_initialized()
        where = "the running cluster"
        if self._started:
            quiet = {"log_to_driver": False, "configure_logging": False, **options}
            try:
                self._ray.init(**{"address": "auto", **quiet})
            except ConnectionError:
                if "address" in options:
                    raise InputError(
                        f"no Ray cluster answers at {options['address']!r}; start it, or leave the "
                        "address out for one of this machine"
                    ) from None
                cores = (processes or available_cores() // threads or 1) * threads
                self._ray.init(**{"num_cpus": cores, "include_dashboard": False, **quiet})
                where = "a cluster of this machine"
        cores = int(self._ray.cluster_resources().get("CPU", 1))
        room, has = max(1, cores // threads), f"{cores} cores"
        if gpus:
            there = float(self._ray.cluster_resources().get("GPU", 0))
            if there < gpus:
                self.stop()
                raise InputError(
                    f"gpus_per_run is {gpus:g}, the cluster has {there:g} GPUs; give less, or "
                    "leave it out"
                )
            room, has = min(room, int(there / gpus)), f"{has}, {there:g} GPUs"
        self.capacity = processes or room
        self.description = f"Ray on {where}, {self.capacity} at a time, {has}"
        # The session submits the run of a lost worker again, and counts how often.
        reserved = {"num_cpus": threads, "num_gpus": gpus, "max_retries": 0}
        self._attempt = self._ray.remote(**reserved)(attempt)

    def submit(self, job: Job) -> None:
        """Submits the job to the cluster."""
        self._jobs[self._attempt.remote(job)] = job

    def wait(self, seconds: float) -> list[Ending]:
        """Waits until a job has ended or its worker is gone."""
        ended, _ = self._ray.wait(
            list(self._jobs), num_returns=1, timeout=seconds, fetch_local=True
        )
        endings = []
        for reference in ended:
            job = self._jobs.pop(reference)
            try:
                endings.append(Ending(job, self._ray.get(reference)))
            except self._ray.exceptions.RayTaskError:
                raise  # `attempt` catches everything else: the worker can't run Offbeat
            except self._ray.exceptions.RayError:
                endings.append(Ending(job, lost=True))
        return endings

    def stop(self) -> None:
        """Ends everything that is under way, and the cluster if it was started here."""
        for reference in self._jobs:
            self._ray.cancel(reference, force=True)
        self._jobs.clear()
        if self._started:
            self._ray.shutdown()
