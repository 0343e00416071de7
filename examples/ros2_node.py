"""A ROS 2 node: subscribes to joint states, publishes what a trained model predicts.

    offbeat train recording.mcap runs/arm          # channels named position.JOINT, velocity.JOINT
    python examples/ros2_node.py --ros-args -p model:=runs/arm -p horizon_s:=0.1

It subscribes to `joint_states` and publishes a `JointState` on `predicted_joint_states` for every
message: the joints as they will be `horizon_s` after the newest stamp, from all that was received.
A joint that a message leaves out was not measured; messages of one stamp are one row, so several
drivers may publish on the topic. Late messages are put where they belong, and stamps that jump
(a simulation that restarts) reset the stream, see `offbeat.StreamOptions`. The counters are
logged every ten seconds.

Besides Offbeat it needs a sourced ROS 2 (rclpy, sensor_msgs). The model may be the folder of a run
or an exported .onnx file, for which no torch is needed on the robot.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from offbeat import OffbeatError
from offbeat.stream.live import LiveStream

FIELDS = ("position", "velocity", "effort")
"""Of a JointState, each with one number per joint, or none at all."""


class JointChannels:
    """Joints of messages to channels of a model, and back.

    Args:
        channels: names of the model's channels: `position.JOINT`, `velocity.JOINT`, `effort.JOINT`.
        prefix: prefix of these names in the model, such as the name of a topic.

    Raises:
        ValueError: no channel is one of a joint.
    """

    def __init__(self, channels: Sequence[str], prefix: str = "") -> None:
        self.channels, self.prefix = tuple(channels), prefix
        self._known = set(channels)
        self._places: dict[str, dict[str, int]] = {}
        for place, name in enumerate(channels):
            field, dot, joint = name.removeprefix(prefix).partition(".")
            if name.startswith(prefix) and dot and field in FIELDS:
                self._places.setdefault(joint, {})[field] = place
        if not self._places:
            raise ValueError(
                f"the model has the channels {', '.join(channels)}; expected some that are named "
                f"{prefix}position.JOINT, {prefix}velocity.JOINT or {prefix}effort.JOINT"
            )

    def values(self, message: Any) -> dict[str, float]:
        """What a JointState measured of the model's channels; other joints are left out."""
        found = {}
        for field in FIELDS:
            numbers = getattr(message, field)
            if len(numbers) != len(message.name):
                continue  # a driver that has no such measurement leaves the field empty
            for joint, number in zip(message.name, numbers, strict=True):
                channel = f"{self.prefix}{field}.{joint}"
                if channel in self._known:
                    found[channel] = float(number)
        return found

    def fill(self, message: Any, prediction: NDArray[np.float64]) -> None:
        """Writes a prediction into a JointState; fields the model does not know stay empty."""
        message.name = list(self._places)
        for field in FIELDS:
            places = [of_joint.get(field) for of_joint in self._places.values()]
            if any(place is not None for place in places):
                numbers = [math.nan if p is None else float(prediction[p]) for p in places]
                setattr(message, field, numbers)


def nanoseconds(stamp: Any) -> int:
    """A ROS time as an integer, exactly; 0 where a driver does not stamp its messages."""
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)


def set_nanoseconds(stamp: Any, time: int) -> None:
    """The inverse of `nanoseconds`."""
    stamp.sec, stamp.nanosec = divmod(time, 1_000_000_000)


def answer(
    stream: LiveStream,
    joints: JointChannels,
    message: Any,
    reply: Any,
    *,
    now: int,
    horizon_s: float,
) -> None:
    """Takes a JointState, and fills another one with what is predicted after it.

    Args:
        stream: with times in ns.
        joints: of the model.
        message: as received.
        reply: to be published.
        now: ns, used as the stamp of a message that has none.
        horizon_s: from the newest stamp to the time predicted at.

    Raises:
        OffbeatError: the message, or the state it leads to, cannot be used.
    """
    stamp = nanoseconds(message.header.stamp)
    stream.observe(stamp or now, joints.values(message))
    at = int(stream.after(horizon_s) or now)
    joints.fill(reply, stream.predict(at))
    reply.header.frame_id = message.header.frame_id
    set_nanoseconds(reply.header.stamp, at)


def load(model: str) -> LiveStream:
    """A stream of the folder of a run, or of an exported file."""
    options: dict[str, Any] = {"late": "reorder", "time_unit": "ns"}
    if model.endswith(".onnx"):
        from offbeat import OnnxStream

        return OnnxStream(model, **options)
    import torch

    from offbeat import Stream, load_model

    torch.set_num_threads(1)
    return Stream(load_model(model), **options)


def main() -> None:
    """Runs the node until it is interrupted."""
    import rclpy
    from rclpy.node import Node
    from rclpy.qos import qos_profile_sensor_data
    from sensor_msgs.msg import JointState

    class Predictor(Node):  # type: ignore[misc]
        """Subscribes, predicts, publishes; one callback at a time."""

        def __init__(self) -> None:
            super().__init__("offbeat_predictor")
            self.declare_parameter("model", "")
            self.declare_parameter("prefix", "")
            self.declare_parameter("horizon_s", 0.1)
            model = self.get_parameter("model").value
            if not model:
                raise ValueError("name the model: --ros-args -p model:=runs/arm")
            self.horizon_s = float(self.get_parameter("horizon_s").value)
            self.stream = load(model)
            self.joints = JointChannels(self.stream.names, self.get_parameter("prefix").value)
            self.publisher = self.create_publisher(JointState, "predicted_joint_states", 10)
            self.create_subscription(
                JointState, "joint_states", self.receive, qos_profile_sensor_data
            )
            self.create_timer(10.0, self.report)

        def receive(self, message: Any) -> None:
            """Answers a message; an invalid one is logged, and the node continues."""
            reply, now = JointState(), self.get_clock().now().nanoseconds
            try:
                answer(self.stream, self.joints, message, reply, now=now, horizon_s=self.horizon_s)
            except ArithmeticError as error:  # the state is of no use any more
                self.get_logger().error(f"{error}; it is reset")
                self.stream.reset()
            except OffbeatError as error:
                self.get_logger().warning(str(error), throttle_duration_sec=1.0)
            else:
                self.publisher.publish(reply)

        def report(self) -> None:
            """Logs what was counted."""
            counted = {k: v for k, v in self.stream.counters.to_dict().items() if v}
            self.get_logger().info(f"counted: {counted}")

    rclpy.init(args=sys.argv)
    try:
        rclpy.spin(Predictor())
    except KeyboardInterrupt:
        pass
    finally:
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()
