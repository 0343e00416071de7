"""Kalman filters and smoothers over chains: a position and its derivatives, at uneven times.

The last state of a chain is an Ornstein-Uhlenbeck process, damped velocity or damped acceleration;
the states before it are its integrals, and the position also has a random walk:

    dx = v dt + sqrt(walk) dB,    dv = -damping v dt + sqrt(drive) dW        (order 2)
    dx = v dt + sqrt(walk) dB,    dv = a dt,    da = -damping a dt + sqrt(drive) dW    (order 3)

Each state may be measured, with white noise. Without damping, order 2 is white acceleration and
order 3 white jerk; with damping, order 3 is the model of Singer (1970), IEEE Trans. AES 6(4).
Discretisation is exact for any gap, and all arithmetic is over arrays of chains: there are no small
matrices.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from offbeat.baselines.base import Array, Rows, State, as_kind, namespace

SERIES_BELOW = 0.3
"""Damping times gap up to which a power series is used: closed forms cancel there."""

NO_LIMIT = 1e30
"""Limit of innovations that limits nothing."""

WIDER = 4.0
"""Factor of the limit after each innovation in a row that was beyond it."""

_TERMS = 14

_TINY = 1e-30
"""Damping times gap of at least this, which divides."""


def _series(p: int, q: int) -> list[float]:
    """Coefficients in z of the integral of u^(p+q) phi_p(-z u) phi_q(-z u) over u from 0 to 1."""
    phi = [[(-1.0) ** m / math.factorial(m + r) for m in range(_TERMS)] for r in (p, q)]
    product = np.convolve(phi[0], phi[1])[:_TERMS]
    return [float(c) / (m + p + q + 1) for m, c in enumerate(product)]


_INTEGRALS = {pair: _series(*pair) for pair in ((0, 2), (1, 1), (2, 2))}
_PHI_2 = [(-1.0) ** m / math.factorial(m + 2) for m in range(_TERMS)]


class Transition(NamedTuple):
    """What happens to chains over a gap.

    Attributes:
        matrix: of order rows and columns; None stands for 0 below the diagonal and for 1 on it.
        noise: covariance that is added, per pair i <= j of states.
    """

    matrix: list[list[Any]]
    noise: dict[tuple[int, int], Any]


def transition(gap: Any, damping: Any, drive: Any, walk: Any, order: int) -> Transition:
    """The exact transition of chains; two of them in a row are one over the sum of the gaps.

    With E_0 = exp(-z), E_1 = 1 - E_0, E_2 = z - E_1 and z = damping * gap, the last state moves
    the p-th state before it by gap^p E_p / z^p, and the covariance of two states is drive times
    the integral of the product of those.

    Args:
        gap: (...) at least 0.
        damping: (...) at least 0, per unit of the gap.
        drive: (...) variance of the noise on the last state, per unit of the gap.
        walk: (...) the same on the position.
        order: number of states, 2 or 3.
    """
    xp = namespace(gap)
    z = xp.clip(gap * damping, _TINY, None)
    small = z < SERIES_BELOW
    safe = xp.where(small, 1.0, z)
    cube = safe * safe * safe
    e0, e1 = xp.exp(-z), -xp.expm1(-z)
    half = e1 * (1.0 - 0.5 * e1)  # (1 - E_0^2) / 2 without cancellation
    reach = [e0, gap * (e1 / z)]  # gap^p E_p / z^p
    squared = drive * gap * gap
    integral = xp.where(small, _polynomial(_INTEGRALS[1, 1], z), (z - 2.0 * e1 + half) / cube)
    # The derivative of the p-th reach is the one before: half its square is their integral.
    last = drive * gap * (half / z)
    beside = 0.5 * drive * reach[1] * reach[1]
    second = squared * gap * integral
    if order == 2:
        matrix: list[list[Any]] = [[None, reach[1]], [None, e0]]
        noise = {(0, 0): second + walk * gap, (0, 1): beside, (1, 1): last}
        return Transition(matrix, noise)
    e2 = z - e1
    reach.append(gap * gap * xp.where(small, _polynomial(_PHI_2, z), e2 / (safe * safe)))
    integral = xp.where(small, _polynomial(_INTEGRALS[0, 2], z), (half - z * e0) / cube)
    across = squared * gap * integral
    exact = ((z - 1.0) * (z - 1.0) * (z - 1.0) + 1.0) / 3.0 - 2.0 * z * e0 + half
    integral = xp.where(small, _polynomial(_INTEGRALS[2, 2], z), exact / (cube * safe * safe))
    noise = {
        (0, 0): squared * gap * gap * gap * integral + walk * gap,
        (0, 1): 0.5 * drive * reach[2] * reach[2],
        (0, 2): across,
        (1, 1): second,
        (1, 2): beside,
        (2, 2): last,
    }
    return Transition([[None, gap, reach[2]], [None, None, reach[1]], [None, None, e0]], noise)


def _polynomial(coefficients: list[float], z: Any) -> Any:
    result = coefficients[-1] * z + coefficients[-2]
    for c in reversed(coefficients[:-2]):
        result = result * z + c
    return result


class Belief(NamedTuple):
    """Mean and covariance of the states of chains.

    Attributes:
        mean: (..., chains) per state.
        cov: (..., chains) per pair i <= j of states.
    """

    mean: list[Any]
    cov: dict[tuple[int, int], Any]

    def moved(self, step: Transition) -> Belief:
        """After a gap."""
        order, f = len(self.mean), step.matrix
        mean = [_row(f[i], i, self.mean) for i in range(order)]
        columns = [[self.cov[min(i, j), max(i, j)] for i in range(order)] for j in range(order)]
        half = [[_row(f[i], i, columns[j]) for j in range(order)] for i in range(order)]
        cov = {(i, j): _row(f[j], j, half[i]) + step.noise[i, j] for i, j in step.noise}
        return Belief(mean, cov)

    def updated(
        self, j: int, value: Any, noise: Any, mask: Any, limit: Any = None
    ) -> tuple[Belief, Update]:
        """After a measurement of state j; exact and symmetric for noise of any size, 0 included.

        Args:
            j: number of the state.
            value: (..., chains) measured.
            noise: (..., chains) its variance.
            mask: (..., chains) bool, where there is a measurement.
            limit: (..., chains) of the innovation, in units of its standard deviation. Beyond it, a
                measurement has so much more noise that it moves the mean as one at the limit would
                (Huber 1964, Annals of Mathematical Statistics 35(1)).
        """
        xp = namespace(value)
        order = len(self.mean)
        measured = xp.where(mask, 1.0, 0.0)
        value = xp.where(mask, value, 0.0)
        column = [self.cov[min(i, j), max(i, j)] for i in range(order)]
        total = column[j] + noise
        total = xp.where(total > 0, total, 1.0)
        surprise = value - measured * self.mean[j]
        beyond = None
        if limit is not None:
            ratio = xp.abs(surprise) / (xp.sqrt(total) * limit)
            beyond = ratio > 1.0
            total = xp.where(beyond, total * ratio, total)
            noise = xp.where(beyond, total - column[j], noise)
        inverse = measured / total
        gain = [c * inverse for c in column]
        kept = noise * inverse + (1.0 - measured)
        mean = [m + g * surprise for m, g in zip(self.mean, gain, strict=True)]
        cov = {}
        for (a, b), p in self.cov.items():
            if j in (a, b):
                cov[a, b] = p * kept
            else:
                left = p - gain[a] * column[b]
                cov[a, b] = xp.clip(left, 0.0, None) if a == b else left
        return Belief(mean, cov), Update(j, gain, surprise * inverse, beyond)


class Update(NamedTuple):
    """A measurement, as the smoother needs it: state, gain, innovation by its variance.

    Where nothing was measured, gain and innovation are 0. `beyond` says where the innovation was
    beyond its limit; None without one.
    """

    state: int
    gain: list[Any]
    surprise: Any
    beyond: Any


def _row(row: list[Any], i: int, vector: list[Any]) -> Any:
    """A row of a transition matrix times a vector."""
    result = vector[i] if row[i] is None else row[i] * vector[i]
    for j in range(i + 1, len(vector)):
        result = result + row[j] * vector[j]
    return result


class Memory:
    """Arrays of all rows, in memory that the next call uses again.

    A search calls a filter or a smoother many times with arrays of the same size; half of its time
    would go into new memory. What a call returns is overwritten by the next one.
    """

    def __init__(self) -> None:
        self._arrays: dict[tuple[int, ...], Array] = {}

    def keeper(self, row: int, shape: tuple[int, ...]) -> Callable[[Array], Array]:
        """A function that copies arrays of a row, each to a place of its own.

        Args:
            row: number of the row.
            shape: (rows, ...) of an array of all rows.
        """
        count = iter(range(1000))

        def keep(array: Array) -> Array:
            place = (next(count), *shape)
            if place not in self._arrays:
                self._arrays[place] = np.empty(shape)
            kept: Array = self._arrays[place][row]
            kept[...] = array
            return kept

        return keep

    def means(self, order: int, shape: tuple[int, ...], rows: int) -> list[Array]:
        """(..., rows, chains) per state, not initialised."""
        found = []
        for j in range(order):
            place = (-1 - j, rows, *shape)
            if place not in self._arrays:
                self._arrays[place] = np.empty((*shape[:-1], rows, shape[-1]))
            found.append(self._arrays[place])
        return found


@dataclass(frozen=True, eq=False)
class Chains:
    """Chains of one order and their parameters.

    States have the unit `unit`, time has the unit `clock`; variances are in multiples of
    `variance`, on which no mean depends. Parameters may have further axes before the last, of
    candidates in a search; then so do states.

    Attributes:
        channels: (chains, order) number of the channel that measures a state; -1 where none does.
        offset: (chains,) zero of the position, in its unit.
        unit: (chains, order) size of one unit of a state in the channel that measures it.
        clock: (chains,) s.
        longest: (chains,) s, longest time after the last observation for which the mean moves on.
        drive: (chains,) see `transition`.
        walk: (chains,) see `transition`.
        damping: (chains,) see `transition`.
        noise: (order, chains) variance of the measurements of a state.
        prior_mean: (order, chains) of the states before the first observation.
        prior: (order, chains) their variance.
        variance: (chains,) unit of the variances.
        limit: (order, chains) of the innovations of a state, in units of their standard deviation
            before `variance`. After each measurement beyond it, the next one may be `WIDER` times
            as far, so that a single wild value moves little and a step is soon followed.
    """

    channels: NDArray[np.int64]
    offset: Array
    unit: Array
    clock: Array
    longest: Array
    drive: Array
    walk: Array
    damping: Array
    noise: Array
    prior_mean: Array
    prior: Array
    variance: Array = field(default_factory=lambda: np.ones(1))
    limit: Array = field(default_factory=lambda: np.full((1, 1), NO_LIMIT))

    @property
    def order(self) -> int:
        """Number of states of a chain."""
        return int(self.channels.shape[1])

    @property
    def limited(self) -> bool:
        """Whether there is a limit of innovations."""
        return bool((self.limit < NO_LIMIT).any())

    def arrays(self, prefix: str) -> dict[str, Array]:
        """All fields by name, after a prefix; `of` is the inverse."""
        return {prefix + name: getattr(self, name) for name in self.__dataclass_fields__}

    @classmethod
    def of(cls, arrays: Mapping[str, Array], prefix: str) -> Chains:
        """From what `arrays` returned."""
        fields: dict[str, Any] = {
            n: np.asarray(arrays[prefix + n])
            for n in cls.__dataclass_fields__
            if n != "limit" or prefix + n in arrays  # not in the first files of 0.2.0
        }
        return cls(**fields)

    @classmethod
    def joined(cls, parts: Sequence[tuple[Chains, int]]) -> Chains:
        """Single chains of one order as one.

        Args:
            parts: chains, and the number of one of them.
        """
        fields: dict[str, Any] = {}
        for name in cls.__dataclass_fields__:
            axis = 0 if name in ("channels", "unit") else -1
            each = [getattr(chains, name).take([i], axis) for chains, i in parts]
            fields[name] = np.concatenate(each, axis)
        return cls(**fields)

    # --- filter -----------------------------------------------------------------------------------

    def start(self, like: Any) -> State:
        """The state before the first row; see `CausalBaseline.start`."""
        empty = like[..., self._of(0)] * 0.0
        seen = {f"seen{i}": empty for i in range(self.order)}
        state = {**self._packed(self._before(empty)), "time": empty, "started": empty, **seen}
        return {**state, **{f"beyond{i}": streak for i, streak in enumerate(self._streaks(empty))}}

    def observe(self, state: State, time: Any, values: Any, mask: Any) -> State:
        """The state after a row; see `CausalBaseline.observe`."""
        return self.committed(state, self.moved(state, time), time, values, mask)

    def read(self, state: State, time: Any) -> list[Any]:
        """(..., chains) per state: the mean, in units of the channels."""
        xp = namespace(state["time"])
        longest = state["time"] + self._like(self.longest, state["time"])
        belief = self.moved(state, xp.where(time < longest, time, longest))
        return self.in_units(belief.mean, [state[f"seen{i}"] for i in range(self.order)])

    def read_variance(self, state: State, time: Any) -> list[Any]:
        """(..., chains) per state: variance of a measurement, in squared units of the channels.

        That of a position that was not observed yet is the square of its unit.
        """
        xp = namespace(state["time"])
        cov = self.moved(state, time).cov
        like = state["time"]
        unit = [self._like(self.unit[:, i] ** 2, like) for i in range(self.order)]
        variance = self._like(self.variance, like)
        found = [
            (cov[i, i] + self._like(self.noise[i], like)) * variance * unit[i]
            for i in range(self.order)
        ]
        return [xp.where(state["seen0"] > 0, found[0], unit[0]), *found[1:]]

    def moved(self, state: State, time: Any) -> Belief:
        """The belief at a time after the last observation; before the first one, the prior."""
        xp = namespace(state["time"])
        belief = self._unpacked(state)
        gap = xp.where(state["started"] > 0, time - state["time"], 0.0)
        return belief.moved(self._transition(gap))

    def committed(self, state: State, moved: Belief, time: Any, values: Any, mask: Any) -> State:
        """The state after a row, given the belief before it."""
        xp = namespace(state["time"])
        masks = self._masks(mask)
        some = masks[0]
        for each in masks[1:]:
            some = some | each
        streaks = [state[f"beyond{i}"] for i in range(self.order)] if self.limited else []
        belief, _, streaks = self._measured(moved, values, masks, streaks)
        new = {
            name: xp.where(some, value, state[name]) for name, value in self._packed(belief).items()
        }
        new["time"] = xp.where(some, time + 0.0 * state["time"], state["time"])
        new["started"] = xp.where(some, 1.0, state["started"])
        for i, each in enumerate(masks):
            new[f"seen{i}"] = xp.where(each, 1.0, state[f"seen{i}"])
        return {**new, **{f"beyond{i}": streak for i, streak in enumerate(streaks)}}

    # --- smoother ---------------------------------------------------------------------------------

    def smooth(self, rows: Rows) -> list[Array]:
        """The mean of every row given all observations: the Rauch-Tung-Striebel smoother.

        In the form of Bryson and Frazier (1963), which inverts no covariance, so that noise and
        gaps may be as small as they like.

        Args:
            rows: of equal channels; `values` and `observed` are used.

        Returns:
            (..., batch, rows, chains) per state, in units of the channels.
        """
        times = _times(rows)
        means = self.smoothed(rows, np.diff(times, axis=1, prepend=times[:, :1]))
        seen = [m.any(axis=1)[:, None] * 1.0 for m in self._masks(rows.observed)]
        return self.in_units(means, seen)

    def smoothed(self, rows: Rows, gaps: Array, memory: Memory | None = None) -> list[Array]:
        """As `smooth`, in the units of the states.

        Args:
            rows: of equal channels.
            gaps: (batch, rows, 1 or chains) s since the row before.
            memory: for the result and for what is kept on the way; see `Memory`.
        """
        memory = memory or Memory()
        kept: list[tuple[list[list[Any]], Belief, list[Update]]] = []
        for matrix, before, updates in self.forward(rows, gaps):
            shape = (gaps.shape[1], *before.mean[0].shape)
            keep = memory.keeper(len(kept), shape)
            kept.append(
                (
                    [[None if each is None else keep(each) for each in row] for row in matrix],
                    Belief(
                        [keep(m) for m in before.mean],
                        {pair: keep(p) for pair, p in before.cov.items()},
                    ),
                    [
                        Update(u.state, [keep(g) for g in u.gain], keep(u.surprise), None)
                        for u in updates
                    ],
                )
            )
        adjoint: list[Any] = [0.0 * m for m in kept[0][1].mean]
        means = memory.means(self.order, adjoint[0].shape, gaps.shape[1])
        for i in range(len(kept) - 1, -1, -1):
            matrix, before, updates = kept.pop()
            for update in reversed(updates):
                j = update.state
                fed = update.surprise
                for g, a in zip(update.gain, adjoint, strict=True):
                    fed = fed + g * a
                adjoint[j] = adjoint[j] - fed
            cov = before.cov
            for a, m in enumerate(before.mean):
                moved = m - cov[0, a] * adjoint[0]
                for b in range(1, self.order):
                    moved -= cov[min(a, b), max(a, b)] * adjoint[b]
                means[a][..., i, :] = moved
            adjoint = _transposed(matrix, adjoint)
        return means

    def forward(
        self, rows: Rows, gaps: Array
    ) -> Iterator[tuple[list[list[Any]], Belief, list[Update]]]:
        """The matrix of the step to every row, the belief before its measurements, and these.

        Args:
            rows: of equal channels.
            gaps: (batch, rows, 1 or chains) s since the row before.
        """
        empty = np.zeros((len(rows.times), len(self.channels)))
        masks = self._masks(rows.observed)
        belief, streaks = self._before(empty), self._streaks(empty)
        for i in range(gaps.shape[1]):
            step = self._transition(gaps[:, i] + empty)
            before = belief.moved(step)
            at = [m[:, i] for m in masks]
            belief, made, streaks = self._measured(before, rows.values[:, i], at, streaks)
            yield step.matrix, before, made

    # --- filter, all rows at once -----------------------------------------------------------------

    def seen_before(self, rows: Rows) -> list[Array]:
        """(batch, rows, chains) per state: 1 where its channel was observed in an earlier row."""
        found = []
        for mask in self._masks(rows.observed):
            before = np.zeros(mask.shape)
            before[:, 1:] = np.logical_or.accumulate(mask, axis=1)[:, :-1]
            found.append(before)
        return found

    def predicted(self, rows: Rows, gaps: Array, memory: Memory | None = None) -> list[Array]:
        """(..., batch, rows, chains) per state: its mean before every row, in units of the states.

        Args:
            rows: of equal channels.
            gaps: of `gaps_of`.
            memory: for the result; see `Memory`.
        """
        memory = memory or Memory()
        means: list[Array] = []
        for i, (_, before, _) in enumerate(self.forward(rows, gaps)):
            if not means:
                means = memory.means(self.order, before.mean[0].shape, gaps.shape[1])
            for stacked, mean in zip(means, before.mean, strict=True):
                stacked[..., i, :] = mean
        return means

    # --- what both share --------------------------------------------------------------------------

    def in_units(self, mean: list[Any], seen: list[Any]) -> list[Any]:
        """States in units of their channels.

        A position that was not observed yet is its mean: its derivatives do not tell where it is.

        Args:
            mean: (..., chains) per state.
            seen: (..., chains) per state, whether its channel was observed.
        """
        xp = namespace(mean[0])
        units = [m * self._like(self.unit[:, i], m) for i, m in enumerate(mean)]
        offset = self._like(self.offset, mean[0])
        return [xp.where(seen[0] > 0, units[0], 0.0) + offset, *units[1:]]

    def _before(self, empty: Any) -> Belief:
        mean = [empty + self._like(m, empty) for m in self.prior_mean]
        cov = {(i, j): empty for i in range(self.order) for j in range(i, self.order)}
        for i in range(self.order):
            cov[i, i] = empty + self._like(self.prior[i], empty)
        return Belief(mean, cov)

    def _transition(self, gap: Any) -> Transition:
        gap = gap / self._like(self.clock, gap)
        damping, drive, walk = (self._like(a, gap) for a in (self.damping, self.drive, self.walk))
        return transition(gap, damping, drive, walk, self.order)

    def _streaks(self, empty: Any) -> list[Any]:
        """Per state, how many measurements in a row were beyond the limit; none without limits."""
        return [empty for _ in range(self.order)] if self.limited else []

    def _measured(
        self, belief: Belief, values: Any, masks: list[Any], streaks: list[Any]
    ) -> tuple[Belief, list[Update], list[Any]]:
        updates, after = [], list(streaks)
        for i, mask in enumerate(masks):
            if not (self.channels[:, i] >= 0).any():
                continue
            value = values[..., self._of(i)]
            xp = namespace(value)
            if i == 0:
                value = value - self._like(self.offset, value)
            value = value / self._like(self.unit[:, i], value)
            limit = None
            if streaks:
                limit = self._like(self.limit[i], value) * xp.exp(math.log(WIDER) * streaks[i])
            noise = self._like(self.noise[i], value)
            belief, update = belief.updated(i, value, noise, mask, limit)
            updates.append(update)
            if streaks:
                longer = xp.clip(streaks[i] + 1.0, 0.0, 30.0)
                streak = xp.where(update.beyond, longer, 0.0 * streaks[i])
                after[i] = xp.where(mask, streak, streaks[i])
        return belief, updates, after

    def _masks(self, mask: Any) -> list[Any]:
        xp = namespace(mask)
        there = xp.asarray(self.channels >= 0)
        if xp is not np:
            there = there.to(mask.device)
        return [mask[..., self._of(i)] & there[:, i] for i in range(self.order)]

    def _of(self, i: int) -> NDArray[np.int64]:
        """(chains,) channel of a state; any where there is none."""
        return np.maximum(self.channels[:, i], 0)

    def _like(self, array: Array, like: Any) -> Any:
        return as_kind(array, like)

    def _packed(self, belief: Belief) -> State:
        means = {f"mean{i}": m for i, m in enumerate(belief.mean)}
        return means | {f"cov{i}{j}": p for (i, j), p in belief.cov.items()}

    def _unpacked(self, state: State) -> Belief:
        order = range(self.order)
        return Belief(
            [state[f"mean{i}"] for i in order],
            {(i, j): state[f"cov{i}{j}"] for i in order for j in order if i <= j},
        )


def filtered(chains: Chains, rows: Rows) -> list[Array]:
    """What a filter predicts for every row: (..., batch, rows, chains) per state."""
    seen = chains.seen_before(rows)
    means = chains.predicted(rows, gaps_of(rows, seen))
    return chains.in_units(means, seen)


def gaps_of(rows: Rows, seen: Sequence[Array]) -> Array:
    """(batch, rows, chains) s since the row before, from the first observation of a chain on.

    Args:
        rows: to step through.
        seen: of `Chains.seen_before`.
    """
    times = _times(rows)
    started = np.maximum.reduce(list(seen)) > 0
    return np.where(started, np.diff(times, axis=1, prepend=times[:, :1]), 0.0)


def _times(rows: Rows) -> Array:
    """(batch, rows, 1) s; (batch, rows, chains) where every chain has rows of its own."""
    return rows.times if rows.times.ndim == 3 else rows.times[..., None]


def _transposed(matrix: list[list[Any]], vector: list[Any]) -> list[Any]:
    """The transpose of a transition matrix times a vector."""
    result = []
    for j in range(len(vector)):
        own = vector[j] if matrix[j][j] is None else matrix[j][j] * vector[j]
        for i in range(j):
            own = own + matrix[i][j] * vector[i]
        result.append(own)
    return result
