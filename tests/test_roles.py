"""Channel roles: what is seen, what is predicted, and when an action is seen."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from model_helpers import small_model

import offbeat as ob

NAMES = ("position", "torque", "wind")
ROLES = ("state", "action", "exogenous")


def arm(count: int = 12, rows: int = 30, *, roles=ROLES) -> ob.Dataset:
    """A torque that responds to the last observed position, and a wind that is not predicted."""
    made = []
    for i in range(count):
        random = np.random.default_rng(i)
        times = np.cumsum(random.uniform(0.02, 0.2, rows))
        wind = random.normal(size=rows)
        position = np.sin(3 * times + i) + 0.1 * wind
        torque = -2.0 * position
        values = np.stack([position, torque, wind], axis=1)
        observed = random.random((rows, 3)) < 0.8
        observed[:, 0] = True
        made.append(ob.Trajectory(times, values, observed=observed, names=NAMES, roles=roles))
    return ob.Dataset(tuple(made))


@pytest.mark.parametrize("name", ["gru", "gru_d", "lstm", "ode_rnn", "anchored_ode_gru_d"])
def test_an_action_is_read_after_the_observations_of_its_row_and_never_from_itself(name):
    data = arm(3)
    model = small_model(name, data)
    batch = model.batch(data)
    row = 7
    with torch.no_grad():
        before = model(batch).mean

        def changed(channel):
            values = batch.values.clone()
            values[:, row, channel] += 1.0
            mask = batch.mask.clone()
            mask[:, row, channel] = True
            known = replace(batch, mask=mask)
            return (model(replace(known, values=values)).mean - model(known).mean).abs()

        action, position = changed(1), changed(0)
    assert float(action[:, : row + 1].max()) == 0.0, "an action is no input of its own row"
    assert float(action[:, row + 1].max()) > 1e-6, "it is an input of the next"
    assert float(position[:, row, 0].max()) == 0.0, "a state is predicted from the past"
    assert float(position[:, row, 1].max()) > 1e-6, "an action from what its row observed"
    assert bool(before.isfinite().all())


@pytest.mark.parametrize("name", ["gru", "gru_d", "anchored_ode_gru_d"])
def test_actions_row_by_row_are_those_of_the_batch(name):
    data = arm(2)
    model = small_model(name, data)
    batch = model.batch(data)
    with torch.no_grad():
        whole = model(batch).mean
        past, parts = None, []
        for start, stop in ((0, 1), (1, 2), (2, 9), (9, batch.rows)):
            names = ("times", "values", "mask", "known", "valid")
            part = replace(batch, **{n: getattr(batch, n)[:, start:stop] for n in names})
            output = model(part, past=past)
            past = output.past
            parts.append(output.mean)
    assert torch.allclose(torch.cat(parts, dim=1), whole, atol=1e-12)


def test_an_exogenous_channel_is_neither_trained_on_nor_scored():
    data = arm(4)
    model = small_model("gru", data)
    batch = model.batch(data)
    assert not bool(batch.targets[..., 2].any())
    assert bool(batch.targets[..., :2].any())
    scores = ob.evaluate({"gru": model}, data).scores["gru"].after_first_observation
    assert np.isnan(scores.per_channel[2])
    assert np.isfinite(scores.per_channel[:2]).all()
    worse = replace(batch, values=batch.values + torch.tensor([0.0, 0.0, 5.0]))
    output = model(batch)
    mask = batch.targets.to(output.mean.dtype)
    assert torch.equal(
        model.loss(output, batch.values, mask), model.loss(output, worse.values, mask)
    )


def test_a_policy_learns_to_answer_what_it_has_just_observed():
    """The torque is -2 times the position of its row: an action head must beat the last torque."""
    data = arm(60)
    train, validation, test = ob.split(data, seed=0)
    model = ob.make_model("gru", train, hidden_size=16, seed=0)
    recipe = ob.TrainConfig(epochs=40, batch_size=10, optimizer="adam", learning_rate=0.01)
    ob.fit(model, train, validation, recipe, progress=False)
    scores = ob.evaluate({"gru": model}, test).scores
    torque = {name: s.after_first_observation.per_channel[1] ** 0.5 for name, s in scores.items()}
    assert torque["gru"] < 0.25 * torque["last_value"]
    # The same channels, all states: the torque cannot be read off the position of its own row.
    blind = arm(60, roles=("state",) * 3)
    train, validation, test = ob.split(blind, seed=0)
    model = ob.make_model("gru", train, hidden_size=16, seed=0)
    ob.fit(model, train, validation, recipe, progress=False)
    other = ob.evaluate({"gru": model}, test).scores["gru"].after_first_observation
    assert torque["gru"] < 0.5 * other.per_channel[1] ** 0.5


def test_roles_are_saved_with_the_model(tmp_path):
    model = small_model("gru", arm(3))
    model.save(tmp_path / "model")
    assert ob.load_model(tmp_path / "model").roles == ROLES


def test_data_with_nothing_to_predict_is_refused():
    with pytest.raises(ob.InputError, match="every channel is exogenous"):
        ob.make_model("gru", arm(3, roles=("exogenous",) * 3))


def test_an_exogenous_channel_is_nan_in_every_answer_and_never_filled():
    data = arm(4)
    model = small_model("anchored_ode_gru_d", data)
    for answered in (ob.predict(model, data), ob.forecast(model, data, [0.1])):
        values = np.concatenate([t.values for t in answered])
        assert np.isnan(values[:, 2]).all()
        assert np.isfinite(values[:, :2]).all()
    for filled, given in zip(ob.impute(model, data), data, strict=True):
        seen = given.observed[:, 2]
        assert np.array_equal(filled.values[seen, 2], given.values[seen, 2])
        assert np.isnan(filled.values[~seen, 2]).all()
        assert np.isfinite(filled.values[:, :2]).all()
    stream = ob.Stream(model)
    stream.observe(0.0, {"position": 0.1, "wind": 0.3})
    predicted = stream.predict(0.1)
    assert np.isfinite(predicted[:2]).all()
    assert np.isnan(predicted[2])
