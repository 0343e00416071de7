"""The command `python -m thesis`: `run` makes the runs, `report` writes the page."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from offbeat.cli.app import run_commands
from thesis.report_command import report_command
from thesis.run_command import run_command

COMMANDS = {"run": run_command, "report": report_command}


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the command line; returns its exit code, as `offbeat.cli.app.main`."""
    return run_commands(COMMANDS, argv, prog="python -m thesis", description=__doc__ or "")


if __name__ == "__main__":
    sys.exit(main())
