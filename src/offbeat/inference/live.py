"""The stream itself, whatever runs the model: rows in the order of time out of messages in any."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from offbeat.data.prepare import Scaler
from offbeat.errors import DivergenceError, InputError
from offbeat.inference.engine import Engine, decode, encode
from offbeat.inference.history import History, seconds
from offbeat.inference.messages import Clock, RowReader, Time, Values
from offbeat.inference.policies import Outcome, StreamCounters, StreamPolicies

FORMAT = "offbeat-stream"
VERSION = 1


@dataclass(frozen=True)
class Frame:
    """What a stream must know of its model.

    Attributes:
        names: of the channels.
        units: of the channels.
        scaler: maps original units to those of the engine.
        median_gap: s, between the rows of the training part.
        elapsed_limit: s without an observation, at which the model's time saturates.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    scaler: Scaler
    median_gap: float
    elapsed_limit: float


@dataclass(frozen=True, eq=False, slots=True)
class _Message:
    """A message kept aside, its time as it came, its values as a row."""

    t: Time
    values: NDArray[Any]
    mask: NDArray[np.bool_]


class LiveStream:
    """Feeds messages to an engine, one row at a time; `Stream` and `OnnxStream` are public.

    Memory does not grow. One thread at a time: calls must not overlap.

    Args:
        engine: runs the model.
        frame: what must be known of it.
        policies: what to do with messages out of order.
        time_unit: of all times given: s, ms, us or ns.
    """

    def __init__(
        self, engine: Engine, frame: Frame, *, policies: StreamPolicies, time_unit: str
    ) -> None:
        self.names, self.units, self.policies = frame.names, frame.units, policies
        self._engine, self._frame = engine, frame
        self._clock = Clock(time_unit)
        self._reader = RowReader(frame.names, frame.scaler, engine.dtype)
        self._history = History(engine, policies.kept_rows)
        self._counters = StreamCounters()
        self._held: list[_Message] = []
        self._seen: float | None = None
        """s, time of the newest row in which anything was measured."""
        self._stepping = False
        self._predicted: NDArray[np.float64] | None = None
        self._pause = frame.median_gap + policies.merge_within_s
        """s, that a jump of the clock is taken for."""
        longest = policies.jump_ahead_s
        if policies.jump == "continue" and longest is not None and longest <= self._pause:
            raise InputError(
                f"jump_ahead_s is {longest!r}, no longer than the model's usual gap of "
                f"{frame.median_gap:g} s (and merge_within_s): every row would be a jump"
            )
        limit = policies.long_gap_s
        self._long_gap = frame.elapsed_limit if limit is None else limit

    @property
    def time_unit(self) -> str:
        """Of all times given to this stream."""
        return self._clock.unit

    @property
    def time(self) -> Time | None:
        """Of the newest row, in the unit of the stream; None before the first."""
        return self._clock.at(self._history.newest) if self._history.rows else None

    def after(self, horizon_s: float) -> Time | None:
        """The time so many seconds after the newest row; None before the first."""
        rows = self._history.rows
        return self._clock.at(self._history.newest + horizon_s) if rows else None

    @property
    def counters(self) -> StreamCounters:
        """A copy of the counts so far."""
        return replace(self._counters)

    @property
    def held(self) -> int:
        """Messages kept aside until it is clear whether the clock has jumped."""
        return len(self._held)

    def observe(self, t: Time, values: Values, *, now: Time | None = None) -> Outcome:
        """Takes what was measured at a time.

        Args:
            t: when, in the unit of the stream; an integer is exact.
            values: channel to value, or one value per channel, in original units. NaN, None and
                channels that are left out were not measured.
            now: what the clock says on arrival, for `stale_after_s`.

        Returns:
            What became of the message.

        Raises:
            InputError: a time that is no finite number, an unknown channel, a value that is no
                number, or what the policies call an error. The message has changed nothing then.
            DivergenceError: an adaptive solver could not keep its tolerance. The message has
                changed nothing then.
        """
        t = self._clock.read(t)
        row, mask, measured, not_finite = self._reader.read(values)
        waited = -math.inf if now is None else self._between(self._clock.read(now), t)
        if waited > (self.policies.stale_after_s or math.inf):
            outcome = self._dropped("stale")
        else:
            outcome = self._take(t, row, mask, measured)
        self._counters.messages += 1
        self._counters.not_finite += not_finite
        self._counters.empty += measured == 0
        return outcome

    def step(
        self, t: Time, values: Values, *, now: Time | None = None
    ) -> tuple[Outcome, NDArray[np.float64] | None]:
        """Predicts a row, then takes it: `observe`, with the prediction that was made before it.

        Args:
            t: as in `observe`.
            values: as in `observe`; the prediction is made before they are looked at.
            now: as in `observe`.

        Returns:
            What became of the message; and where it is a `new` row, (channels,) predicted for it
            in original units, one step ahead.

        Raises:
            InputError: as `observe`.
            DivergenceError: as `observe` and `predict`.
        """
        self._stepping, self._predicted = True, None
        try:
            outcome = self.observe(t, values, now=now)
        finally:
            self._stepping = False
        return outcome, self._predicted if outcome == "new" else None

    def predict(self, t: Time | ArrayLike) -> NDArray[np.float64]:
        """Predicts the channels at a time, from all that was observed; consumes nothing.

        It is what the batch pass says of a row at this time, should it come next. At the time of
        the newest row itself, that row's values are known already. Several times are several
        questions: none of them changes the answer to another.

        Args:
            t: when, in the unit of the stream, not before the newest row; or an array of times.

        Returns:
            (channels,) in original units, or (times, channels).

        Raises:
            InputError: a time that is no finite number, or lies before the newest row.
            DivergenceError: the state has left the finite numbers; `reset` the stream.
        """
        if isinstance(t, np.ndarray) and t.ndim == 0:
            t = t[()]
        several = isinstance(t, list | tuple | np.ndarray)
        asked = [self._asked(self._clock.read(one)) for one in (t if several else [t])]  # type: ignore[union-attr]
        if not asked:
            return np.empty((0, len(self.names)))
        predicted = self._predict(np.array(asked))
        return predicted if several else predicted[0]

    def reset(self) -> None:
        """Begins anew: nothing seen yet. The counters go on."""
        self._engine.reset()
        self._forget()
        self._counters.resets += 1

    def state(self) -> dict[str, Any]:
        """All that the stream is, as JSON knows it; `restore` goes on from it bit for bit."""
        return {
            "format": FORMAT,
            "version": VERSION,
            "model": self._engine.fingerprint(),
            "time_unit": self.time_unit,
            "origin": self._clock.origin,
            "seen": self._seen,
            "history": self._history.record(),
            "held": [
                {"t": m.t, "values": encode(m.values), "mask": encode(m.mask)} for m in self._held
            ],
            "counters": self._counters.to_dict(),
        }

    def restore(self, record: dict[str, Any]) -> None:
        """Takes up what `state` recorded. The policies stay this stream's own.

        Raises:
            InputError: the record is damaged, or of another model or time unit. Nothing has changed
                then.
        """
        if not isinstance(record, dict) or record.get("format") != FORMAT:
            raise InputError(f"this is no record of a stream (it has no format {FORMAT!r})")
        for key, expected, fix in (
            ("version", VERSION, "use the Offbeat that wrote it, or a newer one"),
            ("model", self._engine.fingerprint(), "restore it with the model that wrote it"),
            ("time_unit", self.time_unit, "give this stream the time unit of the record"),
        ):
            if record.get(key) != expected:
                got = record.get(key)
                raise InputError(f"the record is of {key} {got!r}, not {expected!r}; {fix}")
        channels = len(self.names)
        values, mask = np.zeros(channels, self._engine.dtype), np.zeros(channels, dtype=bool)
        try:
            origin = None if record["origin"] is None else self._clock.read(record["origin"])
            seen = None if record["seen"] is None else seconds(record["seen"])
            held = [
                _Message(
                    self._clock.read(m["t"]),
                    decode(m["values"], values, "values of a held message"),
                    decode(m["mask"], mask, "mask of a held message"),
                )
                for m in record["held"]
            ]
            counters = StreamCounters.from_dict(record["counters"])
            self._history.restore(record["history"], channels)
        except (KeyError, TypeError) as error:
            what = f"{type(error).__name__}: {error}"
            raise InputError(f"the record of the stream is damaged ({what})") from None
        self._clock.origin, self._seen = origin, seen
        self._held, self._counters = held, counters

    # --- where a message belongs ------------------------------------------------------------------

    def _take(
        self, t: Time, values: NDArray[Any], mask: NDArray[np.bool_], measured: int
    ) -> Outcome:
        """Puts a message where it belongs: beside the rows, aside, or nowhere."""
        policies = self.policies
        if not self._history.rows:
            self._clock.origin = t
            return self._append(0.0, values, mask, measured)
        time = self._clock.seconds(t)
        ahead = time - self._history.newest
        if ahead < -policies.jump_back_s or ahead > (policies.jump_ahead_s or math.inf):
            return self._far(t, ahead, values, mask)
        if self._held:
            self._release()
        if abs(ahead) <= policies.merge_within_s:
            return self._join(len(self._history.rows) - 1, values, mask)
        if ahead > 0:
            return self._append(time, values, mask, measured)
        return self._late(time, values, mask)

    def _append(
        self, time: float, values: NDArray[Any], mask: NDArray[np.bool_], measured: int
    ) -> Outcome:
        """The next row."""
        gap = time - self._seen if measured and self._seen is not None else 0.0
        long = gap > self._long_gap
        if long and self.policies.long_gap == "reset":
            origin, floor = self._clock.origin, self._history.newest
            self.reset()
            self._clock.origin, self._history.floor = origin, floor
        if self._stepping:
            self._predicted = self._predict(np.array([time]))[0]
        self._history.append(time, values, mask)
        self._counters.rows += 1
        if measured:
            self._seen = time
            self._counters.long_gaps += long
            self._counters.longest_gap_s = max(self._counters.longest_gap_s, gap)
        return "new"

    def _join(self, i: int, values: NDArray[Any], mask: NDArray[np.bool_]) -> Outcome:
        """A message of the time of row i."""
        old = self._history.rows[i]
        twice = mask & old.mask
        repeated = bool(twice.any())
        if repeated and self.policies.duplicates == "error":
            raise InputError(
                f"measured twice at the time {self._clock.at(old.time)}: "
                f"{', '.join(np.array(self.names)[twice])}; choose the policy duplicates='first' "
                "or 'last' if that may be"
            )
        taken = mask if self.policies.duplicates == "last" else mask & ~old.mask
        joined, union = np.where(taken, values, old.values), old.mask | taken
        changed = not (np.array_equal(joined, old.values) and np.array_equal(union, old.mask))
        if changed:
            self._history.replace(i, joined, union)
            self._seen = max(old.time if self._seen is None else self._seen, old.time)
        self._counters.duplicates += repeated
        self._counters.merged += changed
        return "merged" if changed else "duplicate"

    def _late(self, time: float, values: NDArray[Any], mask: NDArray[np.bool_]) -> Outcome:
        """A message older than the newest row."""
        policies, behind = self.policies, self._history.newest - time
        if behind > (policies.stale_after_s or math.inf):
            return self._dropped("stale")
        if policies.late == "error":
            raise InputError(
                f"a message is {behind:g} s older than the newest row, of the time {self.time}; "
                "choose the policy late='drop' or 'reorder' if that may be"
            )
        place = self._history.place(time, policies.merge_within_s)
        if policies.late == "drop" or place is None:
            return self._dropped("late")
        i, joins = place
        if joins:
            return self._join(i, values, mask)
        self._history.insert(i, time, values, mask)
        if mask.any():
            self._seen = time if self._seen is None else max(self._seen, time)
        self._counters.rows += 1
        self._counters.reordered += 1
        return "reordered"

    # --- clocks that jump -------------------------------------------------------------------------

    def _far(self, t: Time, ahead: float, values: NDArray[Any], mask: NDArray[np.bool_]) -> Outcome:
        """A message so far off that the clock may have jumped."""
        policies = self.policies
        if policies.jump == "error":
            newer = "newer" if ahead > 0 else "older"
            raise InputError(
                f"a message is {abs(ahead):g} s {newer} than the newest row, of the time "
                f"{self.time}; choose another policy of jump if that may be"
            )
        if policies.jump == "drop":
            if ahead > 0:
                return self._dropped("ahead")
            return self._late(self._clock.seconds(t), values, mask)
        if self._held:
            step = self._between(t, self._held[-1].t)
            if not -policies.jump_back_s <= step <= (policies.jump_ahead_s or math.inf):
                self._release()
        self._held.append(_Message(t, values, mask))
        if len(self._held) < policies.confirm:
            return "held"
        held, self._held = sorted(self._held, key=lambda message: message.t), []
        self._counters.jumps_ahead += ahead > 0
        self._counters.jumps_back += ahead < 0
        if policies.jump == "reset":
            self.reset()
        else:
            self._clock.rebase(held[0].t, self._history.newest + self._pause)
        for message in held:
            self._take_held(message)
        return "jumped"

    def _take_held(self, message: _Message) -> None:
        """Consumes what was held; what a policy calls an error is dropped: it came long ago."""
        try:
            measured = int(np.count_nonzero(message.mask))
            self._take(message.t, message.values, message.mask, measured)
        except InputError:
            self._dropped("late")

    def _release(self) -> None:
        """The clock has not jumped: held messages are late ones, or too far ahead."""
        held, self._held = self._held, []
        for message in held:
            time = self._clock.seconds(message.t)
            if time > self._history.newest:
                self._dropped("ahead")
                continue
            try:
                self._late(time, message.values, message.mask)
            except InputError:
                self._dropped("late")

    # --- small things -----------------------------------------------------------------------------

    def _forget(self) -> None:
        self._history.forget()
        self._clock.origin = None
        self._held, self._seen = [], None

    def _dropped(self, outcome: Outcome) -> Outcome:
        setattr(self._counters, outcome, getattr(self._counters, outcome) + 1)
        return outcome

    def _predict(self, times: NDArray[np.float64]) -> NDArray[np.float64]:
        """(times, channels) in original units."""
        scaled = self._engine.predict(times)
        if not np.isfinite(scaled).all():
            raise DivergenceError("the state has left the finite numbers; reset the stream")
        self._counters.predictions += len(times)
        return self._frame.scaler.original(scaled)

    def _asked(self, t: Time) -> float:
        """A time that was asked for, in s."""
        if not self._history.rows:
            return 0.0
        time, newest = self._clock.seconds(t), self._history.newest
        if newest - time > self.policies.merge_within_s:
            raise InputError(
                f"asked for the time {t}, {newest - time:g} s before the newest row, of the time "
                f"{self.time}; a stream answers for the time of its newest row and later"
            )
        return max(time, newest)

    def _between(self, later: Time, earlier: Time) -> float:
        """Seconds from one time to another."""
        try:
            return (later - earlier) / self._clock.ticks
        except OverflowError:
            return math.inf if later > earlier else -math.inf
