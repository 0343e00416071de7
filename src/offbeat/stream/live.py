"""A stream of messages in any order, for any engine."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from offbeat.data.scaler import Scaler
from offbeat.data.trajectory import EXOGENOUS
from offbeat.data.transforms import Transforms
from offbeat.errors import DivergenceError, InputError
from offbeat.stream.engine import Engine
from offbeat.stream.in_order import InOrder, is_plain
from offbeat.stream.messages import RowReader, Time, Values
from offbeat.stream.options import Outcome, StreamCounters, StreamOptions
from offbeat.stream.placing import Placement
from offbeat.stream.transformed import TransformedEngine

FORMAT = "offbeat-stream"
VERSION = 2


@dataclass(frozen=True)
class StreamInfo:
    """Properties of a model that a stream needs.

    Attributes:
        names: of the channels.
        units: of the channels.
        scaler: maps original units to those of the engine.
        median_gap: s, between the rows of the training set.
        elapsed_limit: s without an observation, at which the model's time saturates.
        transforms: input transforms of the model.
        roles: of the channels; predictions of exogenous ones are NaN. Empty: all are states.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    scaler: Scaler
    median_gap: float
    elapsed_limit: float
    transforms: Transforms = Transforms()  # noqa: RUF009  # frozen
    roles: tuple[str, ...] = ()


