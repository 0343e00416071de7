"""Ridge regression on what was observed, one fit per channel and time since observation."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from offbeat.baselines.base import (
    BASELINES,
    Array,
    CausalBaseline,
    State,
    as_kind,
    channels_of,
    namespace,
    product,
)
from offbeat.baselines.examples import FURTHEST, Examples, examples_of, likeness, some_tasks
from offbeat.baselines.held_out import held_out_ridge
from offbeat.baselines.history import (
    AgeBins,
    History,
    longest_age,
    others_part,
    others_seen,
    typical_gap,
)
from offbeat.data.trajectory import Dataset

SPANS = (1, 2, 4)
"""Intervals that the slopes span."""

AVERAGES = 2
"""Exponential averages of each channel."""

ROWS = 250_000
"""Most rows of the tasks that a fit looks at."""

FOLLOWED = 16
"""Most channels whose motion since a channel was observed is followed."""


class Ridge(CausalBaseline):
    r"""Ridge regression of the change of each channel since its last observation.

    For a channel whose last value is :math:`x`, observed :math:`a` s ago, the prediction is
    :math:`x + s (r\, w^T \phi + v^T \psi(r))`, with the channel's scale :math:`s`, the relative age
    :math:`r`, which is :math:`a` over the middle of its bin, features :math:`\phi` of all channels
    and :math:`\psi` of its own. Weights differ between the bins of `AgeBins`, and in each of them
    between an outage of all channels and one of this channel, where others were observed in the
    last 55 % of :math:`a`. A channel that was not observed yet has further weights, :math:`r = 1`
    and the training mean as its last value. Between the middles of two bins, the prediction is the
    mean of those with the weights of both, so that it is continuous in time.

    The features of a channel are its last value, its slopes over 1, 2 and 4 intervals, and its last
    value less exponential averages over 4 typical gaps and over the longest age. :math:`\psi` is
    those of the channel, with and without the factor :math:`r`, and the motion of other channels
    since it was observed. All are limited to what training had, with a margin. A change is no
    larger than those of training at that time since observation, and predictions stay in the range
    of training, with a margin, or as far out as the last value, up to 10 scales.

    Weights are those of least squares with relative errors, :math:`1 / r`, on every state of the
    tasks and some later rows. They come in steps, each fitted to what the one before left: own
    features in an outage of all channels, then features of all; then the same for an outage of one.
    The penalty of every step is chosen on held-out trajectories (`held_out_ridge`); where nothing
    helps, the prediction is the last value.
    """

    flexible = True
    located = True
    cost = 60.0

    most_states: ClassVar[int] = 50_000  # of the tasks, that a fit uses
    most_examples: ClassVar[int] = 6_000  # of a channel in a bin
    most_inputs: ClassVar[int] = 32  # channels whose features a channel uses

    edges: Array  # (bins,) s, of AgeBins
    averages: Array  # (averages,) s, time constants
    followed: NDArray[np.int64]  # (channels, followed) whose motion a channel uses
    limits: Array  # (2, channels * features) lowest and highest
    spread: Array  # (channels * features,)
    weight: Array  # (2 * bins + 1, shared features, channels)
    own_weight: Array  # (2 * bins + 1, channels, own features)
    reach: Array = np.full((1, 1), FURTHEST)  # (2 * bins + 1, channels) farthest change of training
    bound: Array  # (2, channels) lowest and highest prediction

    history = History(max(SPANS) + 1)

    def arrays(self) -> dict[str, Array]:
        """See `Baseline`."""
        names = ("edges", "averages", "followed", "limits", "spread")
        fitted = ("weight", "own_weight", "reach", "bound")
        return {**super().arrays(), **{name: getattr(self, name) for name in (*names, *fitted)}}

    # --- state --------------------------------------------------------------------------------

    def start(self, like: Any) -> State:
        """See `CausalBaseline`.

        Besides the history, `average` (batch, channels, averages) and `then` (batch, channels,
        followed), the last values of other channels when this one was observed, standardised.
        """
        xp = namespace(like)
        return {
            **self.history.start(like),
            "average": xp.stack([like] * len(self.averages), -1),
            "then": (0.0 * like)[..., _index(self.followed, xp)],
        }

    def observe(self, state: State, time: Any, values: Any, mask: Any) -> State:
        """See `CausalBaseline`."""
        xp = namespace(values)
        at = mask[..., None]
        since = (time - state["times"][..., 0])[..., None]
        kept = xp.exp(-since / as_kind(self.averages, values)) * (state["count"] > 0)[..., None]
        average = values[..., None] + kept * (state["average"] - values[..., None])
        after = self.history.observe(state, time, values, mask)
        now = self._standardised(after)[..., _index(self.followed, xp)]
        return {
            **after,
            "average": xp.where(at, average, state["average"]),
            "then": xp.where(at, now, state["then"]),
        }

    def _standardised(self, state: State) -> Any:
        """(batch, channels) last values; 0 where there was none."""
        mean = as_kind(self.mean, state["count"])
        return (History.last(state, mean) - mean) / as_kind(self.scale, state["count"])

    def features(self, state: State) -> Any:
        """(batch, channels, features) of every channel; 0 where it was not observed."""
        xp = namespace(state["count"])
        scale = as_kind(self.scale, state["count"])
        moved = (state["values"][..., :1] - state["average"]) / scale[..., None]
        columns = [
            self._standardised(state),
            *(History.slope(state, span) / scale for span in SPANS),
            *(moved[..., i] for i in range(len(self.averages))),
        ]
        return xp.where((state["count"] > 0)[..., None], xp.stack(columns, -1), 0.0)

    def moved(self, state: State) -> Any:
        """(batch, channels, followed) motion of others since a channel was observed."""
        xp = namespace(state["count"])
        now = self._standardised(state)[..., _index(self.followed, xp)]
        return xp.clip(now - state["then"], -FURTHEST, FURTHEST)

    # --- predictions --------------------------------------------------------------------------

    def read(self, state: State, time: Any) -> Any:
        """See `CausalBaseline`."""
        like = state["count"]
        xp = namespace(like)
        features, moved = self._limited(self.features(state)), self.moved(state)
        kinds, inputs, channels = self.weight.shape
        weight = as_kind(self.weight.transpose(1, 0, 2).reshape(inputs, -1), like)
        each = product(self.shared(features), weight).reshape(-1, kinds, channels)
        own_weight = as_kind(self.own_weight, like)
        # Beyond what was fitted to, a change is no larger than those that were seen.
        most = as_kind(np.broadcast_to(self.reach, (kinds, channels)).copy(), like)
        row, channel = xp.arange(len(each))[:, None], channels_of(like)
        change = reach = 0.0 * like
        for relative, several in self._near(History.age(state, time)):
            own = _own(features, moved, relative)
            for at, part in several:
                found = (own * own_weight[at, channel]).sum(-1) + relative * each[row, at, channel]
                change, reach = change + part * found, reach + part * most[at, channel]
        change = xp.minimum(xp.maximum(change, -reach), reach)
        last = History.last(state, as_kind(self.mean, like))
        predicted = last + change * as_kind(self.scale, like)
        # The last value may be beyond what was fitted to, though not by any amount.
        low, high = (as_kind(bound, like) for bound in self.bound)
        further = FURTHEST * as_kind(self.scale, like)
        low, high = xp.clip(last, low - further, low), xp.clip(last, high, high + further)
        return xp.minimum(xp.maximum(predicted, low), high)

    def shared(self, features: Any) -> Any:
        """(batch, shared features) those of all channels, and a 1."""
        flat = features.reshape(features.shape[0], -1)
        xp = namespace(flat)
        return xp.concatenate([flat, xp.ones_like(flat[:, :1])], -1)

    def _limited(self, features: Any) -> Any:
        flat = features.reshape(features.shape[0], -1)
        low, high = (as_kind(limit, flat) for limit in self.limits)
        flat = namespace(flat).clip(flat, low, high) / as_kind(self.spread, flat)
        return flat.reshape(features.shape)

    def _near(self, age: Any) -> list[tuple[Any, list[tuple[Any, Any]]]]:
        """The bins before and after an age: the age over the middle, weights and their parts."""
        xp, bins = namespace(age), AgeBins(self.edges)
        seen, alone = age < np.inf, others_part(age)
        age = xp.where(seen, xp.clip(age, 0.0, float(self.edges[-1])), 0.0)
        before, part = bins.between(age)
        after = xp.where(before < len(bins) - 1, before + 1, before)
        found = []
        for at, share in ((before, 1 - part), (after, part)):
            relative = xp.where(seen, age / as_kind(bins.middle, age)[at], 1.0)
            both = ((at, share * (1 - alone)), (at + len(bins), share * alone))
            several = [(xp.where(seen, which, 2 * len(bins)), each) for which, each in both]
            found.append((relative, several))
        return found

    def placed(self, age: Any) -> tuple[Any, Any]:
        """Which weights are fitted to an age, and the age over the middle of its bin."""
        xp = namespace(age)
        bins = AgeBins(self.edges)
        seen = age < np.inf
        age = xp.clip(age, 0.0, float(self.edges[-1]))
        at = bins.of_age(age)
        relative = age / as_kind(bins.middle, age)[at]
        at = xp.where(others_seen(age), at + len(bins), at)
        return (
            xp.where(seen, at, 0 * at + 2 * len(bins)),
            xp.where(seen, relative, xp.ones_like(relative)),
        )

    # --- fitting ------------------------------------------------------------------------------

    def estimate(self, tasks: Dataset) -> None:
        """See `Baseline`."""
        gap, longest = typical_gap(tasks), longest_age(tasks)
        self.edges = AgeBins.of(tasks).edges
        self.averages = np.geomspace(4 * gap, max(longest, 8 * gap), AVERAGES)
        known = [np.where(t.known, t.values, np.nan) for t in tasks]
        every = np.concatenate([*known, np.where(np.isfinite(self.mean), self.mean, 0.0)[None]])
        low, high = np.nanmin(every, axis=0), np.nanmax(every, axis=0)
        self.bound = np.stack([low - 0.5 * (high - low), high + 0.5 * (high - low)])
        tasks = some_tasks(tasks, ROWS)
        alike = likeness(tasks)
        order = np.argsort(-alike, axis=1, kind="stable")
        self.followed = np.ascontiguousarray(order[:, 1 : FOLLOWED + 1])
        found = examples_of(self, tasks)
        self._measure(found.features)
        features = self._limited(found.features).astype(np.float32)
        self._solve(found, features, alike)

    def _measure(self, features: Array) -> None:
        """Limits and spreads of the features."""
        flat = features.reshape(len(features), -1)
        low, high = np.quantile(flat, [0.0005, 0.9995], axis=0)
        self.limits = np.stack([low - 0.5 * (high - low), high + 0.5 * (high - low)])
        spread = np.clip(flat, *self.limits).std(axis=0, dtype=np.float64)
        self.spread = np.where(spread > 0, spread, 1.0)

    def _solve(self, found: Examples, features: Array, alike: Array) -> None:
        bins, channels = len(self.edges), features.shape[1]
        size = 2 + 2 * features.shape[2] + self.followed.shape[1]
        self.own_weight = np.zeros((2 * bins + 1, channels, size))
        self.weight = np.zeros((2 * bins + 1, self.shared(features[:1]).shape[1], channels))
        self.reach = np.zeros((2 * bins + 1, channels))
        for b in range(2 * bins + 1):
            seen = np.abs(np.where(found.at == b, found.change, 0.0)).max(axis=0, initial=0.0)
            self.reach[b] = np.maximum(seen, self.reach[b - bins] if bins <= b < 2 * bins else 0.0)
            if bins <= b < 2 * bins:
                self.own_weight[b] = self.own_weight[b - bins]
                self.weight[b] = self.weight[b - bins]
            for group, rows in found.together(b, self.most_examples):
                at = found.state[rows]
                columns = self._columns(group, alike, features.shape[2])
                shared = self.shared(features[at])[:, columns].astype(np.float64)
                left = np.empty((len(rows), len(group)))
                for i, c in enumerate(group):
                    r = found.relative[rows, c].astype(np.float64)[:, None]
                    own = _own(features[at, c], found.moved[at, c], r[:, 0]) / r
                    target = found.change[rows, c] / r[:, 0]
                    target = target - own @ self.own_weight[b, c]
                    target = target - shared @ self.weight[b, columns, c]
                    step = held_out_ridge(own, target[:, None], found.fold[at])[:, 0]
                    self.own_weight[b, c] += step
                    left[:, i] = target - own @ step
                self.weight[b][columns[:, None], group] += held_out_ridge(
                    shared, left, found.fold[at]
                )

    def _columns(self, group: list[int], alike: Array, each: int) -> NDArray[np.int64]:
        """The shared features that predict these channels: of the channels most like them."""
        channels = len(alike)
        most = max(len(group), min(max(1000 // channels, 12), self.most_inputs))
        inputs = np.sort(np.argsort(-alike[group].max(axis=0), kind="stable")[:most])
        columns = (inputs[:, None] * each + np.arange(each)).ravel()
        return np.append(columns, channels * each)


def _own(features: Any, moved: Any, relative: Any) -> Any:
    """(..., own features) of the channel itself and of the motion of others."""
    xp = namespace(relative)
    relative = relative[..., None]
    one = xp.ones_like(relative)
    return xp.concatenate([relative, one, relative * features, features, moved], -1)


def _index(index: NDArray[np.int64], xp: Any) -> Any:
    return index if xp is np else xp.as_tensor(index)


BASELINES.register("ridge", Ridge)
