"""One training by several processes: each rank takes its part of every batch.

`torchrun` starts the ranks, and torch's process group connects them: gloo on CPUs, NCCL on GPUs.
The gradients of all ranks are gathered and added in the order of the ranks, each weighted by the
values that count in its part. So the sum is the gradient of the whole batch up to rounding, and it
has the same bits on every rank and in every run. The first rank alone writes, validates and
resumes.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from dataclasses import dataclass
from datetime import timedelta
from functools import partial
from typing import Any, TypeVar

import torch
import torch.distributed as dist

# Optimizers import this module, whose default arguments would keep a group that is there already:
# its threads would outlive it, and may abort the process when it ends.
import torch.distributed.nn.functional
from torch import Tensor

from offbeat.devices import device_of
from offbeat.errors import InputError, OffbeatError

T = TypeVar("T")

TIMEOUT_S = 1800.0
"""s, after which a rank that does not answer counts as lost: longer than a validation takes."""


class LostRankError(OffbeatError, ConnectionError):
    """Another rank does not answer any more."""


@dataclass(frozen=True)
class Ranks:
    """The processes that train one model together.

    Attributes:
        rank: of this process, from 0.
        size: how many there are.
    """

    rank: int
    size: int

    @property
    def first(self) -> bool:
        """Whether this process writes, validates and resumes."""
        return self.rank == 0

    def share(self, index: Tensor) -> Tensor:
        """The part of a batch that this rank takes; empty where there are fewer than ranks.

        Args:
            index: (batch,) positions of trajectories.
        """
        return index.tensor_split(self.size)[self.rank]

    def reduce(self, gradient: Tensor, loss: Tensor, count: Tensor) -> Tensor:
        """Replaces a gradient by that of the whole batch, in place; returns its loss.

        Args:
            gradient: flat, of the mean over the values that count in the part of this rank.
            loss: that mean; any number where nothing counts.
            count: of the values, or the sum of their weights.

        Raises:
            LostRankError: another rank does not answer.
        """
        count = count.to(gradient)
        loss = torch.where(count > 0, loss.detach().to(gradient), 0.0)
        own = torch.cat([gradient * count, (loss * count)[None], count[None]])
        every = [torch.empty_like(own) for _ in range(self.size)]
        self._reach(partial(dist.all_gather, every, own))
        total = every[0]
        for other in every[1:]:
            total = total + other
        whole = total[-1].clamp_min(torch.finfo(total.dtype).tiny)
        gradient.copy_(total[:-2] / whole)
        return total[-2] / whole

    def shared(self, function: Callable[[], T]) -> T:
        """Calls a function on the first rank, and returns its result, or raises its error, on all.

        Args:
            function: returns what can be pickled.

        Raises:
            LostRankError: another rank does not answer.
        """
        box: list[Any] = [None, None]
        if self.first:
            try:
                box[0] = function()
            except OffbeatError as error:
                box[1] = error
        self._reach(partial(dist.broadcast_object_list, box, src=0))
        if box[1] is not None:
            raise box[1]
        return box[0]  # type: ignore[no-any-return]

    def _reach(self, call: Callable[[], Any]) -> None:
        """Calls what needs all ranks."""
        try:
            call()
            return
        except RuntimeError as error:
            why = _line(error)
        # After the handler: the frames of the error would keep the group and its threads, too.
        raise LostRankError(
            f"a rank was lost, as rank {self.rank} of {self.size} sees it ({why}); the same "
            "command continues from the last checkpoint, with any number of ranks"
        )


def _line(error: Exception) -> str:
    """The begin of a message, in one line."""
    return " ".join(str(error).split())[:120]


_current: ContextVar[Ranks | None] = ContextVar("offbeat_ranks", default=None)


def current() -> Ranks | None:
    """The ranks of the `group` that this code runs in; None outside of one."""
    return _current.get()


def is_first() -> bool:
    """Whether this process writes: it is the first rank, or the only one."""
    ranks = current()
    return ranks is None or ranks.first


def on_first(function: Callable[[], T]) -> T:
    """Calls a function on the first rank, with its result on all; without ranks, just calls it."""
    ranks = current()
    return function() if ranks is None else ranks.shared(function)


def launched() -> bool:
    """Whether `torchrun`, or a launcher with its variables, started several ranks."""
    return os.environ.get("WORLD_SIZE", "1") not in ("", "1") and "RANK" in os.environ


def device_here(device: str) -> str:
    """The device of this rank: `cuda` is the GPU of its number on the machine.

    Args:
        device: that all ranks were given.

    Raises:
        InputError: it is `auto` for several ranks, which might choose differently.
    """
    if not launched():
        return device
    if device == "auto":
        raise InputError("several ranks need one kind of device, got 'auto'; give cpu or cuda")
    return f"cuda:{os.environ.get('LOCAL_RANK', 0)}" if device == "cuda" else device


@contextmanager
def group(device: str = "cpu", *, timeout_s: float = TIMEOUT_S) -> Iterator[Ranks | None]:
    """Context manager in which `fit` is one training by all ranks that `torchrun` started.

    Args:
        device: that models are trained on.
        timeout_s: after which a rank that does not answer counts as lost.

    Yields:
        The ranks; None where there is one process alone.

    Raises:
        InputError: the variables of `torchrun` are not complete, or there is no such device here.
        LostRankError: another rank does not answer at the start.

    Example:
        >>> from offbeat.distributed import group
        >>> with group() as ranks:  # doctest: +SKIP
        ...     offbeat.fit(model, train, validation, out="runs/wide")
    """
    if not launched():
        yield None
        return
    here = device_of(device_here(device))
    if here.type == "cuda":
        torch.cuda.set_device(here)
    backend = "nccl" if here.type == "cuda" else "gloo"
    try:
        dist.init_process_group(backend, timeout=timedelta(seconds=timeout_s))
    except ValueError as error:
        raise InputError(
            f"WORLD_SIZE is set, but the ranks can't be connected ({error}); start them with "
            "torchrun, or unset it"
        ) from None
    except dist.DistError as error:
        raise LostRankError(
            f"rank {os.environ['RANK']} of {os.environ['WORLD_SIZE']} can't reach the others "
            f"({_line(error)}); start all of them, with one MASTER_ADDR and MASTER_PORT"
        ) from None
    ranks = Ranks(dist.get_rank(), dist.get_world_size())
    token = _current.set(ranks)
    try:
        yield ranks
    finally:
        _current.reset(token)
        with suppress(RuntimeError):  # where a rank was lost
            dist.destroy_process_group()
