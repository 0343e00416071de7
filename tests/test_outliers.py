"""Values that are no measurements are found, and measurements that are far out are kept."""

from __future__ import annotations

import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import offbeat as ob
from offbeat.data.outliers import Outliers, find_outliers, mask_outliers, search

ROWS = 2000
TIMES = np.arange(ROWS) / 100


def smooth(seed: int = 0, low: float = -2.0, high: float = 2.0) -> np.ndarray:
    random = np.random.default_rng(seed)
    wave = sum(np.sin(TIMES * w + random.uniform(0, 6)) for w in (0.7, 2.3, 5.1)) / 3
    return low + (high - low) * (wave + 1) / 2 + 0.01 * (high - low) * random.normal(size=ROWS)


def dataset(values: np.ndarray, **options) -> ob.Dataset:
    return ob.Dataset((ob.Trajectory(TIMES[: len(values)], values[:, None], **options),))


def kinds(values: np.ndarray) -> list[tuple[str, float, int]]:
    return [(found.kind, found.value, found.count) for found in find_outliers(dataset(values))]


def placed(values: np.ndarray, value: float, rows) -> np.ndarray:
    values = values.copy()
    values[rows] = value
    return values


# --- no measurements ------------------------------------------------------------------------------

SENTINELS = [
    -999.0, 9999.0, -99999.0, 65535.0, 32767.0, -32768.0, 655.35, 214.7483647, 2147483647.0,
    1e30, -1e30, 3.4028234663852886e38, -1.7976931348623157e308, 1e10,
]  # fmt: skip


@pytest.mark.parametrize("value", SENTINELS)
@pytest.mark.parametrize("rows", [[700], [3, 50, 51, 52, 1999], list(range(400, 900))])
def test_a_sentinel_is_found_where_it_stands_alone_in_bursts_and_in_long_runs(value, rows):
    (found,) = search([placed(smooth(), value, rows)])
    assert (found.kind, found.value) == ("sentinel", value)
    assert np.flatnonzero(found.rows[0]).tolist() == rows


@pytest.mark.parametrize(
    "measured",
    [
        smooth(1, 1000, 2000),  # a pulse width
        smooth(1, 0, 30000),
        1e5 + smooth(1, -50, 50),  # a pressure
        np.round(smooth(1, 20, 22), 1),  # a slow sensor of 0.1 degrees
        np.random.default_rng(0).standard_cauchy(ROWS).clip(-400, 400),
    ],
)
def test_a_sentinel_is_found_beside_any_measurement(measured):
    for value in (65535.0, -999999.0, 1e30):
        rows = [10, 500]
        assert ("sentinel", value, 2) in kinds(placed(measured, value, rows))


def test_several_sentinels_and_a_spike_of_one_channel_are_all_found():
    values = placed(placed(placed(smooth(), -999.0, [5, 9]), 1e30, [77]), 65535.0, [500])
    values[1200] = 54321.7
    assert sorted(kinds(values)) == [
        ("sentinel", -999.0, 2),
        ("sentinel", 65535.0, 1),
        ("sentinel", 1e30, 1),
        ("spike", 54321.7, 1),
    ]


def test_a_constant_with_sentinels_stays_a_constant():
    data = mask_outliers(dataset(placed(np.full(ROWS, 5.0), -999.0, [3, 70, 900])))
    assert np.nanmax(data[0].values) == np.nanmin(data[0].values) == 5.0


def test_zeros_before_the_first_measurement_are_found_in_each_episode():
    first, second = smooth(2, 19, 22), smooth(3, 19, 22)
    data = ob.Dataset(
        (
            ob.Trajectory(TIMES, placed(first, 0.0, slice(0, 40))[:, None]),
            ob.Trajectory(TIMES, placed(second, 0.0, slice(0, 3))[:, None]),
        )
    )
    (found,) = find_outliers(data)
    assert (found.kind, found.count) == ("start", 43)
    masked = mask_outliers(data)
    assert [np.isnan(t.values[:, 0]).sum() for t in masked] == [40, 3]


@pytest.mark.parametrize("value", [1e5, -3e4, 1e12])
def test_a_spike_of_a_row_or_two_is_found(value):
    rows = [300, 301, 1500]
    (found,) = search([placed(smooth(), value * 1.0123, rows)])
    assert found.kind == "spike"
    assert np.flatnonzero(found.rows[0]).tolist() == rows


