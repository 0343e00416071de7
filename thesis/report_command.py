"""`python -m thesis report`."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING

from offbeat.cli.common import say

if TYPE_CHECKING:
    from thesis.illustrations import Illustrations


def report_command(
    runs: Path,
    out: Path = Path("runs/report"),
    observed_fraction: float = 0.3,
    illustrate: bool = True,
    summary: Path | None = None,
    json: bool = False,
) -> None:
    """Write the thesis' tables, figures and tests next to those of a reproduction, as one page.

    Runs that are missing are left out and named; the page can be made while runs continue.

    Args:
        runs: folder of a reproduction, with record.parquet or record.csv.
        out: folder for report.html, summary.md, tables/ and figures/.
        observed_fraction: fraction of the rows at which hidden states are shown; the models are
            those of experiment 1 at this fraction, and of experiment 2 where experiment 1 has none.
        illustrate: where neither runs nor out has illustrations.npz of these models, make it in
            out, by simulation and from the checkpoints of the runs; needs the extra sim, and umap
            for the map of hidden states.
        summary: where to write the answers as a Markdown document, in place of summary.md in out.
        json: print what was written as JSON.
    """
    from offbeat.files import writable
    from thesis.illustrations import Illustrations
    from thesis.report.records import read_record
    from thesis.report.reproduction import write_report

    writable(out, folder=True)
    if summary is not None:
        writable(summary)
    read_record(runs)  # before minutes go into anything else
    shown = Illustrations.load(runs) or Illustrations.load(out)
    if illustrate:
        shown = _illustrated(runs, out, observed_fraction, shown)
    written = write_report(runs, out, illustrations=shown, summary=summary)
    say(written.to_dict(), str(written), json)


def _illustrated(
    runs: Path, out: Path, fraction: float, shown: Illustrations | None
) -> Illustrations | None:
    from offbeat import MissingExtraError
    from thesis.illustrate import checkpoints_of, illustrate, runs_of

    found = checkpoints_of(runs, fraction)
    if shown is not None and runs_of(found).items() <= shown.runs.items():
        return shown  # of these models, and maybe of others whose checkpoints are elsewhere
    try:
        made = illustrate(found, observed_fraction=fraction)
    except MissingExtraError as error:
        print(f"no new illustrations: {error}", file=sys.stderr)
        return shown
    made.save(out)
    return made
