"""Every model against an answer known from elsewhere: closed equations, or another library."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
import torchdiffeq
from model_helpers import (
    SMALL,
    dataset,
    draw_weights,
    error,
    predictions,
    small_model,
    trajectory,
    with_growing_decays,
    with_observed,
)
from torch import Tensor, nn

from offbeat import (
    Batch,
    Dataset,
    InputError,
    Model,
    Trajectory,
    kernels,
    make_model,
    thesis_config,
)
from offbeat.models.zoo import THESIS_MODELS, ZOO

ROWS = 9
FIRST_ROW = [True, False, True]
"""Observed channels of the first row: clocks start there, as in the thesis."""


def sample(*, whole_rows: bool = False, seed: int = 5) -> Dataset:
    """One trajectory with masked rows, masks per channel, and something observed in row 0."""
    one = trajectory(seed, ROWS, whole_rows=whole_rows)
    observed = one.observed.copy()
    observed[0] = True if whole_rows else FIRST_ROW
    observed[3] = observed[4] = False
    observed[5] = True if whole_rows else [False, True, True]
    return Dataset((with_observed(one, observed),))


def late_sample(*, whole_rows: bool = False) -> Dataset:
    """The same with nothing observed in the first two rows."""
    (one,) = sample(whole_rows=whole_rows)
    observed = one.observed.copy()
    observed[:2] = False
    observed[2] = True if whole_rows else FIRST_ROW
    return Dataset((with_observed(one, observed),))


def rows_of(model: Model, data: Dataset) -> list[tuple[float, Tensor, Tensor]]:
    """Of the first trajectory: model time, scaled values with 0 where masked, and mask."""
    one = data[0]
    values = torch.from_numpy(model.scaler.scaled(one.values))
    mask = torch.tensor(one.observed)
    times = (one.times - one.times[0]) / model.time_unit
    hidden = torch.where(mask, values, 0.0)
    return [(float(t), v, m) for t, v, m in zip(times, hidden, mask, strict=True)]


def median_gap(model: Model) -> float:
    """In model time."""
    return float(model.config.typical_gap or 0)


def decoded(model: Model, h: Tensor) -> Tensor:
    weights, biases = model.head.decoder.weights, model.head.decoder.biases  # type: ignore[union-attr]
    return weights[1] @ torch.tanh(weights[0] @ h + biases[0]) + biases[1]


def field_of(model: Model) -> nn.Module:
    """The vector field as a module of torch's own, as torchdiffeq takes it."""
    nonlinearity = {"tanh": nn.Tanh, "silu": nn.SiLU}[model.config.activation or ""]
    layers: list[nn.Module] = []
    for weight, bias in model.field.layers:  # type: ignore[union-attr]
        linear = nn.Linear(weight.shape[1], weight.shape[0], dtype=torch.float64)
        linear.load_state_dict({"weight": weight.detach(), "bias": bias.detach()})
        layers += [linear, nonlinearity()]
    body = nn.Sequential(*layers[:-1])

    class Autonomous(nn.Module):
        def forward(self, _: Tensor, y: Tensor) -> Tensor:
            return body(y)

    return Autonomous()


def integrated(model: Model, y: Tensor, gap: float, method: str, **options: Any) -> Tensor:
    if gap == 0:
        return y
    steps = options.pop("steps", 1)
    grid = torch.linspace(0, gap, steps + 1, dtype=torch.float64)
    if method == "dopri5":
        grid, options = grid[[0, -1]], {"rtol": 1e-11, "atol": 1e-12}
    return torchdiffeq.odeint(field_of(model), y, grid, method=method, **options)[-1]


def gru_by_matrices(model: Model, h: Tensor, x: Tensor) -> Tensor:
    """Equations 20 to 23, gates in the order update, reset, candidate."""
    cell = model.cell
    w_z, w_r, w_h = cell.inputs.chunk(3)
    u_z, u_r, u_h = cell.recurrent.chunk(3)  # type: ignore[union-attr]
    b_z, b_r, b_h = cell.bias.chunk(3)
    z = torch.sigmoid(u_z @ h + w_z @ x + b_z)
    r = torch.sigmoid(u_r @ h + w_r @ x + b_r)
    candidate = torch.tanh(u_h @ (r * h) + w_h @ x + b_h)
    return (1 - z) * h + z * candidate


def states_of(model: Model, data: Dataset) -> tuple[Tensor, Tensor, Tensor]:
    """Predictions, states before and after each row, of the first trajectory; of both bodies."""
    batch = model.batch(data)
    with torch.no_grad():
        output = model(batch)
        with kernels.use("reference"):
            reference = model(batch)
    for name in ("mean", "before", "after"):
        assert error(getattr(output, name), getattr(reference, name)) < 1e-13, name
    return output.mean[0], output.before[0], output.after[0]


# --- cells against torch.nn -----------------------------------------------------------------------


def plain_inputs(model: Model, data: Dataset) -> list[tuple[bool, Tensor]]:
    """Of each row: whether it is observed, and [values, mask, time since the last observed row]."""
    found, latest = [], None
    for time, values, mask in rows_of(model, data):
        age = 0.0 if latest is None else (time - latest) / median_gap(model)
        found.append(
            (
                bool(mask.any()),
                torch.cat([values, mask.double(), torch.tensor([age], dtype=torch.float64)]),
            )
        )
        latest = time if mask.any() else latest
    return found


def test_lstm_is_torchs_lstm_cell_at_observed_rows() -> None:
    data = sample()
    model = small_model("lstm")
    n = model.hidden_size
    torchs = nn.LSTMCell(7, n, dtype=torch.float64)
    forget, insert, node, output = range(4)
    order = torch.cat([torch.arange(n) + n * gate for gate in (insert, forget, node, output)])
    with torch.no_grad():
        torchs.weight_ih.copy_(model.cell.inputs[order])
        torchs.weight_hh.copy_(model.cell.recurrent[order])  # type: ignore[index]
        torchs.bias_ih.copy_(model.cell.bias[order])
        torchs.bias_hh.zero_()
        h, c, expected = torch.zeros(n).double(), torch.zeros(n).double(), []
        for observed, x in plain_inputs(model, data):
            if observed:
                h, c = torchs(x, (h, c))
            expected.append(torch.cat([h, c]))
    _, _, after = states_of(model, data)
    assert error(after, torch.stack(expected)) < 1e-14


