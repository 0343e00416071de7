"""`offbeat predict`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from offbeat.cli.common import answer_columns, check_out, read_log, reader_options, say
from offbeat.config import check_seed
from offbeat.errors import InputError

if TYPE_CHECKING:
    from offbeat.data.trajectory import Dataset


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
        out: .csv or .parquet file with columns trajectory, time (s, as times), clock_UNIT (what the
            clock of the log shows then, in its own unit, where that differs) and one per channel.
        times: s since the first row of each trajectory, whatever unit the log counts in: --times
            0.25 or --times '[0.25, 0.5]'. With --reader.start clock, s on the clock of the log
            itself; a data set that Offbeat saved keeps the times it was saved with. Later than the
            last row is fine; before the first observation the answer is the model's start value. By
            default the times of the rows.
        time_unit: that a CSV counts in: s, ms, us or ns; by default what its header says, or its
            numbers. The times asked for stay in s.
        reader: options of the log's format: --reader.format NAME, --reader.OPTION VALUE; the run's
            own hold for what is not given, unless a format is.
        seed: of the generator of self-feeding.
        json: print what was written as JSON.
    """
    from offbeat.answers.predict import predict
    from offbeat.data.writers.tables import write_table
    from offbeat.models.checkpoint import load_model

    check_out(out, data)
    check_seed(seed)
    if time_unit is not None and data.suffix.lower() != ".csv":
        raise InputError(f"time_unit is an option of CSV files; {data} knows its own")
    if time_unit is not None:
        reader = {**reader_options(reader, model), "time_unit": time_unit}
    if isinstance(times, float):
        times = [times]
    loaded = load_model(model)
    dataset = read_log(data, reader, run=model)
    if times is not None:
        _check_since(dataset, times)
    predicted = predict(loaded, dataset, times=times, seed=seed)
    columns = answer_columns(dataset, predicted, masks=False)
    rows = sum(t.rows for t in predicted)
    write_table(out, columns)
    say({"written": str(out), "rows": rows}, f"{out}: {rows} predictions", json)


def _check_since(dataset: Dataset, times: list[float]) -> None:
    """Refuses times of the log's own clock, which would be answered far behind its end.

    Raises:
        InputError: a time is later than every row, but the clock of a trajectory showed it.
    """
    from offbeat.data.cleaning.clocks import NANOSECONDS_PER

    if "clock_start" not in dataset.meta:
        return
    per_second = NANOSECONDS_PER["s"] // NANOSECONDS_PER[dataset.meta["time_unit"]]
    last = max(float(t.times[-1]) for t in dataset)
    for start, trajectory in zip(dataset.meta["clock_start"], dataset, strict=True):
        shown = start / per_second
        for time in times:
            if time > last and shown <= time <= shown + trajectory.times[-1]:
                raise InputError(
                    f"times are seconds since the first row, when the clock of the log showed "
                    f"{shown!r} s; {time!r} is later than its last row, {last!r}, but on its clock "
                    f"within the log: give {time - shown:.9g}, or read it with --reader.start clock"
                )
