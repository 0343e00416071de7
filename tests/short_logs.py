"""Synthetic short logs as users of a robot have them, and what the robot does next.

`SHORT_LOGS[name](seed)` is a log of 8 to 60 s, to fit to, and another minute or two of the same
robot, to score. The lengths, the sizes and the times of motions differ between seeds. In some, what
comes next is like the log (`hover`, `gait`, `filtered_noise`), in some it has the same kind of
motion but no motion that was seen (`arm`, `takeoff`, `slow_sensors`), and in some it is another
motion (`faster`, `two_regimes`, `one_manoeuvre`).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from odd_logs import at, log, merged
from scipy.signal import butter, sosfilt

import offbeat as ob

Values = NDArray[np.float64]
Random = np.random.Generator
Pair = tuple[ob.Dataset, ob.Dataset]

AFTER_S, PIECES = 90.0, 6
"""s, length of what comes next, and trajectories that it is cut into."""


def split(times: Values, values: Values, seconds: float, names: tuple[str, ...] = ()) -> Pair:
    """The log up to a time, and what comes after it, in pieces."""
    before = times < seconds
    after = np.array_split(np.flatnonzero(~before), PIECES)
    pieces = [log(times[rows] - times[rows[0]], values[rows], names)[0] for rows in after]
    return log(times[before], values[before], names), ob.Dataset(tuple(pieces))


def noise(random: Random, times: Values, cutoff_hz: float, channels: int, order: int = 2) -> Values:
    """(rows, channels) white noise behind a low-pass filter, of standard deviation 1."""
    rate = 1 / float(np.median(np.diff(times)))
    sections = butter(order, cutoff_hz, fs=rate, output="sos")
    ahead = int(3 * rate / cutoff_hz)
    found = sosfilt(sections, random.normal(size=(len(times) + ahead, channels)), axis=0)[ahead:]
    return np.asarray(found * np.sqrt(rate / (2 * cutoff_hz)))


def integral(rates: Values, times: Values) -> Values:
    steps = np.diff(times, prepend=times[0])[:, None]
    return np.cumsum(rates * steps, axis=0)


def manoeuvres(
    random: Random, times: Values, rest_s: tuple[float, float], move_s: tuple[float, float]
) -> Values:
    """(rows,) from 0 at rest to 1 in motion, with smooth ends."""
    active = np.zeros(len(times))
    now = random.uniform(*rest_s)
    while now < times[-1]:
        length = random.uniform(*move_s)
        inside = (times >= now) & (times < now + length)
        active[inside] = np.minimum(1.0, 4 * np.sin(np.pi * (times[inside] - now) / length))
        now += length + random.uniform(*rest_s)
    return active


def minimum_jerk(
    random: Random, times: Values, channels: int, move_s: tuple[float, float], rest: float
) -> Values:
    """(rows, channels) from one random pose to the next, with rests between."""
    pose, values, now = random.uniform(-1, 1, channels), np.empty((len(times), channels)), 0.0
    while now <= times[-1]:
        target, length = random.uniform(-1, 1, channels), random.uniform(*move_s)
        part = np.clip((times - now) / length, 0, 1)[:, None]
        values[times >= now] = (pose + (target - pose) * part**3 * (10 - 15 * part + 6 * part**2))[
            times >= now
        ]
        pose, now = target, now + length + random.exponential(rest)
    return values


def takeoff(seed: int) -> Pair:
    """A drone at rest that moves for some seconds, twice or so: gyro, attitude, height."""
    random = np.random.default_rng([1, seed])
    seconds = random.uniform(20, 40)
    times = at(50, seconds + AFTER_S)
    active = manoeuvres(random, times, (4, 9), (3, 7))[:, None]
    rates = active * noise(random, times, random.uniform(0.5, 1.5), 3)
    tilt = rates / 3 + 0.3 * active * noise(random, times, 0.3, 3)
    height = integral(active * noise(random, times, 0.15, 1), times)
    values = np.hstack([rates + 0.01 * random.normal(size=rates.shape), tilt, height])
    values[:, 3:] += 0.003 * random.normal(size=(len(times), 4))
    return split(times, values, seconds, ("gx", "gy", "gz", "roll", "pitch", "yaw", "height"))


def one_manoeuvre(seed: int) -> Pair:
    """At rest but for one manoeuvre; later there are others, with rests between."""
    random = np.random.default_rng([2, seed])
    seconds = random.uniform(12, 25)
    times = at(50, seconds + AFTER_S)
    first = random.uniform(0.3, 0.5) * seconds
    length = random.uniform(2, 4)
    active = manoeuvres(random, times, (4, 9), (2, 6))
    early = times < seconds
    part = np.clip((times[early] - first) / length, 0, 1)
    active[early] = np.minimum(1.0, 4 * np.sin(np.pi * part))
    rates = active[:, None] * noise(random, times, random.uniform(0.8, 2.0), 3)
    angles = integral(rates, times)
    accelerations = active[:, None] * noise(random, times, 4.0, 2)
    values = np.hstack([rates, angles, accelerations])
    values += np.repeat([0.002, 0.0005, 0.01], [3, 3, 2]) * random.normal(size=values.shape)
    return split(times, values, seconds, ("gx", "gy", "gz", "ax", "ay", "az", "fx", "fy"))


def hover(seed: int) -> Pair:
    """Position and velocity that are held by a controller against gusts, and a vibration."""
    random = np.random.default_rng([3, seed])
    seconds = random.uniform(10, 40)
    times = at(50, seconds + AFTER_S)
    gust = noise(random, times, 0.5, 2)
    position, velocity = np.zeros((len(times), 2)), np.zeros((len(times), 2))
    stiff, damped = random.uniform(1, 6), random.uniform(0.8, 3)
    for i in range(1, len(times)):
        force = gust[i] - stiff * position[i - 1] - damped * velocity[i - 1]
        velocity[i] = velocity[i - 1] + 0.02 * force
        position[i] = position[i - 1] + 0.02 * velocity[i]
    shake = np.sin(2 * np.pi * random.uniform(8, 20) * times[:, None] + random.uniform(0, 6, 2))
    force = np.gradient(velocity, times, axis=0) + random.uniform(0.3, 2) * shake
    values = np.hstack([position, velocity, force])
    values += np.repeat([0.002, 0.01, 0.1], 2) * random.normal(size=values.shape)
    return split(times, values, seconds, ("x", "y", "vx", "vy", "ax", "ay"))


def arm(seed: int) -> Pair:
    """Joints that move from pose to pose and rest between; no pose comes twice."""
    random = np.random.default_rng([4, seed])
    seconds = random.uniform(15, 60)
    times = at(50, seconds + AFTER_S)
    values = minimum_jerk(random, times, 4, (0.8, 2.5), random.uniform(0.3, 3))
    values += 0.002 * random.normal(size=values.shape)
    return split(times, values, seconds)


def random_walk(seed: int) -> Pair:
    """Odometry: two positions and a heading that drift."""
    random = np.random.default_rng([5, seed])
    seconds = random.uniform(8, 40)
    times = at(30, seconds + AFTER_S)
    values = np.cumsum(random.normal(size=(len(times), 2)), axis=0)
    drift = integral(noise(random, times, 0.3, 1), times)
    values = np.hstack([values, drift + 0.001 * random.normal(size=drift.shape)])
    return split(times, values, seconds)


def faster(seed: int) -> Pair:
    """Oscillations whose frequency grows, beyond that of the log in what comes next."""
    random = np.random.default_rng([6, seed])
    seconds = random.uniform(15, 40)
    times = at(50, seconds + AFTER_S)
    columns = []
    for _ in range(3):
        low, high = random.uniform(0.2, 0.5), random.uniform(0.7, 1.4)
        rate = low + (high - low) * np.minimum(times / (2 * seconds), 1.0)
        phase = 2 * np.pi * np.cumsum(rate) * 0.02 + random.uniform(0, 6)
        columns.append(np.sin(phase) * (1 + 0.2 * np.sin(0.7 * times)))
    values = np.column_stack(columns) + 0.01 * random.normal(size=(len(times), 3))
    return split(times, values, seconds)


def filtered_noise(seed: int) -> Pair:
    """A gyroscope: noise behind filters of different bandwidth, around zero."""
    random = np.random.default_rng([7, seed])
    seconds = random.uniform(8, 40)
    times = at(50, seconds + AFTER_S)
    columns = [noise(random, times, cutoff, 1) for cutoff in random.uniform(0.3, 5.0, 4)]
    values = np.hstack(columns)
    values += 0.02 * random.normal(size=values.shape)
    return split(times, values, seconds)


def two_regimes(seed: int) -> Pair:
    """Slow motion around one pose; in what comes next also fast motion around another one."""
    random = np.random.default_rng([8, seed])
    seconds = random.uniform(15, 40)
    times = at(50, seconds + AFTER_S)
    slow = 0.5 * noise(random, times, 0.2, 3, order=4)
    quick = random.uniform(0.6, 1.2, 3) * noise(random, times, 0.8, 3, order=4)
    changed = np.clip((times - seconds - 20) / 2, 0, 1)[:, None]
    values = slow + changed * (quick + random.uniform(-1, 1, 3))
    values += 0.003 * random.normal(size=values.shape)
    return split(times, values, seconds)


def slow_sensors(seed: int) -> Pair:
    """A drone for 40 to 60 s: gyro and accelerometer at 50 Hz, barometer at 25 Hz, GPS at 5 Hz."""
    random = np.random.default_rng([9, seed])
    seconds = random.uniform(40, 60)
    fast = at(50, seconds + AFTER_S)
    active = 0.15 + 0.85 * manoeuvres(random, fast, (5, 12), (4, 10))[:, None]
    rates = active * noise(random, fast, random.uniform(0.7, 2.5), 3)
    forces = active * noise(random, fast, 1.0, 2, order=4)
    speed = integral(forces - 0.0, fast)
    for c in range(2):  # speed leaks, as by drag
        for i in range(1, len(fast)):
            speed[i, c] = 0.99 * speed[i - 1, c] + 0.02 * forces[i, c]
    place = integral(np.hstack([speed, active * noise(random, fast, 0.1, 1)]), fast)
    imu = np.hstack([rates, forces])
    imu += np.repeat([0.03, 0.1], [3, 2]) * random.normal(size=imu.shape)
    baro, gps = fast[::2] + 0.003, fast[::10] + 0.007
    height = place[::2, 2:] + 0.1 * random.normal(size=(len(baro), 1))
    place = place[::10, :2] + 0.05 * random.normal(size=(len(gps), 2))
    times, values = merged((fast, imu), (baro, height), (gps, place))
    return split(times, values, seconds, ("gx", "gy", "gz", "fx", "fy", "height", "x", "y"))


def gait(seed: int) -> Pair:
    """Joints that repeat a cycle, whose length and size vary a little."""
    random = np.random.default_rng([10, seed])
    seconds = random.uniform(8, 40)
    times = at(50, seconds + AFTER_S)
    rate = random.uniform(0.6, 1.5) * (1 + 0.05 * noise(random, times, 0.2, 1)[:, 0])
    phase = 2 * np.pi * np.cumsum(rate) * 0.02
    size = 1 + 0.1 * noise(random, times, 0.3, 1)[:, 0]
    columns = []
    for _ in range(4):
        first, second = random.uniform(0, 6, 2)
        columns.append(size * (np.sin(phase + first) + 0.4 * np.sin(2 * phase + second)))
    values = np.column_stack(columns) + 0.01 * random.normal(size=(len(times), 4))
    return split(times, values, seconds)


def pushed(seed: int) -> Pair:
    """A lightly damped joint that swings after each push, and a set point that steps."""
    random = np.random.default_rng([11, seed])
    seconds = random.uniform(12, 40)
    times = at(50, seconds + AFTER_S)
    target = np.repeat(random.uniform(-1, 1, 200), random.integers(60, 250, 200))[: len(times)]
    stiff, damped = (2 * np.pi * random.uniform(0.4, 1.2)) ** 2, random.uniform(0.5, 4)
    swing, speed = np.zeros(len(times)), np.zeros(len(times))
    for i in range(1, len(times)):
        force = stiff * (target[i - 1] - swing[i - 1]) - damped * speed[i - 1]
        speed[i] = speed[i - 1] + 0.02 * force
        swing[i] = swing[i - 1] + 0.02 * speed[i]
    values = np.column_stack([target, swing, speed])
    values[:, 1:] += np.array([0.005, 0.05]) * random.normal(size=(len(times), 2))
    return split(times, values, seconds, ("target", "angle", "rate"))


def drive(seed: int) -> Pair:
    """A cart that drives straight, turns and stops: position, heading, and their rates."""
    random = np.random.default_rng([12, seed])
    seconds = random.uniform(20, 60)
    times = at(20, seconds + AFTER_S)
    command = np.repeat(random.choice([0.0, 0.5, 1.0], 200) * 1.0, random.integers(30, 120, 200))[
        : len(times)
    ]
    turn = np.repeat(random.choice([-0.6, 0.0, 0.0, 0.6], 200), random.integers(20, 90, 200))
    turn = turn[: len(times)]
    speed, rate = np.zeros(len(times)), np.zeros(len(times))
    for i in range(1, len(times)):
        speed[i] = speed[i - 1] + 0.15 * (command[i] - speed[i - 1])
        rate[i] = rate[i - 1] + 0.2 * (turn[i] - rate[i - 1])
    heading = integral(rate[:, None], times)[:, 0]
    path = np.column_stack([speed * np.cos(heading), speed * np.sin(heading)])
    values = np.column_stack([integral(path, times), heading, speed, rate])
    values += np.array([0.003, 0.003, 0.002, 0.02, 0.01]) * random.normal(size=values.shape)
    return split(times, values, seconds, ("x", "y", "heading", "speed", "rate"))


SHORT_LOGS: dict[str, Callable[[int], Pair]] = {
    made.__name__: made
    for made in (
        takeoff, one_manoeuvre, hover, arm, random_walk, faster, filtered_noise, two_regimes,
        slow_sensors, gait, pushed, drive,
    )
}  # fmt: skip
