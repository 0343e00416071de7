"""LeRobot data sets of version 3.0: Parquet files and metadata, by pyarrow alone.

The layout (huggingface.co/docs/lerobot, "LeRobotDataset v3.0"): `data/chunk-000/file-000.parquet`
with the rows of many episodes, `meta/info.json` with the features, `meta/stats.json`,
`meta/tasks.parquet` and `meta/episodes/chunk-000/file-000.parquet`.

LeRobot expects rows at a fixed rate: `timestamp` is row number / fps. The true stamps are in
`complementary_info.time_ns`. What was measured, and the intervals of what was not, are in
`complementary_info.observed`, `.low` and `.high`, which policies are not given.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from offbeat.data.trajectory import Dataset, Trajectory
from offbeat.data.writers.described import (
    as_names,
    checked_rate,
    clocks,
    interval,
    states_and_actions,
)
from offbeat.errors import InputError
from offbeat.files import atomic_folder

EXTRA = "complementary_info."
"""Prefix of the features that LeRobot's policies are not given."""

_FILE_BYTES = 100 * 2**20  # of a file of rows, about, as `data_files_size_in_mb` says
_FILES = 1000  # in a folder
_QUANTILES = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}

Columns = dict[str, NDArray[Any]]


def write_lerobot(
    dataset: Dataset,
    path: str | Path,
    *,
    rate_hz: float | None = None,
    task: str = "",
    level: float = 0.9,
) -> None:
    """Writes a LeRobot data set of version 3.0: an episode per trajectory.

    Channels with the role `action` are the feature `action`, all others `observation.state`, both
    in float32. Values that are not known are NaN.

    Args:
        dataset: at times of any spacing.
        path: the folder to write; a LeRobot data set that is there is replaced.
        rate_hz: rows per second that `info.json` states; by default one over the median time
            between rows.
        task: what the robot does, in words; by default the `task` of the meta, or the source.
        level: probability of the intervals.

    Raises:
        InputError: there are only actions, an option is out of range, or there is another folder
            at `path`.
        OSError: the folder cannot be written.
    """
    path = Path(path)
    if path.is_dir() and any(path.iterdir()) and not (path / "meta" / "info.json").is_file():
        raise InputError(f"{path} holds other files, and no LeRobot data set; give another folder")
    fps = checked_rate(dataset, rate_hz)
    states, acted = states_and_actions(dataset)
    task = task or str(dataset.meta.get("task") or dataset.meta.get("source") or "recorded motion")
    features = _features(dataset, states, acted)
    stamps = clocks(dataset)
    with atomic_folder(path) as folder:
        episodes: list[dict[str, Any]] = []
        whole: dict[str, list[NDArray[Any]]] = {}
        writer = _Rows(folder, features)
        index = 0
        for number, trajectory in enumerate(dataset):
            rows = trajectory.rows
            columns = _columns(trajectory, stamps[number], states, acted, level, features)
            columns |= {
                "timestamp": (np.arange(rows) / fps).astype(np.float32),
                "frame_index": np.arange(rows),
                "episode_index": np.full(rows, number),
                "index": np.arange(index, index + rows),
                "task_index": np.zeros(rows, dtype=np.int64),
            }
            chunk, file = writer.write(columns)
            episodes.append(
                {
                    "episode_index": number,
                    "tasks": [task],
                    "length": rows,
                    "data/chunk_index": chunk,
                    "data/file_index": file,
                    "dataset_from_index": index,
                    "dataset_to_index": index + rows,
                    **{
                        f"stats/{name}/{key}": value
                        for name, stats in _stats(columns).items()
                        for key, value in stats.items()
                    },
                    "meta/episodes/chunk_index": 0,
                    "meta/episodes/file_index": 0,
                }
            )
            index += rows
            for name, column in columns.items():
                whole.setdefault(name, []).append(column)
        writer.close()
        _write_meta(folder, dataset, features, fps, index, task, episodes)
        stats = _stats({name: np.concatenate(parts) for name, parts in whole.items()})
        _write_json(folder / "meta" / "stats.json", stats)


def _features(dataset: Dataset, states: list[int], acted: list[int]) -> dict[str, Any]:
    """The features of `info.json`."""

    def feature(dtype: str, names: list[str] | None) -> dict[str, Any]:
        return {"dtype": dtype, "shape": [len(names) if names else 1], "names": names}

    every = [dataset.names[i] for i in (*states, *acted)]
    features = {"observation.state": feature("float32", as_names(dataset, states))}
    if acted:
        features["action"] = feature("float32", as_names(dataset, acted, "action."))
    for name, index in (("observation.state", states), ("action", acted)):
        if any(dataset.units[i] for i in index):  # a key of Offbeat's own, which LeRobot keeps
            features[name]["units"] = [dataset.units[i] for i in index]
    features[f"{EXTRA}time_ns"] = feature("int64", None)
    features[f"{EXTRA}observed"] = feature("bool", every)
    if all(interval(t, 0.5) is not None for t in dataset):
        features |= {f"{EXTRA}{end}": feature("float32", every) for end in ("low", "high")}
    features["timestamp"] = feature("float32", None)
    for name in ("frame_index", "episode_index", "index", "task_index"):
        features[name] = feature("int64", None)
    return features


