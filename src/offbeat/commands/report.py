"""`offbeat report`."""

from __future__ import annotations

from pathlib import Path

from offbeat.commands.common import say


def report_command(
    runs: Path,
    out: Path = Path("runs/report"),
    observed_fraction: float = 0.3,
    illustrate: bool = True,
    json: bool = False,
) -> None:
    """Write the thesis' tables, figures and tests beside those of a reproduction, as one page.

    Runs that are missing are left out and named; the page can be made while runs go on.

    Args:
        runs: folder of a reproduction, with record.parquet or record.csv.
        out: folder for report.html, tables/ and figures/.
        observed_fraction: share of the rows at which hidden states are shown; the models are those
            of experiment 1 at this share, and of experiment 2 where experiment 1 has none.
        illustrate: make illustrations.npz in the folder of the runs where it is missing, from the
            robot's simulation and the checkpoints of the runs; needs the extra sim.
        json: print what was written as JSON.
    """
    from offbeat.experiment.illustrations import Illustrations
    from offbeat.report.reproduction import write_report

    if illustrate and runs.is_dir() and Illustrations.load(runs) is None:
        _illustrate(runs, observed_fraction)
    written = write_report(runs, out)
    say(written.to_dict(), str(written), json)


def _illustrate(runs: Path, fraction: float) -> None:
    import sys

    from offbeat.errors import MissingExtraError
    from offbeat.experiment.illustrate import checkpoints_of, illustrate

    try:
        made = illustrate(checkpoints_of(runs, fraction), observed_fraction=fraction)
        made.save(runs)
    except MissingExtraError as error:
        print(f"no illustrations: {error}", file=sys.stderr)