def test_masked_values_are_not_known_others_do_not_change_and_nothing_is_left_to_find():
    values = placed(smooth(), -999.0, [3, 70])
    data = dataset(values)
    masked = mask_outliers(data)
    assert np.flatnonzero(~masked[0].known[:, 0]).tolist() == [3, 70]
    assert np.array_equal(masked[0].observed, masked[0].known)
    kept = masked[0].known
    assert np.array_equal(masked[0].values[kept], data[0].values[kept])
    assert find_outliers(masked) == ()
    assert mask_outliers(masked) is masked
    (listed,) = masked.meta["outliers"]
    assert Outliers.from_dict(json.loads(json.dumps(listed))) == find_outliers(data)[0]


def test_the_record_says_which_value_how_often_and_where():
    values = placed(smooth(), -999.0, [3, 70, 71, 900])
    (found,) = find_outliers(dataset(values, names=("height",)))
    assert found.at == ((0, 0.03), (0, 0.7), (0, 0.71))
    assert str(found) == (
        "height: 4 values of -999, far from all others, mark missing values "
        "(at 0.03 s, 0.7 s, 0.71 s, ...)"
    )


# --- measurements ---------------------------------------------------------------------------------


def impacts(seed: int, *, size: float = 20.0, noise: float = 0.05) -> np.ndarray:
    """A force at rest and a few impacts of random height; each decays over a few rows."""
    random = np.random.default_rng(seed)
    values = noise * random.normal(size=ROWS)
    for start in random.integers(0, ROWS - 10, 6):
        decay = size * random.uniform(0.3, 1) * np.exp(-np.arange(8) / random.uniform(0.3, 2))
        values[start : start + 8] += decay
    return values


def one_row_taps(seed: int) -> np.ndarray:
    random = np.random.default_rng(seed)
    values = 0.05 * random.normal(size=ROWS)
    values[random.choice(ROWS, 5, replace=False)] = random.uniform(10, 25, 5)
    return values


