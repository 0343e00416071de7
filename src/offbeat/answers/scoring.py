"""Scores of models, blends and baselines on the same values: one step, fills and forecasts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from offbeat import tables
from offbeat.answers.answer import Answer
from offbeat.answers.blend import Asked, Blend, model_rows
from offbeat.answers.forecast import checked_horizons
from offbeat.answers.impute import impute
from offbeat.answers.intervals import LEVELS, crps
from offbeat.answers.predict import check_any_time
from offbeat.baselines import fill, fillers, forecasters
from offbeat.baselines.history import typical_gap
from offbeat.calibration import Calibration, CalibrationSums
from offbeat.data.batch import delta
from offbeat.data.masking import masked_values
from offbeat.data.trajectory import Dataset, Trajectory
from offbeat.errors import InputError
from offbeat.metrics import gap_groups, null_if_nan
from offbeat.models.base import BaseModel, of_channels

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
        trivial: which of the predictors are baselines.
        calibration: of the intervals of the first predictor, over the values of all channels, each
            in units of its scale; None where it has no intervals.
    """

    task: str
    names: tuple[str, ...]
    units: tuple[str, ...]
    counts: tuple[int, ...]
    rmse: Mapping[str, tuple[float, ...]]
    overall: Mapping[str, float]
    trivial: tuple[str, ...]
    calibration: Calibration | None = None

    @property
    def coverage(self) -> Mapping[float, float] | None:
        """Fraction of the values within the intervals of 50, 80 and 95 %; None without any."""
        found = self.calibration
        return None if found is None else found.shown(found.coverage)

    @property
    def interval_score(self) -> Mapping[float, float] | None:
        """Mean interval score at 50, 80 and 95 %, scaled; None without intervals."""
        found = self.calibration
        return None if found is None else found.shown(found.interval_score)

    @property
    def crps(self) -> float | None:
        """Mean continuous ranked probability score, scaled; None without intervals."""
        return None if self.calibration is None else self.calibration.crps

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
        """A sentence on the best predictor, and on channels where a baseline is better."""
        ranked = sorted((v, name) for name, v in self.overall.items() if v == v)
        if not ranked:
            return f"{self.task}: nothing to score"
        best_trivial = next((v, name) for v, name in ranked if name in self.trivial)
        models = [(v, name) for v, name in ranked if name not in self.trivial]
        text = [f"{self.task}: "]
        if not models or models[0][0] >= best_trivial[0]:
            against = f", the model has {_shown(models[0][0])}" if models else ""
            text.append(
                f"the baseline {best_trivial[1]} wins with RMSE "
                f"{_shown(best_trivial[0])} (scaled){against}"
            )
        else:
            text.append(
                f"{models[0][1]} wins with RMSE {_shown(models[0][0])} (scaled), the best "
                f"baseline, {best_trivial[1]}, has {_shown(best_trivial[0])}"
            )
        lost = []
        for i, name in enumerate(self.names):
            value, who = min((self.rmse[p][i], p) for p in self.rmse)
            if value == value and who in self.trivial:
                lost.append(f"{name} ({who})")
        if lost:
            shown = ", ".join(lost[:8]) + (", ..." if len(lost) > 8 else "")
            text.append(f"; a baseline wins in {len(lost)} of {len(self.names)} channels: {shown}")
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
            **({} if self.calibration is None else self.calibration.to_dict()),
        }

    def short(self) -> str:
        """A plain-text table: the predictor and the best baseline of each channel with values."""
        (name, *_) = self.rmse
        lines = [["channel", "unit", "values", name, "best baseline", "", "ratio"]]
        each = zip(self.names, self.units, self.counts, strict=True)
        for i, (channel, unit, count) in enumerate(each):
            if not count:  # such as a constant, which is not learned
                continue
            own = self.rmse[name][i]
            best, who = min((self.rmse[p][i], p) for p in self.trivial)
            ratio = own / best if best > 0 else float("nan")
            row = [_shown(own), _shown(best), who, _shown(ratio)]
            lines.append([channel, unit or "-", str(count), *row])
        best, who = min((self.overall[p], p) for p in self.trivial)
        own = self.overall[name]
        lines.append(
            [
                OVERALL,
                "-",
                str(sum(self.counts)),
                _shown(own),
                _shown(best),
                who,
                _shown(own / best if best > 0 else float("nan")),
            ]
        )
        return tables.plain(lines, left=(0, 5))


