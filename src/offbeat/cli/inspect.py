"""`offbeat inspect`."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

from offbeat.cli.common import say
from offbeat.errors import one_of


def inspect_command(
    data: Path,
    out: Path | None = None,
    reader: dict[str, Any] | None = None,
    run: Path = Path("runs/log"),
    json: bool = False,
) -> None:
    """Inspect a log: rates, gaps, repeated values, anomalies, and a command that trains on it.

    Args:
        data: the log, of any format that Offbeat reads: a file, or the folder of a data set.
        out: figure to write (.png, .pdf or .svg): when each channel was measured.
        reader: how the log is read.
        run: folder of the run in the command that is printed.
        json: print everything as JSON.
    """
    from offbeat.data.advice import advise
    from offbeat.data.inspection import inspect
    from offbeat.data.readers import READERS, read
    from offbeat.files import writable

    if out is not None:
        one_of("suffix of out", out.suffix.lower(), (".png", ".pdf", ".svg"))
        writable(out)
    # The warnings of the reader are part of the output.
    logging.getLogger("offbeat").addFilter(_silence)
    try:
        dataset = read(data, **(reader or {}))
    finally:
        logging.getLogger("offbeat").removeFilter(_silence)
    inspection = inspect(dataset)
    known = READERS[inspection.format].options if inspection.format in READERS else ()
    advice = advise(dataset, str(data), str(run), reader=reader, known=known)
    result = inspection.to_dict()
    result["advice"] = {"command": list(advice.command), "reasons": list(advice.reasons)}
    if out is not None:
        from offbeat.plots.figures import save
        from offbeat.plots.log import log

        save(log(dataset, inspection, title=data.name), out)
        result["figure"] = str(out)
    say(result, _text(inspection, advice, out), json)


def _silence(record: logging.LogRecord) -> bool:
    return record.levelno > logging.WARNING


def _text(inspection: Any, advice: Any, out: Path | None) -> str:
    from offbeat.cli.inspection_text import channel_table, episode_table, heading

    lines = [heading(inspection), "", channel_table(inspection), "", episode_table(inspection)]
    if inspection.found:
        lines += ["", "Found while reading:", *(f"  - {said}" for said in inspection.found)]
    lines += ["", "To train on it:", "", f"  {str(advice).replace(chr(10), chr(10) + '  ')}", ""]
    lines += [f"  - {reason}" for reason in advice.reasons]
    if out is not None:
        lines += ["", f"{out}: when each channel was measured"]
    return "\n".join(lines)
