"""One streaming step of a model as an ONNX file, its state as inputs and outputs."""

from __future__ import annotations

import json
import logging
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from offbeat.data.transforms import transforms_of
from offbeat.errors import InputError, one_of, require
from offbeat.export.runner import FORMAT, METADATA, STATE, VERSION
from offbeat.export.step import StreamStep, most_steps
from offbeat.files import atomic_path
from offbeat.models.model import Model
from offbeat.ode import tableau

MOST_STEPS = 256
"""Solver steps over one gap that are written out; more make a graph that nobody wants to load."""


def export_onnx(model: Model, path: str | Path) -> None:
    """Writes one streaming step of a model as an ONNX file, for `OnnxStream` or any ONNX runtime.

    Inputs: `t` (1,) float64, s, on any clock that keeps its origin; `values` (1, channels) float64
    in original units, NaN where not measured; and the state. Outputs: `prediction` (1, channels)
    float64 in original units, of a row at `t`, before its values are looked at; and the state
    after the row, each part named as the input with `_next`. A prediction alone is the same step
    with all values NaN, its state thrown away. The state before anything was seen, channel names
    and units stand as JSON in the metadata under `offbeat`.

    Args:
        model: trained.
        path: .onnx file to write, whole or not at all.

    Raises:
        InputError: an adaptive solver, whose number of steps no fixed graph can have; more than
            256 steps over a gap; self-feeding, which draws generator; or another suffix.
        MissingExtraError: onnx or onnxscript is not installed.
    """
    path = Path(path)
    one_of("suffix of an ONNX file", path.suffix, (".onnx",))
    _check_exportable(model)
    onnx = require("onnx", "export")
    require("onnxscript", "export")
    step = StreamStep(model).eval()
    carry = model.empty_state(1)
    initial = {name: getattr(carry, name).detach().clone() for name in STATE}
    inputs = (
        torch.zeros(1, dtype=torch.float64),
        torch.zeros((1, model.channels), dtype=torch.float64),
        *initial.values(),
    )
    with torch.no_grad(), _quiet():
        program: Any = torch.onnx.export(
            step,
            inputs,
            input_names=["t", "values", *STATE],
            output_names=["prediction", *(f"{name}_next" for name in STATE)],
            dynamo=True,
            verbose=False,
        )
    proto = program.model_proto
    entry = proto.metadata_props.add()
    entry.key, entry.value = METADATA, json.dumps(_facts(model, initial), allow_nan=False)
    onnx.checker.check_model(proto)
    with atomic_path(path) as temporary:
        temporary.write_bytes(proto.SerializeToString())


@contextmanager
def _quiet() -> Iterator[None]:
    """Keeps to itself what the exporter says of its own insides."""
    log = logging.getLogger("torch.onnx")
    level = log.level
    log.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        log.setLevel(level)


def _facts(model: Model, initial: dict[str, Tensor]) -> dict[str, Any]:
    """What a stream must know that the graph does not say."""
    limit = float(model.config.gap_limit or 1)
    finite = {  # JSON has no infinities: these begin as the runner knows
        name: initial[name].tolist() for name in ("state", "last")
    }
    return {
        "format": FORMAT,
        "version": VERSION,
        "model": model.config.name,
        "names": list(model.names),
        "units": list(model.units),
        "median_gap_s": model.statistics.median_gap,
        "elapsed_limit_s": model.statistics.longest_elapsed * limit,
        "transforms": transforms_of(model).to_dict(),
        "dtype": str(model.dtype).removeprefix("torch."),
        "initial": finite,
    }


def _check_exportable(model: Model) -> None:
    if model.config.self_feeding:
        raise InputError(
            "a model with self_feeding draws a coin at every row, which no graph can; train one "
            "without self_feeding to export it"
        )
    if not model.spec.field:
        return
    if tableau(model.spec.solver).adaptive:
        raise InputError(
            f"the solver {model.spec.solver!r} takes as many steps as a gap needs, and an ONNX "
            "graph has a fixed number of them; train or load the model with a solver of fixed "
            "steps (euler, midpoint, heun, rk4), or stream it with offbeat.Stream"
        )
    steps = most_steps(model)
    if steps > MOST_STEPS:
        raise InputError(
            f"max_step={model.spec.max_step} makes up to {steps} steps over a gap, more than the "
            f"{MOST_STEPS} that are written out; use a longer max_step, or offbeat.Stream"
        )
