"""Tables of any file format: the meaning of columns, and their conversion to recordings.

A table is wide (a row per time, a column per channel) or long (a row per measured value: time,
channel, value), and holds one recording or, by a column of labels, several.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from offbeat.data.cleaning.clocks import is_rest, split_stamps, split_unit
from offbeat.data.readers.sensors import (
    instance_column,
    long_form,
    turns_of,
    unit_column,
    units_by_key,
)
from offbeat.data.readers.stamp_columns import stamp_columns
from offbeat.data.readers.table_options import (
    LABEL_NAMES,
    Sample,
    TableOptions,
    column_named,
    first_known,
)
from offbeat.data.trajectory import SECONDS_PER
from offbeat.errors import FileFormatError, listed, one_of

_BESIDE = ("observed", "low", "high", "beyond")
"""What columns hold that Offbeat writes beside a channel, as `knee|observed`."""


@dataclass(frozen=True)
class Columns:
    """The meaning of each column of a table.

    Attributes:
        time: the column of times; empty where rows have a fixed rate.
        label: the column of labels, or None.
        channels: the columns of channels; in a long table, the column of values.
        names: of the channels, without units.
        units: of the channels.
        key: the column with the channel of each value in a long table, or with the sensor that each
            row is of.
        chosen: in a long table, the selected channels, or None.
        stated: in a table with a key, units by channel.
        rest: the second column of a stamp in two columns, or None.
        rest_unit: its unit, or `date` where `rest` is a time of day and `time` is the date.
        left_out: names of columns that are there and not read.
        notes: on what was found and left out.
    """

    time: str
    label: str | None
    channels: tuple[str, ...]
    names: tuple[str, ...]
    units: tuple[str, ...]
    key: str | None = None
    chosen: tuple[str, ...] | None = None
    stated: Mapping[str, str] = field(default_factory=dict)
    rest: str | None = None
    rest_unit: str = ""
    left_out: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()

    @classmethod
    def of(
        cls, path: Path, header: Sequence[str], options: TableOptions, sample: Sample
    ) -> Columns:
        """Determines the meaning of each column, from options, names and first values.

        Raises:
            FileFormatError: there is no time or no channel, or the stamp stands in several columns.
            InputError: an option names an unknown column.
        """
        names = list(header)
        stamp = stamp_columns(path, names, options, sample)
        used = {stamp.time, stamp.rest}
        others = [name for name in names if name not in used]
        first_of: dict[str, str] = {}
        for name in others:
            first_of.setdefault(name.casefold(), name)
        label = next((first_of[name] for name in LABEL_NAMES if name in first_of), None)
        if options.trajectory_column is not None:
            label = column_named(options.trajectory_column, others, "trajectory")
        rest = [name for name in others if name != label]
        if not rest:
            raise FileFormatError(
                f"{path} has no channels, only the columns {listed(names, quoted=True)}; it needs "
                "one column per channel besides the time"
            )
        found = cls(
            stamp.time, label, (), (), (), rest=stamp.rest, rest_unit=stamp.rest_unit,
            notes=stamp.notes,
        )  # fmt: skip
        asked = (options.channel_column, options.value_column)
        of_units = unit_column([name for name in rest if name not in asked], sample)
        beside = [name for name in rest if name != of_units]
        key, value = long_form(beside, options, sample)
        if key is not None and value is not None:
            units, noted = ({}, ()) if of_units is None else units_by_key(key, of_units, sample)
            return replace(
                found,
                channels=(value,),
                names=(value,),
                units=("",),
                key=key,
                chosen=None if options.channels is None else tuple(options.channels),
                stated={**units, **(options.units or {})},
                notes=(*found.notes, *noted),
            )
        key = instance_column(stamp, rest, options, sample)
        if key is not None:
            found = replace(
                found,
                key=key,
                stated=dict(options.units or {}),
                notes=(*found.notes, f"rows are of the sensor in column {key!r}: each has channels "
                       "of its own"),
            )  # fmt: skip
            options = replace(options, units=None)
            rest = [name for name in rest if name != key]
        return found._wide(path, rest, options, sample)

    def _wide(
        self, path: Path, columns: list[str], options: TableOptions, sample: Sample
    ) -> Columns:
        split = [split_unit(column) for column in columns]
        short = [name for name, _ in split]
        if len(set(short)) < len(short):
            short = list(columns)
        units = {n: unit for n, c, (_, unit) in zip(short, columns, split, strict=True) if n != c}
        column_of = dict(zip(columns, columns, strict=True)) | dict(
            zip(short, columns, strict=True)
        )
        name_of = dict(zip(columns, short, strict=True))
        stated = dict(options.units or {})
        for name in stated:
            if name not in name_of.values():
                one_of("channel in units", name, short)
        notes: tuple[str, ...] = ()
        left: list[str] = []
        if options.channels is not None:
            kept = list(
                dict.fromkeys(
                    column_of[name if name in column_of else one_of("channel", name, short)]
                    for name in options.channels
                )
            )
            for column in kept:
                if sample.is_text(column):
                    raise FileFormatError(
                        f"{path} has text in column {column!r}, such as "
                        f"{first_known(sample.texts(column))!r}, expected numbers; choose other "
                        "columns with channels="
                    )
            asked = set(kept)
            left = [column for column in columns if column not in asked]
        else:
            without = {column_of[name] for name in options.without if name in column_of}
            beside = _of_answers(columns)
            texts = [c for c in columns if c not in without | beside and sample.is_text(c)]
            stamps = [
                pair
                for *pair, unit in split_stamps(columns)
                if is_rest(sample.numbers(pair[0]), sample.numbers(pair[1]), unit)
            ]
            left = list(dict.fromkeys([*without, *beside, *texts, *itertools.chain(*stamps)]))
            gone = set(left)
            kept = [column for column in columns if column not in gone]
            if beside:
                notes = (
                    "masks, intervals and the clock of answers are left out unless chosen with "
                    "channels=",
                )
            if stamps:
                notes = (
                    *notes,
                    "columns of further stamps are left out: "
                    f"{listed([*itertools.chain(*stamps)], quoted=True)}; time_column= takes two "
                    "of them as the time",
                )
            if texts:
                notes = (
                    *notes,
                    f"columns of text are left out: {listed(texts, 6, quoted=True)}",
                )
                turns = turns_of(texts, sample) if self.key is None else None
                if turns is not None:
                    notes = (
                        *notes,
                        f"rows take turns in column {turns!r}; if it names the sensor of each row, "
                        f"instance_column={turns} gives every sensor its own channels",
                    )
            if not kept:
                raise FileFormatError(
                    f"{path} has no column of numbers besides the time, expected one per channel; "
                    f"left out: {listed(left, 6, quoted=True)}"
                    + (
                        f", with text such as {first_known(sample.texts(texts[0]))[:60]!r}"
                        if texts
                        else ""
                    )
                )
        return replace(
            self,
            channels=tuple(kept),
            names=tuple(name_of[c] for c in kept),
            units=tuple(stated.get(name_of[c], units.get(name_of[c], "")) for c in kept),
            left_out=tuple(dict.fromkeys([*left, *(name_of[c] for c in left)])),
            notes=(*self.notes, *notes),
        )

    @property
    def read(self) -> list[str]:
        """The needed columns, each once."""
        wanted = [self.time, self.rest, self.label, self.key, *self.channels]
        return list(dict.fromkeys(name for name in wanted if name))

    def only(self, kept: Sequence[int], notes: Sequence[str]) -> Columns:
        """The same with some of the channels, and notes on the others."""
        gone = set(range(len(self.channels))) - set(kept)
        return replace(
            self,
            channels=tuple(self.channels[i] for i in kept),
            names=tuple(self.names[i] for i in kept),
            units=tuple(self.units[i] for i in kept),
            left_out=(*self.left_out, *(self.names[i] for i in sorted(gone))),
            notes=(*self.notes, *notes),
        )


def _of_answers(columns: Sequence[str]) -> set[str]:
    """The columns that Offbeat writes beside those of filled channels, such as `knee|observed`."""
    known = set(columns)
    parts = {column: column.rpartition("|") for column in columns}
    found = {c for c, (name, _, what) in parts.items() if name in known and what in _BESIDE}
    channels = {parts[column][0] for column in found}
    clocks = {f"clock_{unit}" for unit in SECONDS_PER} & known - channels
    return found | clocks if found else found


def unit_written(header: Sequence[str], time: str) -> str | None:
    """The unit of times in a table of answers of Offbeat, which counts seconds; else None."""
    clock = header[2:3] and header[2].startswith("clock_")
    ours = list(header[:2]) == ["trajectory", "time"] and (clock or _of_answers(header))
    return "s" if ours and time == "time" else None
