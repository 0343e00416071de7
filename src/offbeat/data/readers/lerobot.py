"""LeRobot data sets, versions 2.0, 2.1 and 3.0, by pyarrow alone: a recording per episode.

The layout (huggingface.co/docs/lerobot, "LeRobotDataset v3.0"): `meta/info.json` names the
features, the rate and the pattern of the files' names. Version 2 has a Parquet file per episode and
`meta/episodes.jsonl`; version 3 packs episodes into files, and `meta/episodes/*/*.parquet` says
which file each one is in.

LeRobot itself writes row number / fps into `timestamp`. Where a data set has measured stamps,
in `timestamp` or in another column, those are used; else rows are on a grid, which is noted.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from offbeat.data.cleaning.clocks import (
    join_stamp,
    split_stamps,
    state_time_unit,
    to_nanoseconds,
)
from offbeat.data.memory import require_rows
from offbeat.data.readers.batches import is_list
from offbeat.data.readers.lerobot_info import WIDEST, Feature, Info, Rows, read_columns
from offbeat.data.signals import Recording, Signal
from offbeat.errors import FileFormatError, InputError, one_of


def root_of(path: Path) -> Path | None:
    """The folder of the data set that a path belongs to, or None."""
    path = path.absolute()
    for folder in (path, *path.parents[:4]):
        try:
            if (folder / "meta" / "info.json").is_file():
                return folder
        except (OSError, ValueError):
            return None
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
    episodes: Sequence[int] | int | None = None,
    columns: Sequence[str] | None = None,
    include_actions: bool = True,
    time_column: str | Sequence[str] | None = None,
    time_unit: str | None = None,
) -> Iterator[Recording]:
    """Reads a LeRobot data set: a recording per episode, in the order of their numbers.

    Args:
        path: the folder of the data set, its `meta/info.json`, or one Parquet file of its data,
            of which only the episodes in it are read.
        episodes: numbers of the episodes to read; by default all.
        columns: features to read as channels, such as `observation.state`; by default all that
            are numbers, except actions, rewards and bookkeeping.
        include_actions: whether the features `action` (or `actions`) and `action.*` are read;
            their channels have the role `action`.
        time_column: column of the stamps, or two that hold them together, as `[sec, nanosec]`; by
            default found by their names, if they are not row number / fps, else row number / fps.
        time_unit: unit of that column; by default from its name, else detected.

    Yields:
        Recordings. Channels are named as in `info.json`, after their feature if there
        are several.

    Raises:
        FileFormatError: a file is missing, truncated, a Git LFS pointer, or not what `info.json`
            says.
        InputError: an episode, column or unit is unknown.
    """
    path = Path(path)
    root = root_of(path)
    if root is None:
        raise FileFormatError(
            f"{path} is not a LeRobot data set: there is no meta/info.json above it"
        )
    info = Info.of(root)
    files = info.episode_files()
    if path.suffix == ".parquet":
        files = {n: at for n, at in files.items() if at.file == path.absolute()}
        if not files:
            raise FileFormatError(f"{path} is not a file of any episode in {root / 'meta'}")
    if episodes is not None:
        episodes = (episodes,) if isinstance(episodes, int) else tuple(episodes)
        for number in episodes:
            if number not in files or not isinstance(number, int):
                one_of("episode", str(number), map(str, files))
                raise InputError(f"episodes must be numbers, got {number!r}")
        files = {number: files[number] for number in sorted(set(episodes))}
    chosen, notes = info.chosen(columns)
    clocks = info.clocks(time_column)
    if columns is None:  # what holds a stamp is no channel
        chosen = [f for f in chosen if not any(f.name in clock for clock in clocks)]
    acted = [
        f
        for f in info.features.values()
        if include_actions and f.role == "action" and f not in chosen and f.width <= WIDEST
    ]
    lengths = [at.length or 0 for at in files.values()]
    width = sum(feature.width for feature in (*chosen, *acted))
    require_rows(root, sum(lengths), width, "choose episodes= or columns=")
    reading = _Reading(
        info, chosen, acted, clocks, time_column is not None, time_unit, tuple(notes)
    )
    for number, at in files.items():
        yield reading.recording(number, at)


class _Reading:
    """Reads episodes in order, with one file in memory at a time."""

    def __init__(
        self,
        info: Info,
        chosen: list[Feature],
        acted: list[Feature],
        clocks: list[tuple[str, ...]],
        given: bool,
        time_unit: str | None,
        notes: tuple[str, ...],
    ) -> None:
        self.info = info
        self.chosen = chosen
        self.acted = acted
        self.time_unit = time_unit
        self.notes = notes
        self.given, self.clocks = given, clocks
        self.path: Path | None = None
        self.table: Any = None

    def recording(self, number: int, at: Rows) -> Recording:
        """One episode."""
        if at.file != self.path:
            columns = dict.fromkeys(
                [
                    *(name for clock in self.clocks for name in clock),
                    "episode_index",
                    *(f.name for f in (*self.chosen, *self.acted)),
                ]
            )
            self.table, self.path = read_columns(at.file, list(columns)), at.file
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
            raise FileFormatError(f"{at.file}: the rows of episode {number} are not consecutive")
        stamps, zero, unit, notes, found = self._stamps(episode, at.file)
        alone = len(self.chosen) == 1
        features = [*self.chosen, *self.acted]
        named = [f.channels(alone=alone and f in self.chosen) for f in features]
        signal = Signal(
            "",
            stamps,
            _matrix(episode, features, at.file),
            tuple(name for names in named for name in names),
            tuple(
                unit
                for f in features
                for unit in (f.units if len(f.units) == f.width else ("",) * f.width)
            ),
            roles=tuple(f.role for f, names in zip(features, named, strict=True) for _ in names),
        )
        return Recording(
            (signal,),
            label=str(number),
            origin=f"{self.info.root.name}, episode {number}",
            time_unit=unit,
            notes=(*notes, *self.notes),
            clock_zero=zero,
            unit_found=found,
            left_out=tuple(self.info.features.keys() - {f.name for f in features}),
        )

    def _stamps(
        self, episode: Any, file: Path
    ) -> tuple[NDArray[np.int64], int, str, tuple[str, ...], bool]:
        """Nanoseconds, the clock at nanosecond 0, the column's unit, notes, and if it was found."""
        fps = self.info.fps
        grid = np.rint(np.arange(episode.num_rows) * (1e9 / fps)).astype(np.int64)
        for name, *rest in self.clocks:
            clock = _raw(episode, name, file)
            unit, found = "s", False
            notes: tuple[str, ...] = ()
            if rest:
                (_, _, of_rest), *_ = split_stamps([name, *rest])
                clock, unit = join_stamp(clock, _raw(episode, rest[0], file), of_rest), "ns"
            elif name != "timestamp" or self.time_unit is not None:
                unit, notes, found = state_time_unit(
                    self.time_unit, name.rpartition(".")[2], clock, str(file)
                )
            try:
                stamps, zero = to_nanoseconds(clock, unit)
            except FileFormatError as error:
                raise FileFormatError(f"{file}, column {name!r}: {error}") from None
            # LeRobot's stamps are float32: differences of 1 us, or 1e-6 relative, are on the grid.
            near = 1_000 + grid // 1_000_000
            if not self.given and (np.abs(stamps - stamps[:1] - grid) <= near).all():
                continue
            what = f"the column {name!r}" if not rest else f"joined from {name!r} and {rest[0]!r}"
            left = self._further_times((name, *rest))
            return stamps, zero, unit, (f"stamps are {what}", *notes, *left), found
        note = f"stamps are row number / {fps:g} fps, no times were recorded"
        return grid, 0, "s", (note, *self._further_times(())), False

    def _further_times(self, used: tuple[str, ...]) -> tuple[str, ...]:
        """A note on columns of times that are neither used nor mentioned yet."""
        told = ", ".join(self.notes)
        names = [n for n in itertools.chain(*self.clocks) if n not in ("timestamp", *used)]
        left = [name for name in dict.fromkeys(names) if name not in told]
        how = "; time_column= takes one of them"
        return (f"further times are left out: {', '.join(left[:20])}{how}",) if left else ()


