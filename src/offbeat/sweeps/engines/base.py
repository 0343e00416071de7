"""What an engine is: it takes jobs, and says how each of them ended."""

from __future__ import annotations

import traceback
from abc import ABC, abstractmethod
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Protocol

from offbeat.errors import DivergenceError, OffbeatError


class Job(Protocol):
    """Something to do in any process: small, can be pickled, done once however often it runs."""

    @property
    def name(self) -> str:
        """Of the job, unique within an engine."""

    def perform(self) -> None:
        """Does it, or goes on where a process that was killed left off."""


@dataclass(frozen=True)
class Failure:
    """Why a job did not succeed, in words that pass between processes.

    Attributes:
        message: one line.
        error: class of the error.
    """

    message: str
    error: type[OffbeatError] = OffbeatError

    @property
    def diverged(self) -> bool:
        """The training left the finite numbers: other runs go on."""
        return issubclass(self.error, DivergenceError)


@dataclass(frozen=True)
class Ending:
    """How a job ended.

    Attributes:
        job: the job.
        failure: None if it is done.
        lost: the process or machine that ran it is gone; the job can be given again.
    """

    job: Job
    failure: Failure | None = None
    lost: bool = False


class Engine(ABC):
    """Runs jobs somewhere, some at a time.

    Attributes:
        capacity: jobs at a time.
        description: one line for the user.
    """

    capacity: int
    description: str

    @abstractmethod
    def submit(self, job: Job) -> None:
        """Starts a job; not called with more than `capacity` of them under way."""

    @abstractmethod
    def wait(self, seconds: float) -> list[Ending]:
        """Waits until a job has ended, or for so long; returns those that have."""

    @abstractmethod
    def stop(self) -> None:
        """Ends everything that is under way."""


def attempt(job: Job) -> Failure | None:
    """Does a job and says how it went; what engines run in their processes."""
    try:
        job.perform()
    except OffbeatError as error:
        return Failure(f"{job.name}: {error}", type(error))
    except OSError as error:
        return Failure(f"{job.name}: {error}")
    except Exception:
        return Failure(f"{job.name}: {traceback.format_exc()}")
    return None


@contextmanager
def threads_of_torch(threads: int) -> Iterator[None]:
    """So many threads for torch, inside the block."""
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        yield
    finally:
        torch.set_num_threads(before)
