"""Elapsed times and gaps at every row against a plain loop, split anywhere, empty rows anywhere."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from itertools import pairwise

import numpy as np
import torch
from hypothesis import given
from hypothesis import strategies as st
from model_helpers import TICK, rows_of
from numpy.typing import NDArray

from offbeat import Batch, Trajectory
from offbeat.models.elapsed import ElapsedTimes, RecurrentState, elapsed_times

FAR = 1e6
NAMES = [field.name for field in fields(ElapsedTimes) if field.name != "rows"]
NAMES += ["delta", "delta_before", "delta_observed", "last"]
MEAN = torch.tensor([50.0, 60.0, 70.0], dtype=torch.float64)


@dataclass(frozen=True)
class Case:
    """Trajectories of different lengths, hardly to fully observed, and limits for the times."""

    trajectories: list[Trajectory]
    limit: float
    random: np.random.Generator
    from_first_row: bool

    @property
    def batch(self) -> Batch:
        return Batch.of(self.trajectories, dtype=torch.float64)


@st.composite
def cases(draw: st.DrawFn) -> Case:
    random = np.random.default_rng(draw(st.integers(0, 2**32)))
    share = draw(st.sampled_from([0.0, 0.1, 0.3, 0.6, 1.0]))
    limit = draw(st.sampled_from([FAR, 30 * TICK, 100 * TICK]))
    made = []
    for rows in draw(st.lists(st.integers(1, 9), min_size=1, max_size=3)):
        times = np.cumsum(random.integers(2, 50, rows)) * TICK
        made.append(
            Trajectory(
                times, random.normal(size=(rows, 3)), observed=random.random((rows, 3)) < share
            )
        )
    return Case(made, limit, random, draw(st.booleans()))


def empty(batch: Batch) -> RecurrentState:
    return RecurrentState.empty(torch.zeros(len(batch), 1, dtype=torch.float64), MEAN)


def measured(
    case: Case, batch: Batch, past: RecurrentState | None = None
) -> tuple[ElapsedTimes, RecurrentState]:
    past = past or empty(batch)
    return elapsed_times(batch, past, elapsed_limit=case.limit, from_first_row=case.from_first_row)


def by_hand(
    one: Trajectory, limit: float, *, from_first_row: bool
) -> dict[str, NDArray[np.float64]]:
    """Row by row, with nothing but the definitions."""
    before = None
    start = latest = 0.0 if from_first_row else None
    seen = False
    channel_at: list[float | None] = [None] * one.channels
    last = MEAN.tolist()
    found: dict[str, list[object]] = {name: [] for name in NAMES}

    def since_observed(time: float | None) -> float:
        return 0.0 if latest is None or time is None else min(time - latest, limit)

    def channel_times(time: float | None) -> list[float]:
        if start is None or time is None:
            return [0.0] * one.channels
        lost = 0.0 if latest is None else max(time - latest - limit, 0.0)
        return [time - lost - (start if at is None else at) for at in channel_at]

    for time, values, mask in zip(
        (one.times - one.times[0]).tolist(), one.values, one.observed, strict=True
    ):
        found["step"].append(0.0 if before is None else time - before)
        found["elapsed"].append(since_observed(time))
        found["elapsed_before"].append(since_observed(before))
        found["gap"].append(since_observed(time) - since_observed(before))
        found["delta"].append(channel_times(time))
        found["delta_before"].append(channel_times(before))
        found["delta_observed"].append(channel_times(time if latest is None else latest))
        found["last"].append(list(last))
        found["observed"].append(bool(mask.any()))
        found["first"].append(bool(mask.any()) and not seen)
        if mask.any():
            start, latest, seen = time if start is None else start, time, True
        for channel in np.flatnonzero(mask):
            channel_at[channel], last[channel] = time, float(values[channel])
        before = time
    return {name: np.array(rows) for name, rows in found.items()}


@given(cases())
def test_elapsed_times_are_those_of_a_plain_loop(case: Case) -> None:
    got, _ = measured(case, case.batch)
    for i, one in enumerate(case.trajectories):
        hand = by_hand(one, case.limit, from_first_row=case.from_first_row)
        for name, expected in hand.items():
            assert np.array_equal(getattr(got, name)[i, : one.rows], expected), name


@given(cases(), st.lists(st.integers(1, 8), max_size=4))
def test_a_state_over_any_split_of_the_rows_gives_the_same(case: Case, cuts: list[int]) -> None:
    batch = case.batch
    whole, end = measured(case, batch)
    edges = sorted({0, batch.rows, *(c for c in cuts if c < batch.rows)})
    past, parts = empty(batch), []
    for start, stop in pairwise(edges):
        part, past = measured(case, rows_of(batch, start, stop), past)
        parts.append(part)
    for name in NAMES:
        joined = torch.cat([getattr(part, name) for part in parts], dim=1)
        assert torch.equal(joined, getattr(whole, name)), name
    for name in ("time", "start", "observed_at", "channel_at", "last"):
        assert torch.equal(getattr(past, name), getattr(end, name)), name
    assert past.rows == end.rows == batch.rows


@given(cases())
def test_rows_with_nothing_observed_change_nothing_at_other_rows(case: Case) -> None:
    """Before the first observation too, unless the clock starts at the first row."""
    batch = case.batch
    plain, _ = measured(case, batch)
    filled = []
    for one in case.trajectories:
        ticks = np.round(one.times / TICK)
        fresh = np.setdiff1d(
            np.arange(ticks[0] if case.from_first_row else -3, ticks[-1] + 60), ticks
        )
        fresh = np.sort(case.random.choice(fresh, size=4, replace=False)) * TICK
        times = np.union1d(one.times, fresh)
        own = np.searchsorted(times, one.times)
        values, observed = np.full((len(times), 3), np.nan), np.zeros((len(times), 3), dtype=bool)
        values[own], observed[own] = one.values, one.observed
        filled.append((Trajectory(times, values, observed=observed), own))
    more, _ = measured(case, Batch.of([one for one, _ in filled], dtype=torch.float64))
    for i, (one, (_, own)) in enumerate(zip(case.trajectories, filled, strict=True)):
        for name in ("observed", "first", "elapsed", "delta", "last"):
            got, expected = getattr(more, name)[i][own], getattr(plain, name)[i, : one.rows]
            assert torch.equal(got, expected), name
        gap = more.gap[i].cumsum(dim=0)[own]
        assert torch.equal(gap, plain.gap[i, : one.rows].cumsum(dim=0)), "gaps add up"


@given(cases())
def test_padding_is_a_pause_in_which_nothing_elapses(case: Case) -> None:
    got, _ = measured(case, case.batch)
    for i, one in enumerate(case.trajectories):
        assert not got.observed[i, one.rows :].any()
        assert not got.first[i, one.rows :].any()
        assert (got.gap[i, one.rows :] == 0).all()
        assert (got.step[i, one.rows :] == 0).all()


@given(cases(), st.sampled_from([0.0, 1.0, 1_700_000_000.0]))
def test_elapsed_times_do_not_depend_on_where_the_clock_starts(case: Case, shift: float) -> None:
    batch = case.batch
    plain, _ = measured(case, batch)
    moved, _ = measured(case, replace(batch, times=batch.times + shift))
    for name in NAMES:
        assert torch.equal(getattr(moved, name), getattr(plain, name)), name


def test_time_since_the_last_observation_stops_at_its_limit() -> None:
    one = Trajectory(
        [0.0, 1.0, 3.0, 9.0, 10.0, 11.0],
        np.zeros((6, 1)),
        observed=np.array([[True], [False], [False], [False], [True], [False]]),
    )
    batch = Batch.of([one])
    got, _ = elapsed_times(batch, empty(batch), elapsed_limit=2.5)
    assert got.elapsed[0].tolist() == [0, 1, 2.5, 2.5, 2.5, 1]
    assert got.delta[0, :, 0].tolist() == [0, 1, 2.5, 2.5, 2.5, 1]
    assert got.gap[0].tolist() == [0, 1, 1.5, 0, 0, 1]
    assert got.step[0].tolist() == [0, 1, 2, 6, 1, 1]


@given(cases())
def test_limited_times_never_exceed_the_limit_nor_shrink_between_observations(case: Case) -> None:
    batch = case.batch
    limit = 40 * TICK
    got, _ = elapsed_times(batch, empty(batch), elapsed_limit=limit)
    for name in ("elapsed", "elapsed_before", "gap"):
        value = getattr(got, name)
        assert ((value >= 0) & (value <= limit)).all(), name
    # All times stop together: what a time has grown by over a gap is the gap.
    grown = got.delta - got.delta_before
    assert torch.allclose(grown, got.gap[..., None].expand_as(grown), rtol=0, atol=1e-12)
    assert (got.delta >= got.delta_before).all()
    assert (got.elapsed >= got.elapsed_before).all()


def test_nothing_observed_means_that_no_time_passes() -> None:
    one = Trajectory([0.0, 5.0, 1e4], np.zeros((3, 3)), observed=np.zeros((3, 3), dtype=bool))
    batch = Batch.of([one], dtype=torch.float64)
    got, past = elapsed_times(batch, empty(batch), elapsed_limit=FAR)
    for name in ("gap", "elapsed", "elapsed_before", "delta", "delta_before"):
        assert (getattr(got, name) == 0).all(), name
    assert (got.last == MEAN).all()
    assert not got.observed.any()
    assert past.start.tolist() == [float("inf")]
