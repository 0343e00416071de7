"""Read-only arrays that records own."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray


def frozen(value: Any, dtype: Any) -> NDArray[Any]:
    """Returns a read-only array that nothing else can write to; copies if needed.

    No copy is made of an array that is new (from a list or another dtype) or read-only,
    including the array that owns the memory, such as a slice of a record's array.

    Raises:
        TypeError, ValueError: `value` cannot be converted to `dtype`.
    """
    array = np.asarray(value, dtype=dtype)
    made_here = isinstance(value, list | tuple | np.ndarray) and array is not value
    if not (made_here and array.base is None) and not _is_frozen(array):
        array = array.copy(order="K")
    array.flags.writeable = False
    return array


def hand_over(array: NDArray[Any]) -> NDArray[Any]:
    """Makes an array read-only, so that records made from it need no copy.

    The array and the arrays that it is a view of become read-only. Call it last, on arrays that
    nothing else writes to.
    """
    part: Any = array
    while isinstance(part, np.ndarray):
        part.flags.writeable = False
        part = part.base
    return array


def _is_frozen(array: NDArray[Any]) -> bool:
    part: Any = array
    while isinstance(part, np.ndarray):
        if part.flags.writeable:
            return False
        part = part.base
    return part is None or isinstance(part, bytes)
