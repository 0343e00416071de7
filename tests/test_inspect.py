"""`offbeat inspect`: rates, gaps, repeated values and anomalies that are known in advance."""

from __future__ import annotations

import json
import shlex
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image
from real_logs import shared

import offbeat as ob
from offbeat.cli.app import main
from offbeat.cli.inspection_text import heading
from offbeat.data.advice import advise
from offbeat.data.inspection import inspect, without_repeats
from offbeat.data.plan import plan, prepare
from offbeat.data.readers import read
from offbeat.data.recording import ReaderOptions, Recording, Signal, assemble

ROWS = 400


@pytest.fixture
def damaged(tmp_path):
    """10 ms apart in microseconds since 1970; an outage of 12 s before row 200."""
    stamps = (
        1_700_000_000_000_000 + 10_000 * np.arange(ROWS) + 12_000_000 * (np.arange(ROWS) >= 200)
    )
    turn = 0.05 * np.arange(ROWS)
    half, sign = 0.01 * np.arange(ROWS), np.where((np.arange(ROWS) // 50) % 2, -1, 1)
    lines = ["time,arm [m],yaw [rad],temp,qw,qx,qy,qz,broken"]
    for i in range(ROWS):
        arm = "" if i % 10 == 3 else f"{np.sin(0.1 * i):.6f}"
        yaw = (turn[i] + np.pi) % (2 * np.pi) - np.pi
        quaternion = f"{sign[i] * np.cos(half[i]):.9f},0,0,{sign[i] * np.sin(half[i]):.9f}"
        lines.append(f"{stamps[i]},{arm},{yaw:.6f},{20 + (i // 4) % 7},{quaternion},")
    lines[51], lines[52] = lines[52], lines[51]
    lines.insert(81, lines[80])
    path = tmp_path / "damaged.csv"
    path.write_text("\n".join(lines) + "\n")
    return path


def test_every_anomaly_that_was_put_in_is_found(damaged):
    found = inspect(read(damaged, angles=["yaw"]))
    channels = {channel.name: channel for channel in found.channels}
    assert (found.format, found.time_unit, found.rows, len(found.episodes)) == (
        "csv",
        "us",
        ROWS,
        2,
    )
    assert found.rate_hz == pytest.approx(100)
    assert channels["arm"].missing == pytest.approx(0.1)
    assert channels["arm"].longest_gap_s == pytest.approx(0.02)
    assert channels["arm"].unit == "m"
    assert (channels["temp"].rows_per_value, channels["arm"].rows_per_value) == (4, 0)
    assert (channels["broken"].known, channels["broken"].rate_hz) == (0, None)
    assert channels["qx"].constant
    assert channels["yaw"].high > 9  # 10 rad per episode, from within half a turn on
    first, second = found.episodes
    assert (first.late, first.duplicates, first.outage_before_s) == (1, 1, None)
    assert second.outage_before_s == pytest.approx(12.01)
    assert len(found.found) == 7, "one sentence for each"


def test_the_plan_masks_repeats_and_keeps_a_quaternion_whole(damaged):
    chosen = plan(read(damaged))
    assert chosen.reader == {"outliers": "mask", "repeated": "mask", "angles": ["yaw"]}
    assert chosen.redundant.empty == ("broken",)
    assert not chosen.redundant.constants, "qx and qy are 0, and parts of a quaternion"


def test_the_advice_says_nothing_that_train_would_choose_itself(damaged):
    reader = {"time_unit": "us", "without": ["broken", "a b"], "max_gap_s": None}
    command = advise(read(damaged, time_unit="us"), "damaged.csv", "run", reader=reader).command
    assert command == (
        "offbeat", "train", "damaged.csv", "run", "--reader.time_unit=us",
        '--reader.without=[broken, "a b"]', "--reader.max_gap_s=null",
    )  # fmt: skip
    assert advise(read(damaged), "damaged.csv").command[2:] == ("damaged.csv", "runs/log")


def test_the_plan_holds_for_the_data_as_they_will_be_read():
    # A sensor of 20 Hz whose values a recording of 100 Hz repeats, beside one of 100 Hz.
    rows = np.arange(2000)
    values = np.column_stack([np.sin(0.1 * rows), (rows // 5) * 7 % 11])
    (one,) = data = ob.Dataset((ob.Trajectory(rows / 100, values, names=("fast", "slow")),))
    assert inspect(data).channels[1].rate_hz == pytest.approx(100)
    masked = inspect(without_repeats(data)).channels
    assert [c.rate_hz for c in masked] == pytest.approx([100, 20])
    chosen = plan(data)
    assert chosen.longest_silence_s == pytest.approx(0.05), "the step of the slow sensor"
    assert chosen.split.mask == "dropout"
    assert chosen.sensors == (("fast",), ("slow",))
    as_read = assemble(
        [Recording((Signal("", 10_000_000 * rows, values.copy(), one.names),))],
        ReaderOptions(repeated="mask"),
    )
    assert np.array_equal(as_read[0].observed, without_repeats(data)[0].observed)


def test_the_command_of_the_advice_trains(damaged, tmp_path, capsys):
    assert main(["inspect", str(damaged), "--run", str(tmp_path / "run"), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    small = ["--model.name=gru", "--model.hidden_size=4", "--training.epochs=1"]
    assert main([*told["advice"]["command"][1:], *small]) == 0
    said = capsys.readouterr().err
    for reason in told["advice"]["reasons"]:
        assert f"offbeat: {reason}" in said
    kept = json.loads((tmp_path / "run" / "reader.json").read_text())
    assert kept.pop("found") == {"time_unit": "us"}  # by the numbers, for other logs
    assert kept == {"outliers": "mask", "repeated": "mask", "angles": ["yaw"]}
    predictions = tmp_path / "predictions.csv"
    assert main(["predict", str(tmp_path / "run"), str(damaged), str(predictions)]) == 0
    assert "broken" in predictions.read_text().splitlines()[0], "no column is lost"
    capsys.readouterr()
    assert main(["evaluate", str(tmp_path / "run"), str(damaged), "--json"]) == 0
    scores = json.loads(capsys.readouterr().out)
    trained = json.loads((tmp_path / "run" / "results.json").read_text())
    assert scores["part"] == "test", "evaluate finds the split of the training again"
    assert scores["predictors"] == trained["predictors"]


def test_what_cannot_be_trained_on_is_inspected_all_the_same(tmp_path, capsys):
    path = tmp_path / "still.csv"
    path.write_text("time,a,b\n" + "".join(f"{0.01 * i},1,2\n" for i in range(100)))
    assert main(["inspect", str(path)]) == 0
    text = capsys.readouterr().out
    assert "constant, so not learned, and given back as they are: a, b" in text
    assert "It cannot be trained on: there is nothing to learn" in text
    assert main(["train", str(path), str(tmp_path / "run")]) == 2
    assert "nothing to learn" in capsys.readouterr().err


def test_a_data_set_of_ours_is_finished_and_the_advice_says_so(tmp_path, capsys):
    trajectories = ob.Trajectory(np.arange(30) / 10, np.random.default_rng(0).normal(size=(30, 2)))
    path = tmp_path / "ours.parquet"
    ob.save(ob.Dataset((trajectories,) * 10), path)
    assert main(["inspect", str(path), "--run", "run", "--json"]) == 0
    advice = json.loads(capsys.readouterr().out)["advice"]
    assert advice["command"] == ["offbeat", "train", str(path), "run"]
    assert "taken as it is" in advice["reasons"][0]


def test_outliers_copies_and_counters_are_told_in_the_table_and_in_sentences(tmp_path, capsys):
    rows = np.arange(300)
    wave = np.sin(0.1 * rows)
    height = np.where(np.isin(rows, [50, 51, 200]), -999.0, wave)
    table = np.column_stack([rows / 100, wave, wave, height + 0.5 * (height > -1), rows])
    path = tmp_path / "log.csv"
    head = "time,x,x_again,height,seq"
    np.savetxt(path, table, delimiter=",", header=head, comments="", fmt="%.9g")
    found = inspect(read(path))
    channels = {channel.name: channel for channel in found.channels}
    assert channels["x_again"].copy_of == "x"
    assert channels["seq"].counter
    (outliers,) = channels["height"].outliers
    assert (outliers.value, outliers.count, outliers.at[0]) == (-999.0, 3, (0, 0.5))
    assert main(["inspect", str(path)]) == 0
    text = capsys.readouterr().out
    assert "copy of x" in text
    assert "counter" in text
    assert "height: 3 values of -999, far from all others, mark missing values (at 0.5 s," in text
    assert main(["inspect", str(path), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["notes"] == list(found.notes)
    assert told["channels"][2]["outliers"][0]["value"] == -999.0


def test_text_ends_in_advice_and_the_picture_shows_the_outage_as_white(damaged, tmp_path, capsys):
    picture = tmp_path / "log.png"
    assert main(["inspect", str(damaged), "--out", str(picture), "--reader.max_gap_s=null"]) == 0
    text = capsys.readouterr().out
    assert shlex.join(["offbeat", "train", str(damaged)]) in text
    pixels = np.asarray(Image.open(picture).convert("RGB")).reshape(-1, 3)
    blue = np.abs(pixels.astype(int) - (0, 114, 178)).max(axis=1) < 8
    assert 0 < blue.mean() < 0.25  # 4 s of 16 s are measured


def test_an_option_that_the_format_does_not_have_is_refused_in_one_line(damaged, capsys):
    assert main(["inspect", str(damaged), "--reader.max_gap=1"]) == 2
    assert "did you mean '--reader.max_gap_s'" in capsys.readouterr().err


def test_a_real_flight_log_shows_its_streams_gaps_and_dropouts():
    found = inspect(read(shared("px4_ulog", "sample.ulg")))
    rates = {channel.name: channel.rate_hz for channel in found.channels}
    assert rates["sensor_combined.gyro_rad[0]"] == pytest.approx(250, rel=0.01)
    assert rates["vehicle_attitude.q[0]"] == pytest.approx(83, rel=0.02)
    assert rates["vehicle_local_position.z"] == pytest.approx(10, rel=0.01)
    assert any("4 dropouts" in said for said in found.found)


def test_an_angle_that_wraps_is_unwrapped_by_the_plan():
    times = np.arange(0, 60, 0.01)
    wrapped = (0.8 * times + np.pi) % (2 * np.pi) - np.pi
    degrees = np.degrees((1.1 * times) % (2 * np.pi))
    noise = np.random.default_rng(0).uniform(-np.pi, np.pi, len(times))
    values = np.column_stack([wrapped, degrees, np.sin(times), noise, wrapped])
    names = ("heading", "bearing", "joint", "noise", "position")
    units = ("rad", "deg", "rad", "rad", "m")
    data = ob.Dataset((ob.Trajectory(times, values, names=names, units=units),))
    chosen = plan(data)
    assert chosen.reader["angles"] == ["heading", "bearing"]
    heading = prepare(data, chosen)[0].values[:, 0]
    np.testing.assert_allclose(heading, 0.8 * times, atol=1e-9)


def test_an_angle_without_a_unit_is_found_by_its_name_and_its_jumps():
    times = np.arange(0, 60, 0.01)
    wrapped = (0.8 * times + np.pi) % (2 * np.pi) - np.pi
    turns = {"arm.yaw": wrapped, "Bearing": np.degrees(wrapped), "level": wrapped}
    steady = {"pitch": np.sin(times), "rolling": wrapped}
    values = np.column_stack([*turns.values(), *steady.values()])
    data = ob.Dataset((ob.Trajectory(times, values, names=(*turns, *steady)),))
    chosen = plan(data)
    assert chosen.reader["angles"] == ["arm.yaw", "Bearing"]
    clean = prepare(data, chosen)[0].values
    np.testing.assert_allclose(clean[:, 0], 0.8 * times, atol=1e-9)
    np.testing.assert_allclose(clean[:, 1], np.degrees(0.8 * times), atol=1e-7)
    assert "angles" not in plan(data, known=["outliers"]).reader


def test_states_that_are_named_like_actions_are_noted():
    times = np.arange(0, 60, 0.01)
    values = np.column_stack([np.sin(times), np.cos(times), np.sin(2 * times)])
    one = ob.Trajectory(times, values, names=("state", "action.0", "action.1"))
    (said,) = [note for note in plan(ob.Dataset((one,))).notes if "like actions" in note]
    assert "action.0, action.1; --reader.actions=[action.0,action.1] makes them actions" in said
    given = replace(one, roles=("state", "action", "action"))
    assert not any("like actions" in note for note in plan(ob.Dataset((given,))).notes)
    other = replace(one, names=("state", "traction", "interaction"))
    assert not any("like actions" in note for note in plan(ob.Dataset((other,))).notes)


def test_the_heading_of_a_slow_log_says_how_long_it_is_and_how_far_rows_are_apart():
    times = 600.0 * np.arange(1000)
    data = ob.Dataset((ob.Trajectory(times, np.sin(times / 5e4)[:, None]),))
    assert "1000 rows in 599400 s (6.94 days), one in 600 s, 1 channels" in heading(inspect(data))