def test_rnn_is_torchs_rnn_cell_at_observed_rows() -> None:
    data = sample()
    model = small_model("rnn")
    torchs = nn.RNNCell(7, model.hidden_size, dtype=torch.float64)
    with torch.no_grad():
        torchs.weight_ih.copy_(model.cell.inputs)
        torchs.weight_hh.copy_(model.cell.recurrent)  # type: ignore[arg-type]
        torchs.bias_ih.copy_(model.cell.bias)
        torchs.bias_hh.zero_()
        h, expected = torch.zeros(model.hidden_size).double(), []
        for observed, x in plain_inputs(model, data):
            h = torchs(x, h) if observed else h
            expected.append(h)
    _, _, after = states_of(model, data)
    assert error(after, torch.stack(expected)) < 1e-14


def test_gru_that_resets_after_is_torchs_gru_cell_with_z_for_1_minus_z() -> None:
    data = sample()
    model = small_model("gru", reset_after=True)
    cell, n = model.cell, model.hidden_size
    torchs = nn.GRUCell(7, n, dtype=torch.float64)
    # torch's order is reset, update, new; its update gate keeps the old state: sigmoid(-a).
    order = torch.cat([torch.arange(n) + n, torch.arange(n), torch.arange(n) + 2 * n])
    sign = torch.ones(3 * n).double()
    sign[n : 2 * n] = -1
    with torch.no_grad():
        torchs.weight_ih.copy_(cell.inputs[order] * sign[:, None])
        torchs.weight_hh.copy_(cell.recurrent[order] * sign[:, None])  # type: ignore[index]
        torchs.bias_ih.copy_(cell.bias[order] * sign)
        torchs.bias_hh.zero_()
        torchs.bias_hh[2 * n :] = cell.recurrent_bias
        h, expected = torch.zeros(n).double(), []
        for observed, x in plain_inputs(model, data):
            h = torchs(x, h) if observed else h
            expected.append(h)
    _, _, after = states_of(model, data)
    assert error(after, torch.stack(expected)) < 1e-14


# --- GRU, equations 20-23, and GRU-D, equations 24-32, in plain floats ----------------------------


def sigmoid(x: float) -> float:
    return 1 / (1 + math.exp(-x))


def gru_in_floats(model: Model, h: list[float], x: list[float]) -> list[float]:
    """Equations 20 to 23, or 29 to 32 where x is x-hat and mask."""
    n = len(h)
    inputs, bias = model.cell.inputs.tolist(), model.cell.bias.tolist()
    recurrent = model.cell.recurrent.tolist()  # type: ignore[union-attr]

    def gate(row: int, state: list[float]) -> float:
        total = bias[row]
        for weight, value in zip(inputs[row], x, strict=True):
            total += weight * value
        for weight, value in zip(recurrent[row], state, strict=True):
            total += weight * value
        return total

    z = [sigmoid(gate(j, h)) for j in range(n)]
    r = [sigmoid(gate(n + j, h)) for j in range(n)]
    reset = [r[j] * h[j] for j in range(n)]
    candidate = [math.tanh(gate(2 * n + j, reset)) for j in range(n)]
    return [(1 - z[j]) * h[j] + z[j] * candidate[j] for j in range(n)]


@pytest.mark.parametrize("time_input", ["none", "elapsed", "gap", "delta"])
@pytest.mark.parametrize("time_input_unit", ["gap", "longest"])
@pytest.mark.parametrize("update_rows", ["observed", "every"])
def test_gru_is_equations_20_to_23_in_plain_floats(
    time_input: str, time_input_unit: str, update_rows: str
) -> None:
    data = sample()
    model = small_model(
        "gru", time_input=time_input, time_input_unit=time_input_unit, update_rows=update_rows
    )
    longest = model.statistics.longest_delta / model.time_unit
    unit = median_gap(model) if time_input_unit == "gap" else longest
    assert longest > 2 * median_gap(model)
    h, after = [0.0] * model.hidden_size, []
    before = latest = 0.0
    delta = [0.0] * 3
    for i, (time, values, mask) in enumerate(rows_of(model, data)):
        if i:
            delta = [d + time - before for d in delta]
        age = {
            "none": [],
            "elapsed": [(time - latest) / unit],
            "gap": [(time - before) / unit],
            "delta": [d / unit for d in delta],
        }[time_input]
        if mask.any() or update_rows == "every":
            h = gru_in_floats(model, h, [*values.tolist(), *map(float, mask.tolist()), *age])
        after.append(h)
        latest = time if mask.any() else latest
        delta = [0.0 if m else d for d, m in zip(delta, mask.tolist(), strict=True)]
        before = time
    _, _, got = states_of(model, data)
    assert error(got, torch.tensor(after, dtype=torch.float64)) < 1e-13


def gru_d_in_floats(
    model: Model, data: Dataset, *, decay_rows: str, update_rows: str
) -> tuple[Tensor, Tensor]:
    """Equations 24 to 32, and the three meanings of a row at which the cell does not act.

    - `continuous`: between updates h is gamma_h(delta) times the state of the last update. With
      nodes at observations, that state is what is kept.
    - `every_row`: each row multiplies h by gamma_h of the cumulative delta; it compounds.
    - `observed_rows`: h decays only where the cell acts, and is left alone elsewhere.
    """
    n, channels = model.hidden_size, 3
    w_h, b_h = model.decay.weight.tolist(), model.decay.bias.tolist()  # type: ignore[union-attr]
    w_x = model.input_decay.weight.tolist()  # type: ignore[union-attr]
    b_x = model.input_decay.bias.tolist()  # type: ignore[union-attr]
    mean = list(model.statistics.mean)
    last, delta, time_before = list(mean), [0.0] * channels, 0.0
    mask_before = [True] * channels
    updated_h = h = [0.0] * n
    before, after = [], []
    for i, (time, values, observed) in enumerate(rows_of(model, data)):
        mask = observed.tolist()
        for d in range(channels):  # equation 25
            if i == 0:
                delta[d] = 0.0
            elif mask_before[d]:
                delta[d] = time - time_before
            else:
                delta[d] = time - time_before + delta[d]
        gamma_h = []
        for j in range(n):  # equation 26, full matrix
            total = b_h[j]
            for d in range(channels):
                total += w_h[j][d] * delta[d]
            gamma_h.append(math.exp(-max(0.0, total)))
        acts = any(mask) or update_rows == "every"
        if decay_rows == "continuous":
            arrived = [g * u for g, u in zip(gamma_h, updated_h, strict=True)]
        elif decay_rows == "every_row" or acts:
            arrived = [g * u for g, u in zip(gamma_h, h, strict=True)]  # equation 28
        else:
            arrived = h
        x_hat = []
        for d in range(channels):  # equations 26, diagonal, and 27
            gamma_x = math.exp(-max(0.0, w_x[d] * delta[d] + b_x[d]))
            faded = gamma_x * last[d] + (1 - gamma_x) * mean[d]
            x_hat.append(float(values[d]) if mask[d] else faded)
        before.append(arrived)
        h = arrived
        if acts:
            h = updated_h = gru_in_floats(model, arrived, [*x_hat, *map(float, mask)])
        after.append(updated_h if model.spec.nodes else h)
        last = [float(values[d]) if mask[d] else last[d] for d in range(channels)]
        mask_before, time_before = mask, time
    return torch.tensor(before, dtype=torch.float64), torch.tensor(after, dtype=torch.float64)


