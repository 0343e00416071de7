"""One streaming step of a model as an ONNX file, its state as inputs and outputs."""

from __future__ import annotations

import json
import logging
import math
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.overrides import TorchFunctionMode

from offbeat import kernels
from offbeat.baselines.history import History
from offbeat.data.batch import Batch
from offbeat.errors import InputError, one_of, require
from offbeat.export.runner import FORMAT, METADATA, STATE, VERSION, WITHOUT_BASE
from offbeat.files import atomic_path
from offbeat.models.corrected import CorrectedModel
from offbeat.models.elapsed import RecurrentState
from offbeat.models.model import Model
from offbeat.ode import tableau
from offbeat.stream.blend_engine import flat_state, like_state


def export_onnx(model: Model | CorrectedModel, path: str | Path) -> None:
    """Writes one streaming step of a model as an ONNX file, for `OnnxStream` or any ONNX runtime.

    Inputs: `t` (1,) float64, s, since any fixed origin; `values` (1, channels) float64 in original
    units, transformed, NaN where not measured; and the state. Outputs: `prediction` (1, channels)
    float64 in original units, of a row at `t`, before its values are used; and the state after the
    row, each part named as the input with `_next`. A prediction alone is the same step with all
    values NaN, whose state is not used. The initial state, channel names, units and input
    transforms are JSON in the metadata under `offbeat`.

    The graph is a trace of `model.forward` in the reference backend, for one row. The steps of the
    solver from node to node are a loop in it. Where the model corrects a baseline, the baseline and
    its state are part of the graph.

    Args:
        model: trained.
        path: .onnx file, written atomically.

    Raises:
        InputError: a model without a recurrent state or with actions; an adaptive solver, whose
            number of steps is not known before; self-feeding, which draws random numbers; or
            another suffix.
        MissingExtraError: onnx or onnxscript is not installed.
    """
    path = Path(path)
    one_of("suffix of an ONNX file", path.suffix, (".onnx",))
    _check_exportable(model)
    onnx = require("onnx", "export")
    optimizer: Any = require("onnxscript.optimizer", "export")
    inner = model.inner if isinstance(model, CorrectedModel) else model
    past = inner.empty_state(1)
    initial = {name: getattr(past, name).detach().cpu().clone() for name in STATE}
    step: nn.Module = StreamStep(inner)
    if isinstance(model, CorrectedModel):
        step = CorrectedStep(model)
        initial |= step.initial()
    inputs = (
        torch.zeros(1, dtype=torch.float64),
        torch.zeros((1, model.channels), dtype=torch.float64),
        *initial.values(),
    )
    with torch.no_grad(), _quiet(), _traceable(inner):
        program: Any = torch.onnx.export(
            step.eval(),
            inputs,
            input_names=["t", "values", *initial],
            output_names=["prediction", *(f"{name}_next" for name in initial)],
            dynamo=True,
            optimize=False,
            verbose=False,
        )
    # All but its rule for nested bounds, which can refer to a constant that it does not add.
    optimizer.fold_constants(program.model)
    optimizer.remove_unused_nodes(program.model)
    proto = program.model_proto
    entry = proto.metadata_props.add()
    entry.key, entry.value = METADATA, json.dumps(_record(model, initial), allow_nan=False)
    onnx.checker.check_model(proto)
    with atomic_path(path) as temporary:
        temporary.write_bytes(proto.SerializeToString())


class StreamStep(nn.Module):
    """`model.forward` for one row of one trajectory, from and to original units.

    Args:
        model: runs within `_traceable`.
    """

    shift: Tensor
    scale: Tensor

    def __init__(self, model: Model) -> None:
        super().__init__()
        self.model = model
        self.register_buffer("shift", torch.tensor(model.scaler.shift)[None])
        self.register_buffer("scale", torch.tensor(model.scaler.scale)[None])

    def forward(self, t: Tensor, values: Tensor, *state: Tensor) -> tuple[Tensor, ...]:
        """Prediction and next state.

        Args:
            t: (1,) float64, s.
            values: (1, channels) float64, original units, NaN where not measured.
            *state: the parts named in `STATE`, as in `RecurrentState`.
        """
        with _ExactNumbers():
            scaled = ((values - self.shift) / self.scale).to(self.model.dtype)
            mask = scaled.abs() < math.inf  # False for NaN, too
            scaled = torch.where(mask, scaled, torch.zeros_like(scaled))[:, None]
            mask, valid = mask[:, None], torch.ones_like(t[:, None], dtype=torch.bool)
            row = Batch(t[:, None], scaled, mask, mask, valid, self.model.roles)
            given: dict[str, Any] = dict(zip(STATE, state, strict=True))
            past = RecurrentState(**given)
            output = self.model(row, past=past)
            prediction = output.mean[:, 0].double() * self.scale + self.shift
            # An output that is also an input would be missing in the graph.
            return prediction, *(getattr(output.past, name).clone() for name in STATE)


