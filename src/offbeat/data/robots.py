"""Robots for simulation: MuJoCo models with a distribution of initial states.

The built-in ones move exactly as those of the DeepMind Control Suite (Tassa et al. 2018,
arXiv:1801.00690) in the same version of MuJoCo. Their files are our own: the suite is not needed.
"""

from __future__ import annotations

import copy
import logging
import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from offbeat.data.source import require_file
from offbeat.errors import FileFormatError, InputError, MissingExtraError, one_of, require
from offbeat.registry import Registry

Draw = Callable[[np.random.RandomState, Any, int], NDArray[np.float64]]
"""Draws (n, nq + nv) initial states for a `mujoco.MjModel`: positions, then velocities, in SI."""

Control = Callable[[float, NDArray[np.float64]], NDArray[np.float64]]
"""Maps a time (s) and the (nq + nv,) positions and velocities to (nu,) controls."""


@dataclass(frozen=True)
class Robot:
    """A robot: its model, the distribution of its initial states, and its controller.

    Args:
        name: for lists, origins of trajectories and `meta`.
        model: MJCF file, or a function that makes the `mujoco.MjModel`.
        draw: draws initial states in the order of trajectories, so that the first k of n
            trajectories do not depend on n. By default joints with limits are uniform in their
            range, hinges without limits have any angle, and velocities are up to 1 in SI units.
        control: by default no control.
        description: one line, for lists.
    """

    name: str
    model: str | Path | Callable[[], Any]
    draw: Draw | None = None
    control: Control | None = None
    description: str = ""

    def initial_states(
        self, random: np.random.RandomState, model: Any, n: int
    ) -> NDArray[np.float64]:
        """(n, nq + nv) initial states.

        Raises:
            InputError: the sampler returns another shape, or the default does not support the
                joints.
        """
        states = np.asarray((self.draw or inside_joint_ranges(1.0))(random, model, n))
        if states.shape != (n, model.nq + model.nv):
            raise InputError(
                f"the sampler of robot {self.name!r} must give initial states of shape "
                f"{(n, model.nq + model.nv)}, got {states.shape}"
            )
        return states.astype(np.float64)

    def __repr__(self) -> str:
        return f"Robot({self.name!r}: {self.description})"


ROBOTS: Registry[Robot] = Registry("robot", group="offbeat.robots")
"""The robots that can be simulated by name."""


def register_robot(
    name: str,
    model: str | Path | Callable[[], Any],
    *,
    draw: Draw | None = None,
    control: Control | None = None,
    description: str = "",
    replace: bool = False,
) -> Robot:
    """Registers a robot for `simulate`.

    Args:
        name: of the robot.
        model: as of `Robot`.
        draw: as of `Robot`.
        control: as of `Robot`.
        description: as of `Robot`.
        replace: allow a name that is taken.

    Raises:
        InputError: the name is taken.
    """
    return ROBOTS.register(name, Robot(name, model, draw, control, description), replace=replace)


def robot_of(robot: str | Path | Robot) -> Robot:
    """A robot by its name, from an MJCF file, or of Gymnasium, as `Hopper-v5`.

    Raises:
        InputError: it is neither; the message lists the names.
    """
    if isinstance(robot, Robot):
        return robot
    if isinstance(robot, Path) or robot.endswith(".xml"):
        return Robot(str(robot), robot)
    if robot not in ROBOTS and re.fullmatch(r"[\w/]+-v\d+", robot):
        return gymnasium_robot(robot)
    return ROBOTS[robot]


def load_model(robot: str | Path | Robot) -> Any:
    """Compiles the model of a robot: a `mujoco.MjModel`, for simulation and for rendering.

    Args:
        robot: name, MJCF file, or robot.

    Raises:
        InputError: the robot is unknown.
        FileFormatError: the file is missing or not MJCF.
        MissingExtraError: mujoco is not installed.
    """
    source = robot_of(robot).model
    mujoco = require("mujoco", "sim")
    if callable(source):
        return source()
    path = require_file(source)
    try:
        with collected_warnings(mujoco) as warnings:
            model = mujoco.MjModel.from_xml_path(str(path))
    except ValueError as error:
        raise FileFormatError(
            f"{path} cannot be compiled as MJCF ({' '.join(str(error).split())})"
        ) from None
    for warning in warnings:
        logging.getLogger("offbeat").warning("%s: %s", path, warning)
    return model


@contextmanager
def collected_warnings(mujoco: Any) -> Iterator[list[str]]:
    """Collects MuJoCo's warnings, which otherwise go to a log file in the working directory.

    Args:
        mujoco: the module.
    """
    before = mujoco.get_mju_user_warning()
    warnings: list[str] = []
    mujoco.set_mju_user_warning(warnings.append)
    try:
        yield warnings
    finally:
        mujoco.set_mju_user_warning(before)


