"""Episodes of a policy in an environment, several at a time."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray

from offbeat.config import check_count, check_seed
from offbeat.data.robots import gymnasium_env
from offbeat.errors import InputError
from offbeat.policies.policy import Policy
from offbeat.progress import progress_bar

if TYPE_CHECKING:
    from offbeat.env import UnevenObservations

OTHER_STEP = 5.0
"""Factor between the steps of an environment and of demonstrations from which on one is warned."""


class Controller(Protocol):
    """What `rollout` needs of a controller; a `Policy` is one."""

    def reset(self, n: int | None = None) -> None:
        """Begins episodes of n robots."""

    def act(
        self,
        t: NDArray[np.float64],
        observation: NDArray[np.float64],
        mask: NDArray[np.bool_],
        *,
        now: NDArray[np.float64],
    ) -> NDArray[np.float64]:
        """(n, actions) from (n,) stamps, (n, observations) values and masks, and (n,) times."""


class HeldController:
    """A controller for complete observations, given the last value of every channel.

    Args:
        function: (n, observations) to (n, actions).
    """

    def __init__(self, function: Callable[[NDArray[np.float64]], NDArray[np.float64]]) -> None:
        self.function = function
        self._held: NDArray[np.float64] | None = None

    def reset(self, n: int | None = None) -> None:
        """Begins episodes of n robots."""
        self._held = None

    def act(
        self,
        t: NDArray[np.float64],
        observation: NDArray[np.float64],
        mask: NDArray[np.bool_],
        *,
        now: NDArray[np.float64],
    ) -> NDArray[np.float64]:
        """Actions on the last value of every channel, 0 before the first."""
        before = np.zeros_like(observation) if self._held is None else self._held
        self._held = np.where(mask, observation, before)
        return np.asarray(self.function(self._held), dtype=np.float64)


@dataclass(frozen=True, eq=False)
class Rollouts:
    """What a controller achieved.

    Attributes:
        returns: (episodes,) sum of the rewards.
        steps: (episodes,) number of steps.
        observed: fraction of the values that arrived.
    """

    returns: NDArray[np.float64]
    steps: NDArray[np.int64]
    observed: float

    def __repr__(self) -> str:
        mean, spread = self.returns.mean(), self.returns.std()
        return (
            f"Rollouts({len(self.returns)} episodes, return {mean:.1f} +- {spread:.1f}, "
            f"{self.steps.mean():.0f} steps, {100 * self.observed:.0f} % observed)"
        )


def rollout(
    controller: Controller,
    env: str | Callable[[], Any],
    episodes: int = 20,
    *,
    seed: int = 0,
    steps: int | None = None,
    progress: bool = False,
    **uneven: Any,
) -> Rollouts:
    """Runs a controller in an environment.

    All episodes run side by side, so that a policy is called once per step. Episode i is seeded
    with `seed + i`: controllers that are compared meet the same starts and the same losses.

    Args:
        controller: a policy, or a controller of any kind.
        env: name of an environment of Gymnasium, or a function that makes one.
        episodes: number of episodes.
        seed: of the first episode.
        steps: that an episode is cut off after; by default as the environment says.
        progress: show a progress bar.
        **uneven: what is lost and late, as of `offbeat.env.UnevenObservations`.

    Returns:
        Returns and lengths of the episodes.

    Raises:
        InputError: the actions of the environment are no `Box`, the controller has other
            observations or actions, or an argument is out of its range.
        MissingExtraError: gymnasium is not installed.
    """
    check_count("episodes", episodes)
    if steps is not None:
        check_count("steps", steps)
    check_seed(seed)
    envs = [uneven_env(env, **uneven) for _ in range(episodes)]
    space = action_space(envs[0])
    if isinstance(controller, Policy):
        _check_fits(controller, envs[0])
    controller.reset(episodes)
    seen = [one.reset(seed=seed + i)[0] for i, one in enumerate(envs)]
    running, arrived, asked = np.ones(episodes, dtype=bool), 0, 0
    returns, count = np.zeros(episodes), np.zeros(episodes, dtype=np.int64)
    with progress_bar(total=steps, desc="rollout", unit="step", show=progress) as bar:
        while running.any():
            rows = {
                k: np.stack([one[k] for one in seen]) for k in ("now", "time", "values", "mask")
            }
            mask = rows["mask"].astype(bool)
            arrived += int(mask[running].sum())
            asked += mask[running].size
            values = np.where(mask, rows["values"], np.nan).astype(np.float64)
            actions = controller.act(rows["time"][:, 0], values, mask, now=rows["now"][:, 0])
            if actions.shape != (episodes, *space.shape):
                raise InputError(
                    f"the controller gave actions of shape {actions.shape[1:]}, the environment "
                    f"takes {space.shape}"
                )
            actions = np.clip(actions, space.low, space.high).astype(space.dtype)
            for i in np.flatnonzero(running):
                seen[i], reward, ended, cut, _ = envs[i].step(actions[i])
                returns[i] += float(reward)
                count[i] += 1
                running[i] = not (ended or cut or count[i] == steps)
            for i in np.flatnonzero(~running):  # time goes on without observations
                seen[i] = _later(seen[i], envs[i].dt)
            bar.update()
    for one in envs:
        one.close()
    return Rollouts(returns, count, arrived / max(asked, 1))


def uneven_env(env: str | Callable[[], Any], **uneven: Any) -> UnevenObservations:
    """An environment whose observations are uneven.

    Args:
        env: name of an environment of Gymnasium, or a function that makes one.
        **uneven: what is lost and late, as of `offbeat.env.UnevenObservations`.

    Raises:
        InputError: Gymnasium knows no such environment.
        MissingExtraError: gymnasium, or what the environment needs, is not installed.
    """
    from offbeat.env import UnevenObservations

    made = gymnasium_env(env) if isinstance(env, str) else env()
    if isinstance(made, UnevenObservations):
        if uneven:
            raise InputError("the environment is uneven already; give what is lost once")
        return made
    return UnevenObservations(made, **uneven)


def action_space(env: Any) -> Any:
    """The actions of an environment.

    Args:
        env: of Gymnasium.

    Raises:
        InputError: they are no `Box` of one dimension.
    """
    from gymnasium.spaces import Box

    space = env.action_space
    if not isinstance(space, Box) or len(space.shape) != 1:
        raise InputError(f"actions must be a Box of one dimension, got {space}")
    return space


def _check_fits(policy: Policy, env: UnevenObservations) -> None:
    """Refuses an environment of other channels, and warns of one whose steps have another length.

    Args:
        policy: to be run.
        env: that it is run in.
    """
    from offbeat.env import name_of

    name = name_of(env)
    for what, own, there in (
        ("observations", policy.observations, env.observation_space["mask"].n),
        ("actions", policy.actions, env.action_space.shape[0]),
    ):
        if len(own) != there:
            raise InputError(
                f"{name} has {there} {what}, the policy has {len(own)} ({', '.join(own)}); give "
                "the environment of its demonstrations"
            )
    gap = policy.model.statistics.median_gap
    if not 1 / OTHER_STEP <= gap / env.dt <= OTHER_STEP:
        logging.getLogger("offbeat").warning(
            "a step of %s is %g s, and the rows of the demonstrations are %.3g s apart; read them "
            "with their rate (--reader.rate_hz %g) if that is not so",
            name,
            env.dt,
            gap,
            1 / env.dt,
        )


def _later(seen: dict[str, NDArray[Any]], dt: float) -> dict[str, NDArray[Any]]:
    now = seen["now"] + dt
    return {**seen, "now": now, "time": now, "mask": np.zeros_like(seen["mask"])}
