"""One run of the protocol, in any process on any machine: the same numbers, and done once."""

from __future__ import annotations

import json
import math
import os
import shutil
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from functools import lru_cache
from pathlib import Path
from typing import Any

from offbeat.data.scaler import Scaler
from offbeat.data.store import load
from offbeat.data.trajectory import Dataset
from offbeat.errors import DivergenceError, FileFormatError
from offbeat.evaluation import LAST_VALUE, evaluate
from offbeat.files import write_json
from offbeat.metrics import row_0_constant
from offbeat.models.model import Model
from offbeat.models.zoo import make_model
from offbeat.sweeps.side_by_side import threads_of_torch
from offbeat.training import fit
from thesis.protocol import Protocol, Run
from thesis.provenance import Provenance
from thesis.record import RUN_COLUMNS, SCORINGS, Row, read_log

CONFIG, SCORES, TRAINING = "config.json", "scores.json", "training"


@dataclass(frozen=True)
class Task:
    """One run to do: small, and the same in any process.

    Attributes:
        run: what to train.
        protocol: how.
        recorded: file of the recorded trajectories.
        fingerprint: of their content.
        folder: of the run: config.json, training/ (log.csv, checkpoints, model), scores.json.
        threads: of torch.
    """

    run: Run
    protocol: Protocol
    recorded: Path
    fingerprint: str
    folder: Path
    threads: int = 1

    def log(self) -> tuple[Row, ...]:
        """The curve of the run, as far as it has come."""
        return read_log(self.folder / TRAINING / "log.csv")

    def result(self) -> Row | None:
        """The run's row of the record, or None if the run is not finished."""
        try:
            kept = json.loads((self.folder / SCORES).read_text(encoding="utf-8"))["run"]
        except FileNotFoundError:
            return None
        except (ValueError, KeyError, TypeError) as error:
            raise FileFormatError(
                f"{self.folder / SCORES} is damaged ({error}); remove it, and the run is scored "
                "again"
            ) from None
        return {k: math.nan if kept[k] is None else kept[k] for k in RUN_COLUMNS}


def execute(task: Task) -> None:
    """Trains a model and scores it, or goes on where a process that was killed left off.

    A finished run is left alone, and a run that another process works on is waited for, so none is
    done twice. A run that was begun by other code, on another processor or with another scan
    backend is begun again: a run is never made half by one and half by the other.

    Args:
        task: what to do.

    Raises:
        DivergenceError: the training left the finite numbers.
        FileFormatError: the recorded trajectories are not those of the task.
        OSError: the disk is full.
    """
    task.folder.mkdir(parents=True, exist_ok=True)
    with threads_of_torch(task.threads), _locked(task.folder / ".lock"):
        if task.result() is None:
            _execute(task)


def _execute(task: Task) -> None:
    run, here = task.run, Provenance.here()
    train, validation, test, scaler, mujoco = _drawn(
        str(task.recorded), task.fingerprint, task.protocol, _Draw.of(run)
    )
    model = make_model(
        task.protocol.model_config(run.model), train, scaler=scaler, seed=run.seed_weights
    )
    training = task.protocol.train_config(run)
    config = {
        "run": {**asdict(run), "run_id": run.run_id},
        "protocol": asdict(task.protocol),
        "model": asdict(model.config),
        "training": asdict(training),
        "data": task.fingerprint,
        "threads": task.threads,
        "provenance": asdict(here),
    }
    before = _take_up(task.folder, config)
    started = time.time()
    write_json(task.folder / CONFIG, {**config, "began": started, "seconds_before": before})
    try:
        fitted = fit(model, train, validation, training, out=task.folder / TRAINING, progress=False)
    except FileFormatError:  # a power cut can leave a checkpoint that is not whole
        shutil.rmtree(task.folder / TRAINING)
        before, started = 0.0, time.time()
        model = make_model(model.config, train, scaler=scaler, seed=run.seed_weights)
        fitted = fit(model, train, validation, training, out=task.folder / TRAINING, progress=False)
    evaluation = evaluate({run.model: model}, test, seed=run.seed_draw)
    ours, trivial = evaluation.scores[run.model], evaluation.scores[LAST_VALUE]
    row: dict[str, Any] = {
        "run_id": run.run_id,
        **asdict(run),
        "steps": fitted.steps,
        **{f"{name}_mse": getattr(ours, score).mse for name, score in SCORINGS.items()},
        **{
            f"last_value_{name}_mse": getattr(trivial, score).mse
            for name, score in SCORINGS.items()
        },
        **_rows_0(model, test),
        "validation_published_mse": fitted.history[-1].validation_published_mse,
        "seconds": before + time.time() - started,
        **asdict(here),
        "threads": task.threads,
        "mujoco": mujoco,
        "data": task.fingerprint[:12],
        "finished_at": datetime.now(UTC).isoformat(timespec="seconds"),
    }
    if not all(math.isfinite(row[f"{name}_mse"]) for name in ("published", "honest")):
        raise DivergenceError(f"the scores of {run.run_id} on the test part are not finite")
    kept = {k: None if row[k] != row[k] else row[k] for k in RUN_COLUMNS}
    write_json(task.folder / SCORES, {"run": kept, "evaluation": evaluation.to_dict()})


