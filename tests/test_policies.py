"""Policies: what each must hold to, and a small cloning."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

import offbeat as ob
from examples.policies.pendulum import expert as pendulum_expert
from offbeat.data.drops import Drops
from offbeat.data.trajectory import ACTION
from offbeat.data.transforms import Angle, Transforms
from offbeat.errors import DivergenceError
from offbeat.parts import Prediction
from offbeat.policies import (
    CloneConfig,
    HeldController,
    OnnxPolicy,
    Policy,
    demonstrate,
    export_policy,
    fit_policy,
    rollout,
)
from offbeat.policies.fitting import _Retreat, _rows, _windows

NAMES = ("angle", "speed", "push")
ROLES = ("state", "state", "action")
MODELS = ("gru", "gru_d", "ode_rnn", "ode_gru_d", "anchored_ode_gru_d", "anchored_trend")
SMALL = {"hidden_size": 6, "decoder_units": (8,), "field_units": (8,)}


def demonstrations(count: int = 6, rows: int = 40) -> ob.Dataset:
    """A swing, and a push against its angle and its speed."""
    made = []
    for i in range(count):
        random = np.random.default_rng(i)
        times = 5.0 + np.cumsum(random.uniform(0.02, 0.08, rows))
        angle = np.sin(3 * times + i)
        speed = 3 * np.cos(3 * times + i)
        push = np.clip(-angle - 0.3 * speed, -1, 1)
        values = np.stack([angle, speed, push], axis=1)
        made.append(ob.Trajectory(times, values, names=NAMES, roles=ROLES))
    return ob.Dataset(tuple(made))


def small(name: str = "anchored_ode_gru_d", **options) -> Policy:
    config = CloneConfig(epochs=1, window=20, loss=options.pop("loss", "mse"))
    policy = fit_policy(
        demonstrations(), name, config=config, progress=False, **{**SMALL, **options}
    )
    policy.model.double()
    policy.reset()
    return policy


def episode(seed: int = 0, rows: int = 25):
    """Times, observations and masks, frames and sensors missing."""
    random = np.random.default_rng(seed)
    times = 3.0 + np.cumsum(random.uniform(0.01, 0.2, rows))
    mask = (random.random((rows, 2)) < 0.7) & (random.random((rows, 1)) < 0.6)
    mask[0] = True
    return times, random.normal(size=(rows, 2)), mask


def acted(policy, times, values, masks):
    return np.array([policy.act(t, v, m) for t, v, m in zip(times, values, masks, strict=True)])


@pytest.mark.parametrize("name", MODELS)
def test_row_by_row_is_the_model_on_the_whole_episode(name):
    policy = small(name)
    times, values, masks = episode()
    whole = np.concatenate([values, np.zeros((len(times), 1))], axis=1)
    seen = np.concatenate([masks, np.zeros((len(times), 1), dtype=bool)], axis=1)
    trajectory = ob.Trajectory(times, whole, observed=seen, names=NAMES, roles=ROLES)
    model = policy.model
    with torch.no_grad():
        predicted = model(model.batch(ob.Dataset((trajectory,)))).mean[0].numpy()
    expected = model.scaler.original(predicted)[:, 2:]
    assert np.allclose(acted(policy, times, values, masks), expected, atol=1e-11)


@pytest.mark.parametrize("name", MODELS)
def test_an_action_depends_on_the_past_and_the_observation_of_its_row_alone(name):
    policy = small(name)
    times, values, masks = episode()
    before = acted(policy, times, values, masks)
    row = 12
    masks = masks.copy()
    masks[row] = True
    policy.reset()
    with_row = acted(policy, times, values, masks)
    changed = values.copy()
    changed[row] += 1.0
    changed[~masks] += 100.0  # what is not measured is not looked at
    policy.reset()
    after = acted(policy, times, changed, masks)
    assert np.array_equal(with_row[:row], before[:row])
    assert np.array_equal(after[:row], with_row[:row])
    assert np.abs(after[row] - with_row[row]).max() > 1e-9


@pytest.mark.parametrize("name", MODELS)
def test_missing_observations_are_accepted_in_every_form(name):
    policy = small(name)
    policy.act(0.0, {"angle": 0.4, "speed": 0.1})
    state = policy.state()
    forms = ((), (None,), ([np.nan, np.nan],), ([7.0, 8.0], [False, False]), ({},))
    chosen = []
    for form in forms:
        policy.restore(state)
        chosen.append(policy.act(0.1, *form))
    assert all(np.array_equal(one, chosen[0]) for one in chosen)
    policy.restore(state)
    partly = policy.act(0.1, {"speed": -2.0})
    policy.restore(state)
    assert np.array_equal(partly, policy.act(0.1, [5.0, -2.0], [0, 1]))
    assert not np.array_equal(partly, chosen[0])
    policy.reset()
    assert np.isfinite(policy.act(0.0)).all()  # nothing was ever observed


@pytest.mark.parametrize("name", MODELS)
def test_asking_without_an_observation_changes_no_later_action(name):
    policy = small(name)
    times, values, masks = episode()
    expected = acted(policy, times, values, masks)
    policy.reset()
    for row, time in enumerate(times):
        if row:
            policy.act((time + times[row - 1]) / 2)
        chosen = policy.act(time, values[row], masks[row])
        assert np.allclose(chosen, expected[row], atol=1e-12)


def test_an_observation_that_is_late_is_placed_at_its_stamp():
    policy = small()
    policy.act(0.0, [0.1, 0.2])
    policy.act(0.3, [0.5, 0.6])
    expected = policy.act(0.4)
    policy.reset()
    policy.act(0.0, [0.1, 0.2])
    assert np.array_equal(policy.act(0.3, [0.5, 0.6], now=0.4), expected)
    policy.reset()
    policy.act(0.0, [0.1, 0.2])
    policy.act(0.35)  # before it arrives
    assert np.array_equal(policy.act(0.3, [0.5, 0.6], now=0.4), expected)


def test_a_model_of_fixed_steps_takes_a_row_per_call_at_the_time_of_the_action():
    policy = small("gru", update_rows="every", time_input="none")
    policy.act(0.0, [0.1, 0.2])
    without = policy.act(0.2, [0.5, 0.6])
    policy.reset()
    policy.act(0.0, [0.1, 0.2])
    policy.act(0.1)
    assert not np.array_equal(policy.act(0.05, [0.5, 0.6], now=0.2), without)


@pytest.mark.parametrize("loss", ["mse", "nll"])
@pytest.mark.parametrize("name", ["gru", "anchored_ode_gru_d"])
def test_actions_stay_within_their_bounds_whatever_is_observed(name, loss):
    policy = small(name, bounds=([-0.5], [2.0]), loss=loss)
    assert (policy.low, policy.high) == (-0.5, 2.0)
    with torch.no_grad():
        for parameter in policy.model.parameters():
            parameter.mul_(30)
    chosen = acted(policy, np.arange(50.0), 1e6 * np.random.default_rng(0).normal(size=(50, 2)),
                   np.ones((50, 2)))  # fmt: skip
    assert (chosen >= -0.5).all()
    assert (chosen <= 2.0).all()
    assert np.ptp(chosen) > 0.1


@pytest.mark.parametrize("name", MODELS)
def test_several_robots_together_are_each_alone(name):
    policy = small(name)
    episodes = [episode(seed) for seed in range(3)]
    alone = []
    for times, values, masks in episodes:
        policy.reset()
        alone.append(acted(policy, times, values, masks))
    policy.reset(3)
    for row in range(25):
        t, v, m = (np.stack([one[part][row] for one in episodes]) for part in range(3))
        assert np.allclose(policy.act(t, v, m), [one[row] for one in alone], atol=1e-11)


@pytest.mark.parametrize("name", MODELS)
def test_a_robot_whose_frames_are_late_changes_no_action_of_another(name):
    policy = small(name)
    with torch.no_grad():  # a decay that acts over a gap of any length
        for part, value in policy.model.named_parameters():
            if part == "decay.bias":
                value.fill_(0.5)
    times, values, masks = episode()
    expected = acted(policy, times, values, masks)
    policy.reset(2)
    for row, time in enumerate(times):
        now = np.array([time, time + 0.01])
        both = [np.stack([part[row]] * 2) for part in (values, masks)]
        chosen = policy.act(np.full(2, time), *both, now=now)
        assert np.allclose(chosen[0], expected[row], atol=1e-11)


@pytest.mark.parametrize("rows", [5, 500])
def test_the_time_since_actions_that_are_never_seen_is_that_since_the_last_observed_row(rows):
    model = small("gru_d").model
    times = 0.05 * np.arange(rows)
    observed = np.zeros((rows, 3), dtype=bool)
    observed[:-2, :2] = True
    values = np.zeros((rows, 3))
    shown = ob.Trajectory(times, values, observed=observed, names=NAMES, roles=ROLES)
    delta = model.step_inputs(model.batch(ob.Dataset((shown,))))[0].delta[0] * model.time_unit
    assert delta[1:].numpy() == pytest.approx(np.repeat([[0.05]] * (rows - 2) + [[0.1]], 3, axis=1))


@pytest.mark.parametrize("name", ["gru_d", "anchored_trend"])
def test_saved_and_loaded_a_policy_acts_the_same_bit_for_bit(name, tmp_path):
    policy = small(name)
    policy.save(tmp_path / "policy")
    loaded = Policy.load(tmp_path / "policy")
    assert (loaded.observations, loaded.actions) == (("angle", "speed"), ("push",))
    assert np.array_equal(acted(policy, *episode()), acted(loaded, *episode()))


@pytest.mark.parametrize("name", MODELS)
def test_a_state_goes_on_bit_for_bit_also_in_another_policy(name, tmp_path):
    policy = small(name)
    times, values, masks = episode()
    acted(policy, times[:10], values[:10], masks[:10])
    np.savez(tmp_path / "state.npz", **policy.state())
    expected = acted(policy, times[10:], values[10:], masks[10:])
    with np.load(tmp_path / "state.npz") as state:
        other = Policy(policy.model)
        other.restore(dict(state))
    assert np.array_equal(acted(other, times[10:], values[10:], masks[10:]), expected)
    with pytest.raises(ob.InputError, match="state is of another model"):
        small("gru" if name != "gru" else "ode_rnn", hidden_size=7).restore(other.state())


@pytest.mark.parametrize("name", ["ode_gru_d", "anchored_trend"])
def test_the_onnx_file_acts_as_the_policy(name, tmp_path):
    pytest.importorskip("onnxscript")
    pytest.importorskip("onnxruntime")
    policy = small(name, bounds=([-2.0], [1.0]))
    export_policy(policy, tmp_path / "policy.onnx")
    other = OnnxPolicy(tmp_path / "policy.onnx")
    assert (other.observations, other.actions) == (policy.observations, policy.actions)
    times, values, masks = episode()
    expected = acted(policy, times, values, masks)
    assert np.allclose(acted(other, times, values, masks), expected, atol=1e-9)
    state = other.state()
    one = other.act(times[-1] + 0.1)
    other.restore(state)
    assert np.array_equal(other.act(times[-1] + 0.1), one)
    assert np.allclose(one, policy.act(times[-1] + 0.1), atol=1e-9)
    with pytest.raises(ob.InputError, match="state is of another policy"):
        other.restore({"state": np.zeros((1, 1))})
    with pytest.raises(ob.InputError, match="t must be a finite time"):
        other.act(np.nan)
    with pytest.raises(ob.InputError, match="times must not decrease"):
        other.act(times[-1] - 1.0)
    assert np.allclose(other.act(times[-1] + 0.2), policy.act(times[-1] + 0.2), atol=1e-9)


def wrapped(seed: int = 0, rows: int = 40) -> ob.Trajectory:
    """A turning joint that is sent from -pi to pi, a quaternion of changing sign, and a push."""
    random = np.random.default_rng(seed)
    times = np.cumsum(random.uniform(0.02, 0.1, rows))
    angle = 4 * times + seed
    half = np.stack([np.cos(angle / 2), np.sin(angle / 2), 0 * angle, 0 * angle], axis=1)
    sent = (angle + np.pi) % (2 * np.pi) - np.pi
    half *= random.choice([-1, 1], rows)[:, None]
    push = np.sin(angle)
    values = np.concatenate([sent[:, None], half, push[:, None]], axis=1)
    names = ("joint", "qw", "qx", "qy", "qz", "push")
    return ob.Trajectory(times, values, names=names, roles=("state",) * 5 + ("action",))


def turning() -> ob.Dataset:
    """Turning joints whose transforms are applied, as a reader does."""
    transforms = Transforms({"joint": Angle(2 * np.pi, -np.pi)}, (("qw", "qx", "qy", "qz"),))
    return transforms.apply(ob.Dataset(tuple(wrapped(i) for i in range(4))))


def test_a_policy_applies_the_input_transforms_of_its_demonstrations_row_by_row(tmp_path):
    config = CloneConfig(epochs=1, window=20)
    policy = fit_policy(turning(), "gru_d", config=config, progress=False, **SMALL)
    policy.model.double()
    asked = [wrapped(9), wrapped(11)]
    observed = np.random.default_rng(0).random((2, 40, 6)) < 0.6
    observed[:, 0], observed[..., 5] = True, False
    shown = [replace(t, observed=seen) for t, seen in zip(asked, observed, strict=True)]
    with torch.no_grad():
        predicted = policy.model(policy.model.batch(ob.Dataset(tuple(shown)))).mean.numpy()
    expected = policy.model.scaler.original(predicted)[..., 5]
    policy.reset(2)
    for row in range(40):
        if row == 15:  # goes on in another policy
            np.savez(tmp_path / "state.npz", **policy.state())
            other = Policy(policy.model)
            other.reset(2)
            with np.load(tmp_path / "state.npz") as state:
                other.restore(dict(state))
            policy = other
        given = [np.array([t.times[row] for t in asked]), [t.values[row, :5] for t in asked]]
        chosen = policy.act(*given, observed[:, row, :5])
        assert np.allclose(chosen[:, 0], expected[:, row], atol=1e-11)
    with pytest.raises(ob.InputError, match="differs in 'angle'"):
        policy.restore({k: v for k, v in policy.state().items() if k != "transforms.angle"})
    with pytest.raises(ob.InputError, match="takes no input transforms, and 'joint' has one"):
        export_policy(policy, tmp_path / "policy.onnx")


def test_an_action_with_an_input_transform_is_refused():
    pushes = Transforms({"push": Angle(2 * np.pi)}).apply(turning())
    with pytest.raises(ob.InputError, match="the action 'push' has an input transform"):
        fit_policy(pushes, "gru_d", progress=False, **SMALL)


def test_a_file_that_is_no_policy_is_refused(tmp_path):
    pytest.importorskip("onnxruntime")
    (tmp_path / "bad.onnx").write_bytes(b"no graph")
    with pytest.raises(ob.FileFormatError, match="not a policy that export_policy wrote"):
        OnnxPolicy(tmp_path / "bad.onnx")


def test_lerobots_form_is_act():
    policy = small()
    batch = {"observation.state": torch.tensor([[0.1, 0.2], [0.3, np.nan]]), "timestamp": 0.5}
    chosen = policy.select_action(batch)
    assert chosen.shape == (2, 1)
    assert chosen.dtype == torch.float32
    policy.reset(2)
    expected = policy.act(0.5, batch["observation.state"].numpy())
    assert np.allclose(chosen.numpy(), expected)
    later = policy.select_action({"observation.state": batch["observation.state"]})
    assert later.shape == (2, 1)
    with pytest.raises(ob.InputError, match=r"expected observation\.state"):
        policy.select_action({"state": 1})


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda p: p.act(1.0, [1.0]), r"must have the shape \(2,\), got \(1,\)"),
        (lambda p: p.act(1.0, [1.0, 2.0], [True]), "a mask must have the shape"),
        (lambda p: p.act(1.0, {"hip": 1.0}), "unknown observation 'hip'"),
        (lambda p: p.act(np.nan), "t must be a finite time"),
        (lambda p: p.act(1.0, "now"), "observation must be numbers"),
        (lambda p: (p.act(1.0, [0, 0]), p.act(0.5)), "times must not decrease"),
        (lambda p: p.act(1.0, [1.0, 1.0], now=0.5), "times must not decrease"),
        (lambda p: p.reset(0), "n must be a number of robots"),
        (lambda p: p.restore({}), "no state of a policy"),
    ],
)
def test_a_wrong_call_says_what_was_expected(call, message):
    with pytest.raises(ob.InputError, match=message):
        call(small("gru"))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"bounds": ([1.0], [1.0])}, "bounds must be finite, the lowest below"),
        ({"bounds": ([1.0, 2.0], [3.0, 4.0])}, "two arrays of 1 actions"),
        ({"sensors": [["hip"]]}, "unknown observation 'hip'"),
    ],
)
def test_a_wrong_option_of_a_cloning_says_what_was_expected(change, message):
    with pytest.raises(ob.InputError, match=message):
        fit_policy(demonstrations(), "gru", progress=False, **change)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"loss": "mae"}, "unknown loss of actions 'mae'"),
        ({"epochs": 0}, "epochs must be an integer of at least 1, got 0"),
        ({"window": 1}, "window must be at least 2 rows"),
        ({"learning_rate": -1.0}, "learning_rate must be a positive"),
        ({"observation_weight": -1.0}, "observation_weight must be at least 0"),
        ({"starts": 1.5}, "starts must be a fraction from 0 to 1, got 1.5"),
    ],
)
def test_a_wrong_config_is_refused(change, message):
    with pytest.raises(ob.InputError, match=message):
        CloneConfig(**change)


def test_demonstrations_without_actions_or_without_observations_are_refused():
    for names in (NAMES[:2], NAMES[2:]):
        with pytest.raises(ob.InputError, match="need observations and actions"):
            fit_policy(demonstrations().select(names), "gru", progress=False)
    model = ob.make_model("gru", demonstrations().select(NAMES[:2]))
    with pytest.raises(ob.InputError, match="needs a model with observations and actions"):
        Policy(model)


def test_the_same_seed_clones_the_same_policy():
    one, same, other = (
        fit_policy(demonstrations(), "gru", config=CloneConfig(epochs=2, window=20, seed=seed),
                   drops=Drops(0.5, 0.3, 0.3), progress=False, **SMALL)
        for seed in (3, 3, 4)
    )  # fmt: skip
    assert [r.epoch for r in one.log] == [1, 2]
    first, again, differs = (acted(policy, *episode()) for policy in (one, same, other))
    assert np.array_equal(first, again)
    assert not np.array_equal(first, differs)


@pytest.mark.parametrize("share", [0.0, 0.3, 1.0])
def test_a_fraction_of_the_windows_begins_where_a_demonstration_does(share):
    # Values that are the number of their row, so that a window tells where it begins.
    rows = np.arange(500.0)
    shown = ob.Dataset(
        tuple(
            ob.Trajectory(0.02 * rows, np.stack([rows, rows], 1), roles=("state", "action"))
            for _ in range(40)
        )
    )
    model = ob.make_model("gru", shown, scaler="identity", head="actions")
    whole = _rows(model, shown, None)
    config = CloneConfig(window=20, starts=share)
    drawn = _windows(whole, Drops(frames=0.0), config, np.random.default_rng(0))
    first = drawn.values[:, 0, 0].numpy()
    assert len(first) == 40 * 25
    # 481 places; 1,000 windows, so three standard errors are 0.044 at 0.3.
    assert (first == 0).mean() == pytest.approx(share + (1 - share) / 481, abs=0.045 * (share < 1))
    if share == 0:
        assert len(np.unique(first)) > 300


def test_the_best_epoch_is_kept():
    # Those that validate are as long as a window, so that each is one, and its error known.
    shown = demonstrations(count=4, rows=20)
    config = CloneConfig(epochs=8, window=20, learning_rate=0.3, starts=0.0)
    policy = fit_policy(demonstrations(), "gru", validation=shown, config=config,
                        drops=Drops(0.0), progress=False, **SMALL)  # fmt: skip
    errors = [record.validation for record in policy.log]
    assert errors[-1] > min(errors), "the last epoch is not the best one"
    squares = []
    for one in shown:
        policy.reset()
        chosen = acted(policy, one.times, one.values[:, :2], one.observed[:, :2])
        half = (policy.high - policy.low) / 2
        squares.append(((chosen - one.values[:, 2:]) / half) ** 2)
    assert np.mean(squares) == pytest.approx(min(errors), rel=1e-4)


@pytest.mark.parametrize(("loss", "start"), [("mse", 1.0), ("nll", 0.0)])
def test_a_training_whose_loss_rises_goes_back_to_the_lowest_one(caplog, loss, start):
    falls = start - np.linspace(0, 0.9, 40)
    flat = torch.zeros(1)
    retreat = _Retreat(flat, loss)
    for epoch, one in enumerate(np.r_[falls[:20], falls[19] + 0.3, falls[20:]], 1):
        flat[:] = epoch
        assert not retreat.rose(float(one)), "one epoch that comes back is none"
    rises = np.full(5, falls[-1] + 0.5)
    rose = []
    for epoch, one in enumerate(rises, 42):
        flat[:] = epoch
        rose.append(retreat.rose(float(one)))
        if rose[-1]:
            break
    assert rose[-1]
    assert flat == 40
    assert "going back to epoch 40, with half the learning rate" in caplog.text
    flat[:] = 99
    assert retreat.rose(math.nan)
    assert flat == 40
    with pytest.raises(DivergenceError, match="lower the learning rate"):
        _Retreat(flat, loss).rose(math.inf)


def test_a_training_goes_on_where_a_step_ruined_the_parameters(caplog, monkeypatch):
    class Kicked(torch.optim.Adam):
        steps = 0

        def step(self):
            super().step()
            Kicked.steps += 1
            if Kicked.steps == 41:
                with torch.no_grad():
                    self.param_groups[0]["params"][0].normal_(0.0, 10.0)

    config = CloneConfig(epochs=60, window=20, learning_rate=0.05)
    given = {"config": config, "drops": Drops(0.5), "progress": False, **SMALL}
    plain = fit_policy(demonstrations(), "anchored_ode_gru_d", **given)
    assert not caplog.text
    monkeypatch.setattr(torch.optim, "Adam", Kicked)
    policy = fit_policy(demonstrations(), "anchored_ode_gru_d", **given)
    assert "half the learning rate" in caplog.text
    assert max(record.loss for record in policy.log[30:]) > 0.5
    assert policy.log[-1].loss < 2 * plain.log[-1].loss + 0.01


class Held(torch.nn.Module):
    """A registered module: the action from the last value of each channel."""

    def __init__(self, data, width=16):
        super().__init__()
        self.acts = torch.tensor([role == ACTION for role in data.roles])
        self.layers = torch.nn.Sequential(
            torch.nn.Linear(data.channels, width),
            torch.nn.Tanh(),
            torch.nn.Linear(width, width),
            torch.nn.Tanh(),
            torch.nn.Linear(width, data.channels),
            torch.nn.Tanh(),
        )

    def forward(self, batch):
        before = ob.last_values(batch.values, batch.mask, before=torch.zeros(batch.channels))
        held = torch.where(batch.mask, batch.values, before)
        return Prediction(torch.where(self.acts, self.layers(held), before))


@pytest.fixture
def held_model():
    from offbeat.models.zoo import MODELS

    ob.register_model("held_policy", Held)
    yield "held_policy"
    MODELS.unregister("held_policy")


def test_a_registered_module_is_a_policy_on_its_newest_rows(held_model, tmp_path):
    config = CloneConfig(epochs=1, window=20)
    policy = fit_policy(demonstrations(), held_model, config=config, progress=False)
    times, values, masks = episode()
    chosen = acted(policy, times, values, masks)
    state = policy.state()
    expected = policy.act(times[-1] + 1, [0.1, 0.2])
    with pytest.raises(ob.InputError, match="state is of another model: it differs in"):
        policy.restore(small("gru").state())
    policy.restore(state)
    assert np.array_equal(policy.act(times[-1] + 1, [0.1, 0.2]), expected)
    assert np.array_equal(policy.act(times[-1] + 2), expected), "held values, no time"
    assert np.ptp(chosen) > 0
    with pytest.raises(ob.InputError, match="has no recurrent state"):
        export_policy(policy, tmp_path / "held.onnx")


def test_drops_take_what_they_say_and_never_the_first_frame():
    times = np.tile(0.05 * np.arange(200), (400, 1))
    random = np.random.default_rng(0)
    arrives = Drops(0.8).draw(times, random, channels=3)
    fractions = arrives.mean(axis=(1, 2))
    assert arrives[:, 0].all()
    assert np.array_equal(arrives.any(axis=2), arrives.all(axis=2))
    assert abs(fractions.mean() - 0.6) < 0.02
    assert fractions.min() < 0.3
    assert fractions.max() > 0.95
    sensors = Drops(0, 0.5).draw(times, random, channels=3, sensors=[[0, 1], [2]])
    assert np.array_equal(sensors[..., 0], sensors[..., 1])
    assert (sensors[..., 0] != sensors[..., 2]).any()
    assert abs(sensors.mean() - 0.75) < 0.02
    bursts = Drops(0, 0, 0.6, (0.5, 0.5)).draw(times, random, channels=1)[..., 0]
    assert abs(bursts.mean() - 0.7) < 0.05
    ends = np.flatnonzero(np.diff(bursts[0].astype(int)) == -1)
    assert not any(bursts[0, end + 1 : end + 9].any() for end in ends if end < 190)
    with pytest.raises(ob.InputError, match="frames must be a fraction"):
        Drops(1.0)


class Random:
    """Acts at random."""

    def reset(self, n=None):
        self.n, self.random = n, np.random.default_rng(0)

    def act(self, t, observation, mask, *, now):
        return self.random.uniform(-2, 2, (self.n, 1))


def test_a_small_cloning_beats_random_and_held_values_under_drops(held_model):
    pytest.importorskip("gymnasium")
    names = ("cosine", "sine", "speed")
    shown = demonstrate(pendulum_expert, "Pendulum-v1", 40, seed=3000, noise=0.3, names=names)
    assert shown.names == (*names, "action_0")
    common = {
        "bounds": ([-2.0], [2.0]),
        "progress": False,
        "drops": Drops(frames=0.9),
        "config": CloneConfig(epochs=100, window=40, starts=0.0),  # the bounds were set with it
    }
    policy = fit_policy(shown, "ode_rnn", decoder_units=(32,), **common)
    # The rival is trained with the same drops: on complete observations it is weaker.
    held = fit_policy(shown, held_model, width=64, **common)
    starts = {"episodes": 24, "seed": 7000}
    expert, random = (
        rollout(one, "Pendulum-v1", **starts).returns.mean()
        for one in (HeldController(pendulum_expert), Random())
    )
    # 0 is random, 100 the expert that sees everything. Settings and bounds were set before these
    # starts and demonstrations were used: three larger trainings of docs/policies.md have 102 with
    # 70 % of the frames lost, and 73 against 34 of the last value with 90 %.
    scores = {
        (name, drop): 100
        * (rollout(one, "Pendulum-v1", **starts, drop=drop).returns - random)
        / (expert - random)
        for name, one in {"policy": policy, "held": held}.items()
        for drop in (0.7, 0.9)
    }
    lead = scores["policy", 0.9] - scores["held", 0.9]  # the same starts and losses, in pairs
    assert scores["policy", 0.7].mean() > 90
    assert lead.mean() > 20
    assert lead.mean() > 2 * lead.std(ddof=1) / np.sqrt(len(lead))


def test_the_python_of_the_policies_page_runs(tmp_path, monkeypatch, capsys):
    pytest.importorskip("gymnasium")
    from test_readme import run_python

    monkeypatch.chdir(tmp_path)
    run_python("docs/policies.md", {}, quick=("epochs=100", "epochs=1"))
    assert "% observed" in capsys.readouterr().out
    assert Policy.load("policy").actions == ("action_0",)


def test_a_rollout_is_the_environment_driven_by_hand():
    gymnasium = pytest.importorskip("gymnasium")
    env = gymnasium.make("Pendulum-v1")
    expected = []
    for i in range(3):
        observation, _ = env.reset(seed=40 + i)
        total = 0.0
        for _ in range(50):
            observation, reward, *_ = env.step(
                pendulum_expert(observation.astype(float)).astype(np.float32)
            )
            total += float(reward)
        expected.append(total)
    found = rollout(HeldController(pendulum_expert), "Pendulum-v1", 3, seed=40, steps=50)
    assert np.allclose(found.returns, expected)
    assert found.steps.tolist() == [50, 50, 50]
    assert found.observed == 1.0


def test_what_a_rollout_cannot_do_is_said():
    pytest.importorskip("gymnasium")
    held = HeldController(pendulum_expert)
    with pytest.raises(ob.InputError, match="Gymnasium has no environment 'Pendulun-v1'"):
        rollout(held, "Pendulun-v1")
    with pytest.raises(ob.InputError, match="must be a Box of one dimension"):
        rollout(held, "CartPole-v1")
    with pytest.raises(ob.InputError, match=r"gave actions of shape \(2,\)"):
        rollout(HeldController(lambda seen: np.zeros((len(seen), 2))), "Pendulum-v1", 2)
    with pytest.raises(ob.InputError, match="recorded in time"):
        demonstrate(pendulum_expert, "Pendulum-v1", 1, delay_s=0.1)
    for wrong, message in (
        ({"episodes": 0}, "episodes must be an integer of at least 1, got 0"),
        ({"noise": -0.1}, "noise must be a number of at least 0, got -0.1"),
        ({"random_actions": 1.5}, "random_actions must be a fraction of 0 to 1, got 1.5"),
    ):
        with pytest.raises(ob.InputError, match=message):
            demonstrate(pendulum_expert, "Pendulum-v1", **wrong)
    with pytest.raises(ob.InputError, match="steps must be an integer of at least 1, got 0"):
        rollout(held, "Pendulum-v1", 1, steps=0)
