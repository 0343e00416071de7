"""`offbeat predict`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from offbeat.cli.common import answer_columns, check_out, read_log, reader_options, say
from offbeat.config import check_seed
from offbeat.errors import InputError
from offbeat.progress import busy

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
    device: str = "cpu",
    json: bool = False,
) -> None:
    """Predict one step ahead at the rows of a log, or at given times.

    Each prediction uses only what was observed strictly before its time. Predictions are in the
    original units.

    Args:
        model: folder of a run or of a saved model.
        data: the log, of any format that Offbeat reads.
        out: .csv or .parquet file with columns trajectory, time (s, as times), clock_UNIT (what the
            clock of the log shows, in its own unit, where that differs) and one per channel. With
            a blend also `name|low`, `name|high` and `name|beyond`, as of offbeat impute.
        times: seconds since the first row of each trajectory, in any unit of the log, such
            as --times 0.25,0.5; by default the times of the rows. With --reader.start clock,
            seconds on the clock of the log. A data set that Offbeat saved keeps the times it was
            saved with. Times after the last row are allowed. Before the first observation, the
            prediction is the model's initial one.
        time_unit: unit of the times in a CSV: s, ms, us or ns; by default found in its header or
            its numbers. It does not change the unit of --times.
        reader: options of reading the log; by default those of the training, unless a format is
            given.
        seed: seed of models that draw random numbers (those trained with --model.self_feeding).
        device: device that computes the models: cpu, cuda, cuda:1, or auto, which takes a GPU
            where it is faster.
        json: print what was written as JSON.
    """
    from offbeat.answers.predict import predict
    from offbeat.answers.saved import load_run
    from offbeat.data.writers.tables import write_table
    from offbeat.devices import moved

    check_out(out, data)
    check_seed(seed)
    if time_unit is not None and data.suffix.lower() != ".csv":
        raise InputError(f"--time_unit is an option of CSV files; {data} has its own unit")
    if time_unit is not None:
        reader = {**reader_options(reader, model), "time_unit": time_unit}
    if isinstance(times, float):
        times = [times]
    loaded = moved(load_run(model), device)
    dataset = read_log(data, reader, run=model)
    if times is not None:
        _check_since(dataset, times)
    with busy("predicting"):
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
    unit, second = NANOSECONDS_PER[dataset.meta["time_unit"]], NANOSECONDS_PER["s"]
    last = max(float(t.times[-1]) for t in dataset)
    for start, trajectory in zip(dataset.meta["clock_start"], dataset, strict=True):
        shown = start / (second // unit) if unit <= second else start * (unit // second)
        for time in times:
            if time > last and shown <= time <= shown + trajectory.times[-1]:
                raise InputError(
                    f"times are seconds since the first row, when the clock of the log showed "
                    f"{shown!r} s; {time!r} is later than its last row, {last!r}, but on its clock "
                    f"within the log: give {time - shown:.9g}, or read it with --reader.start clock"
                )
