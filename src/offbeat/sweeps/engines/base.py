"""Interface of engines: take jobs, report how each of them ended."""

from __future__ import annotations

import traceback
from abc import ABC, abstractmethod
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Protocol

from offbeat.errors import DivergenceError, OffbeatError, of_system


class Job(Protocol):
    """A small, picklable task for any process; running it again does not repeat finished work."""

    @property
    def name(self) -> str:
        """Name of the job, unique within an engine."""

    def perform(self) -> None:
        """Does the job, or resumes where a killed process stopped."""


@dataclass(frozen=True)
class Failure:
    """Why a job failed, in a form that can be sent between processes.

    Attributes:
        message: one line.
        error: class of the error.
    """

    message: str
    error: type[OffbeatError] = OffbeatError

    @property
    def diverged(self) -> bool:
        """Whether the training diverged; other runs continue."""
        return issubclass(self.error, DivergenceError)


@dataclass(frozen=True)
class Ending:
    """How a job ended.

    Attributes:
        job: the job.
        failure: None if it is done.
        lost: the process or machine that ran it was lost; the job can be submitted again.
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
    """Runs a job and returns its failure, if any; called by engines in their processes."""
    try:
        job.perform()
    except OffbeatError as error:
        return Failure(f"{job.name}: {error}", type(error))
    except OSError as error:
        return Failure(f"{job.name}: {of_system(error)}")
    except Exception:
        return Failure(f"{job.name}: {traceback.format_exc()}")
    return None


@contextmanager
def threads_of_torch(threads: int) -> Iterator[None]:
    """Sets the number of torch's threads inside the block."""
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        yield
    finally:
        torch.set_num_threads(before)
