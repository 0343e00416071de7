"""The compiled step of Adamax has the bits of PyTorch."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

import offbeat as ob
from offbeat.kernels import cpu
from offbeat.kernels.optimizer import CompiledAdamax, same_bits

pytestmark = pytest.mark.skipif(
    not hasattr(cpu.compiled, "adamax"), reason="there is no compiled step"
)
every_set = pytest.mark.parametrize("name", cpu.instruction_sets() or ["none"])
every_type = pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
Optimizer = tuple[torch.nn.Parameter, torch.optim.Optimizer]


def pair(start: torch.Tensor, **options: Any) -> tuple[Optimizer, Optimizer]:
    """The same weights twice, each with an optimizer."""
    made = []
    for _ in range(2):
        flat = torch.nn.Parameter(start.clone())
        made.append((flat, torch.optim.Adamax([flat], foreach=True, **options)))
    return made[0], made[1]


def equal(first: Optimizer, second: Optimizer) -> bool:
    """Whether weights, moments and counts have the same bits; NaN equals NaN."""
    tensors = [
        [flat.detach(), *(optimizer.state[flat][k] for k in ("exp_avg", "exp_inf", "step"))]
        for flat, optimizer in (first, second)
    ]
    return all(
        np.array_equal(a.numpy(), b.numpy(), equal_nan=True) for a, b in zip(*tensors, strict=True)
    )


@every_set
@every_type
@pytest.mark.parametrize("n", [1, 3, 16, 37, 1000])
def test_steps_have_the_bits_of_torch(name: str, dtype: torch.dtype, n: int) -> None:
    generator = torch.Generator().manual_seed(n)
    theirs, own = pair(torch.randn(n, generator=generator, dtype=dtype), lr=0.003)
    compiled = CompiledAdamax(own[1], own[0], name)
    for i in range(20):
        scale = 10.0 ** -(3 * i)  # down to numbers that are not normal
        gradient = scale * torch.randn(n, generator=generator, dtype=dtype)
        theirs[0].grad, own[0].grad = gradient, gradient.clone()
        theirs[1].param_groups[0]["lr"] = own[1].param_groups[0]["lr"] = 0.003 / (i + 1)
        theirs[1].step()
        compiled.step()
        assert equal(theirs, own)


@every_set
@every_type
def test_numbers_that_are_not_finite_are_those_of_torch(name: str, dtype: torch.dtype) -> None:
    odd = torch.tensor([0.0, -0.0, 1e-45, np.inf, -np.inf, np.nan, 1e30, -1.0], dtype=dtype)
    gradients, start = odd.repeat(8), odd.repeat_interleave(8)
    theirs, own = pair(start)
    compiled = CompiledAdamax(own[1], own[0], name)
    for _ in range(3):
        theirs[0].grad, own[0].grad = gradients, gradients.clone()
        theirs[1].step()
        compiled.step()
        assert equal(theirs, own)


@every_type
def test_the_best_instruction_set_has_a_step_of_its_own(dtype: torch.dtype) -> None:
    if torch.backends.cpu.get_cpu_capability() not in ("AVX2", "AVX512"):
        pytest.skip("PyTorch rounds twice here")
    assert same_bits(dtype, cpu.instruction_sets()[0])


@pytest.mark.parametrize("short", ["gradient", "average", "largest"])
def test_arrays_of_other_lengths_are_refused(short: str) -> None:
    given = {k: np.ones(5, np.float32) for k in ("gradient", "average", "largest", "weights")}
    given[short] = np.ones(4, np.float32)
    with pytest.raises(ob.InputError, match=short):
        cpu.compiled.adamax(
            instruction_set="baseline", lerp=0.1, beta=0.9, eps=1e-8, step=-0.1, **given
        )


@pytest.mark.parametrize("options", [{"weight_decay": 0.1}, {"maximize": True}])
def test_other_options_are_left_to_torch(options: dict[str, Any]) -> None:
    theirs, own = pair(torch.ones(5), **options)
    compiled = CompiledAdamax(own[1], own[0], cpu.instruction_sets()[0])
    for _ in range(3):
        theirs[0].grad = own[0].grad = torch.arange(5.0)
        theirs[1].step()
        compiled.step()
    assert equal(theirs, own)


PLACES = {
    "a shape of two columns": [[0, 0]],
    "before the start": [[-1, 0, 2]],
    "past the end": [[3, 0, 3]],
    "past the end of the source": [[0, 4, 2]],
    "a negative length": [[0, 0, -1]],
    "a sum over 64 bits": [[2**63 - 1, 0, 2]],
    "a source over 64 bits": [[0, 2**63 - 1, 5]],
}


@pytest.mark.parametrize("case", sorted(PLACES))
def test_segments_outside_of_the_weights_are_refused(case: str) -> None:
    to, source = np.zeros(5), np.ones(5)
    with pytest.raises(ob.InputError):
        cpu.compiled.move_weights(to, source, np.array(PLACES[case]), True)
    assert not to.any()


def test_segments_are_copied_and_added() -> None:
    to, source = np.arange(6.0), np.array([10.0, 20.0, 30.0])
    places = np.array([[4, 0, 2], [0, 2, 1], [3, 1, 0]])
    cpu.compiled.move_weights(to, source, places, True)
    assert to.tolist() == [30, 1, 2, 3, 14, 25]
    cpu.compiled.move_weights(to, source, places, False)
    assert to.tolist() == [30, 1, 2, 3, 10, 20]
    cpu.compiled.move_weights(to, source, np.zeros((0, 3), np.int64), True)
