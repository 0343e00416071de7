"""Clones the teleoperated arms of a Unitree G1, and scores the actions with frames and hands lost.

    python -m examples.policies.arms unitree_g1_lerobot_v21 --minutes 10
    python -m examples.policies.arms --document docs/policies_measured.md

The log is a LeRobot data set of 100 episodes at 30 Hz with 26 joints and 26 actions (it is not part
of the repository). 70 episodes train, 15 validate, 15 test. A file per rival, training and seed is
kept in `results/robots/arms`; what is there is not run again.
"""

from __future__ import annotations

import argparse
import json
import time
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

import offbeat as ob
from examples.documents import write_between
from examples.real_logs.results import machine
from offbeat.data.drops import Outages
from offbeat.data.trajectory import ACTION
from offbeat.files import write_json
from offbeat.policies import CloneConfig, Drops, Policy, fit_policy

from .rivals import RIVALS, options_of

RESULTS = Path("results/robots/arms")
TRAININGS = {"losses": Drops(frames=0.9, sensors=0.5, bursts=0.3), "no losses": Drops(frames=0.0)}
CONDITIONS: dict[str, dict[str, float]] = {
    **{f"{100 * f:.0f} %": {"frames": f} for f in (0.0, 0.3, 0.5, 0.7, 0.9)},
    "bursts": {"bursts": 0.3},
    "hands": {"hands": 0.9},
}
"""What is lost in a test: frames, a fraction of the time in outages of 0.1 to 0.5 s, or the values
of each hand, on its own."""
EPOCHS, WINDOW, HIDDEN = 50, 60, 64
HELD = "last position"  # the action of a joint is the position that was last observed


def sensors_of(names: tuple[str, ...]) -> list[list[str]]:
    """Channels of the arms and hands, left and right."""
    seen = [name for name in names if not name.startswith("action.")]
    return [
        [name for name in seen if side in name and ("Hand" in name) == hand]
        for side, hand in product(("Left", "Right"), (False, True))
    ]


def arriving(
    test: ob.Dataset, frames: float = 0.0, bursts: float = 0.0, hands: float = 0.0
) -> ob.Dataset:
    """Test episodes with what arrives of them; the first frame does. Actions are not observed."""
    made = []
    both = [[test.names.index(n) for n in s] for s in sensors_of(test.names) if "Hand" in s[0]]
    for i, one in enumerate(test):
        random = np.random.default_rng([i, 11])
        outages = Outages(bursts, (0.1, 0.5))
        out = np.array([outages.at(t, random) for t in one.times - one.times[0]])
        lost = out | (random.random(len(one.times)) < frames)
        observed = np.repeat(~lost[:, None], len(test.names), axis=1)
        for hand in both:
            observed[:, hand] &= (random.random(len(one.times)) >= hands)[:, None]
        observed[0] = True
        observed[:, [role == ACTION for role in test.roles]] = False
        made.append(
            ob.Trajectory(one.times, one.values, observed, names=one.names, roles=one.roles)
        )
    return ob.Dataset(tuple(made))


def actions_of(policy: Policy | None, data: ob.Dataset) -> list[NDArray[np.float64]]:
    """(rows, actions) of each episode, as `Policy.act` gives them row by row."""
    acts = np.array([role == ACTION for role in data.roles])
    if policy is None:
        found = []
        for one in data:
            seen = one.observed[:, ~acts]
            last = np.maximum.accumulate(np.where(seen, np.arange(len(seen))[:, None], 0), axis=0)
            found.append(np.take_along_axis(one.values[:, ~acts], last, axis=0))
        return found
    with torch.inference_mode():
        mean = policy.model(policy.model.batch(data)).mean.double().numpy()
    scaled = policy.model.scaler.original(mean)[..., acts].clip(policy.low, policy.high)
    return [scaled[i, : len(one.times)] for i, one in enumerate(data)]


def scored(policy: Policy | None, test: ob.Dataset) -> dict[str, dict[str, float]]:
    """RMSE of the actions of arms (rad) and hands (0 to 1), by condition."""
    acts = np.array([role == ACTION for role in test.roles])
    names = [name for name, act in zip(test.names, acts, strict=True) if act]
    hand = np.array(["Hand" in name for name in names])
    truth = np.concatenate([one.values[:, acts] for one in test])
    found = {}
    for condition, lost in CONDITIONS.items():
        squared = (np.concatenate(actions_of(policy, arriving(test, **lost))) - truth) ** 2
        found[condition] = {
            "arms": float(np.sqrt(squared[:, ~hand].mean())),
            "hands": float(np.sqrt(squared[:, hand].mean())),
        }
    return found


