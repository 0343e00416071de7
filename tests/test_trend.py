"""Anchored models with a trend: they begin as Kalman filters, and learn from there."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from model_helpers import SMALL, dataset, error, predictions, small_model
from scipy.linalg import solve_discrete_are

from offbeat import (
    Dataset,
    InputError,
    Model,
    Stream,
    Trajectory,
    kernels,
    load_model,
    make_model,
)
from offbeat.baselines.base import padded
from offbeat.baselines.kalman import Chains, filtered, transition
from offbeat.errors import FileFormatError
from offbeat.kernels import cpu
from offbeat.kernels.spec import ScanParts, ScanSpec, StepInputs
from offbeat.models.gains import LOOSE, Filters, tune_filters
from offbeat.models.zoo import MODELS
from offbeat.parts import Perceptron
from offbeat.parts.trend import Trend

BACKENDS = ["reference", *cpu.instruction_sets()]
TRAIN = dataset(6, seed=9, rows=30)


def exact(**options: Any) -> Model:
    """An untrained model in double precision, with the parameters of its filter not rounded."""
    model: Model = make_model("anchored_trend", TRAIN, **{**SMALL, **options}).double()
    assert model.trend is not None
    model.trend.begin(model.filters.damping(model.time_unit))
    return model


def filter_of(model: Model) -> Chains:
    """The filter of the baselines with the parameters of a model."""
    clock, damping, drive, walk = model.filters.table.numpy()
    scale, count = np.asarray(model.scaler.scale), model.channels
    level, slope = LOOSE * (1 + drive + walk), drive / (2 * np.maximum(damping, 0.02))
    return Chains(
        channels=np.array([[c, -1] for c in range(count)]),
        offset=model.mean.double().numpy() * scale + model.scaler.shift,
        unit=np.stack([np.ones(count), 1 / clock], axis=1),
        clock=clock,
        longest=np.full(count, 1e9),
        drive=drive,
        walk=walk,
        damping=damping,
        noise=np.ones((2, count)),
        prior_mean=np.zeros((2, count)),
        prior=np.stack([level, slope]),
    )


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize(
    "options",
    [{}, {"nodes": "rows"}, {"nodes": "rows", "solver": "rk4", "steps_per_gap": 3}],
    ids=["nodes", "rows", "rk4"],
)
def test_an_untrained_model_is_the_filter_of_the_baselines(
    backend: str, options: dict[str, Any]
) -> None:
    model, data = exact(**options), dataset(4, seed=3, rows=40)
    scale = np.asarray(model.scaler.scale)
    with kernels.use(backend):
        got = predictions(model, model.batch(data)).numpy() * scale + model.scaler.shift
    expected = [filtered(filter_of(model), rows)[0] for rows in padded(data)]
    np.testing.assert_allclose(got, np.concatenate(expected), rtol=0, atol=1e-9)


def test_an_untrained_stream_is_the_filter_too() -> None:
    model, one = exact(), dataset(1, seed=5, rows=40)[0]
    stream, got = Stream(model), []
    for row in range(one.rows):
        got.append(stream.predict(one.times[row]))
        seen = np.where(one.observed[row], one.values[row], np.nan)
        stream.observe(one.times[row], seen)
    rows = next(iter(padded(Dataset((one,)))))
    expected = filtered(filter_of(model), rows)[0][0]
    np.testing.assert_allclose(np.stack(got), expected, rtol=0, atol=1e-9)


def test_an_untrained_model_is_the_filter_of_pykalman() -> None:
    pykalman = pytest.importorskip("pykalman")
    model, one = exact(), dataset(1, seed=5, rows=40)[0]
    got = predictions(model, model.batch(Dataset((one,))))[0].numpy()
    values = model.batch(Dataset((one,))).values[0].double().numpy()
    for c in range(model.channels):
        clock, damping, drive, walk = model.filters.table[:, c].tolist()
        first = int(np.argmax(one.observed[:, c]))
        gaps = np.diff(one.times[first:]) / clock
        steps = [transition(np.array(g), damping, drive, walk, 2) for g in gaps]
        noise = [[[s.noise[0, 0], s.noise[0, 1]], [s.noise[0, 1], s.noise[1, 1]]] for s in steps]
        prior = float(model.filters.prior()[c, 2])
        moves = [[[1, s.matrix[0][1]], [0, s.matrix[1][1]]] for s in steps]
        kalman = pykalman.KalmanFilter(
            transition_matrices=np.array(moves),
            transition_covariance=np.array(noise),
            observation_matrices=[[1.0, 0.0]],
            observation_covariance=[[1.0]],
            # It begins after the first observation: its covariances lose digits in a loose prior.
            initial_state_mean=[values[first, c], 0.0],
            initial_state_covariance=np.diag([1.0, prior]),
        )
        masked = np.ma.masked_array(values[first:, c], mask=~one.observed[first:, c])
        masked[0] = np.ma.masked
        state, _ = kalman.filter(masked)
        expected = [s @ [1.0, m.matrix[0][1]] for s, m in zip(state[:-1], steps, strict=True)]
        np.testing.assert_allclose(got[first + 1 :, c], expected, rtol=0, atol=1e-7)


# --- the unit of the vector field -----------------------------------------------------------------


def test_the_error_of_a_filter_is_in_standard_deviations_of_its_channel() -> None:
    random, rows = np.random.default_rng(0), 200
    times, made = 0.1 * np.arange(rows), []
    for _ in range(40):
        noise = random.normal(size=rows)
        still = 3.0 * random.normal() + 0.03 * noise  # an offset per trajectory
        values = np.stack([noise, still, np.cumsum(noise)], axis=1)
        made.append(Trajectory(times, values))
    errors = [each[4] for each in tune_filters(Dataset(tuple(made)))]
    assert errors[0] == pytest.approx(1.0, abs=0.1)  # nothing predicts it better than its mean
    assert errors[1] == pytest.approx(0.01, rel=0.3)
    assert errors[1] < errors[2] < errors[0]


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_vector_field_gives_its_outputs_in_the_unit_of_the_errors_of_the_filter(
    backend: str,
) -> None:
    model, data = exact(), dataset(4, seed=3, rows=40)
    channels, field = model.channels, model.field
    assert isinstance(field, Perceptron)
    assert field.unit is not None
    errors = model.filters.error
    hidden = torch.ones(model.hidden_size, dtype=torch.float64)
    torch.testing.assert_close(field.unit.double(), torch.cat([errors, errors, hidden]))
    field.unit = torch.cat([torch.tensor([0.5, 0.25, 2.0] * 2).double()[: 2 * channels], hidden])
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        field.weights[-1].normal_(0.0, 0.3, generator=generator)
        field.biases[-1].normal_(0.0, 0.3, generator=generator)
    weight, bias = field.weights[-1].detach().clone(), field.biases[-1].detach().clone()
    with kernels.use(backend):
        got = model(model.batch(data)).mean
        (to_weight,) = torch.autograd.grad(got.square().sum(), [field.weights[-1]])
        with torch.no_grad():
            field.weights[-1].mul_(field.unit[:, None])
            field.biases[-1].mul_(field.unit)
        unit, field.unit = field.unit, None
        expected = model(model.batch(data)).mean
        (to_product,) = torch.autograd.grad(expected.square().sum(), [field.weights[-1]])
    assert not torch.equal(weight, field.weights[-1])
    assert not torch.equal(bias, field.biases[-1])
    torch.testing.assert_close(got, expected, rtol=1e-12, atol=0)
    torch.testing.assert_close(to_weight, to_product * unit[:, None], rtol=1e-9, atol=1e-12)


# --- gains ----------------------------------------------------------------------------------------


def filters(seed: int, channels: int) -> Filters:
    random = np.random.default_rng(seed)
    low, high = np.array([[-3, -4, -5, -9], [1, 1, 5, 4]])[..., None]
    table = torch.from_numpy(10 ** random.uniform(low, high, (4, channels)))
    return Filters(table, torch.ones(channels, dtype=torch.float64))


def test_compiled_gains_are_those_of_pytorch(monkeypatch: pytest.MonkeyPatch) -> None:
    if not cpu.has_trends():
        pytest.skip("the compiled backend was not built")
    random, own = np.random.default_rng(0), filters(0, 5)
    delta = torch.from_numpy(10 ** random.uniform(-3, 2, (3, 40, 5)))
    mask, started = (torch.from_numpy(random.random(s) < 0.5) for s in ((3, 40, 5), (3, 5)))
    given = (delta, mask, started, own.prior().expand(3, -1, -1))
    got = own.gains(*given, unit=0.3, dtype=torch.float64)
    monkeypatch.setattr(cpu, "has_trends", lambda: False)
    for one, other in zip(got, own.gains(*given, unit=0.3, dtype=torch.float64), strict=True):
        torch.testing.assert_close(one, other, rtol=1e-12, atol=0)


@pytest.mark.parametrize("seed", range(5))
def test_gains_at_equal_times_reach_those_of_the_riccati_equation(seed: int) -> None:
    own, gap = filters(seed, 1), 0.7
    clock, damping, drive, walk = own.table[:, 0].tolist()
    step = transition(np.array(gap / clock), damping, drive, walk, 2)
    f = np.array([[1.0, step.matrix[0][1]], [0.0, step.matrix[1][1]]])
    noise = step.noise
    q = np.array([[noise[0, 0], noise[0, 1]], [noise[0, 1], noise[1, 1]]])
    before = solve_discrete_are(f.T, np.array([[1.0], [0.0]]), q, np.eye(1))
    expected = before[0] / (before[0, 0] + 1)
    rows = 4000
    level, slope, _ = own.gains(
        torch.full((1, rows, 1), gap, dtype=torch.float64),
        torch.ones((1, rows, 1), dtype=torch.bool),
        torch.zeros((1, 1), dtype=torch.bool),
        own.prior()[None],
        unit=clock,
        dtype=torch.float64,
    )
    got = [float(level[0, -1, 0]), float(slope[0, -1, 0])]
    np.testing.assert_allclose(got, expected, rtol=1e-4)


def test_gains_of_0_and_1_stay_so_under_any_correction() -> None:
    trend, gains = Trend(3).double(), torch.tensor([0.0, 0.5, 1.0], dtype=torch.float64)
    for a in (-100.0, 0.0, 2.0, 100.0):
        with torch.no_grad():
            trend.level.fill_(a)
        _, odds, _ = trend.weights()
        corrected = gains / (gains + (1 - gains) * odds)
        expected = [0.0, 1 / (1 + np.exp(-np.clip(a, -30, 30))), 1.0]
        assert corrected.tolist() == pytest.approx(expected, rel=1e-12)
        corrected.sum().backward()
        assert bool(trend.level.grad.isfinite().all())


# --- the trend ------------------------------------------------------------------------------------


@pytest.mark.parametrize("backend", BACKENDS)
def test_the_trend_is_the_solution_of_its_equation_for_any_damping(backend: str) -> None:
    """(1 - exp(-z)) / z by expm1, which does not cancel; with the gradient of the damping."""
    damping = torch.tensor(10.0 ** np.linspace(-12, 2, 29), requires_grad=True)
    n = len(damping)
    spec = ScanSpec(channels=n, hidden_size=1, cell="start", gates=1, anchored=True, trend=True)
    one = torch.ones(1, 1, dtype=torch.float64)
    zero = torch.zeros(1, 1, n, dtype=torch.float64)
    rows = StepInputs(1.7 * one, 0 * one, zero, zero, level_gain=zero, slope_gain=zero)
    cell = small_model("anchored_trend", TRAIN, hidden_size=1, cell="start").cell
    cell.inputs = torch.nn.Parameter(torch.zeros(1, 2 * n, dtype=torch.float64))
    cell.innovation = torch.nn.Parameter(torch.zeros(1, n, dtype=torch.float64))
    parts = ScanParts(
        cell=cell, trend=(damping, torch.ones_like(damping), torch.ones_like(damping))
    )
    state = torch.cat([torch.zeros(n), torch.ones(n), torch.zeros(1)]).double()[None]
    with kernels.use(backend):
        before, _ = kernels.scan(spec, parts, rows, state)
    k = damping.detach().numpy()
    z = 1.7 * k
    np.testing.assert_allclose(before[0, 0, :n].detach(), -np.expm1(-z) / k, rtol=1e-13)
    np.testing.assert_allclose(before[0, 0, n : 2 * n].detach(), np.exp(-z), rtol=1e-13)
    (got,) = torch.autograd.grad(before[0, 0, :n].sum(), damping)
    # The derivative by its series where the closed form cancels.
    close = -(1.7**2) * (1 / 2 - z / 3 + z**2 / 8 - z**3 / 30 + z**4 / 144)
    closed = (1.7 * np.exp(-z) * k + np.expm1(-z)) / k**2
    np.testing.assert_allclose(got, np.where(z < 1e-2, close, closed), rtol=1e-9)


def test_noise_is_filtered_and_a_slope_continues() -> None:
    random = np.random.default_rng(0)
    times = 0.1 * np.arange(200.0)

    def line(slope: float) -> Trajectory:
        values = slope * times[:, None] + random.normal(size=(200, 1))
        return Trajectory(times, values)

    model = make_model("anchored_trend", Dataset(tuple(line(s) for s in (-2, -1, 1, 2))), **SMALL)
    one = line(1.5)
    got = predictions(model, model.batch(Dataset((one,))))[0, 50:, 0].numpy()
    got = got * model.scaler.scale[0] + model.scaler.shift[0]
    true = 1.5 * times[50:]
    assert np.sqrt(np.mean((got - true) ** 2)) < 0.6  # an observation is off by 1


# --- what is refused, and what is saved -----------------------------------------------------------


def test_a_trend_needs_anchored_channels_and_filters() -> None:
    with pytest.raises(InputError, match="trend is an option of anchored models"):
        make_model("ode_rnn", TRAIN, trend=True)
    model = exact()
    data = make_model("anchored_ode_gru_d", TRAIN, **SMALL).data
    with pytest.raises(InputError, match="needs a filter for each of its 3 channels"):
        Model(model.config, data)


def with_filters_of_length(count: int, model: Model, folder: Path) -> Path:
    """A checkpoint whose filters have another number of values."""
    own = model.statistics
    filters = tuple(each[:count] for each in own.filters)
    model.statistics = replace(own, filters=filters)
    model.save(folder)
    model.statistics = own
    return folder


def test_a_file_without_errors_of_filters_has_its_vector_field_in_standard_deviations(
    tmp_path: Path,
) -> None:
    model, data = small_model("anchored_trend", TRAIN), dataset(3, seed=4)
    assert isinstance(model.field, Perceptron)
    loaded = load_model(with_filters_of_length(4, model, tmp_path / "old"))
    batch = model.batch(data)
    assert not torch.equal(predictions(loaded, batch), predictions(model, batch))
    model.field.unit = None
    assert torch.equal(predictions(loaded, batch), predictions(model, batch))
    stream, same = Stream(loaded), Stream(model)
    for each in (stream, same):
        each.observe(0.0, data[0].values[0])
    assert np.array_equal(stream.predict(0.5), same.predict(0.5))


def test_filters_of_another_length_are_refused_in_one_line(tmp_path: Path) -> None:
    folder = with_filters_of_length(3, small_model("anchored_trend", TRAIN), tmp_path / "damaged")
    with pytest.raises(FileFormatError, match=r"a filter has 5 numbers .*, got 3") as error:
        load_model(folder)
    assert "\n" not in str(error.value)


def test_filters_are_tuned_on_tasks_where_nothing_is_masked() -> None:
    whole = Dataset(tuple(Trajectory(t.times, t.values) for t in TRAIN))
    found = tune_filters(whole)
    assert found == tune_filters(whole)
    assert all(np.isfinite(each).all() and each[0] > 0 for each in found)


def test_the_large_model_differs_in_size_and_rate_alone() -> None:
    small, large = MODELS["anchored_trend"], MODELS["anchored_trend_large"]
    differ = {k for k in large.options if large.options[k] != small.options.get(k)}
    assert differ == {"hidden_size", "field_units"}
    assert {k for k in large.recipe if large.recipe[k] != small.recipe[k]} == {"learning_rate"}


def test_a_table_of_step_inputs_gives_the_bits_of_the_rows() -> None:
    model, data = small_model("anchored_trend", TRAIN), dataset(5)
    batch = model.batch(data)
    with torch.no_grad():
        whole = model(batch).mean
        table = model.run(model.prepare(batch).take(torch.arange(5))).mean
    assert torch.equal(whole, table)
    assert error(model.run(model.step_inputs(batch)[0]).mean.detach(), whole) == 0
