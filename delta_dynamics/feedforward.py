# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""The feedforward node's core: messages in, checked efforts out. Pure: time is an argument."""

from __future__ import annotations

from collections.abc import Callable, Generator
from dataclasses import dataclass, field
from typing import Any, Final, Literal, NamedTuple, ParamSpec, TypeVar

import numpy as np

from delta_dynamics.holding import MeasuredPose, find_holding_effort
from delta_dynamics.torques.stiction import friction_reach, zero_resting_rates
from delta_dynamics.torques.virtual_work import inverse_dynamics
from pkm_twin.codegen.arrays import Array
from pkm_twin.errors import MessageError, ParameterError
from pkm_twin.machine.friction import KNOWN_FRACTION, Dahl, Memory
from pkm_twin.machine.joint_map import ControllerNumbers
from pkm_twin.messages.reading import ExtraJoints, JointReader, JointSample, as_message_error
from pkm_twin.messages.stamps import SECOND, StampRules
from pkm_twin.robot.derivatives import nearest_motion
from pkm_twin.robot.effort_limits import NON_FINITE, EffortLimits, LimitedEfforts, LimitPolicy
from pkm_twin.robot.limits import find_first_beyond
from pkm_twin.robot.robot import Robot
from pkm_twin.robot.workspace import describe_singularity_bound
from pkm_twin.settings import (
    AGE_BOUNDS,
    COUNT_BOUNDS,
    DURATION_BOUNDS,
    FRACTION_BOUNDS,
    FUTURE_TOLERANCE_TEXT,
    ZERO_STAMP_TEXT,
    setting,
)
from pkm_twin.streams.base_motion import BaseImu
from pkm_twin.streams.continuity import Continuity
from pkm_twin.streams.differentiator import Differentiator
from pkm_twin.streams.matched import WrenchWindow
from pkm_twin.streams.monitor import Core, StreamMonitor, make_counter, run_to_end
from pkm_twin.streams.rates import RateAgreement
from pkm_twin.streams.rest import VelocityErrorEstimator, gradient_gain, velocity_error_bound
from pkm_twin.streams.wrench import STAMP_ORDER, check_order

P = ParamSpec("P")
R = TypeVar("R")

OnStop = Literal["nothing", "zeros", "gravity"]


@dataclass(frozen=True)
class Settings:
    """Settings of the node; values of the robot are in the robot."""

    differentiate: bool = setting(
        False,
        "for messages without velocities or accelerations: trajectory rejects them, differentiate computes them",
        name="acceleration",
        choices={"trajectory": False, "differentiate": True},
    )
    order: int = setting(2, "polynomial degree of the velocity", name="differentiator.order", low=1, high=4)
    window: int = setting(
        25,
        "samples in the window; below 1 kHz fewer, so that it spans at most this number of ms (24 "
        "if that is more), but at least 5; a longer gap empties it",
        name="differentiator.window",
        low=3,
        high=1000,
    )
    limit_policy: LimitPolicy = setting(
        "warn",
        "efforts beyond effort_limits: warn publishes, reject rejects, clamp limits them",
        choices=("warn", "reject", "clamp"),
    )
    stale_after: float = setting(
        0.1,
        "largest age of a joint state, and longest gap before the stream stops; also lifespan and "
        "deadline of published torques, so at most command_gate's deadline",
        **AGE_BOUNDS,
    )
    future_tolerance: float = setting(0.1, FUTURE_TOLERANCE_TEXT, **DURATION_BOUNDS)
    accept_zero_stamp: bool = setting(False, ZERO_STAMP_TEXT)
    trip_count: int = setting(5, "rejected joint states in a row that stop the stream", **COUNT_BOUNDS)
    recovery_count: int = setting(5, "accepted joint states in a row that restart it", **COUNT_BOUNDS)
    extra_joints: ExtraJoints = setting(
        "refuse",
        "joints of a trajectory that the model does not have: reject the trajectory, or give them zero effort",
        choices=("refuse", "zero"),
    )
    on_stop: OnStop = setting(
        "nothing",
        "command sent once when the stream stops: nothing, zeros, or gravity (the effort against "
        "gravity at the last accepted position, but zeros if that position is older than "
        "stale_after or the effort exceeds effort_limits); with publish_commands not nothing",
        choices=("nothing", "zeros", "gravity"),
    )
    singularity_warn: float = setting(0.05, "warn below this singularity index", **FRACTION_BOUNDS)
    singularity_stop: float = setting(0.01, "stop below this singularity index", **FRACTION_BOUNDS)

    def __post_init__(self) -> None:
        if not self.singularity_stop <= self.singularity_warn:
            raise ParameterError(
                "singularity_warn", self.singularity_warn, f"at least singularity_stop, {self.singularity_stop:g}"
            )
        if not self.order + 2 <= self.window:
            raise ParameterError("differentiator.window", self.window, f"at least order + 2, {self.order + 2}")

    @property
    def stamp_rules(self) -> StampRules:
        """Rules for the stamps of joint states."""
        return StampRules(
            accept_zero=self.accept_zero_stamp,
            future_tolerance=round(self.future_tolerance * SECOND),
            max_age=round(self.stale_after * SECOND),
        )


