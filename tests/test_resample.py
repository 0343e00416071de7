"""A log on an even grid: times, what was measured, fills; and from a bag to LeRobot."""

from __future__ import annotations

import csv
import json
from dataclasses import replace

import numpy as np
import pyarrow.parquet as pq
import pytest
from scipy.interpolate import PchipInterpolator
from test_cli import one_line_error

import offbeat as ob
from offbeat.answers.resample import describe, fit_simple_fill
from offbeat.cli.app import main


def motion(t):
    """Two smooth channels; `(times, 2)`."""
    return np.stack([np.sin(2 * t), 3 + np.cos(3 * t)], axis=1)


@pytest.fixture(scope="module")
def log() -> ob.Dataset:
    """Sensors at 100 and 20 Hz with jitter; the first one drops out from 5.0 to 5.3 s."""
    random = np.random.default_rng(0)
    fast = np.arange(0, 10, 0.01) + random.uniform(0, 2e-3, 1000)
    slow = np.arange(0, 10, 0.05) + random.uniform(3e-3, 5e-3, 200)
    times = np.union1d(fast, slow)
    values = motion(times)
    observed = np.stack([np.isin(times, fast), np.isin(times, slow)], axis=1)
    observed[(times > 5.0) & (times < 5.3), 0] = False
    kept = observed.any(axis=1)
    values = np.where(observed, values, np.nan)[kept]
    one = ob.Trajectory(times[kept], values, names=("hip", "height"), units=("rad", "m"))
    return ob.Dataset((one,), {"source": "log"})


@pytest.fixture(scope="module")
def even(log) -> ob.Dataset:
    return ob.resample(log, 30)


def test_times_are_even_from_the_first_row_to_the_last(log, even):
    times, given = even[0].times, log[0].times
    assert times[0] == given[0]
    assert np.diff(times) == pytest.approx(1 / 30, abs=1e-12)
    assert 0 <= given[-1] - times[-1] < 1 / 30


def test_a_value_is_observed_where_it_was_measured_within_half_a_period(log, even):
    for c in range(2):
        own = log[0].times[log[0].observed[:, c]]
        nearest = np.abs(even[0].times[:, None] - own).min(axis=1)
        assert even[0].observed[:, c].tolist() == (nearest <= 0.5 / 30).tolist()
    hidden = (even[0].times > 5.02) & (even[0].times < 5.28)
    assert not even[0].observed[hidden, 0].any()


def test_without_a_run_the_fill_is_a_blend_that_is_named_and_close_to_the_motion(even):
    assert even.meta["filled_by"].startswith("blend of ")
    error = np.abs(even[0].values - motion(even[0].times))
    assert error[2:-2].max() < 0.02
    assert error[0].max() < 0.01  # the first row is before the first height
    low, high = even[0].interval(0.9)
    inside = (low <= motion(even[0].times)) & (motion(even[0].times) <= high)
    assert inside.mean() > 0.8
    assert (high - low).max() < 0.5


def test_a_blend_of_a_run_fills_what_impute_fills(log):
    blend = fit_simple_fill(log)
    assert "smoother" in describe(blend)
    even = ob.resample(log, 30, blend)
    filled = ob.impute(blend, log, times=even[0].times)
    rows = np.searchsorted(filled[0].times, even[0].times)
    assert np.array_equal(even[0].values[1:], filled[0].values[rows][1:])
    assert even.meta["filled_by"] == "blend"


def test_intervals_hold_between_the_measurements_of_a_slow_sensor(log):
    """Rows of a fast sensor lie there; nothing in a log masks such a value."""
    random = np.random.default_rng(1)
    noisy = log[0].values + random.normal(0, 0.02, log[0].values.shape)
    one = replace(log[0], values=noisy)
    blend = fit_simple_fill(ob.Dataset((one,)))
    filled = ob.impute(blend, one)[0]
    inside = ~one.observed[:, 1]
    inside[:10] = inside[-10:] = False
    low, high = filled.interval(0.9)
    truth = motion(one.times)[:, 1] + random.normal(0, 0.02, one.rows)
    covered = ((low[:, 1] <= truth) & (truth <= high[:, 1]))[inside]
    assert 0.8 < covered.mean() < 0.99
    assert (high - low)[inside, 1].mean() < 0.2


def test_a_log_too_short_to_fit_anything_is_filled_by_pchip():
    times = np.array([0.0, 0.3, 0.7, 1.0])
    values = np.array([[1.0], [2.0], [0.0], [1.0]])
    even = ob.resample(ob.Trajectory(times, values, names=("x",)), 10)
    assert even[0].values[:, 0] == pytest.approx(
        PchipInterpolator(times, values[:, 0])(np.arange(11) / 10), abs=1e-12
    )
    assert even.meta["filled_by"].startswith("pchip (4 rows are too few")
    assert even[0].observed[:, 0].tolist() == [
        True, False, False, True, False, False, False, True, False, False, True,
    ]  # fmt: skip


