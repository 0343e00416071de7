"""Parts that differ from the training part are said to, and parts that do not are not."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import offbeat as ob
from offbeat.data.representative import differences

ROWS = 1500
TIMES = np.arange(ROWS) / 50


def part(*columns: np.ndarray, roles=()) -> ob.Dataset:
    values = np.column_stack(columns)
    names = ("x", "y", "z")[: len(columns)]
    return ob.Dataset((ob.Trajectory(TIMES, values, names=names, roles=roles),))


def wave(seed: int = 0, size: float = 1.0, offset: float = 0.0) -> np.ndarray:
    random = np.random.default_rng(seed)
    moving = np.sin(3 * TIMES + random.uniform(0, 6))
    return offset + size * moving + 0.01 * random.normal(size=ROWS)


@given(st.integers(0, 1000), st.floats(1e-6, 1e6), st.floats(-100, 100))
def test_parts_of_the_same_motion_differ_in_nothing(seed, scale, offset):
    parts = (part(scale * (wave(seed + i) + offset), scale * wave(seed + 7 + i)) for i in range(3))
    assert differences(*parts) == ()


@pytest.mark.parametrize(
    ("other", "said"),
    [
        ((wave(1, 0.0), wave(2, 0.0)), "the test part is at rest: x, y change less than a fifth"),
        ((wave(1), wave(2, 0.0)), "the test part is at rest: y changes"),
        ((wave(1, offset=2.0), wave(2)), "in the test part, x leaves the range of the training"),
        ((wave(1), 0.25 * wave(2) + 0.1), "in the test part, y varies less than a third"),
    ],
)
def test_a_difference_is_said_in_a_sentence_with_the_part_and_the_channels(other, said):
    (note,) = differences(part(wave(), wave(3)), part(wave(4), wave(5)), part(*other))
    assert note.startswith(said)


def test_a_part_that_moves_faster_within_the_same_range_is_said_to():
    slow, fast = np.sin(0.3 * TIMES), 0.9 * np.sin(3 * TIMES)
    (note,) = differences(part(slow, wave()), part(fast, wave(1)), part(slow, wave(2)))
    assert note.startswith("in the validation part, x changes more than 5 times as much")


def test_one_channel_of_three_at_rest_is_not_the_part_at_rest():
    train = part(wave(), wave(1), wave(2))
    (note,) = differences(train, train, part(wave(3), wave(4), 0 * TIMES))
    assert note.startswith("in the test part, z changes less than a fifth as much")


def test_what_is_not_predicted_or_hardly_known_is_not_compared():
    roles = ("state", "exogenous")
    train, other = part(wave(), wave(1), roles=roles), part(wave(2), 0 * TIMES, roles=roles)
    assert differences(train, train, other) == ()
    sparse = np.where(np.arange(ROWS) % 100 == 0, 50.0, np.nan)
    assert differences(part(wave(), wave(1)), part(wave(2), sparse), part(wave(3), sparse)) == ()
