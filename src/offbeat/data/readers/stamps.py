"""Times as text: ISO 8601, other dates, and times of day, read to the nanosecond."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from datetime import datetime, timedelta
from typing import Any

import numpy as np
from numpy.typing import NDArray

from offbeat.errors import InputError

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
_OF_HOUR = re.compile(r"([0-5]?\d):([0-5]\d)[.,](\d{1,9})", re.ASCII)
_AFTER = (  # a date: the time of day, and an offset
    r"(?:(?:T|[ ,]+)(?P<h>\d{1,2}):(?P<i>[0-5]\d)(?::(?P<s>[0-5]\d)(?:[.,](?P<f>\d{1,9}))?)?"
    r"(?: ?(?P<p>[AaPp])\.?[Mm]\.?)?)? ?(?P<o>Z|UTC|[+-]\d\d:?\d\d)?"
)
_NAMED = rf"(?P<b>(?i:{'|'.join(_MONTHS)}))[a-z]*\.?"
_SLASHED = r"(?P<d>\d{1,2})[/-](?P<m>\d{1,2})[/-](?P<y>\d{4})"
_OTHERS = {  # forms of dates besides that of ISO 8601
    "day first": _SLASHED,
    "month first": _SLASHED.replace("<d>", "<x>").replace("<m>", "<d>").replace("<x>", "<m>"),
    "year first": r"(?P<y>\d{4})[-/.](?P<m>\d{1,2})[-/.](?P<d>\d{1,2})",
    "pointed": r"(?P<d>\d{1,2})\.(?P<m>\d{1,2})\.(?P<y>\d{4})",
    "named": rf"(?:[A-Z][a-z][a-z],? )?(?P<d>\d{{1,2}})[ -]{_NAMED},?[ -](?P<y>\d{{4}})",
    "named first": rf"(?:[A-Z][a-z][a-z],? )?{_NAMED} +(?P<d>\d{{1,2}}),? +(?P<y>\d{{4}})",
    "day of year": r"(?P<y>\d{4})-(?P<j>\d{3})",
}
_COMPACT = (
    r"(?P<y>\d{4})-?(?P<m>\d\d)-?(?P<d>\d\d)[T_ -](?P<h>\d\d)[:-]?(?P<i>[0-5]\d)[:-]?"
    r"(?P<s>[0-5]\d)(?:[.,](?P<f>\d{1,9}))?(?P<p>)(?P<o>Z|[+-]\d\d:?\d\d)?"
)
_OF_C = (  # as ctime of C writes it
    rf"(?:[A-Z][a-z][a-z] +)?{_NAMED} +(?P<d>\d{{1,2}}) (?P<h>\d\d):(?P<i>[0-5]\d):(?P<s>[0-5]\d)"
    r"(?:[.,](?P<f>\d{1,9}))?(?P<p>)(?P<o>(?: UTC)?) (?P<y>\d{4})"
)
_COLON = r":(\d{3})$"  # before milliseconds, which some write like that
_PATTERNS = {form: f"^{date}{_AFTER}$" for form, date in _OTHERS.items()}
_PATTERNS |= {"compact": f"^{_COMPACT}$", "of C": f"^{_OF_C}$"}
_COMPILED = {form: re.compile(pattern, re.ASCII) for form, pattern in _PATTERNS.items()}
_EITHER = "day or month first"
_YEARS = range(1678, 2262)  # of which an int64 of nanoseconds since 1970 holds all of
_HOUR = 3600 * 10**9
_DAY = 24 * _HOUR


def form_of(field: str) -> str | None:
    """The form of a time: `with` or `without` an offset from UTC, `of day`, another, or None.

    A time is a date, and most often a T or a space and the time of day, down to nine digits after
    the second's point or comma; smaller parts may be left out. The offset is Z, UTC, +02, +0200 or
    +02:00. A date is 2026-11-24, 2026/11/24, 24.11.2026 or 24-Nov-2026. A time of day alone has
    seconds, and may end in AM or PM, or begin with a number of days, as durations of pandas do; one
    without hours has a fraction and is `of hour`. Other forms are those of `_PATTERNS`, such as
    `month first`, 11/24/2026 9:05:00 PM; a date whose day and month are both at most 12 may be of
    two, and `form_in` decides by the others of its column.
    """
    field = re.sub(_COLON, r".\1", field) if len(field) < 60 and field.count(":") == 3 else field
    match = _STAMP.fullmatch(field)
    if match is None:
        if _OF_DAY.fullmatch(field):
            return "of day"
        return "of hour" if _OF_HOUR.fullmatch(field) else _other_form(field)
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


def form_in(texts: Iterable[str], day_first: bool | None = None, *, where: str = "") -> str | None:
    """The form of the times of a column, by its first texts; empty ones are not known.

    Args:
        texts: the first ones.
        day_first: of dates such as 07/08/2026, whether the day is before the month; by default the
            texts decide, by a number above 12.
        where: the file, for messages.

    Raises:
        InputError: no text decides.
    """
    known = (text for text in texts if text)
    first = next(known, "")
    form = form_of(first)
    if form not in (_EITHER, "day first", "month first"):
        return form
    if day_first is not None:
        return "day first" if day_first else "month first"
    found = (
        form if form != _EITHER else next((f for f in map(form_of, known) if f != _EITHER), None)
    )
    if found is None:
        raise InputError(
            f"{where}{': ' * bool(where)}dates such as {first[:40]!r} may begin with the day or "
            "the month; say which with day_first=true or day_first=false"
        )
    return found


def is_date(form: str | None) -> bool:
    """Whether times of a form have a date."""
    return form not in (None, "of day", "of hour")


def fits_form(text: str, form: str | None) -> bool:
    """Whether a time has a form, as others of its column."""
    found = form_of(text)
    return found == form or (found == _EITHER and form in ("day first", "month first"))


def _other_form(field: str) -> str | None:
    """The form of a date that is not of ISO 8601, if it is one."""
    if len(field) > 60:
        return None
    fitting = [form for form, pattern in _COMPILED.items() if _is_moment(pattern.fullmatch(field))]
    return _EITHER if len(fitting) > 1 else next(iter(fitting), None)


def _is_moment(match: re.Match[str] | None) -> bool:
    if match is None:
        return False
    part = match.groupdict()
    month = _MONTHS.index(part["b"].capitalize()) + 1 if part.get("b") else part.get("m") or 1
    hour = int(part["h"] or 0)
    try:
        made = datetime(int(part["y"]), int(month), int(part.get("d") or 1))
        made += timedelta(days=int(part.get("j") or 1) - 1)
    except (ValueError, OverflowError):
        return False
    return made.year in _YEARS and hour < (13 if part["p"] else 24)


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

    if any(text.count(":") == 3 for text in texts.drop_null()[:1].to_pylist()):
        texts = pc.replace_substring_regex(texts, _COLON, r".\1")
    if form == "of day":
        return _of_day(texts)
    if form == "of hour":
        return _of_day(pc.binary_join_element_wise("0", texts, ":"))
    if form in _PATTERNS:
        return _of_pattern(texts, _PATTERNS[form])
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
    days = _whole(part["d"])
    clock = _clock(part["h"], part["m"], part["s"], part["f"], part["p"])
    return pc.add(clock, pc.multiply(days, _DAY))


def _whole(texts: Any) -> Any:
    """Integers of Arrow texts of digits, 0 for empty ones."""
    import pyarrow as pa
    import pyarrow.compute as pc

    return pc.if_else(pc.equal(texts, ""), "0", texts).cast(pa.int64())


def _clock(hour: Any, minute: Any, second: Any, fraction: Any, half: Any) -> Any:
    """Nanoseconds since midnight of Arrow texts; `half` is a for AM, p for PM, or empty."""
    import pyarrow.compute as pc

    half = pc.utf8_lower(half)
    hours = _whole(hour)
    twelve = pc.and_(pc.not_equal(half, ""), pc.equal(hours, 12))
    hours = pc.if_else(twelve, 0, hours)
    hours = pc.if_else(pc.equal(half, "p"), pc.add(hours, 12), hours)
    minutes = pc.add(pc.multiply(hours, 60), _whole(minute))
    seconds = pc.add(pc.multiply(minutes, 60), _whole(second))
    return pc.add(pc.multiply(seconds, 10**9), _whole(pc.utf8_rpad(fraction, 9, "0")))


def _of_pattern(texts: Any, pattern: str) -> Any:
    """Nanoseconds since 1970 of Arrow texts of one of `_PATTERNS`."""
    import pyarrow as pa
    import pyarrow.compute as pc

    found = pc.extract_regex(texts, pattern)
    if found.null_count > texts.null_count:
        raise pa.ArrowInvalid("a text is no time of the form of the others")
    kind = found.type
    part = {kind[i].name: pc.struct_field(found, kind[i].name) for i in range(kind.num_fields)}
    month = part.get("m", pa.scalar("01"))
    if "b" in part:
        names = pc.utf8_capitalize(part["b"])
        numbers = pc.add(pc.index_in(names, pa.array(_MONTHS)), 1)
        month = numbers.cast(pa.string())
    day = part.get("d", pa.scalar("01"))
    month, day = (pc.utf8_lpad(text, 2, "0") for text in (month, day))
    dates = pc.binary_join_element_wise(part["y"], month, day, "-")
    clock = _clock(*(part[name] for name in "hisfp"))
    if "j" in part:
        clock = pc.add(clock, pc.multiply(pc.subtract(_whole(part["j"]), 1), _DAY))
    stamps = pc.add(dates.cast(pa.timestamp("ns")).cast(pa.int64()), clock)
    offset = part["o"]
    stated = pc.not_equal(offset, "")
    if pc.any(stated).as_py():
        if not pc.all(stated).as_py():
            raise pa.ArrowInvalid("some times have an offset from UTC, and some have none")
        ahead = pc.extract_regex(
            pc.if_else(pc.is_in(offset, pa.array(["Z", "UTC"])), "+00:00", offset),
            r"^(?P<sign>[+-])(?P<h>\d\d):?(?P<m>\d\d)$",
        )
        hours, minutes = (_whole(pc.struct_field(ahead, name)) for name in "hm")
        size = pc.add(pc.multiply(hours, _HOUR), pc.multiply(minutes, _HOUR // 60))
        east = pc.equal(pc.struct_field(ahead, "sign"), "+")
        stamps = pc.if_else(east, pc.subtract(stamps, size), pc.add(stamps, size))
    return stamps.cast(pa.timestamp("ns"))


def over_midnight(clock: NDArray[np.int64], form: str | None = "of day") -> NDArray[np.int64]:
    """Nanoseconds since midnight of the first row, for times of day that pass midnight.

    Those without hours, `of hour`, pass whole hours. Times with dates are given back.
    """
    if is_date(form):
        return clock
    turn = _HOUR if form == "of hour" else _DAY
    turns = np.cumsum(np.diff(clock, prepend=clock[:1]) < -turn // 2)
    return clock + turn * turns


def expected_after(first: str) -> str:
    """Expected form of the times of a file, by the first one, for messages."""
    form = form_of(first)
    if form is None:
        return (
            f"a number, or in all rows a time of ISO 8601, such as {EXAMPLE}, or a time of day "
            "with its seconds, such as 21:00:00"
        )
    if form not in ("with", "without"):
        return f"a time of the form of {first!r}"
    return (
        f"a time of ISO 8601 {form} an offset from UTC, as {first!r} is, of the years 1678 to "
        "2261, with up to nine digits after the second's point"
    )
