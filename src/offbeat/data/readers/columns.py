"""Tables of any file format: the meaning of columns, and their conversion to recordings.

A table is wide (a row per time, a column per channel) or long (a row per measured value: time,
channel, value), and holds one recording or, by a column of labels, several.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from offbeat.data.cleaning.clocks import TIME_NAMES, split_unit, time_column_of, to_nanoseconds
from offbeat.data.recording import Recording, Signal
from offbeat.errors import FileFormatError, one_of

LABEL_NAMES = ("trajectory", "episode", "episode_index", "demo")
"""Names of trajectory columns, in any case."""

KEY_NAMES = ("channel", "variable", "signal", "sensor", "name", "key", "topic", "field")
VALUE_NAMES = ("value", "val", "data", "reading")
"""Names of the two columns of long tables besides the time, in any case."""


@dataclass(frozen=True)
class Columns:
    """The meaning of each column of a table.

    Attributes:
        time: the column of times.
        label: the column of labels, or None.
        channels: the columns of channels; in a long table, the column of values.
        names: of the channels, without units.
        units: of the channels.
        key: in a long table, the column with the channel of each value.
        chosen: in a long table, the selected channels, or None.
    """

    time: str
    label: str | None
    channels: tuple[str, ...]
    names: tuple[str, ...]
    units: tuple[str, ...]
    key: str | None = None
    chosen: tuple[str, ...] | None = None
    stated: Mapping[str, str] = field(default_factory=dict)

    @classmethod
    def of(
        cls,
        path: Path,
        header: Sequence[str],
        *,
        time_column: str | None = None,
        trajectory_column: str | None = None,
        channels: Sequence[str] | None = None,
        units: Mapping[str, str] | None = None,
        channel_column: str | None = None,
        value_column: str | None = None,
    ) -> Columns:
        """Determines the meaning of each column, from options or names.

        Raises:
            FileFormatError: there is no time or no channel.
            InputError: an option names an unknown column.
        """
        names = list(header)
        time = time_column_of(names) if time_column is None else _named(time_column, names, "time")
        if time is None:
            raise FileFormatError(
                f"{path} has no column of times: its columns must have one of the names "
                f"{', '.join(TIME_NAMES[:3])}, ... got {listed(names)}; say which one with "
                "time_column="
            )
        others = [name for name in names if name != time]
        folded = {name.casefold(): name for name in reversed(others)}
        label = next((folded[name] for name in LABEL_NAMES if name in folded), None)
        if trajectory_column is not None:
            label = _named(trajectory_column, others, "trajectory")
        rest = [name for name in others if name != label]
        if not rest:
            raise FileFormatError(
                f"{path} has no channels, only the columns {listed(names)}; it needs one column "
                "per channel besides the time"
            )
        key, value = _long_form(rest, channel_column, value_column)
        if key is not None and value is not None:
            chosen = None if channels is None else tuple(dict.fromkeys(channels))
            return cls(
                time, label, (value,), (value,), ("",), key, chosen, stated=dict(units or {})
            )
        return cls._wide(time, label, rest, channels, dict(units or {}))

    @classmethod
    def _wide(
        cls,
        time: str,
        label: str | None,
        columns: list[str],
        channels: Sequence[str] | None,
        stated: dict[str, str],
    ) -> Columns:
        split = [split_unit(column) for column in columns]
        short = [name for name, _ in split]
        if len(set(short)) < len(short):
            short = columns
        units = {n: unit for n, c, (_, unit) in zip(short, columns, split, strict=True) if n != c}
        column_of = dict(zip(columns, columns, strict=True)) | dict(
            zip(short, columns, strict=True)
        )
        name_of = dict(zip(columns, short, strict=True))
        names = short
        if channels is not None:
            asked = dict.fromkeys(
                column_of[name if name in column_of else one_of("channel", name, short)]
                for name in channels
            )
            columns, names = list(asked), [name_of[column] for column in asked]
        for name in stated:
            one_of("channel in units", name, names)
        return cls(
            time,
            label,
            tuple(columns),
            tuple(names),
            tuple(stated.get(name, units.get(name, "")) for name in names),
        )

    @property
    def read(self) -> list[str]:
        """The needed columns, each once."""
        wanted = [self.time, self.label, self.key, *self.channels]
        return list(dict.fromkeys(name for name in wanted if name is not None))


def _named(name: str, columns: list[str], what: str) -> str:
    """A column by its name, with or without its unit."""
    if name in columns:
        return name
    short = {split_unit(column)[0]: column for column in reversed(columns)}
    return short[name] if name in short else one_of(f"{what}_column", name, columns)


def _long_form(
    rest: list[str], channel_column: str | None, value_column: str | None
) -> tuple[str | None, str | None]:
    folded = {name.casefold(): name for name in reversed(rest)}
    keys = [folded[name] for name in KEY_NAMES if name in folded]
    values = [folded[name] for name in VALUE_NAMES if name in folded]
    if channel_column is None and value_column is None:
        if len(rest) == 2 and len(keys) == len(values) == 1:
            return keys[0], values[0]
        return None, None
    key = (
        _named(channel_column, rest, "channel")
        if channel_column is not None
        else next(iter(keys), None)
    )
    left = [name for name in rest if name != key]
    value = (
        _named(value_column, left, "value")
        if value_column is not None
        else next((name for name in values if name != key), None)
    )
    if key is None:
        key = one_of("channel_column", "", rest)
    if value is None:
        value = one_of("value_column", "", left)
    return key, value


@dataclass(frozen=True, eq=False)
class Coded:
    """A column of texts: a code per row, and the text of each code."""

    codes: NDArray[np.int64]
    texts: list[str]


@dataclass(frozen=True, eq=False)
class Gathered:
    """The needed columns of a table.

    Attributes:
        clock: (rows,) integers or floats.
        labels: the recording of each row, or None.
        keys: in a long table, the channel of each row, or None.
        values: (rows, channels), in column order.
    """

    clock: NDArray[Any]
    labels: Coded | None
    keys: Coded | None
    values: NDArray[np.float64]


class Coder:
    """Encodes the texts of a column in chunks, in the order of their first rows."""

    def __init__(self) -> None:
        self._of: dict[str, int] = {}
        self._codes: list[NDArray[np.int64]] = []

    def add(self, column: Any) -> None:
        """Adds an Arrow array of strings without nulls."""
        coded = column.dictionary_encode()
        texts = coded.dictionary.to_pylist()
        codes = np.array(
            [self._of.setdefault(text, len(self._of)) for text in texts], dtype=np.int64
        )
        self._codes.append(codes[coded.indices.to_numpy(zero_copy_only=False)])

    def add_texts(self, texts: Sequence[str]) -> None:
        """Adds texts, one per row."""
        codes = [self._of.setdefault(text, len(self._of)) for text in texts]
        self._codes.append(np.array(codes, dtype=np.int64))

    def done(self) -> Coded:
        """Returns the encoded column."""
        return Coded(np.concatenate([*self._codes, np.zeros(0, np.int64)]), list(self._of))


def recordings(
    path: Path,
    columns: Columns,
    unit: str,
    notes: Sequence[str],
    table: Gathered,
    *,
    shown: str = "",
) -> list[Recording]:
    """Makes one recording per label, or a single one, from the columns of a table.

    Args:
        path: for messages.
        columns: description of the columns.
        unit: of the clock.
        notes: of the recordings.
        table: the columns.
        shown: unit of the file, where the clock was converted already.

    Raises:
        FileFormatError: a time is not finite, a selected channel is in no row, or two
            have one name.
    """
    for i, name in enumerate(columns.names):
        if name in columns.names[:i]:
            raise FileFormatError(
                f"{path} has two channels with the name {name!r}; rename one, or choose others "
                "with channels="
            )
    try:
        stamps, zero = to_nanoseconds(table.clock, unit)
    except FileFormatError as error:
        raise FileFormatError(f"{path}: {error}") from None
    made = []
    for text, rows in _groups(table.labels):
        origin = f"{path.name}, {columns.label} {text}" if columns.label else path.name
        values = table.values[rows]
        if table.keys is None:
            signals = [Signal("", stamps[rows], values, columns.names, columns.units)]
        else:
            keys = Coded(table.keys.codes[rows], table.keys.texts)
            signals = _by_key(path, columns, keys, stamps[rows], values)
        made.append(
            Recording(tuple(signals), text, origin, shown or unit, tuple(notes), clock_zero=zero)
        )
    return made


def _by_key(
    path: Path,
    columns: Columns,
    keys: Coded,
    stamps: NDArray[np.int64],
    values: NDArray[np.float64],
) -> list[Signal]:
    chosen = list(columns.chosen if columns.chosen is not None else keys.texts)
    for name in [*chosen, *columns.stated]:
        one_of("channel", name, keys.texts)
    rows_of = dict(_groups(keys))
    nothing = np.zeros(0, dtype=np.int64)
    return [
        Signal(
            "",
            stamps[rows_of.get(name, nothing)],
            values[rows_of.get(name, nothing)],
            (name,),
            (columns.stated.get(name, ""),),
        )
        for name in chosen
    ]


def _groups(coded: Coded | None) -> list[tuple[str, Any]]:
    """Texts in the order of their first rows, each with its rows, as a slice if possible."""
    if coded is None:
        return [("", slice(None))]
    codes = coded.codes
    if not len(codes):
        return []
    starts = np.flatnonzero(np.diff(codes, prepend=-1))
    met = codes[starts]
    if len(np.unique(met)) == len(met):  # one run each: no copy is needed
        ends = [*starts[1:], len(codes)]
        return [
            (coded.texts[code], slice(start, end))
            for code, start, end in zip(met, starts, ends, strict=True)
        ]
    order = np.argsort(codes, kind="stable")
    cuts = np.flatnonzero(np.diff(codes[order])) + 1
    groups = np.split(order, cuts)
    groups.sort(key=lambda rows: int(rows[0]))
    return [(coded.texts[codes[rows[0]]], rows) for rows in groups]


def listed(names: Sequence[str]) -> str:
    """Names in quotes, for messages."""
    return ", ".join(map(repr, names))
