"""Scores of predictions against a batch.

`after_first_observation` is the default everywhere: it counts known values after the first
observation of their channel, since before it every model can only predict the mean.
`after_first_row` and `published` are given as well because published numbers use them;
`docs/deviations.md` defines them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from offbeat.calibration import Calibration, CalibrationSums, normal_crps, normal_half_widths
from offbeat.data.batch import Batch, delta, last_index, last_values
from offbeat.tables import plain

SCORINGS = ("after_first_observation", "masked", "after_first_row", "published")
"""Names of the scorings."""


@dataclass(frozen=True)
class Score:
    """A mean squared error, in scaled units.

    Attributes:
        mse: over all values that count; NaN if there are none.
        per_channel: the same per channel.
        count: number of values that count.
    """

    mse: float
    per_channel: tuple[float, ...]
    count: int

    @property
    def rmse(self) -> float:
        """Root of the mean squared error."""
        return float(self.mse**0.5)


@dataclass(frozen=True)
class GapScore:
    """The score of values whose channel was last observed within a range of times.

    Attributes:
        above: s, lower bound of the time since observation, exclusive.
        up_to: s, upper bound, inclusive.
        score: of those values, after the first observation.
    """

    above: float
    up_to: float
    score: Score


@dataclass(frozen=True)
class Scores:
    """All scorings of one predictor on one data set.

    Attributes:
        after_first_observation: known values after their channel's first observation, observed or
            masked.
        masked: those of them that are masked.
        after_first_row: known values of all rows but the first.
        published: all rows, where the prediction of row 0 is the observed row 0, filled with zeros
            where it is masked: what the thesis reports.
        by_gap: after the first observation, by the time since the channel's last observation.
        calibration: of the distributions predicted by a model that has a scale, after the first
            observation, in scaled units; None for others.
    """

    after_first_observation: Score
    masked: Score
    after_first_row: Score
    published: Score
    by_gap: tuple[GapScore, ...]
    calibration: Calibration | None = None

    def to_dict(self) -> dict[str, Any]:
        """JSON-like form; a score without values has null for its error."""
        result: dict[str, Any] = {name: _plain(getattr(self, name)) for name in SCORINGS}
        result["by_gap"] = [
            {"above_s": g.above, "up_to_s": g.up_to, **_plain(g.score)} for g in self.by_gap
        ]
        return result if self.calibration is None else result | self.calibration.to_dict()


def null_if_nan(value: float) -> float | None:
    """A number for JSON, which has no NaN."""
    return None if value != value else value


def _plain(score: Score) -> dict[str, Any]:
    return {
        "mse": null_if_nan(score.mse),
        "rmse": null_if_nan(score.rmse),
        "count": score.count,
        "per_channel_mse": [null_if_nan(v) for v in score.per_channel],
    }


class ScoreSums:
    """Accumulates squared errors over batches, in float64.

    Args:
        channels: number of channels.
        gap_unit: s; times since observation are grouped at 1, 2, 4, 8, ... times this. None
            leaves `by_gap` empty.
    """

    def __init__(self, channels: int, *, gap_unit: float | None = None) -> None:
        self.channels = channels
        self.gap_unit = gap_unit
        self._sums: dict[str | int, tuple[Tensor, Tensor]] = {}
        self._calibration = CalibrationSums(age_unit=gap_unit)

    def add(self, predictions: Tensor, batch: Batch, scale: Tensor | None = None) -> None:
        """Adds a batch.

        Args:
            predictions: (batch, rows, channels) in the units of `batch.values`.
            batch: the observed and known values.
            scale: (batch, rows, channels) standard deviations of the predictions, if they have any.
        """
        squared = (predictions.double() - batch.values.double()) ** 2
        known = batch.targets
        mask = batch.mask & batch.valid[..., None]
        seen = last_index(mask) >= 0
        counted = known & seen
        self._add("after_first_observation", squared, counted)
        self._add("masked", squared, counted & ~mask)
        later = known.clone()
        later[:, 0] = False
        self._add("after_first_row", squared, later)
        shown = torch.where(mask[:, 0], 0.0, batch.values[:, 0].double() ** 2)
        self._add("published", torch.cat([shown[:, None], squared[:, 1:]], dim=1), known)
        elapsed = None if self.gap_unit is None else delta(batch.times, mask)
        if scale is not None:
            self._add_distributions(predictions, batch, scale, counted, elapsed)
        if self.gap_unit is not None and elapsed is not None:
            group = gap_groups(elapsed, self.gap_unit)
            for k in torch.unique(group[counted]).tolist():
                self._add(int(k), squared, counted & (group == k))

    def _add_distributions(
        self,
        predictions: Tensor,
        batch: Batch,
        scale: Tensor,
        counted: Tensor,
        elapsed: Tensor | None,
    ) -> None:
        truth, mean, spread = (
            a.double()[counted].cpu().numpy() for a in (batch.values, predictions, scale)
        )
        half = normal_half_widths(spread)
        low, high = mean[:, None] - half, mean[:, None] + half
        age = None if elapsed is None else elapsed[counted].cpu().numpy()
        self._calibration.add(truth, low, high, normal_crps(truth - mean, spread), age)

    def _add(self, name: str | int, squared: Tensor, counts: Tensor) -> None:
        total = torch.where(counts, squared, 0.0).sum(dim=(0, 1))
        count = counts.sum(dim=(0, 1))
        if name in self._sums:
            total, count = self._sums[name][0] + total, self._sums[name][1] + count
        self._sums[name] = (total, count)

    def scores(self) -> Scores:
        """The scores of all batches added so far."""
        unit = self.gap_unit or 0.0
        groups = sorted(k for k in self._sums if isinstance(k, int))
        by_gap = tuple(
            GapScore(unit * 2.0 ** (k - 1) if k else 0.0, unit * 2.0**k, self._score(k))
            for k in groups
        )
        named = {name: self._score(name) for name in SCORINGS}
        return Scores(**named, by_gap=by_gap, calibration=self._calibration.result())

    def _score(self, name: str | int) -> Score:
        if name not in self._sums:
            return Score(float("nan"), (float("nan"),) * self.channels, 0)
        total, count = self._sums[name]
        entries = int(count.sum())
        mse = float(total.sum()) / entries if entries else float("nan")
        return Score(mse, tuple((total / count).tolist()), entries)


def gap_groups(elapsed: Tensor, unit: float) -> Tensor:
    """Groups of gaps by length: 0 up to the unit, then k up to 2^k units.

    Args:
        elapsed: s, any shape.
        unit: s.

    Returns:
        Integers of the same shape.
    """
    return torch.ceil(torch.log2((elapsed / unit).clamp_min(1.0)) - 1e-6).long()


def last_value_predictions(batch: Batch, mean: Tensor) -> Tensor:
    """The last-value predictor: repeats each channel's last observed value, at first the mean.

    Args:
        batch: scaled.
        mean: (channels,) training mean, scaled.

    Returns:
        (batch, rows, channels).
    """
    mask = batch.mask & batch.valid[..., None]
    return last_values(batch.values, mask, before=mean.to(batch.values))


def row_0_constant(batch: Batch) -> float:
    """The c of `published = (1 - 1/rows) after_first_row + c (masked fraction of rows 0) / rows`.

    The mean square of those rows 0 that are masked, for whole rows masked and equal lengths.
    """
    masked = batch.known[:, 0] & ~batch.mask[:, 0]
    return float((batch.values[:, 0].double()[masked] ** 2).mean())


def _shown(rmse: float) -> str:
    if rmse != rmse:
        return "-"
    return f"{rmse:.4f}" if rmse < 1e4 else f"{rmse:.2e}"


def table(rows: Mapping[str, Scores], *, notes: Mapping[str, str] | None = None) -> str:
    """A plain-text table of scores, one row per predictor, the best one first.

    Args:
        rows: scores by predictor.
        notes: a remark per predictor, shown at the end of its row.
    """
    notes = notes or {}
    lines = [["predictor", "RMSE", "masked only", "after row 0", "published", ""]]
    for name, scores in sorted(rows.items(), key=lambda item: item[1].after_first_observation.mse):
        numbers = (_shown(getattr(scores, scoring).rmse) for scoring in SCORINGS)
        lines.append([name, *numbers, notes.get(name, "")])
    return plain(lines, left=(0, 5))
