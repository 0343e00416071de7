"""Training steps on a GPU: a whole step in one CUDA graph; and precisions of products.

A step of the reference backend is thousands of small kernels, each of which the CPU has to launch.
A CUDA graph records them once, forward pass, backward pass and optimizer, and starts them together.
Nothing in it may wait for the GPU or change its shape, so batches are not trimmed to their longest
trajectory: the rows after the end of one are padding, as in any batch.

No machine with a GPU has run this module. Its logic is tested on the CPU with a recorder in place
of the graph; `OFFBEAT_CUDA_GRAPH=0` takes steps without graphs.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from typing import Any

import torch
from torch import Tensor

from offbeat.config import Recipe
from offbeat.distributed import current
from offbeat.errors import InputError
from offbeat.examples import Examples
from offbeat.kernels import StepTable, choose, cpu, use
from offbeat.kernels.backends import REFERENCE, selected
from offbeat.models.base import BaseModel
from offbeat.models.model import Model
from offbeat.ode import tableau
from offbeat.run import RunState

WARM_UP = 3
"""Steps before a graph is recorded, in which libraries allocate what they need; they are undone."""

FEWEST_STEPS = 20
"""Steps on the same examples from which on a graph is worth the recording."""

VARIABLE = "OFFBEAT_CUDA_GRAPH"
"""Environment variable; `0` turns graphs off."""

Step = Callable[[Tensor], Tensor]
"""(batch,) positions of trajectories on the device, to the loss there."""


def recorded(body: Callable[[], None]) -> Callable[[], None]:
    """Records what a function launches on the current GPU; the result launches it again.

    Args:
        body: reads and writes tensors that stay where they are.
    """
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        body()
    return graph.replay


def unsupported(model: BaseModel, examples: object, recipe: Recipe, steps: int) -> str | None:
    """The reason why a step cannot be one graph; None if it can.

    Args:
        model: that is trained.
        examples: of the epoch.
        recipe: of the training.
        steps: on these examples.
    """
    if os.environ.get(VARIABLE) == "0":
        return f"{VARIABLE}=0"
    if current() is not None:
        return "several ranks exchange their gradients within a step"
    if model.device.type != "cuda":
        return f"the model is on {model.device}, not on a CUDA device"
    if not isinstance(model, Model) or not isinstance(examples, Examples):
        return "only models of parts on fixed examples have steps of a fixed shape"
    if not isinstance(examples.prepared, StepTable):
        return "its step inputs are not in a table"
    if model.needs_generator:
        return "self-feeding draws the shape of each step"
    if model.spec.field and tableau(model.spec.solver).adaptive:
        return "an adaptive solver takes as many steps as a batch needs"
    if not choose(model.spec, model.dtype, model.device).backend.capturable:
        return "its scan backend cannot be captured"
    if steps < FEWEST_STEPS:
        return f"{steps} steps on the same examples are too few to record one"
    return None


class CapturedStep:
    """Training steps on batches of one size, each one launch.

    Args:
        examples: of the epoch.
        state: parameters and optimizer.
        recipe: of the training.
        step: the step without a graph: forward, backward, clipping and optimizer.
        batch: trajectories of a step.
        record: records a function; `recorded` on a GPU.
    """

    def __init__(
        self,
        examples: Examples,
        state: RunState,
        recipe: Recipe,
        step: Step,
        *,
        batch: int,
        record: Callable[[Callable[[], None]], Callable[[], None]] = recorded,
    ) -> None:
        device = state.parameters.flat.device
        self.examples, self.batch = examples, batch
        self._index = torch.zeros(batch, dtype=torch.int64, device=device)
        self._loss = torch.zeros((), device=device, dtype=state.parameters.flat.dtype)

        def once() -> None:
            self._loss.copy_(step(self._index).detach())

        with _undone(state), _side_stream(device):
            for _ in range(WARM_UP):
                once()
        with _undone(state):  # recording does not run anything on a GPU; a stand-in does
            self._replay = record(once)

    def __call__(self, index: Tensor) -> Tensor:
        """Takes a step; returns the loss before it, on the device."""
        self._index.copy_(index)
        self._replay()
        return self._loss.clone()


@contextmanager
def _side_stream(device: torch.device) -> Iterator[None]:
    """The stream that warms up must be another one than that which records."""
    if device.type != "cuda":
        yield
        return
    stream = torch.cuda.Stream(device)  # type: ignore[no-untyped-call]
    stream.wait_stream(torch.cuda.current_stream(device))
    with torch.cuda.stream(stream):
        yield
    torch.cuda.current_stream(device).wait_stream(stream)


@contextmanager
def _undone(state: RunState) -> Iterator[None]:
    """Restores parameters and the state of the optimizer, in place."""
    flat = state.parameters.flat
    weights, moments = flat.detach().clone(), state.optimizer.state.get(flat, {})
    kept = {name: value.clone() for name, value in moments.items()}
    yield
    with torch.no_grad():
        flat.copy_(weights)
        for name, value in state.optimizer.state.get(flat, {}).items():
            value.copy_(kept[name]) if name in kept else value.zero_()


def captured(
    model: BaseModel,
    examples: object,
    state: RunState,
    recipe: Recipe,
    step: Step,
    *,
    steps: int,
) -> CapturedStep | None:
    """A training step in one graph, or None where that is not possible.

    Args:
        model: that is trained.
        examples: of the epoch.
        state: parameters and optimizer.
        recipe: of the training.
        step: the step without a graph, with whole rows.
        steps: on these examples.
    """
    reason = unsupported(model, examples, recipe, steps)
    if reason is None:
        assert isinstance(examples, Examples)
        batch = min(recipe.batch_size, len(examples))
        try:
            return CapturedStep(examples, state, recipe, step, batch=batch)
        except RuntimeError as error:
            reason = " ".join(str(error).split())[:200]
            logging.getLogger("offbeat").warning("no CUDA graph, steps are slower: %s", reason)
    return None


def autocast(model: BaseModel, name: str) -> AbstractContextManager[Any]:
    """Context manager of the forward pass in a precision; see `TrainConfig.precision`.

    Args:
        model: that is trained.
        name: one of `PRECISIONS`.

    Raises:
        InputError: the model cannot be trained in it, see `check_precision`.
    """
    if name != "bf16":
        return nullcontext()
    if _compiled(model):
        return use(_bf16_set())
    # Without the cache of casts, which a graph would not fill again.
    return torch.autocast(model.device.type, dtype=torch.bfloat16, cache_enabled=False)


@contextmanager
def products(model: BaseModel, name: str) -> Iterator[None]:
    """Context manager of training steps: TF32 is on where it is the precision, and off elsewhere.

    On the CPU, `bf16` selects the instruction set of the compiled backend.

    Args:
        model: that is trained.
        name: one of `PRECISIONS`.
    """
    if model.device.type != "cuda":
        with use(_bf16_set()) if name == "bf16" and _compiled(model) else nullcontext():
            yield
        return
    before = torch.get_float32_matmul_precision()
    torch.set_float32_matmul_precision("high" if name == "tf32" else "highest")
    try:
        yield
    finally:
        torch.set_float32_matmul_precision(before)


def check_precision(model: BaseModel, name: str) -> None:
    """Checks that a model can be trained in a precision.

    Args:
        model: on its device.
        name: one of `PRECISIONS`.

    Raises:
        InputError: the compiled backend of the CPU would run it, and has no products in this
            precision for this processor, the selected instruction set or the model's numbers.
    """
    if name == "float32" or not _compiled(model):
        return
    if name != "bf16":
        raise InputError(
            f"precision {name!r} is one of GPUs: on the CPU the backend {model.backend()[0]} "
            "computes in float32 or bf16; leave precision out, or give device cuda"
        )
    if model.dtype != torch.float32:
        raise InputError(
            f"precision 'bf16' is for models in float32, but this one is in {model.dtype}; leave "
            "precision out"
        )
    _bf16_set()


def _compiled(model: BaseModel) -> bool:
    """Whether the compiled backend of the CPU runs a model."""
    return model.device.type == "cpu" and model.backend()[0] not in (REFERENCE, "torch")


def _bf16_set() -> str:
    """The instruction set for products in bfloat16: the best, or the one that is selected."""
    name, where = selected()
    sets = cpu.bf16_sets()
    if not sets:
        raise InputError(
            "precision 'bf16' needs a processor with AVX512-BF16 (avx512_bf16), and Linux; leave "
            "precision out, or give device cuda"
        )
    if name in sets:
        return name
    if name not in ("auto", "cpu"):
        raise InputError(
            f"precision 'bf16' runs in {' or '.join(sets)}, but {where} selects {name}; leave one "
            "of the two out"
        )
    return sets[0]
