"""The command: what it prints, what it writes, and one clear line for every bad input."""

import csv
import importlib.metadata
import inspect
import io
import json
import re
import shutil
import subprocess
import sys
import time
import tomllib
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any, Literal, NotRequired

import numpy as np
import pytest
import torch
import yaml
from packaging.requirements import Requirement

import offbeat as ob
from offbeat import doctor, progress
from offbeat.cli.app import COMMANDS, FREQUENT, main, run_commands
from offbeat.cli.help import in_words
from offbeat.cli.option_groups import reader_options, training_options
from offbeat.cli.parser import CommandParser
from offbeat.cli.train import train_command
from offbeat.config import TaskConfig
from offbeat.models.zoo import MODELS

SMALL = [
    "--model.name=gru", "--model.hidden_size=4", "--training.epochs=1", "--training.batch_size=8",
]  # fmt: skip


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    path = tmp_path_factory.mktemp("data") / "hopper.parquet"
    ob.save(ob.simulate("hopper", 24, 30, seed=1, progress=False), path)
    return path


@pytest.fixture(scope="module")
def run(data, tmp_path_factory):
    out = tmp_path_factory.mktemp("runs") / "first"
    parts = ["--split.window=20", "--split.observed_fraction=0.5"]
    assert main(["train", str(data), str(out), *SMALL, *parts]) == 0
    return out


def one_line_error(capsys, *arguments) -> str:
    """Runs the command, which must fail as bad input does; returns its one line."""
    capsys.readouterr()
    assert main([str(a) for a in arguments]) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    lines = captured.err.strip().splitlines()
    lines = [line for line in lines if "%|" not in line]  # a progress bar that had begun
    assert len(lines) == 1, captured.err
    assert lines[0].startswith("offbeat: error: ")
    return lines[0]


def test_help_teaches_every_command(capsys):
    for arguments in ([], ["--help"]):
        with pytest.raises(SystemExit) as stop:
            main(arguments)
        assert stop.value.code == 0
        text = capsys.readouterr().out
        assert all(command in text for command in COMMANDS)
        assert "offbeat train hopper.parquet" in text


@pytest.mark.parametrize("command", COMMANDS)
def test_each_command_describes_every_option(command, capsys):
    with pytest.raises(SystemExit):
        main([command, "--help"])
    text = capsys.readouterr().out
    options = [line for line in text.splitlines() if line.startswith("  --")]
    assert options
    main_line = inspect.cleandoc(COMMANDS[command].__doc__).splitlines()[0]
    assert main_line in " ".join(text.split())
    for python in ("<class", "None", "Union[", "Optional[", "list[", "Literal["):
        assert python not in text, python
    assert not re.search(r"--\w+[+]|default: null", text)


def test_types_in_a_help_are_words():
    known = {
        Path | None: "path",
        list[float] | float | None: "list of number or number",
        float | Literal["auto"] | None: "number or one of auto",
        Literal["a", "b"]: "one of a, b",
        NotRequired[tuple[int, ...]]: "list of integer",
        Mapping[str, str]: "JSON",
        dict[str, int]: "JSON",
        TaskConfig | None: "YAML",
    }
    assert {kind: in_words(kind) for kind in known} == known


def test_python_m_offbeat_is_the_command():
    found = subprocess.run(
        [sys.executable, "-m", "offbeat", "--version"], capture_output=True, text=True, check=True
    )
    assert found.stdout.strip() == f"offbeat {ob.__version__}"


def test_simulate_writes_a_data_set_and_says_so_in_json(tmp_path, capsys):
    out = tmp_path / "walker.parquet"
    arguments = ["--robot=walker", "--n_trajectories=3", "--rows=5", "--seed=7", "--json"]
    assert main(["simulate", str(out), *arguments]) == 0
    said = json.loads(capsys.readouterr().out)
    assert said["meta"]["robot"] == "walker"
    assert len(ob.load(out)) == 3


