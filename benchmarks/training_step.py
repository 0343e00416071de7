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
from peers import JaxContestant, TorchContestant, facts_of

import offbeat as ob
from offbeat import kernels
from offbeat.run import RunState, flat_parameters
from offbeat.training import Examples, train_step

MODELS = ("ode_rnn", "ode_gru_d", "anchored_ode_gru_d", "gru", "gru_d")


class Contestant(NamedTuple):
    """A step, which returns the loss before it, and what to be in while it is timed."""

    step: Callable[[], float]
    around: Callable[[], AbstractContextManager[Any]] = nullcontext


def ours(config: ob.ModelConfig, data: ob.Dataset, body: str) -> Contestant:
    """A training step of this library in one of its bodies."""
    model = ob.make_model(config, data, seed=0)
    examples = Examples(model, model.batch(data))
    training = ob.TrainConfig()
    state = RunState(flat_parameters(model).__enter__(), training)
    index = torch.arange(len(examples))

    def step() -> float:
        return train_step(model, examples, index, state, training, total=1)

    def around() -> ExitStack:  # as `fit` enters once for all of a training
        stack = ExitStack()
        stack.enter_context(kernels.use(body))
        stack.enter_context(model.threads())
        return stack

    return Contestant(step, around)


def contestants(name: str, data: ob.Dataset) -> dict[str, Contestant]:
    """Everyone who can run a model here."""
    config = ob.thesis_config(name) if name in ob.THESIS_MODELS else ob.ModelConfig(name=name)
    model = ob.make_model(config, data, seed=0)
    batch = model.batch(data)
    rows, _ = model.step_inputs(batch)
    facts = facts_of(rows, batch.values)
    found: dict[str, Contestant] = {}
    if kernels.cpu.instruction_sets():
        found["ours, fused"] = ours(config, data, "fused")
    found["ours, reference"] = ours(config, data, "reference")
    found["eager torchdiffeq" if model.spec.field else "eager torch"] = Contestant(
        TorchContestant(model, facts)
    )
    if importlib.util.find_spec("jax"):
        found["JAX, jitted scan"] = Contestant(JaxContestant(model, facts))
    return found


def measure(name: str, data: ob.Dataset, repeats: int) -> dict[str, Any]:
    """Times of all contestants in turn, ms."""
    everyone = contestants(name, data)

    def timed(who: str) -> tuple[float, float]:
        contestant = everyone[who]
        with contestant.around():
            time.sleep(0.02)  # the idle threads of the contestant before go to sleep
            start = time.perf_counter()
            loss = contestant.step()
            return loss, 1e3 * (time.perf_counter() - start)

    first = {who: timed(who)[0] for who in everyone}
    expected = first["ours, reference"]
    for who, loss in first.items():
        if abs(loss - expected) > 1e-4 * abs(expected):
            raise SystemExit(f"{name}: {who} computes the loss {loss}, the reference {expected}")
    for who in everyone:
        timed(who)
    times: dict[str, list[float]] = {who: [] for who in everyone}
    for _ in range(repeats):
        for who in everyone:
            times[who].append(timed(who)[1])
    own = times.get("ours, fused", times["ours, reference"])
    result = {}
    for who, each in times.items():
        ratio = statistics.median(t / o for t, o in zip(each, own, strict=True))
        result[who] = {
            "median_ms": round(statistics.median(each), 2),
            "fastest_ms": round(min(each), 2),
            "median_ratio_to_fused": round(ratio, 2),
        }
    return result


def main() -> None:
    """Measures and prints."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--batch", type=int, default=50)
    parser.add_argument("--rows", type=int, default=100)
    parser.add_argument("--repeats", type=int, default=15)
    parser.add_argument("--models", nargs="*", default=list(MODELS))
    parser.add_argument("--json")
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    data = synthetic(options.batch, options.rows, observed_fraction=0.3)
    found = {}
    for name in options.models:
        found[name] = measure(name, data, options.repeats)
        for who, numbers in found[name].items():
            print(
                f"{name:20} {who:18} {numbers['median_ms']:8.1f} ms   "
                f"x{numbers['median_ratio_to_fused']:.2f}",
                flush=True,
            )
    write(options.json, {"machine": machine(), "options": vars(options), "steps": found})


if __name__ == "__main__":
    main()
