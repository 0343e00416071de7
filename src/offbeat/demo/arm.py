"""The first half of the demo: a log of an arm with dropouts, filled and forecast."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from offbeat import baselines, tables
from offbeat.answers.blend import Blend
from offbeat.answers.forecast import forecast
from offbeat.answers.impute import impute
from offbeat.answers.scoring import (
    ChannelScores,
    score_forecast,
    score_imputation,
    training_mean,
)
from offbeat.config import TrainConfig
from offbeat.data.arm_log import CHANNELS, JOINTS, RATES_HZ, with_hidden_values, write
from offbeat.data.inspection import inspect
from offbeat.data.readers import read
from offbeat.data.trajectory import Dataset, Trajectory
from offbeat.data.windows import windows
from offbeat.learning import Learned, learn
from offbeat.plots.errors import by_task
from offbeat.plots.figures import save
from offbeat.plots.log import log as draw_log
from offbeat.plots.spans import Span, spans
from offbeat.plots.style import style_of
from offbeat.progress import busy

MODEL = "anchored_trend"
SIMPLE = ("last_value", "damped_slope", "ridge", "linear", "pchip")
"""Baselines of the blend that are fitted in seconds."""

HORIZONS_S = (0.1, 0.5)
_NEW_S = 20.0
_TARGETS = 5  # forecasts scored per window
_SHOWN = SIMPLE


@dataclass(frozen=True, eq=False)
class ArmResult:
    """What the demo finds on the arm.

    Attributes:
        scores: fills of dropouts, then a forecast per horizon, on a recording that nothing was
            fitted to.
        seconds: of training, baselines and intervals.
        trained_s: s, length of the log that was trained on.
    """

    scores: tuple[ChannelScores, ...]
    seconds: float
    trained_s: float

    def errors(self) -> dict[str, dict[str, float]]:
        """RMSE by task and predictor, in standard deviations; the blend is the first."""
        return {
            each.task: {
                name.removesuffix(" alone"): error
                for name, error in each.overall.items()
                if error == error and (name in _SHOWN or name not in each.trivial)
            }
            for each in self.scores
        }

    def table(self) -> str:
        """A line per predictor, a column per task; the last line is the coverage of intervals."""
        errors = self.errors()
        names = list(dict.fromkeys(name for each in errors.values() for name in each))
        lines = [["RMSE", *errors]]
        for name in names:
            label = style_of(name).label + (" alone" if name == MODEL else "")
            cells = [f"{each[name]:.3f}" if name in each else "-" for each in errors.values()]
            lines.append([label, *cells])
        covered = [(each.coverage or {}).get(0.8) for each in self.scores]
        lines.append(
            [
                "in the interval of 80 %",
                *("-" if c is None else f"{100 * c:.0f} %" for c in covered),
            ]
        )
        return tables.plain(lines)

    def to_dict(self) -> dict[str, Any]:
        """JSON-like form."""
        return {
            "seconds": self.seconds,
            "trained_s": self.trained_s,
            "tasks": [each.to_dict() for each in self.scores],
        }


def learn_arm(out: Path, training: TrainConfig, *, seconds: float, progress: bool) -> Learned:
    """Writes the log, draws what was measured when, and trains on it.

    Args:
        out: folder of the demo.
        training: its length, and the seed of weights and tasks.
        seconds: length of the log.
        progress: show progress bars.

    Returns:
        The run of `models/arm`, with its blend.

    Raises:
        InputError: the log is too short, or the folder holds another run.
    """
    path = out / "arm.csv"
    write(path, seconds)
    log = read(path)
    save(draw_log(log, inspect(log), title="arm.csv: what was measured when"), out / INSPECTED)
    return learn(
        log,
        out / "models" / "arm",
        horizon_s=HORIZONS_S[-1],
        model=MODEL,
        training=training,
        baselines=SIMPLE,
        seed=training.seed,
        progress=progress,
    )


INSPECTED, ANSWERED, COMPARED = "arm_inspect.png", "arm_answers.png", "arm_errors.png"
WRITTEN: Mapping[str, str] = {
    INSPECTED: "what was measured when, in the log of an arm",
    ANSWERED: "a dropout filled and a forecast of another recording, with intervals",
    COMPARED: "errors on that recording, next to those of simple predictors",
    "arm.csv": "the log that the model of the arm was trained on",
}


def answer_arm(
    out: Path, blend: Blend, *, seconds: float, trained_s: float, progress: bool
) -> ArmResult:
    """Answers on another recording, scores the answers, and draws them.

    Args:
        out: folder of the demo.
        blend: trained.
        seconds: that it took.
        trained_s: s, length of the log.
        progress: show the time of long steps.

    Returns:
        Scores of fills and forecasts, in standard deviations.
    """
    new = with_hidden_values(_NEW_S, seed=1, outage_s=0.0)
    with busy("filling and forecasting another recording", progress):
        fills = score_imputation(blend, Dataset((new,)), mode="two_sided").scores
        cut = windows(Dataset((new,)), seconds=2.0, cut="consecutive")
        ahead = score_forecast(blend, cut, HORIZONS_S, targets=_TARGETS)
        scores = (replace(fills, task="fill dropouts"), *ahead)
        result = ArmResult(scores, seconds, trained_s)
        filled, foretold = _fill(blend, new), _forecast(blend, new)
    figure = spans(
        [span for span, _ in (filled, foretold)],
        [names for _, names in (filled, foretold)],
        title="Another recording of the arm, which nothing was fitted to",
    )
    save(figure, out / ANSWERED)
    figure = by_task(
        result.errors(),
        title="Fills and forecasts of 26 channels of an arm",
        units="standard deviations of each channel",
    )
    save(figure, out / COMPARED)
    return result


def _fill(blend: Blend, new: Trajectory) -> tuple[Span, tuple[str, ...]]:
    """The dropout of the joints in which one of them travels farthest."""
    silent = ~new.observed[:, 0] & np.isfinite(new.values[:, 0])
    stamped = np.flatnonzero(np.isfinite(new.values[:, 0]))
    runs = np.split(stamped, np.flatnonzero(np.diff(silent[stamped])) + 1)
    runs = [run for run in runs if silent[run[0]]]
    run = max(runs, key=lambda run: _travelled(new, run).max())
    joint = int(_travelled(new, run).argmax()) + 1
    start, stop = (float(new.times[at]) for at in (run[0], run[-1]))
    period = 1 / RATES_HZ[JOINTS]
    near = _between(new, start - 4.0, stop + 4.0)
    seen = Dataset((near,))
    answer = impute(blend, seen)[0]
    mean = training_mean(blend)
    by = replace(near, values=baselines.fill(near, "pchip", mean))
    title = f"Filled, once the joints are back after {stop - start:.1f} s"
    span = Span(title, near, start - period / 2, stop + period / 2, answer, {"pchip": by})
    return span, _of_joint(joint)


def _forecast(blend: Blend, new: Trajectory) -> tuple[Span, tuple[str, ...]]:
    """The time at which a joint moves fastest, after two seconds."""
    horizon = HORIZONS_S[-1]
    speeds = np.abs(new.values[:, 6:12]) / np.nanstd(new.values[:, 6:12], axis=0)
    asked = (new.times > 2.0) & (new.times < new.times[-1] - horizon)
    speeds = np.where(new.observed[:, 6:12] & asked[:, None], speeds, 0.0)
    row, at = np.unravel_index(int(speeds.argmax()), speeds.shape)
    start, joint = float(new.times[row]) + 1e-6, int(at) + 1
    past = _between(new, start - 2.0, start)
    times = np.linspace(0.01, horizon, 50)
    foretold = forecast(blend, Dataset((past,)), times)[0]
    mean = training_mean(blend)
    held = replace(
        foretold,
        values=baselines.forecast(past, foretold.times, "last_value", mean),
    )
    near = _between(new, start - 2.0, start + horizon + 0.1)
    hidden = near.observed & (near.times <= start)[:, None]
    title = f"Forecast from {start:.1f} s on"
    span = Span(
        title,
        replace(near, observed=hidden),
        start,
        start + horizon,
        foretold,
        {"last_value": held},
    )
    return span, _of_joint(joint)


def _travelled(new: Trajectory, rows: Any) -> Any:
    """(6,) how far each joint moves in some rows, in standard deviations of its position."""
    positions = new.values[:, :6]
    if len(rows) < 2:
        return np.zeros(6)
    return np.ptp(positions[rows], axis=0) / np.nanstd(positions, axis=0)


def _between(new: Trajectory, start: float, stop: float) -> Trajectory:
    first, last = np.searchsorted(new.times, [start, stop])
    return new.slice(int(first), int(last))


def _of_joint(joint: int) -> tuple[str, ...]:
    names = [name.partition(" [")[0] for name in CHANNELS[JOINTS]]
    return tuple(name for name in names if name.startswith(f"joint_{joint}_"))
