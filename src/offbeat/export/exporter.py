"""One streaming step of a model as an ONNX file, its state as inputs and outputs."""

from __future__ import annotations

import json
import logging
import math
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.overrides import TorchFunctionMode

from offbeat import kernels
from offbeat.answers.blend import Blend
from offbeat.answers.intervals import LEVELS
from offbeat.answers.predict import Answering, answering
from offbeat.baselines.base import CausalBaseline
from offbeat.baselines.history import History
from offbeat.data.batch import Batch
from offbeat.errors import InputError, one_of, require
from offbeat.export.runner import FORMAT, METADATA, STATE, VERSION, WITH_BASE, WITHOUT_BASE
from offbeat.files import atomic_path
from offbeat.models.base import BaseModel
from offbeat.models.corrected import CorrectedModel
from offbeat.models.elapsed import RecurrentState
from offbeat.models.model import Model
from offbeat.ode import tableau
from offbeat.stream.blend_engine import flat_state, like_state
from offbeat.stream.stream import info_of


def export_onnx(model: Answering, path: str | Path) -> None:
    """Writes one streaming step of a model as an ONNX file, for `OnnxStream` or any ONNX runtime.

    Inputs: `t` (1,) float64, s, since any fixed origin; `values` (1, channels) float64 in original
    units, transformed, NaN where not measured; and the state. Outputs: `prediction` (1, channels)
    float64 in original units, of a row at `t`, before its values are used; of a blend, the
    `half_widths` (1, channels, levels) float64 of its intervals; and the state after the row, each
    part named as the input with `_next`. A prediction alone is the same step with all values NaN,
    whose state is not used. The initial state, channel names, units, input transforms and the
    probabilities of the intervals are JSON in the metadata under `offbeat`.

    The graph is a trace of `model.forward` in the reference backend, for one row. The steps of the
    solver from node to node are a loop in it. Where the model corrects a baseline, the baseline and
    its state are part of the graph; of a blend, all of its causal baselines, in float64.

    Args:
        model: trained; a blend predicts from the past, as in `Stream`.
        path: .onnx file, written atomically.

    Raises:
        InputError: a model without a recurrent state or with actions; an adaptive solver, whose
            number of steps is not known before; self-feeding, which draws random numbers; a
            baseline that does not run on torch tensors; or another suffix.
        MissingExtraError: onnx or onnxscript is not installed.
    """
    model = answering(model)
    forward = model.forward if isinstance(model, Blend) else model
    inner = None if forward is None else exportable(forward)
    if inner is not None and inner.acts:
        raise InputError(
            "a model with actions is exported as a policy (offbeat.policies.export_policy), or "
            "streamed with offbeat.Stream"
        )
    step = BlendStep(model) if isinstance(model, Blend) else _step_of(model)
    write_step(step, inner, _record(model, step.initial()), path, blend=model)


def write_step(
    step: Step,
    inner: Model | None,
    record: dict[str, Any],
    path: str | Path,
    *,
    blend: Any = None,
) -> None:
    """Writes a step as an ONNX file.

    Args:
        step: to trace.
        inner: the model that it runs, from `exportable`.
        record: JSON-like metadata.
        path: .onnx file, written atomically.
        blend: whose baselines are named where they cannot be traced.

    Raises:
        InputError: another suffix, or a baseline that cannot be traced.
        MissingExtraError: onnx or onnxscript is not installed.
    """
    path = Path(path)
    one_of("suffix of an ONNX file", path.suffix, (".onnx",))
    onnx = require("onnx", "export")
    optimizer: Any = require("onnxscript.optimizer", "export")
    with torch.no_grad(), _quiet(), nullcontext() if inner is None else _traceable(inner):
        try:
            program = _traced(step)
        except Exception:
            if isinstance(blend, Blend):
                _check_members(blend)
            raise
    # All but its rule for nested bounds, which can refer to a constant that it does not add.
    optimizer.fold_constants(program.model)
    optimizer.remove_unused_nodes(program.model)
    proto = program.model_proto
    entry = proto.metadata_props.add()
    entry.key, entry.value = METADATA, json.dumps(record, allow_nan=False)
    onnx.checker.check_model(proto)
    with atomic_path(path) as temporary:
        temporary.write_bytes(proto.SerializeToString())


def _traced(step: Step) -> Any:
    """The ONNX program of a step."""
    initial = step.initial()
    inputs = (
        torch.zeros(1, dtype=torch.float64),
        torch.zeros((1, step.channels), dtype=torch.float64),
        *initial.values(),
    )
    return torch.onnx.export(
        step.eval(),
        inputs,
        input_names=["t", "values", *initial],
        output_names=[*step.answers, *(f"{name}_next" for name in initial)],
        dynamo=True,
        optimize=False,
        verbose=False,
    )


