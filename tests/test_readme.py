"""What the README shows, a reader can run."""

import re
import shlex
from pathlib import Path

import pytest

from offbeat.cli.app import COMMANDS, main

README = (Path(__file__).parents[1] / "README.md").read_text(encoding="utf-8")


def blocks(language: str) -> list[str]:
    fenced = re.findall(r"^```(\w*)\n(.*?)^```$", README, re.DOTALL | re.MULTILINE)
    return [text for tag, text in fenced if tag == language]


def test_the_python_blocks_run_one_after_the_other(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    scope: dict[str, object] = {}
    for block in blocks("python"):
        exec(compile(block, "README.md", "exec"), scope)
    assert "last_value" in capsys.readouterr().out
    assert (tmp_path / "runs/first/copy/model.safetensors").is_file()


@pytest.mark.slow
def test_the_commands_run_one_after_the_other(tmp_path, monkeypatch):
    """With fewer trajectories than shown: what is shown takes minutes."""
    monkeypatch.chdir(tmp_path)
    text = next(block for block in blocks("") if "offbeat simulate" in block)
    lines = text.replace("\\\n", " ").strip().splitlines()
    assert {line.split()[1] for line in lines} <= COMMANDS.keys()
    for line in lines:
        arguments = shlex.split(line.replace("2000", "100"))[1:]
        assert main(arguments) == 0, line
    assert (tmp_path / "predictions.csv").is_file()


def test_every_command_is_named():
    assert [name for name in COMMANDS if f"offbeat {name}" not in README] == []


def test_the_links_lead_somewhere():
    for target in re.findall(r"\]\(([^)#:]+)\)", README):
        assert (Path(__file__).parents[1] / target).exists(), target
