"""States of a bounded model stay in the range of training, whatever is observed."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from model_helpers import TICK, dataset, predictions, small_model, trajectory, with_observed
from numpy.typing import NDArray
from stream_helpers import message

from offbeat import (
    Dataset,
    Model,
    ModelConfig,
    Stream,
    Trajectory,
    kernels,
    load_model,
    thesis_config,
)
from offbeat.kernels import cpu
from offbeat.models.zoo import ZOO, resolve

FLOWS = [name for name in sorted(ZOO) if resolve(ModelConfig(name=name)).vector_field == "mlp"]
BACKENDS = ("reference", *cpu.instruction_sets())
STRONG = {"activation": "silu", "std": 1.5, "dtype": torch.float32}
"""A vector field whose state grows without bound unless it is stopped."""


def with_outlier(size: float, *, rows: int = 120, at: int = 5, channel: int = 0) -> Trajectory:
    """Waves, every value observed, one value `size` standard deviations from the mean."""
    one = trajectory(3, rows)
    values = one.values.copy()
    column = np.delete(values[:, channel], at)
    values[at, channel] = column.mean() + size * column.std()
    return with_observed(Trajectory(one.times, values, units=one.units), True)


def scaled(model: Model, one: Trajectory, backend: str) -> NDArray[Any]:
    with kernels.use(backend):
        return predictions(model, model.batch(Dataset((one,))))[0].double().numpy()


def range_of(model: Model) -> tuple[NDArray[Any], NDArray[Any]]:
    """The range of training, widened by half of it on each side."""
    low, high = (np.array(end) for end in (model.statistics.low, model.statistics.high))
    wider = (high - low) / 2
    return low - wider, high + wider


def test_the_range_is_that_of_the_observed_values_of_training() -> None:
    train = dataset(6, seed=9)
    model = small_model("anchored_ode_gru_d", train, scaler="identity")
    for channel in range(3):
        seen = np.concatenate([t.values[t.observed[:, channel], channel] for t in train])
        assert model.statistics.low[channel] == pytest.approx(seen.min(), rel=1e-6)
        assert model.statistics.high[channel] == pytest.approx(seen.max(), rel=1e-6)


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("solver", ["euler", "rk4", "dopri5"])
def test_an_outlier_is_forgotten_once_its_channel_is_observed_again(
    solver: str, backend: str
) -> None:
    model = small_model("anchored_ode_gru_d", solver=solver, **STRONG)
    low, high = range_of(model)
    got = scaled(model, with_outlier(100.0), backend)
    assert np.isfinite(got).all()
    assert got[6, 0] > high[0], "the value itself is held until the next one"
    later = got[7:]
    assert (later >= low - 1e-4).all()
    assert (later <= high + 1e-4).all()


def test_without_bounds_the_same_outlier_drives_the_state_away() -> None:
    model = small_model("anchored_ode_gru_d", bounded=False, **STRONG)
    low, high = range_of(model)
    got = scaled(model, with_outlier(100.0), "reference")[7:]
    assert not ((got >= low - 1e-4) & (got <= high + 1e-4)).all()


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("nodes", ["observations", "rows"])
def test_a_long_silence_does_not_leave_the_range(nodes: str, backend: str) -> None:
    one = trajectory(3, 60)
    observed = np.zeros_like(one.observed)
    observed[:5] = True
    model = small_model("anchored_ode_gru_d", nodes=nodes, gap_limit=100.0, **STRONG)
    low, high = range_of(model)
    got = scaled(model, with_observed(one, observed), backend)[1:]
    assert (got >= low - 1e-4).all()
    assert (got <= high + 1e-4).all()
    last = model.scaler.scaled(one.values)[4]
    assert np.abs(got[-1] - last).max() > 0.1, "it moves"


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("name", FLOWS)
def test_how_far_an_outlier_lies_outside_changes_nothing_else(name: str, backend: str) -> None:
    """Vector field and cell are given the end of the range in its place, bit for bit."""
    model = small_model(name, dtype=torch.float32)
    at = 0 if name == "neural_ode" else 5  # which looks at the first row alone
    inside, near, far = (
        scaled(model, with_outlier(size, at=at), backend) for size in (0.5, 50.0, 500.0)
    )
    assert np.isfinite(near).all()
    held = np.zeros(near.shape, dtype=bool)
    held[6, 0] = model.spec.anchored
    assert np.array_equal(near[~held], far[~held])
    assert (near[held] != far[held]).all()
    assert not np.array_equal(near[6:], inside[6:])


@pytest.mark.parametrize("size", [1e30, -1e30, 3e38])
@pytest.mark.parametrize("name", FLOWS)
def test_the_largest_values_leave_finite_predictions(name: str, size: float) -> None:
    model, one = small_model(name, dtype=torch.float32), trajectory(4, 30)
    values, observed = one.values.copy(), one.observed.copy()
    values[4], observed[4], observed[5:9] = size, True, False
    one = with_observed(Trajectory(one.times, values, units=one.units), observed)
    for backend in BACKENDS:
        assert np.isfinite(scaled(model, one, backend)).all()
    stream = Stream(model)
    for row in range(one.rows):
        assert np.isfinite(stream.predict(one.times[row] + TICK * np.arange(3))).all()
        stream.observe(one.times[row], message(one, row))


def test_models_with_a_vector_field_are_bounded_and_have_nodes_unless_told_otherwise() -> None:
    for name in ZOO:
        config = resolve(ModelConfig(name=name))
        assert (config.nodes, config.bounded) == ("observations", name in FLOWS)
    for options in (
        {"update_rows": "every"},
        {"readout": "last_row"},
        {"decay_rows": "every_row"},
        {"self_feeding": 0.5},
    ):
        assert resolve(ModelConfig(name="ode_rnn", **options)).nodes == "rows"
    thesis = resolve(thesis_config("ode_rnn"))
    assert (thesis.nodes, thesis.bounded) == ("rows", False)


def test_a_checkpoint_of_a_version_without_nodes_keeps_its_steps() -> None:
    model = load_model(Path(__file__).parent / "data" / "run_0_1_0" / "run")
    assert (model.config.nodes, model.config.bounded) == ("rows", False)
    assert not model.spec.nodes
