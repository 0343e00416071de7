"""Ridge regression baselines: linear systems with a known best predictor, and other libraries."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

import offbeat as ob
from offbeat.baselines import cross_fitted, fit_baseline, folds_of, residual_gru
from offbeat.baselines.folds import row_folds
from offbeat.baselines.held_out import Products, held_out_ridge
from offbeat.baselines.kernel_ridge import gaussians, whitening
from offbeat.baselines.residual_gru import ResidualGru, step
from offbeat.baselines.ridge_fill import backwards
from offbeat.data.masking import masked_values
from offbeat.data.tasks import TaskConfig, draw_tasks, take_tasks

GAP = 0.01


def cut(dataset: ob.Dataset, row: int, channels: tuple[int, ...] | None = None) -> ob.Dataset:
    """Everything of these channels masked from a row on."""
    tasks = []
    for t in dataset:
        observed = t.observed.copy()
        observed[row:, slice(None) if channels is None else list(channels)] = False
        tasks.append(replace(t, observed=observed))
    return ob.Dataset(tuple(tasks))


def rms(array: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(array))))


# x[t] = 1.6 x[t-1] - 0.7 x[t-2] + e
SECOND_ORDER = np.array([[1.6, -0.7], [1.0, 0.0]])


def second_order(count: int, seed: int) -> ob.Dataset:
    random = np.random.default_rng(seed)
    made = []
    for _ in range(count):
        x = np.zeros(120)
        for i in range(2, len(x)):
            x[i] = SECOND_ORDER[0] @ x[[i - 1, i - 2]] + random.standard_normal()
        made.append(ob.Trajectory(GAP * np.arange(70), 5 + x[50:, None]))
    return ob.Dataset(tuple(made))


def test_a_second_order_process_gets_its_best_prediction_at_every_horizon():
    train = second_order(400, seed=0)
    fitted = fit_baseline("ridge", cut(train, 64))
    test = cut(second_order(200, seed=1), 60)
    predicted = np.stack([p[:, 0] for p in fitted.predict(test)]) - 5
    x = np.stack([t.values[:, 0] for t in test]) - 5
    best = np.stack([x[:, 1:-1], x[:, :-2]], -1) @ SECOND_ORDER[0]
    spread = rms(x)
    assert rms(predicted[:, 10:60] - best[:, 8:58]) < 0.015 * spread
    power = SECOND_ORDER
    for row in (60, 61, 62):
        ahead = x[:, [59, 58]] @ power[0]
        assert rms(predicted[:, row] - ahead) < 0.05 * spread
        power = power @ SECOND_ORDER


def test_a_channel_that_another_one_drives_is_predicted_from_it():
    # The first channel follows the second one, which is white noise but for a lag of one row.
    random = np.random.default_rng(0)
    made = []
    for _ in range(300):
        driver = random.standard_normal(61)
        driven = np.concatenate([[0.0], driver[:-1]]) + 0.1 * random.standard_normal(61)
        made.append(ob.Trajectory(GAP * np.arange(60), np.stack([driven, driver], -1)[1:]))
    data = ob.Dataset(tuple(made))
    fitted = fit_baseline("ridge", data[:200])
    errors = np.concatenate(
        [(t.values - p)[5:] for t, p in zip(data[200:], fitted.predict(data[200:]), strict=True)]
    )
    assert rms(errors[:, 0]) == pytest.approx(0.1, rel=0.05)
    assert rms(errors[:, 1]) == pytest.approx(1.0, rel=0.05)


def test_a_silent_channel_follows_one_that_is_still_observed():
    random = np.random.default_rng(0)
    made = []
    for _ in range(200):
        walk = np.cumsum(random.standard_normal(60))
        values = np.stack([walk, -3 * walk + 7], -1)
        made.append(ob.Trajectory(GAP * np.arange(60), values))
    data = ob.Dataset(tuple(made))
    silent = ob.Dataset(tuple(cut(data[i : i + 1], 20 + i % 35, (1,))[0] for i in range(len(data))))
    fitted = fit_baseline("ridge", silent[:150])
    held = fit_baseline("last_value", silent[:150])
    test = cut(data[150:], 30, (1,))
    late = [
        rms(
            np.stack([(t.values - p)[35:50, 1] for t, p in zip(test, b.predict(test), strict=True)])
        )
        for b in (fitted, held)
    ]
    # What is left is the step of the first channel since its last row, 3 per row.
    assert late[0] < 3.5
    assert late[1] > 8


def test_noise_is_predicted_no_worse_than_by_its_mean():
    random = np.random.default_rng(0)
    data = ob.Dataset(
        tuple(
            ob.Trajectory(GAP * np.arange(60), 4 + random.standard_normal((60, 2)))
            for _ in range(60)
        )
    )
    fitted = fit_baseline("ridge", data[:40])
    errors = np.concatenate(
        [t.values - p for t, p in zip(data[40:], fitted.predict(data[40:]), strict=True)]
    )
    assert rms(errors) < 1.03


def test_outliers_and_long_times_give_bounded_predictions():
    fitted = fit_baseline("ridge", cut(second_order(100, seed=0), 60))
    t = second_order(1, seed=1)[0]
    values = t.values.copy()
    values[50] = 1e9
    times = np.append(t.times, [1e3, 1e6])
    values = np.vstack([values, [[np.nan], [np.nan]]])
    asked = ob.Dataset((ob.Trajectory(times, values),))
    predicted = fitted.predict(asked)[0]
    assert fitted.bound[0, 0] <= predicted.min()
    # As far out as the last value, up to ten scales.
    assert predicted.max() <= fitted.bound[1, 0] + 10 * fitted.scale[0]
    # Beyond the longest age of training, the prediction stays.
    assert predicted[-1, 0] == predicted[-2, 0]


@pytest.mark.parametrize("name", ["ridge", "kernel_ridge", "residual_gru"])
def test_rounding_decides_nothing_on_a_regular_grid(name, monkeypatch):
    monkeypatch.setattr(residual_gru, "STEPS", 12)
    random = np.random.default_rng(0)
    made = []
    for _ in range(40):
        observed = np.ones((60, 2), dtype=bool)
        first = int(random.integers(5, 30))
        observed[first : first + 20, int(random.integers(2))] = False
        observed[40:55] = False
        values = np.cumsum(random.standard_normal((60, 2)), axis=0)
        made.append(ob.Trajectory(np.arange(60) / 30, values, observed=observed))
    fitted = fit_baseline(name, ob.Dataset(tuple(made)))
    t = made[0]
    expected = fitted.predict(ob.Dataset((t,)))[0]
    state = fitted.start(torch.zeros(1, 2))
    for row in range(t.rows):
        time = torch.tensor([[t.times[row]]], dtype=torch.float32)
        read = fitted.read(state, time)[0].numpy()
        assert read == pytest.approx(expected[row], abs=1e-3)
        values = torch.tensor(t.values[None, row], dtype=torch.float32)
        state = fitted.observe(state, time, values, torch.tensor(t.observed[None, row]))


def test_predictions_do_not_change_with_units():
    tasks = cut(second_order(50, seed=0), 60)
    other = ob.Dataset(tuple(replace(t, values=1e3 * t.values - 40) for t in tasks))
    a = fit_baseline("ridge", tasks).predict(tasks)
    b = fit_baseline("ridge", other).predict(other)
    for one, two in zip(a, b, strict=True):
        assert two == pytest.approx(1e3 * one - 40, rel=1e-4)


# --- held-out ridge regression --------------------------------------------------------------------


def problem(seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    random = np.random.default_rng(seed)
    x = random.standard_normal((120, 12))
    y = x[:, :3] @ random.standard_normal((3, 2)) + [0.5, 4.0] * random.standard_normal((120, 2))
    return x, y, np.repeat(np.arange(4), 30)


def test_weights_are_those_of_scikit_learn():
    linear = pytest.importorskip("sklearn.linear_model")
    x, y, groups = problem()
    expected = linear.Ridge(alpha=0.1 * len(x), fit_intercept=False).fit(x, y).coef_.T
    assert held_out_ridge(x, y, groups, (0.1,)) == pytest.approx(expected, rel=1e-9)


def test_the_penalty_is_that_of_a_search_over_groups():
    linear = pytest.importorskip("sklearn.linear_model")
    x, y, groups = problem()
    penalties = (1e-3, 1e-2, 1e-1, 1.0)
    for target in range(2):
        errors = []
        for penalty in penalties:
            error = 0.0
            for group in range(4):
                inside = groups == group
                model = linear.Ridge(alpha=penalty * (~inside).sum(), fit_intercept=False)
                model.fit(x[~inside], y[~inside, target])
                error += ((model.predict(x[inside]) - y[inside, target]) ** 2).sum()
            errors.append(error)
        best = penalties[int(np.argmin(errors))]
        expected = linear.Ridge(alpha=best * len(x), fit_intercept=False).fit(x, y[:, target])
        found = held_out_ridge(x, y[:, target : target + 1], groups, penalties)[:, 0]
        assert found == pytest.approx(expected.coef_, rel=1e-9)


def test_weights_are_zero_where_nothing_can_be_predicted():
    random = np.random.default_rng(3)
    x = random.standard_normal((40, 30))
    y = random.standard_normal((40, 1))
    groups = np.repeat(np.arange(4), 10)
    assert not held_out_ridge(x, y, groups, (1e-6, 1e-3)).any()
    assert not held_out_ridge(x, y, np.zeros(40, dtype=int)).any()


# --- kernels --------------------------------------------------------------------------------------


def test_with_every_point_as_a_centre_it_is_the_kernel_ridge_of_scikit_learn():
    sklearn = pytest.importorskip("sklearn.kernel_ridge")
    random = np.random.default_rng(0)
    x, new = random.standard_normal((60, 2)), random.standard_normal((20, 2))
    y = np.sin(2 * x[:, :1]) + x[:, 1:] ** 2
    root = whitening(gaussians(x, x))
    weights = held_out_ridge(gaussians(x, x) @ root, y, np.repeat(np.arange(4), 15), (1e-3,))
    model = sklearn.KernelRidge(alpha=1e-3 * 60, kernel=lambda a, b: _mean_of_gaussians(a - b))
    expected = model.fit(x, y).predict(new)
    assert gaussians(new, x) @ root @ weights == pytest.approx(expected, abs=2e-3)


def _mean_of_gaussians(difference: np.ndarray) -> float:
    square = (difference**2).mean()
    return float(np.mean([np.exp(-square / 2 / width**2) for width in (0.5, 1.0, 2.0)]))


def test_a_kernel_learns_a_motion_that_bends_with_the_place():
    # x' = v, v' = 4 (1 - x^2) v - x (van der Pol), from different phases of the cycle.
    random = np.random.default_rng(0)
    made = []
    for _ in range(80):
        x, v, values = random.uniform(-2, 2), random.uniform(-2, 2), []
        for i in range(20 * 100):
            x, v = x + 0.01 * v, v + 0.01 * (4 * (1 - x * x) * v - x)
            if i >= 1000 and i % 20 == 0:
                values.append(x)
        made.append(ob.Trajectory(0.2 * np.arange(50), np.array(values)[:, None]))
    data = cut(ob.Dataset(tuple(made)), 44)
    errors = {}
    for name in ("ridge", "kernel_ridge"):
        fitted = fit_baseline(name, data[:60])
        errors[name] = missed(fitted, data[60:])
    assert errors["kernel_ridge"] < 0.6 * errors["ridge"]


# --- a recurrent network --------------------------------------------------------------------------


def test_the_state_of_the_network_is_that_of_torch():
    torch.manual_seed(0)
    gru = torch.nn.GRU(8, 5, batch_first=True).double()
    network = ResidualGru()
    network.input_weight, network.hidden_weight = (
        w.detach().numpy().T for w in (gru.weight_ih_l0, gru.weight_hh_l0)
    )
    network.input_bias, network.hidden_bias = (
        b.detach().numpy() for b in (gru.bias_ih_l0, gru.bias_hh_l0)
    )
    inputs, hidden = torch.randn(3, 8).double(), torch.randn(3, 5).double()
    expected = gru(inputs[:, None], hidden[None])[0][:, 0].detach().numpy()
    assert step(network, inputs.numpy(), hidden.numpy()) == pytest.approx(expected, abs=1e-12)


def test_a_network_comes_near_the_best_prediction(monkeypatch):
    monkeypatch.setattr(residual_gru, "STEPS", 240)
    train = cut(second_order(200, seed=0), 64)
    test = cut(second_order(100, seed=1), 60)
    x = np.stack([t.values[:, 0] for t in test])[:, 10:60]
    errors = {
        name: rms(np.stack([p[10:60, 0] for p in fit_baseline(name, train).predict(test)]) - x)
        for name in ("last_value", "residual_gru")
    }
    # The best prediction misses by the noise, of deviation 1.
    assert errors["residual_gru"] < 1.05
    assert errors["last_value"] > 1.3


def test_training_a_network_leaves_the_generators_of_others_alone(monkeypatch):
    monkeypatch.setattr(residual_gru, "STEPS", 12)
    torch.manual_seed(7)
    np.random.seed(7)  # noqa: NPY002
    expected = torch.rand(1), np.random.random()  # noqa: NPY002
    torch.manual_seed(7)
    np.random.seed(7)  # noqa: NPY002
    fit_baseline("residual_gru", second_order(4, seed=0))
    assert (torch.rand(1), np.random.random()) == expected  # noqa: NPY002


# --- folds ----------------------------------------------------------------------------------------


def test_windows_of_a_source_are_in_one_fold():
    data = second_order(12, seed=0)
    tasks = draw_tasks(data, TaskConfig(horizon_s=0.05, gap_s=GAP, window_s=0.2), 100)
    fold = folds_of(tasks, 4)
    source = np.array([note[1] for note in tasks.meta["tasks"]])
    assert all(len(set(fold[source == s])) == 1 for s in np.unique(source))
    assert np.bincount(fold, minlength=4).min() > 10


def test_folds_of_one_source_are_blocks_of_time():
    data = second_order(1, seed=0)
    tasks = draw_tasks(data, TaskConfig(horizon_s=0.05, gap_s=GAP, window_s=0.2), 40)
    fold = folds_of(tasks, 4)
    first = np.array([note[2] for note in tasks.meta["tasks"]])
    assert np.bincount(fold).tolist() == [10] * 4
    assert all(first[fold == k].max() <= first[fold == k + 1].min() for k in range(3))


def test_rows_of_one_time_are_in_one_fold_in_all_windows():
    data = second_order(2, seed=0)
    tasks = draw_tasks(data, TaskConfig(horizon_s=0.05, gap_s=GAP, window_s=0.2), 40)
    folds = row_folds(tasks, 4)
    found: dict[tuple[int, int], set[int]] = {}
    for (_, source, first), fold in zip(tasks.meta["tasks"], folds, strict=True):
        for i, f in enumerate(fold.tolist()):
            found.setdefault((source, first + i), set()).add(f)
    assert all(len(seen) == 1 for seen in found.values())
    # 140 rows of two trajectories, in order: blocks of 35.
    blocks = [next(iter(found[key])) for key in sorted(found)]
    assert blocks == sorted(blocks)
    assert set(blocks) == {0, 1, 2, 3}
    many = draw_tasks(second_order(12, seed=0), TaskConfig(horizon_s=0.05, gap_s=GAP), 40)
    whole = folds_of(many, 4)
    assert all((rows == f).all() for rows, f in zip(row_folds(many, 4), whole, strict=True))


def test_cross_fitted_predictions_are_those_of_a_fit_without_the_source():
    data = second_order(12, seed=0)
    tasks = draw_tasks(data, TaskConfig(horizon_s=0.05, gap_s=GAP, window_s=0.2), 60)
    fold = folds_of(tasks, 3)
    found = cross_fitted("ridge", tasks, 3)
    for k in range(3):
        others = fit_baseline("ridge", take_tasks(tasks, np.flatnonzero(fold != k)))
        for i in np.flatnonzero(fold == k):
            assert found[i] == pytest.approx(others.predict(tasks[i : i + 1])[0])


def test_windows_that_overlap_are_predicted_by_fits_to_other_times():
    """A motion that never comes back: a fit to the same times knows it, one to others does not."""
    random = np.random.default_rng(3)
    times = GAP * np.arange(160)
    walk = np.cumsum(np.cumsum(random.normal(size=(160, 2)), axis=0), axis=0)
    tasks = draw_tasks(
        ob.Dataset((ob.Trajectory(times, walk),)), TaskConfig(horizon_s=40 * GAP, gap_s=GAP), 24
    )
    rows = row_folds(tasks, 3)
    assert len({len(np.unique(fold)) for fold in rows} - {1}), "each window has several blocks"
    found = cross_fitted("ridge", tasks, 3)
    fitted = fit_baseline("ridge", tasks).predict(tasks)
    hidden = [masked_values(t) & np.logical_or.accumulate(t.observed, axis=0) for t in tasks]

    def error(predicted):
        missed = [(p - t.values)[h] for p, t, h in zip(predicted, tasks, hidden, strict=True)]
        return float(np.sqrt(np.mean(np.concatenate(missed) ** 2)))

    assert error(found) > 1.5 * error(fitted)


def test_ridge_of_parts_of_products_is_that_of_the_examples():
    x, y, groups = problem()
    products = Products.of(x, y, groups)
    part, spread = np.array([0, 2, 5]), np.array([1.0, 4.0, 0.5])
    first = products.part(part, spread).solve()
    assert first == pytest.approx(held_out_ridge(x[:, part] / spread, y, groups), rel=1e-9)
    weights = np.zeros((12, 2))
    weights[part] = first / spread[:, None]
    left = held_out_ridge(x, y - x @ weights, groups)
    assert products.left(weights).solve() == pytest.approx(left, rel=1e-6, abs=1e-9)


# --- fills ----------------------------------------------------------------------------------------


def gapped(
    dataset: ob.Dataset, length: int, seed: int, channels: tuple[int, ...] | None = None
) -> ob.Dataset:
    """Each trajectory with one gap of some rows, anywhere but near its ends."""
    random = np.random.default_rng(seed)
    tasks = []
    for t in dataset:
        observed = t.observed.copy()
        first = random.integers(6, t.rows - length - 6)
        hidden = slice(None) if channels is None else list(channels)
        observed[first : first + length, hidden] = False
        tasks.append(replace(t, observed=observed))
    return ob.Dataset(tuple(tasks))


def missed(baseline: ob.baselines.Baseline, test: ob.Dataset, channel: int = 0) -> float:
    """Root mean square error of the hidden values of a channel."""
    errors = [
        (t.values - p)[~t.observed[:, channel], channel]
        for t, p in zip(test, baseline.predict(test), strict=True)
    ]
    return rms(np.concatenate(errors))


def test_cubic_polynomials_are_filled():
    random = np.random.default_rng(0)
    time = np.linspace(-1, 1, 30)
    data = ob.Dataset(
        tuple(
            ob.Trajectory(GAP * np.arange(30), np.polyval(random.standard_normal(4), time)[:, None])
            for _ in range(300)
        )
    )
    fitted = fit_baseline("ridge_fill", gapped(data[:250], 4, seed=1))
    test = gapped(data[250:], 4, seed=2)
    curve = missed(fit_baseline("pchip", test), test)
    assert missed(fitted, test) < 0.02 * curve


def moving(count: int, seed: int) -> ob.Dataset:
    """A position and its velocity: sums of sines."""
    random = np.random.default_rng(seed)
    time = GAP * np.arange(80)
    made = []
    for _ in range(count):
        speed, phase = random.uniform(5, 25, 3), random.uniform(0, 6, 3)
        angle = np.outer(time, speed) + phase
        made.append(
            ob.Trajectory(
                time, np.stack([np.sin(angle).sum(1), (speed * np.cos(angle)).sum(1)], -1)
            )
        )
    return ob.Dataset(tuple(made))


@pytest.mark.parametrize("channel", [0, 1])
def test_a_position_is_filled_from_its_velocity_and_the_other_way_round(channel):
    train = gapped(moving(300, seed=0), 15, seed=1, channels=(channel,))
    test = gapped(moving(100, seed=2), 15, seed=3, channels=(channel,))
    curve = missed(fit_baseline("pchip", train), test, channel)
    assert missed(fit_baseline("ridge_fill", train), test, channel) < 0.05 * curve


def test_a_random_walk_is_filled_by_a_line():
    random = np.random.default_rng(0)
    data = ob.Dataset(
        tuple(
            ob.Trajectory(GAP * np.arange(60), np.cumsum(random.standard_normal((60, 2)), axis=0))
            for _ in range(500)
        )
    )
    fitted = fit_baseline("ridge_fill", gapped(data[:400], 9, seed=1))
    test = gapped(data[400:], 9, seed=2)
    assert missed(fitted, test) < 1.01 * missed(fit_baseline("linear", test), test)


def test_outside_all_observations_a_fill_is_a_forecast_in_that_direction():
    tasks = cut(second_order(60, seed=0), 60)
    fitted = fit_baseline("ridge_fill", tasks)
    test = cut(second_order(3, seed=1), 50)
    for t, p, after in zip(test, fitted.predict(test), fitted.forward.predict(test), strict=True):
        assert np.array_equal(p[50:], after[50:])
        assert np.array_equal(p[:50], t.values[:50])
    mirrored = backwards(test)
    for p, before in zip(
        fitted.predict(mirrored), fitted.backward.predict(backwards(mirrored)), strict=True
    ):
        assert np.array_equal(p[:20], before[::-1][:20])


@pytest.mark.parametrize("name", ["ridge", "ridge_fill"])
def test_beyond_the_data_of_training_a_change_is_no_larger_than_there(name):
    """A pose and a motion of another channel that training never had."""
    random = np.random.default_rng(3)

    def made(count: int, offset: float, jump: float) -> ob.Dataset:
        logs = []
        for _ in range(count):
            times = GAP * np.arange(80)
            swing = np.sin(3 * times + random.uniform(0, 6))
            values = np.stack([offset + 0.1 * swing, jump * swing], axis=1)
            observed = np.ones((80, 2), dtype=bool)
            observed[40:52, 0] = False
            values = values + random.normal(0, 1e-3, values.shape)
            logs.append(ob.Trajectory(times, values, observed=observed))
        return ob.Dataset(tuple(logs))

    fitted = fit_baseline(name, made(40, 0.0, 1.0))
    asked = made(10, 0.5, 1000.0)
    for t, predicted in zip(asked, fitted.predict(asked), strict=True):
        line = np.interp(t.times, t.times[[39, 52]], t.values[[39, 52], 0])
        start = line if name == "ridge_fill" else np.full(80, t.values[39, 0])
        # The position moves by 0.2 from end to end in training.
        assert np.abs(predicted[40:52, 0] - start[40:52]).max() <= 0.21
