"""Masking: hides observed values from the model; they stay known for scoring."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from offbeat.config import MASKS
from offbeat.data.arrays import hand_over
from offbeat.data.trajectory import Dataset, Trajectory
from offbeat.errors import InputError, one_of

Mask = Literal["rows", "values", "bursts", "dropout"]


def mask_out(
    dataset: Dataset,
    observed_fraction: float,
    *,
    mask: Mask = "rows",
    burst_rows: int | None = None,
    burst_s: float | None = None,
    sensors: Sequence[Sequence[str]] | None = None,
    seed: int = 0,
) -> Dataset:
    """Masks observed values at random; they stay known, so that predictions of them are scored.

    Only channels with the role `state` are masked. Fractions are exact in each trajectory: of the n
    rows in which something is observed, `int(n * observed_fraction)` stay.

    - `rows` masks rows at random, all channels together.
    - `bursts` masks runs of consecutive such rows, all channels together.
    - `values` masks the values of each channel at random, independently: the fraction applies to
      each channel, which keeps at least one value.
    - `dropout` masks runs of each sensor independently: a sensor is a group of channels, the
      fraction applies to the rows in which it reports, and at least one of them stays.

    Runs do not touch, are placed uniformly, and have the given length; the last one
    in time is shortened to reach the fraction.

    Args:
        dataset: trajectories to mask.
        observed_fraction: fraction that stays observed, above 0 and at most 1.
        mask: `rows`, `values`, `bursts` or `dropout`.
        burst_rows: observed rows per run. Without it and without burst_s, there is a single run
            per trajectory or sensor.
        burst_s: s, length of a run from its first masked row on, instead of burst_rows.
        sensors: names of the channels of each sensor; channels of no sensor are not masked. By
            default channels with the same mask in the whole data set are one sensor, and each
            channel is one where all have the same mask.
        seed: of the masks.

    Raises:
        InputError: the fraction is not above 0 and at most 1, it would leave no row, an option is
            given that this kind of mask does not have, or runs are too short to be separated.
    """
    dataset = Dataset.of(dataset)
    number = isinstance(observed_fraction, int | float)
    if not (number and 0 < observed_fraction <= 1):
        raise InputError(
            f"observed_fraction must be above 0 and at most 1, got {observed_fraction!r}; "
            "0.3 keeps 30 % of the rows"
        )
    one_of("mask", mask, MASKS)
    _check_options(mask, burst_rows, burst_s, sensors)
    groups = _groups(dataset, mask, sensors)
    random = np.random.default_rng(seed)
    masked = []
    for i, trajectory in enumerate(dataset):
        observed = trajectory.observed.copy()
        for group in groups:
            rows = np.flatnonzero(trajectory.observed[:, group].any(axis=1))
            count = _count(len(rows), observed_fraction, mask, i)
            if mask in ("rows", "values"):
                kept = random.choice(rows, size=count, replace=False)
            else:
                kept = rows[
                    _outside_bursts(trajectory.times[rows], count, burst_rows, burst_s, random)
                ]
            dropped = np.ones(trajectory.rows, dtype=bool)
            dropped[kept] = False
            observed[np.ix_(dropped, group)] = False
        masked.append(replace(trajectory, observed=hand_over(observed)))
    meta: dict[str, Any] = {"observed_fraction": observed_fraction}
    if mask != "rows":
        meta["mask"] = mask
    return Dataset(tuple(masked), {**dataset.meta, **meta})


def keep_at_random(
    eligible: NDArray[np.bool_], fractions: NDArray[np.float64], random: np.random.Generator
) -> NDArray[np.bool_]:
    """Keeps an exact fraction of entries along the last axis, at random: `rows` of `mask_out`.

    It is the same for many trajectories at once, with other random numbers than `mask_out` draws.

    Args:
        eligible: (..., rows) True where something is observed.
        fractions: broadcastable to (...), that stay observed.
        random: source of random numbers.

    Returns:
        (..., rows) True at `int(n * fraction)` of the n eligible entries, at one at least.
    """
    count = eligible.sum(axis=-1)
    # 0.29 * 100 is 28.999...: rounded, so that it counts as 29.
    keep = np.clip(np.floor(np.round(count * fractions, 9)).astype(np.int64), 1, None)
    keys = np.where(eligible, random.random(eligible.shape), np.inf)
    last = np.minimum(keep, eligible.shape[-1]) - 1
    limit = np.take_along_axis(np.sort(keys, axis=-1), last[..., None], axis=-1)
    return np.asarray((keys <= limit) & eligible)


def sensors_of(dataset: Dataset) -> list[list[str]]:
    """Groups of states that are always observed together, in the order of the channels.

    Args:
        dataset: recordings in which sensors report at different times.

    Returns:
        One list of names per sensor; each channel on its own where all have the same mask.
    """
    together: dict[bytes, list[str]] = {}
    names = [dataset.names[channel] for channel in _states(dataset)]
    for channel, name in zip(_states(dataset), names, strict=True):
        mask = b"".join(np.packbits(t.observed[:, channel]).tobytes() for t in dataset)
        together.setdefault(mask, []).append(name)
    groups = list(together.values())
    return groups if len(groups) > 1 else [[name] for name in names]


def masked_values(trajectory: Trajectory) -> NDArray[np.bool_]:
    """(rows, channels) True where a value is known and not observed."""
    return trajectory.known & ~trajectory.observed


def _states(dataset: Dataset) -> NDArray[np.int64]:
    return np.array([i for i, role in enumerate(dataset.roles) if role == "state"], dtype=np.int64)


def _check_options(mask: str, burst_rows: Any, burst_s: Any, sensors: Any) -> None:
    if burst_rows is not None and burst_s is not None:
        raise InputError("give burst_rows or burst_s, not both")
    if (burst_rows is not None or burst_s is not None) and mask not in ("bursts", "dropout"):
        raise InputError(
            f"burst_rows and burst_s are options of the masks 'bursts' and 'dropout', mask is "
            f"{mask!r}; leave them out, or mask bursts"
        )
    if burst_rows is not None and burst_rows < 1:
        raise InputError(f"burst_rows must be an integer of at least 1, got {burst_rows!r}")
    if burst_s is not None and not 0 < burst_s < np.inf:
        raise InputError(f"burst_s must be a positive number of seconds, got {burst_s!r}")
    if sensors is not None and mask != "dropout":
        raise InputError(
            f"sensors are an option of the mask 'dropout', mask is {mask!r}; leave them out"
        )


def _groups(
    dataset: Dataset, mask: str, sensors: Sequence[Sequence[str]] | None
) -> list[NDArray[np.int64]]:
    """Positions of the channels that are masked together."""
    if not len(_states(dataset)):
        raise InputError("no channel has the role 'state', so there is nothing to mask")
    if mask in ("rows", "bursts"):
        return [_states(dataset)]
    if mask == "values":
        return [np.array([channel]) for channel in _states(dataset)]
    groups = sensors_of(dataset) if sensors is None else [list(names) for names in sensors]
    named = [name for names in groups for name in names]
    for name in named:
        one_of("channel of a sensor", name, [dataset.names[i] for i in _states(dataset)])
    if len(set(named)) < len(named) or not all(groups):
        raise InputError(f"sensors must share no channel, and have at least one, got {groups}")
    return [np.array([dataset.names.index(name) for name in names]) for names in groups]


def _count(rows: int, fraction: float, mask: str, trajectory: int) -> int:
    """Number of rows that stay observed."""
    # 0.29 * 100 is 28.999...: rounded, so that it counts as 29.
    count = int(round(rows * fraction, 9))
    if mask in ("values", "dropout"):
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
    """(rows,) True at exactly `keep` rows; the others form runs with kept rows between them."""
    masked = len(times) - keep
    if masked == 0:
        return np.ones(len(times), dtype=bool)
    if burst_s is None:
        rows = burst_rows or masked
        ends = np.arange(len(times)) + rows
    else:
        # With a tolerance: a run of 50 ms has ten rows on a grid of 5 ms.
        ends = np.searchsorted(times, times + burst_s * (1 - 1e-9))
    # A run is before the first kept row, between two of them, or after the last one.
    places = random.permutation(keep + 1)
    enough, few = 1, 0
    while not (tried := _runs(np.sort(places[:enough]), keep, ends))[1]:
        if enough == len(places):
            length = f"{burst_rows} rows" if burst_s is None else f"{burst_s} s"
            raise InputError(
                f"bursts of {length} cannot mask {masked} of {len(times)} rows and be apart; "
                "use longer bursts, a larger observed_fraction, or mask 'rows'"
            )
        enough, few = min(2 * enough, len(places)), enough
    runs = tried[0]
    while enough - few > 1:
        middle = (enough + few) // 2
        tried = _runs(np.sort(places[:middle]), keep, ends)
        if tried[1]:
            enough, runs = middle, tried[0]
        else:
            few = middle
    return ~runs


def _runs(
    places: NDArray[np.int64], keep: int, ends: NDArray[np.int64]
) -> tuple[NDArray[np.bool_], bool]:
    """Masks runs at these positions; True if that masks all but `keep` rows."""
    masked = np.zeros(len(ends), dtype=bool)
    left = len(ends) - keep
    for place in places:
        if left == 0:
            break
        start = int(place) + len(ends) - keep - left
        length = min(int(ends[start]) - start, left)
        masked[start : start + length] = True
        left -= length
    return masked, left == 0
