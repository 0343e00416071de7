"""Input transforms in answers and streams: what is sent wrapped is predicted as if it were not."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from model_helpers import small_model
from stream_helpers import message

import offbeat as ob
from offbeat.data.transforms import Angle, Transforms
from offbeat.stream.lines import LineSession

TURN = 2 * math.pi
NAMES = ("yaw", "qw", "qx", "qy", "qz", "speed")
TRANSFORMS = Transforms({"yaw": Angle(TURN, -math.pi)}, (NAMES[1:5],))


def wrap(angle: Any) -> Any:
    return (np.asarray(angle) + math.pi) % TURN - math.pi


def turning(rows: int = 40, *, seed: int = 0) -> ob.Dataset:
    """A robot that turns, its log unwrapped and continuous, as `read` gives it."""
    random = np.random.default_rng(seed)
    times = np.cumsum(random.uniform(0.05, 0.15, rows))
    yaw = 2.0 + 4.0 * times + 0.2 * np.sin(times)
    attitude = np.column_stack([np.cos(yaw / 2), 0 * yaw, 0 * yaw, np.sin(yaw / 2)])
    values = np.column_stack([yaw, attitude, np.cos(times)])
    observed = random.random((rows, 6)) < 0.8
    observed[:, 1:5] = observed[:, 1:2]
    one = ob.Trajectory(times - times[0], values, observed=observed, names=NAMES, units=("",) * 6)
    return ob.Dataset((one,), {"transforms": TRANSFORMS.to_dict()})


def as_sent(data: ob.Dataset, *, seed: int = 1) -> ob.Dataset:
    """The same log before it was cleaned: yaw wrapped, quaternions of random sign and length."""
    values = data[0].values.copy()
    values[:, 0] = wrap(values[:, 0])
    random = np.random.default_rng(seed)
    signs = random.choice([-1.0, 1.0], (len(values), 1))
    signs[0] = 1.0
    values[:, 1:5] *= signs * random.uniform(0.9, 1.1, signs.shape)
    return ob.Dataset((replace(data[0], values=values),))


def model_of(data: ob.Dataset, name: str = "gru_d", **options: Any) -> ob.Model:
    model = small_model(name, data, scaler="standardise", **options)
    assert model.transforms == TRANSFORMS, "recorded by the data"
    return model


def streamed(stream: Any, data: ob.Dataset) -> Any:
    got = []
    one = data[0]
    for row in range(one.rows):
        got.append(stream.predict(one.times[row]))
        assert stream.observe(one.times[row], message(one, row)) == "new"
    return np.array(got)


def same_pose(got: Any, expected: Any, *, atol: float) -> None:
    """Equal but for whole turns of the yaw."""
    np.testing.assert_allclose(wrap(got[:, 0] - expected[:, 0]), 0, atol=atol)
    np.testing.assert_allclose(got[:, 1:], expected[:, 1:], atol=atol)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_live_predictions_of_a_turning_robot_are_those_of_the_batch(dtype: torch.dtype) -> None:
    clean = turning()
    sent, model = as_sent(clean), model_of(clean, dtype=dtype)
    atol = 1e-4 if dtype == torch.float32 else 1e-10
    live = streamed(ob.Stream(model), sent)
    np.testing.assert_allclose(live, ob.predict(model, sent)[0].values, atol=atol)
    assert (np.abs(live[:, 0]) <= math.pi).all(), "sent wrapped, so predicted wrapped"
    # As clean as the training data: the same but for turns, and unit quaternions both ways.
    same_pose(live, ob.predict(model, clean)[0].values, atol=atol)
    np.testing.assert_allclose(np.linalg.norm(live[:, 1:5], axis=1), 1, atol=1e-12)


def test_a_model_without_transforms_takes_a_wrap_for_a_jump() -> None:
    """What streams did before: the test above is not empty."""
    clean = turning()
    model = model_of(clean)
    with_them = streamed(ob.Stream(model), as_sent(clean))
    model.transforms = Transforms.identity()
    without = streamed(ob.Stream(model), as_sent(clean))
    assert np.abs(wrap(with_them[:, 0] - without[:, 0])).max() > 0.1


def test_sent_raw_or_unwrapped_by_hand_is_the_same() -> None:
    clean = turning()
    model = model_of(clean)
    raw, by_hand = ob.Stream(model), ob.Stream(model)
    same_pose(streamed(raw, as_sent(clean)), streamed(by_hand, clean), atol=1e-10)
    newest = clean[0].values[clean[0].observed[:, 0], 0][-1]
    assert newest > TURN
    unwrapped = by_hand.predict(clean[0].times[-1] + 0.01)[0]
    assert unwrapped > math.pi, "sent unwrapped, so predicted unwrapped"
    wrapped = raw.predict(clean[0].times[-1] + 0.01)[0]
    assert wrapped == pytest.approx(wrap(unwrapped), abs=1e-10)


def test_signs_of_quaternions_change_nothing() -> None:
    clean = turning()
    model = model_of(clean)
    one, other = (streamed(ob.Stream(model), as_sent(clean, seed=seed)) for seed in (1, 2))
    np.testing.assert_allclose(one, other, atol=1e-10)


def test_a_checkpoint_keeps_the_transforms(tmp_path: Any) -> None:
    clean = turning()
    model = model_of(clean)
    model.save(tmp_path / "model")
    loaded = ob.load_model(tmp_path / "model")
    sent = as_sent(clean)
    np.testing.assert_array_equal(
        streamed(ob.Stream(loaded), sent), streamed(ob.Stream(model), sent)
    )


def test_a_batch_of_a_wrapped_log_is_that_of_the_unwrapped_one() -> None:
    clean = turning()
    model = model_of(clean)
    one, other = model.batch(as_sent(clean)), model.batch(clean)
    first = int(clean[0].observed[:, 0].argmax())
    turns = (clean[0].values[first, 0] - wrap(clean[0].values[first, 0])) / model.scaler.scale[0]
    shift = np.array([turns, 0, 0, 0, 0, 0])
    np.testing.assert_allclose(one.values[0].numpy() + shift, other.values[0].numpy(), atol=1e-10)


def test_a_late_row_at_the_wrap_is_as_good_as_one_in_time() -> None:
    clean = turning()
    sent, model = as_sent(clean), model_of(clean)
    in_time, late = ob.Stream(model, late="reorder"), ob.Stream(model, late="reorder")
    one = sent[0]
    jump = int(np.flatnonzero(np.abs(np.diff(one.values[:, 0])) > math.pi)[0]) + 1
    order = [*range(jump), jump + 1, jump, *range(jump + 2, one.rows)]
    for row in range(one.rows):
        in_time.observe(one.times[row], message(one, row))
    for row in order:
        late.observe(one.times[row], message(one, row))
    assert late.counters.reordered == 1
    asked = one.times[-1] + np.array([0.0, 0.1])
    np.testing.assert_array_equal(late.predict(asked), in_time.predict(asked))


def test_parts_of_a_quaternion_may_come_one_by_one() -> None:
    """They join one row, which is transformed as a whole."""
    clean = turning(6)
    clean = ob.Dataset((replace(clean[0], observed=np.ones((6, 6), dtype=bool)),), clean.meta)
    sent, model = as_sent(clean)[0], model_of(clean)
    whole, parts = ob.Stream(model), ob.Stream(model)
    for row in range(6):
        said = message(sent, row)
        whole.observe(sent.times[row], said)
        for name, value in said.items():
            parts.observe(sent.times[row], {name: value})
    np.testing.assert_array_equal(parts.predict(9.0), whole.predict(9.0))


def test_a_restored_stream_remembers_its_turns() -> None:
    clean = turning()
    sent, model = as_sent(clean), model_of(clean)
    stream = ob.Stream(model, late="reorder", reorder_rows=3)
    one = sent[0]
    for row in range(25):
        stream.observe(one.times[row], message(one, row))
    record = json.loads(json.dumps(stream.state(), allow_nan=False))
    again = ob.Stream(model, late="reorder", reorder_rows=3)
    again.restore(record)
    for row in range(25, one.rows):
        for each in (stream, again):
            each.observe(one.times[row], message(one, row))
        np.testing.assert_array_equal(again.predict(9.0), stream.predict(9.0))
    other = model_of(clean)
    other.transforms = Transforms({"yaw": Angle(TURN)})
    with pytest.raises(ob.InputError):
        ob.Stream(other).restore(record)
    stream.reset()
    np.testing.assert_array_equal(stream.predict(0.0), ob.Stream(model).predict(0.0))


def test_lines_are_answered_in_what_was_sent() -> None:
    clean = turning()
    sent, model = as_sent(clean), model_of(clean)
    session, expected = LineSession(ob.Stream(model)), streamed(ob.Stream(model), sent)
    one = sent[0]
    for row in range(one.rows):
        line = json.dumps({"t": one.times[row], "values": message(one, row)})
        answer = json.loads(session.answer(line.encode()))
        assert list(answer["prediction"].values()) == expected[row].tolist()


def test_an_onnx_stream_transforms_as_a_stream_does(tmp_path: Any) -> None:
    pytest.importorskip("onnxruntime")
    clean = turning()
    sent, model = as_sent(clean), model_of(clean)
    ob.export_onnx(model, tmp_path / "model.onnx")
    live = streamed(ob.OnnxStream(tmp_path / "model.onnx"), sent)
    np.testing.assert_allclose(live, streamed(ob.Stream(model), sent), atol=1e-9)


def test_a_value_beyond_all_numbers_is_not_measured() -> None:
    model = model_of(turning(), dtype=torch.float32)
    clean, dirty = ob.Stream(model), ob.Stream(model)
    for row, bad in enumerate([float("inf"), 1e300, 10**400]):
        clean.observe(0.1 * row, {"speed": 1.0})
        dirty.observe(0.1 * row, {"speed": 1.0, "yaw": bad})
    np.testing.assert_array_equal(clean.predict(1.0), dirty.predict(1.0))
    assert dirty.counters.not_finite == 3


# --- answers --------------------------------------------------------------------------------------


def test_forecasts_and_fills_come_back_in_what_was_given() -> None:
    clean = turning()
    sent, model = as_sent(clean), model_of(clean)
    horizons = [0.1, 0.5, 1.5]
    wrapped, plain = (ob.forecast(model, data, horizons)[0].values for data in (sent, clean))
    same_pose(wrapped, plain, atol=1e-10)
    assert np.abs(wrapped[:, 0]).max() <= math.pi < plain[:, 0].min()
    masked = ~sent[0].observed
    filled = ob.impute(model, sent)[0].values
    assert np.array_equal(filled[~masked], sent[0].values[~masked])
    assert np.abs(filled[:, 0]).max() <= math.pi
    expected = np.where(masked, ob.predict(model, sent)[0].values, filled)
    np.testing.assert_array_equal(filled, expected)
    same_pose(
        np.where(masked, filled, 0), np.where(masked, ob.impute(model, clean)[0].values, 0),
        atol=1e-10,
    )  # fmt: skip


def test_scores_of_a_wrapped_log_are_those_of_the_unwrapped_one() -> None:
    clean = turning()
    sent, model = as_sent(clean), model_of(clean)
    for score in (
        lambda data: ob.score_forecast(model, data, [0.3])[0],
        lambda data: ob.score_imputation(model, data).scores,
    ):
        one, other = score(sent), score(clean)
        for predictor, rmse in one.rmse.items():
            np.testing.assert_allclose(rmse, other.rmse[predictor], rtol=1e-9)


def test_a_blend_fills_a_wrapped_log_as_it_fills_the_unwrapped_one() -> None:
    clean = turning()
    train = ob.Dataset((clean[0], turning(seed=3)[0]), clean.meta)
    model = model_of(train)
    config = ob.TrainConfig(epochs=1, batch_size=2, optimizer="adam")
    backward, _ = ob.fit_backward(model, train, train, config, progress=False)
    assert backward.transforms == TRANSFORMS
    members = {"causal": ["last_value"], "two_sided": ["linear"]}
    blend = ob.fit_blend(train, train, model, backward, **members)
    sent = as_sent(clean)
    wrapped, plain = (ob.impute(blend, data)[0].values for data in (sent, clean))
    masked = ~sent[0].observed
    same_pose(np.where(masked, wrapped, 0), np.where(masked, plain, 0), atol=1e-9)
    assert np.abs(wrapped[:, 0]).max() <= math.pi
