"""What a policy keeps of the rows before: a recurrent state, or the newest rows themselves."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from offbeat.data.batch import Batch
from offbeat.errors import InputError
from offbeat.models.base import BaseModel
from offbeat.models.elapsed import RecurrentState

Past = RecurrentState | Batch
"""A batch of the newest rows, for a model without a recurrent state."""

_ROWS = ("times", "values", "mask", "known", "valid")


def joined(past: Batch | None, row: Batch, window: int) -> Batch:
    """The newest rows of some and a further one.

    Args:
        past: the rows before.
        row: the further one.
        window: number of rows that are kept.
    """
    if past is None:
        return row
    parts: dict[str, Any] = {
        name: torch.cat([getattr(past, name), getattr(row, name)], dim=1)[:, -window:]
        for name in _ROWS
    }
    # A robot that observes nothing may be asked for a time after that of a later observation.
    parts["times"] = parts["times"].cummax(dim=1).values
    return replace(row, **parts)


def kept(arrived: NDArray[np.bool_], after: Past, before: Past | None) -> Past:
    """The past after a row of the robots that observed something, and that before it of others.

    Args:
        arrived: (robots,) True where something was observed.
        after: with the row.
        before: without it.
    """
    if arrived.all() or not isinstance(before, RecurrentState):
        return after
    assert isinstance(after, RecurrentState)
    where = torch.from_numpy(arrived)
    parts: dict[str, Any] = {}
    for name, old in _tensors(before).items():
        here = where.to(old.device).view(-1, *(1,) * (old.ndim - 1))
        parts[name] = torch.where(here, getattr(after, name), old)
    return replace(after, **parts)


def arrays_of(past: Past | None) -> dict[str, NDArray[Any]]:
    """The past as plain arrays, by the names of its parts.

    Args:
        past: None before the first row of a model without a recurrent state.
    """
    if past is None:
        return {}
    arrays = {name: tensor.cpu().numpy().copy() for name, tensor in _tensors(past).items()}
    if isinstance(past, RecurrentState):
        arrays["rows"] = np.array(past.rows)
    return arrays


def past_of(
    arrays: Mapping[str, NDArray[Any]], model: BaseModel, first: Past | None
) -> Past | None:
    """The past from `arrays_of`.

    Args:
        arrays: its parts.
        model: of the policy.
        first: the past at the start of an episode of as many robots.

    Raises:
        InputError: it is of another model.
    """
    if isinstance(first, RecurrentState):
        expected = {name: tuple(tensor.shape) for name, tensor in _tensors(first).items()}
        expected["rows"] = ()
        found = {name: array.shape for name, array in arrays.items()}
        wrong = {name for name, _ in expected.items() ^ found.items()}
    else:
        wrong = set(_ROWS) ^ arrays.keys() if arrays else set()
    if wrong:
        raise InputError(f"the state is of another model: it differs in {sorted(wrong)}")
    if not arrays:
        return None
    parts: dict[str, Any] = {
        name: torch.tensor(array, device=model.device)
        for name, array in arrays.items()
        if name != "rows"
    }
    if isinstance(first, RecurrentState):
        return replace(first, rows=int(arrays["rows"]), **parts)
    channels = parts["values"].shape[-1]
    if channels != model.channels:
        raise InputError(
            f"the state is of a model of {channels} channels, expected {model.channels}; give a "
            "state of this policy"
        )
    return Batch(**parts, roles=model.roles)


def _tensors(past: Past) -> dict[str, Tensor]:
    """The parts that are tensors, by their names."""
    each = ((field.name, getattr(past, field.name)) for field in fields(past))
    return {name: part for name, part in each if isinstance(part, Tensor)}
