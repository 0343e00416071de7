"""Where the table of a text file is: its delimiter, its header, its units and its first row.

Programs write lines of description above the header, comments, a line of units below it, `sep=;`,
a header behind `#`, or none at all.
"""

from __future__ import annotations

import itertools
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

from offbeat.data.cleaning.clocks import TIME_NAMES, folded, is_unit, time_column_of
from offbeat.data.readers.stamps import form_of
from offbeat.data.readers.text import TextFile
from offbeat.errors import FileFormatError

DELIMITERS = (",", ";", "\t", "|", " ")
"""Tried in this order, where none is given; a blank stands for any number of blanks and tabs."""

COMMENTS = ("#", "%", "//")
"""Beginnings of lines of comment."""

_TIMES = frozenset(TIME_NAMES)
_TYPES = frozenset(  # words in a line of types below a header
    (
        *("float", "float32", "float64", "double", "int", "int32", "int64", "integer", "number"),
        *("bool", "boolean", "string", "str", "text", "datetime", "time", "long", "real"),
    )
)
_LINES = 200  # in which the table must begin
_NUMBER = re.compile(r"[+-]?(\d+([.,]\d*)?|[.,]\d+)([eE][+-]?\d+)?|[+-]?(nan|inf)", re.IGNORECASE)
_END = "***End_of_Header***"  # of LabVIEW, whose lines of description hold numbers, too
_GROUPS = 6  # lines above a header that may complete its names
_SEPARATOR = re.compile(r'"?sep=(.)"?\s*', re.IGNORECASE)

Row = tuple[int, list[str]]
"""The number of the last line of a row, and its fields."""


@dataclass(frozen=True)
class CsvLayout:
    """The place of a table in a text file.

    Attributes:
        delimiter: between two fields.
        names: of the columns as in the file, with units of a line of units in brackets; empty
            where one has none.
        line: of the header; 0 without one.
        first: line where the rows begin.
        notes: on what was skipped.
    """

    delimiter: str
    names: tuple[str, ...]
    line: int
    first: int
    notes: tuple[str, ...] = ()


def is_comment(text: str) -> bool:
    """Whether a line is a comment, if its table has begun."""
    return text.lstrip().startswith(COMMENTS)


def find_csv_layout(
    file: TextFile, delimiter: str | None, column_names: Sequence[str] | None
) -> CsvLayout:
    """Finds the table of a text file.

    Args:
        file: the file.
        delimiter: as given, or None.
        column_names: as given, of a file without a header, or None.

    Raises:
        FileFormatError: there is no table, or it has no header and `column_names` is None.
    """
    start = 0
    first = next(file.lines(), "")
    if match := _SEPARATOR.fullmatch(first.strip("\ufeff")):
        start, delimiter = 1, delimiter or match[1]
    for number, line in enumerate(itertools.islice(file.lines(), _LINES), 1):
        if line.startswith(_END):
            start = number
    found: list[CsvLayout] = []
    for tried in DELIMITERS if delimiter is None else (delimiter,):
        rows = [row for row in itertools.islice(file.rows(tried), _LINES) if row[0] > start]
        layout, sure = _layout(rows, tried, column_names)
        if layout is None:
            continue
        if sure and len(layout.names) > 1:
            return layout
        found.append(layout)
    if not found:
        raise FileFormatError(
            f"{file.path} must name its columns in line 1, got empty lines alone; correct its "
            "first line"
        )
    # None fits all: one whose header at least has several names, else the comma.
    layout = next((layout for layout in found if len(layout.names) > 1), found[0])
    if not layout.line and column_names is None:
        raise FileFormatError(
            f"{file.path} has no header: its first row holds numbers, {first.strip()[:60]!r}; name "
            "its columns with column_names=, such as [time, x, y]"
        )
    return layout


def _layout(
    rows: list[Row], delimiter: str, column_names: Sequence[str] | None
) -> tuple[CsvLayout | None, bool]:
    """The table as this delimiter has it, and whether header and rows agree."""
    if not rows:
        return None, False
    at = None
    for i in range(len(rows)):
        if _begins(rows, i, delimiter):
            at = i if at is None else at
            # Lines of description may hold numbers, too: the table is below a column of times.
            if i and _is_named(rows[_header(rows, i, delimiter)[0] or 0][1]):
                at = i
                break
    if at is None:  # a header alone, or no numbers
        plain = [i for i, row in enumerate(rows) if not is_comment(row[1][0])]
        head = plain[0] if plain else 0
        after = rows[head][0] + 1
        return CsvLayout(delimiter, _names(rows[head][1]), rows[head][0], after), False
    width = len(rows[at][1])
    if column_names is not None:
        names = tuple(column_names)
        first = rows[at - 1][0] + 1 if at else 1
        return CsvLayout(delimiter, names, 0, first), len(names) == width
    above, units = _header(rows, at, delimiter)
    if above is None:
        # Rows without a header are only sure of their delimiter where it splits them.
        return CsvLayout(delimiter, ("",) * width, 0, 1), False
    head = above
    names = _names(rows[head][1], delimiter)
    notes: list[str] = []
    grouped = _grouped(rows, head, names)
    if grouped != names:
        names = grouped
        notes.append("names of the header are completed by the lines above it")
    if units:
        names = tuple(
            f"{name} [{unit}]" if unit.strip("-") and name else name
            for name, unit in itertools.zip_longest(names, units, fillvalue="")
        )
        notes.append(f"line {rows[head + 1][0]} is taken for the units of the columns")
    if len(names) == width - 1 and not any(row[1][-1].strip() for row in _body(rows, at, width)):
        names = (*names, "")  # all rows end in a delimiter
    skipped = [row for row in rows[:head] if not is_comment(row[1][0])]
    if skipped:
        notes.append(f"the header is line {rows[head][0]}; lines above it are left out")
    first = rows[at - 1][0] + 1
    if not any(field.strip() for _, fields in rows[head + 1 : at] for field in fields):
        first = rows[head][0] + 1  # rows without a value
    return CsvLayout(delimiter, names, rows[head][0], first, tuple(notes)), len(names) == width


