# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""The node ``machine_sim``: efforts or trajectories in, a simulated machine's joint states out."""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from typing import Final

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rcl_interfaces.msg import SetParametersResult
from rclpy.parameter import Parameter
from rclpy.time import Time
from rosgraph_msgs.msg import Clock
from std_msgs.msg import Float64MultiArray

from delta_dynamics.feedforward import warm_up
from delta_dynamics.nodes.topics import SIMULATION
from delta_dynamics.simulation.machine import (
    MachineSettings,
    PayloadEvent,
    Simulation,
    WrenchSignal,
    tune_position_control,
)
from pkm_twin.bags.definitions import WRENCH, message_definition
from pkm_twin.codegen.arrays import Array
from pkm_twin.errors import MessageError, ParameterError, shorten_value
from pkm_twin.messages.fast_decoder import DoublesTemplate, RawTrajectory
from pkm_twin.messages.stamps import SECOND
from pkm_twin.robot.effort_limits import effort_limits
from pkm_twin.robot.robot import Robot
from pkm_twin.robot.variation import KINDS, MAX_SPREAD, vary_robot
from pkm_twin.ros import health
from pkm_twin.ros.joints import FIELDS, JointPublisher
from pkm_twin.ros.node import TwinNode, latched_qos
from pkm_twin.ros.run import run

START_TIME: Final = SECOND
"""Simulated time at the start, ns; a stamp of zero would mean that there is none."""
MAX_TICK_TIME: Final = 5e-3
"""Longest time that one tick of the clock may simulate, s: messages are taken between ticks."""
CHECK_PERIOD: Final = 0.05
"""In lockstep: period of the checks for a silent commander, s."""
SIM_TIME_EXPECTED: Final = "false, because machine_sim has its own clock"


