"""The scan over rows: one signature, and the two bodies that run it.

The reference backend (PyTorch) defines what a scan does and runs everywhere; the compiled backend (C++) does
the same, faster, on the CPU. `OFFBEAT_SCAN` in the environment, or `use`, names the one to take:
`auto`, `reference`, `fused`, or a compiled backend such as `avx2`.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar

from torch import Tensor

from offbeat.errors import InputError, one_of
from offbeat.kernels import cpu, reference
from offbeat.kernels.spec import (
    LARGEST_EXPONENT,
    Layers,
    ScanSpec,
    ScanWeights,
    StepInputs,
    StepTable,
    TableSteps,
)

__all__ = [
    "LARGEST_EXPONENT",
    "Layers",
    "ScanSpec",
    "ScanWeights",
    "StepInputs",
    "StepTable",
    "TableSteps",
    "backend",
    "perceptron",
    "scan",
    "use",
]

_chosen: ContextVar[str | None] = ContextVar("offbeat_scan", default=None)


def backend() -> tuple[str, str]:
    """The body that scans run in here, and why.

    Returns:
        `reference`, or the name of a compiled backend such as `avx2`; and the reason in words.

    Raises:
        InputError: a body is asked for that can't run here.
    """
    chosen, where = _chosen.get(), "offbeat.kernels.use"
    if chosen is None:
        chosen, where = os.environ.get("OFFBEAT_SCAN", "auto"), "OFFBEAT_SCAN"
    compiled = cpu.instruction_sets()
    one_of("scan backend", chosen, ("auto", "reference", "fused", "baseline", "avx2", "avx512"))
    if chosen == "reference":
        return "reference", f"asked for by {where}"
    if chosen == "auto":
        if not compiled:
            return "reference", f"the compiled backend was not built: {cpu.why_not}"
        return compiled[0], "the best that this processor runs"
    if not compiled:
        raise InputError(
            f"{where} asks for the scan backend {chosen!r}, but the compiled backend was not built "
            f"({cpu.why_not}); install Offbeat where a C++ compiler is"
        )
    if chosen == "fused":
        return compiled[0], f"asked for by {where}"
    if chosen not in compiled:
        raise InputError(
            f"{where} asks for the scan backend {chosen!r}; this processor runs {', '.join(compiled)}"
        )
    return chosen, f"asked for by {where}"


@contextmanager
def use(name: str) -> Iterator[str]:
    """Runs scans in the named body within a `with` block; yields what `backend` then says.

    Args:
        name: `auto`, `reference`, `fused`, or a compiled backend.
    """
    token = _chosen.set(name)
    try:
        yield backend()[0]
    finally:
        _chosen.reset(token)


def scan(
    spec: ScanSpec, weights: ScanWeights, rows: StepInputs | TableSteps, state: Tensor
) -> tuple[Tensor, Tensor]:
    """Carries a batch of states over all rows, in the compiled backend where it can run the spec.

    Args:
        spec: the shape of the scan.
        weights: all that is trained in it.
        rows: what is known of each row.
        state: (batch, state_size) before the first row.

    Returns:
        Two tensors (batch, rows, state_size): the state carried to each row, before anything is
        observed there, and the state after the row.
    """
    name = backend()[0]
    if name == "reference" or cpu.unsupported(spec, weights, rows, state):
        return reference.scan(spec, weights, rows.gathered(), state)
    return cpu.scan(spec, weights, rows, state, name)


def perceptron(layers: Layers, x: Tensor, activation: str) -> Tensor:
    """Applies linear layers with a nonlinearity between them, none after the last.

    Args:
        layers: weights and biases.
        x: (..., inputs).
        activation: `tanh` or `silu`.
    """
    name = backend()[0]
    if name == "reference" or not cpu.supports_perceptron(layers, x):
        return reference.perceptron(layers, x, activation)
    return cpu.perceptron(layers, x, activation, name)
