"""`offbeat resample`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from offbeat.cli.common import known_options, read_log, say
from offbeat.cli.written import check_answers, write_answers
from offbeat.config import check_seed
from offbeat.errors import InputError
from offbeat.progress import busy


def resample_command(
    data: Path,
    out: Path,
    rate_hz: float | None = None,
    run: Path | None = None,
    format: str | None = None,
    reader: dict[str, Any] | None = None,
    seed: int = 0,
    json: bool = False,
) -> None:
    """Write a log at even times, its gaps filled, with what was measured and intervals marked.

    A bag of sensors at four rates becomes a LeRobot data set in one command:
    offbeat resample walk.bag walk --rate_hz 30

    Args:
        data: the log, of any format that Offbeat reads.
        out: file or folder to write. A name without a suffix is a LeRobot data set; .csv and
            .parquet are tables, .hdf5 is robomimic's, .mcap and .npz as they say.
        rate_hz: rows per second. A log that was split at outages has even times in each part.
        run: folder of a run that fills the gaps; by default a blend of line, PCHIP and Kalman
            smoother does, which is fitted to the log.
        format: format to write, such as minari; by default that of the suffix of out.
        reader: how the log is read. What is not given is read as in training of the run.
        seed: seed of the simple fill, and of models that draw random numbers.
        json: print what was written as JSON.
    """
    from offbeat.answers.resample import resample
    from offbeat.answers.saved import load_run

    if rate_hz is None:
        raise InputError("rate_hz is missing; give rows per second, such as --rate_hz 30")
    check_answers(out, data, format)
    check_seed(seed)
    model = None if run is None else load_run(run)
    if run is None and "outliers" in known_options(data, reader):
        reader = {"outliers": "mask", **(reader or {})}
    dataset = read_log(data, reader, run=run)
    with busy("filling"):
        even = resample(dataset, rate_hz, model, seed=seed)
    name = write_answers(out, dataset, even, format=format, data=data, rate_hz=rate_hz)
    rows, total = sum(t.rows for t in even), sum(t.observed.size for t in even)
    filled = total - sum(int(t.observed.sum()) for t in even)
    by = str(even.meta["filled_by"])
    result = {
        "written": str(out),
        "format": name,
        "trajectories": len(even),
        "rows": rows,
        "filled": filled,
        "values": total,
        "filled_by": by,
    }
    episodes = "trajectory" if len(even) == 1 else "trajectories"
    text = (
        f"{out}: {name}, {len(even)} {episodes}, {rows} rows at {rate_hz:g} Hz; {filled} of "
        f"{total} values have no measurement within half a period and are filled ({by})"
    )
    say(result, text, json)
