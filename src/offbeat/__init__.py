"""Offbeat: learning robot motion from trajectories sampled at uneven times."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from offbeat.config import ModelConfig, RedrawConfig, SplitConfig, TaskConfig, TrainConfig
from offbeat.errors import (
    DivergenceError,
    FileFormatError,
    InputError,
    MissingExtraError,
    OffbeatError,
)

if TYPE_CHECKING:
    from offbeat import baselines
    from offbeat.answers.answer import Answer
    from offbeat.answers.backward import fit_backward
    from offbeat.answers.blend import Blend, fit_blend
    from offbeat.answers.forecast import forecast
    from offbeat.answers.impute import impute
    from offbeat.answers.predict import predict
    from offbeat.answers.resample import resample
    from offbeat.answers.saved import load_run
    from offbeat.comparison import Comparison, compare
    from offbeat.data.batch import Batch
    from offbeat.data.frames import from_pandas, to_pandas
    from offbeat.data.inspection import inspect
    from offbeat.data.loaders import data_loader
    from offbeat.data.masking import mask_out
    from offbeat.data.readers import read, register_reader
    from offbeat.data.robots import register_robot
    from offbeat.data.scaler import Scaler
    from offbeat.data.simulate import simulate
    from offbeat.data.splits import split
    from offbeat.data.store import load
    from offbeat.data.trajectory import Dataset, Trajectory
    from offbeat.data.windows import windows
    from offbeat.data.writers import register_writer, save
    from offbeat.evaluation import evaluate
    from offbeat.export.exporter import export_onnx
    from offbeat.export.runner import OnnxStream
    from offbeat.kernels.backends import register_backend
    from offbeat.learning import learn
    from offbeat.metrics import Scores
    from offbeat.models.checkpoint import load_model
    from offbeat.models.model import Model
    from offbeat.models.zoo import list_models, make_model, register_model
    from offbeat.parts import Prediction, register_part
    from offbeat.policies import Policy, fit_policy
    from offbeat.stream.options import StreamOptions
    from offbeat.stream.stream import Stream
    from offbeat.sweeps.sweep import sweep
    from offbeat.training import FitResult, fit

__version__ = "1.0.0rc1"

_PUBLIC = {
    "Answer": "answers.answer",
    "Batch": "data.batch",
    "Blend": "answers.blend",
    "Comparison": "comparison",
    "Dataset": "data.trajectory",
    "FitResult": "training",
    "Model": "models.model",
    "OnnxStream": "export.runner",
    "Policy": "policies",
    "Prediction": "parts",
    "Scaler": "data.scaler",
    "Scores": "metrics",
    "Stream": "stream.stream",
    "StreamOptions": "stream.options",
    "Trajectory": "data.trajectory",
    "compare": "comparison",
    "data_loader": "data.loaders",
    "evaluate": "evaluation",
    "export_onnx": "export.exporter",
    "fit": "training",
    "fit_backward": "answers.backward",
    "fit_blend": "answers.blend",
    "fit_policy": "policies",
    "forecast": "answers.forecast",
    "from_pandas": "data.frames",
    "impute": "answers.impute",
    "inspect": "data.inspection",
    "learn": "learning",
    "list_models": "models.zoo",
    "load": "data.store",
    "load_model": "models.checkpoint",
    "load_run": "answers.saved",
    "make_model": "models.zoo",
    "mask_out": "data.masking",
    "predict": "answers.predict",
    "read": "data.readers",
    "register_backend": "kernels.backends",
    "register_model": "models.zoo",
    "register_part": "parts",
    "register_reader": "data.readers",
    "register_robot": "data.robots",
    "register_writer": "data.writers",
    "resample": "answers.resample",
    "save": "data.writers",
    "simulate": "data.simulate",
    "split": "data.splits",
    "sweep": "sweeps.sweep",
    "to_pandas": "data.frames",
    "windows": "data.windows",
}
"""Modules of the public names."""

_FURTHER = {
    "BaseModel": "models.base",
    "DataInfo": "models.base",
    "Evaluation": "evaluation",
    "Score": "metrics",
    "SweepResult": "sweeps.running",
    "THESIS_MODELS": "models.zoo",
    "apply_split": "data.splits",
    "delta": "data.batch",
    "extrapolate": "answers.forecast",
    "last_values": "data.batch",
    "read_runs": "comparison",
    "row_0_constant": "metrics",
    "save_model": "models.checkpoint",
    "score_forecast": "answers.scoring",
    "score_imputation": "answers.scoring",
    "split_in_time": "data.splits",
    "thesis_config": "models.zoo",
    "train_config": "models.zoo",
}
"""Modules of further names, for custom protocols; not in `__all__`."""

_RENAMED = {
    "PartsConfig": "SplitConfig",
    "RecurrentModel": "Model",
    "StreamPolicies": "StreamOptions",
    "TwoSided": "Blend",
    "fit_two_sided": "learn, or fit, fit_backward and fit_blend",
    "load_two_sided": "load_run",
    "save_two_sided": "Blend.save",
    "load_checkpoint": "load_model",
    "make": "make_model",
    "parts": "offbeat.data.splits.apply_split",
    "save_checkpoint": "Model.save",
    "score_extrapolation": "offbeat.answers.scoring.score_forecast",
    "thin": "mask_out",
    "write_report": "thesis.report.reproduction.write_report",
}
"""Names of 0.1.0 and their replacements."""

__all__ = [
    "Answer",
    "Batch",
    "Blend",
    "Comparison",
    "Dataset",
    "DivergenceError",
    "FileFormatError",
    "FitResult",
    "InputError",
    "MissingExtraError",
    "Model",
    "ModelConfig",
    "OffbeatError",
    "OnnxStream",
    "Policy",
    "Prediction",
    "RedrawConfig",
    "Scaler",
    "Scores",
    "SplitConfig",
    "Stream",
    "StreamOptions",
    "TaskConfig",
    "TrainConfig",
    "Trajectory",
    "baselines",
    "compare",
    "data_loader",
    "evaluate",
    "export_onnx",
    "fit",
    "fit_backward",
    "fit_blend",
    "fit_policy",
    "forecast",
    "from_pandas",
    "impute",
    "inspect",
    "learn",
    "list_models",
    "load",
    "load_model",
    "load_run",
    "make_model",
    "mask_out",
    "predict",
    "read",
    "register_backend",
    "register_model",
    "register_part",
    "register_reader",
    "register_robot",
    "register_writer",
    "resample",
    "save",
    "simulate",
    "split",
    "sweep",
    "to_pandas",
    "windows",
]


def __getattr__(name: str) -> Any:
    """Imports a public name at its first use, so that `offbeat --help` does not import torch."""
    if name == "baselines":
        return importlib.import_module("offbeat.baselines")
    home = _PUBLIC.get(name) or _FURTHER.get(name)
    if home is None:
        new = f"; it is {_RENAMED[name]} since 0.2" if name in _RENAMED else ""
        raise AttributeError(f"module 'offbeat' has no attribute {name!r}{new}")
    value = getattr(importlib.import_module(f"offbeat.{home}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
