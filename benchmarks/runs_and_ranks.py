"""The time of a training against the number of ranks, and of a sweep against the number of runs.

Ranks are processes that `torchrun` starts for one training of ODE-GRU-D (the protocol's sizes),
each with one thread; one process with as many threads is beside them. The epochs of a training
are timed on the wall, and the first is left out. Trainings take turns. A sweep is timed as a
whole, with the starts of its processes.

    python benchmarks/runs_and_ranks.py --json results/benchmarks/runs_and_ranks.json
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import torch
from common import machine, synthetic, write

import offbeat as ob
from offbeat.distributed import group

MODEL, TRAJECTORIES, ROWS, RUN_EPOCHS = "ode_gru_d", 2000, 100, 5


def train(batch: int, epochs: int, threads: int, out: Path) -> None:
    """A training by the ranks that run this; the first one writes the seconds of its epochs."""
    data = synthetic(TRAJECTORIES, ROWS, observed_fraction=0.3)
    torch.set_num_threads(threads)
    with group() as ranks:
        model = ob.make_model(ob.thesis_config(MODEL), data, seed=0)
        config = ob.TrainConfig(epochs=epochs, batch_size=batch, keep="last")
        fitted = ob.fit(model, data, config=config, progress=False)
        if ranks is None or ranks.first:
            out.write_text(
                json.dumps([record.seconds for record in fitted.history]), encoding="utf-8"
            )


def epoch_s(ranks: int, threads: int, batch: int, epochs: int) -> list[float]:
    """Seconds of each epoch but the first.

    Args:
        ranks: processes.
        threads: of each.
        batch: trajectories per step of all ranks together.
        epochs: of the training.
    """
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "seconds.json"
        launcher = ["-m", "torch.distributed.run", "--standalone", f"--nproc-per-node={ranks}"]
        own = [__file__, f"--train={out}", f"--batch={batch}", f"--epochs={epochs}"]
        subprocess.run(
            [sys.executable, *(launcher if ranks > 1 else []), *own, f"--threads={threads}"],
            check=True,
            env={**os.environ, "OMP_NUM_THREADS": "1"},  # the launcher's default, without a notice
        )
        seconds: list[float] = json.loads(out.read_text(encoding="utf-8"))
    return seconds[1:]


def main() -> None:
    """Measures and prints."""
    parser = argparse.ArgumentParser(description=__doc__)
    add = parser.add_argument
    add("--ranks", type=int, nargs="+", default=[1, 2])
    add("--batches", type=int, nargs="+", default=[50, 200, 1000])
    add("--runs", type=int, nargs="+", default=[1, 2, 4, 8, 16])
    add("--processes", type=int, default=2, help="runs of a sweep at a time")
    add("--repeats", type=int, default=3)
    add("--epochs", type=int, default=4)
    add("--json")
    add("--train", type=Path, help="internal: be a rank, and write its seconds here")
    add("--batch", type=int, help="internal")
    add("--threads", type=int, default=1, help="internal")
    asked = parser.parse_args()
    if asked.train:
        train(asked.batch, asked.epochs, asked.threads, asked.train)
        return
    found: dict[str, Any] = {"ranks": {}, "runs": {}}
    ways = {f"{n} ranks": (n, 1) for n in asked.ranks}
    ways |= {f"{n} threads": (1, n) for n in asked.ranks if n > 1}
    for batch in asked.batches:
        times: dict[str, list[float]] = {name: [] for name in ways}
        for _ in range(asked.repeats):
            for name, (ranks, threads) in ways.items():
                times[name] += epoch_s(ranks, threads, batch, asked.epochs)
        found["ranks"][str(batch)] = {k: round(statistics.median(v), 3) for k, v in times.items()}
        print(f"batch {batch}: s per epoch {found['ranks'][str(batch)]}", flush=True)
    data = synthetic(500, ROWS, observed_fraction=0.3)
    for runs in asked.runs:
        with tempfile.TemporaryDirectory() as folder:
            start = time.perf_counter()
            ob.sweep(
                data,
                {"model": ob.thesis_config(MODEL)},
                out=Path(folder) / "sweep",
                repeats=runs,
                epochs=RUN_EPOCHS,
                processes=asked.processes,
                progress=False,
            )
            found["runs"][str(runs)] = round(time.perf_counter() - start, 2)
        print(f"{runs} runs: {found['runs'][str(runs)]} s", flush=True)
    used = {name: getattr(asked, name) for name in ("processes", "repeats", "epochs")}
    write(asked.json, {"machine": machine(), "options": used, **found})


if __name__ == "__main__":
    main()
