"""Tables of any file format: the meaning of columns, and their conversion to recordings.

A table is wide (a row per time, a column per channel) or long (a row per measured value: time,
channel, value), and holds one recording or, by a column of labels, several.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from offbeat.data.cleaning.clocks import (
    TIME_NAMES,
    folded,
    is_rest,
    may_be_time,
    split_stamps,
    split_unit,
    time_column_of,
)
from offbeat.data.cleaning.options import is_number
from offbeat.data.readers.options import names as names_of
from offbeat.data.readers.stamps import form_of, is_date
from offbeat.errors import FileFormatError, InputError, NoLogError, listed, one_of

LABEL_NAMES = (
    *("trajectory", "episode", "episode_index", "demo", "trajectory_id", "episode_id", "demo_id"),
    *("traj", "traj_id", "trial", "trial_id", "rollout"),
)
"""Names of trajectory columns, in any case."""

KEY_NAMES = (
    *("channel", "variable", "signal", "sensor", "name", "key", "topic", "field", "device"),
    *("joint", "joint_name", "sensor_name", "motor", "link", "marker", "node", "metric"),
)
VALUE_NAMES = ("value", "val", "data", "reading")
"""Names of the two columns of long tables besides the time, in any case."""


INSTANCE_NAMES = ("i", "instance", "multi_id", "imu", "id", "index", "motor", "joint", "sensor")
"""Names of columns with the number of the sensor of a row, in any case."""

_MOST_INSTANCES = 64


class Sample(Protocol):
    """The first values of the columns of a table, from which their meaning is found."""

    def is_text(self, name: str) -> bool:
        """Whether a column holds texts, and not numbers or booleans."""

    def numbers(self, name: str) -> NDArray[np.float64]:
        """The first numbers of a column, NaN where there is none; empty for texts."""

    def texts(self, name: str) -> list[str]:
        """The first values of a column, as texts."""


@dataclass(frozen=True)
class TableOptions:
    """The options that say what the columns of a table mean; see `read_csv`."""

    time_column: str | Sequence[str] | None = None
    trajectory_column: str | None = None
    channels: Sequence[str] | None = None
    without: Sequence[str] = ()
    units: Mapping[str, str] | None = None
    channel_column: str | None = None
    value_column: str | None = None
    instance_column: str | None = None
    rate_hz: float | None = None
    day_first: bool | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "channels", names_of("channels", self.channels))
        object.__setattr__(self, "without", names_of("without", self.without or None) or ())
        for name in ("trajectory_column", "channel_column", "value_column", "instance_column"):
            given = getattr(self, name)
            if not (given is None or isinstance(given, str)):
                raise InputError(f"{name} must be the name of a column, got {given!r}")
        units = self.units or {}
        if not isinstance(units, Mapping) or not all(
            isinstance(text, str) for pair in units.items() for text in pair
        ):
            raise InputError(f"units must map names of channels to units, got {units!r}")
        rate = self.rate_hz
        if rate is not None and not (is_number(rate) and 0 < rate <= 1e9):
            raise InputError(f"rate_hz must be rows per second, above 0, got {rate!r}")


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
            label = _named(options.trajectory_column, others, "trajectory")
        rest = [name for name in others if name != label]
        if not rest:
            raise FileFormatError(
                f"{path} has no channels, only the columns {listed(names, quoted=True)}; it needs "
                "one column per channel besides the time"
            )
        found = replace(stamp, label=label)
        key, value = _long_form(rest, options, sample)
        if key is not None and value is not None:
            return replace(
                found,
                channels=(value,),
                names=(value,),
                units=("",),
                key=key,
                chosen=None if options.channels is None else tuple(options.channels),
                stated=dict(options.units or {}),
            )
        key = _instance_column(found, rest, options, sample)
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
                        f"{_first(sample.texts(column))!r}, expected numbers; choose other columns "
                        "with channels="
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
                    "masks and intervals of answers are left out unless chosen with channels=",
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
                        f", with text such as {_first(sample.texts(texts[0]))[:60]!r}"
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


def stamp_columns(
    path: Path, names: list[str], options: TableOptions, sample: Sample, what: str = "column"
) -> Columns:
    """A description of the stamp alone: one column, or two that hold it together.

    Raises:
        FileFormatError: there is no time, or the stamp stands in several columns.
        InputError: an option names an unknown column.
    """

    def made(time: str, rest: str | None = None, unit: str = "", note: str = "") -> Columns:
        notes = (note,) if note else ()
        return Columns(time, None, (), (), (), rest=rest, rest_unit=unit, notes=notes)

    def joined(time: str, rest: str, unit: str) -> Columns:
        return made(time, rest, unit, f"the stamp is joined from columns {time!r} and {rest!r}")

    pairs = [
        pair for pair in split_stamps(names)
        if is_rest(sample.numbers(pair[0]), sample.numbers(pair[1]), pair[2])
    ]  # fmt: skip
    if options.time_column is not None:
        given = [_named(name, names, "time") for name in columns_in(options.time_column, names)]
        if len(given) == 1:
            return made(given[0])
        if len(given) == 2:
            unit = next((unit for one, two, unit in pairs if [one, two] == given), "")
            if _is_date(sample, given[0]) and sample.is_text(given[1]):
                return joined(given[0], given[1], "date")
            for tried in (unit,) if unit else ("ns", "us", "ms"):
                if is_rest(sample.numbers(given[0]), sample.numbers(given[1]), tried):
                    return joined(given[0], given[1], tried)
        raise InputError(
            f"{path}: time_column must name one column, or two with whole seconds and the "
            "nanoseconds beside them, or with a date and a time of day, got "
            f"{listed(given, quoted=True)}"
        )
    if options.rate_hz is not None:
        return made("", note=f"stamps are row number / {options.rate_hz:g} Hz, as rate_hz says")
    time, left = time_column_of(names), names
    while time is not None and (found := sample.texts(time)) and not any(found):
        left = [name for name in left if name != time]  # one that is never known is not the time
        time = time_column_of(left)
    time = time or time_column_of(names)
    dates = [name for name in names if folded(name) in _DATES and _is_date(sample, name)]
    if time is None and dates:
        return made(dates[0])
    if time is not None:
        for one, two, unit in pairs:
            if time in (one, two):
                return joined(one, two, unit)
        _refuse_dates(path, names, time, options, sample)
        if dates and sample.is_text(time) and not _is_date(sample, time):
            return joined(dates[0], time, "date")
        if folded(time) in _SECONDS and (minutes := [n for n in names if folded(n) in _MINUTES]):
            raise FileFormatError(
                f"{path} has the time in several columns, such as {minutes[0]!r} and {time!r}; add "
                f"them up in one column of seconds, or take {time!r} alone with time_column="
            )
        return made(time)
    if len(pairs) == 1:
        return joined(*pairs[0])
    likely = [
        name
        for name in names
        if may_be_time(name)
        and (_increases(sample.numbers(name)) or _are_times(sample.texts(name)))
    ]
    if not pairs and len(likely) == 1:
        return made(likely[0], note=f"{likely[0]!r} is taken for the time: it alone is named like "
                    "one, and increases")  # fmt: skip
    parts = [name for name in names if folded(name) in (*_DATE_PARTS, *_MINUTES)]
    if len(parts) > 2 and not pairs:
        raise FileFormatError(
            f"{path} has the time in several columns, {listed(parts, 6, quoted=True)}; join them "
            "in one column, such as 2026-11-24T21:00:00, or give rate_hz="
        )
    if pairs:
        shown = ", ".join(f"[{one}, {two}]" for one, two, _ in pairs)
        raise FileFormatError(
            f"{path} has several stamps, each in two columns: {shown}; say which one is the time "
            "with time_column="
        )
    raise NoLogError(
        f"{path} has no {what} of times: one must be called {', '.join(TIME_NAMES[:3])}, ... got "
        f"{listed(names, 12, quoted=True)}; say which one with time_column=, or give rate_hz="
    )


_DATES = ("date", "day", "date_utc", "utc_date", "local_date", "datum")
_SECONDS = ("s", "sec", "secs", "second", "seconds")
_DATE_PARTS = ("year", "month", "day", "doy", "yyyy", "mm", "dd")
_MINUTES = ("minute", "minutes", "hour", "hours")  # min is a minimum


def _refuse_dates(
    path: Path, names: list[str], time: str, options: TableOptions, sample: Sample
) -> None:
    """Raises an error for dates beside times of day that may be of either order."""
    if form_of(_first(sample.texts(time))) != "of day":
        return
    for name in names:
        usual = folded(name) in _DATES and name not in options.without
        if usual and sample.is_text(name) and not _is_date(sample, name):
            raise FileFormatError(
                f"{path} has dates such as {_first(sample.texts(name))[:40]!r} in column {name!r}, "
                "expected a form such as 2026-11-24; leave them out with "
                f"without=[{name}]"
            )


def _increases(numbers: NDArray[np.float64]) -> bool:
    steps = np.diff(numbers[np.isfinite(numbers)])
    return len(steps) > 1 and bool((steps >= 0).all()) and bool((steps > 0).any())


def _are_times(texts: Sequence[str]) -> bool:
    """Whether texts have a form of times, and more than two differ: a single one may be a date."""
    return len({*texts} - {""}) > 2 and form_of(_first(texts)) is not None


def _is_date(sample: Sample, name: str) -> bool:
    text = _first(sample.texts(name))
    return bool(text) and is_date(form_of(text))


def _first(texts: Sequence[str]) -> str:
    return next((text for text in texts if text), "")


def columns_in(given: str | Sequence[str], names: Sequence[str]) -> tuple[str, ...]:
    """The columns that an option names: one, or several as a list, `[a, b]` or `a,b`.

    Raises:
        InputError: they are not names.
    """
    if not isinstance(given, str):
        parts = names_of("time_column", given) or ()
        whole = ",".join(parts)
        return (whole,) if whole in names and not set(parts) <= set(names) else parts
    if given in names or not given.startswith("["):
        parts = tuple(part.strip() for part in given.split(","))
        return parts if given not in names and set(parts) <= set(names) else (given,)
    return tuple(part.strip().strip("'\"") for part in given.strip("[]").split(","))


def _of_answers(columns: Sequence[str]) -> set[str]:
    """The columns that Offbeat writes beside those of filled channels, such as `knee|observed`."""
    known = set(columns)
    parts = {column: column.rpartition("|") for column in columns}
    return {c for c, (name, _, what) in parts.items() if name in known and what in _BESIDE}


def unit_written(header: Sequence[str], time: str) -> str | None:
    """The unit of times in a table of answers of Offbeat, which counts seconds; else None."""
    clock = header[2:3] and header[2].startswith("clock_")
    ours = list(header[:2]) == ["trajectory", "time"] and (clock or _of_answers(header))
    return "s" if ours and time == "time" else None


def _named(name: str, columns: list[str], what: str) -> str:
    """A column by its name, with or without its unit."""
    if name in columns:
        return name
    short = {split_unit(column)[0]: column for column in reversed(columns)}
    return short[name] if name in short else one_of(f"{what}_column", name, columns)


def _long_form(
    rest: list[str], options: TableOptions, sample: Sample
) -> tuple[str | None, str | None]:
    first_of: dict[str, str] = {}
    for name in rest:
        first_of.setdefault(folded(name), name)
    keys = [first_of[name] for name in KEY_NAMES if name in first_of]
    values = [first_of[name] for name in VALUE_NAMES if name in first_of]
    channel_column, value_column = options.channel_column, options.value_column
    if channel_column is None and value_column is None:
        if not (len(rest) == 2 and len(keys) == len(values) == 1):
            return None, None
        # A column of numbers with such a name is a channel.
        is_key = sample.is_text(keys[0]) or not sample.numbers(keys[0]).size
        return (keys[0], values[0]) if is_key else (None, None)
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


def _take_turns(stamp: Columns, keys: list[str], sample: Sample) -> bool:
    """Whether rows of several keys take turns, or share stamps, unlike those of a mode."""
    changes = [i for i in range(1, len(keys)) if keys[i] != keys[i - 1]]
    if 4 * len(changes) >= len(keys):
        return True
    times = sample.numbers(stamp.time) if stamp.time else np.zeros(0)
    return len(times) == len(keys) and any(times[i] <= times[i - 1] for i in changes)


def _instance_column(
    stamp: Columns, rest: list[str], options: TableOptions, sample: Sample
) -> str | None:
    """The column with the sensor of each row, where rows of several sensors take turns.

    By default a column of few texts that is named like a key, or of few integers that is named like
    an instance and tells apart the rows of one stamp.
    """
    if options.instance_column is not None:
        return _named(options.instance_column, rest, "instance")
    if len(rest) < 2 or options.channels is not None:
        return None
    stamps = sample.texts(stamp.time) if stamp.time else []
    if stamp.rest is not None:
        stamps = list(map(str, zip(stamps, sample.texts(stamp.rest), strict=False)))
    times = sample.numbers(stamp.time) if stamp.time else np.zeros(0)
    # Of stamps in whole seconds, a column may count the rows of each second.
    whole = (np.diff(times[np.isfinite(times)]) % 1 == 0).all()
    coarse = stamp.rest is None and times.size and bool(whole)
    shared = 5 * (len(stamps) - len(set(stamps))) >= len(stamps)  # not by chance
    usual_first = sorted(
        rest, key=lambda n: (folded(n) not in KEY_NAMES, folded(n) not in INSTANCE_NAMES)
    )
    for name in usual_first:
        usual = folded(name)
        texts = sample.texts(name)
        different = set(texts)
        few = 1 < len(different) <= min(_MOST_INSTANCES, len(texts) // 2) and "" not in different
        if not few:
            continue
        if sample.is_text(name):
            if usual in KEY_NAMES and _take_turns(stamp, texts, sample):
                return name
        else:
            numbers = sample.numbers(name)
            if not len(numbers) or (numbers != np.floor(numbers)).any():
                continue
            if coarse and (usual == "index" or usual not in INSTANCE_NAMES):
                continue
        apart = len(set(zip(stamps, texts, strict=False))) == len(stamps) == len(texts)
        named = not sample.is_text(name) and usual in INSTANCE_NAMES
        turns = 4 * sum(a != b for a, b in itertools.pairwise(texts)) >= len(texts)
        likely = turns and (usual.endswith("_id") or len(different) <= _MOST_UNNAMED)
        if shared and apart and (named or likely):
            return name
    return None


_MOST_UNNAMED = 16  # sensors in a column of any name


def turns_of(names: list[str], sample: Sample) -> str | None:
    """A column of texts whose rows take turns, as those of several sensors may; or None."""
    for name in names:
        texts = sample.texts(name)
        few = 1 < len(set(texts)) <= min(_MOST_INSTANCES, len(texts) // 4) and "" not in texts
        turns = 4 * sum(a != b for a, b in itertools.pairwise(texts)) >= len(texts)
        if few and turns and form_of(texts[0]) is None:
            return name
    return None
