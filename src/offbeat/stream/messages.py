"""Converts messages to the input of a model: times to seconds, values to scaled rows."""

from __future__ import annotations

import math
import operator
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from offbeat.data.arrays import without_mask
from offbeat.data.scaler import Scaler
from offbeat.data.trajectory import SECONDS_PER
from offbeat.errors import InputError, one_of

Time = int | float
"""In the unit of a stream; integers are exact for any origin of their clock."""

Values = Mapping[str, float | None] | ArrayLike
"""Channel to value, or one value per channel; NaN, None and what is left out was not measured."""

_EXACT = 2.0**53
"""From this number on, the spacing of floats is more than 1."""


class Clock:
    """Converts times of a unit to seconds since an origin.

    A float64 cannot hold nanoseconds since 1970, so integers are subtracted as integers.

    Args:
        unit: s, ms, us or ns.

    Raises:
        InputError: an unknown unit.
    """

    def __init__(self, unit: str) -> None:
        self.unit = one_of("time unit", unit, [u for u, s in SECONDS_PER.items() if s <= 1])
        # Dividing by the exact 1000 rounds once; multiplying by the inexact 0.001 rounds twice.
        self.ticks = round(1 / SECONDS_PER[unit])
        self.origin: Time | None = None

    def read(self, t: Any) -> Time:
        """Checks a time and returns it as a plain number.

        Raises:
            InputError: it is not a finite number, or a float too large to be exact.
        """
        if type(t) is not float:
            # A timedelta64 is an integer in a unit of its own.
            if isinstance(t, bool | np.bool_ | np.datetime64 | np.timedelta64):
                raise InputError(f"a time must be a number in {self.unit}, got {t!r}")
            try:
                return int(operator.index(t))
            except TypeError:
                pass
            if not isinstance(t, float | np.floating):
                raise InputError(f"a time must be a number in {self.unit}, got {t!r}")
        number = float(t)
        if -_EXACT < number < _EXACT:
            return number
        if not math.isfinite(number):
            raise InputError(f"a time must be finite, got {t!r}")
        raise InputError(
            f"a float does not hold {t!r} {self.unit} to the last digit; give an integer"
        )

    def seconds(self, t: Time) -> float:
        """Seconds since the origin; 0 if there is none.

        Raises:
            InputError: too far away to be given in seconds.
        """
        if self.origin is None:
            return 0.0
        try:
            return (t - self.origin) / self.ticks
        except OverflowError:
            raise InputError(f"the time {t} is too far away to be given in seconds") from None

    def at(self, seconds: float) -> Time:
        """The inverse of `seconds`, to the nearest tick where the origin is an integer."""
        origin = self.origin or 0
        ticks = seconds * self.ticks
        return origin + (round(ticks) if isinstance(origin, int) and self.ticks > 1 else ticks)

    def between(self, later: Time, earlier: Time) -> float:
        """Seconds from one time to another; infinite beyond the range of floats."""
        try:
            return (later - earlier) / self.ticks
        except OverflowError:
            return math.inf if later > earlier else -math.inf

    def rebase(self, t: Time, seconds: float) -> None:
        """Moves the origin so that `t` is `seconds` after it."""
        ticks = seconds * self.ticks
        exact = isinstance(t, int) and self.ticks > 1
        self.origin = t - (round(ticks) if exact else ticks)


class RowReader:
    """Converts values in original units to one scaled row and its mask.

    Args:
        names: of the channels, in the order of the model.
        scaler: maps original units to scaled ones.
        dtype: of the scaled row.
        scale: whether rows are scaled; else they stay in original units, as float64.
    """

    def __init__(
        self, names: Sequence[str], scaler: Scaler, dtype: np.dtype[Any], *, scale: bool = True
    ) -> None:
        self.names = tuple(names)
        self._index = {name: i for i, name in enumerate(self.names)}
        self._scaler, self._dtype, self._scale = scaler, dtype, scale
        # Values between these stay finite when scaled; no comparison with NaN is true.
        largest = np.finfo(np.float64).max / 4
        with np.errstate(over="ignore"):
            reach = np.minimum(0.99 * float(np.finfo(dtype).max) * np.abs(scaler.scale), largest)
        self._low, self._high = self.reach = np.stack([scaler.shift - reach, scaler.shift + reach])
        """(2, channels) in original units; values between these count as measured."""

    def read(self, values: Values) -> tuple[NDArray[Any], NDArray[np.bool_], int, int]:
        """A row (0 where not measured), its mask, and two counts.

        The counts are of values that were measured, and of values that were not finite, or too
        large when scaled, and count as not measured.

        Raises:
            InputError: unknown channels, another number of them, or something that is not a number.
        """
        raw = self._named(values) if isinstance(values, Mapping) else self._all(values)
        mask = (raw >= self._low) & (raw <= self._high)
        measured, not_finite = int(np.count_nonzero(mask)), 0
        if measured < len(mask):
            not_finite = len(mask) - measured - int(np.count_nonzero(np.isnan(raw)))
            raw = np.where(mask, raw, self._scaler.shift if self._scale else 0.0)
        if not self._scale:
            return raw, mask, measured, not_finite
        return self._scaler.scaled(raw).astype(self._dtype), mask, measured, not_finite

    def _named(self, values: Mapping[str, Any]) -> NDArray[np.float64]:
        raw = np.full(len(self.names), np.nan)
        for name, value in values.items():
            i = self._index.get(name)
            if i is None:
                one_of("channel", name, self.names)
            elif value is not None:
                raw[i] = value if type(value) is float else _number(name, value)
        return raw

    def _all(self, values: Any) -> NDArray[np.float64]:
        try:
            raw = np.asarray(without_mask(values, "values"))
            if isinstance(values, list | tuple) and any(isinstance(v, bool) for v in values):
                raise TypeError("one is True or False")
            if raw.dtype.kind not in "fiuO":
                raise TypeError(f"they are {raw.dtype}")
            if raw.dtype.kind == "O":
                raw = np.array([_number(f"number {i}", v) for i, v in enumerate(values)])
            raw = raw.astype(np.float64, copy=False)
        except (TypeError, ValueError) as error:
            if isinstance(error, InputError):
                raise
            raise InputError(
                f"values must be a mapping of channel to number, or an array of numbers ({error})"
            ) from None
        if raw.shape != (len(self.names),):
            raise InputError(
                f"values have shape {raw.shape}, expected ({len(self.names)},), one per channel: "
                f"{', '.join(self.names)}; give NaN where nothing was measured, or a mapping"
            )
        return raw


def _number(what: str, value: Any) -> float:
    if value is None:
        return math.nan
    if isinstance(value, int | float | np.integer | np.floating) and not isinstance(value, bool):
        try:
            return float(value)
        except OverflowError:
            return math.inf
    raise InputError(f"the value of {what} must be a number, or None, got {value!r}")
