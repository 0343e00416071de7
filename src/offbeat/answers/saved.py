"""Blends on disk: two models, their tables and what these are for, read without unpickling."""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import SafetensorError
from safetensors.numpy import load as load_arrays
from safetensors.numpy import save as dump_arrays

from offbeat.answers.blend import Blend, tables_of
from offbeat.data.source import read_json
from offbeat.data.tasks import TaskConfig
from offbeat.data.transforms import Transforms
from offbeat.errors import FileFormatError
from offbeat.files import atomic_path, write_json
from offbeat.models.base import BaseModel
from offbeat.models.checkpoint import load_model, save_model

FORMAT = "offbeat-blend"
VERSION = 1
CONFIG = "blend.json"
TABLES = "blend.safetensors"
BACKWARD = "backward"
"""Folder of the backward model's run, inside that of the forward one."""


def save_blend(blend: Blend, path: str | Path) -> None:
    """Writes a blend to a folder: `model`, `backward/model`, its tables and `blend.json`.

    Args:
        blend: to write.
        path: the folder, which may be that of a run; `load_blend` reads it, and `load_model` the
            forward model.
    """
    path = Path(path)
    if blend.forward is not None:
        save_model(blend.forward, path / "model")
    if blend.backward is not None:
        save_model(blend.backward, path / BACKWARD / "model")
    data = dump_arrays({k: np.ascontiguousarray(v) for k, v in blend.arrays().items()})
    with atomic_path(path / TABLES) as temporary:
        temporary.write_bytes(data)
    record: dict[str, Any] = {
        "format": FORMAT,
        "version": VERSION,
        "names": list(blend.names),
        "units": list(blend.units),
        "roles": list(blend.roles),
        "transforms": blend.transforms.to_dict(),
        "tasks": asdict(blend.tasks),
        "tables_sha256": hashlib.sha256(data).hexdigest(),
        "forward_sha256": _weights_of(path / "model", blend.forward),
        "backward_sha256": _weights_of(path / BACKWARD / "model", blend.backward),
    }
    write_json(path / CONFIG, record)


def load_blend(path: str | Path) -> Blend:
    """Reads a blend, which gives the same answers bit for bit.

    Args:
        path: the folder.

    Raises:
        FileFormatError: something is missing, damaged, of a newer version, or of another training
            than the rest.
    """
    path = Path(path)
    if not (path / CONFIG).is_file():
        raise FileFormatError(
            f"{path} has no {CONFIG}: it holds no blend; train one with offbeat train, or fit one "
            "with offbeat.fit_blend"
        )
    try:
        record = read_json(path / CONFIG)
        if record["format"] != FORMAT:
            raise FileFormatError(f"{path / CONFIG} is not of the format {FORMAT}")
        if record["version"] != VERSION:
            raise FileFormatError(
                f"{path} holds a blend of version {record['version']!r}, this Offbeat reads "
                f"version {VERSION}; use the Offbeat that wrote it, or a newer one"
            )
        data = (path / TABLES).read_bytes()
        if hashlib.sha256(data).hexdigest() != record["tables_sha256"]:
            raise FileFormatError(f"{path / TABLES} is damaged: its checksum does not match")
        models: dict[str, Any] = {}
        for side, folder in (("forward", path), ("backward", path / BACKWARD)):
            digest = record[f"{side}_sha256"]
            models[side] = None if digest is None else load_model(folder / "model")
            if _weights_of(folder / "model", models[side]) != digest:
                raise FileFormatError(
                    f"{path}: the blend was fitted to another {side} model than the one that is "
                    "there; train again, which fits both"
                )
        return Blend(
            names=tuple(map(str, record["names"])),
            units=tuple(map(str, record["units"])),
            roles=tuple(map(str, record["roles"])),
            transforms=Transforms.from_dict(record["transforms"]),
            tasks=_tasks(record["tasks"]),
            **tables_of(load_arrays(data)),
            **models,
        )
    except FileFormatError:
        raise
    except OSError as error:
        raise FileFormatError(f"{path} holds no whole blend: {error}") from None
    except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError,
            SafetensorError) as error:  # fmt: skip
        raise FileFormatError(
            f"{path / CONFIG} is damaged ({type(error).__name__}: {error}); the same training "
            "writes it again"
        ) from None


def load_run(path: str | Path) -> BaseModel | Blend:
    """Reads the blend of a folder, or its model where there is no blend.

    Args:
        path: folder of a run or of a checkpoint.

    Raises:
        FileFormatError: as `load_model` and `load_blend`.
    """
    return load_blend(path) if (Path(path) / CONFIG).is_file() else load_model(path)


def _tasks(record: dict[str, Any]) -> TaskConfig:
    sensors = record.pop("sensors")
    named = None if sensors is None else tuple(tuple(map(str, names)) for names in sensors)
    return TaskConfig(**record, sensors=named)


def _weights_of(folder: Path, model: BaseModel | None) -> str | None:
    if model is None:
        return None
    digest: str = json.loads((folder / "config.json").read_text(encoding="utf-8"))["tensors_sha256"]
    return digest
