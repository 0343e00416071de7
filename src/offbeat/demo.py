"""The demo: from simulation to a comparison of models in two minutes."""

from __future__ import annotations

import csv
import io
import json
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from offbeat.answers.predict import predict
from offbeat.data.masking import mask_out
from offbeat.data.scaler import Scaler
from offbeat.data.simulate import available_cores, simulate
from offbeat.data.splits import split
from offbeat.data.store import save
from offbeat.data.trajectory import Dataset, Trajectory
from offbeat.data.windows import windows
from offbeat.errors import InputError, MissingExtraError
from offbeat.evaluation import LAST_VALUE, Evaluation, evaluate
from offbeat.files import write_json, write_text
from offbeat.metrics import SCORINGS
from offbeat.models.checkpoint import load_model
from offbeat.models.model import Model
from offbeat.models.zoo import THESIS_MODELS, train_config
from offbeat.plots import figures
from offbeat.plots.animation import side_by_side
from offbeat.plots.style import style_of
from offbeat.run import EpochRecord
from offbeat.sweeps.side_by_side import Job, one_thread, train_side_by_side

ROBOT = "hopper"
OBSERVED_FRACTION = 0.3
ROWS = 100
ANCHORED = "anchored_ode_gru_d"
_PARTS = ("train", "validation", "test")
CHANNELS = ("rootz_qpos", "rooty_qpos", "knee_qpos", "knee_qvel")
"""Channels of the figure: height and pitch of the torso, angle and speed of the knee."""

PROTOCOL_SEED = 123  # of the initial states, as in the protocol
FULL_STEPS = {**dict.fromkeys(THESIS_MODELS, 7000), ANCHORED: 2100}
"""Steps of a full-size run: 7,000 trajectories, batches of 50, 50 epochs or 15."""


@dataclass(frozen=True)
class Training:
    """The training of one model in the demo.

    Attributes:
        history: one record per epoch.
        full_steps: optimizer steps of a full-size run.
    """

    history: tuple[EpochRecord, ...]
    full_steps: int

    @property
    def steps(self) -> int:
        """Optimizer steps done."""
        return self.history[-1].steps

    @property
    def seconds(self) -> float:
        """Wall time of the training, s."""
        return sum(record.seconds for record in self.history)

    @property
    def under_trained(self) -> bool:
        """Whether it took fewer steps than a full-size run."""
        return self.steps < self.full_steps

    def note(self) -> str:
        """The note at the end of a row of the table."""
        took = f"{self.steps} of {self.full_steps} steps, {self.seconds:.0f} s"
        return f"under-trained: {took}" if self.under_trained else took


@dataclass(frozen=True)
class DemoResult:
    """Scores and files of the demo, shown by `print`.

    Attributes:
        folder: of all files.
        evaluation: every model and the last-value predictor on the test part.
        trainings: by model.
        written: files and folders, relative to `folder`, each with its description.
        messages: steps that could not be done, with reasons.
        seconds: wall time of this call.
    """

    folder: Path
    evaluation: Evaluation
    trainings: Mapping[str, Training]
    written: Mapping[str, str]
    messages: tuple[str, ...]
    seconds: float

    def __str__(self) -> str:
        notes = {name: training.note() for name, training in self.trainings.items()}
        width = max(map(len, self.written))
        run, data = self.folder / "models" / ANCHORED, self.folder / "data" / "test.parquet"
        lines = [
            f"One-step-ahead prediction of {self.evaluation.trajectories} {ROBOT} trajectories of "
            f"the test part, {100 * OBSERVED_FRACTION:.0f} % of the rows observed.",
            "Errors are in the units of the thesis: (x - min) / max per channel, over all data.",
            "",
            self.evaluation.table(notes={**notes, LAST_VALUE: "nothing to train"}),
            "",
            "Models marked as under-trained were stopped early to keep the demo short: the table "
            "does not rank them.",
            *self.messages,
            "",
            f"Written to {self.folder} in {self.seconds:.0f} s:",
            *(f"  {name.ljust(width)}  {about}" for name, about in self.written.items()),
            "",
            f"Next: offbeat evaluate {run} {data}",
        ]
        return "\n".join(lines)

    def to_dict(self) -> dict[str, Any]:
        """JSON-like form."""
        return {
            "folder": str(self.folder),
            **self.evaluation.to_dict(),
            "training": {
                name: {
                    "steps": training.steps,
                    "full_steps": training.full_steps,
                    "seconds": training.seconds,
                    "under_trained": training.under_trained,
                }
                for name, training in self.trainings.items()
            },
            "written": list(self.written),
            "messages": list(self.messages),
            "seconds": self.seconds,
        }


