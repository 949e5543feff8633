# SPDX-License-Identifier: Apache-2.0
"""Publishers of joint numbers: in the controller's names, order and numbers.

A node publishes numbers of the actuated joints through these alone. They take
:data:`~pkm_twin.machine.joint_map.ControllerNumbers`, which only a robot's joint map makes: the
type checker finds a conversion that was forgotten.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

import numpy as np

from pkm_twin.bags.definitions import message_definition
from pkm_twin.machine.joint_map import ControllerNumbers
from pkm_twin.messages.fast_decoder import DoublesTemplate
from pkm_twin.messages.stamps import SECOND
from pkm_twin.robot.robot import Robot

if TYPE_CHECKING:
    from pkm_twin.ros.node import TwinNode

JOINT_STATE: Final = "sensor_msgs/msg/JointState"
NUMBERS: Final = "std_msgs/msg/Float64MultiArray"
FIELDS: Final = ("position", "velocity", "effort")


class JointPublisher:
    """Publishes sensor_msgs/JointState, the same fields in each message."""

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
        self._template = DoublesTemplate(
            JOINT_STATE, definition, {"name": names, **arrays}, stamped=True
        )

    def publish(self, stamp: int, *values: ControllerNumbers) -> None:
        """Send the numbers of the fields, shape (n,) each; the stamp in ns."""
        row: Any = values[0] if len(values) == 1 else np.concatenate(values)
        self._publisher.publish(self._template.fill(row, divmod(stamp, SECOND)))


class CommandPublisher:
    """Publishes std_msgs/Float64MultiArray, a number a joint, as effort controllers take it."""

    def __init__(
        self, node: TwinNode, robot: Robot, topic: str, expiry: float | None = None
    ) -> None:
        """Create the topic; ``expiry`` as of ``create_guarded_publisher``, s."""
        self.publisher = node.create_guarded_publisher(topic, expiry)
        message = {"data": [0.0] * robot.joints_count}
        self._template = DoublesTemplate(
            NUMBERS, message_definition(NUMBERS), message, stamped=False
        )

    def publish(self, efforts: ControllerNumbers) -> None:
        """Send efforts, shape (n,)."""
        self.publisher.publish(self._template.fill(efforts))