@pytest.mark.parametrize("whole_rows", [True, False], ids=["whole_rows", "per_channel"])
@pytest.mark.parametrize("update_rows", ["observed", "every"])
@pytest.mark.parametrize("decay_rows", ["continuous", "every_row", "observed_rows"])
@pytest.mark.parametrize("readout", ["target", "last_row"])
@pytest.mark.parametrize("pick", [sample, late_sample])
def test_gru_d_is_equations_24_to_32_in_plain_floats(
    pick: Callable[..., Dataset],
    readout: str,
    decay_rows: str,
    update_rows: str,
    whole_rows: bool,
) -> None:
    data = pick(whole_rows=whole_rows)
    options = {"decay_rows": decay_rows, "update_rows": update_rows, "readout": readout}
    try:
        model = small_model("gru_d", clock="first_row", **options)
    except InputError:
        pytest.skip("these options do not go together")
    before, after = gru_d_in_floats(model, data, decay_rows=decay_rows, update_rows=update_rows)
    got, got_before, got_after = states_of(model, data)
    assert error(got_before, before) < 1e-13
    assert error(got_after, after) < 1e-13
    start = torch.zeros(1, model.hidden_size, dtype=torch.float64)
    read = before if readout == "target" else torch.cat([start, after[:-1]])
    with torch.no_grad():
        assert error(got, torch.stack([decoded(model, h) for h in read])) < 1e-13


def test_in_gru_d_the_weight_of_gamma_x_is_diagonal_and_that_of_gamma_h_full() -> None:
    model = small_model("gru_d")
    assert model.input_decay.weight.shape == (3,)  # type: ignore[union-attr]
    assert model.decay.weight.shape == (4, 3)  # type: ignore[union-attr]


def test_before_its_first_observation_x_hat_is_the_training_mean_of_observed_values() -> None:
    train = dataset(6, seed=9)
    model = small_model("gru_d", train)
    cells = np.concatenate([model.scaler.scaled(t.values) for t in train])
    seen = np.concatenate([t.observed for t in train])
    means = [cells[seen[:, d], d].mean() for d in range(3)]
    assert model.statistics.mean == pytest.approx(means, abs=1e-6)


# --- RNN-Decay, ODE-RNN, ODE-GRU-D, Neural ODE ----------------------------------------------------


@pytest.mark.parametrize("decay", ["vector", "scalar"])
@pytest.mark.parametrize("decay_rows", ["continuous", "every_row"])
def test_rnn_decay_multiplies_by_exp_of_minus_tau_times_the_gap(
    decay: str, decay_rows: str
) -> None:
    data = sample()
    model = small_model("rnn_decay", decay=decay, time_input="none", decay_rows=decay_rows)
    tau = torch.log1p(torch.exp(model.decay.raw_tau.detach()))  # type: ignore[union-attr, operator]
    assert tau.shape == ((1,) if decay == "scalar" else (4,))
    h, before, time_before = torch.zeros(4).double(), [], 0.0
    with torch.no_grad():
        for time, values, mask in rows_of(model, data):
            h = h * torch.exp(-tau * (time - time_before))  # equation 42
            before.append(h)
            if mask.any():
                h = gru_by_matrices(model, h, torch.cat([values, mask.double()]))
            time_before = time
    assert error(states_of(model, data)[1], torch.stack(before)) < 1e-14


def ode_rnn_by_torchdiffeq(model: Model, data: Dataset, method: str, **options: Any) -> Tensor:
    """Algorithm 2: the gap that leads to an observation comes before its update."""
    h, before, time_before = torch.zeros(model.hidden_size).double(), [], 0.0
    with torch.no_grad():
        for time, values, mask in rows_of(model, data):
            h = integrated(model, h, time - time_before, method, **options)
            before.append(h)
            if mask.any():
                h = gru_by_matrices(model, h, torch.cat([values, mask.double()]))
            time_before = time
    return torch.stack(before)


@pytest.mark.parametrize("steps", [1, 3])
@pytest.mark.parametrize(("solver", "method"), [("euler", "euler"), ("midpoint", "midpoint")])
@pytest.mark.parametrize("pick", [sample, late_sample])
def test_ode_rnn_is_a_loop_over_torchdiffeq_step_by_step(
    pick: Callable[..., Dataset], solver: str, method: str, steps: int
) -> None:
    data = pick()
    options: dict[str, Any] = {"solver": solver, "steps_per_gap": steps, "clock": "first_row"}
    model = small_model("ode_rnn", nodes="rows", **options)
    expected = ode_rnn_by_torchdiffeq(model, data, method, steps=steps)
    got, before, _ = states_of(model, data)
    assert error(before, expected) < 1e-13
    with torch.no_grad():
        assert error(got, torch.stack([decoded(model, h) for h in expected])) < 1e-13


