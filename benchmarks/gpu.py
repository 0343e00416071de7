"""A training step on a GPU: Triton, the reference in a CUDA graph, eager PyTorch and JAX.

It needs torch, triton and NumPy; JAX and torchdiffeq take part where they are installed. All
implementations have the same weights and batch, and must agree on the loss before they are timed.
No GPU has run it yet. `--dry` runs all of it on the CPU, with tiny sizes and interpreted kernels;
its times mean nothing.

    python benchmarks/gpu.py --json results/benchmarks/gpu.json
"""

from __future__ import annotations

import argparse
import importlib.util
import os
import statistics
import sys
import time
from collections.abc import Callable
from typing import Any

if "--dry" in sys.argv:  # before anything imports Triton
    os.environ["TRITON_INTERPRET"] = "1"

import torch
from common import machine, synthetic, write
from other_libraries import JaxStep, TorchStep, inputs_of

import offbeat as ob
from offbeat import kernels
from offbeat.captured import captured
from offbeat.models.zoo import recipe_of
from offbeat.run import FlatParameters, RunState
from offbeat.sweeps.stacked import StackedModels
from offbeat.training import Examples, train_step

MODELS = ("gru", "gru_d", "ode_rnn", "ode_gru_d", "anchored_ode_gru_d")

WARM_UP = 0 if "--dry" in sys.argv else 2
"""Steps before those that are timed."""

Step = Callable[[], float]
"""Takes a training step, waits for it, and returns the loss before it."""


def config_of(name: str, hidden: int, dry: bool) -> ob.ModelConfig:
    """A model as the peers have it: steps from row to row, and no bounds."""
    options: dict[str, Any] = {"hidden_size": hidden}
    if name not in ("gru", "gru_d"):
        layers = 3 if name.startswith("anchored") else 4
        options["field_units"] = (8,) if dry else (max(100, hidden),) * layers
    if name in ob.THESIS_MODELS:
        return ob.thesis_config(name, **options)
    return ob.ModelConfig(name=name, nodes="rows", bounded=False, **options)


class Run:
    """A model with its batch and optimizer on a device."""

    def __init__(
        self, config: ob.ModelConfig, data: ob.Dataset, device: torch.device, *, seed: int = 0
    ) -> None:
        self.model = ob.make_model(config, data, seed=seed).to(device)
        batch = self.model.batch(data).to(device)
        self.examples = Examples(self.model, batch)
        self.recipe = recipe_of(self.model.name, ob.TrainConfig(), validated=False)
        self.state = RunState(FlatParameters(self.model), self.recipe)
        self.index = torch.arange(len(self.examples), device=device)

    def step(self, backend: str) -> Step:
        """A training step with a backend."""

        def step() -> float:
            with kernels.use(backend):
                return train_step(
                    self.model, self.examples, self.index, self.state, self.recipe, total=1
                )

        return step

    def graph(self) -> Step | None:
        """A training step of the reference backend in a CUDA graph, or None."""

        def whole(index: torch.Tensor) -> torch.Tensor:
            loss = self.examples.loss(self.model, index, None, whole=True)
            self.state.parameters.zero_gradient()
            (loss * self.recipe.loss_scale).backward()
            if self.recipe.clip_norm is not None:
                torch.nn.utils.clip_grad_norm_([self.state.parameters.flat], self.recipe.clip_norm)
            self.state.optimizer.step()
            return loss

        with kernels.use("reference"):
            found = captured(
                self.model, self.examples, self.state, self.recipe, whole, steps=10_000
            )
        return None if found is None else lambda: float(found(self.index))


