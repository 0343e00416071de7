"""Environments whose observations are late, incomplete or missing."""

from __future__ import annotations

import numpy as np
import pytest

from offbeat.errors import InputError

gymnasium = pytest.importorskip("gymnasium")

from gymnasium.utils.env_checker import check_env  # noqa: E402

from offbeat.data.drops import Outages  # noqa: E402
from offbeat.env import UnevenObservations  # noqa: E402

EVERYTHING = {
    "drop": 0.4,
    "sensor_drop": 0.2,
    "bursts": 0.2,
    "delay_s": (0.0, 0.12),
    "jitter_s": 0.02,
}


def pendulum(**options):
    return UnevenObservations(gymnasium.make("Pendulum-v1"), **options)


def episode(env, seed, steps=150):
    """Observations of an episode under fixed actions, and the true ones."""
    observation, info = env.reset(seed=seed)
    seen, true = [observation], [info["observation"]]
    for step in range(steps):
        observation, _, _, _, info = env.step(np.array([np.sin(step)], dtype=np.float32))
        seen.append(observation)
        true.append(info["observation"])
    return {k: np.stack([one[k] for one in seen]) for k in seen[0]}, np.stack(true)


@pytest.mark.filterwarnings("ignore:.*The environment .* is different from the unwrapped")
@pytest.mark.filterwarnings("ignore:.*A Box observation space m.* value is")
@pytest.mark.filterwarnings("ignore:.*we recommend using a symmetric and normalized space")
@pytest.mark.filterwarnings("ignore:.*Not able to test alternative render modes")
@pytest.mark.parametrize("name", ["Pendulum-v1", "CartPole-v1"])
@pytest.mark.parametrize("options", [{}, EVERYTHING])
def test_it_is_an_environment_of_gymnasium(name, options):
    env = UnevenObservations(gymnasium.make(name), **{**options, "jitter_s": 0.005})
    check_env(env, skip_render_check=True)
    observation, _ = env.reset(seed=1)
    assert env.observation_space.contains(observation)


def test_nothing_lost_or_late_is_the_environment_itself():
    seen, true = episode(pendulum(), 3)
    assert np.array_equal(seen["values"], true)
    assert seen["mask"].all()
    assert np.allclose(seen["now"][:, 0], 0.05 * np.arange(151))
    assert np.array_equal(seen["now"], seen["time"])


def test_a_seed_gives_the_same_observations_and_another_seed_others():
    one, _ = episode(pendulum(**EVERYTHING), 5)
    same, _ = episode(pendulum(**EVERYTHING), 5)
    other, _ = episode(pendulum(**EVERYTHING), 6)
    for key, value in one.items():
        assert np.array_equal(value, same[key]), key
    assert not np.array_equal(one["mask"], other["mask"])


def test_frames_are_lost_as_often_as_asked_for_and_the_first_one_never_is():
    masks = [episode(pendulum(drop=0.7), seed)[0]["mask"] for seed in range(20)]
    frames = np.stack(masks).all(axis=2)
    assert np.array_equal(np.stack(masks).any(axis=2), frames), "all sensors of a frame together"
    assert frames[:, 0].all()
    assert abs(frames[:, 1:].mean() - 0.3) < 4 * np.sqrt(0.21 / frames[:, 1:].size)


def test_more_drops_of_the_same_seed_lose_the_same_frames_and_others():
    few, many = (episode(pendulum(drop=d), 8)[0]["mask"][:, 0] for d in (0.3, 0.7))
    assert (few >= many).all()
    assert few.sum() > many.sum()


def test_sensors_are_missing_each_on_its_own_and_their_values_are_not_shown():
    seen, true = episode(pendulum(sensor_drop=0.5, sensors=[[0, 1], [2]]), 2)
    mask = seen["mask"].astype(bool)
    assert np.array_equal(mask[:, 0], mask[:, 1])
    assert 0.2 < (mask[:, 0] != mask[:, 2]).mean() < 0.8
    assert np.array_equal(seen["values"][mask], true[mask])
    assert (seen["values"][~mask] == 0).all()


