"""Kalman filters and smoothers: against matrix exponentials, dense Gaussians, other libraries."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import expm

import offbeat as ob
from offbeat.baselines import fit_baseline
from offbeat.baselines.base import Rows, padded
from offbeat.baselines.kalman import Belief, Chains, filtered, transition
from offbeat.baselines.kalman_search import Sample

DAMPINGS = (0.0, 1e-3, 0.299, 0.301, 1.0, 3.0)
GAPS = (1e-6, 1e-2, 0.5, 1.0, 4.0)


def dense(gap, damping, drive, walk, order):
    """Matrix and noise of a gap by Van Loan (1978)'s exponential, in short steps."""
    a = np.diag(np.ones(order - 1), 1)
    a[-1, -1] = -damping
    q = np.zeros((order, order))
    q[0, 0], q[-1, -1] = walk, drive
    q[0, 0] += drive if order == 1 else 0.0
    steps = max(1, int(np.ceil(gap * damping)))
    block = np.block([[-a, q], [np.zeros_like(a), a.T]])
    power = expm(block * gap / steps)
    step = power[order:, order:].T
    added = step @ power[:order, order:]
    matrix, noise = np.eye(order), np.zeros((order, order))
    for _ in range(steps):
        matrix, noise = step @ matrix, step @ noise @ step.T + added
    return matrix, noise


def closed(gap, damping, drive, walk, order):
    """The same by `transition`, as matrices."""
    found = transition(*(np.array([float(v)]) for v in (gap, damping, drive, walk)), order)
    matrix, noise = np.eye(order), np.zeros((order, order))
    for i in range(order):
        for j in range(i, order):
            if found.matrix[i][j] is not None:
                matrix[i, j] = found.matrix[i][j].item()
            noise[i, j] = noise[j, i] = found.noise[i, j].item()
    return matrix, noise


@pytest.mark.parametrize("order", [2, 3])
@pytest.mark.parametrize("damping", DAMPINGS)
@pytest.mark.parametrize("gap", GAPS)
def test_a_transition_is_the_matrix_exponential(order, damping, gap):
    for walk in (0.0, 0.1):
        matrix, noise = closed(gap, damping, 2.0, walk, order)
        expected = dense(gap, damping, 2.0, walk, order)
        assert matrix == pytest.approx(expected[0], rel=1e-10, abs=1e-14)
        # Van Loan's matrix loses digits in the smallest entries at short gaps.
        assert noise == pytest.approx(expected[1], rel=1e-8, abs=1e-25)


@pytest.mark.parametrize("order", [2, 3])
@pytest.mark.parametrize("damping", DAMPINGS)
@pytest.mark.parametrize(("first", "second"), [(1e-6, 1.0), (0.3, 0.7), (3.0, 1e3), (1.0, 1e6)])
def test_two_transitions_in_a_row_are_one(order, damping, first, second):
    f1, q1 = closed(first, damping, 2.0, 0.1, order)
    f2, q2 = closed(second, damping, 2.0, 0.1, order)
    f, q = closed(first + second, damping, 2.0, 0.1, order)
    assert f2 @ f1 == pytest.approx(f, rel=1e-9, abs=0)
    assert f2 @ q1 @ f2.T + q2 == pytest.approx(q, rel=1e-9, abs=0)


def chains(order, channels, noise, damping=0.4, variance=1.0):
    count = len(channels)
    return Chains(
        channels=np.array(channels),
        offset=np.full(count, 5.0),
        unit=np.tile([2.0, 3.0, 0.5][:order], (count, 1)),
        clock=np.full(count, 0.01),
        longest=np.full(count, np.inf),
        drive=np.full(count, 0.7),
        walk=np.full(count, 0.05),
        damping=np.full(count, damping),
        noise=np.array(noise)[:order, None] * np.ones(count),
        prior_mean=np.array([0.0, 0.3, -0.2])[:order, None] * np.ones(count),
        prior=np.array([50.0, 2.0, 1.0])[:order, None] * np.ones(count),
        variance=np.full(count, variance),
    )


def rows(channels, seed=0, count=14, some=0.5):
    random = np.random.default_rng(seed)
    times = np.cumsum(random.exponential(0.01, (2, count)), axis=1)
    times -= times[:, :1]
    values = random.normal(5, 2, (2, count, channels))
    observed = random.random(values.shape) < some
    observed[:, 0] = True  # filter and smoother start at the same row
    return Rows(times, values, observed, np.ones_like(observed), (count, count))


