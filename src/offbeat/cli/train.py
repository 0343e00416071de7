"""`offbeat train`."""

from __future__ import annotations

import sys
from contextlib import nullcontext
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from offbeat.cli.common import FOUND, READER_FILE, plain, read_planned, say
from offbeat.config import ModelConfig, SplitConfig, TrainConfig, check_seed, from_mapping
from offbeat.errors import InputError, one_of
from offbeat.progress import busy

if TYPE_CHECKING:
    from offbeat.data.shards import ShardedDataset

LARGE = 0.25
"""Fraction of the available memory beyond which the files of a folder are read one by one."""

TEST_FILE = "test.parquet"
"""Windows that a run on such a folder was scored on."""

CONVERTED_WITH = {"outliers": "mask"}
"""Options of reading logs that are converted one by one, unless others are given."""


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
    lazy: bool | None = None,
    seed: int = 0,
    threads: int = 1,
    device: str = "cpu",
    json: bool = False,
) -> None:
    """Train on a log for predictions, fills and forecasts with intervals, and score all of them.

    No option is needed. How the log is cleaned and split, its sensors, and the longest forecast are
    found in it, and printed. A few models are tried. The best on validation data is trained forward
    and backward, and blended with simple predictors by their errors on validation data.

    Started by torchrun, all ranks train one model, which has to be given: each takes its part of
    every batch, and the first one writes the run.

    Args:
        data: the log, of any format that Offbeat reads.
        out: folder of the run: config.yaml, log.csv, checkpoints, models, blend, results.json. A
            run that was stopped continues from its last checkpoint.
        horizon_s: longest forecast that will be asked for, in seconds; by default found in the
            log.
        model: model to train, with its options; by default the best of a few on validation data.
        training: options of the training that differ from the recipe of the model.
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
        budget_minutes: about how long training may take in all, in minutes, where no model is
            named.
        reader: options of reading the log; the run keeps them for the other commands.
        lazy: read the files of a folder when they are needed, and never all at once; logs of other
            formats are first converted one by one into the folder converted of the run. By default
            where data sets of Offbeat need more than a quarter of the available memory.
        seed: seed of the initial weights and of the order of training.
        threads: threads of PyTorch; one is fastest for models of this size.
        device: device that trains the model: cpu, cuda, cuda:1, or auto, which takes a GPU where
            it is faster.
        json: print the scores as JSON.
    """
    import torch
    import yaml

    from offbeat.cli.scored import scored
    from offbeat.data.scaler import SCALERS
    from offbeat.data.splits import save_split
    from offbeat.data.store import save
    from offbeat.distributed import group, is_first
    from offbeat.evaluation import evaluate
    from offbeat.files import writable, write_json, write_text
    from offbeat.learning import learn
    from offbeat.learning_shards import learn_shards
    from offbeat.models.zoo import MODELS
    from offbeat.run import CONVERTED, locked

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
    open_model = model == ModelConfig()
    with group(device) as ranks, locked(out) if is_first() else nullcontext():
        opened = _opened_lazily(data, lazy, two_sided, reader, out)
        chosen = dataset = None
        if opened is None:
            with busy("reading and inspecting the log"):
                dataset, chosen = read_planned(
                    data, reader, horizon_s=horizon_s, split=given_split, seed=split.seed
                )
        if chosen is not None:
            reader, split = dict(chosen.reader), chosen.split
            for note in chosen.notes:
                print(f"offbeat: {note}", file=sys.stderr)
        as_it_is = chosen is None or (not open_split and split.observed_fraction is not None)
        common: dict[str, Any] = {
            "horizon_s": horizon_s,
            "training": config,
            "split": split,
            "baselines": baselines,
            "scaler": scaler,
            "seed": seed,
            "device": device,
        }
        folder = out if is_first() else None
        if opened is not None:
            learned = learn_shards(opened, folder, model=model, **common)
        else:
            assert dataset is not None
            learned = learn(
                dataset,
                folder,
                model=None if open_model and not as_it_is else model,
                chosen=chosen,
                as_it_is=as_it_is,
                two_sided=not as_it_is if two_sided is None else two_sided,
                budget_s=60 * budget_minutes,
                **common,
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
            "lazy": opened is not None,
            "seed": seed,
            "threads": threads,
            "device": device,
        }
        write_text(out / "config.yaml", yaml.safe_dump(resolved, sort_keys=False))
        if dataset is None:
            save(learned.test, out / TEST_FILE)
        else:
            save_split(out / "split.json", learned.split, dataset)
        meta = opened.meta if opened is not None else dataset.meta if dataset is not None else {}
        if opened is not None and opened.shards[0].path.parent == out / CONVERTED:
            reader = {**CONVERTED_WITH, **(reader or {})}
        if reader or "found" in meta:
            kept = {**(reader or {}), FOUND: meta.get("found", {})}
            write_json(out / READER_FILE, kept)
        with busy("scoring the test part"):
            scores, text = scored(blend, learned.test, evaluate(made, learned.test))
        result = {"steps": learned.fit.steps, "part": "test", **scores}
        write_json(out / "results.json", result)
        heading = f"{out}: {learned.fit.steps} steps; scores of the test part"
        if dataset is None:
            heading += f", whose windows are in {out / TEST_FILE}"
        say(result, f"{heading}\n{text}", json)