def test_outages_have_the_lengths_and_the_fraction_of_the_time_that_were_asked_for():
    random, outages = np.random.default_rng(0), Outages(0.3, (0.1, 0.5))
    times = np.arange(0, 4000, 0.01)
    out = np.array([outages.at(t, random) for t in times])
    edges = np.flatnonzero(np.diff(out.astype(int)))
    lengths = np.diff(edges)[0 if out[edges[0] + 1] else 1 :: 2] * 0.01
    assert abs(out.mean() - 0.3) < 0.015
    assert lengths.min() > 0.08
    assert np.quantile(lengths, 0.9) < 0.52


@pytest.mark.parametrize("fraction", [0.0, 0.05, 0.6, 0.98])
@pytest.mark.parametrize("length_s", [(0.1, 0.5), (0.0, 0.01)])
def test_outages_of_many_times_are_those_of_one_time_after_another(fraction, length_s):
    times = np.r_[0.0, 0.0, np.cumsum(np.random.default_rng(1).exponential(0.02, 300))]
    one, many = Outages(fraction, length_s), Outages(fraction, length_s)
    first, second = np.random.default_rng(2), np.random.default_rng(2)
    for part in (times[:120], times[120:121], times[121:], times[-1:]):
        expected = [one.at(t, first) for t in part]
        assert many.within(part, second).tolist() == expected
    assert first.random() == second.random()


def test_a_delayed_frame_is_an_earlier_observation_under_its_own_stamp():
    seen, true = episode(pendulum(delay_s=0.15), 4)
    assert np.array_equal(seen["values"][4:], true[1:-3])
    assert np.allclose(seen["time"][4:, 0], seen["now"][4:, 0] - 0.15)
    assert not seen["mask"][1:4].any()


def test_frames_that_are_late_by_different_times_arrive_in_order_and_once():
    seen, true = episode(pendulum(delay_s=(0.0, 0.3)), 4)
    arrived = seen["mask"].any(axis=1)
    stamps = seen["time"][arrived, 0]
    assert (np.diff(stamps) > 0).all()
    assert np.array_equal(seen["values"][arrived], true[np.rint(stamps / 0.05).astype(int)])
    assert 0.3 < arrived.mean() < 0.95


def test_stamps_jitter_within_their_bound_and_never_lie_in_the_future():
    seen, _ = episode(pendulum(jitter_s=0.02, delay_s=0.05), 9)
    late = (seen["now"] - seen["time"])[2:, 0] - 0.05
    assert np.abs(late).max() <= 0.02 + 1e-12
    assert late.std() > 0.008
    assert late.min() < -0.015
    seen, _ = episode(pendulum(jitter_s=0.02), 9)
    assert (seen["time"] <= seen["now"]).all()
    assert (np.diff(seen["time"][:, 0]) > 0).all()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"drop": 1.0}, "drop must be a fraction"),
        ({"bursts": -0.1}, "bursts must be a fraction"),
        ({"burst_s": (0.5, 0.1)}, "burst_s must be seconds"),
        ({"delay_s": -1.0}, "delay_s must be seconds"),
        ({"jitter_s": 0.03}, "less than half a step"),
        ({"sensors": [[3]]}, "positions of channels, 0 to 2"),
        ({"dt": 0.0}, "dt must be positive"),
    ],
)
def test_an_argument_out_of_its_range_is_refused(options, message):
    with pytest.raises(InputError, match=message):
        pendulum(**options)


def test_other_spaces_and_environments_without_a_time_step_are_refused():
    class Bare(gymnasium.Env):
        action_space = gymnasium.spaces.Discrete(2)

        def __init__(self, space):
            self.observation_space = space

    with pytest.raises(InputError, match="observations must be a Box"):
        UnevenObservations(Bare(gymnasium.spaces.Discrete(3)))
    with pytest.raises(InputError, match="give dt"):
        UnevenObservations(Bare(gymnasium.spaces.Box(0.0, 1.0, (2,))))
