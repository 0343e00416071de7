"""Local processes that live as long as the sweep and keep its data in memory."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing import connection
from typing import Any

from offbeat.data.memory import available_memory
from offbeat.data.simulate import available_cores
from offbeat.sweeps.engines.base import Ending, Engine, Job, attempt

_GIB_PER_PROCESS = 2.0  # 100 trajectories of 1000 rows, windows and torch: 1.7 at the peak


class LocalEngine(Engine):
    """Long-lived processes with a few threads each.

    Args:
        processes: how many; by default as many as cores and memory allow.
        threads: of each.
    """

    def __init__(self, processes: int | None, threads: int) -> None:
        self.capacity = processes or max(1, min(available_cores() // threads, _room()))
        self.description = (
            f"{self.capacity} process{'es' * (self.capacity > 1)} of {threads} "
            f"thread{'s' * (threads > 1)}"
        )
        # A fork after torch has computed can hang.
        self._context = multiprocessing.get_context("spawn")
        self._workers: list[_Worker] = []

    def submit(self, job: Job) -> None:
        """Sends the job to an idle process; starts one if there is none."""
        for worker in self._workers:
            if worker.job is None:
                break
        else:
            ours, theirs = self._context.Pipe()
            process = self._context.Process(target=_serve, args=(theirs,), daemon=True)
            process.start()
            theirs.close()
            worker = _Worker(process, ours)
            self._workers.append(worker)
        worker.job = job
        with suppress(OSError):  # it died while idle; `wait` reports the job as lost
            worker.pipe.send(job)

    def wait(self, seconds: float) -> list[Ending]:
        """Waits until a process finishes its job or dies."""
        busy = [(worker, worker.job) for worker in self._workers if worker.job is not None]
        if not busy:
            return []
        signs = [sign for worker, _ in busy for sign in (worker.pipe, worker.process.sentinel)]
        connection.wait(signs, timeout=seconds)
        endings = []
        for worker, job in busy:
            try:
                if worker.pipe.poll():
                    endings.append(Ending(job, worker.pipe.recv()))
                    worker.job = None
                    continue
            except (EOFError, OSError):
                worker.process.join()
            if worker.process.exitcode is not None:
                endings.append(Ending(job, lost=True))
                self._workers.remove(worker)
                worker.pipe.close()
        return endings

    def stop(self) -> None:
        """Ends all processes: idle ones by closing their pipe, others by force."""
        for worker in self._workers:
            worker.pipe.close()
            if worker.job is not None:
                worker.process.kill()
        for worker in self._workers:
            worker.process.join()
        self._workers.clear()


@dataclass(eq=False)
class _Worker:
    process: Any
    pipe: Any
    job: Job | None = None


def _serve(pipe: Any) -> None:
    """Loop of a worker process: runs jobs until the parent process ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent stops this process
    with suppress(ImportError):
        from tqdm import tqdm

        tqdm.set_lock(threading.RLock())  # the default, a semaphore, survives a killed process
    threading.Thread(target=_end_with_parent, daemon=True).start()
    while True:
        try:
            job = pipe.recv()
        except EOFError:
            return
        pipe.send(attempt(job))


def _end_with_parent() -> None:
    """Ends this process when the one that started it ends; for a thread of its own."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _room() -> int:
    """Number of processes that fit in memory, within the limits of the container."""
    free = available_memory()
    return available_cores() if free is None else max(1, int(free / 2**30 / _GIB_PER_PROCESS))
