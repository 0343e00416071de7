"""The compiled backend of the scan: all steps, forward and backward, in one call of C++.

The compiled module has code for several instruction sets and runs the best that the processor has.
Blocks of trajectories run independently, on `torch.get_num_threads()`
threads; the result does not depend on the number of threads. A trajectory's result depends neither
on other trajectories nor on its position in the batch, and the steps of a stream equal those of a
batch bit for bit.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from functools import lru_cache
from typing import Any, cast

import torch
from torch import Tensor
from torch.autograd import Function
from torch.autograd.function import once_differentiable

from offbeat.kernels.spec import (
    QUANTITIES,
    Layers,
    ScanParts,
    ScanSpec,
    StepInputs,
    TableSteps,
)
from offbeat.ode import tableau

try:
    from offbeat.kernels import _cpu as _compiled
except ImportError as _error:  # built without a compiler
    compiled: Any = None
    why_not = str(_error)
else:
    compiled = _compiled
    why_not = ""

TAPE_LIMIT = 32 * 2**20
"""Bytes. A forward pass stores inner activations for its backward pass up to this size. Beyond it
stores only the states (`state_size` numbers per row, twice), and the backward pass recomputes the
rest, a few rows at a time (`benchmarks/scaling.py` measures the cost). Larger blocks of memory are
mapped anew at each call, which can cost more than to compute twice."""

KEPT_TAPE_LIMIT = 512 * 2**20
"""Bytes. The same in memory that stays from step to step, as in most trainings (`direct.py`). With
products in bfloat16, which take little time to compute twice, only with layers of `WIDE` units."""

WIDE = 256

TAPE_LIMIT_WITHOUT_FIELD = 8 * 2**20
"""Bytes. The same for scans without a vector field, whose activations take less time to compute
than to bring back from outside of the caches of a core."""

ROWS_AT_ONCE = 0
"""Rows whose weight gradients are added together; 0 for as many as have eight evaluations of the
vector field (`benchmarks/scaling.py` measures others). It does not change the result: the order of
each sum is fixed."""

_CELLS = {"none": 0, "start": 1, "elman": 2, "lstm": 3, "gru": 4}
_ACTIVATIONS = {"tanh": 0, "silu": 1}
_DECAY_ROWS = {"continuous": 0, "every_row": 1, "observed_rows": 2}
_TYPES = {torch.float32: "f32", torch.float64: "f64"}
_MOST_LAYERS = 16
_OF_TREND = ("level_gain", "slope_gain")


_threads: ContextVar[int | None] = ContextVar("offbeat_threads", default=None)


def threads() -> int:
    """Number of threads of the compiled code: that of torch, also inside `own_threads`."""
    own = _threads.get()
    return torch.get_num_threads() if own is None else own


@contextmanager
def own_threads() -> Iterator[None]:
    """Context manager that gives torch's threads to the compiled code, and leaves one to torch.

    Torch's idle threads spin before they sleep, on the cores that the scan
    uses, and torch's other work is too small for a second thread.
    """
    count = torch.get_num_threads()
    if compiled is None or count == 1:
        yield
        return
    token = _threads.set(count)
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(count)
        _threads.reset(token)


def instruction_sets() -> list[str]:
    """Names of the instruction sets that this processor can run, best first."""
    return list(compiled.instruction_sets()) if compiled is not None else []


def bf16_sets() -> list[str]:
    """Names of the instruction sets for products in bfloat16, best first; `auto` takes none.

    On Linux the first call asks for the tile registers of AMX, which a process may then use.
    """
    return list(compiled.bf16_sets()) if hasattr(compiled, "bf16_sets") else []


def has_trends() -> bool:
    """Whether the compiled module is there, and not of a version without trends."""
    return hasattr(compiled, "filter_gains")


def suffix(dtype: torch.dtype) -> str:
    """Suffix of a dtype in names of the compiled module."""
    return _TYPES[dtype]


def supports(spec: ScanSpec, dtype: torch.dtype, device: torch.device) -> str | None:
    """None if this backend runs scans of a spec, else the reason why not."""
    if compiled is None:
        return f"it was not built ({why_not})"
    if spec.cell not in _CELLS:
        return f"the cell {spec.cell!r} is not one of {', '.join(_CELLS)}"
    if spec.field and spec.field_kind != "mlp":
        return f"the vector field {spec.field_kind!r} is not mlp"
    if spec.field and tableau(spec.solver).adaptive:
        return f"the solver {spec.solver} chooses its own steps"
    if spec.trend and not has_trends():
        return "it was built without trends; build it again"
    if spec.field and spec.adjoint:
        return "gradients are computed by the adjoint method"
    if max(len(spec.field), len(spec.decoder)) > _MOST_LAYERS + 1:
        return f"a perceptron has more than {_MOST_LAYERS} layers"
    if device.type != "cpu" or dtype not in _TYPES:
        return f"the state is {dtype} on {device}, not float32 or float64 on the CPU"
    return None


def unsupported(
    spec: ScanSpec, parts: ScanParts, inputs: StepInputs | TableSteps, state: Tensor
) -> str | None:
    """None if the compiled backend runs a scan, else the reason why not."""
    if reason := supports(spec, state.dtype, state.device):
        return reason
    trained, given = tuple(parts.tensors()), tuple(inputs.known())
    if not trained:
        return "it has no trained parts"
    if any(t.dtype != state.dtype or t.device != state.device for t in (*trained, *given)):
        return "trained parts, inputs and state differ in type or device"
    if any(t.requires_grad for t in given):
        return "a gradient with respect to the step inputs is needed"
    return None


def scan(
    spec: ScanSpec,
    parts: ScanParts,
    inputs: StepInputs | TableSteps,
    state: Tensor,
    variant: str | None = None,
) -> tuple[Tensor, Tensor] | None:
    """Propagates a batch of states over all steps; see `offbeat.kernels.scan`.

    Args:
        spec: see there.
        parts: see there.
        inputs: see there.
        state: see there.
        variant: name of an instruction set; by default the best one.

    Raises:
        RuntimeError: this backend cannot run this scan.
        InputError: shapes disagree, or a size is over a limit of the compiled module.
    """
    if reason := unsupported(spec, parts, inputs, state):
        raise RuntimeError(f"the cpu backend cannot run this scan: {reason}")
    result = _Scan.apply(  # type: ignore[no-untyped-call]
        spec,
        inputs,
        variant or instruction_sets()[0],
        torch.is_grad_enabled(),
        parts.packed(),
        state,
    )
    return cast("tuple[Tensor, Tensor]", result)


@lru_cache(maxsize=64)
def compiled_spec(spec: ScanSpec) -> Any:
    """The compiled module's form of a spec."""
    arguments = spec_arguments(spec)
    if not spec.trend:  # a module of 0.2 does not know it
        del arguments["trend"]
    return compiled.Spec(**arguments)


