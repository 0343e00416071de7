"""How the scores of a model with self-feeding vary with the seed of its random generator alone.

    python -m thesis run --out runs/thesis --only experiment=1,model=gru,fraction=0.3
    python benchmarks/generator.py runs/thesis e1-gru-30-r00 --out results/benchmarks/generator.json

The weights and the test set are the same. Self-feeding draws one random number per row for the
whole test set, so a score belongs to one sequence of draws, however many trajectories there are.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import torch
from common import kept, machine, write

import offbeat as ob
from thesis.protocol import Protocol


def main() -> None:
    """Scores the model of a run with many seeds."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "folder", type=Path, help="the output of `python -m thesis run`, with checkpoints"
    )
    parser.add_argument("run_id")
    parser.add_argument("--seeds", type=int, default=50)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--out", type=Path, default=Path("results/benchmarks/generator.json"))
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)

    protocol = Protocol()
    (run,) = (run for run in protocol.runs() if run.run_id == arguments.run_id)
    _, _, test = protocol.cut(ob.load(arguments.folder / "data" / "recorded.parquet"), run)
    model = ob.load_model(arguments.folder / "runs" / run.run_id / "training" / "model")
    scores = [
        ob.evaluate({"m": model}, test, seed=seed).scores["m"] for seed in range(arguments.seeds)
    ]
    found = {
        name: [getattr(score, name).rmse for score in scores]
        for name in ("published", "after_first_observation")
    }
    runs = {**(kept(arguments.out, "runs") or {}), run.run_id: found}
    write(str(arguments.out), {"machine": machine(), "runs": runs})
    for name, values in found.items():
        print(
            f"{run.run_id}  {name} RMSE over {len(values)} seeds: mean {np.mean(values):.4f}"
            f"  std {np.std(values, ddof=1):.4f}  from {min(values):.4f} to {max(values):.4f}"
        )
        for other in runs:
            if other != run.run_id and len(runs[other][name]) == len(values):
                together = np.corrcoef(values, runs[other][name])[0, 1]
                print(f"  correlation with {other} over the seeds: {together:.4f}")


if __name__ == "__main__":
    main()
