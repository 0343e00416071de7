"""From a log with holes to fills, forecasts and a LeRobot data set, in five commands.

python examples/ten_minutes.py runs/ten_minutes

It runs the commands below in that folder and prints each before: copy them, with a log of your own
as `arm.csv`. The log is that of a simulated arm whose sensors report at 200, 100 and 20 Hz and drop
out at times.
"""

from __future__ import annotations

import argparse
import shlex
import subprocess
import sys
import time
from pathlib import Path

COMMANDS = """
python examples/arm_log.py arm.csv --seconds 60
offbeat train arm.csv run --budget_minutes 1
offbeat impute run arm.csv filled.csv --figure filled.png
offbeat forecast run arm.csv ahead.csv --horizons 0.1,0.5 --figure ahead.png
offbeat resample arm.csv lerobot --rate_hz 30 --run run
"""
ROOT = Path(__file__).resolve().parents[1]
PROGRAMS = {"python": [sys.executable], "offbeat": [sys.executable, "-m", "offbeat"]}


def main() -> int:
    """Runs the commands; returns the exit code of the first that fails."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("out", type=Path, help="folder for everything")
    parser.add_argument("--log", default="", help="further options for the log")
    parser.add_argument("--train", default="", help="further options of offbeat train")
    given = parser.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    further = {"examples/arm_log.py": given.log, "train": given.train}
    began = time.monotonic()
    for line in COMMANDS.strip().splitlines():
        program, what, *arguments = shlex.split(line)
        command = f"{line} {further.get(what, '')}".strip()
        print(f"\n$ {command}", flush=True)
        first = str(ROOT / what) if program == "python" else what
        arguments += shlex.split(further.get(what, ""))
        code = subprocess.run([*PROGRAMS[program], first, *arguments], cwd=given.out).returncode
        if code:
            return code
    print(f"\nfive commands, {(time.monotonic() - began) / 60:.1f} minutes: {given.out}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
