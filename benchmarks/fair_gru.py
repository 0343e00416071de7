"""Where a plain GRU updates, and which time input it has: what that changes at the protocol's size.

    OMP_NUM_THREADS=1 python benchmarks/fair_gru.py --out results/benchmarks/fair_gru.json

Experiment 2 of the protocol at one observed fraction and one repeat: the windows, masks, split,
order of batches and initial weights of the recorded `gru_fair`, without self-feeding. The variants
differ only in the rows at which the cell updates, its time input, and the unit of that
(`update_rows`, `time_input` and `time_input_unit` of `ModelConfig`). A variant whose result is in
the file is not trained again.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from common import kept, machine, write

import offbeat as ob
from offbeat.evaluation import LAST_VALUE
from thesis.protocol import Protocol, Run

VARIANTS = (
    {"update_rows": "observed", "time_input": "none", "time_input_unit": "gap"},
    {"update_rows": "observed", "time_input": "gap", "time_input_unit": "gap"},  # `gru_unfed`
    {"update_rows": "observed", "time_input": "delta", "time_input_unit": "gap"},
    {"update_rows": "observed", "time_input": "delta", "time_input_unit": "longest"},
    {"update_rows": "every", "time_input": "none", "time_input_unit": "gap"},
    {"update_rows": "every", "time_input": "elapsed", "time_input_unit": "gap"},
    {"update_rows": "every", "time_input": "delta", "time_input_unit": "gap"},
    {"update_rows": "every", "time_input": "delta", "time_input_unit": "longest"},  # `gru_fair`
)


def trained(
    protocol: Protocol,
    parts: tuple[ob.Dataset, ...],
    scaler: ob.Scaler,
    run: Run,
    variant: dict[str, Any],
) -> dict[str, Any]:
    """Trains one variant and scores it."""
    train, validation, test = parts
    config = replace(protocol.model_config(run.model), **variant)
    model = ob.make_model(config, train, scaler=scaler, seed=run.seed_weights)
    started = time.perf_counter()
    fitted = ob.fit(model, train, validation, protocol.train_config(run), progress=False)
    scores = ob.evaluate({"gru": model}, test, seed=run.seed_draw).scores
    return {
        **variant,
        "epochs": run.epochs,
        "published_rmse": scores["gru"].published.rmse,
        "after_first_observation_rmse": scores["gru"].after_first_observation.rmse,
        "last_value_rmse": scores[LAST_VALUE].after_first_observation.rmse,
        "validation_mse": [record.validation_mse for record in fitted.history],
        "seconds": time.perf_counter() - started,
    }


def main() -> None:
    """Trains the missing variants, and prints all."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--fraction", type=float, default=0.3)
    parser.add_argument("--repeat", type=int, default=0)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--out", type=Path, default=Path("results/benchmarks/fair_gru.json"))
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)

    protocol = Protocol()
    asked = (2, "gru_fair", arguments.fraction, arguments.repeat)
    run = next(
        run
        for run in protocol.runs()
        if (run.experiment, run.model, run.observed_fraction, run.repeat) == asked
    )
    key = {"fraction": arguments.fraction, "repeat": arguments.repeat}
    done: list[dict[str, Any]] = kept(arguments.out, "runs") or []
    todo = [
        variant for variant in VARIANTS if not any({**row, **key, **variant} == row for row in done)
    ]
    if todo:
        recorded = protocol.simulate(progress=False)
        scaler = ob.Scaler.fit(protocol.scaler, recorded)
        parts = protocol.cut(recorded, run)
    for variant in todo:
        done.append({**key, **trained(protocol, parts, scaler, run, variant)})
        write(str(arguments.out), {"machine": machine(), "runs": done})
    for row in done:
        print(
            f"{row['fraction']:.0%} repeat {row['repeat']}  update {row['update_rows']:8}"
            f"  time input {row['time_input']:8} in {row['time_input_unit']:8}"
            f"  published {row['published_rmse']:.4f}"
            f"  after first observation {row['after_first_observation_rmse']:.4f}"
            f"  last value {row['last_value_rmse']:.4f}"
        )


if __name__ == "__main__":
    main()
