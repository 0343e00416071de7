"""Hiding cells: what is known to the score becomes unseen by the model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from offbeat.config import HIDINGS
from offbeat.data.trajectory import Dataset, Trajectory
from offbeat.errors import InputError, one_of

Hiding = Literal["rows", "cells", "bursts", "dropout"]


def mask_out(
    dataset: Dataset,
    observed_fraction: float,
    *,
    hide: Hiding = "rows",
    burst_rows: int | None = None,
    burst_s: float | None = None,
    sensors: Sequence[Sequence[str]] | None = None,
    seed: int = 0,
) -> Dataset:
    """Hides observed cells at random; their values stay known, so that they can be scored.

    Shares are exact, in each trajectory: of the n rows in which something is observed,
    `int(n * observed_fraction)` stay.

    - `rows` hides rows at random, all channels together.
    - `bursts` hides runs of consecutive such rows, all channels together.
    - `cells` hides the cells of each channel at random, on their own: the share holds in each
      channel, which keeps at least one cell.
    - `dropout` silences sensors, each for spans of its own: a sensor is a group of channels, the
      share holds for the rows in which it says something, and at least one of them stays.

    Runs and silences lie apart, anywhere with the same probability, and are as long as asked for;
    the last one in time is cut where the share is reached.

    Args:
        dataset: trajectories to thin.
        observed_fraction: share that stays observed, above 0 and at most 1.
        hide: `rows`, `cells`, `bursts` or `dropout`.
        burst_rows: rows of a run or of a silence, counting rows that are observed. Without it and
            without burst_s, there is a single one per trajectory or sensor.
        burst_s: s, the same as a span of time, from its first hidden row on.
        sensors: names of the channels of each sensor; a channel that stands in none never falls
            silent. By default channels with the same mask in the whole data set are one sensor, and
            each channel is one where all have the same mask.
        seed: of the draw.

    Raises:
        InputError: the fraction is not above 0 and at most 1, it would leave no row, an option is
            given that the way of hiding does not have, or bursts are too short to lie apart.
    """
    if not 0 < observed_fraction <= 1:
        raise InputError(
            f"observed_fraction must be above 0 and at most 1, got {observed_fraction!r}; "
            "0.3 keeps 30 % of the rows"
        )
    one_of("way of hiding", hide, HIDINGS)
    _check_options(hide, burst_rows, burst_s, sensors)
    groups = _groups(dataset, hide, sensors)
    random = np.random.default_rng(seed)
    masked = []
    for i, trajectory in enumerate(dataset):
        observed = trajectory.observed.copy()
        for group in groups:
            rows = np.flatnonzero(trajectory.observed[:, group].any(axis=1))
            count = _count(len(rows), observed_fraction, hide, i)
            if hide in ("rows", "cells"):
                kept = random.choice(rows, size=count, replace=False)
            else:
                kept = rows[
                    _outside_bursts(trajectory.times[rows], count, burst_rows, burst_s, random)
                ]
            silent = np.ones(trajectory.rows, dtype=bool)
            silent[kept] = False
            observed[np.ix_(silent, group)] = False
        masked.append(replace(trajectory, observed=observed))
    meta: dict[str, Any] = {"observed_fraction": observed_fraction}
    if hide != "rows":
        meta["hide"] = hide
    return Dataset(tuple(masked), {**dataset.meta, **meta})


def sensors_of(dataset: Dataset) -> list[list[str]]:
    """Channels that were always observed together, as groups of names, in order of the channels.

    Args:
        dataset: logs in which sensors speak at times of their own.

    Returns:
        One list of names per sensor; each channel on its own where all have the same mask.
    """
    together: dict[bytes, list[str]] = {}
    for channel, name in enumerate(dataset.names):
        mask = b"".join(np.packbits(t.observed[:, channel]).tobytes() for t in dataset)
        together.setdefault(mask, []).append(name)
    groups = list(together.values())
    return groups if len(groups) > 1 else [[name] for name in dataset.names]


def masked_values(trajectory: Trajectory) -> NDArray[np.bool_]:
    """(rows, channels) True where a value is known and hidden from the model."""
    return trajectory.known & ~trajectory.observed


def _check_options(hide: str, burst_rows: Any, burst_s: Any, sensors: Any) -> None:
    if burst_rows is not None and burst_s is not None:
        raise InputError("give burst_rows or burst_s, not both")
    if (burst_rows is not None or burst_s is not None) and hide not in ("bursts", "dropout"):
        raise InputError(
            f"burst_rows and burst_s are options of 'bursts' and 'dropout', hide is {hide!r}; "
            "leave them out, or hide bursts"
        )
    if burst_rows is not None and burst_rows < 1:
        raise InputError(f"burst_rows must be an integer of at least 1, got {burst_rows!r}")
    if burst_s is not None and not 0 < burst_s < np.inf:
        raise InputError(f"burst_s must be a positive number of seconds, got {burst_s!r}")
    if sensors is not None and hide != "dropout":
        raise InputError(f"sensors are an option of 'dropout', hide is {hide!r}; leave them out")


def _groups(
    dataset: Dataset, hide: str, sensors: Sequence[Sequence[str]] | None
) -> list[NDArray[np.int64]]:
    """Positions of the channels that are hidden together."""
    if hide in ("rows", "bursts"):
        return [np.arange(dataset.channels)]
    if hide == "cells":
        return [np.array([channel]) for channel in range(dataset.channels)]
    groups = sensors_of(dataset) if sensors is None else [list(names) for names in sensors]
    named = [name for names in groups for name in names]
    for name in named:
        one_of("channel of a sensor", name, dataset.names)
    if len(set(named)) < len(named) or not all(groups):
        raise InputError(f"sensors must share no channel, and have at least one, got {groups}")
    return [np.array([dataset.names.index(name) for name in names]) for names in groups]


def _count(rows: int, fraction: float, hide: str, trajectory: int) -> int:
    """How many of so many rows stay."""
    # 0.7 * 100 is 70.0 and 0.29 * 100 is 28.999...: the decimal that was meant counts.
    count = int(round(rows * fraction, 9))
    if hide in ("cells", "dropout"):
        return max(count, min(rows, 1))
    if count == 0:
        raise InputError(
            f"observed_fraction {fraction} of the {rows} observed rows of trajectory {trajectory} "
            "leaves none; use a larger fraction or longer trajectories"
        )
    return count


def _outside_bursts(
    times: NDArray[np.float64],
    keep: int,
    burst_rows: int | None,
    burst_s: float | None,
    random: np.random.Generator,
) -> NDArray[np.bool_]:
    """(rows,) True at exactly `keep` rows; the others lie in runs, with kept rows between them."""
    hide = len(times) - keep
    if hide == 0:
        return np.ones(len(times), dtype=bool)
    if burst_s is None:
        rows = burst_rows or hide
        ends = np.arange(len(times)) + rows
    else:
        # A grid of 5 ms has ten rows in 50 ms, whatever the last bits of its times are.
        ends = np.searchsorted(times, times + burst_s * (1 - 1e-9))
    # A run goes before the first kept row, between two of them, or after the last one.
    places = random.permutation(keep + 1)
    enough, few = 1, 0
    while not (hidden := _runs(np.sort(places[:enough]), keep, ends))[1]:
        if enough == len(places):
            length = f"{burst_rows} rows" if burst_s is None else f"{burst_s} s"
            raise InputError(
                f"bursts of {length} can't hide {hide} of {len(times)} rows and lie apart; use "
                "longer bursts, a larger observed_fraction, or hide 'rows'"
            )
        enough, few = min(2 * enough, len(places)), enough
    while enough - few > 1:
        middle = (enough + few) // 2
        tried = _runs(np.sort(places[:middle]), keep, ends)
        if tried[1]:
            enough, hidden = middle, tried
        else:
            few = middle
    return ~hidden[0]


def _runs(
    places: NDArray[np.int64], keep: int, ends: NDArray[np.int64]
) -> tuple[NDArray[np.bool_], bool]:
    """Hides a run after so many kept rows each; True if that hides all but `keep` rows."""
    hidden = np.zeros(len(ends), dtype=bool)
    left = len(ends) - keep
    for place in places:
        if left == 0:
            break
        start = int(place) + len(ends) - keep - left
        length = min(int(ends[start]) - start, left)
        hidden[start : start + length] = True
        left -= length
    return hidden, left == 0
