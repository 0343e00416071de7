"""One self-contained HTML page without scripts and requests, light and dark, wide and narrow."""

from __future__ import annotations

import html
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from thesis.report import svg
from thesis.report.findings import (
    FAILS,
    HOLDS,
    MISSING,
    NOT_CONTRADICTED,
    PARTLY,
    UNDECIDED,
    Finding,
)
from thesis.report.table import Table

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_STYLE = """
:root{color-scheme:light dark;--paper:#fff;--ink:#1a1a1a;--soft:#595959;--line:#d9d9d9;
--shade:#f4f5f7;--link:#00568a;--warn:#fff4d6;--warn-line:#b58100;
--yes:#00694b;--part:#8a5a00;--no:#a63d00}
@media (prefers-color-scheme:dark){:root{--paper:#14171b;--ink:#e6e6e6;--soft:#a9b0b7;
--line:#3a4047;--shade:#1d2126;--link:#7cc4f2;--warn:#332a12;--warn-line:#c99a2e;
--yes:#4fc79f;--part:#e5b04c;--no:#ff9a63}}
*{box-sizing:border-box}
html{-webkit-text-size-adjust:100%}
body{margin:0;background:var(--paper);color:var(--ink);
font:16px/1.55 system-ui,-apple-system,"Segoe UI",Roboto,"Noto Sans",sans-serif}
main,header,nav,footer{max-width:67rem;margin:0 auto;padding:0 1.1rem}
header{padding-top:2rem}
h1{font-size:1.7rem;line-height:1.25;margin:0 0 .4rem}
h2{font-size:1.3rem;margin:3rem 0 .6rem;padding-top:.6rem;border-top:1px solid var(--line)}
h3{font-size:1.05rem;margin:2rem 0 .4rem}
p,ul,dl{max-width:46rem}
a{color:var(--link)}
nav ul{display:flex;flex-wrap:wrap;gap:.2rem 1.1rem;list-style:none;padding:0;margin:1rem 0 0}
.lead{color:var(--soft)}
.warn{background:var(--warn);border-left:4px solid var(--warn-line);padding:.6rem .9rem;
margin:1rem 0;max-width:46rem}
.warn p{margin:.2rem 0}
.scroll{overflow-x:auto;max-width:100%;margin:1.2rem 0 .3rem}
.scroll:focus-visible,a:focus-visible,summary:focus-visible{outline:2px solid var(--link);
outline-offset:2px}
table{border-collapse:collapse;font-size:.9rem;font-variant-numeric:tabular-nums}
caption{text-align:left;padding-bottom:.4rem;caption-side:top}
caption b{font-weight:600}
caption span{display:block;position:sticky;left:0;max-width:min(46rem,calc(100vw - 2.2rem))}
thead th{border-top:2px solid var(--ink);border-bottom:1px solid var(--ink)}
tbody:last-child tr:last-child>*{border-bottom:2px solid var(--ink)}
th,td{padding:.22rem .6rem;text-align:right;white-space:nowrap;font-weight:400}
thead th{font-weight:600;vertical-align:bottom}
th:first-child{text-align:left;padding-left:0}
tr.block th{padding-top:.7rem;font-style:italic;color:var(--soft)}
tr.block th span{position:sticky;left:0}
td b{font-weight:700}
tbody tr:not(.block):hover{background:var(--shade)}
.notes{font-size:.82rem;color:var(--soft);margin:.1rem 0 .2rem}
.notes p{margin:.15rem 0}
.files{font-size:.82rem;margin:.1rem 0 1.6rem}
figure{margin:1.4rem 0}
figure img{display:block;max-width:100%;height:auto}
figcaption{font-size:.9rem;margin-top:.4rem;max-width:46rem}
.pair img{width:100%}
.pair{display:grid;grid-template-columns:repeat(2,minmax(0,1fr));gap:.5rem 1.6rem}
.wide .scroll{margin:0}
code,pre{font-family:ui-monospace,SFMono-Regular,Menlo,Consolas,monospace;font-size:.87rem}
pre{background:var(--shade);padding:.8rem;overflow-x:auto}
.finding{margin:1.1rem 0;padding:0 0 .3rem .9rem;border-left:3px solid var(--line)}
.finding h3{margin:0}
.finding p{margin:.2rem 0}
.source{font-size:.82rem;color:var(--soft)}
.verdict{font-weight:600}
.yes{color:var(--yes)}.part{color:var(--part)}.no{color:var(--no)}.open{color:var(--soft)}
details{max-width:46rem;font-size:.9rem}
summary{cursor:pointer}
details ul{margin:.3rem 0;padding-left:1.2rem}
dl{display:grid;grid-template-columns:minmax(8rem,max-content) 1fr;gap:.2rem 1rem;font-size:.92rem}
dt{color:var(--soft)}dd{margin:0;overflow-wrap:anywhere}
footer{margin-top:3rem;padding-bottom:3rem;color:var(--soft);font-size:.85rem}
@media (max-width:44rem){th,td{padding:.2rem .45rem}table{font-size:.84rem}
.pair{grid-template-columns:1fr}.wide img{max-width:none;width:42rem}
tbody th[scope=row]{position:sticky;left:0;background:var(--paper)}
dl{grid-template-columns:1fr;gap:0}dd{margin-bottom:.4rem}}
@media print{.scroll{overflow:visible}nav{display:none}}
"""

_CLASSES = {
    HOLDS: "yes",
    NOT_CONTRADICTED: "open",
    PARTLY: "part",
    FAILS: "no",
    UNDECIDED: "open",
    MISSING: "open",
}


