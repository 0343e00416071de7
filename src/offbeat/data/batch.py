"""Padded batches, and times since observation."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any

import numpy as np
import torch
from torch import Tensor

from offbeat.data.scaler import Scaler
from offbeat.data.trajectory import ACTION, EXOGENOUS, STATE, Dataset, Trajectory
from offbeat.errors import InputError


@dataclass(frozen=True, eq=False)
class Batch:
    """Trajectories of any lengths and times as tensors, each padded at its end.

    Attributes:
        times: (batch, rows) float64, s, relative to the first row; padding repeats the last time.
        values: (batch, rows, channels) scaled; 0 where not known.
        mask: (batch, rows, channels) bool, True = observed.
        known: (batch, rows, channels) bool, True = the value is known, and can be scored.
        valid: (batch, rows) bool, False = padding.
        roles: per channel `state`, `action` or `exogenous`; by default all are `state`.
    """

    times: Tensor
    values: Tensor
    mask: Tensor
    known: Tensor
    valid: Tensor
    roles: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if not self.roles:
            object.__setattr__(self, "roles", (STATE,) * self.values.shape[2])

    def __repr__(self) -> str:
        batch, rows, channels = self.values.shape
        kind, device = str(self.values.dtype).removeprefix("torch."), self.values.device
        return (
            f"Batch({batch} trajectories, up to {rows} rows, {channels} channels, {kind}, {device})"
        )

    @classmethod
    def of(
        cls,
        trajectories: Dataset | Sequence[Trajectory],
        *,
        scaler: Scaler | None = None,
        dtype: torch.dtype = torch.float32,
        roles: tuple[str, ...] | None = None,
    ) -> Batch:
        """Pads trajectories into one batch.

        Args:
            trajectories: at least one; all of the same channels.
            scaler: applied to the values; None for no scaling.
            dtype: of `values`; times are always float64.
            roles: of the channels; by default those of the trajectories.

        Raises:
            InputError: there is no trajectory, or numbers of channels differ.
        """
        if not len(trajectories):
            raise InputError("a batch needs at least one trajectory, got none")
        channels = trajectories[0].channels
        if any(t.channels != channels for t in trajectories):
            raise InputError("trajectories of one batch must have the same channels")
        lengths = np.array([t.rows for t in trajectories])
        shape = (len(trajectories), int(lengths.max()))
        valid = np.arange(shape[1]) < lengths[:, None]
        times = np.zeros(shape)
        values = np.full((*shape, channels), np.nan)
        mask = np.zeros((*shape, channels), dtype=bool)
        for i, trajectory in enumerate(trajectories):
            rows = trajectory.rows
            times[i, :rows] = trajectory.times - trajectory.times[0]
            times[i, rows:] = times[i, rows - 1]
            values[i, :rows] = trajectory.values
            mask[i, :rows] = trajectory.observed
        known = ~np.isnan(values)
        if scaler is not None:
            if len(scaler.shift) != channels:
                raise InputError(
                    f"the scaler has {len(scaler.shift)} channels, the data has {channels}"
                )
            values = scaler.scaled(values)
        return cls(
            torch.from_numpy(times),
            torch.from_numpy(np.where(known, values, 0.0)).to(dtype),
            torch.from_numpy(mask),
            torch.from_numpy(known),
            torch.from_numpy(valid),
            roles or tuple(getattr(trajectories[0], "roles", ())),
        )

    @classmethod
    def joined(cls, batches: Sequence[Batch]) -> Batch:
        """One batch of several of the same channels, padded to the longest trajectory.

        Args:
            batches: at least one.
        """
        rows = max(batch.rows for batch in batches)

        def padded(name: str) -> Tensor:
            each = []
            for batch in batches:
                tensor: Tensor = getattr(batch, name)
                missing = rows - batch.rows
                if missing:
                    last = tensor[:, -1:] if name == "times" else torch.zeros_like(tensor[:, -1:])
                    tensor = torch.cat([tensor, last.expand(-1, missing, *last.shape[2:])], dim=1)
                each.append(tensor)
            return torch.cat(each)

        tensors: dict[str, Any] = {name: padded(name) for name, _ in batches[0]._tensors()}
        return replace(batches[0], **tensors)

    def __len__(self) -> int:
        return self.times.shape[0]

    @property
    def rows(self) -> int:
        """Rows of the longest trajectory."""
        return self.times.shape[1]

    @property
    def channels(self) -> int:
        """Number of channels."""
        return self.values.shape[2]

    def _tensors(self) -> Iterator[tuple[str, Tensor]]:
        """Name and value of every tensor."""
        for field in fields(self):
            if field.name != "roles":
                yield field.name, getattr(self, field.name)

    @cached_property
    def lengths(self) -> Tensor:
        """(batch,) rows of each trajectory, on the CPU."""
        return self.valid.sum(dim=1).cpu()

    def take(self, index: Tensor | slice, *, host: Tensor | None = None) -> Batch:
        """The trajectories at these positions, trimmed to the longest of them.

        Args:
            index: positions, on the CPU or on the device of the batch.
            host: the same on the CPU, where `index` is not; then nothing waits for the device.
        """
        at = index if host is None else host
        rows = int(self.lengths[at.cpu() if isinstance(at, Tensor) else at].max())
        cut: dict[str, Any] = {k: v[index][:, :rows] for k, v in self._tensors()}
        return replace(self, **cut)

    @property
    def targets(self) -> Tensor:
        """(batch, rows, channels) bool, True where a prediction can be scored."""
        known = self.known & self.valid[..., None]
        if all(role != EXOGENOUS for role in self.roles):
            return known
        wanted = [role != EXOGENOUS for role in self.roles]
        return known & torch.tensor(wanted, device=known.device)

    @cached_property
    def complete(self) -> bool:
        """Whether every value of every row is observed, as in simulated trajectories."""
        return bool(self.mask.all() and self.valid.all())

    def inputs(self, last: Tensor, seen: Tensor) -> Batch:
        """Inputs of a model: actions are moved to the next row.

        An action is chosen at its row from the observation there. So it is a target of that
        row, and an input of the next row.

        Args:
            last: (batch, channels) actions of the row before the first.
            seen: (batch, channels) bool, True where there were any.

        Returns:
            The batch with the values and masks of `action` channels moved by one row; `known` is
            unchanged.
        """
        if ACTION not in self.roles:
            return self
        acts = torch.tensor([role == ACTION for role in self.roles], device=self.mask.device)
        values = torch.cat([last[:, None].to(self.values), self.values[:, :-1]], dim=1)
        mask = torch.cat([seen[:, None], self.mask[:, :-1]], dim=1) & self.valid[..., None]
        return replace(
            self,
            values=torch.where(acts, values, self.values),
            mask=(mask & acts) | (self.mask & ~acts),
        )

    def to(
        self, device: torch.device | str | None = None, dtype: torch.dtype | None = None
    ) -> Batch:
        """Moves all tensors, and casts `values`; times stay float64."""
        moved: dict[str, Any] = {k: v.to(device) for k, v in self._tensors()}
        batch = replace(self, **moved)
        return batch if dtype is None else replace(batch, values=batch.values.to(dtype))


def last_index(mask: Tensor) -> Tensor:
    """Row of the latest True strictly before each row; -1 where there was none.

    Args:
        mask: (..., rows, channels) bool.

    Returns:
        (..., rows, channels) int64.
    """
    if mask.shape[-2] == 1:  # a stream has one row, with nothing before it
        return torch.full_like(mask, -1, dtype=torch.int64)
    rows = torch.arange(mask.shape[-2], device=mask.device)[:, None]
    latest = torch.where(mask, rows, -1).cummax(dim=-2).values
    return torch.cat([torch.full_like(latest[..., :1, :], -1), latest[..., :-1, :]], dim=-2)


def delta(times: Tensor, mask: Tensor, *, since: Tensor | None = None) -> Tensor:
    """Time since each channel was last observed, before the row's own observation: equation 25.

    Args:
        times: (..., rows) float64, s.
        mask: (..., rows, channels) bool, True = observed.
        since: (..., channels) s, the reference time before a channel's first observation;
            by default the time of the first row, as in equation 25.

    Returns:
        (..., rows, channels) float64, s.
    """
    index = last_index(mask)
    times = times[..., None].expand(index.shape)
    start = times[..., :1, :] if since is None else since[..., None, :]
    return times - torch.where(index >= 0, times.gather(-2, index.clamp_min(0)), start)


def last_values(values: Tensor, mask: Tensor, *, before: Tensor) -> Tensor:
    """The last observed value of each channel, strictly before each row.

    Args:
        values: (..., rows, channels).
        mask: (..., rows, channels) bool, True = observed.
        before: (..., 1, channels) or broadcastable, the values before the first observation.

    Returns:
        (..., rows, channels).
    """
    index = last_index(mask)
    return torch.where(index >= 0, values.gather(-2, index.clamp_min(0)), before)
