"""Groups of positions, velocities and accelerations: found by name, unit and data; and used."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

import offbeat as ob
from offbeat.baselines import MotionFilter, MotionSmoother, Smoother, find_groups, fit_baseline
from offbeat.baselines.groups import Group, kind_of, unit_of


@pytest.mark.parametrize(
    ("position", "velocity"),
    [
        ("joint_1_position", "joint_1_velocity"),
        ("position[3]", "velocity[3]"),
        ("q1", "dq1"),
        ("x", "vx"),
        ("knee_qpos", "knee_qvel"),
        ("theta", "theta_dot"),
        ("pose.pose.position.x", "twist.twist.linear.x"),
        ("leftElbowPos", "leftElbowVel"),
        ("hip", "hip_speed"),
        ("vy", "ay"),
        ("qd_2", "qdd_2"),
        ("a_pos", "a_vel"),
        ("p.x", "v.x"),
    ],
)
def test_names_of_a_pair_have_one_stem(position, velocity):
    stem, kind = kind_of(position)
    assert kind_of(velocity) == (stem, kind + 1)


@pytest.mark.parametrize(
    ("one", "other"), [("joint_1_position", "joint_2_velocity"), ("x", "vy"), ("x", "y")]
)
def test_names_of_no_pair_differ(one, other):
    stem, kind = kind_of(one)
    assert kind_of(other) != (stem, kind + 1)


@pytest.mark.parametrize(
    ("unit", "expected"),
    [
        ("m", ("m", 1.0, 0)),
        ("mm/s", ("m", 1e-3, 1)),
        ("deg/s^2", ("rad", math.pi / 180, 2)),
        ("m/s²", ("m", 1.0, 2)),
        ("rpm", ("rad", math.pi / 30, 1)),
        ("m/min", ("m", 1 / 60, 1)),
        ("bar/s", ("bar", 1.0, 1)),
        ("", None),
        ("N m/rad", None),
    ],
)
def test_units_are_read(unit, expected):
    assert unit_of(unit) == (expected if expected is None else pytest.approx(expected))


NAMES = ("a_pos", "a_vel", "a_acc", "b_pos", "b_vel", "load")


def robot(seed, count=12, rows=150, noise=1e-3, names=NAMES, units=(), factors=(1.0,) * 6):
    """Two joints with their derivatives at uneven times, and a channel of its own."""
    random = np.random.default_rng(seed)
    made = []
    for _ in range(count):
        times = np.cumsum(random.uniform(0.5, 1.5, rows)) * 0.01
        columns = np.zeros((rows, 6))
        for joint in range(2):
            for rate in random.uniform(2, 9, 3):
                size, phase = random.normal(), random.uniform(0, 6)
                angle = rate * times + phase
                derivatives = np.sin(angle), rate * np.cos(angle), -(rate**2) * np.sin(angle)
                for j in range(3 if joint == 0 else 2):
                    columns[:, 3 * joint + j] += size * derivatives[j]
        columns[:, 5] = np.sin(3 * times + random.uniform(0, 6))
        columns += noise * random.normal(size=columns.shape) * columns.std(axis=0)
        made.append(ob.Trajectory(times, columns * factors, names=names, units=units))
    return ob.Dataset(tuple(made))


def test_groups_of_three_and_of_two_are_found():
    found = find_groups(robot(0))
    assert [g.channels for g in found] == [(0, 1, 2), (3, 4)]
    for group in found:
        assert group.slopes == pytest.approx([1.0] * len(group.slopes), abs=0.02)
        assert min(group.r2) > 0.99
        assert set(group.proposed) == {"names"}
    assert found[1].text(NAMES).startswith("b_pos <- b_vel (slope ")


def test_a_group_is_found_by_units_alone_with_their_factor():
    units = ("mm", "m/s", "m/s^2", "deg", "rad/s", "V")
    names = tuple(f"signal {letter}" for letter in "uvwabc")
    factors = (1e3, 1.0, 1.0, math.degrees(1), 1.0, 1.0)
    found = find_groups(robot(0, names=names, units=units, factors=factors))
    assert [g.channels for g in found] == [(0, 1, 2), (3, 4)]
    assert found[0].factors == pytest.approx((1.0, 1e-3, 1e-3))
    assert found[1].factors == pytest.approx((1.0, math.radians(1)))
    assert set(found[0].proposed) == {"units"}


def test_a_group_is_found_by_data_alone():
    found = find_groups(robot(0, names=()))
    assert [g.channels for g in found] == [(0, 1, 2), (3, 4)]


def test_names_are_not_believed_where_data_disagree():
    # What is called velocity of a is that of b, and the other way round.
    names = ("a_pos", "b_vel", "c_acc", "b_pos", "a_vel", "load")
    assert find_groups(robot(0, names=names)) == []


def test_units_that_exclude_a_pair_are_believed():
    units = ("rad", "rad", "rad", "rad", "rad", "V")
    assert find_groups(robot(0, units=units)) == []


def test_channels_without_relation_are_no_group():
    random = np.random.default_rng(0)
    walks = random.normal(size=(3000, 8)).cumsum(axis=0)
    assert find_groups(ob.Dataset((ob.Trajectory(np.arange(3000) * 0.01, walks),))) == []


def test_a_group_of_sensors_that_report_at_different_times_is_found():
    data = robot(0)
    apart = []
    for t in data:
        values = t.values.copy()
        values[::2, [0, 3]] = np.nan
        values[1::3, [1, 2, 4]] = np.nan
        apart.append(ob.Trajectory(t.times, values, names=t.names))
    assert [g.channels for g in find_groups(ob.Dataset(tuple(apart)))] == [(0, 1, 2), (3, 4)]


def test_groups_survive_as_numbers():
    for group in find_groups(robot(0)):
        assert Group.of(np.array(group.numbers())) == group


def outages(data, seed, cut):
    """Sensors that drop out, each for itself; or everything from a row on."""
    random = np.random.default_rng(seed)
    made = []
    for t in data:
        observed = t.observed.copy()
        if cut:
            first = random.integers(60, 120)
            observed[first:] = False
            t = t.slice(0, first + 20)
            observed = observed[: first + 20]
        else:
            for sensor in ([0, 3], [1, 2, 4], [5]):
                for first in random.integers(10, 120, 2):
                    observed[first : first + 20, sensor] = False
        made.append(replace(t, observed=observed))
    return ob.Dataset(tuple(made))


def rmse(baseline, test):
    squares = [
        np.where(t.observed, np.nan, (p - t.values) ** 2)
        for p, t in zip(baseline.predict(test), test, strict=True)
    ]
    return np.sqrt(np.nanmean(np.concatenate(squares), axis=0))


@pytest.fixture(scope="module")
def smoothers():
    train = outages(robot(0, count=24), 0, cut=False)
    return MotionSmoother().fit(train), Smoother().fit(train)


def test_a_smoother_of_groups_fills_far_better_than_one_of_channels(smoothers):
    motion, single = smoothers
    test = outages(robot(1), 1, cut=False)
    ratio = rmse(motion, test) / rmse(single, test)
    assert (ratio[[0, 1, 3, 4]] < 0.3).all()
    assert ratio[5] == pytest.approx(1.0)
    assert motion.has_groups
    assert motion.describe(NAMES).count("\n") == 1


def test_a_filter_of_groups_forecasts_better_than_one_of_channels():
    train = outages(robot(0, count=24), 0, cut=True)
    test = outages(robot(1, count=24), 1, cut=True)
    motion, single = MotionFilter().fit(train), fit_baseline("kalman_long", train)
    ratio = rmse(motion, test) / rmse(single, test)
    assert (ratio[[0, 3]] < 0.8).all()


def test_what_is_saved_of_groups_predicts_the_same(smoothers):
    test = outages(robot(1), 1, cut=False)
    motion = smoothers[0]
    other = MotionSmoother().restore(motion.arrays())
    assert other.groups == motion.groups
    for a, b in zip(motion.predict(test), other.predict(test), strict=True):
        assert np.array_equal(a, b)


def test_without_groups_all_channels_are_single():
    names = tuple(f"channel {i}" for i in range(6))
    data = robot(0, names=names).select([names[0], names[5]])
    train = outages_of_rows(data)
    motion = MotionSmoother().fit(train)
    assert not motion.has_groups
    assert motion.describe(train.names) == "no channel is the derivative of another one"
    single = Smoother().fit(train)
    for a, b in zip(motion.predict(train), single.predict(train), strict=True):
        assert np.array_equal(a, b)


def outages_of_rows(data):
    return ob.Dataset(
        tuple(
            replace(t, observed=(np.arange(t.rows) % 30 < 20)[:, None] & t.observed) for t in data
        )
    )


def test_a_blend_says_which_channels_are_filtered_together():
    times = 0.05 * np.arange(300)
    values = np.stack([np.sin(times), np.cos(times)], axis=1)
    data = ob.Dataset((ob.Trajectory(times, values, names=("x", "vx"), units=("m", "m/s")),))
    names = {"causal": ("last_value", "motion_filter"), "two_sided": ("linear",)}
    notes = ob.fit_blend(data, data, count=30, **names).notes()
    assert any(note.startswith("filtered together: x <- vx") for note in notes)


def test_a_log_whose_only_group_has_an_acceleration_is_filtered():
    data = outages(robot(0, count=8), 0, cut=False).select(NAMES[:3])
    motion = MotionSmoother().fit(data)
    assert [group.channels for group in motion.groups] == [(0, 1, 2)]
