"""Times as text: ISO 8601, read to the nanosecond."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from datetime import datetime
from typing import Any

EXAMPLE = "2026-11-24T21:00:00.5Z"

_STAMP = re.compile(
    r"(\d{4}-\d\d-\d\d)(?:[T ](\d\d(?::\d\d(?::\d\d(?:\.\d{1,9})?)?)?)"
    r"(Z|[+-](?:[01]\d|2[0-3])(?::?[0-5]\d)?)?)?"
)
_YEARS = range(1678, 2262)  # of which an int64 of nanoseconds since 1970 holds all of


def form_of(field: str) -> str | None:
    """Whether a time is `with` or `without` an offset from UTC; None if the text is not a time.

    A time is a date, and most often a T or a space and the time of day, down to nine digits after
    the second's point; smaller parts may be left out. The offset is Z, +02, +0200 or +02:00.
    """
    match = _STAMP.fullmatch(field)
    if match is None:
        return None
    day, clock, offset = match.groups()
    try:
        made = datetime.fromisoformat(f"{day} {(clock or '00')[:8]}")
    except ValueError:
        return None
    if made.year not in _YEARS:
        return None
    return "with" if offset else "without"


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

    kind, nothing = pa.timestamp("ns", "UTC" if form == "with" else None), pa.array(missing)
    for batch in batches:
        texts = pc.utf8_trim_whitespace(batch.column(name))
        texts = pc.if_else(pc.is_in(texts, nothing), pa.scalar(None, pa.string()), texts)
        yield batch.set_column(batch.schema.get_field_index(name), name, texts.cast(kind))


def expected_after(first: str) -> str:
    """Expected form of the times of a file, by the first one, for messages."""
    form = form_of(first)
    if form is None:
        return f"a number, or in all rows a time of ISO 8601, such as {EXAMPLE}"
    return (
        f"a time of ISO 8601 {form} an offset from UTC, as {first!r} is, of the years 1678 to "
        "2261, with up to nine digits after the second's point"
    )
