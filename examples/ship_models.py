"""Writes the trained models that come with the package, with their cards.

    python examples/ship_models.py --large runs/hopper/large_fresh_long-seed0

takes those of the thesis' protocol from results/thesis: experiment 1, first repeat, 300 epochs; and
the large model from the run of `examples.hopper`.
"""

from __future__ import annotations

import argparse
import csv
import json
import math
import shutil
from pathlib import Path

import offbeat as ob
from offbeat.models.hub import CARD, card_of

ROOT = Path(__file__).parents[1]
RECORD, SHIPPED = ROOT / "results/thesis", ROOT / "src/offbeat/trained"
FRACTIONS = (90, 30)
THESIS = {"ode_rnn": "ODE-RNN", "ode_gru_d": "ODE-GRU-D"}


def ship(folder: Path, name: str, about: str, sections: dict[str, str]) -> None:
    """Copies a checkpoint into the package and writes its card."""
    target = SHIPPED / name
    shutil.rmtree(target, ignore_errors=True)
    ob.load_model(folder).save(target)
    text = card_of(ob.load_model(target), name=f"offbeat/{name}", about=about, sections=sections)
    (target / CARD).write_text(text, encoding="utf-8")
    print(target.relative_to(ROOT))


def thesis_models() -> None:
    """ODE-RNN and ODE-GRU-D on the hopper, with 90 and 30 % of the rows observed."""
    with open(RECORD / "record.csv", newline="", encoding="utf-8") as file:
        record = {row["run_id"]: row for row in csv.DictReader(file)}
    for name, title in THESIS.items():
        for percent in FRACTIONS:
            run = f"e1-{name}-{percent}-r00"
            row = record[run]
            error, held = (
                math.sqrt(float(row[key])) for key in ("honest_mse", "last_value_honest_mse")
            )
            sections = {
                "Data": "MuJoCo's hopper, falling: 10,000 trajectories of 200 rows at 5 ms, a "
                f"window of 100 rows of each, of which {percent} % are observed; scaled as in "
                "the thesis. 7,000 train, 1,500 validate, 1,500 test.",
                "Made by": "`python -m thesis run --out runs/thesis --only "
                f"experiment=1,repeat=0,model={name},fraction={percent / 100:g}`: "
                f"{row['epochs']} epochs, {float(row['seconds']) / 60:.0f} min on one core of an "
                f"{row['cpu']} ({row['kernel_body']}), commit {row['commit']}. It is the model of "
                f"`results/thesis/models/{run}`.",
                "Scores": "Test RMSE after the first observation of each channel, in the thesis' "
                f"units: {error:.4f}; of the last value {held:.4f} (`results/thesis/record.csv`). "
                "It decodes each row from the state after the row before, as the thesis does "
                '(`readout="last_row"`), so it predicts the next row of a grid, not any time.',
                "Licence": "Apache-2.0, as Offbeat.",
            }
            about = (
                f"{title} of the thesis: the hopper's next row, {percent} % of the rows observed; "
                f"test RMSE {error:.4f} (last value {held:.4f})"
            )
            ship(RECORD / "models" / run, f"hopper-{percent}-{name}", about, sections)


def large_model(run: Path) -> None:
    """The large anchored model, for any fraction of observed rows and any time."""
    name = run.name.rpartition("-seed")[0]
    found = json.loads((ROOT / f"results/robots/hopper/{run.name}.json").read_text())
    errors = {f: found["scores"][f]["rmse"] for f in ("0.9", "0.7", "0.5", "0.3")}
    shown = ", ".join(f"{error:.4f} at {100 * float(f):.0f} %" for f, error in errors.items())
    sections = {
        "Data": "MuJoCo's hopper, falling: 7,000 trajectories of 200 rows at 5 ms; each epoch "
        "draws a window of 100 rows of each and observes 30 or 90 % of its rows.",
        "Made by": f"`python -m examples.hopper --only {name} --runs runs/hopper`: "
        f"{found['epochs']} epochs, {found['train_s'] / 60:.0f} min on one thread of an "
        f"{found['machine']['cpu']} ({found['backend']}), seed {found['seed']}.",
        "Scores": "Test RMSE after the first observation of each channel, in the thesis' units: "
        f"{shown} observed rows (`results/robots/hopper/{run.name}.json`; other predictors are in "
        "docs/robots.md).",
        "Licence": "Apache-2.0, as Offbeat.",
    }
    about = (
        f"anchored ODE-GRU-D, large: the hopper at any time, 30 to 90 % of the rows observed; "
        f"test RMSE {errors['0.3']:.4f} at 30 % (last value 0.0347)"
    )
    ship(run / "model", "hopper-anchored-large", about, sections)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Writes the models that come with the package.")
    parser.add_argument("--large", type=Path, help="run of examples.hopper with the large model")
    given = parser.parse_args()
    thesis_models()
    if given.large:
        large_model(given.large)
