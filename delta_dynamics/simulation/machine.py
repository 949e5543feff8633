# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Simulate a machine with drives and sensors around a plant, as a controller sees it.

Times are integers in nanoseconds by the machine's own clock, which :meth:`Simulation.advance`
alone moves. Pure: messages are read by their attributes.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Final, Literal

import numpy as np

from delta_dynamics.simulation.plant import Plant
from delta_dynamics.torques.virtual_work import mass_matrix
from pkm_twin.codegen.arrays import Array
from pkm_twin.errors import MessageError, ParameterError, PkmTwinError, UnreachableError
from pkm_twin.machine.sections import make_payload
from pkm_twin.messages.reading import MAX_VELOCITY, JointReader, as_message_error, read_wrench
from pkm_twin.messages.stamps import SECOND, StampRules
from pkm_twin.robot.robot import Robot
from pkm_twin.robot.workspace import random_joints
from pkm_twin.settings import setting
from pkm_twin.streams.continuity import Continuity
from pkm_twin.streams.monitor import Core, make_counter
from pkm_twin.streams.path import JointPath

TimeoutAction = Literal["zeros", "hold"]

MIN_SINGULARITY_INDEX: Final = 1e-3
"""Singularity index below which rigid bodies no longer describe the machine."""
GAIN_MARGIN: Final = 1.25
"""Factor of all gains with which the position control must still be stable."""
MAX_MODELLED_DELAYS: Final = 20
"""Periods of a delay that are modelled one by one; a longer delay is divided into as many."""


@dataclass(frozen=True)
class PayloadEvent:
    """Describe the payload of the platform from ``time`` (s after the start) on."""

    time: float
    mass: float
    com: tuple[float, ...] = (0.0, 0.0, 0.0)

    @property
    def load(self) -> dict[str, Any]:
        """Payload as in a robot's file."""
        return make_payload(self.mass, self.com)


@dataclass(frozen=True)
class WrenchSignal:
    """Describe an external wrench: constant + amplitude sin(2 pi frequency t).

    Shape (6,) each, N and N m, base axes, at the platform's reference point.
    """

    constant: Array = field(default_factory=lambda: np.zeros(6))
    amplitude: Array = field(default_factory=lambda: np.zeros(6))
    frequency: float = 0.0

    def at(self, time: float) -> Array:
        """Return the wrench at a time after the start, s."""
        if not self.amplitude.any():
            return self.constant
        turn = 2.0 * np.pi * self.frequency * time
        return np.asarray(self.constant + self.amplitude * np.sin(turn), np.float64)


@dataclass(frozen=True)
class MachineSettings:
    """Hold settings of drives and sensors of a machine; arrays have shape (n,)."""

    start: Array
    """Joint positions at the start, rad or m."""
    effort_limits: Array
    """Largest efforts of the drives, N m or N."""
    stiffness: Array
    damping: Array
    """Gains of the position control of trajectories, N m/rad and N m s/rad (N/m, N s/m)."""
    period: float = setting(1e-3, "sampling period of sensors and position control", unit="s", low=1e-4, high=10.0)
    substeps: int = setting(1, "integration steps per period", low=1, high=100)
    resolution: Array = field(default_factory=lambda: np.zeros(1))
    """Encoder step, rad or m; 0 is none."""
    delay: float = setting(
        0.0, "delay of every effort command, in whole periods", name="command_delay", unit="s", low=0.0, high=10.0
    )
    deadline: float = setting(0.1, "longest gap between effort commands", unit="s", low=1e-3, high=10.0)
    timeout_action: TimeoutAction = setting(
        "zeros",
        "efforts of the drives after deadline without commands: zeros, or hold (the last effort, "
        "as most effort controllers do)",
        choices=("zeros", "hold"),
    )
    payloads: tuple[PayloadEvent, ...] = ()
    wrench: WrenchSignal = field(default_factory=WrenchSignal)


