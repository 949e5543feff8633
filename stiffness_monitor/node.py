# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""The node ``stiffness_monitor``: wrenches in, compliance and dominant element out.

With measured deflections, the elements that have departed from the file. In addition, the natural
frequencies of the pose, which need joint states alone.
"""

from __future__ import annotations

import math
import sys
from array import array
from functools import partial
from typing import Final

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import Quaternion, TransformStamped, Vector3, WrenchStamped
from std_msgs.msg import Float64MultiArray, Header, MultiArrayDimension, String

from pkm_twin.errors import PkmTwinError
from pkm_twin.ros import health
from pkm_twin.ros.joints import header, make_joint_state, xyz
from pkm_twin.ros.node import TwinNode
from pkm_twin.ros.run import run
from pkm_twin.ros.wrench import declare_mounts
from pkm_twin.settings import list_changeable, with_parameters
from pkm_twin.streams.monitor import Pace
from pkm_twin.streams.wrench import PLATFORM
from stiffness_monitor.alarm_node import StiffnessAlarmTopics
from stiffness_monitor.compliance import kernels
from stiffness_monitor.correction_node import SetpointCorrection
from stiffness_monitor.frame import DIRECTIONS
from stiffness_monitor.modes import has_modes, natural_frequencies
from stiffness_monitor.monitor import Answer, Monitor, Settings
from stiffness_monitor.topics import STIFFNESS

UPPER_TRIANGLE: Final = np.triu_indices(6)
ENTRIES: Final = tuple(f"{DIRECTIONS[i]}_{DIRECTIONS[j]}" for i, j in zip(*UPPER_TRIANGLE, strict=True))
"""Names of the compliance's entries: displacement, then force or moment."""


