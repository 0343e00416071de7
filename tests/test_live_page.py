"""What docs/live.md shows can be run."""

import json
import re
import shlex
import subprocess
import sys
from dataclasses import fields
from pathlib import Path
from typing import get_args

import pytest

from offbeat import StreamOptions
from offbeat.export.runner import STATE
from offbeat.stream.lines import LineSession
from offbeat.stream.options import Outcome, StreamCounters

PAGE = (Path(__file__).parents[1] / "docs" / "live.md").read_text(encoding="utf-8")


def blocks(language: str) -> list[str]:
    fenced = re.findall(r"^```(\w*)\n(.*?)^```$", PAGE, re.DOTALL | re.MULTILINE)
    return [text for tag, text in fenced if tag == language]


@pytest.mark.slow
def test_the_blocks_run_one_after_the_other(tmp_path, monkeypatch, capsys):
    """Python first, then the commands on the model that it saved."""
    monkeypatch.chdir(tmp_path)
    scope = {}
    for block in blocks("python"):
        exec(compile(block, "live.md", "exec"), scope)
    assert "messages=2" in capsys.readouterr().out
    assert scope["ahead"].shape == (14,)
    assert scope["several"].shape == (2, 14)
    assert scope["again"].counters.rows == 2
    lines = [{"t": 0.1 * i, "values": {"waist_qpos": 0.1 * i}} for i in range(5)]
    (tmp_path / "messages.jsonl").write_text("\n".join(map(json.dumps, lines)))
    for line in "".join(blocks("")).strip().splitlines():
        assert shlex.split(line)[0] == "offbeat"
        call = line.replace("offbeat", f"{shlex.quote(sys.executable)} -W error -m offbeat", 1)
        done = subprocess.run(call, shell=True, capture_output=True, check=False)
        assert done.returncode == 0, done.stderr
    answers = (tmp_path / "predictions.jsonl").read_text().splitlines()
    assert [json.loads(answer)["outcome"] for answer in answers] == ["new"] * 5


def test_the_page_names_every_option_counter_outcome_and_input():
    for record in (StreamOptions, StreamCounters):
        assert [f.name for f in fields(record) if f.name not in PAGE] == []
    assert [outcome for outcome in get_args(Outcome) if f"`{outcome}`" not in PAGE] == []
    assert [name for name in STATE if f"| `{name}` |" not in PAGE] == []


def test_the_lines_of_the_page_are_those_of_a_session():
    from stream_helpers import Recorded

    rows = re.findall(r"^\| `(\{.*?\})` \| (?:`(.*?)`)?", PAGE, re.MULTILINE)
    assert len(rows) == 8
    session = LineSession(Recorded())
    state = json.dumps(session.stream.state())
    for line, answer in rows:
        filled = line.replace("STATE", state).replace('"CHANNEL"', '"a"')
        filled = filled.replace("[V, ...]", "[1, 2, 3]").replace("[T, ...]", "[5, 6]")
        filled = re.sub(r"\b[TVN]\b(?!\")", "5", filled).replace(", ...", "")
        said = json.loads(session.answer(filled.encode()))
        assert "error" not in said, (line, said)
        if answer:
            assert list(said) == re.findall(r'(?:^\{|, )"([a-z]+)":', answer), line


def test_the_links_lead_somewhere():
    for target in re.findall(r"\]\(([^)#:]+)\)", PAGE):
        assert (Path(__file__).parents[1] / "docs" / target).exists(), target
