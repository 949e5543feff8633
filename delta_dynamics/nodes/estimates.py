# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Estimate payload, contacts and their places from measured efforts.

Only the node ``delta_dynamics`` imports this module.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from geometry_msgs.msg import Inertia, InertiaStamped, Point, PointStamped, Vector3
from std_msgs.msg import Bool, String

from delta_dynamics.estimates.contact import CONTACT_SIGMAS, Contact, ContactMonitor
from delta_dynamics.estimates.isolation import ContactPlace
from delta_dynamics.estimates.payload import PayloadEstimator
from delta_dynamics.feedforward import Torques
from delta_dynamics.torques.uncertainty import DEFAULT_FRICTION_ERROR, DEFAULT_MASS_ERROR
from pkm_twin.messages.stamps import SECOND
from pkm_twin.robot.robot import Robot
from pkm_twin.ros.joints import JointPublisher, header, make_wrench_message, xyz
from pkm_twin.ros.node import TwinNode
from pkm_twin.streams.monitor import Pace


class Estimates:
    """Publish ``~/payload``, ``~/external_wrench`` and ``~/contact`` from measured efforts."""

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
        # 250 samples a second are enough, because errors of efforts are correlated over a longer time.
        self._pace = Pace(250.0)
        self._payload: PayloadEstimator | None = None
        self._contact: ContactMonitor | None = None
        known = robot()
        still = np.zeros(known.joints_count)
        motion = known.inverse(known.home()), still, still
        if node.declare(
            "estimate_payload", False, "publish ~/payload: the payload estimated from the measured efforts"
        ):
            self._load = node.create_guarded_publisher("~/payload")
            self._load_deviation = node.create_guarded_publisher("~/payload_deviation")
            node.create_trigger("~/reset_payload", self._reset_payload)
            self._payload = PayloadEstimator(known)
            # Push two samples, which compile the programs of a stream.
            first = PayloadEstimator(known)
            for k in range(2):
                first.push(float(k), *motion, still)
        enabled = node.declare(
            "observe_wrench", False, "publish ~/external_wrench and ~/contact, estimated with a momentum observer"
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
            CONTACT_SIGMAS,
            "contact threshold in standard deviations of model and noise together",
            low=1.0,
            high=1e3,
        )
        if not enabled:
            return
        self._wrench = node.create_guarded_publisher("~/external_wrench")
        self._effort = JointPublisher(node, known, "~/external_effort")
        self._event = node.create_guarded_publisher("~/contact")
        self._body = node.create_guarded_publisher("~/contact_body")
        self._point = node.create_guarded_publisher("~/contact_point")
        self._contact = ContactMonitor(known, bandwidth, sigmas)
        self._contact.prepare()
        for k in range(2):
            self._contact.push(float(k), motion, still)
        self._contact.reset()

    def warning(self) -> str:
        """Return the warning to log before the first sample; empty if there is none."""
        if self._contact is None or self._contact.stated:
            return ""
        return (
            "the robot's file has no section uncertainty; the default standard deviation of the "
            f"model's efforts is {100 * DEFAULT_MASS_ERROR:g} % of the efforts due to masses plus "
            f"{100 * DEFAULT_FRICTION_ERROR:g} % of the largest effort"
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
        """Use a robot with another payload, gravity or friction."""
        if self._payload is not None:
            self._payload = PayloadEstimator(robot)
        if self._contact is not None:
            self._contact.change_robot(robot)

    def update(self, torques: Torques) -> None:
        """Update the estimates with a sample; without measured efforts nothing changes."""
        if torques.measured is None:
            return
        # The estimates' models have friction without memory.
        effort = torques.measured - torques.memory
        # The stream may have begun again at earlier stamps, as a bag that loops, or after a gap of 0.1 s.
        if not 0 < torques.stamp - self._last <= SECOND // 10:
            self.reset()
        self._last = torques.stamp
        if self._contact is not None:
            found = self._contact.push(
                torques.stamp / SECOND, torques.motion, effort, torques.wrench, torques.rate_error
            )
            if found is not None:
                self._publish_contact(torques.stamp, found)
        if self._payload is not None and self._pace.due(torques.stamp):
            self._pace.answered(torques.stamp)
            load = self._payload.push(
                torques.stamp / SECOND, *torques.motion, effort, torques.wrench, torques.rate_error
            )
            if load is not None:
                own = header(torques.stamp, self._frames[1])
                for publisher, mass, com in (
                    (self._load, load.mass, load.com),
                    (self._load_deviation, load.mass_deviation, load.com_deviation),
                ):
                    publisher.publish(InertiaStamped(header=own, inertia=Inertia(m=mass, com=xyz(Vector3, com))))

    @property
    def enabled(self) -> bool:
        """True if a payload or contacts are estimated."""
        return self._contact is not None or self._payload is not None

    @property
    def idle(self) -> bool:
        """True if the drives are off or braked, so that their efforts are left out."""
        return any(core is not None and core.drives.idle for core in (self._contact, self._payload))

    def diagnose(self) -> dict[str, object]:
        """Return values of the node's diagnostic status."""
        values: dict[str, object] = {}
        if self.enabled:
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

    def _publish_contact(self, stamp: int, found: Contact) -> None:
        """Publish the external wrench and efforts; contact and place only when they change."""
        own = header(stamp, self._frames[0])
        if not found.idle:
            self._wrench.publish(make_wrench_message(stamp, self._frames[0], found.wrench))
            self._effort.publish(stamp, self._robot().controller.controller_efforts(found.external))
        if found.touching != self.touching:
            self.touching = found.touching
            self.contacts += found.touching
            self._event.publish(Bool(data=found.touching))
        before, self._place = self._place, found.place
        if found.place is before:
            return
        where = "" if found.place is None else found.place.where
        if where != ("" if before is None else before.where):
            self._body.publish(String(data=where))
        if found.place is not None:
            self._point.publish(PointStamped(header=own, point=xyz(Point, found.place.point)))

    def _reset_payload(self) -> str:
        if self._payload is not None:
            self._payload.reset()
        return "the payload estimate was reset"
