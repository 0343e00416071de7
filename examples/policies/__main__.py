"""Clones policies and their rivals, runs them, and writes `docs/policies_measured.md`.

    python -m examples.policies --robot pendulum --seeds 3
    python -m examples.policies --robot hopper --training "all drops" "no drops" --minutes 10
    python -m examples.policies --robot pendulum --document docs/policies_measured.md

A file per rival, training and seed is kept in `results/policies/ROBOT`; what is there is not run
again. It needs `offbeat[robots]`.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import torch

from examples.documents import write_between
from examples.real_logs.results import machine
from offbeat.data.robots import gymnasium_env
from offbeat.data.trajectory import Dataset
from offbeat.env import UnevenObservations
from offbeat.files import write_json
from offbeat.policies import Drops, HeldController, demonstrate, rollout

from . import report
from .rivals import RIVALS
from .robots import Robot, robots

RESULTS = Path("results/policies")
TRAININGS = {
    "drops": Drops(frames=0.9),
    "all drops": Drops(frames=0.9, sensors=0.5, bursts=0.3),
    "no drops": Drops(frames=0.0),
}
FIRST_SEED = 50_000  # of the tests
OPTIONS = ("epochs", "learning_rate", "starts", "decoder_units")


def conditions(robot: Robot, episodes: int) -> dict[str, list[dict[str, Any]]]:
    """What is lost and late in each episode of a test, by name."""
    found: dict[str, dict[str, Any]] = {
        **{f"{100 * d:.0f} %": {"drop": d} for d in (0.0, 0.3, 0.5, 0.7, 0.9)},
        "bursts": {"bursts": 0.3, "burst_s": (0.1, 0.5)},
        "sensors": {"sensor_drop": 0.5},
        "delay": {"delay_s": 2 * robot.dt},
    }
    each = {name: [lost] * episodes for name, lost in found.items()}
    if robot.encoders:  # one of them in each episode
        turns = [robot.encoders[i % len(robot.encoders)] for i in range(episodes)]
        each["encoder"] = [{"sensors": (one,), "sensor_drop": 0.9} for one in turns]
    return each


class Random:
    """Acts at random, uniformly within bounds."""

    def __init__(self, bounds: tuple[float, float], actions: int) -> None:
        self.bounds, self.actions = bounds, actions

    def reset(self, n: int | None = None) -> None:
        """Begins episodes of n robots."""
        self.n, self.random = n or 1, np.random.default_rng(0)

    def act(self, t: Any, observation: Any, mask: Any, *, now: Any) -> Any:
        """(n, actions)."""
        return self.random.uniform(*self.bounds, (self.n, self.actions))


class Again(UnevenObservations):  # type: ignore[misc]
    """An environment whose seeds are taken modulo the number of episodes.

    Args:
        env: of Gymnasium.
        episodes: number of different seeds.
        **lost: as of `UnevenObservations`.
    """

    def __init__(self, env: Any, episodes: int, **lost: Any) -> None:
        super().__init__(env, **lost)
        self.episodes = episodes

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        """Begins an episode."""
        assert seed is not None
        return super().reset(seed=FIRST_SEED + (seed - FIRST_SEED) % self.episodes, options=options)


def tested(controller: Any, robot: Robot, episodes: int, steps: int | None) -> dict[str, Any]:
    """Returns of a controller under all conditions; the same starts and losses for every one.

    The episodes of all conditions run side by side.
    """
    asked = conditions(robot, episodes)
    lost = iter([one for each in asked.values() for one in each])
    found = rollout(
        controller,
        lambda: Again(gymnasium_env(robot.env), episodes, **next(lost)),
        episodes * len(asked),
        seed=FIRST_SEED,
        steps=steps,
    )
    each = found.returns.reshape(len(asked), episodes)
    return {name: each[i].tolist() for i, name in enumerate(asked)}


def shown(robot: Robot) -> tuple[Dataset, Dataset]:
    """Demonstrations to train and to validate."""
    count = robot.demonstrations
    train, validation = (
        demonstrate(robot.expert, robot.env, n, seed=seed, noise=robot.noise, names=robot.names)
        for n, seed in ((count, 1000), (count // 5, 9000))
    )
    return train, validation


def main(given: list[str] | None = None) -> None:
    """Runs the command."""
    parser = argparse.ArgumentParser(
        "python -m examples.policies", description=__doc__.split("\n")[0]
    )
    add = parser.add_argument
    add("--robot", default="pendulum", help=f"one of {', '.join(robots())}")
    add("--seeds", type=int, default=3, help="trainings of each rival")
    add("--training", nargs="+", default=["drops"], choices=TRAININGS, help="what training loses")
    add("--only", default="", help="names of rivals, separated by semicolons")
    add("--episodes", type=int, default=20)
    add("--steps", type=int, help="that an episode of a test is cut off after")
    add("--epochs", type=int, help="of a training, in place of the robot's; a folder of its own")
    add("--learning_rate", type=float, help="in place of the robot's; a folder of its own")
    add("--minutes", type=float, help="stop after the run that is in progress then")
    add("--document", type=Path, help="write the tables into this document instead")
    add("--lengths", type=Path, help="write the table of lengths of trainings into this document")
    asked = parser.parse_args(given)
    if asked.lengths is not None:
        write_between(asked.lengths, "lengths", report.lengths(RESULTS))
        return
    robot, key = robots()[asked.robot], asked.robot
    if asked.epochs is not None:
        robot, key = replace(robot, epochs=asked.epochs), f"{key}_{asked.epochs}_epochs"
    if asked.learning_rate is not None:
        robot = replace(robot, learning_rate=asked.learning_rate)
        key = f"{key}_rate_{asked.learning_rate:g}"
    folder = RESULTS / key
    if asked.document is not None:
        report.write(asked.document, folder, key)
        return
    torch.set_num_threads(1)
    stop = time.monotonic() + 60 * (asked.minutes or 1e9)
    if not (folder / "expert.json").exists():
        probe = demonstrate(robot.expert, robot.env, 1, seed=1, names=robot.names)
        width = sum(role == "action" for role in probe.roles)
        for name, one in (
            ("expert", HeldController(robot.expert)),
            ("random", Random(robot.bounds, width)),
        ):
            found = tested(one, robot, asked.episodes, asked.steps)
            write_json(folder / f"{name}.json", {"rival": f"{name}, last value", "returns": found})
    train = None
    chosen = [name.strip() for name in asked.only.split(";") if name.strip()] or list(RIVALS)
    for seed, training, name in product(range(asked.seeds), asked.training, chosen):
        words = f"{name} {training}".replace(",", "").replace(" ", "_")
        path = folder / f"{words}-{seed}.json"
        if path.exists():
            continue
        if time.monotonic() > stop:
            return
        if train is None:
            train, validation = shown(robot)
        began = time.process_time()
        policy = robot.clone(name, TRAININGS[training], seed, train=train, validation=validation)
        seconds = time.process_time() - began
        found = tested(policy, robot, asked.episodes, asked.steps)
        write_json(
            path,
            {
                "rival": name,
                "training": training,
                "seed": seed,
                **{key: getattr(robot, key) for key in OPTIONS},
                "returns": found,
                "validation": min(record.validation for record in policy.log),
                "parameters": sum(p.numel() for p in policy.model.parameters()),
                "training_seconds": round(seconds, 1),
                "machine": machine(),
            },
        )
        means = " ".join(f"{k} {np.mean(v):.0f};" for k, v in found.items())
        print(f"{name} {training} {seed}: {seconds:.0f} s, {means}", flush=True)


if __name__ == "__main__":
    main()