def steps_of(config: ob.ModelConfig, data: ob.Dataset, device: torch.device) -> dict[str, Step]:
    """The implementations that can run a model here, by name."""
    found: dict[str, Step] = {"Offbeat, triton": Run(config, data, device).step("triton")}
    graph = Run(config, data, device).graph()
    if graph is not None:
        found["Offbeat, reference, CUDA graph"] = graph
    found["Offbeat, reference"] = Run(config, data, device).step("reference")
    model = ob.make_model(config, data, seed=0)
    batch = model.batch(data)
    inputs = inputs_of(model.step_inputs(batch)[0], batch.values)
    if importlib.util.find_spec("jax"):
        found["JAX, jitted scan"] = JaxStep(model, inputs)  # on its own default device
    if not model.spec.field or importlib.util.find_spec("torchdiffeq"):
        name = "eager torchdiffeq" if model.spec.field else "eager torch"
        with torch.device(device):
            eager = TorchStep(
                model.to(device), {key: value.to(device) for key, value in inputs.items()}
            )

        def step() -> float:
            with torch.device(device):
                return eager()

        found[name] = step
    return found


def flops(model: ob.Model, batch: int, rows: int) -> float:
    """Multiplications and additions of the products of a step, forward and backward."""
    matrices = sum(p.numel() for p in model.parameters() if p.ndim == 2)
    return 6.0 * batch * rows * matrices


def measure(
    config: ob.ModelConfig,
    data: ob.Dataset,
    device: torch.device,
    *,
    repeats: int,
    agree: float,
    peak: float,
) -> dict[str, Any]:
    """Times of all implementations in turn, ms, and fractions of the arithmetic limit."""
    steps = steps_of(config, data, device)
    losses = {name: step() for name, step in steps.items()}
    expected = losses["Offbeat, reference"]
    for name, loss in losses.items():
        if abs(loss - expected) > agree * abs(expected):
            raise SystemExit(f"{config.name}: {name} has the loss {loss}, the reference {expected}")
    times: dict[str, list[float]] = {name: [] for name in steps}
    for i in range(repeats + WARM_UP):
        for name, step in steps.items():
            started = time.perf_counter()
            step()
            if i >= WARM_UP:
                times[name].append(1e3 * (time.perf_counter() - started))
    model = ob.make_model(config, data, seed=0)
    work = flops(model, len(data), data[0].rows)
    own = statistics.median(times["Offbeat, triton"])
    return {
        name: {
            "median_ms": round(statistics.median(each), 4),
            "fastest_ms": round(min(each), 4),
            "ratio_to_triton": round(statistics.median(each) / own, 3),
            "fraction_of_peak": round(work / (1e-3 * statistics.median(each)) / peak, 5),
            "loss": losses[name],
        }
        for name, each in times.items()
    }


def accuracy(config: ob.ModelConfig, data: ob.Dataset, device: torch.device) -> dict[str, float]:
    """Largest error of the gradient against float64 on the CPU, of its largest entry."""

    def gradient(backend: str, where: torch.device, dtype: torch.dtype) -> torch.Tensor:
        model = ob.make_model(config, data, seed=0).to(where).to(dtype)
        batch = model.batch(data).to(where)
        examples = Examples(model, batch)
        with kernels.use(backend):
            loss = examples.loss(model, torch.arange(len(data), device=where), None)
        found = torch.autograd.grad(loss, list(model.parameters()), allow_unused=True)
        each = zip(found, model.parameters(), strict=True)
        flat = [torch.zeros_like(p) if g is None else g for g, p in each]
        return torch.cat([g.flatten() for g in flat]).double().cpu()

    exact = gradient("reference", torch.device("cpu"), torch.float64)
    return {
        backend: float((gradient(backend, device, torch.float32) - exact).abs().max())
        / float(exact.abs().max())
        for backend in ("triton", "reference")
    }


def stacked(
    config: ob.ModelConfig, data: ob.Dataset, device: torch.device, runs: int, repeats: int
) -> float:
    """Ms of a step of several runs in one launch of the scan."""
    each = [Run(config, data, device, seed=seed) for seed in range(runs)]
    together = StackedModels(
        [r.model for r in each],
        [r.examples for r in each],
        [r.state for r in each],
        each[0].recipe,
    )
    indices = [r.index for r in each]
    times = []
    with kernels.use("triton"):
        for i in range(repeats + WARM_UP):
            started = time.perf_counter()
            together.step(indices).tolist()
            if i >= WARM_UP:
                times.append(1e3 * (time.perf_counter() - started))
    return statistics.median(times)


