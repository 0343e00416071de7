"""`offbeat sweep`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from offbeat.cli.common import read_log, say
from offbeat.config import SplitConfig

MODELS = ("gru_d", "ode_rnn", "anchored_ode_gru_d")
"""Models of a sweep by default."""


def sweep_command(
    data: Path,
    out: Path,
    models: list[str] | None = None,
    repeats: int = 5,
    split: SplitConfig = SplitConfig(),  # noqa: B008  # frozen
    training: dict[str, Any] | None = None,
    scaler: str = "standardise",
    engine: str = "local",
    processes: int | None = None,
    threads: int = 1,
    device: str = "cpu",
    together: int | None = None,
    budget_minutes: float | None = None,
    mixed: str = "refuse",
    engine_options: dict[str, str | int | float | bool | None] | None = None,
    reader: dict[str, Any] | None = None,
    json: bool = False,
) -> None:
    """Train and score several models over repeats, and compare them.

    In each repeat all models share windows, masks and split. Stopped at any moment, the same
    command continues and ends with the same numbers. For example: offbeat sweep hopper.parquet
    runs/sweep --models gru_d,ode_rnn --repeats 5 --split.window 100 --split.observed_fraction 0.3

    Args:
        data: the log, of any format that Offbeat reads.
        out: folder of the sweep: record.parquet and record.csv with a row per run, curves.parquet
            and curves.csv with a row per epoch, status.json, runs; offbeat compare reads it.
        models: names of models, as in --models gru_d,ode_rnn; by default gru_d, ode_rnn and
            anchored_ode_gru_d. A sweep can be continued with more.
        repeats: number of repeats; a comparison needs three, ten are better. A sweep can be
            continued with more.
        split: windows, masked values, and the split; its seed is that of the first repeat.
        training: epochs, optimizer and the rest, where they differ from each model's recipe.
        scaler: standardise, robust, min_max, divide_by_max or identity; fitted on the training
            part.
        engine: local (processes of this machine), ray or slurm.
        processes: runs at a time; by default as many as cores and memory allow.
        threads: threads of each run.
        device: device that trains the models: cpu, cuda, cuda:1, or auto, a GPU where there is one.
        together: runs of equal shape that are trained in one process and take their steps at once;
            by default 32 on a GPU with the triton backend, else 1.
        budget_minutes: minutes after which to stop; the same command continues later.
        mixed: where out has runs of other code, of another processor, backend, torch or data,
            refuse to continue, accept them (the record marks them), or redo them.
        engine_options: as JSON; for ray, arguments of ray.init, for slurm of submitit's
            update_parameters.
        reader: options of the log's format: --reader.format NAME, --reader.OPTION VALUE.
        json: print the comparison as JSON.
    """
    from offbeat.config import TrainConfig
    from offbeat.errors import one_of
    from offbeat.files import writable
    from offbeat.models.zoo import list_models
    from offbeat.sweeps.sweep import sweep

    models = list(MODELS if models is None else models)
    for name in models:
        one_of("model", name, list_models())
    writable(out, folder=True)
    done = sweep(
        read_log(data, reader),
        models,
        out=out,
        repeats=repeats,
        split=split,
        training=TrainConfig(**(training or {})),
        scaler=scaler,
        engine=engine,
        processes=processes,
        threads=threads,
        device=device,
        together=together,
        budget_minutes=budget_minutes,
        mixed=mixed,
        engine_options=engine_options,
    )
    result: dict[str, Any] = {
        "folder": str(done.folder),
        "runs": len(done.record.runs),
        "missing": [run.run_id for run in done.missing],
        "seconds": done.seconds,
    }
    text = str(done)
    if repeats >= 3 and not done.missing:
        baseline = "last_value" if len(set(models)) == 1 else None
        comparison = done.compare(baseline=baseline)
        result["comparison"] = comparison.to_dict()
        text += "\n\n" + comparison.text().rstrip("\n")
    elif not done.missing:
        text += "\nA comparison needs three repeats; the same command with --repeats 3 continues"
    say(result, text, json)
