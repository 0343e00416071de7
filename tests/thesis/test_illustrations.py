"""What the figures of data and hidden states draw: made from models, kept in one file."""

import sys

import numpy as np
import pytest
import torch

import offbeat
from offbeat.data.masking import mask_out
from offbeat.errors import FileFormatError, InputError, MissingExtraError
from offbeat.models.checkpoint import save_model
from offbeat.models.zoo import make_model, thesis_config
from offbeat.plots import animation
from thesis import illustrate as module
from thesis.illustrate import (
    checkpoints_of,
    hidden_states,
    illustrate,
    lay_out,
    runs_of,
)
from thesis.illustrations import FILE, Illustrations, StateMap, Trace
from thesis.report_command import _illustrated


@pytest.fixture(scope="module")
def data():
    pytest.importorskip("mujoco")
    recorded = offbeat.simulate("hopper", n_trajectories=6, rows=30, seed=3, progress=False)
    return mask_out(recorded, 0.4, seed=1)


def test_illustrations_survive_the_file(tmp_path):
    random = np.random.default_rng(0)
    states = {"gru": random.standard_normal((4, 3)), "ode_rnn": random.standard_normal((4, 3))}
    kept = Illustrations(
        "hopper",
        ("a", "b"),
        ("m", ""),
        np.arange(4.0),
        random.standard_normal((2, 4, 2)),
        0.3,
        {"gru": "e1-gru-30-r00"},
        Trace(np.arange(4.0), np.array([True, False, True, True]), states, states),
        StateMap({"gru": random.standard_normal((5, 2))}, np.arange(5.0), "a", "m"),
        ("Something is not there.",),
    )
    kept.save(tmp_path)
    read = Illustrations.load(tmp_path)
    for name in ("robot", "names", "units", "fraction", "runs", "missing"):
        assert getattr(read, name) == getattr(kept, name)
    np.testing.assert_array_equal(read.recordings, kept.recordings)
    np.testing.assert_array_equal(read.trace.observed, kept.trace.observed)
    for model, values in states.items():
        np.testing.assert_array_equal(read.trace.before[model], values)
        np.testing.assert_array_equal(read.trace.after[model], values)
    np.testing.assert_array_equal(read.map.places["gru"], kept.map.places["gru"])
    assert (read.map.name, read.map.unit) == ("a", "m")


def test_a_file_that_is_not_there_is_none_and_a_damaged_one_is_an_error(tmp_path):
    assert Illustrations.load(tmp_path) is None
    (tmp_path / FILE).write_bytes(b"PK\x03\x04 and then nothing")
    with pytest.raises(FileFormatError, match="is damaged"):
        Illustrations.load(tmp_path)


def test_nothing_is_unpickled(tmp_path):
    np.savez(tmp_path / FILE, robot=np.array([{"a": 1}], dtype=object))
    with pytest.raises(FileFormatError, match="is damaged"):
        Illustrations.load(tmp_path)


def test_recordings_of_another_shape_are_refused():
    with pytest.raises(InputError, match=r"shape \(trajectories, 4, 1\), got \(4, 1\)"):
        Illustrations("hopper", ("a",), ("m",), np.arange(4.0), np.zeros((4, 1)))


def test_a_plain_gru_holds_its_state_between_observations(data):
    model = make_model(thesis_config("gru"), data, seed=0)
    before, after = hidden_states(model, data)
    assert before.shape == after.shape == (6, 30, 15)
    np.testing.assert_array_equal(before[:, 1:], after[:, :-1])
    hidden = ~np.stack([t.observed.any(axis=1) for t in data])
    np.testing.assert_array_equal(after[hidden], before[hidden])
    assert (after[~hidden] != before[~hidden]).any(axis=1).all()


def test_an_ode_moves_the_state_between_observations(data):
    model = make_model("ode_rnn", data, seed=0)
    before, after = hidden_states(model, data)
    seen = np.stack([np.maximum.accumulate(t.observed.any(axis=1)) for t in data])
    moved = (before[:, 1:] != after[:, :-1]).any(axis=2)
    np.testing.assert_array_equal(moved, seen[:, :-1])


def test_the_channels_in_an_anchored_state_are_left_out(data):
    model = make_model("anchored_ode_gru_d", data, seed=0)
    before, after = hidden_states(model, data)
    assert before.shape == after.shape == (6, 30, model.hidden_size)
    batch = model.batch(data)
    with torch.inference_mode():
        whole = model(batch).after
    # The first 14 entries are the channels: they take the value at an observation.
    channels = whole[..., :14] * model.std + model.mean
    torch.testing.assert_close(channels[batch.mask], batch.values[batch.mask])
    np.testing.assert_array_equal(after, whole[..., 14:].double().numpy())


def test_coins_of_self_feeding_are_the_same_every_time(data):
    model = make_model(thesis_config("gru", self_feeding=0.5), data, seed=0)
    for first, second in zip(hidden_states(model, data), hidden_states(model, data), strict=True):
        np.testing.assert_array_equal(first, second)