class ErrorSums:
    """Accumulates squared errors of predictors over trajectories, on the same values.

    Args:
        names: of the channels.
        units: of the channels.
        scale: (channels,) in the unit of each channel, for the error over all channels.
        gap_s: s; widths of intervals are kept by time since observation, in multiples of it.
    """

    def __init__(
        self,
        names: Sequence[str],
        units: Sequence[str],
        scale: ArrayLike,
        *,
        gap_s: float | None = None,
    ) -> None:
        self.names, self.units = tuple(names), tuple(units)
        self.scale = np.asarray(scale, dtype=np.float64)
        self._counts = np.zeros(len(self.names), dtype=np.int64)
        self._sums: dict[str, NDArray[np.float64]] = {}
        self._calibration = CalibrationSums(LEVELS.tolist(), age_unit=gap_s)

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

    def add_intervals(self, truth: Trajectory, answer: Answer, counted: NDArray[np.bool_]) -> None:
        """Adds the intervals of rows that were added.

        Args:
            truth: known where counted.
            answer: with intervals.
            counted: (rows, channels) values that are scored.
        """
        scale = np.broadcast_to(self.scale, counted.shape)[counted]
        true, predicted = truth.values[counted] / scale, answer.values[counted] / scale
        half = answer.half_widths()[counted] / scale[:, None]
        self._calibration.add(
            true,
            predicted[:, None] - half,
            predicted[:, None] + half,
            crps(half, true - predicted),
            _elapsed(truth)[counted],
        )

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
            task,
            self.names,
            self.units,
            tuple(counts.tolist()),
            each,
            overall,
            tuple(trivial),
            self._calibration.result(),
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
        """A sentence on the best predictor, and on gaps where a baseline is better."""
        text = self.scores.verdict()
        lost = []
        for up_to, scores in self.inside:
            value, who = min((scores.overall[p], p) for p in scores.overall)
            if value == value and who in scores.trivial:
                lost.append(f"{up_to:.3g} s ({who})")
        if lost:
            text += f"; in gaps of up to {', '.join(lost)} a baseline wins"
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


def score_one_step(
    model: BaseModel | Blend, dataset: Dataset, *, seed: int = 0, asked: Asked | None = None
) -> ChannelScores:
    """Scores the prediction of every row from the rows before it.

    Every known value after the first observation of its channel counts, for every predictor.

    Args:
        model: a trained model, or a blend, which is scored beside its model and its baselines.
        dataset: masked values are not used as input, and are scored as well.
        seed: of the generator of self-feeding.
        asked: a blend that was asked about this data set, as `prepared` gives it; by default it
            is asked anew.

    Raises:
        InputError: other channels than the model's, or `asked` is of another blend or data set.
    """
    dataset = prepared(model, dataset)
    counted = []
    for t in dataset:
        seen = np.zeros_like(t.observed)
        seen[1:] = np.logical_or.accumulate(t.observed, axis=0)[:-1]
        counted.append(t.known & seen)
    return _scored("one step ahead", model, dataset, counted, seed=seed, asked=asked)


