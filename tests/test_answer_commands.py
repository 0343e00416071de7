"""From a log to filled gaps and forecasts, on the command line, and the figures on the way."""

from __future__ import annotations

import csv
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from test_cli import one_line_error

import offbeat as ob
from offbeat.cli.app import main
from offbeat.cli.common import answer_columns, plain
from offbeat.plots.answers import answers
from offbeat.plots.figures import channel_panels

NAMES = ("gyro", "tilt", "height")
PARTS = [
    "--split.by=time", "--split.window_s=0.4", "--split.mask=bursts",
    "--split.burst_s=0.05", "--split.observed_fraction=0.7",
]  # fmt: skip
MODEL = [
    "--baselines=[last_value,constant_velocity,linear,pchip]",
    "--model.hidden_size=4",
    "--model.field_units=[6]",
    "--training.epochs=1",
]


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    """Two sensors on one clock in ms: gyro and tilt at 100 Hz, height at 25 Hz; values missing."""
    path = tmp_path_factory.mktemp("log") / "log.csv"
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["stamp", *NAMES])
        for i in range(400):
            t = 0.01 * i
            height = f"{np.sin(t):.6f}" if i % 4 == 0 else ""
            tilt = f"{np.cos(5 * t):.6f}" if not 100 <= i < 110 else ""
            writer.writerow([1000 + 10 * i, f"{5 * np.cos(5 * t):.6f}", tilt, height])
    return path


READER = ["--reader.time_column=stamp", "--reader.time_unit=ms"]


@pytest.fixture(scope="module")
def run(log, tmp_path_factory):
    out = tmp_path_factory.mktemp("runs") / "first"
    arguments = ["train", str(log), str(out), *READER, *PARTS, *MODEL, "--two_sided=true"]
    assert main(arguments) == 0
    return out


