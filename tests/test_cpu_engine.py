"""A stream in compiled code gives the bits of a batch in compiled code, for every model."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from test_contract import VARIANTS, build, dataset

import offbeat as ob
from offbeat import kernels
from offbeat.kernels import cpu
from offbeat.stream.cpu_engine import CpuEngine
from offbeat.stream.torch_engine import TorchEngine

pytestmark = pytest.mark.skipif(
    not cpu.instruction_sets(), reason="the compiled backend was not built"
)


@pytest.mark.parametrize("name", cpu.instruction_sets() or ["none"])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=["float32", "float64"])
@pytest.mark.parametrize("variant", list(VARIANTS))
def test_every_row_of_a_stream_has_the_bits_of_the_batch(
    variant: str, dtype: torch.dtype, name: str
) -> None:
    """In a batch of several lengths; the state is exported, reset and restored on the way."""
    with kernels.use(name):
        model = build(variant, dtype)
        if reason := CpuEngine.unsupported(model):
            pytest.skip(reason)
        batch = model.batch(dataset(4))
        with torch.no_grad():
            expected = model(batch).mean.double().numpy()
        for i, length in enumerate(batch.valid.sum(dim=1).tolist()):
            engine = CpuEngine(model)
            engine.reserve(1)
            previous: tuple[Any, ...] = ()
            for row in range(length):
                time, mask = float(batch.times[i, row]), batch.mask[i, row].numpy()
                values = np.where(mask, batch.values[i, row].numpy(), 0).astype(engine.dtype)
                got = engine.predict(np.array([time]))
                assert np.array_equal(got[0], expected[i, row]), (i, row)
                if row == 2:
                    engine.save(0)
                    kept = engine.export()
                    engine.observe(time + 1, values, mask)
                    engine.reset()
                    engine.restore(kept)
                elif row == 3:
                    engine.observe(time, values, mask)
                    engine.load(0)
                    engine.observe(*previous)
                engine.observe(time, values, mask)
                previous = (time, values, mask)


@pytest.mark.parametrize("name", ["gru_d", "ode_gru_d", "anchored_ode_gru_d", "rnn_decay"])
def test_the_public_stream_has_the_bits_of_predict(name: str) -> None:
    data = dataset(3)
    model = build(name, torch.float32)
    for trajectory, expected in zip(data, ob.predict(model, data), strict=True):
        stream = ob.Stream(model)
        for t, row, observed, wanted in zip(
            trajectory.times, trajectory.values, trajectory.observed, expected.values, strict=True
        ):
            seen = np.where(observed, row, np.nan)
            assert np.array_equal(stream.predict(t - trajectory.times[0]), wanted)
            stream.observe(t - trajectory.times[0], seen)


def test_a_state_moves_between_the_engines() -> None:
    model = build("ode_gru_d", torch.float64)
    mine, other = CpuEngine(model), TorchEngine(model)
    mask = np.ones(model.channels, dtype=bool)
    for time in (0.0, 0.4, 1.0):
        mine.observe(time, np.full(model.channels, time), mask)
    assert mine.fingerprint() == other.fingerprint()
    kept = mine.export()
    like = other.export()
    assert kept.keys() == like.keys()
    assert all(kept[k].shape == like[k].shape and kept[k].dtype == like[k].dtype for k in kept)
    other.restore(kept)
    asked = np.array([1.0, 1.5])
    assert np.array_equal(mine.predict(asked), other.predict(asked))
    back = other.export()
    assert all(np.array_equal(back[k], kept[k], equal_nan=kept[k].dtype != bool) for k in kept)


def test_a_stream_of_a_model_without_compiled_backend_runs_in_torch() -> None:
    model = build("ode_rnn-dopri5", torch.float64)
    assert model.backend()[0] == "reference"
    stream = ob.Stream(model)
    stream.observe(0.0, np.zeros(model.channels))
    assert np.isfinite(stream.predict(0.5)).all()


def test_arrays_of_another_type_are_refused() -> None:
    engine = CpuEngine(build("gru", torch.float32))
    mask = np.ones(engine._model.channels, dtype=bool)
    with pytest.raises(TypeError):
        engine.observe(0.0, np.zeros(len(mask)), mask)  # float64 for a float32 model
