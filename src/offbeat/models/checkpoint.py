"""Checkpoints: a folder with `model.safetensors` and `config.json`, read without unpickling."""

from __future__ import annotations

import hashlib
import itertools
import json
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load as load_tensors
from safetensors.torch import save as dump_tensors
from torch import Tensor

from offbeat.data.scaler import Scaler
from offbeat.data.source import read_json, require_file
from offbeat.data.trajectory import STATE
from offbeat.data.transforms import Transforms
from offbeat.errors import FileFormatError, InputError
from offbeat.files import atomic_folder
from offbeat.models.base import BaseModel, DataInfo
from offbeat.models.corrected import CorrectedModel
from offbeat.models.foreign import ForeignModel
from offbeat.models.model import Model
from offbeat.models.statistics import Statistics
from offbeat.models.zoo import MODELS, build

FORMAT = "offbeat-checkpoint"
VERSION = 2
TENSORS = "model.safetensors"
CONFIG = "config.json"


def save_model(model: BaseModel, path: str | Path) -> None:
    """Writes a model to a folder, atomically; an older one is replaced.

    Args:
        model: weights, config, statistics, scaler, channel names and units are all saved.
        path: the folder.
    """
    _write(path, _weights(model), _record(model))


def load_model(path: str | Path) -> Any:
    """Reads a model, which gives the same predictions bit for bit.

    Args:
        path: the folder of a checkpoint, of an unfinished training, or of a run
            that `fit` wrote; or the name of a model that comes with the package, such as
            `offbeat/hopper-30-ode_gru_d` (`offbeat models` lists them).

    Returns:
        A `Model`, a `CorrectedModel`, or a `ForeignModel`.

    Raises:
        FileFormatError: the folder is missing, damaged, not a checkpoint, of a newer version, or
            its weights are not finite.
        InputError: it is a model of another package, which has not been registered.
    """
    if str(path).startswith("offbeat/") and not Path(path).exists():
        from offbeat.models.hub import trained_folder  # which builds on this module

        path = trained_folder(str(path))
    path = Path(path)
    if not (path / CONFIG).is_file() and (path / "model" / CONFIG).is_file():
        path = path / "model"
    tensors, record = _read(path)
    if "name" not in record["model"] and record["name"] not in MODELS:
        raise InputError(
            f"{path} holds the model {record['name']!r} of another package, which is not "
            "registered here; import that package, or call offbeat.register_model, before loading"
        )
    weights = {k: v for k, v in tensors.items() if not k.startswith("training.")}
    try:
        _check_sizes(record["model"], weights)
        model = _build(record, weights)
        if record["dtype"] == "float64":
            model.double()
        model.load_state_dict(weights)
    except _DAMAGE as error:
        what = " ".join(str(error).split())[:150]
        raise FileFormatError(
            f"{path}: its config and its weights disagree ({type(error).__name__}: {what})"
        ) from None
    trained = (name for name, _ in model.named_parameters() if name in weights)
    bad = [name for name in trained if not weights[name].isfinite().all()]
    if bad:
        raise FileFormatError(
            f"{path} has weights that are not finite, in {bad[0]}, so that it predicts nothing; "
            "train it again with a lower learning rate"
        )
    return model


_DAMAGE = (
    ArithmeticError,
    AttributeError,
    LookupError,
    MemoryError,
    RecursionError,
    RuntimeError,
    TypeError,
    ValueError,
)
"""Errors of building a model from a record that no training wrote."""


def save_training_state(
    model: BaseModel, tensors: dict[str, Tensor], record: dict[str, Any], path: str | Path
) -> None:
    """Writes a model with the state of its training, to resume it.

    Args:
        model: in its current state.
        tensors: of the optimizer, and best weights.
        record: JSON-like counters and history.
        path: the folder.
    """
    everything = {**_weights(model), **{f"training.{k}": v for k, v in tensors.items()}}
    _write(path, everything, {**_record(model), "training": record})


def load_training_state(
    path: str | Path,
) -> tuple[dict[str, Tensor], dict[str, Tensor], dict[str, Any]]:
    """Reads the state of a training: weights, training tensors, record.

    Raises:
        FileFormatError: as `load_model`.
    """
    tensors, record = _read(Path(path))
    if "training" not in record:
        raise FileFormatError(f"{path} holds a model without the state of its training")
    weights = {k: v for k, v in tensors.items() if not k.startswith("training.")}
    training = {
        k.removeprefix("training."): v for k, v in tensors.items() if k.startswith("training.")
    }
    return weights, training, record["training"]


def _weights(model: BaseModel) -> dict[str, Tensor]:
    return {k: v.detach().cpu().clone() for k, v in model.state_dict().items()}


def _record(model: BaseModel) -> dict[str, Any]:
    config: dict[str, Any] = {}
    if isinstance(model, Model):
        config = asdict(model.config)
    elif isinstance(model, ForeignModel | CorrectedModel):
        config = model.options
    return {
        "format": FORMAT,
        "version": VERSION,
        "torch": torch.__version__,
        "dtype": str(model.dtype).removeprefix("torch."),
        "name": model.name,
        "model": config,
        "names": list(model.names),
        "units": list(model.units),
        "roles": list(model.roles),
        "statistics": model.statistics.to_dict(),
        "scaler": model.scaler.to_dict(),
        "transforms": model.transforms.to_dict(),
    }


