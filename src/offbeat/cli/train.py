"""`offbeat train`."""

from __future__ import annotations

import sys
from dataclasses import asdict
from pathlib import Path
from typing import Any

from offbeat.cli.common import FOUND, READER_FILE, plain, read_planned, say
from offbeat.config import ModelConfig, SplitConfig, check_seed
from offbeat.errors import InputError, one_of

LONG = 2000
"""Rows of a training trajectory above which a note recommends windows."""


def train_command(
    data: Path,
    out: Path,
    model: ModelConfig = ModelConfig(),  # noqa: B008  # frozen
    training: dict[str, Any] | None = None,
    split: SplitConfig = SplitConfig(),  # noqa: B008
    scaler: str | None = None,
    horizon_s: float | None = None,
    two_sided: bool = False,
    reader: dict[str, Any] | None = None,
    seed: int = 0,
    threads: int = 1,
    device: str = "cpu",
    json: bool = False,
) -> None:
    """Train a model on a data set, and score it on the test part.

    How a log is cleaned and split, and which channels are left out, is found in the log, and said;
    options that are given are kept. Each model has a training recipe of its own; options of the
    training that are not given are those of the recipe. The weights with the best validation error
    are kept.

    Args:
        data: the log, of any format that Offbeat reads.
        out: folder of the run: config.yaml, log.csv, checkpoints, model, results.json. A run that
            was stopped continues from its last checkpoint.
        model: what the model consists of; only the name is needed.
        training: of epochs, optimizer and the rest, those that differ from the model's recipe.
        split: windows, masked values, and the split into training, validation and test part. If
            no option of it is given, all are found in the log.
        scaler: standardise, robust, min_max, divide_by_max or identity; fitted on the training
            part. By default robust, and standardise for a data set in the format of Offbeat.
        horizon_s: s, the longest forecast that will be asked for; by default found in the log.
        two_sided: train a second model on reversed trajectories as well, so that impute can fill
            from both sides; it is saved in the folder backward of the run.
        reader: how the log is read; the run keeps these options for the other commands.
        seed: of the initial weights.
        threads: of torch; one is fastest for models of this size.
        device: that the model is trained on: cpu, cuda or cuda:1.
        json: print the scores as JSON.
    """
    import torch
    import yaml

    from offbeat.answers.impute import fit_two_sided
    from offbeat.answers.two_sided import TwoSided
    from offbeat.cli.scored import scored
    from offbeat.data.scaler import SCALERS
    from offbeat.data.splits import apply_split, save_split
    from offbeat.evaluation import evaluate
    from offbeat.files import writable, write_json, write_text
    from offbeat.models.base import BaseModel
    from offbeat.models.model import Model
    from offbeat.models.zoo import make_model, train_config
    from offbeat.training import fit

    if scaler is not None:
        one_of("scaler", scaler, SCALERS)
    check_seed(seed)
    if threads < 1:
        raise InputError(f"threads must be an integer of at least 1, got {threads}")
    writable(out, folder=True)
    config = train_config(model.name, **{"keep": "best", **(training or {})})
    torch.set_num_threads(threads)
    open_split = split == SplitConfig(seed=split.seed)
    dataset, chosen = read_planned(
        data, reader, horizon_s=horizon_s, split=None if open_split else split, seed=split.seed
    )
    if chosen is not None:
        reader, split = dict(chosen.reader), chosen.split
        for note in chosen.notes:
            print(f"offbeat: {note}", file=sys.stderr)
    scaler = scaler or ("standardise" if chosen is None else "robust")
    train_part, validation, test = apply_split(dataset, split)
    longest = max(t.rows for t in train_part)
    if longest > LONG:
        print(
            f"offbeat: note: training trajectories have up to {longest} rows, each step goes "
            "through all of them; windows train faster: --split.window 200 --split.cut random",
            file=sys.stderr,
        )
    made = make_model(model, train_part, scaler=scaler, seed=seed)  # type: ignore[arg-type]
    composed = isinstance(made, Model)
    given = [name for name, value in asdict(model).items() if value is not None and name != "name"]
    if given and not composed:
        raise InputError(
            f"--model.{given[0]} is an option of the models that come with Offbeat; {model.name} "
            "is a module with options of its own: register it under another name with those"
        )
    resolved = {
        "data": str(data),
        "out": str(out),
        "model": plain(asdict(made.config)) if composed else {"name": made.name},
        "training": plain(asdict(config)),
        "split": plain(asdict(split)),
        "scaler": scaler,
        "horizon_s": horizon_s if chosen is None else chosen.horizon_s,
        "two_sided": two_sided,
        "reader": reader,
        "seed": seed,
        "threads": threads,
        "device": device,
    }
    trained: BaseModel | TwoSided = made
    if two_sided:
        trained, fitted, _ = fit_two_sided(
            made, train_part, validation, config, out=out, seed=seed, device=device
        )
    else:
        fitted = fit(made, train_part, validation, config, out=out, device=device)
    write_text(out / "config.yaml", yaml.safe_dump(resolved, sort_keys=False))
    save_split(out / "split.json", split, dataset)
    if reader or "found" in dataset.meta:
        kept = {**(reader or {}), FOUND: dataset.meta.get("found", {})}
        write_json(out / READER_FILE, kept)
    evaluation = evaluate(made, test)
    scores, text = scored(trained, test, evaluation)
    result = {"steps": fitted.steps, "part": "test", **scores}
    write_json(out / "results.json", result)
    heading = f"{out}: {fitted.steps} steps; RMSE on the test part, in scaled units ({scaler})"
    say(result, f"{heading}\n{text}", json)