def spec_arguments(spec: ScanSpec) -> dict[str, Any]:
    """The arguments of the compiled module's form of a spec: numbers and lists of them."""
    scheme = tableau(spec.solver)
    return {
        "channels": spec.channels,
        "hidden": spec.hidden_size,
        "anchored": spec.channels if spec.anchored else 0,
        "time_inputs": spec.time_inputs,
        "cell": _CELLS[spec.cell],
        "reset_after": spec.reset_after,
        "field": list(spec.field),
        "activation": _ACTIVATIONS[spec.activation],
        "a": [list(row) for row in scheme.a],
        "b": list(scheme.b),
        "steps": spec.steps_per_gap,
        "max_step": spec.max_step or 0.0,
        "nodes": spec.nodes,
        "decay_span": spec.decay_span,
        "bounded": spec.bounded,
        "decay_features": spec.decay,
        "decay_rows": _DECAY_ROWS[spec.decay_rows],
        "input_decay": spec.input_decay,
        "decoder": list(spec.decoder),
        "trend": spec.trend,
    }


def _array(tensor: Tensor | None) -> Any:
    """A view that the compiled module takes without a copy; its last axis is contiguous."""
    if tensor is None:
        return None
    if tensor.ndim and tensor.shape[-1] > 1 and tensor.stride(-1) != 1:
        tensor = tensor.contiguous()
    return tensor.detach().numpy()


def compiled_inputs(rows: StepInputs | TableSteps, dtype: torch.dtype) -> Any:
    """The compiled module's form of step inputs.

    Args:
        rows: of a batch; they must live as long as the result.
        dtype: of their numbers.
    """
    made = getattr(compiled, f"StepInputs_{_TYPES[dtype]}")
    fed = torch.frombuffer(bytearray(rows.fed), dtype=torch.uint8).numpy() if rows.fed else None
    if isinstance(rows, TableSteps):
        table = rows.table
        columns = table.columns
        if not columns[-1][1]:
            columns = columns[: -len(_OF_TREND)]
        return made(
            _array(table.table),
            _array(rows.index),
            columns,
            rows.rows,
            _array(table.mean),
            fed,
            _array(rows.length),
            _array(table.low),
            _array(table.high),
        )
    names = (*QUANTITIES, "mean", "length", "low", "high")
    given = {name: _array(getattr(rows, name)) for name in names}
    given = {n: v for n, v in given.items() if v is not None or n not in _OF_TREND}
    return made(**given, use_prediction=fed)


def tape_size(
    spec: ScanSpec, variant: str, inputs: Any, state: Tensor, *, stays: bool = False
) -> int | None:
    """Numbers that a forward pass stores for its backward pass; None for the states alone.

    Args:
        spec: of the scan.
        variant: name of an instruction set.
        inputs: from `compiled_inputs`.
        state: (batch, state_size) before the first step, contiguous.
        stays: their memory stays from step to step.
    """
    size: int = compiled.tape_size(compiled_spec(spec), variant, inputs, _array(state))
    limit = TAPE_LIMIT if spec.field else min(TAPE_LIMIT, TAPE_LIMIT_WITHOUT_FIELD)
    if stays and spec.field and (not variant.endswith("bf16") or max(spec.field) >= WIDE):
        limit = max(limit, KEPT_TAPE_LIMIT)
    return size if size * state.element_size() <= limit else None


