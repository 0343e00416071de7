"""Training on folders of Parquet files: time and memory against the size of the data.

For each size, trajectories are generated into files, once, and a process of its own then opens the
folder, measures scales and statistics in one pass, and trains a GRU for one epoch, with windows and
masks drawn anew. A process whose resident memory exceeds the limit ends itself, and the benchmark
fails. Times are of the wall and of the processor; peaks of resident memory include the imports.

    python benchmarks/shards.py --gb 0.1,0.3,1,3 --json results/benchmarks/shards.json

Another call adds other sizes to the JSON; `--figure` draws it.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from common import machine

import offbeat as ob
from offbeat.data.shards import save_shards

CHANNELS, ROWS, WINDOW = 16, 2000, 100


def trajectories(gb: float) -> Iterator[ob.Trajectory]:
    """Waves with noise at uneven times, of `gb` GB as float64 in memory."""
    for i in range(round(gb * 1e9 / (8 * ROWS * (CHANNELS + 1)))):
        random = np.random.default_rng([3, i])
        times = np.cumsum(random.uniform(0.005, 0.015, ROWS))
        phase = random.uniform(0, 6, CHANNELS)
        noise = 0.05 * random.normal(size=(ROWS, CHANNELS))
        values = np.sin(np.linspace(1, 8, CHANNELS) * times[:, None] + phase) + noise
        yield ob.Trajectory(times, values.astype(np.float32).astype(np.float64))


def resident_mb(what: str) -> float:
    """MB of a line of the status of this process, such as VmHWM, the peak."""
    for line in Path("/proc/self/status").read_text(encoding="utf-8").splitlines():
        if line.startswith(f"{what}:"):
            return int(line.split()[1]) / 1024
    raise KeyError(what)


def ends_beyond(limit_mb: float) -> None:
    """Ends this process once its resident memory exceeds a limit."""
    while resident_mb("VmRSS") <= limit_mb:
        time.sleep(0.02)
    print(f"more than {limit_mb:g} MB", file=sys.stderr, flush=True)
    os._exit(9)


def trained(folder: Path, cache_mb: float, limit_mb: float) -> dict[str, Any]:
    """Opens, measures and trains in this process."""
    torch.set_num_threads(1)
    threading.Thread(target=ends_beyond, args=(limit_mb,), daemon=True).start()
    began = time.perf_counter()
    cpu = [time.process_time()]
    opened = ob.Dataset.open(folder, window=WINDOW, cache_mb=cache_mb)
    open_s, began = time.perf_counter() - began, time.perf_counter()
    model = ob.make_model("gru", opened, hidden_size=16)
    pass_s, before = time.perf_counter() - began, resident_mb("VmHWM")
    cpu.append(time.process_time())
    redraw = ob.RedrawConfig((0.3, 0.6))
    config = ob.TrainConfig(epochs=1, batch_size=512, redraw=redraw)
    began = time.perf_counter()
    result = ob.fit(model, opened, config=config, progress=False)
    epoch_s = time.perf_counter() - began
    cpu.append(time.process_time())
    return {
        "files": len(opened.shards),
        "rows": opened.rows,
        "windows": sum(opened.windows_of(s) for s in opened.shards),
        "mb_on_disk": sum(s.path.stat().st_size for s in opened.shards) / 1e6,
        "open_s": open_s,
        "statistics_s": pass_s,
        "epoch_s": epoch_s,
        "open_and_statistics_cpu_s": cpu[1] - cpu[0],
        "epoch_cpu_s": cpu[2] - cpu[1],
        "peak_mb_of_statistics": before,
        "peak_mb": resident_mb("VmHWM"),
        "train_mse": result.history[-1].train_mse,
    }


def draw(result: dict[str, Any], path: str) -> None:
    """A figure of time and peak memory against size."""
    from matplotlib.figure import Figure

    points = sorted(result["sizes"].values(), key=lambda point: point["gb"])
    gb = [point["gb"] for point in points]
    figure = Figure(figsize=(8, 3.2), layout="constrained")
    left, right = figure.subplots(1, 2)
    for name, label in (
        ("open_and_statistics_cpu_s", "scales and statistics"),
        ("epoch_cpu_s", "one epoch"),
    ):
        left.loglog(gb, [point[name] for point in points], "o-", label=label)
    left.set(xlabel="data, GB in float64", ylabel="time of the processor, s")
    left.legend(frameon=False)
    right.semilogx(gb, [point["peak_mb"] for point in points], "o-", label="peak, imports included")
    right.axhline(result["limit_mb"], color="0.5", ls="--", label="limit")
    right.semilogx(gb, [1e3 * size for size in gb], ":", color="0.7", label="the data")
    right.set(xlabel="data, GB in float64", ylabel="memory, MB", ylim=(0, 1.6 * result["limit_mb"]))
    right.legend(frameon=False)
    figure.savefig(path, dpi=150)


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--gb", default="0.1,0.3,1,3")
    parser.add_argument("--folder", type=Path, default=Path("/tmp/shards"))
    parser.add_argument("--cache_mb", type=float, default=128.0)
    parser.add_argument("--limit_mb", type=float, default=1000.0)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--figure")
    parser.add_argument("--one", type=Path, help="of the processes that are measured")
    asked = parser.parse_args()
    if asked.one is not None:
        print(json.dumps(trained(asked.one, asked.cache_mb, asked.limit_mb)))
        return
    result: dict[str, Any] = {"sizes": {}}
    if asked.json and asked.json.exists():
        result = json.loads(asked.json.read_text(encoding="utf-8"))
    result |= {
        "channels": CHANNELS,
        "window": WINDOW,
        "cache_mb": asked.cache_mb,
        "limit_mb": asked.limit_mb,
        "machine": machine(),
    }
    for gb in map(float, filter(None, asked.gb.split(","))):
        folder = asked.folder / f"{gb:g}"
        if not (folder / "done").exists():
            save_shards(trajectories(gb), folder)
            (folder / "done").touch()
        command = [sys.executable, __file__, "--one", str(folder)]
        command += ["--cache_mb", str(asked.cache_mb), "--limit_mb", str(asked.limit_mb)]
        found = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True)
        point = {"gb": gb, **json.loads(found.stdout.splitlines()[-1])}
        result["sizes"][f"{gb:g}"] = point
        print(json.dumps(point))
        if asked.json:
            asked.json.write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")
    if asked.figure:
        draw(result, asked.figure)


if __name__ == "__main__":
    main()