def test_checkpoints_are_found_where_runs_and_published_models_lie(data, tmp_path):
    model = make_model("gru", data, seed=0)
    save_model(model, tmp_path / "runs" / "e2-gru-30-r00" / "training" / "model")
    save_model(model, tmp_path / "models" / "e1-ode_rnn-30-r00")
    save_model(model, tmp_path / "models" / "e1-ode_gru_d-90-r00")
    found = checkpoints_of(tmp_path, 0.3)
    assert runs_of(found) == {"gru": "e2-gru-30-r00", "ode_rnn": "e1-ode_rnn-30-r00"}
    save_model(model, tmp_path / "runs" / "e1-gru-30-r00" / "training" / "model")
    assert runs_of(checkpoints_of(tmp_path, 0.3))["gru"] == "e1-gru-30-r00"
    assert checkpoints_of(tmp_path / "nowhere", 0.3) == {}


def test_illustrations_hold_the_first_recordings_and_one_trace_of_fresh_data(
    data, tmp_path, monkeypatch
):
    model = make_model("ode_rnn", data, seed=0)
    save_model(model, tmp_path / "runs" / "e1-ode_rnn-40-r00" / "training" / "model")
    monkeypatch.setattr(module, "lay_out", lambda states: states[:, :2])
    made = illustrate(
        checkpoints_of(tmp_path, 0.4),
        observed_fraction=0.4,
        recordings=2,
        recorded_rows=60,
        window=30,
        trajectories=4,
    )
    protocol = offbeat.simulate("hopper", n_trajectories=5, rows=60, seed=123, progress=False)
    np.testing.assert_array_equal(made.recordings[1], protocol[1].values)
    assert made.runs == {"ode_rnn": "e1-ode_rnn-40-r00"}
    assert made.trace.observed.sum() == 12
    assert made.trace.after["ode_rnn"].shape == (30, 15)
    assert made.trace.times[0] == 0.0
    assert len(made.map.colour) == len(made.map.places["ode_rnn"]) <= 4 * 6
    assert (made.map.name, made.map.unit) == ("rootz_qpos", "m")
    made.save(tmp_path)
    assert Illustrations.load(tmp_path).runs == made.runs


def test_without_checkpoints_there_are_recordings_and_a_reason(data):
    made = illustrate({}, recordings=2, recorded_rows=5)
    assert made.recordings.shape == (2, 5, 14)
    assert made.trace is None
    assert made.map is None
    assert "no checkpoint" in made.missing[0]


def test_without_umap_there_is_no_map_and_a_reason(data, tmp_path, monkeypatch):
    save_model(make_model("gru", data, seed=0), tmp_path / "gru")
    monkeypatch.setitem(sys.modules, "umap", None)
    made = illustrate(
        {"gru": tmp_path / "gru"},
        observed_fraction=0.5,
        recordings=1,
        recorded_rows=40,
        window=30,
        trajectories=5,
    )
    assert made.map is None
    assert made.trace is not None
    assert "offbeat[umap]" in made.missing[0]
    with pytest.raises(MissingExtraError, match="umap"):
        lay_out(np.zeros((30, 3)))


def test_a_map_of_too_few_states_is_refused():
    with pytest.raises(InputError, match="at least 20 states, got 3"):
        lay_out(np.zeros((3, 15)))


@pytest.mark.slow
@pytest.mark.timeout(600)  # its first import compiles for half a minute
def test_umap_lays_near_states_near_each_other_and_the_same_every_time():
    pytest.importorskip("umap", exc_type=ImportError)
    random = np.random.default_rng(0)
    states = 0.1 * random.standard_normal((60, 15)) + np.repeat([[0.0], [5.0]], 30, axis=0)
    places = lay_out(states)
    assert places.shape == (60, 2)
    distances = np.linalg.norm(places[:, None] - places[None], axis=2)
    np.fill_diagonal(distances, np.inf)
    nearest = distances.argmin(axis=1)
    np.testing.assert_array_equal(nearest >= 30, np.arange(60) >= 30)
    np.testing.assert_array_equal(lay_out(states), places)


@pytest.mark.slow
def test_stills_show_the_robot_of_each_row(data):
    positions = data[0].values[:, :7]
    pictures = animation.stills("hopper", positions[[0, 0, 29]])
    assert pictures.shape[0] == 3
    np.testing.assert_array_equal(pictures[0], pictures[1])
    assert (pictures[0] != pictures[2]).any()


def test_a_report_keeps_illustrations_that_show_every_model_it_has_and_more(tmp_path, monkeypatch):
    def begin(run):
        folder = tmp_path / "models" / run
        folder.mkdir(parents=True)
        (folder / "config.json").touch()

    runs = {"gru": "e1-gru-30-r00", "ode_rnn": "e1-ode_rnn-30-r00"}
    recordings = np.zeros((1, 2, 1))
    kept = Illustrations("hopper", ("a",), ("m",), np.arange(2.0), recordings, 0.3, runs)
    remade = Illustrations("hopper", ("a",), ("m",), np.arange(2.0), recordings)
    monkeypatch.setattr(module, "illustrate", lambda found, observed_fraction: remade)
    begin("e1-ode_rnn-30-r00")
    assert _illustrated(tmp_path, tmp_path / "out", 0.3, kept) is kept
    assert _illustrated(tmp_path, tmp_path / "out", 0.3, None) is remade
    begin("e1-ode_gru_d-30-r00")
    assert _illustrated(tmp_path, tmp_path / "out", 0.3, kept) is remade