def table(path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def test_a_run_holds_a_blend_of_both_models_and_says_who_wins(run):
    inside = {path.name for path in run.iterdir()}
    assert {"model", "backward", "blend.json", "reader.json", "split.json"} <= inside
    results = json.loads((run / "results.json").read_text())
    tasks = {task["task"]: task for task in results["tasks"]}
    assert list(tasks)[:3] == ["one step ahead", "imputation, causal", "imputation, two_sided"]
    filled = tasks["imputation, two_sided"]
    assert {"blend", "linear", "pchip"} <= set(filled["rmse_in_units"])
    assert set(filled["rmse_in_units"]["linear"]) == set(NAMES)
    assert "win" in filled["verdict"]
    for score in ("coverage", "interval_score_scaled"):
        assert set(filled[score]) == {"0.5", "0.8", "0.95"}
    config = yaml.safe_load((run / "config.yaml").read_text())
    assert config["two_sided"] is True
    assert config["reader"] == {"time_column": "stamp", "time_unit": "ms", "outliers": "mask"}


def test_the_saved_config_trains_the_same_blend_again(run, log, tmp_path):
    out = tmp_path / "again"
    assert main(["train", f"--config={run / 'config.yaml'}", str(log), str(out)]) == 0
    for name in ("results.json", "blend.json"):
        assert json.loads((out / name).read_text()) == json.loads((run / name).read_text())


@pytest.mark.parametrize("mode", ["causal", "two_sided"])
def test_impute_keeps_what_was_measured_and_fills_the_rest(run, log, tmp_path, mode):
    out = tmp_path / "filled.csv"
    assert main(["impute", str(run), str(log), str(out), f"--mode={mode}"]) == 0
    lines, before = table(out), table(log)
    assert [name for name in lines[0] if not name.endswith("|beyond")] == [
        "trajectory", "time", "clock_ms", *NAMES,
        *(f"{n}|{what}" for what in ("observed", "low", "high") for n in NAMES),
    ]  # fmt: skip
    assert [int(line["clock_ms"]) for line in lines] == [int(line["stamp"]) for line in before]
    for line, was in zip(lines, before, strict=True):
        for name in NAMES:
            assert (line[f"{name}|observed"] == "true") == (was[name] != "")
            assert np.isfinite(float(line[name]))
            assert not was[name] or float(line[name]) == float(was[name])
            assert float(line[f"{name}|low"]) <= float(line[name]) <= float(line[f"{name}|high"])
    data = ob.read(log, time_column="stamp", time_unit="ms")
    expected = ob.impute(ob.load_run(run), data, mode=mode)[0]
    got = [[float(line[name]) for name in NAMES] for line in lines]
    assert np.array_equal(got, expected.values)


def test_impute_at_a_rate_fills_an_outage_of_all_sensors_in_one_trajectory(run, log, tmp_path):
    head, *lines = log.read_text().splitlines()
    late = [f"{int(line.split(',')[0]) + 3000},{line.partition(',')[2]}" for line in lines[200:]]
    broken = tmp_path / "broken.csv"
    broken.write_text("\n".join([head, *lines[:200], *late]) + "\n")
    plain, filled = tmp_path / "plain.csv", tmp_path / "filled.csv"
    assert main(["impute", str(run), str(broken), str(plain)]) == 0
    assert main(["impute", str(run), str(broken), str(filled), "--rate_hz=20"]) == 0
    assert {row["trajectory"] for row in table(plain)} == {"0", "1"}
    rows = table(filled)
    assert {row["trajectory"] for row in rows} == {"0"}
    assert len(rows) == 400 + 59  # every 50 ms from 3050 to 5950 ms
    clock = np.array([int(row["clock_ms"]) for row in rows])
    assert np.diff(clock).max() <= 75
    inside = [row for row in rows if 3000 <= int(row["clock_ms"]) < 6000]
    assert len(inside) == 59
    assert all(row[f"{name}|observed"] == "false" for row in inside for name in NAMES)
    assert all(np.isfinite(float(row[name])) for row in inside for name in NAMES)


def test_impute_writes_the_same_table_as_parquet(run, log, tmp_path):
    import pyarrow.parquet as pq

    paths = [tmp_path / "filled.csv", tmp_path / "filled.parquet"]
    for path in paths:
        assert main(["impute", str(run), str(log), str(path)]) == 0
    lines, parquet = table(paths[0]), pq.read_table(paths[1])
    assert parquet.column_names == list(lines[0])
    for name in NAMES:
        assert parquet[name].to_pylist() == [float(line[name]) for line in lines]
        assert parquet[f"{name}|observed"].to_pylist() == [
            line[f"{name}|observed"] == "true" for line in lines
        ]


def test_extrapolate_answers_after_the_last_row_on_the_clock_of_the_log(run, log, tmp_path):
    out = tmp_path / "ahead.csv"
    assert main(["forecast", str(run), str(log), str(out), "--horizons=[0.05, 0.2]"]) == 0
    lines = table(out)
    assert [float(line["horizon"]) for line in lines] == [0.05, 0.2]
    assert [int(line["clock_ms"]) for line in lines] == [1000 + 3990 + 50, 1000 + 3990 + 200]
    assert {line[f"{name}|observed"] for line in lines for name in NAMES} == {"false"}
    data = ob.read(log, time_column="stamp", time_unit="ms")
    expected = ob.forecast(ob.load_run(run), data, [0.05, 0.2])[0].values
    assert np.array_equal([[float(line[name]) for name in NAMES] for line in lines], expected)


def test_evaluate_scores_fills_and_forecasts_of_the_test_part(run, log, capsys):
    capsys.readouterr()
    arguments = ["evaluate", str(run), str(log), "--horizons=[0.02, 0.1]"]
    assert main([*arguments, "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    results = json.loads((run / "results.json").read_text())
    assert said["part"] == "test"
    tasks = {task["task"]: task for task in said["tasks"]}
    before = {task["task"]: task for task in results["tasks"]}
    for name in ("imputation, causal", "imputation, two_sided"):
        assert tasks[name] == before[name]
    assert [name for name in tasks if "forecast" in name] == ["forecast, 0.02 s", "forecast, 0.1 s"]
    baselines = set(ob.load_run(run).stack.members)
    for name in ("forecast, 0.02 s", "forecast, 0.1 s"):
        predictors = {"blend", "anchored_ode_gru_d alone", *baselines}
        assert set(tasks[name]["rmse_in_units"]) == predictors
    assert main(arguments) == 0
    text = capsys.readouterr().out
    assert "gamma: channel" in text
    for task in said["tasks"]:
        assert task["verdict"] in text


def test_other_data_is_masked_in_any_way_and_scored_as_a_whole(run, log, tmp_path, capsys):
    other = tmp_path / "other.csv"
    other.write_text("\n".join(log.read_text().splitlines()[:200]) + "\n")
    capsys.readouterr()
    masking = ["--observed_fraction=0.6", "--mask=values"]
    assert main(["evaluate", str(run), str(other), *masking, "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert said["part"] == "all"
    data = ob.read(other, time_column="stamp", time_unit="ms")
    masked = ob.mask_out(data, 0.6, mask="values")[0]
    expected = (data[0].observed & ~masked.observed).sum(axis=0).tolist()
    assert list(said["tasks"][1]["counts"].values()) == expected


def test_figures_are_written_on_request(run, log, tmp_path):
    from PIL import Image

    paths = [tmp_path / f"{name}.png" for name in ("fill", "ahead", "scored", "kept")]
    table_of = str(tmp_path / "a.csv")
    for arguments in (
        ["impute", str(run), str(log), table_of, f"--figure={paths[0]}", "--channels=[tilt]"],
        ["forecast", str(run), str(log), table_of, "--horizons=[0.1, 0.2]",
         f"--figure={paths[1]}"],
        ["evaluate", str(run), str(log), f"--figure={paths[2]}", "--trajectory=0",
         f"--calibration={paths[3]}"],
    ):  # fmt: skip
        assert main(arguments) == 0
    for path in paths:
        with Image.open(path) as picture:
            assert picture.size[0] == 1400


def test_a_figure_shows_observed_values_masked_truth_and_every_answer():
    times = np.arange(6.0)
    values = times[:, None] ** 2
    observed = np.array([True, True, False, False, True, True])[:, None]
    truth = ob.Trajectory(times, values, observed=observed, names=("a",), units=("m",))
    filled = ob.Trajectory(times, values + 1 - observed, observed=observed, names=("a",))
    figure = answers(truth, {"two_sided": filled, "my_fill": filled}, ["a"])
    (axes,) = figure.axes
    drawn = {line.get_label(): line for line in axes.get_lines()}
    assert set(drawn) == {"Filled from both sides", "my_fill", "Masked truth", "Observed"}
    assert drawn["Masked truth"].get_xydata().tolist() == [[2, 4], [3, 9]]
    assert drawn["Observed"].get_xdata().tolist() == [0, 1, 4, 5]
    line = drawn["my_fill"].get_ydata()
    assert line[1:5].tolist() == [1, 5, 10, 16], "from the last observed value to the next"
    assert np.isnan(line[[0, 5]]).all()
    assert axes.get_ylabel() == "a (m)"


def test_a_long_name_stands_above_its_panel_where_it_runs_into_no_other():
    short, long = "q[0]", "sensor_combined.accelerometer_m_s2[0]"
    truth = ob.Trajectory(
        [0.0, 1.0], [[3.0, 1.0], [4.0, 2.0]], names=(short, long), units=("", "m/s^2")
    )
    first, second = answers(truth, {}, [short, long]).axes
    assert (first.get_ylabel(), first.get_title(loc="left")) == (short, "")
    assert (second.get_ylabel(), second.get_title(loc="left")) == ("", f"{long} (m/s^2)")


def test_a_forecast_begins_at_the_last_observation():
    truth = ob.Trajectory([0.0, 1.0], [[3.0], [4.0]], names=("a",))
    ahead = ob.Trajectory([2.0], [[6.0]], observed=np.zeros((1, 1), bool), names=("a",))
    (axes,) = answers(truth, {"gru": ahead}, ["a"]).axes
    (line,) = [line for line in axes.get_lines() if line.get_label() == "GRU"]
    assert line.get_xydata().tolist() == [[1, 4], [2, 6]]


def test_bad_input_is_one_clear_line(run, log, tmp_path, capsys):
    out = tmp_path / "out" / "a.csv"
    for arguments, message in (
        (["impute", run, log, out.with_suffix(".txt")], ".txt"),
        (["impute", run, log, log], str(log)),
        (["impute", run, log, out, "--mode=both"], "'both'"),
        (["impute", run / "model", log, out, "--mode=two_sided", *READER], "blend"),
        (["impute", run, log, out, "--figure=a.gif"], ".gif"),
        (["impute", run, log, out, "--channels=[tilts]"], "did you mean 'tilt'"),
        (["impute", run, log, out, "--trajectory=1"], "--trajectory"),
        (
            ["impute", run, log, out, "--reader.time_col=stamp"],
            "did you mean '--reader.time_column'",
        ),
        (["impute", run, log, out, "--reader.format=cvs"], "did you mean 'csv'"),
        (["forecast", run, log, out], "horizons"),
        (["forecast", run, log, out, "--horizons=0"], "horizons"),
        (["evaluate", run, log, "--mask=burst"], "did you mean 'bursts'"),
        (["evaluate", run, log, "--horizons=1000"], "horizons"),
        (["train", log, out.parent, *READER, "--split.mask=cell"], "mask"),
        (["train", log, out.parent, *READER, "--split.window=20"], "--split.by time"),
        (["train", log, out.parent, *READER, "--horizon_s=0"], "horizon_s"),
        (["predict", run, log, out, "--reader.delimiter=;;"], "delimiter"),
    ):
        assert message in one_line_error(capsys, *arguments)
    assert not out.parent.exists(), "bad input writes nothing"


def test_a_thesis_model_fills_at_its_rows_and_says_why_it_cannot_forecast(log, tmp_path, capsys):
    out = tmp_path / "run"
    options = ["--model.name=gru", "--model.readout=last_row", "--model.hidden_size=3"]
    assert main(["train", str(log), str(out), *READER, *PARTS, *options, *MODEL[2:]]) == 0
    assert main(["impute", str(out), str(log), str(tmp_path / "a.csv")]) == 0
    error = one_line_error(capsys, "forecast", out, log, tmp_path / "b.csv", "--horizons=0.1")
    assert "last_row" in error


def test_a_channel_named_like_a_mask_is_refused():
    names = ("a", "a|observed")
    data = ob.Dataset((ob.Trajectory([0.0, 1.0], [[1.0, 2.0], [3.0, 4.0]], names=names),))
    with pytest.raises(ob.InputError, match=r"'a\|observed'"):
        answer_columns(data, data)
    assert list(answer_columns(data, data, masks=False))[2:] == list(names)


def test_nested_options_are_plain_lists():
    assert plain({"sensors": (("a", "b"), ("c",)), "n": 3}) == {
        "sensors": [["a", "b"], ["c"]], "n": 3,
    }  # fmt: skip


def test_the_lasa_example_runs_from_demonstrations_to_scores(tmp_path, capsys):
    """Real handwriting, one shape, far too little training: what counts is the way through."""
    root = Path(__file__).parents[1] / "examples"
    data, out = tmp_path / "lasa.parquet", tmp_path / "run"
    example = [sys.executable, str(root / "lasa.py"), str(data), "--shapes", "Worm", "--every=20"]
    subprocess.run(example, check=True, capture_output=True)
    assert len(ob.load(data)) == 7
    small = ["--training.epochs=1", *MODEL[:2]]
    arguments = ["train", f"--config={root / 'lasa.yaml'}", *small, str(data), str(out)]
    assert main(arguments) == 0
    results = json.loads((out / "results.json").read_text())
    assert results["tasks"][1]["units"] == {"x": "mm", "y": "mm", "vx": "mm/s", "vy": "mm/s"}
    capsys.readouterr()
    assert main(["evaluate", str(out), str(data), "--horizons=0.1"]) == 0
    assert "forecast, 0.1 s: " in capsys.readouterr().out


def test_a_legend_names_what_any_panel_shows_each_once() -> None:
    """The first channel may lack what others have, such as intervals or values beyond training."""
    one = ob.Trajectory([0.0, 1.0], [[1.0, 2.0], [2.0, 1.0]], names=("x", "y"))

    def draw(axes: Any, truth: ob.Trajectory, predicted: Any, name: str) -> None:
        axes.plot(truth.times, truth.values[:, 0], label="True")
        if name == "y":
            axes.plot(truth.times, truth.values[:, 1], label="Beyond training")

    figure = channel_panels(draw, one, {}, ["x", "y"], title="", height=1.0)
    (legend,) = figure.legends
    assert [text.get_text() for text in legend.get_texts()] == ["True", "Beyond training"]
