"""Reading a file that does not fit into memory beside the data set: 10 GB by default.

    python benchmarks/large_file.py --json results/benchmarks/large_file.json
    python benchmarks/large_file.py --format parquet --gigabytes 2 --episodes 20

The file (30 channels, a clock in nanoseconds, one value in twenty missing) is written in chunks
into a temporary folder. `offbeat.read` reads all of it, and three of its channels, each in a new
process. Each reports the bytes of its data set's arrays, and its peak resident memory (`getrusage`)
with and without that of the interpreter and the libraries.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

CHUNK = 100_000  # rows
FEW = ["joint_3", "joint_11", "joint_29"]

# The peak of a process starts at that of its parent, so the parent imports the standard library
# only; everything else runs in new processes.
READ = """
import json, resource, sys, time
import pyarrow.csv, pyarrow.parquet
from offbeat.data.readers import read
unit = 1 if sys.platform == "darwin" else 1024
peak = lambda: resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit
before, started = peak(), time.perf_counter()
dataset = read(sys.argv[1], **json.loads(sys.argv[2]))
seconds, used = time.perf_counter() - started, resource.getrusage(resource.RUSAGE_SELF)
arrays = sum(t.times.nbytes + t.values.nbytes + t.observed.nbytes for t in dataset)
print(json.dumps({
    "episodes": len(dataset),
    "rows": sum(t.rows for t in dataset),
    "channels": dataset.channels,
    "seconds": seconds,
    "cpu_seconds": used.ru_utime + used.ru_stime,
    "array_bytes": arrays,
    "peak_bytes": peak(),
    "peak_bytes_before": before,
    "peak_to_arrays": peak() / arrays,
    "beside_to_arrays": (peak() - before - arrays) / arrays,
}))
"""


def write_file(path: Path, size: int, channels: int, episodes: int) -> None:
    """Writes chunks of random walks until the file has its size."""
    import numpy as np
    import pyarrow as pa
    import pyarrow.csv as pv
    import pyarrow.parquet as pq

    random = np.random.default_rng(0)
    stamp, level, writer = 1_700_000_000_000_000_000, np.zeros(channels), None
    with path.open("wb") as file:
        while file.tell() < size:
            columns: dict[str, Any] = {}
            if episodes > 1:
                columns["episode"] = np.full(CHUNK, file.tell() * episodes // size)
            columns["time_ns"] = stamp + np.cumsum(random.integers(1_000_000, 8_000_000, CHUNK))
            stamp = columns["time_ns"][-1]
            for c in range(channels):
                values = level[c] + np.cumsum(random.normal(size=CHUNK)) * 0.01
                level[c] = values[-1]
                missing = random.random(CHUNK) < 0.05
                columns[f"joint_{c}"] = pa.array(np.round(values, 6), mask=missing)
            table = pa.table(columns)
            if writer is None:
                kind = pv.CSVWriter if path.suffix == ".csv" else pq.ParquetWriter
                writer = kind(file, table.schema)
            writer.write_table(table)
        if writer is not None:
            writer.close()


def own_process(*command: str) -> str:
    """The output of a new process."""
    done = subprocess.run([sys.executable, *command], stdout=subprocess.PIPE, text=True, check=True)
    return done.stdout


def main() -> None:
    """Prints a table, and writes JSON if a path is given."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--gigabytes", type=float, default=10.0)
    parser.add_argument("--format", choices=("csv", "parquet"), default="csv")
    parser.add_argument("--channels", type=int, default=30)
    parser.add_argument("--episodes", type=int, default=1)
    parser.add_argument("--folder", type=Path, help="where the file is written, and removed again")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--write", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    size = int(options.gigabytes * 1e9)
    if options.write is not None:
        write_file(options.write, size, options.channels, options.episodes)
        return
    with tempfile.TemporaryDirectory(dir=options.folder) as folder:
        path = Path(folder) / f"log.{options.format}"
        own_process(*sys.argv, "--write", str(path))
        result: dict[str, Any] = {"command": "python " + " ".join(sys.argv)}
        result["file_bytes"] = path.stat().st_size
        for name, chosen in (("all_channels", {}), ("three_channels", {"channels": FEW})):
            result[name] = json.loads(own_process("-c", READ, str(path), json.dumps(chosen)))
    from common import machine

    result["machine"] = machine()
    print(f"{path.name}, {result['file_bytes'] / 1e9:.2f} GB")
    print(f"{'':16}{'rows':>12}{'s':>9}{'CPU s':>9}{'arrays GB':>11}{'peak GB':>9}{'ratio':>7}")
    for name in ("all_channels", "three_channels"):
        one = result[name]
        print(
            f"{name:16}{one['rows']:12}{one['seconds']:9.1f}{one['cpu_seconds']:9.1f}"
            f"{one['array_bytes'] / 1e9:11.2f}{one['peak_bytes'] / 1e9:9.2f}"
            f"{one['peak_to_arrays']:7.2f}"
        )
    if options.json is not None:
        options.json.parent.mkdir(parents=True, exist_ok=True)
        options.json.write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
