"""Writes a model for the C++ library of `csrc/library/offbeat.hpp`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from offbeat.answers.blend import Blend
from offbeat.data.trajectory import EXOGENOUS
from offbeat.errors import InputError
from offbeat.files import atomic_path
from offbeat.kernels import cpu
from offbeat.models.base import BaseModel
from offbeat.models.model import Model
from offbeat.stream.cpu_engine import CpuEngine, engine_arguments

HEADER = b"offbeat-stream 1\n"


def write_stream(model: BaseModel | Blend, path: str | Path) -> None:
    """Writes a model so that `offbeat::Stream` runs it in C++, with the bits of `Stream`.

    The file is a header and, for each array, a line with name, type and shape, and the numbers in
    little-endian order. It holds no code.

    Args:
        model: trained; its scan must run in the compiled backend.
        path: of the file, written atomically.

    Raises:
        InputError: a blend, or a model that does not run in the compiled engine, or one that has
            input transforms or self-feeding; `export_onnx` writes most of these.
    """
    if not isinstance(model, Model):
        raise InputError(
            f"the C++ library runs a model of parts alone, not a {type(model).__name__}; export "
            "it to onnx, or export the folder of its model"
        )
    reason = CpuEngine.unsupported(model)
    if reason is None and not model.transforms.is_identity:
        reason = "it has input transforms"
    if reason is None and model.config.self_feeding:
        reason = "it has self-feeding, which draws random numbers"
    if reason is None and any("\n" in text for text in (*model.names, *model.units)):
        reason = "the name or unit of a channel has a line break"
    if reason is not None:
        raise InputError(f"the C++ library cannot run this model: {reason}; export it to onnx")
    spec, engine = cpu.spec_arguments(model.spec), engine_arguments(model)
    below = [weight for row in spec.pop("a") for weight in row]
    fields = {
        "spec_decoder": spec.pop("decoder"),
        "a": np.array(below, dtype=np.float64),
        **spec,
        **{k: v for k, v in engine.items() if k not in ("spec", "instruction_set")},
        "shift": model.scaler.shift,
        "scale": model.scaler.scale,
        "exogenous": [i for i, role in enumerate(model.roles) if role == EXOGENOUS],
        "dtype": str(model.dtype).removeprefix("torch."),
        "names": "\n".join(model.names) + "\n",
        "channel_units": "\n".join(model.units) + "\n",
    }
    with atomic_path(Path(path)) as temporary, temporary.open("wb") as out:
        out.write(HEADER)
        for name, value in fields.items():
            if value is not None:
                array = _array(value)
                kind = f"{array.dtype.kind}{array.dtype.itemsize}"
                out.write(f"{name} {kind} {' '.join(map(str, array.shape))}\n".encode())
                out.write(array.tobytes())
        out.write(b"end\n")


def _array(value: Any) -> NDArray[Any]:
    if isinstance(value, str):
        return np.frombuffer(value.encode(), dtype=np.uint8)
    array = np.asarray(value, dtype=np.int64 if isinstance(value, list) and not value else None)
    if array.dtype.kind in "bi":
        array = array.astype(np.int64)
    return np.ascontiguousarray(array.astype(array.dtype.newbyteorder("<"), copy=False))
