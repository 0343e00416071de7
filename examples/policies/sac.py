"""Experts for robots of Gymnasium: networks trained by soft actor-critic.

    python -m examples.policies.sac Walker2d-v5 --out runs/sac --steps 500000
    python -m examples.policies.sac Hopper-v5 --algorithm TQC --dropped 5

SAC of Haarnoja et al. 2018 (arXiv:1801.01290), or TQC, which is SAC with critics of quantiles
(Kuznetsov et al. 2020, arXiv:2005.04269), as SBX has them, the JAX sister of Stable-Baselines3
(`pip install sbx-rl`), with its own settings but for layers of 128 units, 8 updates every 8
steps and 10,000 random actions at the start. A training that was stopped goes on from one of its
last evaluations; its state is pickled by Stable-Baselines3, so `--out` must be a folder that this
script wrote. The actor of every evaluation is kept, so that there are experts of several levels of
skill.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors.numpy import save_file

from offbeat.data.robots import gymnasium_env

from .robots import expert

UNITS = 128
TOGETHER = 8  # updates after as many steps, in one compiled call


def actor(parameters: Any) -> dict[str, NDArray[np.float32]]:
    """Weights (out, in) and biases of the layers that give the mean of the actions.

    Args:
        parameters: of SBX's `SquashedGaussianActor`; its fourth layer is the log of the spread.
    """
    tensors = {}
    for i in range(3):
        layer = parameters["params"][f"Dense_{i}"]
        tensors[f"weight_{i}"] = np.ascontiguousarray(np.asarray(layer["kernel"], np.float32).T)
        tensors[f"bias_{i}"] = np.asarray(layer["bias"], np.float32)
    return tensors


def mean_return(env: Any, act: Any, episodes: int = 10) -> float:
    """Of episodes whose starts no training has seen; the environment's own time limit ends one."""
    total = 0.0
    for i in range(episodes):
        observation, _ = env.reset(seed=10_000 + i)
        ended = cut = False
        while not (ended or cut):
            observation, reward, ended, cut, _ = env.step(act(observation))
            total += float(reward)
    return total / episodes


def train(
    name: str, folder: Path, steps: int, every: int, random: int, seed: int, dropped: int | None
) -> None:
    """Trains up to `steps` of the environment; keeps the best actor by the mean return.

    Args:
        name: of the environment.
        folder: a folder of this script.
        steps: of the environment, those of an earlier call counted.
        every: steps between evaluations.
        random: steps of random actions at the start.
        seed: of the training.
        dropped: the highest quantiles of each critic that TQC leaves out; None for SAC.
    """
    import sbx

    learner, options = sbx.SAC, {}
    at = folder / f"{name}-{seed}"
    if dropped is not None:
        learner, options = sbx.TQC, {"top_quantiles_to_drop_per_net": dropped}
        at = folder / f"{name}-TQC-{seed}"
    at.mkdir(parents=True, exist_ok=True)
    env = gymnasium_env(name, disable_env_checker=True)
    state: dict[str, Any] = {"steps": 0, "best": -np.inf, "log": []}
    if (at / "state.json").exists():
        state = json.loads((at / "state.json").read_text())
        model = learner.load(at / "model.zip", env=env)
        model.load_replay_buffer(at / "buffer.pkl")
    else:
        model = learner(
            "MlpPolicy",
            env,
            seed=seed,
            buffer_size=steps,
            learning_starts=random,
            train_freq=TOGETHER,
            gradient_steps=TOGETHER,
            policy_kwargs={"net_arch": [UNITS] * 2},
            **options,
        )
    judge = gymnasium_env(name, disable_env_checker=True)
    while state["steps"] < steps:
        start = time.process_time()
        model.learn(every, reset_num_timesteps=False)
        state["steps"] = int(model.num_timesteps)
        tensors = actor(model.policy.actor_state.params)
        score = mean_return(judge, expert(tensors))
        seconds = time.process_time() - start
        state["log"].append([state["steps"], round(score, 1), round(seconds, 1)])
        print(name, state["steps"], f"{score:.0f}", f"{seconds:.0f} s", flush=True)
        found = {"env": name, "return": f"{score:.1f}", "steps": str(state["steps"])}
        save_file(tensors, at / f"{state['steps']}.safetensors", metadata=found)
        if score > state["best"]:
            state["best"] = score
            save_file(tensors, at / "expert.safetensors", metadata=found)
        if len(state["log"]) % 4 == 0 or state["steps"] >= steps:
            model.save(at / "model.zip")
            model.save_replay_buffer(at / "buffer.pkl")
            (at / "state.json").write_text(json.dumps(state))


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("env")
    parser.add_argument("--out", type=Path, default=Path("runs/sac"))
    parser.add_argument("--steps", type=int, default=400_000)
    parser.add_argument("--every", type=int, default=10_000)
    parser.add_argument("--random", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--algorithm", choices=("SAC", "TQC"), default="SAC")
    parser.add_argument("--dropped", type=int, default=2, help="quantiles that TQC leaves out")
    given = parser.parse_args()
    dropped = given.dropped if given.algorithm == "TQC" else None
    train(given.env, given.out, given.steps, given.every, given.random, given.seed, dropped)


if __name__ == "__main__":
    main()
