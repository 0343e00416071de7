"""Input transforms: angles and quaternions, in batches and row by row."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest

import offbeat as ob
from offbeat.data.recording import Recording, Signal, assemble
from offbeat.data.transforms import Angle, Transforms
from offbeat.stream.transformed import LiveTransforms

TURN = 2 * math.pi
QUATERNION = ("qw", "qx", "qy", "qz")


def wrap(angle, lowest=-math.pi):
    return (angle - lowest) % TURN + lowest


def turning(rows=200, rate=0.3, start=0.4):
    """A yaw that turns, as it is and as a sensor sends it."""
    true = start + rate * np.arange(rows) + 0.2 * np.sin(np.arange(rows))
    return true, wrap(true)


def dataset(columns, names, *, observed=None, meta=None):
    values = np.column_stack(columns)
    times = 0.1 * np.arange(len(values))
    return ob.Dataset((ob.Trajectory(times, values, observed=observed, names=names),), meta or {})


def spinning(rows=80):
    """A rotation about a fixed axis by more than a turn: its quaternion has no flips."""
    half = 0.05 * np.arange(rows)
    return np.column_stack([np.cos(half), 0.6 * np.sin(half), 0 * half, 0.8 * np.sin(half)])


YAW = Transforms({"yaw": Angle(TURN, -math.pi)})
ATTITUDE = Transforms(quaternions=(QUATERNION,))
BOTH = Transforms({"yaw": Angle(TURN, -math.pi)}, (QUATERNION,))


def streamed(transforms, given):
    """Results of a stream for the rows: values and mask for the model, and the state after each."""
    live = LiveTransforms(transforms, given.names)
    state, made = live.start(), []
    for values, mask in zip(given[0].values, given[0].observed, strict=True):
        values, mask, state = live.apply(np.where(mask, values, 0.0), mask, state)
        made.append((values, mask, state))
    return live, made


def test_a_wrapped_angle_is_made_continuous_and_wrapped_again():
    true, sent = turning()
    given = dataset([sent], ("yaw",))
    applied = YAW.apply(given)
    np.testing.assert_allclose(applied[0].values[:, 0], true, atol=1e-12)
    np.testing.assert_allclose(YAW.undo(applied, given)[0].values[:, 0], sent, atol=1e-12)


def test_transforms_are_applied_once():
    _, sent = turning()
    given = dataset([sent, *spinning(200).T], ("yaw", *QUATERNION))
    once = BOTH.apply(given)
    assert BOTH.apply(once) is once
    assert Transforms.identity().apply(given) is given
    assert YAW.apply(once) is once
    # A masked turn of more than a half does not wrap what has been unwrapped.
    masked = once[0].observed.copy()
    masked[20:45] = False
    again = replace(once, trajectories=(replace(once[0], observed=masked),))
    np.testing.assert_array_equal(BOTH.apply(again)[0].values[:, 0], once[0].values[:, 0])
    back = BOTH.undo(once, once)[0].values
    np.testing.assert_array_equal(back[:, 0], once[0].values[:, 0])


@pytest.mark.parametrize("seed", range(6))
def test_a_stream_agrees_with_a_batch_bit_for_bit(seed):
    generator = np.random.default_rng(seed)
    _, yaw = turning(80)
    four = (
        spinning() * generator.choice([-1.0, 1.0], (80, 1)) * generator.uniform(0.9, 1.1, (80, 1))
    )
    four[17] = 0.0
    observed = generator.random((80, 5)) < 0.6
    observed[::3, 1:] = seed < 5  # else no quaternion is observed in full
    observed[1::3, 1] &= seed < 5
    observed[2::3, 2] &= seed < 5
    given = dataset([yaw, *four.T], ("yaw", *QUATERNION), observed=observed)
    batch = BOTH.apply(given)[0]
    live, made = streamed(BOTH, given)
    np.testing.assert_array_equal([mask for _, mask, _ in made], batch.observed)
    values = np.where(batch.observed, [values for values, _, _ in made], 0.0)
    np.testing.assert_array_equal(values, np.where(batch.observed, batch.values, 0.0))
    # And the way back: each prediction by what was observed before its row.
    said = generator.normal(size=(80, 5)) * 5
    answers = dataset(said.T, given.names)
    back = BOTH.undo(answers, given)[0].values
    states = [live.start(), *(state for _, _, state in made[:-1])]
    rows = [live.undo(row[None], state)[0] for row, state in zip(said, states, strict=True)]
    np.testing.assert_array_equal(back, rows)


def test_what_is_masked_changes_nothing_else():
    _, sent = turning(60)
    observed = np.arange(60)[:, None] % 4 == 0
    one = dataset([sent], ("yaw",), observed=observed)
    other = dataset([np.where(observed[:, 0], sent, 1e3 * sent)], ("yaw",), observed=observed)
    first, second = (YAW.apply(given)[0].values[::4, 0] for given in (one, other))
    np.testing.assert_array_equal(first, second)


def test_masked_values_follow_the_observations_around_them():
    true, sent = turning(60)
    observed = (np.arange(60) % 5 == 2)[:, None]
    applied = YAW.apply(dataset([sent], ("yaw",), observed=observed))[0]
    off = applied.values[:, 0] - true
    np.testing.assert_allclose(off, off[0], atol=1e-12)  # all by the same turns


def test_predictions_come_back_in_what_was_sent():
    true, sent = turning(60)
    for given, expected in ((sent, wrap(true + 0.3)), (true, None)):
        answers = dataset([YAW.apply(dataset([given], ("yaw",)))[0].values[:, 0] + 0.3], ("yaw",))
        back = YAW.undo(answers, dataset([given], ("yaw",)))[0].values[:, 0]
        if expected is not None:
            np.testing.assert_allclose(back, expected, atol=1e-12)
            assert (np.abs(back) <= math.pi).all()
        else:  # unwrapped by hand: wrapped only until the first value beyond the range
            outside = np.flatnonzero(true > math.pi)[0] + 1
            np.testing.assert_allclose(back[outside:], (true + 0.3)[outside:], atol=1e-12)


def test_the_way_back_at_the_wrap():
    live = LiveTransforms(YAW, ("yaw",))
    _, _, state = live.apply(np.array([3.1]), np.array([True]), live.start())
    np.testing.assert_allclose(live.undo(np.array([[3.1], [3.2]]), state), [[3.1], [3.2 - TURN]])
    values, _, state = live.apply(np.array([-3.1]), np.array([True]), state)
    np.testing.assert_allclose(values, [TURN - 3.1])
    np.testing.assert_allclose(live.undo(values[None] + 0.1, state), [[-3.0]])
    np.testing.assert_allclose(live.undo(values[None] - 0.1, state), [[TURN - 3.2]])


def test_an_angle_that_never_wrapped_is_answered_beside_what_was_sent():
    live = LiveTransforms(Transforms({"yaw": Angle(TURN)}), ("yaw",))
    _, _, state = live.apply(np.array([3.1]), np.array([True]), live.start())
    np.testing.assert_allclose(live.undo(np.array([[3.2]]), state), [[3.2]])
    values, _, state = live.apply(np.array([-3.1]), np.array([True]), state)
    np.testing.assert_allclose(live.undo(values[None] + 0.1, state), [[-3.0]])


def test_signs_of_quaternions_change_nothing():
    four = spinning()
    flipped = four * np.where(np.arange(80) % 3 == 1, -1.0, 1.0)[:, None]
    one, other = (
        ATTITUDE.apply(dataset(list(rows.T), QUATERNION))[0].values for rows in (four, flipped)
    )
    np.testing.assert_array_equal(one, other)
    np.testing.assert_allclose(one, four, atol=1e-15)


def test_quaternions_come_back_with_length_1():
    given = dataset(list(spinning().T), QUATERNION)
    answers = dataset(list(1.3 * spinning().T), QUATERNION)
    back = ATTITUDE.undo(answers, given)[0].values
    np.testing.assert_allclose(np.linalg.norm(back, axis=1), 1.0, atol=1e-15)


def test_a_reader_records_its_angles_and_quaternions(tmp_path):
    stamps = np.arange(200) * 10**8
    true, yaw = turning(200)
    values = np.column_stack([yaw, 0.01 * true, wrap(true, 0.0) * 180 / math.pi, spinning(200)])
    signal = Signal(
        "", stamps, values, ("yaw", "still", "heading", *QUATERNION),
        ("rad", "rad", "deg", "", "", "", ""),
        ("angle", "angle", "angle", *("quaternion",) * 4),
    )  # fmt: skip
    read = assemble([Recording(signals=(signal,))])
    found = Transforms.of(read)
    assert found == Transforms(
        {
            "yaw": Angle(TURN, -math.pi),
            "still": Angle(TURN, None),  # it never jumped
            "heading": Angle(360.0, 0.0),
        },
        (QUATERNION,),
    )
    assert found.apply(read) is read
    ob.save(read, tmp_path / "log.parquet")
    stored = ob.load(tmp_path / "log.parquet")
    assert Transforms.of(stored) == found
    assert Transforms.of(stored.select(["still", "qw"])) == Transforms({"still": Angle(TURN)})
    np.testing.assert_allclose(read[0].values[:, 0], true, atol=1e-12)


def test_a_data_set_of_0_1_names_its_angles():
    log = {"angles": {"unwrap": True, "turns": {"yaw": 3}}, "quaternions": {"channels": []}}
    given = dataset([turning()[0]], ("yaw",), meta={"cleaning": log})
    assert Transforms.of(given) == Transforms({"yaw": Angle(TURN)})


def test_transforms_survive_json():
    assert Transforms.from_dict(json.loads(json.dumps(BOTH.to_dict()))) == BOTH
    for damaged in ({}, {"angles": {"a": {"period": "x"}}, "quaternions": []}, {"angles": 1}):
        with pytest.raises(ob.InputError):
            Transforms.from_dict(damaged)
    for wrong in ({"angles": {"a": Angle(1.0)}, "quaternions": (("a", "b", "c", "d"),)},
                  {"quaternions": (("a", "b"),)}):  # fmt: skip
        with pytest.raises(ob.InputError):
            Transforms(**wrong)
    with pytest.raises(ob.InputError):
        Angle(0.0)
