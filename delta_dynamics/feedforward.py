# SPDX-License-Identifier: Apache-2.0
"""The feedforward node's core: messages in, checked efforts out. Pure: time is an argument.

May import: numpy, pkm_twin's core, this package; never rclpy.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from delta_dynamics.differentiator import Differentiator
from delta_dynamics.virtual_work import inverse_dynamics
from pkm_twin.errors import MessageError, ParameterError, SingularityError, UnreachableError
from pkm_twin.guard import Guard
from pkm_twin.mechanisms.robot import Robot
from pkm_twin.messages import JointReader, StampRules

Array = NDArray[np.float64]
LimitPolicy = Literal["warn", "reject", "clamp"]
OnStop = Literal["nothing", "zeros", "gravity"]


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
    bad_limit: int = 5
    good_needed: int = 5
    on_stop: OnStop = "nothing"

    def __post_init__(self) -> None:
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
        self.stream = Guard(s.bad_limit, s.good_needed)
        # Each trajectory stands for itself: a bad one does not speak against the next.
        self.trajectories = Guard(bad_limit=2**62, good_needed=1)
        self.saturations = 0
        self.dropped = 0
        self.last_reject = ""
        self._last_stamp = 0
        self._last_good: Array | None = None
        self._differentiator = Differentiator(s.order, s.window)
        self._rules = StampRules(
            accept_zero=s.accept_zero_stamp,
            future_tolerance=round(s.future_tolerance * 1e9),
            max_age=round(s.stale_after * 1e9),
        )
        self._reader = JointReader(self.robot)

    @property
    def differentiator_delay(self) -> float:
        """Delay of a stream's acceleration, in samples."""
        return self._differentiator.delay

    def change_robot(self, robot: Robot) -> None:
        """Take a robot with another payload, gravity, friction or limits, between two samples."""
        self.robot = robot
        self._reader = JointReader(robot)

    def reset(self) -> None:
        """Forget the stream, as when the clock jumps: no torque across the seam."""
        self._last_stamp = 0
        self._differentiator.reset()

    def trajectory(self, message: Any, now: int) -> Array:
        """Efforts for every point, shape (points, 3), in the message's joint order.

        :raises MessageError: the message is rejected, and counted.
        """
        try:
            efforts = self._trajectory(message, now)
        except MessageError as error:
            self.trajectories.reject(error.reason, str(error))
            self.last_reject = str(error)
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
        t = self._reader.trajectory(message, now, self._rules)
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
        efforts, saturated = self._gate(self._solve(t.q, qd, qdd))
        self.saturations += saturated
        return efforts[:, t.columns]

    def _joint_state(self, message: Any, now: int) -> Torques | None:
        sample = self._reader.joint_state(message, now, self._rules)
        if sample.stamp <= self._last_stamp:
            self.dropped += 1
            raise MessageError(
                "stamp order",
                f"the stamp is {(self._last_stamp - sample.stamp) / 1e9:.6f} s before the last",
            )
        if sample.stamp - self._last_stamp > self.settings.stale_after * 1e9:
            self._differentiator.reset()
        self._last_stamp = sample.stamp
        if sample.qd is None and not self.settings.differentiate:
            raise MessageError(
                "no velocities",
                "the joint state has no velocity; set acceleration to differentiate",
            )
        rates = self._differentiator.push(sample.stamp, sample.q, sample.qd)
        if rates is None:
            return None
        self._reader.check_derived(*rates)
        motion = (sample.q, *rates)
        effort, saturated = self._gate(self._solve(*motion))
        self._last_good = sample.q
        residual = None if sample.effort is None else sample.effort - effort
        return Torques(sample.stamp, motion, effort, residual, saturated)

    def _solve(self, q: Array, qd: Array, qdd: Array) -> Array:
        try:
            return inverse_dynamics(self.robot, q, qd, qdd)
        except UnreachableError as error:
            raise MessageError("unreachable", str(error)) from error
        except SingularityError as error:
            raise MessageError("singular", str(error)) from error
        except ValueError as error:
            # The input was finite: the model overflowed.
            self.stream.stop("non-finite result", str(error))
            raise MessageError("non-finite result", str(error)) from error

    def _gate(self, effort: Array) -> tuple[Array, bool]:
        """Effort limits by the declared policy, between two checks for finite values.

        The first one keeps a clamp from making a limit of an infinity.
        """
        self._finite(effort)
        limits: Array | None = getattr(self.robot, "limits").effort  # noqa: B009
        saturated = False
        if limits is not None and (np.abs(effort) > limits).any():
            saturated = True
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
        if not np.isfinite(effort).all():
            self.stream.stop("non-finite result", "the model gave a value that is not finite")
            raise MessageError("non-finite result", "the model gave a value that is not finite")


def _gradient(values: Array, times: Array) -> Array:
    """Second-order differences on uneven times, shape (n, 3)."""
    gradient: Array = np.gradient(values, times, axis=0, edge_order=2)
    return gradient
