# SPDX-License-Identifier: Apache-2.0
"""The feedforward node's core: messages in, checked efforts out. Pure: time is an argument.

May import: numpy, pkm_twin's core, this package; never rclpy.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

from delta_dynamics import virtual_work
from delta_dynamics.virtual_work import inverse_dynamics
from pkm_twin.codegen.kernels import Kernel
from pkm_twin.errors import MessageError, ParameterError
from pkm_twin.machine.robot import Robot
from pkm_twin.ros.messages import SECOND, JointReader, StampRules, as_message_error
from pkm_twin.streams.continuity import COMPARISON, Continuity
from pkm_twin.streams.differentiator import FIT, Differentiator
from pkm_twin.streams.monitor import StreamMonitor

Array = NDArray[np.float64]
LimitPolicy = Literal["warn", "reject", "clamp"]
OnStop = Literal["nothing", "zeros", "gravity"]

STOPPING: Final = ("non-finite result", "singular", "jump")
"""Reasons for which one sample stops the stream: it has left what the model describes."""


@dataclass(frozen=True)
class Settings:
    """How the node answers; the robot's own values are in the robot."""

    differentiate: bool = False
    order: int = 2
    window: int = 25
    limit_policy: LimitPolicy = "warn"
    stale_after: float = 0.1
    future_tolerance: float = 0.1
    accept_zero_stamp: bool = False
    trip_count: int = 5
    recovery_count: int = 5
    on_stop: OnStop = "nothing"
    singularity_warn: float = 0.05
    singularity_stop: float = 0.01

    def __post_init__(self) -> None:
        if not self.singularity_stop <= self.singularity_warn:
            raise ParameterError(
                "singularity_warn",
                self.singularity_warn,
                f"at least singularity_stop, {self.singularity_stop:g}",
            )
        if not self.order + 2 <= self.window:
            raise ParameterError(
                "differentiator.window", self.window, f"at least order + 2, {self.order + 2}"
            )


@dataclass(frozen=True)
class Torques:
    """Efforts for one joint state; ``residual`` is measured less predicted, None if unmeasured."""

    stamp: int
    motion: tuple[Array, Array, Array]
    """q, qd, qdd, shape (3,) each."""
    effort: Array
    residual: Array | None
    saturated: bool


