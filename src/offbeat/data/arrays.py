"""Arrays that records own: copied from the caller's, and read-only."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray


def frozen(value: Any, dtype: Any) -> NDArray[Any]:
    """Returns a read-only array that nothing else can write to; copies where that is needed.

    Nothing is copied that is new (a list, another type of number) or that is read-only already,
    down to the array that owns the memory, such as a slice of a record's own array.

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
    """Hands an array over to the records that are made from it, which then need no copy.

    The array, and those that it is a view of, become read-only. Call it last, on arrays that
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