class CorrectedStep(nn.Module):
    """The same for a model that corrects a baseline, whose state is further parts.

    Args:
        model: its inner model runs within `_traceable`.
    """

    def __init__(self, model: CorrectedModel) -> None:
        super().__init__()
        self.model, self.history = model, History(1)
        self.inner = StreamStep(model.inner)

    def empty(self) -> dict[str, Any]:
        """The nested state of the baseline before the first row."""
        zeros = np.zeros((1, self.model.channels))
        return {"base": self.model.base.start(zeros), "history": self.history.start(zeros)}

    def initial(self) -> dict[str, Tensor]:
        """The same, flat, by the names of the inputs."""
        return {k: torch.from_numpy(v.copy()) for k, v in flat_state(self.empty()).items()}

    def forward(self, t: Tensor, values: Tensor, *state: Tensor) -> tuple[Tensor, ...]:
        """Prediction and next state, as of `StreamStep`, and then those of the baseline."""
        model, own = self.model, state[len(STATE) :]
        mean, *after = self.inner(t, values, *state[: len(STATE)])
        with _ExactNumbers():
            given: dict[str, Any] = dict(zip(flat_state(self.empty()), own, strict=True))
            past = like_state(self.empty(), given)
            shift, scale = self.inner.shift, self.inner.scale
            time = t[:, None]
            base = (model.base.read(past["base"], time) - shift) / scale
            output = (mean - shift) / scale
            joined = model.joined(base, output, History.age(past["history"], time))
            mask = ((values - shift) / scale).to(model.dtype).abs() < math.inf
            row = (time, torch.where(mask, values, torch.zeros_like(values)), mask)
            then = {
                "base": model.base.observe(past["base"], *row),
                "history": self.history.observe(past["history"], *row),
            }
            named = dict(_named(then))
            nexts = [named[name].double().clone() for name in given]
            return joined * scale + shift, *after, *nexts


def _named(state: dict[str, Any], prefix: str = "") -> Iterator[tuple[str, Tensor]]:
    """The tensors of nested states, with the names of `flat_state`."""
    for name, value in state.items():
        if isinstance(value, dict):
            yield from _named(value, f"{prefix}{name}/")
        else:
            yield prefix + name, value


class _ExactNumbers(TorchFunctionMode):
    """Converts Python numbers that are inexact in float32 to tensors, for the exporter."""

    def __torch_function__(
        self,
        func: Callable[..., Any],
        types: Any,
        args: tuple[Any, ...] = (),
        kwargs: dict[str, Any] | None = None,
    ) -> Any:
        """Calls `func` with tensors for such numbers."""
        kwargs = kwargs or {}
        if func is torch.add and "alpha" in kwargs:
            return args[0] + _exact(kwargs["alpha"]) * args[1]
        if any(isinstance(arg, Tensor) for arg in args):
            args = tuple(_exact(arg) for arg in args)
        return func(*args, **kwargs)


def _exact(value: Any) -> Any:
    if type(value) is float and math.isfinite(value) and float(np.float32(value)) != value:
        return torch.tensor(value, dtype=torch.float64)
    return value


@contextmanager
def _traceable(model: Model) -> Iterator[None]:
    """Runs a model in the reference backend, with its solver steps as a loop."""
    spec = model.spec
    try:
        model.spec = replace(spec, loops=bool(spec.field) and spec.max_step is not None)
        with kernels.use("reference"):
            yield
    finally:
        model.spec = spec


@contextmanager
def _quiet() -> Iterator[None]:
    """Suppresses the warnings of the exporter about its own internals."""
    log = logging.getLogger("torch.onnx")
    level = log.level
    log.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        log.setLevel(level)


def _record(model: Model | CorrectedModel, initial: dict[str, Tensor]) -> dict[str, Any]:
    """The metadata that a stream needs besides the graph."""
    inner = model.inner if isinstance(model, CorrectedModel) else model
    limit = float(inner.config.gap_limit or 1)
    further = {name: value.tolist() for name, value in initial.items() if name not in STATE}
    finite = {  # JSON has no infinities: the runner sets the other initial values
        name: initial[name].tolist() for name in ("state", "last")
    }
    return {
        "format": FORMAT,
        "version": VERSION if further else WITHOUT_BASE,
        "model": model.name,
        "names": list(model.names),
        "units": list(model.units),
        "roles": list(model.roles),
        "median_gap_s": model.statistics.median_gap,
        "elapsed_limit_s": model.statistics.longest_elapsed * limit,
        "transforms": model.transforms.to_dict(),
        "dtype": str(model.dtype).removeprefix("torch."),
        "initial": finite,
        **({"base": further} if further else {}),
    }


def _check_exportable(model: Model | CorrectedModel) -> None:
    model = model.inner if isinstance(model, CorrectedModel) else model
    if not isinstance(model, Model):
        raise InputError(
            f"the model {model.name!r} has no recurrent state, so no step to export; stream it "
            "with offbeat.Stream"
        )
    if model.acts:
        raise InputError("a model with actions cannot be exported; stream it with offbeat.Stream")
    if model.config.self_feeding:
        raise InputError(
            "a model with self_feeding draws random numbers at every row, which a graph cannot; "
            "train one without self_feeding to export it"
        )
    if not model.spec.field:
        return
    if tableau(model.spec.solver).adaptive:
        raise InputError(
            f"the solver {model.spec.solver!r} chooses its steps by their errors, which an ONNX "
            "graph cannot; train or load the model with a solver of fixed "
            "steps (euler, midpoint, heun, rk4), or stream it with offbeat.Stream"
        )
