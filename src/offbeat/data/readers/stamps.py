"""Times as text: ISO 8601 and times of day, read to the nanosecond."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from datetime import datetime
from typing import Any

import numpy as np
from numpy.typing import NDArray

EXAMPLE = "2026-11-24T21:00:00.5Z"

_MONTHS = ("Jan", "Feb", "Mar", "Apr", "May", "Jun", "Jul", "Aug", "Sep", "Oct", "Nov", "Dec")
_DATE = (
    r"(\d{4})[-/](\d\d)[-/](\d\d)|(\d\d)\.(\d\d)\.(\d{4})"
    rf"|(\d\d)-({'|'.join(_MONTHS)})-(\d{{4}})"
)
_CLOCK = r"\d\d(?::\d\d(?::\d\d(?:[.,]\d{1,9})?)?)?"
_OFFSET = r"Z|[+-](?:[01]\d|2[0-3])(?::?[0-5]\d)?| ?UTC"
_STAMP = re.compile(rf"(?:{_DATE})(?:[T ]({_CLOCK})({_OFFSET})?)?")
_OF_DAY = re.compile(
    r"(?:-?\d{1,6} days?,? \+?)?"
    r"(\d{1,2}):([0-5]\d):([0-5]\d)(?:[.,](\d{1,9}))?(?: ?([AaPp])\.?[Mm]\.?)?",
    re.ASCII,
)
_YEARS = range(1678, 2262)  # of which an int64 of nanoseconds since 1970 holds all of
_DAY = 86_400 * 10**9


def form_of(field: str) -> str | None:
    """Whether a time is `with` or `without` an offset from UTC, or `of day`; None for other texts.

    A time is a date, and most often a T or a space and the time of day, down to nine digits after
    the second's point or comma; smaller parts may be left out. The offset is Z, UTC, +02, +0200 or
    +02:00. A date is 2026-11-24, 2026/11/24, 24.11.2026 or 24-Nov-2026. A time of day alone has
    seconds, and may end in AM or PM, or begin with a number of days, as durations of pandas do.
    """
    match = _STAMP.fullmatch(field)
    if match is None:
        return "of day" if _OF_DAY.fullmatch(field) else None
    year, month, day, day_2, month_2, year_2, day_3, name, year_3, clock, offset = match.groups()
    month = month or month_2 or f"{_MONTHS.index(name) + 1:02d}"
    try:
        made = datetime.fromisoformat(
            f"{year or year_2 or year_3}-{month}-{day or day_2 or day_3} {(clock or '00')[:8]}"
        )
    except ValueError:
        return None
    if made.year not in _YEARS:
        return None
    return "with" if offset else "without"


def date_and_time(dates: Any, times: Any, form: str) -> Any:
    """Nanoseconds since 1970 of Arrow texts of dates, and of times of day beside them.

    Raises:
        ArrowInvalid: a text is neither.
    """
    import pyarrow as pa
    import pyarrow.compute as pc

    days = stamps_of(pc.utf8_trim_whitespace(dates), form).cast(pa.int64())
    return pc.add(days, _of_day(pc.utf8_trim_whitespace(times)))


def with_stamps(
    batches: Iterable[Any], name: str, form: str, missing: Sequence[str]
) -> Iterator[Any]:
    """Converts a column of texts in batches to time stamps in nanoseconds.

    Args:
        batches: `pyarrow.RecordBatch`es.
        name: the column.
        form: result of `form_of`, equal for all of its texts.
        missing: texts of missing values.

    Raises:
        ArrowInvalid: a text is no time, or of another form.
    """
    import pyarrow as pa
    import pyarrow.compute as pc

    nothing = pa.array(missing)
    for batch in batches:
        texts = pc.utf8_trim_whitespace(batch.column(name))
        texts = pc.if_else(pc.is_in(texts, nothing), pa.scalar(None, pa.string()), texts)
        at = batch.schema.get_field_index(name)
        yield batch.set_column(at, name, stamps_of(texts, form))


def stamps_of(texts: Any, form: str) -> Any:
    """Arrow time stamps, or nanoseconds since midnight, of texts of one form.

    Raises:
        ArrowInvalid: a text is no time, or of another form.
    """
    import pyarrow as pa
    import pyarrow.compute as pc

    if form == "of day":
        return _of_day(texts)
    texts = pc.replace_substring(texts, ",", ".")
    texts = pc.replace_substring_regex(texts, r"^(\d{4})/(\d\d)/", r"\1-\2-")
    texts = pc.replace_substring_regex(texts, r"^(\d\d)\.(\d\d)\.(\d{4})", r"\3-\2-\1")
    texts = pc.replace_substring_regex(texts, r" ?UTC$", "Z")
    if pc.any(pc.match_substring_regex(texts, r"^\d\d-[A-Z]")).as_py():
        for number, month in enumerate(_MONTHS, 1):
            named = rf"^(\d\d)-{month}-(\d{{4}})"
            texts = pc.replace_substring_regex(texts, named, rf"\2-{number:02d}-\1")
    return texts.cast(pa.timestamp("ns", "UTC" if form == "with" else None))


def _of_day(texts: Any) -> Any:
    import pyarrow as pa
    import pyarrow.compute as pc

    found = pc.extract_regex(
        texts,
        r"^(?:(?P<d>-?\d{1,6}) days?,? \+?)?"
        r"(?P<h>\d{1,2}):(?P<m>[0-5]\d):(?P<s>[0-5]\d)(?:[.,](?P<f>\d{1,9}))?"
        r"(?: ?(?P<p>[AaPp])\.?[Mm]\.?)?$",
    )
    if found.null_count > texts.null_count:
        raise pa.ArrowInvalid("a text is no time of day")
    part = {name: pc.struct_field(found, name) for name in "dhmsfp"}
    days = pc.if_else(pc.equal(part["d"], ""), "0", part["d"]).cast(pa.int64())
    whole = {name: part[name].cast(pa.int64()) for name in "hms"}
    half = pc.utf8_lower(part["p"])
    twelve = pc.and_(pc.not_equal(half, ""), pc.equal(whole["h"], 12))
    hours = pc.if_else(twelve, 0, whole["h"])
    hours = pc.if_else(pc.equal(half, "p"), pc.add(hours, 12), hours)
    hours = pc.add(hours, pc.multiply(days, 24))
    minutes = pc.add(pc.multiply(hours, 60), whole["m"])
    seconds = pc.add(pc.multiply(minutes, 60), whole["s"])
    digits = pc.utf8_rpad(part["f"], 9, "0").cast(pa.int64())
    return pc.add(pc.multiply(seconds, 10**9), digits)


def over_midnight(clock: NDArray[np.int64]) -> NDArray[np.int64]:
    """Nanoseconds since midnight of the first row, for times of day that pass midnight."""
    days = np.cumsum(np.diff(clock, prepend=clock[:1]) < -_DAY // 2)
    return clock + _DAY * days


def expected_after(first: str) -> str:
    """Expected form of the times of a file, by the first one, for messages."""
    form = form_of(first)
    if form is None:
        return f"a number, or in all rows a time of ISO 8601, such as {EXAMPLE}"
    if form == "of day":
        return f"a time of day, as {first!r} is"
    return (
        f"a time of ISO 8601 {form} an offset from UTC, as {first!r} is, of the years 1678 to "
        "2261, with up to nine digits after the second's point"
    )
