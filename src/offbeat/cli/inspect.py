"""`offbeat inspect`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from offbeat.cli.common import say, without_warnings
from offbeat.errors import InputError, one_of
from offbeat.progress import busy

_FINISHED = (
    "a data set in the format of Offbeat is taken as it is: nothing is cleaned or left out",
    "whole trajectories train, validate and test; no value is masked unless "
    "--split.observed_fraction is given",
)


def inspect_command(
    data: Path,
    out: Path | None = None,
    reader: dict[str, Any] | None = None,
    run: Path = Path("runs/log"),
    json: bool = False,
) -> None:
    """Inspect a log: rates, gaps, outliers, anomalies, and the command that trains on it.

    Args:
        data: the log, of any format that Offbeat reads: a file, or the folder of a data set.
        out: figure to write (.png, .pdf or .svg): when each channel was measured.
        reader: how the log is read.
        run: folder of the run in the command that is printed.
        json: print everything as JSON.
    """
    from offbeat.data.advice import Advice, advise
    from offbeat.data.inspection import inspect
    from offbeat.data.readers import READERS, read
    from offbeat.files import writable

    if out is not None:
        one_of("suffix of out", out.suffix.lower(), (".png", ".pdf", ".svg"))
        writable(out)
    # The warnings of the reader are part of the output.
    with without_warnings():
        dataset = read(data, **(reader or {}))
    with busy("inspecting"):
        inspection = inspect(dataset)
    known = READERS[inspection.format].options if inspection.format in READERS else ()
    result = inspection.to_dict()
    try:
        advice = (
            advise(dataset, str(data), str(run), reader=reader, known=known)
            if "cleaning" in dataset.meta
            else Advice(("offbeat", "train", str(data), str(run)), _FINISHED)
        )
        result["advice"] = {"command": list(advice.command), "reasons": list(advice.reasons)}
        trained = ["To train on it:", "", f"  {str(advice).replace(chr(10), chr(10) + '  ')}", ""]
        trained += ["which chooses:", *(f"  - {reason}" for reason in advice.reasons)]
    except InputError as error:
        result["advice"] = {"command": None, "reasons": [str(error)]}
        trained = [f"It cannot be trained on: {error}"]
    if out is not None:
        from offbeat.plots.figures import save
        from offbeat.plots.log import log

        save(log(dataset, inspection, title=data.name), out)
        result["figure"] = str(out)
    say(result, "\n".join([*_text(inspection), *trained, *_figure(out)]), json)


def _text(inspection: Any) -> list[str]:
    from offbeat.cli.inspection_text import channel_table, episode_table, heading

    lines = [heading(inspection), "", channel_table(inspection), "", episode_table(inspection), ""]
    for title, said in (
        ("Found while reading:", inspection.found),
        ("Found in the values:", inspection.notes),
    ):
        if said:
            lines += [title, *(f"  - {sentence}" for sentence in said), ""]
    return lines


def _figure(out: Path | None) -> list[str]:
    return [] if out is None else ["", f"{out}: when each channel was measured"]
