# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Set points that cancel the tool point's deflection under the measured wrench.

Only the node ``stiffness_monitor`` imports this module.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from pkm_twin.errors import MessageError, ParameterError
from pkm_twin.messages.fast_decoder import JointStateView
from pkm_twin.messages.reading import JointReader
from pkm_twin.messages.stamps import SECOND, StampRules
from pkm_twin.robot.effort_limits import EffortLimits
from pkm_twin.robot.robot import Robot
from pkm_twin.ros.joints import JointPublisher
from pkm_twin.ros.node import TwinNode
from pkm_twin.ros.wrench import declare_vector
from pkm_twin.streams.monitor import Core, make_counter
from stiffness_monitor.correction import SetpointStream, setpoint_correction
from stiffness_monitor.monitor import Answer

MAX_BOUND = 1.0
"""Largest bound of an offset, rad or m."""
MAX_WAITING = 64
"""Largest number of set points and torques that wait for their counterpart of the same stamp."""


class SetpointCorrection(Core):
    """Publish ``~/setpoint_offset`` per wrench, and ``~/corrected_setpoint`` per setpoint.

    With ``pair_torques``, that and the ``torques`` of the same stamp are one message,
    ``~/setpoint_with_torques``.
    """

    def __init__(self, node: TwinNode, robot: Robot, rules: StampRules) -> None:
        """Declare the parameters and create the topics that they ask for.

        :param rules: for the stamps of set points.
        """
        self._node, self._robot = node, robot
        self._limits = EffortLimits(robot)
        self._reader = JointReader(robot)
        self._offset: tuple[int, Any] | None = None
        self.bounded = 0
        self.setpoints = make_counter()
        """Counts of corrected and of rejected set points."""
        self.torques = make_counter()
        """Counts of torques to pair with set points."""
        wanted = node.declare(
            "correct_setpoint", False, "publish joint offsets that compensate the tool point's deflection"
        )
        text = "position of the tool point from the platform's reference point, platform axes"
        self._tool = np.array(declare_vector(node, "tool.xyz", text, "m"))
        self._bound = node.declare(
            "correction_bound",
            1e-3,
            "largest joint offset; larger offsets are all scaled down by one factor",
            unit="rad or m",
            low=0.0,
            high=MAX_BOUND,
        )
        self._age = node.declare(
            "correction_age",
            0.1,
            "largest time from a wrench to the setpoint that it corrects, and largest age of setpoints and torques",
            unit="s",
            low=0.0,
            high=3600.0,
        )
        self._stream = SetpointStream(
            robot,
            node.declare(
                "correction_rate",
                0.01,
                "largest rate of the offset from one corrected setpoint to the next: the default "
                "reaches the default correction_bound in 0.1 s",
                unit="rad/s or m/s",
                low=1e-6,
                high=MAX_BOUND,
            ),
            max_elapsed=self._age,
        )
        self.change_rules(rules)
        paired = node.declare(
            "pair_torques",
            False,
            "publish ~/setpoint_with_torques: the corrected setpoint with torques of its stamp; "
            "needs correct_setpoint, and a delta_dynamics that receives the same setpoints",
        )
        self._waiting: dict[int, tuple[str, Any]] = {}
        self.unpaired = 0
        self.wanted, self._paired = bool(wanted), bool(paired)
        if paired and not wanted:
            raise ParameterError("pair_torques", True, "false, unless correct_setpoint is true")
        if not wanted:
            return
        q = robot.inverse(robot.home())
        setpoint_correction(robot, q, np.zeros(6), tool=self._tool, bound=self._bound)
        fields = ("position",)
        self._offsets = JointPublisher(node, robot, "~/setpoint_offset", fields)
        self._corrected = JointPublisher(node, robot, "~/corrected_setpoint", fields)
        node.create_guarded_subscription(
            "setpoint", self._on_setpoint, on_reject=partial(self.count_rejection, self.setpoints)
        )
        if paired:
            both = ("position", "effort")
            self._both = JointPublisher(node, robot, "~/setpoint_with_torques", both)
            node.create_guarded_subscription(
                "torques", self._on_torques, on_reject=partial(self.count_rejection, self.torques)
            )

    def reset(self) -> None:
        """Discard the last wrench, as when the clock jumps."""
        self._offset = None
        self._waiting.clear()
        self._stream.reset()

    def change_rules(self, rules: StampRules) -> None:
        """Use new stamp rules from the next set point on.

        What is older than ``correction_age`` is rejected: after a suspension of the process the
        machine is elsewhere.
        """
        self._rules = replace(rules, max_age=round(self._age * SECOND))

    def update(self, answer: Answer) -> None:
        """Compute and publish the joint offsets that undo a wrench's deflection."""
        if not self.wanted:
            return
        found = setpoint_correction(
            self._robot,
            answer.q,
            answer.energy.deflection,
            tool=self._tool,
            bound=self._bound,
            rotation=answer.rotation,
        )
        self.bounded += bool(found.bounded)
        self._offset = answer.stamp, found.offset
        own = self._robot.controller
        self._offsets.publish(answer.stamp, own.controller_rates(found.offset))

    def diagnose(self) -> dict[str, object]:
        """Return values for the node's diagnostic status."""
        if not self.wanted:
            return {}
        values: dict[str, object] = {
            "corrections at their bound": self.bounded,
            "set points at a position limit": self._stream.at_limit,
            "set points at correction_rate": self._stream.at_rate,
        }
        if self._paired:
            values["set points and torques without a pair"] = self.unpaired
            values |= self.torques.counts("torques")
        return values | self.setpoints.counts("set points", "corrected")

    def _on_setpoint(self, message: JointStateView) -> None:
        with self.taking(self.setpoints):
            sample = self._reader.positions(message, self._node.now(), self._rules)
            if self._offset is None:
                raise MessageError("no wrench", "none to compute a correction from has arrived")
            stamp, offset = self._offset
            age = abs(sample.stamp - stamp) / SECOND
            if age > self._age:
                text = f"the last one is {age:.3f} s from the set point, allowed {self._age:g} s"
                raise MessageError("no wrench", text)
            position = self._stream.correct(sample.stamp, sample.q, offset)
            corrected = self._robot.controller.controller_positions(position)
            self._corrected.publish(sample.stamp, corrected)
            if self._paired:
                self._publish_pair(sample.stamp, "position", corrected)

    def _on_torques(self, message: JointStateView) -> None:
        with self.taking(self.torques):
            sample = self._reader.efforts(message, self._node.now(), self._rules)
            efforts, _ = self._limits.apply(sample.given, "reject")
        self._publish_pair(sample.stamp, "effort", efforts)

    def _publish_pair(self, stamp: int, what: str, numbers: Any) -> None:
        """Publish set point and torques of one stamp, or keep the first until the other arrives."""
        other = self._waiting.pop(stamp, None)
        if other is not None and other[0] != what:
            pair = dict([other, (what, numbers)])
            self._both.publish(stamp, pair["position"], pair["effort"])
            return
        self._waiting[stamp] = (what, numbers)
        if len(self._waiting) > MAX_WAITING:
            self._waiting.pop(next(iter(self._waiting)))
            self.unpaired += 1