def posterior(model, data, chain, batch, before=None):
    """Mean and covariance of the states at all rows given observations, by one dense Gaussian.

    Args:
        model: chains.
        data: rows.
        chain: number of the chain.
        batch: number of the trajectory.
        before: row; only observations of earlier rows count.

    Returns:
        (rows, order) mean and (rows, order, order) covariance, in units of the states.
    """
    n, count = model.order, data.times.shape[1]
    mean, cov = np.zeros((count, n)), np.zeros((count, n, count, n))
    here, spread = model.prior_mean[:, chain], np.diag(model.prior[:, chain])
    for i in range(count):
        gap = (data.times[batch, i] - data.times[batch, max(i - 1, 0)]) / model.clock[chain]
        f, q = dense(gap, model.damping[chain], model.drive[chain], model.walk[chain], n)
        here, spread = f @ here, f @ spread @ f.T + q
        mean[i], cov[i, :, i] = here, spread
        for k in range(i):
            cov[i, :, k] = f @ cov[i - 1, :, k]
            cov[k, :, i] = cov[i, :, k].T
    seen, measured, noise = [], [], []
    for i in range(count if before is None else before):
        for j in range(n):
            c = model.channels[chain, j]
            if c >= 0 and data.observed[batch, i, c]:
                offset = model.offset[chain] if j == 0 else 0.0
                seen.append(i * n + j)
                measured.append((data.values[batch, i, c] - offset) / model.unit[chain, j])
                noise.append(model.noise[j, chain])
    flat, whole = mean.reshape(-1), cov.reshape(count * n, count * n)
    if seen:
        gain = np.linalg.solve(whole[np.ix_(seen, seen)] + np.diag(noise), whole[seen]).T
        flat = flat + gain @ (np.array(measured) - flat[seen])
        whole = whole - gain @ whole[seen]
    whole = whole.reshape(count, n, count, n)
    return flat.reshape(count, n), np.stack([whole[i, :, i] for i in range(count)])


CASES = [
    (2, [[0, -1], [1, -1]], [0.2, 0.3]),
    (2, [[0, 1], [2, 3]], [0.2, 0.3]),
    (3, [[0, -1, -1]], [0.2, 0.3, 0.4]),
    (3, [[0, 1, 2]], [0.2, 0.3, 0.4]),
    (3, [[0, -1, 1]], [0.2, 0.3, 0.4]),
    (2, [[0, 1]], [0.0, 0.0]),
    (3, [[0, 1, 2]], [0.0, 0.0, 0.0]),
]


def tolerance(noise):
    """Relative. Without noise, the dense solution itself is exact to 3e-7 only.

    Against one of 60 digits, it is 3e-7 off in these cases, the filter and the smoother 6e-11.
    """
    return 1e-8 if max(noise) else 2e-6


@pytest.mark.parametrize(("order", "channels", "noise"), CASES)
def test_a_filter_is_the_dense_posterior_of_the_observations_before(order, channels, noise):
    model, data = chains(order, channels, noise, variance=4.0), rows(4)
    means = filtered(model, data)
    state = model.start(np.zeros((2, 4)))
    for row in range(14):
        variances = model.read_variance(state, data.times[:, row, None])
        for chain in range(len(channels)):
            for batch in range(2):
                mean, cov = posterior(model, data, chain, batch, before=row)
                for j in range(order):
                    unit = model.unit[chain, j]
                    expected = mean[row, j] * unit + (5.0 if j == 0 else 0.0)
                    assert means[j][batch, row, chain] == pytest.approx(
                        expected, rel=tolerance(noise)
                    )
                    expected = (cov[row, j, j] + noise[j]) * 4.0 * unit**2
                    if row == 0 and j == 0:  # nothing was observed
                        expected = unit**2
                    found = variances[j][batch, chain]
                    assert found == pytest.approx(expected, rel=tolerance(noise))
        mask = data.observed[:, row]
        state = model.observe(state, data.times[:, row, None], data.values[:, row], mask)


@pytest.mark.parametrize(("order", "channels", "noise"), CASES)
def test_a_smoother_is_the_dense_posterior_of_all_observations(order, channels, noise):
    model, data = chains(order, channels, noise), rows(4)
    means = model.smooth(data)
    for chain in range(len(channels)):
        for batch in range(2):
            mean, _ = posterior(model, data, chain, batch)
            for j in range(order):
                expected = mean[:, j] * model.unit[chain, j] + (5.0 if j == 0 else 0.0)
                assert means[j][batch, :, chain] == pytest.approx(expected, rel=tolerance(noise))