@pytest.mark.parametrize("activation", ["tanh", "silu"])
@pytest.mark.parametrize("solver", ["heun", "rk4", "dopri5", "tsit5"])
def test_ode_rnn_is_a_loop_over_torchdiffeq_within_the_tolerance_of_the_solver(
    solver: str, activation: str
) -> None:
    data = sample()
    model = small_model(
        "ode_rnn",
        solver=solver,
        activation=activation,
        steps_per_gap=100 if solver == "heun" else 10,
        rtol=1e-9,
        atol=1e-10,
    )
    expected = ode_rnn_by_torchdiffeq(model, data, "dopri5")
    assert error(states_of(model, data)[1], expected) < (1e-5 if solver == "heun" else 1e-7)


def test_a_largest_step_takes_as_many_equal_steps_as_each_gap_needs() -> None:
    data = sample()
    model = small_model("ode_rnn", max_step=0.11, nodes="rows")
    h, before, time_before = torch.zeros(4).double(), [], 0.0
    with torch.no_grad():
        for time, values, mask in rows_of(model, data):
            gap = time - time_before
            h = integrated(model, h, gap, "euler", steps=max(1, math.ceil(gap / 0.11 - 1e-6)))
            before.append(h)
            if mask.any():
                h = gru_by_matrices(model, h, torch.cat([values, mask.double()]))
            time_before = time
    assert error(states_of(model, data)[1], torch.stack(before)) < 1e-13


def by_nodes(model: Model, y: Tensor, time: float, method: str) -> Tensor:
    """`time` after the last observed row: whole steps from node to node, then a shorter one."""
    step = float(model.spec.max_step or 0)
    whole = math.floor(time / step + 1e-6)
    for _ in range(whole):
        y = integrated(model, y, step, method)
    return integrated(model, y, time - whole * step, method)


@pytest.mark.parametrize(("solver", "method"), [("euler", "euler"), ("midpoint", "midpoint")])
@pytest.mark.parametrize("options", [{}, {"max_step": 0.11}, {"steps_per_gap": 4}])
@pytest.mark.parametrize("clock", ["first_row", "first_observation"])
def test_nodes_lie_at_equal_times_after_the_last_observed_row(
    clock: str, options: dict[str, Any], solver: str, method: str
) -> None:
    data = sample()
    model = small_model("ode_rnn", solver=solver, clock=clock, **options)
    expected = {"max_step": 0.11}.get(
        next(iter(options), ""), 0.3 / options.get("steps_per_gap", 1)
    )
    assert model.spec.max_step == pytest.approx(expected)
    h, latest, before = torch.zeros(4).double(), 0.0, []
    with torch.no_grad():
        for time, values, mask in rows_of(model, data):
            arrived = by_nodes(model, h, time - latest, method)
            before.append(arrived)
            if mask.any():
                h, latest = (
                    gru_by_matrices(model, arrived, torch.cat([values, mask.double()])),
                    time,
                )
    assert error(states_of(model, data)[1], torch.stack(before)) < 1e-12


@pytest.mark.parametrize("decay", ["trainable", "vector", "scalar"])
def test_between_nodes_h_decays_by_what_its_exponent_grows(decay: str) -> None:
    """Lie splitting from node to node: before each step, and before the step that reads a row."""
    data = sample()
    model = small_model("ode_rnn", decay=decay)
    step, h, latest = float(model.spec.max_step or 0), torch.zeros(4).double(), 0.0
    delta, fresh, before = torch.zeros(3).double(), False, []

    def exponent(since: float) -> Tensor:
        if decay == "trainable":
            weight, bias = model.decay.weight, model.decay.bias  # type: ignore[union-attr]
            return torch.relu(weight @ (delta + since) + bias)
        return nn.functional.softplus(model.decay.raw_tau).expand(4) * since  # type: ignore[union-attr, arg-type]

    with torch.no_grad():
        for time, values, mask in rows_of(model, data):
            since = time - latest
            whole = math.floor(since / step + 1e-6)
            applied = torch.zeros(4).double() if fresh else exponent(0.0)
            arrived = h
            for k in range(whole + 1):
                end = since if k == whole else step * (k + 1)
                grown = (exponent(end) - applied).clamp_min(0)
                arrived = integrated(model, torch.exp(-grown) * arrived, end - step * k, "euler")
                applied = torch.maximum(applied, exponent(end))
            before.append(arrived)
            if mask.any():
                h = gru_by_matrices(model, arrived, torch.cat([values, mask.double()]))
                delta = torch.where(mask, 0.0, delta + since)
                latest, fresh = time, True
    assert error(states_of(model, data)[1], torch.stack(before)) < 1e-12


@pytest.mark.parametrize("decay", ["trainable", "vector", "scalar"])
def test_ode_gru_d_is_algorithm_3_where_every_row_is_observed(decay: str) -> None:
    """ODESolve(f, decayed h, gap) by one Euler step, then the GRU-D cell."""
    data = Dataset((with_observed(sample()[0], True),))
    model = small_model("ode_gru_d", decay=decay, nodes="rows")
    h, before, time_before = torch.zeros(4).double(), [], 0.0
    with torch.no_grad():
        for time, values, mask in rows_of(model, data):
            gap = time - time_before
            if decay == "trainable":
                weight, bias = model.decay.weight, model.decay.bias  # type: ignore[union-attr]
                gamma = torch.exp(-torch.relu(weight.sum(dim=1) * gap + bias))
            else:
                tau = nn.functional.softplus(model.decay.raw_tau)  # type: ignore[union-attr, arg-type]
                gamma = torch.exp(-tau * gap)
            h = integrated(model, gamma * h, gap, "euler")
            before.append(h)
            h = gru_by_matrices(model, h, torch.cat([values, mask.double()]))
            time_before = time
    assert error(states_of(model, data)[1], torch.stack(before)) < 1e-13


