"""Runs that earlier versions of Offbeat made still work with this version."""

import csv
import json
import shutil
from pathlib import Path

import pytest

import offbeat as ob
from offbeat.cli.app import main


def test_a_run_of_0_1_0_still_predicts_fills_and_scores(tmp_path, capsys):
    old = Path(__file__).parent / "data" / "run_0_1_0"
    log, run = str(old / "log.csv"), str(old / "run")
    tables = {}
    for command, name in (("predict", "predictions.csv"), ("impute", "filled.csv")):
        assert main([command, run, log, str(tmp_path / name)]) == 0
        got, then = (
            list(csv.reader(path.read_text().splitlines()))
            for path in (tmp_path / name, old / name)
        )
        assert got[0] == then[0]
        tables[command] = [dict(zip(got[0], row, strict=True)) for row in got[1:]]
        numbers = [i for i, text in enumerate(then[1]) if text not in ("true", "false")]
        for row, was in zip(got[1:], then[1:], strict=True) if command == "predict" else ():
            assert [float(row[i]) for i in numbers] == pytest.approx(
                [float(was[i]) for i in numbers], rel=1e-5, abs=1e-6
            )
    # The rule of a two-sided run of 0.1.0 is not read: values are filled from the past alone.
    assert "two-sided run of an earlier version" in capsys.readouterr().err
    for filled, predicted in zip(tables["impute"], tables["predict"], strict=True):
        for channel in predicted.keys() - {"trajectory", "time"}:
            if filled.get(f"{channel}|observed") == "false":
                assert float(filled[channel]) == pytest.approx(float(predicted[channel]), rel=1e-5)
    capsys.readouterr()
    assert main(["evaluate", run, log, "--json"]) == 0
    scores = json.loads(capsys.readouterr().out)
    then = json.loads((old / "run" / "results.json").read_text())
    assert scores["part"] == "test"
    for name, was in then["predictors"].items():
        got = scores["predictors"][name]["after_first_observation"]["rmse"]
        assert got == pytest.approx(was["honest"]["rmse"], rel=1e-5)
    for name, rmse in then["imputation"]["rmse_scaled"].items():
        if name == "two_sided":
            continue
        assert scores["imputation"]["rmse_scaled"][name] == pytest.approx(rmse, rel=1e-5)


def test_a_run_of_0_2_0_still_predicts_fills_forecasts_and_scores(tmp_path, capsys):
    old = Path(__file__).parent / "data" / "run_0_2_0"
    log, run = str(old.parent / "run_0_1_0" / "log.csv"), str(old / "run")
    commands = {"predict": "predictions.csv", "impute": "filled.csv", "forecast": "ahead.csv"}
    for command, name in commands.items():
        further = ["--horizons", "5"] if command == "forecast" else []
        assert main([command, run, log, str(tmp_path / name), *further]) == 0
        got, then = (
            list(csv.reader(path.read_text().splitlines()))
            for path in (tmp_path / name, old / name)
        )
        assert got[0] == then[0]
        for row, was in zip(got[1:], then[1:], strict=True):
            texts = [i for i, text in enumerate(was) if text in ("true", "false", "")]
            assert [row[i] for i in texts] == [was[i] for i in texts]
            numbers = [i for i in range(len(was)) if i not in texts]
            assert [float(row[i]) for i in numbers] == pytest.approx(
                [float(was[i]) for i in numbers], rel=1e-5, abs=1e-6
            )
    assert "time is taken to be" not in capsys.readouterr().err  # the run keeps its unit
    blend, model = ob.load_run(run), ob.load_model(run)
    assert blend.forward.config == model.config
    capsys.readouterr()
    assert main(["evaluate", run, log, "--json"]) == 0
    scores = json.loads(capsys.readouterr().out)
    then = json.loads((old / "run" / "results.json").read_text())
    assert then.pop("steps") > 0
    assert numbers_of(scores) == pytest.approx(numbers_of(then), rel=1e-5, abs=1e-6)


def numbers_of(value, path=""):
    """The numbers of nested JSON, by their path."""
    if isinstance(value, dict | list):
        items = value.items() if isinstance(value, dict) else enumerate(value)
        found = {}
        for key, each in items:
            found |= numbers_of(each, f"{path}/{key}")
        return found
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    return {path: value} if is_number else {}


def test_runs_of_0_1_0_on_other_data_are_of_another_condition(tmp_path):
    for name, data in (("a", "f00d"), ("b", "beef")):
        shutil.copytree(Path(__file__).parent / "data" / "run_0_1_0" / "run", tmp_path / name)
        split = json.loads((tmp_path / name / "parts.json").read_text())
        (tmp_path / name / "parts.json").write_text(json.dumps({**split, "data": data}))
    a, b = (run.condition for run in ob.read_runs([tmp_path / name for name in "ab"]))
    assert (a[-4:], b[-4:]) == ("f00d", "beef")
