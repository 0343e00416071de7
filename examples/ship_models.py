"""Writes the trained models that come with the package, with their cards.

    python examples/ship_models.py --experiment_1
    python examples/ship_models.py --experiment_2 runs/thesis
    python examples/ship_models.py --large runs/hopper/large_fresh_long-seed0
    python examples/ship_models.py --robot walker runs/walker --lasa runs/lasa

The first takes ODE-RNN and ODE-GRU-D of the thesis' experiment 1 from results/thesis (first repeat,
300 epochs), the second those models of its experiment 2 (first repeat) that a folder of
`python -m thesis run` has, with the scores of the record. The large model is a run of
`examples.hopper`; others are runs of the commands of `robot_commands` and `LASA`.
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
EXPERIMENT_1 = {"ode_rnn": "ODE-RNN of the thesis", "ode_gru_d": "ODE-GRU-D of the thesis"}
EXPERIMENT_2 = {
    "gru": "GRU of the thesis, fed with its own predictions",
    "gru_d": "GRU-D of the thesis, fed with its own predictions",
    "anchored_ode_gru_d": "anchored ODE-GRU-D, small",
}


def ship(folder: Path, name: str, about: str, sections: dict[str, str]) -> None:
    """Copies a checkpoint into the package and writes its card."""
    target = SHIPPED / name
    shutil.rmtree(target, ignore_errors=True)
    ob.load_model(folder).save(target)
    text = card_of(ob.load_model(target), name=f"offbeat/{name}", about=about, sections=sections)
    (target / CARD).write_text(text, encoding="utf-8")
    print(target.relative_to(ROOT))


def thesis_models(experiment: int, models: dict[str, str], checkpoints: str) -> None:
    """Models on the hopper's next row, with 90 and 30 % of the rows observed.

    Args:
        experiment: of the thesis.
        models: titles by the names of the record.
        checkpoints: path of the checkpoint of a run, with its name as `{run}`; others are left out.
    """
    with open(RECORD / "record.csv", newline="", encoding="utf-8") as file:
        record = {row["run_id"]: row for row in csv.DictReader(file)}
    for name, title in models.items():
        for percent in FRACTIONS:
            run = f"e{experiment}-{name}-{percent}-r00"
            checkpoint = Path(checkpoints.format(run=run))
            if not checkpoint.exists():
                continue
            row = record[run]
            error, held = (
                math.sqrt(float(row[key])) for key in ("honest_mse", "last_value_honest_mse")
            )
            sections = {
                "Data": "MuJoCo's hopper, falling: 10,000 trajectories of 200 rows at 5 ms, a "
                f"window of 100 rows of each, of which {percent} % are observed; scaled as in "
                "the thesis. 7,000 train, 1,500 validate, 1,500 test.",
                "Made by": "`python -m thesis run --out runs/thesis --only "
                f"experiment={experiment},repeat=0,model={name},fraction={percent / 100:g}`: "
                f"{row['epochs']} epochs, {float(row['seconds']) / 60:.0f} min on one core of an "
                f"{row['cpu']} ({row['kernel_body']}), commit {row['commit']}. It is the model of "
                f"the run `{run}` of `results/thesis/record.csv`.",
                "Scores": "Test RMSE after the first observation of each channel, in the thesis' "
                f"units: {error:.4f}; of the last value {held:.4f} (`results/thesis/record.csv`)."
                + (" **It loses to the last value.**" if error > held else "")
                + (" " + NEXT_ROW if name in ("gru", "gru_d", *EXPERIMENT_1) else ""),
                "Licence": "Apache-2.0, as Offbeat.",
            }
            about = (
                f"{title}: the hopper's next row, {percent} % of the rows observed; "
                f"test RMSE {error:.4f} (last value {held:.4f})"
            )
            ship(checkpoint, f"hopper-{percent}-{name}", about, sections)


def check_scores(out: Path) -> None:
    """Stops where a run of a folder has another score than the run of the record.

    Args:
        out: of `python -m thesis run`.
    """
    scores = []
    for path in (RECORD / "record.csv", out / "record.csv"):
        with open(path, newline="", encoding="utf-8") as file:
            scores.append({row["run_id"]: row["honest_mse"] for row in csv.DictReader(file)})
    record, made = scores
    other = [run for run, score in made.items() if float(score) != float(record[run])]
    if other:
        raise SystemExit(f"other scores than in {RECORD}: {', '.join(other)}")


NEXT_ROW = (
    "It decodes each row from the state after the row before, as the thesis does "
    '(`readout="last_row"`), so it predicts the next row of a grid, not any time.'
)


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


ROBOTS = {"walker": "2.5 ms", "cheetah": "10 ms", "humanoid": "5 ms"}
"""Time between two rows of each robot."""


def robot_commands(robot: str) -> tuple[str, ...]:
    """The commands that made the model of a robot."""
    return (
        f"offbeat simulate {robot}.parquet --robot {robot} --n_trajectories 3000",
        f"offbeat train {robot}.parquet runs/{robot} --model.name anchored_ode_gru_d "
        "--split.window 100 --split.observed_fraction 0.3 --two_sided false --training.epochs 30",
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
        "simple predictors and gives intervals.",
        "Licence": "Apache-2.0, as Offbeat.",
    }
    about = f"{title}; test RMSE {of_model:.4f} standard deviations (last value {held:.4f})"
    ship(run / "model", name, about, sections)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Writes the models that come with the package.")
    parser.add_argument("--experiment_1", action="store_true", help="from results/thesis")
    parser.add_argument("--experiment_2", type=Path, help="folder of `python -m thesis run`")
    parser.add_argument("--large", type=Path, help="run of examples.hopper with the large model")
    parser.add_argument(
        "--robot",
        nargs=2,
        action="append",
        default=[],
        metavar=("ROBOT", "RUN"),
        help=f"of {', '.join(ROBOTS)}, and the run of its commands",
    )
    parser.add_argument("--lasa", type=Path, help="run of the last command in LASA")
    given = parser.parse_args()
    if given.experiment_1:
        thesis_models(1, EXPERIMENT_1, f"{RECORD}/models/{{run}}")
    if given.experiment_2:
        check_scores(given.experiment_2)
        thesis_models(2, EXPERIMENT_2, f"{given.experiment_2}/runs/{{run}}/training/model")
    if given.large:
        large_model(given.large)
    for robot, run in given.robot:
        other_model(
            Path(run),
            f"{robot}-30-anchored",
            f"anchored ODE-GRU-D: the {robot} at any time, 30 % of the rows observed",
            f"MuJoCo's {robot}, falling: 3,000 trajectories of 200 rows at {ROBOTS[robot]}; a "
            "window of 100 rows of each, of which 30 % are observed. 2,100 train, 450 validate, "
            "450 test.",
            robot_commands(robot),
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