def score_imputation(
    model: BaseModel | Blend,
    dataset: Dataset,
    *,
    mode: str | None = None,
    seed: int = 0,
    asked: Asked | None = None,
) -> ImputationScores:
    """Scores fills of all masked values: the model's and those of baselines.

    Every value that is known and masked counts, for every predictor.

    Args:
        model: a trained model; or a blend, which is scored beside its model and its baselines.
        dataset: with masked values, from `mask_out`.
        mode: of a blend: `causal`, or, by default, `two_sided`.
        seed: of the generator of self-feeding.
        asked: as of `score_one_step`.

    Raises:
        InputError: nothing is masked, other channels than the model's, or `asked` is of another
            blend or data set.
    """
    dataset = prepared(model, dataset)
    if not any(masked_values(t).any() for t in dataset):
        raise InputError(
            "no value is known and masked, so no fill can be scored; mask some with mask_out "
            "(--observed_fraction)"
        )
    unit = typical_gap(dataset)
    fills, answers, trivial = _fills(model, dataset, mode or "two_sided", seed, asked)
    sums = _sums_for(model)
    grouped: dict[int, ErrorSums] = {}
    for i, trajectory in enumerate(dataset):
        counted = masked_values(trajectory)
        each = {name: values[i] for name, values in fills.items()}
        sums.add(trajectory.values, each, counted)
        if answers is not None:
            sums.add_intervals(trajectory, answers[i], counted)
        length = _gap_lengths(trajectory)
        group = gap_groups(torch.from_numpy(length), unit).numpy()
        for k in np.unique(group[counted & (length > 0)]).tolist():
            chosen = counted & (length > 0) & (group == k)
            grouped.setdefault(k, _sums_for(model)).add(trajectory.values, each, chosen)
    inside = tuple(
        (unit * 2.0**k, grouped[k].scores("imputation", trivial)) for k in sorted(grouped)
    )
    name = "imputation" if not isinstance(model, Blend) else f"imputation, {mode or 'two_sided'}"
    return ImputationScores(sums.scores(name, trivial), inside)


def score_forecast(
    model: BaseModel | Blend, dataset: Dataset, horizons: ArrayLike, *, targets: int = 20
) -> tuple[ChannelScores, ...]:
    """Scores forecasts at fixed horizons: the model's and those of baselines.

    For a row at time t and a horizon h, every predictor is given the rows up to t - h and predicts
    t; the values of that row which are known, and whose channel was observed by t - h, count.

    Args:
        model: a trained model, or a blend, which is scored beside its model and its baselines.
        dataset: masked values are not used as input, and are scored as well.
        horizons: s, above 0, strictly increasing.
        targets: rows per trajectory and horizon, evenly spaced among those that can be scored.

    Returns:
        One record per horizon.

    Raises:
        InputError: horizons as of `forecast`, no row can be scored, other channels than the
            model's, or a model that cannot predict at any time.
    """
    dataset = prepared(model, dataset)
    if isinstance(targets, bool) or not isinstance(targets, int) or targets < 1:
        raise InputError(f"targets must be a number of rows of at least 1, got {targets!r}")
    after: list[float] = checked_horizons(horizons).tolist()
    check_any_time(model)
    results = []
    for horizon in after:
        tasks, counted = forecast_tasks(dataset, horizon, targets)
        name = f"forecast, {horizon:g} s"
        results.append(
            _scored(name, model, tasks, counted)
            if tasks is not None
            else _sums_for(model).scores(name, ())
        )
    if not any(sum(scores.counts) for scores in results):
        raise InputError(
            f"no trajectory is long enough for a horizon of {after[0]:g} s after an observation; "
            "use shorter horizons or longer trajectories"
        )
    return tuple(results)


def forecast_tasks(
    dataset: Dataset, horizon: float, targets: int
) -> tuple[Dataset | None, list[NDArray[np.bool_]]]:
    """Trajectories that end with a row to forecast, and which of their values count.

    Args:
        dataset: to cut.
        horizon: s between the last row that is shown and the row to forecast.
        targets: per trajectory.

    Returns:
        The tasks, None where there is none, and (rows, channels) bool for each.
    """
    tasks, counted = [], []
    for trajectory in dataset:
        for past, at, truth, counts in _targets(trajectory, horizon, targets):
            tasks.append(
                replace(
                    past,
                    times=np.append(past.times, at),
                    values=np.vstack([past.values, np.where(counts, truth, np.nan)]),
                    observed=np.vstack([past.observed, np.zeros_like(counts)]),
                )
            )
            counted.append(np.vstack([np.zeros_like(past.observed), counts]))
    return (replace(dataset, trajectories=tuple(tasks)) if tasks else None), counted


_Predictions = Mapping[str, list[NDArray[np.float64]]]


def prepared(model: BaseModel | Blend, dataset: Dataset) -> Dataset:
    """A data set in the order of a model's channels, transformed as its training data were.

    Args:
        model: a trained model, or a blend.
        dataset: with these channels, in any order.

    Raises:
        InputError: other channels than the model's.
    """
    dataset = of_channels(Dataset.of(dataset), model.names, model.units)
    return model.transforms.apply(dataset)


