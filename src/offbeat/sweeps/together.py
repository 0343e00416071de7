"""Runs of equal shape that are trained together: threads of one process that take steps at once.

Each run keeps its own training: its data, log, checkpoints and validation. Only the steps of the
optimizer meet: when all runs of a group have come to their next one, it is one step of
`StackedModels`, one launch on a GPU.
"""

from __future__ import annotations

import threading
from collections.abc import Sequence
from contextvars import copy_context
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from offbeat.config import Recipe
from offbeat.errors import DivergenceError
from offbeat.examples import Examples
from offbeat.kernels import StepTable
from offbeat.kernels.triton import backend as triton_backend
from offbeat.models.model import Model
from offbeat.run import RunState
from offbeat.sweeps.engines.base import Ending, Engine, Failure, Job, threads_of_torch
from offbeat.sweeps.stacked import StackedModels
from offbeat.sweeps.task import Task
from offbeat.training import STEPS

ON_A_GPU = 32
"""Runs that are trained together by default where that pays."""


def default_together(device: str) -> int:
    """How many runs of equal shape to train together: 1 where it does not pay.

    Args:
        device: that models are trained on.
    """
    on_gpu = device.partition(":")[0] == "cuda"  # of this machine or of another one
    return ON_A_GPU if on_gpu and not triton_backend.why_not() else 1


@dataclass(eq=False)
class _Step:
    """A step that a run asks for, and what became of it."""

    number: int
    model: Model
    examples: Examples
    index: Tensor
    state: RunState
    recipe: Recipe
    loss: Tensor | None = None
    error: Exception | None = None

    @property
    def shape(self) -> tuple[Any, ...]:
        """Steps of one shape can be one step."""
        rows = self.examples.prepared.take(self.index).rows
        recipe = self.recipe
        return self.model.spec, len(self.index), rows, recipe.loss_scale, recipe.clip_norm


class Rendezvous:
    """Where the steps of several trainings meet.

    Args:
        runs: that take part until they `leave`.
    """

    def __init__(self, runs: int) -> None:
        self._left, self._asked = runs, list[_Step]()
        self._changed = threading.Condition()

    def take(self, step: _Step) -> Tensor:
        """Waits until all other runs have come to a step, too; returns the loss before it."""
        with self._changed:
            self._asked.append(step)
            self._take_all()
            while step.loss is None and step.error is None:
                self._changed.wait()
        if step.error is not None:
            raise step.error
        assert step.loss is not None
        return step.loss

    def leave(self) -> None:
        """Ends the part of a run, in whatever way the run has ended."""
        with self._changed:
            self._left -= 1
            self._take_all()

    def _take_all(self) -> None:
        if not self._asked or len(self._asked) < self._left:
            return
        # The order in which threads come must not matter.
        asked, self._asked = sorted(self._asked, key=lambda step: step.number), []
        groups: dict[tuple[Any, ...], list[_Step]] = {}
        for step in asked:
            groups.setdefault(step.shape, []).append(step)
        for group in groups.values():
            try:
                with torch.enable_grad():
                    losses = StackedModels(
                        [step.model for step in group],
                        [step.examples for step in group],
                        [step.state for step in group],
                        group[0].recipe,
                    ).step([step.index for step in group])
                for step, loss in zip(group, losses, strict=True):
                    step.loss = loss
            except Exception as error:
                for step in group:
                    step.error = error
        self._changed.notify_all()


@dataclass(frozen=True, eq=False)
class Member:
    """The part of one run in a rendezvous; `STEPS` of its training.

    Attributes:
        rendezvous: of its group.
        number: of the run in the group.
    """

    rendezvous: Rendezvous
    number: int

    def takes(self, model: Any, examples: Any) -> bool:
        """Whether steps of a training can be taken with others."""
        table = type(examples) is Examples and isinstance(examples.prepared, StepTable)
        return table and type(model) is Model and not model.needs_generator

    def step(
        self, model: Any, examples: Any, index: Tensor, state: RunState, recipe: Recipe
    ) -> Tensor:
        """Takes a step with the others; returns the loss before it."""
        return self.rendezvous.take(_Step(self.number, model, examples, index, state, recipe))


@dataclass(frozen=True)
class Group:
    """Runs of equal shape; a job of an engine.

    Attributes:
        tasks: of the runs.
    """

    tasks: tuple[Task, ...]

    @property
    def name(self) -> str:
        """The names of the runs."""
        return " + ".join(task.name for task in self.tasks)

    def perform(self) -> None:
        """Performs all runs; those that can be finished are, if another one fails.

        Raises:
            OffbeatError: the first of the runs that failed, a diverged one last.
        """
        rendezvous, errors = Rendezvous(len(self.tasks)), list[Exception]()

        def run(number: int) -> None:
            STEPS.set(Member(rendezvous, number))
            try:
                self.tasks[number].perform()
            except Exception as error:
                errors.append(error)
            finally:
                rendezvous.leave()

        with threads_of_torch(self.tasks[0].threads):
            threads = [
                threading.Thread(target=copy_context().run, args=(run, i), daemon=True)
                for i in range(len(self.tasks))
            ]
            for thread in threads:
                thread.start()
            for thread in threads:
                thread.join()
        if errors:
            raise min(errors, key=lambda error: isinstance(error, DivergenceError))


class TogetherEngine(Engine):
    """Sends runs of equal shape to an engine as one job.

    Args:
        engine: runs the groups.
        most: runs of a group.
    """

    def __init__(self, engine: Engine, most: int) -> None:
        self._engine, self._most = engine, most
        self.capacity = engine.capacity * most
        self.description = f"{engine.description}, up to {most} runs of equal shape in each"
        self._waiting: list[Task] = []
        self._busy = 0

    def submit(self, job: Job) -> None:
        """Takes a run; it starts with the next `wait`."""
        assert isinstance(job, Task)
        self._waiting.append(job)

    def wait(self, seconds: float) -> list[Ending]:
        """Starts groups, and waits until one has ended; returns an ending for each of its runs."""
        while self._waiting and self._busy < self._engine.capacity:
            shape = _shape(self._waiting[0])
            same = [task for task in self._waiting if _shape(task) == shape][: self._most]
            self._waiting = [task for task in self._waiting if task not in same]
            self._engine.submit(Group(tuple(same)))
            self._busy += 1
        endings = []
        for ending in self._engine.wait(seconds):
            assert isinstance(ending.job, Group)
            self._busy -= 1
            endings += [_ending(task, ending) for task in ending.job.tasks]
        return endings

    def stop(self) -> None:
        """Ends everything that is under way."""
        self._waiting.clear()
        self._engine.stop()


def _shape(task: Task) -> Sequence[Any]:
    """Runs of one shape have equal models and trainings, but for their seeds."""
    training = replace(task.plan.train_config(task.run), seed=0)
    return task.plan.model_config(task.run.model), training


def _ending(task: Task, group: Ending) -> Ending:
    if task.result() is not None:
        return Ending(task)
    failure = group.failure
    if failure is None and not group.lost:
        failure = Failure(f"{task.name} has no result although its group ended")
    return Ending(task, failure, group.lost)