@dataclass
class Feedforward:
    """Answers trajectories and a stream of joint states with feedforward efforts."""

    robot: Robot
    settings: Settings = field(default_factory=Settings)

    def __post_init__(self) -> None:
        s = self.settings
        self.stream = StreamMonitor(s.trip_count, s.recovery_count)
        # Each trajectory stands for itself: a bad one does not speak against the next.
        self.trajectories = StreamMonitor(trip_count=2**62, recovery_count=1)
        self.saturations = 0
        self.dropped = 0
        self.near_singular = False
        self.near_singularities = 0
        self.last_reject = ""
        self._last_stamp = 0
        self._last_now = 0
        self._last_good: Array | None = None
        self._differentiator = Differentiator(s.order, s.window)
        self._rules = StampRules(
            accept_zero=s.accept_zero_stamp,
            future_tolerance=round(s.future_tolerance * 1e9),
            max_age=round(s.stale_after * 1e9),
        )
        self._reader = JointReader(self.robot)
        self._continuity = Continuity(
            self.robot, s.singularity_warn, s.singularity_stop, self._reader.highest_velocity
        )

    @property
    def differentiator_delay(self) -> float:
        """Delay of a stream's acceleration, in samples."""
        return self._differentiator.delay

    def change_robot(self, robot: Robot) -> None:
        """Take a robot with another payload, gravity, friction or limits, between two samples."""
        self.robot = robot
        self._reader = JointReader(robot)
        self._continuity.robot = robot

    def reset(self) -> None:
        """Forget the stream, as when the clock jumps: no torque across the seam."""
        self._last_stamp = 0
        self._begin_anew()

    def time_jumped_forward(self) -> None:
        """The clock jumped forward: what was fresh is stale, so a running stream stops."""
        if self._last_stamp:
            self.stream.stop("clock jump", "the clock jumped forward")
        self.reset()

    def singularity(self) -> float | None:
        """Distance of the last answered state from a singularity, 0 in one, 1 at best."""
        return None if self._last_good is None else float(self.robot.singularity(self._last_good))

    def trajectory(self, message: Any, now: int) -> Array:
        """Efforts for every point, shape (points, 3), in the message's joint order.

        :raises MessageError: the message is rejected, and counted.
        """
        try:
            efforts = self._trajectory(message, now)
        except MessageError as error:
            self.trajectories.reject(error.reason, str(error))
            self.last_reject = str(error)
            if error.reason == "non-finite result":
                # The input was finite: the model itself cannot be trusted now.
                self.stream.stop(error.reason, str(error))
            raise
        self.trajectories.accept()
        return efforts

    def joint_state(self, message: Any, now: int) -> Torques | None:
        """Efforts for one joint state, or None while the window fills or a stop is latched.

        :raises MessageError: the message is rejected, and counted.
        """
        try:
            torques = self._joint_state(message, now)
        except MessageError as error:
            self.stream.reject(error.reason, str(error))
            self.last_reject = str(error)
            if error.reason in STOPPING:
                self.stream.stop(error.reason, str(error))
            raise
        if torques is None or not self.stream.accept():
            return None
        self.saturations += torques.saturated
        return torques

    def stop_effort(self) -> Array | None:
        """What is sent once on entering a stop, by the setting ``on_stop``; None is nothing."""
        if self.settings.on_stop == "nothing":
            return None
        if self.settings.on_stop == "zeros" or self._last_good is None:
            return np.zeros(3)
        zero = np.zeros(3)
        return inverse_dynamics(self.robot, self._last_good, zero, zero)

    def _trajectory(self, message: Any, now: int) -> Array:
        t = self._reader.trajectory(message, now)
        qd, qdd = t.qd, t.qdd
        for what, values in (("velocities", qd), ("accelerations", qdd)):
            if values is None and not self.settings.differentiate:
                raise MessageError(
                    f"no {what}", f"the points carry no {what}; set acceleration to differentiate"
                )
        if (qd is None or qdd is None) and len(t.times) < 3:
            raise MessageError("too short", f"{len(t.times)} points; 3 to differentiate")
        if qd is None:
            qd = _gradient(t.q, t.times)
        if qdd is None:
            qdd = _gradient(qd, t.times)
        self._reader.check_derived(qd, qdd)
        self._check_singularity(as_message_error(self.robot.singularity, t.q))
        efforts, saturated = self._gate(
            as_message_error(inverse_dynamics, self.robot, t.q, qd, qdd)
        )
        self.saturations += saturated
        return efforts[:, t.columns]

    def _check_singularity(self, measures: Array) -> None:
        """All points of a trajectory, shape (points,)."""
        worst = int(measures.argmin())
        stop = self.settings.singularity_stop
        if not measures[worst] >= stop:
            raise MessageError(
                "singular",
                f"point {worst}: too close to a singularity or the edge of reach: measure "
                f"{measures[worst]:.3g}, singularity_stop is {stop:g}",
            )
        self.near_singularities += int((measures < self.settings.singularity_warn).sum())

    def _begin_anew(self) -> None:
        self.near_singular = False
        self._differentiator.reset()
        self._continuity.reset()

    def _take_time(self, now: int) -> None:
        """A clock that went back makes the last stamp a future one: forget it.

        One that went back by less than what stamps may be ahead only drops what is older.
        """
        if now < self._last_now - self._rules.future_tolerance:
            self.reset()
        self._last_now = now

    def _joint_state(self, message: Any, now: int) -> Torques | None:
        self._take_time(now)
        sample = self._reader.joint_state(message, now, self._rules)
        silence = sample.stamp - self._last_stamp
        if silence <= 0:
            self.dropped += 1
            raise MessageError(
                "stamp order", f"the stamp is {-silence / SECOND:.6f} s before the last"
            )
        if silence > self.settings.stale_after * SECOND:
            if self._last_stamp:
                text = f"no joint state for {silence / SECOND:.3f} s by their stamps"
                self.stream.stop("stale input", text)
            self._begin_anew()
        self._last_stamp = sample.stamp
        if sample.qd is None and not self.settings.differentiate:
            raise MessageError(
                "no velocities",
                "the joint state has no velocity; set acceleration to differentiate",
            )
        try:
            self.near_singular = as_message_error(self._continuity.step, sample.stamp, sample.q)
        except MessageError:
            # No derivative across a jump, nor across samples that the model has no state for.
            self._differentiator.reset()
            raise
        self.near_singularities += self.near_singular
        rates = self._differentiator.push(sample.stamp, sample.q, sample.qd)
        if rates is None:
            return None
        self._reader.check_derived(*rates)
        motion = (sample.q, *rates)
        effort, saturated = self._gate(as_message_error(inverse_dynamics, self.robot, *motion))
        self._last_good = sample.q
        residual = None if sample.effort is None else sample.effort - effort
        return Torques(sample.stamp, motion, effort, residual, saturated)

    def _gate(self, effort: Array) -> tuple[Array, bool]:
        """Effort limits by the declared policy, between two checks for finite values.

        The first one keeps a clamp from making a limit of an infinity.
        """
        self._finite(effort)
        limits: Array | None = getattr(self.robot, "limits").effort  # noqa: B009
        saturated = limits is not None and _beyond(effort, limits)
        if limits is not None and saturated:
            worst = np.argmax(np.abs(effort) / limits)
            joint = int(worst % 3)
            if self.settings.limit_policy == "reject":
                raise MessageError(
                    "effort limit",
                    f"effort of {self.robot.joint_names[joint]} is {effort.flat[worst]:g}, "
                    f"allowed {limits[joint]:g}",
                )
            if self.settings.limit_policy == "clamp":
                effort = np.clip(effort, -limits, limits)
        self._finite(effort)
        return effort, saturated

    def _finite(self, effort: Array) -> None:
        one = effort.ndim == 1
        if not (all(map(math.isfinite, effort.tolist())) if one else np.isfinite(effort).all()):
            raise MessageError("non-finite result", "the model gave a value that is not finite")


def kernels(robot: Robot) -> tuple[Kernel, ...]:
    """The kernels to warm up before live use.

    :raises ParameterError: a mechanism without masses.
    """
    return (
        *virtual_work.kernels(robot), robot.forward_kernel, robot.jacobian_kernel, FIT, COMPARISON,
    )  # fmt: skip


def _beyond(effort: Array, limits: Array) -> bool:
    """Whether an effort passes its limit; one sample, the stream's case, without numpy."""
    if effort.ndim == 1:
        pairs = zip(effort.tolist(), limits.tolist(), strict=True)
        return any(abs(value) > limit for value, limit in pairs)
    return bool((np.abs(effort) > limits).any())


def _gradient(values: Array, times: Array) -> Array:
    """Second-order differences on uneven times, shape (n, 3)."""
    gradient: Array = np.gradient(values, times, axis=0, edge_order=2)
    return gradient
