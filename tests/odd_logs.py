"""Synthetic logs as people have them: short, gappy, slow beside fast, with marks and copies.

Each generator writes nothing; `ODD_LOGS[name]()` is a data set as `read` gives it, and `write_csv`
makes a file of it. What `offbeat train` must choose for each is in `test_odd_logs.py`.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import offbeat as ob

Values = NDArray[np.float64]
NAN = float("nan")


def motion(times: Values, seed: int = 0, channels: int = 3) -> Values:
    """(rows, channels) smooth motion like that of joints, with a little noise."""
    random = np.random.default_rng(seed)
    columns = []
    for _ in range(channels):
        rates, phases = random.uniform(0.3, 2.0, 3), random.uniform(0, 6.28, 3)
        waves = np.sin(2 * np.pi * rates[:, None] * times / 2 + phases[:, None])
        columns.append(waves.sum(axis=0) / 2 + 0.005 * random.normal(size=len(times)))
    return np.column_stack(columns)


def log(times: Values, values: Values, names: tuple[str, ...] = (), units=()) -> ob.Dataset:
    names = names or tuple(f"q{c}" for c in range(values.shape[1]))
    return ob.Dataset((ob.Trajectory(times, values, names=names, units=units),))


def at(rate_hz: float, seconds: float) -> Values:
    return np.arange(round(rate_hz * seconds)) / rate_hz


def merged(*sensors: tuple[Values, Values]) -> tuple[Values, Values]:
    """The union of the times of several sensors, and their values, NaN elsewhere."""
    times = np.unique(np.concatenate([clock for clock, _ in sensors]))
    columns = []
    for clock, values in sensors:
        column = np.full((len(times), values.shape[1]), NAN)
        column[np.searchsorted(times, clock)] = values
        columns.append(column)
    return times, np.concatenate(columns, axis=1)


def out(times: Values, values: Values, spans: list[tuple[float, float]]) -> Values:
    values = values.copy()
    for start, stop in spans:
        values[(times >= start) & (times < stop)] = NAN
    return values


def short() -> ob.Dataset:
    times = at(50, 3)
    return log(times, motion(times))


def long() -> ob.Dataset:
    times = at(100, 300)
    return log(times, motion(times, channels=2))


def one_channel() -> ob.Dataset:
    times = at(100, 30)
    return log(times, motion(times, channels=1))


def late_sensor() -> ob.Dataset:
    times = at(50, 60)
    values = motion(times)
    values[times < 35, 2] = NAN
    return log(times, values)


def constants() -> ob.Dataset:
    times = at(20, 60)
    still = np.column_stack([np.full(len(times), 7.25), np.zeros(len(times))])
    return log(times, np.hstack([motion(times), still]), ("q0", "q1", "q2", "gain", "mode"))


def sentinels() -> ob.Dataset:
    times = at(50, 60)
    values = motion(times)
    values[[100, 101, 900], 0] = -999.0
    values[[5, 1700], 1] = 1e30
    values[:20, 2] = 0.0
    values[20:, 2] += 30.0
    return log(times, values)


def noise_only() -> ob.Dataset:
    times = at(50, 60)
    return log(times, np.random.default_rng(0).normal(size=(len(times), 3)))


def multi_rate() -> ob.Dataset:
    joints, imu, gripper = at(100, 60), at(200, 60) + 0.0012, at(20, 60) + 0.0031
    times, values = merged(
        (joints, motion(joints, 1)),
        (imu, motion(imu, 2)),
        (gripper, motion(gripper, 3, 1)),
    )
    return log(times, values, ("q0", "q1", "q2", "ax", "ay", "az", "grip"))


def long_dropouts() -> ob.Dataset:
    """One sensor is out for up to 6 s of 30, longer than any window that the log has room for."""
    fast, slow = at(25, 30), at(25, 30) + 0.004
    values = out(slow, motion(slow, 1, 2), [(5, 11), (20, 23)])
    kept = ~np.isnan(values[:, 0])
    times, values = merged((fast, motion(fast)), (slow[kept], values[kept]))
    return log(times, values, ("q0", "q1", "q2", "x", "y"))


def bursts() -> ob.Dataset:
    """20 rows at 100 Hz, then nothing for 0.4 s."""
    times = at(100, 60)
    times = times[(times * 100).round().astype(int) % 60 < 20]
    return log(times, motion(times))


def step_signal() -> ob.Dataset:
    """A set point that steps between levels, and its response."""
    times = at(50, 60)
    target = np.array([0.0, 1.0, 0.4, 2.0, 1.2, 0.0])[(times / 2).astype(int) % 6]
    response = np.zeros(len(times))
    for i in range(1, len(times)):
        response[i] = response[i - 1] + 0.1 * (target[i - 1] - response[i - 1])
    response += 0.003 * np.random.default_rng(0).normal(size=len(times))
    return log(times, np.column_stack([target, response]), ("target", "response"))


def wrapped_angle() -> ob.Dataset:
    times = at(50, 60)
    heading = (1.3 * times + np.sin(times) + np.pi) % (2 * np.pi) - np.pi
    values = np.column_stack([heading, motion(times, channels=2)])
    return log(times, values, ("heading", "q0", "q1"), ("rad", "rad", "rad"))


def huge_offset() -> ob.Dataset:
    times = at(50, 60)
    return log(times, motion(times) + np.array([4.7e6, -8.1e5, 2.0e4]))


def tiny_scales() -> ob.Dataset:
    times = at(50, 60)
    return log(times, motion(times) * np.array([1e-9, 1e-6, 1e-12]))


def two_episodes() -> ob.Dataset:
    clocks = at(20, 25), at(20, 40)
    return ob.Dataset(
        tuple(log(times, motion(times, seed))[0] for seed, times in enumerate(clocks))
    )


def many_episodes() -> ob.Dataset:
    random = np.random.default_rng(0)
    clocks = [at(50, seconds) for seconds in random.uniform(4, 9, 30)]
    return ob.Dataset(
        tuple(log(times, motion(times, seed))[0] for seed, times in enumerate(clocks))
    )


def duplicate_topics() -> ob.Dataset:
    first, again = at(50, 60), at(50, 60) + 0.002
    values = motion(first)
    times, both = merged((first, values), (again, values))
    names = tuple(f"{topic}.q{c}" for topic in ("joints", "joints_filtered") for c in range(3))
    return log(times, both, names)


def counters() -> ob.Dataset:
    times = at(50, 60)
    rows = np.arange(len(times))
    values = np.column_stack([motion(times), rows + 512, rows % 256, 1e9 * times])
    return log(times, values, ("q0", "q1", "q2", "seq", "frame", "stamp"))


def impacts() -> ob.Dataset:
    """A force that is at rest but for contacts, and a gripper that is 0 or 1."""
    times = at(100, 60)
    random = np.random.default_rng(0)
    force = 0.05 * random.normal(size=len(times))
    for start in random.integers(0, len(times) - 20, 25):
        force[start : start + 15] += random.uniform(5, 40) * np.exp(-np.arange(15) / 3)
    gripper = (np.sin(0.9 * times) > 0.4).astype(float)
    values = np.column_stack([motion(times, channels=2), force, gripper])
    return log(times, values, ("q0", "q1", "force", "gripper"))


def rest_at_the_end() -> ob.Dataset:
    """It moves for half of the time, and then stands still."""
    times = at(50, 60)
    values = motion(times)
    still = times > 30
    values[still] = values[~still][-1]
    values += 0.002 * np.random.default_rng(0).normal(size=values.shape)
    return log(times, values)


def slow() -> ob.Dataset:
    """A row every 2 s or so, at uneven times, for an hour."""
    random = np.random.default_rng(0)
    times = np.cumsum(random.uniform(1, 3, 1800))
    return log(times, motion(times / 60))


ODD_LOGS: dict[str, Callable[[], ob.Dataset]] = {
    made.__name__: made
    for made in (
        short, long, one_channel, late_sensor, constants, sentinels, noise_only, multi_rate,
        long_dropouts, bursts, step_signal, wrapped_angle, huge_offset, tiny_scales, two_episodes,
        many_episodes, duplicate_topics, counters, impacts, rest_at_the_end, slow,
    )
}  # fmt: skip


def write_csv(dataset: ob.Dataset, path: Path) -> Path:
    """Writes a data set as a log; episodes are a minute apart."""
    header = [
        f"{name} [{unit}]" if unit else name
        for name, unit in zip(dataset.names, dataset.units, strict=True)
    ]
    lines, start = [",".join(["time", *header])], 0.0
    for t in dataset:
        for time, row in zip(start + t.times, t.values, strict=True):
            cells = ("" if np.isnan(value) else repr(float(value)) for value in row)
            lines.append(",".join([f"{time:.6f}", *cells]))
        start += float(t.times[-1]) + 60.0
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path