@pytest.mark.parametrize("whole_rows", [True, False], ids=["whole_rows", "per_channel"])
@pytest.mark.parametrize("pick", [sample, late_sample])
def test_ode_gru_d_of_the_thesis_compounds_gamma_h_at_every_row(
    pick: Callable[..., Dataset], whole_rows: bool
) -> None:
    """Algorithm 3 on the grid of the thesis, from its first row on, read from the row before."""
    data = pick(whole_rows=whole_rows)
    model = small_model(thesis_config("ode_gru_d"))
    weight, bias = model.decay.weight, model.decay.bias  # type: ignore[union-attr]
    w_x, b_x = model.input_decay.weight, model.input_decay.bias  # type: ignore[union-attr]
    mean = torch.tensor(model.statistics.mean, dtype=torch.float64)
    last, delta, h, time_before = mean, torch.zeros(3).double(), torch.zeros(4).double(), 0.0
    expected = []
    with torch.no_grad():
        for time, values, mask in rows_of(model, data):
            gap = time - time_before
            delta = delta + gap
            expected.append(decoded(model, h))
            h = integrated(model, torch.exp(-torch.relu(weight @ delta + bias)) * h, gap, "euler")
            gamma_x = torch.exp(-torch.relu(w_x * delta + b_x))
            x_hat = torch.where(mask, values, gamma_x * last + (1 - gamma_x) * mean)
            if mask.any():
                h = gru_by_matrices(model, h, torch.cat([x_hat, mask.double()]))
            last, delta = torch.where(mask, values, last), torch.where(mask, 0.0, delta)
            time_before = time
    assert error(states_of(model, data)[0], torch.stack(expected)) < 1e-6
    # The mean of x-hat is kept in single precision; all else agrees to the last bits.
    model.mean.copy_(mean)
    assert error(states_of(model, data)[0], torch.stack(expected)) < 1e-13


@pytest.mark.parametrize(("name", "decay"), [("ode_gru_d", "trainable"), ("ode_rnn", "vector")])
def test_decay_and_flow_in_ever_shorter_steps_converge_to_the_adaptive_solution(
    name: str, decay: str
) -> None:
    """Lie splitting is of first order: ten times the steps, a tenth of the error."""
    data = sample()
    exact = states_of(small_model(name, decay=decay, solver="dopri5", rtol=1e-9, atol=1e-11), data)
    errors = [
        error(
            states_of(small_model(name, decay=decay, solver="rk4", steps_per_gap=n), data)[1],
            exact[1],
        )
        for n in (4, 40)
    ]
    assert errors[1] < 0.02
    assert 0.05 < errors[1] / errors[0] < 0.2


@pytest.mark.parametrize("method", ["euler", "dopri5"])
def test_neural_ode_starts_at_a_linear_map_of_the_first_observed_row(method: str) -> None:
    data = sample()
    observed = data[0].observed.copy()
    observed[0] = False
    observed[1] = [True, False, True]
    data = Dataset((with_observed(data[0], observed),))
    model = small_model("neural_ode", solver=method, rtol=1e-9, atol=1e-10, nodes="rows")
    rows = rows_of(model, data)
    _, values, mask = rows[1]
    with torch.no_grad():
        h = model.cell.inputs @ torch.cat([values, mask.double()]) + model.cell.bias
        zero = torch.zeros(4).double()
        expected = [zero, zero]
        time_before = rows[1][0]
        for time, _, _ in rows[2:]:
            h = integrated(model, h, time - time_before, method)
            expected.append(h)
            time_before = time
    tolerance = 1e-13 if method == "euler" else 1e-7
    assert error(states_of(model, data)[1], torch.stack(expected)) < tolerance


# --- anchored -------------------------------------------------------------------------------------


@pytest.mark.parametrize("decay", ["none", "trainable", "scalar"])
def test_anchored_is_the_loop_of_innovations_with_x_set_where_observed(decay: str) -> None:
    data = sample()
    model = small_model("anchored_ode_gru_d", decay=decay, nodes="rows", bounded=False)
    mean = torch.tensor(model.statistics.mean, dtype=torch.float64)
    std = torch.tensor(model.statistics.std, dtype=torch.float64)
    model.mean.copy_(mean)
    model.std.copy_(std)
    model.head.mean.copy_(mean)
    model.head.std.copy_(std)
    cell = model.cell
    u_z, u_r, u_h = cell.recurrent.chunk(3)  # type: ignore[union-attr]
    x, h = model.start.detach(), torch.zeros(4).double()  # type: ignore[union-attr]
    assert float(x.abs().max()) > 0.1
    expected, time_before, latest, delta = [], 0.0, 0.0, torch.zeros(3).double()
    unchanged = torch.zeros(3).double()
    damped = unchanged[:1].expand(4)
    with torch.no_grad():
        for time, values, mask in rows_of(model, data):
            gap = time - time_before
            delta = delta + gap
            if decay == "trainable":
                weight, bias = model.decay.weight, model.decay.bias  # type: ignore[union-attr]
                exponent = torch.relu(weight @ delta + bias)
            elif decay == "scalar":
                tau = nn.functional.softplus(model.decay.raw_tau)  # type: ignore[union-attr, arg-type]
                exponent = tau.expand(4) * (time - latest)
            else:
                exponent = damped
            h = h * torch.exp(-(exponent - damped).clamp_min(0))
            x, h = integrated(model, torch.cat([x, h]), gap, "euler").split([3, 4])
            expected.append(x * std + mean)
            damped = torch.maximum(exponent, damped)
            if mask.any():
                m = mask.double()
                standard = m * (values - mean) / std
                innovation = m * (standard - x)
                gate = cell.inputs @ torch.cat([standard, m]) + cell.bias
                gate = gate + cell.innovation @ innovation  # type: ignore[operator]
                a_z, a_r, a_h = gate.chunk(3)
                z, r = torch.sigmoid(a_z + u_z @ h), torch.sigmoid(a_r + u_r @ h)
                h = (1 - z) * h + z * torch.tanh(a_h + u_h @ (r * h))
                x = torch.where(mask, standard, x)
                damped, latest = torch.zeros(4).double(), time
            delta = torch.where(mask, 0.0, delta)
            time_before = time
    assert error(states_of(model, data)[0], torch.stack(expected)) < 1e-13


def test_anchored_repeats_the_last_values_where_its_field_is_zero() -> None:
    data = sample()
    model = small_model("anchored_ode_gru_d")
    with torch.no_grad():
        for parameter in model.field.parameters():  # type: ignore[union-attr]
            parameter.zero_()
    got, _, _ = states_of(model, data)
    last, seen = torch.zeros(3).double(), torch.zeros(3, dtype=torch.bool)
    for prediction, (_, values, mask) in zip(got, rows_of(model, data), strict=True):
        assert torch.allclose(prediction[seen], last[seen], rtol=0, atol=1e-6)
        last, seen = torch.where(mask, values, last), seen | mask
    assert seen.all()


# --- self-feeding ---------------------------------------------------------------------------------


