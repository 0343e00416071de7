"""The blend: weights with closed forms, intervals that cover, and answers that lose to nobody."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

import offbeat as ob
from offbeat.answers.blend import Asked, fit_blend, tables_of
from offbeat.answers.both_sides import SideMotion, Sides
from offbeat.answers.intervals import LEVELS, crps, fit_half_widths, half_width
from offbeat.answers.scoring import prepared, score_one_step
from offbeat.baselines.history import AgeBins, filled_bins
from offbeat.baselines.local_scale import LocalScale
from offbeat.baselines.stack import LEVELS as MOTIONS
from offbeat.baselines.stack import Keys, Stack, kinds_of
from offbeat.baselines.weights import (
    CAUTION,
    POOLED,
    Errors,
    as_if_refitted,
    gate,
    on_simplex,
    simplex_weights,
    task_weights,
)
from offbeat.data.masking import masked_values
from offbeat.data.tasks import TaskConfig, draw_tasks
from offbeat.evaluation import evaluate_blend


def waves(seed: int, count: int = 8, rows: int = 200, noise: float = 0.02) -> ob.Dataset:
    """Sines of two channels with noise, and a channel of noise alone, at uneven times."""
    random = np.random.default_rng(seed)
    made = []
    for _ in range(count):
        times = np.cumsum(random.uniform(0.008, 0.012, rows))
        phase = random.uniform(0, 6)
        values = np.stack(
            [np.sin(6 * times + phase), 3 * np.cos(6 * times + phase), 0 * times], axis=1
        )
        values += random.normal(0, [noise, 3 * noise, 1.0], values.shape)
        made.append(ob.Trajectory(times, values))
    return ob.Dataset(tuple(made))


def errors_from(truth, predictions, *, key=None, channel=None, count=1e9) -> Errors:
    many = len(truth)
    zeros = np.zeros(many, dtype=np.int64)
    return Errors(
        zeros if key is None else key,
        zeros if channel is None else channel,
        np.arange(many),
        np.asarray(truth, dtype=float),
        np.asarray(predictions, dtype=float),
        np.array([count]),
    )


def test_independent_errors_are_weighted_by_their_inverse_variance():
    weights = on_simplex(np.diag([1.0, 4.0, 4.0]))
    assert weights == pytest.approx([4 / 6, 1 / 6, 1 / 6], abs=1e-6)


def test_a_predictor_that_another_one_contains_gets_no_weight():
    # errors e and e + f: the second adds noise only
    assert on_simplex(np.array([[1.0, 1.0], [1.0, 3.0]])) == pytest.approx([1, 0], abs=1e-6)


def test_selection_draws_the_weights_to_the_best_predictor():
    # (1 - s) (w^2 + 4 (1 - w)^2) + s (w + 4 (1 - w)) is least at
    # w = (8 (1 - s) + 3 s) / (10 (1 - s))
    gram = np.diag([1.0, 4.0])
    assert on_simplex(gram, 0.2) == pytest.approx([7 / 8, 1 / 8], abs=1e-6)
    assert on_simplex(gram, 0.5) == pytest.approx([1, 0], abs=1e-6)
    many = on_simplex(np.full((3, 3), 0.5) + 0.5 * np.eye(3), 0.8)
    assert many == pytest.approx([1 / 3, 1 / 3, 1 / 3], abs=1e-6), "equal ones are averaged"


def test_one_large_motion_decides_only_where_there_are_many_like_it():
    # At rest for 19 of 20 tasks, where the first one is ten times better; then a large motion.
    usual, large = np.array([0.1, 1.0]), np.array([20.0, 2.0])
    missed = np.vstack([np.tile(usual, (19, 1)), large])
    few = simplex_weights(errors_from(np.zeros(20), missed, count=5.0), 1)
    many = simplex_weights(errors_from(np.zeros(20), missed, count=1e6), 1)
    assert few[0, 0, 0] > 0.95
    assert many[0, 0, 1] > 0.95


def test_weights_in_other_units_are_the_same():
    random = np.random.default_rng(0)
    truth = random.normal(0, 1, 40)
    predictions = truth[:, None] + random.normal(0, [1, 2, 3], (40, 3))
    first, again = (
        simplex_weights(errors_from(unit * truth, unit * predictions, count=30.0), 1)
        for unit in (1.0, 0.1)
    )
    assert again == pytest.approx(first, abs=1e-5)


def test_a_task_counts_once_however_many_values_it_has():
    zeros = np.zeros(5, dtype=np.int64)
    errors = Errors(
        zeros, zeros, np.array([0, 0, 0, 0, 1]), np.zeros(5), np.zeros((5, 1)), np.array([9.0])
    )
    weight, effective = task_weights(errors, 1)
    assert weight.tolist() == [0.25] * 4 + [1.0]
    assert effective.tolist() == [[2.0]]


def test_no_more_tasks_count_than_fit_into_the_data():
    errors = errors_from(np.zeros(100), np.zeros((100, 1)), count=5.0)
    weight, effective = task_weights(errors, 1)
    assert effective.tolist() == [[5.0]]
    assert weight.sum() == pytest.approx(5.0)


def test_weights_of_many_tasks_are_those_of_least_squares():
    random = np.random.default_rng(0)
    truth = random.normal(0, 3, 20000)
    predictions = np.stack(
        [truth + random.normal(0, 1, 20000), truth + random.normal(0, 2, 20000)], axis=1
    )
    weights = simplex_weights(errors_from(truth, predictions), 1)
    assert weights[0, 0] == pytest.approx([0.8, 0.2], abs=0.02)


def test_gamma_is_the_least_squares_factor():
    random = np.random.default_rng(0)
    base, said = np.zeros(20000), random.normal(0, 1, 20000)
    truth = 0.4 * said + random.normal(0, 0.1, 20000)
    errors = errors_from(truth, base[:, None])
    assert gate(errors, base, said, 1)[0, 0] == pytest.approx(0.4, abs=0.01)
    assert gate(errors, base, -said, 1)[0, 0] == 0
    few = errors_from(truth[:3], base[:3, None])
    assert gate(few, base[:3], said[:3], 1)[0, 0] < 0.4


def test_gamma_is_smaller_where_it_differs_between_stretches_of_the_data():
    """The model is right by half in all of four stretches, or by 1, 1, 0 and 0."""
    random = np.random.default_rng(0)
    model = random.choice([-1.0, 1.0], 4000)
    cluster = np.repeat(np.arange(4), 1000)
    base = np.zeros(4000)

    def gamma(right, cluster):
        errors = replace(errors_from(right * model, base[:, None]), cluster=cluster)
        return gate(errors, base, model, 1)[0, 0]

    half = np.full(4000, 0.5)
    differs = np.where(cluster < 2, 1.0, 0.0)
    assert gamma(half, None) == pytest.approx(0.5, abs=2e-3)
    assert gamma(half, cluster) == pytest.approx(gamma(half, None))
    assert gamma(differs, None) == pytest.approx(0.5, abs=2e-3)
    # Sums of a stretch miss by 1000 / 2; sqrt(4 * 500^2) / 4000 * sqrt(4 / 3)
    error = 0.25 * np.sqrt(4 / 3)
    assert gamma(differs, cluster) == pytest.approx(gamma(differs, None) - error)
    assert gamma(half, 0 * cluster) == 0.0, "one stretch says nothing about the next"


def test_a_model_that_is_right_about_a_large_motion_is_not_used_at_rest():
    # It misses by 10 where the base misses by 1, and once it is right and the base misses by 200.
    base, model = np.zeros(40), np.tile([11.0, -9.0], 20)
    truth = np.ones(40)
    truth[7] = model[7] = 200.0
    few, many = (
        gate(errors_from(truth, base[:, None], count=count), base, model, 1)[0, 0]
        for count in (30.0, 1e6)
    )
    assert few < 0.05
    # At rest 49 / 3959, and 400 / 400 with a weight of (20 / 200)^2; drawn to 0 by 2 of 40.
    pooled = 449 / 4359 * 40 / 42
    typical = 4359 / 40
    expected = (449 + POOLED * pooled * typical) / (4359 + (POOLED + CAUTION) * typical)
    assert many == pytest.approx(expected, abs=1e-4)


def test_gamma_of_a_channel_that_is_well_predicted_does_not_come_from_another_one():
    random = np.random.default_rng(0)
    said = random.normal(0, 1, (2, 6))
    truth = np.stack([said[0], 1e-3 * random.normal(0, 1, 6)])  # the model is right, and wrong
    channel = np.repeat([0, 1], 6)
    errors = errors_from(truth.ravel(), np.zeros((12, 1)), channel=channel)
    gamma = gate(errors, np.zeros(12), said.ravel(), 2)[0]
    assert gamma[0] > 0.4
    assert gamma[1] < 3e-3


def test_half_widths_are_quantiles_of_absolute_errors():
    random = np.random.default_rng(0)
    truth = random.normal(0, 1, 50000)
    widths = fit_half_widths(errors_from(truth, np.zeros((50000, 1))), np.zeros(50000), 1)
    # quantiles of the half-normal distribution
    assert half_width(widths.table[0, 0], 0.5) == pytest.approx(0.6745, abs=0.02)
    assert half_width(widths.table[0, 0], 0.9) == pytest.approx(1.6449, abs=0.03)
    assert half_width(widths.table[0, 0], 0.95) == pytest.approx(1.96, abs=0.03)


def test_with_few_values_the_intervals_are_wider():
    truth = np.linspace(-1, 1, 9)
    few = fit_half_widths(errors_from(truth, np.zeros((9, 1)), count=9.0), np.zeros(9), 1)
    assert half_width(few.table[0, 0], 0.9) == pytest.approx(1.0)


def test_crps_of_a_gaussian_is_its_closed_form():
    # quantiles of N(0, 1); CRPS(y) = y (2 Phi(y) - 1) + 2 phi(y) - 1 / sqrt(pi)
    from scipy.stats import norm

    widths = norm.ppf((1 + LEVELS) / 2)
    for y in (0.0, 0.3, -1.2, 2.5):
        exact = y * (2 * norm.cdf(y) - 1) + 2 * norm.pdf(y) - 1 / math.sqrt(math.pi)
        assert crps(widths, np.array(y)) == pytest.approx(exact, rel=0.03)


def test_models_that_continue_straight_are_joined_to_the_cubic_hermite_interpolation():
    times = np.array([0.0, 0.3, 0.5, 1.1, 1.9, 2.0])
    cubic = np.polynomial.Polynomial([1.0, -2.0, 0.7, 3.0])
    seen = np.array([True, False, False, False, False, True])
    t = ob.Trajectory(times, cubic(times)[:, None], observed=seen[:, None])
    slope = cubic.deriv()
    forward = cubic(0.0) + slope(0.0) * times
    backward = cubic(2.0) + slope(2.0) * (times - 2.0)
    joined = Sides.of(t).joined(t.values, forward[:, None], backward[:, None])
    assert joined[1:5, 0] == pytest.approx(cubic(times[1:5]))


@pytest.fixture(scope="module")
def blend():
    config = TaskConfig(horizon_s=0.3, gap_s=0.01)
    members = ["last_value", "mean", "constant_velocity", "damped_slope", "kalman_short"]
    return fit_blend(waves(0), waves(1, 4), tasks=config, causal=members, two_sided=["pchip"])


def counted(t: ob.Trajectory) -> np.ndarray:
    """Masked values after the first observation of their channel."""
    return masked_values(t) & np.logical_or.accumulate(t.observed, axis=0)


def test_answers_lose_to_no_baseline(blend):
    test = draw_tasks(waves(2, 10), blend.tasks, 300, seed=5)
    answers = [a.values for a in blend.causal(test)]
    each = {name: m.predict(test) for name, m in blend.stack.members.items()}
    for channel in range(3):
        rmse = {}
        for name, predicted in {**each, "blend": answers}.items():
            missed = [
                (p - t.values)[counted(t)[:, channel], channel]
                for p, t in zip(predicted, test, strict=True)
            ]
            rmse[name] = np.sqrt(np.mean(np.concatenate(missed) ** 2))
        assert rmse["blend"] <= 1.02 * min(rmse.values())


@pytest.mark.parametrize("level", [0.5, 0.8, 0.95])
def test_intervals_cover(blend, level):
    test = draw_tasks(waves(2, 20), blend.tasks, 400, seed=5)
    inside = []
    for answer, t in zip(blend.causal(test), test, strict=True):
        low, high = answer.interval(level)
        inside.append(((low <= t.values) & (t.values <= high))[masked_values(t)])
    assert np.concatenate(inside).mean() == pytest.approx(level, abs=0.04)


def test_an_evaluation_asks_each_baseline_once_about_a_data_set(blend, monkeypatch):
    asked = Counter()

    def counting(name, predict):
        def counted(dataset):
            asked[name] += 1
            return predict(dataset)

        return counted

    for name, member in (*blend.stack.members.items(), *blend.both.members.items()):
        monkeypatch.setattr(member, "predict", counting(name, member.predict))
    evaluate_blend(blend, waves(2, 3), horizons=[0.1])
    # One step ahead, fills and a forecast; only fills use both sides.
    assert asked == dict.fromkeys(blend.stack.members, 3) | dict.fromkeys(blend.both.members, 1)


def test_answers_to_other_data_are_not_scored(blend):
    asked = Asked(blend, prepared(blend, waves(2, 3)))
    assert score_one_step(blend, waves(2, 3), asked=asked) == score_one_step(blend, waves(2, 3))
    for other in (waves(2, 2), waves(3, 3)):
        with pytest.raises(ob.InputError, match="other data"):
            score_one_step(blend, other, asked=asked)


def test_intervals_grow_with_the_time_since_observation(blend):
    t = waves(3, 1)[0]
    observed = np.ones_like(t.observed)
    observed[100:] = False
    answer = blend.causal(ob.Dataset((ob.Trajectory(t.times, t.values, observed=observed),)))[0]
    half = answer.half_width(0.9)[:, 0]
    assert half[125] > 2 * half[100]


def test_few_validation_data_are_named(blend):
    members = {"causal": ["last_value"], "two_sided": ["linear"]}
    config = TaskConfig(horizon_s=0.3, gap_s=0.01)
    short = fit_blend(waves(0), waves(1, 1), tasks=config, **members)  # 2 s to validate on
    assert short.widths.count.max() > 20  # enough just after an observation
    (note,) = short.notes()
    assert "need 20 independent spans" in note
    long = fit_blend(waves(0), waves(1, 12), tasks=replace(config, horizon_s=0.1), **members)
    assert long.notes() == ()


def test_asked_times_change_no_other_answer(blend):
    t = waves(3, 1)[0]
    observed = np.ones_like(t.observed)
    observed[100:] = False
    whole = ob.Trajectory(t.times, t.values, observed=observed)
    last = ob.Trajectory(
        np.append(t.times[:100], t.times[150]),
        np.vstack([t.values[:100], t.values[150:151]]),
        observed=np.vstack([observed[:100], observed[150:151]]),
    )
    many = blend.causal(ob.Dataset((whole,)))[0].values
    one = blend.causal(ob.Dataset((last,)))[0].values
    assert np.array_equal(one[-1], many[150])


def test_what_is_saved_answers_the_same(blend):
    again = replace(blend, **tables_of(blend.arrays()))
    test = draw_tasks(waves(2, 4), blend.tasks, 20, seed=5)
    for ask in ("causal", "fill"):
        for a, b in zip(getattr(blend, ask)(test), getattr(again, ask)(test), strict=True):
            assert np.array_equal(a.values, b.values)
            assert np.array_equal(a.half_width(), b.half_width())


def test_answers_stay_in_the_range_of_training_and_say_where_they_are_beyond(blend):
    t = waves(3, 1)[0]
    observed = np.ones_like(t.observed)
    observed[60:] = False
    late = ob.Trajectory(
        np.where(np.arange(200) < 60, t.times, t.times + 100.0), t.values, observed=observed
    )
    answer = blend.causal(ob.Dataset((late,)))[0]
    assert answer.beyond[60:].all()
    assert not answer.beyond[10:60, 0].any()
    assert np.abs(answer.values[:, 0]).max() < 2.2


def test_bins_of_lengths_end_at_the_longest():
    edges = AgeBins.of_lengths(0.01, 0.12, 0.2).edges
    assert edges.tolist() == pytest.approx([0.0153, 0.0306, 0.0612, 0.2])


def test_a_channel_that_left_the_range_of_training_is_not_expected_back(blend):
    """With half of the weight on the mean, and the channel far from it."""
    names = list(blend.stack.members)
    weights = np.zeros_like(blend.stack.weights)
    weights[..., names.index("last_value")] = weights[..., names.index("mean")] = 0.5
    stack = Stack().restore({**blend.stack.arrays(), "weights": weights})
    t = waves(3, 1)[0]
    for shift, drawn in ((0.0, 0.5), (100.0, 0.0)):
        values = t.values + shift * stack.scale
        (found,) = stack.predict(ob.Dataset((replace(t, values=values),)))
        expected = values[:-1] + drawn * (stack.mean - values[:-1])
        assert found[1:, :2] == pytest.approx(expected[:, :2])


def test_a_single_wild_value_does_not_look_like_motion_for_long(blend):
    t = waves(3, 1)[0]
    values = t.values.copy()
    values[60] += 1000.0
    keys, rows = blend.stack.keys, np.arange(200)
    (usual,), (wild,) = (
        kinds_of(keys, ob.Dataset((ob.Trajectory(t.times, v),))) for v in (t.values, values)
    )
    assert np.array_equal(wild[:61], usual[:61])
    assert (wild[62, :, 1] > 5).all(), "it is seen"
    assert (wild[rows > 110, :, 1] < 2 * usual[rows > 110, :, 1]).all()


def rests_and_moves(seed: int, count: int, moving: float) -> ob.Dataset:
    """White noise of 1e-3, and of 1 in a part of the trajectories, which move all the time."""
    random = np.random.default_rng(seed)
    size = np.where(np.arange(count) < moving * count, 1.0, 1e-3)
    times = 0.01 * np.arange(60)
    return ob.Dataset(tuple(ob.Trajectory(times, random.normal(0, s, (60, 1))) for s in size))


@pytest.mark.parametrize(("moving", "level"), [(0.2, 0), (0.8, MOTIONS - 1)])
def test_a_trajectory_starts_as_most_of_training_is(moving, level):
    keys = Keys(AgeBins(np.array([0.02, 0.3])), LocalScale().fit(rests_and_moves(0, 40, moving)))
    kind = kinds_of(keys, rests_and_moves(1, 1, moving=0.0))[0][:, 0]
    # No error is measured before the third observation.
    assert kind[1, 0] % MOTIONS == kind[2, 0] % MOTIONS == level
    assert kind[40, 0] % MOTIONS == 0


def test_the_first_values_of_a_task_teach_about_the_motion_that_follows():
    data = rests_and_moves(0, 40, moving=0.2)
    keys = Keys(AgeBins(np.array([0.02, 0.3])), LocalScale().fit(data))
    found, asked = keys.cells(data, afterwards=True), keys.cells(data)
    assert np.array_equal(found.row, asked.row)
    first = (found.row == 1) | (found.row == 2)
    moves = found.task < 8
    assert (found.key[first & moves] % MOTIONS == MOTIONS - 1).all()
    assert (found.key[first & ~moves] % MOTIONS == 0).all()
    assert (asked.key[first] % MOTIONS == 0).all(), "beforehand, all seem to rest"


def test_blends_saved_before_the_start_was_measured_start_at_the_usual_motion(blend):
    old = blend.stack.keys.local.arrays()
    assert (old.pop("median") < 1).all()
    local = LocalScale().restore(old)
    assert np.array_equal(local.start(np.zeros((2, 3)))["square"], np.ones((2, 3)))


# --- with models ----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def with_models(blend):
    train, validation = waves(0), waves(1, 4)
    model = ob.make_model("gru", train, seed=0)
    backward = ob.make_model("gru", train, seed=1)
    members = {"causal": list(blend.stack.members), "two_sided": ["linear", "pchip"]}
    return fit_blend(train, validation, model, backward, tasks=blend.tasks, **members)


def largest_steps(values: np.ndarray, spread: np.ndarray) -> np.ndarray:
    """Per channel, the largest difference of neighbouring rows, in units of its spread."""
    return np.abs(np.diff(values, axis=0)).max(axis=0) / spread


def test_forecasts_and_intervals_do_not_jump_in_the_asked_time(with_models):
    """Ten times closer, neighbours differ ten times less; at a jump they would differ as before."""
    ridge = fit_blend(
        waves(0), waves(1, 4), tasks=with_models.tasks, causal=["ridge", "damped_slope"], count=40
    )
    t = waves(3, 1)[0]
    observed = np.ones((200, 3), dtype=bool)
    observed[180:, 0], observed[190:, 1] = False, False
    log = ob.Dataset((replace(t, observed=observed),))
    longest = 1.5 * with_models.stack.keys.bins.edges[-1]
    for blend in (with_models, ridge):
        steps = []
        for count in (100, 1000):
            found = ob.forecast(blend, log, np.linspace(1e-4, longest, count))[0]
            each = np.concatenate([found.values, found.half_width(0.9)], axis=1)
            steps.append(largest_steps(each, np.tile(blend.stack.scale, 2)))
        assert (steps[0] > 1e-6).sum() >= 5, "they move"
        assert (steps[1] <= 0.2 * steps[0] + 1e-9).all()


def test_fills_and_intervals_do_not_jump_inside_a_gap(with_models):
    t = waves(4, 1)[0]
    steps = []
    for count in (50, 500):
        asked = np.linspace(t.times[90], t.times[115], count)[1:-1]
        times = np.concatenate([t.times[:91], asked, t.times[115:]])
        gap = np.full((count - 2, 3), np.nan)
        values = np.concatenate([t.values[:91], gap, t.values[115:]])
        found = with_models.fill(ob.Dataset((ob.Trajectory(times, values),)))[0]
        inside = slice(91, 91 + len(asked))
        each = np.concatenate([found.values[inside], found.half_width(0.9)[inside]], axis=1)
        steps.append(largest_steps(each, np.tile(with_models.stack.scale, 2)))
    assert (steps[0] > 1e-6).all(), "they move"
    assert (steps[1] <= 0.2 * steps[0]).all()


def test_a_model_with_nothing_to_say_changes_little(with_models):
    # The third channel is noise, and before the first observation nobody knows more.
    assert with_models.gamma[:-1, :2].max() < 0.3


def test_a_saved_blend_answers_the_same(with_models, tmp_path):
    from offbeat.answers.saved import load_blend, load_run, save_blend

    save_blend(with_models, tmp_path / "run")
    again = load_run(tmp_path / "run")
    data = ob.mask_out(waves(4, 2), 0.5, mask="bursts", burst_rows=10)
    for ask in (
        lambda b: ob.predict(b, data, times=[0.5, 0.7]),
        lambda b: ob.forecast(b, data, [0.1, 0.2]),
        lambda b: ob.impute(b, data),
        lambda b: ob.impute(b, data, mode="causal"),
    ):
        for a, b in zip(ask(with_models), ask(again), strict=True):
            assert np.array_equal(a.values, b.values)
            assert np.array_equal(a.interval(0.8)[0], b.interval(0.8)[0])
    (tmp_path / "run" / "blend.safetensors").write_bytes(b"x")
    with pytest.raises(ob.FileFormatError, match="damaged"):
        load_blend(tmp_path / "run")


def test_a_blend_of_another_model_is_refused(with_models, tmp_path):
    from offbeat.answers.saved import load_blend, save_blend

    save_blend(with_models, tmp_path / "run")
    ob.make_model("gru", waves(0), seed=5).save(tmp_path / "run" / "model")
    with pytest.raises(ob.FileFormatError, match="another forward model"):
        load_blend(tmp_path / "run")


def test_a_fill_keeps_what_was_observed(with_models):
    data = ob.mask_out(waves(4, 2), 0.5, mask="bursts", burst_rows=10)
    for given, filled in zip(data, ob.impute(with_models, data), strict=True):
        seen = given.observed
        assert np.array_equal(filled.values[seen], given.values[seen])
        assert (filled.half_width(0.9)[seen] == 0).all()
        assert (filled.half_width(0.9)[~seen] > 0).all()
        assert np.array_equal(filled.observed, seen)


def test_the_answer_of_a_model_alone_has_no_intervals(with_models):
    answer = ob.predict(with_models.forward, waves(4, 1))[0]
    with pytest.raises(ob.InputError, match="no intervals"):
        answer.interval()


# --- streams --------------------------------------------------------------------------------------


def test_a_stream_of_a_blend_is_the_batch(with_models):
    (t,) = waves(5, 1)
    observed = np.random.default_rng(0).random(t.values.shape) < 0.7
    given = ob.Trajectory(t.times, t.values, observed=observed)
    batch = ob.predict(with_models, given)[0]
    stream = ob.Stream(with_models)
    for row in range(60):
        if row:
            low, high = stream.interval(t.times[row], 0.8)
            predicted = stream.predict(t.times[row])
            assert predicted == pytest.approx(batch.values[row], rel=1e-5, abs=1e-6)
            assert high - low == pytest.approx(2 * batch.half_width(0.8)[row], rel=1e-5)
        stream.observe(t.times[row], np.where(observed[row], t.values[row], np.nan))


def test_the_state_of_a_stream_of_a_blend_is_restored_bit_for_bit(with_models):
    (t,) = waves(5, 1)
    one, other = ob.Stream(with_models), ob.Stream(with_models)
    for row in range(30):
        one.observe(t.times[row], t.values[row])
    other.restore(one.state())
    at = t.times[29] + 0.05
    assert np.array_equal(one.predict(at), other.predict(at))
    assert np.array_equal(one.interval(at)[0], other.interval(at)[0])


def test_a_stream_of_baselines_alone_reorders_late_messages(blend):
    (t,) = waves(5, 1)
    one = ob.Stream(blend, late="reorder")
    other = ob.Stream(blend, late="reorder")
    for row in range(20):
        one.observe(t.times[row], t.values[row])
    order = [*range(10), 11, 10, *range(12, 20)]
    for row in order:
        other.observe(t.times[row], t.values[row])
    assert np.array_equal(one.predict(t.times[20]), other.predict(t.times[20]))


def test_a_wild_value_leaves_no_trace_that_grows(with_models):
    (t,) = waves(5, 1)
    stream = ob.Stream(with_models)
    for row in range(150):
        stream.observe(t.times[row], t.values[row] if row != 20 else [1e30, -1e30, 1e200])
    assert np.abs(stream.predict(t.times[150])[:2] - t.values[150, :2]).max() < 1.0


def test_a_motion_that_leaves_the_range_of_training_is_followed():
    """A heading that turns at a constant rate: unwrapped, it grows without end."""

    def turning(start: float) -> ob.Dataset:
        times = 0.02 * np.arange(400)
        return ob.Dataset((ob.Trajectory(times, (start + 2.0 * times)[:, None]),))

    members = {"causal": ["last_value", "constant_velocity"], "two_sided": ["linear"]}
    config = TaskConfig(horizon_s=0.5, gap_s=0.02)
    blend = fit_blend(turning(0.0), turning(1.0), tasks=config, **members)
    later = turning(100.0)
    ahead = ob.forecast(blend, later, 0.4)[0]
    assert ahead.values[0, 0] == pytest.approx(later[0].values[-1, 0] + 0.8, abs=0.05)


def test_cross_validated_errors_are_made_as_small_as_those_of_the_final_fit():
    random = np.random.default_rng(0)
    truth = random.normal(size=4000)
    noise = random.normal(size=(4000, 2))
    cross = errors_from(truth, truth[:, None] + noise * [1.0, 2.0])
    other = errors_from(truth, truth[:, None] + noise[::-1] * [1.0, 1.0])
    better = as_if_refitted(cross, other, np.array([False, True]), 1)
    missed = better.predictions - truth[:, None]
    assert missed.std(axis=0) == pytest.approx([1.0, 1.0], rel=0.05)


# --- between the measurements of a slow sensor ----------------------------------------------------


@pytest.fixture(scope="module")
def two_rates():
    """A walk at 100 Hz, and one with three times its steps that is measured in each tenth row.

    The truth of every row, and a blend that was fitted to the measurements alone.
    """
    random = np.random.default_rng(5)
    times = 0.01 * np.arange(1200)
    truth, logs = [], []
    for _ in range(6):
        values = np.cumsum(random.normal(0, [0.1, 0.3], (1200, 2)), axis=0)
        values -= 0.02 * np.cumsum(values, axis=0) / 10
        truth.append(values)
        shown = values.copy()
        shown[np.arange(1200) % 10 > 0, 1] = np.nan
        logs.append(ob.Trajectory(times, shown, names=("fast", "slow")))
    task = TaskConfig(0.5, 0.01, 3.0, (("fast",), ("slow",)))
    blend = fit_blend(
        ob.Dataset(tuple(logs[:3])),
        ob.Dataset(tuple(logs[3:5])),
        tasks=task,
        causal=("last_value", "damped_slope"),
        two_sided=("linear", "pchip"),
        count=150,
    )
    return blend, ob.Dataset((logs[5],)), truth[5]


@pytest.mark.parametrize("mode", ["two_sided", "causal"])
def test_intervals_hold_between_the_measurements_of_a_slow_sensor(two_rates, mode):
    """No task asks for such a value, as it was never measured; here the truth is known."""
    blend, log, truth = two_rates
    filled = ob.impute(blend, log, mode=mode)[0]
    inside = ~log[0].observed[:, 1]
    inside[:20] = inside[-20:] = False
    for level in (0.5, 0.9):
        low, high = filled.interval(level)
        covered = ((low <= truth) & (truth <= high))[inside, 1].mean()
        assert level - 0.03 < covered, "an interval is too narrow"
    # The walk moves by 0.3 sqrt(10) between two measurements: 90 % of that, and no more.
    assert (high - low)[inside, 1].max() < 2 * 1.645 * 0.3 * np.sqrt(10) * 1.5


def test_a_kind_that_no_task_has_takes_the_next_that_one_has(two_rates):
    blend, _, _ = two_rates
    bins, many = blend.both.keys.bins, len(blend.both.keys.bins)
    usual, twice = (int(b) for b in bins.of_age(np.array([0.1, 0.2])))
    assert usual < twice
    for table in (blend.both.weights, blend.both.widths.table):
        of_kind = table[:-1].reshape(-1, blend.both.keys.levels, *table.shape[1:])
        for kind in (usual, twice, many + usual):
            assert np.array_equal(of_kind[kind, :, 1], of_kind[many + twice, :, 1])
    # `of_kind` of the widths; the best weights of a channel that has both kinds may be the same.
    assert not np.array_equal(of_kind[many + usual, :, 0], of_kind[many + twice, :, 0])
    ages = blend.stack.keys.bins.of_age(np.array([0.01, 0.1]))
    assert ages[0] < ages[1]
    short, own = (int(blend.stack.keys.usual[int(at)]) for at in ages)
    for table in (blend.stack.weights, blend.widths.table):
        for kind in (short, short + MOTIONS):
            # The next measurement comes when the other sensor was seen in the meantime.
            assert np.array_equal(table[kind, 1], table[own + MOTIONS, 1])


def test_an_outage_of_one_sensor_is_another_kind_than_one_of_all():
    """Position and velocity: a position that is out is found from its velocity, not so both."""
    random = np.random.default_rng(3)
    times = 0.02 * np.arange(300)
    logs = []
    for _ in range(10):
        velocity = np.cumsum(random.normal(0, 1, 300)) * 0.2
        velocity -= np.linspace(0, velocity[-1], 300)
        position = np.cumsum(velocity) * 0.02
        logs.append(ob.Trajectory(times, np.stack([position, velocity], 1), names=("x", "v")))
    task = TaskConfig(0.6, 0.02, 4.0, (("x",), ("v",)))
    parts = ob.Dataset(tuple(logs[:7])), ob.Dataset(tuple(logs[7:]))
    blend = fit_blend(
        *parts, tasks=task, causal=("last_value", "ridge"), two_sided=("linear",), count=150
    )
    usual = blend.stack.keys.usual[3:]
    alone = blend.stack.weights[usual + MOTIONS, 0, 1]
    assert (alone > 0.9).all()
    widths = blend.widths.table
    assert (widths[usual + MOTIONS, 0, 9] < widths[usual, 0, 9]).all()


def test_blends_saved_before_outages_had_kinds_of_their_own_are_read(blend):
    old = dict(blend.stack.arrays())
    kinds = len(blend.stack.keys.bins) * MOTIONS + 1
    old["weights"] = old["weights"][:kinds]
    keys = Stack().restore(old).keys
    assert (keys.each, len(keys)) == (MOTIONS, kinds)
    found, now = kinds_of(keys, waves(3, 1))[0], kinds_of(blend.stack.keys, waves(3, 1))[0]
    assert np.array_equal(found[..., 1:], now[..., 1:])
    assert found[..., 0].max() == kinds - 1


def test_bins_without_values_take_those_of_a_neighbour():
    table = np.array([[1.0, 2.0], [3.0, 4.0], [5.0, 6.0], [7.0, 8.0]])
    count = np.array([[0, 1], [1, 0], [0, 0], [2, 0]])
    found = [[3, 2], [3, 2], [3, 2], [7, 2]]
    assert filled_bins(table, count).tolist() == found


def test_motion_around_a_gap_is_that_of_its_neighbours_and_of_its_ends():
    times = 0.1 * np.arange(40)
    observed = np.ones((40, 3), dtype=bool)
    observed[18:22] = False
    walk = np.cumsum(np.where(np.arange(40) % 2, 1.0, -0.5))
    values = np.stack([walk, 1e-3 * walk, np.where(np.arange(40) < 20, 0.0, 20.0)], axis=1)
    one = ob.Trajectory(times, values, observed=observed)
    sides = Sides.of(one)
    # Usual: a squared slope of 62.5 (steps of 1 and -0.5 in 0.1 s), and ends that differ by 2.
    motion = SideMotion(np.full(3, 0.1), np.full(3, 62.5), np.full((1, 3), 4.0))
    level = motion.level(one, sides, np.zeros((40, 3), dtype=np.int64))
    assert level[19].tolist() == [2, 0, 2], "moves, rests, rests on both sides of a move"
    motion = replace(motion, slope=np.full(3, 620.0), rise=np.full((1, 3), 1e6))
    level = motion.level(one, sides, np.zeros((40, 3), dtype=np.int64))
    assert level[19].tolist() == [1, 0, 0], "a tenth of the usual squared slope"


def test_a_channel_that_rests_is_filled_as_if_it_always_did():
    """It moves in half of the tasks, where a smooth curve is far better than the line."""
    random = np.random.default_rng(2)

    def made(count: int) -> ob.Dataset:
        logs = []
        for i in range(count):
            times = 0.01 * np.arange(400)
            wave = np.sin(8 * times + random.uniform(0, 6)) if i % 2 else 0.0 * times
            noise = random.normal(0, 1e-3, 400)
            logs.append(ob.Trajectory(times, (wave + noise)[:, None], names=("x",)))
        return ob.Dataset(tuple(logs))

    task = TaskConfig(0.3, 0.01, 2.0)
    options = {"causal": ("last_value",), "two_sided": ("linear", "pchip")}
    blend = fit_blend(made(16), made(8), tasks=task, count=120, **options)
    many, levels = len(blend.both.keys.bins), blend.both.keys.levels
    linear = list(blend.both.members).index("linear")
    longest = (2 * many - 1) * levels  # the middle of the longest gaps
    rests, moves = (
        blend.both.weights[longest, 0, linear],
        blend.both.weights[longest + 2, 0, linear],
    )
    assert rests > 0.6 > 0.2 > moves
    widths = blend.both.widths.table[:, 0, LEVELS.tolist().index(0.9)]
    assert widths[longest] < 0.1 * widths[longest + 2]
    again = tables_of(blend.arrays())["both"]
    assert np.array_equal(again.keys.motion.rise, blend.both.keys.motion.rise)
    before = {k: v for k, v in blend.arrays().items() if ".motion." not in k}
    assert tables_of(before)["both"].keys.levels == 1, "a blend that was saved before"
