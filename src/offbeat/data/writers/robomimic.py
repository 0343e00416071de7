"""HDF5 in the layout of robomimic, through `h5py`: a demonstration per trajectory.

The layout (robomimic.github.io, "Dataset structure"): `data/demo_0/obs/<name>`,
`data/demo_0/actions`, `rewards` and `dones`, a row per time, and the environment as JSON in the
attribute `env_args` of `data`.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from offbeat.data.trajectory import Dataset
from offbeat.data.writers.described import (
    checked_rate,
    clocks,
    interval,
    states_and_actions,
)
from offbeat.errors import require
from offbeat.files import atomic_path


def write_robomimic(
    dataset: Dataset, path: str | Path, *, rate_hz: float | None = None, level: float = 0.9
) -> None:
    """Writes HDF5 of robomimic: `data/demo_i/obs/state` and `data/demo_i/actions`.

    The attribute `names` of both, and `units` of the first, describe their columns. Beside them lie
    `time_ns` (rows,), the true stamps, `observed` (rows, channels) bool and, for answers with
    intervals, `low` and `high`, with states first and actions after them. robomimic ignores these.

    Args:
        dataset: at times of any spacing; without actions `actions` has no columns.
        path: the file.
        rate_hz: rows per second, the `control_freq` of the environment; by default one over the
            median time between rows.
        level: probability of the intervals.

    Raises:
        InputError: there are only actions, or an option is out of range.
        MissingExtraError: `h5py` is not installed.
        OSError: the file cannot be written.
    """
    h5py: Any = require("h5py", "hdf5")
    states, acted = states_and_actions(dataset)
    rate = checked_rate(dataset, rate_hz)
    stamps = clocks(dataset)
    source = str(dataset.meta.get("source", "log"))
    environment = {"env_name": source, "type": 2, "env_kwargs": {"control_freq": rate}}
    with atomic_path(path) as temporary, h5py.File(temporary, "w", locking=False) as file:
        data = file.create_group("data")
        data.attrs["total"] = sum(t.rows for t in dataset)
        data.attrs["env_args"] = json.dumps(environment)
        for i, trajectory in enumerate(dataset):
            group = data.create_group(f"demo_{i}")
            group.attrs["num_samples"] = trajectory.rows
            last = np.arange(trajectory.rows) == trajectory.rows - 1
            write_named(group, "obs/state", trajectory.values[:, states], dataset, states)
            write_named(group, "actions", trajectory.values[:, acted], dataset, acted)
            group["rewards"] = np.zeros(trajectory.rows)
            group["dones"] = last.astype(np.int64)
            group["time_ns"] = stamps[i]
            every = [*states, *acted]
            write_named(group, "observed", trajectory.observed[:, every], dataset, every)
            ends = interval(trajectory, level)
            for name, end in zip(("low", "high"), ends or (), strict=False):
                write_named(group, name, end[:, every], dataset, every)


def write_named(
    group: Any, name: str, values: NDArray[Any], dataset: Dataset, index: list[int]
) -> None:
    """Writes an array whose attributes `names` and `units` describe its columns.

    Args:
        group: of HDF5.
        name: of the array.
        values: (rows, columns).
        dataset: of these channels.
        index: position of the channel of each column.
    """
    array = group.create_dataset(name, data=values)
    array.attrs["names"] = [dataset.names[i] for i in index]
    array.attrs["units"] = [dataset.units[i] for i in index]
