"""The demo: an arm with dropouts and a hopper, from data to scores and pictures."""

from __future__ import annotations

import json
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from offbeat.config import TrainConfig
from offbeat.demo import arm, hopper
from offbeat.errors import InputError
from offbeat.files import write_json

WRITTEN: Mapping[str, str] = {
    **arm.WRITTEN,
    **hopper.WRITTEN,
    "models": "the runs: log of the training, checkpoints, models",
    "results.json": "all scores",
    "settings.json": "the settings of this folder",
}


@dataclass(frozen=True)
class DemoResult:
    """Scores and files of the demo, shown by `print`.

    Attributes:
        folder: of all files.
        arm: fills and forecasts of an arm.
        hopper: predictions of a hopper.
        written: files and folders, relative to `folder`, each with its description.
        seconds: wall time of this call.
    """

    folder: Path
    arm: arm.ArmResult
    hopper: hopper.HopperResult
    written: Mapping[str, str]
    seconds: float

    def __str__(self) -> str:
        width = max(map(len, self.written))
        run, log = self.folder / "models" / "arm", self.folder / "arm.csv"
        lines = [
            f"A simulated arm: trained on a log of {self.arm.trained_s:.0f} s in "
            f"{self.arm.seconds:.0f} s, scored on another recording.",
            "RMSE in standard deviations of each channel, of 26.",
            "",
            self.arm.table(),
            "",
            f"A simulated hopper, {100 * hopper.OBSERVED_FRACTION:.0f} % of the rows observed: "
            "each row of new trajectories is predicted from those before it.",
            "Errors are in the units of the thesis: x / max per channel, over all of its data.",
            "",
            self.hopper.table(),
            *self.hopper.messages,
            "",
            f"Written to {self.folder} in {self.seconds:.0f} s:",
            *(f"  {name.ljust(width)}  {about}" for name, about in self.written.items()),
            "",
            f"Next: offbeat impute {run} {log} filled.csv",
        ]
        return "\n".join(lines)

    def to_dict(self) -> dict[str, Any]:
        """JSON-like form."""
        return {
            "folder": str(self.folder),
            "arm": self.arm.to_dict(),
            "hopper": self.hopper.to_dict(),
            "written": list(self.written),
            "messages": list(self.hopper.messages),
            "seconds": self.seconds,
        }


def run_demo(
    out: str | Path = "runs/demo",
    *,
    seed: int = 0,
    log_s: float = 40.0,
    arm_epochs: int = 4,
    arm_tasks: int = 200,
    n_trajectories: int = 3000,
    hopper_epochs: int = 12,
    n_new: int = 300,
    progress: bool = True,
) -> DemoResult:
    """Fills and forecasts the log of an arm, predicts a hopper, scores both and draws pictures.

    Models are trained for seconds, next to those that come with the package. Scores are of data
    that nothing was fitted to. A demo that was stopped is resumed.

    Args:
        out: folder to write to.
        seed: of windows, masks, splits, weights, batches and tasks.
        log_s: s, length of the log of the arm.
        arm_epochs: of its model.
        arm_tasks: per epoch.
        n_trajectories: hoppers to simulate; 70 % of them are trained on.
        hopper_epochs: of their model.
        n_new: further hoppers, which are scored.
        progress: show progress bars on standard error.

    Returns:
        Scores and files; `print` shows them.

    Raises:
        InputError: an argument is out of bounds, or `out` holds a demo with other settings.
        MissingExtraError: mujoco is not installed.
    """
    import torch

    started = time.perf_counter()
    out = Path(out)
    settings = {
        "seed": seed,
        "log_s": log_s,
        "arm_epochs": arm_epochs,
        "arm_tasks": arm_tasks,
        "n_trajectories": n_trajectories,
        "hopper_epochs": hopper_epochs,
    }
    _check_folder(out, settings)
    training = TrainConfig(seed=seed, epochs=arm_epochs, tasks_per_epoch=arm_tasks)
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        trained, fitted = hopper.train_hopper(
            out, n_trajectories=n_trajectories, epochs=hopper_epochs, seed=seed, progress=progress
        )
        write_json(out / "settings.json", settings)
        of_hopper = hopper.compare_hopper(out, trained, fitted, n_new=n_new, progress=progress)
        began = time.perf_counter()
        learned = arm.learn_arm(out, training, seconds=log_s, progress=progress)
        took = time.perf_counter() - began
        of_arm = arm.answer_arm(
            out, learned.blend, seconds=took, trained_s=log_s, progress=progress
        )
    finally:
        torch.set_num_threads(before)
    write_json(out / "results.json", {"arm": of_arm.to_dict(), "hopper": of_hopper.to_dict()})
    written = {name: about for name, about in WRITTEN.items() if (out / name).exists()}
    return DemoResult(out, of_arm, of_hopper, written, time.perf_counter() - started)


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
