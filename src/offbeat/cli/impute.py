"""`offbeat impute`."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

from offbeat.cli.common import (
    check_figure,
    known_options,
    one_trajectory,
    plotted_channels,
    read_log,
    say,
)
from offbeat.cli.written import check_answers, write_answers
from offbeat.config import check_seed
from offbeat.progress import busy


def impute_command(
    model: Path,
    data: Path,
    out: Path,
    mode: str | None = None,
    rate_hz: float | None = None,
    format: str | None = None,
    figure: Path | None = None,
    channels: list[str] | None = None,
    trajectory: int = 0,
    reader: dict[str, Any] | None = None,
    seed: int = 0,
    device: str = "cpu",
    json: bool = False,
) -> None:
    """Fill every value of a log that was not observed, in the units of the log.

    Args:
        model: folder of a run or of a saved model.
        data: the log, of any format that Offbeat reads; missing and masked values are filled.
        out: .csv or .parquet file with columns trajectory, time (s), one per channel, and one
            `name|observed` per channel: true where the value was measured, false where it was
            filled. With a blend also `name|low` and `name|high`, the ends of the interval of 90 %,
            and `name|beyond`, true where an answer is beyond what was trained. Other formats by
            their suffix: .mcap, .hdf5 (robomimic), .npz; a name without one is a LeRobot data set.
        mode: causal, from the past alone; two_sided, from past and future, the default of a run
            with a blend, which offbeat train makes.
        rate_hz: add rows at this rate where no row is within half a period, so that times at which
            no sensor reported are filled too. The log is then not split at outages, unless
            --reader.max_gap_s is given.
        format: format to write, such as minari; by default that of the suffix of out.
        figure: .png, .pdf or .svg of one trajectory, its fills, linear interpolation and PCHIP.
        channels: names of the channels to plot; by default the first four.
        trajectory: number of the trajectory to plot, counted from 0.
        reader: options of reading the log; by default those of the training, unless a format is
            given.
        seed: seed of models that draw random numbers (those trained with --model.self_feeding).
        device: device that computes the models: cpu, cuda, cuda:1, or auto, which takes a GPU
            where it is faster.
        json: print what was written as JSON.
    """
    from offbeat.answers.impute import impute
    from offbeat.answers.saved import load_run
    from offbeat.cli.scored import fill_figure
    from offbeat.devices import moved
    from offbeat.models.base import BaseModel

    check_answers(out, data, format)
    check_figure(figure)
    check_seed(seed)
    loaded = moved(load_run(model), device)
    if (model / "two_sided.json").is_file() and isinstance(loaded, BaseModel):
        print(
            f"offbeat: note: {model} is a two-sided run of an earlier version, whose rule is not "
            "read any more: values are filled from the past alone; train again for both sides",
            file=sys.stderr,
        )
    if rate_hz is not None and "max_gap_s" in known_options(data, reader, run=model):
        reader = {"max_gap_s": None, **(reader or {})}
    dataset = read_log(data, reader, run=model)
    with busy("filling"):
        filled = impute(loaded, dataset, mode=mode, rate_hz=rate_hz, seed=seed)  # type: ignore[arg-type]
    chosen = plotted_channels(filled.names, channels)
    one_trajectory(dataset, trajectory)
    name = write_answers(out, dataset, filled, format=format, data=data)
    filled_values = sum(int((~t.observed).sum()) for t in filled)
    total = sum(t.observed.size for t in filled)
    how = str(filled.meta["filled"])
    result = {
        "written": str(out),
        "format": name,
        "mode": how,
        "filled": filled_values,
        "values": total,
    }
    text = f"{out}: {filled_values} of {total} values filled ({how})"
    if not filled_values:
        text += _why_none(dataset, rate_hz)
    if figure is not None:
        fill_figure(
            loaded, dataset, figure, chosen, trajectory, mode=how, rate_hz=rate_hz, seed=seed
        )
        result["figure"] = str(figure)
        text += f"; {figure}"
    say(result, text, json)


def _why_none(dataset: Any, rate_hz: float | None) -> str:
    """Why there was nothing to fill, and what gives something, in a sentence."""
    import numpy as np

    gaps = np.concatenate([np.diff(t.times) for t in dataset] or [np.zeros(0)])
    if rate_hz is not None or not len(gaps):
        return "; every channel was measured in every row, so there is nothing to fill"
    rate = 1 / float(np.median(gaps))
    return (
        "; every channel was measured in every row, so there is nothing to fill: --rate_hz "
        f"{2 * rate:.3g} adds rows in between, and offbeat evaluate masks values and scores fills"
    )
