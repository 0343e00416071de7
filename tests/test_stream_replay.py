"""A model without a recurrent state is streamed by running it again on its newest rows."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest
import torch
from model_helpers import dataset, trajectory
from stream_helpers import message

import offbeat as ob
from offbeat.data.batch import Batch


class Mixer(torch.nn.Module):
    """Each row from the values, masks and times of all rows before it."""

    def __init__(self, data: ob.DataInfo) -> None:
        super().__init__()
        generator = torch.Generator().manual_seed(0)
        weight = torch.randn(data.channels, 2 * data.channels, generator=generator)
        self.weight = torch.nn.Parameter(weight.double())

    def forward(self, batch: Batch) -> ob.Prediction:
        seen = torch.cat([torch.where(batch.mask, batch.values, 0.0), batch.mask.double()], dim=2)
        age = batch.times[:, :, None] - batch.times[:, None, :]
        weight = torch.tril(torch.ones_like(age), -1) * torch.exp(-age)
        return ob.Prediction(torch.einsum("bij,bjk,ck->bic", weight, seen, self.weight))


@pytest.fixture(scope="module")
def model() -> Any:
    """The module, registered and made for some data."""
    ob.register_model("mixer", Mixer, replace=True)
    return ob.make_model("mixer", dataset(4))


def batch_predictions(model: Any, one: ob.Trajectory) -> Any:
    with torch.no_grad():
        mean = model(Batch.of([one], scaler=model.scaler, dtype=model.dtype)).mean[0]
    return model.scaler.original(mean.numpy())


def streamed(stream: ob.Stream, one: ob.Trajectory, rows: range) -> Any:
    got = []
    for row in rows:
        got.append(stream.predict(one.times[row]))
        stream.observe(one.times[row], message(one, row))
    return np.array(got)


def test_a_stream_of_any_module_predicts_what_its_batch_predicts(model: Any) -> None:
    one = trajectory(4, 14)
    got = streamed(ob.Stream(model, window_rows=14), one, range(14))
    np.testing.assert_allclose(got, batch_predictions(model, one), rtol=0, atol=1e-12)


def test_rows_older_than_the_window_do_not_count(model: Any) -> None:
    one = trajectory(4, 14)
    stream = ob.Stream(model, window_rows=5)
    streamed(stream, one, range(14))
    asked = one.times[-1] + 0.1
    newest = one.slice(9, 14)
    longer = ob.Trajectory(
        np.append(newest.times, asked),
        np.vstack([newest.values, np.full(3, np.nan)]),
        observed=np.vstack([newest.observed, np.zeros(3, dtype=bool)]),
    )
    expected = batch_predictions(model, longer)[-1]
    np.testing.assert_allclose(stream.predict(asked), expected, rtol=0, atol=1e-12)
    assert np.isfinite(ob.Stream(model, window_rows=1).predict(0.0)).all()


def test_the_window_is_that_of_the_training_unless_told_otherwise(model: Any) -> None:
    longest = max(one.rows for one in dataset(4))
    stream, told = ob.Stream(model), ob.Stream(model, window_rows=longest)
    one = trajectory(4, longest + 5)
    streamed(stream, one, range(one.rows))
    streamed(told, one, range(one.rows))
    assert stream.state() == told.state()
    with pytest.raises(ob.InputError):
        ob.Stream(model, window_rows=0)


def test_several_times_are_independent_and_the_newest_row_is_known_at_its_time(model: Any) -> None:
    one = trajectory(4, 8)
    stream = ob.Stream(model)
    streamed(stream, one, range(8))
    asked = one.times[-1] + np.array([0.0, 0.3, 0.1])
    each = [stream.predict(t) for t in asked]
    np.testing.assert_allclose(stream.predict(asked), each, rtol=0, atol=1e-12)


def test_late_rows_and_records_are_as_for_any_stream(model: Any) -> None:
    one = trajectory(4, 12)
    in_time, late = (ob.Stream(model, late="reorder", window_rows=6) for _ in range(2))
    streamed(in_time, one, range(8))
    for row in (0, 1, 2, 3, 4, 6, 5, 7):
        late.observe(one.times[row], message(one, row))
    assert late.counters.reordered == 1
    again = ob.Stream(model, late="reorder", window_rows=6)
    again.restore(json.loads(json.dumps(late.state(), allow_nan=False)))
    for stream in (late, again):
        np.testing.assert_array_equal(stream.predict(9.0), in_time.predict(9.0))
    with pytest.raises(ob.InputError):
        ob.Stream(model, late="reorder", window_rows=7).restore(late.state())
    again.reset()
    np.testing.assert_array_equal(again.predict(9.0), ob.Stream(model).predict(9.0))


def test_answers_of_a_module_are_those_of_its_batch(model: Any) -> None:
    data = dataset(3)
    for one, got in zip(data, ob.predict(model, data), strict=True):
        np.testing.assert_allclose(got.values, batch_predictions(model, one), rtol=0, atol=1e-12)
    ahead, stream = ob.forecast(model, data, 0.1), ob.Stream(model)
    streamed(stream, data[0], range(data[0].rows))
    asked = ahead[0].times[0]
    np.testing.assert_allclose(stream.predict(asked), ahead[0].values[0], rtol=0, atol=1e-12)
    assert np.isfinite(ob.impute(model, data)[0].values).all()
    with pytest.raises(ob.InputError):
        ob.export_onnx(model, "model.onnx")
