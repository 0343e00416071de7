"""The rule that combines two predictions of a value, fitted in closed form on validation data."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from offbeat.errors import InputError
from offbeat.metrics import gap_groups

GROUPS = 16
"""Upper ends of the groups of lengths, in median gaps; longer ones are in the last group."""

SIDES = ("between", "after_last", "before_first")
"""Where a value is: between two observations of its channel, or outside all of them."""

START: NDArray[np.float64] = np.array([[0.5, 0.5, 0, 0, 0], [0.0] * 5, [0.0] * 5])
"""(sides, 5) the weights without data."""

RIDGES = (3.0, 10.0, 30.0, 100.0, 300.0, 1000.0)
"""Ridge strengths that are tried, as numbers of values."""

PLAIN: dict[str, tuple[tuple[int, ...], int]] = {
    "line": ((0,), 3),
    "pchip": ((0,), 4),
    "hold": ((1, 2), 0),
}
"""Alternatives without a model: their sides, and the only weight that is 1."""

FOLDS = 5
"""Folds of the validation trajectories, each left out once to choose the strength."""

_Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class FillRule:
    """The weights of the rule in `offbeat.answers.two_sided`, and properties of their fit.

    Attributes:
        gap_unit: s, the length of the shortest group.
        weights: (channels, sides, groups, 5) w1 to w5; outside, the first is v.
        counts: (sides, groups) masked values of the validation data.
        chosen: per channel and side, the origin of its weights: `start`, `ridge 30`, or one of
            `PLAIN`.
    """

    gap_unit: float
    weights: _Array
    counts: NDArray[np.int64]
    chosen: tuple[tuple[str, ...], ...]

    def __post_init__(self) -> None:
        weights = np.asarray(self.weights, dtype=np.float64)
        counts = np.asarray(self.counts).astype(np.int64)
        expected = (len(SIDES), GROUPS, START.shape[1])
        if weights.ndim != 4 or weights.shape[1:] != expected:
            raise InputError(
                f"weights must have shape (channels, {', '.join(map(str, expected))}), got "
                f"{weights.shape}"
            )
        if counts.shape != expected[:2] or not np.isfinite(weights).all() or not self.gap_unit > 0:
            raise InputError("a rule needs finite weights, a count per group, a gap unit above 0")
        object.__setattr__(self, "weights", weights)
        object.__setattr__(self, "counts", counts)
        chosen = tuple(tuple(map(str, names)) for names in self.chosen)
        if [len(names) for names in chosen] != [len(SIDES)] * len(weights):
            raise InputError("chosen must have one entry per channel and side")
        object.__setattr__(self, "chosen", chosen)

    @classmethod
    def start(cls, channels: int, gap_unit: float) -> FillRule:
        """The rule without data."""
        weights = np.broadcast_to(START[:, None], (channels, len(SIDES), GROUPS, START.shape[1]))
        counts = np.zeros((len(SIDES), GROUPS), dtype=np.int64)
        return cls(gap_unit, weights, counts, (("start",) * len(SIDES),) * channels)

    @property
    def model_fraction(self) -> list[tuple[float, float]]:
        """s, upper end of each group of gaps with values, and the weight of the models there."""
        fraction = 1 - self.weights[:, 0, :, 3:].sum(axis=2).mean(axis=0)
        ends = self.gap_unit * 2.0 ** np.arange(GROUPS)
        return [(float(ends[g]), float(fraction[g])) for g in np.flatnonzero(self.counts[0])]

    def weights_at(self, side: NDArray[np.int64], length: _Array) -> _Array:
        """(rows, channels, 5) the weights of values on that side, in gaps of that length in s."""
        channels = np.arange(side.shape[1])
        return np.asarray(self.weights[channels, side, group_of(length, self.gap_unit)])

    def to_dict(self) -> dict[str, Any]:
        """JSON-like form; floats are exact."""
        return {
            "gap_unit_s": self.gap_unit,
            "chosen": [list(names) for names in self.chosen],
            "weights": self.weights.tolist(),
            "counts": self.counts.tolist(),
        }

    @classmethod
    def from_dict(cls, value: Mapping[str, Any]) -> FillRule:
        """The inverse of `to_dict`."""
        counts = value["counts"] if "counts" in value else value["cells"]  # the name in 0.1
        weights = np.array(value["weights"])
        return cls(value["gap_unit_s"], weights, np.array(counts), value["chosen"])


def group_of(length: _Array, unit: float) -> NDArray[np.int64]:
    """The group of gaps of a length in s."""
    group: NDArray[np.int64] = gap_groups(torch.from_numpy(length), unit).numpy()
    return np.minimum(group, GROUPS - 1)


class NormalEquations:
    """Accumulates the normal equations of the rule over trajectories, and solves them.

    Args:
        channels: number of channels.
        gap_unit: s, the length of the shortest group.
    """

    def __init__(self, channels: int, gap_unit: float) -> None:
        self.channels, self.gap_unit = channels, gap_unit
        shape, size = (FOLDS, channels, len(SIDES), GROUPS), START.shape[1]
        self._gram = np.zeros((*shape, size, size))
        self._moment = np.zeros((*shape, size))
        self._square = np.zeros(shape)
        self._counts = np.zeros(shape, dtype=np.int64)
        self._trajectories = np.zeros(
            shape[1:3], dtype=np.int64
        )  # with a value, per channel and side
        self._added = 0

    def add(
        self,
        terms: _Array,
        missed: _Array,
        side: NDArray[np.int64],
        length: _Array,
        counted: NDArray[np.bool_],
    ) -> None:
        """Adds the masked values of a trajectory.

        Args:
            terms: (rows, channels, 5) regressors of the weights, scaled.
            missed: (rows, channels) the errors to correct, scaled.
            side: (rows, channels) index into `SIDES`.
            length: (rows, channels) s.
            counted: (rows, channels) which values are masked and known.
        """
        fold = self._added % FOLDS
        self._added += 1
        for s in range(len(SIDES)):
            self._trajectories[:, s] += (counted & (side == s)).any(axis=0)
        rows, channels = np.nonzero(counted)
        phi, y = terms[rows, channels], missed[rows, channels]
        group = group_of(length[rows, channels], self.gap_unit)
        at: Any = (fold, channels, side[rows, channels], group)
        np.add.at(self._gram, at, phi[:, :, None] * phi[:, None, :])
        np.add.at(self._moment, at, phi * y[:, None])
        np.add.at(self._square, at, y**2)
        np.add.at(self._counts, at, 1)

    def rule(self) -> FillRule:
        """The weights; per channel and side, those with the least error on trajectories left out.

        Where channels are pooled, each is divided by the size of the errors that its
        weights correct; otherwise the noisiest ones would dominate. Values of one gap are
        correlated, so with fewer than `FOLDS` trajectories the strongest ridge is used
        between observations, and `START` outside.
        """
        size = self._square.sum((0, 3)) / np.maximum(self._counts.sum((0, 3)), 1)
        relative = 1 / np.where(size > 0, size, 1.0)  # (channels, sides)
        tried = {f"ridge {ridge:g}": self._ridge(ridge, relative) for ridge in RIDGES}
        strongest = len(tried) - 1
        for name, (sides, weight) in PLAIN.items():
            tried[name] = self._plain(sides, weight)
        names = list(tried)
        best = np.argmin([error for _, error in tried.values()], axis=0)
        few = self._trajectories < FOLDS
        best[few] = strongest
        chosen = [[names[k] for k in row] for row in best]
        weights = np.empty(self._moment.shape[1:])
        for (c, s), k in np.ndenumerate(best):
            weights[c, s] = tried[names[k]][0][c, s]
            if few[c, s] and s > 0:
                weights[c, s], chosen[c][s] = START[s], "start"
        return FillRule(
            self.gap_unit, weights, self._counts.sum(axis=(0, 1)), tuple(map(tuple, chosen))
        )

    def _ridge(self, ridge: float, relative: _Array) -> tuple[_Array, _Array]:
        """The weights, and (channels, sides) squared errors with weights from the other folds."""
        error = np.zeros(relative.shape)
        for fold in range(min(FOLDS, self._added) if self._added > 1 else 0):
            others = self._solved(np.arange(FOLDS) != fold, ridge, relative)
            error += self._error(np.arange(FOLDS) == fold, others)
        return self._solved(slice(None), ridge, relative), error

    def _plain(self, sides: tuple[int, ...], weight: int) -> tuple[_Array, _Array]:
        """Weights of a single predictor, and (channels, sides) its squared errors."""
        weights = np.zeros(self._moment.shape[1:])
        weights[..., weight] = 1.0
        error = self._error(slice(None), weights)
        error[:, [s for s in range(len(SIDES)) if s not in sides]] = np.inf
        return weights, error

    def _error(self, folds: Any, weights: _Array) -> _Array:
        """(channels, sides) squared error of weights on the values of some folds."""
        gram, moment = self._gram[folds].sum(0), self._moment[folds].sum(0)
        fitted = np.einsum("...i,...ij,...j", weights, gram, weights)
        fitted = fitted - 2 * (weights * moment).sum(-1) + self._square[folds].sum(0)
        return np.asarray(fitted.sum(axis=2))

    def _solved(self, folds: Any, ridge: float, relative: _Array) -> _Array:
        """(channels, sides, groups, 5): groups shrunk towards their side, channels towards all."""
        gram = self._gram[folds].sum(0) * relative[:, :, None, None, None]
        moment = self._moment[folds].sum(0) * relative[:, :, None, None]
        counts = self._counts[folds].sum(0)
        weights = np.empty(moment.shape)
        for s, start in enumerate(START):
            side = _ridge_solution(
                gram[:, s].sum((0, 1)),
                moment[:, s].sum((0, 1)),
                int(counts[:, s].sum()),
                ridge,
                start,
            )
            for g in range(GROUPS):
                count = int(counts[:, s, g].sum())
                together = _ridge_solution(
                    gram[:, s, g].sum(0), moment[:, s, g].sum(0), count, ridge, side
                )
                for c in range(self.channels):
                    count = int(counts[c, s, g])
                    weights[c, s, g] = _ridge_solution(
                        gram[c, s, g], moment[c, s, g], count, ridge, together
                    )
        return weights


def _ridge_solution(
    gram: _Array, moment: _Array, count: int, ridge: float, towards: _Array
) -> _Array:
    """Least squares, shrunk towards given weights by a prior of `ridge` values."""
    if not count:
        return towards
    scale = ridge * np.diag(gram) / count
    step = np.linalg.pinv(gram + np.diag(scale), rcond=1e-12, hermitian=True)
    return np.asarray(towards + step @ (moment - gram @ towards))
