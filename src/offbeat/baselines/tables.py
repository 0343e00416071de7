"""Tables of results per kind of value, and averages of their entries between kinds."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from offbeat.baselines.base import channels_of, namespace


@dataclass(frozen=True, eq=False)
class Place:
    """Where values lie between the kinds that a table has entries of.

    Kinds are divisions of what is continuous, such as the time since observation. A value at the
    centre of a kind has the entry of that kind, and one between two centres a mean of both, so that
    an answer does not jump where one kind ends.

    Attributes:
        key: (...) kind, an index array or tensor.
        part: (..., 2) how far the value is on the way to the next kind in two directions, 0 to 1.
        step: the next kind in either direction is so many kinds further.
    """

    key: Any
    part: Any
    step: tuple[int, int]

    def __getitem__(self, index: Any) -> Place:
        """Some of the values."""
        return Place(self.key[index], self.part[index], self.step)

    def average(self, table: Any, channel: Any = None) -> Any:
        """(..., ...) the entries of the values, linear between kinds.

        Args:
            table: (keys, channels, ...) array or tensor like `part`.
            channel: (...) of each value; by default the last axis of `key` is that of the channels.
        """
        channel = channels_of(self.key) if channel is None else channel
        xp, last, total = namespace(self.part), len(table) - 1, 0.0
        for i, first in enumerate((1 - self.part[..., 0], self.part[..., 0])):
            for j, second in enumerate((1 - self.part[..., 1], self.part[..., 1])):
                key = self.key + (i * self.step[0] + j * self.step[1])
                key = xp.where(key < last, key, last)
                found = table[key, channel]
                weight = first * second
                further = (1,) * (found.ndim - weight.ndim)
                total = total + weight.reshape(*weight.shape, *further) * found
        return total
