"""`offbeat forecast`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from offbeat.cli.common import (
    answer_columns,
    check_figure,
    check_out,
    one_trajectory,
    plotted_channels,
    read_log,
    say,
)
from offbeat.errors import InputError
from offbeat.progress import busy


def forecast_command(
    model: Path,
    data: Path,
    out: Path,
    horizons: list[float] | float | None = None,
    figure: Path | None = None,
    channels: list[str] | None = None,
    trajectory: int = 0,
    reader: dict[str, Any] | None = None,
    device: str = "cpu",
    json: bool = False,
) -> None:
    """Forecast what follows the last row of a log, in the units of the log.

    Args:
        model: folder of a run or of a saved model.
        data: the log, of any format that Offbeat reads.
        out: .csv or .parquet file with columns trajectory, time (s), horizon (s after the last
            row), one per channel, and one `name|observed` per channel, which is false: these values
            were not measured. With a blend also `name|low` and `name|high`, the ends of the
            interval of 90 %, and `name|beyond`, true where a forecast is beyond what was trained.
        horizons: seconds after the last row, such as --horizons 0.1,0.5,1.0.
        figure: .png, .pdf or .svg of the end of one trajectory, the forecast, last value and
            constant velocity.
        channels: names of the channels to plot; by default the first four.
        trajectory: number of the trajectory to plot, counted from 0.
        reader: options of reading the log; by default those of the training, unless a format is
            given.
        device: device that computes the models: cpu, cuda, cuda:1, or auto, which takes a GPU
            where it is faster.
        json: print what was written as JSON.
    """
    import numpy as np

    from offbeat.answers.forecast import checked_horizons, forecast
    from offbeat.answers.saved import load_run
    from offbeat.cli.scored import forecast_figure
    from offbeat.data.writers.tables import write_table
    from offbeat.devices import moved

    if horizons is None:
        raise InputError(
            "horizons are missing; give seconds after the last row, such as --horizons 0.1,0.5,1.0"
        )
    check_out(out, data)
    check_figure(figure)
    after = checked_horizons(horizons)
    loaded = moved(load_run(model), device)
    dataset = read_log(data, reader, run=model)
    with busy("forecasting"):
        predicted = forecast(loaded, dataset, after)
    chosen = plotted_channels(predicted.names, channels)
    one_trajectory(dataset, trajectory)
    columns = answer_columns(dataset, predicted)
    names = list(columns)
    at = names.index(predicted.names[0])
    columns["horizon"] = np.tile(after, len(predicted))
    write_table(out, {name: columns[name] for name in [*names[:at], "horizon", *names[at:]]})
    rows = len(predicted) * len(after)
    result = {"written": str(out), "rows": rows, "horizons_s": after.tolist()}
    text = f"{out}: {rows} predictions, up to {after[-1]:g} s after the last row"
    if figure is not None:
        forecast_figure(loaded, dataset, after, figure, chosen, trajectory)
        result["figure"] = str(figure)
        text += f"; {figure}"
    say(result, text, json)
