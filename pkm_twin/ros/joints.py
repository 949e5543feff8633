# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Make messages with a header, and publish joint values as the controller has them.

Nodes publish values of the actuated joints only through these classes. They take
:data:`~pkm_twin.machine.joint_map.ControllerNumbers`, which only a robot's joint map makes, so
that the type checker finds a missing conversion.
"""

from __future__ import annotations

from array import array
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from geometry_msgs.msg import Vector3, Wrench, WrenchStamped
from rclpy.duration import Duration
from rclpy.time import Time
from sensor_msgs.msg import JointState
from std_msgs.msg import Header

from pkm_twin.bags.definitions import JOINT_STATE, message_definition
from pkm_twin.codegen.arrays import Array
from pkm_twin.machine.joint_map import ControllerNumbers
from pkm_twin.messages.fast_decoder import DoublesTemplate
from pkm_twin.messages.stamps import SECOND
from pkm_twin.robot.effort_limits import LimitedEfforts
from pkm_twin.robot.robot import Robot

if TYPE_CHECKING:
    from pkm_twin.ros.node import TwinNode

NUMBER_ARRAY: Final = "std_msgs/msg/Float64MultiArray"
FIELDS: Final = ("position", "velocity", "effort")


def header(stamp: int, frame: str = "") -> Header:
    """Return a header with a stamp, ns."""
    return Header(stamp=Time(nanoseconds=stamp).to_msg(), frame_id=frame)


def xyz(kind: Any, values: Iterable[float]) -> Any:
    """Return a message of numbers x, y, z and, if there are four, w."""
    return kind(**dict(zip("xyzw", map(float, values), strict=False)))


def make_wrench_message(stamp: int, frame: str, wrench: Array) -> WrenchStamped:
    """Return a wrench message, values (6,), N and N m, along the axes of a frame."""
    force, torque = xyz(Vector3, wrench[:3]), xyz(Vector3, wrench[3:])
    return WrenchStamped(header=header(stamp, frame), wrench=Wrench(force=force, torque=torque))


def make_joint_state(
    header: Header,
    names: Sequence[str],
    values: Sequence[float],
    rates: Sequence[float] = (),
    efforts: Sequence[float] = (),
) -> JointState:
    """Make a joint state of named values, for plotting tools."""
    position, velocity, effort = (array("d", row) for row in (values, rates, efforts))
    return JointState(header=header, name=list(names), position=position, velocity=velocity, effort=effort)


class JointPublisher:
    """Publish sensor_msgs/JointState with the same fields in each message."""

    def __init__(
        self,
        node: TwinNode,
        robot: Robot,
        topic: str,
        fields: tuple[str, ...] = ("effort",),
        expiry: float | None = None,
    ) -> None:
        """Create the topic.

        :param fields: some of :data:`FIELDS`, in their order.
        :param expiry: as of ``create_guarded_publisher``, s.
        """
        self._publisher = node.create_guarded_publisher(topic, expiry)
        names = list(robot.controller.names)
        arrays = {what: [0.0] * len(names) if what in fields else [] for what in FIELDS}
        definition = message_definition(JOINT_STATE)
        self._template = DoublesTemplate(JOINT_STATE, definition, {"name": names, **arrays}, stamped=True)

    def publish(self, stamp: int, *values: ControllerNumbers) -> None:
        """Publish the values of the fields, shape (n,) each; the stamp in ns."""
        row: Any = values[0] if len(values) == 1 else np.concatenate(values)
        self._publisher.publish(self._template.fill(row, divmod(stamp, SECOND)))


class EffortPublisher:
    """Publish efforts with names and a stamp, and as plain numbers for effort controllers.

    Efforts leave a node through this class alone. It takes
    :data:`~pkm_twin.robot.effort_limits.LimitedEfforts`, which only the limits make.
    """

    def __init__(
        self,
        node: TwinNode,
        robot: Robot,
        stamped: str,
        plain: str,
        expiry: float | None = None,
        *,
        with_plain: bool = True,
    ) -> None:
        """Create the topics.

        :param stamped: topic of sensor_msgs/JointState; ``plain``: topic of
            std_msgs/Float64MultiArray, a number per joint, created if ``with_plain`` is true.
        :param expiry: as of ``create_guarded_publisher``, s.
        """
        self._stamped = JointPublisher(node, robot, stamped, expiry=expiry)
        self._plain = node.create_guarded_publisher(plain, expiry) if with_plain else None
        message = {"data": [0.0] * robot.joints_count}
        self._template = DoublesTemplate(NUMBER_ARRAY, message_definition(NUMBER_ARRAY), message, stamped=False)

    @property
    def controller_count(self) -> int:
        """Number of subscribers of the plain numbers."""
        return 0 if self._plain is None else self._plain.get_subscription_count()

    def publish(self, stamp: int, efforts: LimitedEfforts) -> None:
        """Publish efforts, shape (n,); the stamp in ns."""
        if self._plain is not None:
            self._plain.publish(self._template.fill(efforts))
        self._stamped.publish(stamp, efforts)

    def wait_for_controllers(self) -> None:
        """Wait until the controllers have acknowledged the last numbers, at most 0.5 s."""
        if self._plain is not None:
            self._plain.wait_for_all_acked(Duration(seconds=0.5))
