"""Padding, taking parts, and the times since observation that follow from times and masks."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from model_helpers import TICK, dataset, rows_of, trajectory
from torch import Tensor

from offbeat import Batch, InputError, Scaler, Trajectory, delta, last_values
from offbeat.data.batch import last_index

NAN = float("nan")
FIELDS = ("times", "values", "mask", "known", "valid")


@st.composite
def sequences(draw: st.DrawFn) -> tuple[Tensor, Tensor, Tensor]:
    """Times (batch, rows), values and mask (batch, rows, channels)."""
    shape = tuple(draw(st.integers(1, n)) for n in (3, 8, 3))
    random = np.random.default_rng(draw(st.integers(0, 2**32)))
    share = draw(st.sampled_from([0.0, 0.1, 0.5, 1.0]))
    times = np.cumsum(random.integers(1, 50, shape[:2]), axis=1) * TICK
    return (
        torch.from_numpy(times),
        torch.from_numpy(random.normal(size=shape)),
        torch.from_numpy(random.random(shape) < share),
    )


def test_delta_is_figure_2_1_of_the_thesis() -> None:
    times = torch.tensor([0, 0.1, 0.6, 1.6, 2.2, 2.5, 3.1], dtype=torch.float64)
    mask = torch.tensor([[1, 1, 0, 1, 0, 1, 1], [0, 1, 1, 0, 0, 0, 1]], dtype=torch.bool)
    expected = torch.tensor(
        [[0.0, 0.1, 0.5, 1.5, 0.6, 0.9, 0.6], [0.0, 0.1, 0.5, 1.0, 1.6, 1.9, 2.5]],
        dtype=torch.float64,
    )
    torch.testing.assert_close(delta(times, mask.T), expected.T, rtol=0, atol=1e-12)


def test_last_values_of_figure_2_1_are_those_before_each_row() -> None:
    x = [[47.0, 49.0, NAN, 40.0, NAN, 43.0, 55.0], [NAN, 15.0, 14.0, NAN, NAN, NAN, 15.0]]
    values = torch.tensor(x).T
    got = last_values(values, ~values.isnan(), before=torch.tensor([-1.0, -2.0]))
    expected = [[-1.0, 47, 49, 49, 40, 40, 43], [-2.0, -2, 15, 14, 14, 14, 14]]
    assert got.T.tolist() == expected


@given(sequences())
def test_delta_is_the_recursion_of_equation_25(sequence: tuple[Tensor, Tensor, Tensor]) -> None:
    times, _, mask = sequence
    expected = torch.zeros(mask.shape, dtype=torch.float64)
    for b in range(mask.shape[0]):
        for t in range(1, mask.shape[1]):
            for d in range(mask.shape[2]):
                expected[b, t, d] = times[b, t] - times[b, t - 1]
                if not mask[b, t - 1, d]:
                    expected[b, t, d] += expected[b, t - 1, d]
    assert torch.equal(delta(times, mask), expected)


@given(sequences(), st.integers(-5, 5))
def test_delta_counts_from_a_given_time_before_the_first_observation(
    sequence: tuple[Tensor, Tensor, Tensor], ticks: int
) -> None:
    times, _, mask = sequence
    since = torch.full((mask.shape[0], mask.shape[2]), ticks * TICK, dtype=torch.float64)
    seen = mask.cumsum(dim=1) - mask.long() > 0
    expected = torch.where(seen, delta(times, mask), times[..., None] - ticks * TICK)
    assert torch.equal(delta(times, mask, since=since), expected)


@given(sequences())
def test_last_values_and_last_index_are_those_of_a_plain_loop(
    sequence: tuple[Tensor, Tensor, Tensor],
) -> None:
    _, values, mask = sequence
    before = torch.arange(mask.shape[2], dtype=torch.float64) + 100
    expected, index = torch.empty_like(values), torch.empty(mask.shape, dtype=torch.int64)
    for b in range(mask.shape[0]):
        for d in range(mask.shape[2]):
            last, row = before[d], -1
            for t in range(mask.shape[1]):
                expected[b, t, d], index[b, t, d] = last, row
                if mask[b, t, d]:
                    last, row = values[b, t, d], t
    assert torch.equal(last_values(values, mask, before=before), expected)
    assert torch.equal(last_index(mask), index)


def test_last_values_take_a_start_value_of_each_trajectory() -> None:
    values, mask = torch.zeros(2, 3, 1), torch.zeros(2, 3, 1, dtype=torch.bool)
    got = last_values(values, mask, before=torch.tensor([[[5.0]], [[6.0]]]))
    assert got[:, :, 0].tolist() == [[5, 5, 5], [6, 6, 6]]


def test_a_batch_holds_each_trajectory_and_pads_its_end() -> None:
    data = dataset(4)
    batch = Batch.of(data, dtype=torch.float64)
    assert (len(batch), batch.rows, batch.channels) == (4, max(t.rows for t in data), 3)
    for i, one in enumerate(data):
        own, rest = slice(0, one.rows), slice(one.rows, None)
        assert np.array_equal(batch.times[i, own], one.times - one.times[0])
        assert np.array_equal(batch.values[i, own], one.values)
        assert np.array_equal(batch.mask[i, own], one.observed)
        assert batch.known[i, own].all()
        assert batch.valid[i].tolist() == [r < one.rows for r in range(batch.rows)]
        assert (batch.times[i, rest] == batch.times[i, one.rows - 1]).all()
        assert not batch.mask[i, rest].any()
        assert not batch.known[i, rest].any()
        assert (batch.values[i, rest] == 0).all()


def test_unknown_values_become_0_and_are_neither_known_nor_observed() -> None:
    one = Trajectory([0.0, 1.0], [[NAN, 2.0], [3.0, NAN]])
    batch = Batch.of([one])
    assert batch.values.tolist() == [[[0.0, 2.0], [3.0, 0.0]]]
    assert batch.mask.tolist() == batch.known.tolist() == [[[False, True], [True, False]]]
    assert batch.values.dtype == torch.float32
    assert batch.times.dtype == torch.float64


def test_a_batch_is_scaled_where_values_are_known() -> None:
    one = Trajectory([0.0, 1.0], [[NAN, 2.0], [3.0, NAN]])
    batch = Batch.of([one], scaler=Scaler("standardise", np.array([1.0, 4.0]), np.array([2.0, 5])))
    torch.testing.assert_close(batch.values, torch.tensor([[[0.0, -0.4], [1.0, 0.0]]]))


def test_clocks_since_1970_keep_their_gaps() -> None:
    early, late = trajectory(3), trajectory(3)
    late = Trajectory(early.times + 1.7e9, early.values, observed=early.observed)
    assert torch.equal(Batch.of([early]).times, Batch.of([late]).times)


def test_no_trajectories_or_other_channels_are_refused() -> None:
    with pytest.raises(InputError, match="at least one trajectory"):
        Batch.of([])
    with pytest.raises(InputError, match="same channels"):
        Batch.of([trajectory(0), trajectory(1, channels=2)])
    with pytest.raises(InputError, match="the scaler has 2 channels, the data has 3"):
        Batch.of([trajectory(0)], scaler=Scaler.identity(2))


@given(st.lists(st.integers(1, 6), min_size=1, max_size=5), st.data())
def test_take_is_a_batch_of_those_trajectories_alone(
    lengths: list[int], data: st.DataObject
) -> None:
    all_of_them = [trajectory(i, rows) for i, rows in enumerate(lengths)]
    index = data.draw(st.lists(st.integers(0, len(lengths) - 1), min_size=1, max_size=6))
    got = Batch.of(all_of_them).take(torch.tensor(index))
    expected = Batch.of([all_of_them[i] for i in index])
    for name in FIELDS:
        assert torch.equal(getattr(got, name), getattr(expected, name)), name


def test_take_also_takes_a_slice() -> None:
    data = dataset(5)
    got, expected = Batch.of(data).take(slice(1, 3)), Batch.of(data[1:3])
    for name in FIELDS:
        assert torch.equal(getattr(got, name), getattr(expected, name)), name


def test_casts_values_alone() -> None:
    batch = Batch.of(dataset(3))
    part = rows_of(batch, 2, 5)
    assert part.rows == 3
    assert torch.equal(part.times, batch.times[:, 2:5])
    assert torch.equal(part.mask, batch.mask[:, 2:5])
    cast = batch.to(dtype=torch.float64)
    assert (cast.values.dtype, cast.times.dtype, cast.mask.dtype) == (
        torch.float64,
        torch.float64,
        torch.bool,
    )
    assert torch.equal(cast.values, batch.values.double())
