"""Full-size runs of the thesis' protocol, scored: the numbers of `results/calibration.md`.

    python benchmarks/calibration.py run --model ode_rnn --observed_fraction 0.3 --epochs 50
    python benchmarks/calibration.py table results/calibration

Data, windows, masks, split, normalisation, models and training follow chapter 3 of the thesis: the
draw of the public generator (seed 123), a window of 100 of 200 rows per trajectory,
`divide_by_max` over all rows, 70/15/15 by trajectory, batches of 50. The anchored model trains with
its own optimizer (`offbeat.train_config`). An interrupted run continues when it is started again.
"""

from __future__ import annotations

import json
import platform
import subprocess
import time
from pathlib import Path
from typing import Any

import torch

import offbeat as ob
from offbeat.files import write_json


def protocol_data(
    observed_fraction: float, *, n_trajectories: int = 10_000, seed: int = 0
) -> tuple[ob.Dataset, ob.Dataset, ob.Dataset, ob.Scaler]:
    """Training, validation and test set, and the scaler fitted on everything."""
    recorded = ob.simulate("hopper", n_trajectories, 200, seed=123)
    scaler = ob.Scaler.fit("divide_by_max", recorded)
    masked = ob.mask_out(ob.windows(recorded, 100, seed=seed), observed_fraction, seed=seed)
    train, validation, test = ob.split(masked, seed=seed)
    return train, validation, test, scaler


def run(
    model: str = "ode_rnn",
    observed_fraction: float = 0.3,
    epochs: int = 50,
    seed: int = 0,
    n_trajectories: int = 10_000,
    threads: int = 1,
    clock: str = "first_row",
    out: Path = Path("runs/calibration"),
) -> None:
    """Trains one model of the protocol and scores it on the test set.

    Args:
        model: id of the model.
        observed_fraction: fraction of the rows that are observed.
        epochs: to train.
        seed: of windows, masks, split, weights and batches.
        n_trajectories: 10,000 in the protocol.
        threads: of torch.
        clock: start of the clock of a thesis model: `first_row`, as in the thesis, or
            `first_observation`, the default of other models.
        out: folder; the run goes to a subfolder of it.
    """
    torch.set_num_threads(threads)
    machine = _machine(threads)  # before the run, which may outlast this commit
    train, validation, test, scaler = protocol_data(
        observed_fraction, n_trajectories=n_trajectories, seed=seed
    )
    thesis = model in ob.THESIS_MODELS
    config = ob.thesis_config(model, clock=clock) if thesis else ob.ModelConfig(name=model)
    made = ob.make_model(config, train, scaler=scaler, seed=seed)
    name = f"{model}-{round(100 * observed_fraction)}-{epochs}"
    if thesis and clock != "first_row":
        name += f"-{clock}"
    folder = out / (f"{name}-seed{seed}" if seed else name)
    started = time.perf_counter()
    fitted = ob.fit(made, train, validation, ob.train_config(model, epochs=epochs), out=folder)
    evaluation = ob.evaluate({model: made}, test)
    print(evaluation.table())
    write_json(
        folder / "result.json",
        {
            "model": model,
            "observed_fraction": observed_fraction,
            "epochs": epochs,
            "steps": fitted.steps,
            "seed": seed,
            "clock": made.config.clock,
            "n_trajectories": n_trajectories,
            "training_seconds": sum(record.seconds for record in fitted.history),
            "seconds_of_this_call": time.perf_counter() - started,
            "row_0_constant": ob.row_0_constant(made.batch(test)),
            "scores": evaluation.to_dict(),
            "machine": machine,
        },
    )
    print(json.dumps({"written": str(folder / "result.json")}))


def _machine(threads: int) -> dict[str, Any]:
    commit = subprocess.run(
        ["git", "describe", "--always", "--dirty"], capture_output=True, text=True, check=False
    ).stdout.strip()
    return {
        "commit": commit,
        "processor": _processor(),
        "threads": threads,
        "python": platform.python_version(),
        "torch": torch.__version__,
    }


def _processor() -> str:
    for line in Path("/proc/cpuinfo").read_text().splitlines():
        if line.startswith("model name"):
            return line.split(":", 1)[1].strip()
    return platform.processor()


def _scores(predictor: dict[str, Any]) -> dict[str, Any]:
    """The scores of a predictor under the names of today; files of 0.1.0 have others."""
    old = {
        "honest": "after_first_observation",
        "honest_hidden": "masked",
        "rows_1_99": "after_first_row",
    }
    return {old.get(name, name): score for name, score in predictor.items()}


def table(folder: Path) -> None:
    """Prints a Markdown table of the results in a folder.

    Args:
        folder: holds JSON files that `run` wrote as `result.json`, under any name.
    """
    titles = (
        "run", "MSE after the first observation (RMSE)", "masked values, RMSE", "rows 1-99 MSE",
        "published RMSE", "last value, RMSE", "ratio", "training", "commit",
    )  # fmt: skip
    print("| " + " | ".join(titles) + " |\n" + "|---" * len(titles) + "|")
    for path in sorted(folder.glob("*.json")):
        result = json.loads(path.read_text(encoding="utf-8"))
        predictors = result["scores"]["predictors"]
        ours, trivial = (_scores(predictors[name]) for name in (result["model"], "last_value"))
        late, trivial_rmse = (
            ours["after_first_observation"],
            trivial["after_first_observation"]["rmse"],
        )
        percent = round(100 * result["observed_fraction"])
        cells = (
            f"{path.stem}: {result['model']}, {percent} %, {result['epochs']} epochs",
            f"{late['mse']:.6f} ({late['rmse']:.4f})",
            f"{ours['masked']['rmse']:.4f}",
            f"{ours['after_first_row']['mse']:.5f}",
            f"{ours['published']['rmse']:.4f}",
            f"{trivial_rmse:.4f}",
            f"{late['rmse'] / trivial_rmse:.3f}",
            f"{result['steps']} steps, {result['training_seconds'] / 60:.0f} min",
            result["machine"]["commit"],
        )
        print("| " + " | ".join(cells) + " |")


if __name__ == "__main__":
    from jsonargparse import auto_cli

    auto_cli([run, table])
