"""Scores: which values count, and how the three scorings are related."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

import offbeat as ob
from offbeat.data.batch import Batch
from offbeat.metrics import Scores, ScoreSums, last_value_predictions, row_0_constant, table


def trajectory(values, observed=None, times=None):
    values = np.asarray(values, dtype=float)
    times = np.arange(len(values)) * 0.1 if times is None else times
    return ob.Trajectory(times, values, None if observed is None else np.asarray(observed))


def scores_of(batch: Batch, predictions: torch.Tensor, **options: float) -> Scores:
    sums = ScoreSums(batch.channels, **options)
    sums.add(predictions, batch)
    return sums.scores()


def test_each_scoring_counts_the_values_it_names():
    # Channel 0 is seen from row 1 on, channel 1 from row 2 on; row 3 is hidden.
    values = [[1.0, 2.0], [3.0, 4.0], [5.0, 6.0], [7.0, 8.0]]
    observed = [[False, False], [True, False], [True, True], [False, False]]
    batch = Batch.of([trajectory(values, observed)], dtype=torch.float64)
    error = torch.tensor([[[1.0, 2.0], [3.0, 5.0], [7.0, 11.0], [13.0, 17.0]]])
    scores = scores_of(batch, batch.values + error)
    # honest: channel 0 at rows 2 and 3, channel 1 at row 3
    assert scores.after_first_observation.count == 3
    assert scores.after_first_observation.mse == pytest.approx((7**2 + 13**2 + 17**2) / 3)
    assert scores.after_first_observation.per_channel == pytest.approx(((7**2 + 13**2) / 2, 17**2))
    assert scores.masked.mse == pytest.approx((13**2 + 17**2) / 2)
    later = 3**2 + 5**2 + 7**2 + 11**2 + 13**2 + 17**2
    assert scores.after_first_row.mse == pytest.approx(later / 6)
    # published: row 0 is hidden, so its error is the value itself, whatever was predicted
    assert scores.published.mse == pytest.approx((later + 1**2 + 2**2) / 8)


def test_published_counts_no_error_at_an_observed_first_row():
    batch = Batch.of([trajectory([[3.0], [4.0]])], dtype=torch.float64)
    scores = scores_of(batch, torch.full((1, 2, 1), 9.0))
    assert scores.published.mse == pytest.approx((9 - 4) ** 2 / 2)


@given(st.integers(0, 10_000), st.integers(2, 30), st.integers(1, 6), st.floats(0.1, 1.0))
def test_published_is_rows_1_99_plus_the_constant_of_the_hidden_first_rows(seed, rows, n, share):
    random = np.random.default_rng(seed)
    trajectories = []
    for _ in range(n):
        seen = random.random(rows) < share
        observed = np.repeat(seen[:, None], 3, axis=1)
        trajectories.append(trajectory(random.normal(size=(rows, 3)), observed))
    batch = Batch.of(trajectories, dtype=torch.float64)
    scores = scores_of(batch, torch.from_numpy(random.normal(size=(n, rows, 3))))
    hidden = float((~batch.mask[:, 0, 0]).double().mean())
    constant = row_0_constant(batch) if hidden else 0.0
    expected = (1 - 1 / rows) * scores.after_first_row.mse + constant * hidden / rows
    assert scores.published.mse == pytest.approx(expected, rel=1e-12)


def test_values_that_are_not_known_and_padding_count_nowhere():
    long = trajectory([[1.0, np.nan], [2.0, 5.0], [3.0, 6.0]])
    short = trajectory([[1.0, 1.0], [2.0, 2.0]])
    batch = Batch.of([long, short], dtype=torch.float64)
    scores = scores_of(batch, torch.full((2, 3, 2), 1e3))
    assert scores.published.count == 5 + 4
    assert scores.after_first_row.count == 4 + 2
    assert (
        scores.after_first_observation.count == 2 + 1 + 2
    )  # channel 1 of the long one is first seen in row 1


def test_parts_add_up_to_the_whole():
    random = np.random.default_rng(0)
    trajectories = [
        trajectory(random.normal(size=(9, 2)), random.random((9, 2)) < 0.5) for _ in range(7)
    ]
    batch = Batch.of(trajectories, dtype=torch.float64)
    predictions = torch.from_numpy(random.normal(size=(7, 9, 2)))
    whole = scores_of(batch, predictions, gap_unit=0.1)
    sums = ScoreSums(2, gap_unit=0.1)
    for part in (slice(0, 3), slice(3, 7)):
        sums.add(predictions[part], batch.take(part))
    split = sums.scores()
    assert split.after_first_observation.mse == pytest.approx(
        whole.after_first_observation.mse, rel=1e-12
    )
    assert split.by_gap[0].score.count == whole.by_gap[0].score.count


def test_scores_by_gap_group_by_the_time_since_observation():
    # One channel, observed at row 0 only: 0.1 to 0.5 s since, groups up to 0.1, 0.2, 0.4, 0.8 s.
    observed = np.array([[True]] + [[False]] * 5)
    batch = Batch.of([trajectory(np.zeros((6, 1)), observed)], dtype=torch.float64)
    predictions = torch.arange(6.0, dtype=torch.float64).reshape(1, 6, 1)
    groups = scores_of(batch, predictions, gap_unit=0.1).by_gap
    assert [g.up_to for g in groups] == pytest.approx([0.1, 0.2, 0.4, 0.8])
    assert [g.above for g in groups] == pytest.approx([0.0, 0.1, 0.2, 0.4])
    assert [g.score.mse for g in groups] == pytest.approx([1, 4, (9 + 16) / 2, 25])
    assert sum(g.score.count for g in groups) == 5


def test_the_last_value_predictor_repeats_what_was_seen_and_starts_from_the_mean():
    values = [[1.0], [2.0], [3.0], [4.0]]
    observed = [[False], [True], [False], [True]]
    batch = Batch.of([trajectory(values, observed)])
    predictions = last_value_predictions(batch, torch.tensor([9.0]))
    assert predictions.flatten().tolist() == [9, 9, 2, 2]


def test_a_score_without_values_is_nan_and_null_in_json():
    batch = Batch.of([trajectory([[1.0], [2.0]], [[False], [False]])])
    scores = scores_of(batch, torch.zeros(1, 2, 1))
    assert math.isnan(scores.after_first_observation.mse)
    assert scores.to_dict()["after_first_observation"]["mse"] is None


def test_the_table_ranks_by_the_honest_score_and_shows_every_note():
    batch = Batch.of([trajectory([[1.0], [2.0], [3.0]])])
    good = scores_of(batch, batch.values + 0.1)
    bad = scores_of(batch, batch.values + 1.0)
    text = table({"bad": bad, "good": good}, notes={"good": "12 steps"})
    lines = text.splitlines()
    assert lines[1].startswith("good")
    assert lines[1].endswith("12 steps")
    assert "1.0000" in lines[2]
