"""Runs a recurrent model row by row with its forward pass, as batches of one row."""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict, dataclass, fields, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from offbeat.data.batch import Batch
from offbeat.data.trajectory import ACTION
from offbeat.models.elapsed import RecurrentState
from offbeat.models.model import Model
from offbeat.stream.engine import Arrays, Engine


@dataclass(frozen=True, eq=False)
class _State:
    """A recurrent state, and the state of its generator at that time."""

    past: RecurrentState
    generator: Tensor | None


class TorchEngine(Engine):
    """The reference engine: calls `model(row, past=...)`.

    Args:
        model: its weights are used as they are when a row comes.
        seed: of the generator of self-feeding.
    """

    def __init__(self, model: Model, *, seed: int = 0) -> None:
        self._model, self._seed = model, seed
        self._valid = torch.ones((1, 1), dtype=torch.bool)
        self._slots: list[_State | None] = []
        self.reset()

    @property
    def dtype(self) -> np.dtype[Any]:
        """Dtype of the model's weights."""
        return np.dtype(str(self._model.dtype).removeprefix("torch."))

    def reserve(self, slots: int) -> None:
        """Allocates slots for references; states are never modified in place."""
        self._slots = [None] * slots

    def reset(self) -> None:
        """Resets the state and the generator."""
        feeding = bool(self._model.config.self_feeding)
        generator = torch.Generator().manual_seed(self._seed) if feeding else None
        with torch.inference_mode():
            self._past = self._model.empty_state(1, generator=generator)
            if self._model.acts:  # so that all states have the same parts
                nothing = torch.full_like(self._past.last, torch.nan)
                self._past = replace(self._past, actions=nothing)

    def observe(self, time: float, values: NDArray[Any], mask: NDArray[np.bool_]) -> None:
        """Consumes one row."""
        before = self._state()
        seen = torch.tensor(mask)[None, None]
        row = Batch(
            torch.tensor([[time]], dtype=torch.float64),
            torch.tensor(values, dtype=self._model.dtype)[None, None],
            seen,
            seen,
            self._valid,
            self._model.roles,
        )
        try:
            with torch.inference_mode():
                self._past = self._model(row.to(self._model.device), past=self._past).past
        except Exception:
            self._take(before)
            raise

    def predict(self, times: NDArray[np.float64]) -> NDArray[np.float64]:
        """Predicts each time as a trajectory of its own, all from the current state."""
        count, channels = len(times), self._model.channels
        unseen = torch.zeros((count, 1, channels), dtype=torch.bool)
        asked = Batch(
            torch.tensor(times)[:, None],
            torch.zeros((count, 1, channels), dtype=self._model.dtype),
            unseen,
            unseen,
            self._valid.expand(count, 1),
            self._model.roles,
        )
        expanded = {
            name: part.expand(count, *part.shape[1:]) for name, part in _tensors(self._past).items()
        }
        past = replace(self._past, **expanded)  # type: ignore[arg-type]
        if past.generator is not None:  # it acts after the prediction
            past = replace(past, generator=torch.Generator())
        with torch.inference_mode():
            output = self._model(asked.to(self._model.device), past=past)
            predicted: Tensor = output.mean[:, 0]
            if self._model.acts:  # an action is read after the observation of its own row
                now = (torch.tensor(times) == self._past.time.cpu())[:, None]
                acts = torch.tensor([role == ACTION for role in self._model.roles])
                kept = (self._past.observed_at == self._past.time) | (not self._model.spec.nodes)
                state = torch.where(kept[:, None], self._past.state, output.before[:, 0])
                acting = self._model.head.decode(state).mean
                predicted = torch.where((now & acts).to(predicted.device), acting, predicted)
            return predicted.double().cpu().numpy()

    def save(self, slot: int) -> None:
        """Keeps a reference to the state."""
        self._slots[slot] = self._state()

    def load(self, slot: int) -> None:
        """Restores a saved state."""
        kept = self._slots[slot]
        if kept is None:
            raise ValueError(f"nothing was saved in slot {slot}")
        self._take(kept)

    def export(self) -> Arrays:
        """The parts of the recurrent state by name, `rows`, and `generator` where there is one."""
        state = self._state()
        arrays = {name: part.cpu().numpy().copy() for name, part in _tensors(state.past).items()}
        arrays["rows"] = np.array(state.past.rows, dtype=np.int64)
        if state.generator is not None:
            arrays["generator"] = state.generator.numpy().copy()
        return arrays

    def restore(self, arrays: Arrays) -> None:
        """Restores the parts of a recurrent state."""
        device = self._model.device
        parts: dict[str, Any] = {
            name: torch.tensor(arrays[name], device=device) for name in _tensors(self._past)
        }
        past = replace(self._past, rows=int(arrays["rows"]), **parts)
        generator = torch.tensor(arrays["generator"]) if "generator" in arrays else None
        self._take(_State(past, generator))

    def fingerprint(self) -> str:
        """Fingerprint of config, statistics, scaler, channels and weights."""
        model = self._model
        record = {
            "model": asdict(model.config),
            "statistics": model.statistics.to_dict(),
            "scaler": model.scaler.to_dict(),
            "names": model.names,
            "units": model.units,
            "dtype": str(model.dtype),
        }
        digest = hashlib.sha256(json.dumps(record, sort_keys=True).encode())
        for name, weight in sorted(model.state_dict().items()):
            digest.update(name.encode() + weight.detach().cpu().contiguous().numpy().tobytes())
        return digest.hexdigest()

    def _state(self) -> _State:
        generator = self._past.generator
        return _State(self._past, None if generator is None else generator.get_state())

    def _take(self, state: _State) -> None:
        self._past = state.past
        if state.generator is not None and state.past.generator is not None:
            state.past.generator.set_state(state.generator)


def _tensors(past: RecurrentState) -> dict[str, Tensor]:
    parts = {field.name: getattr(past, field.name) for field in fields(past)}
    return {name: part for name, part in parts.items() if isinstance(part, Tensor)}
