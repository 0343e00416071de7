"""Runs the notebooks of this folder and writes them, with what they print and draw, as pages.

    python examples/notebooks/render.py docs/notebooks

A notebook is a Python file in the percent format: `# %%` begins a cell, `# %% [markdown]` one of
text. It runs as a script; `jupytext --to ipynb FILE` makes a notebook of it. Pictures that a cell
saves are shown below it.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import os
import re
import shutil
import tempfile
from dataclasses import dataclass
from pathlib import Path

HERE = Path(__file__).parent
NOTEBOOKS = tuple(
    HERE / f"{name}.py"
    for name in ("read_and_inspect", "fill_and_forecast", "compare_models", "own_model")
)


@dataclass(frozen=True)
class Cell:
    """A cell: its lines, and whether they are text."""

    text: bool
    lines: str


def cells(notebook: Path) -> list[Cell]:
    """The cells of a notebook; text without its comment signs."""
    parts = re.split(r"^# %%(.*)\n", notebook.read_text(encoding="utf-8"), flags=re.MULTILINE)
    found = []
    for kind, lines in zip(parts[1::2], parts[2::2], strict=True):
        text = kind.strip() == "[markdown]"
        if text:
            lines = re.sub(r"^# ?", "", lines, flags=re.MULTILINE)
        found.append(Cell(text, lines.strip("\n")))
    return found


def render(notebook: Path, folder: Path) -> str:
    """Runs a notebook in an empty folder; returns its page, and copies its pictures.

    Args:
        notebook: to run.
        folder: of the page, for pictures.
    """
    page: list[str] = []
    scope: dict[str, object] = {"__name__": "__main__"}
    with tempfile.TemporaryDirectory() as work, contextlib.chdir(work):
        shown: set[str] = set()
        for cell in cells(notebook):
            if cell.text:
                page.append(cell.lines)
                continue
            page.append(f"```python\n{cell.lines}\n```")
            printed = io.StringIO()
            with contextlib.redirect_stdout(printed):
                exec(compile(cell.lines, str(notebook), "exec"), scope)
            if printed.getvalue():
                page.append(f"```text\n{printed.getvalue().rstrip()}\n```")
            for picture in sorted({p.name for p in Path().glob("*.png")} - shown):
                name = f"{notebook.stem}_{picture}"
                shutil.copy(picture, folder / name)
                shown.add(picture)
                page.append(f"![{picture.removesuffix('.png')}]({name})")
    source = f"examples/notebooks/{notebook.name}"
    page.append(
        f"This page is `{source}` with its output; `jupytext --to ipynb {source}` makes a "
        "notebook of it."
    )
    return "\n\n".join(page) + "\n"


def main() -> None:
    """Renders all notebooks, or those that are named."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("out", type=Path)
    parser.add_argument("names", nargs="*", help="names of notebooks; all by default")
    given = parser.parse_args()
    out = given.out.absolute()
    out.mkdir(parents=True, exist_ok=True)
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    for notebook in NOTEBOOKS:
        if not given.names or notebook.stem in given.names:
            (out / f"{notebook.stem}.md").write_text(render(notebook, out), encoding="utf-8")
            print(out / f"{notebook.stem}.md")


if __name__ == "__main__":
    main()