def tune_position_control(robot: Robot, bandwidth: float) -> tuple[Array, Array]:
    """Return stiffness and damping of a position control, by the masses at home, (n,) each.

    Drives that share the effort share the masses.

    :param bandwidth: undamped natural frequency of each joint for itself, Hz; damped critically.
    """
    inertia = np.diag(mass_matrix(robot, robot.inverse(robot.home())))
    inertia = inertia * robot.joints_count / len(robot.graph.leads)
    turn = 2.0 * np.pi * bandwidth
    return inertia * turn**2, 2.0 * inertia * turn


def stable_fraction(robot: Robot, settings: MachineSettings) -> float:
    """Return the largest stable fraction of the position control's bandwidth, at most 1.

    The control is stable if no error grows in the discrete loop of the sampled control and the
    machine's masses, linearised about rest: at the start and in the pose where the loop is fastest,
    with every payload, and with gains that are higher by :data:`GAIN_MARGIN`. As in
    :func:`tune_position_control`, the stiffness is proportional to the square of the bandwidth, the
    damping to the bandwidth.
    """
    q = np.vstack([settings.start, random_joints(robot, np.random.default_rng(0), 64)])
    inertias = []
    drive_rates = robot.drive_jacobian(q)
    for event in settings.payloads or (None,):
        loaded = robot if event is None else robot.changed(payload=event.load)
        inertia = mass_matrix(loaded.leading_machine, q[:, robot.graph.leading])
        gains = settings.damping + 0.5 * settings.period * settings.stiffness
        gains = drive_rates.swapaxes(-1, -2) @ (gains[:, None] * drive_rates)
        speeds = np.abs(np.linalg.eigvals(np.linalg.solve(inertia, gains))).max(-1)
        fastest = int(speeds.argmax())
        inertias += [(inertia[0], drive_rates[0]), (inertia[fastest], drive_rates[fastest])]

    def is_stable(fraction: float) -> bool:
        return all(
            error_growth(inertia, settings, gain * fraction**2, gain * fraction, rates) <= 1.0 + 1e-6
            for inertia, rates in inertias
            for gain in (1.0, GAIN_MARGIN)
        )

    if is_stable(1.0):
        return 1.0
    low, high = 0.0, 1.0
    for _ in range(12):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if is_stable(middle) else (low, middle)
    return low


def error_growth(
    inertia: Array, settings: MachineSettings, stiffness: float = 1.0, damping: float = 1.0, follow: Array | None = None
) -> float:
    """Return the largest factor by which a position control error grows in a period.

    The spectral radius of the loop that :meth:`Simulation.advance` closes: positions, rates, the
    positions a period before (rates of an encoder with steps are differences) and the efforts on
    their way. The mass matrix is constant, and efforts are constant in a period.

    :param inertia: mass matrix of the drives that lead, shape (m, m).
    :param follow: rates of all drives per rate of these, shape (n, m); by default all lead.
    :param stiffness: factor of the settings' stiffness, ``damping``: of their damping.
    """
    n, s = len(inertia), settings
    drive_rates = np.eye(n) if follow is None else follow
    delay = math.ceil(s.delay / s.period)
    period = s.period if delay <= MAX_MODELLED_DELAYS else s.delay / MAX_MODELLED_DELAYS
    # Every row block of the unit matrix is one quantity, in terms of the state.
    unit = np.eye(n * (3 + min(delay, MAX_MODELLED_DELAYS)))
    q, qd, before, *waiting = unit.reshape(-1, n, len(unit))
    rates = np.where(s.resolution[:, None] > 0.0, drive_rates @ (q - before) / period, drive_rates @ qd)
    effort = -stiffness * s.stiffness[:, None] * (drive_rates @ q) - damping * s.damping[:, None] * rates
    waiting.append(drive_rates.T @ effort)
    qdd = np.linalg.solve(inertia, waiting.pop(0))
    after = [q + period * qd + 0.5 * period**2 * qdd, qd + period * qdd, q, *waiting]
    return float(np.abs(np.linalg.eigvals(np.concatenate(after))).max())


@dataclass(frozen=True)
class SensorReadings:
    """Hold what the sensors measure, shape (n,) each: rad or m, their rates, N m or N."""

    stamp: int
    q: Array
    qd: Array
    effort: Array
    wrench: Array
    """At the platform's reference point, platform axes, without the payload's own, shape (6,)."""


