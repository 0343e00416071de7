"""The notebooks run, and the pages of the documentation are made from them."""

from __future__ import annotations

import re

import numpy as np
import pytest
from test_readme import ROOT

from examples.notebooks.render import NOTEBOOKS, cells, render
from offbeat.models.zoo import MODELS

PAGES = ROOT / "docs" / "notebooks"
QUICK = {
    "fill_and_forecast": (("epochs=3, tasks_per_epoch=100", "epochs=1, tasks_per_epoch=16"),),
    "compare_models": (('"hopper", 300', '"hopper", 30'), ("epochs=8", "epochs=1")),
    "own_model": (("range(120)", "range(20)"), ("epochs=10", "epochs=1")),
}


@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_runs_and_shows_what_its_page_says_that_it_shows(notebook, tmp_path):
    quick = tmp_path / notebook.name
    text = notebook.read_text(encoding="utf-8")
    for old, new in QUICK.get(notebook.stem, ()):
        assert old in text
        text = text.replace(old, new)
    quick.write_text(text, encoding="utf-8")
    before = set(MODELS)
    try:
        page = render(quick, tmp_path)
    finally:
        for name in set(MODELS) - before:
            MODELS.unregister(name)
    shown = (PAGES / f"{notebook.stem}.md").read_text(encoding="utf-8")
    parts = r"^(?:#+ .*|```\w+|!\[.*)$"
    assert len(re.findall(parts, page, re.M)) == len(re.findall(parts, shown, re.M))
    pictures = re.findall(r"^!\[\w+\]\((.*)\)$", shown, re.M)
    assert sorted(pictures) == sorted(path.name for path in tmp_path.glob("*.png"))
    assert all((PAGES / name).is_file() for name in pictures)


@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_page_has_the_text_and_the_code_of_its_notebook(notebook):
    page = (PAGES / f"{notebook.stem}.md").read_text(encoding="utf-8")
    at = 0
    for cell in cells(notebook):
        wanted = cell.lines if cell.text else f"```python\n{cell.lines}\n```"
        at = page.find(wanted, at)
        assert at >= 0, f"render {notebook.name} again: the page lacks\n{cell.lines}"


def test_jupytext_reads_the_cells_that_we_read():
    jupytext = pytest.importorskip("jupytext")
    for notebook in NOTEBOOKS:
        book = jupytext.read(notebook)
        assert [(c.cell_type == "markdown", c.source) for c in book.cells] == [
            (cell.text, cell.lines) for cell in cells(notebook)
        ]
    assert np.all([len(cells(notebook)) > 5 for notebook in NOTEBOOKS])
