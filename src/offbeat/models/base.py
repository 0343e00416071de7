"""The base class of models: batches of their data, predictions and a loss."""

from __future__ import annotations

from collections.abc import Sized
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from offbeat.data.batch import Batch
from offbeat.data.scaler import Scaler
from offbeat.data.trajectory import EXOGENOUS, Dataset
from offbeat.data.transforms import Transforms
from offbeat.errors import InputError
from offbeat.models.statistics import Statistics
from offbeat.parts.heads import Prediction


@dataclass(frozen=True, eq=False)
class DataInfo:
    """Properties of the data that a model is made for; saved with it.

    Attributes:
        names: channel names, which data must match.
        units: channel units.
        roles: per channel `state`, `action` or `exogenous`.
        scaler: maps original units to the scaled ones that the model works in.
        statistics: measured on the training set.
        transforms: input transforms of the data.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    roles: tuple[str, ...]
    scaler: Scaler
    statistics: Statistics
    transforms: Transforms = field(default_factory=Transforms.identity)

    @property
    def channels(self) -> int:
        """Number of channels."""
        return len(self.names)


class Prepared(Sized, Protocol):
    """A data set in the form that `BaseModel.run` takes, or parts of it."""

    def take(self, index: Tensor) -> Any:
        """Some trajectories.

        Args:
            index: (batch,) positions, int64.
        """


class BaseModel(nn.Module):
    """Base class of models: the interface for fitting, scoring and predicting.

    A subclass defines `prepare` and `run`, or only `forward`.

    Args:
        name: of its registry entry, shown in tables.
        data: properties of the data that it is made for.
    """

    mean: Tensor
    std: Tensor

    def __init__(self, name: str, data: DataInfo) -> None:
        super().__init__()
        self.name, self.data = name, data
        self.names, self.units, self.roles = data.names, data.units, data.roles
        self.scaler, self.statistics = data.scaler, data.statistics
        self.transforms, self.channels = data.transforms, data.channels
        self.register_buffer("mean", torch.tensor(data.statistics.mean), persistent=False)
        self.register_buffer("std", torch.tensor(data.statistics.std), persistent=False)

    @property
    def dtype(self) -> torch.dtype:
        """That of the trained parameters."""
        return self.mean.dtype

    @property
    def device(self) -> torch.device:
        """That of the trained parameters."""
        return self.mean.device

    @property
    def predicted(self) -> NDArray[np.bool_]:
        """(channels,) True where the channel is predicted; exogenous ones are not."""
        return np.array([role != EXOGENOUS for role in self.roles])

    @property
    def needs_generator(self) -> bool:
        """Whether a prediction draws random numbers."""
        return False

    def expect_silences(self, seconds: float) -> None:
        """Lets the model know of longer silences than those in the data that it was made for.

        The clock of a model saturates at a multiple of the longest time since observation.

        Args:
            seconds: longest time since observation that it is going to meet in training.
        """
        known = self.statistics
        self.statistics = replace(
            known,
            longest_elapsed=max(known.longest_elapsed, seconds),
            longest_delta=max(known.longest_delta, seconds),
        )
        self.data = replace(self.data, statistics=self.statistics)

    def batch(self, dataset: Dataset) -> Batch:
        """Transforms, scales and pads a data set of this model's channels, in any order.

        Actions that the model does not have are left out.

        Returns:
            The batch, on the model's device.

        Raises:
            InputError: channels differ from the model's, or their units where the data has any.
        """
        dataset = of_channels(dataset, self.names, self.units)
        dataset = self.transforms.apply(dataset)
        batch = Batch.of(dataset, scaler=self.scaler, dtype=self.dtype, roles=self.roles)
        return batch.to(self.device)

    def prepare(self, batch: Batch) -> Prepared:
        """Computes the input of `run` from a batch, once per data set.

        Args:
            batch: scaled.
        """
        return batch

    def run(self, prepared: Any, *, generator: torch.Generator | None = None) -> Prediction:
        """Predicts every row of prepared data from earlier observations.

        Args:
            prepared: from `prepare`, whole or some trajectories of it.
            generator: of random numbers, for models that need one.
        """
        prediction: Prediction = self(prepared)
        return prediction

    def loss(self, prediction: Prediction, target: Tensor, mask: Tensor | None) -> Tensor:
        """Mean squared error over the entries that count; see `parts.Head.loss`."""
        squared = (prediction.mean - target).square()
        if mask is None:
            return squared.mean()
        return (squared * mask).sum() / mask.sum().clamp_min(1)

    def backend(self) -> tuple[str, str]:
        """The backend that runs this model, and the reason."""
        return "torch", "a registered module"

    def threads(self) -> AbstractContextManager[None]:
        """A context manager that assigns the threads for training this model."""
        return nullcontext()

    def save(self, path: str | Path) -> None:
        """Writes the model to a folder, atomically: `model.safetensors` and `config.json`.

        Args:
            path: the folder; an existing one is replaced.
        """
        from offbeat.models.checkpoint import save_model

        save_model(self, path)

    def save_pretrained(self, path: str | Path, *, card: str | None = None) -> None:
        """Writes the model and a card, `README.md`, to a folder.

        Args:
            path: the folder; a model in it is replaced.
            card: Markdown; by default what is known from the model itself.
        """
        from offbeat.models.hub import save_pretrained

        save_pretrained(self, path, card=card)

    @staticmethod
    def from_pretrained(name: str | Path, *, revision: str | None = None) -> Any:
        """Reads a model from a folder, the package or the Hugging Face Hub.

        Args:
            name: a folder; `offbeat/NAME`, as `offbeat models` lists; or `OWNER/NAME` of the hub.
            revision: branch, tag or commit of the hub.

        Raises:
            FileFormatError: as `load_model`.
            InputError: the name is none of these, or the hub has no such repository.
            MissingExtraError: huggingface-hub is not installed, for a name of the hub.
            OffbeatError: the hub is out of reach.
        """
        from offbeat.models.hub import from_pretrained

        return from_pretrained(name, revision=revision)

    def push_to_hub(self, repository: str, **options: Any) -> str:
        """Uploads the model and a card to the Hugging Face Hub; returns the address of the commit.

        Args:
            repository: `OWNER/NAME`; made where there is none.
            **options: `card`, `private`, `token`, as of `offbeat.models.hub.push_to_hub`.

        Raises:
            InputError: the name is none of a repository.
            MissingExtraError: huggingface-hub is not installed.
            OffbeatError: the hub refuses, or is out of reach.
        """
        from offbeat.models.hub import push_to_hub

        return push_to_hub(self, repository, **options)


def of_channels(dataset: Dataset, names: tuple[str, ...], units: tuple[str, ...]) -> Dataset:
    """A data set with the channels that a model was made for, in their order.

    Actions that are not among them are left out.

    Args:
        dataset: given.
        names: of the model's channels.
        units: of the model's channels.

    Raises:
        InputError: channels differ, or their units where the data has any.
    """
    dataset = dataset.without_actions_but(names)
    own = dict(zip(names, units, strict=True))
    given = dict(zip(dataset.names, dataset.units, strict=True))
    agree = own.keys() == given.keys() and all(
        unit in ("", own[name]) or not own[name] for name, unit in given.items()
    )
    if not agree:
        raise InputError(f"the model was made for other channels: {_difference(own, given)}")
    return dataset if dataset.names == names else dataset.select(names)


def _difference(own: dict[str, str], given: dict[str, str]) -> str:
    """The differences between the channels of the data and of the model."""
    units = (
        f"{name} is in {given[name]}, not {unit}"
        for name, unit in own.items()
        if given.get(name, "") not in ("", unit)
    )
    named = {
        "the data lacks": own.keys() - given.keys(),
        "the model does not know": given.keys() - own.keys(),
    }
    parts = [f"{what} {', '.join(sorted(names))}" for what, names in named.items() if names]
    return "; ".join([*parts, *units]) + "; give it the channels it was made for"
