"""Statistics of the training data, saved with the model."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import torch

from offbeat.data.batch import Batch, last_index
from offbeat.data.gaps import fastest_step, usual_gap
from offbeat.data.scaler import Scaler, clipped
from offbeat.data.shards import Moments
from offbeat.data.trajectory import EXOGENOUS
from offbeat.errors import InputError


@dataclass(frozen=True)
class Statistics:
    """Measured on the training part, in scaled units and seconds.

    Attributes:
        mean: per channel, over observed values: the empirical mean of equation 27.
        std: per channel, over observed values; 1 for a constant channel.
        median_gap: s, between consecutive rows, or between observations of the fastest channel
            where sensors report almost at once (see `usual_gap`).
        longest_elapsed: s, longest time since the last observed row.
        longest_delta: s, longest time since observation of any channel (equation 25).
        rows: of the longest training trajectory; 0 in checkpoints of 0.1.
        low: per channel, smallest observed value, 0 without one; empty in checkpoints up to 0.2.
        high: per channel, largest observed value, 0 without one.
        filters: per channel, the Kalman filter that a model with a trend begins as, see
            `models.gains.Filters`; empty for other models. Files of earlier versions lack its
            error, and mean 1: their vector fields are in standard deviations.
    """

    mean: tuple[float, ...]
    std: tuple[float, ...]
    median_gap: float
    longest_elapsed: float
    longest_delta: float
    rows: int = 0
    low: tuple[float, ...] = ()
    high: tuple[float, ...] = ()
    filters: tuple[tuple[float, ...], ...] = ()

    @property
    def channels(self) -> int:
        """Number of channels."""
        return len(self.mean)

    @classmethod
    def of(cls, batch: Batch, *, robust: bool = False) -> Statistics:
        """Measures a training batch.

        Args:
            batch: scaled.
            robust: whether mean and standard deviation are those of the `clipped` values, which a
                few wild values do not change.

        Raises:
            InputError: a channel that is not exogenous is never observed, or no trajectory has two
                rows.
        """
        mask = batch.mask & batch.valid[..., None]
        count = mask.sum(dim=(0, 1))
        for channel, (seen, role) in enumerate(zip(count.tolist(), batch.roles, strict=True)):
            if not seen and role != EXOGENOUS:
                raise InputError(
                    f"channel {channel} is never observed in the training part; leave it out"
                )
        count = count.clamp_min(1)
        values = batch.values.double()
        mean = torch.where(mask, values, 0.0).sum(dim=(0, 1)) / count
        variance = (torch.where(mask, values - mean, 0.0) ** 2).sum(dim=(0, 1)) / count
        std = variance.sqrt()
        if robust:
            columns = [values[..., c][mask[..., c]].cpu().numpy() for c in range(len(count))]
            inner = [clipped(column) if len(column) else np.zeros(1) for column in columns]
            mean = torch.tensor([column.mean() for column in inner])
            std = torch.tensor([column.std() for column in inner])
        std = torch.where(std > 1e-7 * mean.abs().clamp_min(1e-30), std, 1.0)
        gaps = (batch.times[:, 1:] - batch.times[:, :-1])[batch.valid[:, 1:]]
        if not len(gaps):
            raise InputError(
                "every training trajectory has a single row; a model needs at least one "
                "trajectory of two rows"
            )
        gap = usual_gap(float(gaps.median()), _fastest(batch, mask))
        low = torch.where(mask, values, torch.inf).amin(dim=(0, 1))
        high = torch.where(mask, values, -torch.inf).amax(dim=(0, 1))
        never = low > high  # exogenous ones without a value
        longest = [_longest(batch, mask.any(dim=2, keepdim=True)), _longest(batch, mask)]
        return cls(
            tuple(mean.tolist()),
            tuple(std.tolist()),
            gap,
            max(longest[0], gap),
            max(*longest, gap),
            batch.rows,
            tuple(torch.where(never, 0.0, low).tolist()),
            tuple(torch.where(never, 0.0, high).tolist()),
        )

    @classmethod
    def of_moments(cls, moments: Moments, scaler: Scaler, *, rows: int) -> Statistics:
        """From one pass over a folder.

        Args:
            moments: in the channels' units.
            scaler: that the model works with.
            rows: of the longest window.
        """
        none = moments.count == 0
        mean = np.where(none, 0.0, scaler.scaled(moments.mean))
        std = np.sqrt(moments.variance) / np.abs(scaler.scale)
        std = np.where(std > 1e-7 * np.maximum(np.abs(mean), 1e-30), std, 1.0)
        ends = [
            np.where(none, 0.0, scaler.scaled(np.where(none, 0.0, end)))
            for end in (moments.low, moments.high)
        ]
        low, high = np.minimum(*ends), np.maximum(*ends)  # a scale may be negative
        return cls(
            tuple(mean.tolist()),
            tuple(std.tolist()),
            moments.median_gap,
            moments.longest_elapsed,
            moments.longest_delta,
            rows,
            tuple(low.tolist()),
            tuple(high.tolist()),
        )

    def to_dict(self) -> dict[str, Any]:
        """JSON-like form; floats are exact."""
        return asdict(self)

    @classmethod
    def from_dict(cls, value: Mapping[str, Any]) -> Statistics:
        """The inverse of `to_dict`."""
        fields: dict[str, Any] = {
            k: tuple(v) if isinstance(v, list) else v for k, v in value.items()
        }
        fields["filters"] = tuple(
            (*each, 1.0) if len(each) == 4 else tuple(each) for each in fields.get("filters", ())
        )
        return cls(**fields)


def _fastest(batch: Batch, mask: torch.Tensor) -> float:
    """Smallest median time between two observations of a channel, in s."""
    valid = batch.valid
    of = torch.arange(len(batch), device=valid.device)[:, None].expand(valid.shape)
    return fastest_step(
        batch.times[valid].cpu().numpy(), of[valid].cpu().numpy(), mask[valid].cpu().numpy()
    )


def _longest(batch: Batch, mask: torch.Tensor) -> float:
    """Longest time from a valid row back to the previous observation; 0 if there is none."""
    index = last_index(mask)
    times = batch.times[..., None].expand(index.shape)
    since = times - times.gather(1, index.clamp_min(0))
    since = since[(index >= 0) & batch.valid[..., None]]
    return float(since.max()) if len(since) else 0.0
