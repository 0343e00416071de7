"""Offbeat: learning robot motion from trajectories sampled at uneven times."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from offbeat.config import ModelConfig, SplitConfig, TrainConfig
from offbeat.errors import (
    DivergenceError,
    FileFormatError,
    InputError,
    MissingExtraError,
    OffbeatError,
)

if TYPE_CHECKING:
    from offbeat.answers.forecast import extrapolate, forecast
    from offbeat.answers.impute import fit_two_sided, impute, load_two_sided, save_two_sided
    from offbeat.answers.predict import predict
    from offbeat.answers.scoring import score_forecast, score_imputation
    from offbeat.answers.two_sided import TwoSided
    from offbeat.comparison import Comparison, compare, read_runs
    from offbeat.data.batch import Batch, delta, last_values
    from offbeat.data.frames import from_pandas, to_pandas
    from offbeat.data.inspection import inspect
    from offbeat.data.masking import mask_out
    from offbeat.data.readers import read, register_reader
    from offbeat.data.robots import register_robot
    from offbeat.data.scaler import Scaler
    from offbeat.data.simulate import simulate
    from offbeat.data.splits import apply_split, split, split_in_time
    from offbeat.data.store import load
    from offbeat.data.trajectory import Dataset, Trajectory
    from offbeat.data.windows import windows
    from offbeat.data.writers import register_writer, save
    from offbeat.evaluation import Evaluation, evaluate
    from offbeat.export.exporter import export_onnx
    from offbeat.export.runner import OnnxStream
    from offbeat.kernels.backends import register_backend
    from offbeat.metrics import Score, Scores, row_0_constant
    from offbeat.models.base import BaseModel, DataInfo
    from offbeat.models.checkpoint import load_model, save_model
    from offbeat.models.model import Model
    from offbeat.models.zoo import (
        THESIS_MODELS,
        list_models,
        make_model,
        register_model,
        thesis_config,
        train_config,
    )
    from offbeat.parts import Prediction, register_part
    from offbeat.stream.options import StreamOptions
    from offbeat.stream.stream import Stream
    from offbeat.sweeps.running import SweepResult
    from offbeat.sweeps.sweep import sweep
    from offbeat.training import FitResult, fit

__version__ = "0.2.0"

_HOMES = {
    "BaseModel": "models.base",
    "Batch": "data.batch",
    "Comparison": "comparison",
    "DataInfo": "models.base",
    "Dataset": "data.trajectory",
    "Evaluation": "evaluation",
    "FitResult": "training",
    "Model": "models.model",
    "OnnxStream": "export.runner",
    "Prediction": "parts",
    "Scaler": "data.scaler",
    "Score": "metrics",
    "Scores": "metrics",
    "Stream": "stream.stream",
    "StreamOptions": "stream.options",
    "SweepResult": "sweeps.running",
    "THESIS_MODELS": "models.zoo",
    "Trajectory": "data.trajectory",
    "TwoSided": "answers.two_sided",
    "apply_split": "data.splits",
    "compare": "comparison",
    "delta": "data.batch",
    "evaluate": "evaluation",
    "export_onnx": "export.exporter",
    "extrapolate": "answers.forecast",
    "fit": "training",
    "fit_two_sided": "answers.impute",
    "forecast": "answers.forecast",
    "from_pandas": "data.frames",
    "impute": "answers.impute",
    "inspect": "data.inspection",
    "last_values": "data.batch",
    "list_models": "models.zoo",
    "load": "data.store",
    "load_model": "models.checkpoint",
    "load_two_sided": "answers.impute",
    "make_model": "models.zoo",
    "mask_out": "data.masking",
    "predict": "answers.predict",
    "read": "data.readers",
    "read_runs": "comparison",
    "register_backend": "kernels.backends",
    "register_model": "models.zoo",
    "register_part": "parts",
    "register_reader": "data.readers",
    "register_robot": "data.robots",
    "register_writer": "data.writers",
    "row_0_constant": "metrics",
    "save": "data.writers",
    "save_model": "models.checkpoint",
    "save_two_sided": "answers.impute",
    "score_forecast": "answers.scoring",
    "score_imputation": "answers.scoring",
    "simulate": "data.simulate",
    "split": "data.splits",
    "split_in_time": "data.splits",
    "sweep": "sweeps.sweep",
    "thesis_config": "models.zoo",
    "to_pandas": "data.frames",
    "train_config": "models.zoo",
    "windows": "data.windows",
}

__all__ = [
    "THESIS_MODELS",
    "BaseModel",
    "Batch",
    "Comparison",
    "DataInfo",
    "Dataset",
    "DivergenceError",
    "Evaluation",
    "FileFormatError",
    "FitResult",
    "InputError",
    "MissingExtraError",
    "Model",
    "ModelConfig",
    "OffbeatError",
    "OnnxStream",
    "Prediction",
    "Scaler",
    "Score",
    "Scores",
    "SplitConfig",
    "Stream",
    "StreamOptions",
    "SweepResult",
    "TrainConfig",
    "Trajectory",
    "TwoSided",
    "apply_split",
    "compare",
    "delta",
    "evaluate",
    "export_onnx",
    "extrapolate",
    "fit",
    "fit_two_sided",
    "forecast",
    "from_pandas",
    "impute",
    "inspect",
    "last_values",
    "list_models",
    "load",
    "load_model",
    "load_two_sided",
    "make_model",
    "mask_out",
    "predict",
    "read",
    "read_runs",
    "register_backend",
    "register_model",
    "register_part",
    "register_reader",
    "register_robot",
    "register_writer",
    "row_0_constant",
    "save",
    "save_model",
    "save_two_sided",
    "score_forecast",
    "score_imputation",
    "simulate",
    "split",
    "split_in_time",
    "sweep",
    "thesis_config",
    "to_pandas",
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
