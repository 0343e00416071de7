"""LeRobot data sets, versions 2.0, 2.1 and 3.0, by pyarrow alone: a recording per episode.

The layout (huggingface.co/docs/lerobot, "LeRobotDataset v3.0"): `meta/info.json` names the
features, the rate and the pattern of the files' names. Version 2 has a Parquet file per episode and
`meta/episodes.jsonl`; version 3 packs episodes into files, and `meta/episodes/*/*.parquet` says
which file each one is in.

LeRobot itself writes row number / fps into `timestamp`. Where a data set brings stamps of its own,
in `timestamp` or in another column, those are taken; else the rows are on a grid, and that is said.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from offbeat.data.clock import state_time_unit, time_column_of, to_nanoseconds
from offbeat.data.signals import Recording, Signal
from offbeat.data.source import require_file
from offbeat.errors import FileFormatError, one_of

WIDEST = 1024
"""Numbers per row from which on a feature is taken for a picture or a cloud, and left out."""

_BOOKKEEPING = ("timestamp", "frame_index", "episode_index", "index", "task_index")
_BESIDE = ("next.", "action", "annotation.", "complementary_info", "task", "subtask", "language")
_NUMBERS = re.compile(r"(u?int|float|bool)\d*")


def root_of(path: Path) -> Path | None:
    """The folder of the data set that a path belongs to, or None."""
    path = path.absolute()
    for folder in (path, *path.parents[:4]):
        if (folder / "meta" / "info.json").is_file():
            return folder
    return None


def recognises(path: Path) -> bool:
    """Whether a path is a LeRobot data set, its `info.json`, or a Parquet file of its data."""
    root = root_of(path)
    if root is None:
        return False
    inside = path.absolute().relative_to(root)
    return path.is_dir() or inside.parts[0] == "data" or path.name == "info.json"


def recordings(
    path: str | Path,
    *,
    episodes: Sequence[int] | None = None,
    columns: Sequence[str] | None = None,
    actions: bool = True,
    time_column: str | None = None,
    time_unit: str | None = None,
) -> Iterator[Recording]:
    """Reads a LeRobot data set: a recording per episode, in the order of their numbers.

    Args:
        path: the folder of the data set, its `meta/info.json`, or one Parquet file of its data,
            whose episodes alone are then read.
        episodes: numbers of the episodes to read; by default all.
        columns: features to read as channels, such as `observation.state`; by default all that
            are numbers, but for actions, rewards and bookkeeping.
        actions: whether the feature `action` (or `actions`) is read, too.
        time_column: column of the stamps; by default one that is named like a time and is no mere
            row number / fps, else row number / fps.
        time_unit: unit of that column; by default what its name says, else found.

    Yields:
        Recordings. Channels are named as `info.json` names them, after their feature where there
        are several.

    Raises:
        FileFormatError: a file is missing, truncated, a Git LFS pointer, or not what `info.json`
            says.
        InputError: an episode, column or unit is unknown.
    """
    path = Path(path)
    root = root_of(path)
    if root is None:
        raise FileFormatError(f"{path} is no LeRobot data set, there is no meta/info.json above it")
    info = _Info.of(root)
    files = info.episode_files()
    if path.suffix == ".parquet":
        files = {n: at for n, at in files.items() if at.file == path.absolute()}
        if not files:
            raise FileFormatError(f"{path} is named by no episode in {root / 'meta'}")
    if episodes is not None:
        for number in episodes:
            one_of("episode", str(number), map(str, files))
        files = {number: files[number] for number in sorted(set(episodes))}
    chosen, notes = info.chosen(columns)
    acted = (
        [f for f in info.features.values() if f.name in ("action", "actions")] if actions else []
    )
    reading = _Reading(info, chosen, acted, time_column, time_unit, tuple(notes))
    for number, at in files.items():
        yield reading.recording(number, at)


@dataclass(frozen=True)
class _Feature:
    """A feature as `info.json` describes it."""

    name: str
    dtype: str
    shape: tuple[int, ...]
    labels: tuple[str, ...]

    @property
    def width(self) -> int:
        return int(np.prod(self.shape))

    @property
    def is_number(self) -> bool:
        return _NUMBERS.fullmatch(self.dtype) is not None

    @property
    def is_time(self) -> bool:
        """Whether it is named like a time, `timestamp` or `observation.time_ns`."""
        last = self.name.rpartition(".")[2]
        return self.is_number and self.width == 1 and time_column_of([last]) is not None

    def channels(self, *, alone: bool) -> list[str]:
        """A name per number; after the feature's where others are read, too."""
        if self.labels:
            return list(self.labels) if alone else [f"{self.name}.{label}" for label in self.labels]
        if self.width == 1:
            return [self.name]
        return [f"{self.name}[{i}]" for i in range(self.width)]


