"""The report of a reproduction: reads the record, writes tables, figures and one page."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from offbeat import InputError
from offbeat.files import writable, write_text
from offbeat.plots import figures
from thesis.illustrations import Illustrations
from thesis.report.circumstances import Circumstances
from thesis.report.contents import Contents
from thesis.report.document import document
from thesis.report.page import Picture
from thesis.report.records import Record, read_record
from thesis.report.summary import summary as summarised
from thesis.report.table import Table

PAGE = "report.html"
SUMMARY = "summary.md"


@dataclass(frozen=True)
class ReportFiles:
    """What `write_report` wrote.

    Attributes:
        page: the HTML page, with everything in it.
        summary: the answers as a Markdown document.
        tables: CSV, Markdown and LaTeX of each table.
        figures: PNG and PDF of each figure.
        messages: missing parts, and why.
    """

    page: Path
    summary: Path
    tables: tuple[Path, ...]
    figures: tuple[Path, ...]
    messages: tuple[str, ...]

    def to_dict(self) -> dict[str, Any]:
        """JSON-like form."""
        return {
            "page": str(self.page),
            "summary": str(self.summary),
            "tables": [str(path) for path in self.tables],
            "figures": [str(path) for path in self.figures],
            "messages": list(self.messages),
        }

    def __str__(self) -> str:
        lines = [
            f"{self.page}: {len(self.tables) // 3} tables, {len(self.figures) // 2} figures; each "
            f"also as a file of its own in {self.page.parent / 'tables'} and "
            f"{self.page.parent / 'figures'}",
            f"{self.summary}: the answers in short",
        ]
        return "\n".join([*lines, *self.messages])


def write_report(
    runs: str | Path | Record,
    out: str | Path,
    *,
    illustrations: Illustrations | None = None,
    repeats: int | None = None,
    summary: str | Path | None = None,
) -> ReportFiles:
    """Writes the thesis' tables, figures and tests next to ours, as one page and as files.

    Missing runs, and numbers whose runs have different provenance, are marked.
    Nothing else in `out` is touched.

    Args:
        runs: folder of a reproduction, or of its record; or a record that was read.
        out: folder for `report.html`, `summary.md`, `tables/` and `figures/`.
        illustrations: recordings and hidden states; by default `illustrations.npz` in `runs`.
        repeats: of experiment 2 in the full protocol; by default what `protocol.json` in `runs`
            says, or the thesis' 10.
        summary: where to write the Markdown document in place of `summary.md` in `out`.

    Returns:
        The files, and missing parts.

    Raises:
        FileFormatError: there is no record, or a file is damaged.
        InputError: the record is not what it must be, or `out` cannot be written.

    Example:
        >>> print(write_report("runs/thesis", "runs/report"))  # doctest: +SKIP
    """
    out = writable(out, folder=True)
    answers = out / SUMMARY if summary is None else writable(summary)
    if repeats is not None and repeats < 1:
        raise InputError(f"repeats must be at least 1, got {repeats}")
    circumstances = Circumstances()
    if isinstance(runs, Record):
        record = runs
    else:
        record = read_record(runs)
        illustrations = illustrations or Illustrations.load(runs)
        circumstances = Circumstances.of(runs)
    contents = Contents(
        record, illustrations, circumstances, repeats=repeats or circumstances.repeats
    )
    tables: list[Path] = []
    pictures: list[Path] = []
    for table in contents.tables.values():
        tables += _write_table(table, out / "tables")
    for picture in contents.pictures.values():
        pictures += _write_picture(picture, out / "figures")
    write_text(out / PAGE, document(contents))
    write_text(answers, summarised(contents))
    return ReportFiles(
        out / PAGE, answers, tuple(tables), tuple(pictures), (*contents.warnings, *contents.missing)
    )


def _write_table(table: Table, folder: Path) -> Iterator[Path]:
    forms = {"csv": table.to_csv, "md": table.to_markdown, "tex": table.to_latex}
    for suffix, render in forms.items():
        path = folder / f"{table.slug}.{suffix}"
        write_text(path, render())
        yield path


def _write_picture(picture: Picture, folder: Path) -> Iterator[Path]:
    for suffix in ("png", "pdf"):
        yield figures.save(picture.figure, folder / f"{picture.slug}.{suffix}")
