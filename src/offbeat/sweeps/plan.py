"""What a sweep consists of: its runs, and what each of them is made of."""

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
        """Name of the run, and of its folder."""

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
        """Of windows, masks, split and batches: equal for the models of a repeat."""

    @property
    def seed_weights(self) -> int:
        """Of the initial weights."""


class Plan(ABC):
    """The runs of a sweep. A frozen, hashable value that can be sent to another process.

    Attributes:
        file: where a folder keeps the settings that it was begun with.
        noun: what it is called in messages.
        record: class of the record, which names its columns.
        grows: a folder may be gone on with by a plan that has other runs.
    """

    file: ClassVar[str] = "sweep.json"
    noun: ClassVar[str] = "sweep"
    record: ClassVar[type[Record]] = Record
    grows: ClassVar[bool] = False

    @abstractmethod
    def runs(self) -> tuple[Run, ...]:
        """All runs, in the order in which they are begun."""

    @abstractmethod
    def settings(self) -> Mapping[str, Any]:
        """What all runs have in common, JSON-like: a folder is gone on with by the same alone."""

    def models(self) -> Mapping[str, Any]:
        """More settings, of single models: a folder may be gone on with by more of these."""
        return {}

    @abstractmethod
    def simulate(self, *, progress: bool) -> Dataset:
        """The trajectories, where no data set is given."""

    @abstractmethod
    def parts(self, recorded: Dataset, run: Run) -> Parts:
        """Windows, masks and split of a run: equal for the models of a repeat."""

    @abstractmethod
    def scaler(self, recorded: Dataset, train: Dataset) -> Scaler:
        """The scaler of a repeat's models, whose units all of its scores have."""

    @abstractmethod
    def model_config(self, label: str) -> ModelConfig:
        """What the model of a label consists of."""

    @abstractmethod
    def train_config(self, run: Run) -> TrainConfig:
        """How a run is trained; its seed is that of the draw."""

    @abstractmethod
    def provenance(self) -> dict[str, str]:
        """What makes runs in this process: columns of the record."""

    def fingerprint(self, recorded: Dataset) -> str:
        """Of the content of the trajectories."""
        return recorded.fingerprint()

    def draw(self, run: Run) -> Hashable:
        """What the parts of a run depend on."""
        return run.seed_draw

    def steps(self, run: Run) -> int | None:
        """Optimizer steps of a run; None where they are not known before."""
        return None

    def columns(
        self, run: Run, model: BaseModel, test: Dataset, recorded: Dataset
    ) -> dict[str, Any]:
        """More columns of a run's row.

        Args:
            run: which run.
            model: as it was trained.
            test: its test part.
            recorded: the trajectories.
        """
        return {}