def limits(device: torch.device, size: int) -> dict[str, float]:
    """Operations per second of a large product of PyTorch, and bytes per second of a copy."""
    a, b = (torch.randn(size, size, device=device) for _ in range(2))
    large = torch.empty(16 * size * size, device=device)

    def fastest(work: Callable[[], Any]) -> float:
        times = []
        for _ in range(5):
            started = time.perf_counter()
            float(work().flatten()[0])
            times.append(time.perf_counter() - started)
        return min(times)

    product, copy = fastest(lambda: a @ b), fastest(large.clone)
    return {"flops": 2 * size**3 / product, "bytes": 2 * large.nbytes / copy}


def main() -> None:
    """Measures and prints."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", 1)[0])
    parser.add_argument("--models", nargs="*", default=list(MODELS))
    parser.add_argument("--batch", type=int, nargs="*", default=[50, 512, 4096])
    parser.add_argument("--hidden", type=int, nargs="*", default=[15, 64, 256])
    parser.add_argument("--runs", type=int, nargs="*", default=[1, 8, 32, 176])
    parser.add_argument("--rows", type=int, default=100)
    parser.add_argument("--repeats", type=int, default=20)
    parser.add_argument("--precision", choices=["float32", "tf32"], default="float32")
    parser.add_argument("--dry", action="store_true", help="tiny sizes, on the CPU")
    parser.add_argument("--json")
    options = parser.parse_args()
    device = torch.device("cpu" if options.dry else "cuda")
    if options.dry:
        options.batch, options.hidden, options.runs = [3], [4], [1, 2]
        options.rows, options.repeats = 3, 1
    elif not torch.cuda.is_available():
        raise SystemExit("there is no CUDA device here; --dry runs without one")
    torch.set_float32_matmul_precision("high" if options.precision == "tf32" else "highest")
    agree = 1e-2 if options.precision == "tf32" else 1e-4
    card = "none" if options.dry else torch.cuda.get_device_name(device)
    limit = limits(device, 64 if options.dry else 8192)
    result: dict[str, Any] = {
        "machine": machine() | {"gpu": card},
        "options": vars(options),
        "limits": limit,
        "steps": [],
        "accuracy": {},
        "stacked": [],
    }
    print(f"{card}: {limit['flops']:.3g} FLOP/s, {limit['bytes']:.3g} B/s")
    for name in options.models:
        for hidden in options.hidden:
            config = config_of(name, hidden, options.dry)
            for batch in options.batch:
                data = synthetic(batch, options.rows, observed_fraction=0.7)
                found = measure(
                    config,
                    data,
                    device,
                    repeats=options.repeats,
                    agree=agree,
                    peak=limit["flops"],
                )
                result["steps"].append(
                    {"model": name, "hidden": hidden, "batch": batch, "times": found}
                )
                for which, numbers in found.items():
                    print(
                        f"{name:20} {hidden:4} {batch:5} {which:31} "
                        f"{numbers['median_ms']:9.3f} ms  x{numbers['ratio_to_triton']:.2f}",
                        flush=True,
                    )
                write(options.json, result)
        config = config_of(name, options.hidden[0], options.dry)
        data = synthetic(options.batch[0], options.rows, observed_fraction=0.7)
        result["accuracy"][name] = accuracy(config, data, device)
        print(f"{name:20} largest error of the gradient: {result['accuracy'][name]}", flush=True)
        for runs in options.runs:
            ms = stacked(config, data, device, runs, options.repeats)
            result["stacked"].append(
                {"model": name, "runs": runs, "median_ms": ms, "runs_per_s": 1e3 * runs / ms}
            )
            print(f"{name:20} {runs:4} runs {ms:9.3f} ms, {1e3 * runs / ms:8.1f} runs/s")
        write(options.json, result)


if __name__ == "__main__":
    main()
