"""The model with a trend beside its own Kalman filter and the model without one.

    python benchmarks/trend.py step
    python benchmarks/trend.py log g1 --epochs 10
    python benchmarks/trend.py blend lasa --epochs 10

`step` measures the processor time of training steps of both, in turns within one process. `log`
trains bare models (no blend) on the tasks of a log of `examples.real_logs`, and counts on its test
part where they are more than 2 % worse than the best of last value, constant velocity and mean in
hindsight, per channel and task; and where the trained model is more than 2 % worse than its filter.
`blend` fits blends of the baselines with each candidate of `offbeat.ladder`, all trained equally
long, and prints their validation scores and the RMSE on the test part beside that of the first.
"""

from __future__ import annotations

import argparse
import statistics
import time
from typing import Any

import numpy as np
import torch
from common import synthetic

import offbeat as ob
from offbeat.answers.blend import fit_blend
from offbeat.baselines import fit_baseline
from offbeat.ladder import CANDIDATES, fit_ladder
from offbeat.models.zoo import recipe_of
from offbeat.run import FlatParameters, RunState
from offbeat.training import Examples, train_step

TREND, PLAIN = "anchored_trend", "anchored_ode_gru_d"
TRIVIAL = ("last_value", "constant_velocity", "mean")
RATE = CANDIDATES[0].learning_rate


def step(repeats: int) -> None:
    """Prints the median ratio of the times of two steps, one after the other."""
    data, steps = synthetic(50, 100, observed_fraction=0.3), []
    for name in (PLAIN, TREND):
        model = ob.make_model(name, data, seed=0)
        examples, recipe = (
            Examples(model, model.batch(data)),
            recipe_of(name, ob.TrainConfig(), validated=False),
        )
        state = RunState(FlatParameters(model), recipe)
        index = torch.arange(len(examples))

        def run(model=model, examples=examples, index=index, state=state, recipe=recipe) -> float:
            start = time.thread_time()
            train_step(model, examples, index, state, recipe, total=repeats + 3)
            return time.thread_time() - start

        steps.append(run)
    pairs = [[run() for run in steps] for _ in range(repeats + 3)][3:]
    ratio = statistics.median(b / a for a, b in pairs)
    print(f"{PLAIN} {1e3 * statistics.median(a for a, _ in pairs):.1f} ms, {TREND} {ratio:.2f} x")


def log(name: str, epochs: int, seed: int) -> None:
    """Prints the losses of bare models on a log."""
    from examples.real_logs.logs import LOGS

    log = LOGS[name](False)
    asked = [task for part in log.asked.values() for task in part]
    tasks = log.fitting_tasks(causal=True, seed=seed)

    def errors(predict: Any) -> np.ndarray:
        """(tasks, channels) RMSE."""
        found = []
        for task in asked:
            total, count = np.zeros(task.dataset.channels), np.zeros(task.dataset.channels)
            each = zip(predict(task.dataset), task.dataset, task.scored, strict=True)
            for predicted, true, scored in each:
                total += (np.where(scored, predicted - true.values, 0.0) ** 2).sum(axis=0)
                count += scored.sum(axis=0)
            found.append(np.sqrt(total / np.maximum(count, 1)))
        return np.array(found)

    def show(what: str, error: np.ndarray, beside: np.ndarray) -> None:
        ratio = error / beside
        mean = np.exp(np.log(ratio).mean())
        print(
            f"{name}, {what}: {(ratio > 1.02).sum()} of {ratio.size} more than 2 % worse, "
            f"worst {ratio.max():.2f}, geometric mean {mean:.3f}",
            flush=True,
        )

    trivial = [fit_baseline(each, log.training_windows) for each in TRIVIAL]
    oracle = np.minimum.reduce([errors(each.predict) for each in trivial])

    def trained(model_name: str, **training: Any) -> tuple[np.ndarray, np.ndarray]:
        """Errors before and after training."""
        model = ob.make_model(
            model_name, log.train, scaler="robust", seed=seed, tasks=tasks, hidden_size=32,
            field_units=(64, 64),
        )  # fmt: skip

        def ask(data: ob.Dataset) -> list[Any]:
            return [t.values for t in ob.predict(model, data)]

        before = errors(ask)
        config = ob.TrainConfig(seed=seed, tasks=log.task_config, learning_rate=RATE, **training)
        ob.fit(model, log.train, log.validation, config, progress=False)
        return before, errors(ask)

    filtered, short = trained(TREND, epochs=1, tasks_per_epoch=1600)
    show("filter", filtered, oracle)
    show("100 steps", short, oracle)
    show("100 steps beside the filter", short, filtered)
    _, long = trained(TREND, epochs=epochs)
    show(f"{TREND}, {epochs} epochs", long, oracle)
    show(f"{TREND}, {epochs} epochs, beside the filter", long, filtered)
    show(f"{PLAIN}, {epochs} epochs", trained(PLAIN, epochs=epochs)[1], oracle)


def blend(name: str, epochs: int, seed: int) -> None:
    """Prints the errors of blends with each candidate for the same number of epochs."""
    from examples.real_logs.logs import LOGS
    from examples.real_logs.predictors import Blended
    from examples.real_logs.scores import score

    log = LOGS[name](False)
    config = ob.TrainConfig(seed=seed, tasks=log.task_config, epochs=epochs)
    asked = [task for part in log.asked.values() for task in part]
    first: np.ndarray | None = None
    for candidate in CANDIDATES:
        if candidate.learning_rate != RATE:
            continue
        found = fit_ladder(
            log.train, log.validation, config, candidates=(candidate,), budget_s=1.0,
            scaler="robust", seed=seed, progress=False,
        )  # fmt: skip
        fitted = fit_blend(log.train, log.validation, found.model, tasks=log.task_config, seed=seed)
        predictor = Blended(fitted, causal=True)
        errors = np.array([score(t, predictor, log.scale)["rmse_scaled"] for t in asked])
        first = errors if first is None else first
        ratio = np.exp(np.log(errors / first).mean())
        print(
            f"{name}, seed {seed}, {candidate.label}: validation {found.fit.validation_score:.3f}, "
            f"RMSE {ratio:.3f} of the first candidate's (geometric mean of {len(asked)} tasks): "
            + ", ".join(f"{t.name} {e:.3g}" for t, e in zip(asked, errors, strict=True)),
            flush=True,
        )


def main() -> None:
    """Runs a part."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("part", choices=("step", "log", "blend"))
    parser.add_argument("name", nargs="?", default="g1")
    parser.add_argument("--epochs", type=int, default=10)
    parser.add_argument("--repeats", type=int, default=60)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    torch.set_num_threads(1)
    if options.part == "step":
        step(options.repeats)
    elif options.part == "blend":
        blend(options.name, options.epochs, options.seed)
    else:
        log(options.name, options.epochs, options.seed)


if __name__ == "__main__":
    main()
