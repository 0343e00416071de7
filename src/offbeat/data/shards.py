"""Data sets larger than memory: a folder of Parquet files, each of some trajectories.

Each file is one that `save` writes. Opening a folder reads the schemas and the lengths of the
trajectories; values are read file by file, when they are needed.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from offbeat.data.gaps import fastest_step_of, usual_gap
from offbeat.data.memory import require_rows, row_bytes
from offbeat.data.scaler import moments
from offbeat.data.schema import Schema
from offbeat.data.store import load, save
from offbeat.data.trajectory import Dataset, Trajectory
from offbeat.errors import FileFormatError, InputError

ROWS_PER_SHARD = 65_536
"""Rows of a file of `save_shards`, about."""

CACHE_MB = 256.0
"""MB of windows in memory at a time, by default."""

MOST_GAPS = 2**20
"""Gaps between rows that the median is taken of, at most."""

_BYTES_PER_VALUE = 6  # float32, and two masks
_FOOTER = 8  # length of the footer and magic number at the end of a Parquet file


def save_shards(
    trajectories: Iterable[Trajectory], folder: str | Path, *, rows: int = ROWS_PER_SHARD
) -> list[Path]:
    """Writes trajectories to files of a folder, which `Dataset.open` opens.

    Args:
        trajectories: of the same channels; taken one by one, so that they need not fit in memory.
        folder: made if it is missing; files that are there stay.
        rows: of a file, about: files of whole trajectories are written once they have as many.

    Returns:
        The files, `shard-000000.parquet` and so on.

    Raises:
        InputError: there is no trajectory, or channels differ within a file.
        OSError: a file can't be written.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    written: list[Path] = []
    waiting: list[Trajectory] = []

    def write() -> None:
        path = folder / f"shard-{len(written):06d}.parquet"
        save(Dataset(tuple(waiting)), path)
        written.append(path)
        waiting.clear()

    for trajectory in trajectories:
        waiting.append(trajectory)
        if sum(t.rows for t in waiting) >= rows:
            write()
    if waiting or not written:
        write()
    return written


@dataclass(frozen=True, eq=False)
class Shard:
    """A file of some trajectories.

    Attributes:
        path: the file.
        rows: of each trajectory.
        digest: of its size and of the footer, which holds the schema and the sizes of all columns.
    """

    path: Path
    rows: tuple[int, ...]
    digest: str


@dataclass(frozen=True, eq=False)
class Moments:
    """What one pass over a data set measures, in the channels' units.

    Attributes:
        count: (channels,) number of observed values.
        mean: (channels,) of them.
        variance: (channels,) of them.
        low: (channels,) smallest of them; inf without one.
        high: (channels,) largest of them; -inf without one.
        median_gap: s, between consecutive rows, of at most `MOST_GAPS` of them, evenly chosen; see
            `usual_gap`, with the median over files of the step of the fastest channel.
        longest_elapsed: s, longest time since the last observed row.
        longest_delta: s, longest time since observation of any channel.
    """

    count: NDArray[np.int64]
    mean: NDArray[np.float64]
    variance: NDArray[np.float64]
    low: NDArray[np.float64]
    high: NDArray[np.float64]
    median_gap: float
    longest_elapsed: float
    longest_delta: float


