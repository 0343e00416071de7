"""Gains of Kalman filters with damped velocity, which a model with a trend begins as.

The gains of a filter depend on times and masks alone, so they are step inputs. Channels are
independent. Right after an observation at the time since the one before, the covariance P of level
and slope gives the gains P00 / (P00 + 1) and P01 / (P00 + 1): variances are multiples of that of
the noise. See `baselines.kalman` for the model, and for the search of its parameters.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from offbeat.baselines.base import Array, moments
from offbeat.baselines.history import typical_gap
from offbeat.baselines.kalman import Belief, transition
from offbeat.baselines.kalman_channels import Wiring, fit_chains
from offbeat.baselines.kalman_search import Sample
from offbeat.config import TaskConfig
from offbeat.data.masking import masked_values
from offbeat.data.tasks import draw_tasks
from offbeat.data.trajectory import Dataset
from offbeat.errors import InputError
from offbeat.kernels import cpu

TASKS = 256
"""Trajectories that filters are tuned on, spread evenly over the training data; and tasks, where
nothing is masked."""

HORIZON = 16
"""Longest forecast of these tasks, in typical gaps."""

FURTHEST = 10.0
"""A slope carries a level at most as far as it does in this many of the longest times tuned for."""

CELLS = 30_000
"""Most rows of all channels together that a search steps through."""

KEPT = 8
"""Data sets whose filters are kept: models of several sizes or seeds are made for the same data."""

SMALLEST_ERROR = 1e-3
"""Least typical error of a filter, in standard deviations of its channel."""

_tuned: dict[str, tuple[tuple[float, ...], ...]] = {}

LOOSE = 1e8
"""Variance of a level before its first observation."""


def tune_filters(train: Dataset) -> tuple[tuple[float, ...], ...]:
    """Finds the filter of each channel.

    Args:
        train: its masked values are predicted from the others; where none is masked, tasks are
            drawn from it.

    Returns:
        Per channel, as of `Filters`: clock, damping, drive, walk and error.
    """
    tasks = train
    if not any(masked_values(t).any() for t in train):
        gap = typical_gap(train)
        horizon = HORIZON * gap
        window = TaskConfig(horizon_s=horizon, gap_s=gap, window_s=5 * horizon)
        tasks = draw_tasks(train, window, TASKS)
    if len(tasks) > TASKS:
        tasks = tasks.take(np.linspace(0, len(tasks) - 1, TASKS).round().astype(np.int64))
    key = tasks.fingerprint()
    if key not in _tuned:
        while len(_tuned) >= KEPT:
            _tuned.pop(next(iter(_tuned)))
        _tuned[key] = _tune(tasks)
    return _tuned[key]


def _tune(tasks: Dataset) -> tuple[tuple[float, ...], ...]:
    channels = [[c, -1] for c in range(tasks.channels)]
    sample = Sample.of(tasks, np.array(channels), two_sided=False, cells=CELLS)
    mean, scale = moments(tasks)
    weights = sample.weights()
    longest = sample.longest(weights)[:, 0]
    wiring = Wiring.of(tasks, channels, np.ones((len(channels), 2)), mean, scale, longest)
    found, loss = fit_chains(wiring, sample, scale, weights)
    damping = torch.from_numpy(found.damping)
    clock, far = torch.from_numpy(found.clock), torch.from_numpy(found.longest)
    damping = torch.maximum(damping, clock / (FURTHEST * torch.maximum(far, clock)))
    error = torch.from_numpy(_errors(sample, weights, loss) / scale)
    error = error.nan_to_num(nan=1.0).clamp(SMALLEST_ERROR, 1.0)
    each = (clock, damping, torch.from_numpy(found.drive), torch.from_numpy(found.walk), error)
    columns = [column.tolist() for column in each]
    return tuple(zip(*columns, strict=True))


def _errors(sample: Sample, weights: Array, loss: Array) -> Array:
    """(channels,) typical errors of filters at the longest time that counts.

    Args:
        sample: that they were tuned on, a column per channel and state.
        weights: (bins, columns) of its bins.
        loss: (channels, states) mean over bins of log(MSE / MSE of the reference).
    """
    shape = (len(weights), *loss.shape)
    counts, reference = (of.reshape(shape)[..., 0] for of in (weights > 0.5, sample.reference))
    last = np.max(counts * np.arange(len(counts))[:, None], axis=0)
    mse = reference[last, np.arange(len(last))] * np.exp(loss[:, 0])
    return np.asarray(np.sqrt(mse))


@dataclass(frozen=True, eq=False)
class Filters:
    """The filters of all channels.

    Attributes:
        table: (4, channels) float64: the clock of each channel, s; and per clock its damping, the
            variance of the noise on its slope, and that on its level.
        error: (channels,) float64, typical error at the longest time tuned for, in standard
            deviations of the channel, at most 1.
    """

    table: Tensor
    error: Tensor

    @classmethod
    def of(cls, filters: tuple[tuple[float, ...], ...]) -> Filters:
        """From `Statistics.filters`.

        Args:
            filters: per channel clock, damping, drive, walk and error.

        Raises:
            InputError: they are not five numbers per channel.
        """
        wrong = {len(each) for each in filters} - {5}
        if wrong:
            raise InputError(
                f"a filter has 5 numbers (clock, damping, drive, walk, error), got {min(wrong)}; "
                "offbeat.make_model tunes them"
            )
        table = torch.tensor(filters, dtype=torch.float64).reshape(-1, 5).t().contiguous()
        return cls(table[:4].contiguous(), table[4].clone())

    def to(self, device: torch.device) -> Filters:
        """The same on a device."""
        return Filters(self.table.to(device), self.error.to(device))

    def damping(self, unit: float) -> Tensor:
        """(channels,) damping of the slopes per `unit` s."""
        return self.table[1] / self.table[0] * unit

    def prior(self) -> Tensor:
        """(channels, 3) covariance of level, level and slope, and slope before an observation."""
        _, damping, drive, walk = self.table
        level = LOOSE * (1.0 + drive + walk)
        slope = drive / (2.0 * damping.clamp_min(0.02))
        return torch.stack([level, torch.zeros_like(level), slope], dim=1)

    def gains(
        self,
        delta: Tensor,
        mask: Tensor,
        started: Tensor,
        covariance: Tensor,
        *,
        unit: float,
        dtype: torch.dtype,
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Gains at each row.

        Args:
            delta: (batch, rows, channels) float64, s, since each channel's last observation.
            mask: (batch, rows, channels) bool, where there is an observation.
            started: (batch, channels) bool, which channels were observed before.
            covariance: (batch, channels, 3) right after the last observation, or of `prior`.
            unit: s, of the slopes.
            dtype: of the gains.

        Returns:
            The gains of levels and of slopes, (batch, rows, channels), 0 where nothing is observed;
            and the covariance after the last row.
        """
        if cpu.has_trends() and delta.device.type == "cpu" and not _tracing():
            level = torch.empty(delta.shape, dtype=dtype)
            slope, covariance = torch.empty_like(level), covariance.contiguous().clone()
            given = (self.table, delta.contiguous(), mask.contiguous(), started.contiguous())
            arrays = [each.numpy() for each in (*given, covariance, level, slope)]
            cpu.compiled.filter_gains(*arrays, unit)
            return level, slope, covariance
        clock, damping, drive, walk = self.table
        levels, slopes = [], []
        for i in range(delta.shape[1]):
            seen = mask[:, i]
            gap = torch.where(started, delta[:, i] / clock, 0.0)
            step = transition(gap, damping, drive, walk, 2)
            keys = ((0, 0), (0, 1), (1, 1))
            cov = dict(zip(keys, covariance.unbind(-1), strict=True))
            zero = torch.zeros_like(gap)
            belief = Belief([zero, zero], cov).moved(step)
            updated, made = belief.updated(0, zero, zero + 1.0, seen)
            levels.append(made.gain[0])
            slopes.append(made.gain[1] * (unit / clock))
            after = torch.stack([updated.cov[key] for key in keys], dim=-1)
            covariance = torch.where(seen[..., None], after, covariance)
            started = started | seen
        stacked = (torch.stack(each, dim=1).to(dtype) for each in (levels, slopes))
        return (*stacked, covariance)  # type: ignore[return-value]


def _tracing() -> bool:
    return torch.compiler.is_exporting()
