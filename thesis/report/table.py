"""A table as a value, and its formats: CSV, Markdown, LaTeX, HTML."""

from __future__ import annotations

import csv
import html
import io
from collections.abc import Sequence
from dataclasses import dataclass, replace

from offbeat import InputError
from offbeat.tables import DASH, escape_latex, latex, markdown

MIXED = "†"
"""Marks a number whose runs differ in code, processor, scan backend, torch or data."""


@dataclass(frozen=True)
class Cell:
    """One entry of a table.

    Attributes:
        text: as it is printed; an en dash where there is nothing.
        value: the number behind the text, or None.
        spread: its standard deviation, or None.
        n: number of runs behind it, or None.
        bold: whether it is the best of its column, or see the note of the table.
        mark: superscript after the text.
    """

    text: str = DASH
    value: float | None = None
    spread: float | None = None
    n: int | None = None
    bold: bool = False
    mark: str = ""


@dataclass(frozen=True)
class Block:
    """Rows that belong together, under a heading of their own.

    Attributes:
        heading: what they have in common.
        rows: label and cells of each.
    """

    heading: str
    rows: tuple[tuple[str, tuple[Cell, ...]], ...]


@dataclass(frozen=True)
class Table:
    """A table.

    Attributes:
        number: `3.1` as in the thesis, or `A.1` for what the thesis does not have.
        caption: a sentence, without the number.
        corner: what the labels of the rows are.
        columns: headings.
        blocks: of rows.
        notes: sentences below the table.

    Raises:
        InputError: a row has not one cell per column.
    """

    number: str
    caption: str
    corner: str
    columns: tuple[str, ...]
    blocks: tuple[Block, ...]
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        for block in self.blocks:
            for label, cells in block.rows:
                if len(cells) != len(self.columns):
                    raise InputError(
                        f"table {self.number}: row {label!r} has {len(cells)} cells for "
                        f"{len(self.columns)} columns"
                    )

    @property
    def slug(self) -> str:
        """Name of its files, without suffix."""
        return f"table-{self.number.lower().replace('.', '-')}"

    def to_csv(self) -> str:
        """One line per cell, numbers to the last bit.

        Block, row and column, by which lines are looked up, have plain spaces for thin ones.
        """
        buffer = io.StringIO()
        writer = csv.writer(buffer, lineterminator="\n")
        writer.writerow(["block", "row", "column", "value", "std", "n", "bold", "mark", "text"])
        for block in self.blocks:
            for label, cells in block.rows:
                for column, cell in zip(self.columns, cells, strict=True):
                    numbers = (_plain(cell.value), _plain(cell.spread), cell.n)
                    shown = ["" if v is None else v for v in numbers]
                    bold = "true" if cell.bold else "false"
                    keys = [
                        key.replace("\N{THIN SPACE}", " ") for key in (block.heading, label, column)
                    ]
                    writer.writerow([*keys, *shown, bold, cell.mark, cell.text])
        return buffer.getvalue()

    def to_markdown(self) -> str:
        """A table as GitHub shows it, the caption above it, the notes below."""
        rows: list[list[str]] = []
        for block in self.blocks:
            if len(self.blocks) > 1:
                rows.append([f"*{block.heading}*", *("",) * len(self.columns)])
            for label, cells in block.rows:
                shown = [f"**{c.text}**{c.mark}" if c.bold else c.text + c.mark for c in cells]
                rows.append([label, *shown])
        shown_table = markdown((self.corner, *self.columns), rows)
        caption = f"**Table {self.number}.** {self.caption}"
        return "\n".join([caption, "", shown_table, *(f"\n{note}" for note in self.notes)]) + "\n"

    def to_latex(self) -> str:
        """A `table` environment for the package booktabs."""
        headed = len(self.blocks) > 1
        blocks = [
            (
                block.heading if headed else "",
                [
                    [escape_latex(label), *(_latex_cell(cell) for cell in cells)]
                    for label, cells in block.rows
                ],
            )
            for block in self.blocks
        ]
        label = self.slug.removeprefix("table-")
        head = (self.corner, *self.columns)
        return latex(head, blocks, caption=self.caption, label=label, notes=self.notes) + "\n"

    def to_html(self) -> str:
        """A `table` element with caption and header cells, in a box that scrolls sideways."""
        head = "".join(f'<th scope="col">{_html(c)}</th>' for c in (self.corner, *self.columns))
        parts = []
        for block in self.blocks:
            rows = []
            if len(self.blocks) > 1:
                heading = f'<th colspan="{1 + len(self.columns)}" scope="rowgroup">'
                rows.append(
                    f'<tr class="block">{heading}<span>{_html(block.heading)}</span></th></tr>'
                )
            for label, cells in block.rows:
                shown = "".join(f"<td>{_html_cell(cell)}</td>" for cell in cells)
                rows.append(f'<tr><th scope="row">{_html(label)}</th>{shown}</tr>')
            parts.append("<tbody>" + "\n".join(rows) + "</tbody>")
        words = f"<b>Table {_html(self.number)}.</b> {_html(self.caption)}"
        caption = f"<caption><span>{words}</span></caption>"
        name = _html(f"Table {self.number}")
        return (
            f'<div class="scroll" role="region" aria-label="{name}" tabindex="0">'
            f"<table>{caption}<thead><tr>{head}</tr></thead>\n"
            + "\n".join(parts)
            + "</table></div>"
        )


def bold_lowest(
    rows: Sequence[tuple[str, Sequence[Cell]]],
) -> tuple[tuple[str, tuple[Cell, ...]], ...]:
    """Sets the lowest number of each column in bold, and all that are printed equally.

    A column in which a number is missing has no best one.
    """
    marked = [list(cells) for _, cells in rows]
    for column in range(len(marked[0]) if marked else 0):
        values = [cells[column] for cells in marked]
        if any(cell.value is None for cell in values):
            continue
        lowest = min(values, key=lambda cell: float(cell.value or 0.0))
        shown = _mean(lowest.text)
        for cells in marked:
            cell = cells[column]
            if _mean(cell.text) == shown:
                cells[column] = replace(cell, bold=True)
    return tuple((label, tuple(cells)) for (label, _), cells in zip(rows, marked, strict=True))


def _mean(text: str) -> str:
    return text.split()[0] if text else ""


def _plain(value: float | None) -> str | None:
    return None if value is None else repr(float(value))


def _html(text: str) -> str:
    return html.escape(text)


def _html_cell(cell: Cell) -> str:
    text = f"<b>{_html(cell.text)}</b>" if cell.bold else _html(cell.text)
    return text + (f"<sup>{_html(cell.mark)}</sup>" if cell.mark else "")


def _latex_cell(cell: Cell) -> str:
    text = rf"\textbf{{{escape_latex(cell.text)}}}" if cell.bold else escape_latex(cell.text)
    return text + escape_latex(cell.mark)
