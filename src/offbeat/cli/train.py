"""`offbeat train`."""

from __future__ import annotations

import sys
from contextlib import nullcontext
from dataclasses import asdict
from pathlib import Path
from typing import Any

from offbeat.cli.common import FOUND, READER_FILE, plain, read_planned, say
from offbeat.config import ModelConfig, SplitConfig, TrainConfig, check_seed, from_mapping
from offbeat.errors import InputError, one_of
from offbeat.progress import busy


def train_command(
    data: Path,
    out: Path,
    horizon_s: float | None = None,
    model: ModelConfig = ModelConfig(),  # noqa: B008  # frozen
    training: dict[str, Any] | None = None,
    split: SplitConfig = SplitConfig(),  # noqa: B008
    scaler: str | None = None,
    two_sided: bool | None = None,
    baselines: list[str] | None = None,
    budget_minutes: float = 4.0,
    reader: dict[str, Any] | None = None,
    seed: int = 0,
    threads: int = 1,
    device: str = "cpu",
    json: bool = False,
) -> None:
    """Train on a log for predictions, fills and forecasts with intervals, and score all of them.

    No option is needed. How the log is cleaned and split, its sensors, and the longest forecast are
    found in it, and said. A few models are tried, the best on validation is trained forward and
    backward, and blended with simple predictors so that the answers lose to none of these.

    Started by torchrun, all ranks train one model, which has to be given: each takes its part of
    every batch, and the first one writes the run.

    Args:
        data: the log, of any format that Offbeat reads.
        out: folder of the run: config.yaml, log.csv, checkpoints, models, blend, results.json. A
            run that was stopped continues from its last checkpoint.
        horizon_s: s, the longest forecast that will be asked for; by default found in the log.
        model: to train, with its options; by default the best of a few on validation.
        training: options of the training, those that differ from the recipe.
        split: windows, masked values, and the split into training, validation and test part. By
            default found in the log. With observed_fraction, and for a data set of Offbeat, models
            are trained on these windows and masks instead of the tasks that will be asked.
        scaler: standardise, robust, min_max, divide_by_max or identity; fitted on the training
            part. By default robust, and standardise for a data set in the format of Offbeat.
        two_sided: train a second model on reversed trajectories as well, for fills from both
            sides, in the folder backward of the run. By default for logs.
        baselines: names of the simple predictors that answers are blended with, such as
            [last_value,ridge,pchip]; by default all for logs, and those that are fitted at once
            for a data set of Offbeat.
        budget_minutes: time for trainings, baselines and blend, about, where the model is chosen.
        reader: how the log is read; the run keeps these options for the other commands.
        seed: of the initial weights.
        threads: of torch; one is fastest for models of this size.
        device: that the model is trained on: cpu, cuda, cuda:1, or auto for a GPU where there is a
            gain.
        json: print the scores as JSON.
    """
    import torch
    import yaml

    from offbeat.cli.scored import scored
    from offbeat.data.scaler import SCALERS
    from offbeat.data.splits import save_split
    from offbeat.distributed import group, is_first
    from offbeat.evaluation import evaluate
    from offbeat.files import writable, write_json, write_text
    from offbeat.learning import learn
    from offbeat.models.zoo import MODELS
    from offbeat.run import locked

    if scaler is not None:
        one_of("scaler", scaler, SCALERS)
    check_seed(seed)
    if threads < 1:
        raise InputError(f"threads must be an integer of at least 1, got {threads}")
    if not 0 < budget_minutes < float("inf"):
        raise InputError(f"budget_minutes must be a positive number, got {budget_minutes!r}")
    writable(out, folder=True)
    given = [name for name, value in asdict(model).items() if value is not None and name != "name"]
    if given and MODELS[model.name].factory is not None:
        raise InputError(
            f"--model.{given[0]} is an option of the models that come with Offbeat; {model.name} "
            "is a module with options of its own: register it under another name with those"
        )
    config: TrainConfig = from_mapping(TrainConfig, {"seed": seed, **(training or {})})
    torch.set_num_threads(threads)
    open_split = split == SplitConfig(seed=split.seed)
    given_split = None if open_split else split
    with busy("reading and inspecting the log"):
        dataset, chosen = read_planned(
            data, reader, horizon_s=horizon_s, split=given_split, seed=split.seed
        )
    if chosen is not None:
        reader, split = dict(chosen.reader), chosen.split
        for note in chosen.notes:
            print(f"offbeat: {note}", file=sys.stderr)
    as_it_is = chosen is None or (not open_split and split.observed_fraction is not None)
    open_model = model == ModelConfig()
    with group(device) as ranks, locked(out) if is_first() else nullcontext():
        learned = learn(
            dataset,
            out if is_first() else None,
            horizon_s=horizon_s,
            model=None if open_model and not as_it_is else model,
            training=config,
            split=split,
            chosen=chosen,
            as_it_is=as_it_is,
            two_sided=not as_it_is if two_sided is None else two_sided,
            baselines=baselines,
            scaler=scaler,  # type: ignore[arg-type]
            budget_s=60 * budget_minutes,
            seed=seed,
            device=device,
        )
        if ranks is not None and not ranks.first:
            return
        for note in learned.notes[len(() if chosen is None else chosen.notes) :]:
            print(f"offbeat: {note}", file=sys.stderr)
        blend, made = learned.blend, learned.blend.forward
        assert made is not None
        resolved = {
            "data": str(data),
            "out": str(out),
            "model": _resolved(made, model),
            "training": plain(asdict(learned.fit.recipe)),
            "split": plain(asdict(learned.split)),
            "scaler": made.scaler.kind,
            "horizon_s": blend.tasks.horizon_s,
            "two_sided": blend.backward is not None,
            "baselines": [*blend.stack.members, *blend.both.members],
            "reader": reader,
            "seed": seed,
            "threads": threads,
            "device": device,
        }
        write_text(out / "config.yaml", yaml.safe_dump(resolved, sort_keys=False))
        save_split(out / "split.json", learned.split, dataset)
        if reader or "found" in dataset.meta:
            kept = {**(reader or {}), FOUND: dataset.meta.get("found", {})}
            write_json(out / READER_FILE, kept)
        with busy("scoring the test part"):
            scores, text = scored(blend, learned.test, evaluate(made, learned.test))
        result = {"steps": learned.fit.steps, "part": "test", **scores}
        write_json(out / "results.json", result)
        heading = f"{out}: {learned.fit.steps} steps; scores of the test part"
        say(result, f"{heading}\n{text}", json)


def _resolved(made: Any, given: ModelConfig) -> dict[str, Any]:
    """The options of the model for config.yaml: with them, the same command gives the same model.

    A model that was chosen among a few is chosen again.
    """
    config = getattr(made, "config", None)
    if isinstance(config, ModelConfig):
        return plain(asdict(config))
    return plain({k: v for k, v in asdict(given).items() if v is not None})
