"""Wall time of `offbeat --help` and of the simulation.

python benchmarks/commands.py
python benchmarks/commands.py --robots hopper walker cheetah humanoid
"""

from __future__ import annotations

import argparse
import json
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from offbeat import simulate


def seconds(arguments: list[str], repeats: int) -> float:
    """Median wall time of `python -m offbeat` with these arguments."""
    taken = []
    for _ in range(repeats):
        started = time.perf_counter()
        subprocess.run(
            [sys.executable, "-m", "offbeat", *arguments], check=True, capture_output=True
        )
        taken.append(time.perf_counter() - started)
    return statistics.median(taken)


def main() -> None:
    """Prints a table, or JSON."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--robots", nargs="*", default=[], help="simulate these instead")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    if options.robots:
        shown(
            {f"{robot}, 10,000 x 200 rows": simulated(robot) for robot in options.robots}, options
        )
        return
    with tempfile.TemporaryDirectory() as folder:
        out = str(Path(folder) / "hopper.parquet")
        results = {
            "simulate() in Python, 10,000 x 200 rows": simulated("hopper"),
            "offbeat --help": seconds(["--help"], options.repeats),
            "offbeat simulate, 10,000 x 200 rows, written to disk": seconds(["simulate", out], 1),
        }
    shown(results, options)


def simulated(robot: str) -> float:
    """Wall time of 10,000 trajectories of 200 rows, on all cores."""
    started = time.perf_counter()
    simulate(robot, progress=False)
    return time.perf_counter() - started


def shown(results: dict[str, float], options: argparse.Namespace) -> None:
    """Prints them."""
    if options.json:
        print(json.dumps(results, indent=2))
        return
    print("| command | seconds |\n|---|---|")
    for name, value in results.items():
        print(f"| {name} | {value:.2f} |")


if __name__ == "__main__":
    main()
