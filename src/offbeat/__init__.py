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
    from offbeat.data.prepare import Scaler, parts, split, split_in_time, windows
    from offbeat.data.readers import read
    from offbeat.data.simulate import simulate
    from offbeat.data.store import load, save
    from offbeat.data.thin import thin
    from offbeat.data.trajectory import Dataset, Trajectory
    from offbeat.evaluation import Evaluation, evaluate
    from offbeat.inference.export import export_onnx
    from offbeat.inference.extrapolate import extrapolate
    from offbeat.inference.impute import fit_two_sided, impute, load_two_sided, save_two_sided
    from offbeat.inference.onnx_runner import OnnxStream
    from offbeat.inference.policies import StreamPolicies
    from offbeat.inference.predict import predict
    from offbeat.inference.scoring import score_extrapolation, score_imputation
    from offbeat.inference.stream import Stream
    from offbeat.inference.two_sided import TwoSided
    from offbeat.models.checkpoint import load_checkpoint, save_checkpoint
    from offbeat.models.recurrence import RecurrentModel
    from offbeat.models.zoo import THESIS_MODELS, make, thesis_config, train_config
    from offbeat.report.comparison import Comparison, compare, read_runs
    from offbeat.report.reproduction import write_report
    from offbeat.scores import Score, Scores, row_0_constant
    from offbeat.training import FitResult, fit

__version__ = "0.1.0"

_HOMES = {
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
    "THESIS_MODELS": "models.zoo",
    "Trajectory": "data.trajectory",
    "TwoSided": "inference.two_sided",
    "compare": "report.comparison",
    "delta": "data.batch",
    "evaluate": "evaluation",
    "export_onnx": "inference.export",
    "extrapolate": "inference.extrapolate",
    "fit": "training",
    "fit_two_sided": "inference.impute",
    "impute": "inference.impute",
    "last_values": "data.batch",
    "load": "data.store",
    "load_checkpoint": "models.checkpoint",
    "load_two_sided": "inference.impute",
    "make": "models.zoo",
    "parts": "data.prepare",
    "predict": "inference.predict",
    "read": "data.readers",
    "read_runs": "report.comparison",
    "row_0_constant": "scores",
    "save": "data.store",
    "save_checkpoint": "models.checkpoint",
    "save_two_sided": "inference.impute",
    "score_extrapolation": "inference.scoring",
    "score_imputation": "inference.scoring",
    "simulate": "data.simulate",
    "split": "data.prepare",
    "split_in_time": "data.prepare",
    "thesis_config": "models.zoo",
    "thin": "data.thin",
    "train_config": "models.zoo",
    "windows": "data.prepare",
    "write_report": "report.reproduction",
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
    "TwoSided",
    "compare",
    "delta",
    "evaluate",
    "export_onnx",
    "extrapolate",
    "fit",
    "fit_two_sided",
    "impute",
    "last_values",
    "load",
    "load_checkpoint",
    "load_two_sided",
    "make",
    "parts",
    "predict",
    "read",
    "read_runs",
    "row_0_constant",
    "save",
    "save_checkpoint",
    "save_two_sided",
    "score_extrapolation",
    "score_imputation",
    "simulate",
    "split",
    "split_in_time",
    "thesis_config",
    "thin",
    "train_config",
    "windows",
    "write_report",
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
