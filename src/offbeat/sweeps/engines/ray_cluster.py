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
        options: arguments of `ray.init`, `address` above all.
    """

    def __init__(self, processes: int | None, threads: int, options: Mapping[str, Any]) -> None:
        self._ray: Any = require("ray", "cluster")
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
        self.capacity = processes or max(1, cores // threads)
        self.description = f"Ray on {where}, {self.capacity} at a time, {cores} cores"
        # The session submits the run of a lost worker again, and counts how often.
        self._attempt = self._ray.remote(num_cpus=threads, max_retries=0)(attempt)
        self._jobs: dict[Any, Job] = {}

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
