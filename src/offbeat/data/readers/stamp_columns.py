"""The stamp of a table: the column of times, or two that hold it together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from offbeat.data.cleaning.clocks import (
    TIME_NAMES,
    folded,
    is_rest,
    may_be_time,
    split_stamps,
    time_column_of,
)
from offbeat.data.readers.options import names as names_of
from offbeat.data.readers.stamps import form_of, is_date
from offbeat.data.readers.table_options import Sample, TableOptions, column_named, first_known
from offbeat.errors import FileFormatError, InputError, NoLogError, listed

_DATES = ("date", "day", "date_utc", "utc_date", "local_date", "datum")
_SECONDS = ("s", "sec", "secs", "second", "seconds")
_DATE_PARTS = ("year", "month", "day", "doy", "yyyy", "mm", "dd")
_MINUTES = ("minute", "minutes", "hour", "hours")  # min is a minimum


@dataclass(frozen=True)
class Stamp:
    """The columns of the times of a table.

    Attributes:
        time: the column of times; empty where rows have a fixed rate.
        rest: the second column of a stamp in two columns, or None.
        rest_unit: its unit, or `date` where `rest` is a time of day and `time` is the date.
        notes: on what was found.
    """

    time: str
    rest: str | None = None
    rest_unit: str = ""
    notes: tuple[str, ...] = ()


def stamp_columns(
    path: Path, names: list[str], options: TableOptions, sample: Sample, what: str = "column"
) -> Stamp:
    """The stamp of a table: one column, or two that hold it together.

    Raises:
        FileFormatError: there is no time, or the stamp stands in several columns.
        InputError: an option names an unknown column.
    """

    def made(time: str, rest: str | None = None, unit: str = "", note: str = "") -> Stamp:
        return Stamp(time, rest, unit, (note,) if note else ())

    def joined(time: str, rest: str, unit: str) -> Stamp:
        return made(time, rest, unit, f"the stamp is joined from columns {time!r} and {rest!r}")

    pairs = [
        pair for pair in split_stamps(names)
        if is_rest(sample.numbers(pair[0]), sample.numbers(pair[1]), pair[2])
    ]  # fmt: skip
    if options.time_column is not None:
        given = [
            column_named(name, names, "time") for name in columns_in(options.time_column, names)
        ]
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
        f"{path} has no {what} of times (called {', '.join(TIME_NAMES[:3])}, ...), got "
        f"{listed(names, 12, quoted=True)}; name one with time_column=, or give rate_hz="
    )


def _refuse_dates(
    path: Path, names: list[str], time: str, options: TableOptions, sample: Sample
) -> None:
    """Raises an error for dates beside times of day that may be of either order."""
    if form_of(first_known(sample.texts(time))) != "of day":
        return
    for name in names:
        usual = folded(name) in _DATES and name not in options.without
        if usual and sample.is_text(name) and not _is_date(sample, name):
            raise FileFormatError(
                f"{path} has dates such as {first_known(sample.texts(name))[:40]!r} in column "
                f"{name!r}, expected a form such as 2026-11-24; leave them out with "
                f"without=[{name}]"
            )


def _increases(numbers: NDArray[np.float64]) -> bool:
    steps = np.diff(numbers[np.isfinite(numbers)])
    return len(steps) > 1 and bool((steps >= 0).all()) and bool((steps > 0).any())


def _are_times(texts: Sequence[str]) -> bool:
    """Whether texts have a form of times, and more than two differ: a single one may be a date."""
    return len({*texts} - {""}) > 2 and form_of(first_known(texts)) is not None


def _is_date(sample: Sample, name: str) -> bool:
    text = first_known(sample.texts(name))
    return bool(text) and is_date(form_of(text))


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