class Simulation(Core):
    """Simulate one machine with brakes, which the first command opens.

    The latest effort command or trajectory takes effect.

    :param start: the machine's clock at its start, ns.
    """

    def __init__(self, robot: Robot, settings: MachineSettings, start: int) -> None:
        bounds = robot.limits.position
        if bounds is not None:
            places = zip(robot.joint_names, settings.start, bounds, strict=True)
            for name, q, (low, high) in places:
                if not low <= q <= high:
                    raise ParameterError(f"start, {name}", float(q), f"{low:g} to {high:g}")
        self.robot, self.settings = robot, settings
        self.stream = make_counter()
        """Counts of effort commands, and the reason of a stop."""
        self.trajectories = make_counter()
        self.wrenches = make_counter()
        """Counts of wrenches from a topic."""
        self.saturations = 0
        self.now = start
        self._reader = JointReader(robot, with_effort=True)
        self._reset_state()

    def _reset_state(self) -> None:
        s = self.settings
        self.braked, self.failure = True, ""
        self.plant = Plant(self.robot, s.start)
        self._continuity = Continuity(
            self.robot, MIN_SINGULARITY_INDEX, MIN_SINGULARITY_INDEX, [MAX_VELOCITY] * self.robot.joints_count
        )
        self._begun = self.now
        self._payloads = deque(sorted(s.payloads, key=lambda event: event.time))
        self._delayed_efforts: deque[tuple[int, Array]] = deque()
        self._effort = np.zeros(self.robot.joints_count)
        self._commanded: int | None = None
        self._path: tuple[int, JointPath] | None = None
        self._topic_wrench = np.zeros(6)
        self._encoder_positions = self._read_encoders()
        self._encoder_rates = np.zeros_like(self._encoder_positions)

    def restart(self) -> None:
        """Return to the start, braked; the clock continues."""
        self.stream.resume()
        self._reset_state()

    @property
    def time(self) -> float:
        """Time since the machine's start, s."""
        return (self.now - self._begun) / SECOND

    def skip(self, nanoseconds: int) -> None:
        """Advance the clock but not the machine, as after a suspension of the process."""
        self.now += nanoseconds
        self._begun += nanoseconds

    def commands(self, message: Any) -> None:
        """Apply efforts of a std_msgs/Float64MultiArray, in the controller's units and the robot's order.

        :raises MessageError: rejected and counted; the previous command stays in effect.
        """
        with self.taking(self.stream):
            effort = self._reader.commands(message.data)
        self._path = None
        self._commanded = self.now
        self.braked = False
        self._queue_effort(effort)

    def trajectory(self, message: Any) -> None:
        """Follow a trajectory_msgs/JointTrajectory by position control with its feedforward.

        A zero stamp starts it now. Before its first point the path leads there from here.

        :param message: the message or its TrajectoryFields.
        :raises MessageError: rejected and counted; the previous command stays in effect.
        """
        with self.taking(self.trajectories):
            t = self._reader.trajectory(message, self.now)
            if self.stable_fraction < 1.0:
                raise MessageError("unstable control", self.control_fault())
        self._path = (t.stamp or self.now, JointPath(t).start_from(self._encoder_positions))

    @cached_property
    def stable_fraction(self) -> float:
        """Largest stable fraction, at most 1, of the control bandwidth that the settings ask for."""
        return stable_fraction(self.robot, self.settings)

    def control_fault(self) -> str:
        """Explain why no trajectory is followed if :attr:`stable_fraction` is below 1."""
        s, share = self.settings, self.stable_fraction
        # Critically damped: stiffness m w^2 and damping 2 m w.
        damped = s.damping > 0.0
        bandwidth = (s.stiffness[damped] / s.damping[damped] / np.pi).max(initial=0.0)
        right = f"{share * bandwidth:.2g} Hz" if bandwidth else f"stiffness times {share**2:.2g}"
        return (
            f"the position control is unstable at period {s.period:g} s with the machine's "
            f"inertia; stable up to {right}"
        )

    def push(self, message: Any, frame: str) -> None:
        """Apply the wrench of a geometry_msgs/WrenchStamped, base frame, until the next message.

        :raises MessageError: the message is rejected, and counted.
        """
        rules = StampRules(accept_zero=True, future_tolerance=SECOND)
        with self.taking(self.wrenches):
            self._topic_wrench = read_wrench(message, self.now, rules, frame, False).wrench

    def read_sensors(self) -> SensorReadings:
        """Return the sensors' present measurements."""
        force = self._applied_wrench()
        rotation = self.robot.platform(self.plant.q)[1]
        turned = np.concatenate([force[:3] @ rotation, force[3:] @ rotation])
        return SensorReadings(self.now, self._encoder_positions, self._encoder_rates, self._effort, turned)

    def advance(self) -> None:
        """Simulate one period; a failed machine stays where it was.

        :raises MessageError: it fails: a singularity, the edge of the workspace, or no finite result.
        """
        s = self.settings
        if self._path is not None and self.now >= self._path[0]:
            start, path = self._path
            self.braked, self._commanded = False, None
            wanted = path.at((self.now - start) / SECOND)
            errors = wanted.q - self._encoder_positions, wanted.qd - self._encoder_rates
            self._queue_effort(np.asarray(s.stiffness * errors[0] + s.damping * errors[1] + wanted.effort))
        while self._delayed_efforts and self._delayed_efforts[0][0] <= self.now:
            self._apply_effort(self._delayed_efforts.popleft()[1])
        silent = self._commanded is not None and self.now - self._commanded > s.deadline * SECOND
        if silent and s.timeout_action == "zeros":
            self._apply_effort(np.zeros_like(self._effort))
        while self._payloads and self._payloads[0].time <= self.time:
            load = self._payloads.popleft().load
            self.plant.change_robot(self.robot.changed(payload=load))
        if not self.failure and not self.braked:
            try:
                as_message_error(self._integrate_period)
            except MessageError as error:
                self.plant.stop_motion()
                self.failure = f"{error.reason}: {error}"
                self.stream.stop(error.reason, str(error))
                self._end_period()
                raise
        self._end_period()

    def _integrate_period(self) -> None:
        s, wrench = self.settings, self._applied_wrench()
        q = self.plant.q
        for _ in range(s.substeps):
            self.plant.advance(self._effort, wrench, s.period / s.substeps)
        bounds = self.robot.limits.position
        for k in self.plant.others:
            # Redundant drives have no simulated stop.
            name, here = self.robot.joint_names[k], float(self.plant.q[k])
            low, high = (-math.inf, math.inf) if bounds is None else bounds[k]
            if not low <= here <= high:
                how = f"is at {here:.4g}, allowed {low:g} to {high:g}, and has no simulated stop"
                raise UnreachableError("joint state", name, (), 0.0, how=how)
        if not np.isfinite(self.plant.qd).all():
            raise MessageError("non-finite result", "the motion is not finite")
        try:
            self._continuity.step(self.now, self.plant.q)
        except PkmTwinError:
            self.plant.q = q
            raise

    def _end_period(self) -> None:
        """End the period: advance the clock, and sample the encoders."""
        s = self.settings
        self.now += round(s.period * SECOND)
        before, self._encoder_positions = self._encoder_positions, self._read_encoders()
        self._encoder_rates = self.plant.qd
        if s.resolution.any():
            self._encoder_rates = np.where(
                s.resolution > 0.0, (self._encoder_positions - before) / s.period, self.plant.qd
            )

    def _read_encoders(self) -> Array:
        q, step = self.plant.q, self.settings.resolution
        if not step.any():
            return q
        steps = np.where(step > 0.0, step, 1.0)
        return np.where(step > 0.0, np.round(q / steps) * steps, q)

    def _queue_effort(self, effort: Array) -> None:
        self._delayed_efforts.append((self.now + round(self.settings.delay * SECOND), effort))

    def _apply_effort(self, effort: Array) -> None:
        limits = self.settings.effort_limits
        self.saturations += bool((np.abs(effort) > limits).any())
        self._effort = np.clip(effort, -limits, limits)

    def _applied_wrench(self) -> Array:
        return self.settings.wrench.at(self.time) + self._topic_wrench
