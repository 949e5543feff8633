# SPDX-License-Identifier: Apache-2.0
"""The feedforward node's core: messages in, checked efforts out. Pure: time is an argument.

May import: numpy, pkm_twin's core, this package; never rclpy.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

from delta_dynamics.differentiator import Differentiator
from delta_dynamics.virtual_work import inverse_dynamics
from pkm_twin.errors import MessageError, ParameterError, SingularityError, UnreachableError
from pkm_twin.guard import Guard
from pkm_twin.mechanisms.robot import Robot
from pkm_twin.mechanisms.tracking import MAX_MOVE
from pkm_twin.messages import SECOND, JointReader, StampRules

Array = NDArray[np.float64]
LimitPolicy = Literal["warn", "reject", "clamp"]
OnStop = Literal["nothing", "zeros", "gravity"]

STOPPING: Final = ("non-finite result", "singular", "jump")
"""Reasons for which one sample stops the stream: it has left what the model describes."""
JUMP_FACTOR: Final = 2.0
JUMP_SLACK: Final = 5e-3
"""How far a joint may move between two samples: so many times what its velocity limit allows,
over the time between their stamps and this slack for stamps that are off, s."""


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


class Continuity:
    """Whether a stream is clear of singularities and moves without jumps, sample by sample.

    The edge of reach is a singularity too, so one measure (see :meth:`Robot.singularity`) warns
    of both. Joint positions alone do not tell the assembly mode: modes meet in singularities,
    where the stream is stopped, and what skips over one shows as a jump of a joint or of the pose.
    """

    def __init__(self, robot: Robot, settings: Settings, velocity: tuple[float, ...]) -> None:
        self.robot = robot
        self._warn, self._stop = settings.singularity_warn, settings.singularity_stop
        self._velocity = velocity
        self._radius = float(getattr(robot, "geometry").platform_radius)  # noqa: B009
        self._scale = [1.0 if unit == "m" else self._radius for unit in robot.pose_units]
        self.reset()

    def reset(self) -> None:
        """Forget the last sample."""
        self._last: tuple[int, list[float], list[float], list[float]] | None = None

    def step(self, stamp: int, q: Array) -> bool:
        """Take a sample: whether it is within the warning band of a singularity.

        :raises MessageError: it is too close to a singularity ("singular"), or it jumped ("jump");
            the next sample is compared with this one all the same.
        """
        robot, last = self.robot, self._last
        here = q.tolist()
        pose, fault = robot.forward_kernel(robot.parameters, q)
        robot.raise_fault(fault, "joint state")
        rates, _, fault = robot.jacobian_kernel(robot.parameters, q)
        robot.raise_fault(fault, "joint state")
        # Pose rates per joint rate, joint by joint; lengths at the platform's rim.
        x, y, z = self._scale
        a, b, c, d, e, f, g, h, i = rates.tolist()
        columns = [x * a, y * b, z * c, x * d, y * e, z * f, x * g, y * h, z * i]
        place = [s * value for s, value in zip(self._scale, pose.tolist(), strict=True)]
        self._last = (stamp, here, place, columns)
        if last is not None:
            self._compare(last, self._last)
        if _clearance(columns) >= self._warn:
            return False
        measure = float(robot.singularity(q))
        if not measure >= self._stop:
            raise MessageError(
                "singular",
                f"too close to a singularity or the edge of reach: measure {measure:.3g}, "
                f"singularity_stop is {self._stop:g}",
            )
        return measure < self._warn

    def _compare(self, last: tuple[Any, ...], this: tuple[Any, ...]) -> None:
        """No joint moves farther than its velocity limit allows, no pose than its rates tell."""
        period = (this[0] - last[0]) / SECOND
        moves = [new - old for new, old in zip(this[1], last[1], strict=True)]
        for joint, (move, velocity) in enumerate(zip(moves, self._velocity, strict=True)):
            allowed = velocity * (JUMP_FACTOR * period + JUMP_SLACK)
            if not -allowed <= move <= allowed:
                raise MessageError(
                    "jump",
                    f"{self.robot.joint_names[joint]} moved by {move:g} {self.robot.joint_unit} "
                    f"in {period:g} s, allowed {allowed:g}",
                )
        for k in range(3):
            told = 0.0
            for joint in range(3):
                told += 0.5 * (this[3][3 * joint + k] + last[3][3 * joint + k]) * moves[joint]
            # The mean of both rates errs by the third power of the move: half of it is plenty.
            error = abs(this[2][k] - last[2][k] - told) - 0.5 * abs(told)
            if not error <= MAX_MOVE * self._radius:
                raise MessageError(
                    "jump",
                    f"{self.robot.pose_names[k]} of the platform jumped while the joints did "
                    "not: another assembly mode",
                )


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
        self._continuity = Continuity(self.robot, s, self._reader.highest_velocity)

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

    def clock_leapt(self) -> None:
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
        self._check_singularity(_modelled(self.robot.singularity, t.q))
        efforts, saturated = self._gate(_modelled(inverse_dynamics, self.robot, t.q, qd, qdd))
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
            self.near_singular = _modelled(self._continuity.step, sample.stamp, sample.q)
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
        effort, saturated = self._gate(_modelled(inverse_dynamics, self.robot, *motion))
        self._last_good = sample.q
        residual = None if sample.effort is None else sample.effort - effort
        return Torques(sample.stamp, motion, effort, residual, saturated)

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
            raise MessageError("non-finite result", "the model gave a value that is not finite")


def _modelled(call: Callable[..., Any], *arguments: Any) -> Any:
    """What the model answers, its refusals as those of the message."""
    try:
        return call(*arguments)
    except MessageError:
        raise
    except UnreachableError as error:
        raise MessageError("unreachable", str(error)) from error
    except SingularityError as error:
        raise MessageError("singular", str(error)) from error
    except ValueError as error:
        # The input was finite: the model overflowed.
        raise MessageError("non-finite result", str(error)) from error


def _clearance(j: list[float]) -> float:
    """A lower bound of a 3x3 matrix's reciprocal condition number, at least a third of it.

    By the Frobenius norms of the matrix and of its inverse: the singular values themselves take
    three times as long.
    """
    a, b, c, d, e, f, g, h, i = j
    m, n, o = e * i - f * h, f * g - d * i, d * h - e * g
    p, q, r = c * h - b * i, a * i - c * g, b * g - a * h
    s, t, u = b * f - c * e, c * d - a * f, a * e - b * d
    matrix = a * a + b * b + c * c + d * d + e * e + f * f + g * g + h * h + i * i
    adjugate = m * m + n * n + o * o + p * p + q * q + r * r + s * s + t * t + u * u
    size = math.sqrt(matrix * adjugate)
    return abs(a * m + b * n + c * o) / size if size > 0.0 else 0.0


def _gradient(values: Array, times: Array) -> Array:
    """Second-order differences on uneven times, shape (n, 3)."""
    gradient: Array = np.gradient(values, times, axis=0, edge_order=2)
    return gradient
