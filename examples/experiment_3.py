"""The passive motion of walker, cheetah and humanoid: what the thesis names as future work.

    python examples/experiment_3.py --robots walker cheetah humanoid --minutes 10
    python examples/experiment_3.py --document docs/robots.md

Robots of the Control Suite fall without control from its own random states, as the thesis' Hopper
does. Windows of 100 rows, a physics step apart, are cut, 90 or 30 % of the rows are observed, and
each row is predicted from the rows before it. In a repeat all predictors have the same windows,
masks and split. All models are trained alike: Adam, cosine decay, the epoch with the lowest
validation error.
A file per robot, length, fraction, predictor and repeat is kept in `results/robots/experiment_3`;
what is there is not run again. It needs `offbeat[sim]`.
"""

from __future__ import annotations

import argparse
import time
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import torch

import offbeat as ob
from examples import experiment_3_report
from examples.real_logs.results import machine
from offbeat.baselines import fit_baseline
from offbeat.files import write_json

RESULTS = Path("results/robots/experiment_3")
ROBOTS = ("walker", "cheetah", "humanoid")
FRACTIONS = (0.9, 0.3)
BASELINES = {"last value": "last_value", "ridge": "ridge", "residual GRU": "residual_gru"}
MODELS = {
    "GRU": "gru",
    "GRU-D": "gru_d",
    "ODE-RNN": "ode_rnn",
    "ODE-GRU-D": "ode_gru_d",
    "anchored": "anchored_ode_gru_d",
}
PREDICTORS = (*BASELINES, *MODELS)
TRAINING = {"optimizer": "adam", "learning_rate": 0.004, "schedule": "cosine", "batch_size": 25}


def parts(
    whole: ob.Dataset, rows: int, fraction: float, repeat: int
) -> tuple[ob.Dataset, ob.Dataset, ob.Dataset]:
    """Training, validation and test windows of a repeat, with masks."""
    seed = 1000 * repeat + round(100 * fraction)
    cut = ob.mask_out(ob.windows(whole, rows, seed=seed), fraction, seed=seed)
    train, validation, test = ob.split(cut, seed=seed)
    return train, validation, test


def rmse(predicted: list[Any], test: ob.Dataset, scaler: ob.Scaler) -> float:
    """In units of the spread of each channel, over the rows after the first observed one."""
    squared = []
    for mean, window in zip(predicted, test, strict=True):
        first = int(np.argmax(window.observed.any(axis=1)))
        squared.append(scaler.scaled(mean)[first + 1 :] - scaler.scaled(window.values)[first + 1 :])
    return float(np.sqrt(np.mean(np.concatenate(squared) ** 2)))


def run(name: str, data: tuple[ob.Dataset, ...], epochs: int, repeat: int) -> dict[str, Any]:
    """Fits or trains a predictor, and scores it on the test windows."""
    train, validation, test = data
    scaler = ob.Scaler.fit("standardise", train)
    began = time.process_time()
    if name in BASELINES:
        found = fit_baseline(BASELINES[name], train).predict(test)
        seconds = time.process_time() - began
        return {"rmse": rmse(found, test, scaler), "seconds": round(seconds, 1)}
    model = ob.make_model(MODELS[name], train, scaler=scaler, seed=repeat)
    config = ob.TrainConfig(epochs=epochs, keep="best", seed=repeat, **TRAINING)
    done = ob.fit(model, train, validation, config, progress=False)
    seconds = time.process_time() - began
    with torch.inference_mode():
        mean = scaler.original(model(model.batch(test)).mean.double().numpy())
    return {
        "rmse": rmse(list(mean), test, scaler),
        "best_epoch": done.best_epoch,
        "curve": [float(f"{epoch.validation_mse**0.5:.4g}") for epoch in done.history],
        "parameters": sum(p.numel() for p in model.parameters()),
        "seconds": round(seconds, 1),
    }


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    add = parser.add_argument
    add("--robots", nargs="+", default=list(ROBOTS), choices=ROBOTS)
    add("--rows", type=int, default=100, help="of a window; twice as many are simulated")
    add("--trajectories", type=int, default=10_000)
    add("--epochs", type=int, default=50)
    add("--repeats", type=int, default=5)
    add("--only", nargs="+", default=list(PREDICTORS), choices=PREDICTORS)
    add("--minutes", type=float, help="stop after the training that is in progress then")
    add("--document", type=Path, help="write the tables into this document instead")
    asked = parser.parse_args()
    if asked.document is not None:
        experiment_3_report.write(asked.document, RESULTS)
        return
    torch.set_num_threads(1)
    stop = time.monotonic() + 60 * (asked.minutes or 1e9)
    simulated: dict[str, ob.Dataset] = {}
    for repeat, robot, fraction, name in product(
        range(asked.repeats), asked.robots, FRACTIONS, asked.only
    ):
        words = f"{robot}-{asked.rows}-{100 * fraction:.0f}-{name.replace(' ', '_')}-{repeat}"
        path = RESULTS / f"{words}.json"
        if path.exists():
            continue
        if time.monotonic() > stop:
            return
        if robot not in simulated:
            simulated[robot] = ob.simulate(
                robot, asked.trajectories, 2 * asked.rows, threads=1, progress=False
            )
        data = parts(simulated[robot], asked.rows, fraction, repeat)
        found = run(name, data, asked.epochs, repeat)
        own = {"robot": robot, "rows": asked.rows, "fraction": fraction, "repeat": repeat}
        made = {"trajectories": asked.trajectories, "epochs": asked.epochs}
        write_json(path, {"predictor": name, **own, **found, **made, "machine": machine()})
        print(words, f"{found['rmse']:.4f}", f"{found['seconds']} s", flush=True)


if __name__ == "__main__":
    main()
