"""`offbeat predict`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from offbeat.commands.common import say
from offbeat.config import check_seed
from offbeat.errors import InputError, one_of


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
    from offbeat.inference.predict import predict
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
    say({"written": str(out), "rows": len(values)}, f"{out}: {len(values)} predictions", json)
