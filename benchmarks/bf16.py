"""Training steps with products in bfloat16 against float32, and what they cost in accuracy.

Steps are those of a training (forward, backward, optimizer), one thread, in turns within one
process: the compiled backend in float32 and in each instruction set for bfloat16 that the processor
has, and the reference backend in float32 and under autocast, which uses the same instructions.
Then the same trainings on recordings of the hopper in both precisions (needs MuJoCo).

    python benchmarks/bf16.py --json results/benchmarks/bf16.json
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable
from contextlib import ExitStack
from typing import Any

import torch
from common import machine, synthetic, write

import offbeat as ob
from offbeat import kernels
from offbeat.captured import products
from offbeat.kernels import cpu
from offbeat.models.zoo import recipe_of
from offbeat.run import FlatParameters, RunState
from offbeat.training import Examples, train_step

SIZES = ((15, 100, 50), (64, 128, 512), (64, 256, 512), (256, 256, 512), (256, 512, 512),
         (256, 256, 4096))  # fmt: skip
"""Hidden units, units of each of the four layers of the vector field, trajectories."""


def step_of(
    backend: str, precision: str, size: tuple[int, int, int], rows: int
) -> Callable[[], Any]:
    """A training step; returns its loss."""
    hidden, units, batch = size
    data = synthetic(batch, rows, observed_fraction=0.3)
    config = ob.thesis_config("ode_gru_d", hidden_size=hidden, field_units=(units,) * 4)
    model = ob.make_model(config, data, seed=0)
    examples = Examples(model, model.batch(data))
    config = ob.TrainConfig(precision=precision)  # type: ignore[arg-type]
    recipe = recipe_of(model.name, config, validated=False)
    state = RunState(FlatParameters(model), recipe)
    index = torch.arange(len(examples))

    def step() -> float:
        with ExitStack() as stack:
            stack.enter_context(kernels.use(backend))
            stack.enter_context(model.threads())
            stack.enter_context(products(model, precision))
            return train_step(model, examples, index, state, recipe, total=1)

    return step


def times_of(size: tuple[int, int, int], rows: int, repeats: int) -> dict[str, Any]:
    """Processor time of a step of each way, ms."""
    ways = {"float32": ("cpu", "float32")}
    ways |= {name: (name, "bf16") for name in cpu.bf16_sets()}
    ways |= {"reference float32": ("reference", "float32"),
             "reference autocast": ("reference", "bf16")}  # fmt: skip
    steps = {name: step_of(*way, size, rows) for name, way in ways.items()}
    first = {name: step() for name, step in steps.items()}
    for name, loss in first.items():
        if abs(loss - first["reference float32"]) > 1e-2 * abs(loss):
            raise SystemExit(f"{name} computes the loss {loss}, others {first}")
    taken: dict[str, list[float]] = {name: [] for name in steps}
    for _ in range(repeats):
        for name, step in steps.items():
            start = time.process_time()
            step()
            taken[name].append(1e3 * (time.process_time() - start))
    found = {}
    for name, each in taken.items():
        ratios = [a / b for a, b in zip(taken["float32"], each, strict=True)]
        found[name] = {
            "median_ms": round(statistics.median(each), 1),
            "fastest_ms": round(min(each), 1),
            "times_as_fast_as_float32": round(statistics.median(ratios), 2),
        }
    return found


def scores(seeds: int, epochs: int) -> list[dict[str, float]]:
    """Validation MSE after the same training in both precisions, for each seed."""
    found = []
    for seed in range(seeds):
        recorded = ob.simulate("hopper", 300, 100, seed=seed)
        data = ob.mask_out(recorded, 0.7, seed=seed)
        train, validation = data[:200], data[200:]
        one: dict[str, float] = {"seed": seed}
        for precision in ("float32", "bf16"):
            config = ob.thesis_config("ode_gru_d", hidden_size=64, field_units=(128,) * 4)
            model = ob.make_model(config, train, seed=seed)
            asked = ob.TrainConfig(epochs=epochs, seed=seed, precision=precision)  # type: ignore[arg-type]
            result = ob.fit(model, train, validation, config=asked, progress=False)
            one[precision] = min(record.validation_mse for record in result.history)
            one[f"{precision}, first epoch"] = result.history[0].validation_mse
        found.append(one)
        print(one, flush=True)
    return found


def main() -> None:
    """Measures and prints."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", 1)[0])
    parser.add_argument("--rows", type=int, default=50)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--epochs", type=int, default=30)
    parser.add_argument("--only", choices=["steps", "training"])
    parser.add_argument("--json")
    options = parser.parse_args()
    if not cpu.bf16_sets():
        raise SystemExit("this processor has no AVX512-BF16 (avx512_bf16 in /proc/cpuinfo)")
    torch.set_num_threads(1)
    found: dict[str, Any] = {"machine": machine(), "options": vars(options)}
    if options.only != "training":
        found["steps"] = {}
        for size in SIZES:
            few = options.repeats * (4 if size[2] < 100 else 1)
            name = "hidden {}, units {}, batch {}".format(*size)
            found["steps"][name] = times_of(size, options.rows, few)
            print(name, found["steps"][name], flush=True)
    if options.only != "steps":
        each = found["training"] = scores(options.seeds, options.epochs)
        ratios = [one["bf16"] / one["float32"] for one in each]
        found["ratio of validation MSE"] = {"median": statistics.median(ratios),
                                            "least": min(ratios), "most": max(ratios)}  # fmt: skip
        print(found["ratio of validation MSE"])
    write(options.json, found)


if __name__ == "__main__":
    main()
