"""Devices: which one a model is computed on, by name or by what it gains there."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from typing import Any

import torch
from torch import nn

from offbeat.errors import InputError
from offbeat.kernels.backends import REFERENCE, choose
from offbeat.models.base import BaseModel
from offbeat.models.corrected import CorrectedModel
from offbeat.models.model import Model
from offbeat.ode import tableau

AUTO = "auto"
"""The name of the device that is chosen by `preferred`."""

CPU_RATE = 50e9
"""Floating-point operations per second of one core, about, in the compiled backend."""

GPU_RATE = 10e12
"""Floating-point operations per second of a GPU in products of this kind, about, in float32."""

LAUNCH_S = 2.5e-6
"""s, time of a small kernel within a CUDA graph, about."""

LAYER_S = 1e-6
"""s, time of a layer of a block of trajectories in the triton backend, about."""

LAUNCHES_PER_STEP = 12
"""Kernels of the reference backend per evaluation of the vector field, and per update, about."""


def device_of(name: str | torch.device) -> torch.device:
    """The device of a name, which is there.

    Args:
        name: `cpu`, `cuda`, `cuda:1`; `auto` is decided by `resolved`.

    Raises:
        InputError: there is no such device here, or it has no float64, which times need.
    """
    try:
        device = torch.device(name)
    except (RuntimeError, TypeError):
        raise InputError(f"there is no device {name!r}; give auto, cpu, cuda or cuda:1") from None
    if device.type == "mps":
        raise InputError("the device 'mps' has no float64, which times need; give cpu")
    if device.type == "cuda":
        if not torch.cuda.is_available():
            raise InputError(
                f"there is no device {str(name)!r} here: torch finds no CUDA; give cpu or auto"
            )
        count = torch.cuda.device_count()
        if device.index is not None and device.index >= count:
            here = "cuda:0" if count == 1 else f"cuda:0 to cuda:{count - 1}"
            raise InputError(f"there is no device {str(name)!r} here: there is {here}")
    return device


def resolved(
    name: str | torch.device, model: nn.Module | None = None, *, batch: int = 1
) -> torch.device:
    """The device of a name; of `auto`, the preferred one.

    Args:
        name: as of `device_of`, or `auto`.
        model: that is to be computed on it.
        batch: trajectories that are computed at a time.

    Raises:
        InputError: as `device_of`.
    """
    if name == AUTO:
        return preferred(model, batch=batch)[0]
    return device_of(name)


def preferred(model: nn.Module | None = None, *, batch: int = 1) -> tuple[torch.device, str]:
    """The device on which a step of a model takes the least time by estimate, and the reason.

    The work of a row is the number of multiplications and additions of its products, forward and
    backward, for the whole batch. The CPU does it at `CPU_RATE` per core; a GPU at `GPU_RATE`,
    and needs `LAUNCH_S` for each of the small kernels that one row takes after the other, or in
    the triton backend `LAYER_S` for each layer. So a GPU gains from large batches and wide models.
    The rates are rough figures, which nobody has measured for this purpose: where it matters, time
    both.

    Args:
        model: that is to be computed; a registered module takes a GPU wherever there is one.
        batch: trajectories that are computed at a time.
    """
    cpu = torch.device("cpu")
    if not torch.cuda.is_available():
        return cpu, "torch finds no CUDA device"
    gpu = torch.device("cuda", torch.cuda.current_device())
    inner = model.inner if isinstance(model, CorrectedModel) else model
    if inner is None:
        return gpu, f"{torch.cuda.get_device_name(gpu)}; for batches that gain from it"
    if not isinstance(inner, Model):
        return gpu, f"{torch.cuda.get_device_name(gpu)}; a registered module runs in torch"
    on_cpu, on_gpu = row_seconds(inner, batch, cpu), row_seconds(inner, batch, gpu)
    why = (
        f"a row of {batch} trajectories takes about {1e6 * on_cpu:.0f} us on the CPU and "
        f"{1e6 * on_gpu:.0f} us on {torch.cuda.get_device_name(gpu)}"
    )
    return (gpu if on_gpu < on_cpu else cpu), why


def row_seconds(model: Model, batch: int, device: torch.device) -> float:
    """s, estimate of the time of one row of a training step; see `preferred`.

    Args:
        model: of parts.
        batch: trajectories.
        device: CPU or GPU.
    """
    spec = model.spec
    scheme = tableau(spec.solver)
    evaluations = len(scheme.b) * spec.steps_per_gap if spec.field else 0
    fields = sum(p.numel() for p in model.field.parameters()) if model.field is not None else 0
    others = sum(p.numel() for p in model.parameters()) - fields
    work = 6.0 * batch * (fields * evaluations + others)
    if device.type == "cpu":
        cores = torch.get_num_threads()
        return work / (CPU_RATE * max(1, cores))
    compiled = choose(spec, model.dtype, device).backend.name != REFERENCE
    if compiled:  # all rows are one launch, in which layer waits for layer
        layers = max(len(spec.field) - 1, 0) * evaluations + 3
        return 3 * layers * LAYER_S + work / GPU_RATE
    launches = 3 * LAUNCHES_PER_STEP * (evaluations + 1)
    return launches * LAUNCH_S + work / GPU_RATE


@contextmanager
def placed(
    predictor: Any, device: str | torch.device | None, *, batch: int = 500
) -> Iterator[None]:
    """Context manager in which the models of a predictor lie on a device; then they move back.

    Args:
        predictor: a model or a blend.
        device: as of `resolved`; None leaves them where they are.
        batch: trajectories that are computed at a time.

    Raises:
        InputError: as `device_of`.
    """
    with ExitStack() as stack:
        for model in models_of(predictor) if device is not None else ():
            there = resolved(device, model, batch=batch)  # type: ignore[arg-type]
            before = model.device
            if there != before:
                stack.callback(model.to, before)
                model.to(there)
        yield


def moved(predictor: Any, device: str | torch.device, *, batch: int = 500) -> Any:
    """The predictor, with its models on a device.

    Args:
        predictor: a model or a blend.
        device: as of `resolved`.
        batch: trajectories that are computed at a time.

    Raises:
        InputError: as `device_of`.
    """
    for model in models_of(predictor):
        model.to(resolved(device, model, batch=batch))
    return predictor


def models_of(predictor: Any) -> list[BaseModel]:
    """The models of a predictor: itself, or those of a blend."""
    if isinstance(predictor, BaseModel):
        return [predictor]
    return [m for m in (predictor.forward, predictor.backward) if isinstance(m, BaseModel)]


def examined() -> str:
    """The device that `auto` takes here and why, for `offbeat doctor`."""
    device, why = preferred()
    if os.environ.get("CUDA_VISIBLE_DEVICES") == "":
        why += " (CUDA_VISIBLE_DEVICES is empty)"
    return f"{device} ({why})"