def run_demo(
    out: str | Path = "runs/demo",
    *,
    seed: int = 0,
    n_trajectories: int = 4000,
    epochs: int = 5,
    anchored_epochs: int = 12,
    workers: int | None = None,
    progress: bool = True,
) -> DemoResult:
    """Simulates a hopper, masks rows, trains five models, scores them and plots the results.

    Training stops long before the models of the thesis converge, which the result states. A demo
    that was stopped is resumed. Results do not depend on `workers`.

    Args:
        out: folder to write to.
        seed: of windows, masks, split, weights and batches.
        n_trajectories: to simulate; 70 % of them are trained on.
        epochs: of the models of the thesis.
        anchored_epochs: of the anchored model.
        workers: models trained side by side, each in a process with one thread; by default 2, or
            1 where there is one core. With 1, this process trains.
        progress: show progress bars on standard error.

    Returns:
        Scores and files; `print` shows them.

    Raises:
        InputError: an argument is out of bounds, or `out` holds a demo with other settings.
        MissingExtraError: mujoco is not installed.
    """
    started = time.perf_counter()
    out = Path(out)
    if workers is not None and workers < 1:
        raise InputError(f"workers must be at least 1, got {workers}")
    if workers is None:
        workers = min(2, available_cores())
    settings = {
        "robot": ROBOT,
        "observed_fraction": OBSERVED_FRACTION,
        "seed": seed,
        "n_trajectories": n_trajectories,
        "epochs": epochs,
        "anchored_epochs": anchored_epochs,
    }
    # The longest first, so that two workers end at about the same time.
    configs = {
        name: train_config(name, epochs=anchored_epochs if name == ANCHORED else epochs, seed=seed)
        for name in (ANCHORED, *reversed(THESIS_MODELS))
    }
    _check_folder(out, settings)
    recorded = simulate(ROBOT, n_trajectories, 2 * ROWS, seed=PROTOCOL_SEED, progress=progress)
    scaler = Scaler.fit("divide_by_max", recorded)
    masked = mask_out(windows(recorded, ROWS, seed=seed), OBSERVED_FRACTION, seed=seed)
    parts = dict(zip(_PARTS, split(masked, seed=seed), strict=True))
    write_json(out / "settings.json", settings)
    for name, part in parts.items():
        save(part, out / "data" / f"{name}.parquet")
    data = out / "data"
    jobs = {
        name: Job(
            name,
            config,
            scaler,
            data / "train.parquet",
            data / "validation.parquet",
            out / "models" / name,
        )
        for name, config in configs.items()
    }
    train_side_by_side(list(jobs.values()), workers=workers, progress=progress)
    trainings = {name: Training(jobs[name].history(), full) for name, full in FULL_STEPS.items()}
    with one_thread():
        models = {name: load_model(jobs[name].folder) for name in FULL_STEPS}
        evaluation = evaluate(models, parts["test"], seed=seed)
        _write_scores(out, evaluation, trainings)
        # The window that starts soonest after the release, chosen without looking at errors.
        shown = min(parts["test"], key=lambda trajectory: float(trajectory.times[0]))
        _draw_curves(out, models, parts["validation"], trainings)
        _draw_predictions(out, models, shown)
        messages = _animate(out, models[ANCHORED], shown)
    return DemoResult(
        out,
        evaluation,
        trainings,
        {name: about for name, about in _WRITTEN.items() if (out / name).exists()},
        messages,
        time.perf_counter() - started,
    )


