"""The metadata of a LeRobot data set: features, files, episodes."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from offbeat.data.cleaning.clocks import time_column_of
from offbeat.data.readers.options import names
from offbeat.data.source import require_file
from offbeat.errors import FileFormatError, one_of

WIDEST = 1024
"""Features with at least this many numbers per row are treated as images and left out."""

_BOOKKEEPING = ("timestamp", "frame_index", "episode_index", "index", "task_index")
_BESIDE = ("next.", "action", "annotation.", "complementary_info", "task", "subtask", "language")
_NUMBERS = re.compile(r"(u?int|float|bool)\d*")


@dataclass(frozen=True)
class Feature:
    """A feature of `info.json`."""

    name: str
    dtype: str
    shape: tuple[int, ...]
    labels: tuple[str, ...]

    @property
    def width(self) -> int:
        """Numbers per row."""
        return int(np.prod(self.shape))

    @property
    def is_number(self) -> bool:
        """Whether it is numeric, and not text, images or videos."""
        return _NUMBERS.fullmatch(self.dtype) is not None

    @property
    def role(self) -> str:
        """`action` for commands, by its name; else `state`."""
        acted = self.name in ("action", "actions") or self.name.startswith("action.")
        return "action" if acted and self.is_number else "state"

    @property
    def is_time(self) -> bool:
        """Whether it is named like a time, `timestamp` or `observation.time_ns`."""
        last = self.name.rpartition(".")[2]
        return self.is_number and self.width == 1 and time_column_of([last]) is not None

    def channels(self, *, alone: bool) -> list[str]:
        """A name per number, with the feature's name as a prefix if others are read."""
        if self.labels:
            return list(self.labels) if alone else [f"{self.name}.{label}" for label in self.labels]
        if self.width == 1:
            return [self.name]
        return [f"{self.name}[{i}]" for i in range(self.width)]


@dataclass(frozen=True)
class Rows:
    """The location of an episode: a file, and its number of rows there."""

    file: Path
    length: int | None


@dataclass(frozen=True)
class Info:
    """`meta/info.json`."""

    root: Path
    version: str
    fps: float
    features: dict[str, Feature]
    data_path: str
    total: int
    chunk: int

    @classmethod
    def of(cls, root: Path) -> Info:
        """Reads and checks the metadata."""
        path = require_file(root / "meta" / "info.json")
        try:
            found = json.loads(path.read_text(encoding="utf-8"))
            features = {
                name: Feature(
                    name,
                    str(feature["dtype"]),
                    tuple(int(n) for n in feature.get("shape") or (1,)),
                    _labels(feature),
                )
                for name, feature in found["features"].items()
            }
            version, fps = str(found["codebase_version"]), float(found["fps"])
            data_path = str(found["data_path"])
            total, chunk = int(found["total_episodes"]), int(found.get("chunks_size", 1000))
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

    def chosen(self, columns: Sequence[str] | None) -> tuple[list[Feature], list[str]]:
        """The features that become channels, and notes on the others."""
        listed = names("columns", columns)
        if listed is not None:
            for name in listed:
                one_of("column", name, [f.name for f in self.features.values() if f.is_number])
            return [self.features[name] for name in listed], []
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

    def episode_files(self) -> dict[int, Rows]:
        """The file of each episode, by its number."""
        return self._packed() if self.version.startswith("v3") else self._one_each()

    def _one_each(self) -> dict[int, Rows]:
        lengths: dict[int, int] = {}
        path = self.root / "meta" / "episodes.jsonl"
        if path.is_file():
            try:
                for line in require_file(path).read_text(encoding="utf-8").splitlines():
                    if line.strip():
                        found = json.loads(line)
                        lengths[int(found["episode_index"])] = int(found["length"])
            except (KeyError, TypeError, ValueError) as error:
                raise FileFormatError(f"{path} is damaged ({error!r}); download it again") from None
        return {
            number: Rows(
                self._file(
                    episode_chunk=number // self.chunk,
                    episode_index=number,
                    total_episodes=self.total,
                ),
                lengths.get(number),
            )
            for number in sorted(lengths) or range(self.total)
        }

    def _packed(self) -> dict[int, Rows]:
        paths = sorted((self.root / "meta" / "episodes").glob("**/*.parquet"))
        if not paths:
            raise FileFormatError(
                f"{self.root / 'meta' / 'episodes'} holds no Parquet files, which say where each "
                "episode is; download them, or finish the recording with finalize()"
            )
        columns = ["episode_index", "length", "data/chunk_index", "data/file_index"]
        found: dict[int, Rows] = {}
        for path in paths:
            table = read_columns(path, columns)
            for number, length, chunk, file in zip(
                *(table.column(name).to_pylist() for name in columns), strict=True
            ):
                found[int(number)] = Rows(self._file(chunk_index=chunk, file_index=file), length)
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
    """One unique name per number, or none if `names` is something else, such as axes."""
    names = feature.get("names")
    if isinstance(names, dict):  # {"motors": [...]}; in others, a name and its position
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


def read_columns(path: Path, columns: list[str]) -> Any:
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
