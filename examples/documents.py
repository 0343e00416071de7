"""Documents with markers `<!-- NAME -->` and `<!-- end of NAME -->` that commands fill."""

from __future__ import annotations

from pathlib import Path

from offbeat.errors import InputError


def between(text: str, name: str, body: str) -> str:
    """Puts a body between the markers of a text.

    Args:
        text: with both markers.
        name: of the markers.
        body: replaces what is between them.

    Raises:
        InputError: a marker is missing.
    """
    start, end = f"<!-- {name} -->", f"<!-- end of {name} -->"
    before, found, rest = text.partition(start)
    _, closed, after = rest.partition(end)
    if not found or not closed:
        raise InputError(f"the document has no {start} followed by {end}; add both")
    return f"{before}{start}\n\n{body.strip()}\n\n{end}{after}"


def write_between(document: Path, name: str, body: str) -> None:
    """Puts a body between the markers of a document.

    Args:
        document: its path.
        name: of the markers.
        body: replaces what is between them.

    Raises:
        InputError: a marker is missing.
    """
    text = between(document.read_text(encoding="utf-8"), name, body)
    document.write_text(text, encoding="utf-8")
