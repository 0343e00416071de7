"""The robots that can be simulated: one entry each, on the models of the DeepMind Control Suite.

The model files come with the `dm_control` package, which is found and not imported: importing it
takes seconds and chooses a rendering backend, and all that is needed of it here is its XML.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from offbeat.errors import MissingExtraError, one_of, require

Draw = Callable[[np.random.RandomState, Any, int], NDArray[np.float64]]
"""Draws (n, nq + nv) initial states for a compiled model: positions, then velocities, SI units."""


@dataclass(frozen=True)
class Robot:
    """A robot: its model file and the distribution of its initial states.

    Args:
        name: the name users give.
        xml: name of the MJCF file in the suite's folder of `dm_control`.
        description: one line, for lists and reports.
        draw: draws initial states, trajectory by trajectory, so that the first k of n trajectories
            do not depend on n.
    """

    name: str
    xml: str
    description: str
    draw: Draw

    def __repr__(self) -> str:
        return f"Robot({self.name!r}: {self.description})"


def _box(*sides: tuple[int, float, float]) -> Draw:
    """Independent uniform draws: (how many entries, low, high) per side of the box.

    `uniform` with arrays gives, bit for bit, what one call per side gives in a loop.
    """
    counts, lows, highs = zip(*sides, strict=True)
    low, high = np.repeat(lows, counts), np.repeat(highs, counts)

    def draw(random: np.random.RandomState, model: Any, n: int) -> NDArray[np.float64]:
        return random.uniform(low, high, size=(n, len(low)))

    return draw


def _inside_joint_ranges(speed: float) -> Draw:
    """Limited joints anywhere in their range, free hinges at any angle, free slides where they are.

    For models of slide and hinge joints. Velocities are uniform in plus or minus `speed`.
    """

    def draw(random: np.random.RandomState, model: Any, n: int) -> NDArray[np.float64]:
        limited = model.jnt_limited.astype(bool)
        hinge = model.jnt_type == require("mujoco", "sim").mjtJoint.mjJNT_HINGE.value
        reach = np.where(hinge, np.pi, 0.0)
        low = np.where(limited, model.jnt_range[:, 0], model.qpos0 - reach)
        high = np.where(limited, model.jnt_range[:, 1], model.qpos0 + reach)
        still = np.full(model.nv, speed)
        low, high = np.concatenate([low, -still]), np.concatenate([high, still])
        return random.uniform(low, high, size=(n, len(low)))

    return draw


ROBOTS = {
    robot.name: robot
    for robot in (
        Robot(
            "hopper",
            "hopper.xml",
            "a planar one-legged hopper: 7 joints, 14 channels, 5 ms",
            # The protocol's draw: qpos[0:2], qpos[2:7], qvel; joint ranges are not respected.
            _box((2, 0.0, 0.5), (5, -2.0, 2.0), (7, -5.0, 5.0)),
        ),
        Robot(
            "walker",
            "walker.xml",
            "a planar two-legged walker: 9 joints, 18 channels, 2.5 ms",
            _inside_joint_ranges(speed=5.0),
        ),
    )
}
"""The robots by name. A new robot is a new entry."""


def robot_named(name: str) -> Robot:
    """The robot of this name.

    Raises:
        InputError: there is none; the message lists the names.
    """
    return ROBOTS[one_of("robot", name, ROBOTS)]


def load_model(name: str) -> Any:
    """Compiles the model of a robot: a `mujoco.MjModel`, for simulation and for rendering.

    Args:
        name: one of `ROBOTS`.

    Raises:
        InputError: the robot is unknown.
        MissingExtraError: mujoco or dm_control is not installed.
    """
    robot = robot_named(name)
    mujoco = require("mujoco", "sim")
    suite = _suite_folder()
    try:
        xml = (suite / robot.xml).read_text(encoding="utf-8")
        # The suite's models include these under exactly this spelling.
        common = sorted((suite / "common").glob("*.xml"))
        assets = {f"./common/{file.name}": file.read_bytes() for file in common}
    except OSError as error:
        raise MissingExtraError(
            f"the installed dm_control lacks the model of {name!r} ({error}); "
            "reinstall it with: pip install --force-reinstall dm_control"
        ) from None
    return mujoco.MjModel.from_xml_string(xml, assets)


def _suite_folder() -> Path:
    spec = importlib.util.find_spec("dm_control")
    if spec is None or not spec.submodule_search_locations:
        raise MissingExtraError(
            "this needs the model files of 'dm_control', which is not installed; "
            "install it with: pip install 'offbeat[sim]'"
        )
    return Path(spec.submodule_search_locations[0]) / "suite"


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
