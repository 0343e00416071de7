"""Which commit a run says it was made by."""

import subprocess

import pytest

from offbeat import __version__
from offbeat.sweeps import provenance


@pytest.fixture
def checkout(tmp_path, monkeypatch):
    """A repository that the package seems to run from, with one commit."""

    def git(*arguments):
        identity = ("-c", "user.name=a", "-c", "user.email=a@example.org")
        command = ("git", "-C", str(tmp_path), *identity, *arguments)
        return subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip()

    git("init", "-q")
    for name in ("src/offbeat/code.py", "results/thesis/record.csv", "README.md"):
        file = tmp_path / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text("first\n")
    git("add", "-A")
    git("commit", "-q", "-m", "First")
    monkeypatch.setattr(provenance, "PACKAGE", tmp_path / "src" / "offbeat")
    return tmp_path, git("rev-parse", "--short=12", "HEAD")


def test_a_clean_checkout_is_named_by_its_commit(checkout):
    assert provenance.commit() == checkout[1]


@pytest.mark.parametrize("name", ["src/offbeat/code.py", "README.md"])
def test_changes_are_told(checkout, name):
    (checkout[0] / name).write_text("second\n")
    assert provenance.commit() == f"{checkout[1]}-dirty"


def test_what_runs_publish_is_no_change(checkout):
    (checkout[0] / "results" / "thesis" / "record.csv").write_text("second\n")
    assert provenance.commit() == checkout[1]


def test_a_package_inside_another_repository_is_named_by_its_version(checkout, monkeypatch):
    monkeypatch.setattr(provenance, "PACKAGE", checkout[0] / "lib" / "offbeat")
    (checkout[0] / "lib" / "offbeat").mkdir(parents=True)
    assert provenance.commit() == f"offbeat {__version__}"
