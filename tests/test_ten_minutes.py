"""The first ten minutes of a user: five commands from a log with holes to a LeRobot data set."""

from __future__ import annotations

import csv
import json
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq

SCRIPT = Path(__file__).parents[1] / "examples" / "ten_minutes.py"
QUICK = (
    "--baselines [last_value,constant_velocity,linear,pchip] "
    "--model.name gru --model.hidden_size 4 --training.epochs 1 --training.tasks_per_epoch 32 "
    "--two_sided=false"
)


def test_five_commands_lead_from_a_log_to_fills_forecasts_and_a_lerobot_data_set(tmp_path):
    out = tmp_path / "arm"
    arguments = [out, "--log=--seconds 8", f"--train={QUICK}"]
    done = subprocess.run(
        [sys.executable, SCRIPT, *map(str, arguments)], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    commands = re.findall(r"^\$ (.*)$", done.stdout, re.MULTILINE)
    assert [c.split()[:2] for c in commands] == [
        ["python", "examples/arm_log.py"],
        *(["offbeat", name] for name in ("train", "impute", "forecast", "resample")),
    ]
    with (out / "filled.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    holes = [row for row in rows if row["joint_1_position|observed"] == "false"]
    assert 0 < len(holes) < len(rows)
    assert all(np.isfinite(float(row["joint_1_position"])) for row in rows)
    with (out / "ahead.csv").open(newline="") as file:
        ahead = list(csv.DictReader(file))
    assert {float(row["horizon"]) for row in ahead} == {0.1, 0.5}
    for row in ahead:
        low, value, high = (float(row[f"gyro_x{end}"]) for end in ("|low", "", "|high"))
        assert low < value < high
    info = json.loads((out / "lerobot" / "meta" / "info.json").read_text())
    assert info["fps"] == 30
    table = pq.read_table(out / "lerobot" / "data")
    assert np.isfinite(np.array(table["observation.state"].to_pylist())).all()
    for name in ("filled.png", "ahead.png"):
        assert (out / name).read_bytes().startswith(b"\x89PNG")
