# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Pass stamped torques to an effort controller while they arrive, else zeros or gravity.

A command of plain numbers has no stamp, so an effort controller cannot distinguish a live
torque from the last one of a dead process: only this gate can. Pure: times are arguments.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

from delta_dynamics.holding import MeasuredPose, find_holding_effort
from pkm_twin.codegen.arrays import Array
from pkm_twin.errors import MessageError
from pkm_twin.messages.reading import JointReader
from pkm_twin.messages.stamps import SECOND, StampRules
from pkm_twin.robot.effort_limits import EffortLimits, LimitedEfforts
from pkm_twin.robot.robot import Robot
from pkm_twin.settings import AGE_BOUNDS, COUNT_BOUNDS, DURATION_BOUNDS, FUTURE_TOLERANCE_TEXT, setting
from pkm_twin.streams.continuity import check_step
from pkm_twin.streams.monitor import Core, StreamMonitor, make_counter
from pkm_twin.streams.wrench import check_order

OnStop = Literal["zeros", "gravity"]


@dataclass(frozen=True)
class GateSettings:
    """Settings of the gate: when it closes, and its command while closed."""

    on_stop: OnStop = setting(
        "zeros",
        "command while no torques arrive: zeros, or gravity (the effort against gravity at the "
        "measured position, but zeros if that position is older than deadline or the effort "
        "exceeds effort_limits)",
        choices=("zeros", "gravity"),
    )
    deadline: float = setting(
        0.1,
        "largest age of a torque, and longest gap between torques, checked four times per "
        "deadline; stale_after of delta_dynamics must not exceed it",
        **AGE_BOUNDS,
    )
    future_tolerance: float = setting(0.1, FUTURE_TOLERANCE_TEXT, **DURATION_BOUNDS)
    trip_count: int = setting(1, "rejected torques in a row that close the gate", **COUNT_BOUNDS)
    recovery_count: int = setting(5, "accepted torques in a row that open the gate", **COUNT_BOUNDS)


@dataclass
class Gate(Core):
    """Forwards the torques of one robot; closed at the start, and whenever no torques arrive.

    The controller may still hold the command of an earlier gate. Therefore a new gate is closed and
    sends :meth:`stop_command` before the first torque.
    """

    robot: Robot
    settings: GateSettings = field(default_factory=GateSettings)

    def __post_init__(self) -> None:
        s = self.settings
        self.stream = StreamMonitor(s.trip_count, s.recovery_count)
        self.stream.stop("waiting", "no torque yet")
        self.states = make_counter()
        self._rules = StampRules(
            future_tolerance=round(s.future_tolerance * SECOND), max_age=round(s.deadline * SECOND)
        )
        self._reader = JointReader(self.robot)
        self._limits = EffortLimits(self.robot)
        self._last_stamp = 0
        self._last_arrival = 0
        self._pose: MeasuredPose | None = None
        self._last_state: tuple[int, Array] | None = None

    def change_robot(self, robot: Robot) -> None:
        """Take a robot with another payload, gravity or limits, between two messages."""
        self.robot = robot
        self._reader = JointReader(robot)
        self._limits = EffortLimits(robot)

    def reset(self) -> None:
        """Close the gate after a jump of the clock, and forget the last stamp and pose."""
        self.stream.stop("clock jump", "the clock jumped")
        self._last_stamp = 0
        self._pose = self._last_state = None

    def torques(self, message: Any, now: int, steady: int) -> LimitedEfforts | None:
        """Return the command for one message of stamped torques, shape (n,), or None while closed.

        The numbers are those of the message, bit by bit, in the robot's joint order.

        :param message: sensor_msgs/JointState with one effort per joint, in any order of names.
        :param now: the ROS clock, ns; stamps are judged by it.
        :param steady: the steady clock, ns; silences are judged by it.
        :raises MessageError: the message is rejected, and counted.
        """
        self.close_if_silent(steady)
        with self.count_rejections(self.stream):
            sample = self._reader.efforts(message, now, self._rules)
            try:
                check_order(sample.stamp, self._last_stamp + 1)
            except MessageError:
                # The torque of a stop has a later stamp than the joint states of the next torques, which are
                # therefore compared with this one. Torques of two sources in turns are still rejected.
                self._last_stamp = sample.stamp
                raise
            efforts, _ = self._limits.apply(sample.given, "reject")
        self._last_stamp = sample.stamp
        self._last_arrival = steady
        return efforts if self.stream.accept() else None

    def joint_state(self, message: Any, now: int, steady: int) -> None:
        """Store the robot's measured pose, for the effort against gravity.

        :raises MessageError: the message is rejected, and counted; also one that is older than the last,
            or that a joint could not reach since then, such as one of a second publisher.
        """
        with self.taking(self.states):
            sample = self._reader.joint_state(message, now, self._rules)
            check_step(self._reader, sample, self._last_state)
        self._last_state = sample.stamp, sample.q
        self._pose = MeasuredPose.from_sample(sample.q, sample.stamp, now, steady)

    def close_if_silent(self, steady: int) -> None:
        """Close the gate if no torque arrived within the deadline."""
        silent = (steady - self._last_arrival) / SECOND
        if not self.stream.stopped and silent > self.settings.deadline:
            self.stream.stop("stale torques", f"no torque for {silent:.3f} s")

    def stop_command(self, steady: int) -> LimitedEfforts:
        """Return the command of the closed gate, shape (n,): zeros, or the effort against gravity.

        Gravity needs a pose measured within the deadline, an answer of the model for it, and an
        answer within the effort limits; without these it is zeros.
        """
        pose = self._pose if self.settings.on_stop == "gravity" else None
        return find_holding_effort(self._limits, pose, steady, self.settings.deadline)
