"""`offbeat predict`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from offbeat.commands.common import answer_columns, check_out, read_log, say
from offbeat.config import check_seed
from offbeat.errors import InputError


def predict_command(
    model: Path,
    data: Path,
    out: Path,
    times: list[float] | float | None = None,
    time_unit: str | None = None,
    reader: dict[str, Any] | None = None,
    seed: int = 0,
    json: bool = False,
) -> None:
    """Predict at the rows of a data set, one step ahead, or at asked times.

    Each prediction is made from what was observed strictly before its time, and written in the
    original units.

    Args:
        model: folder of a run or of a checkpoint.
        data: the log, of any format that Offbeat reads; a CSV has a column `time`, and empty cells
            where nothing is known.
        out: .csv or .parquet file with columns trajectory, time (s) and one per channel.
        times: s, on the clock of the data, or since its first row where that clock is made of
            integers: --times 0.25 or --times '[0.25, 0.5]'. Later than the last row is fine;
            before the first observation the answer is the model's start value. By default the
            times of the rows.
        time_unit: of the times in a CSV: s, ms, us or ns; by default what its header says.
        reader: options of the log's format: --reader.format NAME, --reader.OPTION VALUE; by default
            those of the run.
        seed: of the coins of self-feeding.
        json: print what was written as JSON.
    """
    from offbeat.data.writers import write_table
    from offbeat.inference.predict import predict
    from offbeat.models.checkpoint import load_checkpoint

    check_out(out, data)
    check_seed(seed)
    if time_unit is not None and data.suffix.lower() != ".csv":
        raise InputError(f"time_unit is an option of CSV files; {data} knows its own")
    if time_unit is not None:
        reader = {**(reader or {}), "time_unit": time_unit}
    if isinstance(times, float):
        times = [times]
    loaded = load_checkpoint(model)
    dataset = read_log(data, reader, run=model)
    predicted = predict(loaded, dataset, times=times, seed=seed)
    columns = answer_columns(dataset, predicted, masks=False)
    rows = sum(t.rows for t in predicted)
    write_table(out, columns)
    say({"written": str(out), "rows": rows}, f"{out}: {rows} predictions", json)
