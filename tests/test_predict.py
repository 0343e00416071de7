"""Predictions in original units, at any times, whatever the size of the parts."""

import numpy as np
import pytest
import torch
from model_helpers import dataset, small_model

import offbeat as ob
from offbeat.models.zoo import ZOO


@pytest.mark.parametrize("name", sorted(ZOO))
def test_predictions_are_the_models_own_in_original_units(name):
    data = dataset(3)
    model = small_model(name, data, scaler="standardise")
    scaled = model(model.batch(data)).mean.detach().double().numpy()
    for trajectory, got, expected in zip(data, ob.predict(model, data), scaled, strict=True):
        assert np.array_equal(got.times, trajectory.times)
        expected = model.scaler.original(expected[: trajectory.rows])
        assert np.allclose(got.values, expected, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("options", [{}, {"self_feeding": 0.5}])
def test_predictions_do_not_depend_on_how_many_are_made_at_a_time(options):
    data = dataset(5)
    model = small_model("gru", data, **options)
    one_by_one, at_once = (ob.predict(model, data, size=size) for size in (1, 5))
    for a, b in zip(one_by_one, at_once, strict=True):
        assert np.allclose(a.values, b.values, rtol=0, atol=1e-6)


def test_own_times_per_trajectory_and_times_after_the_last_row():
    data = dataset(2)
    model = small_model("anchored_ode_gru_d", data)
    ends = [float(t.times[-1]) for t in data]
    asked = [[ends[0] + 0.1], [ends[1] + 0.1, ends[1] + 0.2]]
    got = ob.predict(model, data, times=asked)
    assert [t.times.tolist() for t in got] == asked
    assert all(np.isfinite(t.values).all() for t in got)


@pytest.mark.parametrize(
    "times",
    [
        [0.2, 0.1],
        [],
        float("nan"),
        [0.1, float("inf")],
        "soon",
        "0.1",
        ["0.1"],
        [None],
        {"t": 0.1},
        True,
        1j,
        np.zeros((2, 2, 1)),
        [[0.1], [0.2], [0.3]],
        [[0.1], []],
        [0.1, [0.2, 0.1]],
    ],
)
def test_times_that_are_none_are_refused_in_one_line(times):
    data = dataset(2)
    with pytest.raises(ob.InputError) as refused:
        ob.predict(small_model("gru", data), data, times=times)
    assert "\n" not in str(refused.value)


def test_one_time_is_asked_of_every_trajectory():
    data = dataset(2)
    model = small_model("gru", data)
    for one in (0.1, np.float32(0.1), np.array(0.1), [0.1], (0.1,), np.array([0.1]), -1, [-0.5]):
        got = ob.predict(model, data, times=one)
        assert [t.times.tolist() for t in got] == [np.ravel(one).astype(float).tolist()] * 2


@pytest.mark.parametrize("options", [{"size": 0}, {"size": 2.0}, {"seed": -1}, {"seed": 0.5}])
def test_sizes_and_seeds_that_are_none_are_refused(options):
    data = dataset(2)
    with pytest.raises(ob.InputError):
        ob.predict(small_model("gru", data), data, **options)


def test_nothing_of_a_prediction_needs_a_gradient():
    data = dataset(2)
    model = small_model("ode_rnn", data)
    ob.predict(model, data)
    assert torch.is_grad_enabled()
    assert all(p.grad is None for p in model.parameters())


def test_one_trajectory_is_a_data_set_and_anything_else_is_refused_in_one_line():
    data = dataset(3)
    model = small_model("anchored_ode_gru_d", data)
    one = data[0]
    alone, among = ob.predict(model, one)[0], ob.predict(model, data)[0]
    np.testing.assert_allclose(alone.values, among.values, rtol=1e-12)
    assert len(ob.forecast(model, [one, data[1]], 0.1)) == 2
    assert len(ob.impute(model, one)) == 1
    for call in (
        lambda: ob.predict(model, "log.csv"),
        lambda: ob.forecast(model, 3, 0.1),
        lambda: ob.impute(model, None),
        lambda: ob.evaluate(model, "log.csv"),
        lambda: ob.fit(model, "log.csv"),
        lambda: ob.inspect("log.csv"),
        lambda: ob.mask_out("log.csv", 0.5),
        lambda: ob.split("log.csv"),
        lambda: ob.make_model("gru", "log.csv"),
    ):
        with pytest.raises(ob.InputError, match="expected a Dataset, a Trajectory or a list"):
            call()
    with pytest.raises(ob.InputError, match="observed_fraction must be"):
        ob.mask_out(data, "half")
    with pytest.raises(ob.InputError, match="seed must be"):
        ob.make_model("gru", data, seed="one")
