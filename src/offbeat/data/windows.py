"""Windows of consecutive rows, in rows or in seconds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from offbeat.config import CUTS
from offbeat.data.trajectory import Dataset, Trajectory
from offbeat.errors import InputError, one_of

Cut = Literal["one", "consecutive", "random"]


def windows(
    dataset: Dataset,
    length: int | None = None,
    *,
    seconds: float | None = None,
    cut: Cut = "one",
    count: int | None = None,
    seed: int = 0,
) -> Dataset:
    """Cuts windows of consecutive rows out of each trajectory.

    - `one` window per trajectory, its start drawn uniformly.
    - `consecutive` windows, one after the other. The remainder at the end joins the last window if
      it is shorter than half a window, and is a separate window otherwise.
    - `random` windows, the start of each drawn uniformly; they may overlap.

    A trajectory shorter than a window raises an error for `one`, and is a window for the others.

    Args:
        dataset: trajectories to cut.
        length: rows of a window; this or `seconds`.
        seconds: s, length of a window: its rows are within that time from its first row on.
        cut: `one`, `consecutive` or `random`.
        count: windows that `random` draws from each trajectory; by default as many as have the
            length of the trajectory together.
        seed: of the random starts.

    Returns:
        The windows, in the order of their trajectories, with unchanged times.

    Raises:
        InputError: a length is not above 0, both or none are given, or a trajectory is too short.
    """
    dataset = Dataset.of(dataset)
    cuts = [cut] * len(dataset)
    return owned_windows(dataset, length, seconds=seconds, cuts=cuts, count=count, seed=seed)[0]


def owned_windows(
    dataset: Dataset,
    length: int | None,
    *,
    seconds: float | None,
    cuts: Sequence[Cut],
    count: int | None,
    seed: int,
) -> tuple[Dataset, NDArray[np.int64]]:
    """As `windows`, with a cut per trajectory; also returns the trajectory of each window.

    Args:
        dataset: trajectories to cut.
        length: as of `windows`.
        seconds: as of `windows`.
        cuts: one per trajectory.
        count: as of `windows`.
        seed: of the random starts.

    Returns:
        The windows, and (windows,) the position of the trajectory that each is a part of.
    """
    if (length is None) == (seconds is None):
        raise InputError("give the length of a window in rows or in seconds, one of the two")
    if seconds is not None and not 0 < seconds < np.inf:
        raise InputError(f"a window must have a positive number of seconds, got {seconds!r}")
    span = _Span(length, seconds or 0.0)
    random = np.random.default_rng(seed)
    pieces, owners = [], []
    for i, (trajectory, cut) in enumerate(zip(dataset, cuts, strict=True)):
        one_of("cut", cut, CUTS)
        for start, stop in _spans(trajectory, span, cut, count, random, i):
            pieces.append(trajectory.slice(start, stop))
            owners.append(i)
    key = "window" if length is not None else "window_s"
    return Dataset(tuple(pieces), {**dataset.meta, key: length or seconds}), np.array(owners)


@dataclass(frozen=True)
class _Span:
    """The length of a window, in rows or in seconds."""

    rows: int | None
    seconds: float

    def ends(self, times: NDArray[np.float64]) -> NDArray[np.int64]:
        """(rows,) the end of a window that starts at each row; may be beyond the last row."""
        if self.rows is not None:
            return np.arange(len(times)) + self.rows
        # With a tolerance: a window of 1 s has 200 rows on a grid of 5 ms.
        return np.asarray(np.searchsorted(times, times + self.seconds * (1 - 1e-9)))

    def fits(self, times: NDArray[np.float64]) -> NDArray[np.int64]:
        """Rows at which a whole window can start."""
        if self.rows is not None:
            return np.arange(max(len(times) - self.rows + 1, 0))
        typical = float(np.median(np.diff(times))) if len(times) > 1 else 0.0
        length = self.seconds * (1 - 1e-9)
        return np.flatnonzero(times + length <= times[-1] + typical)

    def __str__(self) -> str:
        return f"{self.rows} rows" if self.rows is not None else f"{self.seconds} s"


def _spans(
    trajectory: Trajectory,
    span: _Span,
    cut: Cut,
    count: int | None,
    random: np.random.Generator,
    number: int,
) -> list[tuple[int, int]]:
    """First row and end of each window of a trajectory."""
    times, rows = trajectory.times, trajectory.rows
    fits = span.fits(times)
    if span.rows is not None and (span.rows < 1 or (cut == "one" and not len(fits))):
        raise InputError(
            f"a window of {span} does not fit into trajectory {number} of {rows} rows; use a "
            f"length from 1 to {rows}"
        )
    if cut == "one" and not len(fits):
        raise InputError(
            f"a window of {span} does not fit into trajectory {number} of "
            f"{times[-1] - times[0]:.6g} s; use a shorter one, or cut 'consecutive'"
        )
    ends = np.minimum(span.ends(times), rows)
    if cut == "one":
        start = int(fits[random.integers(0, len(fits))])
        return [(start, int(ends[start]))]
    if cut == "random" and len(fits):
        whole = rows / span.rows if span.rows else (times[-1] - times[0]) / span.seconds
        drawn = np.sort(random.choice(fits, size=count or max(int(np.ceil(whole)), 1)))
        return [(int(start), int(ends[start])) for start in drawn]
    spans = [(0, int(ends[0]))]
    while spans[-1][1] < rows:
        start = spans[-1][1]
        spans.append((start, int(ends[start])))
    start, stop = spans[-1]
    left = stop - start if span.rows else times[-1] - times[start]
    if len(spans) > 1 and left < (span.rows or span.seconds) / 2:
        spans[-2:] = [(spans[-2][0], stop)]
    return spans
