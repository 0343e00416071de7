"""Input transforms around an engine, row by row."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from offbeat.data.scaler import Scaler
from offbeat.data.transforms import (
    NO_LENGTH,
    Mask,
    Transforms,
    Values,
    in_range,
    into_range,
    lengths,
    unit_quaternions,
)
from offbeat.stream.engine import Arrays, Engine

_PREFIX = "transforms."


@dataclass(frozen=True, eq=False)
class TransformState:
    """State of the transforms between rows.

    Attributes:
        angle: (angles,) the last observation of each angle as it was sent; NaN before the first.
        turns: (angles,) number of turns removed from it.
        in_range: (angles,) whether all observations so far lay in the range of the sensor.
        quaternion: (quaternions, 4) the last observation, of length 1; NaN before the first.
        sign: (quaternions,) 1 or -1, applied to it.
    """

    angle: Values
    turns: Values
    in_range: Mask
    quaternion: Values
    sign: Values


class LiveTransforms:
    """Applies `Transforms` row by row; takes and returns the state.

    Args:
        transforms: input transforms of the model.
        names: channels of a row, in order.
    """

    def __init__(self, transforms: Transforms, names: Sequence[str]) -> None:
        transforms = transforms.restricted(names)
        angles, fours = transforms.angles, transforms.quaternions
        self._angles = np.array([names.index(name) for name in angles], dtype=np.int64)
        self._periods = np.array([angle.period for angle in angles.values()])
        self._lowest = np.array(
            [np.nan if angle.lowest is None else angle.lowest for angle in angles.values()]
        )
        self._fours = [[names.index(name) for name in four] for four in fours]
        self._missing = [(names.index(name), marks) for name, marks in transforms.missing.items()]
        self._left_out = [names.index(name) for name in transforms.left_out]
        self._constants = [(names.index(name), x) for name, x in transforms.constants.items()]
        self._copies = [
            (names.index(one), names.index(of)) for one, of in transforms.copies.items()
        ]

    def start(self) -> TransformState:
        """Returns the state before the first observation."""
        angles, quaternions = len(self._angles), len(self._fours)
        return TransformState(
            np.full(angles, np.nan),
            np.zeros(angles),
            ~np.isnan(self._lowest),
            np.full((quaternions, 4), np.nan),
            np.ones(quaternions),
        )

    def apply(
        self, values: Values, mask: Mask, state: TransformState
    ) -> tuple[Values, Mask, TransformState]:
        """Transforms a row.

        Args:
            values: (channels,) as sent, in original units.
            mask: (channels,) True where observed.
            state: after the row before.

        Returns:
            Values and mask for the model, and the state after the row.
        """
        values, mask = values.copy(), mask.copy()
        for c, marks in self._missing:
            mask[c] &= values[c] not in marks
        mask[self._left_out] = False
        sent, seen = values[self._angles], mask[self._angles]
        step = np.where(seen & ~np.isnan(state.angle), sent - state.angle, 0.0)
        turns = state.turns + np.round(step / self._periods)
        values[self._angles] = np.where(seen, sent - self._periods * turns, sent)
        inside = in_range(sent, self._lowest, self._periods)
        last, signs = state.quaternion.copy(), state.sign.copy()
        for k, four in enumerate(self._fours):
            own = mask[four]
            if own.all():
                unit = unit_quaternions(values[four][None])[0]
                if lengths(values[four][None])[0] <= NO_LENGTH:
                    mask[four] = False
                    continue
                if (unit * last[k]).sum() < 0:
                    signs[k] = -signs[k]
                last[k], values[four] = unit, unit * signs[k]
            elif own.any():
                values[four] = values[four] * signs[k]
        return (
            values,
            mask,
            TransformState(
                np.where(seen, sent, state.angle),
                turns,
                state.in_range & (inside | ~seen),
                last,
                signs,
            ),
        )

    def undo(self, predicted: Values, state: TransformState) -> Values:
        """Converts predictions back to the convention of the sent values.

        Args:
            predicted: (times, channels) in original units.
            state: after the newest row.
        """
        values = predicted.copy()
        back = predicted[:, self._angles] + self._periods * state.turns
        values[:, self._angles] = np.where(
            state.in_range, into_range(back, self._lowest, self._periods), back
        )
        for four in self._fours:
            values[:, four] = unit_quaternions(values[:, four])
        for c, constant in self._constants:
            values[:, c] = constant
        for c, source in self._copies:
            values[:, c] = values[:, source]
        return values

    def undo_widths(self, widths: Values) -> Values:
        """Half widths of the predictions that `undo` gives.

        Args:
            widths: (times, channels) in original units.
        """
        widths = widths.copy()
        for c, _ in self._constants:
            widths[:, c] = 0.0
        for c, source in self._copies:
            widths[:, c] = widths[:, source]
        return widths


class TransformedEngine(Engine):
    """Takes rows as sent, in original units, and predicts in the same convention.

    Args:
        engine: takes scaled rows.
        transforms: input transforms of the model.
        names: of the channels, in the order of the model.
        scaler: maps original units to those of the engine.
    """

    def __init__(
        self, engine: Engine, transforms: Transforms, names: tuple[str, ...], scaler: Scaler
    ) -> None:
        self._engine, self._transforms, self._scaler = engine, transforms, scaler
        self._live = LiveTransforms(transforms, names)
        self._state = self._live.start()
        self._slots: list[TransformState] = []

    @property
    def dtype(self) -> np.dtype[Any]:
        """Dtype of values in original units."""
        return np.dtype(np.float64)

    def reserve(self, slots: int) -> None:
        """Allocates slots for copies of the state."""
        self._engine.reserve(slots)
        self._slots = [self._state] * slots

    def reset(self) -> None:
        """Resets the state and the transforms."""
        self._engine.reset()
        self._state = self._live.start()

    def observe(self, time: float, values: NDArray[Any], mask: NDArray[np.bool_]) -> None:
        """Transforms and scales one row, and consumes it."""
        values, mask, state = self._live.apply(values, mask, self._state)
        scaled = np.where(mask, self._scaler.scaled(values), 0.0)
        self._engine.observe(time, scaled.astype(self._engine.dtype), mask)
        self._state = state

    def predict(self, times: NDArray[np.float64]) -> NDArray[np.float64]:
        """(times, channels) in original units, in the convention of what was sent."""
        predicted = self._scaler.original(self._engine.predict(times))
        return self._live.undo(predicted, self._state)

    def half_widths(self, times: NDArray[np.float64], level: float) -> NDArray[np.float64] | None:
        """Those of the engine; 0 for channels that are given back as they were in training."""
        widths = self._engine.half_widths(times, level)
        return None if widths is None else self._live.undo_widths(widths)

    def save(self, slot: int) -> None:
        """Copies the state to a slot."""
        self._engine.save(slot)
        self._slots[slot] = self._state

    def load(self, slot: int) -> None:
        """Copies a slot to the state."""
        self._engine.load(slot)
        self._state = self._slots[slot]

    def export(self) -> Arrays:
        """The state of the engine, and that of the transforms."""
        own = {_PREFIX + f.name: getattr(self._state, f.name).copy() for f in fields(self._state)}
        return {**self._engine.export(), **own}

    def restore(self, arrays: Arrays) -> None:
        """Restores a state from `export`."""
        self._engine.restore({k: v for k, v in arrays.items() if not k.startswith(_PREFIX)})
        own = {k.removeprefix(_PREFIX): v for k, v in arrays.items() if k.startswith(_PREFIX)}
        self._state = TransformState(**own)

    def fingerprint(self) -> str:
        """Fingerprint of the engine and the transforms."""
        record = json.dumps(self._transforms.to_dict(), sort_keys=True)
        return hashlib.sha256((self._engine.fingerprint() + record).encode()).hexdigest()