def test_train_leaves_everything_that_a_run_needs(run):
    assert {"config.yaml", "log.csv", "checkpoints", "model", "split.json", "results.json"} <= {
        path.name for path in run.iterdir()
    }
    config = yaml.safe_load((run / "config.yaml").read_text())
    assert config["model"]["hidden_size"] == 4
    assert config["model"]["solver"] == "euler", "the resolved config names every option"
    results = json.loads((run / "results.json").read_text())
    assert set(results["predictors"]) == {"gru", "last_value"}


def test_the_saved_config_trains_the_same_model_again(run, data, tmp_path):
    out = tmp_path / "again"
    arguments = ["train", f"--config={run / 'config.yaml'}", str(data), str(out)]
    assert main(arguments) == 0
    assert json.loads((out / "results.json").read_text()) == json.loads(
        (run / "results.json").read_text()
    )


def test_what_is_typed_wins_over_a_config_in_any_order(run, data, tmp_path):
    before = (run / "results.json").read_bytes()
    out = tmp_path / "typed"
    assert main(["train", str(data), str(out), "--config", str(run / "config.yaml")]) == 0
    assert (out / "results.json").is_file()
    assert (run / "results.json").read_bytes() == before


def parsed(*arguments: str) -> dict[str, Any]:
    """What a command would be given."""
    given: dict[str, Any] = {}

    def command(
        paths: list[str],
        model: ob.ModelConfig = ob.ModelConfig(),  # noqa: B008
        horizons: list[float] | float | None = None,
        channels: list[str] | None = None,
        two_sided: bool = False,
        json: bool = True,
        seed: int = 0,
        training: dict[str, Any] | None = None,
        reader: dict[str, Any] | None = None,
        split: ob.SplitConfig = ob.SplitConfig(),  # noqa: B008
    ) -> None:
        """Take options."""
        given.update(locals())

    assert run_commands({"go": command}, ["go", *arguments], prog="test", description="") == 0
    return given


@pytest.mark.parametrize(
    ("typed", "name", "value"),
    [
        (["--two_sided"], "two_sided", True),
        (["--two_sided=true"], "two_sided", True),
        (["--two_sided=false"], "two_sided", False),
        (["--two_sided", "true"], "two_sided", True),
        (["--json=false"], "json", False),
        (["--json", "false"], "json", False),
        (["--json", "--seed=3"], "json", True),
        (["--horizons", "0.1,0.5"], "horizons", [0.1, 0.5]),
        (["--horizons=[0.1, 0.5]"], "horizons", [0.1, 0.5]),
        (["--horizons", "1e-3"], "horizons", [0.001]),
        (["--channels", "q[0],q[1]"], "channels", ["q[0]", "q[1]"]),
        (["--channels", '["a,b"]'], "channels", ["a,b"]),
        (["--model.field_units", "3,4"], "model", ob.ModelConfig(field_units=(3, 4))),
        (["--model.anchored"], "model", ob.ModelConfig(anchored=True)),
        (["--model.anchored=false"], "model", ob.ModelConfig(anchored=False)),
        ([], "reader", None),
        (["--reader.max_gap_s", "null"], "reader", {"max_gap_s": None}),
        (["--reader", '{"max_gap_s": 2, "format": "csv"}'], "reader",
         {"max_gap_s": 2.0, "format": "csv"}),
        (["--reader.units", '{"a": "m"}'], "reader", {"units": {"a": "m"}}),
        (["--reader.episodes", "1,2"], "reader", {"episodes": [1, 2]}),
        (["--reader.unwrap=false"], "reader", {"unwrap": False}),
        (["--training.epochs=3"], "training", {"epochs": 3}),
    ],
)  # fmt: skip
def test_flags_lists_and_groups_are_read_as_they_are_typed(typed, name, value):
    assert parsed("a", "b", *typed)[name] == value
    before = parsed(*typed, "a", "b")
    assert (before[name], before["paths"]) == (value, ["a", "b"])


