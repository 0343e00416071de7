"""Data sets as `torch.utils.data`, for training loops of one's own."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch.utils.data import DataLoader
from torch.utils.data import Dataset as TorchDataset

from offbeat.config import check_seed
from offbeat.data.batch import Batch
from offbeat.data.scaler import Scaler
from offbeat.data.trajectory import Dataset, Trajectory
from offbeat.errors import InputError


class Trajectories(TorchDataset[Trajectory]):
    """A map-style data set of PyTorch: item i is trajectory i.

    Trajectories differ in length, so a loader needs `collate`; `data_loader` has it.

    Args:
        dataset: the trajectories.
        scaler: applied by `collate`; None for no scaling.
        dtype: of the values that `collate` gives.
    """

    def __init__(
        self, dataset: Dataset, *, scaler: Scaler | None = None, dtype: torch.dtype = torch.float32
    ) -> None:
        self.dataset, self.scaler, self.dtype = Dataset.of(dataset), scaler, dtype

    def __len__(self) -> int:
        return len(self.dataset)

    def __getitem__(self, index: int) -> Trajectory:
        return self.dataset[index]

    def collate(self, trajectories: Sequence[Trajectory]) -> Batch:
        """Pads trajectories into one batch.

        Args:
            trajectories: items of this data set.
        """
        return Batch.of(trajectories, scaler=self.scaler, dtype=self.dtype)


def data_loader(
    dataset: Dataset,
    *,
    batch_size: int = 32,
    shuffle: bool = False,
    scaler: Scaler | None = None,
    dtype: torch.dtype = torch.float32,
    seed: int = 0,
    workers: int = 0,
) -> DataLoader[Trajectory]:
    """A loader of PyTorch over a data set, which yields a `Batch` at a time.

    A batch has `.to(device)`, so Lightning and accelerate move it; a registered model takes it as
    it is.

    Args:
        dataset: the trajectories, or windows of them.
        batch_size: trajectories per batch; the last one may have fewer.
        shuffle: draw a new order in each epoch.
        scaler: applied to the values; None for no scaling.
        dtype: of the values; times are float64, s.
        seed: of the order.
        workers: processes that pad batches; 0 pads in this one.

    Returns:
        A `DataLoader`; `len` of it is the number of batches.

    Raises:
        InputError: a number is out of range.

    Example:
        >>> for batch in offbeat.data_loader(train, batch_size=16):  # doctest: +SKIP
        ...     loss = ((model(batch).mean - batch.values) ** 2)[batch.targets].mean()
    """
    check_seed(seed)
    for name, number, least in (("batch_size", batch_size, 1), ("workers", workers, 0)):
        if isinstance(number, bool) or not isinstance(number, int) or number < least:
            raise InputError(f"{name} must be an integer of at least {least}, got {number!r}")
    items = Trajectories(dataset, scaler=scaler, dtype=dtype)
    return DataLoader(
        items,
        batch_size=batch_size,
        shuffle=shuffle,
        collate_fn=items.collate,
        generator=torch.Generator().manual_seed(seed) if shuffle else None,
        num_workers=workers,
        multiprocessing_context="spawn" if workers else None,
    )
