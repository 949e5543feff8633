# SPDX-License-Identifier: Apache-2.0
"""Numbers and shapes as messages, and the publishers of transforms.

Needs message classes, not rclpy.
"""

from __future__ import annotations

from array import array
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Final

from builtin_interfaces.msg import Duration, Time
from geometry_msgs.msg import (
    Point,
    PoseStamped,
    Quaternion,
    TransformStamped,
    TwistStamped,
    Vector3,
)
from numpy.typing import NDArray
from sensor_msgs.msg import JointState
from std_msgs.msg import ColorRGBA
from visualization_msgs.msg import Marker, MarkerArray

from pkm_twin.machine import rotations
from pkm_twin.messages.stamps import SECOND
from pkm_twin.streams.wrench import Mount

if TYPE_CHECKING:
    from pkm_twin.ros.node import TwinNode
    from pkm_twin.state.scene import Shape

KINDS: Final = {
    "cylinder": Marker.CYLINDER,
    "sphere": Marker.SPHERE,
    "arrow": Marker.ARROW,
    "line": Marker.LINE_STRIP,
    "text": Marker.TEXT_VIEW_FACING,
}


def joint_state(
    stamp: Time, names: Sequence[str], values: NDArray[Any], rates: NDArray[Any] | None = None
) -> JointState:
    """Positions, and velocities where there are any, by name."""
    message = JointState(name=list(names), position=array("d", values))
    if rates is not None:
        message.velocity = array("d", rates)
    message.header.stamp = stamp
    return message


def pose(stamp: Time, frame: str, position: NDArray[Any], turn: NDArray[Any]) -> PoseStamped:
    """A place (3,) and a quaternion x y z w."""
    message = PoseStamped()
    message.header.stamp, message.header.frame_id = stamp, frame
    message.pose.position, message.pose.orientation = _point(position), _quaternion(turn)
    return message


def twist(stamp: Time, frame: str, values: NDArray[Any]) -> TwistStamped:
    """Velocity and angular velocity, shape (6,)."""
    message = TwistStamped()
    message.header.stamp, message.header.frame_id = stamp, frame
    message.twist.linear, message.twist.angular = _vector(values[:3]), _vector(values[3:])
    return message


def transform(
    stamp: Time, frame: str, child: str, position: NDArray[Any], turn: NDArray[Any]
) -> TransformStamped:
    """From a frame to its child."""
    message = TransformStamped(child_frame_id=child)
    message.header.stamp, message.header.frame_id = stamp, frame
    message.transform.translation = _vector(position)
    message.transform.rotation = _quaternion(turn)
    return message


def markers(stamp: Time, frame: str, shapes: Iterable[Shape], lifetime: Duration) -> MarkerArray:
    """Shapes as markers; those that do not last are drawn for ``lifetime``."""
    array_of = MarkerArray()
    for shape in shapes:
        marker = Marker(ns=shape.group, id=shape.number, type=KINDS[shape.kind], text=shape.text)
        marker.header.stamp, marker.header.frame_id = stamp, frame
        marker.pose.position = _point(shape.position)
        marker.pose.orientation = _quaternion(shape.quaternion)
        marker.scale = _vector(shape.size)
        marker.points = [_point(point) for point in shape.points]
        r, g, b, a = shape.colour
        marker.color = ColorRGBA(r=r, g=g, b=b, a=a)
        if not shape.lasting:
            marker.lifetime = lifetime
        array_of.markers.append(marker)
    return array_of


class Transforms:
    """Publishers of ``/tf`` (base to platform) and ``/tf_static`` (platform to tool).

    :param frames: names of the frames ``platform`` and ``tool``; ``tool``: where it stands.
    :param platform: whether base to platform is published here.
    :raises ImportError: tf2_msgs is not installed.
    """

    def __init__(
        self, node: TwinNode, base: str, frames: Mapping[str, str], tool: Mount, platform: bool
    ) -> None:
        from tf2_msgs.msg import TFMessage

        self._message = TFMessage
        self._base, self._frames, self._tool = base, frames, tool
        self.platform = platform
        self._static = node.create_guarded_publisher("/tf_static")
        self._moving = node.create_guarded_publisher("/tf") if platform else None

    def send_tool(self, now: int) -> None:
        """Platform to tool, once and for all; ``now`` in ns."""
        sec, nanosec = divmod(now, SECOND)
        turn = rotations.to_quaternion(self._tool.rotation)
        self._static.publish(
            self._message(
                transforms=[
                    transform(
                        Time(sec=sec, nanosec=nanosec),
                        self._frames["platform"],
                        self._frames["tool"],
                        self._tool.position,
                        turn,
                    )
                ]
            )
        )

    def send_platform(self, stamp: Time, position: NDArray[Any], turn: NDArray[Any]) -> None:
        """Base to platform."""
        if self._moving is not None:
            found = transform(stamp, self._base, self._frames["platform"], position, turn)
            self._moving.publish(self._message(transforms=[found]))


def _point(values: Sequence[float] | NDArray[Any]) -> Point:
    x, y, z = map(float, values)
    return Point(x=x, y=y, z=z)


def _vector(values: Sequence[float] | NDArray[Any]) -> Vector3:
    x, y, z = map(float, values)
    return Vector3(x=x, y=y, z=z)


def _quaternion(values: Sequence[float] | NDArray[Any]) -> Quaternion:
    x, y, z, w = map(float, values)
    return Quaternion(x=x, y=y, z=z, w=w)