def test_a_flag_takes_true_or_false_alone(capsys):
    error = one_line_error(capsys, "doctor", "--json=maybe")
    assert "--json" in error
    assert "'maybe'" in error


def test_paths_stand_together(capsys):
    error = one_line_error(capsys, "compare", "a", "--json", "b")
    assert error.endswith("unrecognized arguments: b; give all paths together")


def test_a_config_counts_where_nothing_is_typed_before_or_after_it(tmp_path):
    path = tmp_path / "config.yaml"
    path.write_text(
        "paths: [c]\nseed: 5\ntwo_sided: true\nhorizons: 0.5\nmodel: {name: gru, hidden_size: 3}\n"
        "reader: {repeated: mask, max_gap_s: null}\ntraining: null\n"
    )
    config = f"--config={path}"
    alone = parsed(config)
    assert (alone["paths"], alone["seed"], alone["two_sided"]) == (["c"], 5, True)
    assert (alone["horizons"], alone["training"]) == (0.5, None)
    assert alone["reader"] == {"repeated": "mask", "max_gap_s": None}
    typed = [
        "a",
        "b",
        "--seed=0",
        "--model.hidden_size=4",
        "--two_sided=false",
        "--reader.repeated=keep",
    ]
    for arguments in (
        [config, *typed],
        [*typed, config],
        [*typed[:4], "--config", str(path), *typed[4:]],
    ):
        got = parsed(*arguments)
        assert (got["paths"], got["seed"], got["two_sided"]) == (["a", "b"], 0, False)
        assert got["model"] == ob.ModelConfig(name="gru", hidden_size=4)
        assert got["reader"] == {"repeated": "keep", "max_gap_s": None}
    second = tmp_path / "second.yaml"
    second.write_text("seed: 6\n")
    both = parsed(config, "--config", str(second))
    assert (both["seed"], both["two_sided"]) == (6, True)


@pytest.mark.parametrize(
    ("of_config", "typed", "expected"),
    [
        ("window: 100", "window_s=0.5", {"window_s": 0.5, "window": None}),
        ("window_s: 0.5", "window=100", {"window_s": None, "window": 100}),
        ("burst_rows: 5", "burst_s=0.5", {"burst_s": 0.5, "burst_rows": None}),
    ],
)
def test_what_is_typed_in_seconds_replaces_rows_of_a_config(tmp_path, of_config, typed, expected):
    path = tmp_path / "config.yaml"
    path.write_text(f"split: {{{of_config}, seed: 3}}\n")
    split = parsed("a", "b", f"--config={path}", f"--split.{typed}")["split"]
    assert {name: getattr(split, name) for name in (*expected, "seed")} == {**expected, "seed": 3}


def test_a_part_can_be_asked_for_on_the_data_of_the_run_alone(run, data, tmp_path, capsys):
    other = tmp_path / "other.parquet"
    ob.save(ob.simulate("hopper", 3, 30, seed=9, progress=False), other)
    assert "--part" in one_line_error(capsys, "evaluate", run, other, "--part=train")
    assert main(["evaluate", str(run), str(other)]) == 0
    assert "part: all" in capsys.readouterr().out
    assert main(["evaluate", str(run / "model"), str(data)]) == 0
    assert "part: all" in capsys.readouterr().out


def test_a_checkpoint_of_a_training_that_goes_on_can_be_used(run, data, tmp_path):
    (checkpoint,) = (run / "checkpoints").iterdir()
    out = tmp_path / "predictions.csv"
    assert main(["predict", str(checkpoint), str(data), str(out), "--times", "0.1"]) == 0
    assert out.is_file()


