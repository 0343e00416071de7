"""Reading a large table: 1 million rows x 30 channels of CSV and of Parquet, to a data set.

    python benchmarks/readers.py [--rows 1000000] [--channels 30] [--repeats 3] [--out FILE]

The file is written once, with a clock in nanoseconds and one value in twenty missing. The readers
alternate; wall and CPU seconds, medians and minima. pyarrow alone, which makes columns and no
trajectories, is timed for comparison.
"""

from __future__ import annotations

import argparse
import importlib.metadata
import json
import os
import platform
import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.csv as pv
import pyarrow.parquet as pq

from offbeat.data.readers import read
from offbeat.sweeps.provenance import commit, cpu


def write(folder: Path, rows: int, channels: int) -> dict[str, Path]:
    """The same table as CSV and as Parquet."""
    random = np.random.default_rng(0)
    stamps = 1_700_000_000_000_000_000 + np.cumsum(random.integers(1_000_000, 8_000_000, rows))
    columns: dict[str, Any] = {"time_ns": stamps}
    for c in range(channels):
        values = np.round(np.cumsum(random.normal(size=rows)) * 0.01, 6)
        columns[f"joint_{c}"] = pa.array(values, mask=random.random(rows) < 0.05)
    table = pa.table(columns)
    made = {"csv": folder / "log.csv", "parquet": folder / "log.parquet"}
    pv.write_csv(table, made["csv"])
    pq.write_table(table, made["parquet"])
    return made


def main() -> None:
    """Prints a table, and writes JSON if a path is given."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rows", type=int, default=1_000_000)
    parser.add_argument("--channels", type=int, default=30)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    load = os.getloadavg()[0] if hasattr(os, "getloadavg") else None
    with tempfile.TemporaryDirectory() as folder:
        paths = write(Path(folder), options.rows, options.channels)
        ways: dict[str, Callable[[], Any]] = {
            "csv": lambda: read(paths["csv"]),
            "csv_pyarrow_alone": lambda: pv.read_csv(paths["csv"]),
            "parquet": lambda: read(paths["parquet"]),
            "parquet_pyarrow_alone": lambda: pq.read_table(paths["parquet"]),
        }
        wall: dict[str, list[float]] = {name: [] for name in ways}
        busy: dict[str, list[float]] = {name: [] for name in ways}
        for _ in range(options.repeats):
            for name, way in ways.items():
                started = time.perf_counter(), time.process_time()
                way()
                wall[name].append(time.perf_counter() - started[0])
                busy[name].append(time.process_time() - started[1])
        sizes = {name: path.stat().st_size for name, path in paths.items()}
    result = {
        "rows": options.rows,
        "channels": options.channels,
        "repeats": options.repeats,
        "bytes": sizes,
        "wall_seconds": {name: statistics.median(seconds) for name, seconds in wall.items()},
        "least_wall_seconds": {name: min(seconds) for name, seconds in wall.items()},
        "cpu_seconds": {name: statistics.median(seconds) for name, seconds in busy.items()},
        "least_cpu_seconds": {name: min(seconds) for name, seconds in busy.items()},
        "cpu": cpu(),
        "cores": os.cpu_count(),
        "load_before": load,
        "python": platform.python_version(),
        "commit": commit(),
        **{name: importlib.metadata.version(name) for name in ("numpy", "pyarrow")},
    }
    print(f"{'':24}{'wall s':>10}{'least':>10}{'CPU s':>10}{'least':>10}")
    for name in ways:
        print(
            f"{name:24}{result['wall_seconds'][name]:10.2f}"
            f"{result['least_wall_seconds'][name]:10.2f}{result['cpu_seconds'][name]:10.2f}"
            f"{result['least_cpu_seconds'][name]:10.2f}"
        )
    if options.out is not None:
        options.out.parent.mkdir(parents=True, exist_ok=True)
        options.out.write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
