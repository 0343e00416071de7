"""Gaps between the observations of a channel, and features of the values inside."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from offbeat.baselines.base import Array, Rows

OWN, EACH = 13, 10
"""Features of the channel itself, and of each other one."""

DENSE = 0.55
"""Another channel is observed more often where its gap is at most this part of the gap."""

SIZE = 128
"""Trajectories that are handled together."""


class Gaps:
    """Neighbours of every value, in scaled units.

    Attributes:
        earlier, later: (batch, rows, channels) whether there is an observation at or before, and
            at or after a row.
        gap: (batch, rows, channels) s between them.
        line: (batch, rows, channels) the line between them; the nearest one outside.
        alone: (batch, rows, channels) whether no other channel is observed between them.
        hidden: (batch, rows, channels) not observed, with observations on both sides, in a
            trajectory.
    """

    def __init__(self, rows: Rows, mean: Array, scale: Array) -> None:
        self.times = rows.times
        shape = rows.observed.shape
        index = np.broadcast_to(np.arange(shape[1])[:, None], shape)
        self._before = np.maximum.accumulate(np.where(rows.observed, index, -1), axis=1)
        after = np.where(rows.observed, index, shape[1])[:, ::-1]
        self._after = np.minimum.accumulate(after, axis=1)[:, ::-1]
        self.earlier, self.later = self._before >= 0, self._after < shape[1]
        self._before = np.maximum(self._before, 0)
        self._after = np.minimum(self._after, shape[1] - 1)
        self.values = np.where(rows.observed, (rows.values - mean) / scale, 0.0)
        v0, v1 = self._at(self.values, self._before), self._at(self.values, self._after)
        v0, v1 = np.where(self.earlier, v0, v1), np.where(self.later, v1, v0)
        times = np.broadcast_to(rows.times[..., None], shape)
        self._t0, self._t1 = self._at(times, self._before), self._at(times, self._after)
        both = self.earlier & self.later
        self.gap = np.where(both, self._t1 - self._t0, 0.0)
        self.spacing = np.where(both, self.gap, np.inf)
        length = np.where(self.gap > 0, self.gap, 1.0)
        self.u = np.where(self.gap > 0, (times - self._t0) / length, 0.0)
        self.line = v0 + self.u * (v1 - v0)
        self.rise = np.where(both, v1 - v0, 0.0)
        inside = np.arange(shape[1]) < np.array(rows.lengths)[:, None]
        self.hidden = both & ~rows.observed & inside[..., None]
        some = np.concatenate(
            [np.zeros((shape[0], 1)), np.cumsum(rows.observed.any(axis=2), axis=1)], axis=1
        )
        batch = np.arange(shape[0])[:, None, None]
        self.alone = some[batch, self._after] - some[batch, self._before + 1] < 1
        # Slopes at observations over 1 and 2 intervals, on their other side.
        self._slopes_before = self._slopes(rows.observed, index, times, -1)
        self._slopes_after = self._slopes(rows.observed, index, times, 1)
        step = np.diff(rows.times, axis=1)[..., None]
        mid = 0.5 * (self.line[:, 1:] + self.line[:, :-1])
        self.integral = np.concatenate(
            [np.zeros((shape[0], 1, shape[2])), np.cumsum(mid * step, axis=1)], axis=1
        )
        steep = np.diff(self.line, axis=1) / np.where(step > 0, step, np.inf)
        weight = np.concatenate([step, 0 * step[:, :1]], axis=1)
        other = np.concatenate([0 * step[:, :1], step], axis=1)
        left = np.concatenate([0 * steep[:, :1], steep], axis=1)
        right = np.concatenate([steep, 0 * steep[:, :1]], axis=1)
        total = np.where(weight + other > 0, weight + other, 1.0)
        inner = (weight > 0) & (other > 0)
        self.slope = np.where(
            inner, (left * weight + right * other) / total, np.where(other > 0, left, right)
        )

    @staticmethod
    def _at(array: Array, index: NDArray[np.int64]) -> Array:
        return np.take_along_axis(array, index, axis=1)

    def _slopes(
        self, observed: NDArray[np.bool_], index: NDArray[np.int64], times: Array, side: int
    ) -> list[tuple[Array, Array]]:
        """Slope and length over 1 and 2 intervals before (or after) each observation; 0 if none."""
        size = observed.shape[1]
        shifted = np.full(observed.shape, -1 if side < 0 else size)
        if side < 0:
            seen = np.maximum.accumulate(np.where(observed, index, -1), axis=1)
            shifted[:, 1:] = seen[:, :-1]
        else:
            seen = np.minimum.accumulate(np.where(observed, index, size)[:, ::-1], axis=1)
            shifted[:, :-1] = seen[:, ::-1][:, 1:]
        result = []
        at = shifted
        for _ in range(2):
            there = (at >= 0) & (at < size)
            safe = np.clip(at, 0, size - 1)
            span = times - self._at(times, safe)
            span = np.where(there & (span != 0), span, 1.0)
            rise = np.where(there, self.values - self._at(self.values, safe), 0.0)
            result.append((rise / span, np.where(there, np.abs(span), 0.0)))
            at = np.where(there, self._at(shifted, safe), at)
        return result

    def inside(self, c: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Trajectory and row of the values of a channel that are between two observations."""
        task, row = np.nonzero(self.hidden[..., c])
        return task, row

    def own(self, c: int, task: NDArray[np.int64], row: NDArray[np.int64], longest: float) -> Array:
        """(values, OWN) features of the channel itself."""
        u, gap = self.u[task, row, c], self.gap[task, row, c]
        rise = self.rise[task, row, c]
        a, b = u * (1 - u) ** 2, u**2 * (1 - u)
        before, after = self._before[task, row, c], self._after[task, row, c]
        used = np.minimum(gap, longest)
        columns = [a, b, a * rise, b * rise]
        ends = []
        for slopes, at, shape in (
            (self._slopes_before, before, a),
            (self._slopes_after, after, b),
        ):
            first, length = (part[task, at, c] for part in slopes[0])
            second, further = (part[task, at, c] for part in slopes[1])
            second = np.where(further > 0, second, first)
            columns += [
                shape * np.where(length > 0, used * first - rise, 0.0),
                shape * np.where(length > 0, used * second - rise, 0.0),
            ]
            w1, w2 = 2 * gap + length, gap + 2 * length
            same = (first * rise > 0) & (length > 0)
            mean = (w1 + w2) / (
                w1 / np.where(same, first, 1.0) + w2 * gap / np.where(same, rise, 1.0)
            )
            ends.append(np.where(length > 0, np.where(same, mean, 0.0), rise / gap))
        cubic = a * (gap * ends[0] - rise) - b * (gap * ends[1] - rise)
        value = self.line[task, before, c], self.line[task, after, c]
        columns += [cubic, a * used * value[0], b * used * value[1], a * value[0], b * value[1]]
        return np.stack(columns, axis=1)

    def dense(
        self, c: int, near: NDArray[np.int64], task: NDArray[np.int64], row: NDArray[np.int64]
    ) -> NDArray[np.bool_]:
        """(values, others) whether others are observed more often at a value and its neighbours."""
        at = self._places(c, near, task, row)
        return self._dense(self.spacing.reshape(-1), at, self.gap[task, row, c][:, None])

    def _places(
        self, c: int, near: NDArray[np.int64], task: NDArray[np.int64], row: NDArray[np.int64]
    ) -> list[NDArray[np.int64]]:
        """(values, others) of others in flattened arrays: at the value, before and after it."""
        _, rows, channels = self.spacing.shape
        first = task * rows
        neighbours = (row, self._before[task, row, c], self._after[task, row, c])
        return [((first + at) * channels)[:, None] + near for at in neighbours]

    @staticmethod
    def _dense(spacing: Array, at: list[NDArray[np.int64]], gap: Array) -> NDArray[np.bool_]:
        found = spacing.take(at[0]) <= DENSE * gap
        for place in at[1:]:
            found &= spacing.take(place) <= DENSE * gap
        return np.asarray(found)

    def others(
        self,
        c: int,
        near: NDArray[np.int64],
        task: NDArray[np.int64],
        row: NDArray[np.int64],
        longest: float,
    ) -> Array:
        """(values, EACH * others) features of other channels."""
        u, gap = self.u[task, row, c][:, None], self.gap[task, row, c][:, None]
        at = self._places(c, near, task, row)
        spacing, line = self.spacing.reshape(-1), self.line.reshape(-1)
        dense, close = self._dense(spacing, at, gap), spacing.take(at[0]) <= DENSE * gap
        columns = np.empty((len(task), EACH, len(near)))
        ends = [line.take(place) for place in at[1:]]
        for i, array in enumerate((line, self.integral.reshape(-1), self.slope.reshape(-1))):
            left, right = ends if i == 0 else (array.take(place) for place in at[1:])
            here = array.take(at[0])
            bend = here - left - u * (right - left)
            columns[:, 2 * i] = np.where(dense, bend, 0.0)
            columns[:, 2 * i + 1] = bend
        columns[:, 6] = np.where(close, here, 0.0)  # the slope
        columns[:, 7] = np.where(close, self.line[task, row, c][:, None], 0.0)
        used = np.minimum(gap, longest)
        columns[:, 8] = used * u * (1 - u) ** 2 * ends[0]
        columns[:, 9] = used * u**2 * (1 - u) * ends[1]
        return columns.reshape(len(task), EACH * len(near))
