"""One step as an ONNX graph predicts what a stream predicts, and runs without torch."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from model_helpers import draw_weights, small_model, trajectory
from stream_helpers import message
from task_helpers import TASKS, TRAIN, VALIDATION
from test_contract import FLOAT32, FLOAT64, TOLERANCE, VARIANTS, ZOO, build, dtypes
from torch import Tensor

from offbeat import (
    FileFormatError,
    InputError,
    Model,
    OnnxStream,
    Stream,
    export_onnx,
    save_model,
)
from offbeat.answers.blend import Blend, fit_blend
from offbeat.answers.saved import save_blend
from offbeat.baselines import BASELINES, LastValue, fit_baseline
from offbeat.cli.app import main
from offbeat.data.tasks import draw_tasks
from offbeat.export.exporter import StreamStep, _traceable
from offbeat.export.runner import STATE
from offbeat.models.corrected import CorrectedModel
from offbeat.models.zoo import make_model

FIXED = [
    name
    for name, config in VARIANTS.items()
    if not config.self_feeding and config.solver not in ("dopri5", "tsit5")
]
QUICK = ("gru_d", "lstm", "anchored_ode_gru_d", "thesis-ode_gru_d", "gru_d-every")
EXPORTED = [
    *QUICK,
    "ode_gru_d-decay_rk4",
    "ode_rnn-max_step",
    *(pytest.param(name, marks=pytest.mark.slow) for name in sorted(ZOO) if name not in QUICK),
    pytest.param("anchored_ode_gru_d-decay_max_step", marks=pytest.mark.slow),
]
"""The exporter takes seconds, so beside the zoo only what takes another way through the graph."""


def made(name: str, dtype: torch.dtype = FLOAT32) -> Model:
    if name == "ode_gru_d-decay_rk4":
        return small_model("ode_gru_d", dtype=dtype, solver="rk4", steps_per_gap=3)
    return build(name, dtype)


@pytest.fixture(scope="session")
def exported(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """Path of an exported model, made when it is first asked for."""
    folder, paths = tmp_path_factory.mktemp("onnx"), {}

    def path(name: str, dtype: torch.dtype = FLOAT32) -> Path:
        key = f"{name}-{dtype}".replace("torch.", "")
        if key not in paths:
            paths[key] = folder / f"{key}.onnx"
            export_onnx(made(name, dtype), paths[key])
        return paths[key]

    return path


def difference(got: Any, expected: Any) -> float:
    """Largest error relative to the largest entry."""
    assert np.shape(got) == np.shape(expected)
    assert np.isfinite(expected).all()
    return float(np.abs(np.subtract(got, expected)).max() / np.abs(expected).max())


# --- the equations --------------------------------------------------------------------------------


@pytest.mark.parametrize("variant", FIXED)
@dtypes
def test_the_traced_step_predicts_what_a_stream_predicts(variant: str, dtype: torch.dtype) -> None:
    """Without the exporter: every option that can be exported, with gaps of all lengths."""
    model, one = build(variant, dtype), trajectory(4, 14)
    times = one.times.copy()
    times[9:] += 0.3  # longer than the limit of the model's clock
    assert 4 * model.statistics.longest_elapsed < 0.3
    step, past = StreamStep(model), model.empty_state(1)
    state: tuple[Tensor, ...] = tuple(getattr(past, name) for name in step.parts)
    stream, got, expected = Stream(model), [], []
    for row in range(one.rows):
        values = np.where(one.observed[row], one.values[row], np.nan)
        t = torch.tensor([times[row] - times[0]])
        with torch.no_grad(), _traceable(model):
            prediction, *after = step(t, torch.tensor(values)[None], *state)
        got.append(prediction[0].numpy())
        expected.append(stream.predict(times[row]))
        stream.observe(times[row], message(one, row))
        state = tuple(after)
    assert [part.dtype for part in state] == [getattr(past, name).dtype for name in step.parts]
    assert difference(got, expected) < TOLERANCE[dtype]


# --- onnxruntime ----------------------------------------------------------------------------------


def check_parity(model: Model, live: OnnxStream, tolerance: float) -> None:
    one, stream = trajectory(4, 14), Stream(model, time_unit="ns", late="reorder")
    ticks = np.round(one.times * 1e9).astype(np.int64) + 1_700_000_000_000_000_000
    got, expected = [], []
    for row in range(one.rows):
        asked = ticks[row] + np.array([0, 10**7, 5 * 10**9])
        got.append(live.predict(asked))
        expected.append(stream.predict(asked))
        for each in (live, stream):
            assert each.observe(ticks[row], message(one, row)) == "new"
            if row == 8:
                assert each.observe(ticks[6] + 1, {"channel_1": 0.5}) == "reordered"
    assert difference(got, expected) < tolerance
    assert live.counters == stream.counters


@pytest.mark.parametrize("name", EXPORTED)
def test_an_exported_model_predicts_what_its_stream_predicts(name: str, exported: Any) -> None:
    live = OnnxStream(exported(name), time_unit="ns", late="reorder")
    model = made(name)
    assert (live.names, live.units) == (model.names, model.units)
    check_parity(model, live, 1e-6)


def test_an_exported_model_of_double_precision_keeps_it(exported: Any) -> None:
    """Constants, too: the exporter writes Python numbers in single precision."""
    path = exported("ode_gru_d-decay_rk4", FLOAT64)
    model = made("ode_gru_d-decay_rk4", FLOAT64)
    check_parity(model, OnnxStream(path, time_unit="ns", late="reorder"), 1e-12)


@pytest.mark.parametrize(
    ("base", "name"),
    [
        ("damped_slope", "anchored_trend"),
        pytest.param("damped_slope", "anchored_ode_gru_d", marks=pytest.mark.slow),
        pytest.param("kalman_short", "ode_gru_d", marks=pytest.mark.slow),
    ],
)
def test_an_exported_model_that_corrects_a_baseline_predicts_what_its_stream_predicts(
    base: str, name: str, tmp_path: Path
) -> None:
    tasks = draw_tasks(TRAIN, TASKS, 60, seed=9)
    inner = make_model(name, TRAIN, hidden_size=4, decoder_units=(4,), field_units=(4,))
    model = CorrectedModel.of(draw_weights(inner), fit_baseline(base, tasks), tasks)
    export_onnx(model, tmp_path / "model.onnx")
    live, onnx = Stream(model), OnnxStream(tmp_path / "model.onnx")
    for time, values, observed in zip(
        VALIDATION[0].times, VALIDATION[0].values, VALIDATION[0].observed, strict=True
    ):
        ahead = float(time) + 0.3
        np.testing.assert_allclose(onnx.predict(ahead), live.predict(ahead), atol=1e-5)
        seen = np.where(observed & (time % 1 < 0.7), values, np.nan)
        live.observe(float(time), seen)
        onnx.observe(float(time), seen)
    again = OnnxStream(tmp_path / "model.onnx")
    again.restore(onnx.state())
    assert np.array_equal(again.predict(ahead), onnx.predict(ahead))


# --- blends ---------------------------------------------------------------------------------------

FEW = ("last_value", "damped_slope", "kalman_short")


def small_blend(model: Any = None, causal: Any = FEW) -> Blend:
    return fit_blend(
        TRAIN, VALIDATION, model, tasks=TASKS, causal=causal, two_sided=["linear"], count=40
    )


@pytest.fixture(scope="module")
def few(tmp_path_factory: pytest.TempPathFactory) -> tuple[Blend, Path]:
    """A blend of baselines alone, and its file."""
    blend, path = small_blend(), tmp_path_factory.mktemp("blend") / "blend.onnx"
    export_onnx(blend, path)
    return blend, path


def check_blend(blend: Blend, path: Path, tolerance: float) -> None:
    """Predictions and intervals, with dropouts, a late message and values out of any range."""
    live, onnx = Stream(blend, late="reorder"), OnnxStream(path, late="reorder")
    one, random = VALIDATION[0], np.random.default_rng(0)
    spread, moved = blend.stack.scale, []
    for row in range(60):
        for ahead in (0.0, 0.03, 0.3, 4.0):
            t = float(one.times[row]) + ahead
            expected, got = live.predict(t), onnx.predict(t)
            size = np.maximum(spread, np.abs(expected))
            assert np.abs((got - expected) / size).max() < tolerance
            moved.append(expected)
            for level in (0.33, 0.9):
                wide, same = live.half_width(t, level), onnx.half_width(t, level)
                np.testing.assert_allclose(same, wide, rtol=1e-9)
        seen = one.observed[row] & (random.random(3) < 0.8) & (not 20 <= row < 35)
        values = np.where(seen, one.values[row], np.nan)
        if row == 40:
            values = np.array([1e30, -np.inf, -1e200])
        for each in (live, onnx):
            assert each.observe(float(one.times[row]), values) == "new"
            if row == 12:
                assert each.observe(float(one.times[10]) + 0.01, {"b": 0.5}) == "reordered"
    assert (np.std(moved, axis=0) > 0).all()
    assert live.counters == onnx.counters


def test_an_exported_blend_of_baselines_is_its_stream_in_double_precision(few: Any) -> None:
    check_blend(*few, 1e-12)


def test_every_baseline_of_a_blend_by_default_can_be_exported(tmp_path: Path) -> None:
    blend = small_blend(causal=None)
    assert list(blend.stack.members) == [
        name for name, kind in BASELINES.items() if kind.causal and not kind.slow
    ]
    # Weights of all members, whatever they are good for here.
    blend.stack.weights[:] = 1 / len(blend.stack.members)
    export_onnx(blend, tmp_path / "blend.onnx")
    check_blend(blend, tmp_path / "blend.onnx", 1e-9)


@pytest.mark.slow
def test_a_blend_with_a_network_as_a_baseline_can_be_exported(tmp_path: Path) -> None:
    blend = small_blend(causal=["last_value", "residual_gru"])
    blend.stack.weights[:] = 0.5
    export_onnx(blend, tmp_path / "blend.onnx")
    check_blend(blend, tmp_path / "blend.onnx", 1e-9)


@pytest.mark.parametrize("corrects", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_a_blend_is_exported_with_its_model(corrects: bool, tmp_path: Path) -> None:
    sizes: dict[str, Any] = {"hidden_size": 4, "decoder_units": (4,), "field_units": (4,)}
    model: Any = draw_weights(make_model("anchored_ode_gru_d", TRAIN, **sizes))
    if corrects:
        tasks = draw_tasks(TRAIN, TASKS, 60, seed=9)
        model = CorrectedModel.of(model, fit_baseline("damped_slope", tasks), tasks)
    blend = small_blend(model)
    blend.gamma[:] = 0.5
    export_onnx(blend, tmp_path / "blend.onnx")
    check_blend(blend, tmp_path / "blend.onnx", 1e-5)


def test_a_restored_onnx_stream_of_a_blend_goes_on_bit_for_bit(few: Any) -> None:
    blend, path = few
    stream, again = OnnxStream(path), OnnxStream(path)
    for row in range(10):
        stream.observe(float(row), [0.1 * row, 0.0, np.nan])
    again.restore(json.loads(json.dumps(stream.state(), allow_nan=False)))
    assert np.array_equal(again.predict(9.5), stream.predict(9.5))
    assert np.array_equal(again.interval(9.5, 0.7), stream.interval(9.5, 0.7))
    with pytest.raises(InputError, match=r"at most 0\.98"):
        stream.interval(9.5, 0.99)
    with pytest.raises(InputError):
        Stream(blend).restore(stream.state())


def test_the_file_of_a_blend_tells_the_levels_of_its_half_widths(few: Any) -> None:
    """As docs/live.md tells it, for any runtime."""
    import onnxruntime

    blend, path = few
    session = onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])
    record = json.loads(session.get_modelmeta().custom_metadata_map["offbeat"])
    assert [i.name for i in session.get_inputs()] == ["t", "values", *record["base"]]
    state = {name: np.array(value) for name, value in record["base"].items()}
    stream, values = Stream(blend), np.array([[0.5, np.nan, 0.1]])
    out = session.run(None, {"t": np.array([0.0]), "values": values, **state})
    stream.observe(0.0, values[0])
    state = dict(zip(state, out[2:], strict=True))
    mean, half = session.run(None, {"t": np.array([0.2]), "values": values + np.nan, **state})[:2]
    low, high = stream.interval(0.2, 0.8)
    half = half[..., record["levels"].index(0.8)]
    np.testing.assert_allclose([(mean - half)[0], (mean + half)[0]], [low, high], rtol=1e-9)


def test_a_baseline_that_no_graph_can_hold_is_named(tmp_path: Path) -> None:
    class Branching(LastValue):
        def read(self, state: Any, time: Any) -> Any:
            last = super().read(state, time)
            return last if float(last.max()) > 0 else 2 * last

    BASELINES.register("branching", Branching)
    try:
        blend = small_blend(causal=["mean", "branching"])
        with pytest.raises(InputError, match="the baseline 'branching' of the blend cannot") as e:
            export_onnx(blend, tmp_path / "blend.onnx")
        assert "\n" not in str(e.value)
    finally:
        BASELINES.unregister("branching")
    assert not list(tmp_path.iterdir())


def test_the_command_exports_the_blend_of_a_run_and_streams_it_without_torch(
    few: Any, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    blend, _ = few
    save_blend(blend, tmp_path / "run")
    out = tmp_path / "run.onnx"
    assert main(["export", str(tmp_path / "run"), str(out), "--json"]) == 0
    assert json.loads(capfd.readouterr().out)["model"] == "blend"
    code = (
        "import sys; sys.modules['torch'] = None\n"
        "from offbeat.cli.app import main; sys.exit(main(sys.argv[1:]))"
    )
    lines = b'{"t": 0.0, "values": {"a": 0.5}}\n{"predict": 0.2}\n'
    call = [sys.executable, "-c", code, "stream", str(out)]
    found = subprocess.run(call, input=lines, capture_output=True, check=False)
    assert found.returncode == 0, found.stderr
    answer = json.loads(found.stdout.splitlines()[1])
    stream = Stream(blend)
    stream.observe(0.0, {"a": 0.5})
    assert list(answer["prediction"].values()) == pytest.approx(stream.predict(0.2).tolist())
    assert list(answer["low"].values()) == pytest.approx(stream.interval(0.2)[0].tolist())


# --- the file -------------------------------------------------------------------------------------


def test_any_runtime_can_run_the_file_from_what_stands_in_it(exported: Any) -> None:
    """As docs/live.md tells it: names, state and its beginning are in the file."""
    import onnxruntime

    path = exported("gru_d")
    session = onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])
    record = json.loads(session.get_modelmeta().custom_metadata_map["offbeat"])
    inputs = {i.name: (i.type, i.shape) for i in session.get_inputs()}
    assert list(inputs) == ["t", "values", *STATE]
    assert inputs["t"] == ("tensor(double)", [1])
    assert inputs["values"] == ("tensor(double)", [1, 3])
    assert inputs["state"] == ("tensor(float)", [1, 4])
    outputs = [o.name for o in session.get_outputs()]
    assert outputs == ["prediction", *(f"{name}_next" for name in STATE)]
    inf = np.inf
    state = {
        "state": np.array(record["initial"]["state"], dtype=np.float32),
        "last": np.array(record["initial"]["last"], dtype=np.float32),
        "time": np.array([np.nan]),
        "start": np.array([inf]),
        "observed_at": np.array([-inf]),
        "channel_at": np.full((1, 3), -inf),
        "updated": np.array([False]),
    }
    stream = Stream(made("gru_d"))
    for t in (0.0, 0.25):
        values = np.array([[1.0, np.nan, t]])
        found = session.run(None, {"t": np.array([t]), "values": values, **state})
        assert difference(found[0][0], stream.predict(t)) < 1e-6
        stream.observe(t, values[0])
        state = dict(zip(STATE, found[1:], strict=True))
    assert record["names"] == ["channel_0", "channel_1", "channel_2"]
    assert record["units"] == ["m"] * 3
    assert record["model"] == "gru_d"


def test_what_is_no_number_in_single_precision_was_not_measured(exported: Any) -> None:
    clean, dirty = OnnxStream(exported("gru_d")), OnnxStream(exported("gru_d"))
    for row, bad in enumerate([np.inf, -1e39, 1e300, np.nan]):
        clean.observe(0.1 * row, {"channel_0": 1.0})
        dirty.observe(0.1 * row, {"channel_0": 1.0, "channel_1": bad})
    assert np.array_equal(clean.predict(1.0), dirty.predict(1.0))


def test_a_restored_onnx_stream_goes_on_bit_for_bit(exported: Any) -> None:
    one, stream = trajectory(4, 10), OnnxStream(exported("gru_d"))
    for row in range(6):
        stream.observe(one.times[row], message(one, row))
    record = json.loads(json.dumps(stream.state(), allow_nan=False))
    again = OnnxStream(exported("gru_d"))
    again.restore(record)
    for row in range(6, 10):
        assert np.array_equal(again.predict(one.times[row]), stream.predict(one.times[row]))
        for each in (again, stream):
            each.observe(one.times[row], message(one, row))
    with pytest.raises(InputError):
        Stream(made("gru_d")).restore(record)
    stream.reset()
    fresh = OnnxStream(exported("gru_d"))
    assert np.array_equal(stream.predict(0.0), fresh.predict(0.0))


def test_it_runs_without_torch(exported: Any) -> None:
    code = (
        "import sys\n"
        "sys.modules['torch'] = None  # an import of it would fail\n"
        "from offbeat import OnnxStream\n"
        "stream = OnnxStream(sys.argv[1])\n"
        "stream.observe(0.0, {'channel_0': 1.0})\n"
        "print(stream.predict(0.5).tolist())\n"
        "assert sys.modules['torch'] is None\n"
    )
    call = [sys.executable, "-W", "error", "-c", code, str(exported("gru_d"))]
    found = subprocess.run(call, capture_output=True, text=True, check=False)
    assert found.returncode == 0, found.stderr
    stream = Stream(made("gru_d"))
    stream.observe(0.0, {"channel_0": 1.0})
    assert difference(json.loads(found.stdout), stream.predict(0.5)) < 1e-6


# --- the commands ---------------------------------------------------------------------------------


def test_the_command_exports_and_the_stream_command_runs_the_file_without_torch(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    model, out = small_model("anchored_ode_gru_d", dtype=FLOAT32), tmp_path / "model.onnx"
    save_model(model, tmp_path / "model")
    assert main(["export", str(tmp_path / "model"), str(out), "--to", "onnx", "--json"]) == 0
    captured = capfd.readouterr()
    assert captured.err == ""
    assert json.loads(captured.out) == {
        "written": str(out), "model": "anchored_ode_gru_d", "bytes": out.stat().st_size,
    }  # fmt: skip
    code = (
        "import sys; sys.modules['torch'] = None\n"
        "from offbeat.cli.app import main; sys.exit(main(sys.argv[1:]))"
    )
    lines = b'{"t": 0.0, "values": {"channel_0": 1.0}}\n{"predict": 0.5}\n'
    call = [sys.executable, "-c", code, "stream", str(out)]
    found = subprocess.run(call, input=lines, capture_output=True, check=False)
    assert found.returncode == 0, found.stderr
    answers = [json.loads(line) for line in found.stdout.splitlines()]
    stream = Stream(model)
    stream.observe(0.0, {"channel_0": 1.0})
    assert difference(list(answers[1]["prediction"].values()), stream.predict(0.5)) < 1e-6


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"solver": "dopri5"}, "chooses its steps by their errors"),
        ({"solver": "tsit5"}, "chooses its steps by their errors"),
        ({"self_feeding": 0.5}, "draws random numbers"),
    ],
)
def test_what_no_graph_can_do_is_refused_in_one_line(
    options: dict[str, Any], said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    save_model(small_model("ode_rnn", **options), tmp_path / "model")
    assert main(["export", str(tmp_path / "model"), str(tmp_path / "out.onnx")]) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1
    assert said in lines[0]
    assert not (tmp_path / "out.onnx").exists()


def test_bad_arguments_of_the_export_command_are_one_line_each(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for arguments, said in (
        (["none", "out.onnx"], "not a checkpoint"),
        (["none", "out.pt"], "unknown suffix"),
        (["none", "out.onnx", "--to=tflite"], "unknown export format 'tflite'"),
    ):
        assert main(["export", *arguments]) == 2
        assert said in capsys.readouterr().err
    with pytest.raises(InputError):
        export_onnx(small_model("gru"), tmp_path / "model.pt")


@pytest.mark.parametrize("content", [b"", b"no model", None])
def test_a_file_that_is_not_ours_is_refused(content: bytes | None, tmp_path: Path) -> None:
    path = tmp_path / "model.onnx"
    if content is None:
        import onnx

        graph = onnx.helper.make_graph(
            [onnx.helper.make_node("Identity", ["x"], ["y"])],
            "other",
            [onnx.helper.make_tensor_value_info("x", 1, [1])],
            [onnx.helper.make_tensor_value_info("y", 1, [1])],
        )
        opset = [onnx.helper.make_opsetid("", 20)]
        model = onnx.helper.make_model(graph, opset_imports=opset, ir_version=10)
        content = model.SerializeToString()
    path.write_bytes(content)
    with pytest.raises(FileFormatError):
        OnnxStream(path)
    with pytest.raises(FileFormatError):
        OnnxStream(tmp_path / "none.onnx")


def test_a_file_of_another_version_is_refused(exported: Any, tmp_path: Path) -> None:
    import onnx

    model = onnx.load(exported("gru_d"))
    (entry,) = [e for e in model.metadata_props if e.key == "offbeat"]
    entry.value = json.dumps(json.loads(entry.value) | {"version": 99})
    onnx.save(model, tmp_path / "model.onnx")
    with pytest.raises(FileFormatError):
        OnnxStream(tmp_path / "model.onnx")
