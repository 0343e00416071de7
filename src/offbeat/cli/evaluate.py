"""`offbeat evaluate`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from offbeat.cli.common import (
    check_figure,
    drawn_channels,
    one_trajectory,
    read_log,
    say,
)
from offbeat.config import MASKS, check_seed
from offbeat.errors import InputError, one_of


def evaluate_command(
    model: Path,
    data: Path,
    part: str | None = None,
    observed_fraction: float | None = None,
    mask: str = "rows",
    burst_rows: int | None = None,
    burst_s: float | None = None,
    horizons: list[float] | float | None = None,
    out: Path | None = None,
    figure: Path | None = None,
    channels: list[str] | None = None,
    trajectory: int = 0,
    reader: dict[str, Any] | None = None,
    seed: int = 0,
    json: bool = False,
) -> None:
    """Score a trained model beside trivial predictors.

    One step ahead, beside the last observed value. Where cells are hidden, filling them, beside
    last value, linear interpolation and PCHIP. At horizons, if they are given, beside last value
    and constant velocity. Errors are in the channels' units and, over all channels, in scaled ones.

    Args:
        model: folder of a run or of a checkpoint.
        data: the log, of any format that Offbeat reads.
        part: test, validation, train or all. On the data that the run was trained on, the same
            windows, hidden rows and split are made again, and test is the default; other data can
            only be scored as a whole.
        observed_fraction: mask values of other data at random; this fraction stays observed.
        mask: how: rows, values, bursts or dropout.
        burst_rows: rows of a burst or of a silence.
        burst_s: its length in s, instead.
        horizons: s, to score extrapolation at: --horizons 0.5 or --horizons '[0.1, 0.5]'.
        out: JSON file for the scores.
        figure: .png, .pdf or .svg of one trajectory, its hidden cells and what fills them.
        channels: to draw; by default the first four.
        trajectory: to draw, counted from 0 within the part.
        reader: options of the log's format: --reader.format NAME, --reader.OPTION VALUE; the run's
            own hold for what is not given, unless a format is.
        seed: of hidden rows and generator.
        json: print the scores as JSON.
    """
    from offbeat.answers.forecast import checked_horizons
    from offbeat.answers.impute import load_run
    from offbeat.answers.two_sided import TwoSided
    from offbeat.cli.scored import fill_figure, scored
    from offbeat.data.masking import mask_out
    from offbeat.data.splits import load_split
    from offbeat.evaluation import evaluate
    from offbeat.files import write_json

    if part is not None:
        one_of("part", part, ("train", "validation", "test", "all"))
    check_seed(seed)
    one_of("mask", mask, MASKS)
    check_figure(figure)
    after = None if horizons is None else checked_horizons(horizons).tolist()
    loaded = load_run(model)
    dataset = read_log(data, reader, run=model)
    own = load_split(model / "split.json", dataset)
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
            dataset = mask_out(
                dataset,
                observed_fraction,
                mask=mask,  # type: ignore[arg-type]
                burst_rows=burst_rows,
                burst_s=burst_s,
                seed=seed,
            )
    forward = loaded.forward if isinstance(loaded, TwoSided) else loaded
    chosen = drawn_channels(forward.names, channels)
    one_trajectory(dataset, trajectory)
    evaluation = evaluate(forward, dataset, seed=seed)
    scores, text = scored(loaded, dataset, evaluation, horizons=after, seed=seed)
    result = {"part": part, **scores}
    if out is not None:
        write_json(out, result)
    heading = (
        f"RMSE in scaled units ({evaluation.scaler}), part: {part}, {len(dataset)} trajectories"
    )
    if figure is not None:
        fill_figure(loaded, dataset, figure, chosen, trajectory, seed=seed)
        result["figure"] = str(figure)
    say(result, f"{heading}\n{text}", json)