class LiveStream:
    """Feeds messages to an engine, one row at a time; base of `Stream` and `OnnxStream`.

    Memory does not grow. Not thread-safe: calls must not overlap.

    Args:
        engine: runs the model.
        info: about the model.
        options: what to do with messages out of order.
        time_unit: of all times given: s, ms, us or ns.
    """

    def __init__(
        self, engine: Engine, info: StreamInfo, *, options: StreamOptions, time_unit: str
    ) -> None:
        self.names, self.units, self.options = info.names, info.units, options
        transformed = not info.transforms.is_identity
        self._reader = RowReader(info.names, info.scaler, engine.dtype, scale=not transformed)
        given_back = {*info.transforms.constants, *info.transforms.copies}
        self._exogenous = [
            i
            for i, (name, role) in enumerate(zip(info.names, info.roles, strict=False))
            if role == EXOGENOUS and name not in given_back
        ]
        self._scaler = Scaler.identity(len(info.names)) if transformed else info.scaler
        if transformed:
            engine = TransformedEngine(engine, info.transforms, info.names, info.scaler)
        self._engine = engine
        self._placing = Placement(
            engine,
            options,
            names=info.names,
            time_unit=time_unit,
            median_gap=info.median_gap,
            elapsed_limit=info.elapsed_limit,
        )
        self._clock = self._placing.clock
        self._in_order = InOrder(
            self._placing, self._reader, self._scaler, options, self._exogenous
        )

    def __repr__(self) -> str:
        newest = "" if self.time is None else f", newest row at {self.time} {self.time_unit}"
        return f"{type(self).__name__}({len(self.names)} channels{newest})"

    @property
    def time_unit(self) -> str:
        """Unit of all times given to this stream."""
        return self._clock.unit

    @property
    def time(self) -> Time | None:
        """Time of the newest row, in the unit of the stream; None before the first."""
        newest = self._in_order.newest
        return None if newest is None else self._clock.at(newest)

    def after(self, horizon_s: float) -> Time | None:
        """The time `horizon_s` after the newest row; None before the first."""
        newest = self._in_order.newest
        return None if newest is None else self._clock.at(newest + horizon_s)

    @property
    def counters(self) -> StreamCounters:
        """A copy of the counters."""
        self._in_order.close()
        counters = replace(self._placing.counters)
        self._in_order.open()
        return counters

    @property
    def recoveries(self) -> int:
        """Number of times the state was no longer finite and was reset."""
        return self._placing.counters.recoveries

    @property
    def pending(self) -> int:
        """Number of messages that wait until it is clear whether the clock jumped."""
        return len(self._placing.pending)

    def observe(self, t: Time, values: Values, *, now: Time | None = None) -> Outcome:
        """Consumes the values measured at a time.

        Args:
            t: in the unit of the stream; an integer is exact.
            values: channel to value, or one value per channel, in original units. NaN, None and
                channels that are left out were not measured.
            now: time of arrival, for `stale_after_s`.

        Returns:
            What was done with the message.

        Raises:
            InputError: a time that is not a finite number, an unknown channel, a value that is not
                a number, or what the options call an error. The stream has not changed then.
            DivergenceError: an adaptive solver could not reach its tolerance, not even from a reset
                state.
        """
        t = t if is_plain(t) else self._clock.read(t)
        stale = now is not None and self._is_stale(t, now)
        outcome = None if stale else self._in_order.observe(t, values)
        return outcome or self._place(t, values, stale=stale)

    def step(
        self, t: Time, values: Values, *, now: Time | None = None
    ) -> tuple[Outcome, NDArray[np.float64] | None]:
        """Predicts a row, then observes it.

        Args:
            t: as in `observe`.
            values: as in `observe`; the prediction does not depend on them.
            now: as in `observe`.

        Returns:
            What was done with the message; and for a `new` row, (channels,) predicted for
            it in original units, one step ahead.

        Raises:
            InputError: as `observe`.
            DivergenceError: as `observe` and `predict`.
        """
        t = t if is_plain(t) else self._clock.read(t)
        stale = now is not None and self._is_stale(t, now)
        done = None if stale else self._in_order.step(t, values)
        if done is not None:
            return done
        predicted: list[NDArray[np.float64]] = []

        def before_row(time: float) -> None:
            predicted.append(self._predict(np.array([time]), next_row=True)[0])

        self._placing.before_row = before_row
        try:
            outcome = self._place(t, values, stale=stale)
        finally:
            self._placing.before_row = None
        return outcome, predicted[-1] if outcome == "new" else None

    def _is_stale(self, t: Time, now: Time) -> bool:
        waited = self._clock.between(self._clock.read(now), self._clock.read(t))
        return waited > (self.options.stale_after_s or math.inf)

    def _place(self, t: Time, values: Values, *, stale: bool) -> Outcome:
        """Consumes any message."""
        t = self._clock.read(t)
        row, mask, measured, not_finite = self._reader.read(values)
        self._in_order.close()
        try:
            if stale:
                outcome = self._placing.drop("stale")
            else:
                outcome = self._placing.take(t, row, mask, measured)
            counters = self._placing.counters
            counters.messages += 1
            counters.not_finite += not_finite
            counters.empty += measured == 0
        finally:
            self._in_order.open()
        return outcome

    def predict(self, t: Time | ArrayLike) -> NDArray[np.float64]:
        """Predicts the channels at a time from all observations; does not change the state.

        This is the prediction of the batch pass for a row at this time, if it is the next one.
        At the time of the newest row, the values of that row are known already. Several times are
        independent: each is predicted as if it were the only one. A state that is no longer finite
        is reset, and counted in `recoveries`.

        Args:
            t: in the unit of the stream, not before the newest row; or an array of times.

        Returns:
            (channels,) in original units, or (times, channels).

        Raises:
            InputError: a time that is not a finite number, or is before the newest row.
            DivergenceError: the prediction is not finite, although the state is.
        """
        if isinstance(t, np.ndarray) and t.ndim == 0:
            t = t[()]
        if is_plain(t) and (quick := self._in_order.predict(t)) is not None:  # type: ignore[arg-type]
            return quick
        several = isinstance(t, list | tuple | np.ndarray)
        asked = [self._asked(self._clock.read(one)) for one in (t if several else [t])]  # type: ignore[union-attr]
        if not asked:
            return np.empty((0, len(self.names)))
        predicted = self._predict(np.array(asked))
        return predicted if several else predicted[0]

    def interval(
        self, t: Time | ArrayLike, level: float = 0.9
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """The interval around `predict` that holds the true value with a probability.

        Args:
            t: as of `predict`.
            level: the probability, at most 0.98.

        Returns:
            Lower and upper end, each of the shape that `predict` returns.

        Raises:
            InputError: as `predict`, the level is out of range, or the model has no intervals.
        """
        predicted = self.predict(t)
        half = self.half_width(t, level).reshape(predicted.shape)
        return predicted - half, predicted + half

    def half_width(self, t: Time | ArrayLike, level: float = 0.9) -> NDArray[np.float64]:
        """(times, channels) half the width of `interval`; the arguments are the same."""
        asked = [
            self._asked(self._clock.read(one)) for one in np.atleast_1d(np.asarray(t)).tolist()
        ]
        half = self._engine.half_widths(np.array(asked), level)
        if half is None:
            raise InputError(
                "this stream runs a model alone, whose predictions have no intervals; run a blend "
                "(the folder of offbeat train)"
            )
        half[:, self._exogenous] = np.nan
        return half

    @property
    def has_intervals(self) -> bool:
        """Whether predictions have intervals."""
        return self._engine.half_widths(np.zeros(0), 0.5) is not None

    def reset(self) -> None:
        """Resets the state. The counters keep their values."""
        self._in_order.close()
        self._placing.reset()

    def state(self) -> dict[str, Any]:
        """State of the stream as a JSON-like record; `restore` continues from it bit for bit."""
        self._in_order.close()
        record = {
            "format": FORMAT,
            "version": VERSION,
            "model": self._engine.fingerprint(),
            "time_unit": self.time_unit,
            **self._placing.record(),
        }
        self._in_order.open()
        return record

    def restore(self, record: dict[str, Any]) -> None:
        """Continues from a record of `state`. The options of this stream are kept.

        Raises:
            InputError: the record is damaged, or of another model or time unit. The stream has not
                changed then.
        """
        if not isinstance(record, dict) or record.get("format") != FORMAT:
            raise InputError(f"this is no record of a stream (it has no format {FORMAT!r})")
        for key, expected, fix in (
            ("version", VERSION, "use the version of Offbeat that wrote it"),
            ("model", self._engine.fingerprint(), "restore it with the model that wrote it"),
            ("time_unit", self.time_unit, "give this stream the time unit of the record"),
        ):
            if record.get(key) != expected:
                got = record.get(key)
                raise InputError(f"the record is of {key} {got!r}, not {expected!r}; {fix}")
        self._in_order.close()
        try:
            self._placing.restore(record)
        finally:
            self._in_order.open()

    def _predict(
        self, times: NDArray[np.float64], *, next_row: bool = False
    ) -> NDArray[np.float64]:
        """(times, channels) in original units.

        Args:
            times: s.
            next_row: whether the row of that time is observed next; the state has to go on there.
        """
        predicted = self._engine.predict(times)
        if not np.isfinite(predicted).all():
            self._in_order.close()
            rows = self._placing.history.rows
            newest = [rows[-1].time] if rows else []
            if not next_row and np.isfinite(self._engine.predict(np.array(newest))).all():
                raise DivergenceError(
                    "a prediction is not finite, although the state of the stream is; ask for an "
                    "earlier time, or train the model with a lower learning rate"
                )
            self._placing.recover()
            predicted = self._engine.predict(times)
        if not np.isfinite(predicted).all():
            raise DivergenceError("the model predicts no finite numbers from its first state")
        self._placing.counters.predictions += len(times)
        predicted = self._scaler.original(predicted)
        predicted[:, self._exogenous] = np.nan
        return predicted

    def _asked(self, t: Time) -> float:
        """A time to predict at, in s."""
        newest = self._in_order.newest
        if newest is None:
            return 0.0
        time = self._clock.seconds(t)
        if newest - time > self.options.merge_within_s:
            raise InputError(
                f"asked for the time {t}, {newest - time:g} s before the newest row, of the time "
                f"{self.time}; a stream predicts at the time of its newest row and later"
            )
        return max(time, newest)
