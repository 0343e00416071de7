"""Messages in the order of time, in one compiled call each."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from offbeat.data.scaler import Scaler
from offbeat.stream.history import Row
from offbeat.stream.messages import RowReader, Time, Values
from offbeat.stream.options import Outcome, StreamOptions
from offbeat.stream.placing import Placement

_OUTCOMES: tuple[Outcome | None, ...] = (None, "new", "merged", "duplicate", "late", "stale")
_NEW = 1


class InOrder:
    """Consumes messages that are the next row, join the newest one, or are late and dropped.

    While it is open, the rows are in compiled code (`csrc/module/in_order.hpp`); `close` gives them
    to the placement. It refuses any other message and changes nothing then. With an engine that has
    no compiled code it refuses all.

    Args:
        placing: places all other messages.
        reader: of the values.
        scaler: maps predictions to original units.
        options: of the stream.
        exogenous: numbers of the channels that are not predicted.
    """

    def __init__(
        self,
        placing: Placement,
        reader: RowReader,
        scaler: Scaler,
        options: StreamOptions,
        exogenous: Sequence[int],
    ) -> None:
        self._placing, self._channels = placing, len(reader.names)
        stale = options.stale_after_s
        self._loop = placing.engine.in_order(
            index={name: i for i, name in enumerate(reader.names)},
            array=np.ndarray,
            shift=scaler.shift,
            scale=scaler.scale,
            reach=reader.reach,
            exogenous=list(exogenous),
            ticks=float(placing.clock.ticks),
            merge_within=options.merge_within_s,
            jump_back=options.jump_back_s,
            jump_ahead=math.inf if options.jump_ahead_s is None else options.jump_ahead_s,
            stale_after=math.inf if stale is None else stale,
            long_gap=placing.long_gap,
            resets_long_gap=options.long_gap == "reset",
            drops_late=options.late == "drop",
            takes_last=options.duplicates == "last",
            takes_twice=options.duplicates != "error",
            kept=options.kept_rows,
        )

    @property
    def newest(self) -> float | None:
        """s, time of the newest row; None before the first."""
        if self._loop is not None and self._loop.is_open:
            return float(self._loop.newest)
        rows = self._placing.history.rows
        return rows[-1].time if rows else None

    def observe(self, t: Time, values: Values) -> Outcome | None:
        """Consumes a message; None refuses it.

        Args:
            t: in the unit of the stream.
            values: as of `LiveStream.observe`.
        """
        return None if self._loop is None else _OUTCOMES[self._loop.observe(t, values, None)]

    def step(self, t: Time, values: Values) -> tuple[Outcome, NDArray[np.float64] | None] | None:
        """Predicts a row, (channels,) in original units, and observes it; None refuses it.

        Args:
            t: in the unit of the stream.
            values: as of `LiveStream.observe`.
        """
        if self._loop is None:
            return None
        out = np.empty(self._channels)
        done = self._loop.observe(t, values, out)
        outcome = _OUTCOMES[done]
        return None if outcome is None else (outcome, out if done == _NEW else None)

    def predict(self, t: Time) -> NDArray[np.float64] | None:
        """(channels,) predicted at a time, in original units; None refuses it.

        Args:
            t: in the unit of the stream.
        """
        if self._loop is None:
            return None
        out = np.empty(self._channels)
        return out if self._loop.predict(t, out) else None

    def open(self) -> None:
        """Continues from the rows of the placement, where there are any and nothing is pending."""
        placing, loop = self._placing, self._loop
        history = placing.history
        if loop is None or loop.is_open or placing.pending or not history.rows:
            return
        newest = history.rows[-1]
        loop.open(
            placing.clock.origin,
            [row.time for row in history.rows],
            [row.slot for row in history.rows],
            newest.values,
            newest.mask,
            history.free,
            history.floor,
            placing.seen,
            placing.counters.longest_gap_s,
        )

    def close(self) -> None:
        """Gives rows, time and counts to the placement."""
        placing, loop = self._placing, self._loop
        if loop is None or not loop.is_open:
            return
        shape = (loop.made, self._channels)
        values, mask = np.empty(shape, placing.engine.dtype), np.empty(shape, dtype=bool)
        given, times, slots, free, floor, seen, longest, counts = loop.close(values, mask)
        history, counters = placing.history, placing.counters
        made = [Row(*row) for row in zip(times, values, mask, slots, strict=True)]
        history.rows = [history.rows[i] for i in given] + made
        history.free, history.floor, placing.seen = free, floor, seen
        counters.longest_gap_s = longest
        for name, count in counts.items():
            setattr(counters, name, getattr(counters, name) + count)


def is_plain(t: Any) -> bool:
    """Whether a time is a plain number, which the clock has no need to convert."""
    return type(t) is float or type(t) is int
