"""Measures and demonstrations of the examples of policies."""

from __future__ import annotations

import itertools
import json

import numpy as np
import pytest
import torch
from scipy import stats

import offbeat as ob
from examples import irregular_walker
from examples.linear_state_space import LRU
from examples.policies import paired, report
from examples.policies.__main__ import conditions
from examples.policies.measures import distances, swept_error_area
from examples.policies.robots import expert, robots
from examples.policies.shapes import RETURNS_S, cloned, pushed


def test_trainings_of_one_seed_are_pairs_and_each_counts_once(tmp_path):
    def write(name, **record):
        (tmp_path / f"{name}.json").write_text(json.dumps(record))

    write("expert", returns={"0 %": [200.0] * 8})
    write("random", returns={"0 %": [0.0] * 8})
    returns = {"anchored": [220, 222, 224], "ODE-RNN": [200, 200, 206], "GRU-D": [260]}
    for rival, each in returns.items():
        for seed, value in enumerate(each):
            record = {"rival": rival, "training": "drops", "seed": seed}
            write(f"{rival}-{seed}", **record, returns={"70 %": [float(value)] * 8})
    alone, three = sorted(paired.differences(tmp_path, "drops", "70 %"), key=lambda d: d.pairs)
    assert (alone.rival, alone.pairs, alone.ahead, alone.test) == ("GRU-D", 1, 0, None)
    assert alone.interval == (alone.difference,) * 2 == (-20.0, -20.0)
    assert (three.rival, three.pairs, three.ahead) == ("ODE-RNN", 3, 3)
    expected = stats.ttest_rel([110, 111, 112], [100, 100, 103])
    assert three.test.paired_t.p == pytest.approx(expected.pvalue)
    assert three.difference == pytest.approx(111 - stats.trim_mean([100] * 16 + [103] * 8, 0.25))
    assert 9 <= three.interval[0] < three.difference < three.interval[1] <= 11.5


def test_lengths_of_trainings_are_rows_with_the_best_rival(tmp_path):
    for robot, options in (
        ("walker2d_sac", {"epochs": 320, "learning_rate": 0.003}),
        ("walker2d_sac_short", {}),
    ):
        folder = tmp_path / robot
        folder.mkdir()
        scores = {"expert": 200.0, "random": 0.0}
        for name, value in scores.items():
            (folder / f"{name}.json").write_text(json.dumps({"returns": {"0 %": [value] * 4}}))
        for rival, lost in (("anchored", [150.0, 170.0]), ("GRU-D", [100.0]), ("ODE-RNN", [90.0])):
            for seed, value in enumerate(lost):
                returns = {"0 %": [200.0] * 4, "70 %": [value] * 4}
                record = {"rival": rival, "training": "all drops", "seed": seed, "returns": returns}
                record["validation"] = 0.02 + 0.01 * seed
                (folder / f"{rival}-{seed}.json").write_text(json.dumps({**record, **options}))
    rows = [line.split(" | ") for line in report.lengths(tmp_path).splitlines()[2:]]
    assert [row[:4] for row in rows] == [
        ["| walker2d", "80", "0.01", "2"],
        ["| walker2d", "320", "0.003", "2"],
    ]
    assert rows[0][4:] == ["0.0250", "100", "80 (75–85)", "75, 85", "GRU-D, 50 |"]


TURN = np.linspace(0, 2 * np.pi, 2001)[:, None]
CIRCLE = np.concatenate([np.cos(TURN), np.sin(TURN)], axis=1)


def test_the_swept_area_is_that_between_two_lines_and_two_circles():
    x = np.linspace(0, 10, 50)
    line = np.stack([x, 3 + 0 * x], axis=1)
    assert swept_error_area(line, line - [0, 2]) == pytest.approx(20)
    assert swept_error_area(3 * CIRCLE, CIRCLE) == pytest.approx(np.pi * (9 - 1), rel=1e-5)
    assert swept_error_area(CIRCLE, CIRCLE) == 0
    with pytest.raises(ValueError, match="two paths of"):
        swept_error_area(CIRCLE, CIRCLE[1:])


