"""The log of a simulated arm, whose true motion is known.

An arm of six joints picks objects up and puts them down. Joints (position, velocity, effort)
report at 100 Hz, the wrist's inertial unit at 200 Hz, the gripper at 20 Hz, each at stamps of its
own. Each sensor drops out for 5 % of the time, and for 4 s nothing is written at all. A cell is
empty where its sensor does not report.

The motion is a chain of minimum-jerk movements between random postures (Flash and Hogan 1985, The
Journal of Neuroscience 5(7)) with pauses in which the gripper closes on an object or opens.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from offbeat.config import check_seed
from offbeat.data.drops import check_fraction, check_seconds
from offbeat.data.trajectory import Trajectory
from offbeat.errors import InputError
from offbeat.files import write_text

Array = NDArray[np.float64]

JOINTS, IMU, GRIPPER = "joints", "imu", "gripper"
RATES_HZ = {JOINTS: 100.0, IMU: 200.0, GRIPPER: 20.0}
CHANNELS = {
    JOINTS: tuple(
        f"joint_{i}_{what} [{unit}]"
        for what, unit in (("position", "rad"), ("velocity", "rad/s"), ("effort", "N m"))
        for i in range(1, 7)
    ),
    IMU: tuple(f"gyro_{axis} [rad/s]" for axis in "xyz")
    + tuple(f"acceleration_{axis} [m/s^2]" for axis in "xyz"),
    GRIPPER: ("gripper_position [m]", "gripper_force [N]"),
}
NOISE = {
    JOINTS: np.repeat([2e-4, 5e-3, 0.15], 6),
    IMU: np.repeat([0.01, 0.08], 3),
    GRIPPER: np.array([2e-4, 0.2]),
}
"""Standard deviation of the measurement noise of each channel, in its unit."""

STEP_S = 0.001
GRAVITY = 9.81
OPEN_M = 0.08
# Lengths and twists of the links (Denavit and Hartenberg), m and rad, of an arm of 0.9 m.
LINK_A = (0.0, -0.425, -0.392, 0.0, 0.0, 0.0)
LINK_D = (0.089, 0.0, 0.0, 0.109, 0.095, 0.082)
LINK_TWIST = (np.pi / 2, 0.0, 0.0, np.pi / 2, -np.pi / 2, 0.0)
# Inertia kg m^2, viscous N m s, Coulomb friction N m, and the pull of gravity N m of each joint.
INERTIA = np.array([2.5, 2.2, 1.1, 0.2, 0.15, 0.05])
VISCOUS = np.array([4.0, 4.0, 2.5, 0.8, 0.8, 0.5])
COULOMB = np.array([3.0, 3.0, 2.0, 0.6, 0.6, 0.4])
LOW = np.array([-1.8, -2.0, 0.6, -1.8, -1.9, -1.5])
HIGH = np.array([1.8, -0.9, 1.9, -0.4, -1.2, 1.5])


@dataclass(frozen=True, eq=False)
class Motion:
    """A motion on a grid of `STEP_S`.

    Attributes:
        times: (n,) s.
        position: (n, 6) rad; `velocity` rad/s and `acceleration` rad/s^2 are its derivatives.
        velocity: (n, 6) rad/s.
        acceleration: (n, 6) rad/s^2.
        opening: (n,) m, between the fingers.
        force: (n,) N, of the fingers on an object.
        payload: (n,) kg, of what is held.
    """

    times: Array
    position: Array
    velocity: Array
    acceleration: Array
    opening: Array
    force: Array
    payload: Array


def minimum_jerk(start: Array, end: Array, samples: int) -> tuple[Array, Array, Array]:
    """Position, velocity and acceleration from rest at `start` to rest at `end`.

    With s = t / T, x = x0 + (x1 - x0) (10 s^3 - 15 s^4 + 6 s^5).

    Args:
        start: (joints,) rad.
        end: (joints,) rad.
        samples: rows, `STEP_S` apart; the last one is a step before the end.

    Returns:
        Three arrays (samples, joints).
    """
    s = (np.arange(samples) / samples)[:, None]
    duration = samples * STEP_S
    way = end - start
    return (
        start + way * s**3 * (10 - 15 * s + 6 * s**2),
        way / duration * 30 * s**2 * (1 - s) ** 2,
        way / duration**2 * 60 * s * (1 - s) * (1 - 2 * s),
    )


def motion(seconds: float, seed: int) -> Motion:
    """A pick-and-place motion.

    Args:
        seconds: length.
        seed: of postures, speeds, pauses and objects.
    """
    random = np.random.default_rng(seed)
    needed = round(seconds / STEP_S)
    joints: list[tuple[Array, Array, Array]] = []
    fingers: list[tuple[Array, Array]] = []
    payload: list[Array] = []
    made, posture = 0, random.uniform(LOW, HIGH)
    opening, pressing, mass = OPEN_M, 0.0, 0.0

    def add(target: Array, samples: int, width: float, push: float) -> None:
        nonlocal made, posture, opening, pressing
        joints.append(minimum_jerk(posture, target, samples))
        fingers.append(_grip(opening, width, pressing, push, samples))
        payload.append(np.full(samples, mass))
        made, posture, opening, pressing = made + samples, target, width, push

    while made < needed:
        object_m, object_kg = random.uniform(0.015, 0.06), random.uniform(0.1, 1.5)
        for picks_up in (True, False):  # else it puts down
            above = random.uniform(LOW, HIGH)
            down = above + np.array([0.0, 0.25, -0.15, -0.1, 0.0, 0.0]) * random.uniform(0.6, 1.2)
            for target in (above, down):
                speed = random.uniform(0.5, 1.1)
                duration = np.clip(np.abs(target - posture).max() / speed, 0.4, 3.0)
                add(target, round(duration / STEP_S), opening, pressing)
            width, push = (object_m, random.uniform(8, 25)) if picks_up else (OPEN_M, 0.0)
            add(posture, round(random.uniform(0.4, 0.9) / STEP_S), width, push)
            mass = object_kg if picks_up else 0.0
            add(above, round(random.uniform(0.4, 0.7) / STEP_S), opening, pressing)
        if random.random() < 0.3:
            add(posture, round(random.uniform(0.5, 3.0) / STEP_S), opening, pressing)
    position, velocity, acceleration = (
        np.concatenate(part)[:needed] for part in zip(*joints, strict=True)
    )
    between, force = (np.concatenate(part)[:needed] for part in zip(*fingers, strict=True))
    times = (np.arange(needed) * STEP_S).astype(np.float64)
    held = np.concatenate(payload)[:needed]
    return Motion(times, position, velocity, acceleration, between, force, held)


def _grip(
    opening: float, width: float, pressing: float, push: float, samples: int
) -> tuple[Array, Array]:
    """Opening and force of the fingers: at 0.15 m/s to the width, then force builds up."""
    t = np.arange(samples) * STEP_S
    contact = abs(width - opening) / 0.15
    moved = np.clip(t / max(contact, STEP_S), 0, 1)
    if push >= pressing:  # closes, the force grows after contact
        force = pressing + (push - pressing) * -np.expm1(-np.maximum(t - contact, 0) / 0.03)
    else:  # opens, the force is gone first
        force = push + (pressing - push) * np.exp(-t / 0.02)
    return opening + (width - opening) * moved, force


def wrist(position: Array) -> tuple[Array, Array]:
    """Place and attitude of the wrist, by forward kinematics.

    Args:
        position: (n, 6) rad.

    Returns:
        (n, 3) m and (n, 3, 3), the axes of the wrist as columns, both in the base's frame.
    """
    place = np.zeros((len(position), 3))
    attitude = np.broadcast_to(np.eye(3), (len(position), 3, 3))
    for angle, a, d, twist in zip(position.T, LINK_A, LINK_D, LINK_TWIST, strict=True):
        c, s, ct, st = np.cos(angle), np.sin(angle), np.cos(twist), np.sin(twist)
        offset = np.stack([a * c, a * s, np.full_like(c, d)], axis=1)
        turn = np.stack(
            [
                np.stack([c, -s * ct, s * st], axis=1),
                np.stack([s, c * ct, -c * st], axis=1),
                np.stack([np.zeros_like(c), np.full_like(c, st), np.full_like(c, ct)], axis=1),
            ],
            axis=1,
        )
        place = place + np.einsum("nij,nj->ni", attitude, offset)
        attitude = attitude @ turn
    return place, attitude


def sensed(moved: Motion) -> dict[str, Array]:
    """What each sensor would report without noise, on the grid of the motion.

    Args:
        moved: the motion.

    Returns:
        (n, channels of the sensor) by sensor, in the order of `CHANNELS`.
    """
    q, v = moved.position, moved.velocity
    shoulder, elbow = np.sin(q[:, 1]), np.sin(q[:, 1] + q[:, 2])
    pull = np.zeros_like(q)
    pull[:, 1] = (35 + 6 * moved.payload) * shoulder + (14 + 4 * moved.payload) * elbow
    pull[:, 2] = (14 + 4 * moved.payload) * elbow
    pull[:, 3] = (1.5 + 0.9 * moved.payload) * np.sin(q[:, 1:4].sum(axis=1))
    inertia = INERTIA * (1 + 0.1 * moved.payload[:, None])
    effort = inertia * moved.acceleration + VISCOUS * v + COULOMB * np.tanh(v / 0.02) + pull
    place, attitude = wrist(q)
    change = np.einsum("nji,njk->nik", attitude, np.gradient(attitude, STEP_S, axis=0))
    turning = np.stack([change[:, 2, 1], change[:, 0, 2], change[:, 1, 0]], axis=1)
    felt = np.gradient(np.gradient(place, STEP_S, axis=0), STEP_S, axis=0)
    felt = np.einsum("nji,nj->ni", attitude, felt + np.array([0.0, 0.0, GRAVITY]))
    return {
        JOINTS: np.concatenate([q, v, effort], axis=1),
        IMU: np.concatenate([turning, felt], axis=1),
        GRIPPER: np.stack([moved.opening, moved.force], axis=1),
    }


@dataclass(frozen=True, eq=False)
class Recording:
    """What one sensor reports, and when it is silent.

    Attributes:
        times: (rows,) s, stamps, those of its silence included.
        values: (rows, channels), with noise.
        silent: (rows,) bool, where nothing is written.
    """

    times: Array
    values: Array
    silent: NDArray[np.bool_]


def measured(
    seconds: float = 240.0,
    *,
    seed: int = 0,
    dropout_fraction: float = 0.05,
    outage_s: float = 4.0,
) -> dict[str, Recording]:
    """What each sensor measures, its dropouts included.

    Args:
        seconds: length.
        seed: of the motion, stamps, noise and dropouts.
        dropout_fraction: of the time, in which a sensor is silent for 0.05 to 1 s at a time.
        outage_s: in which nothing reports, between 30 and 50 % of the log; 0 for none.

    Returns:
        By sensor.

    Raises:
        InputError: the log is shorter than 1 s, or an argument is out of its range.
    """
    if not 1 <= seconds < math.inf:
        raise InputError(f"seconds must be a length of at least 1 s, got {seconds!r}")
    check_seed(seed)
    check_fraction("dropout_fraction", dropout_fraction)
    check_seconds("outage_s", outage_s)
    moved = motion(seconds, seed)
    random = np.random.default_rng([seed, 1])
    outage = random.uniform(0.3, 0.5) * seconds
    found = {}
    for sensor, clean in sensed(moved).items():
        rate = RATES_HZ[sensor]
        t = np.arange(round(seconds * rate) - 2) / rate + random.uniform(0, 1 / rate)
        t = t + np.clip(random.normal(0, 2e-4, len(t)), -6e-4, 6e-4) + 6e-4
        noisy = np.stack([np.interp(t, moved.times, column) for column in clean.T], axis=1)
        noisy += NOISE[sensor] * random.normal(size=noisy.shape)
        silent = (t >= outage) & (t < outage + outage_s)
        left = dropout_fraction * seconds
        while left > 0:
            length = min(np.exp(random.uniform(np.log(0.05), np.log(1.0))), left)
            start = random.uniform(0, seconds - length)
            silent |= (t >= start) & (t < start + length)
            left -= length
        found[sensor] = Recording(np.round(t, 6), noisy, silent)
    return found


def recorded(seconds: float = 240.0, **options: Any) -> tuple[Array, dict[str, Array]]:
    """The log: rows at the union of all stamps.

    Args:
        seconds: length.
        options: as of `measured`.

    Returns:
        (rows,) s and (rows, channels) per sensor, NaN where it does not report.

    Raises:
        InputError: as `measured`.
    """
    found = measured(seconds, **options)
    times = np.unique(np.concatenate([each.times[~each.silent] for each in found.values()]))
    table = {}
    for sensor, each in found.items():
        table[sensor] = np.full((len(times), len(CHANNELS[sensor])), np.nan)
        at = np.searchsorted(times, each.times[~each.silent])
        table[sensor][at] = each.values[~each.silent]
    return times, table


def with_hidden_values(seconds: float = 240.0, **options: Any) -> Trajectory:
    """The log with what the sensors would have reported in their dropouts: known, not observed.

    Args:
        seconds: length.
        options: as of `measured`.

    Returns:
        26 channels in their units; hidden values are finite, and not observed.

    Raises:
        InputError: as `measured`.
    """
    found = measured(seconds, **options)
    times = np.unique(np.concatenate([each.times for each in found.values()]))
    names = [name for sensor in found for name in CHANNELS[sensor]]
    values = np.full((len(times), len(names)), np.nan)
    observed = np.zeros(values.shape, dtype=bool)
    first = 0
    for each in found.values():
        rows, last = np.searchsorted(times, each.times), first + each.values.shape[1]
        values[rows, first:last] = each.values
        observed[rows, first:last] = ~each.silent[:, None]
        first = last
    return Trajectory(
        times,
        values,
        observed=observed,
        names=tuple(name.partition(" [")[0] for name in names),
        units=tuple(name.partition(" [")[2].rstrip("]") for name in names),
        origin="arm_new.csv",
    )


def write(
    path: str | Path, seconds: float = 240.0, *, seed: int = 0, outage_s: float = 4.0
) -> None:
    """Writes the log as CSV: `time [s]` and a column per channel, empty where there is no value.

    Args:
        path: to write.
        seconds: length of the log.
        seed: as of `recorded`.
        outage_s: as of `recorded`.

    Raises:
        InputError: as `measured`.
    """
    times, table = recorded(seconds, seed=seed, outage_s=outage_s)
    header = ["time [s]", *(name for sensor in table for name in CHANNELS[sensor])]
    lines = [",".join(header)]
    for time, row in zip(times, np.concatenate(list(table.values()), axis=1), strict=True):
        cells = ("" if value != value else f"{value:.7g}" for value in row)
        lines.append(f"{time:.6f},{','.join(cells)}")
    write_text(Path(path), "\n".join([*lines, ""]))