STOP_REASONS: Final = (NON_FINITE, "singular", "jump", "no wrench", "no base motion")
"""Reasons for which a single sample stops the stream, because the model cannot describe it."""
POINTS_PER_SLICE: Final = 256
"""Points of a trajectory that are computed between two turns of the executor."""


class Torques(NamedTuple):
    """Efforts for one joint state.

    ``measured``: efforts that the drives report, None without. ``wrench``: the external wrench that
    ``effort`` includes, base axes at the platform's reference point, shape (6,). ``rate_error``:
    error bounds of the rates, shape (n,), None if they are not needed.
    ``memory``: the part of ``effort`` that friction with memory adds, shape (n,); 0 without.
    """

    stamp: int
    motion: tuple[Array, Array, Array]
    """q, qd, qdd, shape (n,) each."""
    effort: Array
    """Within the limits, shape (n,), N m or N."""
    sent: LimitedEfforts
    """The efforts in the controller's values."""
    measured: Array | None
    saturated: bool
    wrench: Array | None = None
    rate_error: Array | None = None
    memory: Array | float = 0.0

    @property
    def residual(self) -> Array | None:
        """Measured minus predicted efforts, shape (n,)."""
        return None if self.measured is None else self.measured - self.effort


@dataclass
class Feedforward(Core):
    """Computes feedforward efforts for trajectories and for a stream of joint states.

    ``wrenches``: external wrenches for the stream's efforts; None: none. ``base``: measures the
    motion of the base; None: at rest. ``uncertain``: compute the rates' error bounds for every
    robot, not only for those with dry friction.
    """

    robot: Robot
    settings: Settings = field(default_factory=Settings)
    wrenches: WrenchWindow | None = None
    base: BaseImu | None = None
    uncertain: bool = False

    def __post_init__(self) -> None:
        s = self.settings
        self.stream = StreamMonitor(s.trip_count, s.recovery_count)
        # Trajectories are independent: a rejected one does not affect the next.
        self.trajectories = make_counter()
        self.saturations = 0
        self.near_singular = False
        self.near_singularities = 0
        self._last_stamp = 0
        self._last_now = 0
        self._last_good: Array | None = None
        self.limits = EffortLimits(self.robot)
        self.pose: MeasuredPose | None = None
        """Pose of the last accepted joint state."""
        self._base_acceleration: Array | None = None
        """Mean acceleration of the base less gravity there, shape (3,); None: at rest."""
        self._memory: Memory | None = None
        """Memory of the drives' friction; None before the stream's first answer."""
        self.differentiator = _make_differentiator(s, self.robot)
        self._window = s.window
        self._velocity_error = VelocityErrorEstimator(self.differentiator.slope_gain())
        self.rates = RateAgreement(self.robot)
        self._friction_reach = friction_reach(self.robot)
        self._apply_stamp_rules(s)
        self._reader = JointReader(self.robot, extra_joints=s.extra_joints)
        self._continuity = Continuity(self.robot, s.singularity_warn, s.singularity_stop, self._reader.highest_velocity)

    def change_robot(self, robot: Robot) -> None:
        """Take a robot with another payload, gravity, friction or limits, between two samples."""
        self.robot = robot
        self.limits = EffortLimits(robot)
        self._friction_reach = friction_reach(robot)
        self._reader = JointReader(robot, extra_joints=self.settings.extra_joints)
        self._continuity.robot = robot

    def change_settings(self, settings: Settings) -> None:
        """Use other settings from the next sample on."""
        before, self.settings = self.settings, settings
        self.stream.trip_count = settings.trip_count
        self.stream.recovery_count = settings.recovery_count
        self._apply_stamp_rules(settings)
        if settings.extra_joints != before.extra_joints:
            self._reader = JointReader(self.robot, extra_joints=settings.extra_joints)
        self._continuity.warn = settings.singularity_warn
        self._continuity.stop = settings.singularity_stop
        if self.wrenches is not None:
            self.wrenches.change_stamps(settings.accept_zero_stamp, settings.future_tolerance)
        if (before.order, before.window) != (settings.order, settings.window):
            self.differentiator = _make_differentiator(settings, self.robot)
            self._window = settings.window
            self._velocity_error = VelocityErrorEstimator(self.differentiator.slope_gain())
            if self.wrenches is not None:
                self.wrenches.change_fit(settings.order, settings.window)

    def _apply_stamp_rules(self, settings: Settings) -> None:
        self._rules = settings.stamp_rules
        if self.base is not None:
            self.base.rules = self._rules

    @property
    def dropped(self) -> int:
        """Number of joint states that were not newer than the one before."""
        return self.stream.rejected[STAMP_ORDER]

    def reset(self) -> None:
        """Discard the stream and the pose after a jump of the clock."""
        self.pose = None
        if self.base is not None:
            self.base.clear()
        self._forget_stream()

    def stop(self, reason: str, text: str) -> None:
        """Stop the stream; the next sample is the first of a new one."""
        if self.stream.stop(reason, text):
            self._forget_stream()

    def time_jumped_forward(self) -> None:
        """Stop a running stream after the clock jumped forward, as its samples are stale."""
        if self._last_stamp:
            self.stream.stop("clock jump", "the clock jumped forward")
        self.reset()

    def singularity(self) -> float | None:
        """Return the last answered state's index, 0 in a singularity, 1 at best; None before."""
        return None if self._last_good is None else float(self.robot.singularity(self._last_good))

    def unknown_friction(self) -> list[str]:
        """List the joints whose friction depends on motion before the stream began."""
        distance, memory = self.robot.friction.presliding, self._memory
        unknown = distance > 0.0
        if memory is not None:
            unknown &= memory.unknown > KNOWN_FRACTION
        return [n for n, one in zip(self.robot.joint_names, unknown, strict=True) if one]

    def trajectory(self, message: Any, now: int) -> LimitedEfforts:
        """Compute the controller's efforts for every point, (points, n), in the message's order.

        :raises MessageError: the message is rejected, and counted.
        """
        return run_to_end(self.trajectory_steps(message, now))

    def trajectory_steps(
        self, message: Any, now: int, *, holding: bool = False
    ) -> Generator[None, None, LimitedEfforts]:
        """Compute :meth:`trajectory` some points at a time, yielding between them.

        The robot and the settings are those of the beginning.

        :param holding: the points stop the machine: as in :meth:`stop_effort`, efforts are zeros
            at a point where one exceeds a limit.
        :returns: the generator's value, the efforts.
        """
        robot, settings, reader, limits = self.robot, self.settings, self._reader, self.limits
        with self.taking(self.trajectories):
            if self.base is not None:
                text = "the motion of the base during a trajectory is unknown"
                raise MessageError("base motion", f"{text}; with base_imu only joint states are answered")
            t = reader.trajectory(message, now)
            yield
            for what, values in (("velocities", t.qd), ("accelerations", t.qdd)):
                if values is None and not settings.differentiate:
                    raise MessageError(f"no {what}", f"the points carry no {what}; set acceleration to differentiate")
            if (t.qd is None or t.qdd is None) and len(t.times) < 3:
                raise MessageError("too short", f"{len(t.times)} points; 3 to differentiate")
            qd = np.gradient(t.q, t.times, axis=0, edge_order=2) if t.qd is None else t.qd
            qdd = np.gradient(qd, t.times, axis=0, edge_order=2) if t.qdd is None else t.qdd
            reader.check_derived(qd, qdd)
            if t.qd is None and self._friction_reach.any():
                rate_error = velocity_error_bound(t.times, t.q, gradient_gain(t.times))
                qd = zero_resting_rates(qd, np.abs(qd) <= rate_error, self._friction_reach)
            efforts = np.empty_like(t.q)
            saturated = False
            for first in range(0, len(t.q), POINTS_PER_SLICE):
                yield
                part = slice(first, first + POINTS_PER_SLICE)
                q = t.q[part]
                beyond = _evaluate_points(first, find_first_beyond, robot, q, actuated=False)
                if beyond is not None:
                    where = f"point {first + (beyond.index or 0)}: {beyond.joint}"
                    text = f"is {beyond.value:g} {beyond.unit}, allowed {beyond.low:g} to {beyond.high:g}"
                    raise MessageError("limit", f"{where} {text}")
                measures = _evaluate_points(first, robot.singularity, q)
                worst, stop = int(measures.argmin()), self.settings.singularity_stop
                if not measures[worst] >= stop:
                    raise MessageError(
                        "singular",
                        f"point {first + worst}: close to a singularity or the edge of the workspace: "
                        f"index {measures[worst]:.3g}, allowed {stop:g} or more; "
                        f"{describe_singularity_bound(float(measures[worst]), 'singularity_stop ')} passes",
                    )
                self.near_singularities += int((measures < self.settings.singularity_warn).sum())
                solved = _evaluate_points(first, inverse_dynamics, robot, q, qd[part], qdd[part])
                efforts[part], limited = limits.apply(
                    robot.controller.controller_efforts(solved), "zeros" if holding else settings.limit_policy
                )
                saturated |= limited
            self.saturations += saturated
            # In the message's order, zero for joints that the model lacks.
            padded = np.hstack([efforts, np.zeros((len(efforts), 1))])
        return LimitedEfforts(ControllerNumbers(np.ascontiguousarray(padded[:, t.columns])))

    def check_shape(self, message: Any) -> None:
        """Check a trajectory's names and lengths, before its efforts are computed in steps.

        :raises MessageError: the message is rejected, and counted.
        """
        with self.count_rejections(self.trajectories):
            self._reader.check_shape(message)

    def joint_state(self, message: Any, now: int, steady: int | None = None) -> Torques | None:
        """Compute the efforts for one joint state; None while the window fills or while stopped.

        :param now: the ROS clock, ns. ``steady``: the steady clock, ns; by default the same.
        :raises MessageError: the message is rejected, and counted.
        """
        with self.count_rejections(self.stream):
            torques = self._compute_efforts(message, now, now if steady is None else steady)
        if torques is None or not self.stream.accept():
            return None
        self.saturations += torques.saturated
        return torques

    def count_rejection(self, counts: StreamMonitor, error: MessageError) -> None:
        """Count a message that is rejected; several joint states in a row stop the stream.

        A trajectory stops it if the model gives no finite result for finite input.
        """
        super().count_rejection(counts, error)
        if error.reason in (STOP_REASONS if counts is self.stream else (NON_FINITE,)):
            self.stream.stop(error.reason, str(error))

    def check_age(self, torques: Torques, now: int) -> None:
        """Reject efforts that are too late, for example after a suspension of the process.

        :raises MessageError: the state is older than ``stale_after`` by now; counted.
        """
        age = now - torques.stamp
        if age > self.settings.stale_after * SECOND:
            with self.count_rejections(self.stream):
                raise MessageError(
                    "late answer",
                    f"the answer is ready {age / SECOND:.3f} s after the state's stamp, allowed "
                    f"{self.settings.stale_after:g} s; this computer is overloaded",
                )

    def stop_effort(self, steady: int) -> LimitedEfforts | None:
        """Return the efforts to send once when the stream stops; None if ``on_stop`` is ``nothing``.

        :param steady: the steady clock, ns: gravity is that of a pose within ``stale_after``.
        """
        if self.settings.on_stop == "nothing":
            return None
        pose = self.pose if self.settings.on_stop == "gravity" else None
        return find_holding_effort(self.limits, pose, steady, self.settings.stale_after, self._base_acceleration)

    def _forget_stream(self) -> None:
        self._last_stamp = 0
        if self.wrenches is not None:
            self.wrenches.clear()
        self._restart_stream()

    def _restart_stream(self) -> None:
        self.near_singular = False
        self._memory = None
        self._restart_differentiation()
        self._continuity.reset()

    def _restart_differentiation(self) -> None:
        self.differentiator.reset()
        self._velocity_error.reset()
        self.rates.reset()
        if self.wrenches is not None:
            self.wrenches.restart()

    def _compute_efforts(self, message: Any, now: int, steady: int) -> Torques | None:
        """Compute the efforts of one sample; a rejected sample does not change the state."""
        # After a smaller step back the last stamp stays, and older samples are rejected.
        if now < self._last_now - self._rules.future_tolerance:
            self.reset()
        self._last_now = now
        sample = self._reader.joint_state(message, now, self._rules)
        check_order(sample.stamp, self._last_stamp + 1)
        elapsed = sample.stamp - self._last_stamp
        if sample.qd is None and not self.settings.differentiate:
            raise MessageError("no velocities", "the joint state has no velocity; set acceleration to differentiate")
        if elapsed > self.settings.stale_after * SECOND:
            if self._last_stamp:
                text = f"no accepted joint state for {elapsed / SECOND:.3f} s, by the stamps"
                self.stream.stop("stale input", text)
            self._restart_stream()
        wrench = None if self.wrenches is None else self.wrenches.require(sample.stamp)
        base = None
        if self.base is not None:
            base = self.base.require(sample.stamp, self.robot.gravity)
        try:
            near_singular = as_message_error(self._continuity.step, sample.stamp, sample.q)
        except MessageError:
            # Do not differentiate across a jump, or across samples at which the machine cannot be assembled.
            self._restart_differentiation()
            raise
        try:
            rates = self._differentiate(sample)
            rate_error = None
            if self.uncertain or self._friction_reach.any():
                rate_error = self._velocity_error.push(
                    sample.stamp, sample.q, sample.qd, None if rates is None else rates[0]
                )
            measured, external = sample.effort, None
            if self.wrenches is not None:
                self.wrenches.push(sample, self.robot.platform(sample.q)[1], wrench)
            if rates is not None:
                self._reader.check_derived(*rates)
                if self.wrenches is not None:
                    external, measured = self.wrenches.through()
                motion, rates_used, accelerations_used = as_message_error(
                    self._resolve_motion, sample, rates, rate_error
                )
                solved = as_message_error(
                    inverse_dynamics, self.robot, sample.q, rates_used, accelerations_used, external, base
                )
                memory, added = self._add_friction_memory(sample.q, rates_used)
                controller, effort = self.robot.controller, solved + added
                sent, saturated = self.limits.apply(controller.controller_efforts(effort), self.settings.limit_policy)
                if saturated:
                    effort = controller.efforts(sent)
        except MessageError:
            self.differentiator.retract()
            self._velocity_error.retract()
            if self.wrenches is not None:
                self.wrenches.retract()
            self._continuity.retract()
            raise
        self._last_stamp = sample.stamp
        self.pose = MeasuredPose.from_sample(sample.q, sample.stamp, now, steady)
        self._base_acceleration = None if self.base is None else self.base.mean
        if sample.qd is not None:
            self.rates.push(sample.stamp, sample.q, sample.qd)
        self.near_singular = near_singular
        self.near_singularities += near_singular
        if rates is None:
            return None
        self._last_good, self._memory = sample.q, memory
        return Torques(sample.stamp, motion, effort, sent, measured, saturated, external, rate_error, added)

    def _add_friction_memory(self, q: Array, rates: Array) -> tuple[Memory | None, Array | float]:
        """Return the presliding state after a sample, and the efforts (n,) that it adds."""
        friction = self.robot.friction
        if not friction.presliding.any():
            return None, 0.0
        before = self._memory or Memory.unknown_at(q)
        memory = before.advance_to(q[None], np.sign(rates), friction.presliding).last
        return memory, Dahl.memory_effort(friction, memory.z, rates)

    def _resolve_motion(
        self, sample: JointSample, rates: tuple[Array, Array], rate_error: Array | None
    ) -> tuple[tuple[Array, Array, Array], Array, Array]:
        """Return the measured motion, and the rates and accelerations to compute efforts for.

        Rates below their noise count as zero.
        """
        # Differentiated noise may contradict the loop constraints: take the nearest motion that fulfils them.
        rate, acceleration = nearest_motion(self.robot, sample.q, *rates)
        motion = sample.q, rate, acceleration
        rates_used = rate if sample.qd is None else rates[0]
        if rate_error is not None:
            rates_used = zero_resting_rates(rates_used, np.abs(rates_used) <= rate_error, self._friction_reach)
        if self.robot.redundant:
            _, own, acceleration = self.robot.project_redundant(sample.q, rates_used, acceleration)
            rates_used = own if sample.qd is None else rates_used
        return motion, rates_used, acceleration

    def _differentiate(self, sample: JointSample) -> tuple[Array, Array] | None:
        """Return rates and accelerations; tell the other estimators when the window's length changes."""
        rates = self.differentiator.push(sample.stamp, sample.q, sample.qd)
        if self.differentiator.window != self._window:
            self._window = self.differentiator.window
            self._velocity_error.gain = self.differentiator.slope_gain()
            if self.wrenches is not None:
                self.wrenches.window = self._window
        return rates


def _make_differentiator(s: Settings, robot: Robot) -> Differentiator:
    differentiator = Differentiator(s.order, s.window, time=1e-3 * max(s.window - 1, 24))
    differentiator.prepare(robot.joints_count)
    return differentiator


def warm_up(robot: Robot, *, base: bool = False) -> None:
    """Compile, or load, the programs of live use: for single samples and for batches.

    :param base: whether the base moves.
    :raises ParameterError: a robot without masses.
    """
    q = robot.inverse(robot.home())
    for batch in ((), (2,)):
        here = np.broadcast_to(q, (*batch, len(q)))
        rest = np.zeros_like(here)
        robot.forward(here)
        robot.singularity(here)
        inverse_dynamics(robot, here, rest, rest, base=np.zeros(9) if base else None)


def _evaluate_points(first: int, call: Callable[P, R], *arguments: P.args, **options: P.kwargs) -> R:
    """Evaluate the model at a trajectory's points from ``first`` on; errors name the point.

    :raises MessageError: the model rejects a point.
    """
    try:
        return as_message_error(call, *arguments, **options)
    except MessageError as error:
        if first == 0:
            raise
        raise MessageError(error.reason, f"in the points from point {first} on: {error}") from error