def _build(record: dict[str, Any], weights: dict[str, Tensor]) -> BaseModel:
    data = DataInfo(
        names=tuple(record["names"]),
        units=tuple(record["units"]),
        roles=tuple(record["roles"]),
        scaler=Scaler.from_dict(record["scaler"]),
        statistics=Statistics.from_dict(record["statistics"]),
        transforms=Transforms.from_dict(record["transforms"]),
    )
    if "inner" in record["model"]:
        inner = {**_ADDED, **record["model"]["inner"]}
        return CorrectedModel.restored(inner, record["model"]["base"], data, weights)
    config = record["model"]
    if "name" in config:  # a composed model
        config = {**_ADDED, **config}
    return build(record["name"], config, data)


_ADDED: dict[str, Any] = {"nodes": "rows", "bounded": False, "trend": False}
"""Options that files of earlier versions lack, and what those versions did."""


_RENAMED = {"age_input": "time_input", "age_unit": "time_input_unit"}
"""Fields of `ModelConfig` by their names in version 1."""


def _of_version_1(record: dict[str, Any]) -> dict[str, Any]:
    """Converts a record of version 1 to version 2."""
    config = {_RENAMED.get(key, key): value for key, value in record["model"].items()}
    config.setdefault("time_input_unit", "gap")  # the first files of version 1 do not say
    return {
        **record,
        "name": config["name"],
        "model": {**config, "head": "point"},
        "roles": [STATE] * len(record["names"]),
        "transforms": Transforms.identity().to_dict(),
    }


def _renamed(name: str) -> str:
    """The name of a tensor of version 1 in version 2."""
    prefix, kept = ("training.", name.removeprefix("training."))
    if name == kept:
        prefix = ""
    best = "best." if kept.startswith("best.") else ""
    kept = kept.removeprefix(best)
    if kept.startswith("decoder."):
        kept = f"head.{kept}"
    return f"{prefix}{best}{kept}"


def _write(path: str | Path, tensors: dict[str, Tensor], record: dict[str, Any]) -> None:
    data = dump_tensors(tensors)
    record = {**record, "tensors_sha256": hashlib.sha256(data).hexdigest()}
    record["config_sha256"] = _digest(record)
    with atomic_folder(path) as folder:
        (folder / TENSORS).write_bytes(data)
        text = json.dumps(record, indent=2, allow_nan=False)
        (folder / CONFIG).write_text(text + "\n", encoding="utf-8")


def _read(path: Path) -> tuple[dict[str, Tensor], dict[str, Any]]:
    for name in (CONFIG, TENSORS):
        if not (path / name).is_file():
            raise FileFormatError(
                f"{path} is not a checkpoint: it has no {name}; give the folder that was written "
                "by training, or its subfolder 'model'"
            )
    record = read_json(path / CONFIG)
    if not isinstance(record, dict) or record.get("format") != FORMAT:
        raise FileFormatError(
            f"{path / CONFIG} is not an Offbeat checkpoint (no format {FORMAT!r})"
        )
    if record.get("version") not in (1, VERSION):
        raise FileFormatError(
            f"{path} is of checkpoint version {record.get('version')!r}, this Offbeat reads "
            f"versions 1 to {VERSION}; use the Offbeat that wrote it, or a newer one"
        )
    try:
        digest = _digest({key: value for key, value in record.items() if key != "config_sha256"})
    except (ValueError, RecursionError):  # NaN, which no training writes
        digest = ""
    if record.pop("config_sha256", None) != digest:
        raise FileFormatError(f"{path / CONFIG} is damaged: its checksum does not match")
    data = require_file(path / TENSORS).read_bytes()
    if hashlib.sha256(data).hexdigest() != record.get("tensors_sha256"):
        raise FileFormatError(f"{path / TENSORS} is damaged: its checksum does not match")
    try:
        tensors = load_tensors(data)
        if record["version"] == 1:
            tensors = {_renamed(name): tensor for name, tensor in tensors.items()}
            record = _of_version_1(record)
        for name, kind in _FIELDS.items():
            if not isinstance(record[name], kind):
                raise TypeError(f"{name} is a {type(record[name]).__name__}")
    except (SafetensorError, *_DAMAGE) as error:
        raise FileFormatError(
            f"{path} is damaged ({type(error).__name__}: {str(error)[:100]}), although its "
            "checksum matches; do not trust it"
        ) from None
    return tensors, record


_FIELDS = {
    "dtype": str,
    "name": str,
    "model": dict,
    "names": list,
    "units": list,
    "roles": list,
    "statistics": dict,
    "scaler": dict,
    "transforms": dict,
}
"""Fields of a record, and their types."""


def _check_sizes(config: Mapping[str, Any], weights: Mapping[str, Tensor]) -> None:
    """Checks that a config asks for no more weights than there are, before any is allocated.

    Raises:
        ValueError: it does.
    """
    count = sum(weight.numel() for weight in weights.values())
    hidden = config.get("hidden_size") or 1
    sizes = [hidden, *(config.get("field_units") or ()), *(config.get("decoder_units") or ())]
    cell = config.get("cell") not in (None, "none")
    largest = max((one * other for one, other in itertools.pairwise(sizes)), default=0)
    if max(*sizes, 1) > count or largest > 100 * count or (cell and hidden * hidden > count):
        raise ValueError(f"its config asks for layers of {sizes[:5]} units, it has {count} weights")
    for inner in config.values():
        if isinstance(inner, Mapping):
            _check_sizes(inner, weights)


def _digest(record: dict[str, Any]) -> str:
    text = json.dumps(record, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()