def test_what_stands_there_is_not_overwritten(run, data, tmp_path, capsys):
    copy = tmp_path / "copy.parquet"
    copy.write_bytes(data.read_bytes())
    assert str(copy) in one_line_error(capsys, "predict", run, copy, copy)
    assert copy.read_bytes() == data.read_bytes()
    folder = tmp_path / "other"
    folder.mkdir()
    (folder / "config.yaml").write_text("mine")
    assert str(folder) in one_line_error(capsys, "train", data, folder, *SMALL)
    assert (folder / "config.yaml").read_text() == "mine"
    for arguments in (["simulate", folder / "config.yaml" / "a.parquet"], ["train", data, copy]):
        one_line_error(capsys, *arguments)
    (tmp_path / "d.parquet").mkdir()
    assert "d.parquet" in one_line_error(capsys, "simulate", tmp_path / "d.parquet")


def test_print_config_prints_yaml_that_can_be_overridden(tmp_path, capsys):
    with pytest.raises(SystemExit):
        main(["train", "a.parquet", "out", "--model.name=ode_rnn", "--print_config"])
    config = yaml.safe_load(capsys.readouterr().out)
    assert config["model"]["name"] == "ode_rnn"
    assert config["split"]["observed_fraction"] is None


def test_evaluate_scores_the_test_part_on_the_same_values(run, data, capsys):
    capsys.readouterr()
    assert main(["evaluate", str(run), str(data), "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    results = json.loads((run / "results.json").read_text())
    assert said["part"] == "test"
    assert said["predictors"] == results["predictors"]
    assert main(["evaluate", str(run), str(data), "--part=all"]) == 0
    assert "part: all, 24 trajectories" in capsys.readouterr().out


def test_predict_answers_at_asked_times_in_original_units(run, data, tmp_path):
    out = tmp_path / "predictions.csv"
    assert main(["predict", str(run), str(data), str(out), "--times=[0.1, 0.2]"]) == 0
    with out.open() as file:
        lines = list(csv.DictReader(file))
    assert len(lines) == 24 * 2
    assert [float(line["time"]) for line in lines[:2]] == [0.1, 0.2]
    expected = ob.predict(ob.load_run(run), ob.load(data), times=[0.1, 0.2])
    assert (
        float(lines[1]["waist_qpos"]) == expected[0].values[1, expected.names.index("waist_qpos")]
    )


def test_predict_reads_a_csv_with_empty_values_and_columns_in_another_order(run, data, tmp_path):
    names = list(ob.load(data).names)
    path = tmp_path / "log.csv"
    rows = [[f"{0.005 * i}", *(str(0.1 * i + j) if i % 2 else "" for j in range(14))] for i in
            range(6)]  # fmt: skip
    with path.open("w", newline="") as file:
        csv.writer(file).writerows([["time", *reversed(names)], *rows])
    out = tmp_path / "predictions.parquet"
    assert main(["predict", str(run), str(path), str(out)]) == 0
    import pyarrow.parquet as pq

    table = pq.read_table(out)
    assert table.column_names[:16] == ["trajectory", "time", *names]
    assert {f"{name}|low" for name in names} < set(table.column_names)
    assert np.isfinite(table["knee_qvel"].to_numpy()).all()


def test_predict_keeps_the_clock_of_a_log_in_nanoseconds(run, data, tmp_path):
    names = list(ob.load(data).names)
    start, path, out = 1_700_000_000_123_456_789, tmp_path / "log.csv", tmp_path / "out.csv"
    with path.open("w", newline="") as file:
        rows = [[start + 5_000_000 * i, *[0.1 * i] * 14] for i in range(4)]
        csv.writer(file).writerows([["time_ns", *names], *rows])
    assert main(["predict", str(run), str(path), str(out), "--times=[0.0025, 0.02]"]) == 0
    with out.open() as file:
        lines = list(csv.DictReader(file))
    assert [float(line["time"]) for line in lines] == [0.0025, 0.02]
    assert [int(line["clock_ns"]) for line in lines] == [start + 2_500_000, start + 20_000_000]


@pytest.fixture
def stamped(data, tmp_path):
    """A log of 4 rows whose clock shows 100 s at the first, in a column that must be named."""
    path = tmp_path / "stamped.csv"
    with path.open("w", newline="") as file:
        rows = [[f"{100 + 0.005 * i:.3f}", *[0.1 * i] * 14] for i in range(4)]
        csv.writer(file).writerows([["when", *ob.load(data).names], *rows])
    return path


def test_predict_takes_times_since_the_first_row_or_on_the_clock(run, stamped, tmp_path, capsys):
    out, named = tmp_path / "out.csv", "--reader.time_column=when"
    answers = []
    for options in (["--times=0.01"], ["--times=100.01", "--reader.start=clock"]):
        assert main(["predict", str(run), str(stamped), str(out), named, *options]) == 0
        with out.open(newline="") as file:
            answers += list(csv.DictReader(file))
    since, shown = answers
    assert (since.pop("time"), since.pop("clock_s")) == ("0.01", "100.01")
    assert shown.pop("time") == "100.01"
    assert since.keys() == shown.keys()
    numbers = [name for name, value in since.items() if value not in ("true", "false")]
    assert [float(since[n]) for n in numbers] == pytest.approx([float(shown[n]) for n in numbers])
    error = one_line_error(capsys, "predict", run, stamped, out, named, "--times=[0.01, 100.01]")
    assert all(said in error for said in ("100.01", "0.015", "give 0.01", "--reader.start clock"))
    assert main(["predict", str(run), str(stamped), str(out), named, "--times=150"]) == 0


def test_options_of_the_run_hold_beside_those_that_are_given(run, stamped, tmp_path, capsys):
    copy, out = tmp_path / "run", tmp_path / "out.csv"
    shutil.copytree(run, copy)
    (copy / "reader.json").write_text('{"time_column": "when", "time_unit": "s"}')
    predict = ["predict", str(copy), str(stamped), str(out), "--times=0.01"]
    for options in ([], ["--reader.repeated=mask"]):
        assert main([*predict, *options]) == 0
    assert main([*predict, "--time_unit=ms"]) == 0
    with out.open(newline="") as file:
        assert [row["clock_ms"] for row in csv.DictReader(file)] == ["110"]
    one_line_error(capsys, *predict, "--reader.format=csv")  # and no longer those of the run


def test_doctor_names_every_declared_dependency_with_its_version(capsys):
    assert main(["doctor", "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert {"offbeat", "python", "torch threads", "scan backend"} <= set(said)
    project = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text())["project"]
    declared = [*project["dependencies"]]
    for extra, names in project["optional-dependencies"].items():
        declared += names if extra not in ("test", "bench", "hub") else []
    for text in declared:
        name = Requirement(text).name
        assert said[name] == importlib.metadata.version(name)
    try:  # what the tests do not need
        hub = importlib.metadata.version("huggingface-hub")
    except importlib.metadata.PackageNotFoundError:
        hub = "missing; pip install 'offbeat[hub]'"
    assert said["huggingface-hub"] == hub


def test_doctor_says_which_extra_brings_what_is_missing(monkeypatch):
    monkeypatch.setattr("importlib.metadata.version", missing)
    found = doctor.examine()
    assert found["scipy"].startswith("missing; blends of `learn`")
    assert found["mujoco"] == "missing; pip install 'offbeat[sim]'"


def missing(name: str) -> str:
    raise importlib.metadata.PackageNotFoundError(name)


def test_bad_input_is_one_clear_line_and_exit_code_2(run, data, tmp_path, capsys):
    out = tmp_path / "out"
    assert "'fly'" in one_line_error(capsys, "fly")
    error = one_line_error(capsys, "simulate", out / "a.csv")
    assert ".parquet" in error
    error = one_line_error(capsys, "simulate", out / "a.parquet", "--robot=hoper")
    assert "did you mean 'hopper'" in error
    error = one_line_error(capsys, "train", tmp_path / "none.parquet", out)
    assert "none.parquet" in error
    for fraction in ("0", "1.2"):
        error = one_line_error(capsys, "train", data, out, f"--split.observed_fraction={fraction}")
        assert f"--split.observed_fraction must be above 0 and at most 1, got {fraction}" in error
    error = one_line_error(capsys, "train", data, out, "--model.name=ode_rn")
    assert "did you mean 'ode_rnn'" in error
    config = tmp_path / "of_0_1_0.yaml"
    config.write_text("model: {age_input: gap}")
    for old, new in (
        ("--parts.window=20", "--split.window"),
        ("--parts.hide=rows", "--split.mask"),
        ("--model.age_unit=gap", "--model.time_input_unit"),
        (f"--config={config}", "--model.time_input"),
    ):
        assert f"did you mean {new!r}" in one_line_error(capsys, "train", data, out, old)
    error = one_line_error(capsys, "train", data, out, "--training.epochs=none")
    assert "epochs" in error
    for option in ("--split.seed=-1", "--training.seed=-1", "--seed=-1"):
        assert "seed" in one_line_error(capsys, "train", data, out, option)
    assert "--threads must be" in one_line_error(capsys, "train", data, out, "--threads=0")
    error = one_line_error(capsys, "predict", run, data, out / "a.csv", "--time_unit=ms")
    assert "--time_unit" in error
    error = one_line_error(capsys, "evaluate", tmp_path, data)
    assert str(tmp_path) in error
    error = one_line_error(capsys, "predict", run, data, out / "a.xlsx")
    assert ".csv" in error
    error = one_line_error(capsys, "predict", run, data, out / "a.csv", "--times=[0.2, 0.1]")
    assert "0.2" in error
    assert not out.exists(), "bad input writes nothing"


def test_a_config_with_an_unknown_key_is_refused(run, data, tmp_path, capsys):
    config = yaml.safe_load((run / "config.yaml").read_text())
    config["training"]["epoks"] = 3
    path = tmp_path / "config.yaml"
    path.write_text(yaml.safe_dump(config))
    error = one_line_error(capsys, "train", f"--config={path}", data, tmp_path / "out")
    assert "epoks" in error
    assert not (tmp_path / "out").exists()


def test_data_of_other_channels_and_a_damaged_checkpoint_are_refused(run, data, tmp_path, capsys):
    walker = tmp_path / "walker.parquet"
    ob.save(ob.simulate("walker", 3, 30, progress=False), walker)
    assert "hip_qpos" in one_line_error(capsys, "evaluate", run, walker)
    copy = tmp_path / "copy"
    ob.save_model(ob.load_model(run), copy)
    damaged = bytearray((copy / "model.safetensors").read_bytes())
    damaged[-5] ^= 1
    (copy / "model.safetensors").write_bytes(bytes(damaged))
    assert str(copy) in one_line_error(capsys, "evaluate", copy, data)


@pytest.mark.parametrize(
    ("times", "options", "said"),
    [
        (("0.0", "0.2", "0.1"), ["--reader.order", "refuse"], ("order", "0.1")),
        (("0.0", "nan", "0.1"), [], ("time",)),
        (("0.0", "inf", "0.1"), [], ("inf",)),
        (("0.0", "0.1", "inf", "inf", "0.2"), [], ("inf",)),
    ],
)
def test_times_that_cannot_be_used_are_named(run, data, tmp_path, capsys, times, options, said):
    names = ob.load(data).names
    path = tmp_path / "log.csv"
    with path.open("w", newline="") as file:
        csv.writer(file).writerows([["time", *names], *([t, *[1.0] * 14] for t in times)])
    error = one_line_error(capsys, "predict", run, path, tmp_path / "out.csv", *options)
    assert all(word in error for word in said), error


def test_rows_out_of_order_are_sorted_by_default(run, data, tmp_path):
    names = ob.load(data).names
    path, out = tmp_path / "log.csv", tmp_path / "out.csv"
    with path.open("w", newline="") as file:
        rows = ([t, *[1.0] * 14] for t in ("0.0", "0.2", "0.1"))
        csv.writer(file).writerows([["time", *names], *rows])
    assert main(["predict", str(run), str(path), str(out)]) == 0
    with out.open(newline="") as file:
        assert [float(row["time"]) for row in csv.DictReader(file)] == [0.0, 0.1, 0.2]


def test_a_channel_that_is_never_observed_is_named(tmp_path, capsys):
    path = tmp_path / "log.csv"
    with path.open("w", newline="") as file:
        rows = [[e, 0.1 * i, i, ""] for e in range(10) for i in range(5)]
        csv.writer(file).writerows([["episode", "time", "knee", "ankle"], *rows])
    error = one_line_error(capsys, "train", path, tmp_path / "out", *SMALL)
    assert "ankle" in error


def test_a_missing_extra_is_named_by_its_extra(tmp_path):
    """A sitecustomize-like block of `mujoco` simulates a machine without it."""
    code = (
        "import sys; sys.modules['mujoco'] = None\n"
        "from offbeat.cli.app import main; sys.exit(main(sys.argv[1:]))"
    )
    found = subprocess.run(
        [sys.executable, "-c", code, "simulate", str(tmp_path / "a.parquet")],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert found.returncode == 2
    assert "pip install 'offbeat[sim]'" in found.stderr
    assert len(found.stderr.strip().splitlines()) == 1
    assert not list(Path(tmp_path).iterdir())


def test_the_example_config_runs(data, tmp_path):
    path = Path(__file__).parents[1] / "examples" / "anchored.yaml"
    arguments = ["--split.window=20", "--training.epochs=1", "--model.hidden_size=4"]
    out = tmp_path / "run"
    assert main(["train", f"--config={path}", *arguments, str(data), str(out)]) == 0
    assert "anchored_ode_gru_d" in (out / "results.json").read_text()


@pytest.mark.parametrize(
    ("said", "spoken"),
    [
        ("give window or window_s, not both", "give window or --split.window_s, not both"),
        ("split it by time (by='time')", "split it by time (--split.by time)"),
        ("name its format with format=", "name its format with --reader.format"),
        ("epochs must be at least 1, got 0", "--training.epochs must be at least 1, got 0"),
        ("seed must be at least 0", "seed must be at least 0"),
        ("there is no file 'window_s'", "there is no file 'window_s'"),
        ("out.csv/window_s is a file", "out.csv/window_s is a file"),
    ],
)
def test_messages_of_the_library_name_options_as_they_are_typed(said, spoken):
    parser = CommandParser(
        train_command, {"reader": reader_options, "training": training_options}, prog="offbeat"
    )
    parser.fill()
    assert parser.spoken(said) == spoken


@pytest.mark.slow
def test_a_training_without_options_follows_the_recipe_and_beats_the_last_value(tmp_path):
    data, run = tmp_path / "hopper.parquet", tmp_path / "run"
    assert main(["simulate", str(data), "--n_trajectories=1000", "--rows=60"]) == 0
    assert main(["train", str(data), str(run)]) == 0
    results = json.loads((run / "results.json").read_text())
    assert results["steps"] <= 700
    rmse = {
        name: scores["after_first_observation"]["rmse"]
        for name, scores in results["predictors"].items()
    }
    assert rmse["anchored_ode_gru_d"] < 0.8 * rmse["last_value"]
    config = yaml.safe_load((run / "config.yaml").read_text())["training"]
    recipe = ob.train_config("anchored_ode_gru_d", keep="best")
    expected = {k: v for k, v in asdict(recipe).items() if v is not None}
    assert expected.items() <= config.items()
    assert config["optimizer"] == "adam"


class Mean(torch.nn.Module):
    """Predicts a learned mean of each channel: a model that is none of the library's."""

    def __init__(self, data: ob.DataInfo) -> None:
        super().__init__()
        self.mean = torch.nn.Parameter(torch.zeros(len(data.names)))

    def forward(self, batch: ob.Batch) -> ob.Prediction:
        return ob.Prediction(self.mean.expand_as(batch.values))


def test_a_model_of_ones_own_goes_through_every_command(data, tmp_path, capsys):
    ob.register_model("mean", Mean)
    run, out = tmp_path / "run", tmp_path / "out.csv"
    train = ["train", str(data), str(run), "--model.name=mean", "--training.epochs=1"]
    try:
        assert "--model.hidden_size" in one_line_error(capsys, *train, "--model.hidden_size=3")
        assert "'gpu'" in one_line_error(capsys, *train, "--device=gpu")
        assert not run.exists()
        assert main([*train, "--device=cpu"]) == 0
        assert yaml.safe_load((run / "config.yaml").read_text())["model"] == {"name": "mean"}
        for command in (["evaluate"], ["predict", out], ["impute", out]):
            assert main([command[0], str(run), str(data), *map(str, command[1:])]) == 0
        assert main(["forecast", str(run), str(data), str(out), "--horizons=0.1"]) == 0
        assert "'mean'" in one_line_error(capsys, "export", run, tmp_path / "a.onnx")
    finally:
        MODELS.unregister("mean")


def test_options_of_the_training_replace_those_of_the_recipe(data, tmp_path):
    arguments = ["train", str(data), str(tmp_path), "--model.hidden_size=4", "--training.epochs=1"]
    assert main([*arguments, "--training.learning_rate=0.01", "--training.keep=last"]) == 0
    config = yaml.safe_load((tmp_path / "config.yaml").read_text())["training"]
    assert (config["learning_rate"], config["keep"], config["clip_norm"]) == (0.01, "last", 1.0)


def test_the_help_of_train_has_ten_options_first_and_the_rest_under_help_all(capsys):
    said = {}
    for option in ("--help", "--help-all"):
        with pytest.raises(SystemExit) as stop:
            main(["train", option])
        assert stop.value.code == 0
        text = capsys.readouterr().out
        said[option] = re.findall(r"^  (?:-h, )?--([\w.-]+)", text, re.MULTILINE)
    assert said["--help"][:10] == list(FREQUENT["train"])
    assert said["--help"][10:] == ["help", "config", "quiet", "verbose"]
    assert {*said["--help"], "model.hidden_size", "reader.max_gap_s"} <= set(said["--help-all"])
    assert len(said["--help-all"]) > 100


def test_quiet_prints_results_and_errors_alone(tmp_path, capsys):
    def noted() -> None:
        """Say something."""
        print("a note", file=sys.stderr)
        print("a result")
        if (tmp_path / "broken").exists():
            raise ob.InputError("it is broken")

    commands = {"go": noted}
    assert run_commands(commands, ["go", "--quiet"], prog="test", description="") == 0
    captured = capsys.readouterr()
    assert (captured.out, captured.err) == ("a result\n", "")
    (tmp_path / "broken").touch()
    assert run_commands(commands, ["go", "--quiet"], prog="test", description="") == 2
    assert capsys.readouterr().err == "offbeat: error: it is broken\n"
    assert run_commands(commands, ["go", "--verbose"], prog="test", description="") == 2
    said = capsys.readouterr().err
    assert "Traceback" in said
    assert "a note" in said
    assert re.search(r"^offbeat: \d+\.\d s$", said, re.MULTILINE)


def test_a_long_step_shows_its_time_on_a_terminal_alone(monkeypatch):
    class Terminal(io.StringIO):
        def isatty(self):
            return True

    for stream, shown in ((Terminal(), True), (io.StringIO(), False)):
        monkeypatch.setattr(sys, "stderr", stream)
        monkeypatch.setattr(progress, "_AFTER_S", 0.05)
        monkeypatch.setattr(progress, "_EVERY_S", 0.01)
        with progress.busy("filling"):
            time.sleep(0.4)
        assert ("filling: 00:0" in stream.getvalue()) == shown
        with progress.busy("reading"):
            pass
        assert "reading" not in stream.getvalue()
        with pytest.raises(KeyError), progress.busy("scoring"):
            raise KeyError
