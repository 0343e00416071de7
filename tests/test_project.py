"""The papers of the project agree with each other and with the code."""

import ast
import re
import shutil
import subprocess
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
    assert str(citation["date-released"]) in changelog_heading()
    assert citation["license"] == PROJECT["project"]["license"]
    assert re.match(r"## \[(.+?)\]", changelog_heading())[1] == offbeat.__version__


def changelog_heading():
    """The heading of the newest version in the changelog."""
    changelog = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    return re.findall(r"^## .+$", changelog, re.MULTILINE)[0]


def test_the_address_is_set_in_all_files_by_the_commands_of_the_release_guide(tmp_path):
    files = ("pyproject.toml", "CITATION.cff", "mkdocs.yml")
    guide = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    commands = re.findall(r"^sed -i\.bak .+$", guide, re.MULTILINE)
    assert len(commands) == 2
    for name in files:
        (tmp_path / name).write_bytes((ROOT / name).read_bytes())
    if shutil.which("sed") and "ADDRESS" in (ROOT / "CITATION.cff").read_text(encoding="utf-8"):
        for command in commands:
            subprocess.run(["bash", "-c", command], cwd=tmp_path, check=True)
    project = tomllib.loads((tmp_path / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    citation = yaml.safe_load((tmp_path / "CITATION.cff").read_text(encoding="utf-8"))
    site = (tmp_path / "mkdocs.yml").read_text(encoding="utf-8")
    address = project["urls"]["Repository"]
    assert address.startswith("https://")
    assert citation["repository-code"] == address
    assert re.findall(r'^repo_url: "(.+)"$', site, re.MULTILINE) == [address]
    assert citation["doi"].startswith("10.")
    assert project["name"] == "offbeat"  # what follows the address is still read


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


@pytest.fixture(scope="module")
def sdist(tmp_path_factory):
    """Files of the source distribution, by their path in it, with their sizes."""
    pyproject = pytest.importorskip("scikit_build_core.build")
    import tarfile

    folder = tmp_path_factory.mktemp("sdist")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(ROOT)
        path = folder / pyproject.build_sdist(str(folder))
    with tarfile.open(path) as archive:
        return {m.name.partition("/")[2]: m.size for m in archive.getmembers() if m.isfile()}


def test_the_source_distribution_has_all_that_its_build_and_the_package_need(sdist):
    source = [
        path.relative_to(ROOT).as_posix()
        for folder in ("csrc", "src/offbeat")
        for path in (ROOT / folder).rglob("*")
        if path.is_file() and path.suffix not in (".so", ".pyc")
    ]
    needed = ["pyproject.toml", "CMakeLists.txt", "README.md", "LICENSE", "PKG-INFO", *source]
    assert [name for name in needed if name not in sdist] == []
    assert any(name.endswith("mjcf/hopper.xml") for name in sdist)
    assert any(name.endswith("model.safetensors") for name in sdist)


def test_the_source_distribution_has_nothing_that_was_built_and_stays_small(sdist):
    stray = [name for name in sdist if name.endswith((".so", ".pyc", ".o")) or "/runs/" in name]
    assert stray == []
    assert {name.partition("/")[0] for name in sdist if "/" in name} == {"csrc", "src"}
    assert sum(sdist.values()) < 10e6
    trained = [size for name, size in sdist.items() if name.startswith("src/offbeat/trained/")]
    assert 1e6 < sum(trained) < 5e6


def test_the_citation_names_the_thesis_and_the_papers_of_the_models():
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    known = {str(each.get("notes", "")).split(".")[0] for each in citation["references"]}
    assert {"GRU-D", "Neural ODE and its adjoint", "ODE-RNN and RNN-Decay"} <= known
    titles = [each["title"] for each in citation["references"]]
    readme = (ROOT / "README.md").read_text(encoding="utf-8").replace("\n", " ")
    assert titles[0] in readme
