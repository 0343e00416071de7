"""Models of one data set trained side by side: each in a process of its own, with one thread."""

from __future__ import annotations

import csv
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from offbeat.config import TrainConfig
from offbeat.data.scaler import Scaler
from offbeat.data.store import load
from offbeat.errors import FileFormatError, OffbeatError
from offbeat.models.zoo import make_model, recipe_of
from offbeat.progress import progress_bar
from offbeat.run import EpochRecord
from offbeat.sweeps.engines import base
from offbeat.sweeps.engines.local import LocalEngine
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

    def perform(self, *, progress: bool = False) -> None:
        """Trains, or resumes training; the same in any process."""
        train, validation = load(self.train), load(self.validation)
        model = make_model(self.name, train, scaler=self.scaler, seed=self.training.seed)
        with one_thread():
            fit(model, train, validation, self.training, out=self.folder, progress=progress)

    def history(self) -> tuple[EpochRecord, ...]:
        """The epochs in its log so far."""
        log = self.folder / "log.csv"
        if not log.exists():
            return ()
        try:
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
        except (KeyError, OverflowError, TypeError, ValueError, csv.Error) as error:
            raise FileFormatError(
                f"{log} is damaged ({str(error)[:150]}); remove its folder, and the model is "
                "trained again"
            ) from None


def train_side_by_side(jobs: Sequence[Job], *, workers: int, progress: bool = True) -> None:
    """Trains several models; the results do not depend on `workers`.

    Args:
        jobs: the longest first, so that all workers end at about the same time.
        workers: processes; with 1, this process trains.
        progress: show a progress bar.

    Raises:
        OffbeatError: a run raised it, or its process was killed.
    """
    if workers == 1:
        for job in jobs:
            if progress:
                print(f"training {job.name}", file=sys.stderr)
            job.perform(progress=progress)
        return
    waiting, running = list(jobs), list[str]()
    engine = LocalEngine(workers, 1)
    total = sum(recipe_of(job.name, job.training, validated=True).epochs for job in jobs)
    with progress_bar(total=total, desc="training", unit="epoch", show=progress) as bar:
        try:
            while waiting or running:
                while waiting and len(running) < workers:
                    running.append(waiting[0].name)
                    engine.submit(waiting.pop(0))
                for ending in engine.wait(0.5):
                    running.remove(ending.job.name)
                    raise_failure(ending)
                new = sum(len(job.history()) for job in jobs) - bar.n
                if new:
                    bar.set_postfix_str(", ".join(running), refresh=False)
                    bar.update(new)
        finally:
            engine.stop()


def raise_failure(ending: base.Ending) -> None:
    """Raises the error of a job that failed."""
    if ending.failure is not None:
        raise ending.failure.error(ending.failure.message)
    if ending.lost:
        raise OffbeatError(
            f"the process that trained {ending.job.name!r} was killed; run the same again to "
            "resume (workers=1 needs less memory)"
        )


@contextmanager
def one_thread() -> Iterator[None]:
    """Uses one thread: sums in one order on any machine, and small steps are faster."""
    with base.threads_of_torch(1):
        yield
