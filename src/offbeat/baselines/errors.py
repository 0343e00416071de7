"""Errors of predictors by time since observation and channel, and scores relative to them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from offbeat.baselines.history import AgeBins
from offbeat.data.batch import Batch

CLIPPED = 0.995
"""Squared errors above this quantile of their cell count as the quantile: outliers in a log."""

SMALLEST = 1e-3
"""Smallest typical error, in standard deviations of the channel."""

FEW = 10.0
"""Number of errors, each a typical one, that a relative score adds to every cell."""

UNOBSERVED = 0.25
"""Weight of predictions before the first observation of a channel, in weights of a bin."""


def cells(batch: Batch, bins: AgeBins) -> Tensor:
    """The bin of the time since each channel's last observation, before each row.

    Args:
        batch: observed values, masks and times.
        bins: of times since observation.

    Returns:
        (batch, rows, channels) int64; `len(bins)` before the first observation.
    """
    times = batch.times.cpu().numpy()[..., None]
    mask = (batch.mask & batch.valid[..., None]).cpu().numpy()
    latest = np.full(mask.shape, -np.inf)
    np.maximum.accumulate(np.where(mask, times, -np.inf)[:, :-1], axis=1, out=latest[:, 1:])
    age = times - latest
    found = np.searchsorted(bins.edges[:-1], age)  # as `AgeBins.of_age`
    return torch.from_numpy(np.where(np.isinf(age), len(bins), found)).to(batch.times.device)


@dataclass(frozen=True, eq=False)
class ErrorTable:
    """Mean squared errors of a predictor by time since observation and channel.

    Attributes:
        bins: of times since observation.
        mse: (bins + 1, channels) float64, in squared units of the batch; NaN where nothing counts.
            The last row is of predictions before the first observation of their channel.
        count: (bins + 1, channels) float64, number of errors.
    """

    bins: AgeBins
    mse: Tensor
    count: Tensor

    @classmethod
    def of(
        cls, predictions: Tensor, batch: Batch, bins: AgeBins, *, clipped: float | None = None
    ) -> ErrorTable:
        """Measures predictions of every row but the first.

        Args:
            predictions: (batch, rows, channels) in the units of `batch.values`.
            batch: observed and known values.
            bins: of times since observation.
            clipped: quantile of each cell at which squared errors are cut off; None for no limit.
        """
        counts = batch.targets.clone()
        counts[:, 0] = False
        # On the CPU, where sums are in one order.
        squared = (predictions.double() - batch.values.double()).square()[counts].cpu()
        where = cells(batch, bins) * batch.channels + torch.arange(
            batch.channels, device=counts.device
        )
        at, size = where[counts].cpu(), (len(bins) + 1) * batch.channels
        if clipped is not None:
            limit = torch.zeros(size, dtype=torch.float64)
            for k, errors in zip(*_groups(at, squared), strict=True):
                limit[k] = _quantile(errors, clipped)
            squared = torch.minimum(squared, limit[at])
        count = torch.bincount(at, minlength=size).double()
        total = torch.zeros(size, dtype=torch.float64).index_add(0, at, squared)
        shape = (len(bins) + 1, batch.channels)
        return cls(bins, (total / count).view(shape), count.view(shape))

    @classmethod
    def best(cls, tables: Iterable[ErrorTable]) -> ErrorTable:
        """The table of the best of several predictors in each cell.

        Args:
            tables: at least one, of the same errors.
        """
        every = list(tables)
        least = torch.stack([table.mse for table in every]).amin(dim=0)
        return cls(every[0].bins, least, every[0].count)

    def typical(self, std: Tensor) -> Tensor:
        """Typical errors, positive everywhere.

        Args:
            std: (channels,) standard deviations of the channels.

        Returns:
            (bins + 1, channels) roots of the mean squared errors, at least `SMALLEST` of `std`. A
            cell in which nothing counts has the error of the next shorter time, else of the next
            longer one, else `std`.
        """
        std = std.double()
        root = self.mse.sqrt()
        for order in (range(1, len(self.bins)), range(len(self.bins) - 2, -1, -1)):
            step = order.step
            for k in order:
                root[k] = torch.where(root[k].isnan(), root[k - step], root[k])
        return torch.maximum(torch.where(root.isnan(), std, root), SMALLEST * std)

    def weights(self) -> Tensor:
        """Weights of errors, so that each bin of each channel counts alike.

        Returns:
            (bins + 1, channels) with a mean of 1 over all errors. A cell of few errors weighs less:
            no error weighs more than four times one of the median cell.
        """
        some = self.count[:-1][self.count[:-1] > 0]
        typical = some.median() if len(some) else self.count.new_ones(())
        weights = 1 / torch.maximum(self.count, typical / 4)
        weights[-1] *= UNOBSERVED
        total = (weights * self.count).sum()
        return weights * self.count.sum() / total if total > 0 else torch.ones_like(weights)

    def relative(self, reference: ErrorTable, typical: Tensor) -> float:
        """The mean logarithm of the ratio of two predictors' MSE, over bins and channels.

        To each cell `FEW` typical errors are added, so that few errors change little.

        Args:
            reference: of another predictor, of the same values.
            typical: (bins + 1, channels) typical errors.

        Returns:
            Negative where this predictor is the better one; NaN where no error counts. Its
            exponential is a geometric mean of ratios.
        """
        counted = self.count[:-1] > 0
        added = FEW * typical[:-1].square()
        ours = self.count[:-1] * self.mse[:-1] + added
        theirs = self.count[:-1] * reference.mse[:-1] + added
        return float(torch.log(ours / theirs)[counted].mean())


def _groups(at: Tensor, values: Tensor) -> tuple[list[int], Sequence[Tensor]]:
    """Each number that occurs in `at`, and the values there."""
    order = torch.argsort(at, stable=True)
    found, counts = torch.unique_consecutive(at[order], return_counts=True)
    return found.tolist(), torch.split(values[order], counts.tolist())


def _quantile(values: Tensor, fraction: float) -> Tensor:
    """A quantile without interpolation, of any number of values."""
    rank = min(len(values), int(fraction * len(values)) + 1)
    return values.kthvalue(rank).values
