"""Windows and masks that are drawn anew in each epoch, where complete values are known."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from offbeat.config import RedrawConfig
from offbeat.data.arrays import hand_over
from offbeat.data.batch import Batch
from offbeat.data.masking import keep_at_random
from offbeat.data.trajectory import STATE, Dataset
from offbeat.errors import InputError


@dataclass(frozen=True, eq=False)
class Redrawn:
    """Windows and masks of an epoch; a batch of them is gathered when it is needed.

    Attributes:
        whole: the trajectories.
        start: (trajectories,) int64, first row of each window.
        mask: (trajectories, window, channels or 1) bool, what stays observed of the window.
    """

    whole: Batch
    start: Tensor
    mask: Tensor

    def __len__(self) -> int:
        return len(self.start)

    def take(self, index: Tensor) -> Batch:
        """The windows at these positions, trimmed to the longest of them.

        Args:
            index: (batch,) positions of the trajectories, on any device.
        """
        whole, index = self.whole, index.to(self.start.device)
        first = index * whole.rows + self.start[index]
        row = torch.arange(self.mask.shape[1], device=index.device)
        flat = (first[:, None] + row).flatten()

        def rows(of: Tensor) -> Tensor:
            some = of.flatten(0, 1).index_select(0, flat)
            return some.view(len(index), len(row), *of.shape[2:])

        kept, times = self.mask.index_select(0, index), rows(whole.times)
        if whole.complete:
            shape = (len(index), len(row), whole.channels)
            mask, known = kept.expand(shape), torch.ones_like(kept[..., :1]).expand(shape)
            valid = known[..., 0]
        else:
            mask, known, valid = rows(whole.mask) & kept, rows(whole.known), rows(whole.valid)
        values = rows(whole.values)
        batch = Batch(times - times[:, :1], values, mask, known, valid, whole.roles)
        return batch if whole.complete or bool(valid.all()) else batch.take(slice(None))

    def dataset(self, dataset: Dataset) -> Dataset:
        """All windows, as trajectories.

        Args:
            dataset: the trajectories that `whole` was made of.
        """
        pieces = []
        for trajectory, start, mask in zip(
            dataset, self.start.tolist(), self.mask.cpu().numpy(), strict=True
        ):
            piece = trajectory.slice(start, min(start + len(mask), trajectory.rows))
            observed = piece.observed & mask[: piece.rows]
            pieces.append(replace(piece, observed=hand_over(observed)))
        return Dataset(tuple(pieces), dataset.meta)


def redraw(whole: Batch, config: RedrawConfig, *, seed: int | Sequence[int] = 0) -> Redrawn:
    """Draws a window of each trajectory, and which of its observed values stay observed.

    Fractions are exact in each window, as those of `mask_out`: of the n rows in which a state is
    observed, or of the n observed values of a state, `int(n * fraction)` stay, one at least. Only
    states are masked; masked values stay known. The work is a few array operations for all
    trajectories together.

    Args:
        whole: the trajectories, padded; a shorter one than a window is its own window.
        config: fractions and length of the windows.
        seed: of everything that is drawn.

    Raises:
        InputError: no channel has the role `state`.
    """
    states = np.array([role == STATE for role in whole.roles])
    if not states.any():
        raise InputError("no channel has the role 'state', so there is nothing to mask")
    random = np.random.default_rng(seed)
    lengths = whole.valid.sum(dim=1).cpu().numpy()
    rows = min(config.window or whole.rows, whole.rows)
    start = random.integers(0, np.maximum(lengths - rows, 0) + 1)
    fractions = np.asarray(config.observed_fractions)[
        random.integers(0, len(config.observed_fractions), len(whole))
    ]
    if config.mask == "rows":
        seen = np.ones((len(whole), rows), dtype=bool)
        if not whole.complete:
            at = start[:, None] + np.arange(rows)
            seen = np.take_along_axis(_shown(whole)[..., states].any(axis=2), at, axis=1)
        mask = keep_at_random(seen, fractions, random)[..., None]
    else:
        seen = np.ones((len(whole), whole.channels, rows), dtype=bool)
        if not whole.complete:
            at = start[:, None] + np.arange(rows)
            seen = np.take_along_axis(_shown(whole).transpose(0, 2, 1), at[:, None], axis=2)
        mask = keep_at_random(seen, fractions[:, None], random).transpose(0, 2, 1)
    if not states.all():
        mask = mask | ~states
    device = whole.values.device
    return Redrawn(
        whole,
        torch.from_numpy(start).to(device),
        torch.from_numpy(np.ascontiguousarray(mask)).to(device),
    )


def _shown(whole: Batch) -> NDArray[np.bool_]:
    """(trajectories, rows, channels) what is observed of them."""
    shown: NDArray[np.bool_] = (whole.mask & whole.valid[..., None]).cpu().numpy()
    return shown