def _grouped(rows: list[Row], head: int, names: tuple[str, ...]) -> tuple[str, ...]:
    """Names with those of groups from the lines above, where they would be empty or equal.

    Motion capture writes the body and the quantity above `X`, `Y` and `Z`, pandas the outer levels
    of a `MultiIndex`. A group holds up to the next one; a line that is equal in all columns, or
    holds numbers, tells nothing apart.
    """
    counts = Counter(names)
    twice = {name for name, count in counts.items() if count > 1 or not name}
    if not twice or (names[-1:] == ("",) and counts[""] == 1 and len(twice) == 1):
        return names
    above: list[list[str]] = []
    below = rows[head][0]
    for number, fields in reversed(rows[max(0, head - _GROUPS) : head]):
        if number != below - 1 or len(fields) != len(names) or is_comment(fields[0]):
            break
        below = number
        filled: list[str] = []
        for text in map(str.strip, fields):
            filled.append(text or (filled[-1] if filled else ""))
        under = [f for f, name in zip(filled, names, strict=True) if name in twice and f]
        if len(set(under)) > 1 and not all(_NUMBER.fullmatch(f) for f in under):
            above.insert(0, filled)
    made = [
        ".".join(part for part in (*(line[i] for line in above), name) if part)
        if name in twice or (i and name and time_column_of([name]) is None)
        else name
        for i, name in enumerate(names)
    ]
    return tuple(made) if above and len(set(made)) == len(made) else names


def _body(rows: list[Row], at: int, width: int) -> list[Row]:
    return [row for row in rows[at:] if len(row[1]) == width]


def _begins(rows: list[Row], i: int, delimiter: str) -> bool:
    """Whether a row is the first one of a table: it and the next one hold numbers."""
    if not _is_data(rows[i][1], delimiter) or (i == 0 and _is_named(rows[i][1])):
        return False
    if i and _is_named(rows[i][1]) and not _is_named(rows[i - 1][1]):
        return False
    following = next((r[1] for r in rows[i + 1 :] if not is_comment(r[1][0])), None)
    if following is None:
        return True
    if _is_data(following, delimiter) and not _is_named(following):
        return len(following) == len(rows[i][1]) or i == 0 or _is_named(rows[i - 1][1])
    return bool(i) and _is_named(rows[i - 1][1])


def _is_data(fields: list[str], delimiter: str) -> bool:
    if is_comment(fields[0]):
        return False
    stripped = [field.strip() for field in fields]
    return any(
        (_NUMBER.fullmatch(field) and not (delimiter == "," and "," in field and field[0] == ","))
        or form_of(field)
        for field in stripped
    )


def _is_named(fields: list[str]) -> bool:
    """Whether a row names a column of times, as a header does."""
    words = (field for field in fields if field[:1] not in "0123456789+-." and len(field) < 60)
    return any(folded(word) in _TIMES for word in words)


def _header(rows: list[Row], at: int, delimiter: str) -> tuple[int | None, list[str] | None]:
    """The row of the header above the first row of numbers, and the fields of a row of units."""
    if at == 0:
        return None, None
    width = len(rows[at][1])
    units: list[str] | None = None
    head = at - 1
    while head > 0 and len(rows[head][1]) == len(_names(rows[head - 1][1], delimiter)):
        words = [field.strip().strip("[]()") for field in rows[head][1]]
        if _is_named(rows[head][1]) and not _is_named(rows[head - 1][1]):
            break
        if any(words) and all(not word or word == "-" or is_unit(word) for word in words):
            units = words
        elif not all(word.casefold() in _TYPES or not word.strip("-:=+") for word in words):
            break
        head -= 1
    if head < at - 1:
        return head, units
    for i in [at - 1, at - 2][: min(at, 2)]:
        if len(_names(rows[i][1], delimiter)) in (width, width - 1) and (
            not is_comment(rows[i][1][0]) or i == at - 1
        ):
            return i, None
    if not is_comment(rows[at - 1][1][0]):
        return at - 1, None
    return None, None


def _names(fields: list[str], delimiter: str = ",") -> tuple[str, ...]:
    """The names of a header, which may be a line of comment."""
    names = [field.strip() for field in fields]
    first = names[0].removeprefix("//").lstrip("#%").strip()
    if not first and names[0] and delimiter == " ":
        return tuple(names[1:])
    return (first, *names[1:])
