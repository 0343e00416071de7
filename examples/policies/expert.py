"""Experts for robots of Gymnasium: linear policies found by augmented random search.

    python -m examples.policies.expert Hopper-v5 --out runs/experts --minutes 10

ARS V2-t of Mania, Guy and Recht 2018 (arXiv:1803.07055): finite differences of the return along
random directions, the best ones kept, observations in units of their running spread. It needs the
simulator alone, on one core. A search that was stopped goes on where it was. The policy of every
20th iteration is kept, so that there are experts of several levels of skill.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors.numpy import load_file, save_file

from offbeat.data.robots import gymnasium_env

SEARCH = {  # step, directions, kept, noise: the values of the paper's appendix
    "Hopper-v5": (0.01, 8, 4, 0.025),
    "Walker2d-v5": (0.03, 40, 30, 0.025),
    "HalfCheetah-v5": (0.02, 32, 4, 0.03),
    "Swimmer-v5": (0.02, 1, 1, 0.01),
}


@dataclass
class Linear:
    """A linear policy of observations in units of their spread.

    Attributes:
        weights: (actions, observations).
        mean: (observations,) running mean.
        squares: (observations,) running sum of squared deviations.
        count: observations so far.
    """

    weights: NDArray[np.float64]
    mean: NDArray[np.float64]
    squares: NDArray[np.float64]
    count: float = 0.0

    def matrix(self, weights: NDArray[np.float64]) -> NDArray[np.float64]:
        """(actions, observations) in the units of the observations."""
        spread = np.sqrt(self.squares / max(self.count - 1, 1))
        return weights / np.where(spread < 1e-7, np.inf, spread)

    def add(self, seen: NDArray[np.float64]) -> None:
        """Counts (n, observations) in the running mean and spread."""
        n, mean = len(seen), seen.mean(axis=0)
        difference = mean - self.mean
        self.squares += ((seen - mean) ** 2).sum(axis=0)
        self.squares += difference**2 * self.count * n / (self.count + n)
        self.mean += difference * n / (self.count + n)
        self.count += n


def episode(
    env: Any, matrix: NDArray[np.float64], mean: NDArray[np.float64], seed: int
) -> tuple[float, float, NDArray[np.float64]]:
    """Return, return without the bonus of being upright, and what was observed."""
    observation, _ = env.reset(seed=seed)
    low, high = env.action_space.low, env.action_space.high
    total = shifted = 0.0
    seen = []
    ended = cut = False
    while not (ended or cut):
        seen.append(observation)
        action = np.clip(matrix @ (observation - mean), low, high)
        observation, reward, ended, cut, info = env.step(action)
        total += float(reward)
        shifted += float(reward) - float(info.get("reward_survive", 0.0))
    return total, shifted, np.array(seen)


def search(name: str, folder: Path, minutes: float, seed: int) -> None:
    """Searches for some minutes; keeps the best policy by the mean return of 10 episodes."""
    step, directions, kept, noise = SEARCH[name]
    env = gymnasium_env(name, disable_env_checker=True)
    shape = (env.action_space.shape[0], env.observation_space.shape[0])
    policy = Linear(np.zeros(shape), np.zeros(shape[1]), np.zeros(shape[1]))
    state = {"iteration": 0, "steps": 0, "best": -np.inf, "log": []}
    at = folder / f"{name}-{seed}"
    if (at / "state.json").exists():
        state = json.loads((at / "state.json").read_text())
        policy = Linear(**load_file(at / "search.safetensors"), count=state["count"])
    at.mkdir(parents=True, exist_ok=True)
    stop = time.monotonic() + 60 * minutes
    while time.monotonic() < stop:
        random = np.random.default_rng([seed, state["iteration"]])
        deltas = random.standard_normal((directions, *shape))
        mean, returns, seen = policy.mean.copy(), np.zeros((directions, 2)), []
        for i, delta in enumerate(deltas):
            for j, sign in enumerate((1, -1)):
                matrix = policy.matrix(policy.weights + sign * noise * delta)
                one = episode(env, matrix, mean, int(random.integers(2**31)))
                returns[i, j] = one[1]
                seen.append(one[2])
        best = np.argsort(-returns.max(axis=1))[:kept]
        spread = returns[best].std() + 1e-8
        change = ((returns[best, 0] - returns[best, 1])[:, None, None] * deltas[best]).mean(axis=0)
        policy.weights = policy.weights + step / spread * change
        for each in seen:
            policy.add(each)
        state["iteration"] += 1
        state["steps"] += sum(len(each) for each in seen)
        if state["iteration"] % 20 == 0:
            matrix = policy.matrix(policy.weights)
            score = float(
                np.mean([episode(env, matrix, policy.mean, 10_000 + i)[0] for i in range(10)])
            )
            state["log"].append([state["iteration"], state["steps"], score])
            print(name, state["iteration"], state["steps"], f"{score:.0f}", flush=True)
            found = {"env": name, "return": f"{score:.1f}", "steps": str(state["steps"])}
            tensors = {"matrix": matrix, "mean": policy.mean}
            save_file(tensors, at / f"{state['iteration']}.safetensors", metadata=found)
            if score > state["best"]:
                state["best"] = score
                save_file(tensors, at / "expert.safetensors", metadata=found)
            save_file(
                {"weights": policy.weights, "mean": policy.mean, "squares": policy.squares},
                at / "search.safetensors",
            )
            (at / "state.json").write_text(json.dumps({**state, "count": policy.count}))


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("env", choices=SEARCH)
    parser.add_argument("--out", type=Path, default=Path("runs/experts"))
    parser.add_argument("--minutes", type=float, default=10)
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    search(given.env, given.out, given.minutes, given.seed)


if __name__ == "__main__":
    main()
