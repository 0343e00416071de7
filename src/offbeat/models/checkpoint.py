"""Checkpoints: a folder with `model.safetensors` and `config.json`, read without unpickling."""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import load as load_tensors
from safetensors.torch import save as dump_tensors
from torch import Tensor

from offbeat.config import ModelConfig, from_mapping
from offbeat.data.scaler import Scaler
from offbeat.errors import FileFormatError
from offbeat.files import atomic_folder
from offbeat.models.model import Model
from offbeat.models.statistics import Statistics

FORMAT = "offbeat-checkpoint"
VERSION = 1
TENSORS = "model.safetensors"
CONFIG = "config.json"


def save_model(model: Model, path: str | Path) -> None:
    """Writes a model to a folder, atomically; one that stood there is replaced.

    Args:
        model: weights, config, statistics, scaler, channel names and units are all saved.
        path: the folder.
    """
    _write(path, _weights(model), _facts(model))


def load_model(path: str | Path) -> Model:
    """Reads a model back: the same predictions, bit for bit.

    Args:
        path: the folder of a checkpoint, one of a training that goes on included, or of a run
            that `fit` wrote.

    Raises:
        FileFormatError: the folder is missing, damaged by as little as one byte, not a checkpoint,
            or of a newer version.
    """
    path = Path(path)
    if not (path / CONFIG).is_file() and (path / "model" / CONFIG).is_file():
        path = path / "model"
    tensors, facts = _read(path)
    try:
        model = _build(facts)
        if facts["dtype"] == "float64":
            model.double()
        weights = {k: v for k, v in tensors.items() if not k.startswith("training.")}
        model.load_state_dict(weights)
    except (KeyError, TypeError, ValueError, RuntimeError) as error:
        raise FileFormatError(f"{path}: its config and its weights disagree ({error})") from None
    return model


def save_training_state(
    model: Model, tensors: dict[str, Tensor], facts: dict[str, Any], path: str | Path
) -> None:
    """Writes a model with all that its training needs to go on.

    Args:
        model: as it stands.
        tensors: of the optimizer, and best weights.
        facts: JSON-like counters and history.
        path: the folder.
    """
    everything = {**_weights(model), **{f"training.{k}": v for k, v in tensors.items()}}
    _write(path, everything, {**_facts(model), "training": facts})


def load_training_state(
    path: str | Path,
) -> tuple[dict[str, Tensor], dict[str, Tensor], dict[str, Any]]:
    """Reads what `save_training_state` wrote: weights, training tensors, facts.

    Raises:
        FileFormatError: as `load_model`.
    """
    tensors, facts = _read(Path(path))
    if "training" not in facts:
        raise FileFormatError(f"{path} holds a model without the state of its training")
    weights = {k: v for k, v in tensors.items() if not k.startswith("training.")}
    training = {
        k.removeprefix("training."): v for k, v in tensors.items() if k.startswith("training.")
    }
    return weights, training, facts["training"]


def _weights(model: Model) -> dict[str, Tensor]:
    return {k: v.detach().cpu().clone() for k, v in model.state_dict().items()}


def _facts(model: Model) -> dict[str, Any]:
    return {
        "format": FORMAT,
        "version": VERSION,
        "torch": torch.__version__,
        "dtype": str(model.dtype).removeprefix("torch."),
        "model": asdict(model.config),
        "names": list(model.names),
        "units": list(model.units),
        "time_unit_s": model.time_unit,
        "statistics": model.statistics.to_dict(),
        "scaler": model.scaler.to_dict(),
    }


def _build(facts: dict[str, Any]) -> Model:
    return Model(
        from_mapping(ModelConfig, facts["model"]),
        Statistics.from_dict(facts["statistics"]),
        scaler=Scaler.from_dict(facts["scaler"]),
        names=tuple(facts["names"]),
        units=tuple(facts["units"]),
    )


def _write(path: str | Path, tensors: dict[str, Tensor], facts: dict[str, Any]) -> None:
    data = dump_tensors(tensors)
    facts = {**facts, "tensors_sha256": hashlib.sha256(data).hexdigest()}
    facts["config_sha256"] = _digest(facts)
    with atomic_folder(path) as folder:
        (folder / TENSORS).write_bytes(data)
        text = json.dumps(facts, indent=2, allow_nan=False)
        (folder / CONFIG).write_text(text + "\n", encoding="utf-8")


def _read(path: Path) -> tuple[dict[str, Tensor], dict[str, Any]]:
    for name in (CONFIG, TENSORS):
        if not (path / name).is_file():
            raise FileFormatError(
                f"{path} is not a checkpoint: it has no {name}; give the folder that was written "
                "by training, or its subfolder 'model'"
            )
    try:
        facts = json.loads((path / CONFIG).read_text(encoding="utf-8"))
    except (UnicodeDecodeError, json.JSONDecodeError) as error:
        raise FileFormatError(f"{path / CONFIG} is damaged ({error})") from None
    if not isinstance(facts, dict) or facts.get("format") != FORMAT:
        raise FileFormatError(
            f"{path / CONFIG} is not an Offbeat checkpoint (no format {FORMAT!r})"
        )
    if facts.get("version") != VERSION:
        raise FileFormatError(
            f"{path} is of checkpoint version {facts.get('version')!r}, this Offbeat reads "
            f"version {VERSION}; use the Offbeat that wrote it, or a newer one"
        )
    if facts.pop("config_sha256", None) != _digest(facts):
        raise FileFormatError(f"{path / CONFIG} is damaged: its checksum does not match")
    data = (path / TENSORS).read_bytes()
    if hashlib.sha256(data).hexdigest() != facts["tensors_sha256"]:
        raise FileFormatError(f"{path / TENSORS} is damaged: its checksum does not match")
    return load_tensors(data), facts


def _digest(facts: dict[str, Any]) -> str:
    text = json.dumps(facts, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()
