"""The documentation site: it builds without a warning, links lead somewhere, examples run."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

import pytest
from test_readme import ROOT, run_python

import offbeat as ob

API = sorted(page for page in (ROOT / "docs/api").glob("*.md") if page.name != "index.md")
CONCEPTS = ["masking", "extending", "uneven_time", "scores"]


class Links(HTMLParser):
    """Targets of links, sources of pictures, and names that can be linked to, of a page."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.targets: list[str] = []
        self.names: set[str] = set()
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = dict(attrs)
        self.targets += [t for t in (given.get("href"), given.get("src")) if t]
        self.names |= {name for name in (given.get("id"), given.get("name")) if name}


@pytest.fixture(scope="module")
def site(tmp_path_factory) -> Path:
    """The site, built from a copy of the pages and sources."""
    pytest.importorskip("zensical")
    root = tmp_path_factory.mktemp("site")
    left_out = shutil.ignore_patterns("*.so", "__pycache__")
    for name in ("docs", "src"):
        shutil.copytree(ROOT / name, root / name, ignore=left_out)
    for page in (ROOT / "mkdocs.yml", *ROOT.glob("*.md")):
        shutil.copy(page, root)
    command = [sys.executable, "-m", "zensical", "build", "--strict"]
    done = subprocess.run(command, cwd=root, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stdout + done.stderr
    return root / "site"


def test_every_link_of_the_site_leads_to_a_page_and_a_heading_that_exist(site):
    pages = {page: Links(page.read_text(encoding="utf-8")) for page in site.rglob("*.html")}
    assert len(pages) > 30
    missing = []
    for page, links in pages.items():
        if page.name == "404.html":  # its links are those of the root of a server
            continue
        for target in links.targets:
            parts = urlsplit(target)
            if parts.scheme or parts.netloc:
                continue
            path = (page.parent / unquote(parts.path)).resolve() if parts.path else page
            if path.is_dir():
                path /= "index.html"
            exists = path.is_file() and (
                not parts.fragment or path not in pages or parts.fragment in pages[path].names
            )
            if not exists:
                missing.append((page.name, target))
    assert missing == []


def test_no_page_loads_anything_from_elsewhere(site):
    for page in site.rglob("*.html"):
        text = page.read_text(encoding="utf-8")
        assert not re.search(r"<(script|img|link|iframe)[^>]+(src|href)=\"https?:", text), page.name


def test_every_public_name_has_an_entry_and_an_example():
    entries: dict[str, Path] = {}
    for page in API:
        for name in re.findall(r"^::: offbeat\.(\w+)$", page.read_text(encoding="utf-8"), re.M):
            assert name not in entries
            entries[name] = page
    assert set(entries) == set(ob.__all__) - {"baselines"}
    for name in ob.__all__:
        assert getattr(ob, name).__doc__, name


@pytest.mark.parametrize("page", API, ids=lambda page: page.stem)
def test_the_examples_of_the_api_run(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    run_python(f"docs/api/{page.name}", {"__name__": "example"})


@pytest.mark.parametrize("page", CONCEPTS)
def test_the_examples_of_the_guides_run(page, tmp_path, monkeypatch):
    from offbeat.data.robots import ROBOTS
    from offbeat.models.zoo import MODELS

    monkeypatch.chdir(tmp_path)
    before = [set(MODELS), set(ROBOTS)]
    run_python(f"docs/{page}.md", {})
    for registry, names in zip((MODELS, ROBOTS), before, strict=True):
        for name in set(registry) - names:
            registry.unregister(name)