def _opened_lazily(
    data: Path,
    lazy: bool | None,
    two_sided: bool | None,
    reader: dict[str, Any] | None,
    out: Path,
) -> ShardedDataset | None:
    """The folder, if its files are to be read when they are needed; None if all at once.

    With `lazy`, logs that are no data sets of Offbeat are converted into the folder `converted` of
    the run, one by one.

    Raises:
        InputError: the former is asked for, and the data is no folder; or it is so, and a model of
            reversed trajectories is asked for.
    """
    from offbeat.data.converted import convert
    from offbeat.data.memory import available_memory, gigabytes
    from offbeat.data.shards import ShardedDataset
    from offbeat.data.store import holds_data_set
    from offbeat.distributed import on_first
    from offbeat.run import CONVERTED

    first = next(iter(sorted(data.glob("*.parquet"))), None) if data.is_dir() else None
    ours = first is not None and holds_data_set(first)
    if lazy and not data.is_dir():
        raise InputError(f"--lazy reads the files of a folder one by one, got {data}")
    if lazy is False or (not ours and not lazy):
        return None
    needs_memory = InputError(
        f"--two_sided needs the data in memory, and the files of {data} are read when they are "
        "needed; leave it out"
    )
    if lazy and two_sided:
        raise needs_memory
    if ours:
        opened = ShardedDataset.open(data)
    else:
        options = {**CONVERTED_WITH, **(reader or {})}

        found: list[ShardedDataset] = []

        def converted() -> None:
            found.append(convert(data, out / CONVERTED, **options))

        with busy(f"converting the files of {data} to {out / CONVERTED}"):
            on_first(converted)
        # The other ranks have waited, and find it done where they see the folder.
        opened = found[0] if found else convert(data, out / CONVERTED, **options)
    free = available_memory()
    if not lazy and (free is None or opened.bytes <= LARGE * free):
        return None
    if two_sided:
        raise needs_memory
    why = "" if lazy else f", more than {LARGE:.0%} of the {gigabytes(free or 0)} available"
    print(
        f"offbeat: {data}: {len(opened.shards)} files, {opened.rows} rows x {opened.channels} "
        f"channels, {gigabytes(opened.bytes)} in memory{why}: files are read when they are needed "
        "(--lazy=false reads all at once)",
        file=sys.stderr,
    )
    return opened


def _resolved(made: Any, given: ModelConfig) -> dict[str, Any]:
    """The options of the model for config.yaml: with them, the same command gives the same model.

    A model that was chosen among a few is chosen again.
    """
    config = getattr(made, "config", None)
    if isinstance(config, ModelConfig):
        return plain(asdict(config))
    return plain({k: v for k, v in asdict(given).items() if v is not None})
