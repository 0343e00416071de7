"""Backends of the scan: a registry, and the choice among them.

A backend is a module that registers its supported specs and its scan. `OFFBEAT_SCAN` in the
environment, or `use`, selects one: `auto`, the name of a backend, or one of its variants.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from contextvars import ContextVar
from dataclasses import dataclass

import torch
from torch import Tensor

from offbeat.errors import InputError, one_of
from offbeat.kernels.spec import Layers, ScanParts, ScanSpec, StepInputs, TableSteps
from offbeat.registry import Registry

States = tuple[Tensor, Tensor]


@dataclass(frozen=True)
class Backend:
    """A way to run scans.

    Attributes:
        name: value of `OFFBEAT_SCAN` that selects it.
        supports: (spec, dtype, device) to None, or to the reason why it does not support them.
        scan: (spec, parts, inputs, state, variant) to the states before and after each step, or to
            None if this call cannot run although its spec is supported.
        variants: names of its variants, such as instruction sets, for `OFFBEAT_SCAN`.
        available: variants that run here, best first; empty if the backend was not
            built. A backend without variants returns its own name.
        named_only: variants that run here and that only their name selects.
        why_not: the reason if none is available.
        fix: what makes it available.
        perceptron: (layers, x, activation, variant) to the outputs, or to None if the call
            cannot run; None for a backend without one.
        training: a context manager for training with this backend.
        devices: types of the devices on which `auto` tries it.
        capturable: on a GPU, a whole training step with it can be recorded in a CUDA graph: nothing
            in it waits for the GPU.
    """

    name: str
    supports: Callable[[ScanSpec, torch.dtype, torch.device], str | None]
    scan: Callable[
        [ScanSpec, ScanParts, StepInputs | TableSteps, Tensor, str | None], States | None
    ]
    variants: tuple[str, ...] = ()
    available: Callable[[], Sequence[str]] | None = None
    named_only: Callable[[], Sequence[str]] = tuple
    why_not: Callable[[], str] = str
    fix: str = "install Offbeat where a C++ compiler is available"
    perceptron: Callable[[Layers, Tensor, str, str | None], Tensor | None] | None = None
    training: Callable[[], AbstractContextManager[None]] = nullcontext
    devices: tuple[str, ...] = ("cpu", "cuda")
    capturable: bool = True

    def runnable(self) -> Sequence[str]:
        """The variants that run here, best first."""
        return (self.name,) if self.available is None else self.available()


BACKENDS: Registry[Backend] = Registry("scan backend", group="offbeat.backends")
"""Backends by name; `auto` selects the first that supports a scan, `reference` last."""

REFERENCE = "reference"
ALIASES = {"fused": "cpu"}
"""Names of 0.1.0."""


def register_backend(backend: Backend, *, replace: bool = False) -> Backend:
    """Registers a backend of the scan; returns it.

    Args:
        backend: the backend; `auto` tries it before those registered earlier.
        replace: allow a name that is taken.

    Raises:
        InputError: the name is taken.
    """
    return BACKENDS.register(backend.name, backend, replace=replace)


@dataclass(frozen=True)
class Choice:
    """A backend for a spec.

    Attributes:
        backend: the backend.
        variant: of the backend.
        reason: of the choice.
    """

    backend: Backend
    variant: str
    reason: str


_chosen: ContextVar[str | None] = ContextVar("offbeat_scan", default=None)


def choose(
    spec: ScanSpec | None = None,
    dtype: torch.dtype = torch.float32,
    device: torch.device | None = None,
) -> Choice:
    """Chooses the backend for scans of a spec.

    Args:
        spec: of the scan; by default any that all backends support.
        dtype: of the state.
        device: of the state; by default the CPU.

    Raises:
        InputError: the selected backend cannot run here.
    """
    device = device or torch.device("cpu")
    name, where = selected()
    named = {variant: each for each in BACKENDS.values() for variant in each.variants}
    one_of("scan backend", name, ("auto", *BACKENDS, *named, *ALIASES))
    reference = BACKENDS[REFERENCE]
    if name == REFERENCE:
        return Choice(reference, REFERENCE, f"selected by {where}")
    reasons = []
    if name == "auto":
        for backend in reversed(list(BACKENDS.values())):
            if backend is reference or device.type not in backend.devices:
                continue
            reason = _why_not(backend, spec, dtype, device)
            if reason is None:
                return Choice(backend, backend.runnable()[0], "the best that runs here")
            reasons.append(f"{backend.name}: {reason}")
        return Choice(reference, REFERENCE, "; ".join(reasons) or "the only one")
    backend = named.get(name) or BACKENDS[name]
    runnable = backend.runnable()
    if not runnable:
        raise InputError(
            f"{where} asks for the scan backend {name!r}, but the backend {backend.name} was not "
            f"built ({backend.why_not()}); {backend.fix}"
        )
    variant = name if name in named else runnable[0]
    if variant not in runnable and variant not in (more := backend.named_only()):
        raise InputError(
            f"{where} asks for the scan backend {name!r}; this processor runs "
            f"{', '.join((*runnable, *more))}"
        )
    reason = _why_not(backend, spec, dtype, device)
    if reason is not None:
        return Choice(reference, REFERENCE, f"{backend.name}: {reason}")
    return Choice(backend, variant, f"selected by {where}")


def selected() -> tuple[str, str]:
    """The name of the backend or variant that is asked for, or `auto`, and what asks for it."""
    name, where = _chosen.get(), "offbeat.kernels.use"
    if name is None:
        name, where = os.environ.get("OFFBEAT_SCAN", "auto"), "OFFBEAT_SCAN"
    return ALIASES.get(name, name), where


def _why_not(
    backend: Backend, spec: ScanSpec | None, dtype: torch.dtype, device: torch.device
) -> str | None:
    if not backend.runnable():
        return f"it was not built ({backend.why_not()})"
    return None if spec is None else backend.supports(spec, dtype, device)


@contextmanager
def use(name: str) -> Iterator[str]:
    """Context manager that runs scans in the named backend; yields the variant.

    Args:
        name: `auto`, a backend, or one of its variants.

    Raises:
        InputError: it cannot run here.
    """
    token = _chosen.set(name)
    try:
        yield choose().variant
    finally:
        _chosen.reset(token)