def _take_up(folder: Path, config: dict[str, Any]) -> float:
    """Prepares the folder of a run; returns the wall time that went into it before, s."""
    try:
        kept = json.loads((folder / CONFIG).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        kept = {}
    if _comparable(kept, config) != _comparable(json.loads(json.dumps(config)), config):
        shutil.rmtree(folder / TRAINING, ignore_errors=True)
        return 0.0
    log = folder / TRAINING / "log.csv"
    alive = log.stat().st_mtime if log.exists() else 0.0
    before, began = float(kept["seconds_before"]), float(kept["began"])
    return before + max(0.0, alive - began) if alive else 0.0


def _comparable(kept: Any, keys: Iterable[str]) -> dict[str, Any]:
    """What must be the same for a run to go on: all but the commit, which is a name."""
    part: dict[str, Any] = {key: kept.get(key) for key in keys} if isinstance(kept, dict) else {}
    made = part.get("provenance")
    if isinstance(made, dict):
        part["provenance"] = {k: v for k, v in made.items() if k != "commit"}
    return part


def _rows_0(model: Model, test: Dataset) -> dict[str, float]:
    """The constant c of the masked first rows, and their fraction."""
    batch = model.batch(test)
    hidden = ~batch.mask[:, 0].any(dim=1)
    return {
        "row_0_constant": row_0_constant(batch),
        "hidden_rows_0_share": float(hidden.double().mean()),
    }


# --- data, kept from run to run -------------------------------------------------------------------


@dataclass(frozen=True)
class _Draw:
    """What the parts of a run depend on; the models of a repeat share it."""

    observed_fraction: float
    seed_draw: int

    @classmethod
    def of(cls, run: Run) -> _Draw:
        return cls(run.observed_fraction, run.seed_draw)

    def run(self) -> Run:
        return Run(0, "", self.observed_fraction, 0, 0, self.seed_draw, 0)


@lru_cache(maxsize=1)
def _drawn(
    path: str, fingerprint: str, protocol: Protocol, draw: _Draw
) -> tuple[Dataset, Dataset, Dataset, Scaler, str]:
    recorded, scaler = _recorded(path, fingerprint, protocol.scaler)
    versions = recorded.meta.get("versions", {})
    return *protocol.cut(recorded, draw.run()), scaler, str(versions.get("mujoco", "unknown"))


@lru_cache(maxsize=1)
def _recorded(path: str, fingerprint: str, scaler: str) -> tuple[Dataset, Scaler]:
    recorded = load(path)
    if recorded.fingerprint() != fingerprint:
        raise FileFormatError(
            f"{path} does not hold the trajectories that were recorded for this experiment; remove "
            "it, and the same command simulates them again"
        )
    return recorded, Scaler.fit(scaler, recorded)


@contextmanager
def _locked(path: Path) -> Iterator[None]:
    """Holds a file for this process, whose id it names; waits for another one that holds it."""
    with path.open("a") as file:
        if os.name == "posix":
            import fcntl

            fcntl.flock(file, fcntl.LOCK_EX)
        file.truncate(0)
        file.write(str(os.getpid()))
        file.flush()
        yield
