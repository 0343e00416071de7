"""The metadata of a LeRobot data set: features, files, episodes."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from offbeat.data.cleaning.clocks import split_stamps, time_column_of
from offbeat.data.readers.options import names
from offbeat.data.readers.stamp_columns import columns_in
from offbeat.data.source import inside, read_json, require_file
from offbeat.errors import FileFormatError, InputError, listed, one_of

WIDEST = 1024
"""Features with at least this many numbers per row are treated as images and left out."""

_BOOKKEEPING = ("timestamp", "frame_index", "episode_index", "index", "task_index")
_BESIDE = ("next.", "annotation.", "complementary_info.")  # rewards, labels, and what is no state
_LONGEST_AXIS = 1 << 20
_NUMBERS = re.compile(r"(u?int|float|bool)\d*")


@dataclass(frozen=True)
class Feature:
    """A feature of `info.json`."""

    name: str
    dtype: str
    shape: tuple[int, ...]
    labels: tuple[str, ...]
    units: tuple[str, ...] = ()

    @property
    def width(self) -> int:
        """Numbers per row."""
        return math.prod(self.shape)

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
        path = root / "meta" / "info.json"
        found = read_json(path)
        try:
            features = {
                name: Feature(
                    name,
                    str(feature["dtype"]),
                    tuple(int(n) for n in feature.get("shape") or (1,)),
                    _labels(name, feature),
                    tuple(map(str, feature.get("units") or ())),
                )
                for name, feature in found["features"].items()
            }
            version, fps = str(found["codebase_version"]), float(found["fps"])
            data_path = str(found["data_path"])
            total, chunk = int(found["total_episodes"]), int(found.get("chunks_size", 1000))
        except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
            raise FileFormatError(
                f"{path} is not the info.json of a LeRobot data set ({str(error)[:100]!r}); "
                "download it again"
            ) from None
        if not re.match(r"v[23]\.", version):
            raise FileFormatError(
                f"{path} is of version {version}, expected v2.0, v2.1 or v3.0; convert it with "
                "LeRobot"
            )
        if not 0 < fps < 1e9 or not features or chunk < 1 or total < 0:
            raise FileFormatError(
                f"{path} says {fps:g} fps, {len(features)} features, {total} episodes and "
                f"{chunk} in a folder, expected some of each"
            )
        for feature in features.values():
            if not all(0 <= n <= _LONGEST_AXIS for n in feature.shape):
                raise FileFormatError(
                    f"{path} says that {feature.name[:60]!r} has shape {feature.shape[:4]}, "
                    f"expected sizes from 0 to {_LONGEST_AXIS}"
                )
        _check_pattern(data_path, path)
        return cls(root, version, fps, features, data_path, total, chunk)

    def chosen(self, columns: Sequence[str] | None) -> tuple[list[Feature], list[str]]:
        """The features that become channels, and notes on the others."""
        wanted = names("columns", columns)
        if wanted is not None:
            for name in wanted:
                one_of("column", name, [f.name for f in self.features.values() if f.is_number])
            return [self.features[name] for name in wanted], []
        chosen, left = [], []
        stamps = {name for pair in self._pairs() for name in pair}
        for feature in self.features.values():
            if feature.name in _BOOKKEEPING or feature.role == "action":
                continue
            if feature.name.startswith(_BESIDE) or feature.name in stamps:
                left.append(feature.name)
            elif feature.is_number and 0 < feature.width <= WIDEST and len(feature.shape) < 3:
                if not feature.is_time:
                    chosen.append(feature)
            else:
                left.append(f"{feature.name} ({feature.dtype})")
        if not chosen:
            raise FileFormatError(
                f"{self.root} has no features that are numbers but actions and bookkeeping; "
                f"choose with columns= from: {listed(list(self.features), 12, quoted=True)}"
            )
        return chosen, [f"left out unless chosen with columns=: {', '.join(left)}"] if left else []

    def clocks(self, given: str | Sequence[str] | None) -> list[tuple[str, ...]]:
        """The features that may hold the stamps, the best first; two hold one stamp together.

        Raises:
            FileFormatError: several pairs hold a stamp.
            InputError: those given are unknown, or hold no stamp together.
        """
        pairs = self._pairs()
        if given is not None:
            parts = columns_in(given, list(self.features))
            for part in parts:
                one_of("time_column", part, self.features)
            if len(parts) != 1 and parts not in pairs:
                raise InputError(
                    f"{self.root}: time_column must name one column, or two with whole seconds and "
                    f"what is left of each in ns, us or ms, got {listed(parts, quoted=True)}"
                )
            return [parts]
        named = [(f.name,) for f in self.features.values() if f.is_time]
        single = [clock for clock in named if not any(clock[0] in pair for pair in pairs)]
        measured = [clock for clock in single if clock != ("timestamp",)]
        if len(pairs) > 1 and not measured:
            raise FileFormatError(
                f"{self.root} has several stamps, each in two columns: "
                f"{listed([f'[{one}, {two}]' for one, two in pairs], 3)}; say which "
                "one is the time with time_column="
            )
        # measured stamps take precedence over LeRobot's
        return [*measured, *pairs[:1], *(clock for clock in single if clock not in measured)]

    def _pairs(self) -> list[tuple[str, str]]:
        """Pairs of features of integers that hold a stamp together, as `sec` and `nanosec`."""
        whole = [f.name for f in self.features.values() if f.width == 1 and "int" in f.dtype]
        return [(one, two) for one, two, _ in split_stamps(whole)]

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
            except (KeyError, TypeError, ValueError, OverflowError, RecursionError) as error:
                raise FileFormatError(
                    f"{path} is damaged ({str(error)[:100]!r}); download it again"
                ) from None
            if any(number < 0 or length < 0 for number, length in lengths.items()):
                raise FileFormatError(f"{path} holds a negative number; download it again")
        else:
            there = sum(1 for _ in self.root.glob("data/**/*.parquet"))
            if self.total > there:
                raise FileFormatError(
                    f"{self.root / 'meta' / 'info.json'} says {self.total} episodes, and there are "
                    f"{there} files of data; download the rest"
                )
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
                if not all(isinstance(n, int) and n >= 0 for n in (number, length, chunk, file)):
                    raise FileFormatError(
                        f"{path} has an episode {number!r} of {length!r} rows in chunk {chunk!r}, "
                        f"file {file!r}, expected numbers from 0; download it again"
                    )
                found[number] = Rows(self._file(chunk_index=chunk, file_index=file), length)
        return dict(sorted(found.items()))

    def _file(self, **numbers: Any) -> Path:
        where = self.root / "meta" / "info.json"
        try:
            name = self.data_path.format(**numbers)
        except (KeyError, ValueError, IndexError) as error:
            raise FileFormatError(
                f"{where}: the pattern {self.data_path[:100]!r} can't be filled ({error!r})"
            ) from None
        return inside(self.root, name, where)


_FIELD = re.compile(r"\{[a-z_]+(:0?\d{0,2}d?)?\}")


def _check_pattern(pattern: str, path: Path) -> None:
    """Raises an error for a pattern of file names with anything but numbers to fill in."""
    rest = _FIELD.sub("", pattern)
    if "{" in rest or "}" in rest or len(pattern) > 1000:
        raise FileFormatError(
            f"{path} has the pattern {pattern[:100]!r} of file names, expected one such as "
            "'data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet'"
        )


def _labels(feature_name: str, feature: dict[str, Any]) -> tuple[str, ...]:
    """One unique name per number, or none if `names` is something else, such as axes."""
    names = feature.get("names")
    if isinstance(names, dict):  # {"motors": [...]}; in others, a name and its position
        values = list(names.values())
        names = list(names) if all(isinstance(v, int) for v in values) else values
    while isinstance(names, list) and len(names) == 1 and isinstance(names[0], list):
        names = names[0]
    if isinstance(names, list) and names and all(isinstance(part, list) for part in names):
        names = [name for part in names for name in part]
    width = math.prod(int(n) for n in feature.get("shape") or (1,))
    if not isinstance(names, list) or len(names) != width:
        return ()
    if width == 1 and feature_name not in ("observation.state", "action"):
        return ()  # the feature itself has the name
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
                    f"{path} has no column {listed(missing, 1, quoted=True)}, expected as "
                    f"meta/info.json says; it has: {listed(file.schema_arrow.names)}"
                )
            return file.read(columns=columns)
    except FileFormatError:
        raise
    except (pa.ArrowException, OSError, ValueError) as error:
        raise FileFormatError(
            f"{path} can't be read as Parquet, it is truncated, damaged or of another format "
            f"({' '.join(str(error).split())[:120]}); download it again"
        ) from None
