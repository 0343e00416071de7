"""The papers of the project agree with each other and with the code."""

import re
import tomllib
from pathlib import Path

import pytest
import yaml
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

import offbeat

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
DECLARED = [
    *PROJECT["build-system"]["requires"],
    *PROJECT["project"]["dependencies"],
    *(text for extra in PROJECT["project"]["optional-dependencies"].values() for text in extra),
]


def test_the_version_stands_in_one_place_and_the_papers_repeat_it():
    assert PROJECT["project"]["dynamic"] == ["version"]
    version = PROJECT["tool"]["scikit-build"]["metadata"]["version"]
    assert version["input"] == "src/offbeat/__init__.py"
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert citation["version"] == offbeat.__version__
    assert citation["license"] == PROJECT["project"]["license"]
    changelog = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    assert re.findall(r"^## \[(.+?)\]", changelog, re.MULTILINE)[0] == offbeat.__version__


@pytest.mark.parametrize("text", [text for text in DECLARED if not text.startswith("offbeat[")])
def test_a_declared_dependency_is_pinned_to_a_version_that_it_allows(text):
    pins = {}
    for line in (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines():
        if line and not line.startswith("#"):
            name, version = line.split("==")
            pins[canonicalize_name(name)] = version
    wanted = Requirement(text)
    pin = pins.get(canonicalize_name(wanted.name))
    assert pin is not None, f"{wanted.name} has no line in constraints.txt"
    assert pin in wanted.specifier, f"constraints.txt pins {wanted.name}=={pin}, declared: {text}"


def test_no_dependency_is_declared_without_a_lower_bound():
    loose = [
        text
        for text in DECLARED
        if not text.startswith("offbeat[")
        and not any(bound.operator == ">=" for bound in Requirement(text).specifier)
    ]
    assert loose == []


def test_the_readme_begins_with_make_demo_and_make_test():
    blocks = re.findall(
        r"^```\w*\n(.*?)^```", (ROOT / "README.md").read_text(encoding="utf-8"), re.M | re.S
    )
    commands = [line.split("#")[0].strip() for line in blocks[0].splitlines()]
    assert [line for line in commands if line.startswith("make ")] == ["make demo", "make test"]


def test_contributing_stays_under_sixty_lines():
    assert len((ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8").splitlines()) < 60


def file_tree(text):
    """Files of the tree that begins with `src/offbeat/` in a page, each with what is said of it."""
    block = re.search(r"^src/offbeat/.*\n((?:(?:[ \t].*)?\n)*)", text, re.M)
    assert block, "docs/architecture.md has no block that begins with 'src/offbeat/'"
    files, folders = {}, []
    for line in filter(str.strip, block[1].splitlines()):
        name, _, about = line.strip().partition(" ")
        indent = len(line) - len(line.lstrip())
        folders = [(depth, folder) for depth, folder in folders if depth < indent]
        if name.endswith("/"):
            folders.append((indent, name))
        else:
            files["".join(folder for _, folder in folders) + name] = about.strip()
    return files


def test_the_tree_of_the_architecture_page_is_read_by_indentation():
    page = (
        "```\nsrc/offbeat/\n  cli.py  the commands\n  data/  what was measured\n"
        "    thin.py  hides rows\n    readers/\n      csv.py\n  files.py  whole files\n```\n"
    )
    assert file_tree(page) == {
        "cli.py": "the commands",
        "data/thin.py": "hides rows",
        "data/readers/csv.py": "",
        "files.py": "whole files",
    }


def test_the_architecture_page_has_a_line_for_every_module_and_for_nothing_else():
    tree = file_tree((ROOT / "docs" / "architecture.md").read_text(encoding="utf-8"))
    source = ROOT / "src" / "offbeat"
    # The file that makes a folder a package needs no line: the folder has one.
    modules = {
        path.relative_to(source).as_posix()
        for path in source.rglob("*.py")
        if path.name != "__init__.py" or path.parent == source
    }
    assert modules - tree.keys() == set(), "modules without a line"
    assert {name for name in tree if not (source / name).exists()} == set(), "lines without a file"
    assert [name for name, about in tree.items() if not about] == [], "lines that say nothing"
