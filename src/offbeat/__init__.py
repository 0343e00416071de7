"""Offbeat: learning robot motion from trajectories sampled at uneven times."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from offbeat.config import ModelConfig, PartsConfig, TrainConfig
from offbeat.errors import (
    DivergenceError,
    FileFormatError,
    InputError,
    MissingExtraError,
    OffbeatError,
)

if TYPE_CHECKING:
    from offbeat.data.batch import Batch, delta, last_values
    from offbeat.data.prepare import Scaler, parts, split, windows
    from offbeat.data.readers import read
    from offbeat.data.simulate import simulate
    from offbeat.data.store import load, save
    from offbeat.data.thin import thin
    from offbeat.data.trajectory import Dataset, Trajectory
    from offbeat.evaluation import Evaluation, evaluate
    from offbeat.inference.export import export_onnx
    from offbeat.inference.onnx_runner import OnnxStream
    from offbeat.inference.policies import StreamPolicies
    from offbeat.inference.predict import predict
    from offbeat.inference.stream import Stream
    from offbeat.models.checkpoint import load_checkpoint, save_checkpoint
    from offbeat.models.recurrence import RecurrentModel
    from offbeat.models.zoo import THESIS_MODELS, make, thesis_config, train_config
    from offbeat.report.comparison import Comparison, compare, read_runs
    from offbeat.scores import Score, Scores, row_0_constant
    from offbeat.training import FitResult, fit

__version__ = "0.1.0"

_HOMES = {
    "THESIS_MODELS": "models.zoo",
    "Batch": "data.batch",
    "Comparison": "report.comparison",
    "Dataset": "data.trajectory",
    "Evaluation": "evaluation",
    "FitResult": "training",
    "OnnxStream": "inference.onnx_runner",
    "RecurrentModel": "models.recurrence",
    "Scaler": "data.prepare",
    "Score": "scores",
    "Scores": "scores",
    "Stream": "inference.stream",
    "StreamPolicies": "inference.policies",
    "Trajectory": "data.trajectory",
    "compare": "report.comparison",
    "delta": "data.batch",
    "evaluate": "evaluation",
    "export_onnx": "inference.export",
    "fit": "training",
    "last_values": "data.batch",
    "load": "data.store",
    "load_checkpoint": "models.checkpoint",
    "make": "models.zoo",
    "parts": "data.prepare",
    "predict": "inference.predict",
    "read": "data.readers",
    "read_runs": "report.comparison",
    "row_0_constant": "scores",
    "save": "data.store",
    "save_checkpoint": "models.checkpoint",
    "simulate": "data.simulate",
    "split": "data.prepare",
    "thesis_config": "models.zoo",
    "thin": "data.thin",
    "train_config": "models.zoo",
    "windows": "data.prepare",
}

__all__ = [
    "THESIS_MODELS",
    "Batch",
    "Comparison",
    "Dataset",
    "DivergenceError",
    "Evaluation",
    "FileFormatError",
    "FitResult",
    "InputError",
    "MissingExtraError",
    "ModelConfig",
    "OffbeatError",
    "OnnxStream",
    "PartsConfig",
    "RecurrentModel",
    "Scaler",
    "Score",
    "Scores",
    "Stream",
    "StreamPolicies",
    "TrainConfig",
    "Trajectory",
    "compare",
    "delta",
    "evaluate",
    "export_onnx",
    "fit",
    "last_values",
    "load",
    "load_checkpoint",
    "make",
    "parts",
    "predict",
    "read",
    "read_runs",
    "row_0_constant",
    "save",
    "save_checkpoint",
    "simulate",
    "split",
    "thesis_config",
    "thin",
    "train_config",
    "windows",
]


def __getattr__(name: str) -> Any:
    """Imports a public name when it is first asked for: `offbeat --help` needs no torch."""
    if name not in _HOMES:
        raise AttributeError(f"module 'offbeat' has no attribute {name!r}")
    value = getattr(importlib.import_module(f"offbeat.{_HOMES[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted([*globals(), *_HOMES])
