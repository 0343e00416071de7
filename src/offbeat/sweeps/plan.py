"""Interface of a sweep's plan: its runs, and the data and configuration of each."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Hashable, Mapping
from typing import TYPE_CHECKING, Any, ClassVar, Protocol

from offbeat.config import ModelConfig, TrainConfig
from offbeat.sweeps.record import Record

if TYPE_CHECKING:
    from offbeat.data.scaler import Scaler
    from offbeat.data.trajectory import Dataset
    from offbeat.models.base import BaseModel

Parts = tuple["Dataset", "Dataset", "Dataset"]
"""Training, validation and test part."""


class Run(Protocol):
    """One training and its scores, a frozen dataclass."""

    @property
    def run_id(self) -> str:
        """Name of the run and of its folder."""

    @property
    def model(self) -> str:
        """Label of the model."""

    @property
    def repeat(self) -> int:
        """Counted from 0."""

    @property
    def epochs(self) -> int:
        """Passes over the training part."""

    @property
    def seed_draw(self) -> int:
        """Seed of windows, masks, split and batches: equal for the models of a repeat."""

    @property
    def seed_weights(self) -> int:
        """Seed of the initial weights."""


class Plan(ABC):
    """The runs of a sweep. A frozen, hashable value that can be sent to another process.

    Attributes:
        file: where a folder keeps the settings that it was created with.
        noun: what it is called in messages.
        record: class of the record, which names its columns.
        grows: whether a folder can be continued by a plan that has other runs.
    """

    file: ClassVar[str] = "sweep.json"
    noun: ClassVar[str] = "sweep"
    record: ClassVar[type[Record]] = Record
    grows: ClassVar[bool] = False

    @abstractmethod
    def runs(self) -> tuple[Run, ...]:
        """All runs, in the order in which they are started."""

    @abstractmethod
    def settings(self) -> Mapping[str, Any]:
        """Settings of all runs, JSON-like; a folder is continued only with equal ones."""

    def models(self) -> Mapping[str, Any]:
        """Settings of single models; a folder can be continued with more models."""
        return {}

    @abstractmethod
    def simulate(self, *, progress: bool) -> Dataset:
        """The trajectories, where no data set is given."""

    @abstractmethod
    def parts(self, recorded: Dataset, run: Run) -> Parts:
        """Windows, masks and split of a run: equal for the models of a repeat."""

    @abstractmethod
    def scaler(self, recorded: Dataset, train: Dataset) -> Scaler:
        """The scaler of a repeat's models, which defines the units of all of its scores."""

    @abstractmethod
    def model_config(self, label: str) -> ModelConfig:
        """Configuration of the model of a label."""

    @abstractmethod
    def train_config(self, run: Run) -> TrainConfig:
        """Training configuration of a run; its seed is that of the draw."""

    @abstractmethod
    def provenance(self) -> dict[str, str]:
        """Code, processor and libraries of this process, as columns of the record."""

    def fingerprint(self, recorded: Dataset) -> str:
        """Fingerprint of the content of the trajectories."""
        return recorded.fingerprint()

    def draw(self, run: Run) -> Hashable:
        """What the parts of a run depend on."""
        return run.seed_draw

    def steps(self, run: Run) -> int | None:
        """Optimizer steps of a run; None if not known in advance."""
        return None

    def columns(
        self, run: Run, model: BaseModel, test: Dataset, recorded: Dataset
    ) -> dict[str, Any]:
        """Additional columns of a run's row.

        Args:
            run: which run.
            model: as it was trained.
            test: its test part.
            recorded: the trajectories.
        """
        return {}
