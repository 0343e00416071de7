"""The command `offbeat`: each subcommand is a function, its options are the function's arguments.

Torch and everything else that is slow to import is imported inside the functions, so that
`offbeat --help` answers at once.
"""

from __future__ import annotations

import json as json_
import sys
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from offbeat.config import ModelConfig, PartsConfig, TrainConfig, check_seed
from offbeat.errors import InputError, OffbeatError, one_of

DESCRIPTION = """Learn robot motion from trajectories sampled at uneven times.

A first way through, from simulation to a scored model:

  offbeat simulate hopper.parquet --n_trajectories 2000
  offbeat train hopper.parquet runs/ode_rnn --parts.window 100 --parts.observed_fraction 0.3 \\
      --model.name ode_rnn --training.epochs 5
  offbeat evaluate runs/ode_rnn hopper.parquet
  offbeat predict runs/ode_rnn hopper.parquet predictions.csv

Or all of it at once, every model beside the trivial predictor: offbeat demo"""


def simulate_command(
    out: Path,
    robot: str = "hopper",
    n_trajectories: int = 10_000,
    rows: int = 200,
    seed: int = 0,
    threads: int | None = None,
    json: bool = False,
) -> None:
    """Simulate a robot falling without control, and write a data set.

    Args:
        out: Parquet file to write.
        robot: hopper or walker.
        n_trajectories: how many, each from its own random state.
        rows: rows per trajectory; one per physics step, 5 ms for the hopper.
        seed: of the initial states; 123 is the draw of the thesis' protocol.
        threads: of the simulation; all cores by default. They do not change the result.
        json: print what was written as JSON.
    """
    from offbeat.data.simulate import simulate
    from offbeat.data.store import save
    from offbeat.files import writable

    if out.suffix != ".parquet":
        raise InputError(f"out must be a .parquet file, got {out}")
    writable(out)
    dataset = simulate(robot, n_trajectories, rows, seed=seed, threads=threads)
    save(dataset, out)
    _say({"written": str(out), "meta": dict(dataset.meta)}, f"{out}: {dataset!r}", json)


def train_command(
    data: Path,
    out: Path,
    model: ModelConfig = ModelConfig(),  # noqa: B008  # frozen
    training: TrainConfig = TrainConfig(),  # noqa: B008
    parts: PartsConfig = PartsConfig(),  # noqa: B008
    scaler: str = "standardise",
    seed: int = 0,
    threads: int = 1,
    json: bool = False,
) -> None:
    """Train a model on a data set, and score it on the part that was held out.

    Args:
        data: data set (.parquet) or CSV.
        out: folder of the run: config.yaml, log.csv, checkpoints, model, results.json. A run that
            was stopped goes on where it was.
        model: what the model consists of; only the name is needed.
        training: epochs, optimizer and the rest.
        parts: windows, hidden rows, and the split into training, validation and test.
        scaler: standardise, min_max, divide_by_max or identity; fitted on the training part.
        seed: of the initial weights.
        threads: of torch; one is fastest for models of this size.
        json: print the scores as JSON.
    """
    import torch
    import yaml

    from offbeat.data.prepare import SCALERS, save_parts
    from offbeat.data.prepare import parts as cut
    from offbeat.data.readers import read
    from offbeat.evaluation import evaluate
    from offbeat.files import writable, write_json, write_text
    from offbeat.models.zoo import make
    from offbeat.training import fit

    one_of("scaler", scaler, SCALERS)
    check_seed(seed)
    if threads < 1:
        raise InputError(f"threads must be an integer of at least 1, got {threads}")
    writable(out, folder=True)
    torch.set_num_threads(threads)
    dataset = read(data)
    train_part, validation, test = cut(dataset, parts)
    made = make(model, train_part, scaler=scaler, seed=seed)  # type: ignore[arg-type]
    resolved = {
        "data": str(data),
        "out": str(out),
        "model": _plain(asdict(made.config)),
        "training": _plain(asdict(training)),
        "parts": _plain(asdict(parts)),
        "scaler": scaler,
        "seed": seed,
        "threads": threads,
    }
    fitted = fit(made, train_part, validation, training, out=out)
    write_text(out / "config.yaml", yaml.safe_dump(resolved, sort_keys=False))
    save_parts(out / "parts.json", parts, dataset)
    evaluation = evaluate(made, test)
    result = {"steps": fitted.steps, "part": "test", **evaluation.to_dict()}
    write_json(out / "results.json", result)
    heading = f"{out}: {fitted.steps} steps; RMSE on the test part, in scaled units ({scaler})"
    _say(result, f"{heading}\n{evaluation.table()}", json)


