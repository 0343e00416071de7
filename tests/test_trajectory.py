"""Trajectories and data sets are checked when they are made."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import offbeat as ob
from offbeat.data.arrays import hand_over

TIMES = np.array([0.0, 0.1, 0.3])
VALUES = np.array([[1.0, 2.0], [np.nan, 3.0], [4.0, np.nan]])


def test_known_and_observed_differ():
    observed = np.array([[True, False], [False, True], [True, False]])
    one = ob.Trajectory(TIMES, VALUES, observed)
    assert np.array_equal(one.known, ~np.isnan(VALUES))
    assert np.array_equal(one.observed, observed)
    assert np.array_equal(ob.Trajectory(TIMES, VALUES).observed, one.known)
    assert (one.rows, one.channels) == (3, 2)


def test_a_trajectory_cannot_be_changed():
    one = ob.Trajectory(TIMES, VALUES)
    for array in (one.times, one.values, one.observed):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 0
    with pytest.raises(AttributeError):
        one.names = ("a", "b")


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"times": [0.0, np.nan, 0.2]}, "finite seconds, got nan at row 1"),
        ({"times": [0.0, np.inf, 0.2]}, "finite seconds, got inf at row 1"),
        ({"times": [0.0, 0.2, 0.1]}, r"got 0.2 at row 1 and .*0.1.* at row 2"),
        ({"times": [0.0, 0.0, 0.1]}, "must increase strictly"),
        ({"times": [0.0, 0.1]}, r"values .*2 rows, as times has, got shape \(3, 2\)"),
        ({"times": [[0.0], [0.1], [0.2]]}, r"shape \(rows,\)"),
        ({"times": ["a", "b", "c"]}, "times must be numbers"),
        ({"values": VALUES[:, 0]}, r"shape \(rows, channels\)"),
        ({"values": np.full((3, 2), np.inf)}, "infinite at row 0, channel 'channel_0'"),
        ({"values": np.zeros((3, 0))}, "empty: 3 rows, 0 channels"),
        ({"times": [], "values": np.zeros((0, 2))}, "empty: 0 rows"),
        ({"observed": np.ones((3, 2), bool)}, "True at row 1, channel 'channel_0', where the"),
        ({"observed": np.ones((3, 2))}, "observed must be bool"),
        ({"names": ("a", "a")}, "have the name 'a'"),
        ({"names": ("a",)}, "1 names, 2 units and 2 roles for 2 channels"),
        ({"units": ("m",)}, "2 names, 1 units"),
        ({"roles": ("state",)}, "2 units and 1 roles"),
        ({"roles": ("state", "control")}, "unknown role of a channel 'control'.* exogenous, state"),
    ],
)
def test_what_is_wrong_is_said_with_what_was_got_and_where(fields, message):
    with pytest.raises(ob.InputError, match=message):
        ob.Trajectory(**{"times": TIMES, "values": VALUES, **fields})


def test_messages_name_the_origin():
    with pytest.raises(ob.InputError, match="of run 7"):
        ob.Trajectory(TIMES[::-1], VALUES, origin="run 7")


@pytest.mark.parametrize(("unit", "per_second"), [("s", 1), ("ms", 10**3), ("us", 10**6)])
def test_times_in_any_unit_give_the_same_trajectory(unit, per_second):
    seconds = np.array([0.0, 0.125, 0.5])
    one = ob.Trajectory.from_arrays(seconds * per_second, VALUES, time_unit=unit)
    assert np.array_equal(one.times, seconds)


@given(st.integers(0, 2**60), st.lists(st.integers(1, 10**10), min_size=2, max_size=2))
def test_an_integer_clock_loses_no_nanosecond(start, steps):
    ticks = np.array([start, start + steps[0], start + sum(steps)])
    one = ob.Trajectory.from_arrays(ticks, VALUES, time_unit="ns")
    assert np.array_equal(np.rint(one.times * 1e9).astype(int), ticks - start)


def test_an_unknown_unit_of_time_is_refused_with_the_choices():
    with pytest.raises(ob.InputError, match="one of: 100ns, d, h, min, ms, ns, s, us"):
        ob.Trajectory.from_arrays(TIMES, VALUES, time_unit="sec")


def test_a_data_set_holds_trajectories_of_the_same_channels():
    one = ob.Trajectory(TIMES, VALUES, names=("a", "b"))
    for other, message in (
        (ob.Trajectory(TIMES, VALUES), "trajectory 1 has channels channel_0"),
        (ob.Trajectory(TIMES, VALUES, names=("a", "b"), units=("m", "")), r"a \[m\]"),
        (
            ob.Trajectory(TIMES, VALUES, names=("a", "b"), roles=("state", "action")),
            r"b \[\] \(action\)",
        ),
    ):
        with pytest.raises(ob.InputError, match=message):
            ob.Dataset((one, other))
    with pytest.raises(ob.InputError, match="at least one trajectory"):
        ob.Dataset(())


def test_a_data_set_is_sliced_chosen_from_and_reordered():
    roles = ("state", "action")
    many = ob.Dataset(
        tuple(ob.Trajectory(TIMES, VALUES + i, names=("a", "b"), roles=roles) for i in range(4)),
        {"seed": 1},
    )
    assert len(many[1:3]) == 2
    assert many[1:3].meta == {"seed": 1}
    assert [float(t.values[0, 0]) for t in many.take([3, 0])] == [4.0, 1.0]
    swapped = many.select(("b", "a"))
    assert (swapped.names, swapped.roles) == (("b", "a"), ("action", "state"))
    assert many.take([2]).roles == many[0].slice(0, 1).roles == roles
    assert np.array_equal(many[0].actions, VALUES[:, 1:], equal_nan=True)
    assert many.select(("a",))[0].actions is None
    assert np.array_equal(swapped[0].values, VALUES[:, ::-1], equal_nan=True)
    with pytest.raises(ob.InputError, match="unknown channel 'c'"):
        many.select(("c",))


def test_fingerprints_are_equal_for_equal_data_alone():
    def made(values=VALUES, times=TIMES, **fields):
        return ob.Dataset((ob.Trajectory(times, values, **fields),))

    masked = ~np.isnan(VALUES) & np.array([[True, False]] * 3)
    others = [
        made(VALUES * 2),
        made(times=TIMES * 2),
        made(observed=masked),
        made(names=("a", "b")),
        made(units=("m", "")),
        made(units=("", "m")),
        made(roles=("state", "action")),
        made(roles=("state", "exogenous")),
    ]
    assert made().fingerprint() == made().fingerprint()
    assert len({made().fingerprint(), *(other.fingerprint() for other in others)}) == 9


def test_a_trajectory_owns_its_arrays():
    times, values, observed = TIMES.copy(), VALUES.copy(), ~np.isnan(VALUES)
    one = ob.Trajectory(times, values, observed)
    values[0, 0], times[0], observed[0, 0] = np.inf, np.nan, False
    assert (one.times[0], one.values[0, 0], one.observed[0, 0]) == (0.0, 1.0, True)
    backing = np.stack([VALUES, VALUES])
    view = backing[0].view()
    view.flags.writeable = False
    aliased = ob.Trajectory(TIMES, view)
    backing[:] = np.inf
    assert aliased.values[0, 0] == 1.0
    buffer = bytearray(VALUES.tobytes())
    seen = np.frombuffer(memoryview(buffer).toreadonly()).reshape(3, 2)
    aliased = ob.Trajectory(TIMES, seen)
    buffer[:8] = np.array([np.inf]).tobytes()
    assert aliased.values[0, 0] == 1.0


def test_what_is_read_only_is_not_copied():
    one = ob.Trajectory(TIMES, VALUES)
    part = one.slice(1, 3)
    assert np.shares_memory(part.values, one.values)
    assert np.shares_memory(part.times, one.times)
    made = hand_over(np.zeros((2, 3, 2)))
    assert np.shares_memory(ob.Trajectory(TIMES, made[0]).values, made)
    with pytest.raises(ValueError, match="read-only"):
        made[0] = 1


def test_a_model_of_states_takes_data_that_have_actions_too():
    data = ob.Dataset((ob.Trajectory(TIMES, VALUES, names=("a", "b")),))
    acted = ob.Trajectory(
        TIMES,
        np.column_stack([np.ones(3), VALUES]),
        names=("u", "a", "b"),
        roles=("action", "state", "state"),
    )
    assert ob.Dataset((acted,)).without_actions_but(("a",)).fingerprint() == data.fingerprint()
    assert ob.Dataset((acted,)).without_actions_but(("u",)).channels == 3
    model = ob.make_model("gru", data, hidden_size=2)
    expected, got = ob.predict(model, data), ob.predict(model, ob.Dataset((acted,)))
    assert np.array_equal(got[0].values, expected[0].values)
    filled, again = ob.impute(model, data), ob.impute(model, ob.Dataset((acted,)))
    assert np.array_equal(filled[0].values, again[0].values)