@dataclass(frozen=True, eq=False)
class ShardedDataset:
    """Trajectories in a folder of files, which are read when they are needed; see `Dataset.open`.

    Attributes:
        shards: the files, in the order of their names.
        names: of the channels.
        units: of the channels.
        roles: of the channels.
        window: rows of a window; None for whole trajectories.
        cache_mb: MB of windows in memory at a time.
        meta: of the first file.
    """

    shards: tuple[Shard, ...]
    names: tuple[str, ...]
    units: tuple[str, ...]
    roles: tuple[str, ...]
    window: int | None = None
    cache_mb: float = CACHE_MB
    meta: dict[str, Any] = field(default_factory=dict)

    @classmethod
    def open(
        cls, folder: str | Path, *, window: int | None = None, cache_mb: float = CACHE_MB
    ) -> ShardedDataset:
        """Opens the files of a folder; see `Dataset.open`.

        Args:
            folder: with files that `save` or `save_shards` wrote.
            window: rows of a window; None for whole trajectories.
            cache_mb: MB of windows in memory at a time.

        Raises:
            FileFormatError: there is no such folder or no file in it, a file is damaged, or its
                channels are others than those of the first.
            InputError: an option is out of range.
        """
        paths = sorted(Path(folder).glob("*.parquet"))
        if not paths:
            raise FileFormatError(
                f"{folder} holds no Parquet files; give the folder that save_shards wrote to"
            )
        return cls.of_files(paths, window=window, cache_mb=cache_mb)

    @classmethod
    def of_files(
        cls, paths: Sequence[Path], *, window: int | None = None, cache_mb: float = CACHE_MB
    ) -> ShardedDataset:
        """Opens files; see `open`.

        Args:
            paths: files that `save` or `save_shards` wrote.
            window: as of `open`.
            cache_mb: as of `open`.

        Raises:
            FileFormatError: as of `open`.
            InputError: as of `open`.
        """
        if window is not None and (
            isinstance(window, bool) or not isinstance(window, int) or window < 2
        ):
            raise InputError(f"window must be a number of rows of at least 2, got {window!r}")
        if not cache_mb > 0:
            raise InputError(f"cache_mb must be above 0, got {cache_mb!r}")
        with ThreadPoolExecutor(4) as pool:
            opened = list(pool.map(_opened, paths))
        first = opened[0][1]
        for path, (_, schema) in zip(paths, opened, strict=True):
            same = (schema.names, schema.units, schema.roles)
            if same != (first.names, first.units, first.roles):
                raise FileFormatError(
                    f"{path} has the channels {', '.join(schema.names)}, {paths[0]} has "
                    f"{', '.join(first.names)}, or their units or roles differ; put files of other "
                    "channels in another folder"
                )
        return cls(
            tuple(shard for shard, _ in opened),
            tuple(first.names),
            tuple(first.units),
            tuple(first.roles),
            window,
            float(cache_mb),
            dict(first.meta),
        )

    @property
    def channels(self) -> int:
        """Number of channels."""
        return len(self.names)

    @property
    def rows(self) -> int:
        """Number of rows of all trajectories."""
        return sum(sum(shard.rows) for shard in self.shards)

    def __len__(self) -> int:
        """Number of trajectories."""
        return sum(len(shard.rows) for shard in self.shards)

    def __repr__(self) -> str:
        return (
            f"ShardedDataset({len(self.shards)} files, {len(self)} trajectories, {self.rows} rows, "
            f"{self.channels} channels, {sum(self.windows_of(s) for s in self.shards)} windows)"
        )

    def take(self, index: Sequence[int] | NDArray[np.int64]) -> ShardedDataset:
        """The files at these positions, such as a part for training."""
        return replace(self, shards=tuple(self.shards[int(i)] for i in index))

    def parts(self) -> Iterator[Dataset]:
        """The data set of each file; the next one is read while one is used."""
        with ThreadPoolExecutor(1) as reader:
            ahead = reader.submit(self.part, 0)
            for i in range(len(self.shards)):
                part = ahead.result()
                if i + 1 < len(self.shards):
                    ahead = reader.submit(self.part, i + 1)
                yield part

    def part(self, i: int) -> Dataset:
        """The data set of one file.

        Args:
            i: position of the file.

        Raises:
            FileFormatError: it was changed after the folder was opened, or is damaged.
        """
        shard = self.shards[i]
        part = load(shard.path)
        if tuple(t.rows for t in part) != shard.rows:
            raise FileFormatError(f"{shard.path} was changed after the folder was opened")
        return part

    @property
    def bytes(self) -> int:
        """Memory of all trajectories, about, if they were read at once."""
        return self.rows * row_bytes(self.channels)

    def whole(self) -> Dataset:
        """All trajectories, in memory.

        Raises:
            FileFormatError: they need more memory than is available, or as of `part`.
        """
        require_rows(self.shards[0].path.parent, self.rows, self.channels, copies=2)
        return Dataset(tuple(t for part in self.parts() for t in part), self.meta)

    def windows_of(self, shard: Shard) -> int:
        """Number of windows of a file in an epoch."""
        return sum(self._count(rows) for rows in shard.rows)

    def bytes_of(self, shard: Shard) -> int:
        """Memory of the windows of a file, about."""
        longest = max(shard.rows) if self.window is None else min(self.window, max(shard.rows))
        return self.windows_of(shard) * longest * (self.channels * _BYTES_PER_VALUE + 9)

    def windows(self, i: int, random: np.random.Generator | None = None) -> Dataset:
        """The windows of one file, one after the other in each trajectory.

        Args:
            i: position of the file.
            random: draws where the first window of each trajectory begins; by default at its first
                row.
        """
        return Dataset(tuple(self._cut(self.part(i), random)), self.meta)

    def sample(self, count: int = 512, *, seed: int = 0) -> Dataset:
        """Some windows, in memory: evenly from as many files as are needed.

        Args:
            count: of windows, at most.
            seed: of the choice.
        """
        random = np.random.default_rng(seed)
        chosen = np.sort(random.permutation(len(self.shards))[:count])
        each = -(-count // len(chosen))
        found: list[Trajectory] = []
        for i in chosen.tolist():
            windows = self.windows(i)
            some = np.sort(random.permutation(len(windows))[:each])
            # Windows are views: copies let go of the file's memory.
            found += [_copied(windows[int(k)]) for k in some]
        return Dataset(tuple(found[:count]), self.meta)

    @cached_property
    def moments(self) -> Moments:
        """Measured in one pass over all files; kept."""
        total: list[NDArray[Any]] | None = None
        gaps: list[NDArray[np.float64]] = []
        fastest: list[float] = []
        stride = max(1, self.rows // MOST_GAPS)
        longest = np.zeros(2)
        for part in self.parts():
            total = _merged(total, list(moments(part)))
            fastest.append(fastest_step_of(part))
            for t in part:
                gaps.append(np.diff(t.times)[::stride])
                longest = np.maximum(longest, _silences(t))
        assert total is not None
        every = np.concatenate(gaps)
        if not len(every):
            raise InputError(
                "every trajectory has a single row; a model needs at least one of two rows"
            )
        median = usual_gap(float(np.median(every)), float(np.median(fastest)))
        elapsed = max(float(longest[0]), median)
        count, mean, variance, low, high = total
        delta = max(float(longest[1]), elapsed)
        return Moments(count, mean, variance, low, high, median, elapsed, delta)

    def fingerprint(self) -> str:
        """SHA-256 of the files' sizes and footers: of schemas and sizes, not of every value."""
        digest = hashlib.sha256()
        for shard in self.shards:
            digest.update(f"{shard.path.name}:{shard.digest};".encode())
        return digest.hexdigest()

    def _count(self, rows: int) -> int:
        return 1 if self.window is None else max(1, rows // self.window)

    def _cut(self, part: Dataset, random: np.random.Generator | None) -> Iterator[Trajectory]:
        for t in part:
            count, length = self._count(t.rows), self.window or t.rows
            left = max(t.rows - count * length, 0)
            first = 0 if random is None else int(random.integers(left + 1))
            for k in range(count):
                start = first + k * length
                yield t.slice(start, min(start + length, t.rows))


def _copied(trajectory: Trajectory) -> Trajectory:
    return replace(
        trajectory,
        times=trajectory.times.copy(),
        values=trajectory.values.copy(),
        observed=trajectory.observed.copy(),
    )


def _opened(path: Path) -> tuple[Shard, Schema]:
    """A file's lengths, digest and schema."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        with pq.ParquetFile(path) as file:
            schema = Schema.from_metadata(file.schema_arrow.metadata, path)
            number = file.read(["trajectory"]).column(0).to_numpy()
        with path.open("rb") as raw:
            size = raw.seek(0, 2)
            raw.seek(size - _FOOTER)
            length = int.from_bytes(raw.read(4), "little")
            raw.seek(max(0, size - _FOOTER - length))
            digest = hashlib.sha256(f"{size}:".encode() + raw.read(length)).hexdigest()
    except (pa.ArrowException, OSError, KeyError) as error:
        raise FileFormatError(
            f"{path} can't be read as Parquet ({' '.join(str(error).split())[:150]}); copy or "
            "write it again"
        ) from None
    rows = np.bincount(number, minlength=schema.trajectories)
    return Shard(path, tuple(rows.tolist()), digest), schema


def _merged(total: list[NDArray[Any]] | None, part: list[NDArray[Any]]) -> list[NDArray[Any]]:
    """Count, mean, variance, minimum, maximum of two parts together (Chan, Golub, LeVeque 1983)."""
    if total is None:
        return part
    count, mean, variance, low, high = total
    n, m, v, least, most = part
    whole = np.maximum(count + n, 1)
    step = m - mean
    return [
        count + n,
        mean + step * (n / whole),
        (count * variance + n * v + step**2 * (count * (n / whole))) / whole,
        np.minimum(low, least),
        np.maximum(high, most),
    ]


def _silences(trajectory: Trajectory) -> NDArray[np.float64]:
    """(2,) s, longest time since the last observed row, and since observation of any channel."""
    times, observed = trajectory.times, trajectory.observed

    def longest(seen: NDArray[np.bool_]) -> float:
        at = times[seen]
        return float(np.diff(np.append(at, times[-1])).max()) if len(at) else 0.0

    each = [longest(observed[:, c]) for c in range(observed.shape[1])]
    return np.array([longest(np.asarray(observed.any(axis=1))), max(each)])
