"""The harness of the simulated Hopper: what it scores, how it starts a field, one small run."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch

import offbeat as ob
from examples.hopper import __main__ as command
from examples.hopper import models, scores
from examples.hopper.data import Hopper, run_of, switches
from examples.hopper.models import Plan, start_linear

pytest.importorskip("mujoco")


@pytest.fixture(scope="module")
def hopper() -> Hopper:
    return Hopper.simulated(40)


def test_windows_are_those_of_the_thesis_and_belong_to_the_whole_trajectories(hopper):
    run = run_of(0.3)
    assert run.seed_draw == 230_000
    for windows, whole in zip(hopper.parts(0.3), hopper.whole(0.3), strict=True):
        assert [t.origin for t in windows] == [t.origin for t in whole]
        for window, all_ in zip(windows, whole, strict=True):
            first = round(window.times[0] / 0.005)
            assert np.array_equal(window.values, all_.values[first : first + 100])
            assert window.observed.any(axis=1).sum() == 30


def test_no_trajectory_of_a_training_is_in_the_test_part_of_another_fraction(hopper):
    trained = {t.origin for t in hopper.whole(0.3)[0]}
    assert trained & {t.origin for t in hopper.parts(0.9)[2]}  # each fraction has its own split
    train, _, test = hopper.parts(0.9, drawn_for=0.3)
    assert {t.origin for t in train} == trained
    assert not trained & {t.origin for t in test}
    assert all(t.observed.any(axis=1).sum() == 90 for t in test)
    for a, b in zip(hopper.parts(0.3, drawn_for=0.3)[2], hopper.parts(0.3)[2], strict=True):
        assert np.array_equal(a.observed, b.observed)


def test_a_contact_or_a_limit_that_begins_or_ends_is_a_switch(hopper):
    high = np.zeros(14)
    high[[1, 5]] = 3.0, 1.0  # m above where it stands; rad, the knee within its range
    low = high.copy()
    low[1] = -0.3  # the foot is in the ground
    straight = high.copy()
    straight[5] = 0.0  # below 0.087 rad
    rows = np.stack([high, high, low, low, high, straight])
    one = replace(hopper.recorded[0], times=0.005 * np.arange(6), values=rows, observed=None)
    assert switches(ob.Dataset((one,))).tolist() == [[False, False, True, False, True, True]]


def test_scores_count_rows_after_the_first_observed_one_by_their_time_since(hopper):
    (window,) = hopper.recorded.take([0])
    observed = np.zeros((10, 14), dtype=bool)
    observed[[2, 4, 9]] = True
    window = replace(window.slice(0, 10), observed=observed)
    asked = scores.Questions(ob.Dataset((window,)), hopper.scaler)
    assert asked.age.tolist() == [[0, 0, 0, 1, 2, 1, 2, 3, 4, 5]]
    switch = switches(asked.test)[0]
    for row, age in enumerate(asked.age[0].tolist()):
        if age:
            assert asked.switched[0, row] == switch[row - age : row + 1].any()
    perfect = asked.score(asked.truth)
    assert perfect["rmse"] == 0
    error = np.zeros(10)
    error[[0, 3, 8]] = 100.0, 3.0, 4.0
    found = asked.score(asked.truth + error[None, :, None])
    assert (found["rows"], found["rows_by_age"]) == (7, [2, 2, 1, 1, 1, 0, 0, 0])
    assert found["rmse"] == pytest.approx(np.sqrt(25 / 7))
    assert found["by_age"][:4] == pytest.approx([np.sqrt(4.5), 0, 0, 4])
    assert found["error_by_age"][:4] == pytest.approx([9 / 25, 0, 0, 16 / 25])
    assert found["worst_hundredth"] == pytest.approx(16 / 25)


def test_the_record_of_the_thesis_is_read_by_repeat():
    row = {"experiment": "2", "model": "gru", "observed_fraction": "0.3", "epochs": "50"}
    rows = [
        {**row, "repeat": "0", "honest_mse": "0.04", "seconds": "60"},
        {**row, "repeat": "1", "honest_mse": "0.09", "seconds": "180"},
        {**row, "repeat": "0", "honest_mse": "1", "seconds": "1", "experiment": "1"},
    ]
    found = scores.record(rows, "gru", 0.3)
    assert found == {"rmse": 0.2, "all": pytest.approx([0.2, 0.3]), "minutes": 2, "epochs": 50}


def test_a_field_that_starts_linear_is_the_map_of_a_linear_system():
    turn = np.array([[0.99, -0.1], [0.1, 0.99]])
    random, trajectories = np.random.default_rng(0), []
    for _ in range(8):
        rows = [random.normal(size=2)]
        for _ in range(20):
            rows.append(turn @ rows[-1])
        trajectories.append(ob.Trajectory(0.1 * np.arange(21), np.array(rows)))
    train = ob.Dataset(tuple(trajectories))
    model = ob.make_model("anchored_ode_gru_d", train, hidden_size=3, field_units=(9, 8))
    start_linear(model, train)
    with torch.no_grad():
        model.field.weights[-1][:, 4:] = 0.0  # of the units that are not part of it
    predicted = scores.predictions(model, train)
    values = model.batch(train).values.double().numpy()
    assert np.abs(predicted[:, 1:] - values[:, 1:]).max() < 1e-4
    tanh = ob.make_model("ode_rnn", train)
    with pytest.raises(ob.InputError, match="SiLU"):
        start_linear(tanh, train)


def test_a_training_goes_on_from_the_weights_of_another(tmp_path, monkeypatch, hopper):
    options = {"hidden_size": 2, "field_units": (28,)}
    first = Plan("first", 0.3, (0.3,), options, {"epochs": 1, "learning_rate": 0.01})
    still = replace(first, training={"epochs": 1, "learning_rate": 1e-12}, after="small")
    monkeypatch.setitem(models.PLANS, "small", first)
    before, _ = models.train(first, hopper, tmp_path / "small-seed0")
    after, results = models.train(still, hopper, tmp_path / "on")
    assert [len(result.history) for result in results] == [1, 1]
    for name, value in before.state_dict().items():
        assert torch.allclose(value, after.state_dict()[name], atol=1e-9), name


def test_the_command_keeps_scores_and_writes_the_tables(tmp_path, monkeypatch, hopper):
    options = {"hidden_size": 2, "field_units": (28,)}
    plan = Plan("tiny", 0.3, (0.3, 0.9), options, {"epochs": 1}, linear=True)
    monkeypatch.setitem(models.PLANS, "large_fresh", plan)
    page = tmp_path / "robots.md"
    ablations = ("ablation", "ablation, 40 epochs")
    names = ("errors", *ablations, "curves", "since observation", "contacts", "runs")
    page.write_text("".join(f"<!-- {n} -->\n<!-- end of {n} -->\n" for n in names))
    given = ["--only", "last_value,large_fresh", "--fractions", "0.3", "--trajectories", "40"]
    places = ["--out", str(tmp_path), "--runs", str(tmp_path / "runs"), "--document", str(page)]
    command.main([*given, *places])
    kept = json.loads((tmp_path / "large_fresh-seed0.json").read_text())
    assert kept["epochs"] == len(kept["curve"]) == 1
    rmse = json.loads((tmp_path / "last_value.json").read_text())["scores"]["0.3"]["rmse"]
    asked = scores.Questions(hopper.parts(0.3)[2], hopper.scaler)
    fitted = ob.baselines.fit_baseline("last_value", hopper.parts(0.3)[0])
    expected = asked.score(scores.baseline_predictions(fitted, asked.test, hopper.scaler))
    assert rmse == expected["rmse"]
    text = page.read_text()
    assert f"| last value | not run | not run | not run | {rmse:.4f} |" in text
    monkeypatch.setattr(command, "fit_baseline", None)  # nothing is fitted again
    command.main([*given, *places])
    assert page.read_text() == text
    assert (tmp_path / "figures" / "hopper_curves.png").stat().st_size > 5000
    with pytest.raises(ob.InputError, match="unknown fraction"):
        command.main(["--only", "ridge", "--fractions", "0.4"])
