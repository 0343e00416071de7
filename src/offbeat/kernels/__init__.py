"""The scan over time steps: one signature, and the backends that run it.

The reference backend (PyTorch) defines what a scan does and runs any part on any device. The cpu
backend (C++) and the triton backend (CUDA) run the named parts faster.
`offbeat.kernels.backends` chooses between them.
"""

from __future__ import annotations

from torch import Tensor

from offbeat.kernels import cpu, reference
from offbeat.kernels.backends import (
    BACKENDS,
    REFERENCE,
    Backend,
    Choice,
    choose,
    register_backend,
    use,
)
from offbeat.kernels.spec import (
    LARGEST_EXPONENT,
    Layers,
    ScanParts,
    ScanSpec,
    StepInputs,
    StepTable,
    TableSteps,
)
from offbeat.kernels.triton import backend as triton_backend

__all__ = [
    "BACKENDS",
    "LARGEST_EXPONENT",
    "Backend",
    "Choice",
    "Layers",
    "ScanParts",
    "ScanSpec",
    "StepInputs",
    "StepTable",
    "TableSteps",
    "backend",
    "choose",
    "perceptron",
    "register_backend",
    "scan",
    "use",
]


def backend() -> tuple[str, str]:
    """Returns the variant of the backend that scans run in, and the reason.

    Raises:
        InputError: the selected backend cannot run here.
    """
    choice = choose()
    return choice.variant, choice.reason


def scan(
    spec: ScanSpec, parts: ScanParts, inputs: StepInputs | TableSteps, state: Tensor
) -> tuple[Tensor, Tensor]:
    """Propagates a batch of states over all steps, in the best backend that supports the spec.

    Args:
        spec: the shape of the scan.
        parts: the trained parts.
        inputs: the inputs of each step.
        state: (batch, state_size) before the first step.

    Returns:
        Two tensors (batch, rows, state_size): the state before the observation of each step,
        and the state after the step.
    """
    choice = choose(spec, state.dtype, state.device)
    found = choice.backend.scan(spec, parts, inputs, state, choice.variant)
    if found is None:
        return reference.scan(spec, parts, inputs.gathered(), state)
    return found


def perceptron(layers: Layers, x: Tensor, activation: str) -> Tensor:
    """Applies linear layers with a nonlinearity between them, none after the last.

    Args:
        layers: weights and biases.
        x: (..., inputs).
        activation: `tanh` or `silu`.
    """
    choice = choose()
    if choice.backend.perceptron is not None:
        found = choice.backend.perceptron(layers, x, activation, choice.variant)
        if found is not None:
            return found
    return reference.perceptron(layers, x, activation)


def _reference_scan(
    spec: ScanSpec,
    parts: ScanParts,
    inputs: StepInputs | TableSteps,
    state: Tensor,
    variant: str | None,
) -> tuple[Tensor, Tensor]:
    return reference.scan(spec, parts, inputs.gathered(), state)


def _cpu_scan(
    spec: ScanSpec,
    parts: ScanParts,
    inputs: StepInputs | TableSteps,
    state: Tensor,
    variant: str | None,
) -> tuple[Tensor, Tensor] | None:
    if cpu.unsupported(spec, parts, inputs, state):
        return None
    return cpu.scan(spec, parts, inputs, state, variant)


def _cpu_perceptron(
    layers: Layers, x: Tensor, activation: str, variant: str | None
) -> Tensor | None:
    if not cpu.supports_perceptron(layers, x):
        return None
    return cpu.perceptron(layers, x, activation, variant)


def _triton_scan(
    spec: ScanSpec,
    parts: ScanParts,
    inputs: StepInputs | TableSteps,
    state: Tensor,
    variant: str | None,
) -> tuple[Tensor, Tensor] | None:
    if triton_backend.refused(spec, parts, inputs, state):
        return None
    return triton_backend.scan(spec, parts, inputs, state)


register_backend(Backend(REFERENCE, lambda spec, dtype, device: None, _reference_scan))
register_backend(
    Backend(
        "triton",
        triton_backend.supports,
        _triton_scan,
        available=lambda: () if triton_backend.why_not() else ("triton",),
        why_not=lambda: triton_backend.why_not(),
        fix="install triton where a GPU is, or set TRITON_INTERPRET=1",
        devices=("cuda",),  # interpreted, it must be named
    )
)
register_backend(
    Backend(
        "cpu",
        cpu.supports,
        _cpu_scan,
        variants=("baseline", "avx2", "avx512", "avx512_bf16", "amx_bf16"),
        available=lambda: cpu.instruction_sets(),
        named_only=lambda: cpu.bf16_sets(),
        why_not=lambda: cpu.why_not,
        perceptron=_cpu_perceptron,
        training=cpu.own_threads,
    )
)
