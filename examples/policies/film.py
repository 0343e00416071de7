"""A film of three controllers side by side while frames are lost: expert, perceptron, anchored.

    MUJOCO_GL=egl python -m examples.policies.film --robot hopper docs/figures/policies_hopper.gif

The expert and the perceptron act on the last value; all three begin alike and lose the same frames.
Policies are cloned as the comparison does (seed 0), and kept in `--runs`.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image, ImageDraw

from offbeat.data.robots import gymnasium_env
from offbeat.env import UnevenObservations
from offbeat.policies import HeldController, Policy

from .__main__ import FIRST_SEED, TRAININGS, shown
from .robots import Robot, robots

LEARNERS = ("MLP, last value", "anchored")


def cloned(robot: Robot, name: str, path: Path) -> Policy:
    """A policy of the comparison, from a folder if it is there."""
    if path.exists():
        return Policy.load(path)
    train, validation = shown(robot)
    drops = TRAININGS["all drops"]
    policy = robot.clone(name, drops, 0, train=train, validation=validation)
    policy.save(path)
    return policy


def filmed(
    controller: Any, robot: Robot, lost: float, steps: int, every: int, size: int
) -> list[Image.Image]:
    """Pictures of an episode; the last one is repeated after a fall."""
    made = gymnasium_env(
        robot.env, render_mode="rgb_array", width=size, height=size, camera_name="track"
    )
    env = UnevenObservations(made, drop=lost)
    seen, _ = env.reset(seed=FIRST_SEED)
    controller.reset(1)
    pictures: list[Image.Image] = []
    total, over, marked, fell = 0.0, False, False, 0
    for step in range(steps):
        if not over:
            mask = seen["mask"].astype(bool)
            values = np.where(mask, seen["values"], np.nan)[None]
            action = controller.act(seen["time"], values, mask[None], now=seen["now"])[0]
            low, high = env.action_space.low, env.action_space.high
            clipped = np.clip(action, low, high).astype(np.float32)
            seen, reward, ended, cut, _ = env.step(clipped)
            total += float(reward)
            over, fell = ended or cut, step
        if step % every == 0:
            picture = Image.fromarray(made.render()) if not over else pictures[-1].copy()
            if over and not marked:
                marked = True
                ImageDraw.Draw(picture).text((6, 20), f"fell after {fell + 1} steps", fill="white")
            pictures.append(picture)
    made.close()
    print(f"return {total:.0f}, {fell + 1} steps", flush=True)
    return pictures


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser("python -m examples.policies.film", description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("--robot", default="hopper")
    parser.add_argument("--lost", type=float, default=0.7)
    parser.add_argument("--steps", type=int, default=400)
    parser.add_argument("--every", type=int, default=8)
    parser.add_argument("--size", type=int, default=200)
    parser.add_argument("--runs", type=Path, default=Path("runs/film"))
    parser.add_argument("--only_clone", choices=LEARNERS, help="clone this one, and stop")
    asked = parser.parse_args()
    torch.set_num_threads(1)
    robot = robots()[asked.robot]
    controllers: dict[str, Any] = {"expert, last value": HeldController(robot.expert)}
    for name in LEARNERS:
        if asked.only_clone in (None, name):
            path = asked.runs / f"{asked.robot}-{name.replace(', ', '_').replace(' ', '_')}"
            controllers[name] = cloned(robot, name, path)
    if asked.only_clone is not None:
        return
    films = {
        name: filmed(each, robot, asked.lost, asked.steps, asked.every, asked.size)
        for name, each in controllers.items()
    }
    joined = []
    for pictures in zip(*films.values(), strict=True):
        whole = Image.new("RGB", (asked.size * len(films), asked.size))
        for i, (name, picture) in enumerate(zip(films, pictures, strict=True)):
            whole.paste(picture, (i * asked.size, 0))
            ImageDraw.Draw(whole).text((i * asked.size + 6, 4), name, fill="white")
        joined.append(whole.quantize(64))
    dt = 1000 * robot.dt * asked.every
    asked.out.parent.mkdir(parents=True, exist_ok=True)
    joined[0].save(asked.out, save_all=True, append_images=joined[1:], duration=dt, loop=0)


if __name__ == "__main__":
    main()