def test_the_smoother_is_that_of_pykalman():
    pykalman = pytest.importorskip("pykalman")
    model, data = chains(2, [[0, -1]], [0.2, 0.3]), rows(1)
    gaps = np.diff(data.times[0]) / model.clock[0]
    steps = [dense(g, 0.4, 0.7, 0.05, 2) for g in gaps]
    values = (data.values[0] - 5.0) / 2.0
    kalman = pykalman.KalmanFilter(
        transition_matrices=np.stack([f for f, _ in steps]),
        transition_covariance=np.stack([q for _, q in steps]),
        observation_matrices=np.array([[1.0, 0.0]]),
        observation_covariance=np.array([[0.2]]),
        initial_state_mean=model.prior_mean[:, 0],
        initial_state_covariance=np.diag(model.prior[:, 0]),
    )
    masked = np.ma.masked_array(values, mask=~data.observed[0])
    expected = kalman.smooth(masked)[0]
    for j, found in enumerate(model.smooth(data)):
        unit, offset = model.unit[0, j], 5.0 if j == 0 else 0.0
        assert found[0, :, 0] == pytest.approx(expected[:, j] * unit + offset, rel=1e-9)


@pytest.mark.parametrize("order", [2, 3])
@pytest.mark.parametrize("damping", [0.0, 0.4, 30.0])
@pytest.mark.parametrize("noise", [0.0, 1e-12, 1e6])
def test_tiny_and_huge_gaps_and_noise_stay_finite_and_covariances_positive(order, damping, noise):
    random = np.random.default_rng(0)
    model = chains(order, [list(range(order))], [noise] * 3, damping)
    times = 0.01 * np.cumsum(10.0 ** random.uniform(-6, 6, (1, 60)), axis=1)
    values = random.normal(size=(1, 60, order)) * 10.0 ** np.arange(order)
    observed = random.random(values.shape) < 0.6
    data = Rows(times - times[:, :1], values, observed, observed, (60,))
    for found in [*filtered(model, data), *model.smooth(data)]:
        assert np.isfinite(found).all()
    state = model.start(np.zeros((1, order)))
    for row in range(60):
        state = model.observe(state, data.times[:, row, None], values[:, row], observed[:, row])
        for i in range(order):
            for j in range(i, order):
                limit = np.sqrt(state[f"cov{i}{i}"] * state[f"cov{j}{j}"])
                assert (abs(state[f"cov{i}{j}"]) <= limit * (1 + 1e-6)).all()


def test_a_position_that_is_not_observed_is_its_mean():
    model, data = chains(2, [[0, 1]], [0.2, 0.3]), rows(2)
    data.observed[:, :, 0] = False
    for means in (filtered(model, data), model.smooth(data)):
        assert (means[0] == 5.0).all()
        assert np.abs(means[1]).max() > 0.1


TRUE = {"damping": 0.1, "drive": 0.5, "noise": 0.3}
"""Parameters of `motion`, per typical gap."""

SCALES = np.array([1.0, 1e4])


def motion(seed, count=60):
    """Two channels of damped velocity, with outages; every second one ends in its outage."""
    random = np.random.default_rng(seed)
    made = []
    for i in range(count):
        gaps = np.append(0.0, random.uniform(0.5, 1.5, 59))
        state, values = np.zeros((2, 2)), np.empty((60, 2))
        state[1] = random.normal(size=2) * np.sqrt(TRUE["drive"] / (2 * TRUE["damping"]))
        for row, gap in enumerate(gaps):
            matrix, noise = closed(gap, TRUE["damping"], TRUE["drive"], 0.0, 2)
            state = matrix @ state + np.linalg.cholesky(noise + 1e-12 * np.eye(2)) @ random.normal(
                size=(2, 2)
            )
            values[row] = state[0] + random.normal(size=2) * np.sqrt(TRUE["noise"])
        observed = np.ones(values.shape, dtype=bool)
        first = random.integers(20, 40)
        observed[first : first + 8] = False
        times = 0.01 * np.cumsum(gaps)
        whole = ob.Trajectory(times, values * SCALES, observed=observed)
        made.append(whole.slice(0, first + 8) if i % 2 else whole)
    return ob.Dataset(tuple(made))


def true_chains():
    """The model that made `motion`."""
    model = chains(2, [[0, -1], [1, -1]], [TRUE["noise"], 1.0], TRUE["damping"])
    return replace(
        model,
        offset=np.zeros(2),
        unit=np.stack([SCALES, SCALES], axis=1),
        drive=np.full(2, TRUE["drive"]),
        walk=np.zeros(2),
        prior_mean=np.zeros((2, 2)),
        prior=np.array([[1e6, 1e6], [2.5, 2.5]]),
    )


