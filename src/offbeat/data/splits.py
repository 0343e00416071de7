"""Splits of data sets into training, validation and test part."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from offbeat.config import SplitConfig, from_mapping
from offbeat.data.masking import mask_out
from offbeat.data.source import read_json
from offbeat.data.trajectory import Dataset, Trajectory
from offbeat.data.windows import Cut, owned_windows
from offbeat.errors import FileFormatError, InputError
from offbeat.files import write_json

_BLOCK_ROWS = 50
_MOST_BLOCKS = 5
_AROUND = (4.0, 4.0, 4.0)  # of the Dirichlet distribution of the training rows around two blocks


def split(
    dataset: Dataset,
    fractions: Sequence[float] = (0.7, 0.15, 0.15),
    *,
    seed: int = 0,
) -> tuple[Dataset, ...]:
    """Splits by trajectory, at random; no trajectory is in two parts.

    Args:
        dataset: trajectories to split.
        fractions: one per part; they sum to 1.
        seed: of the shuffle.

    Returns:
        One data set per fraction (training, validation, test by default).

    Raises:
        InputError: fractions are not positive or do not sum to 1, or a part would be empty.
    """
    dataset = Dataset.of(dataset)
    return tuple(dataset.take(index) for index in _drawn(len(dataset), fractions, seed))


def split_in_time(
    dataset: Dataset, fractions: Sequence[float] = (0.7, 0.15, 0.15)
) -> tuple[Dataset, ...]:
    """Splits by time: the first rows are the first part, the next rows the second, and so on.

    Several trajectories count as one recording, one after the other; the one in which a part ends
    is split there. A part of a trajectory with a single row is dropped.

    Args:
        dataset: a recording, its trajectories in the order of time.
        fractions: one per part, of the rows; they sum to 1.

    Returns:
        One data set per fraction.

    Raises:
        InputError: fractions are not positive or do not sum to 1, or a part would be empty.
    """
    dataset = Dataset.of(dataset)
    rows = sum(t.rows for t in dataset)
    ends = _ends(rows, fractions)
    pieces: list[list[Trajectory]] = [[] for _ in ends]
    before = 0
    for trajectory in dataset:
        start = 0
        for part, end in zip(pieces, ends, strict=True):
            stop = min(max(int(end) - before, start), trajectory.rows)
            if stop - start >= 2:
                part.append(trajectory.slice(start, stop))
            start = stop
        before += trajectory.rows
    if not all(pieces):
        raise InputError(
            f"{rows} rows are too few to be split in time into {list(fractions)}: a part would be "
            "empty; use a longer recording or fewer parts"
        )
    return tuple(replace(dataset, trajectories=tuple(part)) for part in pieces)


def split_in_blocks(
    dataset: Dataset,
    fractions: Sequence[float] = (0.7, 0.15, 0.15),
    *,
    blocks: int | None = None,
    gap_s: float = 0.0,
    seed: int = 0,
) -> tuple[Dataset, Dataset, Dataset]:
    """Splits a recording in blocks: validation and test come from several places of it.

    The rows are divided into as many sections as there are blocks. Each section has a validation
    and a test block, in random order and at random places: a motion that repeats itself is met at
    other phases. Several trajectories count as one recording, as in `split_in_time`.

    Args:
        dataset: a recording, its trajectories in the order of time.
        fractions: of the rows for training, validation and test; they sum to 1.
        blocks: validation blocks, and as many test blocks; by default as many as have 50 rows or
            more, from 1 to 5.
        gap_s: s, training rows this near to a row of another part are left out.
        seed: of the places.

    Returns:
        Training, validation and test part; a trajectory per block.

    Raises:
        InputError: fractions are not three, not positive or do not sum to 1, or a part would be
            empty.
    """
    dataset = Dataset.of(dataset)
    rows = sum(t.rows for t in dataset)
    if len(fractions) != 3:
        raise InputError(f"a split in blocks has three fractions, got {list(fractions)}")
    _ends(rows, fractions)  # checks them
    if blocks is None:
        smallest = int(rows * min(fractions[1:]))
        blocks = min(max(smallest // _BLOCK_ROWS, 1), _MOST_BLOCKS)
    part_of_row = _blocks(rows, fractions, blocks, np.random.default_rng(seed))
    pieces: list[list[Trajectory]] = [[], [], []]
    before = 0
    for trajectory in dataset:
        own = part_of_row[before : before + trajectory.rows]
        edges = [0, *(np.flatnonzero(np.diff(own)) + 1).tolist(), trajectory.rows]
        for start, stop in pairwise(edges):
            first, last = start, stop
            if own[start] == 0:
                first, last = _apart(trajectory.times, start, stop, gap_s)
            if last - first >= 2:
                pieces[own[start]].append(trajectory.slice(first, last))
        before += trajectory.rows
    if not all(pieces):
        raise InputError(
            f"{rows} rows are too few to be split into {blocks} blocks of {list(fractions)}, "
            f"{gap_s:g} s apart: a part would be empty; use a longer recording or fewer blocks"
        )
    made = [replace(dataset, trajectories=tuple(part)) for part in pieces]
    return made[0], made[1], made[2]


def _blocks(
    rows: int, fractions: Sequence[float], blocks: int, random: np.random.Generator
) -> NDArray[np.int64]:
    """(rows,) the part of each row: 0 training, 1 validation, 2 test."""
    part_of_row = np.zeros(rows, dtype=np.int64)
    for section in range(blocks):
        around = fractions[0] * random.dirichlet(_AROUND)  # training before, between and after
        order = random.permutation([1, 2])
        start = section
        for training, part in zip(around, order, strict=False):
            start += training
            ends = [start, start := start + fractions[part]]
            first, last = np.floor(np.array(ends) * rows / blocks + 0.5).astype(np.int64)
            part_of_row[first:last] = part
    return part_of_row


def _apart(times: NDArray[np.float64], start: int, stop: int, gap_s: float) -> tuple[int, int]:
    """First row and end of the rows of a block that are `gap_s` away from those around it."""
    if not gap_s:
        return start, stop
    if start > 0:
        start = max(start, int(np.searchsorted(times, times[start - 1] + gap_s, side="right")))
    if stop < len(times):
        stop = min(stop, int(np.searchsorted(times, times[stop] - gap_s, side="left")))
    return start, stop


def apply_split(dataset: Dataset, config: SplitConfig) -> tuple[Dataset, Dataset, Dataset]:
    """Cuts windows, masks values and splits, all from one seed.

    By trajectory, all windows of a trajectory are in one part. By time and in blocks, the recording
    is split first, so that no window spans two parts. Where each trajectory gives one window,
    values are masked in the windows; where it gives several, they are masked before it is cut, so
    that the fraction holds for the trajectory, or for its piece. `random` windows are for training:
    validation and test are cut consecutively, so that each of their rows counts once.

    Args:
        dataset: as recorded.
        config: the options.

    Returns:
        Training, validation and test part.

    Raises:
        InputError: as of `windows`, `mask_out`, `split`, `split_in_time` and `split_in_blocks`.
    """
    dataset = Dataset.of(dataset)
    if config.by != "trajectory":
        parts: Sequence[Dataset] = (
            split_in_time(dataset, config.fractions)
            if config.by == "time"
            else split_in_blocks(
                dataset,
                config.fractions,
                blocks=config.blocks,
                gap_s=config.gap_s or 0.0,
                seed=config.seed,
            )
        )
        dataset = replace(dataset, trajectories=tuple(t for part in parts for t in part))
        ends = np.cumsum([len(part) for part in parts])
        index_of = np.split(np.arange(len(dataset)), ends[:-1])
    else:
        index_of = _drawn(len(dataset), config.fractions, config.seed)
    cut: Cut = config.cut or ("one" if config.by == "trajectory" else "consecutive")
    owners = np.arange(len(dataset))
    if config.observed_fraction is not None and cut != "one":
        dataset = mask_out(dataset, seed=config.seed, **config.masking)
    if config.window is not None or config.window_s is not None:
        other: Cut = "consecutive" if cut == "random" else cut
        dataset, owners = owned_windows(
            dataset,
            config.window,
            seconds=config.window_s,
            cuts=[cut if i in index_of[0] else other for i in range(len(dataset))],
            count=config.window_count,
            seed=config.seed,
        )
    if config.observed_fraction is not None and cut == "one":
        dataset = mask_out(dataset, seed=config.seed, **config.masking)
    train, validation, test = (
        dataset.take(np.flatnonzero(np.isin(owners, index))) for index in index_of
    )
    return train, validation, test


def _drawn(count: int, fractions: Sequence[float], seed: int) -> list[NDArray[np.int64]]:
    """Positions of the trajectories of each part."""
    ends = _ends(count, fractions)
    starts = np.concatenate([[0], ends[:-1]])
    if (ends <= starts).any():
        raise InputError(
            f"{count} trajectories are too few for the fractions {list(fractions)}: a part "
            "would be empty; use more trajectories or fewer parts, or split a long recording with "
            "split_in_blocks (by='blocks') or split_in_time (by='time')"
        )
    order = np.random.default_rng(seed).permutation(count)
    return [np.sort(order[start:end]) for start, end in zip(starts, ends, strict=True)]


def _ends(count: int, fractions: Sequence[float]) -> NDArray[np.int64]:
    parts = np.asarray(fractions, dtype=float)
    if parts.ndim != 1 or not (parts > 0).all() or not abs(parts.sum() - 1) <= 1e-9:
        raise InputError(f"fractions must be positive and sum to 1, got {list(fractions)}")
    return np.floor(np.cumsum(parts) * count + 0.5).astype(np.int64)


def save_split(path: str | Path, config: SplitConfig, dataset: Dataset) -> None:
    """Saves how a data set was split, for `load_split`.

    Args:
        path: JSON file to write.
        config: as given to `apply_split`.
        dataset: as given to `apply_split`.
    """
    write_json(path, {**asdict(config), "data": dataset.fingerprint()})


def load_split(path: str | Path, dataset: Dataset) -> tuple[Dataset, Dataset, Dataset] | None:
    """Repeats a saved split.

    Args:
        path: JSON file that `save_split` wrote; where it is missing, `parts.json` in its folder,
            which Offbeat 0.1.0 wrote.
        dataset: as recorded.

    Returns:
        Training, validation and test part, or None if the file is missing or was written for other
        data.

    Raises:
        FileFormatError: the file is damaged.
    """
    path = Path(path)
    if not path.is_file():
        path = path.with_name("parts.json")
    if not path.is_file():
        return None
    try:
        kept = read_json(path)
        old = "hide" in kept
        if kept.pop("data") != dataset.fingerprint(version=1 if old else 2):
            return None
        return apply_split(dataset, from_mapping(SplitConfig, _renamed(kept) if old else kept))
    except (AttributeError, KeyError, OverflowError, TypeError, ValueError) as error:
        raise FileFormatError(f"{path} is damaged ({str(error)[:150]}); train again") from None


def _renamed(kept: Mapping[str, Any]) -> dict[str, Any]:
    """The options of a split in the names of this version, from those of Offbeat 0.1.0."""
    kept = dict(kept)
    mask, by = kept.pop("hide"), kept.pop("split")
    return kept | {
        "mask": {"cells": "values"}.get(mask, mask),
        "by": {"by_trajectory": "trajectory", "in_time": "time"}[by],
    }