def switch(levels, every: int) -> np.ndarray:
    return np.asarray(levels, float)[(np.arange(ROWS) // every) % len(levels)]


def switched(high: float, noise: float, seed: int = 0) -> np.ndarray:
    """A noisy channel that is at an exact stop for a third of the time."""
    values = noise * np.random.default_rng(seed).normal(size=ROWS)
    values[(np.arange(ROWS) // 150) % 3 == 2] = high
    return values


LEGITIMATE = {
    "smooth": smooth(),
    "impacts": impacts(0),
    "one-row taps": one_row_taps(0),
    "saturated impacts": impacts(1, size=80).clip(-16, 16),
    "contacts": switch([0, 1], 70),
    "a single contact": placed(np.zeros(ROWS), 1.0, [900]),
    "a gripper": switch([0, 0, 0, 850], 200),
    "bang-bang": switch([-32768, 0, 32767], 50),
    "full or none": switch([0, 65535], 80),
    "modes": switch([0, 1, 2, 3, 4, 99], 40),
    "a noisy stop": switched(1.0, 0.001),
    "a step": np.where(np.arange(ROWS) < 900, 0.0, 1000.0) + smooth(4, -1, 1),
    "a late step": np.where(np.arange(ROWS) < 1990, 0.0, 1000.0) + smooth(4, -1, 1),
    "a motor that is switched on": np.where(np.arange(ROWS) < 500, 0.0, smooth(5, 11, 13)),
    "a motor that pauses": np.where(np.arange(ROWS) % 500 < 50, 0.0, smooth(5, 11, 13)),
    "a take-off": np.maximum(0, np.minimum(TIMES - 1, 10.0)) + 0.01 * smooth(),
    "a counter": np.arange(ROWS, dtype=float),
    "a clock in ns": 1.7e18 + 1e7 * np.arange(ROWS),
    "a slow counter across 999": np.arange(ROWS, dtype=float) // 2 + 5,
    "huge offset": 4e9 + smooth(),
    "tiny": 1e-9 * smooth(),
    "tiny impacts": 1e-9 * impacts(2),
    "a reading whose highest value is 999": 37.0 * (np.arange(ROWS) % 28),
    "a heater that is switched on": np.where(np.arange(ROWS) < 60, 0.0, smooth(5, 11, 25)),
    "two taps": placed(0.05 * np.random.default_rng(8).normal(size=ROWS), 20.0, [300, 1500]),
    "a pulse of three rows": placed(smooth(), 5000.0, [500, 501, 502]),
    "a kick of a set point": placed(switch([1, 2, 3], 50), 50_000.0, [700]),
    "levels after a start at 0": np.where(np.arange(ROWS) < 60, 0.0, switch([30, 31, 32], 50)),
    "growth over 17 decades": np.exp(2 * TIMES),
    "a huge step": 1e13 * smooth() + np.where(np.arange(ROWS) < 1900, 0.0, 3e15),
    "constant": np.full(ROWS, 7.0),
    "constant 999": np.full(ROWS, 999.0),
    "never": np.full(ROWS, np.nan),
    "two rows": np.array([1.0, 999.0]),
    "growth": np.exp(TIMES),
    "log-normal": np.random.default_rng(6).lognormal(0, 2, ROWS),
    "student": np.random.default_rng(7).standard_t(2, ROWS),
    "a wrapped angle": (2 * TIMES + np.pi) % (2 * np.pi) - np.pi,
}


@pytest.mark.parametrize("name", LEGITIMATE)
def test_a_measurement_that_is_far_out_is_kept(name):
    data = dataset(LEGITIMATE[name])
    assert mask_outliers(data) is data, find_outliers(data)


@given(st.integers(0, 10_000), st.sampled_from(["impacts", "taps", "student", "log-normal"]))
def test_heavy_tails_are_kept_whatever_is_drawn(seed, shape):
    random = np.random.default_rng(seed)
    values = {
        "impacts": lambda: impacts(seed, size=float(10 ** random.uniform(0, 3))),
        "taps": lambda: one_row_taps(seed),
        "student": lambda: random.standard_t(2, ROWS),
        "log-normal": lambda: random.lognormal(0, 2, ROWS),
    }[shape]()
    assert not [found for found in search([values]) if found.kind != "suspect"]


@given(st.integers(0, 10_000))
def test_offset_and_scale_do_not_change_what_counts_as_a_spike(seed):
    random = np.random.default_rng(seed)
    values = placed(smooth(seed), 12345.6, [random.integers(1, ROWS)])
    (found,) = search([values])
    scale, offset = 10.0 ** random.uniform(-6, 6), random.normal()
    (moved,) = search([scale * (values + offset)])
    assert found.kind == moved.kind == "spike"
    assert np.array_equal(found.rows[0], moved.rows[0])


def test_the_largest_floats_are_compared_without_overflow():
    assert search([np.array([1.797e308, -1.797e308, 3.0, -1e292])]) == []


def test_what_is_not_certain_is_reported_and_kept():
    values = placed(smooth(), -100.0, [3, 50, 51, 1200])
    (found,) = find_outliers(dataset(values))
    assert (found.kind, found.value, found.masked) == ("suspect", -100.0, False)
    assert "they are kept" in str(found)


def test_an_action_is_never_masked():
    data = dataset(placed(smooth(), -999.0, [3]), roles=("action",))
    assert find_outliers(data) == ()


# --- while reading --------------------------------------------------------------------------------


@pytest.fixture
def log(tmp_path):
    """An angle, a height and a temperature, with -999, 65535, 1e30 and zeros at the start."""
    angle = (2 * TIMES + np.pi) % (2 * np.pi) - np.pi
    values = [
        placed(angle, -999.0, [100, 101, 900]),
        placed(placed(smooth(), 65535.0, [5]), 1e30, [44]),
        placed(smooth(2, 19, 22), 0.0, slice(0, 10)),
    ]
    table = np.column_stack([TIMES, *values])
    path = tmp_path / "log.csv"
    head = "time,yaw [rad],height [m],temp"
    np.savetxt(path, table, delimiter=",", header=head, comments="", fmt="%.9g")
    return path


def test_a_reader_reports_outliers_and_masks_them_if_asked(log):
    kept, masked = ob.read(log), ob.read(log, outliers="mask")
    assert kept[0].known.all()
    assert (~masked[0].known).sum(axis=0).tolist() == [3, 2, 10]
    for data, option in ((kept, "keep"), (masked, "mask")):
        entry = data.meta["cleaning"]["outliers"]
        assert entry["option"] == option
        assert [(o["name"], o["kind"]) for o in entry["found"]] == [
            ("yaw", "sentinel"),
            ("height", "sentinel"),
            ("height", "sentinel"),
            ("temp", "start"),
        ]
    said = " ".join(ob.inspect(kept).found)
    assert "15 values of yaw, height, temp are no measurements; they were kept" in said
    assert "they are missing now" in " ".join(ob.inspect(masked).found)


def test_an_angle_is_unwrapped_after_its_sentinels_are_masked(log):
    data = ob.read(log, outliers="mask", angles=["yaw"])
    yaw = data[0].values[:, 0]
    np.testing.assert_allclose(yaw, np.where(np.isnan(yaw), np.nan, 2 * TIMES), atol=1e-6)
    # Without, each -999 counts as turns.
    assert np.abs(ob.read(log, angles=["yaw"])[0].values[:, 0] - 2 * TIMES).max() > 1


def test_a_wrong_choice_is_refused(log):
    with pytest.raises(ob.InputError, match="unknown outliers 'drop'"):
        ob.read(log, outliers="drop")
