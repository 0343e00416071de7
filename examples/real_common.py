"""What the three examples on real logs share: a log in, a table, a figure and a JSON file out.

Each example describes its log (`Log`); `run` trains a causal and a backward model on it
and scores them with the trivial predictors. Learning rate and epoch are chosen on the validation
part; the test part is looked at once, at the end.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

import offbeat as ob
from offbeat.answers.scoring import ChannelScores, training_mean
from offbeat.baselines import fill
from offbeat.data.inspection import inspect
from offbeat.files import write_json
from offbeat.plots.answers import answers
from offbeat.plots.figures import save

ROOT = Path(__file__).resolve().parents[1]
MODEL = "anchored_ode_gru_d"
RATES = (0.001, 0.004)
"""Learning rates that are tried; the one of the lower validation MSE is kept."""


@dataclass(frozen=True)
class Log:
    """A log and the settings of its evaluation.

    Attributes:
        name: of the JSON file and of the figure.
        log: as it was read, for its inspection.
        train: the training part, as logged.
        validation: the validation part, as logged.
        tests: test parts by name, as logged; the figure shows the first.
        window: rows of a training window.
        windows: windows drawn from each training trajectory.
        sensors: channels that drop out together.
        silence_s: how long they do.
        horizons_s: of the extrapolation.
        groups: channels whose errors are one line of the printed tables, by name.
        drawn: channels of the figure.
        epochs: of each training.
        batch_size: windows per step.
        draw_from: number of the test trajectory that the figure shows.
    """

    name: str
    log: ob.Dataset
    train: ob.Dataset
    validation: ob.Dataset
    tests: Mapping[str, ob.Dataset]
    window: int
    windows: int
    sensors: tuple[tuple[str, ...], ...]
    silence_s: float
    horizons_s: tuple[float, ...]
    groups: Mapping[str, tuple[str, ...]]
    drawn: tuple[str, ...]
    epochs: int
    batch_size: int
    draw_from: int = 0


def data_folder() -> Path:
    """Folder of logs that are not part of this repository: OFFBEAT_DATA, or next to it."""
    return Path(os.environ.get("OFFBEAT_DATA") or ROOT.parent / "shared" / "data")


def silenced(log: Log, dataset: ob.Dataset, *, seed: int = 0) -> ob.Dataset:
    """Masks 30 % of each sensor in independent dropouts, to be imputed."""
    return ob.mask_out(
        dataset,
        0.7,
        mask="dropout",
        burst_s=log.silence_s,
        sensors=log.sensors,
        seed=seed,
    )


def views(log: Log, dataset: ob.Dataset, seed: int) -> tuple[ob.Dataset, ob.Dataset, ob.Dataset]:
    """The same windows as logged, with dropouts of single sensors, and with outages of all.

    A model learns from its data only: complete rows teach it to predict the next row, dropouts to
    fill from other sensors, outages to forecast for a longer time.
    """
    return (
        dataset,
        silenced(log, dataset, seed=seed),
        ob.mask_out(dataset, 0.6, mask="bursts", burst_s=log.horizons_s[-1] / 2, seed=seed),
    )


def together(parts: Iterable[ob.Dataset]) -> ob.Dataset:
    """Trajectories of several data sets as one."""
    return ob.Dataset(tuple(t for part in parts for t in part))


def main(make_log: Callable[[bool], Log], description: str | None) -> None:
    """Reads the options of an example and runs it."""
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("--epochs", type=int, help="of each training")
    parser.add_argument("--small", action="store_true", help="a small part, in seconds")
    parser.add_argument("--out", type=Path, default=Path("runs/real"), help="folder of the JSON")
    parser.add_argument("--figures", type=Path, help="folder of the figure; by default --out")
    options = parser.parse_args()
    torch.set_num_threads(1)
    log = make_log(options.small)
    log = replace(log, epochs=options.epochs or (2 if options.small else log.epochs))
    script = Path(sys.argv[0]).name
    result = run(log, options.out, options.figures or options.out)
    result["command"] = " ".join(["python", f"examples/{script}", *sys.argv[1:]])
    result["machine"] = machine()
    write_json(options.out / f"{log.name}.json", result)
    print(f"\n{options.out / log.name}.json, {result['figure']}")


def machine() -> dict[str, Any]:
    """Where and with what this ran, as the benchmarks say it."""
    sys.path.append(str(ROOT / "benchmarks"))
    from common import machine as described

    found: dict[str, Any] = described()
    return found


def run(log: Log, out: Path, figures: Path) -> dict[str, Any]:
    """Trains, scores, prints, draws.

    Args:
        log: what to do.
        out: folder of the JSON file; made if it is missing.
        figures: folder of the figure; made if it is missing.

    Returns:
        Everything that was measured, JSON-like.
    """
    for folder in (out, figures):
        folder.mkdir(parents=True, exist_ok=True)
    windows = ob.windows(log.train, log.window, cut="random", count=log.windows, seed=1)
    # Each training window in one of the three views, each validation window in all of them.
    train = together(
        view.take(np.arange(i, len(windows), 3))
        for i, view in enumerate(views(log, windows, seed=2))
    )
    validation_set = ob.windows(log.validation, log.window, cut="consecutive")
    validation = together(views(log, validation_set, seed=3))
    print(
        f"{log.name}: {len(train)} training windows of {sum(t.rows for t in train)} rows, "
        f"{len(validation)} validation windows of {sum(t.rows for t in validation)} rows"
    )
    started = time.perf_counter()
    pair, tried = trained(log, train, validation)
    seconds = time.perf_counter() - started
    for each in tried:
        print(
            f"learning rate {each['learning_rate']:g}: lowest validation MSE "
            f"{each['validation_mse']:.5g} (scaled), after epoch {each['epoch']}"
        )
    print(f"trained in {seconds:.0f} s")
    scored = {name: scores(log, pair, test) for name, test in log.tests.items()}
    figure = figures / f"real_{log.name}.png"
    draw(log, pair, figure)
    return {
        "rows": {"train": sum(t.rows for t in log.train), "in_windows": sum(t.rows for t in train)},
        "settings": {
            "model": asdict(pair.forward.config),
            "epochs": log.epochs,
            "batch_size": log.batch_size,
            "window": log.window,
            "silence_s": log.silence_s,
            "sensors": log.sensors,
        },
        "chosen_on_validation": tried,
        "training_seconds": seconds,
        "inspection": inspected(log.log),
        "scores": scored,
        "figure": figure.name,
    }


def inspected(dataset: ob.Dataset) -> dict[str, Any]:
    """What `offbeat inspect` measures of a log, without its list of episodes."""
    found = inspect(dataset)
    return {
        "episodes": len(dataset),
        "rows": found.rows,
        "known_share": found.known,
        "channels": [
            {
                "name": c.name,
                "unit": c.unit,
                "rate_hz": c.rate_hz,
                "missing": c.missing,
                "longest_gap_s": c.longest_gap_s,
                "held_share": c.repeated_fraction,
                "constant": c.constant,
            }
            for c in found.channels
        ],
    }


def trained(
    log: Log, train: ob.Dataset, validation: ob.Dataset
) -> tuple[ob.TwoSided, list[dict[str, float]]]:
    """A pair of models, the learning rate chosen on the validation part."""
    tried: list[dict[str, float]] = []
    with tempfile.TemporaryDirectory() as kept:

        def config(rate: float) -> ob.TrainConfig:
            return ob.train_config(
                MODEL,
                epochs=log.epochs,
                batch_size=log.batch_size,
                learning_rate=rate,
                keep="best",
            )

        def fresh() -> ob.Model:
            return ob.make_model(MODEL, train, field_units=(64, 64), seed=0)

        for rate in RATES:
            folder = Path(kept) / f"{rate:g}"
            fitted = ob.fit(fresh(), train, validation, config(rate), out=folder, progress=False)
            best = min(fitted.history, key=lambda r: r.validation_mse)
            tried.append(
                {
                    "learning_rate": rate,
                    "validation_mse": best.validation_mse,
                    "epoch": best.epoch,
                }
            )
        rate = min(tried, key=lambda t: t["validation_mse"])["learning_rate"]
        # The forward training in that folder is finished; only the backward one runs.
        folder = Path(kept) / f"{rate:g}"
        pair, _, _ = ob.fit_two_sided(
            fresh(), train, validation, config(rate), out=folder, progress=False
        )
    return pair, tried


def scores(log: Log, pair: ob.TwoSided, test: ob.Dataset) -> dict[str, Any]:
    """One step ahead and forecasts on the test part as logged, fills of its masked values."""
    print(f"\n{len(test)} test trajectories, {sum(t.rows for t in test)} rows")
    one = ob.evaluate(pair.forward, test).in_units()
    show(log, one)
    filled = ob.score_imputation(pair, silenced(log, test, seed=4))
    show(log, filled.scores, filled.verdict())
    ahead = ob.score_forecast(pair.forward, test, log.horizons_s, targets=12)
    for each in ahead:
        show(log, each)
    return {
        "one_step_ahead": {**one.to_dict(), "groups": grouped(log, one)},
        "imputation": {**filled.to_dict(), "groups": grouped(log, filled.scores)},
        "extrapolation": [
            {"horizon_s": h, **s.to_dict(), "groups": grouped(log, s)}
            for h, s in zip(log.horizons_s, ahead, strict=True)
        ],
    }


def grouped(log: Log, found: ChannelScores) -> dict[str, dict[str, float | None]]:
    """RMSE over all cells of the channels of a group, in their unit, per predictor."""
    cells = np.array(found.counts)
    result = {}
    for group, channels in log.groups.items():
        at = [found.names.index(name) for name in channels]
        count = int(cells[at].sum())
        result[group] = {
            who: float((np.nansum(np.square(each)[at] * cells[at]) / count) ** 0.5)
            if count
            else None
            for who, each in ((who, np.array(rmse)) for who, rmse in found.rmse.items())
        }
    return result


def show(log: Log, found: ChannelScores, verdict: str | None = None) -> None:
    """Prints a table, a line per group of channels, and who wins."""
    who = list(found.rmse)
    print(f"\n{found.task}, RMSE\n{'':24}" + "".join(f"{name:>20}" for name in who))
    for group, each in grouped(log, found).items():
        numbers = [each[name] for name in who]
        print(f"{group:24}" + "".join(f"{'-' if n is None else f'{n:.4g}':>20}" for n in numbers))
    print(f"{'all, scaled':24}" + "".join(f"{found.overall[name]:>20.4g}" for name in who))
    print(verdict or found.verdict())


def draw(log: Log, pair: ob.TwoSided, path: Path) -> None:
    """One test trajectory with dropouts: truth, the model's fills, PCHIP."""
    test = silenced(log, next(iter(log.tests.values())), seed=4)
    one = ob.Dataset((test[min(log.draw_from, len(test) - 1)],)).select(pair.forward.names)
    truth = one[0]
    curve = fill(truth, "pchip", training_mean(pair.forward))
    drawn = {
        "pchip": replace(truth, values=np.where(truth.observed, truth.values, curve)),
        "causal": ob.impute(pair, one, mode="causal")[0],
        "two_sided": ob.impute(pair, one)[0],
    }
    save(answers(truth, drawn, log.drawn, title=truth.origin), path)
