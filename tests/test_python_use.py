"""What a user of the Python functions types: results that show themselves, and wrong arguments."""

import numpy as np
import pytest

import offbeat as ob
from offbeat.data.splits import split_in_time
from offbeat.errors import InputError
from offbeat.evaluation import evaluate_blend

TIMES = 0.02 * np.arange(600)
LOG = ob.Trajectory(TIMES, np.stack([np.sin(3 * TIMES), np.cos(2 * TIMES)], axis=1))


@pytest.fixture(scope="module")
def learned():
    return ob.learn(
        LOG,
        model=ob.ModelConfig(hidden_size=4, field_units=(6,)),
        training=ob.TrainConfig(epochs=1, tasks_per_epoch=16),
        two_sided=False,
        baselines=["last_value", "constant_velocity", "linear"],
        progress=False,
    )


def test_the_result_of_learn_answers_as_its_blend_does(learned):
    blend, rows = learned.blend, learned.test
    for ask in (
        lambda model: ob.predict(model, rows),
        lambda model: ob.forecast(model, rows, [0.05, 0.1]),
        lambda model: ob.impute(model, rows, rate_hz=80),
        lambda model: ob.resample(rows, 30, model),
    ):
        for one, other in zip(ask(learned), ask(blend), strict=True):
            np.testing.assert_array_equal(one.values, other.values)
    streams = [ob.Stream(learned), ob.Stream(blend)]
    given = [stream.step(0.0, [0.5, 0.5]) for stream in streams]
    np.testing.assert_array_equal(given[0][1], given[1][1])


def test_a_blend_is_evaluated_on_every_task(learned):
    found = ob.evaluate(learned, learned.test, horizons=[0.05, 0.1])
    assert [scores.task for scores in found.tasks] == [
        "one step ahead",
        "imputation, causal",
        "imputation, two_sided",
        "forecast, 0.05 s",
        "forecast, 0.1 s",
    ]
    again = evaluate_blend(learned.blend, learned.test, horizons=[0.05, 0.1])
    assert found.to_dict() == again.to_dict()
    ahead = found.tasks[0]
    rows = ob.predict(learned, learned.test)
    errors = [
        (p.values - t.values)[1:] / learned.blend.forward.scaler.scale
        for p, t in zip(rows, learned.test, strict=True)
    ]
    expected = np.sqrt(np.mean(np.concatenate(errors) ** 2))
    assert ahead.overall["blend"] == pytest.approx(expected)
    assert "forecast, 0.1 s" in repr(found)
    assert ob.evaluate(learned.blend.forward, learned.test).scores.keys() >= {"last_value"}


def test_results_show_a_few_lines_however_long_they_are(learned):
    model, long = learned.blend.forward, ob.Trajectory(np.arange(10_000.0), np.ones((10_000, 2)))
    shown = {
        "Trajectory(10000 rows, 2 channels": long,
        "Dataset(1 trajectories, 10000 rows": ob.Dataset(long),
        "Batch(1 trajectories, up to 10000 rows": model.batch(ob.Dataset(long)),
        "Answer(10000 rows, 2 channels": ob.predict(learned, long)[0],
        "Inspection(data: 1 episodes, 10000 rows": ob.inspect(long),
        "Blend(2 channels": learned.blend,
        "Learned(": learned,
        "FitResult(1 epochs": learned.fit,
        "Stream(2 channels": ob.Stream(learned),
    }
    for start, value in shown.items():
        assert repr(value).startswith(start), value
        assert len(repr(value)) < 3000, value
    assert "with intervals" in repr(ob.predict(learned, long)[0])
    assert "without intervals" in repr(ob.predict(model, long)[0])
    stream = ob.Stream(learned, time_unit="ms")
    stream.observe(20, [0.1, 0.2])
    assert repr(stream) == "Stream(2 channels, newest row at 20 ms)"


@pytest.mark.parametrize(
    "ask",
    [
        lambda: ob.forecast("runs/arm", LOG, 0.1),
        lambda: ob.evaluate("runs/arm", LOG),
        lambda: ob.evaluate({"mine": 3}, LOG),
        lambda: ob.evaluate({"blend": ob.fit_blend(LOG, LOG, causal=("mean",))}, LOG),
        lambda: ob.evaluate(ob.make_model("gru", LOG), LOG, horizons=[0.1]),
        lambda: ob.Stream(None),
        lambda: ob.export_onnx("runs/arm", "arm.onnx"),
        lambda: ob.fit("gru", LOG),
        lambda: ob.windows(LOG.values, 10),
        lambda: ob.split(LOG),
        lambda: ob.learn(ob.to_pandas(LOG)),
    ],
)
def test_wrong_arguments_give_one_line(ask):
    with pytest.raises(InputError) as caught:
        ask()
    assert "\n" not in str(caught.value)


def test_one_trajectory_is_taken_as_a_data_set():
    assert len(ob.windows(LOG, 100, cut="consecutive")) == 6
    assert len(ob.Dataset(LOG)) == 1
    parts = split_in_time(LOG, (0.5, 0.25, 0.25))
    assert [part[0].rows for part in parts] == [300, 150, 150]