def evaluate_command(
    model: Path,
    data: Path,
    part: str | None = None,
    observed_fraction: float | None = None,
    out: Path | None = None,
    seed: int = 0,
    json: bool = False,
) -> None:
    """Score a trained model beside the last observed value.

    Args:
        model: folder of a run or of a checkpoint.
        data: data set (.parquet) or CSV.
        part: test, validation, train or all. On the data that the run was trained on, the same
            windows, hidden rows and split are made again, and test is the default; other data can
            only be scored as a whole.
        observed_fraction: hide rows of other data at random, this share stays observed.
        out: JSON file for the scores.
        seed: of hidden rows and coins.
        json: print the scores as JSON.
    """
    from offbeat.data.prepare import load_parts
    from offbeat.data.readers import read
    from offbeat.data.thin import thin
    from offbeat.evaluation import evaluate
    from offbeat.files import write_json
    from offbeat.models.checkpoint import load_checkpoint

    if part is not None:
        one_of("part", part, ("train", "validation", "test", "all"))
    check_seed(seed)
    loaded = load_checkpoint(model)
    dataset = read(data)
    own = load_parts(model / "parts.json", dataset)
    if own is None and part not in (None, "all"):
        raise InputError(
            f"there is no {part} part: {model} was not trained on {data}, or is not the folder of "
            "a run; leave part out to score everything"
        )
    if own is not None and part != "all":
        part = part or "test"
        if observed_fraction is not None:
            raise InputError(
                "the rows hidden in training are hidden again; leave observed_fraction out, or "
                "give --part all"
            )
        dataset = dict(zip(("train", "validation", "test"), own, strict=True))[part]
    else:
        part = "all"
        if observed_fraction is not None:
            dataset = thin(dataset, observed_fraction, seed=seed)
    evaluation = evaluate(loaded, dataset, seed=seed)
    result = {"part": part, **evaluation.to_dict()}
    if out is not None:
        write_json(out, result)
    heading = (
        f"RMSE in scaled units ({evaluation.scaler}), part: {part}, {len(dataset)} trajectories"
    )
    _say(result, f"{heading}\n{evaluation.table()}", json)


def predict_command(
    model: Path,
    data: Path,
    out: Path,
    times: list[float] | float | None = None,
    time_unit: str | None = None,
    seed: int = 0,
    json: bool = False,
) -> None:
    """Predict at the rows of a data set, one step ahead, or at asked times.

    Each prediction is made from what was observed strictly before its time, and written in the
    original units.

    Args:
        model: folder of a run or of a checkpoint.
        data: data set (.parquet) or CSV with a column `time`; empty cells are not known.
        out: .csv or .parquet file with columns trajectory, time (s) and one per channel.
        times: s, on the clock of the data, or since its first row where that clock is made of
            integers: --times 0.25 or --times '[0.25, 0.5]'. Later than the last row is fine;
            before the first observation the answer is the model's start value. By default the
            times of the rows.
        time_unit: of the times in a CSV: s, ms, us or ns; by default what its header says.
        seed: of the coins of self-feeding.
        json: print what was written as JSON.
    """
    import numpy as np

    from offbeat.data.readers import read
    from offbeat.data.trajectory import SECONDS_PER
    from offbeat.data.writers import write_table
    from offbeat.inference import predict
    from offbeat.models.checkpoint import load_checkpoint

    one_of("suffix of out", out.suffix, (".csv", ".parquet"))
    check_seed(seed)
    if out.exists() and data.exists() and out.samefile(data):
        raise InputError(f"{out} is the data set itself; give another file for the predictions")
    if time_unit is not None and data.suffix.lower() != ".csv":
        raise InputError(f"time_unit is an option of CSV files; {data} knows its own")
    if isinstance(times, float):
        times = [times]
    loaded = load_checkpoint(model)
    dataset = read(data) if time_unit is None else read(data, time_unit=time_unit)
    predicted = predict(loaded, dataset, times=times, seed=seed)
    each = [t.rows for t in predicted]
    labels = np.asarray(dataset.meta.get("labels", range(len(predicted))))
    seconds = np.concatenate([t.times for t in predicted])
    columns: dict[str, Any] = {"trajectory": np.repeat(labels, each), "time": seconds}
    if "clock_start" in dataset.meta:
        # An integer clock was read relative to its first row; this puts it back, to the tick.
        unit, start = dataset.meta["time_unit"], np.repeat(dataset.meta["clock_start"], each)
        ticks = seconds / SECONDS_PER[unit]
        columns[f"clock_{unit}"] = start + (ticks if unit == "s" else np.rint(ticks).astype(int))
    values = np.concatenate([t.values for t in predicted])
    columns.update({name: values[:, i] for i, name in enumerate(predicted.names)})
    write_table(out, columns)
    _say({"written": str(out), "rows": len(values)}, f"{out}: {len(values)} predictions", json)