def errors(predicted, test, rows=slice(0, 8)):
    """RMSE per channel of the masked values; `rows` of each outage."""
    squares = []
    for each, t in zip(predicted, test, strict=True):
        outage = np.flatnonzero(~t.observed[:, 0])[rows]
        squares.append((each[: t.rows] - t.values)[outage] ** 2)
    return np.sqrt(np.concatenate(squares).mean(axis=0))


@pytest.mark.parametrize(
    ("name", "rows"),
    [("kalman_short", slice(0, 3)), ("kalman_long", slice(3, 8)), ("smoother", slice(0, 8))],
)
def test_fitted_parameters_are_as_good_as_the_true_ones(name, rows):
    train, test = motion(0), motion(1)
    best = true_chains()
    data = next(padded(test))
    optimal = best.smooth(data)[0] if name == "smoother" else filtered(best, data)[0]
    found = errors(fit_baseline(name, train).predict(test), test, rows)
    assert (found < 1.05 * errors(optimal, test, rows)).all()


def test_the_variance_of_a_fitted_filter_is_that_of_its_errors():
    train, test = motion(0), motion(1)
    fitted = fit_baseline("kalman_short", train)
    squares = []
    for data in padded(test):
        state = fitted.start(np.zeros(data.values[:, 0].shape))
        for row in range(data.times.shape[1]):
            time = data.times[:, row, None]
            error = fitted.read(state, time) - data.values[:, row]
            if row > 5:
                seen = data.observed[:, row]
                squares.append(
                    error**2 / fitted.read_variance(state, time) * np.where(seen, 1, np.nan)
                )
            state = fitted.observe(state, time, data.values[:, row], data.observed[:, row])
    assert np.nanmean(np.concatenate(squares), axis=0) == pytest.approx([1.0, 1.0], abs=0.3)


def test_channels_of_very_different_scale_are_fitted_alike():
    train = motion(0)
    for name in ("kalman_short", "smoother"):
        plain = fit_baseline(name, train)
        scaled = fit_baseline(
            name,
            ob.Dataset(
                tuple(
                    ob.Trajectory(t.times, t.values * [1e-9, 1e12], observed=t.observed)
                    for t in train
                )
            ),
        )
        assert scaled.banks[0].damping == pytest.approx(plain.banks[0].damping, rel=1e-6)
        assert scaled.banks[0].drive == pytest.approx(plain.banks[0].drive, rel=1e-6)


def degenerate():
    """Data that tell little, by name."""
    random = np.random.default_rng(0)
    times = np.arange(50) * 0.01
    waves = np.stack([np.sin(9 * times), np.cos(9 * times)], axis=1)
    some = np.repeat((times % 0.1 < 0.06)[:, None], 2, axis=1)
    never = np.array([False, True]) & some
    spike = np.where((times == 0.2)[:, None], [-999.0, 1.0], waves)
    yield "one row", times[:1], waves[:1], some[:1]
    yield "three rows", times[:3], random.normal(size=(3, 2)), some[:3]
    yield "a constant", times, np.where([True, False], 7.0, waves), some
    yield "a channel that is never observed", times, waves, never
    yield "a channel that is never known", times, np.where([True, False], np.nan, waves), never
    yield "units of extreme size", times * 1e9, waves * [1e30, 1e-30], some
    yield "a sentinel", times, spike, some


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("name", ["kalman_short", "smoother", "motion_filter", "motion_smoother"])
def test_data_that_tell_little_give_finite_predictions(name):
    for what, times, values, observed in degenerate():
        data = ob.Dataset((ob.Trajectory(times, values, observed=observed),))
        fitted = fit_baseline(name, data)
        assert np.isfinite(fitted.predict(data)[0]).all(), what
        assert np.isfinite(np.concatenate([a.ravel() for a in fitted.arrays().values()])).all(), (
            what
        )


# --- wild values ----------------------------------------------------------------------------------


def wild(trajectory, row, size):
    """The same with a value of one row that is wrong."""
    values = trajectory.values.copy()
    values[row] += size
    return ob.Trajectory(trajectory.times, values, observed=trajectory.observed)


def with_limits(baseline, limit):
    """A fitted baseline with other limits of innovations."""
    arrays = baseline.arrays()
    limits = {n: np.full_like(a, limit) for n, a in arrays.items() if n.endswith(".limit")}
    return type(baseline)().restore({**arrays, **limits})