def test_self_feeding_gru_takes_its_decoded_state_where_the_coin_says_so() -> None:
    data = sample()
    model = small_model(thesis_config("gru", self_feeding=0.5))
    generator = torch.Generator().manual_seed(11)
    drawn = [float(torch.rand((), generator=generator)) < 0.5 for _ in range(ROWS)]
    drawn[0] = False
    assert len(set(drawn)) == 2
    h, expected, time_before = torch.zeros(4).double(), [], 0.0
    with torch.no_grad():
        for fed, (time, values, mask) in zip(drawn, rows_of(model, data), strict=True):
            expected.append(decoded(model, h))
            gap = (time - time_before) / median_gap(model)
            shown = decoded(model, h) if fed else values
            if mask.any():
                h = gru_by_matrices(
                    model,
                    h,
                    torch.cat([shown, mask.double(), torch.tensor([gap], dtype=torch.float64)]),
                )
            time_before = time
    got = predictions(model, model.batch(data), generator=torch.Generator().manual_seed(11))
    assert error(got[0], torch.stack(expected)) < 1e-13


@pytest.mark.parametrize("whole_rows", [True, False], ids=["whole_rows", "per_channel"])
def test_self_feeding_gru_d_leaves_h_undecayed_at_hidden_rows_and_replaces_x_hat(
    whole_rows: bool,
) -> None:
    data = sample(whole_rows=whole_rows)
    model = small_model(thesis_config("gru_d", self_feeding=0.5))
    generator = torch.Generator().manual_seed(3)
    drawn = [float(torch.rand((), generator=generator)) < 0.5 for _ in range(ROWS)]
    drawn[0] = False
    mean = torch.tensor(model.statistics.mean, dtype=torch.float64)
    model.mean.copy_(mean)
    weight, bias = model.decay.weight, model.decay.bias  # type: ignore[union-attr]
    w_x, b_x = model.input_decay.weight, model.input_decay.bias  # type: ignore[union-attr]
    last, delta, h, time_before = mean, torch.zeros(3).double(), torch.zeros(4).double(), 0.0
    expected = []
    with torch.no_grad():
        for fed, (time, values, mask) in zip(drawn, rows_of(model, data), strict=True):
            delta = delta + time - time_before
            own = decoded(model, h)
            expected.append(own)
            if mask.any():
                gamma_x = torch.exp(-torch.relu(w_x * delta + b_x))
                x_hat = torch.where(mask, values, gamma_x * last + (1 - gamma_x) * mean)
                h = h * torch.exp(-torch.relu(weight @ delta + bias))
                h = gru_by_matrices(model, h, torch.cat([own if fed else x_hat, mask.double()]))
            last, delta = torch.where(mask, values, last), torch.where(mask, 0.0, delta)
            time_before = time
    got = predictions(model, model.batch(data), generator=torch.Generator().manual_seed(3))
    assert error(got[0], torch.stack(expected)) < 1e-13


def test_one_coin_is_drawn_per_row_for_the_whole_batch_and_never_at_row_0() -> None:
    """Fed at every row, a model sees no value after row 0, and all of row 0."""
    data = Dataset((sample()[0], with_observed(sample(seed=6)[0], True)))
    model = small_model("gru", self_feeding=1.0)
    batch = model.batch(data)
    later = batch.values.clone()
    later[:, 1:] += 1
    first = batch.values.clone()
    first[:, 0] += 1
    plain = predictions(model, batch)
    assert torch.equal(predictions(model, replace(batch, values=later)), plain)
    assert not torch.equal(predictions(model, replace(batch, values=first)), plain)
    half = small_model("gru", self_feeding=0.5)
    changed = predictions(half, replace(batch, values=later)) != predictions(half, batch)
    generator = torch.Generator().manual_seed(0)
    fed = [float(torch.rand((), generator=generator)) < 0.5 for _ in range(ROWS)]
    seen = next(i for i in range(1, ROWS) if not fed[i] and batch.mask[1, i].any())
    assert not changed[1, : seen + 1].any()
    assert changed[1, seen + 1].any()


def test_without_self_feeding_no_coin_is_drawn() -> None:
    model = small_model("gru")
    generator = torch.Generator().manual_seed(1)
    state = generator.get_state()
    predictions(model, model.batch(sample()), generator=generator)
    assert torch.equal(generator.get_state(), state)


# --- where a prediction is read -------------------------------------------------------------------


@pytest.mark.parametrize("name", sorted(ZOO))
def test_a_prediction_is_read_from_the_state_on_arrival_or_after_the_row_before(name: str) -> None:
    data = sample()
    for readout in ("target", "last_row"):
        model = small_model(name, readout=readout)
        got, before, after = states_of(model, data)
        start = model.empty_state(1).state
        states = before if readout == "target" else torch.cat([start, after[:-1]])
        with torch.no_grad():
            assert torch.equal(got, model.head.decode(states).mean)


# --- gradients ------------------------------------------------------------------------------------


def tiny(name: str, **options: Any) -> tuple[Model, Batch]:
    """Weights are positive where a maximum with 0 would bend the loss."""
    one = trajectory(2, 5, channels=2)
    observed = [[True, False], [False, False], [True, True], [False, True], [True, True]]
    data = Dataset((with_observed(one, observed),))
    sizes = {"hidden_size": 2, "decoder_units": (2,), "field_units": (2,), "typical_gap": 0.3}
    model = make_model(name, data, **{**sizes, **options}).double()
    draw_weights(model, seed=4)
    with_growing_decays(model)
    return model, model.batch(data)


def check_gradients(model: Model, batch: Batch, *, fast: bool = False) -> None:
    names = [name for name, _ in model.named_parameters()]
    weights = [p.detach().clone().requires_grad_() for p in model.parameters()]

    def run(*values: Tensor) -> Tensor:
        given = dict(zip(names, values, strict=True))
        output = torch.func.functional_call(model, given, (batch,))
        return output.mean.sum(dim=0)

    torch.autograd.gradcheck(run, weights, fast_mode=fast)


