"""`offbeat evaluate`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from offbeat.cli.common import (
    check_figure,
    one_trajectory,
    plotted_channels,
    read_log,
    say,
)
from offbeat.config import MASKS, check_seed
from offbeat.errors import InputError, one_of
from offbeat.progress import busy


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
    calibration: Path | None = None,
    channels: list[str] | None = None,
    trajectory: int = 0,
    reader: dict[str, Any] | None = None,
    seed: int = 0,
    device: str = "cpu",
    json: bool = False,
) -> None:
    """Score a trained model and simple baselines on the same values.

    Predictions, fills and forecasts of a blend are compared with its model alone and with all its
    baselines. One-step-ahead predictions of a model are compared with the last observed value;
    fills of masked values with the last value, linear interpolation and PCHIP; forecasts at the
    horizons, if any are given, with the last value and constant velocity. Errors are in the
    channels' units and, over all channels, in scaled units.

    Args:
        model: folder of a run or of a saved model.
        data: the log, of any format that Offbeat reads.
        part: test, validation, train or all. On the data of the run, the windows, masks and split
            of the training are made again, and test is the default; other data is scored as a
            whole.
        observed_fraction: fraction of the observed values of other data that is not masked.
        mask: what is masked: rows, values, bursts or dropout.
        burst_rows: length of a burst or of a dropout in rows.
        burst_s: length of a burst or of a dropout in seconds, instead of in rows.
        horizons: seconds of the forecasts after the last row, such as --horizons 0.1,0.5; for a
            blend, by default fractions of the longest one that it was trained for.
        out: JSON file for the scores.
        figure: .png, .pdf or .svg of one trajectory, its masked values and the fills.
        calibration: .png, .pdf or .svg of the intervals: how many values are within those of each
            level, and how wide they are by the time since an observation.
        channels: names of the channels to plot; by default the first four.
        trajectory: number of the trajectory to plot, counted from 0 within the part.
        reader: options of reading the log; by default those of the training, unless a format is
            given.
        seed: seed of the mask, and of models that draw random numbers.
        device: device that computes the models: cpu, cuda, cuda:1, or auto, which takes a GPU
            where it is faster.
        json: print the scores as JSON.
    """
    from offbeat.answers.blend import Blend
    from offbeat.answers.forecast import checked_horizons
    from offbeat.answers.saved import load_run
    from offbeat.cli.scored import fill_figure, scored
    from offbeat.data.masking import mask_out
    from offbeat.data.redundant import leave_out_of
    from offbeat.data.splits import load_split
    from offbeat.devices import moved
    from offbeat.evaluation import evaluate
    from offbeat.files import write_json

    if part is not None:
        one_of("part", part, ("train", "validation", "test", "all"))
    check_seed(seed)
    one_of("mask", mask, MASKS)
    check_figure(figure)
    check_figure(calibration)
    after = None if horizons is None else checked_horizons(horizons).tolist()
    loaded = moved(load_run(model), device)
    forward = loaded.forward if isinstance(loaded, Blend) else loaded
    # As in training, where these channels were not masked.
    dataset = leave_out_of(read_log(data, reader, run=model), loaded.transforms)
    own = load_split(model / "split.json", dataset)
    if own is None and part not in (None, "all"):
        raise InputError(
            f"there is no {part} part: {model} was not trained on {data}, or is not the folder of "
            "a run; leave out --part to score all of it"
        )
    if own is not None and part != "all":
        part = part or "test"
        if observed_fraction is not None:
            raise InputError(
                "the masks of the training are made again; leave out --observed_fraction, or give "
                "--part all"
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
    chosen = plotted_channels(loaded.names, channels)
    one_trajectory(dataset, trajectory)
    evaluation = None if forward is None else evaluate(forward, dataset, seed=seed)
    with busy("scoring"):
        scores, text = scored(
            loaded, dataset, evaluation, horizons=after, seed=seed, calibration=calibration
        )
    result = {"part": part, **scores}
    if out is not None:
        write_json(out, result)
    scaler = "standard deviations" if evaluation is None else evaluation.scaler
    heading = f"RMSE in scaled units ({scaler}), part: {part}, {len(dataset)} trajectories"
    if figure is not None:
        fill_figure(loaded, dataset, figure, chosen, trajectory, seed=seed)
        result["figure"] = str(figure)
    if calibration is not None:
        result["calibration"] = str(calibration)
    say(result, f"{heading}\n{text}", json)