@dataclass(frozen=True)
class _Rows:
    """Where an episode is: a file, and how many rows it has there."""

    file: Path
    length: int | None


@dataclass(frozen=True)
class _Info:
    """`meta/info.json`."""

    root: Path
    version: str
    fps: float
    features: dict[str, _Feature]
    data_path: str
    total: int
    chunk: int

    @classmethod
    def of(cls, root: Path) -> _Info:
        """Reads and checks it."""
        path = require_file(root / "meta" / "info.json")
        try:
            said = json.loads(path.read_text(encoding="utf-8"))
            features = {
                name: _Feature(
                    name,
                    str(feature["dtype"]),
                    tuple(int(n) for n in feature.get("shape") or (1,)),
                    _labels(feature),
                )
                for name, feature in said["features"].items()
            }
            version, fps = str(said["codebase_version"]), float(said["fps"])
            data_path = str(said["data_path"])
            total, chunk = int(said["total_episodes"]), int(said.get("chunks_size", 1000))
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise FileFormatError(
                f"{path} is not the info.json of a LeRobot data set ({error!r}); download it again"
            ) from None
        if not re.match(r"v[23]\.", version):
            raise FileFormatError(
                f"{path} is of version {version}, expected v2.0, v2.1 or v3.0; convert it with "
                "LeRobot"
            )
        if not fps > 0 or not features:
            raise FileFormatError(
                f"{path} says {fps:g} fps and {len(features)} features, expected some"
            )
        return cls(root, version, fps, features, data_path, total, chunk)

    def chosen(self, columns: Sequence[str] | None) -> tuple[list[_Feature], list[str]]:
        """The features that become channels, and what is to be said about others."""
        if columns is not None:
            for name in columns:
                one_of("column", name, [f.name for f in self.features.values() if f.is_number])
            return [self.features[name] for name in dict.fromkeys(columns)], []
        chosen, left = [], []
        for feature in self.features.values():
            if feature.name in _BOOKKEEPING or feature.name.startswith(_BESIDE):
                continue
            if feature.is_number and feature.width <= WIDEST and len(feature.shape) < 3:
                if not feature.is_time:
                    chosen.append(feature)
            else:
                left.append(f"{feature.name} ({feature.dtype})")
        if not chosen:
            raise FileFormatError(
                f"{self.root} has no features that are numbers but actions and bookkeeping; "
                f"choose with columns= from: {', '.join(self.features)}"
            )
        return chosen, [f"left out: {', '.join(left)}"] if left else []

    def episode_files(self) -> dict[int, _Rows]:
        """The file of each episode, by its number."""
        return self._packed() if self.version.startswith("v3") else self._one_each()

    def _one_each(self) -> dict[int, _Rows]:
        lengths: dict[int, int] = {}
        path = self.root / "meta" / "episodes.jsonl"
        if path.is_file():
            try:
                for line in require_file(path).read_text(encoding="utf-8").splitlines():
                    if line.strip():
                        said = json.loads(line)
                        lengths[int(said["episode_index"])] = int(said["length"])
            except (KeyError, TypeError, ValueError) as error:
                raise FileFormatError(f"{path} is damaged ({error!r}); download it again") from None
        return {
            number: _Rows(
                self._file(
                    episode_chunk=number // self.chunk,
                    episode_index=number,
                    total_episodes=self.total,
                ),
                lengths.get(number),
            )
            for number in sorted(lengths) or range(self.total)
        }

    def _packed(self) -> dict[int, _Rows]:
        paths = sorted((self.root / "meta" / "episodes").glob("**/*.parquet"))
        if not paths:
            raise FileFormatError(
                f"{self.root / 'meta' / 'episodes'} holds no Parquet files, which say where each "
                "episode is; download them, or finish the recording with finalize()"
            )
        names = ["episode_index", "length", "data/chunk_index", "data/file_index"]
        found: dict[int, _Rows] = {}
        for path in paths:
            table = _read(path, names)
            for number, length, chunk, file in zip(
                *(table.column(name).to_pylist() for name in names), strict=True
            ):
                found[int(number)] = _Rows(self._file(chunk_index=chunk, file_index=file), length)
        return dict(sorted(found.items()))

    def _file(self, **numbers: Any) -> Path:
        try:
            return self.root / self.data_path.format(**numbers)
        except (KeyError, ValueError, IndexError) as error:
            raise FileFormatError(
                f"{self.root}: the pattern {self.data_path!r} in meta/info.json can't be filled "
                f"({error!r})"
            ) from None


