"""Scores of fills, forecasts and trivial predictors on the same values, in their units."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from offbeat import tables
from offbeat.answers.forecast import checked_horizons
from offbeat.answers.impute import impute
from offbeat.answers.predict import in_model_order, predict
from offbeat.answers.two_sided import TwoSided
from offbeat.baselines import fill, fillers, forecast, forecasters
from offbeat.data.masking import masked_values
from offbeat.data.trajectory import Dataset, Trajectory
from offbeat.errors import InputError
from offbeat.metrics import gap_groups, null_if_nan
from offbeat.models.base import BaseModel

OVERALL = "all, scaled"
"""Name of the last row of a table: all channels, in units of their standard deviation."""


@dataclass(frozen=True)
class ChannelScores:
    """RMSE of several predictors on the same values, per channel in its unit.

    Attributes:
        task: what is predicted, for headings.
        names: of the channels.
        units: of the channels.
        counts: per channel, how many values were scored.
        rmse: per predictor, per channel; NaN where a channel has no value.
        overall: per predictor, over the values of all channels, each in units of its scale.
        trivial: which of the predictors are trivial.
    """

    task: str
    names: tuple[str, ...]
    units: tuple[str, ...]
    counts: tuple[int, ...]
    rmse: Mapping[str, tuple[float, ...]]
    overall: Mapping[str, float]
    trivial: tuple[str, ...]

    def table(self) -> str:
        """A plain-text table with a row per channel and a column per predictor."""
        predictors = list(self.rmse)
        lines = [["channel", "unit", "values", *predictors]]
        each = zip(self.names, self.units, self.counts, strict=True)
        for i, (name, unit, count) in enumerate(each):
            numbers = [_shown(self.rmse[p][i]) for p in predictors]
            lines.append([name, unit or "-", str(count), *numbers])
        overall = [_shown(self.overall[p]) for p in predictors]
        lines.append([OVERALL, "-", str(sum(self.counts)), *overall])
        return tables.plain(lines)

    def verdict(self) -> str:
        """A sentence on the best predictor, and on channels where a trivial one is better."""
        ranked = sorted((v, name) for name, v in self.overall.items() if v == v)
        if not ranked:
            return f"{self.task}: nothing to score"
        best_trivial = next((v, name) for v, name in ranked if name in self.trivial)
        models = [(v, name) for v, name in ranked if name not in self.trivial]
        text = [f"{self.task}: "]
        if not models or models[0][0] >= best_trivial[0]:
            against = f", the model has {_shown(models[0][0])}" if models else ""
            text.append(
                f"the trivial predictor {best_trivial[1]} wins with RMSE "
                f"{_shown(best_trivial[0])} (scaled){against}"
            )
        else:
            text.append(
                f"{models[0][1]} wins with RMSE {_shown(models[0][0])} (scaled), the best trivial "
                f"predictor, {best_trivial[1]}, has {_shown(best_trivial[0])}"
            )
        lost = []
        for i, name in enumerate(self.names):
            value, who = min((self.rmse[p][i], p) for p in self.rmse)
            if value == value and who in self.trivial:
                lost.append(f"{name} ({who})")
        if lost:
            shown = ", ".join(lost[:8]) + (", ..." if len(lost) > 8 else "")
            text.append(
                f"; a trivial predictor wins in {len(lost)} of {len(self.names)} channels: {shown}"
            )
        return "".join(text)

    def to_dict(self) -> dict[str, Any]:
        """JSON-like form; null where there is no value."""
        return {
            "task": self.task,
            "counts": dict(zip(self.names, self.counts, strict=True)),
            "units": dict(zip(self.names, self.units, strict=True)),
            "rmse_in_units": {
                predictor: dict(zip(self.names, map(null_if_nan, values), strict=True))
                for predictor, values in self.rmse.items()
            },
            "rmse_scaled": {name: null_if_nan(value) for name, value in self.overall.items()},
            "verdict": self.verdict(),
        }


class ErrorSums:
    """Accumulates squared errors of predictors over trajectories, on the same values.

    Args:
        names: of the channels.
        units: of the channels.
        scale: (channels,) in the unit of each channel, for the error over all channels.
    """

    def __init__(self, names: Sequence[str], units: Sequence[str], scale: ArrayLike) -> None:
        self.names, self.units = tuple(names), tuple(units)
        self.scale = np.asarray(scale, dtype=np.float64)
        self._counts = np.zeros(len(self.names), dtype=np.int64)
        self._sums: dict[str, NDArray[np.float64]] = {}

    def add(
        self,
        truth: NDArray[np.float64],
        predictions: Mapping[str, NDArray[np.float64]],
        counted: NDArray[np.bool_],
    ) -> None:
        """Adds the errors of rows.

        Args:
            truth: (rows, channels) known where counted.
            predictions: per predictor (rows, channels); the same predictors in every call.
            counted: (rows, channels) values that are scored.
        """
        self._counts += counted.sum(axis=0)
        for name, values in predictions.items():
            squared = np.where(counted, values - truth, 0.0) ** 2
            self._sums[name] = self._sums.get(name, 0.0) + squared.sum(axis=0)

    def scores(self, task: str, trivial: Sequence[str]) -> ChannelScores:
        """The scores of all rows added so far."""
        counts, total = self._counts, int(self._counts.sum())
        each = {
            name: tuple(
                float((s / n) ** 0.5) if n else float("nan")
                for s, n in zip(sums, counts, strict=True)
            )
            for name, sums in self._sums.items()
        }
        overall = {
            name: float((sums / self.scale**2).sum() / total) ** 0.5 if total else float("nan")
            for name, sums in self._sums.items()
        }
        return ChannelScores(
            task, self.names, self.units, tuple(counts.tolist()), each, overall, tuple(trivial)
        )


@dataclass(frozen=True)
class ImputationScores:
    """Imputation scores of all masked values, and by the length of their gap.

    Attributes:
        scores: of all masked values.
        inside: s, upper end of each group of gaps, and the scores of the masked values with an
            observation of their channel on both sides, that far apart.
    """

    scores: ChannelScores
    inside: tuple[tuple[float, ChannelScores], ...]

    def table(self) -> str:
        """A table by channel, and one by length of the gap."""
        predictors = list(self.scores.rmse)
        lines = [["gap up to", "values", *predictors]]
        for up_to, scores in self.inside:
            numbers = [_shown(scores.overall[p]) for p in predictors]
            lines.append([f"{up_to:.3g} s", str(sum(scores.counts)), *numbers])
        by_gap = f"\nscaled, by time between the observations around:\n{tables.plain(lines)}"
        return self.scores.table() + (by_gap if self.inside else "")

    def verdict(self) -> str:
        """A sentence on the best predictor, and on gaps where a trivial one is better."""
        text = self.scores.verdict()
        lost = []
        for up_to, scores in self.inside:
            value, who = min((scores.overall[p], p) for p in scores.overall)
            if value == value and who in scores.trivial:
                lost.append(f"{up_to:.3g} s ({who})")
        if lost:
            text += f"; in gaps of up to {', '.join(lost)} a trivial predictor wins"
        return text

    def to_dict(self) -> dict[str, Any]:
        """JSON-like form."""
        return {
            **self.scores.to_dict(),
            "verdict": self.verdict(),
            "by_gap": [
                {"up_to_s": up_to, "count": sum(s.counts), "rmse_scaled": dict(s.overall)}
                for up_to, s in self.inside
            ],
        }


def fills_of(
    model: BaseModel | TwoSided, dataset: Dataset, *, seed: int = 0
) -> dict[str, list[NDArray[np.float64]]]:
    """The fills of each predictor by name: the model, causal and two-sided, and trivial ones.

    Args:
        model: a trained model, or a pair.
        dataset: in the order of the model's channels.
        seed: of the generator of self-feeding.

    Returns:
        Per predictor and trajectory (rows, channels) in original units.
    """
    forward = model.forward if isinstance(model, TwoSided) else model
    result = {"causal": [t.values for t in impute(forward, dataset, seed=seed)]}
    if isinstance(model, TwoSided):
        result["two_sided"] = [t.values for t in impute(model, dataset, seed=seed)]
    mean = training_mean(forward)
    for method in fillers():
        result[method] = [fill(t, method, mean) for t in dataset]
    return result


def score_imputation(
    model: BaseModel | TwoSided, dataset: Dataset, *, seed: int = 0
) -> ImputationScores:
    """Scores fills of all masked values: the model, last value, linear interpolation and PCHIP.

    Every value that is known and masked counts, for every predictor.

    Args:
        model: a trained model, or a pair, which is scored causal and two-sided.
        dataset: with masked values, from `mask_out`.
        seed: of the generator of self-feeding.

    Raises:
        InputError: nothing is masked, or other channels than the model's.
    """
    forward = model.forward if isinstance(model, TwoSided) else model
    dataset = forward.transforms.apply(in_model_order(forward, dataset))
    if not any(masked_values(t).any() for t in dataset):
        raise InputError(
            "no value is known and masked, so no fill can be scored; mask some with mask_out "
            "(--observed_fraction)"
        )
    fills = fills_of(model, dataset, seed=seed)
    unit = forward.statistics.median_gap
    sums = _sums_for(forward)
    grouped: dict[int, ErrorSums] = {}
    for i, trajectory in enumerate(dataset):
        counted = masked_values(trajectory)
        each = {name: values[i] for name, values in fills.items()}
        sums.add(trajectory.values, each, counted)
        length = _gap_lengths(trajectory)
        group = gap_groups(torch.from_numpy(length), unit).numpy()
        for k in np.unique(group[counted & (length > 0)]).tolist():
            chosen = counted & (length > 0) & (group == k)
            grouped.setdefault(k, _sums_for(forward)).add(trajectory.values, each, chosen)
    inside = tuple(
        (unit * 2.0**k, grouped[k].scores("imputation", fillers())) for k in sorted(grouped)
    )
    return ImputationScores(sums.scores("imputation", fillers()), inside)


def score_forecast(
    model: BaseModel, dataset: Dataset, horizons: ArrayLike, *, targets: int = 20
) -> tuple[ChannelScores, ...]:
    """Scores forecasts at fixed horizons: the model, last value and constant velocity.

    For a row at time t and a horizon h, every predictor is given the rows up to t - h and predicts
    t; the values of that row which are known, and whose channel was observed by t - h, count.

    Args:
        model: trained.
        dataset: masked values are not used as input, and are scored as well.
        horizons: s, above 0, strictly increasing.
        targets: rows per trajectory and horizon, evenly spaced among those that can be scored.

    Returns:
        One record per horizon.

    Raises:
        InputError: horizons as of `forecast`, no row can be scored, other channels than the
            model's, or a model that cannot predict at any time.
    """
    dataset = model.transforms.apply(in_model_order(model, dataset))
    if isinstance(targets, bool) or not isinstance(targets, int) or targets < 1:
        raise InputError(f"targets must be a number of rows of at least 1, got {targets!r}")
    mean = training_mean(model)
    results = []
    after: list[float] = checked_horizons(horizons).tolist()
    for horizon in after:
        tasks = [task for t in dataset for task in _targets(t, horizon, targets)]
        name = f"forecast, {horizon:g} s"
        sums = _sums_for(model)
        if tasks:
            pasts = replace(dataset, trajectories=tuple(past for past, _, _, _ in tasks))
            asked = [np.array([at]) for _, at, _, _ in tasks]
            predicted = predict(model, pasts, times=asked)
            for (past, at, truth, counted), answer in zip(tasks, predicted, strict=True):
                each = {model.name: answer.values}
                for method in forecasters():
                    each[method] = forecast(past, np.array([at]), method, mean)
                sums.add(truth, each, counted)
        results.append(sums.scores(name, forecasters()))
    if not any(sum(scores.counts) for scores in results):
        raise InputError(
            f"no trajectory is long enough for a horizon of {after[0]:g} s after an observation; "
            "use shorter horizons or longer trajectories"
        )
    return tuple(results)


def training_mean(model: BaseModel) -> list[float]:
    """The mean of each channel over the observed values of the training set, in its unit."""
    mean: list[float] = model.scaler.original(np.array(model.statistics.mean)).tolist()
    return mean


def _sums_for(model: BaseModel) -> ErrorSums:
    scale = np.abs(model.scaler.scale) * np.array(model.statistics.std)
    return ErrorSums(model.names, model.units, scale)


def _gap_lengths(trajectory: Trajectory) -> NDArray[np.float64]:
    """(rows, channels) s between the observations around a value; 0 where a side is missing."""
    times = np.where(trajectory.observed, trajectory.times[:, None], np.nan)
    before = np.fmax.accumulate(times, axis=0)
    after = np.fmin.accumulate(times[::-1], axis=0)[::-1]
    length: NDArray[np.float64] = np.nan_to_num(after - before)
    return length


_Target = tuple[Trajectory, float, NDArray[np.float64], NDArray[np.bool_]]


def _targets(trajectory: Trajectory, horizon: float, count: int) -> list[_Target]:
    """Past rows, times to predict, true values, and which of them count."""
    times = trajectory.times
    rows = np.searchsorted(times, times - horizon * (1 - 1e-9), side="right")
    seen = np.logical_or.accumulate(trajectory.observed, axis=0)
    counted = trajectory.known & seen[np.maximum(rows - 1, 0)] & (rows > 0)[:, None]
    possible = np.flatnonzero(counted.any(axis=1))
    if not len(possible):
        return []
    spread = np.linspace(0, len(possible) - 1, min(count, len(possible)))
    return [
        (
            trajectory.slice(0, int(rows[row])),
            float(times[row]),
            np.nan_to_num(trajectory.values[row : row + 1]),
            counted[row : row + 1],
        )
        for row in possible[np.unique(np.rint(spread).astype(int))]
    ]


def _shown(value: float) -> str:
    return "-" if value != value else f"{value:.4g}"
