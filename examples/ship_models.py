"""Writes the trained models that come with the package, with their cards.

    python examples/ship_models.py --large runs/hopper/large_fresh_long-seed0
    python examples/ship_models.py --walker runs/walker --lasa runs/lasa

takes those of the thesis' protocol from results/thesis: experiment 1, first repeat, 300 epochs; the
large model from the run of `examples.hopper`; and others from the runs of the commands in
`WALKER` and `LASA`.
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


WALKER = (
    "offbeat simulate walker.parquet --robot walker --n_trajectories 3000",
    "offbeat train walker.parquet runs/walker --model.name anchored_ode_gru_d --split.window 100 "
    "--split.observed_fraction 0.3 --two_sided false --training.epochs 30",
)
LASA = (
    "python examples/lasa.py lasa.parquet",
    "offbeat train --config examples/lasa.yaml lasa.parquet runs/lasa",
)


def other_model(run: Path, name: str, title: str, data: str, commands: tuple[str, ...]) -> None:
    """A model of `offbeat train`, with the scores of its run."""
    found = json.loads((run / "results.json").read_text(encoding="utf-8"))
    of_model, held = (
        found["predictors"][predictor]["after_first_observation"]["rmse"]
        for predictor in ("anchored_ode_gru_d", "last_value")
    )
    made_by = "\n".join(f"- `{command}`" for command in commands)
    sections = {
        "Data": data,
        "Made by": f"{made_by}\n\n{found['steps']} steps.",
        "Scores": "One step ahead on the test part, RMSE after the first observation of each "
        f"channel, in standard deviations: {of_model:.4f}; of the last value {held:.4f} "
        f"({found['trajectories']} trajectories). It is the network alone: the run blends it with "
        "simple predictors, which is better, and gives intervals.",
        "Licence": "Apache-2.0, as Offbeat.",
    }
    about = f"{title}; test RMSE {of_model:.4f} standard deviations (last value {held:.4f})"
    ship(run / "model", name, about, sections)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Writes the models that come with the package.")
    parser.add_argument("--large", type=Path, help="run of examples.hopper with the large model")
    parser.add_argument("--walker", type=Path, help="run of the last command in WALKER")
    parser.add_argument("--lasa", type=Path, help="run of the last command in LASA")
    given = parser.parse_args()
    if not (given.walker or given.lasa):
        thesis_models()
    if given.large:
        large_model(given.large)
    if given.walker:
        other_model(
            given.walker,
            "walker-30-anchored",
            "anchored ODE-GRU-D: the walker at any time, 30 % of the rows observed",
            "MuJoCo's walker, falling: 3,000 trajectories of 200 rows at 2.5 ms; a window of 100 "
            "rows of each, of which 30 % are observed. 2,100 train, 450 validate, 450 test.",
            WALKER,
        )
    if given.lasa:
        other_model(
            given.lasa,
            "lasa-anchored",
            "anchored ODE-GRU-D: handwriting whose sensors drop out",
            "LASA handwriting (Khansari-Zadeh and Billard 2011): 30 shapes, seven demonstrations "
            "each, every tenth row; position and velocity drop out independently for 0.5 s at a "
            "time, 70 % are observed.",
            LASA,
        )