class StiffnessMonitor(TwinNode):
    """Publish live compliance and strain energy of any robot with elastic members."""

    topics = STIFFNESS
    core: Monitor

    def __init__(self) -> None:
        super().__init__("stiffness_monitor")
        robot = self.declare_robot("upr_rpu")
        for kernel in kernels(robot):
            kernel.warm_up()
        settings = self.declare_settings(Settings)
        given = self.declare(
            "platform_frame",
            "",
            "frame of ~/deflection; empty: wrench_frame if it moves with the platform and the "
            "sensor is at the reference point, else `platform`",
        )
        mounts = declare_mounts(self, given or PLATFORM)
        self._platform_frame = given or ("" if mounts is None else PLATFORM)
        self.core = Monitor(robot, settings, mounts)
        text = "largest rate of messages, by the stamps of the wrenches; 0: one for each wrench"
        self.core.pace = Pace(self.declare("rate", 0.0, text, unit="Hz", low=0.0, high=1e4))
        self._correction = SetpointCorrection(self, robot, settings.stamp_rules)
        self._alarm = StiffnessAlarmTopics(
            self, robot, settings.stamp_rules, (settings.base_frame, self._platform_frame or settings.platform_frame)
        )
        # Plots need stamps and numbers: messages without them have a second topic.
        self._outputs = [
            (self.create_guarded_publisher(topic), make)
            for topic, make in (
                ("~/compliance", _compliance_message),
                (
                    "~/compliance_stamped",
                    lambda a: make_joint_state(self._base_header(a), ENTRIES, a.compliance[UPPER_TRIANGLE].tolist()),
                ),
                ("~/strain_energy", self._energies_message),
                (
                    "~/strain_energy_stamped",
                    lambda a: make_joint_state(
                        self._base_header(a),
                        a.energy.elements,
                        a.energy.factors.tolist(),
                        efforts=a.energy.energies.tolist(),
                    ),
                ),
                ("~/dominant_element", lambda answer: String(data=answer.energy.dominant)),
                ("~/deflection", self._deflection_message),
            )
        ]
        self._published_stamp = 0
        """Stamp of the joint state whose frequencies were published last."""
        rate = self.declare(
            "frequencies_rate", 10.0, "largest rate of ~/natural_frequencies; 0: none", unit="Hz", low=0.0, high=1000.0
        )
        if rate > 0.0 and has_modes(robot):
            # Compile now: the first call would block a callback.
            natural_frequencies(robot, robot.home())
            self._frequencies = self.create_guarded_publisher("~/natural_frequencies")
            self._frequencies_stamped = self.create_guarded_publisher("~/natural_frequencies_stamped")
            self.create_guarded_timer(1.0 / rate, self._publish_frequencies)
        self.create_guarded_subscription(
            "joint_states",
            lambda message: self.core.joint_state(message, self.now()),
            on_reject=partial(self.core.count_rejection, self.core.states),
            expected=True,
        )
        self.create_guarded_subscription("wrench", self._on_wrench)
        self.follow(
            list_changeable(Settings), lambda values: with_parameters(self.core.settings, values), self._change_settings
        )
        self.start()

    def details(self) -> str:
        """Return the wrench's frame, for the start message."""
        return f", wrench in {self.core.settings.wrench_frame}"

    def time_jumped_backward(self) -> None:
        """Discard all stored samples."""
        self.core.reset()
        self._correction.reset()
        self._alarm.reset()
        self._published_stamp = 0

    def worst_status(self) -> tuple[bytes, str]:
        """Return level and message of the node's diagnostic status."""
        if self._alarm.departures:
            return health.WARN, self._alarm.warning()
        return super().worst_status()

    def values(self) -> dict[str, object]:
        """Return the values of the node's diagnostic status."""
        core = self.core
        return {
            "older stamps dropped": core.dropped,
            **core.states.counts("joint states"),
            **core.wrenches.counts("wrenches", "answered"),
            **self._correction.diagnose(),
            **self._alarm.diagnose(),
        }

    def activated(self) -> None:
        """Discard samples from before the activation."""
        self.core.reset()
        self._alarm.reset()

    def _change_settings(self, settings: Settings) -> None:
        """Apply new settings to the monitor, the correction and the alarm."""
        self.core.change_settings(settings)
        self._correction.change_rules(settings.stamp_rules)
        platform = self._platform_frame or settings.platform_frame
        self._alarm.change_rules(settings.stamp_rules, (settings.base_frame, platform))

    def _on_wrench(self, message: WrenchStamped) -> None:
        answer = self.core.wrench(message, self.now())
        if answer is None:
            return
        for publisher, make in self._outputs:
            # Make only the messages that have a subscriber, because making them takes most of the time.
            if publisher.get_subscription_count():
                publisher.publish(make(answer))
        self.call_further_outputs("correction or alarm", answer, self._correction.update, self._alarm.update)

    def _publish_frequencies(self) -> None:
        """Publish the frequencies of the latest joint state, at most at ``frequencies_rate``."""
        latest = self.core.latest
        if not self.active or latest is None or latest[0] == self._published_stamp:
            return
        listeners = (self._frequencies, self._frequencies_stamped)
        if not any(publisher.get_subscription_count() for publisher in listeners):
            return
        self._published_stamp, q = latest
        robot = self.core.robot
        try:
            values = natural_frequencies(robot, robot.forward(q))
        except (PkmTwinError, ValueError) as error:
            self.log_throttled("natural frequencies", f"no natural frequencies: {error}")
            return
        message = Float64MultiArray(data=array("d", values))
        message.layout.dim = [MultiArrayDimension(label="frequency", size=len(values), stride=len(values))]
        self._frequencies.publish(message)
        names = [f"mode_{k + 1}" for k in range(len(values))]
        self._frequencies_stamped.publish(make_joint_state(header(self._published_stamp, ""), names, values.tolist()))

    def _base_header(self, answer: Answer) -> Header:
        return header(answer.stamp, self.core.settings.base_frame)

    def _energies_message(self, answer: Answer) -> DiagnosticArray:
        """Return factors, energy, pose and frame; no factors without load."""
        robot, energy = self.core.robot, answer.energy
        pairs: dict[str, str] = {}
        if energy.dominant != "none":
            factors = energy.factors.tolist()
            pairs |= {e: repr(f) for e, f in zip(energy.elements, factors, strict=True)}
        pairs["total_energy"] = repr(float(energy.total))
        pairs["tie"] = str(bool(energy.tie)).lower()
        pose = answer.pose.tolist()
        pairs |= {name: repr(x) for name, x in zip(robot.pose_names, pose, strict=True)}
        pairs["frame"] = self.core.settings.base_frame
        status = DiagnosticStatus(
            level=health.OK,
            name=f"{self.get_name()}: strain energy",
            message=energy.dominant,
            hardware_id=robot.name,
            values=[KeyValue(key=key, value=value) for key, value in pairs.items()],
        )
        return DiagnosticArray(header=self._base_header(answer), status=[status])

    def _deflection_message(self, answer: Answer) -> TransformStamped:
        """Return the transform from platform to deflected platform, in platform axes."""
        shift = answer.rotation.T @ answer.energy.deflection[:3]
        turn = answer.rotation.T @ answer.energy.deflection[3:]
        angle = math.sqrt(float(turn @ turn))
        # Near zero sin(x/2)/x is 1/2; the quotient of tiny numbers would lose digits.
        scale = 0.5 if angle < 1e-6 else math.sin(angle / 2) / angle
        frame = self._platform_frame or self.core.settings.platform_frame
        message = TransformStamped(header=header(answer.stamp, frame), child_frame_id=f"{frame}_deflected")
        message.transform.translation = xyz(Vector3, shift)
        message.transform.rotation = xyz(Quaternion, (*(scale * turn), math.cos(angle / 2)))
        return message


def _compliance_message(answer: Answer) -> Float64MultiArray:
    rows, columns = answer.compliance.shape
    message = Float64MultiArray(data=array("d", answer.compliance.ravel()))
    message.layout.dim = [
        MultiArrayDimension(label="row", size=rows, stride=rows * columns),
        MultiArrayDimension(label="col", size=columns, stride=columns),
    ]
    return message


NODE = StiffnessMonitor
"""The node class, for a process of one or several nodes."""

if __name__ == "__main__":
    sys.exit(run(NODE))
