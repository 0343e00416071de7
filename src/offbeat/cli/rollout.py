"""`offbeat rollout`."""

from __future__ import annotations

from pathlib import Path

from offbeat.cli.common import say


def rollout_command(
    policy: Path,
    env: str,
    episodes: int = 20,
    drop: float = 0.0,
    sensor_drop: float = 0.0,
    bursts: float = 0.0,
    burst_s: list[float] | None = None,
    delay_s: float = 0.0,
    jitter_s: float = 0.0,
    steps: int | None = None,
    dt: float | None = None,
    seed: int = 0,
    json: bool = False,
) -> None:
    """Run a policy in an environment of Gymnasium, with frames and sensors missing.

    Args:
        policy: folder that offbeat clone wrote; its observations and actions must be those of the
            environment, in the same order.
        env: name of the environment, such as Pendulum-v1 or Hopper-v5.
        episodes: number of episodes, run side by side.
        drop: fraction of the frames that are lost.
        sensor_drop: fraction of the values of each channel that are missing besides.
        bursts: fraction of the time in outages.
        burst_s: shortest and longest outage in seconds; by default 0.1 and 0.5.
        delay_s: seconds from a measurement to its arrival.
        jitter_s: largest error of a time stamp, in seconds.
        steps: steps after which an episode ends; by default as the environment says.
        dt: seconds per step; by default as the environment says.
        seed: seed of the first episode; each further one adds 1.
        json: print every return as JSON.
    """
    from offbeat.policies import Policy, rollout

    found = rollout(
        Policy.load(policy),
        env,
        episodes,
        seed=seed,
        steps=steps,
        progress=True,
        drop=drop,
        sensor_drop=sensor_drop,
        bursts=bursts,
        burst_s=tuple(burst_s or (0.1, 0.5)),
        delay_s=delay_s,
        jitter_s=jitter_s,
        dt=dt,
    )
    result = {
        "environment": env,
        "returns": found.returns.tolist(),
        "steps": found.steps.tolist(),
        "observed": found.observed,
    }
    text = (
        f"{env}: return {found.returns.mean():.1f} on average over {episodes} episodes, "
        f"{found.returns.min():.1f} to {found.returns.max():.1f}; {found.steps.mean():.0f} steps, "
        f"{100 * found.observed:.0f} % of the values arrived"
    )
    say(result, text, json)
