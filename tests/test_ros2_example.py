"""The example node: all of it but ROS itself, which is not here."""

from __future__ import annotations

import importlib.util
import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from model_helpers import small_model

from offbeat import Dataset, Stream, Trajectory, save_model

PATH = Path(__file__).parents[1] / "examples" / "ros2_node.py"
CHANNELS = ("position.hip", "velocity.hip", "position.knee", "torso.height")


@pytest.fixture(scope="module")
def node() -> Any:
    """The module, imported without ROS."""
    spec = importlib.util.spec_from_file_location("ros2_node", PATH)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def joint_state(names: list[str], stamp: tuple[int, int] = (0, 0), **fields: Any) -> Any:
    header = SimpleNamespace(stamp=SimpleNamespace(sec=stamp[0], nanosec=stamp[1]), frame_id="arm")
    empty: dict[str, Any] = {"position": [], "velocity": [], "effort": []}
    return SimpleNamespace(header=header, name=names, **(empty | fields))


def arm(channels: tuple[str, ...] = CHANNELS) -> Any:
    times = 0.01 * np.arange(30)
    values = np.sin(20 * times[:, None] + np.arange(len(channels)))
    return small_model("gru_d", Dataset((Trajectory(times, values, names=channels),)))


def test_joints_of_a_message_become_the_channels_of_the_model(node: Any) -> None:
    joints = node.JointChannels(CHANNELS)
    message = joint_state(["knee", "wrist", "hip"], position=[1.0, 2.0, math.nan], velocity=[4.0])
    found = joints.values(message)
    assert found.keys() == {"position.knee", "position.hip"}
    assert found["position.knee"] == 1.0
    assert math.isnan(found["position.hip"])
    assert joints.values(joint_state(["hip"], velocity=[3])) == {"velocity.hip": 3.0}
    assert joints.values(joint_state([])) == {}


def test_a_prediction_becomes_a_message_with_what_is_not_known_left_empty(node: Any) -> None:
    reply = joint_state([])
    node.JointChannels(CHANNELS).fill(reply, np.array([1.0, 2.0, 3.0, 4.0]))
    assert reply.name == ["hip", "knee"]
    assert reply.position == [1.0, 3.0]
    assert reply.velocity[0] == 2.0
    assert math.isnan(reply.velocity[1])
    assert reply.effort == []


def test_channels_may_have_a_prefix_and_must_be_of_joints(node: Any) -> None:
    joints = node.JointChannels(["/arm:position.hip", "position.hip"], prefix="/arm:")
    assert joints.values(joint_state(["hip"], position=[1.0])) == {"/arm:position.hip": 1.0}
    with pytest.raises(ValueError, match=r"that are named position\.JOINT"):
        node.JointChannels(["height", "tilt.x"])


def test_stamps_are_exact(node: Any) -> None:
    stamp = SimpleNamespace(sec=0, nanosec=0)
    node.set_nanoseconds(stamp, 1_700_000_000_123_456_789)
    assert (stamp.sec, stamp.nanosec) == (1_700_000_000, 123_456_789)
    assert node.nanoseconds(stamp) == 1_700_000_000_123_456_789


def test_a_message_is_answered_with_what_the_stream_predicts_after_it(
    node: Any, tmp_path: Path
) -> None:
    model = arm()
    save_model(model, tmp_path / "model")
    live, joints = node.load(str(tmp_path / "model")), node.JointChannels(CHANNELS)
    plain = Stream(model, time_unit="ns", late="reorder")
    start = 1_700_000_000
    rows = [(start, 500, "hip", 1.0), (start, 500, "knee", 2.0), (start, 10**7, "hip", 3.0),
            (start, 5 * 10**6, "knee", 4.0)]  # fmt: skip
    for sec, nanosec, joint, value in rows:
        reply = joint_state([])
        message = joint_state([joint], (sec, nanosec), position=[value])
        node.answer(live, joints, message, reply, now=7, horizon_s=0.1)
        plain.observe(sec * 10**9 + nanosec, {f"position.{joint}": value})
        newest = plain.time
        assert isinstance(newest, int)
        assert node.nanoseconds(reply.header.stamp) == newest + 10**8
        assert reply.header.frame_id == "arm"
        expected = plain.predict(newest + 10**8)
        assert reply.position == [expected[0], expected[2]]
    assert live.counters == plain.counters
    assert (live.counters.rows, live.counters.merged, live.counters.reordered) == (3, 1, 1)


def test_a_message_without_a_stamp_is_of_now(node: Any) -> None:
    live, joints = Stream(arm(), time_unit="ns"), node.JointChannels(CHANNELS)
    node.answer(live, joints, joint_state(["hip"], position=[1.0]), joint_state([]), now=10**18,
                horizon_s=0.0)  # fmt: skip
    assert live.time == 10**18
