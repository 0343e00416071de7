"""CSV, read as a data set: a header, then one row per time, or one per measured value."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from offbeat.data.cleaning.clocks import state_time_unit
from offbeat.data.readers.columns import Columns, unit_written
from offbeat.data.readers.csv_fields import MISSING
from offbeat.data.readers.csv_file import CsvFile
from offbeat.data.readers.csv_layout import find_csv_layout
from offbeat.data.readers.csv_lines import CsvSample
from offbeat.data.readers.gathered import recordings
from offbeat.data.readers.options import names as names_of
from offbeat.data.readers.table_options import TableOptions
from offbeat.data.readers.text import TextFile
from offbeat.data.recording import Recording
from offbeat.data.signals import MOST_CHANNELS
from offbeat.data.source import require_file
from offbeat.errors import FileFormatError, InputError, one_of


def read_csv(
    path: str | Path,
    *,
    time_column: str | Sequence[str] | None = None,
    trajectory_column: str | None = None,
    channels: Sequence[str] | None = None,
    without: Sequence[str] = (),
    time_unit: str | None = None,
    units: Mapping[str, str] | None = None,
    delimiter: str | None = None,
    channel_column: str | None = None,
    value_column: str | None = None,
    instance_column: str | None = None,
    decimal: str | None = None,
    missing: Sequence[str | float] = (),
    column_names: Sequence[str] | None = None,
    rate_hz: float | None = None,
    day_first: bool | None = None,
) -> list[Recording]:
    """Reads recordings from CSV: a header, then one row per time, or one per measured value.

    The text is UTF-8, UTF-16 with a byte order mark, or else Windows-1252, which is noted; it may
    be compressed by gzip, bzip2 or xz. Lines above the header, comments (`#`, `%`, `//`), `sep=;`
    and a line of units are found. A first column without a name that counts the rows, as pandas
    writes it, is left out; one that holds times is the time. Columns of text are left out, which
    is noted. A unit in brackets after a name, as in `speed [m/s]`, is the channel's unit and no
    part of its name. Times keep every digit down to the nanosecond, as numbers and as texts
    of ISO 8601, whose clock counts nanoseconds since 1970 (in UTC if they have an offset); times of
    day count from midnight. A file that ends in the middle of a row is read up to there. The
    file is read a mebibyte at a time.

    Args:
        path: the file.
        time_column: the column of times, or two that hold the stamp together, as `[sec, nanosec]`
            and `[Date, Time]`; by default found by their names, such as `time` or `stamp`.
        trajectory_column: the column with the trajectory of each row, as a number or
            any text; by default found by its name, such as `episode`. Without one, the file is one
            trajectory.
        channels: the columns to read as channels (in the long form: their names in the column of
            channels), in this order; by default all numbers.
        without: columns to leave out.
        time_unit: `s`, `ms`, `us`, `100ns`, `ns`, `min`, `h` or `d`; by default from the column's
            name, else detected from the numbers, which is noted, else `s`. Times of ISO 8601 need
            none.
        units: unit of a channel by its name.
        delimiter: the character between two fields, a blank for any number of them; by default
            the comma, semicolon, tab, bar or blank that the header has.
        channel_column: the column with the channel of each value, in the long form; by
            default used if the table has only a time, a `channel` of texts and a `value`.
        value_column: the column of values, in the long form.
        instance_column: the column with the sensor of each row, where rows of several sensors take
            turns; each sensor has channels of its own. By default one that is named like
            `instance` or `sensor` and tells the rows apart.
        decimal: the decimal separator of numbers, `.` or `,`; by default the comma where fields are
            separated by something else and their numbers have commas and no points.
        missing: more fields whose value is not known, such as `-999` or `lost`.
        column_names: names of the columns of a file without a header.
        rate_hz: rows per second, for a file without times.
        day_first: of dates such as 07/08/2026, whether the day is before the month; by default
            decided by a number above 12 in the first rows, else asked for.

    Returns:
        A recording per trajectory, in the order of their first rows; a field that is empty, or
        another of `MISSING`, is NaN.

    Raises:
        FileFormatError: the file is missing or empty, its header or a row is invalid, or
            a field is not a number.
        InputError: an option names an unknown column or unit, or has a wrong type.
    """
    if delimiter is not None and not (
        isinstance(delimiter, str)
        and len(delimiter) == 1
        and delimiter.isascii()
        and delimiter not in '"\r\n'
    ):
        raise InputError(
            f"delimiter must be one ASCII character, no quote or line end, got {delimiter!r}"
        )
    if decimal is not None:
        one_of("decimal", decimal, (".", ","))
    column_names = names_of("column_names", column_names)
    options = TableOptions(
        time_column=time_column,
        trajectory_column=trajectory_column,
        channels=channels,
        without=without,
        units=units,
        channel_column=channel_column,
        value_column=value_column,
        instance_column=instance_column,
        rate_hz=rate_hz,
        day_first=day_first,
    )
    text = TextFile.of(require_file(path))
    layout = find_csv_layout(text, delimiter, column_names)
    file = CsvFile(text, layout, decimal, (*MISSING, *map(str, missing)), day_first=day_first)
    header, noted = file.header()
    notes = [*noted]
    file, header = file.with_units(header)
    sample = file.sample(header)
    if decimal is None:
        decimal, more = file.decimal_of(sample)
        file = replace(file, decimal=decimal or ".", thousands=bool(decimal))
        sample = CsvSample(sample.fields, file)
        notes += more
    named = [name for name in header if name]
    if channels is None and len(named) > MOST_CHANNELS:
        raise FileFormatError(
            f"{text.path} has {len(named)} columns, more than {MOST_CHANNELS}; choose some with "
            "channels="
        )
    columns = Columns.of(text.path, named, options, sample)
    if columns.rest or not columns.time or sample.form_of(columns.time):
        unit, found = "ns", False
    else:
        time_unit = time_unit or unit_written(header, columns.time)
        stated = state_time_unit(
            time_unit, columns.time, sample.numbers(columns.time), str(text.path)
        )
        unit, found = stated.unit, stated.found
        notes += stated.notes
    columns, table, counted_in = file.columns(header, sample, columns, unit, rate_hz)
    notes += [*text.notes, *file.notes]
    if text.cuts:
        notes.append(f"the compressed data end early ({text.cuts[0]}); they are read up to there")
    return recordings(text.path, columns, counted_in, notes, table, shown=unit, found=found)
