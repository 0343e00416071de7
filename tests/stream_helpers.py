"""An engine that only remembers what it was given: what a stream consumed is then plain to see."""

from __future__ import annotations

import json
from typing import Any

import numpy as np

from offbeat import Dataset, Model, Scaler, StreamOptions, Trajectory
from offbeat.stream.engine import Engine
from offbeat.stream.live import LiveStream, StreamInfo

NAMES = ("a", "b", "c")


class Recorder(Engine):
    """Its state is the list of rows consumed; predicts their number in every channel."""

    def __init__(self) -> None:
        self.reset()

    @property
    def dtype(self) -> np.dtype[Any]:
        return np.dtype(np.float64)

    def reserve(self, slots: int) -> None:
        self.slots: list[Any] = [None] * slots

    def reset(self) -> None:
        self.rows: tuple[tuple[float, tuple[float, ...]], ...] = ()

    def observe(self, time: float, values: Any, mask: Any) -> None:
        assert not values[~mask].any()
        assert not self.rows or time > self.rows[-1][0], "rows must come in the order of time"
        row = tuple(v if m else None for v, m in zip(values.tolist(), mask.tolist(), strict=True))
        if 666.0 in row:
            raise ArithmeticError("the engine refuses this value")
        self.rows = (*self.rows, (time, row))

    def predict(self, times: Any) -> Any:
        return np.full((len(times), len(NAMES)), float(len(self.rows)))

    def save(self, slot: int) -> None:
        self.slots[slot] = self.rows

    def load(self, slot: int) -> None:
        self.rows = self.slots[slot]

    def export(self) -> dict[str, Any]:
        text = json.dumps(self.rows).encode().ljust(10_000)
        return {"rows": np.frombuffer(text, dtype=np.uint8).copy()}

    def restore(self, arrays: dict[str, Any]) -> None:
        rows = json.loads(arrays["rows"].tobytes())
        self.rows = tuple((time, tuple(values)) for time, values in rows)

    def fingerprint(self) -> str:
        return "recorder"


class Recorded(LiveStream):
    """A stream over a recorder, in original units."""

    def __init__(self, *, time_unit: str = "s", **options: Any) -> None:
        self.recorder = Recorder()
        info = StreamInfo(NAMES, ("m",) * 3, Scaler.identity(3), median_gap=0.1, elapsed_limit=2.0)
        super().__init__(self.recorder, info, options=StreamOptions(**options), time_unit=time_unit)

    @property
    def rows(self) -> list[tuple[float, tuple[float | None, ...]]]:
        """What the model has seen, as (time since the first row, values)."""
        return list(self.recorder.rows)

    @property
    def counted(self) -> dict[str, Any]:
        """The counters that are not 0."""
        return {k: v for k, v in self.counters.to_dict().items() if v}


def message(one: Trajectory, row: int) -> dict[str, float]:
    """What was observed at a row, as a message says it."""
    cells = zip(one.names, one.values[row].tolist(), one.observed[row].tolist(), strict=True)
    return {name: value for name, value, seen in cells if seen}


def batch_predictions(model: Model, one: Trajectory) -> Any:
    """(rows, channels) by the batch pass, in original units."""
    import torch

    with torch.no_grad():
        scaled = model(model.batch(Dataset((one,)))).mean[0]
    return model.scaler.original(scaled.double().numpy())