def _labels(feature: dict[str, Any]) -> tuple[str, ...]:
    """One name per number, unique, or none where `names` says something else, such as axes."""
    names = feature.get("names")
    if isinstance(names, dict):  # {"motors": [...]}; in others, a name and its place
        values = list(names.values())
        names = list(names) if all(isinstance(v, int) for v in values) else values
    while isinstance(names, list) and len(names) == 1 and isinstance(names[0], list):
        names = names[0]
    if isinstance(names, list) and names and all(isinstance(part, list) for part in names):
        names = [name for part in names for name in part]
    width = int(np.prod(feature.get("shape") or (1,)))
    if not isinstance(names, list) or len(names) != width or width == 1:
        return ()
    labels = [str(name) for name in names]
    return tuple(
        label if labels.count(label) == 1 else f"{label}[{labels[:i].count(label)}]"
        for i, label in enumerate(labels)
    )


def _read(path: Path, columns: list[str]) -> Any:
    """Some columns of a Parquet file."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    path = require_file(path)
    try:
        with pq.ParquetFile(path) as file:
            missing = [name for name in columns if name not in file.schema_arrow.names]
            if missing:
                raise FileFormatError(
                    f"{path} has no column {missing[0]!r}, expected as meta/info.json says; it "
                    f"has: {', '.join(file.schema_arrow.names)}"
                )
            return file.read(columns=columns)
    except (pa.ArrowException, OSError, UnicodeDecodeError) as error:
        raise FileFormatError(
            f"{path} can't be read as Parquet, it is truncated, damaged or of another format "
            f"({' '.join(str(error).split())}); download it again"
        ) from None


class _Reading:
    """Reads episodes one after the other; holds one file at a time."""

    def __init__(
        self,
        info: _Info,
        chosen: list[_Feature],
        acted: list[_Feature],
        time_column: str | None,
        time_unit: str | None,
        notes: tuple[str, ...],
    ) -> None:
        self.info = info
        self.chosen = chosen
        self.acted = acted
        self.time_unit = time_unit
        self.notes = notes
        self.given = time_column
        if time_column is not None:
            one_of("time_column", time_column, info.features)
            self.clocks = [time_column]
        else:  # stamps of their own come before LeRobot's
            named = [f.name for f in info.features.values() if f.is_time]
            self.clocks = sorted(named, key=lambda name: name == "timestamp")
        self.path: Path | None = None
        self.table: Any = None

    def recording(self, number: int, at: _Rows) -> Recording:
        """One episode."""
        if at.file != self.path:
            names = dict.fromkeys(
                [*self.clocks, "episode_index"] + [f.name for f in (*self.chosen, *self.acted)]
            )
            self.table, self.path = _read(at.file, list(names)), at.file
            self.index = _column(self.table, "episode_index", 1, at.file)[:, 0]
        rows = np.flatnonzero(self.index == number)
        if not len(rows) or at.length not in (None, len(rows)):
            expected = "some" if at.length is None else at.length
            raise FileFormatError(
                f"{at.file} holds {len(rows)} rows of episode {number}, expected {expected}; "
                "download it again"
            )
        episode = self.table.slice(int(rows[0]), int(rows[-1] - rows[0]) + 1)
        if episode.num_rows != len(rows):
            raise FileFormatError(f"{at.file}: the rows of episode {number} do not stand together")
        stamps, zero, unit, said = self._stamps(episode, at.file)
        alone = len(self.chosen) == 1
        channels = [name for f in self.chosen for name in f.channels(alone=alone)]
        signal = Signal("", stamps, _matrix(episode, self.chosen, at.file), tuple(channels))
        actions = None
        if self.acted:
            actions = Signal(
                "action",
                stamps,
                _matrix(episode, self.acted, at.file),
                tuple(name for f in self.acted for name in f.channels(alone=True)),
            )
        return Recording(
            (signal,),
            label=str(number),
            origin=f"{self.info.root.name}, episode {number}",
            time_unit=unit,
            notes=(*said, *self.notes),
            clock_zero=zero,
            actions=actions,
        )

    def _stamps(
        self, episode: Any, file: Path
    ) -> tuple[NDArray[np.int64], int, str, tuple[str, ...]]:
        """Nanoseconds, the clock at nanosecond 0, the column's unit, and what is to be said."""
        fps = self.info.fps
        grid = np.rint(np.arange(episode.num_rows) * (1e9 / fps)).astype(np.int64)
        for name in self.clocks:
            clock = _raw(episode, name, file)
            unit = "s"
            said: tuple[str, ...] = ()
            if name != "timestamp" or self.time_unit is not None:
                unit, said = state_time_unit(
                    self.time_unit, name.rpartition(".")[2], clock, str(file)
                )
            stamps, zero = to_nanoseconds(clock, unit)
            # LeRobot's own are float32: within a microsecond, or a millionth of them, is the grid.
            near = 1_000 + grid // 1_000_000
            if self.given is None and (np.abs(stamps - stamps[:1] - grid) <= near).all():
                continue
            return stamps, zero, unit, (f"stamps are the column {name!r}", *said)
        return grid, 0, "s", (f"stamps are row number / {fps:g} fps, no times were recorded",)


