"""How the units of the thesis' scores depend on the draw of initial states.

    python benchmarks/row_0_constant.py --draws 12 --out results/benchmarks/row_0_constant.json

`divide_by_max` divides by the largest value of a channel, so its units, c (the mean square of row
0) and every error depend on a few rows. For each draw of 10,000 initial states: c, and the RMSE of
repeating the last observed value, which does not depend on training. The first draw is the
protocol's own.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from common import kept, machine, write

import offbeat as ob
from offbeat.evaluation import LAST_VALUE
from thesis.protocol import Protocol


def measured(protocol: Protocol) -> dict[str, Any]:
    """The constant and the scores of the last value, for the draw of a protocol."""
    recorded = protocol.simulate(progress=False)
    scaler = ob.Scaler.fit(protocol.scaler, recorded)
    found: dict[str, Any] = {"state_seed": protocol.state_seed, "last_value": {}}
    for run in protocol.runs():
        if (run.experiment, run.model, run.repeat) != (2, "gru", 0):
            continue
        train, _, test = protocol.cut(recorded, run)
        model = ob.make_model(protocol.model_config("gru"), train, scaler=scaler, seed=0)
        if "c" not in found:
            rows = np.stack([scaler.scaled(t.values[:1])[0] for t in (*train, *test)])
            found["c"] = float((rows**2).mean())
        scores = ob.evaluate({"gru": model}, test, seed=0).scores[LAST_VALUE]
        found["last_value"][str(run.observed_fraction)] = {
            name: getattr(scores, name).rmse
            for name in ("published", "after_first_row", "after_first_observation")
        }
    return found


def main() -> None:
    """Measures the missing draws, and prints all."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--draws", type=int, default=12)
    parser.add_argument("--out", type=Path, default=Path("results/benchmarks/row_0_constant.json"))
    arguments = parser.parse_args()
    protocol = Protocol()
    done: list[dict[str, Any]] = kept(arguments.out, "draws") or []
    for seed in (protocol.state_seed, *range(arguments.draws - 1)):
        if all(draw["state_seed"] != seed for draw in done):
            done.append(measured(replace(protocol, state_seed=seed)))
            write(str(arguments.out), {"machine": machine(), "draws": done})
    for draw in done:
        shown = "  ".join(
            f"{float(p):.0%} {scores['published']:.4f} ({scores['after_first_observation']:.4f})"
            for p, scores in draw["last_value"].items()
        )
        print(f"seed {draw['state_seed']:4}  c {draw['c']:.3f}  last value {shown}")


if __name__ == "__main__":
    main()
