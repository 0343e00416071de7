"""What an engine is: it takes tasks, and says how each of them ended."""

from __future__ import annotations

import traceback
from abc import ABC, abstractmethod
from dataclasses import dataclass

from offbeat.errors import DivergenceError, OffbeatError
from thesis.execute import Task, execute


@dataclass(frozen=True)
class Failure:
    """Why a task did not succeed, in words that pass between processes.

    Attributes:
        message: one line.
        diverged: True if the training left the finite numbers: other runs go on.
    """

    message: str
    diverged: bool = False


@dataclass(frozen=True)
class Ending:
    """How a task ended.

    Attributes:
        task: the task.
        failure: None if the run is finished.
        lost: the process or machine that ran it is gone; the task can be given again.
    """

    task: Task
    failure: Failure | None = None
    lost: bool = False


class Engine(ABC):
    """Runs tasks somewhere, some at a time.

    Attributes:
        capacity: tasks at a time.
        description: one line for the user.
    """

    capacity: int
    description: str

    @abstractmethod
    def submit(self, task: Task) -> None:
        """Starts a task; not called with more than `capacity` of them under way."""

    @abstractmethod
    def wait(self, seconds: float) -> list[Ending]:
        """Waits until a task has ended, or for so long; returns those that have."""

    @abstractmethod
    def stop(self) -> None:
        """Ends everything that is under way; a run goes on from its last checkpoint later."""


def attempt(task: Task) -> Failure | None:
    """Does a task and says how it went; what engines run in their processes."""
    try:
        execute(task)
    except DivergenceError as error:
        return Failure(f"{task.run.run_id}: {error}", diverged=True)
    except (OffbeatError, OSError) as error:
        return Failure(f"{task.run.run_id}: {error}")
    except Exception:
        return Failure(f"{task.run.run_id}: {traceback.format_exc()}")
    return None