def run(data: ob.Dataset, name: str, training: str, seed: int, path: Path) -> None:
    """Clones and scores a rival, and writes what was found."""
    train, validation, test = ob.split(data, seed=0)
    began = time.process_time()
    policy, record = None, {}
    if name != HELD:
        model, options = options_of(name, (100,))
        policy = fit_policy(
            train,
            model,
            validation=validation,
            drops=TRAININGS[training],
            sensors=sensors_of(data.names),
            config=CloneConfig(epochs=EPOCHS, window=WINDOW, starts=0.0, seed=seed),
            progress=False,
            **options,
            **({} if model == "held" else {"hidden_size": HIDDEN}),
        )
        record["validation"] = min(each.validation for each in policy.log)
        record["parameters"] = sum(p.numel() for p in policy.model.parameters())
    seconds = time.process_time() - began
    found = scored(policy, test)
    write_json(
        path,
        {
            "rival": name,
            "training": training,
            "seed": seed,
            "rmse": found,
            **record,
            "training_seconds": round(seconds, 1),
            "machine": machine(),
        },
    )
    said = " ".join(f"{k} {v['arms']:.4f} {v['hands']:.4f};" for k, v in found.items())
    print(f"{name} {training} {seed}: {seconds:.0f} s, {said}", flush=True)


def table(folder: Path, joints: str) -> str:
    """A Markdown table of the RMSE of the actions of `arms` or `hands`, mean of the seeds."""
    records = [json.loads(path.read_text()) for path in sorted(folder.glob("*.json"))]
    lines = [
        f"| {joints}, trained with | rival | " + " | ".join(CONDITIONS) + " | trainings | s |",
        "|---" * (len(CONDITIONS) + 4) + "|",
    ]
    for training, name in [("", HELD), *product(TRAININGS, RIVALS)]:
        some = [r for r in records if r["rival"] == name and training in ("", r["training"])]
        if not some:
            continue
        means = [np.mean([r["rmse"][c][joints] for r in some]) for c in CONDITIONS]
        seconds = np.mean([r["training_seconds"] for r in some])
        end = f"{len(some)} | {seconds:.0f}" if training else " | "
        lines.append(f"| {training} | {name} | " + " | ".join(f"{m:.4f}" for m in means))
        lines[-1] += f" | {end} |"
    return "\n".join(lines)


def write(document: Path, folder: Path) -> None:
    """Replaces the tables in a document, between its marks."""
    body = "\n\n".join(table(folder, joints) for joints in ("arms", "hands"))
    write_between(document, "arms", body)


def main(given: list[str] | None = None) -> None:
    """Runs the command."""
    parser = argparse.ArgumentParser(
        "python -m examples.policies.arms", description=__doc__.split("\n")[0]
    )
    add = parser.add_argument
    add("data", nargs="?", type=Path, help="folder of the LeRobot data set")
    add("--seeds", type=int, default=3, help="trainings of each rival")
    add("--training", nargs="+", default=list(TRAININGS), choices=TRAININGS)
    add("--minutes", type=float, help="stop after the run that is in progress then")
    add("--document", type=Path, help="write the tables into this document instead")
    asked = parser.parse_args(given)
    if asked.document is not None:
        write(asked.document, RESULTS)
        return
    if asked.data is None:
        parser.error("give the folder of the data set, or --document")
    torch.set_num_threads(1)
    stop = time.monotonic() + 60 * (asked.minutes or 1e9)
    plan: list[tuple[int, Any, str]] = [(0, "losses", HELD)]
    plan += product(range(asked.seeds), asked.training, RIVALS)
    data = None
    for seed, training, name in plan:
        words = f"{name} {training}".replace(",", "").replace(" ", "_")
        path = RESULTS / f"{words}-{seed}.json"
        if path.exists():
            continue
        if time.monotonic() > stop:
            return
        data = ob.read(asked.data) if data is None else data
        run(data, name, training, seed, path)


if __name__ == "__main__":
    main()
