"""Places messages after or among the rows, drops them, and detects jumps of the clock."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from offbeat.errors import InputError
from offbeat.stream.engine import Engine, decode, encode
from offbeat.stream.history import History, seconds
from offbeat.stream.messages import Clock, Time
from offbeat.stream.options import Outcome, StreamCounters, StreamOptions


@dataclass(frozen=True, eq=False, slots=True)
class Message:
    """A pending message: its original time, and its values as a row."""

    t: Time
    values: NDArray[Any]
    mask: NDArray[np.bool_]


class Placement:
    """Orders messages into rows by time, and counts what was done with them.

    Args:
        engine: consumes the rows.
        options: what to do with messages out of order.
        names: of the channels, for messages.
        time_unit: of all times.
        median_gap: s, between the rows of the training set.
        elapsed_limit: s without an observation, at which the model's time saturates.

    Raises:
        InputError: an unknown unit, or options that do not fit the median gap of the model.
    """

    def __init__(
        self,
        engine: Engine,
        options: StreamOptions,
        *,
        names: tuple[str, ...],
        time_unit: str,
        median_gap: float,
        elapsed_limit: float,
    ) -> None:
        self.engine, self._options, self._names = engine, options, names
        self.clock, self.history = (
            Clock(time_unit),
            History(engine, options.kept_rows, self.recover),
        )
        self.counters = StreamCounters()
        self.pending: list[Message] = []
        self.seen: float | None = None
        """s, time of the newest row in which anything was measured."""
        self.before_row: Callable[[float], None] | None = None
        """Called with the time of each next row, before the engine consumes it."""
        self._pause = median_gap + options.merge_within_s
        """s, the gap that replaces a jump of the clock."""
        longest = options.jump_ahead_s
        if options.jump == "continue" and longest is not None and longest <= self._pause:
            raise InputError(
                f"jump_ahead_s is {longest!r}, no longer than the median gap of the model, "
                f"{median_gap:g} s (and merge_within_s): every row would be a jump"
            )
        limit = options.long_gap_s
        self.long_gap = elapsed_limit if limit is None else limit
        """s without a value; a longer gap counts as long."""

    @property
    def time(self) -> Time | None:
        """Time of the newest row, in the unit of the clock; None before the first."""
        return self.clock.at(self.history.newest) if self.history.rows else None

    def reset(self) -> None:
        """Resets the state. The counters keep their values."""
        self.engine.reset()
        self.history.forget()
        self.clock.origin = None
        self.pending, self.seen = [], None
        self.counters.resets += 1

    def recover(self) -> None:
        """Resets the engine alone, whose state is no longer finite; time and rows stay."""
        self.engine.reset()
        self.counters.recoveries += 1
        if self.counters.recoveries == 1:
            logging.getLogger("offbeat").warning(
                "the state of the stream left the finite numbers at the time %s; it was reset and "
                "starts again from what comes next (counted as recoveries)",
                self.time,
            )

    def drop(self, outcome: Outcome) -> Outcome:
        """Counts a message that is dropped."""
        setattr(self.counters, outcome, getattr(self.counters, outcome) + 1)
        return outcome

    def record(self) -> dict[str, Any]:
        """The state as a JSON-like record."""
        return {
            "origin": self.clock.origin,
            "seen": self.seen,
            "history": self.history.record(),
            "pending": [
                {"t": m.t, "values": encode(m.values), "mask": encode(m.mask)} for m in self.pending
            ],
            "counters": self.counters.to_dict(),
        }

    def restore(self, record: dict[str, Any]) -> None:
        """The inverse of `record`.

        Raises:
            InputError: the record is damaged. Nothing changes then.
        """
        channels = len(self._names)
        values, mask = np.zeros(channels, self.engine.dtype), np.zeros(channels, dtype=bool)
        try:
            origin = None if record["origin"] is None else self.clock.read(record["origin"])
            seen = None if record["seen"] is None else seconds(record["seen"])
            pending = [
                Message(
                    self.clock.read(m["t"]),
                    decode(m["values"], values, "values of a pending message"),
                    decode(m["mask"], mask, "mask of a pending message"),
                )
                for m in record["pending"]
            ]
            counters = StreamCounters.from_dict(record["counters"])
            self.history.restore(record["history"], channels)
        except (ArithmeticError, AttributeError, LookupError, TypeError) as error:
            what = f"{type(error).__name__}: {error}"
            raise InputError(f"the record of the stream is damaged ({what})") from None
        self.clock.origin, self.seen = origin, seen
        self.pending, self.counters = pending, counters

    def take(
        self, t: Time, values: NDArray[Any], mask: NDArray[np.bool_], measured: int
    ) -> Outcome:
        """Places a message."""
        options = self._options
        if not self.history.rows:
            self.clock.origin = t
            return self._append(0.0, values, mask, measured)
        time = self.clock.seconds(t)
        ahead = time - self.history.newest
        if ahead < -options.jump_back_s or ahead > (options.jump_ahead_s or math.inf):
            return self._far(t, ahead, values, mask)
        if self.pending:
            self._release()
        if abs(ahead) <= options.merge_within_s:
            return self._join(len(self.history.rows) - 1, values, mask)
        if ahead > 0:
            return self._append(time, values, mask, measured)
        return self._late(time, values, mask)

    def _append(
        self, time: float, values: NDArray[Any], mask: NDArray[np.bool_], measured: int
    ) -> Outcome:
        """Appends the next row."""
        gap = time - self.seen if measured and self.seen is not None else 0.0
        long = gap > self.long_gap
        if long and self._options.long_gap == "reset":
            origin, floor = self.clock.origin, self.history.newest
            self.reset()
            self.clock.origin, self.history.floor = origin, floor
        if self.before_row is not None:
            self.before_row(time)
        self.history.append(time, values, mask)
        self.counters.rows += 1
        if measured:
            self.seen = time
            self.counters.long_gaps += long
            self.counters.longest_gap_s = max(self.counters.longest_gap_s, gap)
        return "new"

    def _join(self, i: int, values: NDArray[Any], mask: NDArray[np.bool_]) -> Outcome:
        """Merges a message into row i, which has the same time."""
        old = self.history.rows[i]
        twice = mask & old.mask
        repeated = bool(twice.any())
        if repeated and self._options.duplicates == "error":
            raise InputError(
                f"measured twice at the time {self.clock.at(old.time)}: "
                f"{', '.join(np.array(self._names)[twice])}; set duplicates to 'last' or "
                "'first' to allow that"
            )
        taken = mask if self._options.duplicates == "last" else mask & ~old.mask
        joined, union = np.where(taken, values, old.values), old.mask | taken
        changed = not (np.array_equal(joined, old.values) and np.array_equal(union, old.mask))
        if changed:
            self.history.replace(i, joined, union)
            self.seen = max(old.time if self.seen is None else self.seen, old.time)
        self.counters.duplicates += repeated
        self.counters.merged += changed
        return "merged" if changed else "duplicate"

    def _late(self, time: float, values: NDArray[Any], mask: NDArray[np.bool_]) -> Outcome:
        """Handles a message older than the newest row."""
        options, behind = self._options, self.history.newest - time
        if behind > (options.stale_after_s or math.inf):
            return self.drop("stale")
        if options.late == "error":
            raise InputError(
                f"a message is {behind:g} s older than the newest row, of the time {self.time}; "
                "set late to 'drop' or 'reorder' to allow that"
            )
        place = self.history.place(time, options.merge_within_s)
        if options.late == "drop" or place is None:
            return self.drop("late")
        i, joins = place
        if joins:
            return self._join(i, values, mask)
        self.history.insert(i, time, values, mask)
        if mask.any():
            self.seen = time if self.seen is None else max(self.seen, time)
        self.counters.rows += 1
        self.counters.reordered += 1
        return "reordered"

    # --- clocks that jump -------------------------------------------------------------------------

    def _far(self, t: Time, ahead: float, values: NDArray[Any], mask: NDArray[np.bool_]) -> Outcome:
        """Handles a message so far off that the clock may have jumped."""
        options = self._options
        if options.jump == "error":
            newer = "newer" if ahead > 0 else "older"
            raise InputError(
                f"a message is {abs(ahead):g} s {newer} than the newest row, of the time "
                f"{self.time}; set jump to 'reset', 'continue' or 'drop' to allow that"
            )
        if options.jump == "drop":
            if ahead > 0:
                return self.drop("ahead")
            return self._late(self.clock.seconds(t), values, mask)
        if self.pending:
            step = self.clock.between(t, self.pending[-1].t)
            if not -options.jump_back_s <= step <= (options.jump_ahead_s or math.inf):
                self._release()
        self.pending.append(Message(t, values, mask))
        if len(self.pending) < options.confirm:
            return "pending"
        pending, self.pending = sorted(self.pending, key=lambda message: message.t), []
        self.counters.jumps_ahead += ahead > 0
        self.counters.jumps_back += ahead < 0
        if options.jump == "reset":
            self.reset()
        else:
            self.clock.rebase(pending[0].t, self.history.newest + self._pause)
        for message in pending:
            self._take_pending(message)
        return "jumped"

    def _take_pending(self, message: Message) -> None:
        """Consumes a pending message; drops it where the options ask for an error."""
        try:
            measured = int(np.count_nonzero(message.mask))
            self.take(message.t, message.values, message.mask, measured)
        except InputError:
            self.drop("late")

    def _release(self) -> None:
        """Drops pending messages as late or too far ahead, if the clock has not jumped."""
        pending, self.pending = self.pending, []
        for message in pending:
            time = self.clock.seconds(message.t)
            if time > self.history.newest:
                self.drop("ahead")
                continue
            try:
                self._late(time, message.values, message.mask)
            except InputError:
                self.drop("late")
