"""Trains and scores predictors on the thesis' Hopper, and writes their table.

    python -m examples.hopper --only last_value,ridge --fractions 0.3,0.9
    python -m examples.hopper --only large_fresh --runs runs/hopper
    python -m examples.hopper --document docs/robots.md

Scores are kept in `results/robots/hopper`, a file per predictor. A training that was stopped goes
on from its last checkpoint in `--runs`.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import Any

import torch

from examples.real_logs.logs import ROOT
from examples.real_logs.results import machine
from offbeat.baselines import fit_baseline
from offbeat.errors import one_of
from offbeat.files import write_json

from . import figures, report, scores
from .data import FRACTIONS, Hopper
from .models import PLANS, train

BASELINES = ("last_value", "constant_velocity", "motion_filter", "ridge", "residual_gru")


def main(given: list[str] | None = None) -> None:
    """Runs the command."""
    parser = argparse.ArgumentParser(
        "python -m examples.hopper", description=__doc__.split("\n")[0]
    )
    add = parser.add_argument
    add("--only", default="", help=f"of {', '.join((*BASELINES, *PLANS))}; comma-separated")
    add("--fractions", default="", help="observed fractions, comma-separated; by default all four")
    add("--seed", type=int, default=0, help="of weights, batches and fresh masks")
    add("--out", type=Path, default=ROOT / "results" / "robots" / "hopper")
    add("--runs", type=Path, default=Path("runs/hopper"), help="folder of checkpoints")
    add("--trajectories", type=int, help="fewer than 10,000, for a trial")
    add(
        "--document",
        type=Path,
        help="a page whose tables are written anew, with a figure beside it",
    )
    options = parser.parse_args(given)
    names = [name for name in options.only.split(",") if name]
    for name in names:
        one_of("predictor", name, (*BASELINES, *PLANS))
    fractions = [float(text) for text in options.fractions.split(",") if text] or list(FRACTIONS)
    for fraction in fractions:
        one_of("fraction", str(fraction), [str(each) for each in FRACTIONS])
    if names:
        torch.set_num_threads(1)
        hopper = Hopper.simulated(options.trajectories)
        for name in names:
            _run(name, hopper, fractions, options)
    if options.document:
        text = options.document.read_text(encoding="utf-8")
        found = report.read(options.out, ROOT / "results" / "thesis")
        options.document.write_text(report.document(text, found), encoding="utf-8")
        figures.draw(found, options.document.parent / "figures" / "hopper_curves.png")


def _run(name: str, hopper: Hopper, fractions: list[float], options: argparse.Namespace) -> None:
    seed = options.seed if name in PLANS else 0
    path = options.out / f"{name}{f'-seed{seed}' if name in PLANS else ''}.json"
    found: dict[str, Any] = {"predictor": name, "seed": seed, "scores": {}}
    if path.exists():
        found = json.loads(path.read_text(encoding="utf-8"))
    open_ = [fraction for fraction in fractions if str(fraction) not in found["scores"]]
    if not open_:
        return
    if name in PLANS:
        folder = options.runs / f"{name}-seed{seed}"
        model, results = train(PLANS[name], hopper, folder, seed=seed)
        history = [epoch for result in results for epoch in result.history]
        found["size"] = sum(p.numel() for p in model.parameters())
        found["train_s"] = round(sum(epoch.seconds for epoch in history), 1)
        found["epochs"] = len(history)
        found["best_epoch"] = len(history) - len(results[-1].history) + results[-1].best_epoch
        found["curve"] = [float(f"{e.validation_mse**0.5:.5g}") for e in history]
        found["backend"] = model.backend()[0]
    for fraction in open_:
        drawn_for = PLANS[name].drawn_for if name in PLANS else None
        windows, _, test = hopper.parts(fraction, drawn_for=drawn_for)
        asked = scores.Questions(test, hopper.scaler)
        own: dict[str, Any] = {}
        if name in PLANS:
            last = fit_baseline("last_value", windows)
            found_last = scores.baseline_predictions(last, test, hopper.scaler)
            own = {"last_value_rmse": asked.score(found_last)["rmse"]}
            predicted = scores.predictions(model, test)
        else:
            started = time.process_time()
            fitted = fit_baseline(name, windows)
            own = {
                "fit_s": round(time.process_time() - started, 1),
                "size": sum(int(array.size) for array in fitted.arrays().values()),
            }
            predicted = scores.baseline_predictions(fitted, test, hopper.scaler)
        found["scores"][str(fraction)] = {**own, **asked.score(predicted)}
        print(f"{name} {fraction}: {found['scores'][str(fraction)]['rmse']:.5f}", flush=True)
        write_json(path, {**found, "command": _command(name, seed), "machine": machine()})


def _command(name: str, seed: int) -> str:
    return f"python -m examples.hopper --only {name}{f' --seed {seed}' if seed else ''}"


if __name__ == "__main__":
    main()
