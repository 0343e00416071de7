"""Trajectories of simulated robots: one row per physics step."""

from __future__ import annotations

import importlib.metadata
import os
import sys
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from offbeat.data.arrays import hand_over
from offbeat.data.robots import (
    Control,
    Robot,
    channels_of,
    collected_warnings,
    controls_of,
    load_model,
    quaternions_of,
    robot_of,
    sensors_of,
)
from offbeat.data.trajectory import Dataset, Trajectory
from offbeat.data.transforms import META_KEY, Transforms
from offbeat.errors import DivergenceError, InputError, require
from offbeat.progress import progress_bar

_ROWS_PER_CHUNK = 32_768  # about 0.25 s: updates the progress bar, and keeps threads busy


def simulate(
    robot: str | Path | Robot = "hopper",
    n_trajectories: int = 10_000,
    rows: int = 200,
    *,
    controls: Control | ArrayLike | Any | None = None,
    seed: int = 0,
    initial_states: ArrayLike | None = None,
    sensors: Sequence[str] = (),
    threads: int | None = None,
    progress: bool = True,
) -> Dataset:
    """Simulates trajectories of a robot, without controls by default.

    The first row of a trajectory is its initial state, and one row follows per physics step. With
    controls, each row also has those applied from it to the next row, as channels with the role
    `action`. The same arguments give the same bytes for any `threads`, and the first
    trajectories of a larger data set are those of a smaller one.

    Args:
        robot: name of the robot, one of `offbeat.data.robots.ROBOTS`, or of an environment of
            Gymnasium that runs in MuJoCo, such as `Hopper-v5`; an MJCF file; or a `Robot`.
        n_trajectories: number of trajectories; ignored with `initial_states`.
        rows: rows per trajectory, at least 2.
        controls: a function of the time (s) and the (nq + nv,) positions and velocities that gives
            (nu,) controls, or recorded ones, (rows, nu) for all trajectories or
            (n, rows, nu); by default those of the robot, or none. A function is called in one
            thread. A `Policy` of these positions and velocities is reset for every trajectory.
        seed: seed of the initial states, 0 to 2**32 - 1.
        initial_states: (n, nq + nv) positions, then velocities, instead of the robot's own draw.
        sensors: names of sensors and contacts of the model, such as `left_hand_touch`, which
            become further channels.
        threads: number of threads; by default one per available core.
        progress: show a progress bar on standard error.

    Returns:
        Trajectories with one channel per position and velocity, quaternions with the transform of
        quaternions, then one per component of each sensor; `meta` holds the robot, the seed
        (None with given states), the time step and the versions of the software.

    Raises:
        InputError: the robot is unknown, or an argument is out of bounds.
        FileFormatError: the MJCF file is missing or cannot be compiled.
        MissingExtraError: mujoco is not installed.
        DivergenceError: a simulation became unstable.
    """
    entry = robot_of(robot)
    n_trajectories = _at_least("n_trajectories", n_trajectories, 1)
    rows = _at_least("rows", rows, 2)
    threads = available_cores() if threads is None else _at_least("threads", threads, 1)
    random = _random_state(seed)
    model = load_model(entry)
    if initial_states is None:
        states = entry.initial_states(random, model, n_trajectories)
    else:
        states = _given_states(initial_states, model)
    given = controls if controls is not None else entry.control
    names, units = channels_of(model)
    sensed, sensor_names, sensor_units = sensors_of(model, sensors)
    names, units = (*names, *sensor_names), (*units, *sensor_units)
    if callable(given) or hasattr(given, "act"):
        kind = "function" if callable(given) else "policy"
        values, acted = _step(entry.name, model, states, rows, given, progress, sensed)
    elif given is not None:
        kind = "recorded"
        acted = _recorded(given, (len(states), rows, model.nu))
        values = _roll_out(entry.name, model, states, rows, threads, progress, acted, sensed)
    else:
        kind = "zero"
        values = _roll_out(entry.name, model, states, rows, threads, progress, None, sensed)
    roles = ("state",) * len(names)
    if given is not None:
        values = np.concatenate([values, acted], axis=2)
        names, units = (*names, *controls_of(model)), (*units, *[""] * model.nu)
        roles = (*roles, *["action"] * model.nu)
    fours = quaternions_of(model)
    timestep = float(model.opt.timestep)
    times = hand_over(np.arange(rows, dtype=np.float64) * timestep)
    hand_over(values)
    return Dataset(
        tuple(
            Trajectory(
                times, value, names=names, units=units, roles=roles, origin=f"{entry.name} {i}"
            )
            for i, value in enumerate(values)
        ),
        meta={
            "robot": entry.name,
            "seed": None if initial_states is not None else int(seed),
            "timestep_s": timestep,
            "control": kind,
            "versions": _versions(),
            **({META_KEY: Transforms(quaternions=fours).to_dict()} if fours else {}),
        },
    )


