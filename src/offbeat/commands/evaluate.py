"""`offbeat evaluate`."""

from __future__ import annotations

from pathlib import Path

from offbeat.commands.common import say
from offbeat.config import check_seed
from offbeat.errors import InputError, one_of


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
    say(result, f"{heading}\n{evaluation.table()}", json)
