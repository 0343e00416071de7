"""Training on data larger than memory: the windows of an epoch, group after group of files.

The files of a folder are shuffled by seed and epoch, and taken in groups whose windows fit into
half of the cache. The windows of a group are shuffled together, so that a batch mixes many files.
While the model is trained on one group, a thread reads the next. So the order of batches is a
function of the seed, the epoch, and how the folder was opened.
"""

from __future__ import annotations

from concurrent.futures import Future, ThreadPoolExecutor

import numpy as np
import torch
from torch import Tensor

from offbeat.config import Recipe
from offbeat.data.batch import Batch
from offbeat.data.redraw import Redrawn, redraw
from offbeat.data.shards import ShardedDataset
from offbeat.errors import InputError
from offbeat.examples import RedrawnExamples, Reference
from offbeat.models.base import BaseModel

# Streams of random numbers of an epoch: (seed, stream, epoch, ...).
_SHARDS, _STARTS, _MASKS, _ORDER = range(11, 15)


class ShardedEpoch:
    """The windows of one epoch, by their turn.

    Args:
        model: its scales and statistics give the step inputs.
        data: the folder.
        recipe: with the seed, and how masks are drawn anew.
        epoch: counted from 0.
        reader: reads groups ahead.
        reference: of the relative loss; None for that of the model's head.
    """

    def __init__(
        self,
        model: BaseModel,
        data: ShardedDataset,
        recipe: Recipe,
        epoch: int,
        *,
        reader: ThreadPoolExecutor,
        reference: Reference | None = None,
    ) -> None:
        self._model, self._data, self._recipe, self._epoch = model, data, recipe, epoch
        self._reader, self._reference = reader, reference
        self.groups = groups_of(data, seed=recipe.seed, epoch=epoch)
        counts = [sum(data.windows_of(data.shards[i]) for i in group) for group in self.groups]
        self._ends = np.cumsum(counts)
        self._loaded: dict[int, Future[tuple[RedrawnExamples, Tensor]]] = {}

    def __len__(self) -> int:
        return int(self._ends[-1])

    def loss(self, model: BaseModel, index: Tensor, generator: torch.Generator | None) -> Tensor:
        """The model's loss of the one-step-ahead prediction of some windows.

        Args:
            model: in its current state.
            index: (batch,) turns of the windows in this epoch, increasing.
            generator: of self-feeding.
        """
        return self.weighed(model, index, generator)[0]

    def weighed(
        self, model: BaseModel, index: Tensor, generator: torch.Generator | None
    ) -> tuple[Tensor, Tensor]:
        """The loss, and how many values it is the mean of; as `Examples.weighed`."""
        turns = index.cpu().numpy()
        of = np.searchsorted(self._ends, turns, side="right")
        found = []
        for group in np.unique(of).tolist():  # two where a batch lies across their border
            examples, order = self._group(group)
            first = 0 if group == 0 else int(self._ends[group - 1])
            some = order[torch.from_numpy(turns[of == group] - first)]
            found.append(examples.weighed(model, some, generator))
        if len(found) == 1:
            return found[0]
        count = torch.stack([n for _, n in found]).sum()
        return torch.stack([loss * n for loss, n in found]).sum() / count.clamp_min(1e-12), count

    def _group(self, group: int) -> tuple[RedrawnExamples, Tensor]:
        """The examples of a group and their order; the next group is read meanwhile."""
        for old in [g for g in self._loaded if g < group]:
            del self._loaded[old]
        for g in (group, group + 1):
            if g not in self._loaded and g < len(self.groups):
                self._loaded[g] = self._reader.submit(self._read, g)
        return self._loaded[group].result()

    def _read(self, group: int) -> tuple[RedrawnExamples, Tensor]:
        seed, drawn = self._recipe.seed, self._recipe.redraw
        batches = []
        for i in self.groups[group]:
            starts = None
            if drawn is not None:
                starts = np.random.default_rng([seed, _STARTS, self._epoch, i])
            batches.append(self._model.batch(self._data.windows(i, starts)))
        whole = Batch.joined(batches)
        del batches
        order = np.random.default_rng([seed, _ORDER, self._epoch, group]).permutation(len(whole))
        if drawn is None:
            every = torch.ones((len(whole), whole.rows, 1), dtype=torch.bool)
            start = torch.zeros(len(whole), dtype=torch.int64)
            masked = Redrawn(whole, start.to(whole.mask.device), every.to(whole.mask.device))
        else:
            masked = redraw(whole, drawn, seed=[seed, _MASKS, self._epoch, group])
        turns = torch.from_numpy(order)
        return RedrawnExamples(masked, turns, reference=self._reference), turns


class ShardedTrainingSet:
    """The examples of every epoch of a folder; the same methods as of `TrainingSet`.

    Args:
        model: that is trained.
        train: the folder.
        recipe: with the seed, and how masks are drawn anew.
        reference: of the relative loss; None for that of the model's head.
    """

    def __init__(
        self,
        model: BaseModel,
        train: ShardedDataset,
        recipe: Recipe,
        *,
        reference: Reference | None = None,
    ) -> None:
        self._model, self._train, self._recipe = model, train, recipe
        self._reference, self._reader = reference, ThreadPoolExecutor(1)

    def __len__(self) -> int:
        return sum(self._train.windows_of(shard) for shard in self._train.shards)

    def epoch(self, epoch: int) -> ShardedEpoch:
        """The windows of an epoch, the same whenever they are asked for.

        Args:
            epoch: counted from 0.
        """
        return ShardedEpoch(
            self._model,
            self._train,
            self._recipe,
            epoch,
            reader=self._reader,
            reference=self._reference,
        )

    def close(self) -> None:
        """Ends the thread."""
        self._reader.shutdown(cancel_futures=True)


def groups_of(data: ShardedDataset, *, seed: int, epoch: int) -> list[list[int]]:
    """Files that are in memory together, in the order of an epoch.

    Args:
        data: the folder; two groups fit into its cache, and each has one file at least.
        seed: of the training.
        epoch: counted from 0.
    """
    most = data.cache_mb * 1e6 / 2
    groups: list[list[int]] = []
    size = 0.0
    for i in np.random.default_rng([seed, _SHARDS, epoch]).permutation(len(data.shards)).tolist():
        own = data.bytes_of(data.shards[i])
        if not groups or size + own > most:
            groups.append([])
            size = 0.0
        groups[-1].append(i)
        size += own
    return groups


def check_trainable(data: ShardedDataset, recipe: Recipe) -> None:
    """Checks that a training can draw from a folder.

    Args:
        data: the folder.
        recipe: of the training.

    Raises:
        InputError: it trains on tasks, or cuts other windows than the folder was opened with.
    """
    if recipe.tasks is not None:
        raise InputError(
            "tasks are drawn from a data set in memory; give redraw instead, or a data set of "
            "Dataset.open(folder).sample()"
        )
    drawn = recipe.redraw
    if drawn is not None and drawn.window is not None and drawn.window != data.window:
        raise InputError(
            f"redraw cuts windows of {drawn.window} rows, the folder was opened with windows of "
            f"{data.window}; give the window to Dataset.open, and leave it out of redraw"
        )
