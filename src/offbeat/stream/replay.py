"""Runs a model without a recurrent state on the newest rows, again for each prediction."""

from __future__ import annotations

import hashlib
import json
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from offbeat.data.batch import Batch
from offbeat.data.trajectory import Trajectory
from offbeat.models.base import BaseModel
from offbeat.stream.engine import Arrays, Engine


class ReplayEngine(Engine):
    """Keeps the newest rows, and runs the model on them and the row to predict.

    Args:
        model: its weights are used as they are when a prediction is made.
        window: rows that are kept, 1 or more; older ones no longer matter.
    """

    def __init__(self, model: BaseModel, *, window: int) -> None:
        self._model, self._window = model, window
        self._slots: list[Arrays] = []
        self.reset()

    @property
    def dtype(self) -> np.dtype[Any]:
        """Dtype of the model's parameters."""
        return np.dtype(str(self._model.dtype).removeprefix("torch."))

    def reserve(self, slots: int) -> None:
        """Allocates slots for references; arrays are never modified in place."""
        self._slots = [{}] * slots

    def reset(self) -> None:
        """Drops all rows."""
        shape = (0, self._model.channels)
        self._rows: Arrays = {
            "time": np.zeros(0),
            "values": np.zeros(shape, self.dtype),
            "mask": np.zeros(shape, dtype=bool),
        }

    def observe(self, time: float, values: NDArray[Any], mask: NDArray[np.bool_]) -> None:
        """Adds a row, and drops the oldest one of a full window."""
        new = {"time": np.array(time), "values": values, "mask": mask}
        self._rows = {
            name: np.concatenate([rows[-self._window + 1 :] if self._window > 1 else rows[:0],
                                  new[name][None]])
            for name, rows in self._rows.items()
        }  # fmt: skip

    def predict(self, times: NDArray[np.float64]) -> NDArray[np.float64]:
        """Predicts each time as an unobserved last row of a trajectory of its own."""
        seen, channels = self._rows["mask"], self._model.channels
        known = np.where(seen, self._rows["values"].astype(np.float64), np.nan)
        values = np.concatenate([known, np.full((1, channels), np.nan)])
        newest = self._rows["time"][-1:]
        asked = np.maximum(times, np.nextafter(newest, np.inf)) if len(newest) else times
        batch = Batch.of(
            [Trajectory(np.append(self._rows["time"], time), values) for time in asked],
            dtype=self._model.dtype,
            roles=self._model.roles,
        ).to(self._model.device)
        with torch.inference_mode():
            mean: torch.Tensor = self._model(batch).mean
        return np.asarray(mean[:, -1].double().cpu().numpy())

    def save(self, slot: int) -> None:
        """Keeps a reference to the rows."""
        self._slots[slot] = self._rows

    def load(self, slot: int) -> None:
        """Restores saved rows."""
        self._rows = self._slots[slot]

    def export(self) -> Arrays:
        """The rows, padded at the start to a full window, and their number."""
        rows = len(self._rows["time"])
        padded = {
            name: np.concatenate(
                [np.zeros((self._window - rows, *part.shape[1:]), part.dtype), part]
            )
            for name, part in self._rows.items()
        }
        return {**padded, "rows": np.array(rows)}

    def restore(self, arrays: Arrays) -> None:
        """Restores a state from `export`."""
        rows = min(max(int(arrays["rows"]), 0), self._window)
        self._rows = {name: arrays[name][self._window - rows :] for name in self._rows}

    def fingerprint(self) -> str:
        """Fingerprint of the class and the tensors."""
        record = [self._model.name, str(self._model.dtype), self._window]
        digest = hashlib.sha256(json.dumps(record).encode())
        for name, tensor in sorted(self._model.state_dict().items()):
            digest.update(name.encode() + tensor.detach().cpu().contiguous().numpy().tobytes())
        return digest.hexdigest()
