"""Times since observation and gaps at every row, and the recurrent state.

By default the model's clock starts at the first observation. After it,
time since the last observed row saturates at a limit, and a gap is the growth of that saturated
time. So rows in which nothing is observed can be inserted anywhere without effect.

The nodes of a solver lie at fixed times after the last observed row (`kernels.spec.nodes_before`).
Which of them a row is read from, and the time from there to the row, are computed in float64 from
that one time alone, so they do not depend on other rows either.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from offbeat.data.batch import Batch, last_index
from offbeat.data.trajectory import ACTION


@dataclass(frozen=True, eq=False)
class RecurrentState:
    """The state of a model after the rows it has processed.

    Attributes:
        state: (batch, state_size); with solver nodes at observations, that of the last node.
        time: (batch,) float64, s, of the last row; NaN before the first.
        start: (batch,) float64, s, at which the clock started; +inf before.
        observed_at: (batch,) float64, s, of the last observed row; -inf before the first.
        channel_at: (batch, channels) float64, s, of each channel's last observation; -inf before.
        last: (batch, channels) last observed value of each channel; the training mean before.
        updated: (batch,) bool, True if the cell acted at the last row; with solver nodes at
            observations, at the last observed row.
        rows: number of processed rows.
        generator: of self-feeding, or None.
        actions: (batch, channels) values of the last row in channels with the role `action`, NaN
            elsewhere and where there was none; None for a model without such channels.
        covariance: (batch, channels, 3) float64, of level, level and slope, and slope right after
            the last observation of each channel (`models.gains`); None for a model without a trend.
    """

    state: Tensor
    time: Tensor
    start: Tensor
    observed_at: Tensor
    channel_at: Tensor
    last: Tensor
    updated: Tensor
    rows: int = 0
    generator: torch.Generator | None = None
    actions: Tensor | None = None
    covariance: Tensor | None = None

    @classmethod
    def empty(
        cls, state: Tensor, mean: Tensor, *, generator: torch.Generator | None = None
    ) -> RecurrentState:
        """The state before the first row.

        Args:
            state: (batch, state_size) the state before anything is observed.
            mean: (channels,) values before the first observation.
            generator: of self-feeding.
        """
        batch, device = len(state), state.device

        def full(value: float, *shape: int) -> Tensor:
            return torch.full((batch, *shape), value, dtype=torch.float64, device=device)

        inf = float("inf")
        return cls(
            state,
            full(float("nan")),
            full(inf),
            full(-inf),
            full(-inf, len(mean)),
            mean.expand(batch, -1),
            torch.zeros(batch, dtype=torch.bool, device=device),
            generator=generator,
        )


@dataclass(frozen=True, eq=False)
class ElapsedTimes:
    """Elapsed times, from times and masks; all in s, float64.

    Those of single channels are computed when they are first used: many models need none.

    Attributes:
        observed: (batch, rows) bool, True where any channel is observed.
        first: (batch, rows) bool, True at the first observed row.
        step: (batch, rows) since the row before, in the data.
        gap: (batch, rows) growth of the saturated time since the last observed row.
        elapsed: (batch, rows) saturated time since the last observed row, before the row's
            observation.
        elapsed_before: (batch, rows) the same at the row before, after its observation.
        rows: what they are computed from.
    """

    observed: Tensor
    first: Tensor
    step: Tensor
    gap: Tensor
    elapsed: Tensor
    elapsed_before: Tensor
    rows: _Rows

    @property
    def delta(self) -> Tensor:
        """(batch, rows, channels) time since each channel's last observation, on arrival.

        It is that of equation 25; over a gap it grows as long as `elapsed` does.
        """
        rows = self.rows
        return (rows.spread - rows.lost[..., None] - rows.channel_clock).clamp_min(0)

    @property
    def delta_before(self) -> Tensor:
        """(batch, rows, channels) the same at the row before, after its observation."""
        rows = self.rows
        return ((rows.before - rows.lost_before)[..., None] - rows.channel_clock).clamp_min(0)

    @property
    def delta_observed(self) -> Tensor:
        """(batch, rows, channels) the same at the last observed row, after its observation."""
        rows = self.rows
        at = torch.minimum(rows.clock, rows.batch.times)[..., None]
        return (at - rows.channel_clock).clamp_min(0)

    @property
    def last(self) -> Tensor:
        """(batch, rows, channels) last value of each channel on arrival."""
        return self.rows.last


@dataclass(frozen=True, eq=False)
class _Rows:
    """What the elapsed times of channels are computed from.

    Attributes:
        batch: the rows.
        past: state after the earlier rows.
        mask: (batch, rows, channels) bool, True = observed.
        before: (batch, rows) time of the row before.
        start: (batch,) at which the clock starts.
        clock: (batch, rows) time of the last observed row, or the start.
        lost: (batch, rows) part of the time since then beyond the limit.
        lost_before: (batch, rows) the same at the row before.
    """

    batch: Batch
    past: RecurrentState
    mask: Tensor
    before: Tensor
    start: Tensor
    clock: Tensor
    lost: Tensor
    lost_before: Tensor

    @cached_property
    def index(self) -> Tensor:
        """(batch, rows, channels) row of the last observation of each channel; -1 without one."""
        return last_index(self.mask)

    @property
    def spread(self) -> Tensor:
        """(batch, rows, channels) time of each row."""
        return self.batch.times[..., None].expand(self.index.shape)

    @cached_property
    def channel_at(self) -> Tensor:
        """(batch, rows, channels) time of the last observation of each channel; -inf without."""
        return _pick(self.spread, self.index, self.past.channel_at[:, None])

    @cached_property
    def channel_clock(self) -> Tensor:
        """(batch, rows, channels) the same, or the start of the clock.

        Of an action that was never observed, as in a policy, it is the time of the last observed
        row: the time since the start would leave the range of training in a longer episode.
        """
        clock = torch.maximum(self.channel_at, self.start[:, None, None])
        if ACTION not in self.batch.roles:
            return clock
        acts = torch.tensor([role == ACTION for role in self.batch.roles], device=clock.device)
        return torch.where(acts & self.channel_at.isneginf(), self.clock[..., None], clock)

    @cached_property
    def last(self) -> Tensor:
        """(batch, rows, channels) last value of each channel."""
        return _pick(self.batch.values, self.index, self.past.last[:, None])


def elapsed_times(
    batch: Batch,
    past: RecurrentState,
    *,
    elapsed_limit: float,
    from_first_row: bool = False,
    ends: bool = True,
) -> tuple[ElapsedTimes, RecurrentState]:
    """Computes the times at each row of a batch that continues `past`.

    Args:
        batch: rows to come, in order.
        past: state after the earlier rows; its `state`, `updated`, `actions` and `covariance`
            are kept.
        elapsed_limit: s, at which the time since the last observed row saturates.
        from_first_row: the clock starts at the first row, observed or not.
        ends: whether the second result is the past after the last row; else it is `past`.
    """
    times = batch.times
    mask = batch.mask & batch.valid[..., None]
    observed = mask.any(dim=2)
    row_index = last_index(observed[..., None])[..., 0]
    observed_at = _pick(times, row_index, past.observed_at[:, None])
    before = torch.cat([past.time[:, None], times[:, :-1]], dim=1)
    before = torch.where(before.isnan(), times, before)

    inf = float("inf")
    starts = batch.valid if from_first_row else observed
    earliest = torch.where(starts, times, inf).min(dim=1).values
    start = torch.minimum(past.start, earliest)
    clock = torch.maximum(observed_at, start[:, None])
    elapsed, lost = _saturate(times - clock, elapsed_limit)
    elapsed_before, lost_before = _saturate(before - clock, elapsed_limit)
    rows = _Rows(batch, past, mask, before, start, clock, lost, lost_before)
    result = ElapsedTimes(
        observed=observed,
        first=observed & (row_index < 0) & past.observed_at.isneginf()[:, None],
        step=times - before,
        gap=elapsed - elapsed_before,
        elapsed=elapsed,
        elapsed_before=elapsed_before,
        rows=rows,
    )
    if not ends:
        return result, past
    ended = RecurrentState(
        state=past.state,
        time=times[:, -1],
        start=start,
        observed_at=torch.where(observed[:, -1], times[:, -1], observed_at[:, -1]),
        channel_at=torch.where(mask[:, -1], rows.spread[:, -1], rows.channel_at[:, -1]),
        last=torch.where(mask[:, -1], batch.values[:, -1], rows.last[:, -1]),
        updated=past.updated,
        rows=past.rows + batch.rows,
        generator=past.generator,
        actions=past.actions,
        covariance=past.covariance,
    )
    return result, ended


def at_last(flag: Tensor, rows: Tensor, past: Tensor) -> Tensor:
    """(batch, rows) `flag` at the latest earlier row of `rows`; `past` where there was none.

    Args:
        flag: (batch, rows).
        rows: (batch, rows) bool.
        past: (batch,).
    """
    return _pick(flag, last_index(rows[..., None])[..., 0], past[:, None])


def _saturate(elapsed: Tensor, limit: float) -> tuple[Tensor, Tensor]:
    """Splits elapsed time into the part up to the limit, and the rest."""
    elapsed = elapsed.clamp_min(0)
    counted = elapsed.clamp_max(limit)
    return counted, elapsed - counted


def _pick(values: Tensor, index: Tensor, otherwise: Tensor) -> Tensor:
    """`values` along dimension 1 at `index`; `otherwise` where the index is -1."""
    return torch.where(index >= 0, values.gather(1, index.clamp_min(0)), otherwise)
