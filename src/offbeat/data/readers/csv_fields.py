"""Fields of text tables: numbers, booleans, and missing values in the forms programs write."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

from offbeat.data.cleaning.clocks import is_unit
from offbeat.data.readers.columns import Columns

MISSING = (
    *("", "NaN", "nan", "NAN", "NA", "N/A", "n/a", "#N/A", "<NA>", "null", "NULL", "Null", "None"),
    *("none", "nil", "NaT", "-", "--", "---", "?", ".", "-nan", "-NaN", "+nan", "nan(ind)"),
    *("-nan(ind)", "NaN(ind)", "-NaN(ind)", "nan(snan)", "1.#QNAN", "-1.#QNAN", "1.#IND"),
    *("-1.#IND", "1.#SNAN", "-1.#SNAN", "#DIV/0!", "#VALUE!", "#NUM!", "#REF!", "#NULL!"),
    *("#NAME?", "#N/A N/A", "*", "missing", "Missing", "undefined"),
)
"""Fields whose value is not known."""

_MINUS = "\u2212"  # the sign of mathematics
BOOLEANS = ("true", "false", "True", "False", "TRUE", "FALSE")
SWITCHES = {"yes": 1, "no": 0, "on": 1, "off": 0}
"""Words for 1 and 0, in any case, in a column that holds no others."""

_HEX = re.compile(r"0[xX][0-9a-fA-F]{1,13}")
_FORTRAN = r"^([+-]?(?:[0-9]+(?:\.[0-9]*)?|\.[0-9]+))[dD]([+-]?[0-9]+)$"

_NUMBER = r"^[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]+)?$|^[+-]?(inf|infinity|nan)$"
_INFINITE = r"^([+-]?)1\.#(INF|inf).*$"
_THOUSANDS = r"^[+-]?[1-9][0-9]{0,2}(,[0-9]{3})+(\.[0-9]*)?$"
GROUPED_BY_POINTS = re.compile(r"[+-]?[1-9][0-9]{0,2}(\.[0-9]{3})+,[0-9]+")
"""Numbers with a decimal comma, and a point for each thousand."""

_APART = " '\u2019\u00a0\u2009\u202f"
_GROUPED_BY_OTHERS = rf"^([+-]?[1-9][0-9]{{0,2}})((?:[{_APART}][0-9]{{3}})+)((?:\.[0-9]*)?)$"
"""Numbers with a blank or an apostrophe for each thousand."""

_GROUPED_BY_COMMAS = re.compile(_THOUSANDS)


_CELL = re.compile(r"[+-]?[0-9.][0-9.,]*(?:[eE][+-]?[0-9]+)?(\s*)([^\s0-9.,][^0-9,]{0,11})")
_CLOSE = frozenset("sVA%°mNWKghC")  # units of one letter that may follow a number without a blank


def unit_of_fields(fields: Iterable[str]) -> str:
    """The unit that follows each of the numbers of a column, as in `12.5 V`; empty if none does."""
    found = set()
    for text in fields:
        match = _CELL.fullmatch(text)
        if match is None or not is_unit(match[2]):
            return ""
        if not match[1] and len(match[2]) == 1 and match[2] not in _CLOSE:
            return ""
        found.add(match[2])
    return found.pop() if len(found) == 1 else ""


def without_unit(text: str, unit: str) -> str:
    """A field without the unit after its number."""
    return text.removesuffix(unit).rstrip() if unit else text


def number_in(text: str, decimal: str) -> float | None:
    """The number in a field, or None."""
    if decimal != ".":
        if GROUPED_BY_POINTS.fullmatch(text.strip()):
            text = text.replace(".", "")
        text = text.replace(".", "?").replace(decimal, ".")
    elif "," in text and _GROUPED_BY_COMMAS.fullmatch(text.strip()):
        text = text.replace(",", "")
    try:
        number = float(text)
    except ValueError:
        text = text.strip()
        if text[:1] == _MINUS:
            return number_in(f"-{text[1:]}", ".")
        if grouped := re.match(_GROUPED_BY_OTHERS, text):
            return float(f"{grouped[1]}{re.sub('[^0-9]', '', grouped[2])}{grouped[3]}")
        if infinite := re.match(_INFINITE, text):
            return float(f"{infinite[1]}inf")
        if fortran := re.match(_FORTRAN, text):
            return float(f"{fortran[1]}e{fortran[2]}")
        return float(int(text, 16)) if _HEX.fullmatch(text) else None
    # Python allows _ between digits, and digits of other scripts; CSV does not.
    return number if text.isascii() and "_" not in text else None


@dataclass
class Bad:
    """Fields of a column that are no numbers.

    Attributes:
        row: of the first one.
        count: of all.
    """

    row: int
    count: int = 0


@dataclass
class Converter:
    """Converts columns of texts to numbers, batch by batch, and counts what is none.

    Args:
        columns: description of the table.
        missing: texts of missing values.
        decimal: the decimal separator.
        thousands: whether a comma may separate thousands where the point is the decimal separator.
        bad: fields that are no numbers, by the position of their channel.
        known: fields that are numbers, by channel.
        rows: converted so far.
    """

    columns: Columns
    missing: Sequence[str]
    decimal: str
    thousands: bool = True
    bad: dict[int, Bad] = field(default_factory=dict)
    known: dict[int, int] = field(default_factory=dict)
    rows: int = 0

    def converted(self, batches: Iterator[Any]) -> Iterator[Any]:
        """Yields batches whose channels are numbers, null where there is none."""
        for batch in batches:
            for c, name in enumerate(self.columns.channels):
                at = batch.schema.get_field_index(name)
                batch = batch.set_column(at, name, self._numbers(c, batch.column(at)))
            self.rows += batch.num_rows
            yield batch

    def texts(self) -> list[int]:
        """Channels of which more than half of the known fields are no numbers."""
        return [c for c, bad in self.bad.items() if bad.count > self.known.get(c, 0)]

    def _numbers(self, c: int, column: Any) -> Any:
        import pyarrow as pa
        import pyarrow.compute as pc

        texts = pc.utf8_trim_whitespace(column)
        nothing = pa.scalar(None, pa.string())
        texts = pc.if_else(pc.is_in(texts, pa.array(self.missing, pa.string())), nothing, texts)
        if self.decimal != ".":
            grouped = pc.match_substring_regex(texts, f"^{GROUPED_BY_POINTS.pattern}$")
            texts = pc.if_else(grouped, pc.replace_substring(texts, ".", ""), texts)
            texts = pc.replace_substring(pc.replace_substring(texts, ".", "?"), self.decimal, ".")
        try:
            numbers = texts.cast(pa.float64())
        except pa.ArrowInvalid:
            numbers = self._one_by_one(c, texts)
        self.known[c] = self.known.get(c, 0) + len(numbers) - numbers.null_count
        return numbers

    def _one_by_one(self, c: int, texts: Any) -> Any:
        import pyarrow as pa
        import pyarrow.compute as pc

        lower = pc.utf8_lower(texts)
        switches = pc.all(pc.is_in(lower.drop_null(), pa.array([*SWITCHES]))).as_py()
        words = {"true": 1, "false": 0, **(SWITCHES if switches else {})}
        for word, number in words.items():
            texts = pc.if_else(pc.equal(lower, word), str(number), texts)
        texts = pc.replace_substring_regex(texts, _FORTRAN, r"\1e\2")
        if pc.any(pc.starts_with(lower, "0x")).as_py():
            texts = pa.array(
                [str(int(t, 16)) if t and _HEX.fullmatch(t) else t for t in texts.to_pylist()],
                pa.string(),
            )
        texts = pc.replace_substring_regex(texts, _INFINITE, r"\1inf")
        texts = pc.replace_substring_regex(texts, f"^{_MINUS}", "-")
        grouped = pc.fill_null(pc.match_substring_regex(texts, _GROUPED_BY_OTHERS), False)
        if pc.any(grouped).as_py():
            plain = pc.replace_substring_regex(texts, "[^0-9.+-]", "")
            texts = pc.if_else(grouped, plain, texts)
        if self.decimal == "." and self.thousands:
            grouped = pc.match_substring_regex(texts, _THOUSANDS)
            texts = pc.if_else(grouped, pc.replace_substring(texts, ",", ""), texts)
        fits = pc.match_substring_regex(texts, _NUMBER, ignore_case=True)
        bad = pc.and_(pc.is_valid(texts), pc.invert(pc.fill_null(fits, False)))
        count = pc.sum(bad).as_py() or 0
        if count:
            first = self.rows + pc.index(bad, True).as_py()
            self.bad.setdefault(c, Bad(first)).count += count
        return pc.if_else(fits, texts, pa.scalar(None, pa.string())).cast(pa.float64())
