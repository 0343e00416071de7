"""Small tables of text: for a terminal, in Markdown and in LaTeX."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Sequence

from offbeat.errors import printable

Row = Sequence[str]

MINUS, DASH, TIMES = "\N{MINUS SIGN}", "\N{EN DASH}", "\N{MULTIPLICATION SIGN}"


def plain(rows: Sequence[Row], *, left: Collection[int] = (0,)) -> str:
    """Aligned columns for a terminal.

    Args:
        rows: of equal length, the head first.
        left: columns that are aligned to the left; the others are to the right.
    """
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = []
    for row in rows:
        fields = [
            text.ljust(width) if i in left else text.rjust(width)
            for i, (text, width) in enumerate(zip(row, widths, strict=True))
        ]
        lines.append("  ".join(fields).rstrip())
    return "\n".join(lines)


def markdown(head: Row, rows: Iterable[Row], *, right: bool = False) -> str:
    """A table in Markdown.

    Args:
        head: of the columns.
        rows: of the same number of texts.
        right: align all columns but the first to the right.
    """
    rule = "|---|" + ("---:|" if right else "---|") * (len(head) - 1)
    lines = ["|" + "".join(map(_piped, row)) for row in (head, *rows)]
    return "\n".join([lines[0], rule, *lines[1:]])


def _piped(text: str) -> str:
    return f" {escape_markdown(text)} |" if text else " |"


def escape_markdown(text: str) -> str:
    """Plain text for a line of Markdown: no tags, links, tables or control characters."""
    text = printable(text).replace("\n", " ").replace("|", "\\|")
    return re.sub(r"<(?=[A-Za-z/!?])", "&lt;", text).replace("](", "]\\(")


def latex(
    head: Row,
    blocks: Sequence[tuple[str, Sequence[Row]]],
    *,
    caption: str,
    label: str = "",
    notes: Iterable[str] = (),
) -> str:
    """A `table` environment for the package booktabs.

    Args:
        head: of the columns, plain text, as caption, headings and notes.
        blocks: heading and rows of each; rows are LaTeX. An empty heading is left out.
        caption: above the table.
        label: after `tab:`; empty for none.
        notes: sentences below the table.
    """
    lines = [r"\begin{table}", r"  \centering", rf"  \caption{{{escape_latex(caption)}}}"]
    lines += [rf"  \label{{tab:{label}}}"] if label else []
    lines += [
        r"  \small",
        rf"  \begin{{tabular}}{{l{'r' * (len(head) - 1)}}}",
        r"    \toprule",
        "    " + " & ".join(map(escape_latex, head)) + r" \\",
    ]
    for heading, rows in blocks:
        lines.append(r"    \midrule")
        if heading:
            said = rf"\emph{{{escape_latex(heading)}}}"
            lines.append(rf"    \multicolumn{{{len(head)}}}{{l}}{{{said}}} \\")
        lines += ["    " + " & ".join(row) + r" \\" for row in rows]
    lines += [r"    \bottomrule", r"  \end{tabular}"]
    lines += [rf"  \par\smallskip\footnotesize {escape_latex(note)}" for note in notes]
    return "\n".join([*lines, r"\end{table}"])


_LATEX = {
    "\\": r"\textbackslash{}",
    "&": r"\&",
    "%": r"\%",
    "#": r"\#",
    "_": r"\_",
    "$": r"\$",
    "{": r"\{",
    "}": r"\}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "±": r"$\pm$",
    TIMES: r"$\times$",
    MINUS: "$-$",
    DASH: "--",
    "†": r"$^{\dagger}$",
    "≤": r"$\leq$",
    "<": r"$<$",
    ">": r"$>$",
    "\N{THIN SPACE}": r"\,",
}
_LATEX_SPECIAL = re.compile("|".join(re.escape(c) for c in _LATEX))


def escape_latex(text: str) -> str:
    """Plain text for LaTeX."""
    return _LATEX_SPECIAL.sub(lambda found: _LATEX[found[0]], text)