def _raw(table: Any, name: str, file: Path) -> NDArray[Any]:
    """A column of one number per row, in its own type, so that an integer clock stays exact."""
    import pyarrow as pa

    column = table.column(name).combine_chunks()
    while is_list(column.type):
        column = column.flatten()
    if pa.types.is_timestamp(column.type):
        column = column.cast(pa.timestamp("ns")).cast(pa.int64())
    if column.null_count or len(column) != table.num_rows:
        raise FileFormatError(f"{file} has rows without a time in column {name!r}; name another")
    values: NDArray[Any] = column.to_numpy(zero_copy_only=False)
    if values.dtype.kind not in "iuf":
        raise FileFormatError(f"{file} has {column.type} in column {name!r}, expected times")
    return values


def _matrix(table: Any, features: list[Feature], file: Path) -> NDArray[np.float64]:
    """(rows, numbers) the columns of some features."""
    values = np.empty((table.num_rows, sum(f.width for f in features)), order="F")
    first = 0
    for feature in features:
        last = first + feature.width
        values[:, first:last] = _column(table, feature.name, feature.width, file)
        first = last
    return values


def _column(table: Any, name: str, width: int, file: Path) -> NDArray[np.float64]:
    """(rows, width) a column of numbers or of lists of numbers, NaN for null."""
    import pyarrow as pa

    column = table.column(name).combine_chunks()
    while is_list(column.type):
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
