"""Passive trajectories of simulated robots: no control, one row per physics step."""

from __future__ import annotations

import importlib.metadata
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from tqdm import tqdm

from offbeat.data.robots import channels_of, load_model, robot_named
from offbeat.data.trajectory import Dataset, Trajectory
from offbeat.errors import DivergenceError, InputError, require

_ROWS_PER_CHUNK = 32_768  # about a quarter of a second: the progress bar moves, threads stay busy


def simulate(
    robot: str = "hopper",
    n_trajectories: int = 10_000,
    rows: int = 200,
    *,
    seed: int = 0,
    initial_states: ArrayLike | None = None,
    threads: int | None = None,
    progress: bool = True,
) -> Dataset:
    """Simulates a robot that falls, bounces and comes to rest under zero control.

    The first row of a trajectory is its initial state, and one row follows per physics step.
    The same arguments give the same bytes whatever `threads` is, and the first trajectories of a
    larger data set are those of a smaller one.

    Args:
        robot: name of the robot, one of `offbeat.data.robots.ROBOTS`.
        n_trajectories: how many to simulate; with `initial_states`, their number counts.
        rows: rows per trajectory, at least 2.
        seed: seed of the initial states, 0 to 2**32 - 1.
        initial_states: (n, nq + nv) positions, then velocities, instead of the robot's own draw.
        threads: how many to use; by default one per core that this process may run on.
        progress: show a progress bar on standard error.

    Returns:
        Trajectories with one channel per position and velocity; `meta` holds the robot, the seed
        (None with given states), the time step and the versions of what made the data.

    Raises:
        InputError: the robot is unknown, or an argument is out of bounds.
        MissingExtraError: mujoco or dm_control is not installed.
        DivergenceError: a simulation became unstable.
    """
    entry = robot_named(robot)
    n_trajectories = _at_least("n_trajectories", n_trajectories, 1)
    rows = _at_least("rows", rows, 2)
    threads = available_cores() if threads is None else _at_least("threads", threads, 1)
    random = _random_state(seed)
    model = load_model(robot)
    if initial_states is None:
        states = entry.draw(random, model, n_trajectories)
    else:
        states = _given_states(initial_states, model)
    values = _roll_out(robot, model, states, rows, threads, progress)
    names, units = channels_of(model)
    timestep = float(model.opt.timestep)
    times = np.arange(rows, dtype=np.float64) * timestep
    return Dataset(
        tuple(
            Trajectory(times, value, names=names, units=units, origin=f"{robot} {i}")
            for i, value in enumerate(values)
        ),
        meta={
            "robot": robot,
            "seed": None if initial_states is not None else int(seed),
            "timestep_s": timestep,
            "control": "zero",
            "versions": _versions(),
        },
    )


def available_cores() -> int:
    """Number of cores that this process may run on."""
    if sys.platform == "linux":  # where affinity and container limits hold
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _roll_out(
    robot: str,
    model: Any,
    states: NDArray[np.float64],
    rows: int,
    threads: int,
    progress: bool,
) -> NDArray[np.float64]:
    """Steps every initial state: (n, nq + nv) to (n, rows, nq + nv)."""
    mujoco = require("mujoco", "sim")
    rollout = require("mujoco.rollout", "sim")
    # An unstable state must stay to be seen, not be replaced by the model's default state.
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET.value
    data = [mujoco.MjData(model) for _ in range(threads)]
    full = np.zeros((len(states), mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_FULLPHYSICS)))
    # The full state is the time, the positions, the velocities, and internal variables at rest.
    mujoco.mj_getState(model, data[0], full[0], mujoco.mjtState.mjSTATE_FULLPHYSICS)
    full[1:] = full[0]
    width = states.shape[1]
    full[:, 1 : 1 + width] = states
    values = np.empty((len(states), rows, width))
    values[:, 0] = states
    chunk = max(threads, _ROWS_PER_CHUNK // rows)
    with (
        _collected_warnings(mujoco) as warnings,
        rollout.Rollout(nthread=threads if threads > 1 else 0) as pool,
        tqdm(
            total=len(states), desc=robot, unit=" trajectories", disable=None if progress else True
        ) as bar,
    ):
        for start in range(0, len(states), chunk):
            part = slice(start, min(start + chunk, len(states)))
            # After a warning the rollout repeats the row it came with. The one step too many makes
            # that show in the clock for warnings of the last row, too.
            stepped, _ = pool.rollout(model, data, full[part], nstep=rows)
            _check_stable(robot, stepped, start, warnings)
            values[part, 1:] = stepped[:, : rows - 1, 1 : 1 + width]
            bar.update(part.stop - part.start)
    return values


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


@contextmanager
def _collected_warnings(mujoco: Any) -> Iterator[list[str]]:
    """Collects MuJoCo's warnings, which else go to a log file in the working directory."""
    before = mujoco.get_mju_user_warning()
    warnings: list[str] = []
    mujoco.set_mju_user_warning(warnings.append)
    try:
        yield warnings
    finally:
        mujoco.set_mju_user_warning(before)


def _at_least(name: str, value: int, low: int) -> int:
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < low:
        raise InputError(f"{name} must be an integer of at least {low}, got {value!r}")
    return int(value)


def _random_state(seed: int) -> np.random.RandomState:
    if isinstance(seed, bool) or not isinstance(seed, int | np.integer) or not 0 <= seed < 2**32:
        raise InputError(f"seed must be an integer from 0 to {2**32 - 1}, got {seed!r}")
    # The legacy generator: its stream is frozen, and the protocol's draw is defined by it.
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
    from offbeat import __version__  # late: the package's front page imports this module

    packages = ("mujoco", "dm_control", "numpy")
    return {"offbeat": __version__} | {name: importlib.metadata.version(name) for name in packages}