class _Scan(Function):
    @staticmethod
    def forward(
        ctx: Any,
        spec: ScanSpec,
        rows: StepInputs | TableSteps,
        variant: str,
        keep: bool,
        packed: Tensor,
        state: Tensor,
    ) -> tuple[Tensor, Tensor]:
        own = compiled_spec(spec)
        inputs = compiled_inputs(rows, state.dtype)
        state = state.contiguous()
        first = _array(state)
        before = state.new_empty((len(rows), rows.rows, spec.state_size))
        after = torch.empty_like(before)
        tape = None
        if keep:
            size = tape_size(spec, variant, inputs, state)
            tape = None if size is None else state.new_empty(size)
        ctx.threads = threads()
        compiled.scan_forward(
            own, variant, _array(packed), inputs, first, _array(before), _array(after),
            _array(tape), ctx.threads,
        )  # fmt: skip
        ctx.own, ctx.inputs, ctx.variant, ctx.rows = own, inputs, variant, rows
        # Outputs must be saved in this way: as attributes they would never be freed.
        ctx.save_for_backward(packed, state, after, tape)
        ctx.set_materialize_grads(False)
        return before, after

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, to_before: Tensor | None, to_after: Tensor | None) -> tuple[Any, ...]:
        packed, state, after, tape = ctx.saved_tensors
        to_packed, to_state = torch.empty_like(packed), torch.empty_like(state)
        compiled.scan_backward(
            ctx.own,
            ctx.variant,
            _array(packed),
            ctx.inputs,
            _array(state),
            _array(after),
            _array(tape),
            _array(to_before),
            _array(to_after),
            _array(to_packed),
            _array(to_state),
            ctx.threads,
            ROWS_AT_ONCE,
        )
        return None, None, None, None, to_packed, to_state


# --- a perceptron over many rows ------------------------------------------------------------------


def perceptron(layers: Layers, x: Tensor, activation: str, variant: str | None = None) -> Tensor:
    """Applies a perceptron to (..., inputs); a row's result depends only on that row, bit for bit.

    Args:
        layers: weights and biases.
        x: (..., inputs) float32 or float64 on the CPU.
        activation: `tanh` or `silu`, between the layers.
        variant: name of an instruction set; by default the best one.
    """
    sizes = (layers[0][0].shape[1], *(weight.shape[0] for weight, _ in layers))
    packed = torch.cat([tensor.reshape(-1) for layer in layers for tensor in layer])
    flat = x.reshape(-1, sizes[0])
    result = _Perceptron.apply(  # type: ignore[no-untyped-call]
        sizes, activation, variant or instruction_sets()[0], torch.is_grad_enabled(), packed, flat
    )
    return cast(Tensor, result).reshape(*x.shape[:-1], sizes[-1])


def supports_perceptron(layers: Layers, x: Tensor) -> bool:
    """True where `perceptron` can run."""
    return (
        compiled is not None
        and x.device.type == "cpu"
        and x.dtype in _TYPES
        and x.numel() > 0
        and len(layers) <= _MOST_LAYERS
        and all(t.dtype == x.dtype and t.device == x.device for layer in layers for t in layer)
    )


@lru_cache(maxsize=64)
def compiled_perceptron(sizes: tuple[int, ...], activation: str) -> Any:
    """The compiled module's form of a perceptron."""
    return compiled.Perceptron(list(sizes), _ACTIVATIONS[activation])


def perceptron_tape_size(shape: Any, variant: str, x: Tensor) -> int:
    """Numbers that a forward pass of a perceptron stores for its backward pass.

    Args:
        shape: from `compiled_perceptron`.
        variant: name of an instruction set.
        x: (rows, inputs).
    """
    size: int = getattr(compiled, f"perceptron_tape_{_TYPES[x.dtype]}")(shape, variant, len(x))
    return size


class _Perceptron(Function):
    @staticmethod
    def forward(
        ctx: Any,
        sizes: tuple[int, ...],
        activation: str,
        variant: str,
        keep: bool,
        packed: Tensor,
        x: Tensor,
    ) -> Tensor:
        shape = compiled_perceptron(sizes, activation)
        y = x.new_empty((len(x), sizes[-1]))
        tape = None
        if keep:
            tape = x.new_empty(perceptron_tape_size(shape, variant, x))
        ctx.threads = threads()
        compiled.perceptron_forward(
            shape, variant, _array(packed), _array(x), _array(y), _array(tape), ctx.threads
        )
        ctx.shape, ctx.variant = shape, variant
        ctx.save_for_backward(packed, x, tape)
        return y

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, to_y: Tensor) -> tuple[Any, ...]:
        packed, x, tape = ctx.saved_tensors
        to_packed = torch.empty_like(packed)
        to_x = x.new_empty(x.shape) if ctx.needs_input_grad[-1] else None
        compiled.perceptron_backward(
            ctx.shape,
            ctx.variant,
            _array(packed),
            _array(x),
            _array(tape),
            _array(to_y.contiguous()),
            _array(to_packed),
            _array(to_x),
            ctx.threads,
        )
        return None, None, None, None, to_packed, to_x
