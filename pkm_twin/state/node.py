# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""The node ``machine_state``: joint states in; all joints, the platform's motion, markers out."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from functools import partial
from typing import Any, Final

import numpy as np
from geometry_msgs.msg import (
    Point,
    Pose,
    PoseStamped,
    Quaternion,
    Transform,
    TransformStamped,
    Twist,
    TwistStamped,
    Vector3,
)
from numpy.typing import NDArray
from rclpy.duration import Duration
from std_msgs.msg import ColorRGBA, String
from visualization_msgs.msg import Marker, MarkerArray

from pkm_twin.errors import ParameterError, PkmTwinError
from pkm_twin.machine import rotations
from pkm_twin.messages.fast_decoder import JointStateView
from pkm_twin.robot.robot import Robot
from pkm_twin.robot.robot_urdf import joint_names, robot_urdf
from pkm_twin.ros.joints import header, make_joint_state, xyz
from pkm_twin.ros.node import TwinNode
from pkm_twin.ros.run import run
from pkm_twin.ros.wrench import declare_mounts, declare_vector
from pkm_twin.settings import list_changeable, with_parameters
from pkm_twin.state.scene import Scales, Scene, WrenchEffects
from pkm_twin.state.state import (
    STATE_TOPICS,
    MachineState,
    make_state_program,
    make_state_program_with_velocities,
)
from pkm_twin.streams.monitor import Pace
from pkm_twin.streams.wrench import PLATFORM, Mount, WrenchSettings
from stiffness_monitor.compliance import kernels, member_deflections, platform_response

MARKER_TYPES: Final = {
    "cylinder": Marker.CYLINDER,
    "sphere": Marker.SPHERE,
    "arrow": Marker.ARROW,
    "line": Marker.LINE_STRIP,
    "text": Marker.TEXT_VIEW_FACING,
}


def make_transform(stamp: int, frame: str, child: str, position: NDArray[Any], turn: NDArray[Any]) -> TransformStamped:
    """Make the message of a frame's transform to its child: position (3,), quaternion x y z w."""
    moved = Transform(translation=xyz(Vector3, position), rotation=xyz(Quaternion, turn))
    return TransformStamped(header=header(stamp, frame), child_frame_id=child, transform=moved)


class Transforms:
    """Publishers of ``/tf`` (base to platform) and ``/tf_static`` (platform to tool).

    :param frames: names of the frames ``platform`` and ``tool``.
    :param tool: pose of the tool on the platform.
    :param platform: whether to publish the transform from base to platform.
    :raises ImportError: tf2_msgs is not installed.
    """

    def __init__(self, node: TwinNode, base: str, frames: Mapping[str, str], tool: Mount, platform: bool) -> None:
        from tf2_msgs.msg import TFMessage

        self._message = TFMessage
        self._base, self._frames, self._tool = base, frames, tool
        self.platform = platform
        self._static = node.create_guarded_publisher("/tf_static")
        self._moving = node.create_guarded_publisher("/tf") if platform else None

    def send_tool(self, now: int) -> None:
        """Publish the static transform from platform to tool; ``now`` in ns."""
        turn = rotations.to_quaternion(self._tool.rotation)
        names = self._frames["platform"], self._frames["tool"]
        found = make_transform(now, *names, self._tool.position, turn)
        self._static.publish(self._message(transforms=[found]))

    def send_platform(self, stamp: int, position: NDArray[Any], turn: NDArray[Any]) -> None:
        """Publish the transform from base to platform, if it is published here."""
        if self._moving is not None:
            found = make_transform(stamp, self._base, self._frames["platform"], position, turn)
            self._moving.publish(self._message(transforms=[found]))