@pytest.mark.parametrize("name", sorted(ZOO))
def test_gradients_of_every_parameter_are_those_of_finite_differences(name: str) -> None:
    check_gradients(*tiny(name))


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("gru_d", {"decay_rows": "every_row", "readout": "last_row"}),
        ("gru_d", {"self_feeding": 0.5, "decay_rows": "observed_rows", "readout": "last_row"}),
        ("gru", {"reset_after": True, "update_rows": "every", "time_input": "delta"}),
        ("ode_gru_d", {"solver": "rk4", "steps_per_gap": 2}),
        ("anchored_ode_gru_d", {"decay": "trainable", "max_step": 0.2}),
    ],
)
def test_gradients_of_options_are_those_of_finite_differences(
    name: str, options: dict[str, Any]
) -> None:
    check_gradients(*tiny(name, **options), fast=True)


RK4 = {"solver": "rk4", "steps_per_gap": 15}
DOPRI5 = {"solver": "dopri5", "rtol": 1e-8, "atol": 1e-9}
TSIT5 = {"solver": "tsit5", "rtol": 1e-8, "atol": 1e-9}


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("neural_ode", RK4),
        ("neural_ode", TSIT5),
        ("ode_rnn", RK4),
        ("ode_rnn", DOPRI5),
        ("ode_rnn", {**DOPRI5, "decay": "scalar"}),
        ("ode_gru_d", RK4),
        ("ode_gru_d", DOPRI5),
        ("ode_gru_d", {**TSIT5, "decay": "vector"}),
        ("anchored_ode_gru_d", RK4),
        ("anchored_ode_gru_d", DOPRI5),
        ("anchored_ode_gru_d", {**TSIT5, "decay": "trainable"}),
    ],
)
def test_the_adjoint_method_gives_the_gradients_of_backpropagation(
    name: str, options: dict[str, Any]
) -> None:
    data = Dataset((sample()[0].slice(0, 6), trajectory(3, 4)))
    found = []
    for gradient in ("backprop", "adjoint"):
        model = with_growing_decays(small_model(name, gradient=gradient, **options))
        model(model.batch(data)).mean.square().sum().backward()
        found.append({k: p.grad for k, p in model.named_parameters()})
    for key, expected in found[0].items():
        assert error(found[1][key], expected) < 1e-6, key


# --- model time -----------------------------------------------------------------------------------


@pytest.mark.parametrize("name", sorted(ZOO))
def test_milliseconds_and_seconds_give_the_same_answers(name: str) -> None:
    options = {"units": ("m",) * 3}
    milliseconds = [np.round(t.times * 1024).astype(int) * 5 for t in dataset(4)]
    values = [(t.values, t.observed) for t in dataset(4)]
    got = []
    for unit in ("ms", "s"):
        made = [
            Trajectory.from_arrays(t, v, observed=o, time_unit="ms", **options)
            if unit == "ms"
            else Trajectory.from_arrays(t / 1000, v, observed=o, **options)
            for t, (v, o) in zip(milliseconds, values, strict=True)
        ]
        data = Dataset(tuple(made))
        model = small_model(name, data)
        got.append(predictions(model, model.batch(data)))
    # Seconds that were rounded before the first time was taken off differ in their last bits.
    assert error(got[0], got[1]) < 1e-12


@pytest.mark.parametrize("name", sorted(ZOO))
def test_milliseconds_taken_as_seconds_give_the_same_predictions(name: str) -> None:
    data = dataset(4)
    slow = Dataset(tuple(replace(t, times=t.times * 1000) for t in data))
    models = [small_model(name, train) for train in (data, slow)]
    assert models[1].time_unit == pytest.approx(1000 * models[0].time_unit, rel=1e-12)
    got = [predictions(m, m.batch(d)) for m, d in zip(models, (data, slow), strict=True)]
    assert error(got[1], got[0]) < 1e-12


def test_the_median_gap_of_training_is_the_typical_gap_in_model_time() -> None:
    train = dataset(6, seed=9)
    model = make_model("ode_rnn", train, **{**SMALL, "typical_gap": 0.25})
    gaps = np.concatenate([np.diff(t.times) for t in train])
    assert 0.25 * model.time_unit in gaps
    assert (gaps <= 0.25 * model.time_unit).mean() == pytest.approx(0.5, abs=0.03)


# --- initial weights ------------------------------------------------------------------------------


@pytest.mark.parametrize("name", sorted(ZOO))
def test_initial_weights_follow_from_the_seed(name: str) -> None:
    train = dataset(4)
    first, again, other = (make_model(name, train, seed=s, **SMALL) for s in (1, 1, 2))
    for (key, a), b in zip(first.named_parameters(), again.parameters(), strict=True):
        assert torch.equal(a, b), key
    assert any(
        not torch.equal(a, b) for a, b in zip(first.parameters(), other.parameters(), strict=True)
    )
    state = torch.get_rng_state()
    make_model(name, train, **SMALL)
    assert torch.equal(torch.get_rng_state(), state), "no global state is touched"


@pytest.mark.parametrize("name", THESIS_MODELS)
def test_weights_of_the_thesis_start_at_a_tenth_of_a_normal_and_biases_at_0(name: str) -> None:
    model = make_model(thesis_config(name), dataset(6, seed=9, channels=14))
    for key, parameter in model.named_parameters():
        if "bias" in key:
            assert not parameter.any(), key
        elif parameter.ndim == 2:
            assert parameter.square().mean().sqrt().item() == pytest.approx(0.1, rel=0.25), key
    for part in (model.decay, model.input_decay):
        if part is not None:
            assert bool((part.weight > 0).all()), "a negative weight of (26) gets no gradient"
    assert model.hidden_size == 15
    assert [w.shape for w in model.head.decoder.weights] == [(100, 15), (14, 100)]  # type: ignore[union-attr]
    if name.startswith("ode"):
        shapes = [(100, 15), (100, 100), (100, 100), (100, 100), (15, 100)]
        assert [w.shape for w in model.field.weights] == shapes  # type: ignore[union-attr]


def test_weights_of_the_anchored_model_start_at_1_over_fan_in() -> None:
    model = make_model("anchored_ode_gru_d", dataset(6, seed=9, channels=14))
    assert not model.start.any()  # type: ignore[union-attr]
    *inner, last = model.field.weights  # type: ignore[union-attr]
    assert [w.shape for w in (*inner, last)] == [(100, 46), (100, 100), (100, 100), (46, 100)]
    for weight in (*inner, model.cell.inputs, model.cell.recurrent, model.cell.innovation):
        expected = weight.shape[1] ** -0.5
        assert weight.square().mean().sqrt().item() == pytest.approx(expected, rel=0.1)
    assert last.square().mean().sqrt().item() == pytest.approx(0.1 * 0.1, rel=0.1)


