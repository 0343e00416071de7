"""The usual time between rows, where sensors report almost at once."""

from __future__ import annotations

import numpy as np
import pytest
from model_helpers import dataset

import offbeat as ob
from offbeat.data.batch import Batch
from offbeat.data.gaps import fastest_step, usual_gap
from offbeat.data.plan import plan
from offbeat.data.shards import save_shards
from offbeat.models.statistics import Statistics

STEP, ROWS = 0.02, 400


def two_sensors(apart: float) -> ob.Dataset:
    """Two at 50 Hz, the second always so many seconds after the first."""
    first = STEP * np.arange(ROWS)
    times = np.sort(np.concatenate([first, first + apart]))
    wave = np.sin(times[:, None] * [2.0, 3.0])
    wave[1::2, 0] = wave[::2, 1] = np.nan
    return ob.Dataset((ob.Trajectory(times, wave, names=("a", "b")),))


def test_the_fastest_channel_is_that_of_the_smallest_median_step():
    times, of = np.array([0.0, 1, 2, 3, 0, 5]), np.array([0, 0, 0, 0, 1, 1])
    observed = np.array([[1, 1], [0, 1], [1, 0], [0, 1], [1, 1], [1, 0]], dtype=bool)
    assert fastest_step(times, of, observed) == 1.5  # steps 2 and 5, and 1 and 2
    assert fastest_step(times, of, np.zeros((6, 2), dtype=bool)) == 0.0
    assert usual_gap(0.06, 1.0) == 0.06
    assert usual_gap(0.04, 1.0) == 1.0
    assert usual_gap(0.04, 0.0) == 0.04


@pytest.mark.parametrize("apart", [1e-8, 1e-6, 5e-4])
def test_sensors_that_report_almost_at_once_have_the_step_of_one(apart, tmp_path):
    data = two_sensors(apart)
    assert Statistics.of(Batch.of(data)).median_gap == pytest.approx(STEP)
    assert ob.inspect(data).rate_hz == pytest.approx(1 / STEP)
    assert plan(data).typical_gap_s == pytest.approx(STEP)
    save_shards(iter(data), tmp_path)
    model = ob.make_model("gru", ob.Dataset.open(tmp_path, window=100), hidden_size=2)
    assert model.statistics.median_gap == pytest.approx(STEP)


def test_sensors_that_report_in_turns_have_the_step_between_them():
    for apart in (0.002, STEP / 2):
        gaps = Statistics.of(Batch.of(two_sensors(apart))).median_gap
        assert gaps == pytest.approx(min(apart, STEP - apart))


def test_one_sensor_has_its_median_gap_to_the_bit():
    data = dataset()
    gaps = np.sort(np.concatenate([np.diff(t.times) for t in data]))
    assert Statistics.of(Batch.of(data)).median_gap == gaps[(len(gaps) - 1) // 2]
