"""Some mutants of every format; `make fuzz` runs many more."""

from __future__ import annotations

import fuzz
import pytest

COUNT = 40
"""Mutants of each target: the suite takes seconds, and the same ones are run every time."""


@pytest.mark.parametrize("name", fuzz.TARGETS)
def test_mutants_are_read_or_refused_in_one_line(name, tmp_path):
    good = fuzz.prepared(name, tmp_path / "good")
    found = dict(fuzz.outcomes(name, range(COUNT), good))
    assert {n: said for n, said in found.items() if said not in ("read", "refused")} == {}
    assert "refused" in found.values()


@pytest.mark.parametrize("name", fuzz.TARGETS)
def test_an_unchanged_file_is_read(name, tmp_path, monkeypatch):
    monkeypatch.setattr(fuzz, "mutate", lambda data, random: data)
    good = fuzz.prepared(name, tmp_path / "good")
    assert [said for _, said in fuzz.outcomes(name, range(3), good)] == ["read"] * 3


@pytest.mark.parametrize(
    ("name", "number"), [("lerobot v3.0", 402), ("lerobot v3.0", 1035), ("ros_echo", 51000153)]
)
def test_mutants_that_once_ended_in_a_fault(name, number, tmp_path):
    assert fuzz.outcome(name, number, fuzz.prepared(name, tmp_path / "good")) == "refused"


def test_a_fault_is_found(tmp_path, monkeypatch):
    """The outcome of a reader that raises, hangs, or prints control characters names the fault."""
    good = fuzz.prepared("csv", tmp_path / "good")
    for error, said in (
        (KeyError("x"), "KeyError: 'x'"),
        (TimeoutError(), "hang"),
        (fuzz.InputError("x" * 800), f"message: {'x' * 100!r}"),
    ):

        def broken(path, error=error):
            raise error

        monkeypatch.setitem(fuzz.TARGETS, "csv", fuzz.Target(fuzz.TARGETS["csv"].make, broken))
        assert fuzz.outcome("csv", 0, good) == said
