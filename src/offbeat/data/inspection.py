"""Inspection of a data set: rates, jitter, gaps, repeated values and anomalies."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from offbeat.data.arrays import hand_over
from offbeat.data.cleaning.channels import find_repeats, new_values
from offbeat.data.cleaning.log import sentences
from offbeat.data.gaps import fastest_step_of, usual_gap
from offbeat.data.outliers import Outliers, find_outliers
from offbeat.data.redundant import find_redundant
from offbeat.data.trajectory import Dataset


@dataclass(frozen=True)
class ChannelInspection:
    """A channel, over all episodes together.

    Attributes:
        name: of the channel.
        unit: or empty.
        role: one of `ROLES`.
        known: number of known values.
        missing: fraction of the rows in which it is not known.
        rate_hz: one over the median time between two known values; None below two.
        jitter_s: half the distance from the 5th to the 95th percentile of those times.
        lost: fraction of the values expected from its rate between its first and last one
            that are missing; 0 if there are more values.
        longest_gap_s: the longest time between two known values of an episode.
        longest_gap_at: the episode, counted from 0, and the time in it at which that gap starts.
        rows_per_value: usual length of its runs of equal values, where a faster recording repeats
            the values of a slower sensor, else 0.
        repeated_fraction: fraction of known values that equal the previous one.
        low: its lowest value; None if it is never known.
        high: its highest value.
        mean: its mean value.
        constant: whether it has a single value.
        counter: whether it is a sequence number or a clock.
        copy_of: the channel that has the same values, or empty.
        outliers: its values that are no measurements.
    """

    name: str
    unit: str
    role: str
    known: int
    missing: float
    rate_hz: float | None
    jitter_s: float | None
    lost: float
    longest_gap_s: float | None
    longest_gap_at: tuple[int, float] | None
    rows_per_value: int
    repeated_fraction: float
    low: float | None
    high: float | None
    mean: float | None
    constant: bool
    counter: bool = False
    copy_of: str = ""
    outliers: tuple[Outliers, ...] = ()


@dataclass(frozen=True)
class EpisodeInspection:
    """An episode.

    Attributes:
        label: from the file, or empty.
        origin: where it came from.
        rows: of all its channels together.
        duration_s: from the first to the last row.
        longest_step_s: the longest time between two rows.
        outage_before_s: the outage between the previous episode and this one, or None.
        clock_set_before: whether the clock was set before it.
        late: rows out of order.
        duplicates: rows with the time stamp of another row.
    """

    label: str
    origin: str
    rows: int
    duration_s: float
    longest_step_s: float
    outage_before_s: float | None = None
    clock_set_before: bool = False
    late: int = 0
    duplicates: int = 0


@dataclass(frozen=True)
class Inspection:
    """The contents of a data set.

    Attributes:
        source: the file, if known.
        format: of the file.
        time_unit: unit of times in the file.
        rows: of all episodes together.
        known: fraction of the values that are known.
        rate_hz: one over the median time between two rows (see `usual_gap`); None where no episode
            has two.
        channels: one entry each.
        episodes: one entry each.
        found: sentences on what was found and changed while reading.
        notes: sentences on values that are no measurements, and on channels that nothing can be
            learned from.
        cleaning: the full record, see `CleaningLog`; empty for data that were not read.
    """

    source: str
    format: str
    time_unit: str
    rows: int
    known: float
    rate_hz: float | None
    channels: tuple[ChannelInspection, ...]
    episodes: tuple[EpisodeInspection, ...]
    found: tuple[str, ...]
    notes: tuple[str, ...]
    cleaning: dict[str, Any]

    def __repr__(self) -> str:
        rate = "" if self.rate_hz is None else f", about {self.rate_hz:.3g} Hz"
        return (
            f"Inspection({self.source or 'data'}: {len(self.episodes)} episodes, {self.rows} rows, "
            f"{len(self.channels)} channels, {100 * self.known:.0f} % known{rate})"
        )

    def to_dict(self) -> dict[str, Any]:
        """JSON-like form."""
        plain = asdict(self)
        return {key: list(v) if isinstance(v, tuple) else v for key, v in plain.items()}


def inspect(dataset: Dataset) -> Inspection:
    """Inspects a data set: rates, gaps, repeated values, outliers and anomalies.

    Args:
        dataset: from `read`.
    """
    dataset = Dataset.of(dataset)
    steps = np.concatenate([np.diff(t.times) for t in dataset])
    rows = sum(t.rows for t in dataset)
    cleaning = dict(dataset.meta.get("cleaning", {}))
    outliers = _outliers(dataset, cleaning)
    redundant = find_redundant(dataset)
    channels = tuple(
        replace(
            _channel(dataset, c, rows),
            counter=name in redundant.counters,
            copy_of=redundant.copies.get(name, ""),
            outliers=tuple(found for found in outliers if found.name == name),
        )
        for c, name in enumerate(dataset.names)
    )
    known = sum(channel.known for channel in channels)
    return Inspection(
        source=str(dataset.meta.get("source", "")),
        format=str(dataset.meta.get("format", "offbeat")),
        time_unit=str(dataset.meta.get("time_unit", "s")),
        rows=rows,
        known=known / (rows * dataset.channels),
        rate_hz=_rate(steps, fastest_step_of(dataset)),
        channels=channels,
        episodes=_episodes(dataset, cleaning),
        found=tuple(sentences(cleaning)) if cleaning else (),
        notes=(*(str(found) for found in outliers), *redundant.notes()),
        cleaning=cleaning,
    )


def without_repeats(dataset: Dataset) -> Dataset:
    """The data set with repeated values as not known, as from `read` with `repeated="mask"`."""
    columns = [t.values.copy() for t in dataset]
    for c, role in enumerate(dataset.roles):
        found = None if role == "action" else find_repeats([v[:, c] for v in columns])
        if found is not None:
            for values in columns:
                values[~new_values(values[:, c], found.rows_per_value), c] = np.nan
    trajectories = tuple(
        replace(t, values=hand_over(v), observed=hand_over(t.observed & ~np.isnan(v)))
        for t, v in zip(dataset, columns, strict=True)
    )
    return replace(dataset, trajectories=trajectories)


def _outliers(dataset: Dataset, cleaning: dict[str, Any]) -> tuple[Outliers, ...]:
    """Those that its reader found, before it unwrapped angles, or those in the data."""
    if "outliers" not in cleaning:
        return find_outliers(dataset)
    found = (Outliers.from_dict(entry) for entry in cleaning["outliers"]["found"])
    return tuple(outliers for outliers in found if outliers.name in dataset.names)


def _channel(dataset: Dataset, c: int, rows: int) -> ChannelInspection:
    columns = [t.values[:, c] for t in dataset]
    known = [np.flatnonzero(~np.isnan(column)) for column in columns]
    steps = [np.diff(t.times[at]) for t, at in zip(dataset, known, strict=True)]
    together = np.concatenate(steps)
    count = sum(len(at) for at in known)
    described = {
        "name": dataset.names[c],
        "unit": dataset.units[c],
        "role": dataset.roles[c],
        "known": count,
    }
    if not count:
        return ChannelInspection(
            **described,  # type: ignore[arg-type]
            missing=1.0,
            rate_hz=None,
            jitter_s=None,
            lost=0.0,
            longest_gap_s=None,
            longest_gap_at=None,
            rows_per_value=0,
            repeated_fraction=0.0,
            low=None,
            high=None,
            mean=None,
            constant=False,
        )
    values = [column[at] for column, at in zip(columns, known, strict=True) if len(at)]
    low = min(float(v.min()) for v in values)
    high = max(float(v.max()) for v in values)
    repeats = sum(int(np.count_nonzero(v[1:] == v[:-1])) for v in values)
    found = None if low == high else find_repeats(columns)
    gap, at = _longest(dataset, steps, known)
    return ChannelInspection(
        **described,  # type: ignore[arg-type]
        missing=1 - count / rows,
        rate_hz=_rate(together),
        jitter_s=_jitter(together),
        lost=_lost(together),
        longest_gap_s=gap,
        longest_gap_at=at,
        rows_per_value=0 if found is None else found.rows_per_value,
        repeated_fraction=repeats / max(sum(len(v) - 1 for v in values), 1),
        low=low,
        high=high,
        mean=sum(float(v.sum()) for v in values) / count,
        constant=low == high,
    )


def _longest(
    dataset: Dataset, steps: Sequence[NDArray[np.float64]], known: Sequence[NDArray[np.int64]]
) -> tuple[float | None, tuple[int, float] | None]:
    longest = [float(own.max()) if len(own) else -1.0 for own in steps]
    episode = int(np.argmax(longest))
    if longest[episode] < 0:
        return None, None
    row = known[episode][int(np.argmax(steps[episode]))]
    return longest[episode], (episode, float(dataset[episode].times[row]))


def _rate(steps: NDArray[np.float64], fastest: float = 0.0) -> float | None:
    return 1 / usual_gap(float(np.median(steps)), fastest) if len(steps) else None


def _jitter(steps: NDArray[np.float64]) -> float | None:
    if not len(steps):
        return None
    low, high = np.quantile(steps, [0.05, 0.95])
    return float(high - low) / 2


def _lost(steps: NDArray[np.float64]) -> float:
    """Fraction of the values expected from the median step that are missing."""
    if not len(steps):
        return 0.0
    expected = float(steps.sum()) / float(np.median(steps))
    return max(0.0, 1 - len(steps) / expected)


def _episodes(dataset: Dataset, cleaning: dict[str, Any]) -> tuple[EpisodeInspection, ...]:
    found = {entry["episode"]: entry for entry in cleaning.get("episodes", ())}
    labels = dataset.meta.get("labels", [""] * len(dataset))
    # A part of the data, such as a split, has fewer trajectories than the log.
    if len(labels) != len(dataset) or any(i >= len(dataset) for i in found):
        labels, found = [""] * len(dataset), {}
    episodes = []
    for i, trajectory in enumerate(dataset):
        own = found.get(i, {})
        steps = np.diff(trajectory.times)
        episodes.append(
            EpisodeInspection(
                label=str(labels[i]),
                origin=trajectory.origin,
                rows=trajectory.rows,
                duration_s=float(trajectory.times[-1] - trajectory.times[0]),
                longest_step_s=float(steps.max()) if len(steps) else 0.0,
                outage_before_s=own.get("outage_before_s"),
                clock_set_before=bool(own.get("clock_set_before", False)),
                late=int(own.get("late", 0)),
                duplicates=int(own.get("duplicates", 0)),
            )
        )
    return tuple(episodes)
