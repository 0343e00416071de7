"""Runs a model row by row in compiled code, in buffers that are allocated once."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from offbeat.kernels import choose, cpu
from offbeat.models.model import Model
from offbeat.parts import Point
from offbeat.parts.decay import TrainableDecay
from offbeat.stream.engine import Arrays, Engine
from offbeat.stream.torch_engine import TorchEngine

_TIME_INPUTS = {"none": 0, "elapsed": 1, "gap": 2, "delta": 3}


class CpuEngine(Engine):
    """The same bits as a batch in the compiled backend, a row at a time.

    Args:
        model: its weights are copied; changes to the model afterwards are not seen.
        seed: of the generator of self-feeding.
    """

    def __init__(self, model: Model, *, seed: int = 0) -> None:
        self._model, self._seed = model, seed
        self._dtype = np.dtype(str(model.dtype).removeprefix("torch."))
        self._fraction = float(model.config.self_feeding or 0.0)
        kind = getattr(cpu.compiled, f"StreamEngine_{cpu.suffix(model.dtype)}")
        self._live = kind(**engine_arguments(model))
        self._generator: torch.Generator | None = None
        self._kept: list[torch.Tensor | None] = []
        self.reset()

    @staticmethod
    def unsupported(model: Model) -> str | None:
        """Why this engine cannot run a model; None if it can.

        Args:
            model: any.
        """
        choice = choose(model.spec, model.dtype, model.device)
        if choice.backend.name != "cpu":
            return f"its scan runs in {choice.backend.name} here ({choice.reason})"
        if type(model.head) is not Point:
            return "its head is not point"
        return "it has actions" if model.acts else None

    @property
    def dtype(self) -> np.dtype[Any]:
        """Dtype of the model's weights."""
        return self._dtype

    def reserve(self, slots: int) -> None:
        """Allocates slots for copies of the state."""
        self._live.reserve(slots)
        self._kept = [None] * slots

    def reset(self) -> None:
        """Resets the state and the generator."""
        self._live.reset()
        self._generator = torch.Generator().manual_seed(self._seed) if self._fraction else None

    def observe(self, time: float, values: NDArray[Any], mask: NDArray[np.bool_]) -> None:
        """Consumes one row."""
        fed = False
        if self._generator is not None:
            fed = float(torch.rand((), generator=self._generator)) < self._fraction
            fed = fed and self._live.rows > 0
        self._live.observe(time, values, mask, fed)

    def predict(self, times: NDArray[np.float64]) -> NDArray[np.float64]:
        """Predicts each time independently from the current state."""
        out = np.empty((len(times), self._model.channels))
        self._live.predict(times, out)
        return out

    def in_order(self, **settings: Any) -> Any | None:
        """Compiled code for messages in the order of time; None with self-feeding."""
        if self._fraction:
            return None
        # A module that was compiled from older sources has none.
        kind = getattr(cpu.compiled, f"InOrder_{cpu.suffix(self._model.dtype)}", None)
        return kind and kind(self._live, **settings)

    def save(self, slot: int) -> None:
        """Copies the state to a slot."""
        self._live.save(slot)
        self._kept[slot] = None if self._generator is None else self._generator.get_state()

    def load(self, slot: int) -> None:
        """Copies a slot to the state."""
        self._live.load(slot)
        kept = self._kept[slot]
        if self._generator is not None and kept is not None:
            self._generator.set_state(kept)

    def export(self) -> Arrays:
        """The parts of the recurrent state, named as those of `TorchEngine`."""
        flat = np.empty(self._live.size)
        self._live.export_to(flat)
        arrays: Arrays = {}
        at = 0
        for name, shape, kind in self._parts():
            n = int(np.prod(shape))
            arrays[name] = flat[at : at + n].reshape(shape).astype(kind)
            at += n
        if self._generator is not None:
            arrays["generator"] = self._generator.get_state().numpy().copy()
        return arrays

    def restore(self, arrays: Arrays) -> None:
        """Restores the parts of a recurrent state."""
        parts = [arrays[name].astype(np.float64).reshape(-1) for name, _, _ in self._parts()]
        self._live.restore(np.concatenate(parts))
        if self._generator is not None:
            self._generator.set_state(torch.tensor(arrays["generator"]))

    def fingerprint(self) -> str:
        """Equals that of `TorchEngine`: states can be exchanged between the two."""
        return TorchEngine(self._model).fingerprint()

    def _parts(self) -> list[tuple[str, tuple[int, ...], Any]]:
        states, channels = self._model.spec.state_size, self._model.channels
        trend = [("covariance", (1, channels, 3), np.float64)] if self._model.spec.trend else []
        return [
            ("state", (1, states), self._dtype),
            ("time", (1,), np.float64),
            ("start", (1,), np.float64),
            ("observed_at", (1,), np.float64),
            ("channel_at", (1, channels), np.float64),
            ("last", (1, channels), self._dtype),
            ("updated", (1,), np.bool_),
            *trend,
            ("rows", (), np.int64),
        ]


def engine_arguments(model: Model) -> dict[str, Any]:
    """What the compiled engine is made of: a spec, arrays and numbers.

    Args:
        model: that the engine supports.
    """
    config, spec = model.config, model.spec
    limit = float(config.gap_limit or 1)
    decoder, decoder_weights = [], None
    if layers := model.head.layers:
        decoder = [layers[0][0].shape[1], *(weight.shape[0] for weight, _ in layers)]
        decoder_weights = _flat([t for layer in layers for t in layer])
    further = {}
    if spec.trend:
        filters = model.filters
        further = {
            "filters": filters.table.cpu().numpy(),
            "prior": filters.prior().cpu().numpy(),
        }
    with torch.no_grad():
        return dict(
            spec=cpu.compiled_spec(spec),
            instruction_set=choose(spec, model.dtype, model.device).variant,
            weights=_flat(list(model.scan_parts().tensors())),
            mean=model.mean.numpy(),
            std=model.std.numpy(),
            decoder=decoder,
            decoder_weights=decoder_weights,
            first_state=model.first_state(1)[0].detach().contiguous().numpy(),
            low=model.low.numpy() if spec.bounded else None,
            high=model.high.numpy() if spec.bounded else None,
            unit=model.time_unit,
            time_input_unit=model.time_input_unit,
            elapsed_limit=model.elapsed_limit,
            longest_delta=model.statistics.longest_delta * limit,
            time_input=_TIME_INPUTS[config.time_input or "none"],
            from_first_row=config.clock == "first_row",
            last_row=config.readout == "last_row",
            every_row=config.update_rows == "every",
            starts_only=config.cell == "none",
            exponential=bool(spec.decay) and not isinstance(model.decay, TrainableDecay),
            **further,
        )


def _flat(tensors: list[torch.Tensor]) -> NDArray[Any]:
    flat: NDArray[Any] = torch.cat([t.detach().reshape(-1) for t in tensors]).numpy()
    return flat