def _raw(table: Any, name: str, file: Path) -> NDArray[Any]:
    """A column of one number per row, in its own type, so that an integer clock keeps its bits."""
    import pyarrow as pa

    column = table.column(name).combine_chunks()
    while _is_list(column.type):
        column = column.flatten()
    if pa.types.is_timestamp(column.type):
        column = column.cast(pa.timestamp("ns")).cast(pa.int64())
    if column.null_count or len(column) != table.num_rows:
        raise FileFormatError(f"{file} has rows without a time in column {name!r}; name another")
    values: NDArray[Any] = column.to_numpy(zero_copy_only=False)
    if values.dtype.kind not in "iuf":
        raise FileFormatError(f"{file} has {column.type} in column {name!r}, expected times")
    return values


def _is_list(kind: Any) -> bool:
    import pyarrow as pa

    return bool(
        pa.types.is_list(kind) or pa.types.is_large_list(kind) or pa.types.is_fixed_size_list(kind)
    )


def _matrix(table: Any, features: list[_Feature], file: Path) -> NDArray[np.float64]:
    """(rows, numbers) the columns of some features, side by side."""
    values = np.empty((table.num_rows, sum(f.width for f in features)), order="F")
    first = 0
    for feature in features:
        last = first + feature.width
        values[:, first:last] = _column(table, feature.name, feature.width, file)
        first = last
    return values


def _column(table: Any, name: str, width: int, file: Path) -> NDArray[np.float64]:
    """(rows, width) a column of numbers or of lists of them, NaN where there is none."""
    import pyarrow as pa

    column = table.column(name).combine_chunks()
    while _is_list(column.type):
        column = column.flatten()
    numeric = pa.types.is_integer(column.type) or pa.types.is_floating(column.type)
    if pa.types.is_boolean(column.type):
        column, numeric = column.cast(pa.uint8()), True
    if not numeric:
        raise FileFormatError(f"{file} has {column.type} in column {name!r}, expected numbers")
    if len(column) != table.num_rows * width:
        raise FileFormatError(
            f"{file} has {len(column)} numbers in column {name!r}, expected {width} in each of its "
            f"{table.num_rows} rows, as meta/info.json says"
        )
    numbers = column.cast(pa.float64()).to_numpy(zero_copy_only=False)
    return np.asarray(numbers, dtype=np.float64).reshape(table.num_rows, width)