def _check_members(blend: Blend) -> None:
    """Says which baseline of a blend cannot be exported."""
    for name, member in blend.stack.members.items():
        try:
            _traced(BaselineStep(member, blend.channels))
        except Exception as error:
            what = " ".join(str(error.__cause__ or error).split())[:200]
            raise InputError(
                f"the baseline {name!r} of the blend cannot be exported ({what}); its methods must "
                "run on torch tensors without branches on their values, or fit the blend without it"
            ) from error


class Step(nn.Module):
    """One row of one trajectory, from and to original units; the state goes in and out flat.

    Args:
        channels: their number.
    """

    answers: tuple[str, ...] = ("prediction",)
    """Names of the outputs before the next state."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.channels = channels

    def initial(self) -> dict[str, Tensor]:
        """The state before the first row, by the names of the inputs."""
        raise NotImplementedError


class StreamStep(Step):
    """`model.forward` for one row of one trajectory, from and to original units.

    Args:
        model: runs within `_traceable`.
    """

    shift: Tensor
    scale: Tensor

    def __init__(self, model: Model) -> None:
        super().__init__(model.channels)
        self.model = model
        self.parts = (*STATE, "covariance") if model.spec.trend else STATE
        self.register_buffer("shift", torch.tensor(model.scaler.shift)[None])
        self.register_buffer("scale", torch.tensor(model.scaler.scale)[None])

    def initial(self) -> dict[str, Tensor]:
        """See `Step`."""
        past = self.model.empty_state(1)
        return {name: getattr(past, name).detach().cpu().clone() for name in self.parts}

    def forward(self, t: Tensor, values: Tensor, *state: Tensor) -> tuple[Tensor, ...]:
        """Prediction and next state.

        Args:
            t: (1,) float64, s.
            values: (1, channels) float64, original units, NaN where not measured.
            *state: the parts named in `parts`, as in `RecurrentState`.
        """
        with _ExactNumbers():
            scaled = ((values - self.shift) / self.scale).to(self.model.dtype)
            mask = scaled.abs() < math.inf  # False for NaN, too
            scaled = torch.where(mask, scaled, torch.zeros_like(scaled))[:, None]
            mask, valid = mask[:, None], torch.ones_like(t[:, None], dtype=torch.bool)
            row = Batch(t[:, None], scaled, mask, mask, valid, self.model.roles)
            given: dict[str, Any] = dict(zip(self.parts, state, strict=True))
            past = RecurrentState(**given)
            output = self.model(row, past=past)
            prediction = output.mean[:, 0].double() * self.scale + self.shift
            # An output that is also an input would be missing in the graph.
            return prediction, *(getattr(output.past, name).clone() for name in self.parts)


class CorrectedStep(Step):
    """The same for a model that corrects a baseline, whose state is further parts.

    Args:
        model: its inner model runs within `_traceable`.
    """

    def __init__(self, model: CorrectedModel) -> None:
        super().__init__(model.channels)
        self.model, self.history = model, History(1)
        self.inner = StreamStep(model.inner)

    def empty(self) -> dict[str, Any]:
        """The nested state of the baseline before the first row."""
        zeros = np.zeros((1, self.channels))
        return {"base": self.model.base.start(zeros), "history": self.history.start(zeros)}

    def initial(self) -> dict[str, Tensor]:
        """See `Step`."""
        return {**self.inner.initial(), **_tensors(self.empty())}

    def forward(self, t: Tensor, values: Tensor, *state: Tensor) -> tuple[Tensor, ...]:
        """Prediction and next state, as of `StreamStep`, and then those of the baseline."""
        count = len(self.inner.parts)
        model, own = self.model, state[count:]
        mean, *after = self.inner(t, values, *state[:count])
        with _ExactNumbers():
            past = _nested(self.empty(), own)
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
            return joined * scale + shift, *after, *_next(self.empty(), then)


class BaselineStep(Step):
    """The same for a baseline alone.

    Args:
        baseline: fitted.
        channels: their number.
    """

    def __init__(self, baseline: CausalBaseline, channels: int) -> None:
        super().__init__(channels)
        self.baseline = baseline

    def empty(self) -> dict[str, Any]:
        """The nested state before the first row."""
        return {"stack": self.baseline.start(np.zeros((1, self.channels)))}

    def initial(self) -> dict[str, Tensor]:
        """See `Step`."""
        return _tensors(self.empty())

    def forward(self, t: Tensor, values: Tensor, *state: Tensor) -> tuple[Tensor, ...]:
        """Prediction and next state, as of `StreamStep`."""
        with _ExactNumbers():
            past, time, mask = _nested(self.empty(), state)["stack"], t[:, None], _finite(values)
            row = (time, torch.where(mask, values, torch.zeros_like(values)), mask)
            then = {"stack": self.baseline.observe(past, *row)}
            return self.baseline.read(past, time).clone(), *_next(self.empty(), then)


class BlendStep(Step):
    """The same for a blend, with intervals: its forward model, where it has one, and its stack.

    Args:
        blend: its forward model runs within `_traceable`.
    """

    answers = ("prediction", "half_widths")

    def __init__(self, blend: Blend) -> None:
        super().__init__(blend.channels)
        self.blend = blend
        self.stack = BaselineStep(blend.stack, blend.channels)
        self.model = None if blend.forward is None else _step_of(blend.forward)

    def initial(self) -> dict[str, Tensor]:
        """See `Step`."""
        model = {} if self.model is None else self.model.initial()
        return {**model, **self.stack.initial()}

    def forward(self, t: Tensor, values: Tensor, *state: Tensor) -> tuple[Tensor, ...]:
        """Prediction, half widths at the levels of `intervals.LEVELS`, and next state.

        Args:
            t: (1,) float64, s.
            values: (1, channels) float64, original units, NaN where not measured.
            *state: of the model and then of the stack.
        """
        blend, model, after = self.blend, None, ()
        own = state[len(state) - len(self.stack.initial()) :]
        with _ExactNumbers():
            unseen = torch.full_like(values, math.nan)
            values = torch.where(_finite(values), blend.limited(values), unseen)
        if self.model is not None:
            model, *after = self.model(t, values, *state[: len(state) - len(own)])
        base, *then = self.stack(t, values, *own)
        with _ExactNumbers():
            keys = _nested(self.stack.empty(), own)["stack"]["keys"]
            kind = blend.stack.keys.read(keys, t[:, None])
            prediction, _ = blend.corrected(base, model, kind)
            return prediction.clone(), blend.half_widths(kind), *after, *then


def _step_of(model: BaseModel) -> Step:
    """The step of a model that `exportable` accepts."""
    if isinstance(model, CorrectedModel):
        return CorrectedStep(model)
    assert isinstance(model, Model)
    return StreamStep(model)


def _finite(values: Tensor) -> Tensor:
    """Where a number is finite; NaN is not."""
    return values.abs() < math.inf


def _tensors(empty: dict[str, Any]) -> dict[str, Tensor]:
    """Nested states of arrays as tensors, flat."""
    return {name: torch.from_numpy(value.copy()) for name, value in flat_state(empty).items()}


def _nested(empty: dict[str, Any], flat: Sequence[Tensor]) -> dict[str, Any]:
    """Flat tensors as nested states like these."""
    given: dict[str, Any] = dict(zip(flat_state(empty), flat, strict=True))
    return like_state(empty, given)


def _next(empty: dict[str, Any], then: dict[str, Any]) -> list[Tensor]:
    """Nested states as flat tensors, in the order of these; no output is also an input."""
    named = dict(_named(then))
    return [named[name].double().clone() for name in flat_state(empty)]


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
            # Where one bound of a clip is a tensor, the other one must be, too.
            convert = _as_tensor if func in (torch.clip, torch.clamp) else _exact
            args = tuple(map(convert, args))
        return func(*args, **kwargs)


def _exact(value: Any) -> Any:
    if type(value) is float and math.isfinite(value) and float(np.float32(value)) != value:
        return torch.tensor(value, dtype=torch.float64)
    return value


def _as_tensor(value: Any) -> Any:
    if isinstance(value, float | int):
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


def _record(model: BaseModel | Blend, initial: dict[str, Tensor]) -> dict[str, Any]:
    """The metadata that a stream needs besides the graph."""
    info, blend = info_of(model), isinstance(model, Blend)
    further = {name: value.tolist() for name, value in initial.items() if name not in STATE}
    # JSON has no infinities: the runner sets the other initial values.
    finite = {name: initial[name] for name in ("state", "last") if name in initial}
    dtypes = {str(value.dtype).removeprefix("torch.") for value in finite.values()}
    return {
        "format": FORMAT,
        "version": VERSION if blend else WITH_BASE if further else WITHOUT_BASE,
        "model": model.name,
        "names": list(info.names),
        "units": list(info.units),
        "roles": list(info.roles),
        "median_gap_s": info.median_gap,
        "elapsed_limit_s": info.elapsed_limit,
        "transforms": info.transforms.to_dict(),
        "dtype": dtypes.pop() if dtypes else "float64",
        "initial": {name: value.tolist() for name, value in finite.items()},
        **({"base": further} if further else {}),
        **({"levels": LEVELS.tolist()} if blend else {}),
    }


def exportable(model: BaseModel) -> Model:
    """The model itself, or the one that corrects a baseline, if a graph can hold its step.

    Args:
        model: any.

    Raises:
        InputError: a graph cannot.
    """
    model = model.inner if isinstance(model, CorrectedModel) else model
    if not isinstance(model, Model):
        raise InputError(
            f"the model {model.name!r} has no recurrent state, so no step to export; stream it "
            "with offbeat.Stream"
        )
    if model.config.self_feeding:
        raise InputError(
            "a model with self_feeding draws random numbers at every row, which a graph cannot; "
            "train one without self_feeding to export it"
        )
    if model.spec.field and tableau(model.spec.solver).adaptive:
        raise InputError(
            f"the solver {model.spec.solver!r} chooses its steps by their errors, which an ONNX "
            "graph cannot; train or load the model with a solver of fixed "
            "steps (euler, midpoint, heun, rk4), or stream it with offbeat.Stream"
        )
    return model
