"""What every model must keep, whatever its parts: one suite over the zoo and its options.

A new entry of the zoo is covered without a new test: its option sets follow from its parts.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from model_helpers import (
    TICK,
    dataset,
    draw_weights,
    error,
    predictions,
    rows_of,
    small_model,
    trajectory,
    with_growing_decays,
    with_observed,
)
from torch import Tensor

from offbeat import (
    Batch,
    Dataset,
    InputError,
    Model,
    ModelConfig,
    Trajectory,
    kernels,
    load_model,
    make_model,
    predict,
    save_model,
    thesis_config,
)
from offbeat.kernels import cpu
from offbeat.models.model import Output
from offbeat.models.zoo import MODELS, THESIS_MODELS, resolve
from offbeat.parts import CELLS, FIELDS, HEADS

ZOO = [
    name
    for name, entry in MODELS.items()
    if entry.factory is None and not name.endswith("_large")  # another size of the same parts
]

FLOAT32, FLOAT64 = torch.float32, torch.float64
TOLERANCE = {FLOAT32: 1e-6, FLOAT64: 1e-12}


def option_sets(name: str) -> dict[str, dict[str, Any]]:
    """Of a zoo entry, by what its parts allow."""
    entry = resolve(ModelConfig(name=name))
    sets: dict[str, dict[str, Any]] = {"": {}, "first_row": {"clock": "first_row"}}
    if entry.cell != "none":
        sets["every"] = {
            "update_rows": "every",
            "time_input": "delta",
            "time_input_unit": "longest",
        }
        if not entry.anchored:
            sets["self_feeding"] = {"self_feeding": 0.5}
    if entry.cell == "gru":
        sets["reset_after"] = {"reset_after": True, "readout": "last_row"}
    if name in ("gru", "anchored_ode_gru_d"):
        sets |= {head: {"head": head} for head in HEADS if head != "point"}
    if name == "ode_rnn":
        sets |= {cell: {"cell": cell} for cell in CELLS if cell not in ("gru", "start")}
        sets |= {field: {"vector_field": field} for field in FIELDS if field != "mlp"}
    if entry.vector_field == "mlp":
        sets["dopri5"] = {"solver": "dopri5"}
        sets["max_step"] = {"solver": "midpoint", "max_step": 0.2, "activation": "silu"}
        if not entry.trend:
            sets["tsit5_scalar"] = {"solver": "tsit5", "decay": "scalar"}
        sets["adjoint"] = {"solver": "rk4", "steps_per_gap": 2, "gradient": "adjoint"}
    if entry.decay == "trainable":
        sets["every_row"] = {"decay_rows": "every_row"}
        if entry.vector_field == "mlp":
            sets["dopri5_every_row"] = {"decay_rows": "every_row", "solver": "dopri5"}
    elif entry.vector_field == "mlp":
        if not entry.trend:
            sets["decay"] = {"decay": "trainable"}
        sets["decay_max_step"] = {"decay": "trainable", "max_step": 0.2}
    return sets


VARIANTS: dict[str, ModelConfig] = {
    "-".join(filter(None, (name, key))): ModelConfig(name=name, **options)
    for name in ZOO
    for key, options in option_sets(name).items()
}
VARIANTS |= {f"thesis-{name}": thesis_config(name) for name in THESIS_MODELS}
VARIANTS |= {
    f"thesis-{name}-self_feeding": thesis_config(name, self_feeding=0.5)
    for name in ("gru", "gru_d")
}

variants = pytest.mark.parametrize("variant", list(VARIANTS))
dtypes = pytest.mark.parametrize("dtype", [FLOAT32, FLOAT64], ids=["float32", "float64"])


def build(variant: str, dtype: torch.dtype = FLOAT64, **options: Any) -> Model:
    return small_model(replace(VARIANTS[variant], **options), dtype=dtype)


# --- deterministic, finite, kept ------------------------------------------------------------------


@variants
def test_the_same_batch_gives_the_same_finite_predictions_bit_for_bit(variant: str) -> None:
    model, data = build(variant, FLOAT32), dataset(4)
    first = predictions(model, model.batch(data))
    assert bool(first.isfinite().all())
    assert torch.equal(predictions(model, model.batch(data)), first)
    assert torch.equal(predictions(build(variant, FLOAT32), model.batch(data)), first)
    assert float((first[:, 1:] - first[:, :-1]).abs().max()) > 1e-3, "nothing moves"


@variants
def test_single_and_double_precision_agree(variant: str) -> None:
    single, double = build(variant, FLOAT32), build(variant, FLOAT64)
    data = dataset(4)
    got, expected = (predictions(m, m.batch(data)) for m in (single, double))
    assert (got.dtype, expected.dtype) == (FLOAT32, FLOAT64)
    adaptive = bool(double.spec.field) and double.spec.solver in ("dopri5", "tsit5")
    assert error(got, expected) < (1e-3 if adaptive else 1e-5)


@variants
@dtypes
def test_a_saved_model_predicts_the_same_bit_for_bit(
    variant: str, dtype: torch.dtype, tmp_path: Path
) -> None:
    model, data = build(variant, dtype), dataset(3)
    save_model(model, tmp_path / "model")
    again = load_model(tmp_path / "model")
    assert again.config == model.config
    assert again.statistics == model.statistics
    assert (again.names, again.units) == (model.names, model.units)
    assert torch.equal(predictions(again, again.batch(data)), predictions(model, model.batch(data)))


# --- batch mates, padding, clocks -----------------------------------------------------------------


@variants
@dtypes
def test_batch_mates_and_padding_do_not_matter(variant: str, dtype: torch.dtype) -> None:
    model, data = build(variant, dtype), dataset(5)
    together = predictions(model, model.batch(data))
    for i, one in enumerate(data):
        alone = predictions(model, model.batch(Dataset((one,))))[0]
        assert error(together[i, : one.rows], alone) < TOLERANCE[dtype]


@variants
def test_what_stands_in_padding_is_never_looked_at(variant: str) -> None:
    model = build(variant)
    batch = model.batch(dataset(4))
    padding = ~batch.valid[..., None]
    assert bool(padding.any())
    rubbish = replace(
        batch,
        values=torch.where(padding, 1e6, batch.values),
        mask=batch.mask | padding,
        known=batch.known | padding,
    )
    assert torch.equal(predictions(model, rubbish), predictions(model, batch))


@variants
def test_a_shift_of_the_clock_changes_nothing(variant: str) -> None:
    model, data = build(variant, FLOAT32), dataset(3)
    plain = model.batch(data)
    expected = predictions(model, plain)
    for shift in (-3.0, 12.5, 1_700_000_000.0):
        moved = Dataset(tuple(replace(t, times=t.times + shift) for t in data))
        assert torch.equal(predictions(model, model.batch(moved)), expected)
        raw = replace(plain, times=plain.times + shift)
        assert torch.equal(predictions(model, raw), expected)


# --- causality, masked values ---------------------------------------------------------------------


@variants
def test_what_comes_at_or_after_a_row_changes_no_prediction_up_to_it(variant: str) -> None:
    model = build(variant)
    batch = model.batch(dataset(4))
    expected = predictions(model, batch)
    for row in (0, 2, 5):
        here = torch.arange(batch.rows)[:, None] >= row
        other_values = replace(batch, values=torch.where(here, batch.values + 10, batch.values))
        other_mask = replace(batch, mask=batch.mask ^ (here & batch.valid[..., None]))
        all_seen = replace(batch, mask=batch.mask | (here & batch.valid[..., None]))
        later = torch.where(here[:, 0] & (torch.arange(batch.rows) > row), 5.0, 0.0)
        other_times = replace(batch, times=batch.times + later)
        for changed in (other_values, other_mask, all_seen, other_times):
            got = predictions(model, changed)
            assert torch.equal(got[:, : row + 1], expected[:, : row + 1]), row
        cut = predictions(model, rows_of(batch, 0, row + 1))
        assert error(cut, expected[:, : row + 1]) < 1e-12


@pytest.mark.parametrize("decay", ["trainable", "vector"])
@pytest.mark.parametrize("name", sorted(ZOO))
def test_decay_at_observed_rows_alone_does_not_tell_whether_the_row_to_predict_is_observed(
    name: str, decay: str
) -> None:
    """Read at the row itself, such a decay would show its mask: it is refused, or does not."""
    try:
        model = small_model(name, decay=decay, decay_rows="observed_rows", readout="target")
    except InputError:
        return
    batch = model.batch(dataset(4))
    expected = predictions(model, batch)
    for row in range(batch.rows):
        mask = batch.mask.clone()
        mask[:, row] = batch.valid[:, row, None] & ~mask[:, row].any(dim=1, keepdim=True)
        got = predictions(model, replace(batch, mask=mask))
        assert torch.equal(got[:, : row + 1], expected[:, : row + 1]), row


@variants
def test_a_value_moves_only_the_predictions_after_it(variant: str) -> None:
    """By gradients: of each prediction with respect to each value, observed before it or not."""
    model = build(variant)
    batch = model.batch(Dataset((trajectory(4, 7),)))
    values = batch.values.clone().requires_grad_()
    output = model(replace(batch, values=values)).mean
    for row in range(batch.rows):
        (found,) = torch.autograd.grad(output[0, row].sum(), values, retain_graph=True)
        assert not found[0, row:].any()
        assert not found[~batch.mask].any()


@variants
def test_masked_values_never_leak(variant: str) -> None:
    model = build(variant)
    batch = model.batch(dataset(4))
    expected = predictions(model, batch)
    for hidden in (1e6, float("nan"), float("inf")):
        values = torch.where(batch.mask, batch.values, hidden)
        assert torch.equal(predictions(model, replace(batch, values=values)), expected)
    unknown = replace(batch, known=batch.mask, values=torch.where(batch.mask, batch.values, 0.0))
    assert torch.equal(predictions(model, unknown), expected)


@variants
def test_masked_values_leave_no_trace_in_gradients(variant: str) -> None:
    model = build(variant)
    batch = model.batch(dataset(3))
    hidden = replace(batch, values=torch.where(batch.mask, batch.values, float("nan")))
    found = []
    for given in (batch, hidden):
        model.zero_grad()
        output = model(given)
        (whole(output) * batch.valid[..., None]).square().sum().backward()
        found.append([p.grad.clone() for p in model.parameters() if p.grad is not None])
    for got, expected in zip(*found, strict=True):
        assert torch.equal(got, expected)


# --- a stream is the same loop --------------------------------------------------------------------


def in_parts(model: Model, batch: Batch, edges: list[int]) -> Tensor:
    past = model.empty_state(len(batch))
    parts = []
    with torch.no_grad():
        for start, stop in pairwise(edges):
            output = model(rows_of(batch, start, stop), past=past)
            past = output.past
            parts.append(output.mean)
    return torch.cat(parts, dim=1) * batch.valid[..., None]


@variants
@dtypes
def test_one_row_at_a_time_is_the_whole_sequence(variant: str, dtype: torch.dtype) -> None:
    model = build(variant, dtype)
    batch = model.batch(dataset(4))
    expected = predictions(model, batch)
    for edges in (list(range(batch.rows + 1)), [0, 1, 4, batch.rows], [0, 5, batch.rows]):
        assert error(in_parts(model, batch, edges), expected) < TOLERANCE[dtype]


# --- rows in which nothing is observed ------------------------------------------------------------


def with_empty_rows(data: Dataset, *, seed: int = 0) -> tuple[Dataset, list[Any]]:
    """Rows inserted everywhere: before the first, between, after the last."""
    random = np.random.default_rng(seed)
    made, own = [], []
    for one in data:
        last = round(one.times[-1] / TICK)
        free = np.setdiff1d(np.arange(-20, last + 40), np.round(one.times / TICK))
        times = np.union1d(one.times, random.choice(free, size=12, replace=False) * TICK)
        rows = np.searchsorted(times, one.times)
        values = np.full((len(times), one.channels), np.nan)
        observed = np.zeros(values.shape, dtype=bool)
        values[rows], observed[rows] = one.values, one.observed
        made.append(Trajectory(times, values, observed=observed, names=one.names, units=one.units))
        own.append(rows)
    return Dataset(tuple(made)), own


def effect_of_empty_rows(model: Model, data: Dataset) -> float:
    """Largest change of a prediction at the rows that were there before."""
    more, own = with_empty_rows(data)
    expected, got = (predictions(model, model.batch(d)) for d in (data, more))
    return max(error(got[i, rows], expected[i, : len(rows)]) for i, rows in enumerate(own))


FLOWS = [name for name in ZOO if resolve(ModelConfig(name=name)).vector_field == "mlp"]


NODES: dict[str, dict[str, Any]] = {
    "": {},
    "decay": {"decay": "trainable"},
    "scalar": {"decay": "scalar"},
    "rk4": {"solver": "rk4", "steps_per_gap": 3},
    "lstm": {"cell": "lstm"},
    "max_step": {"max_step": 0.17, "bounded": False},
    "dopri5": {"solver": "dopri5"},
    "tsit5_decay": {"solver": "tsit5", "decay": "vector"},
    "adjoint": {"solver": "heun", "gradient": "adjoint"},
}
"""Options by which a prediction depends on what was observed alone; `dopri5` runs in PyTorch."""


@pytest.mark.parametrize("options", list(NODES))
@pytest.mark.parametrize("name", ZOO)
@dtypes
def test_asking_any_times_changes_no_bit_of_a_prediction(
    name: str, options: str, dtype: torch.dtype
) -> None:
    """In the compiled backend. In PyTorch a product of one row and of the same row among others
    differ in their last bits; the steps are the same, so that is all."""
    if name == "neural_ode" and options == "lstm":
        pytest.skip("it has no cell")
    model = small_model(name, dtype=dtype, **NODES[options])
    data, random = dataset(3), np.random.default_rng(zlib.crc32(f"{name} {options}".encode()))
    asked = []
    for one in data:
        ticks = np.arange(-5, round((one.times[-1] - one.times[0]) / TICK) + 400)
        free = one.times[0] + random.choice(ticks, 40, replace=False) * TICK
        asked.append(np.union1d(one.times, free))
    later = [one.times[-1] + TICK * np.arange(1, 78, 4) for one in data]
    for backend in ("reference", *cpu.instruction_sets()):
        with kernels.use(backend):
            plain, more = predict(model, data), predict(model, data, times=asked)
            last = predict(model, data, times=[at[-1:] for at in later])
            on_the_way = predict(model, data, times=later)
            exact = model.backend()[0] != "reference"
        for i, one in enumerate(data):
            rows = np.searchsorted(asked[i], one.times)
            for got, expected in (
                (more[i].values[rows], plain[i].values),
                (on_the_way[i].values[-1:], last[i].values),
            ):
                if exact:
                    assert np.array_equal(got, expected)
                else:
                    assert error(torch.tensor(got), torch.tensor(expected)) < TOLERANCE[dtype]


@pytest.mark.parametrize("decay", [None, "none", "trainable", "vector", "scalar"])
@pytest.mark.parametrize("name", FLOWS)
def test_rows_with_nothing_observed_change_steps_from_row_to_row_by_the_error_of_the_solver(
    name: str, decay: str | None
) -> None:
    options: dict[str, Any] = {} if decay is None else {"decay": decay}
    model = build(name, solver="dopri5", rtol=1e-9, atol=1e-10, nodes="rows", **options)
    assert effect_of_empty_rows(model, dataset(2)) < 1e-6


@pytest.mark.parametrize(
    ("solver", "order", "steps"),
    [("euler", 1, 8), ("midpoint", 2, 4), ("heun", 2, 4), ("rk4", 4, 2)],
)
@pytest.mark.parametrize("name", FLOWS)
def test_the_effect_of_empty_rows_on_steps_from_row_to_row_shrinks_at_the_order_of_the_solver(
    name: str, solver: str, order: int, steps: int
) -> None:
    """With a decay or a trend the steps are split (Lie), which is of first order for any solver."""
    config = resolve(ModelConfig(name=name))
    if config.decay != "none" or config.trend:
        order, steps = 1, 8
    coarse, fine = (
        effect_of_empty_rows(
            build(name, solver=solver, steps_per_gap=n, nodes="rows", bounded=False), dataset(2)
        )
        for n in (steps, 4 * steps)
    )
    assert coarse < 0.1
    measured = np.log(coarse / fine) / np.log(4)
    assert measured == pytest.approx(order, abs=0.4)


@pytest.mark.parametrize("name", sorted(ZOO))
@pytest.mark.parametrize("gap_limit", [1.0, 2.0])
def test_rows_with_nothing_observed_change_nothing_beyond_the_longest_training_gap(
    name: str, gap_limit: float
) -> None:
    """Where time saturates, too."""
    solver: dict[str, Any] = {}
    if name in FLOWS:
        solver = {"solver": "dopri5", "rtol": 1e-9, "atol": 1e-10}
    model = build(name, gap_limit=gap_limit, **solver)
    limit = model.statistics.longest_elapsed * gap_limit
    one = trajectory(8, 6)
    observed = one.observed.copy()
    observed[0], observed[1], observed[2:] = True, [True, False, False], [False, True, False]
    pauses = [0, 0, round(2.5 * limit / TICK), 0, round(7 * limit / TICK), 0]
    times = one.times + np.cumsum(pauses) * TICK
    data = Dataset((with_observed(replace(one, times=times), observed),))
    assert effect_of_empty_rows(model, data) < (1e-6 if solver else 1e-12)


ASKED = {
    "every": {"update_rows": "every"},
    "every_row": {"decay": "trainable", "decay_rows": "every_row"},
    "observed_rows": {"decay": "trainable", "decay_rows": "observed_rows"},
    "gap": {"time_input": "gap"},
    "first_row": {"clock": "first_row", "time_input": "elapsed"},
    "last_row": {"readout": "last_row"},
    "self_feeding": {"self_feeding": 0.5},
    "zoo": {},
}


@pytest.mark.parametrize("choice", list(ASKED))
@pytest.mark.parametrize("name", sorted(ZOO))
def test_asked_times_change_no_other_prediction_or_are_refused(name: str, choice: str) -> None:
    options = dict(ASKED[choice])
    if name in FLOWS:
        options |= {"solver": "dopri5", "rtol": 1e-7, "atol": 1e-8}
    data = dataset(2)
    at = np.union1d(data[0].times, np.arange(-30, 150, 29) * TICK)
    try:
        model = small_model(name, **options)
        asked = predict(model, data, times=[at, data[1].times])
    except InputError:
        return
    plain = predict(model, data)
    own = np.searchsorted(at, data[0].times)
    np.testing.assert_allclose(asked[0].values[own], plain[0].values, rtol=0, atol=1e-4)
    np.testing.assert_allclose(asked[1].values, plain[1].values, rtol=0, atol=1e-4)


# --- gradients ------------------------------------------------------------------------------------


def whole(output: Output) -> Tensor:
    """Mean, and with a head that has one, scale: a gradient reaches every part of the head."""
    return output.mean if output.scale is None else output.mean + output.scale


def gradients(model: Model, batch: Batch) -> dict[str, Tensor | None]:
    model.zero_grad()
    target = torch.cos(torch.arange(batch.values.numel()).to(model.dtype)).view_as(batch.values)
    loss = ((whole(model(batch)) - target) * batch.valid[..., None]).square().sum()
    loss.backward()
    return {name: p.grad for name, p in model.named_parameters()}


@variants
def test_a_gradient_reaches_every_parameter_under_masks_per_channel(variant: str) -> None:
    """At the initial weights, from which training starts, and at others.

    A model with a trend begins as a filter: h matters once the last layer of its field is not 0.
    """
    data = dataset(4)
    initial = make_model(VARIANTS[variant], dataset(6, seed=9)).double()
    for model in (initial, with_growing_decays(build(variant))):
        for name, gradient in gradients(model, model.batch(data)).items():
            assert gradient is not None, name
            assert bool(gradient.isfinite().all()), name
            silent = model is initial and model.spec.trend
            silent &= not name.startswith(("trend.", "start", "field.weights.3", "field.biases.3"))
            assert bool(gradient.any()) != silent, name


@variants
def test_the_bodies_of_the_scan_agree_in_values_and_gradients(variant: str) -> None:
    model = build(variant)
    batch = model.batch(dataset(4))
    got, found = predictions(model, batch), gradients(model, batch)
    with kernels.use("reference"):
        assert error(got, predictions(model, batch)) < 1e-12
        for name, expected in gradients(model, batch).items():
            assert error(found[name], expected) < 1e-11, name  # type: ignore[arg-type]


# --- extremes -------------------------------------------------------------------------------------


def extreme(change: Callable[[Any, Any], None]) -> Dataset:
    one = trajectory(11, 18)
    times, observed = one.times.copy(), one.observed.copy()
    change(times, observed)
    return Dataset((with_observed(replace(one, times=times), observed), trajectory(12, 9)))


@variants
def test_gaps_from_a_microsecond_to_hours_keep_everything_finite(variant: str) -> None:
    def stretch(times: Any, observed: Any) -> None:
        gaps = np.diff(times)
        gaps[3:8] = 1e-6
        gaps[10] = 1e4
        times[1:] = times[0] + np.cumsum(gaps)

    data = extreme(stretch)
    config = VARIANTS[variant]
    # With Euler's one step per gap such a gap may have been met in training, too. Others would
    # take a step after the other, or powers of the gap.
    whole = resolve(config)
    euler = whole.solver == "euler" and whole.max_step is None
    euler = euler and (whole.nodes == "rows" or whole.vector_field == "none")
    for train in (None, data) if euler else (None,):
        model = small_model(config, train, dtype=FLOAT32)
        batch = model.batch(data)
        assert bool(predictions(model, batch).isfinite().all())
        for name, gradient in gradients(model, batch).items():
            assert gradient is not None, name
            assert bool(gradient.isfinite().all()), name


@variants
def test_many_long_gaps_keep_initial_models_finite(variant: str) -> None:
    def stretch(times: Any, observed: Any) -> None:
        times += 1e4 * np.arange(len(times))

    model = build(variant, FLOAT32)
    draw_weights(model, std=0.1)
    assert bool(predictions(model, model.batch(extreme(stretch))).isfinite().all())


@variants
def test_a_trajectory_with_nothing_observed_is_predicted_and_harms_nobody(variant: str) -> None:
    def hide(times: Any, observed: Any) -> None:
        observed[:] = False

    data = extreme(hide)
    model = build(variant)
    batch = model.batch(data)
    got = predictions(model, batch)
    assert bool(got.isfinite().all())
    alone = predictions(model, model.batch(Dataset((data[1],))))[0]
    assert error(got[1, :9], alone) < 1e-12
    for name, gradient in gradients(model, batch).items():
        assert gradient is None or bool(gradient.isfinite().all()), name


@variants
def test_nothing_moves_before_the_first_observation(variant: str) -> None:
    """A model that updates at every row may count them; no other sees time pass."""
    model = build(variant)
    if model.config.update_rows == "every" or model.config.clock == "first_row":
        pytest.skip("it is meant to move from its first row on")

    def hide(times: Any, observed: Any) -> None:
        observed[:10] = False
        observed[10] = True

    got = predictions(model, model.batch(extreme(hide)))[0]
    assert error(got[:11], got[:1].expand(11, -1)) < 1e-12
    assert float((got[12] - got[0]).abs().max()) > 1e-6


@variants
def test_a_single_row_is_predicted(variant: str) -> None:
    model = build(variant)
    one = trajectory(3, 1)
    got = predictions(model, model.batch(Dataset((with_observed(one, True),))))
    assert got.shape == (1, 1, 3)
    assert bool(got.isfinite().all())