# --- refusals -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"hiden_size": 3}, "did you mean 'hidden_size'"),
        ({"hidden_size": 0}, "hidden_size must be an integer of at least 1, got 0"),
        ({"hidden_size": 2.5}, "hidden_size must be an integer"),
        ({"hidden_size": True}, "hidden_size must be an integer"),
        ({"decoder_units": (5, 0)}, "decoder_units must be a list of layer sizes"),
        ({"field_units": 7}, "field_units must be a list of layer sizes"),
        ({"cell": "grru"}, "unknown cell 'grru'.*did you mean 'gru'"),
        ({"solver": "rk45"}, "unknown solver.*dopri5"),
        ({"activation": "relu"}, "expected one of: silu, tanh"),
        ({"decay": "yes"}, "unknown model option decay 'yes'"),
        ({"decay_rows": "all"}, "unknown model option decay_rows"),
        ({"update_rows": "all"}, "unknown model option update_rows"),
        ({"time_input": "age"}, "unknown model option time_input"),
        ({"readout": "here"}, "unknown model option readout"),
        ({"init": "xavier"}, "unknown model option init"),
        ({"gradient": "none"}, "unknown model option gradient"),
        ({"steps_per_gap": 0}, "steps_per_gap must be an integer of at least 1"),
        ({"max_step": 0.0}, "max_step must be a positive number"),
        ({"rtol": -1e-3}, "rtol must be a positive number"),
        ({"atol": float("nan")}, "atol must be a positive number"),
        ({"typical_gap": 0}, "typical_gap must be a positive number"),
        ({"typical_gap": float("inf")}, "typical_gap must be a positive"),
        ({"max_step": float("inf")}, "max_step must be a positive"),
        ({"max_step": 0.1, "steps_per_gap": 2}, "give max_step or steps_per_gap, not both"),
        ({"nodes": "observations", "update_rows": "every"}, "nodes='observations' needs update_r"),
        ({"nodes": "grid"}, "unknown model option nodes 'grid'"),
        ({"bounded": 1}, "bounded must be true or false"),
        ({"gap_limit": 0.5}, "gap_limit must be at least 1"),
        ({"gap_limit": float("nan")}, "gap_limit must be at least 1"),
        ({"gap_limit": float("inf")}, "gap_limit must be"),
        ({"self_feeding": 1.5}, "self_feeding must be a fraction from 0 to 1"),
        ({"self_feeding": "half"}, "self_feeding must be a fraction"),
        ({"reset_after": "no"}, "reset_after must be"),
        ({"input_decay": 2}, "input_decay must be"),
        ({"anchored": "no"}, "anchored must be"),
        ({"cell": "none"}, "needs a cell or a vector field"),
        ({"anchored": True, "vector_field": "mlp", "self_feeding": 0.5}, "self_feeding"),
        ({"anchored": True, "input_decay": True}, "leave input_decay off"),
        ({"cell": "none", "vector_field": "mlp", "self_feeding": 0.5}, "need a cell"),
    ],
    ids=lambda value: str(value)[:50] if isinstance(value, dict) else "",
)
def test_an_option_that_cannot_be_is_refused_by_name(options: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        make_model("gru", dataset(3), **options)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            {"max_step": 1e-6},
            "max_step=1e-06 reaches 0.00205 with its 2048 nodes, less than",
        ),
        ({"steps_per_gap": 4096}, "max_step=7.32e-05 reaches 0.15 with its 2048 nodes"),
    ],
)
def test_nodes_that_do_not_reach_the_next_row_are_refused(
    options: dict[str, Any], message: str
) -> None:
    with pytest.raises(InputError, match=message):
        small_model("ode_rnn", **options)
    small_model("ode_rnn", nodes="rows", **options)


def test_an_unknown_model_is_refused_with_the_choices() -> None:
    with pytest.raises(InputError, match=r"unknown model 'gru-d'.*did you mean 'gru_d'"):
        make_model("gru-d", dataset(2))
    with pytest.raises(InputError, match="unknown thesis model 'lstm'"):
        thesis_config("lstm")


def test_a_model_built_from_an_open_config_says_what_is_open() -> None:
    model = make_model("gru", dataset(2), **SMALL)
    with pytest.raises(InputError, match="not set: hidden_size"):
        Model(replace(model.config, hidden_size=None), model.data)


def test_channels_that_are_not_the_models_are_refused() -> None:
    model = make_model("gru", dataset(2), **SMALL)
    with pytest.raises(InputError, match="the batch has 2 channels, the model has 3"):
        model(Batch.of(dataset(2, channels=2)))
    for fields, message in (
        (
            {"names": ("a", "channel_1", "channel_2")},
            "lacks channel_0; the model does not know a",
        ),
        ({"units": ("cm", "m", "m")}, "channel_0 is in cm, not m"),
    ):
        other = Dataset(tuple(replace(t, **fields) for t in dataset(2)))
        with pytest.raises(InputError, match=message):
            model.batch(other)


def test_channels_in_another_order_are_put_in_the_models() -> None:
    model, data = make_model("gru", dataset(2), **SMALL), dataset(2)
    turned = [
        Trajectory(t.times, t.values[:, ::-1], observed=t.observed[:, ::-1], names=t.names[::-1])
        for t in data
    ]
    got, expected = model.batch(Dataset(tuple(turned))), model.batch(data)
    assert torch.equal(got.values, expected.values)
    assert torch.equal(got.mask, expected.mask)


def test_training_data_in_which_a_channel_is_never_observed_is_refused_by_name() -> None:
    one = dataset(1)[0]
    observed = one.observed.copy()
    observed[:, 1] = False
    with pytest.raises(InputError, match="channel_1"):
        make_model("gru", Dataset((with_observed(one, observed),)))
    with pytest.raises(InputError, match="at least one trajectory of two rows"):
        make_model("gru", Dataset((with_observed(one.slice(0, 1), True),)))


def test_a_state_without_a_generator_cannot_feed_itself() -> None:
    model = small_model("gru", self_feeding=0.5)
    batch = model.batch(sample())
    past = replace(model.empty_state(1), generator=None)
    with pytest.raises(InputError, match="give a generator"):
        model(batch, past=past)
