"""NPZ of NumPy: one array of values, with its times, masks and intervals."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from offbeat.data.trajectory import Dataset
from offbeat.data.writers.described import clocks, interval, labels
from offbeat.files import atomic_path


def write_npz(dataset: Dataset, path: str | Path, *, level: float = 0.9) -> None:
    """Writes a data set as arrays, the trajectories one after the other.

    `trajectory` (rows,) labels, `time` (rows,) s, `values` (rows, channels), `names`, `units` and
    `roles` (channels,), `observed` (rows, channels) bool; for answers with intervals `low` and
    `high` (rows, channels); where the clock of the log is known `clock_ns` (rows,) nanoseconds.

    Args:
        dataset: any.
        path: the file.
        level: probability of the intervals.

    Raises:
        OSError: the file cannot be written.
    """
    rows = [t.rows for t in dataset]
    arrays: dict[str, NDArray[Any]] = {
        "trajectory": np.repeat(np.array(labels(dataset)), rows),
        "time": np.concatenate([t.times for t in dataset]),
        "values": np.concatenate([t.values for t in dataset]),
        "names": np.array(dataset.names),
        "units": np.array(dataset.units),
        "roles": np.array(dataset.roles),
        "observed": np.concatenate([t.observed for t in dataset]),
    }
    ends = [interval(t, level) for t in dataset]
    found = [end for end in ends if end is not None]
    if len(found) == len(ends):
        arrays["low"] = np.concatenate([low for low, _ in found])
        arrays["high"] = np.concatenate([high for _, high in found])
    if "clock_start" in dataset.meta:
        arrays["clock_ns"] = np.concatenate(clocks(dataset))
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        np.savez_compressed(file, **arrays)  # type: ignore[arg-type]
