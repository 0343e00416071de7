"""The needed columns of a table, and their conversion to recordings."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from offbeat.data.cleaning.clocks import to_nanoseconds
from offbeat.data.cleaning.odd_clocks import without_wraps
from offbeat.data.readers.columns import Columns
from offbeat.data.readers.table_options import VALUE_NAMES
from offbeat.data.recording import Recording, Signal
from offbeat.data.signals import MOST_CHANNELS
from offbeat.errors import FileFormatError, one_of


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
    found: bool = False,
) -> list[Recording]:
    """Makes one recording per label, or a single one, from the columns of a table.

    Args:
        path: for messages.
        columns: description of the columns.
        unit: of the clock.
        notes: of the recordings.
        table: the columns.
        shown: unit of the file, where the clock was converted already.
        found: whether nothing states the unit of the clock.

    Raises:
        FileFormatError: a time is not finite, a selected channel is in no row, or two
            have one name.
    """
    if len(set(columns.names)) < len(columns.names):
        name = next(n for n, count in Counter(columns.names).items() if count > 1)
        raise FileFormatError(
            f"{path} has two channels with the name {name!r}; rename one, or choose others "
            "with channels="
        )
    clock = table.clock
    if table.labels is None and shown in ("", unit):  # else other logs begin, or it is converted
        clock, wraps = without_wraps(clock)
        notes = (*notes, wraps) if wraps else notes
    try:
        stamps, zero = to_nanoseconds(clock, unit)
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
            Recording(
                tuple(signals),
                text,
                origin,
                shown or unit,
                (*columns.notes, *notes),
                clock_zero=zero,
                unit_found=found,
                left_out=columns.left_out,
            )
        )
    return made


def _by_key(
    path: Path,
    columns: Columns,
    keys: Coded,
    stamps: NDArray[np.int64],
    values: NDArray[np.float64],
) -> list[Signal]:
    """A signal per key: a channel of the long form, or the channels of a sensor."""
    rows_of = dict(_groups(keys))
    nothing = np.zeros(0, dtype=np.int64)
    if len(keys.texts) > MOST_CHANNELS:
        raise FileFormatError(
            f"{path} has {len(keys.texts)} different values in column {columns.key!r}, more than "
            f"{MOST_CHANNELS} channels; choose another column with channel_column="
        )
    numbered = all(text.lstrip("-").isdecimal() for text in keys.texts)
    of_sensors = numbered and columns.names[0].casefold() not in VALUE_NAMES
    if columns.chosen is None and (len(columns.channels) > 1 or of_sensors):
        called = {
            text: tuple(f"{n}[{text}]" if numbered else f"{text}.{n}" for n in columns.names)
            for text in keys.texts
        }
        every = {name for names in called.values() for name in names}
        for name in columns.stated:
            if name not in every and name not in columns.names:
                one_of("channel in units", name, every)
        stated = columns.stated
        return [
            Signal(
                "",
                stamps[rows_of.get(text, nothing)],
                values[rows_of.get(text, nothing)],
                names,
                tuple(
                    stated.get(name, stated.get(short, unit))
                    for name, short, unit in zip(names, columns.names, columns.units, strict=True)
                ),
            )
            for text, names in called.items()
        ]
    chosen = list(columns.chosen if columns.chosen is not None else keys.texts)
    for name in [*chosen, *columns.stated]:
        if name not in rows_of and name not in keys.texts:
            one_of("channel", name, keys.texts)
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
