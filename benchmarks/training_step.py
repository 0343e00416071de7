"""One training step (forward, backward, optimizer) of Offbeat, eager PyTorch and JAX.

All implementations take turns within one process, with the same threads, weights and batch. They
must agree on the loss before they are timed. `two_builds.py` compares two checkouts of Offbeat.

    python benchmarks/training_step.py --threads 2 --json results/benchmarks/training_step.json
"""

from __future__ import annotations

import argparse
import importlib.util
import statistics
import time
from collections.abc import Callable
from contextlib import AbstractContextManager, ExitStack, nullcontext
from typing import Any, NamedTuple

import torch
from common import machine, synthetic, write
from other_libraries import JaxStep, TorchStep, inputs_of

import offbeat as ob
from offbeat import kernels
from offbeat.models.zoo import recipe_of
from offbeat.run import FlatParameters, RunState
from offbeat.training import Examples, train_step

MODELS = ("ode_rnn", "ode_gru_d", "anchored_ode_gru_d", "gru", "gru_d")


class Step(NamedTuple):
    """A training step, which returns the loss before it, and the context that it is timed in."""

    step: Callable[[], float]
    around: Callable[[], AbstractContextManager[Any]] = nullcontext


def offbeat_step(
    config: ob.ModelConfig, data: ob.Dataset, backend: str, *, autograd: bool = False
) -> Step:
    """A training step of Offbeat with one of its backends."""
    model = ob.make_model(config, data, seed=0)
    examples = Examples(model, model.batch(data))
    recipe = recipe_of(model.name, ob.TrainConfig(), validated=False)
    state = RunState(FlatParameters(model), recipe)
    index = torch.arange(len(examples))
    if autograd:  # as before `offbeat/direct.py`
        state.direct = (model, examples, None)

    def step() -> float:
        return train_step(model, examples, index, state, recipe, total=1)

    def around() -> ExitStack:  # `fit` enters it once per training
        stack = ExitStack()
        stack.enter_context(kernels.use(backend))
        stack.enter_context(model.threads())
        return stack

    return Step(step, around)


def steps_of(name: str, data: ob.Dataset) -> dict[str, Step]:
    """The implementations that can run a model here."""
    config = ob.ModelConfig(name=name, nodes="rows", bounded=False)  # as the peers
    if name in ob.THESIS_MODELS:
        config = ob.thesis_config(name)
    model = ob.make_model(config, data, seed=0)
    batch = model.batch(data)
    rows, _ = model.step_inputs(batch)
    inputs = inputs_of(rows, batch.values)
    found: dict[str, Step] = {}
    if kernels.cpu.instruction_sets():
        found["Offbeat, cpu"] = offbeat_step(config, data, "cpu")
        found["Offbeat, cpu, autograd"] = offbeat_step(config, data, "cpu", autograd=True)
    found["Offbeat, reference"] = offbeat_step(config, data, "reference")
    found["eager torchdiffeq" if model.spec.field else "eager torch"] = Step(
        TorchStep(model, inputs)
    )
    if importlib.util.find_spec("jax"):
        found["JAX, jitted scan"] = Step(JaxStep(model, inputs))
    return found


CLOCKS = {"wall": time.perf_counter, "processor": time.process_time}


def measure(
    name: str, data: ob.Dataset, repeats: int, in_a_row: int, clock: Callable[[], float]
) -> dict[str, Any]:
    """Times of a step of all implementations in turn, ms; each takes some steps in a row."""
    steps = steps_of(name, data)

    def timed(which: str) -> tuple[float, float]:
        step, around = steps[which]
        with around():
            time.sleep(0.02)  # until the idle threads of the step before sleep
            start = clock()
            loss = step()
            for _ in range(1, in_a_row):
                step()
            return loss, 1e3 * (clock() - start) / in_a_row

    first = {which: timed(which)[0] for which in steps}
    expected = first["Offbeat, reference"]
    for which, loss in first.items():
        if abs(loss - expected) > 1e-4 * abs(expected):
            raise SystemExit(f"{name}: {which} computes the loss {loss}, the reference {expected}")
    for which in steps:
        timed(which)
    times: dict[str, list[float]] = {which: [] for which in steps}
    for _ in range(repeats):
        for which in steps:
            times[which].append(timed(which)[1])
    own = times.get("Offbeat, cpu", times["Offbeat, reference"])
    result = {}
    for which, each in times.items():
        ratio = statistics.median(t / o for t, o in zip(each, own, strict=True))
        result[which] = {
            "ratio_of_fastest": round(min(each) / min(own), 2),
            "median_ms": round(statistics.median(each), 2),
            "fastest_ms": round(min(each), 2),
            "median_ratio_to_cpu": round(ratio, 2),
        }
    return result


def main() -> None:
    """Measures and prints."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--batch", type=int, default=50)
    parser.add_argument("--rows", type=int, default=100)
    parser.add_argument("--repeats", type=int, default=15)
    parser.add_argument(
        "--in-a-row", type=int, default=1, help="steps of each turn, as in a training"
    )
    parser.add_argument(
        "--clock",
        choices=list(CLOCKS),
        default="wall",
        help="processor: time of all threads, for one thread on a busy machine",
    )
    parser.add_argument("--models", nargs="*", default=list(MODELS))
    parser.add_argument("--json")
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    data = synthetic(options.batch, options.rows, observed_fraction=0.3)
    found = {}
    for name in options.models:
        found[name] = measure(name, data, options.repeats, options.in_a_row, CLOCKS[options.clock])
        for which, numbers in found[name].items():
            print(
                f"{name:20} {which:22} {numbers['median_ms']:8.1f} ms   "
                f"x{numbers['median_ratio_to_cpu']:.2f}   "
                f"fastest {numbers['fastest_ms']:8.1f} ms   x{numbers['ratio_of_fastest']:.2f}",
                flush=True,
            )
    write(options.json, {"machine": machine(), "options": vars(options), "steps": found})


if __name__ == "__main__":
    main()