def _box(*sides: tuple[int, float, float]) -> Draw:
    """Independent uniform draws: (number of entries, low, high) per side of the box.

    One call of `uniform` with arrays equals one call per side bit for bit.
    """
    counts, lows, highs = zip(*sides, strict=True)
    low, high = np.repeat(lows, counts), np.repeat(highs, counts)

    def draw(random: np.random.RandomState, model: Any, n: int) -> NDArray[np.float64]:
        return random.uniform(low, high, size=(n, len(low)))

    return draw


def inside_joint_ranges(speed: float, *, turned: bool = True) -> Draw:
    """Draws joints with limits in their range, and no other slides.

    Free and ball joints have any orientation, uniformly (Shoemake 1992); the position of a free
    joint is that of the model. Velocities are uniform in plus or minus `speed`.

    Args:
        speed: largest velocity, in SI units.
        turned: whether hinges without limits have any angle; else that of the model.
    """

    def draw(random: np.random.RandomState, model: Any, n: int) -> NDArray[np.float64]:
        kinds = require("mujoco", "sim").mjtJoint
        low, high = model.qpos0.copy(), model.qpos0.copy()
        fours = []
        for joint in range(model.njnt):
            at, kind = int(model.jnt_qposadr[joint]), int(model.jnt_type[joint])
            if kind in (kinds.mjJNT_FREE.value, kinds.mjJNT_BALL.value):
                fours.append(at + 3 * (kind == kinds.mjJNT_FREE.value))
                low[fours[-1] : fours[-1] + 4], high[fours[-1] : fours[-1] + 4] = 0.0, 1.0
            elif model.jnt_limited[joint]:
                low[at], high[at] = model.jnt_range[joint]
            elif kind == kinds.mjJNT_HINGE.value and turned:
                low[at], high[at] = low[at] - np.pi, high[at] + np.pi
        still = np.full(model.nv, speed)
        low, high = np.concatenate([low, -still]), np.concatenate([high, still])
        states = random.uniform(low, high, size=(n, len(low)))
        for at in fours:  # of four numbers three are used, so that a row is drawn as a whole
            radius, one, two = states[:, at], *(2 * np.pi * states[:, at + 1 : at + 3].T)
            near, far = np.sqrt(1 - radius), np.sqrt(radius)
            states[:, at : at + 4] = np.stack(
                [far * np.cos(two), near * np.sin(one), near * np.cos(one), far * np.sin(two)], 1
            )
        return states

    return draw


def gymnasium_env(name: str, **options: Any) -> Any:
    """An environment of Gymnasium by its name.

    Args:
        name: such as `Hopper-v5`.
        **options: of `gymnasium.make`.

    Raises:
        InputError: there is none of this name.
        MissingExtraError: gymnasium, or a package that the environment needs, is not installed.
    """
    gymnasium = require("gymnasium", "robots")
    try:
        with _warnings_of_gymnasium(name):
            return gymnasium.make(name, **options)
    except gymnasium.error.DependencyNotInstalled as error:
        raise MissingExtraError(
            f"the environment {name!r} needs a package that is not installed "
            f"({' '.join(str(error).split())}); install it with: pip install 'offbeat[robots]'"
        ) from None
    except gymnasium.error.Error as error:
        what = " ".join(str(error).split())
        raise InputError(
            f"Gymnasium has no environment {name!r} ({what}); give a name such as Hopper-v5"
        ) from None


@contextmanager
def _warnings_of_gymnasium(name: str) -> Iterator[None]:
    """Logs MuJoCo's warnings while an environment is made.

    The model of HalfCheetah sets its mass by `settotalmass`, which MuJoCo still does, and warns of
    each time: that is for Gymnasium to change, so it is left out.
    """
    if not find_spec("mujoco"):
        yield
        return
    with collected_warnings(require("mujoco", "sim")) as warnings:
        yield
    for warning in warnings:
        if "settotalmass" not in warning:
            logging.getLogger("offbeat").warning("%s: %s", name, warning)


def gymnasium_robot(name: str) -> Robot:
    """A robot of Gymnasium's MuJoCo environments; its initial states are those of `reset`.

    Args:
        name: such as `Hopper-v5`.

    Raises:
        InputError: there is none of this name, or it is not one of MuJoCo.
        MissingExtraError: gymnasium is not installed.
    """
    env = gymnasium_env(name).unwrapped
    if not hasattr(env, "model") or not hasattr(env, "init_qpos"):
        raise InputError(
            f"{name!r} is no robot of MuJoCo, so there is nothing to simulate; give one such as "
            "Hopper-v5"
        )

    def draw(random: np.random.RandomState, model: Any, n: int) -> NDArray[np.float64]:
        states = np.empty((n, model.nq + model.nv))
        for state in states:
            env.reset(seed=int(random.randint(2**31)))
            state[:] = np.concatenate([env.data.qpos, env.data.qvel])
        return states

    def model() -> Any:
        return copy.copy(env.model)

    return Robot(name, model, draw, description="of Gymnasium")