def test_an_exogenous_channel_holds_its_last_value():
    times = np.array([0.0, 0.3, 0.7, 1.0])
    values = np.array([[1.0, np.nan], [2.0, 5.0], [0.0, np.nan], [1.0, 7.0]])
    one = ob.Trajectory(times, values, names=("x", "wind"), roles=("state", "exogenous"))
    even = ob.resample(one, 10)[0]
    assert even.values[:, 1].tolist() == [5.0] * 10 + [7.0]


def test_a_bad_rate_is_refused(log):
    for rate in (0, -1.0, float("nan"), 1e12, True):
        with pytest.raises(ob.InputError, match="rate_hz"):
            ob.resample(log, rate)


@pytest.fixture(scope="module")
def bag(tmp_path_factory):
    """A ROS 2 bag with topics at 100, 50, 20 and 10 Hz, the joints silent for 0.4 s."""
    robot_logs = pytest.importorskip("robot_logs")
    types, start = robot_logs.ROS2.types, 1_700_000_000 * 10**9
    messages = []
    for topic, rate in (("/joints", 100), ("/imu", 50), ("/force", 20), ("/height", 10)):
        for t in np.arange(0, 6, 1 / rate) + 1e-4 * rate:
            at = start + int(t * 1e9)
            head = robot_logs.header(robot_logs.ROS2, at)
            vector = types["geometry_msgs/msg/Vector3"]
            if topic == "/joints":
                if 4 < t < 4.4:
                    continue
                message = robot_logs.joint_message(
                    robot_logs.ROS2, at, ["hip", "knee"], [np.sin(2 * t), np.cos(t)]
                )
            elif topic == "/imu":
                message = types["geometry_msgs/msg/Vector3Stamped"](
                    head, vector(np.sin(t), np.cos(2 * t), 9.81 + np.sin(3 * t))
                )
            elif topic == "/force":
                force = vector(np.sin(5 * t), 0.0, 4.0)
                message = types["geometry_msgs/msg/WrenchStamped"](
                    head, types["geometry_msgs/msg/Wrench"](force, vector(0.0, 0.0, np.cos(t)))
                )
            else:
                message = types["geometry_msgs/msg/PointStamped"](
                    head, types["geometry_msgs/msg/Point"](0.0, 0.0, 1 + 0.1 * np.sin(t))
                )
            messages.append((topic, at, message))
    messages.sort(key=lambda message: message[1])
    return robot_logs.write_bag2(tmp_path_factory.mktemp("bag") / "walk", messages, mcap=True)


def test_a_bag_of_sensors_at_four_rates_becomes_a_lerobot_data_set_in_one_command(
    bag, tmp_path, capsys
):
    out = tmp_path / "even"
    assert main(["resample", str(bag), str(out), "--rate_hz=30", "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert (said["format"], said["trajectories"]) == ("lerobot", 1)
    assert said["filled"] > 0
    info = json.loads((out / "meta" / "info.json").read_text())
    assert info["fps"] == 30
    names = info["features"]["observation.state"]["names"]
    table = pq.read_table(out / "data" / "chunk-000" / "file-000.parquet")
    state = np.array(table["observation.state"].to_pylist())
    assert np.isfinite(state).all()
    seconds = (table["complementary_info.time_ns"].to_numpy() - 1_700_000_000 * 10**9) / 1e9
    hip = names.index("/joints.position.hip")
    assert np.abs(state[:, hip] - np.sin(2 * seconds)).max() < 0.02
    observed = np.array(table["complementary_info.observed"].to_pylist())
    assert not observed[(seconds > 4.03) & (seconds < 4.37), hip].any()
    assert observed[seconds < 3.9, hip].all()
    low, high = (np.array(table[f"complementary_info.{e}"].to_pylist()) for e in ("low", "high"))
    assert (low <= high).all()
    assert ob.read(out).names == tuple(names)


def test_the_command_writes_tables_and_says_what_is_wrong(tmp_path, capsys):
    log = tmp_path / "log.csv"
    with log.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["time [s]", "x [m]"])
        writer.writerows([0.01 * i, np.sin(0.05 * i)] for i in range(600))
    assert main(["resample", str(log), str(tmp_path / "even.csv"), "--rate_hz=40"]) == 0
    assert "40 Hz" in capsys.readouterr().out
    with (tmp_path / "even.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [float(row["time"]) for row in rows] == pytest.approx(np.arange(240) / 40)
    assert {"x|observed", "x|low", "x|high"} <= set(rows[0])
    again = ob.read(tmp_path / "even.csv")
    assert again.names == ("x",)
    for arguments, message in (
        ([tmp_path / "a.csv"], "rate_hz is missing"),
        ([tmp_path / "a.xls", "--rate_hz=3"], "unknown suffix '.xls'"),
        ([tmp_path / "a", "--rate_hz=3", "--format=minary"], "did you mean 'minari'"),
        ([log, "--rate_hz=3"], "is the data set itself"),
        ([tmp_path / "a.csv", "--rate_hz=0"], "rate_hz must be a positive number"),
        ([tmp_path / "a.csv", "--rate_hz=3", "--run=none"], "none"),
    ):
        assert message in one_line_error(capsys, "resample", log, *arguments)
