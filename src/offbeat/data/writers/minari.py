"""The folder of a Minari data set in HDF5, through `h5py`: an episode per trajectory.

The layout (minari.farama.org, "Dataset standards"): `data/main_data.hdf5` with
`episode_0/observations`, one row longer than `actions`, `rewards`, `terminations` and
`truncations`, and `infos` as long as the observations; `data/metadata.json` describes the spaces.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from offbeat.data.trajectory import Dataset
from offbeat.data.writers.described import clocks, interval, states_and_actions
from offbeat.data.writers.robomimic import write_named
from offbeat.errors import InputError, require
from offbeat.files import atomic_folder


def write_minari(dataset: Dataset, path: str | Path, *, level: float = 0.9) -> None:
    """Writes the folder of a Minari data set, `PATH/data/main_data.hdf5` and its metadata.

    `minari.MinariDataset(PATH / "data")` reads it. Observations are one array, whose attribute
    `names` describes its columns. `infos` holds `time_ns` (rows,), the true stamps, `observed`
    (rows, channels) bool and, for answers with intervals, `low` and `high`. An action of the last
    row, which nothing follows, is left out, as the layout has no place for it; rewards are 0.

    Args:
        dataset: trajectories of at least two rows.
        path: the folder to write; a Minari data set that is there is replaced.
        level: probability of the intervals.

    Raises:
        InputError: there are only actions, a trajectory has one row, or there is another folder
            at `path`.
        MissingExtraError: `h5py` is not installed.
        OSError: the folder cannot be written.
    """
    h5py: Any = require("h5py", "hdf5")
    path = Path(path)
    states, acted = states_and_actions(dataset)
    short = next((i for i, t in enumerate(dataset) if t.rows < 2), None)
    if short is not None:
        raise InputError(
            f"trajectory {short} has one row, and an episode of Minari needs two; leave it out"
        )
    if path.is_dir() and any(path.iterdir()) and not (path / "data" / "metadata.json").is_file():
        raise InputError(f"{path} holds other files, and no Minari data set; give another folder")
    every = [*states, *acted]
    stamps = clocks(dataset)
    with atomic_folder(path) as folder:
        (folder / "data").mkdir()
        main = folder / "data" / "main_data.hdf5"
        with h5py.File(main, "w", track_order=True, locking=False) as file:
            for i, trajectory in enumerate(dataset):
                steps = trajectory.rows - 1
                group = file.create_group(f"episode_{i}")
                group.attrs["id"], group.attrs["total_steps"] = i, steps
                write_named(group, "observations", trajectory.values[:, states], dataset, states)
                write_named(group, "actions", trajectory.values[:-1, acted], dataset, acted)
                group["rewards"] = np.zeros(steps)
                group["terminations"] = np.zeros(steps, dtype=bool)
                group["truncations"] = np.arange(steps) == steps - 1
                infos = group.create_group("infos")
                infos["time_ns"] = stamps[i]
                write_named(infos, "observed", trajectory.observed[:, every], dataset, every)
                ends = interval(trajectory, level)
                for name, end in zip(("low", "high"), ends or (), strict=False):
                    write_named(infos, name, end[:, every], dataset, every)
        said = {
            "dataset_id": f"{path.name}-v0",
            "data_format": "hdf5",
            "minari_version": "0.5.4",
            "total_episodes": len(dataset),
            "total_steps": sum(t.rows - 1 for t in dataset),
            "dataset_size": round(main.stat().st_size / 1e6, 3),
            "observation_space": _box(len(states)),
            "action_space": _box(len(acted)),
            "description": f"Written by Offbeat from {dataset.meta.get('source', 'a log')}.",
        }
        text = json.dumps(said, indent=2)
        (folder / "data" / "metadata.json").write_text(text, encoding="utf-8")


def _box(width: int) -> str:
    """The unbounded space of `width` numbers, as Minari writes it: JSON in a text."""
    bounds = {"low": [-np.inf] * width, "high": [np.inf] * width}
    return json.dumps({"type": "Box", "dtype": "float64", "shape": [width], **bounds})