def available_cores() -> int:
    """Number of cores that this process may run on."""
    if sys.platform == "linux":  # affinity and container limits apply
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _roll_out(
    robot: str,
    model: Any,
    states: NDArray[np.float64],
    rows: int,
    threads: int,
    progress: bool,
    controls: NDArray[np.float64] | None = None,
    sensed: Sequence[int] = (),
) -> NDArray[np.float64]:
    """Steps every initial state: (n, nq + nv), with (n, rows, nu), to (n, rows, nq + nv + sensed).

    A step computes the sensors of the state that it begins with.
    """
    mujoco = require("mujoco", "sim")
    rollout = require("mujoco.rollout", "sim")
    _keep_unstable_states(mujoco, model)
    data = [mujoco.MjData(model) for _ in range(threads)]
    full = np.zeros((len(states), mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_FULLPHYSICS)))
    # The full state is the time, the positions, the velocities, and internal variables at rest.
    mujoco.mj_getState(model, data[0], full[0], mujoco.mjtState.mjSTATE_FULLPHYSICS)
    full[1:] = full[0]
    width = states.shape[1]
    full[:, 1 : 1 + width] = states
    values = np.empty((len(states), rows, width + len(sensed)))
    values[:, 0, :width] = states
    chunk = max(threads, _ROWS_PER_CHUNK // rows)
    with (
        collected_warnings(mujoco) as warnings,
        rollout.Rollout(nthread=threads if threads > 1 else 0) as pool,
        progress_bar(total=len(states), desc=robot, unit=" trajectories", show=progress) as bar,
    ):
        for start in range(0, len(states), chunk):
            part = slice(start, min(start + chunk, len(states)))
            # After a warning the rollout repeats that row. One more step than needed makes this
            # visible in the clock for warnings of the last row as well.
            acted = None if controls is None else controls[part]
            stepped, measured = pool.rollout(model, data, full[part], acted, nstep=rows)
            _check_stable(robot, stepped, start, warnings)
            values[part, 1:, :width] = stepped[:, : rows - 1, 1 : 1 + width]
            if len(sensed):
                values[part, :, width:] = measured[:, :, list(sensed)]
            bar.update(part.stop - part.start)
    return values


def _step(
    robot: str,
    model: Any,
    states: NDArray[np.float64],
    rows: int,
    control: Any,
    progress: bool,
    sensed: Sequence[int],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """As `_roll_out`, with the controls of a function, which are returned, too."""
    mujoco = require("mujoco", "sim")
    _keep_unstable_states(mujoco, model)
    width = states.shape[1]
    values = np.empty((len(states), rows, width + len(sensed)))
    acted = np.empty((len(states), rows, model.nu))
    stepped = np.empty((1, rows, 1 + width))
    with collected_warnings(mujoco) as warnings:
        rows_of = range(len(states))
        for i in progress_bar(rows_of, desc=robot, unit=" trajectories", show=progress):
            data = mujoco.MjData(model)
            data.qpos[:], data.qvel[:] = states[i, : model.nq], states[i, model.nq :]
            values[i, 0, :width] = states[i]
            stepped[:] = np.nan
            if not callable(control):
                control.reset()
            act = control if callable(control) else control.act
            for row in range(rows):
                given = np.asarray(act(data.time, values[i, row, :width].copy()), dtype=np.float64)
                if given.shape != (model.nu,) or not np.isfinite(given).all():
                    raise InputError(
                        f"controls of {robot!r} must be {model.nu} finite numbers, got "
                        f"{given.tolist()} for trajectory {i}, row {row}"
                    )
                acted[i, row] = data.ctrl[:] = given
                mujoco.mj_step(model, data)
                values[i, row, width:] = data.sensordata[list(sensed)]
                if np.any(data.warning.number):
                    break
                stepped[0, row] = np.concatenate([[data.time], data.qpos, data.qvel])
                if row + 1 < rows:
                    values[i, row + 1, :width] = stepped[0, row, 1:]
            _check_stable(robot, stepped, i, warnings)
    return values, acted


def _keep_unstable_states(mujoco: Any, model: Any) -> None:
    """Disables the reset of an unstable state to the model's default state."""
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET.value


def _recorded(controls: Any, shape: tuple[int, int, int]) -> NDArray[np.float64]:
    """(n, rows, nu) recorded controls, checked."""
    try:
        given = np.asarray(controls, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(f"controls must be a function or numbers: {error}") from None
    if given.shape not in (shape, shape[1:]):
        raise InputError(
            f"controls must have the shape {shape} (trajectories, rows, controls), or {shape[1:]} "
            f"for all trajectories, got {given.shape}"
        )
    if not np.isfinite(given).all():
        raise InputError("controls must be finite")
    return np.broadcast_to(given, shape).copy()


def _check_stable(
    robot: str, stepped: NDArray[np.float64], start: int, warnings: list[str]
) -> None:
    stuck = np.diff(stepped[:, :, 0], axis=1) <= 0
    bad = stuck | ~np.isfinite(stepped[:, :-1]).all(axis=2)
    if bad.any():
        which, row = (int(i) for i in np.argwhere(bad)[0])
        reason = f" (MuJoCo: {warnings[0]})" if warnings else ""
        raise DivergenceError(
            f"the simulation of {robot!r} became unstable in trajectory {start + which} at row "
            f"{row + 1}{reason}; start it from smaller velocities, or from positions inside the "
            "joint ranges"
        )


def _at_least(name: str, value: int, low: int) -> int:
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < low:
        raise InputError(f"{name} must be an integer of at least {low}, got {value!r}")
    return int(value)


def _random_state(seed: int) -> np.random.RandomState:
    if isinstance(seed, bool) or not isinstance(seed, int | np.integer) or not 0 <= seed < 2**32:
        raise InputError(f"seed must be an integer from 0 to {2**32 - 1}, got {seed!r}")
    # The legacy generator, whose numbers never change: the draw of the thesis is defined by it.
    return np.random.RandomState(int(seed))


def _given_states(initial_states: ArrayLike, model: Any) -> NDArray[np.float64]:
    try:
        states = np.array(initial_states, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(f"initial_states must be numbers: {error}") from None
    width = model.nq + model.nv
    if states.ndim != 2 or states.shape[1] != width or len(states) == 0:
        raise InputError(
            f"initial_states must have shape (n, {width}), {model.nq} positions and then "
            f"{model.nv} velocities, got shape {states.shape}"
        )
    if not np.isfinite(states).all():
        row, column = np.argwhere(~np.isfinite(states))[0]
        raise InputError(
            f"initial_states must be finite, got {states[row, column]} for state {row} in "
            f"channel {channels_of(model)[0][column]!r}"
        )
    return states


def _versions() -> dict[str, str]:
    from offbeat import __version__  # the package imports this module

    versions = {"offbeat": __version__}
    for name in ("mujoco", "numpy"):
        with suppress(importlib.metadata.PackageNotFoundError):
            versions[name] = importlib.metadata.version(name)
    return versions
