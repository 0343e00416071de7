"""`offbeat clone` and `offbeat rollout`."""

from __future__ import annotations

import json

import numpy as np
import pytest

import offbeat as ob
from offbeat.cli.app import main

CLONE = ["--model=gru", "--epochs=2", "--window=20", "--json", "--quiet"]


@pytest.fixture
def log(tmp_path):
    """A table of 8 demonstrations: cosine, sine, speed and torque."""
    path = tmp_path / "shown.csv"
    lines = ["trajectory,time,cosine,sine,speed,torque"]
    for i in range(8):
        random = np.random.default_rng(i)
        time = 0.0
        for _ in range(30):
            angle = np.sin(time + i)
            row = [np.cos(angle), np.sin(angle), np.cos(time + i), np.clip(-3 * angle, -2, 2)]
            lines.append(f"{i},{time:.6f}," + ",".join(f"{v:.6f}" for v in row))
            time += random.uniform(0.02, 0.1)
    path.write_text("\n".join(lines) + "\n")
    return path


def test_a_log_becomes_a_policy_that_acts_in_an_environment(log, tmp_path, capsys):
    pytest.importorskip("gymnasium")
    out = tmp_path / "policy"
    named = ["--actions=[torque]", "--low=[-2]", "--high=[2]", "--reader.unwrap=false"]
    assert main(["clone", str(log), str(out), *named, *CLONE]) == 0
    said = json.loads(capsys.readouterr().out)
    assert said["observations"] == ["cosine", "sine", "speed"]
    assert said["actions"] == ["torque"]
    assert said["demonstrations"] == 7
    assert said["validation_mse"] > 0
    policy = ob.Policy.load(out)
    assert (policy.low, policy.high) == (-2, 2)
    run = ["--episodes=2", "--steps=12", "--drop=0.7", "--json", "--quiet"]
    assert main(["rollout", str(out), "Pendulum-v1", *run]) == 0
    said = json.loads(capsys.readouterr().out)
    assert len(said["returns"]) == 2
    assert said["steps"] == [12, 12]
    assert 0.1 < said["observed"] < 0.7


def test_an_environment_that_is_not_that_of_the_demonstrations_is_said(
    log, tmp_path, capsys, caplog
):
    pytest.importorskip("gymnasium")
    out = tmp_path / "policy"
    slow = ["--actions=[torque]", "--reader.time_unit=min", *CLONE]  # rows 60 times as far apart
    assert main(["clone", str(log), str(out), *slow]) == 0
    capsys.readouterr()
    assert main(["rollout", str(out), "Hopper-v5"]) == 2
    error = "Hopper-v5 has 11 observations, the policy has 3 (cosine, sine, speed); give the"
    assert error in capsys.readouterr().err
    assert main(["rollout", str(out), "MountainCarContinuous-v0"]) == 2
    error = "MountainCarContinuous-v0 does not say how long a step is; give dt"
    assert error in capsys.readouterr().err
    assert main(["rollout", str(out), "MountainCarContinuous-v0", "--dt=0.02"]) == 2
    assert "MountainCarContinuous-v0 has 2 observations" in capsys.readouterr().err
    assert main(["rollout", str(out), "Pendulum-v1", "--episodes=1", "--steps=2"]) == 0
    assert "a step of Pendulum-v1 is 0.05 s, and the rows of" in caplog.text


def test_at_least_one_demonstration_is_trained_on(log, tmp_path, capsys):
    arguments = ["--actions=[torque]", "--validation=0.99", *CLONE]
    assert main(["clone", str(log), str(tmp_path / "policy"), *arguments]) == 0
    assert json.loads(capsys.readouterr().out)["demonstrations"] == 1


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "does not say which of its channels are actions; name them, such as --actions"),
        (["--actions=[speed_limit]"], "unknown channel 'speed_limit'"),
        (["--actions=[torque]", "--low=[-2]"], "give both, or neither"),
        (["--actions=[torque]", "--loss=mae"], "unknown loss of actions 'mae'"),
        (["--actions=[torque]", "--drop=1"], "frames must be a fraction"),
        (["--actions=[torque]", "--starts=2"], "starts must be a fraction from 0 to 1"),
        (["--actions=[torque]", "--validation=1"], "validation must be a fraction"),
        (["--actions=[torque]", "--model=grub"], "unknown model 'grub'"),
    ],
)
def test_a_wrong_option_ends_in_one_line(arguments, message, log, tmp_path, capsys):
    assert main(["clone", str(log), str(tmp_path / "out"), *arguments, "--epochs=1"]) == 2
    error = capsys.readouterr().err.splitlines()[-1]
    assert error.startswith("offbeat: error: ")
    assert message in error


def test_a_folder_of_other_files_is_not_replaced(log, tmp_path, capsys):
    assert main(["clone", str(log), str(tmp_path), "--actions=[torque]", "--epochs=1"]) == 2
    assert "holds other files" in capsys.readouterr().err
    assert log.exists()


def test_a_folder_without_a_policy_is_refused(tmp_path, capsys):
    assert main(["rollout", str(tmp_path), "Pendulum-v1"]) == 2
    assert "is not a checkpoint" in capsys.readouterr().err
