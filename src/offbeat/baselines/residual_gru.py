"""A plain recurrent network that corrects the last value."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from offbeat.baselines.base import (
    BASELINES,
    Array,
    CausalBaseline,
    Rows,
    State,
    as_kind,
    namespace,
    padded,
    product,
)
from offbeat.baselines.examples import some_tasks
from offbeat.baselines.folds import folds_of
from offbeat.baselines.history import AgeBins, History, typical_gap
from offbeat.data.tasks import take_tasks
from offbeat.data.trajectory import Dataset

if TYPE_CHECKING:
    from torch import Tensor

UNITS, BATCH, STEPS, RATE = 64, 32, 600, 3e-3
"""Hidden units, trajectories of a batch, optimizer steps and largest learning rate."""

CHECKS = 6
"""How often the network is scored on held-out trajectories; the best one is kept."""

ROWS = 150_000
"""Most rows of the tasks that it is trained on."""

FURTHEST = 20.0
"""Largest input and output, in units of a usual change."""


class ResidualGru(CausalBaseline):
    """A gated recurrent unit (Cho et al., 2014) whose output is added to the last value.

    It has no model of the dynamics: its state changes at observations only, and an asked time is an
    input of the read-out. A neural model that predicts worse than this one gains nothing from its
    structure. Inputs of a row with observations are the values, their changes since the last ones,
    what is observed and the times since observation; the read-out is a layer on the state and on
    the times since observation at the asked time. Changes are in units of the root mean square
    change after such a time. Trained for a fixed number of steps with Adam on the Huber loss; an
    eighth of the trajectories is held out and chooses among six moments of the training.
    """

    flexible = True
    slow = True
    cost = 200.0

    gap: Array  # () s, typical one
    edges: Array  # (bins,) s, of AgeBins
    unit: Array  # (bins + 1, channels) usual change, scaled; of channels that were not observed, 1
    bound: Array  # (2, channels) lowest and highest prediction
    input_weight: Array  # (4 * channels, 3 * units)
    input_bias: Array
    hidden_weight: Array  # (units, 3 * units)
    hidden_bias: Array
    read_weight: Array  # (units + channels, units)
    read_bias: Array
    out_weight: Array  # (units, channels)
    out_bias: Array

    history = History(1)

    def arrays(self) -> dict[str, Array]:
        """See `Baseline`."""
        names = ("gap", "edges", "unit", "bound", *WEIGHTS)
        return {**super().arrays(), **{name: getattr(self, name) for name in names}}

    def start(self, like: Any) -> State:
        """See `CausalBaseline`. Besides the history, `hidden` (batch, units)."""
        xp = namespace(like)
        hidden = xp.zeros((like.shape[0], len(self.hidden_weight)), dtype=like.dtype)
        return {**self.history.start(like), "hidden": hidden if xp is np else hidden.to(like)}

    def observe(self, state: State, time: Any, values: Any, mask: Any) -> State:
        """See `CausalBaseline`."""
        xp = namespace(values)
        last = History.last(state, as_kind(self.mean, values))
        inputs = self.inputs(last, History.age(state, time), values, mask)
        hidden = step(self, inputs, state["hidden"])
        seen = xp.where(mask, 1.0 + 0.0 * values, 0.0 * last).sum(-1)[:, None] > 0
        after = self.history.observe(state, time, values, mask)
        return {**after, "hidden": xp.where(seen, hidden, state["hidden"])}

    def read(self, state: State, time: Any) -> Any:
        """See `CausalBaseline`."""
        like = state["count"]
        xp = namespace(like)
        age = History.age(state, time)
        since, unit = self.elapsed(age)
        joined = xp.concatenate([state["hidden"], since], -1)
        read = product(joined, as_kind(self.read_weight, like))
        layer = xp.tanh(read + as_kind(self.read_bias, like))
        out = product(layer, as_kind(self.out_weight, like)) + as_kind(self.out_bias, like)
        change = xp.clip(out, -FURTHEST, FURTHEST) * unit * as_kind(self.scale, like)
        predicted = History.last(state, as_kind(self.mean, like)) + change
        return xp.clip(predicted, as_kind(self.bound[0], like), as_kind(self.bound[1], like))

    def elapsed(self, age: Any) -> tuple[Any, Any]:
        """The input of an age, and the usual change after it."""
        xp = namespace(age)
        never = age == np.inf
        age = xp.clip(age, 0.0, float(self.edges[-1]))
        at = AgeBins(self.edges).of_age(age)
        at = xp.where(never, 0 * at + len(self.edges), at)
        channel = np.arange(len(self.mean)) if xp is np else xp.arange(len(self.mean))
        since = xp.log1p(age / float(self.gap))
        return xp.where(never, 0.0 * since, since), as_kind(self.unit, age)[at, channel]

    def inputs(self, last: Any, age: Any, values: Any, mask: Any) -> Any:
        """(..., 4 * channels) inputs of a row.

        Args:
            last: (..., channels) value before the row, or the training mean.
            age: (..., channels) s since then; infinite without one.
            values: (..., channels) of the row.
            mask: (..., channels) whether they are observed.
        """
        xp = namespace(values)
        since, unit = self.elapsed(age)
        scale = as_kind(self.scale, values)
        place = (values - as_kind(self.mean, values)) / scale
        change = (values - last) / (scale * unit)
        nothing = 0.0 * since
        columns = [
            xp.where(mask, xp.clip(place, -FURTHEST, FURTHEST), nothing),
            xp.where(mask, xp.clip(change, -FURTHEST, FURTHEST), nothing),
            xp.where(mask, 1.0 + nothing, nothing),
            since,
        ]
        return xp.concatenate(columns, -1)

    def estimate(self, tasks: Dataset) -> None:
        """See `Baseline`."""
        bins = AgeBins(1.02 * AgeBins.of(tasks).edges)  # not at multiples of a gap
        self.gap, self.edges = np.asarray(typical_gap(tasks)), bins.edges
        self.unit = np.ones((len(bins) + 1, tasks.channels))
        tasks = some_tasks(tasks, ROWS)
        square, count = np.zeros_like(self.unit), np.zeros_like(self.unit)
        low, high = self.mean.copy(), self.mean.copy()
        for rows in padded(tasks):
            last, age = before(rows, self.mean)
            counted = rows.known & np.isfinite(age)
            channel = np.broadcast_to(np.arange(tasks.channels), age.shape)[counted]
            at = bins.of_age(age)[counted], channel
            np.add.at(square, at, (((rows.values - last) / self.scale)[counted]) ** 2)
            np.add.at(count, at, 1.0)
            low = np.minimum(low, np.where(rows.known, rows.values, np.inf).min(axis=(0, 1)))
            high = np.maximum(high, np.where(rows.known, rows.values, -np.inf).max(axis=(0, 1)))
        usual = np.sqrt(square / np.maximum(count, 1.0))
        self.unit = np.where(usual > 0, np.maximum(usual, 1e-6), 1.0)
        self.bound = np.stack([low - 0.5 * (high - low), high + 0.5 * (high - low)])
        _train(self, tasks)


WEIGHTS = (
    "input_weight",
    "input_bias",
    "hidden_weight",
    "hidden_bias",
    "read_weight",
    "read_bias",
    "out_weight",
    "out_bias",
)


def step(network: ResidualGru, inputs: Any, hidden: Any) -> Any:
    """The next state of a gated recurrent unit, as `torch.nn.GRU` defines it.

    Args:
        network: weights.
        inputs: (batch, inputs).
        hidden: (batch, units) state before.
    """
    xp = namespace(hidden)
    given = inputs @ as_kind(network.input_weight, hidden) + as_kind(network.input_bias, hidden)
    own = hidden @ as_kind(network.hidden_weight, hidden) + as_kind(network.hidden_bias, hidden)
    units = hidden.shape[-1]
    reset, update = (
        0.5 + 0.5 * xp.tanh(0.5 * (given + own)[:, i * units : (i + 1) * units]) for i in range(2)
    )
    new = xp.tanh(given[:, 2 * units :] + reset * own[:, 2 * units :])
    return new + update * (hidden - new)


def before(rows: Rows, mean: Array) -> tuple[Array, Array]:
    """What was last observed before each row.

    Args:
        rows: trajectories.
        mean: (channels,) where there was nothing.

    Returns:
        (batch, rows, channels) values, and s since then, infinite where there was nothing.
    """
    shape = rows.observed.shape
    index = np.where(rows.observed, np.arange(shape[1])[:, None], -1)
    at = np.full(shape, -1)
    at[:, 1:] = np.maximum.accumulate(index, axis=1)[:, :-1]
    there, safe = at >= 0, np.maximum(at, 0)
    times = np.broadcast_to(rows.times[..., None], shape)
    age = times - np.take_along_axis(times, safe, axis=1)
    last = np.take_along_axis(rows.values, safe, axis=1)
    return np.where(there, last, mean), np.where(there, age, np.inf)


@dataclass(frozen=True)
class _Batch:
    """Tensors of trajectories.

    Attributes:
        inputs: (batch, rows, inputs) of the rows that have observations, these first.
        state: (batch, asked) how many of them come before an asked row.
        since: (batch, asked, channels) input of the read-out.
        target: (batch, asked, channels) change since the last value, in units of the usual one.
        weight: (batch, asked, channels) 1 where it is known.
    """

    inputs: Tensor
    state: Tensor
    since: Tensor
    target: Tensor
    weight: Tensor


def _batches(
    network: ResidualGru, tasks: Dataset, size: int, random: np.random.Generator
) -> Iterator[_Batch]:
    """Batches in which each row is asked, and a later one as if all were cut off at the row."""
    import torch

    for rows in padded(tasks, size):
        last, age = before(rows, network.mean)
        inputs = network.inputs(last, age, rows.values, rows.observed)
        some = rows.observed.any(axis=2)
        order = np.argsort(~some, axis=1, kind="stable")[..., None]
        row = np.arange(some.shape[1])
        left = np.maximum(np.array(rows.lengths)[:, None] - row, 1)
        later = row + (left ** random.random(some.shape)).astype(np.int64)
        later = np.minimum(later, some.shape[1] - 1)
        batch = np.arange(len(later))[:, None]
        further = age + (rows.times[batch, later] - rows.times)[..., None]
        known = rows.known[batch, later] & (further <= network.edges[-1])
        ages, lasts = np.concatenate([age, further], axis=1), np.concatenate([last, last], axis=1)
        truth = np.concatenate([rows.values, rows.values[batch, later]], axis=1)
        since, unit = network.elapsed(ages)
        target = np.clip((truth - lasts) / (network.scale * unit), -FURTHEST, FURTHEST)
        weight = np.concatenate([rows.known, known], axis=1)
        state: NDArray[np.int64] = np.cumsum(some, axis=1) - some
        given, asked, wanted, counted = (
            torch.from_numpy(array.astype(np.float32))
            for array in (np.take_along_axis(inputs, order, axis=1), since, target, weight)
        )
        at = torch.from_numpy(np.concatenate([state, state], axis=1))
        yield _Batch(given, at, asked, wanted, counted)


def _train(network: ResidualGru, tasks: Dataset) -> None:
    """Trains the weights of a network; everything else of it is there already."""
    import torch
    from torch import nn

    held = folds_of(tasks, 8) == 0 if len(tasks) > 1 else np.zeros(1, dtype=bool)
    train = take_tasks(tasks, np.flatnonzero(~held))
    held_out = take_tasks(tasks, np.flatnonzero(held)) if held.any() else train
    channels = tasks.channels
    random = np.random.default_rng(0)
    with torch.random.fork_rng(devices=[]), torch.enable_grad():
        torch.manual_seed(0)
        gru = nn.GRU(4 * channels, UNITS, batch_first=True)
        read, out = nn.Linear(UNITS + channels, UNITS), nn.Linear(UNITS, channels)
        nn.init.zeros_(out.weight)
        nn.init.zeros_(out.bias)
        parameters = [p for part in (gru, read, out) for p in part.parameters()]
        optimizer = torch.optim.Adam(parameters, lr=RATE)
        schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, RATE, total_steps=STEPS)

        def loss(batch: _Batch) -> Tensor:
            states, _ = gru(batch.inputs)
            states = torch.cat([torch.zeros_like(states[:, :1]), states], dim=1)
            at = batch.state[..., None].expand(-1, -1, UNITS)
            joined = torch.cat([states.gather(1, at), batch.since], dim=2)
            predicted = out(torch.tanh(read(joined)))
            each = nn.functional.huber_loss(predicted, batch.target, reduction="none", delta=3.0)
            return (each * batch.weight).sum() / batch.weight.sum().clamp(min=1.0)

        def kept() -> list[Tensor]:
            return [p.detach().clone() for p in parameters]

        def score() -> float:
            total = 0.0
            with torch.no_grad():
                for batch in _batches(network, held_out, 256, np.random.default_rng(1)):
                    total += float(loss(batch) * batch.weight.sum())
            return total

        best, weights = score(), kept()
        for i in range(STEPS):
            some = random.choice(len(train), size=min(BATCH, len(train)), replace=False)
            optimizer.zero_grad()
            batch = next(_batches(network, train.take(some), BATCH, random))
            loss(batch).backward()  # type: ignore[no-untyped-call]
            nn.utils.clip_grad_norm_(parameters, 1.0)
            optimizer.step()
            schedule.step()
            if (i + 1) % (STEPS // CHECKS) == 0 and (now := score()) < best:
                best, weights = now, kept()
    found = [w.numpy().astype(np.float64) for w in weights]
    # Of torch: input, hidden weights, their biases, then weights and biases of two layers.
    order = (found[0], found[2], found[1], found[3], *found[4:])
    for name, array in zip(WEIGHTS, order, strict=True):
        setattr(network, name, np.ascontiguousarray(array.T))


BASELINES.register("residual_gru", ResidualGru)
