"""No option runs what a config names or takes all memory; completion knows every option."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

import thesis.__main__
from offbeat.cli import app
from offbeat.cli.option_groups import reader_options, training_options
from offbeat.cli.parser import CommandParser

COMMANDS = [(app.main, name) for name in app.COMMANDS]
COMMANDS += [(thesis.__main__.main, name) for name in thesis.__main__.COMMANDS]


def parser_of(command: str) -> CommandParser:
    function = {**app.COMMANDS, **thesis.__main__.COMMANDS}[command]
    groups = {"reader": reader_options, "training": training_options}
    parser = CommandParser(function, groups, prog="offbeat")
    parser.fill()
    return parser


def options_of(command: str) -> list[str]:
    """The names of all options and paths of a command: `seed`, `split.window`, `split`."""
    names = {action.dest for action in parser_of(command)._actions}
    return sorted({*names, *(name.partition(".")[0] for name in names)} - {"help", "config"})


def paths_of(command: str, folder: Path) -> list[str]:
    """Paths for which every command stops before it has done anything."""
    (folder / "file").touch()
    at_fault = {"simulate": ["a.csv"], "doctor": [], "demo": ["--out=file"], "run": ["--out=file"]}
    required = [a.dest for a in parser_of(command)._actions if not a.option_strings]
    return at_fault.get(command, [f"file/{name}.csv" for name in required])


@pytest.mark.parametrize(("main", "command"), COMMANDS)
def test_no_option_of_any_command_runs_what_a_config_names(
    main, command, tmp_path, capsys, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    paths = paths_of(command, tmp_path)
    capsys.readouterr()
    hostile = {"class_path": "os.system", "init_args": {"command": "touch marker"}}
    for option in options_of(command):
        for value in (hostile, {"x": hostile}) if "." not in option else (hostile,):
            given: Any = value
            for name in reversed(option.split(".")):
                given = {name: given}
            Path("config.yaml").write_text(json.dumps(given))
            forms = [["--config=config.yaml"]]
            if (
                value is hostile and option != "out" and "." not in option
            ):  # typed, that would name a file
                forms += [[f"--{option}={json.dumps(value)}"]]
            for arguments in forms:
                assert main([command, *paths, *arguments]) == 2, (option, arguments)
                error = capsys.readouterr().err
                assert error.startswith("offbeat: error: "), (option, arguments)
                assert len(error.splitlines()) == 1, (option, arguments)
                assert not Path("marker").exists(), (option, arguments)


@pytest.mark.parametrize("command", [name for _, name in COMMANDS])
def test_every_option_has_a_type_and_no_type_takes_anything(command):
    for action in parser_of(command)._actions:
        kind = str(getattr(action, "_typehint", action.type))
        assert not any(word in kind for word in ("Any", "object", "Unvalidated")), action.dest


BOMB = "a: &a [x, x]\n" + "".join(
    f"{chr(98 + i)}: &{chr(98 + i)} [*{chr(97 + i)}, *{chr(97 + i)}]\n" for i in range(24)
)


@pytest.mark.parametrize(
    "text",
    [
        BOMB,
        "model: " + "[" * 100_000,
        "seed: " + "{a: " * 200 + "1" + "}" * 200,
        "seed: &a [*a]",
        "reader: !!python/object/apply:os.system ['touch marker']",
        "seed: [",
        "- seed",
        "",
        "seed: \x00",
        "x" * 2_000_000,
    ],
    ids=["aliases", "deep", "nested", "cycle", "tag", "cut", "list", "empty", "control", "long"],
)
def test_a_config_that_is_no_config_ends_in_one_line(text, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("config.yaml").write_text(text)
    assert app.main(["train", "none.csv", "out", "--config", "config.yaml"]) == 2
    error = capsys.readouterr().err
    assert error.startswith("offbeat: error: ")
    assert len(error.splitlines()) == 1
    assert len(error) < 1000
    assert not Path("marker").exists()


@pytest.mark.parametrize("text", [BOMB, "model: " + "[" * 100_000], ids=["aliases", "deep"])
def test_the_config_of_a_run_that_is_compared_is_read_within_bounds(text, tmp_path, capsys):
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "config.yaml").write_text(text)
        (tmp_path / name / "results.json").write_text("{}")
    assert app.main(["compare", str(tmp_path / "a"), str(tmp_path / "b")]) == 2
    error = capsys.readouterr().err
    assert str(tmp_path / "a" / "config.yaml") in error
    assert len(error.splitlines()) == 1


@pytest.mark.parametrize("value", ["[" * 100_000, "{a: " * 200, BOMB])
def test_a_typed_value_that_is_no_value_ends_in_one_line(value, tmp_path, capsys):
    inner = tmp_path / "model.yaml"
    for wrapped in (value, json.dumps(value), json.dumps(json.dumps(value))):
        inner.write_text(json.dumps({"hidden_size": wrapped}))
        for name, given in (("--model", inner), ("--seed", wrapped)):
            assert app.main(["train", "none.csv", str(tmp_path / "out"), name, str(given)]) == 2
            assert len(capsys.readouterr().err.splitlines()) == 1
    for option in ("--seed", "--reader", "--split.sensors", "--model", "--reader.units"):
        assert app.main(["train", "none.csv", str(tmp_path / "out"), option, value]) == 2
        assert len(capsys.readouterr().err.splitlines()) == 1


COMPLETE = """
source completion
complete_line() { COMP_WORDS=("$@"); COMP_CWORD=$(($# - 1)); _shtab_offbeat; echo ${COMPREPLY[@]}; }
complete_line offbeat ex
complete_line offbeat train --split.obs
complete_line offbeat train --two
complete_line offbeat train a b --split.mask ''
complete_line offbeat extrapolate --reader.time_u
"""


def test_bash_completes_commands_options_and_choices(tmp_path):
    python = [sys.executable, "-m", "offbeat", "--print_completion=shtab-bash"]
    script = subprocess.run(python, capture_output=True, text=True, check=True).stdout
    (tmp_path / "completion").write_text(script)
    found = subprocess.run(
        ["bash", "-c", COMPLETE], cwd=tmp_path, capture_output=True, text=True, check=True
    )
    assert found.stdout.splitlines() == [
        "extrapolate export",
        "--split.observed_fraction",
        "--two_sided",
        "rows values bursts dropout",
        "--reader.time_unit",
    ]


@pytest.mark.parametrize("shell", ["zsh", "tcsh"])
def test_completion_of_other_shells_knows_commands_options_and_choices(shell):
    found = subprocess.run(
        [sys.executable, "-m", "offbeat", f"--print_completion=shtab-{shell}"],
        capture_output=True,
        text=True,
        check=True,
    )
    for word in ("forecast", "extrapolate", "--two_sided", "--reader.time_unit", "dropout"):
        assert word in found.stdout


@pytest.mark.parametrize(
    ("option", "expected"),
    [
        ("max_gap_s=abc", "--reader.max_gap_s must be float, Literal['auto'], null, got abc"),
        ("units=abc", "--reader.units must be Mapping[str, str], null, got abc"),
        ("order=[1]", "--reader.order must be Literal['sort', 'drop', 'refuse'], got [1]"),
        (f"min_rows={'a' * 5000}", f"--reader.min_rows must be int, got {'a' * 60}..."),
    ],
)
def test_an_option_of_a_wrong_type_is_one_short_line(option, expected, tmp_path, capsys):
    (tmp_path / "log.csv").write_text("time,x\n0,1\n1,2\n")
    assert app.main(["inspect", str(tmp_path / "log.csv"), f"--reader.{option}"]) == 2
    assert capsys.readouterr().err == f"offbeat: error: {expected}\n"
