"""Slurm, through submitit; where there is no Slurm, submitit's jobs of this machine."""

from __future__ import annotations

import time
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from offbeat.data.simulate import available_cores
from offbeat.errors import InputError, require
from offbeat.sweeps.engines.base import Ending, Engine, Job, attempt

_AT_A_TIME = 100  # below the number of jobs that clusters allow one user


class SlurmEngine(Engine):
    """Runs each run as a job. A job that is preempted or times out is queued again and resumes.

    Args:
        processes: jobs at a time, waiting ones too; by default 100 under Slurm, and on this machine
            one per core.
        threads: of each run.
        options: of submitit's `update_parameters`, such as `slurm_partition` and `timeout_min`.
        folder: for job files and their logs, seen by all nodes.
    """

    def __init__(
        self, processes: int | None, threads: int, options: Mapping[str, Any], folder: Path
    ) -> None:
        submitit: Any = require("submitit", "cluster")
        self._executor = submitit.AutoExecutor(folder=folder)
        here = self._executor.cluster == "local"
        usual = {"timeout_min": 240, "cpus_per_task": threads, "name": "offbeat"}
        try:
            self._executor.update_parameters(**{**usual, **options})
        except (NameError, TypeError, ValueError) as error:
            raise InputError(f"submitit does not take these engine_options: {error}") from None
        self.capacity = processes or (max(1, available_cores() // threads) if here else _AT_A_TIME)
        what = "submitit on this machine (no Slurm found)" if here else "Slurm through submitit"
        self.description = f"{what}, {self.capacity} jobs at a time"
        self._given: list[tuple[Any, Job]] = []

    def submit(self, job: Job) -> None:
        """Queues a job."""
        self._given.append((self._executor.submit(_Submitted(), job), job))

    def wait(self, seconds: float) -> list[Ending]:
        """Polls the jobs until one has ended."""
        end = time.monotonic() + seconds
        while True:
            ended = [pair for pair in self._given if pair[0].done()]
            if ended or time.monotonic() >= end:
                break
            time.sleep(min(0.2, max(0.0, end - time.monotonic())))
        self._given = [pair for pair in self._given if pair not in ended]
        return [_ending(*pair) for pair in ended]

    def stop(self) -> None:
        """Cancels all jobs."""
        for submitted, _ in self._given:
            with suppress(Exception):  # it may have ended in between
                submitted.cancel()
        self._given.clear()


class _Submitted:
    """The callable of a job. submitit calls `checkpoint` before a job is preempted."""

    def __call__(self, job: Job) -> Any:
        return attempt(job)

    def checkpoint(self, job: Job) -> Any:
        """Resubmits the same job, which resumes from the checkpoints of its run."""
        from submitit.helpers import DelayedSubmission

        return DelayedSubmission(self, job)


def _ending(submitted: Any, job: Job) -> Ending:
    from submitit.core.utils import FailedJobError, UncompletedJobError

    try:
        return Ending(job, submitted.result())
    except FailedJobError:
        raise  # `attempt` catches everything else: the node can't run Offbeat
    except UncompletedJobError:
        return Ending(job, lost=True)
