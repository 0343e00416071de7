"""What windows and masks that are drawn anew in each epoch cost a training.

    python benchmarks/redraw.py

Processor time of training steps on the same windows and masks in every epoch, and on ones that are
drawn anew (`TrainConfig.redraw`), in turns within one process, in groups of as many steps as have
their inputs computed together. The drawing of an epoch is counted in its steps. Complete
trajectories of 200 rows, windows of 100, 14 channels, 30 % of the rows observed.
"""

from __future__ import annotations

import argparse
import statistics
import time
from typing import Any

import torch
from common import synthetic

import offbeat as ob
from offbeat.examples import AHEAD, TrainingSet, order_of
from offbeat.models.zoo import recipe_of
from offbeat.run import FlatParameters, RunState
from offbeat.training import train_step

MODEL = "anchored_ode_gru_d"
LARGE: dict[str, Any] = {"hidden_size": 64, "field_units": (256, 256, 256)}
WAYS: dict[str, ob.RedrawConfig | None] = {
    "the same": None,
    "rows": ob.RedrawConfig((0.3,), 100),
    "values": ob.RedrawConfig((0.3,), 100, "values"),
}
"""What is drawn anew, and how it masks."""


def cost(size: str, batch: int, trajectories: int, repeats: int) -> None:
    """Prints the median time of a step, and the ratio to that on the same windows.

    Args:
        size: of the model, `small` or `large`.
        batch: trajectories of a step.
        trajectories: of an epoch, a multiple of `AHEAD` batches.
        repeats: groups of steps of each kind.
    """
    whole = synthetic(trajectories, 200, observed_fraction=1.0)
    windows = ob.mask_out(ob.windows(whole, 100), 0.3)
    sets: list[Any] = []
    for config in WAYS.values():
        model = ob.make_model(MODEL, windows, **(LARGE if size == "large" else {}))
        recipe = recipe_of(MODEL, ob.TrainConfig(epochs=1, redraw=config), validated=False)
        training_set = TrainingSet(model, windows if config is None else whole, recipe)
        started = time.process_time()
        examples = training_set.epoch(0)
        drawn = 0.0 if config is None else time.process_time() - started
        training_set.close()
        state = RunState(FlatParameters(model), recipe)
        sets.append((model, examples, state, recipe, drawn * batch / trajectories))
    order, groups = torch.from_numpy(order_of(0, 0, trajectories)), []
    for group in range(repeats + 1):
        times = [0.0] * len(sets)
        for i in range(AHEAD):
            first = batch * (AHEAD * group + i) % (trajectories - batch + 1)
            index = order[first : first + batch]
            for k, (model, examples, state, recipe, drawn) in enumerate(sets):
                started = time.thread_time()
                train_step(model, examples, index, state, recipe, total=AHEAD * (repeats + 1))
                times[k] += time.thread_time() - started + drawn
        groups.append(times)
    for k, way in enumerate(WAYS):
        step = statistics.median(times[k] for times in groups[1:]) / AHEAD
        ratio = statistics.median(times[k] / times[0] for times in groups[1:])
        print(f"{size}, {way}: {1e3 * step:.2f} ms, {ratio:.3f} x", flush=True)


def main() -> None:
    """Runs both sizes."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--size", choices=("small", "large"), action="append")
    parser.add_argument("--batch", type=int, default=50)
    parser.add_argument("--trajectories", type=int, default=2000)
    parser.add_argument("--repeats", type=int, default=10)
    options = parser.parse_args()
    torch.set_num_threads(1)
    for size in options.size or ("small", "large"):
        cost(size, options.batch, options.trajectories, options.repeats)


if __name__ == "__main__":
    main()
