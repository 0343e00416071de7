"""What the README and the pages of docs/ show, a reader can run."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import numpy as np
import pytest
from test_cli_safety import parser_of

import offbeat as ob
import thesis.__main__
from offbeat.cli.app import ALIASES, COMMANDS, main
from offbeat.data.readers import READERS

ROOT = Path(__file__).parents[1]
# Two pages are left out: test_live_page.py runs the one, and the other one is a record of what was
# run at its time.
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]
PAGES = [page for page in PAGES if page.name not in ("reproduction.md",)]


def blocks(page: Path, language: str) -> list[str]:
    text = page.read_text(encoding="utf-8")
    fenced = re.findall(r"^```(\w*)\n(.*?)^```$", text, re.DOTALL | re.MULTILINE)
    return [block for tag, block in fenced if tag == language]


def commands(text: str) -> list[list[str]]:
    """The command lines in a text, each split into words, without redirections."""
    lines = re.sub(r"\\\n\s*#?", " ", text).splitlines()
    found = [re.sub(r"^[#$\s]+", "", line) for line in lines]
    shown = r"(offbeat|python -m thesis) [a-z]+ .*|offbeat (doctor|demo)"
    split = [shlex.split(line, comments=True) for line in found if re.fullmatch(shown, line)]
    words = [line[2:] if line[0] == "python" else line for line in split]
    return [line[: min([*map(line.index, {"<", ">"} & set(line)), len(line)])] for line in words]


def run_python(page: str, scope: dict[str, object], *, quick: tuple[str, str] = ("", "")) -> None:
    for block in blocks(ROOT / page, "python"):
        exec(compile(block.replace(*quick), page, "exec"), scope)


SOURCES = [*PAGES, *sorted((ROOT / "examples").glob("*.*"))]


@pytest.mark.parametrize("source", SOURCES, ids=lambda path: path.name)
def test_every_command_that_is_shown_is_one_that_the_command_line_takes(source, monkeypatch):
    monkeypatch.chdir(ROOT)
    text = source.read_text(encoding="utf-8")
    if source.suffix == ".md":
        text = "\n".join(blocks(source, ""))
    names = {alias: name for name, others in ALIASES.items() for alias in others}
    for program, command, *options in commands(text):
        assert command in (
            {**COMMANDS, **names} if program == "offbeat" else thesis.__main__.COMMANDS
        )
        parser = parser_of(names.get(command, command))
        parser.instantiate(parser.parse_args(options))


def test_the_commands_of_a_page_are_found():
    text = "$ offbeat train a b \\\n    --seed 1 > out  # so\n"
    text += "# python -m thesis run --tiny\noffbeat: no\n"
    assert commands(text) == [
        ["offbeat", "train", "a", "b", "--seed", "1"],
        ["thesis", "run", "--tiny"],
    ]


SMALL = "model=ob.ModelConfig(hidden_size=4), training=ob.TrainConfig(epochs=1)"


@pytest.fixture
def logs(tmp_path, monkeypatch):
    """log.csv and arm.csv in the working directory: a pendulum at 50 Hz."""
    monkeypatch.chdir(tmp_path)
    t = 0.02 * np.arange(1000)
    lines = [f"{time:.2f},{np.sin(time):.5f},{np.cos(time):.5f}" for time in t]
    for name in ("log.csv", "arm.csv"):
        (tmp_path / name).write_text("\n".join(["time,x,v", *lines]))


@pytest.mark.slow
def test_the_python_of_the_readme_runs(logs, tmp_path, capsys):
    scope: dict[str, object] = {}
    run_python("README.md", scope, quick=('"runs/arm")', f'"runs/arm", {SMALL})'))
    assert scope["low"].shape == (2, 2)
    assert "last_value" in capsys.readouterr().out
    assert (tmp_path / "runs/first/copy/model.safetensors").is_file()
    scores = ob.evaluate(scope["again"], scope["test"]).scores
    for name in ("anchored_ode_gru_d", "last_value"):
        assert np.isfinite(scores[name].after_first_observation.rmse)


@pytest.mark.slow
def test_the_commands_of_the_readme_run(tmp_path, monkeypatch):
    """With fewer trajectories than shown: what is shown takes minutes."""
    monkeypatch.chdir(tmp_path)
    (text,) = [block for block in blocks(ROOT / "README.md", "") if "offbeat simulate" in block]
    for _, *arguments in commands(text.replace("2000", "60")):
        small = ["--training.epochs=2"] if arguments[0] == "train" else []
        assert main([*arguments, *small]) == 0, arguments
    assert (tmp_path / "predictions.csv").is_file()


@pytest.mark.slow
def test_the_python_of_the_answers_page_runs(logs, capsys):
    scope: dict[str, object] = {}
    run_python("docs/answers.md", scope, quick=('"runs/python")', f'"runs/python", {SMALL})'))
    assert "pchip" in capsys.readouterr().out
    assert scope["filled"].rows == 1999  # from 0 to 19.98 s at 100 Hz
    assert (scope["low_x"] <= scope["high_x"]).all()


@pytest.mark.slow
def test_the_commands_of_the_answers_page_run(logs):
    text = next(block for block in blocks(ROOT / "docs/answers.md", "") if "log.csv" in block)
    for _, *arguments in commands(text):
        small = ["--training.epochs=1", "--model.hidden_size=4"] if arguments[0] == "train" else []
        assert main([*arguments, *small]) == 0, arguments
    assert Path("ahead.csv").is_file()


@pytest.mark.parametrize("page", ["docs/readers.md", "docs/readers_robots.md"])
def test_the_readers_take_the_options_that_their_pages_show(page, monkeypatch):
    """Without the files: those that are read in other tests are of every format."""

    def read(path: str, *, format: str | None = None, **options: object) -> ob.Dataset:
        suffix = Path(path).suffix or "/"
        known = [reader.options for reader in READERS.values() if suffix in reader.suffixes]
        assert any(set(options) <= set(names) for names in known), (path, options)
        return ob.Dataset((ob.Trajectory([0.0, 1.0], [[1.0], [2.0]]),), {"cleaning": {}})

    monkeypatch.setattr(ob, "read", read, raising=False)
    run_python(page, {"ob": ob, "read_mine": lambda path: ()})
    READERS.unregister("mine")


def test_the_python_of_the_statistics_page_runs(capsys):
    run_python("docs/statistics.md", {}, quick=("4000", "20"))
    assert len(capsys.readouterr().out.splitlines()) == 3


def test_every_command_is_named_in_the_readme():
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    assert [name for name in COMMANDS if f"offbeat {name}" not in readme] == []


def test_the_links_lead_somewhere():
    for page in PAGES:
        for target in re.findall(r"\]\(([^)#:]+)\)", page.read_text(encoding="utf-8")):
            assert (page.parent / target).exists(), (page.name, target)
