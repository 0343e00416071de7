"""`offbeat clone`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from offbeat.cli.common import read_log, say
from offbeat.errors import InputError, one_of


def clone_command(
    data: Path,
    out: Path,
    actions: list[str] | None = None,
    model: str = "anchored_ode_gru_d",
    low: list[float] | None = None,
    high: list[float] | None = None,
    drop: float = 0.9,
    sensor_drop: float = 0.0,
    bursts: float = 0.0,
    loss: str = "mse",
    epochs: int = 200,
    window: int = 50,
    starts: float = 0.1,
    learning_rate: float = 0.01,
    validation: float = 0.15,
    reader: dict[str, Any] | None = None,
    seed: int = 0,
    json: bool = False,
) -> None:
    """Clone a policy from demonstrations at uneven times, with frames and sensors missing.

    Args:
        data: the demonstrations, of any format that Offbeat reads; a trajectory each.
        out: folder of the policy; an existing one is replaced.
        actions: names of the channels that are actions, such as --actions torque; by default those
            that the file marks as such.
        model: name of a model, such as gru, gru_d, ode_rnn or anchored_ode_gru_d.
        low: lowest action per channel; by default the lowest of the demonstrations.
        high: highest action per channel.
        drop: fraction of the frames that are lost in training, at most; each window of each epoch
            has its own.
        sensor_drop: fraction of the values of each channel that are missing besides, at most.
        bursts: fraction of the time in outages of 0.1 to 0.5 s, at most.
        loss: loss of the actions, mse or nll.
        epochs: passes over the demonstrations.
        window: rows of each training window.
        starts: fraction of the windows that begin where a demonstration does, as a rollout does.
        learning_rate: learning rate at the start.
        validation: fraction of the demonstrations by which the best epoch is chosen; 0 keeps the
            last one.
        reader: options of reading the demonstrations.
        seed: seed of everything random.
        json: print the result as JSON.
    """
    from dataclasses import replace

    import numpy as np

    from offbeat.data.trajectory import ACTION, STATE, Dataset
    from offbeat.files import writable
    from offbeat.policies import CloneConfig, Drops, fit_policy

    if (low is None) != (high is None):
        raise InputError("low and high bound the actions together; give both, or neither")
    if not 0 <= validation < 1:
        raise InputError(
            f"validation must be a fraction of at least 0 and below 1, got {validation!r}"
        )
    config = CloneConfig(
        loss=loss,  # type: ignore[arg-type]  # it is checked there
        epochs=epochs,
        window=window,
        starts=starts,
        learning_rate=learning_rate,
        seed=seed,
    )
    drops = Drops(frames=drop, sensors=sensor_drop, bursts=bursts)
    writable(out, folder=True)
    if out.is_dir() and any(out.iterdir()) and not (out / "model.safetensors").is_file():
        raise InputError(f"{out} holds other files, and no policy; give another folder")
    dataset = read_log(data, reader)
    if actions is not None:
        for name in actions:
            one_of("channel", name, dataset.names)
        roles = tuple(ACTION if name in actions else STATE for name in dataset.names)
        dataset = Dataset(tuple(replace(t, roles=roles) for t in dataset), dataset.meta)
    elif ACTION not in dataset.roles:
        raise InputError(
            f"{data} does not say which of its channels are actions; name them, such as "
            f"--actions '[{dataset.names[-1]}]', of: {', '.join(dataset.names)}"
        )
    order = np.random.default_rng(seed).permutation(len(dataset))
    held = min(round(validation * len(dataset)), len(dataset) - 1)
    policy = fit_policy(
        dataset.take(order[held:]),
        model,
        validation=dataset.take(order[:held]) if held else None,
        bounds=None if low is None or high is None else (low, high),
        drops=drops,
        config=config,
    )
    policy.save(out)
    best = min((r.validation for r in policy.log), default=float("nan"))
    result = {
        "written": str(out),
        "model": policy.model.name,
        "observations": list(policy.observations),
        "actions": list(policy.actions),
        "demonstrations": len(dataset) - held,
        "validation_mse": best if held else None,
    }
    text = f"{out}: {policy!r}, cloned from {len(dataset) - held} demonstrations"
    if held:
        text += (
            f"; RMSE of its actions on {held} others with as much lost: {best**0.5:.3f} of half "
            "their range"
        )
    say(result, text, json)
