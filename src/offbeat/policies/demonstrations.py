"""Demonstrations of an expert in an environment."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from offbeat.config import check_count, check_seed
from offbeat.data.arrays import hand_over
from offbeat.data.trajectory import ACTION, STATE, Dataset, Trajectory
from offbeat.errors import InputError
from offbeat.policies.rollouts import action_space, uneven_env

Expert = Callable[[NDArray[np.float64]], NDArray[np.float64]]
"""Maps (observations,) to (actions,), or (n, observations) to (n, actions)."""


def demonstrate(
    expert: Expert,
    env: str | Callable[[], Any],
    episodes: int = 50,
    *,
    seed: int = 0,
    noise: float = 0.0,
    random_actions: float = 0.0,
    names: Sequence[str] | None = None,
    **uneven: Any,
) -> Dataset:
    """Records an expert, which sees everything, as trajectories of observations and actions.

    Args:
        expert: (observations,) to (actions,).
        env: name of an environment of Gymnasium, or a function that makes one.
        episodes: number of episodes, a trajectory each.
        seed: of the first episode; that of episode i is `seed + i`.
        noise: standard deviation of what is added to the actions that are executed, as a fraction
            of half the range of each. What is recorded is what the expert would have done, also
            from states that it does not reach by itself (Laskey et al. 2017).
        random_actions: fraction of the actions that are replaced by random ones, which are
            recorded.
        names: of the observed channels; by default `observation_0`, ...
        **uneven: what is lost, as of `offbeat.env.UnevenObservations`: values that did not arrive
            are known, and not observed. Nothing can be late.

    Returns:
        A trajectory per episode, a row per step; `meta` holds the name of the environment, the seed
        and the mean return.

    Raises:
        InputError: an argument is out of its range, or the actions of the environment are no `Box`.
        MissingExtraError: gymnasium is not installed.
    """
    check_seed(seed)
    check_count("episodes", episodes)
    if not 0 <= noise < math.inf:
        raise InputError(f"noise must be a number of at least 0, got {noise!r}")
    if not 0 <= random_actions <= 1:
        raise InputError(f"random_actions must be a fraction of 0 to 1, got {random_actions!r}")
    if uneven.get("delay_s") or uneven.get("jitter_s"):
        raise InputError("a demonstration is recorded in time; leave delay_s and jitter_s out")
    made = uneven_env(env, **uneven)
    space = action_space(made)
    half = (space.high - space.low) / 2
    trajectories, returns = [], []
    for i in range(episodes):
        random = np.random.default_rng([seed + i, 1])
        observation, info = made.reset(seed=seed + i)
        rows: list[tuple[Any, ...]] = []
        total, over = 0.0, False
        while not over:
            true = info["observation"].astype(np.float64)
            action = np.clip(np.asarray(expert(true), dtype=np.float64), space.low, space.high)
            if random.random() < random_actions:
                action = random.uniform(space.low, space.high)
            executed = action + noise * half * random.standard_normal(len(action))
            mask = np.concatenate([observation["mask"].astype(bool), np.ones(len(action), bool)])
            rows.append((observation["now"][0], np.concatenate([true, action]), mask))
            executed = np.clip(executed, space.low, space.high).astype(space.dtype)
            observation, reward, ended, cut, info = made.step(executed)
            total += float(reward)
            over = ended or cut
        times, values, masks = (hand_over(np.array(part)) for part in zip(*rows, strict=True))
        seen = values.shape[1] - len(half)
        given = tuple(names or (f"observation_{k}" for k in range(seen)))
        trajectories.append(
            Trajectory(
                times,
                values,
                observed=masks,
                names=(*given, *(f"action_{k}" for k in range(len(half)))),
                roles=(STATE,) * seen + (ACTION,) * len(half),
                origin=f"demonstration {i}",
            )
        )
        returns.append(total)
    made.close()
    name = env if isinstance(env, str) else str(made.unwrapped)
    meta = {"environment": name, "seed": seed, "mean_return": float(np.mean(returns))}
    return Dataset(tuple(trajectories), meta)