def test_distances_of_concentric_circles_are_the_difference_of_their_radii():
    pytest.importorskip("shapely")
    pytest.importorskip("dtaidistance")
    found = distances(3 * CIRCLE[::20], CIRCLE[::20])
    assert found["frechet"] == pytest.approx(2)
    assert found["dtw"] == pytest.approx(2)


def test_a_pushed_demonstration_moves_as_its_velocities_say_but_for_the_push():
    times = np.linspace(0, 2, 4001)
    values = np.stack([np.sin(times), times**2, np.cos(times), 2 * times], axis=1)
    demo = cloned(ob.Trajectory(times, values, names=("x", "y", "vx", "vy")), 1.0, _random())
    other = pushed(demo, _random())
    moved = np.diff(other.values[:, :2], axis=0) / np.diff(times)[:, None]
    meant = (other.values[1:, 2:] + other.values[:-1, 2:]) / 2
    wrong = np.flatnonzero(np.abs(moved - meant).max(axis=1) > 1e-2)
    assert len(wrong) == 1  # the push itself
    off = other.values[wrong[0] + 1 :, :2] - values[wrong[0] + 1 :, :2]
    late = int(np.searchsorted(times, times[wrong[0]] + RETURNS_S)) - wrong[0]
    assert np.allclose(off[late] / off[0], np.exp(-1), rtol=1e-2)


def test_a_part_of_the_stamps_is_as_many_as_asked_with_both_ends():
    times = np.linspace(0, 1, 200)
    values = np.random.default_rng(0).normal(size=(200, 4))
    some = cloned(ob.Trajectory(times, values, names=("x", "y", "vx", "vy")), 0.3, _random())
    assert len(some.times) == 60
    assert (some.times[0], some.times[-1]) == (0.0, 1.0)
    assert some.roles == ("state", "state", "action", "action")


def test_windows_of_the_walker_end_with_the_frame_that_is_asked_for():
    times = 0.008 * np.arange(400)
    values = np.stack([times, times**2], axis=1)
    cut = irregular_walker.windows(ob.Trajectory(times, values), _random(), 16)
    assert len(cut) == pytest.approx((0.9 * 400 - 64) / 16, abs=2)
    for window in cut:
        left = window.observed.any(axis=1)
        assert left.sum() == 64
        assert left[0]
        assert not left[-1]
    gone = 1 - np.concatenate([w.observed[:-1, 0] for w in cut]).mean()
    assert gone == pytest.approx(0.1, abs=0.03)
    held = [np.concatenate([w.values[:1], w.values[:-1]]) for w in cut]
    slopes = np.array([0.008**2, np.mean([np.mean(_steps(w)) for w in cut])])
    error = irregular_walker.mean_squared_error(held, ob.Dataset(tuple(cut)))
    assert error == pytest.approx(slopes.mean())


def _steps(window: ob.Trajectory) -> np.ndarray:
    rows = np.flatnonzero(window.observed[:, 0])
    return (window.values[rows + 1, 1] - window.values[rows, 1]) ** 2


def test_the_table_of_the_walker_is_sorted_and_tests_seeds_against_the_anchored_model(tmp_path):
    errors = {
        "anchored": [2.0, 2.2, 2.4],
        "GRU": [3.0, 3.5, 3.1],
        "CfC": [1.0],
        "last value": [8.0],
    }
    for model, each in errors.items():
        for seed, mse in enumerate(each):
            record = {"model": model, "seed": seed, "mse": mse, "parameters": 9, "epochs": 4}
            path = tmp_path / f"{model}-{seed}.json"
            path.write_text(json.dumps({**record, "seconds_per_epoch": 0.5}))
    lines = irregular_walker.table(tmp_path).split("\n")[2:]
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
    assert [row[0] for row in rows] == ["CfC", "anchored", "GRU", "last value"]
    p = stats.ttest_ind(errors["anchored"], errors["GRU"], equal_var=False).pvalue
    assert rows[1][1:3] == ["2.200 ± 0.200", "0.275"]
    assert rows[2][-2:] == ["3", f"{p:.2g}"]
    assert rows[0][-2:] == ["1", ""]


