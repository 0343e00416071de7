"""A step of an optimizer over all weights in one compiled call, with the bits of PyTorch.

PyTorch takes ten operations for a step of Adamax. On the weights of a small model, most of their
time is that of starting them.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import torch
from torch import Tensor

from offbeat.kernels import cpu


class CompiledAdamax:
    """The steps of a `torch.optim.Adamax` over one tensor, on the state of that optimizer.

    Args:
        optimizer: over `flat` alone.
        flat: all weights, with their gradient; a contiguous vector on the CPU.
        variant: name of an instruction set.
    """

    def __init__(self, optimizer: torch.optim.Optimizer, flat: Tensor, variant: str) -> None:
        self._optimizer, self._flat, self._variant = optimizer, flat, variant
        group = optimizer.param_groups[0]
        self._supported = (
            type(optimizer) is torch.optim.Adamax
            and hasattr(cpu.compiled, "adamax")
            and len(optimizer.param_groups) == len(group["params"]) == 1
            and not (group["weight_decay"] or group["maximize"] or group["differentiable"])
            and same_bits(flat.dtype, variant)
        )

    def step(self) -> None:
        """Takes a step with the gradient in `flat.grad`: the same bits as `optimizer.step()`."""
        state = self._optimizer.state.get(self._flat)
        if not state or not self._supported:  # the first step makes the state
            self._optimizer.step()
            return
        _step(self._variant, self._flat, state, self._optimizer.param_groups[0])


def _step(variant: str, flat: Tensor, state: dict[str, Tensor], group: dict[str, Any]) -> None:
    beta1, beta2 = group["betas"]
    count = state["step"]
    count += 1
    assert flat.grad is not None
    cpu.compiled.adamax(
        variant,
        flat.grad.numpy(),
        1 - beta1,
        beta2,
        group["eps"],
        -(float(group["lr"]) / (1 - beta1 ** count.item())),
        state["exp_avg"].numpy(),
        state["exp_inf"].numpy(),
        flat.detach().numpy(),
    )


@lru_cache(maxsize=64)
def same_bits(dtype: torch.dtype, variant: str) -> bool:
    """Whether the compiled step has the bits of PyTorch here, by some steps of both.

    PyTorch rounds a product and its sum once with AVX2 and AVX-512, and twice without them.

    Args:
        dtype: of the weights.
        variant: name of an instruction set.
    """
    generator = torch.Generator().manual_seed(0)
    start, *gradients = torch.randn(6, 2000, generator=generator, dtype=dtype)
    pair = []
    for _ in range(2):
        flat = torch.nn.Parameter(start.clone())
        # With such a momentum, other rounding changes a tenth of the numbers in each step.
        pair.append((flat, torch.optim.Adamax([flat], betas=(0.6, 0.999), foreach=True)))
    (theirs, reference), (own, optimizer) = pair
    for i, gradient in enumerate(gradients):
        theirs.grad = own.grad = gradient
        reference.step()
        if i:
            _step(variant, own, optimizer.state[own], optimizer.param_groups[0])
        else:
            optimizer.step()
    moments = [
        (reference.state[theirs][name], optimizer.state[own][name])
        for name in ("exp_avg", "exp_inf")
    ]
    return all(torch.equal(a, b) for a, b in [(theirs, own), *moments])
