"""JSON: an object per line, an array of objects, or an object of columns, as a table."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from offbeat.data.cleaning.clocks import time_column_of
from offbeat.data.memory import require_memory, require_rows
from offbeat.data.readers.arrow_columns import TableSource, recordings_of
from offbeat.data.readers.csv_fields import MISSING, number_in
from offbeat.data.readers.table_options import LABEL_NAMES, TableOptions
from offbeat.data.readers.text import TextFile, start_of
from offbeat.data.recording import Recording
from offbeat.data.signals import MOST_CHANNELS
from offbeat.data.source import require_file
from offbeat.errors import FileFormatError, NoLogError

_DEEPEST = 10
_WHOLE = 1 << 26  # bytes of a file that is looked at as a whole
_MANY, _SPARSE = 10**7, 200  # cells of a table, and cells for each value
_LONGEST_LIST = 64  # a longer one is a scan or a picture
_TYPES = ("type", "topic", "msg_type", "message_type", "mavpackettype", "msg")
"""Names of texts that say which message a row is of, at any depth."""

Row = dict[str, Any]


def read_json_lines(
    path: str | Path,
    *,
    time_column: str | Sequence[str] | None = None,
    trajectory_column: str | None = None,
    channels: Sequence[str] | None = None,
    without: Sequence[str] = (),
    time_unit: str | None = None,
    units: Mapping[str, str] | None = None,
    channel_column: str | None = None,
    value_column: str | None = None,
    instance_column: str | None = None,
    rate_hz: float | None = None,
    day_first: bool | None = None,
) -> list[Recording]:
    """Reads recordings from JSON: a row per object.

    Each line is an object; or the file is an array of objects, an object of arrays, or one with
    `columns` and `data`, as pandas writes them. Objects in objects give columns `pose.x`, lists of
    up to 64 numbers `q[0]`. Texts that are numbers in all rows are numbers. Where a `type` or
    `topic` names the message of each row and the fields differ, each message has columns of its
    own, `IMU.acc.x`. A last line that is cut off is left out, which is noted.

    Args:
        path: the file; it may be compressed, as text.
        time_column: as of `read_csv`.
        trajectory_column: as of `read_csv`.
        channels: as of `read_csv`.
        without: as of `read_csv`.
        time_unit: as of `read_csv`.
        units: as of `read_csv`.
        channel_column: as of `read_csv`.
        value_column: as of `read_csv`.
        instance_column: as of `read_csv`.
        rate_hz: as of `read_csv`.
        day_first: as of `read_csv`.

    Raises:
        FileFormatError: a line is no JSON, no object, or nested too deeply; there is no time, or no
            channel of numbers.
        InputError: an option names an unknown column or unit.
    """
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
    path = require_file(path)
    require_memory(path, 8 * path.stat().st_size, f"{path.stat().st_size} bytes of JSON")
    notes: list[str] = []
    return recordings_of_rows(_rows(path, notes), path, "JSON", options, time_unit, notes)


def recordings_of_rows(
    objects: Iterable[Any],
    path: Path,
    what: str,
    options: TableOptions,
    time_unit: str | None,
    notes: list[str],
) -> list[Recording]:
    """Recordings of nested objects, one per row.

    Args:
        objects: dicts of numbers, texts, lists and dicts.
        path: the file, for messages.
        what: name of the format, for messages.
        options: which columns are what.
        time_unit: as of `read_csv`.
        notes: on the file, also such as are added while the objects are read.

    Raises:
        FileFormatError: one is no dict, or nested too deeply; there is no time, or no channel of
            numbers.
        InputError: an option names an unknown column or unit.
    """
    rows = _by_type([_flat(row, path, i) for i, row in enumerate(objects)])
    if not rows:
        raise NoLogError(f"{path} holds no rows, expected an object for each")
    names = dict.fromkeys(name for row in rows for name in row)
    if len(names) > MOST_CHANNELS:
        raise FileFormatError(f"{path} has {len(names)} columns, more than {MOST_CHANNELS}")
    cells, stated = len(rows) * len(names), sum(map(len, rows))
    if cells > _MANY and cells > _SPARSE * stated:
        raise FileFormatError(
            f"{path} has {len(names)} names in {len(rows)} rows, most in few rows; write the "
            "name as a value, of a column such as channel"
        )
    require_rows(path, len(rows), len(names))
    import pyarrow as pa

    for name in names:
        if name not in options.without:
            _check_texts(path, name, [row.get(name) for row in rows])
    table = pa.table({name: _column([row.get(name) for row in rows]) for name in names})
    made = recordings_of(TableSource(path, what, table), options, time_unit)
    return [replace(one, notes=(*one.notes, *notes)) for one in made]


def recognises(path: Path) -> bool:
    """Whether a file of JSON holds a table, and no metadata."""
    if ".json" not in (path.suffix.lower(), Path(path.stem).suffix.lower()):
        return True
    lines = [line for line in start_of(path).splitlines() if line.strip()]
    if lines and lines[0].lstrip().startswith(b"["):
        return True
    try:
        if len(lines) > 1 and lines[1].startswith(b"{") and _parsed(lines[0].decode()):
            return True
        small = path.stat().st_size <= _WHOLE
        whole = _parsed(path.read_text(encoding="utf-8-sig")) if small else None
    except (OSError, ValueError):
        return False
    return isinstance(whole, dict) and (_is_table(whole) or _list_in(whole) is not None)


def _rows(path: Path, notes: list[str]) -> Iterator[Row]:
    """The objects of a file."""
    text = TextFile.of(path)
    lines = text.lines()
    start = ""
    for line in lines:
        start = line.strip().lstrip("\ufeff")
        if start:
            break
    first = _parsed(start)
    if isinstance(first, dict) and not _is_table(first) and _list_in(first) is None:
        yield first
        yield from _of_lines(path, lines, notes)
        return
    whole = first if first is not None else _parsed(start + "".join(lines))
    if whole is None:
        raise FileFormatError(f"{path} is no JSON: {start[:60]!r}; it is cut off, or of other text")
    if isinstance(whole, dict):
        yield from _of_columns(whole, path)
    elif isinstance(whole, list):
        yield from whole


def _parsed(text: str) -> Any:
    """The value of a text of JSON, or None if it is none."""
    try:
        return json.loads(text)
    except (ValueError, RecursionError):
        return None


def _of_lines(path: Path, lines: Iterator[str], notes: list[str]) -> Iterator[Row]:
    bad = ""
    for number, line in enumerate(lines, 2):
        if not line.strip():
            continue
        if bad:
            raise FileFormatError(f"{path} has {bad}, expected an object of JSON in each line")
        row = _parsed(line)
        if isinstance(row, dict):
            yield row
        else:
            bad = f"{line.strip()[:60]!r} in line {number}"
    if bad:
        notes.append("the last line is cut off, and left out")


def _is_table(value: Mapping[str, Any]) -> bool:
    """Whether an object is a whole table: columns of equal length, or `columns` and `data`."""
    if isinstance(value.get("columns"), list) and isinstance(value.get("data"), list):
        return True
    inner = list(value.values())
    lists = [one for one in inner if isinstance(one, list)]
    if len(lists) == len(inner) > 1:
        return len({len(one) for one in lists}) == 1 and len(lists[0]) > 1
    indexed = [list(one) for one in inner if isinstance(one, dict)]
    return len(indexed) == len(inner) > 1 and all(
        one == indexed[0] and one[:2] == ["0", "1"] for one in indexed
    )


def _list_in(whole: Mapping[str, Any]) -> list[Any] | None:
    """The rows in an object: its only list of objects, or its values if they are numbered."""
    inner = list(whole.values())
    if list(whole)[:2] == ["0", "1"] and all(isinstance(one, dict) for one in inner):
        return inner
    lists = [one for one in inner if isinstance(one, list) and len(one) > 1]
    rows = [one for one in lists if all(isinstance(row, dict) for row in one)]
    return rows[0] if len(rows) == 1 else None


def _of_columns(whole: Mapping[str, Any], path: Path) -> Iterator[Row]:
    if not _is_table(whole):
        yield from _list_in(whole) or [dict(whole)]
        return
    if isinstance(whole.get("columns"), list):
        for row in whole["data"]:
            if not isinstance(row, list) or len(row) != len(whole["columns"]):
                raise FileFormatError(f"{path} has rows of other lengths than its columns")
            yield {str(name): value for name, value in zip(whole["columns"], row, strict=True)}
        return
    columns = [list(c.values()) if isinstance(c, dict) else c for c in whole.values()]
    for values in zip(*columns, strict=True):
        yield dict(zip(whole, values, strict=True))


def _flat(row: Any, path: Path, i: int) -> Row:
    """An object without objects in it."""
    if not isinstance(row, dict):
        raise FileFormatError(
            f"{path} has {str(row)[:40]!r} in row {i}, expected an object with the time and values"
        )
    found: Row = {}

    def put(name: str, value: Any, depth: int) -> None:
        if depth > _DEEPEST:
            raise FileFormatError(f"{path} nests objects more than {_DEEPEST} deep, in row {i}")
        if isinstance(value, dict) and len(value) == 1 and (key := next(iter(value)))[:1] == "$":
            put(name, value[key], depth + 1)  # a type of MongoDB, as {"$date": ...}
        elif isinstance(value, dict):
            for key, inner in value.items():
                put(f"{name}.{key}" if name else str(key), inner, depth + 1)
        elif isinstance(value, list):
            for k, inner in enumerate(value if len(value) <= _LONGEST_LIST else ()):
                put(f"{name}[{k}]", inner, depth + 1)
        else:
            found[name] = value

    put("", row, 0)
    return found


def _by_type(rows: list[Row]) -> list[Row]:
    """Rows in which each type of message has names of its own, if their fields differ."""
    for key in dict.fromkeys(name for row in rows[:1000] for name in row):
        if key.rpartition(".")[2] not in _TYPES:
            continue
        fields: dict[str, set[str]] = {}
        for row in rows:
            if not isinstance(row.get(key), str):
                break
            fields.setdefault(row[key], set()).update(row)
        else:
            if 1 < len(fields) <= 1000 and len({frozenset(f) for f in fields.values()}) > 1:
                common = set.intersection(*fields.values())
                kept = {name for name in common if _is_common(name)}
                return [
                    {n if n in kept else f"{row[key]}.{n}": v for n, v in row.items() if n != key}
                    for row in rows
                ]
    return rows


def _is_common(name: str) -> bool:
    """Whether a field of all messages is the time or the trajectory."""
    return time_column_of([name]) is not None or name.casefold() in LABEL_NAMES


def _check_texts(path: Path, name: str, values: list[Any]) -> None:
    """Raises an error for a text among numbers."""
    texts = [i for i, v in enumerate(values) if isinstance(v, str) and v.strip() not in MISSING]
    texts = [i for i in texts if number_in(values[i], ".") is None]
    numbers = sum(isinstance(v, int | float) for v in values)
    if texts and numbers > len(texts):
        raise FileFormatError(
            f"{path} has {values[texts[0]][:40]!r} in row {texts[0]}, {name!r}, expected a number; "
            "leave the column out with without="
        )


def _column(values: list[Any]) -> Any:
    """An Arrow array of integers, numbers, booleans or texts, null where there is no value."""
    import pyarrow as pa

    known = [v for v in values if v is not None]
    if all(isinstance(v, bool) for v in known):
        return pa.array(values, pa.bool_())
    if all(isinstance(v, int) and abs(v) < 2**63 for v in known):
        return pa.array(values, pa.int64())
    if all(isinstance(v, int | float) for v in known):
        return pa.array([None if v is None else _float(v) for v in values], pa.float64())
    texts = [v if isinstance(v, str) else None if v is None else json.dumps(v) for v in values]
    numbers = [None if t is None or t in MISSING else number_in(t, ".") for t in texts]
    stated = [t for t in texts if t is not None and t not in MISSING]
    if stated and sum(n is not None for n in numbers) == len(stated):
        whole = all(t.lstrip("-").isdecimal() and len(t) < 19 for t in stated)
        if whole:
            return pa.array([None if n is None else int(t or 0) for n, t in
                             zip(numbers, texts, strict=True)], pa.int64())  # fmt: skip
        return pa.array(numbers, pa.float64())
    return pa.array(texts, pa.string())


def _float(value: float) -> float:
    try:
        return float(value)
    except OverflowError:
        return float(np.copysign(np.inf, value))
