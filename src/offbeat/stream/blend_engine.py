"""Runs a blend row by row: its baselines, and its model in an engine of its own."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from offbeat.answers.blend import Blend
from offbeat.stream.engine import Arrays, Engine

_MODEL, _STACK = "model.", "stack."


class BlendEngine(Engine):
    """Takes rows in original units, and predicts in original units, with intervals.

    Args:
        blend: fitted.
        model: runs its forward model; None where it has none.
    """

    def __init__(self, blend: Blend, model: Engine | None) -> None:
        self._blend, self._model = blend, model
        self._stack = blend.stack
        self._slots: list[dict[str, Any]] = []
        self._restart()

    def _restart(self) -> None:
        self._state: dict[str, Any] = self._stack.start(np.zeros((1, self._blend.channels)))

    @property
    def dtype(self) -> np.dtype[Any]:
        """Dtype of values in original units."""
        return np.dtype(np.float64)

    def reserve(self, slots: int) -> None:
        """Allocates slots for references; states are never modified in place."""
        self._slots = [self._state] * slots
        if self._model is not None:
            self._model.reserve(slots)

    def reset(self) -> None:
        """Resets the state."""
        self._restart()
        if self._model is not None:
            self._model.reset()

    def observe(self, time: float, values: NDArray[Any], mask: NDArray[np.bool_]) -> None:
        """Consumes one row."""
        values = self._blend.limited(values)
        after = self._stack.observe(
            self._state, np.array([[time]]), np.where(mask, values, 0.0)[None], mask[None]
        )
        if self._model is not None and self._blend.forward is not None:
            scaled = np.where(mask, self._blend.forward.scaler.scaled(values), 0.0)
            self._model.observe(time, scaled.astype(self._model.dtype), mask)
        self._state = after

    def predict(self, times: NDArray[np.float64]) -> NDArray[np.float64]:
        """(times, channels) in original units."""
        models = None
        if self._model is not None and self._blend.forward is not None:
            models = self._blend.forward.scaler.original(self._model.predict(times))
        rows = []
        for i, time in enumerate(times):
            base = self._stack.read(self._state, np.array([[time]]))
            kind = self._kind(time)
            values, _ = self._blend.corrected(
                base, None if models is None else models[i : i + 1], kind
            )
            rows.append(values[0])
        return np.array(rows)

    def half_widths(self, times: NDArray[np.float64], level: float) -> NDArray[np.float64]:
        """(times, channels) half widths of intervals, in original units.

        Args:
            times: as of `predict`.
            level: probability of the interval.
        """
        return np.array([self._blend.half_width(self._kind(time), level)[0] for time in times])

    def _kind(self, time: float) -> NDArray[np.float64]:
        kind: NDArray[np.float64] = self._stack.keys.read(self._state["keys"], np.array([[time]]))
        return kind

    def save(self, slot: int) -> None:
        """Keeps a reference to the state."""
        self._slots[slot] = self._state
        if self._model is not None:
            self._model.save(slot)

    def load(self, slot: int) -> None:
        """Restores a saved state."""
        self._state = self._slots[slot]
        if self._model is not None:
            self._model.load(slot)

    def export(self) -> Arrays:
        """The states of the baselines, and that of the model."""
        own = {_STACK + name: value.copy() for name, value in flat_state(self._state).items()}
        if self._model is None:
            return own
        return {**own, **{_MODEL + name: value for name, value in self._model.export().items()}}

    def restore(self, arrays: Arrays) -> None:
        """Restores a state from `export`."""
        if self._model is not None:
            self._model.restore(
                {k.removeprefix(_MODEL): v for k, v in arrays.items() if k.startswith(_MODEL)}
            )
        own = {k.removeprefix(_STACK): v for k, v in arrays.items() if k.startswith(_STACK)}
        self._state = like_state(self._state, own)

    def fingerprint(self) -> str:
        """Fingerprint of the model and of all tables."""
        digest = hashlib.sha256()
        if self._model is not None:
            digest.update(self._model.fingerprint().encode())
        for name, value in sorted(self._blend.arrays().items()):
            digest.update(name.encode() + np.ascontiguousarray(value).tobytes())
        return digest.hexdigest()


def flat_state(state: Mapping[str, Any], prefix: str = "") -> Arrays:
    """The arrays of nested states, by their names joined with slashes."""
    arrays: Arrays = {}
    for name, value in state.items():
        if isinstance(value, Mapping):
            arrays |= flat_state(value, f"{prefix}{name}/")
        else:
            arrays[prefix + name] = np.asarray(value)
    return arrays


def like_state(state: Mapping[str, Any], arrays: Arrays, prefix: str = "") -> dict[str, Any]:
    """The inverse of `flat_state`, for states nested like these."""
    return {
        name: like_state(value, arrays, f"{prefix}{name}/")
        if isinstance(value, Mapping)
        else arrays[prefix + name]
        for name, value in state.items()
    }
