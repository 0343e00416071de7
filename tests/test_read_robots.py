"""What holds for every reader of robots' logs: the same walk, whatever format it was logged in."""

from __future__ import annotations

import numpy as np
import pytest
import robot_logs as logs

from offbeat.data.readers import read

START = 1_700_000_000_123_456_000
RNG = np.random.default_rng(0)
STAMPS = START + 1000 * np.cumsum(RNG.integers(1, 30_000, 200))
VALUES = RNG.normal(size=(200, 2))


@pytest.fixture(params=sorted(logs.SAME_WALK))
def logged(request, tmp_path):
    """Writes the walk in a format, and reads it back."""

    def read_back(stamps=STAMPS, values=VALUES, **options):
        write = logs.SAME_WALK[request.param]
        path = write(tmp_path / f"log_{len(list(tmp_path.iterdir()))}", stamps, values)
        (trajectory,) = dataset = read(
            path, **logs.SAME_WALK_OPTIONS.get(request.param, {}), **options
        )
        return dataset, trajectory

    return read_back


def test_every_stamp_and_value_comes_back_to_the_bit(logged):
    dataset, trajectory = logged()
    assert trajectory.times.tobytes() == ((STAMPS - STAMPS[0]) / 1e9).tobytes()
    assert trajectory.values[:, :2].tobytes("C") == VALUES.tobytes("C")
    assert set(dataset.roles[2:]) <= {"action"}
    unit = {"ns": 1, "us": 1000}[dataset.meta["time_unit"]]
    assert dataset.meta["clock_start"] == [STAMPS[0] // unit]


def test_reading_twice_gives_the_same(logged):
    assert logged()[0].fingerprint() == logged()[0].fingerprint()


def test_a_shift_of_the_clock_changes_nothing_but_its_start(logged):
    assert logged(STAMPS + 86_400 * 10**9)[0].fingerprint() == logged()[0].fingerprint()


def test_late_and_repeated_stamps_are_cleaned_and_counted(logged):
    stamps = STAMPS.copy()
    stamps[[10, 11]] = stamps[[11, 10]]
    stamps[20] = stamps[19]
    dataset, trajectory = logged(stamps)
    assert trajectory.rows == 199
    assert dataset.meta["cleaning"]["order"]["late"] == 1
    assert dataset.meta["cleaning"]["duplicates"]["rows"] == 1


def test_a_missing_value_is_not_known(logged):
    values = VALUES.copy()
    values[5, 1] = np.nan
    _, trajectory = logged(values=values)
    assert np.argwhere(~trajectory.observed).tolist() == [[5, 1]]


def test_what_was_logged_can_be_resampled(logged):
    _, trajectory = logged(resample_hz=10.0)
    assert np.allclose(np.diff(trajectory.times), 0.1, rtol=1e-12)


def test_names_end_in_those_of_the_log(logged):
    _, trajectory = logged()
    assert [name[-4:].strip(".n[") for name in trajectory.names[:2]] in (
        ["hip", "knee"], ["s[0]", "s[1]"],
    )  # fmt: skip
