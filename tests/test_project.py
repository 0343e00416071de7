"""The papers of the project agree with each other and with the code."""

import ast
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


def test_every_module_begins_with_a_line_that_says_what_it_is_for():
    for path in [*(ROOT / "src").rglob("*.py"), *(ROOT / "thesis").rglob("*.py")]:
        said = ast.get_docstring(ast.parse(path.read_text(encoding="utf-8")))
        assert said, path
        assert said.splitlines()[0].endswith((".", ",", "?")), path
