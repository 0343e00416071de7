"""The irregular Walker2d benchmark, made anew: predict the next frame while frames are dropped.

    python examples/irregular_walker.py --minutes 10
    python examples/irregular_walker.py --document docs/robots.md

The recipe is that of Lechner and Hasani 2020 (arXiv:2006.04418), whose files are not available:
experts of four levels of skill, 1 % random actions, 17 observed values, 10 % of the frames dropped,
windows of 64 frames that are left. A model is given the frames that are left and their times, and
predicts the frame after each. The experts are those of `examples.policies.sac`. Errors are mean
squared errors of the values as the simulator gives them. It needs `offbeat[robots]` and
`pip install ncps==1.0.1`.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors.numpy import load_file
from torch import Tensor, nn

import offbeat as ob
from examples.documents import write_between
from examples.linear_state_space import LRUNetwork
from examples.policies.robots import HERE, expert
from examples.real_logs.results import machine
from offbeat.baselines import fit_baseline
from offbeat.comparison.statistics import holm, welch_t
from offbeat.data.trajectory import STATE
from offbeat.files import write_json
from offbeat.policies import demonstrate

RESULTS = Path("results/robots/irregular_walker")
LEVELS = ("walker2d_sac_80k", "walker2d_sac_330k", "walker2d_sac_360k", "walker2d_sac")
"""Files of one training of soft actor-critic after 80,000, 330,000, 360,000 and 410,000 steps."""
FRAMES, STRIDE, DROPPED, RANDOM_ACTIONS = 64, 16, 0.1, 0.01
FRACTIONS = (0.75, 0.1, 0.15)  # of the rollouts: 300, 40 and 60 of 400
COMPOSED = {"hidden_size": 64, "init": "fan_in", "field_units": (64, 64)}
LARGE = {"hidden_size": 128, "field_units": (128, 128)}


class Foreign(nn.Module):
    """A network of others on the frames that are left, and the times between them.

    `ncps.torch` takes `timespans[:, row].squeeze()` of a batch, (batch,), which broadcasts against
    (batch, units) along the wrong axis. So they are given as (batch, rows, units).

    Args:
        data: that it is made for.
        kind: `cfc`, `cfc_mixed` (with the memory of an LSTM) or `ltc` of `ncps`, or `lru`, the
            linear state-space network of `examples.linear_state_space`.
        units: hidden units.
        change: whether it predicts the change since the last frame.
    """

    def __init__(
        self, data: ob.DataInfo, kind: str = "cfc", units: int = 64, change: bool = False
    ) -> None:
        super().__init__()
        self.linear = kind == "lru"
        if self.linear:
            self.network: nn.Module = LRUNetwork(data.channels, units)
        else:
            from ncps.torch import LTC, CfC

            mixed = {"mixed_memory": True} if kind == "cfc_mixed" else {}
            made = LTC if kind == "ltc" else CfC
            network = made(data.channels, units, batch_first=True, **mixed)
            if kind == "ltc":  # its six steps per frame take the longest by far
                solver = network.rnn_cell._ode_solver
                network.rnn_cell._ode_solver = torch.compile(solver, dynamic=False)
            self.network = network
        self.read = nn.Linear(units, data.channels)
        self.units, self.change = units, change
        self.gap = data.statistics.median_gap

    def forward(self, batch: ob.Batch) -> ob.Prediction:
        """The prediction of every row from the frames before it."""
        left = batch.mask.any(dim=2)
        count = left.sum(dim=1)
        order = torch.argsort((~left).to(torch.int8), dim=1, stable=True)[:, : int(count.max())]
        frames = _at(batch.values, order)
        stamps = batch.times.gather(1, order)
        gaps = torch.diff(stamps, dim=1, prepend=stamps[:, :1] - self.gap) / self.gap
        real = torch.arange(order.shape[1], device=order.device) < count[:, None]
        spans = torch.where(real, gaps, 1.0).to(frames.dtype)
        if self.linear:
            hidden = self.network(frames, spans)
        else:
            each = spans[..., None].expand(-1, -1, self.units)
            hidden, _ = self.network(frames, timespans=each)
        after = self.read(hidden) + (frames if self.change else 0.0)
        before = left.cumsum(dim=1) - left.to(torch.int64) - 1  # the last frame before a row
        known = (before >= 0)[..., None]
        return ob.Prediction(torch.where(known, _at(after, before.clamp_min(0)), 0.0))


def _at(values: Tensor, rows: Tensor) -> Tensor:
    """(batch, rows, channels) of these rows."""
    return values.gather(1, rows[..., None].expand(-1, -1, values.shape[2]))


ob.register_model(
    "foreign",
    Foreign,
    recipe={"optimizer": "adam", "loss_scale": 1.0, "clip_norm": 1.0},
    replace=True,
)

MODELS: dict[str, tuple[str, dict[str, Any]]] = {
    "GRU": ("gru", {}),
    "GRU-D": ("gru_d", {}),
    "ODE-RNN": ("ode_rnn", {}),
    "ODE-GRU-D": ("ode_gru_d", {}),
    "anchored": ("anchored_ode_gru_d", {}),
    "anchored, LSTM": ("anchored_ode_gru_d", {"cell": "lstm"}),
    "anchored, LSTM, 128 units": ("anchored_ode_gru_d", {"cell": "lstm", **LARGE}),
    "CfC": ("foreign", {"kind": "cfc"}),
    "CfC-mmRNN": ("foreign", {"kind": "cfc_mixed"}),
    "CfC-mmRNN, 128 units": ("foreign", {"kind": "cfc_mixed", "units": 128}),
    "CfC, change of the last frame": ("foreign", {"kind": "cfc", "change": True}),
    "ODE-LSTM": ("ode_rnn", {"cell": "lstm"}),
    "LTC": ("foreign", {"kind": "ltc"}),
    "LRU, two layers": ("foreign", {"kind": "lru"}),
}
BASELINES = {"last value": "last_value", "ridge": "ridge"}
REFERENCE, FEWEST = "anchored", 3  # seeds that a test needs


def made(rollouts: int, stride: int) -> tuple[ob.Dataset, ob.Dataset, ob.Dataset]:
    """Windows to train, to validate and to test, of different rollouts."""
    each = rollouts // len(LEVELS)
    found = []
    for i, name in enumerate(LEVELS):
        act = expert(load_file(HERE / f"{name}.safetensors"))
        seed = 100_000 * (i + 1)
        found += list(
            demonstrate(act, "Walker2d-v5", each, seed=seed, random_actions=RANDOM_ACTIONS)
        )
    random = np.random.default_rng(0)
    order = random.permutation(len(found))
    ends = np.cumsum([round(f * len(found)) for f in FRACTIONS[:2]])
    parts = np.split(order, ends)
    return tuple(  # type: ignore[return-value]
        ob.Dataset(tuple(w for i in part for w in windows(found[i], random, stride)))
        for part in parts
    )


def windows(
    rollout: ob.Trajectory, random: np.random.Generator, stride: int
) -> list[ob.Trajectory]:
    """Windows of 64 frames that are left; dropped ones are known targets, as the last one is."""
    seen = [i for i, role in enumerate(rollout.roles) if role == STATE]
    values = rollout.values[:, seen]
    left = np.flatnonzero(random.random(len(values) - 1) >= DROPPED)
    cut = []
    for start in range(0, len(left) - FRAMES, stride):
        rows = left[start : start + FRAMES]
        first, last = rows[0], rows[-1] + 1
        observed = np.zeros((last - first + 1, len(seen)), dtype=bool)
        observed[rows - first] = True
        cut.append(
            ob.Trajectory(
                rollout.times[first : last + 1],
                values[first : last + 1],
                observed,
                names=tuple(rollout.names[i] for i in seen),
            )
        )
    return cut


def mean_squared_error(predicted: list[Any], test: ob.Dataset) -> float:
    """Of the frame after each frame that is left, in the units of the simulator."""
    squared = []
    for mean, window in zip(predicted, test, strict=True):
        rows = 1 + np.flatnonzero(window.observed.any(axis=1))
        squared.append((mean[rows] - window.values[rows]) ** 2)
    return float(np.mean(np.concatenate(squared)))


def predicted(model: Any, data: ob.Dataset) -> list[Any]:
    """(rows, channels) of each window, in the units of the simulator."""
    with torch.inference_mode():
        mean = model(model.batch(data)).mean.double().numpy()
    scaled = model.scaler.original(mean)
    return [scaled[i, : len(one.times)] for i, one in enumerate(data)]


def run(name: str, seed: int, data: tuple[ob.Dataset, ...], epochs: int) -> dict[str, Any]:
    """Trains and scores a model, or fits and scores a baseline."""
    train, validation, test = data
    began = time.process_time()
    if name in BASELINES:
        found = fit_baseline(BASELINES[name], train).predict(test)
        seconds = time.process_time() - began
        return {"mse": mean_squared_error(found, test), "seconds": round(seconds, 1)}
    kind, options = MODELS[name]
    own = options if kind == "foreign" else {**COMPOSED, **options}
    model = ob.make_model(kind, train, seed=seed, **own)
    config = ob.TrainConfig(
        epochs=epochs, batch_size=64, optimizer="adam", learning_rate=0.005, schedule="cosine",
        clip_norm=1.0, seed=seed,
    )  # fmt: skip
    ob.fit(model, train, validation, config, progress=False)
    seconds = time.process_time() - began
    return {
        "mse": mean_squared_error(predicted(model, test), test),
        "validation_mse": mean_squared_error(predicted(model, validation), validation),
        "parameters": sum(p.numel() for p in model.parameters()),
        "epochs": epochs,
        "seconds_per_epoch": round(seconds / epochs, 2),
    }


def table(folder: Path) -> str:
    """A Markdown table: means over the seeds, and Welch's tests against the anchored model."""
    records = [json.loads(path.read_text(encoding="utf-8")) for path in folder.glob("*.json")]
    found = {
        name: some
        for name in (*BASELINES, *MODELS)
        if (some := [r for r in records if r["model"] == name])
    }
    errors = {name: np.array([r["mse"] for r in some]) for name, some in found.items()}
    order = sorted(found, key=lambda name: float(errors[name].mean()))
    held, own = errors["last value"].mean(), errors[REFERENCE]
    p_values = {
        name: welch_t(own, errors[name]).p
        for name in order
        if name != REFERENCE and min(len(own), len(errors[name])) >= FEWEST
    }
    corrected = dict(zip(p_values, holm(list(p_values.values())) if p_values else (), strict=True))
    lines = [
        "| model | MSE | of the last value | parameters | epochs | s per epoch | seeds "
        f"| p, from {REFERENCE} |",
        "|---" * 8 + "|",
    ]
    for name in order:
        mse, some = errors[name], found[name]
        spread = f" ± {mse.std(ddof=1):.3f}" if len(mse) > 1 else ""
        end = " | | "
        if "epochs" in some[0]:
            cost = np.mean([r["seconds_per_epoch"] for r in some])
            end = f"{some[0]['parameters']:,} | {some[0]['epochs']} | {cost:.1f}"
        p = f"{corrected[name]:.2g}" if name in corrected else ""
        lines.append(
            f"| {name} | {mse.mean():.3f}{spread} | {mse.mean() / held:.3f} | {end} | {len(some)} "
            f"| {p} |"
        )
    return "\n".join(lines)


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    add = parser.add_argument
    add("--rollouts", type=int, default=400)
    add("--stride", type=int, default=STRIDE, help="frames between the starts of windows")
    add("--epochs", type=int, default=50)
    add("--seeds", type=int, default=5)
    add("--only", nargs="*", default=[], choices=(*BASELINES, *MODELS))
    add("--minutes", type=float, help="stop after the training that is in progress then")
    add("--document", type=Path, help="write the table into this document instead")
    asked = parser.parse_args()
    if asked.document is not None:
        write_between(asked.document, "irregular walker", table(RESULTS))
        return
    torch.set_num_threads(1)
    stop = time.monotonic() + 60 * (asked.minutes or 1e9)
    data = None
    for seed in range(asked.seeds):
        for name in asked.only or (*BASELINES, *MODELS):
            path = RESULTS / f"{name.replace(',', '').replace(' ', '_')}-{seed}.json"
            if path.exists() or (name in BASELINES and seed):
                continue
            if time.monotonic() > stop:
                return
            data = made(asked.rollouts, asked.stride) if data is None else data
            found = run(name, seed, data, asked.epochs)
            own = {"rollouts": asked.rollouts, "stride": asked.stride}
            own["windows"] = [len(part) for part in data]
            write_json(path, {"model": name, "seed": seed, **found, **own, "machine": machine()})
            print(name, seed, found, flush=True)


if __name__ == "__main__":
    main()
