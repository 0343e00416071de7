"""Arrays behind the figures that show data and hidden states: one file, no torch to read it."""

from __future__ import annotations

import zipfile
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from offbeat import FileFormatError, InputError
from offbeat.files import atomic_path

FILE = "illustrations.npz"
"""Its name in the folder of a reproduction."""

_FACTS = ("robot", "names", "units", "times", "recordings")
_TRACE = ("trace_times", "trace_observed")
_MAP = ("map_colour", "map_colour_name", "map_colour_unit")


@dataclass(frozen=True, eq=False)
class Trace:
    """Hidden states along one trajectory.

    Attributes:
        times: (rows,) s.
        observed: (rows,) bool.
        before: by model, (rows, hidden) the state on arrival at a row.
        after: by model, (rows, hidden) the state after it.
    """

    times: NDArray[np.float64]
    observed: NDArray[np.bool_]
    before: Mapping[str, NDArray[np.float64]]
    after: Mapping[str, NDArray[np.float64]]


@dataclass(frozen=True, eq=False)
class StateMap:
    """Hidden states of many trajectories, in two dimensions per model.

    Attributes:
        places: by model, (points, 2) without units.
        colour: (points,) a channel at these points, the same points for all models.
        name: of that channel.
        unit: of that channel.
    """

    places: Mapping[str, NDArray[np.float64]]
    colour: NDArray[np.float64]
    name: str
    unit: str


@dataclass(frozen=True, eq=False)
class Illustrations:
    """What the figures of data and of hidden states draw.

    Attributes:
        robot: its name.
        names: of the channels.
        units: of the channels.
        times: (rows,) s.
        recordings: (trajectories, rows, channels) in the channels' units.
        fraction: observed fraction of the rows in `trace` and `map`; NaN without models.
        runs: by model, the run whose checkpoint was used.
        trace: hidden states along one trajectory, or None without models.
        map: hidden states of many, or None without models or without umap-learn.
        missing: why something is None, a sentence each.
    """

    robot: str
    names: tuple[str, ...]
    units: tuple[str, ...]
    times: NDArray[np.float64]
    recordings: NDArray[np.float64]
    fraction: float = float("nan")
    runs: Mapping[str, str] = field(default_factory=dict)
    trace: Trace | None = None
    map: StateMap | None = None
    missing: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        wanted = (len(self.times), len(self.names))
        if self.recordings.ndim != 3 or self.recordings.shape[1:] != wanted:
            raise InputError(
                f"recordings must have shape (trajectories, {wanted[0]}, {wanted[1]}), got "
                f"{self.recordings.shape}"
            )

    def save(self, folder: str | Path) -> Path:
        """Writes `illustrations.npz` into a folder, whole or not at all."""
        arrays: dict[str, Any] = {
            **{name: getattr(self, name) for name in _FACTS},
            "fraction": self.fraction,
            "run_models": list(self.runs),
            "run_ids": list(self.runs.values()),
            "missing": list(self.missing),
        }
        if self.trace is not None:
            arrays |= {"trace_times": self.trace.times, "trace_observed": self.trace.observed}
            arrays |= {f"before:{m}": v for m, v in self.trace.before.items()}
            arrays |= {f"after:{m}": v for m, v in self.trace.after.items()}
        if self.map is not None:
            described = (self.map.colour, self.map.name, self.map.unit)
            arrays |= dict(zip(_MAP, described, strict=True))
            arrays |= {f"place:{m}": v for m, v in self.map.places.items()}
        path = Path(folder) / FILE
        with atomic_path(path) as temporary:
            np.savez_compressed(temporary, **arrays)
        return path

    @classmethod
    def load(cls, folder: str | Path) -> Illustrations | None:
        """Reads what `save` wrote; None if the folder has no such file.

        Raises:
            FileFormatError: the file is damaged. Nothing is unpickled.
        """
        path = Path(folder) / FILE
        if not path.is_file():
            return None
        try:
            # numpy leaves a file open that it finds damaged; this one is closed by us.
            with path.open("rb") as opened, np.load(opened, allow_pickle=False) as file:
                return _unpacked(dict(file))
        except (OSError, EOFError, KeyError, ValueError, zipfile.BadZipFile) as error:
            raise FileFormatError(
                f"{path} is damaged ({' '.join(str(error).split())}); remove it, and it is made "
                "again from the checkpoints"
            ) from None


def _unpacked(arrays: dict[str, NDArray[Any]]) -> Illustrations:
    def by_model(prefix: str) -> dict[str, NDArray[Any]]:
        return {k.partition(":")[2]: v for k, v in arrays.items() if k.startswith(f"{prefix}:")}

    trace = state_map = None
    if "trace_times" in arrays:
        times, observed = (arrays[name] for name in _TRACE)
        trace = Trace(times, observed, by_model("before"), by_model("after"))
    if "map_colour" in arrays:
        colour, name, unit = (arrays[key] for key in _MAP)
        state_map = StateMap(by_model("place"), colour, str(name), str(unit))
    texts = {name: tuple(map(str, arrays[name])) for name in ("names", "units", "missing")}
    return Illustrations(
        str(arrays["robot"]),
        texts["names"],
        texts["units"],
        arrays["times"],
        arrays["recordings"],
        float(arrays["fraction"]),
        dict(zip(map(str, arrays["run_models"]), map(str, arrays["run_ids"]), strict=True)),
        trace,
        state_map,
        texts["missing"],
    )