def _columns(
    trajectory: Trajectory,
    stamps: NDArray[np.int64],
    states: list[int],
    acted: list[int],
    level: float,
    features: dict[str, Any],
) -> Columns:
    """The columns of one episode, (rows, numbers) each."""
    with np.errstate(over="ignore"):
        values, every = trajectory.values.astype(np.float32), [*states, *acted]
    if np.isinf(values).any():
        channel = int(np.argwhere(np.isinf(values))[0, 1])
        raise InputError(
            f"LeRobot holds float32, and channel {trajectory.names[channel]!r} has values beyond "
            "3.4e38; write another format, or in another unit"
        )
    columns: Columns = {"observation.state": values[:, states]}
    if acted:
        columns["action"] = values[:, acted]
    columns[f"{EXTRA}time_ns"] = stamps
    columns[f"{EXTRA}observed"] = trajectory.observed[:, every]
    if f"{EXTRA}low" in features:
        ends = interval(trajectory, level)
        assert ends is not None
        for end, value in zip(("low", "high"), ends, strict=True):
            columns[f"{EXTRA}{end}"] = value[:, every].astype(np.float32)
    return columns


class _Rows:
    """Writes the rows of episodes, a row group for each, to files of a limited size."""

    def __init__(self, folder: Path, features: dict[str, Any]) -> None:
        import pyarrow as pa

        kinds = {"float32": pa.float32(), "int64": pa.int64(), "bool": pa.bool_()}
        self.folder = folder
        fields = []
        for name, feature in features.items():
            (width,), kind = feature["shape"], kinds[feature["dtype"]]
            # Features of one number are numbers, not lists, as in LeRobot.
            fields.append(pa.field(name, kind if width == 1 else pa.list_(kind, width)))
        self.schema = pa.schema(fields)
        self.number, self.bytes = -1, _FILE_BYTES
        self.writer: Any = None

    def write(self, columns: Columns) -> tuple[int, int]:
        """Writes an episode; returns the numbers of its folder and of its file in there."""
        import pyarrow as pa
        import pyarrow.parquet as pq

        if self.bytes >= _FILE_BYTES:
            self.close()
            self.number, self.bytes = self.number + 1, 0
            chunk, file = divmod(self.number, _FILES)
            path = self.folder / "data" / f"chunk-{chunk:03d}" / f"file-{file:03d}.parquet"
            path.parent.mkdir(parents=True, exist_ok=True)
            self.writer = pq.ParquetWriter(path, self.schema, compression="snappy")
        arrays = []
        for field in self.schema:
            column = columns[field.name]
            flat = pa.array(np.ascontiguousarray(column).reshape(-1))
            width = getattr(field.type, "list_size", 1)
            arrays.append(flat if width == 1 else pa.FixedSizeListArray.from_arrays(flat, width))
            self.bytes += column.nbytes
        self.writer.write_table(pa.Table.from_arrays(arrays, schema=self.schema))
        return divmod(self.number, _FILES)

    def close(self) -> None:
        """Ends the file that is being written."""
        if self.writer is not None:
            self.writer.close()


def _stats(columns: Columns) -> dict[str, dict[str, list[float]]]:
    """Statistics of each feature, of the values that are known; 0 where none is."""
    stats: dict[str, dict[str, list[float]]] = {}
    for name, column in columns.items():
        table = column.reshape(len(column), -1).astype(np.float64)
        empty = np.isnan(table).all(axis=0)
        table = np.where(empty, 0.0, table)
        found = {
            "min": np.nanmin(table, axis=0),
            "max": np.nanmax(table, axis=0),
            "mean": np.nanmean(table, axis=0),
            "std": np.nanstd(table, axis=0),
        }
        quantiles = np.nanquantile(table, list(_QUANTILES.values()), axis=0)
        found |= dict(zip(_QUANTILES, quantiles, strict=True))
        stats[name] = {key: value.tolist() for key, value in found.items()}
        stats[name]["count"] = [len(table)]
    return stats


def _write_meta(
    folder: Path,
    dataset: Dataset,
    features: dict[str, Any],
    fps: float,
    rows: int,
    task: str,
    episodes: list[dict[str, Any]],
) -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    meta = folder / "meta"
    (meta / "episodes" / "chunk-000").mkdir(parents=True)
    info = {
        "codebase_version": "v3.0",
        "robot_type": dataset.meta.get("robot"),
        "total_episodes": len(episodes),
        "total_frames": rows,
        "total_tasks": 1,
        "chunks_size": _FILES,
        "data_files_size_in_mb": _FILE_BYTES >> 20,
        "video_files_size_in_mb": 200,
        "fps": int(fps) if fps == int(fps) else fps,
        "splits": {"train": f"0:{len(episodes)}"},
        "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
        "video_path": None,
        "features": features,
    }
    _write_json(meta / "info.json", info)
    table = pa.Table.from_pylist(episodes)
    pq.write_table(table, meta / "episodes" / "chunk-000" / "file-000.parquet")
    pq.write_table(_tasks(task), meta / "tasks.parquet")


def _tasks(task: str) -> Any:
    """The tasks, with the column of texts marked as the index, as pandas does."""
    import pyarrow as pa

    def column(name: str, kind: str, numpy: str) -> dict[str, Any]:
        said = {"name": name, "field_name": name, "pandas_type": kind, "numpy_type": numpy}
        return {**said, "metadata": None}

    described = {
        "index_columns": ["task"],
        "column_indexes": [],
        "columns": [column("task_index", "int64", "int64"), column("task", "unicode", "object")],
        "pandas_version": "2.2.0",
    }
    table = pa.table({"task_index": pa.array([0], pa.int64()), "task": [task]})
    return table.replace_schema_metadata({"pandas": json.dumps(described)})


def _write_json(path: Path, value: Any) -> None:
    path.write_text(json.dumps(value, indent=4, allow_nan=False) + "\n", encoding="utf-8")
