"""Input transforms around an engine, row by row."""

from __future__ import annotations

import hashlib
import json
from dataclasses import fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from offbeat.data.scaler import Scaler
from offbeat.data.transforms import LiveTransforms, Transforms, TransformState
from offbeat.stream.engine import Arrays, Engine

_PREFIX = "transforms."


class TransformedEngine(Engine):
    """Takes rows as they were sent, in original units, and predicts in the same convention.

    Args:
        engine: takes scaled rows.
        transforms: of the model.
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
        """Of values in original units."""
        return np.dtype(np.float64)

    def reserve(self, slots: int) -> None:
        """Makes room for copies of the state."""
        self._engine.reserve(slots)
        self._slots = [self._state] * slots

    def reset(self) -> None:
        """Begins anew: no turns, no signs."""
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
        """Takes what `export` gave."""
        self._engine.restore({k: v for k, v in arrays.items() if not k.startswith(_PREFIX)})
        own = {k.removeprefix(_PREFIX): v for k, v in arrays.items() if k.startswith(_PREFIX)}
        self._state = TransformState(**own)

    def fingerprint(self) -> str:
        """Of the engine and the transforms."""
        record = json.dumps(self._transforms.to_dict(), sort_keys=True)
        return hashlib.sha256((self._engine.fingerprint() + record).encode()).hexdigest()