@dataclass(frozen=True, eq=False)
class Picture:
    """A figure with what a reader needs who cannot see it.

    Attributes:
        number: `3.3` as in the thesis, or `A.1`.
        caption: below the figure.
        alt: what it shows, in words and numbers.
        figure: of matplotlib.
        wide: two columns of a journal; scrolls sideways on a phone.
    """

    number: str
    caption: str
    alt: str
    figure: Figure
    wide: bool = False

    def __post_init__(self) -> None:
        # The layout is computed once for all files, because it takes most of the time.
        self.figure.draw_without_rendering()
        self.figure.set_layout_engine("none")

    @property
    def slug(self) -> str:
        """Name of its files, without suffix."""
        return f"figure-{self.number.lower().replace('.', '-')}"


def text(words: str) -> str:
    """A string as HTML."""
    return html.escape(words)


def paragraph(words: str, kind: str = "") -> str:
    """A paragraph."""
    return f'<p class="{kind}">{text(words)}</p>' if kind else f"<p>{text(words)}</p>"


def warning(sentences: Iterable[str]) -> str:
    """A box that is not overlooked; nothing where there is nothing to say."""
    lines = [paragraph(s) for s in sentences if s]
    return f'<div class="warn" role="note">{"".join(lines)}</div>' if lines else ""


def table(one: Table) -> str:
    """A table with its notes and links to its files."""
    said = "".join(paragraph(note) for note in one.notes)
    links = _links("tables", one.slug, ("csv", "md", "tex"), f"table {one.number}")
    return f'<div id="{one.slug}">{one.to_html()}<div class="notes">{said}</div>{links}</div>'


def picture(one: Picture) -> str:
    """A figure with its caption and links to its files."""
    shown = svg.image(one.figure, one.slug, one.alt)
    if one.wide:
        name = text(f"Figure {one.number}")
        shown = f'<div class="scroll" role="region" aria-label="{name}" tabindex="0">{shown}</div>'
    caption = f"<figcaption><b>Figure {text(one.number)}.</b> {text(one.caption)}</figcaption>"
    links = _links("figures", one.slug, ("png", "pdf"), f"figure {one.number}")
    kind = ' class="wide"' if one.wide else ""
    return f'<figure id="{one.slug}"{kind}>{shown}{caption}{links}</figure>'


def side_by_side(pictures: Sequence[Picture]) -> str:
    """Narrow figures in two columns, or one below the other on a phone."""
    shown = "".join(map(picture, pictures))
    return f'<div class="pair">{shown}</div>' if shown else ""


def finding(one: Finding) -> str:
    """A claim, its verdicts, and the evidence to unfold."""
    lines = []
    for decided_by, verdict in one.verdicts.items():
        word = f'<span class="verdict {_CLASSES[verdict.word]}">{text(verdict.word)}</span>'
        if verdict.count:
            word += f" ({text(verdict.count)})"
        evidence = "".join(f"<li>{text(s)}</li>" for s in verdict.evidence)
        lines.append(
            f"<details><summary>{text(decided_by)}: {word}</summary><ul>{evidence}</ul></details>"
        )
    return (
        f'<div class="finding"><h3>{text(one.claim)}</h3>'
        f'<p class="source">{text(one.source)}</p>{"".join(lines)}</div>'
    )


def definitions(pairs: Iterable[tuple[str, str]]) -> str:
    """A list of names and values."""
    return "<dl>" + "".join(f"<dt>{text(k)}</dt><dd>{text(v)}</dd>" for k, v in pairs) + "</dl>"


def commands(lines: Sequence[str]) -> str:
    """Commands as they are typed."""
    return f"<pre>{text(chr(10).join(lines))}</pre>"


def section(name: str, title: str, *parts: str) -> tuple[str, str, str]:
    """Identifier, title and content of a part of the page."""
    return name, title, "\n".join(filter(None, parts))


def page(
    title: str, lead: str, sections: Sequence[tuple[str, str, str]], *, top: str, foot: str
) -> str:
    """The whole page.

    Args:
        title: of the page.
        lead: a paragraph below it.
        sections: of `section`.
        top: HTML before the first section.
        foot: a sentence at the end.
    """
    links = "".join(f'<li><a href="#{name}">{text(t)}</a></li>' for name, t, _ in sections)
    body = "\n".join(
        f'<section id="{name}" aria-labelledby="{name}-title">'
        f'<h2 id="{name}-title">{text(t)}</h2>\n{content}</section>'
        for name, t, content in sections
    )
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width,initial-scale=1">\n'
        '<meta name="color-scheme" content="light dark">\n'
        '<link rel="icon" href="data:,">\n'
        f"<title>{text(title)}</title>\n<style>{_STYLE}</style></head>\n<body>\n"
        f"<header><h1>{text(title)}</h1>{paragraph(lead, 'lead')}{top}</header>\n"
        f'<nav aria-label="Sections"><ul>{links}</ul></nav>\n<main>\n{body}\n</main>\n'
        f"<footer>{paragraph(foot)}</footer>\n</body></html>\n"
    )


def _links(folder: str, slug: str, suffixes: Sequence[str], what: str) -> str:
    names = {"md": "Markdown", "tex": "LaTeX"}
    shown = " · ".join(
        f'<a href="{folder}/{slug}.{suffix}" aria-label="{text(what)} as '
        f'{names.get(suffix, suffix.upper())}">{names.get(suffix, suffix.upper())}</a>'
        for suffix in suffixes
    )
    return f'<p class="files">{shown}</p>'