def demo_command(out: Path = Path("runs/demo"), seed: int = 0, json: bool = False) -> None:
    """Run everything once, small: simulate, hide rows, train five models, score, draw.

    Args:
        out: folder for the table, the figures, the animation and the trained models.
        seed: of windows, hidden rows, split, weights and batches.
        json: print the scores as JSON.
    """
    from offbeat.demo import run_demo

    result = run_demo(out, seed=seed)
    _say(result.to_dict(), str(result), json)


def doctor_command(json: bool = False) -> None:
    """Tell versions, threads, and what is installed.

    Args:
        json: print as JSON.
    """
    from offbeat.doctor import examine

    findings = examine()
    width = max(len(name) for name in findings)
    text = "\n".join(f"{name.ljust(width)}  {value}" for name, value in findings.items())
    _say(findings, text, json)


# The functions are not named after the commands: jsonargparse would find their namesakes in the
# lazy package `offbeat`, and import torch to look at them.
COMMANDS: dict[str, Any] = {
    "simulate": simulate_command,
    "train": train_command,
    "evaluate": evaluate_command,
    "predict": predict_command,
    "demo": demo_command,
    "doctor": doctor_command,
}


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the command line; returns its exit code.

    0 is success, 2 bad input (one line on standard error says what is wrong), 1 a computation that
    failed, 130 an interrupt.
    """
    from jsonargparse import ArgumentError, auto_cli

    arguments = list(sys.argv[1:] if argv is None else argv) or ["--help"]
    # A flag, although options made from bool arguments want a value.
    arguments = ["--json=true" if argument == "--json" else argument for argument in arguments]
    if arguments == ["--version"]:
        from offbeat import __version__

        print(f"offbeat {__version__}")
        return 0
    arguments = _configs_first(arguments)
    try:
        auto_cli(
            COMMANDS,
            args=arguments,
            prog="offbeat",
            description=DESCRIPTION,
            formatter_class=_formatter(),
            exit_on_error=False,
        )
    except ArgumentError as error:
        return _fail(str(error), 2)
    except (OffbeatError, OSError) as error:
        return _fail(str(error), 1 if isinstance(error, ArithmeticError) else 2)
    except KeyboardInterrupt:
        return _fail("interrupted; the same command goes on from the last checkpoint", 130)
    return 0


def _configs_first(arguments: list[str]) -> list[str]:
    """Puts `--config FILE` before all else: what is typed wins over the file, in any order."""
    command, rest = arguments[:1], arguments[1:]
    configs: list[str] = []
    while any(a == "--config" or a.startswith("--config=") for a in rest):
        at = next(i for i, a in enumerate(rest) if a == "--config" or a.startswith("--config="))
        width = 2 if rest[at] == "--config" else 1
        configs += rest[at : at + width]
        rest = rest[:at] + rest[at + width :]
    return [*command, *configs, *rest]


def _fail(message: str, code: int) -> int:
    line = " ".join(message.split())
    print(f"offbeat: error: {line}", file=sys.stderr)
    return code


def _say(result: Any, text: str, as_json: bool) -> None:
    print(json_.dumps(result, indent=2) if as_json else text)


def _formatter() -> type:
    from jsonargparse import DefaultHelpFormatter

    class Formatter(DefaultHelpFormatter):
        """Leaves the lines of the description as they are."""

        def _fill_text(self, text: str, width: int, indent: str) -> str:
            return "".join(indent + line for line in text.splitlines(keepends=True))

    return Formatter


def _plain(config: dict[str, Any]) -> dict[str, Any]:
    return {k: list(v) if isinstance(v, tuple) else v for k, v in config.items()}
