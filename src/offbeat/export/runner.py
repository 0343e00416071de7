"""`OnnxStream`: runs an exported model on messages as they arrive, without torch."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from offbeat.data.scaler import Scaler
from offbeat.data.transforms import Transforms
from offbeat.errors import FileFormatError, require
from offbeat.stream.engine import Arrays, Engine
from offbeat.stream.live import LiveStream, StreamInfo
from offbeat.stream.options import StreamOptions, with_options

FORMAT = "offbeat-step"
VERSION = 4
WITH_BASE = 3
WITHOUT_BASE = 2
"""Versions: 4 of a blend, 3 of a model that corrects a baseline, 2 of one that corrects none."""

METADATA = "offbeat"
"""Key of a JSON object in the metadata of the file."""

STATE = ("state", "time", "start", "observed_at", "channel_at", "last", "updated")
"""Inputs that are the state of a model; each has an output of its name with `_next`."""

_NONE: dict[str, Any] = {"angles": {}, "quaternions": []}  # version 1 had no transforms
BEGINS = {"time": np.nan, "start": np.inf, "observed_at": -np.inf, "channel_at": -np.inf}
"""Initial values of parts of the state, which JSON cannot hold."""

Record = TypeVar("Record")


class OnnxStream(LiveStream):
    """Runs a model or blend that `export_onnx` wrote on messages as they arrive, without torch.

    Predictions of a blend have intervals, as in `Stream`.

    Args:
        path: the .onnx file.
        options: what to do with messages out of order.
        time_unit: of all times given: s, ms, us or ns. Integers are exact.
        **fields: fields of `StreamOptions` that replace those of `options`.

    Raises:
        FileFormatError: the file is missing, damaged, or not written by `export_onnx`.
        InputError: an unknown unit or option, or an option out of its range.
        MissingExtraError: onnxruntime is not installed.
    """

    def __init__(
        self,
        path: str | Path,
        options: StreamOptions | None = None,
        *,
        time_unit: str = "s",
        **fields: Any,
    ) -> None:
        engine = OnnxEngine(path)
        super().__init__(
            engine,
            engine.info,
            options=with_options(options, fields),
            time_unit=time_unit,
        )


class OnnxEngine(Engine):
    """Runs the step of an ONNX file on one thread; the step includes the scaling.

    Args:
        path: the .onnx file.

    Raises:
        FileFormatError: as `OnnxStream`.
        MissingExtraError: onnxruntime is not installed.
    """

    def __init__(self, path: str | Path) -> None:
        opened = open_step(path, "model that offbeat export", _read)
        self._session, self._digest = opened.session, opened.digest
        self.info, self._initial, self._levels = opened.record
        self._unmeasured = np.full((1, len(self.info.names)), np.nan)
        self._parts = list(self._initial)
        self._next = [f"{name}_next" for name in self._parts]
        self._slots: list[Arrays] = []
        self.reset()

    @property
    def dtype(self) -> np.dtype[Any]:
        """Dtype of values in original units."""
        return np.dtype(np.float64)

    def reserve(self, slots: int) -> None:
        """Makes room for references: states are never changed, only followed by others."""
        self._slots = [{}] * slots

    def reset(self) -> None:
        """Resets the state."""
        self._state = dict(self._initial)

    def observe(self, time: float, values: NDArray[Any], mask: NDArray[np.bool_]) -> None:
        """Consumes one row."""
        row = np.where(mask, values, np.nan)[None]
        found = self._session.run(self._next, {"t": np.array([time]), "values": row, **self._state})
        self._state = dict(zip(self._parts, found, strict=True))

    def predict(self, times: NDArray[np.float64]) -> NDArray[np.float64]:
        """Runs the step without measurements for each time; does not change the state."""
        feed = {"values": self._unmeasured, **self._state}
        each = [self._session.run(["prediction"], {"t": t[None], **feed})[0] for t in times]
        return np.concatenate(each)

    def half_widths(self, times: NDArray[np.float64], level: float) -> NDArray[np.float64] | None:
        """Half widths of intervals at each time, where the file is of a blend."""
        if not len(self._levels):
            return None
        from offbeat.answers.intervals import half_width

        feed = {"values": self._unmeasured, **self._state}
        each = [self._session.run(["half_widths"], {"t": t[None], **feed})[0] for t in times]
        table = np.array(each).reshape(len(times), len(self.info.names), len(self._levels))
        return half_width(table, level, self._levels)

    def save(self, slot: int) -> None:
        """Keeps a reference to the state."""
        self._slots[slot] = self._state

    def load(self, slot: int) -> None:
        """Goes back to a state that was kept."""
        self._state = self._slots[slot]

    def export(self) -> Arrays:
        """The inputs that are the state."""
        return {name: array.copy() for name, array in self._state.items()}

    def restore(self, arrays: Arrays) -> None:
        """Restores the inputs that are the state."""
        self._state = dict(arrays)

    def fingerprint(self) -> str:
        """Fingerprint of the file."""
        return self._digest


@dataclass(frozen=True, eq=False)
class OpenedStep(Generic[Record]):
    """A step of an ONNX file, ready to run on one thread.

    Attributes:
        session: of onnxruntime.
        digest: SHA-256 of the file, hexadecimal.
        record: what was read of its metadata.
    """

    session: Any
    digest: str
    record: Record


def open_step(path: str | Path, what: str, read: Callable[[Any], Record]) -> OpenedStep[Record]:
    """Opens an ONNX file of Offbeat for one thread.

    Args:
        path: the .onnx file.
        what: the file should hold and what writes it, such as `policy that export_policy`.
        read: takes the JSON of its metadata; its errors mean another file.

    Raises:
        FileFormatError: the file is missing or damaged, or `read` refused it.
        MissingExtraError: onnxruntime is not installed.
    """
    runtime = require("onnxruntime", "export")
    path = Path(path)
    try:
        data = path.read_bytes()
    except OSError as error:
        raise FileFormatError(f"{path} can't be read ({error.strerror})") from None
    options = runtime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 3
    try:
        session = runtime.InferenceSession(data, options, providers=["CPUExecutionProvider"])
        record = read(json.loads(session.get_modelmeta().custom_metadata_map[METADATA]))
    except FileFormatError:
        raise
    except Exception as error:  # onnxruntime has an exception for each kind of error
        why = " ".join(f"{type(error).__name__}: {error}".split())
        raise FileFormatError(f"{path} is not a {what} wrote, or damaged ({why})") from None
    return OpenedStep(session, hashlib.sha256(data).hexdigest(), record)


def _read(record: Any) -> tuple[StreamInfo, Arrays, NDArray[np.float64]]:
    """Reads the metadata: properties of the stream, the initial state, levels of intervals."""
    if record["format"] != FORMAT or record["version"] not in range(1, VERSION + 1):
        raise FileFormatError(
            f"the ONNX file is a {record['format']!r} of version {record['version']!r}, this "
            f"Offbeat runs {FORMAT!r} of versions 1 to {VERSION}; export the model again"
        )
    names = tuple(record["names"])
    initial: Arrays = {}
    if record["initial"]:  # a blend may be of baselines alone
        dtype, shapes = np.dtype(record["dtype"]), {"channel_at": (1, len(names))}
        given = {name: np.array(v, dtype=dtype) for name, v in record["initial"].items()}
        begins = {name: np.full(shapes.get(name, (1,)), v) for name, v in BEGINS.items()}
        every = {**given, **begins, "updated": np.zeros(1, dtype=bool)}
        initial = {name: every[name] for name in STATE}
    info = StreamInfo(
        names=names,
        units=tuple(record["units"]),
        scaler=Scaler.identity(len(names)),
        median_gap=float(record["median_gap_s"]),
        elapsed_limit=float(record["elapsed_limit_s"]),
        transforms=Transforms.from_dict(record["transforms"] if record["version"] > 1 else _NONE),
        roles=tuple(record.get("roles", ())),
    )
    base = {name: np.array(v, dtype=np.float64) for name, v in record.get("base", {}).items()}
    return info, {**initial, **base}, np.array(record.get("levels", []), dtype=np.float64)
