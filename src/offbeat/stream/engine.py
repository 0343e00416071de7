"""Interface of engines, which run a model one row at a time and save its states."""

from __future__ import annotations

import base64
import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from offbeat.errors import InputError

Arrays = dict[str, NDArray[Any]]
"""A state, by the names of its parts."""


class Engine(ABC):
    """Runs a model row by row; has the current state, and copies of earlier states in slots.

    A method that raises leaves the state as it was.
    """

    @property
    @abstractmethod
    def dtype(self) -> np.dtype[Any]:
        """Dtype of the values that `observe` takes."""

    @abstractmethod
    def reserve(self, slots: int) -> None:
        """Allocates this many slots for copies of the state, numbered from 0."""

    @abstractmethod
    def reset(self) -> None:
        """Resets the state."""

    @abstractmethod
    def observe(self, time: float, values: NDArray[Any], mask: NDArray[np.bool_]) -> None:
        """Consumes one row.

        Args:
            time: s, later than the row before; any origin that stays the same until a reset.
            values: (channels,) of `dtype`; 0 where not measured.
            mask: (channels,) True where measured.
        """

    @abstractmethod
    def predict(self, times: NDArray[np.float64]) -> NDArray[np.float64]:
        """Predicts the next row at each of these times; does not change the state.

        Args:
            times: (times,) s, none before the newest row.

        Returns:
            (times, channels) in the units of the engine.
        """

    def half_widths(self, times: NDArray[np.float64], level: float) -> NDArray[np.float64] | None:
        """Half widths of the intervals of predictions, where the engine has any.

        Args:
            times: as of `predict`.
            level: probability of the interval.

        Returns:
            (times, channels) in original units, or None.
        """
        return None

    def in_order(self, **settings: Any) -> Any | None:
        """Compiled code that takes messages in the order of time, where the engine has any.

        Args:
            settings: of `stream/in_order.py`.
        """
        return None

    @abstractmethod
    def save(self, slot: int) -> None:
        """Copies the state to a slot."""

    @abstractmethod
    def load(self, slot: int) -> None:
        """Copies a slot to the state."""

    @abstractmethod
    def export(self) -> Arrays:
        """The state as plain arrays, which share no memory with it."""

    @abstractmethod
    def restore(self, arrays: Arrays) -> None:
        """Restores a state from `export`; names, types and shapes have been checked."""

    @abstractmethod
    def fingerprint(self) -> str:
        """Differs between models: a state belongs to the model that made it."""


def encode(array: NDArray[Any]) -> dict[str, Any]:
    """Encodes an array as JSON, exactly, including NaN and infinities."""
    array = np.ascontiguousarray(array)
    array = array.astype(array.dtype.newbyteorder("<"), copy=False)
    data = base64.b64encode(array.tobytes()).decode("ascii")
    return {"dtype": array.dtype.str, "shape": list(array.shape), "base64": data}


def decode(record: Any, like: NDArray[Any], what: str) -> NDArray[Any]:
    """The inverse of `encode`, for an array of the type and shape of `like`.

    Raises:
        InputError: the record is damaged, or of another type or shape.
    """
    expected = encode(like)
    try:
        if record["dtype"] != expected["dtype"] or record["shape"] != expected["shape"]:
            raise InputError(
                f"{what} is {record['dtype']} of shape {record['shape']}, expected "
                f"{expected['dtype']} of shape {expected['shape']}"
            )
        data = base64.b64decode(record["base64"], validate=True)
        if len(data) != math.prod(like.shape) * like.dtype.itemsize:
            raise ValueError(f"{len(data)} bytes")
        found = np.frombuffer(data, dtype=record["dtype"]).reshape(like.shape)
    except InputError:
        raise
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{what} is damaged ({type(error).__name__}: {error})") from None
    return found.astype(like.dtype)


def encode_all(arrays: Mapping[str, NDArray[Any]]) -> dict[str, Any]:
    """A state in JSON-like form."""
    return {name: encode(array) for name, array in arrays.items()}


def decode_all(records: Any, like: Mapping[str, NDArray[Any]], what: str) -> Arrays:
    """The inverse of `encode_all`, for a state of the names, types and shapes of `like`.

    Raises:
        InputError: the records are damaged, or of another model.
    """
    if not isinstance(records, dict) or records.keys() != like.keys():
        got = ", ".join(sorted(records)) if isinstance(records, dict) else repr(records)
        raise InputError(f"{what} must have the parts {', '.join(sorted(like))}, got {got}")
    return {name: decode(records[name], like[name], f"{what}: {name}") for name in like}
