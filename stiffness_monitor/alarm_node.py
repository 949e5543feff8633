# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Measured deflections in, ``~/stiffness_alarm`` out.

Only the node ``stiffness_monitor`` imports this module.
"""

from __future__ import annotations

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import TransformStamped

from pkm_twin.errors import ParameterError, UnknownNameError
from pkm_twin.messages.stamps import StampRules
from pkm_twin.robot.robot import Robot
from pkm_twin.ros import health
from pkm_twin.ros.joints import header
from pkm_twin.ros.node import TwinNode
from pkm_twin.ros.turns import Task
from pkm_twin.settings import DURATION_BOUNDS
from stiffness_monitor.alarm import AlarmSettings, Departure, StiffnessWatch
from stiffness_monitor.frame import DIRECTIONS
from stiffness_monitor.monitor import Answer


class StiffnessAlarmTopics:
    """Subscribe to ``measured_deflection`` and publish ``~/stiffness_alarm``."""

    def __init__(self, node: TwinNode, robot: Robot, rules: StampRules, frames: tuple[str, str]) -> None:
        """Declare the parameters and create the topics that they ask for.

        :param rules: for the stamps of deflections.
        :param frames: of the base, and of the platform as ``~/deflection`` names it.
        """
        self._node, self._robot, self._base = node, robot, frames[0]
        self._reported: tuple[str, ...] | None = None
        self._core: StiffnessWatch | None = None
        wanted = node.declare(
            "watch_stiffness",
            True,
            "subscribe to measured_deflection and publish ~/stiffness_alarm: elements whose "
            "compliance differs from the file",
        )
        words = node.declare("alarm.directions", list(DIRECTIONS), "measured directions, of x y z rx ry rz")
        for word in words:
            if word not in DIRECTIONS:
                raise UnknownNameError("alarm.directions", word, DIRECTIONS)
        if not words:
            raise ParameterError("alarm.directions", [], "at least one of x y z rx ry rz")
        measured = tuple(word in words for word in DIRECTIONS)
        settings = node.declare_settings(AlarmSettings, fixed=True, directions=measured)
        age = node.declare(
            "alarm.wrench_age",
            0.02,
            "largest time between a deflection and the wrenches before and after it",
            **DURATION_BOUNDS,
        )
        period = node.declare(
            "alarm.period", 0.1, "shortest time between two deflections that are used", **DURATION_BOUNDS
        )
        if not wanted:
            return
        self._core = StiffnessWatch(robot, rules, frames, settings, age, period)
        self._alarm = node.create_guarded_publisher("~/stiffness_alarm")
        node.create_guarded_subscription("measured_deflection", self._on_deflection)
        node.create_trigger("~/reset_stiffness", self._reset_stiffness)

    @property
    def departures(self) -> tuple[Departure, ...]:
        """Departures of the last evaluation."""
        return (self._core.departures or ()) if self._core is not None else ()

    def reset(self) -> None:
        """Discard all deflections, as when the clock jumps."""
        if self._core is not None:
            self._core.reset()

    def change_rules(self, rules: StampRules, frames: tuple[str, str]) -> None:
        """Use new rules for stamps and frames from the next deflection on."""
        if self._core is not None:
            self._core.rules, self._core.frames = rules, frames

    def update(self, answer: Answer) -> None:
        """Use the model's answer to a wrench."""
        if self._core is not None:
            self._core.answer(answer)
            self._start_evaluation(self._core)

    def warning(self) -> str:
        """Return the departures as a diagnostics message; empty without any."""
        texts = (
            f"compliance of {d.candidates} is {d.factor:.3g} +- {d.deviation:.2g} times the file's"
            for d in self.departures
        )
        return "; ".join(texts)

    def diagnose(self) -> dict[str, object]:
        """Return values for the node's diagnostic status."""
        core = self._core
        if core is None or not (core.taken.accepted or core.taken.rejected):
            return {}
        return {"deflections in the window": core.count, **core.taken.counts("deflections")}

    def _on_deflection(self, message: TransformStamped) -> None:
        if self._core is not None:
            self._core.deflection(message, self._node.now())
            self._start_evaluation(self._core)

    def _start_evaluation(self, core: StiffnessWatch) -> None:
        """Start an evaluation if it is due, in slices, so that wrenches are answered meanwhile."""
        work = core.judgement()

        def evaluate() -> Task:
            if work is not None and (yield from work):
                self._publish(core)

        if work is not None:
            self._node.defer("measured_deflection", evaluate())

    def _publish(self, core: StiffnessWatch) -> None:
        """Publish departures, one WARN status each; without any, publish OK once."""
        found = core.departures
        if found is None:
            return
        names = tuple(departure.candidates for departure in found)
        if not names and self._reported == ():
            return
        self._reported = names
        name, hardware = f"{self._node.get_name()}: stiffness", self._robot.name
        statuses = []
        if not found:
            statuses = [DiagnosticStatus(level=health.OK, name=name, message="none", hardware_id=hardware, values=[])]
        for departure in found:
            pairs = {
                "element": departure.element,
                "factor": repr(departure.factor),
                "deviation": repr(departure.deviation),
                "bound": repr(departure.bound),
            }
            # Add the elements that the loads do not distinguish from this one.
            pairs |= {f"or {other}": repr(factor) for other, factor in departure.others}
            statuses.append(
                DiagnosticStatus(
                    level=health.WARN,
                    name=name,
                    message=departure.candidates,
                    hardware_id=hardware,
                    values=[KeyValue(key=key, value=value) for key, value in pairs.items()],
                )
            )
        self._alarm.publish(DiagnosticArray(header=header(core.stamp, self._base), status=statuses))

    def _reset_stiffness(self) -> str:
        self.reset()
        return "the stored deflections were deleted"
