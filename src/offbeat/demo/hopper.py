"""The second half of the demo: models of a hopper, trained here and shipped, are compared."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from offbeat import baselines, tables
from offbeat.answers.predict import predict
from offbeat.data.masking import mask_out
from offbeat.data.scaler import Scaler
from offbeat.data.simulate import simulate
from offbeat.data.splits import split
from offbeat.data.trajectory import Dataset, Trajectory
from offbeat.data.windows import windows
from offbeat.errors import MissingExtraError
from offbeat.models.base import BaseModel
from offbeat.models.checkpoint import load_model
from offbeat.models.zoo import make_model, train_config
from offbeat.plots.animation import side_by_side
from offbeat.plots.errors import by_elapsed
from offbeat.plots.figures import save
from offbeat.plots.style import style_of
from offbeat.training import FitResult, fit

ROBOT = "hopper"
OBSERVED_FRACTION = 0.3
ROWS = 100
LIVE = "anchored_ode_gru_d"
LARGE = "hopper-anchored-large"
LAST_VALUE = "last_value"
NEW_SEED = 2024
"""Of the initial states of the trajectories that are scored; no model was trained on them."""

_LONGEST = 10  # rows since the last observation, in the figure
_PREFIX = f"{ROBOT}-{100 * OBSERVED_FRACTION:.0f}-"
SHIPPED = (LARGE, f"{_PREFIX}ode_rnn", f"{_PREFIX}ode_gru_d")
"""Trained models that are compared; `offbeat models` lists all."""

COMPARED, SHOWN, FREE = "hopper_errors.png", "hopper.gif", "hopper_extrapolation.gif"
WRITTEN: Mapping[str, str] = {
    COMPARED: "errors by the time since the last observation, of new trajectories",
    SHOWN: "a new trajectory, simulated and predicted by the shipped model",
    FREE: "the same, with no observation after the middle",
}


@dataclass(frozen=True)
class HopperResult:
    """What the demo finds on the hopper.

    Attributes:
        errors: per predictor (rows since the last observation,) RMSE in the units of the thesis.
        overall: per predictor RMSE over all rows after the first observed one.
        notes: per predictor, where it comes from.
        messages: what could not be drawn, with the reason.
    """

    errors: Mapping[str, tuple[float, ...]]
    overall: Mapping[str, float]
    notes: Mapping[str, str]
    messages: tuple[str, ...]

    def table(self) -> str:
        """A line per predictor, best first."""
        lines = [["", "RMSE", "5 ms after", "25 ms after", ""]]
        for name in sorted(self.overall, key=self.overall.__getitem__):
            each = (self.overall[name], self.errors[name][0], self.errors[name][4])
            lines.append([name, *(f"{error:.4f}" for error in each), self.notes[name]])
        return tables.plain(lines, left=(0, 4))

    def to_dict(self) -> dict[str, Any]:
        """JSON-like form."""
        return {
            name: {
                "rmse": self.overall[name],
                "rmse_by_rows_since_observation": list(self.errors[name]),
                "note": self.notes[name],
            }
            for name in self.overall
        }


def train_hopper(
    out: Path, *, n_trajectories: int, epochs: int, seed: int, progress: bool
) -> tuple[BaseModel, FitResult]:
    """Simulates hoppers and trains a model on them; one that was stopped is resumed.

    Args:
        out: folder of the demo.
        n_trajectories: to simulate; 70 % of them are trained on.
        epochs: of the training.
        seed: of windows, masks, split, weights and batches.
        progress: show progress bars.

    Returns:
        The model, and its training.

    Raises:
        InputError: a number is out of its range, or the folder holds another run.
        MissingExtraError: mujoco is not installed.
    """
    recorded = simulate(ROBOT, n_trajectories, 2 * ROWS, seed=seed, progress=progress)
    masked = mask_out(windows(recorded, ROWS, seed=seed), OBSERVED_FRACTION, seed=seed)
    train, validation, _ = split(masked, seed=seed)
    scaler = Scaler.fit("divide_by_max", recorded)
    model = make_model(LIVE, train, scaler=scaler, seed=seed)
    config = train_config(LIVE, epochs=epochs, seed=seed)
    fitted = fit(model, train, validation, config, out=out / "models" / ROBOT, progress=progress)
    return model, fitted


def compare_hopper(
    out: Path, trained: BaseModel, fitted: FitResult, *, n_new: int, progress: bool
) -> HopperResult:
    """Scores the trained model and the shipped ones on new trajectories, and draws them.

    Args:
        out: folder of the demo.
        trained: the model.
        fitted: its training.
        n_new: trajectories to score.
        progress: show progress bars.

    Returns:
        Errors of all models in the units of the thesis.
    """
    recorded = simulate(ROBOT, n_new, 2 * ROWS, seed=NEW_SEED, progress=progress)
    new = mask_out(windows(recorded, ROWS, seed=NEW_SEED), OBSERVED_FRACTION, seed=NEW_SEED)
    models: dict[str, BaseModel] = {name: load_model(f"offbeat/{name}") for name in SHIPPED}
    seconds = sum(epoch.seconds for epoch in fitted.history)
    here = f"{LIVE}, trained here"
    models[here] = trained
    notes = {name: f"offbeat/{name}, comes with the package" for name in SHIPPED}
    notes[here] = f"{fitted.steps} steps in {seconds:.0f} s"
    notes[LAST_VALUE] = "nothing to train"
    unit = models[f"{_PREFIX}ode_rnn"].scaler
    predictions = {name: _values(model, new) for name, model in models.items()}
    held = baselines.BASELINES[LAST_VALUE]()
    held.mean = np.asarray(trained.statistics.mean)
    predictions[LAST_VALUE] = held.predict(new)
    scored = {name: _errors(each, new, unit) for name, each in predictions.items()}
    overall = {name: error for name, (error, _) in scored.items()}
    errors = {name: by_rows for name, (_, by_rows) in scored.items()}
    _draw_errors(out, errors, overall, here, seconds)
    # The window that starts soonest after the release, chosen without looking at errors.
    shown = min(new, key=lambda trajectory: float(trajectory.times[0]))
    return HopperResult(errors, overall, notes, _animate(out, models[LARGE], shown))


def _values(model: BaseModel, new: Dataset) -> list[NDArray[np.float64]]:
    return [trajectory.values for trajectory in predict(model, new)]


def _errors(
    predicted: list[NDArray[np.float64]], new: Dataset, unit: Scaler
) -> tuple[float, tuple[float, ...]]:
    """RMSE over all rows after the first observed one, and by rows since the last one before."""
    sums, counts = np.zeros(ROWS + 1), np.zeros(ROWS + 1)
    for values, truth in zip(predicted, new, strict=True):
        seen = truth.observed.any(axis=1)
        last = np.maximum.accumulate(np.where(seen, np.arange(truth.rows), -1))
        before = np.concatenate([[-1], last[:-1]])
        since = np.where(before >= 0, np.arange(truth.rows) - before, 0)
        squares = np.mean(((values - truth.values) / unit.scale) ** 2, axis=1)
        np.add.at(sums, since, squares)
        np.add.at(counts, since, 1)
    rmse = np.sqrt(sums[1:] / np.maximum(counts[1:], 1))
    overall = float(np.sqrt(sums[1:].sum() / counts[1:].sum()))
    return overall, tuple(rmse[:_LONGEST].tolist())


def _draw_errors(
    out: Path,
    errors: Mapping[str, tuple[float, ...]],
    overall: Mapping[str, float],
    here: str,
    seconds: float,
) -> None:
    step_ms = 5.0
    by_style = {here: LIVE, LARGE: "anchored_large"}
    named = {name: by_style.get(name) or name.removeprefix(_PREFIX) for name in errors}
    labels = {style: f"{style_of(style).label} (shipped)" for style in named.values()}
    labels |= {LIVE: f"Anchored (here, {seconds:.0f} s)", LAST_VALUE: ""}
    figure = by_elapsed(
        step_ms * np.arange(1, _LONGEST + 1),
        {named[name]: errors[name] for name in sorted(errors, key=overall.__getitem__)},
        labels=labels,
        title="Prediction of new trajectories of the hopper, 30 % of the rows observed",
        units="units of the thesis",
        highlighted=(LIVE,),
    )
    save(figure, out / COMPARED)


def _animate(out: Path, model: BaseModel, shown: Trajectory) -> tuple[str, ...]:
    """Writes two GIFs of one trajectory; returns why not, where MuJoCo cannot render."""
    free = ROWS // 2
    unseen = shown.observed & (np.arange(shown.rows) < free)[:, None]
    after = 1e3 * (shown.times[free] - shown.times[0])
    views = {
        SHOWN: (shown, "Large anchored model: each row from the observed rows before it"),
        FREE: (
            replace(shown, observed=unseen),
            f"Large anchored model: nothing observed from {after:.0f} ms on",
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