class MachineStateNode(TwinNode):
    """The node ``machine_state``, for rviz2, Foxglove, robot_state_publisher and plots."""

    topics = STATE_TOPICS

    def __init__(self) -> None:
        super().__init__("machine_state")
        robot = self.declare_robot()
        settings = self.declare_settings(WrenchSettings)
        self._frames = {
            "platform": self._declare_frame("platform_frame", PLATFORM, "of the platform, at its reference point"),
            "tool": self._declare_frame("tool_frame", "tool0", "of the tool"),
        }
        self._tool = Mount.of(
            declare_vector(
                self, "tool.xyz", "position of the tool from the platform's reference point, platform axes", "m"
            ),
            declare_vector(self, "tool.rpy", "roll, pitch and yaw of the tool relative to the platform", "rad"),
        )
        mounts = declare_mounts(self, self._frames["platform"])
        self.core = MachineState(robot, settings, mounts)
        self.core.pace = Pace(
            self.declare(
                "rate",
                100.0,
                "largest rate of ~/joint_states, ~/pose and ~/twist; 0: every sample",
                unit="Hz",
                low=0.0,
                high=1e4,
            )
        )
        self._scene = Scene(robot, self.declare_settings(Scales, fixed=True))
        self._elastic = _warm_up(robot)
        self._joints = self.create_guarded_publisher("~/joint_states")
        self._pose = self.create_guarded_publisher("~/pose")
        self._twist = self.create_guarded_publisher("~/twist")
        self._description = self.create_guarded_publisher("robot_description")
        # Only on request: a controller_manager that reads the description loads this hardware.
        hardware = self.declare(
            "hardware_plugin",
            "",
            "hardware plugin in the ros2_control element of robot_description; empty: no such element",
        )
        self._urdf = robot_urdf(robot, hardware)
        self._names = joint_names(robot, hardware)
        self._transforms = self._create_transforms()
        self._drawn = 0
        """Stamp of the state that was drawn last, ns."""
        text = "largest rate of ~/markers; 0: none"
        rate = self.declare("markers_rate", 20.0, text, unit="Hz", low=0.0, high=1000.0)
        if rate > 0.0:
            self._markers = self.create_guarded_publisher("~/markers")
            self.create_guarded_timer(1.0 / rate, self._publish_markers)
        self.create_guarded_subscription(
            "joint_states",
            self._on_joint_state,
            on_reject=partial(self.core.count_rejection, self.core.states),
            expected=True,
        )
        self.create_guarded_subscription("wrench", lambda m: self.core.store_wrench(m, self.now()))
        self.follow(
            list_changeable(WrenchSettings),
            lambda values: with_parameters(self.core.settings, values),
            self.core.change_settings,
        )
        self.start()

    def details(self) -> str:
        """Describe passive joints, members and transforms."""
        members = "elastic" if self._elastic else "rigid"
        transforms = "" if self._transforms else "; no transforms"
        return f" and {len(self.core.robot.passive_joints)} passive, {members} members{transforms}"

    def time_jumped_backward(self) -> None:
        """Forget all states after the clock jumped backward."""
        self.core.reset()
        self._transforms_pace.reset()
        self._drawn = 0

    def activated(self) -> None:
        """Publish the URDF and the tool's transform once; forget earlier states."""
        self.time_jumped_backward()
        self._description.publish(String(data=self._urdf))
        if self._transforms is not None:
            self._transforms.send_tool(self.now())

    def values(self) -> dict[str, object]:
        """Return the values of the node's diagnostic status."""
        core = self.core
        return {
            "older stamps dropped": core.dropped,
            "velocities": "" if core.latest is None else str(core.latest.twist is not None).lower(),
            **core.states.counts("joint states", "answered"),
            **core.wrenches.counts("wrenches"),
        }

    def _declare_frame(self, name: str, default: str, text: str) -> str:
        frame: str = self.declare(name, default, f"frame id {text}")
        if not frame:
            raise ParameterError(name, frame, "a frame's name")
        return frame

    def _create_transforms(self) -> Transforms | None:
        """Create the publishers of ``/tf`` and ``/tf_static``; None without tf2_msgs."""
        wanted = self.declare(
            "publish_tf",
            "all",
            "transforms to publish: all (base to platform, platform to tool), tool (if "
            "robot_state_publisher publishes the platform) or none",
            choices=("all", "tool", "none"),
        )
        rate = self.declare(
            "tf_rate", 100.0, "largest rate of the transform from base to platform", unit="Hz", low=0.1, high=1e4
        )
        self._transforms_pace = Pace(rate)
        if wanted == "none":
            return None
        try:
            return Transforms(self, self.core.settings.base_frame, self._frames, self._tool, wanted == "all")
        except ImportError as error:
            self.get_logger().warning(f"tf2_msgs is missing, so no transforms are published ({error})")
            return None

    def _on_joint_state(self, message: JointStateView) -> None:
        state = self.core.joint_state(message, self.now())
        if state is None:
            return
        own = header(state.stamp, self.core.settings.base_frame)
        quaternion = rotations.to_quaternion(state.rotation)
        rates = () if state.rates is None else state.rates
        self._joints.publish(make_joint_state(header(state.stamp), self._names, state.joints, rates))
        place = Pose(position=xyz(Point, state.position), orientation=xyz(Quaternion, quaternion))
        self._pose.publish(PoseStamped(header=own, pose=place))
        if state.twist is not None:
            linear, angular = xyz(Vector3, state.twist[:3]), xyz(Vector3, state.twist[3:])
            twist = Twist(linear=linear, angular=angular)
            self._twist.publish(TwistStamped(header=own, twist=twist))
        if self._transforms is None or not self._transforms.platform:
            return
        if self._transforms_pace.due(state.stamp):
            self._transforms_pace.answered(state.stamp)
            self._transforms.send_platform(state.stamp, state.position, quaternion)

    def _publish_markers(self) -> None:
        """Publish markers of the latest state; a timer limits their rate, as they take time."""
        state = self.core.latest
        if not self.active or state is None or state.stamp == self._drawn:
            return
        if not self._markers.get_subscription_count():
            return
        self._drawn = state.stamp
        own = header(state.stamp, self.core.settings.base_frame)
        lifetime = Duration(seconds=1.0).to_msg()
        markers = MarkerArray()
        robot, effects = self.core.robot, None
        wrench = self.core.find_wrench(state) if self._elastic else None
        if wrench is not None:
            try:
                found = platform_response(robot, state.q, wrench)
                effects = WrenchEffects(
                    wrench,
                    found.compliance,
                    found.deflection,
                    dict(zip(found.elements, found.factors.tolist(), strict=True)),
                    str(found.dominant),
                    member_deflections(robot, state.q, wrench),
                )
            except (PkmTwinError, ValueError) as error:
                self.log_throttled("load", f"~/markers: without the load: {error}")
        for shape in self._scene.shapes(state, effects):
            marker = Marker(header=own, ns=shape.group, id=shape.number, type=MARKER_TYPES[shape.kind])
            marker.text = shape.text
            marker.pose.position = xyz(Point, shape.position)
            marker.pose.orientation = xyz(Quaternion, shape.quaternion)
            marker.scale = xyz(Vector3, shape.size)
            marker.points = [xyz(Point, point) for point in shape.points]
            marker.color = ColorRGBA(**dict(zip("rgba", shape.colour, strict=True)))
            if not shape.lasting:
                marker.lifetime = lifetime
            markers.markers.append(marker)
        self._markers.publish(markers)


def _warm_up(robot: Robot) -> bool:
    """Compile, or load, all programs before the node's topics exist; return whether the robot is elastic."""
    for kernel in (make_state_program(robot), make_state_program_with_velocities(robot)):
        kernel.warm_up()
    home = robot.inverse(robot.home())
    robot.placements(home)
    try:
        for kernel in kernels(robot):
            kernel.warm_up()
    except ParameterError:
        return False
    member_deflections(robot, home, np.zeros(6))
    return True


NODE = MachineStateNode
"""The class of this module's node, for processes of one or several nodes."""

if __name__ == "__main__":
    sys.exit(run(NODE))