def test_a_linear_recurrent_unit_is_a_sum_of_decayed_inputs():
    unit = LRU(2, 3).double()
    x, gaps = torch.randn(1, 4, 2).double(), torch.tensor([[1.0, 0.5, 2.0, 0.25]]).double()
    rate = torch.complex(-unit.log_decay.exp(), unit.log_angle.exp())
    gamma = (1 - rate.exp().abs() ** 2).sqrt()
    since = gaps.sum() - gaps.cumsum(dim=1)[0]
    given = gamma * ((x[0] + 0j) @ torch.view_as_complex(unit.b))
    state = (torch.exp(since[:, None] * rate) * given).sum(dim=0)
    last = (state @ torch.view_as_complex(unit.c)).real + unit.d * x[0, -1]
    assert torch.allclose(unit(x, gaps)[0, -1], last)


@pytest.mark.parametrize("kind", ["cfc", "cfc_mixed", "ltc", "lru"])
def test_networks_of_others_predict_a_window_alike_alone_and_among_others(kind):
    if kind != "lru":
        pytest.importorskip("ncps")
    random = _random()
    made = []
    for i in range(3):
        times = np.cumsum(random.uniform(0.5, 2.0, 200 + i))
        made += irregular_walker.windows(ob.Trajectory(times, np.sin(times)[:, None]), random, 60)
    model = ob.make_model("foreign", ob.Dataset(tuple(made)), kind=kind, units=8)
    together = irregular_walker.predicted(model, ob.Dataset(tuple(made)))
    for i, window in enumerate(made):
        alone = irregular_walker.predicted(model, ob.Dataset((window,)))[0]
        assert np.allclose(together[i], alone, atol=1e-5)  # float32, as ncps has it
    slower = ob.Trajectory(2 * made[0].times, made[0].values, made[0].observed)
    changed = irregular_walker.predicted(model, ob.Dataset((slower,)))[0]
    assert np.abs(changed - together[0])[2:].max() > 1e-3  # times do matter


def _random() -> np.random.Generator:
    return np.random.default_rng(3)


@pytest.mark.parametrize("name", ["hopper", "half_cheetah", "walker2d"])
def test_an_encoder_is_the_angle_and_the_velocity_of_a_joint_that_is_driven(name):
    pytest.importorskip("gymnasium")
    pytest.importorskip("mujoco")
    from offbeat.data.robots import gymnasium_env

    robot = robots()[name]
    env = gymnasium_env(robot.env).unwrapped
    env.reset(seed=0)
    model, data = env.model, env.data
    driven = [int(model.actuator_trnid[i, 0]) for i in range(model.nu)]
    assert len(robot.encoders) == len(driven)
    before = env._get_obs()
    for joint, channels in zip(driven, robot.encoders, strict=True):
        position, velocity = data.qpos.copy(), data.qvel.copy()
        position[model.jnt_qposadr[joint]] += 0.1
        velocity[model.jnt_dofadr[joint]] += 0.1
        env.set_state(position, velocity)
        changed = np.flatnonzero(env._get_obs() != before)
        assert tuple(changed) == channels
        position[model.jnt_qposadr[joint]] -= 0.1
        velocity[model.jnt_dofadr[joint]] -= 0.1
        env.set_state(position, velocity)
        before = env._get_obs()
    lost = conditions(robot, 20)["encoder"]
    assert [one["sensors"][0] for one in lost[: len(driven)]] == list(robot.encoders)
    assert len(lost) == 20


def test_an_expert_is_its_layers():
    random = np.random.default_rng(0)
    sizes = (17, 128, 128, 6)
    tensors, layers = {}, []
    for i, (wide, out) in enumerate(itertools.pairwise(sizes)):
        layer = torch.nn.Linear(wide, out)
        tensors[f"weight_{i}"] = layer.weight.detach().numpy()
        tensors[f"bias_{i}"] = layer.bias.detach().numpy()
        layers += [layer, torch.nn.Tanh() if i == 2 else torch.nn.ReLU()]
    seen = random.normal(size=(3, 17)).astype(np.float32)
    wanted = torch.nn.Sequential(*layers)(torch.from_numpy(seen)).detach().numpy()
    assert np.allclose(expert(tensors)(seen), wanted, atol=1e-6)
    matrix, mean = np.array([[1.0, 0.0], [0.0, 30.0]]), np.array([0.5, 0.0])
    assert np.allclose(expert({"matrix": matrix, "mean": mean})([1.0, 1.0]), [0.5, 1.0])