def _scored(
    name: str,
    model: BaseModel | Blend,
    dataset: Dataset,
    counted: Sequence[NDArray[np.bool_]],
    *,
    seed: int = 0,
    asked: Asked | None = None,
) -> ChannelScores:
    """Scores causal predictions of a data set that is transformed and in the model's order."""
    answers: list[Answer] | None = None
    every: dict[str, list[NDArray[np.float64]]] = {}
    if isinstance(model, Blend):
        asked = _asked(model, dataset, seed, asked)
        answers, baselines = asked.causal, asked.members
        every["blend"] = [a.values for a in answers]
        if asked.model is not None and model.forward is not None:
            every[f"{model.forward.name} alone"] = asked.model
    else:
        rows = model_rows(model, dataset, seed=seed)
        assert rows is not None
        every[model.name] = rows
        mean = training_mean(model)
        baselines = {n: [fill(t, n, mean) for t in dataset] for n in forecasters()}
    every |= baselines
    sums = _sums_for(model)
    for i, trajectory in enumerate(dataset):
        each = {n: values[i] for n, values in every.items()}
        sums.add(np.nan_to_num(trajectory.values), each, counted[i])
        if answers is not None:
            sums.add_intervals(trajectory, answers[i], counted[i])
    return sums.scores(name, tuple(baselines))


def _fills(
    model: BaseModel | Blend, dataset: Dataset, mode: str, seed: int, asked: Asked | None
) -> tuple[_Predictions, list[Answer] | None, tuple[str, ...]]:
    """Fills of each predictor, answers with intervals, and which predictors are baselines."""
    if isinstance(model, Blend):
        asked = _asked(model, dataset, seed, asked)
        ahead = mode == "causal"
        answers = asked.causal if ahead else asked.fills
        members = asked.members if ahead else asked.two_sided_members
        rows = asked.model if ahead else asked.models
        every = {"blend": [a.values for a in answers]}
        if rows is not None and model.forward is not None:
            every[f"{model.forward.name} alone"] = rows
        return {**every, **members}, answers, tuple(members)
    result = {"causal": [t.values for t in impute(model, dataset, seed=seed)]}
    mean = training_mean(model)
    for method in fillers():
        result[method] = [fill(t, method, mean) for t in dataset]
    return result, None, fillers()


def _asked(blend: Blend, dataset: Dataset, seed: int, before: Asked | None) -> Asked:
    """What was asked before, if it is of this blend and data set; else the blend, asked now."""
    if before is None:
        return Asked(blend, dataset, seed)
    same = before.blend is blend and len(before.dataset) == len(dataset)
    if not same or any(
        not (np.array_equal(a.times, b.times) and np.array_equal(a.observed, b.observed))
        for a, b in zip(before.dataset, dataset, strict=True)
    ):
        raise InputError(
            f"asked is of another blend or of other data ({len(before.dataset)} trajectories, "
            f"{len(dataset)} are scored); give Asked(blend, prepared(blend, dataset)), or none"
        )
    return before


def training_mean(model: BaseModel | Blend) -> list[float]:
    """The mean of each channel over the observed values of the training set, in its unit."""
    if isinstance(model, Blend):
        return [float(m) for m in model.stack.mean]
    mean: list[float] = model.scaler.original(np.array(model.statistics.mean)).tolist()
    return mean


def _sums_for(model: BaseModel | Blend) -> ErrorSums:
    gap = model.tasks.gap_s if isinstance(model, Blend) else None
    return ErrorSums(model.names, model.units, channel_scale(model), gap_s=gap)


def channel_scale(model: BaseModel | Blend) -> NDArray[np.float64]:
    """(channels,) standard deviation of the training data, in the unit of each channel."""
    own = model.forward if isinstance(model, Blend) else model
    if own is None:
        assert isinstance(model, Blend)
        return model.stack.scale
    return np.asarray(np.abs(own.scaler.scale) * np.array(own.statistics.std))


def _elapsed(t: Trajectory) -> NDArray[np.float64]:
    """(rows, channels) s since the channel was observed in an earlier row; NaN where it was not."""
    never = torch.full((t.channels,), torch.nan, dtype=torch.float64)
    return delta(torch.tensor(t.times), torch.tensor(t.observed), since=never).numpy()


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
