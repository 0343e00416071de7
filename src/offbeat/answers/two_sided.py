"""Two-sided imputation: a forward model, a backward model, and a rule that combines them.

The backward model is trained on trajectories reversed in time, so it predicts a value from what was
observed strictly after it. Between two observations of a channel, x0 at t0 and x1 at t1, let
s = (t - t0) / (t1 - t0), f(t) and b(t) the two predictions, and r_f = x1 - f(t1) and
r_b = x0 - b(t0) their known errors at the other end. The fill is

    (1 - s) f + s b
        + s (1 - s) (w1 (r_f + r_b) + w2 (1 - 2 s) (r_b - r_f) + w3 (f - b))
        + w4 (line - (1 - s) f - s b) + w5 (curve - (1 - s) f - s b)

with the straight line through x0 and x1, and PCHIP through all observations of the channel.
The first line is the inverse-variance weighting of two predictions whose error variances grow in
proportion to the distance from their observation. The second corrects the known errors: with
w1 = w2 = 1/2 and models that continue straight, the fill is the cubic Hermite interpolation with
their slopes. The third is for data where the line or the curve is better than the models;
1 - w4 - w5 is the weight of the models (`FillRule.model_fraction`).

After the last observation of a channel the fill is f + v (x0 - f), before the first one
b + v (x1 - b): the model's prediction, shrunk towards the observed value. A channel that is never
observed gets the mean of both predictions.

The weights are the least-squares solution on masked values of validation data: by length of the gap
(outside, of the distance) and channel, shrunk by ridge regression towards those of all channels
pooled, these towards those of all lengths, and these towards `fill_rule.START`. The strength of
the ridge is, for each channel, the one with the least error in cross-validation over trajectories;
where the line, PCHIP or the observed value alone is better, it is used. Outside, fewer
than five validation trajectories with such a value keep `START`.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from offbeat.answers.fill_rule import FillRule, NormalEquations
from offbeat.answers.predict import in_model_order, predict
from offbeat.baselines import fill
from offbeat.data.masking import mask_out, masked_values
from offbeat.data.trajectory import Dataset, Trajectory
from offbeat.errors import InputError
from offbeat.models.base import BaseModel


@dataclass(frozen=True, eq=False)
class TwoSided:
    """Two models of the same channels, and the rule that combines their predictions.

    Attributes:
        forward: predicts from what was observed before.
        backward: trained on trajectories reversed in time.
        rule: fitted to validation data.

    Raises:
        InputError: the models have different channels.
    """

    forward: BaseModel
    backward: BaseModel
    rule: FillRule

    def __post_init__(self) -> None:
        if (self.forward.names, self.forward.units) != (self.backward.names, self.backward.units):
            raise InputError("the forward and the backward model must have the same channels")
        if len(self.rule.weights) != self.forward.channels:
            raise InputError(
                f"the rule is for {len(self.rule.weights)} channels, the models have "
                f"{self.forward.channels}"
            )


def reversed_in_time(dataset: Dataset) -> Dataset:
    """Each trajectory from its end to its start, times counted from its last row.

    Args:
        dataset: any trajectories; values are not changed, not even the signs of velocities.
    """
    return replace(
        dataset,
        trajectories=tuple(
            replace(
                t,
                times=t.times[-1] - t.times[::-1],
                values=t.values[::-1],
                observed=t.observed[::-1],
            )
            for t in dataset
        ),
    )


def fill_two_sided(pair: TwoSided, dataset: Dataset, *, seed: int = 0) -> list[_Array]:
    """The fill of every value that is not observed.

    Args:
        pair: models and rule.
        dataset: in the order of the models' channels; masked values are not used.
        seed: of the generator of self-feeding.

    Returns:
        Per trajectory (rows, channels) in original units; NaN where the value is observed.
    """
    filled = []
    for trajectory, sides in zip(
        dataset, _sides(pair.forward, pair.backward, dataset, seed), strict=True
    ):
        weights = pair.rule.weights_at(sides.side, sides.length)
        values = sides.base + (weights * sides.terms).sum(axis=2)
        values[trajectory.observed] = np.nan
        filled.append(values)
    return filled


def fit_rule(
    forward: BaseModel, backward: BaseModel, validation: Dataset, *, seed: int = 0
) -> FillRule:
    """Fits the weights of the rule, in closed form, to the masked values of validation data.

    Args:
        forward: trained.
        backward: trained on reversed trajectories.
        validation: if none of its values are masked, 30 % of the values of each channel are, at
            random.
        seed: of that mask, and of the generator of self-feeding.
    """
    validation = forward.transforms.apply(in_model_order(forward, validation))
    if not any(masked_values(t).any() for t in validation):
        validation = mask_out(validation, 0.7, mask="values", seed=seed)
    scale = np.abs(forward.scaler.scale) * np.array(forward.statistics.std)
    equations = NormalEquations(forward.channels, forward.statistics.median_gap)
    every = zip(validation, _sides(forward, backward, validation, seed), strict=True)
    for trajectory, sides in every:
        equations.add(
            sides.terms / scale[:, None],
            (trajectory.values - sides.base) / scale,
            sides.side,
            sides.length,
            masked_values(trajectory) & trajectory.observed.any(axis=0),
        )
    return equations.rule()


# --- both sides -------------------------------------------------------------------------------

_Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class _Sides:
    """Inputs of the rule for each value; (rows, channels) each, in original units.

    Attributes:
        side: index into `fill_rule.SIDES`.
        length: s, between the observations on both sides; outside, to the nearest one.
        base: the fill with weights 0.
        terms: (rows, channels, 5) regressors of the weights.
    """

    side: NDArray[np.int64]
    length: _Array
    base: _Array
    terms: _Array


def _sides(
    forward: BaseModel, backward: BaseModel, dataset: Dataset, seed: int
) -> Iterator[_Sides]:
    ahead = predict(forward, dataset, seed=seed)
    back = predict(backward, reversed_in_time(dataset), seed=seed)
    for trajectory, f, b in zip(dataset, ahead, back, strict=True):
        yield _sides_of(trajectory, f.values, b.values[::-1])


def _sides_of(trajectory: Trajectory, f: _Array, b: _Array) -> _Sides:
    observed, times = trajectory.observed, trajectory.times[:, None]
    rows, at = np.arange(trajectory.rows)[:, None], np.arange(trajectory.channels)
    earlier = np.maximum.accumulate(np.where(observed, rows, -1), axis=0)
    later = np.minimum.accumulate(np.where(observed, rows, len(rows))[::-1], axis=0)[::-1]
    before, after = earlier >= 0, later < len(rows)
    earlier, later = np.maximum(earlier, 0), np.minimum(later, len(rows) - 1)
    start, end = trajectory.times[earlier], trajectory.times[later]
    between = before & after & ~observed

    seen = np.where(observed, trajectory.values, 0.0)  # masked values are not used below
    first, last = seen[earlier, at], seen[later, at]
    length = np.where(between, end - start, 1.0)
    s = np.where(between, (times - start) / length, 0.0)
    weight = s * (1 - s)
    joined = (1 - s) * f + s * b
    missed_ahead, missed_back = last - f[later, at], first - b[earlier, at]
    curve = fill(trajectory, "pchip", [0.0] * trajectory.channels)
    terms = [
        weight * (missed_ahead + missed_back),
        weight * (1 - 2 * s) * (missed_back - missed_ahead),
        weight * (f - b),
        (1 - s) * first + s * last - joined,
        curve - joined,
    ]
    alone = np.where(before, f, b)
    towards_observed = np.where(before, first, last) - alone
    one_side = before != after
    return _Sides(
        side=np.where(one_side, np.where(before, 1, 2), 0),
        length=np.where(
            between, length, np.where(one_side, np.where(before, times - start, end - times), 0.0)
        ),
        base=np.where(between, joined, np.where(one_side, alone, (f + b) / 2)),
        terms=np.stack(
            [
                np.where(between, term, np.where(one_side & (k == 0), towards_observed, 0.0))
                for k, term in enumerate(terms)
            ],
            axis=2,
        ),
    )
