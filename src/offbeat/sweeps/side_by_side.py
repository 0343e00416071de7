"""Training runs side by side: each in a process of its own, with one thread."""

from __future__ import annotations

import csv
import multiprocessing
import os
import signal
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from multiprocessing import connection
from pathlib import Path
from typing import Any

import torch
from tqdm import tqdm

from offbeat.config import TrainConfig
from offbeat.data.scaler import Scaler
from offbeat.data.store import load
from offbeat.errors import OffbeatError
from offbeat.models.zoo import make_model
from offbeat.run import EpochRecord
from offbeat.training import fit


@dataclass(frozen=True)
class Job:
    """One model to train, in this process or in another.

    Attributes:
        name: id of the model.
        training: how to train it; its seed draws the weights too.
        scaler: of the scores' units.
        train: file of the training part.
        validation: file of the validation part.
        folder: of the run.
    """

    name: str
    training: TrainConfig
    scaler: Scaler
    train: Path
    validation: Path
    folder: Path

    def run(self, *, progress: bool) -> None:
        """Trains, or goes on training; the same in any process."""
        train, validation = load(self.train), load(self.validation)
        model = make_model(self.name, train, scaler=self.scaler, seed=self.training.seed)
        with one_thread():
            fit(model, train, validation, self.training, out=self.folder, progress=progress)

    def history(self) -> tuple[EpochRecord, ...]:
        """What its log holds so far."""
        log = self.folder / "log.csv"
        if not log.exists():
            return ()
        with log.open(newline="", encoding="utf-8") as file:
            lines = list(csv.DictReader(file))
        return tuple(
            EpochRecord(
                int(line.pop("epoch")),
                int(line.pop("steps")),
                **{name: float(value) for name, value in line.items()},
            )
            for line in lines
        )


def train_side_by_side(jobs: Sequence[Job], *, workers: int, progress: bool = True) -> None:
    """Trains several models; the results do not depend on `workers`.

    Args:
        jobs: the longest first, so that all workers end at about the same time.
        workers: processes; with 1, this process trains.
        progress: show a progress bar.

    Raises:
        OffbeatError: what a run raised, or that its process was ended.
    """
    if workers == 1:
        for job in jobs:
            if progress:
                print(f"training {job.name}", file=sys.stderr)
            job.run(progress=progress)
        return
    waiting, running = list(jobs), dict[Any, tuple[Job, Any, Any]]()
    context = multiprocessing.get_context("spawn")  # a fork after torch has computed can hang
    total = sum(job.training.epochs for job in jobs)
    with tqdm(
        total=total, desc="training", unit="epoch", disable=None if progress else True
    ) as bar:
        try:
            while waiting or running:
                while waiting and len(running) < workers:
                    job = waiting.pop(0)
                    receiver, sender = context.Pipe(duplex=False)
                    process = context.Process(target=_run_apart, args=(job, sender), daemon=True)
                    process.start()
                    sender.close()
                    running[process.sentinel] = (job, process, receiver)
                for sentinel in connection.wait(list(running), timeout=0.5):
                    _collect(*running.pop(sentinel))
                new = sum(len(job.history()) for job in jobs) - bar.n
                if new:
                    names = ", ".join(job.name for job, _, _ in running.values())
                    bar.set_postfix_str(names, refresh=False)
                    bar.update(new)
        finally:
            for _, process, _ in running.values():
                process.terminate()
                process.join()


def _run_apart(job: Job, sender: Any) -> None:
    """A process that trains one model; it ends with the process that started it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # that one stops us
    threading.Thread(target=end_with_parent, daemon=True).start()
    try:
        job.run(progress=False)
    except OffbeatError as error:
        sender.send(error)


def end_with_parent() -> None:
    """Ends this process when the one that started it ends; for a thread of its own."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _collect(job: Job, process: Any, receiver: Any) -> None:
    process.join()
    if receiver.poll():
        with suppress(EOFError):  # it ended without a word
            raise receiver.recv()
    if process.exitcode:
        raise OffbeatError(
            f"the process that trained {job.name!r} ended with exit code {process.exitcode}; run "
            "the same again, it goes on where it was (with workers=1 it needs less memory)"
        )


@contextmanager
def one_thread() -> Iterator[None]:
    """Sums in one order, on any machine; and small steps are faster so."""
    with threads_of_torch(1):
        yield


@contextmanager
def threads_of_torch(threads: int) -> Iterator[None]:
    """So many threads for torch, inside the block."""
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        yield
    finally:
        torch.set_num_threads(before)
