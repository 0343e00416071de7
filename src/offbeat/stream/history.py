"""The newest rows of a stream with the state before each, so that late rows can be inserted."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from offbeat.errors import DivergenceError, InputError
from offbeat.stream.engine import Engine, decode, decode_all, encode, encode_all


class Row(NamedTuple):
    """A row that was consumed.

    Attributes:
        time: s.
        values: (channels,) scaled; 0 where not measured.
        mask: (channels,) True where measured.
        slot: of the engine, with the state before the row.
    """

    time: float
    values: NDArray[Any]
    mask: NDArray[np.bool_]
    slot: int


class History:
    """Feeds rows to an engine, and can restore its state before any of the newest rows.

    Args:
        engine: runs the model.
        kept: number of newest rows that are kept.
        recover: resets the engine, after a row at which it diverged; the row is then its first.
    """

    def __init__(self, engine: Engine, kept: int, recover: Callable[[], None]) -> None:
        self._engine, self._kept, self._recover = engine, kept, recover
        # The kept rows, the same number while they are replaced, one more, and one to restore.
        self._undo = 2 * kept + 1
        engine.reserve(self._undo + 1)
        self.forget()

    def forget(self) -> None:
        """Drops all rows; does not change the engine."""
        self.rows: list[Row] = []
        self.free = list(range(self._undo))
        """Slots of the engine without a state."""
        self.floor = -math.inf
        """s, time of the newest row that is no longer kept."""

    @property
    def newest(self) -> float:
        """s, time of the newest row; there must be one."""
        return self.rows[-1].time

    def append(self, time: float, values: NDArray[Any], mask: NDArray[np.bool_]) -> None:
        """Appends the next row. If the engine raises, nothing changes."""
        slot = self.free[-1]
        self._engine.save(slot)
        self._observe(time, values, mask)
        self.free.pop()
        self.rows.append(Row(time, values, mask, slot))
        if len(self.rows) > self._kept:
            self._trim()

    def replace(self, i: int, values: NDArray[Any], mask: NDArray[np.bool_]) -> None:
        """Replaces row i and repeats the later rows. If this raises, nothing changes."""
        self._run_again(i, (self.rows[i].time, values, mask), i + 1)

    def insert(self, i: int, time: float, values: NDArray[Any], mask: NDArray[np.bool_]) -> None:
        """Inserts a row before row i, repeats the later ones. If this raises, nothing changes."""
        self._run_again(i, (time, values, mask), i)
        self._trim()

    def place(self, time: float, within: float) -> tuple[int, bool] | None:
        """Where a late row belongs: the row to join (True) or to precede (False).

        None: it belongs among rows that are no longer kept.
        """
        i = bisect_right([row.time for row in self.rows], time)
        near = [k for k in (i - 1, i) if 0 <= k < len(self.rows)]
        k = min(near, key=lambda k: abs(self.rows[k].time - time))
        if abs(self.rows[k].time - time) <= within:
            return k, True
        return None if i == 0 and time - within <= self.floor else (i, False)

    def record(self) -> dict[str, Any]:
        """The rows and all states, JSON-like."""
        rows = []
        self._engine.save(self._undo)
        now = self._engine.export()
        for row in self.rows:
            self._engine.load(row.slot)
            before = encode_all(self._engine.export())
            values, mask = encode(row.values), encode(row.mask)
            rows.append({"time": row.time, "values": values, "mask": mask, "before": before})
        self._engine.load(self._undo)
        floor = self.floor if math.isfinite(self.floor) else None
        return {"state": encode_all(now), "floor": floor, "rows": rows}

    def restore(self, record: Any, channels: int) -> None:
        """The inverse of `record`.

        Raises:
            InputError: the record is damaged. Nothing changes then.
        """
        like = self._engine.export()
        values, mask = np.zeros(channels, self._engine.dtype), np.zeros(channels, dtype=bool)
        rows = [
            (
                seconds(row["time"]),
                decode(row["values"], values, "values of a row"),
                decode(row["mask"], mask, "mask of a row"),
                decode_all(row["before"], like, "state before a row"),
            )
            for row in record["rows"]
        ]
        now = decode_all(record["state"], like, "state")
        floor = -math.inf if record["floor"] is None else seconds(record["floor"])
        self.forget()
        self.floor = floor
        for time, row_values, row_mask, before in rows:
            slot = self.free.pop()
            self._engine.restore(before)
            self._engine.save(slot)
            self.rows.append(Row(time, row_values, row_mask, slot))
            self._trim()
        self._engine.restore(now)

    def _run_again(
        self, i: int, row: tuple[float, NDArray[Any], NDArray[np.bool_]], rest: int
    ) -> None:
        """Consumes `row` and the rows from `rest` on, from the state before row i."""
        again = [row, *((r.time, r.values, r.mask) for r in self.rows[rest:])]
        self._engine.save(self._undo)
        self._engine.load(self.rows[i].slot)
        free, made = list(self.free), []
        try:
            for time, values, mask in again:
                slot = free.pop()
                self._engine.save(slot)
                self._observe(time, values, mask)
                made.append(Row(time, values, mask, slot))
        except Exception:
            self._engine.load(self._undo)
            raise
        self.free = free + [old.slot for old in self.rows[i:]]
        self.rows[i:] = made

    def _observe(self, time: float, values: NDArray[Any], mask: NDArray[np.bool_]) -> None:
        try:
            self._engine.observe(time, values, mask)
        except DivergenceError:
            self._recover()
            self._engine.observe(time, values, mask)

    def _trim(self) -> None:
        while len(self.rows) > self._kept:
            row = self.rows.pop(0)
            self.free.append(row.slot)
            self.floor = row.time


def seconds(value: Any) -> float:
    """A finite number from a record.

    Raises:
        InputError: it is not one.
    """
    number = isinstance(value, int | float) and not isinstance(value, bool)
    if not number or not math.isfinite(value):
        raise InputError(f"the record of a stream is damaged: it has {value!r} for a time")
    return float(value)
