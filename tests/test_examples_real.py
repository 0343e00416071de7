import json
import math
import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
DATA = Path(os.environ.get("OFFBEAT_DATA") or ROOT.parent / "shared" / "data")


def run(name, out):
    """What an example prints and writes on a small part of its log."""
    done = subprocess.run(
        [sys.executable, ROOT / "examples" / f"real_{name}.py", "--small", "--out", out],
        cwd=ROOT,
        env={**os.environ, "OFFBEAT_DATA": str(DATA)},
        capture_output=True,
        text=True,
        timeout=600,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout, json.loads((out / f"{name}.json").read_text(encoding="utf-8"))


def check(said, result, out):
    """Every task was scored beside its trivial predictors, and the figure is there."""
    assert (out / result["figure"]).read_bytes().startswith(b"\x89PNG")
    assert "--small" in result["command"]
    assert result["machine"]["offbeat"]
    for scores in result["scores"].values():
        one, filled = scores["one_step_ahead"], scores["imputation"]
        assert set(one["rmse_scaled"]) == {"anchored_ode_gru_d", "last_value"}
        assert set(filled["rmse_scaled"]) == {
            "causal",
            "two_sided",
            "last_value",
            "linear",
            "pchip",
        }
        assert [s["horizon_s"] for s in scores["extrapolation"]] == [0.1, 0.2, 0.5, 1.0]
        for task in (one, filled, *scores["extrapolation"][:2]):
            assert sum(task["counts"].values()) > 0
            assert all(math.isfinite(v) and v > 0 for v in task["rmse_scaled"].values())
        assert one["verdict"] in said
        assert filled["verdict"] in said
    tried = result["chosen_on_validation"]
    assert len(tried) == 2
    assert all(math.isfinite(each["validation_mse"]) for each in tried)


@pytest.fixture(scope="module")
def lasa(tmp_path_factory):
    out = tmp_path_factory.mktemp("lasa")
    return (*run("lasa", out), out)


def test_the_lasa_example_scores_every_task_and_draws_its_figure(lasa):
    said, result, out = lasa
    check(said, result, out)
    position = result["scores"]["test"]["imputation"]["groups"]["position, mm"]
    # A pen moves smoothly: PCHIP is much better than the last value, for any model.
    assert position["pchip"] < 0.5 * position["last_value"]


def test_lines_of_a_table_are_root_mean_squares_over_the_values_of_their_channels(lasa):
    _, result, _ = lasa
    filled = result["scores"]["test"]["imputation"]
    cells, each = filled["counts"], filled["rmse_in_units"]["linear"]
    squares = sum(cells[c] * each[c] ** 2 for c in ("vx", "vy"))
    expected = math.sqrt(squares / (cells["vx"] + cells["vy"]))
    assert filled["groups"]["velocity, mm/s"]["linear"] == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize(
    ("name", "folder"), [("px4", "px4_ulog"), ("g1", "unitree_g1_lerobot_v21")]
)
def test_the_examples_on_other_logs_run_where_their_data_is(name, folder, tmp_path):
    if not (DATA / folder).exists():
        pytest.skip(f"{DATA / folder} is not here, set OFFBEAT_DATA")
    said, result = run(name, tmp_path)
    check(said, result, tmp_path)


@pytest.mark.parametrize("name", ["px4", "g1"])
def test_an_example_says_where_it_looked_for_its_log(name, tmp_path):
    done = subprocess.run(
        [sys.executable, ROOT / "examples" / f"real_{name}.py", "--out", tmp_path],
        env={**os.environ, "OFFBEAT_DATA": str(tmp_path)},
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert done.returncode == 1
    assert str(tmp_path) in done.stderr
    assert "set OFFBEAT_DATA" in done.stderr