_MJCF = Path(__file__).parent / "mjcf"

register_robot(
    "hopper",
    _MJCF / "hopper.xml",
    # The draw of the thesis: qpos[0:2], qpos[2:7], qvel; joint ranges are not respected.
    draw=_box((2, 0.0, 0.5), (5, -2.0, 2.0), (7, -5.0, 5.0)),
    description="a planar one-legged hopper: 7 joints, 14 channels, 5 ms",
)
register_robot(
    "walker",
    _MJCF / "walker.xml",
    draw=inside_joint_ranges(5.0),
    description="a planar two-legged walker: 9 joints, 18 channels, 2.5 ms",
)
register_robot(
    "cheetah",
    _MJCF / "cheetah.xml",
    # As the suite's, which then lets it settle: the torso level, at its height.
    draw=inside_joint_ranges(5.0, turned=False),
    description="a planar two-legged cheetah: 9 joints, 18 channels, 10 ms",
)
register_robot(
    "humanoid",
    _MJCF / "humanoid.xml",
    # As the suite's, which draws again where the floor is touched.
    draw=inside_joint_ranges(1.0),
    description="a humanoid: a free joint and 21 hinges, 55 channels, 5 ms",
)

_QUATERNION = [(f"q{axis}", "1") for axis in "wxyz"]
_POSITION = [(axis, "m") for axis in "xyz"]
_VELOCITY = [(axis, "m/s") for axis in "xyz"]
_ROTATION = [(f"w{axis}", "rad/s") for axis in "xyz"]
_COMPONENTS = {
    "mjJNT_FREE": (_POSITION + _QUATERNION, _VELOCITY + _ROTATION),
    "mjJNT_BALL": (_QUATERNION, _ROTATION),
    "mjJNT_SLIDE": ([("", "m")], [("", "m/s")]),
    "mjJNT_HINGE": ([("", "rad")], [("", "rad/s")]),
}
"""Per type of joint the components of its position and velocity: (suffix, unit)."""


def channels_of(model: Any) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Names and units of a model's state: all positions, then all velocities.

    Args:
        model: a `mujoco.MjModel`.

    Returns:
        (nq + nv) names such as `knee_qpos` and `knee_qvel`, for joints of several components
        `root_x_qpos` or `root_qw_qpos`; and as many units, `1` for the entries of a quaternion.
    """
    joint_type = require("mujoco", "sim").mjtJoint
    names, units = [], []
    for part, kind in enumerate(("qpos", "qvel")):
        for j in range(model.njnt):
            joint = model.joint(j).name or f"joint{j}"
            for suffix, unit in _COMPONENTS[joint_type(int(model.jnt_type[j])).name][part]:
                names.append("_".join(filter(None, (joint, suffix, kind))))
                units.append(unit)
    return tuple(names), tuple(units)


def quaternions_of(model: Any) -> tuple[tuple[str, ...], ...]:
    """The four channel names of each quaternion of a model.

    Args:
        model: a `mujoco.MjModel`.
    """
    names, _ = channels_of(model)
    first = [i for i, name in enumerate(names) if name.endswith("qw_qpos")]
    return tuple(names[i : i + 4] for i in first)


_SENSED = {
    "TOUCH": "N",
    "FORCE": "N",
    "TORQUE": "Nm",
    "ACCELEROMETER": "m/s^2",
    "GYRO": "rad/s",
    "VELOCIMETER": "m/s",
    "SUBTREELINVEL": "m/s",
}
"""Units of sensors by their type; others have none."""


def sensors_of(model: Any, names: Sequence[str]) -> tuple[list[int], list[str], list[str]]:
    """Positions in `sensordata`, channel names and units of some sensors.

    Args:
        model: a `mujoco.MjModel`.
        names: of sensors; one with three components is the channels `name_x`, `name_y`, `name_z`.

    Raises:
        InputError: the model has no such sensor.
    """
    kinds = require("mujoco", "sim").mjtSensor
    there = [model.sensor(i).name for i in range(model.nsensor)]
    index: list[int] = []
    channels, units = [], []
    for name in names:
        i = there.index(one_of("sensor", name, there))
        size, at = int(model.sensor_dim[i]), int(model.sensor_adr[i])
        kind = kinds(int(model.sensor_type[i])).name.removeprefix("mjSENS_")
        ends = {1: ("",), 3: ("_x", "_y", "_z")}.get(size, tuple(f"_{k}" for k in range(size)))
        index += range(at, at + size)
        channels += [name + end for end in ends]
        units += [_SENSED.get(kind, "")] * size
    return index, channels, units


def controls_of(model: Any) -> tuple[str, ...]:
    """Names of a model's controls, such as `knee_ctrl`, one per actuator."""
    return tuple(f"{model.actuator(i).name or f'actuator{i}'}_ctrl" for i in range(model.nu))
