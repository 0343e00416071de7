"""One run of a sweep; gives the same numbers in any process and is performed once."""

from __future__ import annotations

import json
import math
import os
import shutil
import threading
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
from offbeat.models.zoo import make_model
from offbeat.sweeps.engines.base import threads_of_torch
from offbeat.sweeps.plan import Parts, Plan, Run
from offbeat.sweeps.record import Row
from offbeat.training import fit

CONFIG, SCORES, TRAINING = "config.json", "scores.json", "training"


@dataclass(frozen=True)
class Task:
    """One run: a small, picklable task that gives the same result in any process.

    Attributes:
        run: what to train.
        plan: the plan of the run.
        recorded: file of the recorded trajectories.
        fingerprint: of their content.
        folder: of the run: config.json, training/ (log.csv, checkpoints, model), scores.json.
        threads: of torch.
        device: that the model is trained on.
    """

    run: Run
    plan: Plan
    recorded: Path
    fingerprint: str
    folder: Path
    threads: int = 1
    device: str = "cpu"

    @property
    def name(self) -> str:
        """Id of the run."""
        return self.run.run_id

    def curve(self) -> tuple[Row, ...]:
        """The curve of the run so far."""
        return self.plan.record.curve(self.name, self.folder / TRAINING / "log.csv")

    def result(self) -> Row | None:
        """The run's row of the record, or None if the run is not finished."""
        try:
            kept = json.loads((self.folder / SCORES).read_text(encoding="utf-8"))["run"]
            return {
                k: math.nan if kept[k] is None else kept[k] for k in self.plan.record.RUN_COLUMNS
            }
        except FileNotFoundError:
            return None
        except (ValueError, KeyError, TypeError) as error:
            raise FileFormatError(
                f"{self.folder / SCORES} is damaged ({error}); remove it, and the run is scored "
                "again"
            ) from None

    def perform(self) -> None:
        """Trains and scores a model, or resumes where a killed process stopped.

        A finished run is kept, and a run of another process is waited for, so no run
        is performed twice. A run that other code, another processor or another scan
        backend started is restarted: no run mixes two provenances.

        Raises:
            DivergenceError: the training diverged.
            FileFormatError: the recorded trajectories are not those of the task.
            OSError: the disk is full.
        """
        self.folder.mkdir(parents=True, exist_ok=True)
        with threads_of_torch(self.threads), _locked(self.folder / ".lock"):
            if self.result() is None:
                self._perform()

    def _perform(self) -> None:
        run, plan, here = self.run, self.plan, self.plan.provenance()
        with _DRAWING:
            recorded = _recorded(self.recorded, self.fingerprint, plan)
            (train, validation, test), scaler = _drawn(self)
        chosen, training = plan.model_config(run.model), plan.train_config(run)
        model = make_model(chosen, train, scaler=scaler, seed=run.seed_weights)
        named: dict[str, Any] = {"run_id": run.run_id, **asdict(run)}  # type: ignore[call-overload]
        config = {
            "run": named,
            "plan": plan.settings(),
            "model": asdict(chosen),
            "training": asdict(training),
            "data": self.fingerprint,
            "threads": self.threads,
            "device": self.device,
            "provenance": here,
        }
        before = _prepare(self.folder, config)
        started, out = time.time(), self.folder / TRAINING
        write_json(self.folder / CONFIG, {**config, "began": started, "seconds_before": before})
        options: dict[str, Any] = {"out": out, "device": self.device, "progress": False}
        try:
            fitted = fit(model, train, validation, training, **options)
        except FileFormatError:  # a power failure can leave an incomplete checkpoint
            shutil.rmtree(out)
            before, started = 0.0, time.time()
            model = make_model(chosen, train, scaler=scaler, seed=run.seed_weights)
            fitted = fit(model, train, validation, training, **options)
        evaluation = evaluate({run.model: model}, test, seed=run.seed_draw)
        row: dict[str, Any] = {
            **named,
            "steps": fitted.steps,
            "validation_mse": fitted.history[-1].validation_mse,
            "validation_published_mse": fitted.history[-1].validation_published_mse,
            "seconds": before + time.time() - started,
            **here,
            "threads": self.threads,
            "device": self.device,
            "data": self.fingerprint[:12],
            "finished_at": datetime.now(UTC).isoformat(timespec="seconds"),
            **plan.columns(run, model, test, recorded),
        }
        for column, scoring in plan.record.SCORINGS.items():
            ours, trivial = evaluation.scores[run.model], evaluation.scores[LAST_VALUE]
            row[f"{column}_mse"] = getattr(ours, scoring).mse
            row[f"last_value_{column}_mse"] = getattr(trivial, scoring).mse
            if scoring != "masked" and not math.isfinite(row[f"{column}_mse"]):
                raise DivergenceError(f"the scores of {self.name} on the test part are not finite")
        kept = {k: None if row[k] != row[k] else row[k] for k in plan.record.RUN_COLUMNS}
        write_json(self.folder / SCORES, {"run": kept, "evaluation": evaluation.to_dict()})


def _prepare(folder: Path, config: dict[str, Any]) -> float:
    """Prepares the folder of a run; returns the wall time spent on it before, s."""
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
    """Settings that must be equal to resume a run: all except the commit."""
    part: dict[str, Any] = {key: kept.get(key) for key in keys} if isinstance(kept, dict) else {}
    made = part.get("provenance")
    if isinstance(made, dict):
        part["provenance"] = {k: v for k, v in made.items() if k != "commit"}
    return part


# --- data, kept between runs ----------------------------------------------------------------------

_LAST: dict[Any, tuple[Parts, Scaler]] = {}
"""The parts of the last repeat, which its models share."""


_DRAWING = threading.RLock()
"""Runs that are trained together are threads of one process."""


def _drawn(task: Task) -> tuple[Parts, Scaler]:
    key = (task.recorded, task.fingerprint, task.plan, task.plan.draw(task.run))
    if key not in _LAST:
        _LAST.clear()
        recorded = _recorded(task.recorded, task.fingerprint, task.plan)
        parts = task.plan.parts(recorded, task.run)
        _LAST[key] = (parts, task.plan.scaler(recorded, parts[0]))
    return _LAST[key]


@lru_cache(maxsize=1)
def _recorded(path: Path, fingerprint: str, plan: Plan) -> Dataset:
    recorded = load(path)
    if plan.fingerprint(recorded) != fingerprint:
        raise FileFormatError(
            f"{path} does not hold the trajectories of this sweep; remove it, and the same call "
            "writes them again"
        )
    return recorded


@contextmanager
def _locked(path: Path) -> Iterator[None]:
    """Locks a file for this process and writes its id; waits for a process that locks it."""
    with path.open("a") as file:
        if os.name == "posix":
            import fcntl

            fcntl.flock(file, fcntl.LOCK_EX)
        file.truncate(0)
        file.write(str(os.getpid()))
        file.flush()
        yield
