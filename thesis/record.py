"""The record of the thesis' runs, with its original column names."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

from offbeat.sweeps import record

SCORINGS: dict[str, str] = {
    "honest": "after_first_observation",
    "honest_hidden": "masked",
    "rows_1_99": "after_first_row",
    "published": "published",
}
"""Names of the scorings in the record, each with its name in `offbeat.metrics.SCORINGS`. The record
was started with these names; "honest" is the score after the first observation."""

RUN_COLUMNS: dict[str, type] = {
    "run_id": str,
    "experiment": int,
    "model": str,
    "observed_fraction": float,
    "repeat": int,
    "epochs": int,
    "steps": int,
    "published_mse": float,
    "rows_1_99_mse": float,
    "honest_mse": float,
    "honest_hidden_mse": float,
    "last_value_published_mse": float,
    "last_value_rows_1_99_mse": float,
    "last_value_honest_mse": float,
    "last_value_honest_hidden_mse": float,
    "row_0_constant": float,
    "hidden_rows_0_share": float,
    "validation_published_mse": float,
    "seconds": float,
    "seed_draw": int,
    "seed_weights": int,
    "commit": str,
    "bits": str,
    "cpu": str,
    "kernel_body": str,
    "threads": int,
    "torch": str,
    "mujoco": str,
    "data": str,
    "finished_at": str,
}
"""Columns of the table of runs. Errors are mean squares on the test part, in scaled units;
`seconds` is wall time; `kernel_body` is the backend of the scan; `data` is a hash of the recorded
trajectories."""

CURVE_COLUMNS: dict[str, type] = {
    "run_id": str,
    "epoch": int,
    "train_mse": float,
    "validation_honest_mse": float,
    "validation_rows_1_99_mse": float,
    "validation_published_mse": float,
    "seconds": float,
}
"""Columns of the table of curves, a line per epoch; `seconds` is the training time of the epoch."""

LOG_COLUMNS: dict[str, str] = {
    **{name: name for name in CURVE_COLUMNS if name != "run_id"},
    "validation_honest_mse": "validation_mse",
    "validation_rows_1_99_mse": "validation_after_first_row_mse",
}
"""Columns of the table of curves, each with its name in the `log.csv` of a training."""

GROUP = ("bits", "cpu", "kernel_body", "torch", "data")
"""Runs that agree in these are comparable; others are never mixed without a mark."""


class Record(record.Record):
    """Finished runs of the protocol, each once, and their curves."""

    SCORINGS: ClassVar[Mapping[str, str]] = SCORINGS
    RUN_COLUMNS: ClassVar[Mapping[str, type]] = RUN_COLUMNS
    CURVE_COLUMNS: ClassVar[Mapping[str, type]] = CURVE_COLUMNS
    LOG_COLUMNS: ClassVar[Mapping[str, str]] = LOG_COLUMNS
    GROUP: ClassVar[tuple[str, ...]] = GROUP