_WRITTEN = {
    "results.csv": "a line per predictor",
    "results.json": "all scores, per channel and by time since the last observation",
    "learning_curves.png": "validation error while training",
    "predictions.png": "four channels of one test trajectory, each model one step ahead",
    "hopper.gif": "the same trajectory, simulated and predicted one step ahead",
    "hopper_extrapolation.gif": "the same, with no observation after the middle",
    "models": "a run per model: log.csv, checkpoints, the trained model",
    "data": "training, validation and test part",
    "settings.json": "the settings of this folder",
}


def _check_folder(out: Path, settings: Mapping[str, Any]) -> None:
    if out.exists() and not out.is_dir():
        raise InputError(f"{out} is a file; the demo needs a folder to write to")
    record = out / "settings.json"
    if not record.exists():
        return
    try:
        then = dict(json.loads(record.read_text(encoding="utf-8")))
    except (ValueError, TypeError):
        then = {}
    changed = {k: v for k, v in settings.items() if then.get(k) != v}
    other = [f"{k} ({then.get(k)!r} then, {v!r} now)" for k, v in changed.items()]
    if other:
        raise InputError(
            f"{out} holds a demo with another {', '.join(other)}; give the same, or another folder"
        )


def _write_scores(out: Path, evaluation: Evaluation, trainings: Mapping[str, Training]) -> None:
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    measured = [f"{scoring}_rmse" for scoring in SCORINGS]
    table.writerow(["model", "steps", "epochs", "training_seconds", *measured, "under_trained"])
    for name, scores in evaluation.scores.items():
        trained = trainings.get(name)
        table.writerow(
            [
                name,
                trained.steps if trained else 0,
                len(trained.history) if trained else 0,
                round(trained.seconds, 2) if trained else 0,
                *(getattr(scores, scoring).rmse for scoring in SCORINGS),
                str(trained.under_trained if trained else False).lower(),
            ]
        )
    write_text(out / "results.csv", text.getvalue())
    write_json(out / "results.json", evaluation.to_dict())


def _draw_curves(
    out: Path,
    models: Mapping[str, Model],
    validation: Dataset,
    trainings: Mapping[str, Training],
) -> None:
    trivial = evaluate(models[THESIS_MODELS[0]], validation).scores[LAST_VALUE]
    figure = figures.learning_curves(
        {name: training.history for name, training in trainings.items()},
        last_value_rmse=trivial.after_first_observation.rmse,
        x="steps",
        units="divide_by_max units",
    )
    figures.save(figure, out / "learning_curves.png")


def _draw_predictions(out: Path, models: Mapping[str, Model], shown: Trajectory) -> None:
    asked = Dataset((shown,))
    figure = figures.predictions(
        shown,
        {name: predict(model, asked)[0] for name, model in models.items()},
        CHANNELS,
        title=f"One-step-ahead predictions of a test trajectory ({shown.origin})",
    )
    figures.save(figure, out / "predictions.png")


def _animate(out: Path, model: Model, shown: Trajectory) -> tuple[str, ...]:
    """Writes two GIFs of one trajectory; returns why not, where MuJoCo cannot render."""
    free = ROWS // 2
    unseen = shown.observed & (np.arange(shown.rows) < free)[:, None]
    label = style_of(model.config.name).label
    views = {
        "hopper.gif": (shown, f"{label}: each row predicted from the observed rows before it"),
        "hopper_extrapolation.gif": (
            replace(shown, observed=unseen),
            f"{label}: nothing observed from "
            f"{1e3 * (shown.times[free] - shown.times[0]):.0f} ms on",
        ),
    }
    qpos = [i for i, name in enumerate(shown.names) if name.endswith("_qpos")]
    for name, (trajectory, caption) in views.items():
        predicted = predict(model, Dataset((trajectory,)))[0]
        try:
            side_by_side(
                ROBOT,
                trajectory.values[:, qpos],
                predicted.values[:, qpos],
                out / name,
                times=trajectory.times,
                observed=trajectory.observed.any(axis=1),
                labels=("simulated", "predicted (blue: simulated)"),
                caption=caption,
            )
        except MissingExtraError as error:
            return (f"No animation: {error}.",)
    return ()
