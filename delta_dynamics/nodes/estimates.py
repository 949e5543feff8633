# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Estimate payload, contacts and their places from measured efforts.

Only the node ``delta_dynamics`` imports this module.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from geometry_msgs.msg import Inertia, InertiaStamped, Point, PointStamped, Vector3
from std_msgs.msg import Bool, String
from std_srvs.srv import Trigger

from delta_dynamics.estimates.contact import SIGMAS, Contact, ContactMonitor
from delta_dynamics.estimates.isolation import ContactPlace
from delta_dynamics.estimates.payload import PayloadEstimator
from delta_dynamics.feedforward import Torques
from delta_dynamics.torques.uncertainty import FRICTION, MASSES
from pkm_twin.messages.stamps import SECOND
from pkm_twin.robot.robot import Robot
from pkm_twin.ros.joints import JointPublisher, header, wrench_stamped, xyz
from pkm_twin.ros.node import TwinNode
from pkm_twin.streams.monitor import Pace

PAYLOAD_RATE = 250.0
"""Samples a second that the payload is estimated from: errors last longer."""
MAX_SILENCE = 0.1
"""Longest gap in a stream, s; after it the estimates start again."""


class Estimates:
    """``~/payload``, ``~/external_wrench`` and ``~/contact`` of a stream that measures efforts."""

    def __init__(self, node: TwinNode, robot: Callable[[], Robot], frames: tuple[str, str]):
        """Declare the parameters and create the topics that they ask for.

        :param robot: the robot as it is now.
        :param frames: of the base and of the platform.
        """
        self._node, self._robot, self._frames = node, robot, frames
        self.touching = False
        self.contacts = 0
        self._place: ContactPlace | None = None
        self._last = 0
        self._pace = Pace(PAYLOAD_RATE)
        known = robot()
        self._payload = self._create_payload(known)
        self._contact = self._create_contact(known)
        self._warm_up(known)

    def _warm_up(self, robot: Robot) -> None:
        """Compile what a stream's samples call, before there are any."""
        still = np.zeros(robot.joints_count)
        motion = robot.inverse(robot.home()), still, still
        load = None if self._payload is None else PayloadEstimator(robot)
        contact = None if self._contact is None else ContactMonitor(robot)
        for k in range(2):
            if load is not None:
                load.push(float(k), *motion, still)
            if contact is not None:
                contact.push(float(k), motion, still)
        if self._contact is not None:
            self._contact.prepare()

    def _create_payload(self, robot: Robot) -> PayloadEstimator | None:
        node = self._node
        if not node.declare(
            "estimate_payload",
            False,
            "publish ~/payload: the payload estimated from the measured efforts",
        ):
            return None
        self._load = node.create_guarded_publisher("~/payload")
        self._load_deviation = node.create_guarded_publisher("~/payload_deviation")
        node.create_service(Trigger, "~/reset_payload", self._reset_payload)
        return PayloadEstimator(robot)

    def _create_contact(self, robot: Robot) -> ContactMonitor | None:
        node = self._node
        wanted = node.declare(
            "observe_wrench",
            False,
            "publish ~/external_wrench and ~/contact, estimated with a momentum observer",
        )
        bandwidth = node.declare(
            "observer.bandwidth",
            60.0,
            "bandwidth of ~/external_wrench, the inverse of its time constant",
            unit="1/s",
            low=0.1,
            high=1e4,
        )
        sigmas = node.declare(
            "observer.sigmas",
            SIGMAS,
            "contact threshold in standard deviations of model and noise together",
            low=1.0,
            high=1e3,
        )
        if not wanted:
            return None
        self._wrench = node.create_guarded_publisher("~/external_wrench")
        self._effort = JointPublisher(node, robot, "~/external_effort")
        self._event = node.create_guarded_publisher("~/contact")
        self._body = node.create_guarded_publisher("~/contact_body")
        self._point = node.create_guarded_publisher("~/contact_point")
        return ContactMonitor(robot, bandwidth, sigmas)

    def warning(self) -> str:
        """Return the warning to log before the first sample; empty if there is none."""
        if self._contact is None or self._contact.stated:
            return ""
        return (
            "the robot's file has no section uncertainty; the default standard deviation of the "
            f"model's efforts is {100 * MASSES:g} % of the efforts due to masses plus "
            f"{100 * FRICTION:g} % of the largest effort"
        )

    def reset(self) -> None:
        """Prepare for a new stream, whose stamps may be earlier; the estimated load stays."""
        self._last = 0
        self._pace.reset()
        if self._contact is not None:
            self._contact.reset()
        if self._payload is not None:
            self._payload.begin_anew()

    def change_robot(self, robot: Robot) -> None:
        """Another payload, gravity or friction was set."""
        if self._payload is not None:
            self._payload = PayloadEstimator(robot)
        if self._contact is not None:
            self._contact.change_robot(robot)

    def take(self, torques: Torques) -> None:
        """Update the estimates with a sample; without measured efforts nothing changes."""
        if torques.measured is None:
            return
        # The estimates' models have friction without memory.
        effort = torques.measured - torques.memory
        # The stream may have begun anew at earlier stamps, as where a bag loops.
        if not 0 < torques.stamp - self._last <= MAX_SILENCE * SECOND:
            self.reset()
        self._last = torques.stamp
        if self._contact is not None:
            self._take_contact(self._contact, torques, effort)
        if self._payload is not None and self._pace.due(torques.stamp):
            self._pace.answered(torques.stamp)
            self._take_payload(self._payload, torques, effort)

    @property
    def wanted(self) -> bool:
        """Whether anything is estimated."""
        return self._contact is not None or self._payload is not None

    @property
    def idle(self) -> bool:
        """Whether the drives are off or braked, so that their efforts are left out."""
        return any(core is not None and core.drives.idle for core in (self._contact, self._payload))

    def diagnose(self) -> dict[str, object]:
        """Values of the node's diagnostic status."""
        values: dict[str, object] = {}
        if self.wanted:
            values["drives off or braked"] = self.idle
        if self._contact is not None:
            values |= {"contact": self.touching, "contacts": self.contacts}
            if self._place is not None:
                one = self._place
                values["struck"] = f"{one.where}, confidence {one.confidence:.2f}"
                values["struck body"] = f"{one.body}, {one.deviation:.2g} m along it"
            values["model uncertainty"] = "robot file" if self._contact.stated else "default"
        if self._payload is not None:
            found = self._payload.estimate()
            value = f"{found.mass:.4g} +- {found.mass_deviation:.2g}"
            if found.asked < 0.0:
                value += f", bounded to zero: the efforts give {found.asked:.4g}"
            values["payload estimate (kg)"] = value
            values["payload changes detected"] = found.resets
        return values

    def _take_contact(self, core: ContactMonitor, torques: Torques, effort: Any) -> None:
        found = core.push(torques.stamp / SECOND, torques.motion, effort, torques.wrench, torques.doubt)
        if found is None:
            return
        if not found.idle:
            self._publish_contact(torques.stamp, found)
        if found.touching != self.touching:
            self.touching = found.touching
            self.contacts += found.touching
            self._event.publish(Bool(data=found.touching))
        if found.place is not self._place:
            self._publish_place(torques.stamp, found.place)

    def _publish_place(self, stamp: int, place: ContactPlace | None) -> None:
        before, self._place = self._place, place
        where = "" if place is None else place.where
        if where != ("" if before is None else before.where):
            self._body.publish(String(data=where))
        if place is not None:
            own = header(stamp, self._frames[0])
            self._point.publish(PointStamped(header=own, point=xyz(Point, place.point)))

    def _publish_contact(self, stamp: int, found: Contact) -> None:
        self._wrench.publish(wrench_stamped(stamp, self._frames[0], found.wrench))
        own = self._robot().controller
        self._effort.publish(stamp, own.controller_efforts(found.external))

    def _take_payload(self, core: PayloadEstimator, torques: Torques, effort: Any) -> None:
        found = core.push(torques.stamp / SECOND, *torques.motion, effort, torques.wrench, torques.doubt)
        if found is None:
            return
        pairs = (
            (self._load, found.mass, found.com),
            (self._load_deviation, found.mass_deviation, found.com_deviation),
        )
        for publisher, mass, com in pairs:
            inertia = Inertia(m=mass, com=xyz(Vector3, com))
            own = header(torques.stamp, self._frames[1])
            publisher.publish(InertiaStamped(header=own, inertia=inertia))

    def _reset_payload(self, _request: Any, response: Any) -> Any:
        if self._payload is not None:
            self._payload.reset()
        response.success, response.message = True, "the payload estimate was reset"
        return response
