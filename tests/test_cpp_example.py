"""The C++ example is built, and predicts with the bits of a stream in Python."""

from __future__ import annotations

import math
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from model_helpers import dataset, small_model, trajectory

from offbeat import Dataset, InputError, Model, ModelConfig, Scaler, Stream, kernels
from offbeat.cli.export import export_command
from offbeat.data.transforms import Angle, Transforms
from offbeat.kernels import cpu
from offbeat.stream.file import write_stream

EXAMPLE = Path(__file__).parent.parent / "examples" / "cpp"
MODELS: dict[str, dict[str, Any]] = {
    "gru": {"readout": "last_row"},
    "gru_d": {},
    "ode_rnn": {"dtype": torch.float32, "solver": "rk4", "time_input": "gap"},
    "ode_gru_d": {"clock": "first_row", "nodes": "rows", "bounded": False},
    "anchored_ode_gru_d": {"max_step": 0.5, "dtype": torch.float32},
    "anchored_trend": {},
}
pytestmark = [
    pytest.mark.skipif(
        not (shutil.which("cmake") and shutil.which("c++")), reason="there is no C++ compiler"
    ),
    pytest.mark.skipif(not cpu.instruction_sets(), reason="there is no compiled backend"),
    pytest.mark.timeout(600),
]


@pytest.fixture(scope="module")
def follow(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The program, with the instruction set that every processor has: the others take minutes."""
    build = tmp_path_factory.mktemp("build")
    for command in (
        ["cmake", "-S", EXAMPLE, "-B", build, "-DOFFBEAT_PORTABLE=ON"],
        ["cmake", "--build", build, "--parallel", "2"],
    ):
        done = subprocess.run(command, capture_output=True, text=True)
        assert done.returncode == 0, done.stdout + done.stderr
    return build / "follow"


def model_of(name: str) -> Model:
    train = dataset(6, seed=9)
    train = Dataset(tuple(replace(one, roles=("state", "state", "exogenous")) for one in train))
    scaler = Scaler("standardise", np.array([0.3, -0.1, 1e3]), np.array([0.7, 1 / 3, -9.0]))
    return small_model(name, train, scaler=scaler, **MODELS[name])


def log(rows: int = 40) -> list[tuple[float, list[float]]]:
    """Rows at Unix times with values of some channels, of none, and out of all bounds."""
    one = trajectory(5, rows)
    values = np.where(one.observed, one.values, math.nan)
    values[7, 0], values[9, 2] = math.inf, -1e308
    return list(zip((1.7e9 + one.times).tolist(), values.tolist(), strict=True))


def run(follow: Path, model: Path, text: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([follow, model], input=text, capture_output=True, text=True)


def text_of(rows: list[tuple[float, list[float]]]) -> str:
    return "".join(" ".join(map(repr, (t, *values))) + "\n" for t, values in rows)


@pytest.mark.parametrize("name", sorted(MODELS))
def test_it_predicts_with_the_bits_of_a_stream(name: str, follow: Path, tmp_path: Path) -> None:
    model, rows = model_of(name), log()
    write_stream(model, tmp_path / "model")
    done = run(follow, tmp_path / "model", text_of(rows))
    assert done.returncode == 0, done.stderr
    got = np.array([[float(word) for word in line.split()] for line in done.stdout.splitlines()])
    with kernels.use("baseline"):
        stream = Stream(model)
        expected = [stream.step(t, values)[1] for t, values in rows]
    assert np.array_equal(got, np.array(expected), equal_nan=True)
    assert np.isfinite(got[:, :2]).all()
    assert np.isnan(got[:, 2]).all()
    assert len(np.unique(got[:, 0])) > 10


@pytest.mark.parametrize("cut", [0, 10, 17, 60, 1000, -5, -4])
def test_a_damaged_file_is_one_line_of_error(cut: int, follow: Path, tmp_path: Path) -> None:
    write_stream(model_of("gru_d"), tmp_path / "model")
    data = (tmp_path / "model").read_bytes()
    (tmp_path / "model").write_bytes(data[:cut])
    done = run(follow, tmp_path / "model", text_of(log()))
    assert done.returncode == 2
    assert done.stdout == ""
    assert done.stderr.count("\n") == 1
    assert "damaged" in done.stderr or "is no model" in done.stderr


def test_a_file_that_is_not_there_is_one_line_of_error(follow: Path, tmp_path: Path) -> None:
    done = run(follow, tmp_path / "model", "")
    assert (done.returncode, done.stderr) == (2, f"{tmp_path / 'model'} can't be read\n")


def test_rows_out_of_order_are_refused(follow: Path, tmp_path: Path) -> None:
    write_stream(model_of("gru"), tmp_path / "model")
    done = run(follow, tmp_path / "model", "2 1 1 1\n1 1 1 1\n")
    assert done.returncode == 2
    assert "1 s older than the newest one" in done.stderr


@pytest.mark.parametrize(
    ("made", "reason"),
    [
        ({"solver": "dopri5"}, "chooses its own steps"),
        ({"head": "gaussian"}, "its head is not point"),
        ({"self_feeding": 0.5}, "self-feeding"),
    ],
)
def test_a_model_that_the_library_cannot_run_is_refused(
    made: dict[str, Any], reason: str, tmp_path: Path
) -> None:
    with pytest.raises(InputError, match=reason):
        write_stream(small_model(ModelConfig(name="ode_rnn", **made)), tmp_path / "model")
    assert not list(tmp_path.iterdir())


def test_the_command_writes_the_same_file(tmp_path: Path) -> None:
    model = model_of("anchored_trend")
    write_stream(model, tmp_path / "expected")
    model.save(tmp_path / "model")
    export_command(tmp_path / "model", tmp_path / "got", to="cpp")
    assert (tmp_path / "got").read_bytes() == (tmp_path / "expected").read_bytes()


def test_a_model_with_transforms_is_refused(tmp_path: Path) -> None:
    train = dataset(6, seed=9)
    transforms = Transforms({train.names[0]: Angle(2 * math.pi, -math.pi)})
    model = small_model("gru", transforms.apply(train))
    with pytest.raises(InputError, match="transforms"):
        write_stream(model, tmp_path / "model")