@pytest.mark.parametrize("name", ["kalman_short", "kalman_long", "motion_filter"])
def test_a_single_wild_value_moves_a_filter_little(name):
    train, test = motion(0), motion(1)
    fitted = fit_baseline(name, train)
    assert all(bank.limited for bank in fitted.banks)
    t = test[0]
    row = int(np.flatnonzero(t.observed.all(axis=1))[20])
    usual = fitted.predict(ob.Dataset((t,)))[0]
    noise = np.sqrt(np.mean((usual - t.values)[5:][t.observed.all(axis=1)[5:]] ** 2, axis=0))
    one = ob.Dataset((wild(t, row, 100 * noise),))
    after = slice(row + 1, row + 12)
    moved = np.abs(fitted.predict(one)[0] - usual)[after].max(axis=0)
    free = np.abs(with_limits(fitted, 1e30).predict(one)[0] - usual)[after].max(axis=0)
    assert (moved < 20 * noise).all()
    assert (moved < 0.25 * free).all()


def test_a_single_wild_value_moves_a_smoother_little():
    train, test = motion(0), motion(1)
    fitted = fit_baseline("smoother", train)
    t = test[0]
    row = int(np.flatnonzero(t.observed.all(axis=1))[20])
    usual = fitted.predict(ob.Dataset((t,)))[0]
    size = 100 * np.sqrt(np.mean(np.diff(t.values, axis=0) ** 2, axis=0))
    one = ob.Dataset((wild(t, row, size),))
    others = np.arange(t.rows) != row
    moved = np.abs(fitted.predict(one)[0] - usual)[others].max(axis=0)
    free = np.abs(with_limits(fitted, 1e30).predict(one)[0] - usual)[others].max(axis=0)
    assert (moved < 0.25 * free).all()


def test_a_step_is_followed_after_a_few_values():
    train, test = motion(0), motion(1)
    fitted = fit_baseline("kalman_short", train)
    t = test[0]
    values = t.values.copy()
    size = 100 * np.sqrt(np.mean(np.diff(values, axis=0) ** 2, axis=0))
    values[50:] += size
    stepped = ob.Trajectory(t.times, values, observed=np.ones_like(t.observed))
    missed = np.abs(fitted.predict(ob.Dataset((stepped,)))[0] - values)
    assert (missed[58:] < 0.2 * size).all()


def test_a_measurement_at_the_limit_is_that_of_a_filter_without_one():
    chains = true_chains()
    free = next(padded(motion(1)))
    far = replace(chains, limit=np.full((2, len(chains.channels)), 1e6))
    for exact, limited in zip(filtered(chains, free), filtered(far, free), strict=True):
        assert np.array_equal(exact, limited)


def test_beyond_the_limit_the_mean_moves_as_by_a_value_at_the_limit():
    belief = Belief(
        [np.zeros(1), np.zeros(1)],
        {(0, 0): np.full(1, 3.0), (0, 1): np.ones(1), (1, 1): np.full(1, 2.0)},
    )
    there, noise = np.array([True]), np.ones(1)
    at, _ = belief.updated(0, np.full(1, 2 * 2.5), noise, there)  # the deviation is 2
    beyond, update = belief.updated(0, np.full(1, 1000.0), noise, there, np.full(1, 2.5))
    assert update.beyond.all()
    assert np.allclose(beyond.mean, at.mean)
    assert beyond.cov[0, 0] > 0.99 * belief.cov[0, 0], "it says nothing about where the chain is"


@pytest.mark.parametrize("two_sided", [False, True])
def test_a_search_scores_what_filter_and_smoother_predict(two_sided):
    tasks = motion(0)
    index = np.arange(tasks.channels)[:, None] * [1, 0] + [0, -1]
    sample = Sample.of(tasks, index, two_sided=two_sided)
    own = replace(true_chains(), channels=sample.index)
    found = sample.errors(own)
    assert np.array_equal(sample.errors(own), found), "and again in the same memory"
    means = own.smooth(sample.rows) if two_sided else filtered(own, sample.rows)
    columns = [c * 2 for c in range(tasks.channels)]
    errors = (means[0] - sample.rows.values[..., columns]) ** 2
    for c, column in enumerate(columns):
        total = np.nansum(found[:, 0, column] * sample.count[:, column])
        chosen = sample.rows.known[..., column]
        assert sample.count[:, column].sum() == chosen.sum() > 0
        assert total == pytest.approx(errors[..., c][chosen].sum())
