"""What every baseline is: fitted on tasks in closed form, and asked like a model."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from contextvars import ContextVar
from dataclasses import dataclass
from types import ModuleType
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from offbeat.data.trajectory import Dataset
from offbeat.errors import InputError
from offbeat.registry import Registry

Array = NDArray[np.float64]
State = dict[str, Any]
"""Arrays whose first axis is the batch. Nothing in it depends on the times that are asked."""

CHUNK = 256
"""Trajectories that are stepped through together."""

READ_AT_ONCE = 1024
"""Rows of all these trajectories that are read together, about."""

_batch: ContextVar[int] = ContextVar("batch", default=0)
"""Trajectories whose rows are read together."""


class Baseline(ABC):
    """A predictor of every channel, fitted in closed form.

    A task is a trajectory with masked values. A causal baseline predicts each row from what was
    observed strictly before it. Another one uses everything observed, and only its predictions of
    values that are not observed matter. A forecast is a task whose last rows are masked, and a fill
    one whose inner rows are, so one method answers all of them.

    Attributes:
        causal: whether a prediction uses only what was observed before its row.
        flexible: whether it has so many parameters that its errors on the tasks it was fitted to
            are smaller than those on others; then weights are fitted to cross-validated errors.
        located: whether it depends on where a channel is, so that it says little out of the range
            of training.
        slow: whether its fit takes much longer than those of the others; then it is used where it
            is asked for by name.
        cost: time of its fits and predictions, about, relative to those of `damped_slope`.
        mean: (channels,) mean of the observed values of training, in units of the channels.
        scale: (channels,) their standard deviation; 1 where a channel is constant.
    """

    causal: ClassVar[bool] = True
    flexible: ClassVar[bool] = False
    located: ClassVar[bool] = False
    slow: ClassVar[bool] = False
    cost: ClassVar[float] = 1.0

    mean: Array
    scale: Array

    def fit(self, tasks: Dataset) -> Baseline:
        """Fits to training data; returns itself.

        Args:
            tasks: trajectories; their observed values are inputs, and all known ones are targets.
        """
        self.mean, self.scale = moments(tasks)
        self.estimate(tasks)
        return self

    def estimate(self, tasks: Dataset) -> None:  # noqa: B027  # most have nothing to estimate
        """Estimates whatever else a baseline has; `mean` and `scale` are there already.

        Args:
            tasks: as of `fit`.
        """

    @abstractmethod
    def predict(self, dataset: Dataset) -> list[Array]:
        """Predicts every row.

        Args:
            dataset: trajectories of the channels that it was fitted to; masked values are not used.

        Returns:
            (rows, channels) per trajectory, in original units. Where no observation may be used,
            the training mean.
        """

    def arrays(self) -> dict[str, Array]:
        """Everything that `fit` found, by name: what is saved, and what `restore` takes."""
        return {"mean": self.mean, "scale": self.scale}

    def restore(self, arrays: Mapping[str, Array]) -> Baseline:
        """The inverse of `arrays`; returns itself.

        Args:
            arrays: of a fitted baseline of the same class.
        """
        for name, value in arrays.items():
            setattr(self, name, np.asarray(value))
        return self


class CausalBaseline(Baseline):
    """A baseline with a state that only observations change, so that it also runs in a stream.

    The three methods work on NumPy arrays and on torch tensors alike, by `namespace`.
    """

    @abstractmethod
    def start(self, like: Any) -> State:
        """The state before the first row.

        Args:
            like: (batch, channels) zeros: shape, kind and type of the state's arrays.
        """

    @abstractmethod
    def observe(self, state: State, time: Any, values: Any, mask: Any) -> State:
        """The state after a row.

        Args:
            state: before the row.
            time: (batch, 1) s, since the start of the trajectory.
            values: (batch, channels) in original units; anything where not observed.
            mask: (batch, channels) bool, True where observed.

        Returns:
            A new state; where nothing is observed, equal to the old one.
        """

    @abstractmethod
    def read(self, state: State, time: Any) -> Any:
        """The prediction from a state.

        Args:
            state: of what was observed.
            time: (batch, 1) s, later than all of it.

        Returns:
            (batch, channels) in original units.
        """

    def predict(self, dataset: Dataset) -> list[Array]:
        """Predicts every row; see `Baseline.predict`."""
        return [
            read
            for rows in padded(dataset)
            for read, trajectory in zip(stepped(self, rows), rows.lengths, strict=True)
            for read in [read[:trajectory]]
        ]


@dataclass(frozen=True, eq=False)
class Rows:
    """Trajectories of equal channels, padded to the longest.

    Attributes:
        times: (batch, rows) s since the start of each trajectory; repeated in padding.
        values: (batch, rows, channels) in original units, 0 where not known.
        observed: (batch, rows, channels) bool, False in padding.
        known: (batch, rows, channels) bool, False in padding.
        lengths: rows of each trajectory.
    """

    times: Array
    values: Array
    observed: NDArray[np.bool_]
    known: NDArray[np.bool_]
    lengths: tuple[int, ...]


def padded(dataset: Dataset, size: int = CHUNK) -> Iterator[Rows]:
    """Chunks of a data set as arrays, in its order.

    Args:
        dataset: to convert.
        size: trajectories of a chunk.
    """
    for first in range(0, len(dataset), size):
        part = dataset[first : first + size]
        shape = (len(part), max(t.rows for t in part))
        times, values = np.zeros(shape), np.zeros((*shape, dataset.channels))
        observed = np.zeros(values.shape, dtype=bool)
        known = np.zeros(values.shape, dtype=bool)
        for i, t in enumerate(part):
            times[i, : t.rows] = t.times - t.times[0]
            times[i, t.rows :] = times[i, t.rows - 1]
            known[i, : t.rows] = t.known
            observed[i, : t.rows] = t.observed
            values[i, : t.rows] = np.where(t.known, t.values, 0.0)
        yield Rows(times, values, observed, known, tuple(t.rows for t in part))


def stepped(machine: Any, rows: Rows) -> Array:
    """Reads a machine at every row, from what was observed before it.

    Args:
        machine: with the methods `start`, `observe` and `read` of `CausalBaseline`; what it reads
            may have further axes.
        rows: to step through.

    Returns:
        (batch, rows, ...) what was read.
    """
    batch, length, channels = rows.values.shape
    state = machine.start(np.zeros((batch, channels)))
    reads = []
    # A machine reads many rows of a long trajectory at once, as if they were a batch.
    together = max(READ_AT_ONCE // batch, 1)
    for first in range(0, length, together):
        states, some = [], slice(first, first + together)
        for i in range(first, min(first + together, length)):
            states.append(state)
            if rows.observed[:, i].any():
                time = rows.times[:, i, None]
                state = machine.observe(state, time, rows.values[:, i], rows.observed[:, i])
        before = _batch.set(batch)
        read = machine.read(_concatenated(states), rows.times[:, some].T.reshape(-1, 1))
        _batch.reset(before)
        reads.append(np.moveaxis(read.reshape(-1, batch, *read.shape[1:]), 0, 1))
    return np.concatenate(reads, axis=1)


def product(rows: Any, weights: Any) -> Any:
    """The matrix product of what is read, with weights.

    Its bits do not depend on how many rows are read together: a product of another shape may add in
    another order.

    Args:
        rows: (batch, inputs), or several times as many where rows are read together.
        weights: (inputs, outputs).
    """
    batch = _batch.get()
    if not batch or len(rows) == batch:
        return rows @ weights
    each = rows.reshape(-1, batch, rows.shape[1]) @ weights
    return each.reshape(len(rows), -1)


def _concatenated(states: Sequence[State]) -> State:
    """States of equal form as those of one batch."""
    if len(states) == 1:
        return states[0]
    return {
        name: _concatenated([state[name] for state in states])
        if isinstance(value, dict)
        else np.concatenate([state[name] for state in states])
        for name, value in states[0].items()
    }


def moments(dataset: Dataset) -> tuple[Array, Array]:
    """Mean and standard deviation of the observed values of each channel.

    Args:
        dataset: of training.

    Returns:
        (channels,) each; 0 and 1 for a channel that is never observed, and a deviation of 1 for one
        that is constant.
    """
    count = sum(t.observed.sum(axis=0) for t in dataset)
    many = np.maximum(count, 1)
    mean = sum(np.where(t.observed, t.values, 0.0).sum(axis=0) for t in dataset) / many
    squares = sum((np.where(t.observed, t.values - mean, 0.0) ** 2).sum(axis=0) for t in dataset)
    scale = np.sqrt(squares / many)
    return np.asarray(mean), np.where(scale > 1e-12 * np.maximum(np.abs(mean), 1e-300), scale, 1.0)


def namespace(array: Any) -> ModuleType:
    """NumPy, or torch for a tensor: `where`, `exp`, `clip` and the like of the right kind.

    Args:
        array: of a state.
    """
    if isinstance(array, np.ndarray):
        return np
    import torch

    return torch


def as_kind(array: Array, like: Any) -> Any:
    """A fitted array as an array or tensor of the kind of another one."""
    if isinstance(like, np.ndarray):
        return array
    import torch

    return torch.as_tensor(array, dtype=like.dtype, device=like.device)


def channels_of(like: Any) -> Any:
    """(channels,) numbers of the channels, an index for tables.

    Args:
        like: (..., channels) array or tensor.
    """
    xp = namespace(like)
    return xp.arange(like.shape[-1])


def as_index(numbers: Any) -> Any:
    """Whole numbers as an index for tables, int64.

    Args:
        numbers: array or tensor of floats.
    """
    return numbers.astype(np.int64) if isinstance(numbers, np.ndarray) else numbers.long()


BASELINES: Registry[type[Baseline]] = Registry("baseline", group="offbeat.baselines")
"""Classes of baselines by name. A class is made without arguments and then fitted."""


def fit_baseline(name: str, tasks: Dataset) -> Baseline:
    """Makes and fits a baseline.

    Args:
        name: of the registry.
        tasks: as of `Baseline.fit`.

    Raises:
        InputError: there is no such baseline.
    """
    return BASELINES[name]().fit(tasks)


def causal_baselines() -> tuple[str, ...]:
    """Names of the baselines that use only the past."""
    return tuple(name for name, kind in BASELINES.items() if kind.causal)


def checked_causal(name: str) -> type[Baseline]:
    """The class of a baseline that forecasts.

    Raises:
        InputError: there is none of that name, or it uses the future.
    """
    if not BASELINES[name].causal:
        raise InputError(
            f"the baseline {name!r} uses the future and cannot forecast; choose one of "
            f"{', '.join(causal_baselines())}"
        )
    return BASELINES[name]
