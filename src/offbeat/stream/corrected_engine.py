"""Runs a model that corrects a baseline row by row: the baseline, and the inner model's engine."""

from __future__ import annotations

import hashlib
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from offbeat.baselines.history import History
from offbeat.models.corrected import CorrectedModel
from offbeat.stream.blend_engine import flat_state, like_state
from offbeat.stream.engine import Arrays, Engine

_INNER, _BASE = "inner.", "base."


class CorrectedEngine(Engine):
    """Takes scaled rows, and predicts in scaled units.

    Args:
        model: trained.
        inner: runs its inner model.
    """

    def __init__(self, model: CorrectedModel, inner: Engine) -> None:
        self._model, self._inner = model, inner
        self._history = History(1)
        self._slots: list[dict[str, Any]] = []
        self._restart()

    def _restart(self) -> None:
        empty = np.zeros((1, self._model.channels))
        self._state: dict[str, Any] = {
            "base": self._model.base.start(empty),
            "history": self._history.start(empty),
        }

    @property
    def dtype(self) -> np.dtype[Any]:
        """That of the inner engine."""
        return self._inner.dtype

    def reserve(self, slots: int) -> None:
        """Allocates slots for references; states are never modified in place."""
        self._slots = [self._state] * slots
        self._inner.reserve(slots)

    def reset(self) -> None:
        """Resets the state."""
        self._restart()
        self._inner.reset()

    def observe(self, time: float, values: NDArray[Any], mask: NDArray[np.bool_]) -> None:
        """Consumes one row."""
        original = np.where(mask, self._model.scaler.original(values.astype(np.float64)), 0.0)
        row = (np.array([[time]]), original[None], mask[None])
        after = {
            "base": self._model.base.observe(self._state["base"], *row),
            "history": self._history.observe(self._state["history"], *row),
        }
        self._inner.observe(time, values, mask)
        self._state = after

    def predict(self, times: NDArray[np.float64]) -> NDArray[np.float64]:
        """(times, channels) in scaled units."""
        outputs = torch.from_numpy(np.asarray(self._inner.predict(times), dtype=np.float64))
        bases, ages = [], []
        for time in times:
            at = np.array([[time]])
            bases.append(self._model.base.read(self._state["base"], at)[0])
            ages.append(History.age(self._state["history"], at)[0])
        base = torch.from_numpy(self._model.scaler.scaled(np.array(bases)))
        with torch.inference_mode():
            joined = self._model.joined(base, outputs, torch.from_numpy(np.array(ages)))
        return np.asarray(joined.numpy(), dtype=np.float64)

    def save(self, slot: int) -> None:
        """Keeps a reference to the state."""
        self._slots[slot] = self._state
        self._inner.save(slot)

    def load(self, slot: int) -> None:
        """Restores a saved state."""
        self._state = self._slots[slot]
        self._inner.load(slot)

    def export(self) -> Arrays:
        """The state of the baseline, and that of the inner model."""
        own = {_BASE + name: value.copy() for name, value in flat_state(self._state).items()}
        return {**own, **{_INNER + name: value for name, value in self._inner.export().items()}}

    def restore(self, arrays: Arrays) -> None:
        """Restores a state from `export`."""
        self._inner.restore(
            {k.removeprefix(_INNER): v for k, v in arrays.items() if k.startswith(_INNER)}
        )
        own = {k.removeprefix(_BASE): v for k, v in arrays.items() if k.startswith(_BASE)}
        self._state = like_state(self._state, own)

    def fingerprint(self) -> str:
        """Fingerprint of the inner model and of all tables."""
        digest = hashlib.sha256(self._inner.fingerprint().encode())
        for name, value in self._model.state_dict().items():
            digest.update(name.encode() + value.cpu().numpy().tobytes())
        return digest.hexdigest()