class MachineSim(TwinNode):
    """Simulate the motion of a robot with its drives and sensors."""

    topics = SIMULATION
    core: Simulation

    def __init__(self) -> None:
        super().__init__("machine_sim")
        robot = self.declare_robot()
        robot.massive()
        size = self.declare(
            "spread", 0.0, "relative perturbation of the robot file's parameters", low=0.0, high=MAX_SPREAD
        )
        kinds = self.declare("spread_kinds", list(KINDS), f"parameters to perturb: {', '.join(KINDS)}")
        seed = self.declare("seed", 1, "seed of the perturbation", low=0, high=2**31 - 1)
        distribution = self.declare(
            "distribution",
            "normal",
            "normal: spread is the standard deviation; uniform: the bound",
            choices=("normal", "uniform"),
        )
        self._variation = vary_robot(robot, dict.fromkeys(kinds, size), seed, distribution)
        self._clock_kind = self.declare(
            "clock",
            "wall",
            "wall: the computer's clock; simulated: publishes /clock at "
            "real_time_factor; lockstep: publishes /clock, one period per effort command",
            choices=("wall", "simulated", "lockstep"),
        )
        self._factor = self.declare(
            "real_time_factor", 1.0, "speed of the simulated clock; 0: as fast as possible", low=0.0, high=1000.0
        )
        self._simulated = self._clock_kind != "wall"
        self._lockstep = self._clock_kind == "lockstep"
        if self.get_parameter("use_sim_time").value:
            raise ParameterError("use_sim_time", True, SIM_TIME_EXPECTED)
        self.add_on_set_parameters_callback(_refuse_sim_time)
        if not self._simulated:
            self._factor = 1.0
        settings = self._declare_settings(robot)
        begin = START_TIME if self._simulated else self.now()
        self.core = Simulation(self._variation.robot, settings, begin)
        self._check_control()
        self._skipped = 0
        # Other nodes find this one by its topics: compile before.
        warm_up(self._variation.robot)
        self.core.plant.advance(np.zeros_like(settings.start), np.zeros(6), settings.period / settings.substeps)
        self.core.restart()
        self._frame = self.declare("wrench_frame", "platform", "frame id of wrench")
        self._base = self.declare("base_frame", "base_link", "frame of ~/applied_wrench")
        self._create_topics()
        self._due = time.monotonic()
        self._heard = self._due
        self._flying = 0
        if self._lockstep:
            self.create_guarded_timer(CHECK_PERIOD, self._advance_without_command)
        else:
            step = settings.period / self._factor if self._factor else 0.0
            # At most 1 kHz: a faster timer would cost more time in the executor than the simulation takes.
            self.create_guarded_timer(max(1e-3, step), self._catch_up)
        self.start()
        # Publish the drawn parameters on a transient local topic, and log them.
        drawn = self._variation.drawn
        values = [KeyValue(key=name, value=shorten_value(value)) for name, value in drawn.items()]
        status = DiagnosticStatus(name=self.get_fully_qualified_name(), values=values)
        status.message = f"{len(drawn)} parameters drawn"
        status.hardware_id = self.core.robot.name
        message = DiagnosticArray(status=[status])
        message.header.stamp = self.get_clock().now().to_msg()
        self._drawn.publish(message)
        for name, value in drawn.items():
            self.get_logger().info(f"drawn: {name} {value:.6g}")

    def details(self) -> str:
        """Return the diagnostics' text: the number of drawn parameters, and the clock."""
        drawn = self._variation.drawn
        spread = f", {len(drawn)} parameters drawn" if drawn else ""
        return f"{spread}, clock {self._clock_kind}"

    def activated(self) -> None:
        """Resume the simulation; on the wall clock from the present time."""
        self._due = self._heard = time.monotonic()
        if not self._simulated:
            self.core.skip(max(0, self.now() - self.core.now))
        self._publish()

    def reset_stop(self) -> str:
        """Return to the start, braked."""
        text = self.core.failure
        self.core.restart()
        return text or "the machine is at its start"

    def worst_status(self) -> tuple[bytes, str]:
        """Return level and message of the node's diagnostic status."""
        sim = self.core
        if sim.failure:
            return health.ERROR, f"the machine has failed: {sim.failure}"
        return health.OK, "braked: no command yet" if sim.braked else "moving freely"

    def values(self) -> dict[str, object]:
        """Return the values of the node's diagnostic status."""
        sim = self.core
        return {
            "time (s)": f"{sim.time:.3f}",
            "effort limit exceeded": sim.saturations,
            "payload mass": sim.plant.robot.payload.mass,
            "delays skipped": self._skipped,
            **sim.stream.counts("effort commands"),
            **sim.trajectories.counts("trajectories"),
            **sim.wrenches.counts("applied wrenches"),
        }

    def _declare_settings(self, robot: Robot) -> MachineSettings:
        """Declare drives and sensors, whose defaults come from the unperturbed robot."""
        bandwidth = self.declare(
            "bandwidth", 10.0, "bandwidth of the position control, critically damped", unit="Hz", low=0.01, high=1000.0
        )
        stiffness, damping = tune_position_control(robot, bandwidth)
        home = robot.inverse(robot.home())
        # By default the robot's own payload, from the start.
        own = robot.payload
        times = self.declare("payload.times", [0.0], "times at which the payload changes, s after the start")
        masses = self.declare("payload.masses", [own.mass], "payload from each time on, kg", usual="the robot's")
        coms = self.declare(
            "payload.coms",
            own.com.tolist(),
            "centre of mass of the payload, m from the platform's reference point, three numbers per time",
            usual="the robot's",
        )
        if len(masses) != len(times) or len(coms) != 3 * len(times):
            raise ParameterError(
                "payload.masses", list(masses), f"{len(times)} numbers, and three for each in payload.coms"
            )
        events = tuple(
            PayloadEvent(float(t), float(m), tuple(map(float, coms[3 * i : 3 * i + 3])))
            for i, (t, m) in enumerate(zip(times, masses, strict=True))
        )
        for event in events:
            if not 0.0 <= event.time < np.inf:
                raise ParameterError("payload.times", event.time, "0 or more, finite")
            robot.changed(payload=event.load)
        return self.declare_settings(
            MachineSettings,
            fixed=True,
            start=self._declare_array(
                "start", home, "joint positions at the start, rad or m", usual="the robot's home"
            ),
            effort_limits=self._declare_array(
                "effort_limits", effort_limits(robot), "largest effort of the drives, N m or N", 0.0, "the robot's"
            ),
            stiffness=self._declare_array("stiffness", stiffness, "of the position control", 0.0, "from bandwidth"),
            damping=self._declare_array("damping", damping, "of the position control", 0.0, "from bandwidth"),
            resolution=self._declare_array(
                "encoder_resolution",
                np.zeros(len(home)),
                "resolution of the encoders, rad or m; velocities are then differences of steps; 0: exact",
                0.0,
            ),
            payloads=events,
            wrench=WrenchSignal(
                self._declare_array("wrench.constant", np.zeros(6), "wrench on the platform, N and N m, base axes"),
                self._declare_array("wrench.amplitude", np.zeros(6), "amplitude of a sine added to wrench.constant"),
                self.declare("wrench.frequency", 1.0, "frequency of the sine", unit="Hz", low=0.0, high=1e4),
            ),
        )

    def _check_control(self) -> None:
        """Check the position control's stability; default gains that are too high only warn.

        :raises ParameterError: gains that were given are unstable at the period.
        """
        sim = self.core
        if sim.stable_fraction == 1.0:
            return
        bandwidth = sim.stable_fraction * self.get_parameter("bandwidth").value
        for name, right in (
            ("bandwidth", f"at most {bandwidth:.2g} Hz"),
            ("stiffness", f"at most {sim.stable_fraction**2:.2g} times this"),
            ("damping", f"at most {sim.stable_fraction:.2g} times this"),
        ):
            if name in self.given:
                value = self.get_parameter(name).value
                period = sim.settings.period
                raise ParameterError(name, value, f"{right}, stable at period {period:g} s")
        self.report_limitation(f"trajectories are rejected: {sim.control_fault()}")

    def _declare_array(self, name: str, default: Array, text: str, low: float | None = None, usual: str = "") -> Array:
        """Declare a parameter with one number per joint or component; one number stands for all."""
        given = self.declare(name, default.tolist(), text, usual=usual)
        values = np.asarray(given, np.float64)
        if len(values) not in (1, len(default)):
            raise ParameterError(name, list(given), f"{len(default)} numbers, or one for all")
        if np.isnan(values).any() or (low is not None and (values < low).any()):
            raise ParameterError(name, list(given), "numbers" if low is None else f"{low:g} or more")
        return np.broadcast_to(values, default.shape).copy()

    def _create_topics(self) -> None:
        self._states = JointPublisher(self, self.core.robot, "joint_states", FIELDS)
        self._wrenches = self.create_guarded_publisher("wrench")
        self._wrench = DoublesTemplate(
            WRENCH,
            message_definition(WRENCH),
            {
                "header": {"stamp": {"sec": 0, "nanosec": 0}, "frame_id": self._frame},
                "wrench": {part: dict.fromkeys("xyz", 0.0) for part in ("force", "torque")},
            },
            stamped=True,
        )
        self._drawn = self.create_publisher(DiagnosticArray, "~/drawn", latched_qos())
        self._clock_topic = self.create_publisher(Clock, "/clock", 10) if self._simulated else None
        self._clock_due = 0
        # In lockstep each command is a step.
        self.create_guarded_subscription("~/commands", self._on_commands, droppable=not self._lockstep)
        self.create_guarded_subscription("~/joint_trajectory", self._on_trajectory, raw=True)
        self.create_guarded_subscription("~/applied_wrench", lambda m: self.core.push(m, self._base))

    def _on_commands(self, message: Float64MultiArray) -> None:
        self.core.commands(message)
        self._heard = time.monotonic()
        if self._lockstep:
            # Advance only when the newest state is answered; states sent on a timeout may be answered later.
            self._flying = max(0, self._flying - 1)
            if self._flying == 0:
                self._advance()

    def _on_trajectory(self, data: bytes) -> None:
        with self.core.count_rejections(self.core.trajectories):
            raw = RawTrajectory.decode(data)
        self.core.trajectory(raw.fields)

    def _catch_up(self) -> None:
        """Simulate the periods that are due by the steady clock."""
        if not self.active:
            return
        period = self.core.settings.period
        begun = time.monotonic()
        if self._factor == 0.0:
            self._due = begun - MAX_TICK_TIME
        step = period / self._factor if self._factor else 0.0
        # Simulate a period up to a quarter period early, rather than wait for the next tick of the timer.
        while self._due + 0.75 * step <= (now := time.monotonic()):
            if now - begun > MAX_TICK_TIME:
                break
            self._due += step
            self._advance()
        # A machine more than 0.1 s behind its clock skips the delay.
        behind = time.monotonic() - self._due
        if self._factor and behind > 0.1:
            self._skipped += 1
            self._due += behind
            if not self._simulated:
                self.core.skip(round(behind * SECOND))

    def _advance_without_command(self) -> None:
        """Advance in lockstep before the first command, and without a command for 1 s."""
        if not self.active:
            return
        silent = time.monotonic() - self._heard > 1.0
        if silent:
            self._flying = 0
        if self.core.braked or silent:
            self._advance()

    def _advance(self) -> None:
        try:
            self.core.advance()
        except MessageError as error:
            self.log_throttled(error.reason, f"the machine has failed: {error.labelled}")
        self._publish()

    def _publish(self) -> None:
        measured = self.core.read_sensors()
        if self._clock_topic is not None and measured.stamp >= self._clock_due:
            self._clock_due = measured.stamp + SECOND // 200
            self._clock_topic.publish(Clock(clock=Time(nanoseconds=measured.stamp).to_msg()))
        stamped = divmod(measured.stamp, SECOND)
        self._wrenches.publish(self._wrench.fill(measured.wrench, stamped))
        own = self.core.robot.controller
        self._flying += 1
        # Publish the joint states last, so that a node that answers them has received the other topics.
        self._states.publish(
            measured.stamp,
            own.controller_positions(measured.q),
            own.controller_rates(measured.qd),
            own.controller_efforts(measured.effort),
        )


def _refuse_sim_time(changes: Sequence[Parameter]) -> SetParametersResult:
    """Reject use_sim_time while the node runs, as at its start."""
    good = not any(change.name == "use_sim_time" and change.value for change in changes)
    reason = "" if good else str(ParameterError("use_sim_time", True, SIM_TIME_EXPECTED))
    return SetParametersResult(successful=good, reason=reason)


NODE = MachineSim
"""The node class, for a process of one or several nodes."""

if __name__ == "__main__":
    sys.exit(run(NODE))
