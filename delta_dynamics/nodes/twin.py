# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""The node ``delta_dynamics``: trajectories and joint states in, feedforward torques out."""

from __future__ import annotations

import sys
import time
from contextlib import AbstractContextManager
from typing import Any

import numpy as np
from geometry_msgs.msg import WrenchStamped

from delta_dynamics.feedforward import Feedforward, Settings, Torques, warm_up
from delta_dynamics.nodes.estimates import Estimates
from delta_dynamics.nodes.parameters import CHANGEABLE_PARAMETERS, change_robot, declare_changes
from delta_dynamics.nodes.topics import TWIN
from delta_dynamics.torques.reactions import reactions
from pkm_twin.errors import MessageError, ParameterError
from pkm_twin.messages.fast_decoder import JointStateView, RawTrajectory
from pkm_twin.messages.stamps import SECOND
from pkm_twin.robot.robot import Robot
from pkm_twin.ros import health
from pkm_twin.ros.joints import EffortPublisher, JointPublisher, make_wrench_message
from pkm_twin.ros.node import TwinNode
from pkm_twin.ros.run import run
from pkm_twin.ros.turns import Task
from pkm_twin.ros.wrench import declare_mounts
from pkm_twin.settings import DURATION_BOUNDS, list_changeable, with_parameters
from pkm_twin.streams.base_motion import BaseImu, ImuSettings
from pkm_twin.streams.matched import WrenchWindow
from pkm_twin.streams.monitor import Pace
from pkm_twin.streams.topics import make_topic_tokens
from pkm_twin.streams.wrench import WrenchReader, WrenchSettings


class DeltaDynamics(TwinNode):
    """Feedforward torques from the virtual-work model of any robot with masses."""

    topics = TWIN
    core: Feedforward

    def __init__(self) -> None:
        super().__init__("delta_dynamics")
        robot = self.declare_robot()
        imu = "take the motion of the base from base_imu, else it is at rest; only joint states are answered then"
        wanted = self.declare("base_imu", False, imu)
        settings_of_imu = self.declare_settings(ImuSettings, fixed=True)
        base = BaseImu(settings_of_imu) if wanted else None
        # Other nodes find this one by its topics: compile before, as a first start takes many seconds.
        warm_up(robot, base=base is not None)
        robot = change_robot(robot, declare_changes(self, robot))
        settings = self.declare_settings(Settings)
        self.core = Feedforward(robot, settings, self._create_wrench_window(settings), base)
        commands = self.declare("publish_commands", False, "publish ~/commands")
        if commands and "on_stop" not in self.given:
            # An effort controller holds the last plain command indefinitely.
            text = "nothing, zeros or gravity, explicitly set, because publish_commands is true"
            raise ParameterError("on_stop", None, text)
        self._trajectory = self.create_guarded_publisher("~/joint_trajectory_ff")
        # A torque expires after the time after which its joint state counts as stale.
        stale_after = self.core.settings.stale_after
        self._torques = EffortPublisher(
            self, robot, "~/joint_torques", "~/commands", stale_after, with_plain=bool(commands)
        )
        self._residual = JointPublisher(self, robot, "~/torque_residual")
        self._reactions = self._create_reaction_publishers(robot)
        self._estimates = Estimates(self, lambda: self.core.robot, (self._base_frame, "platform"))
        self.core.uncertain = self._estimates.enabled
        if self._estimates.warning():
            self.get_logger().warning(self._estimates.warning())
        self.create_guarded_subscription("~/joint_trajectory", self._on_trajectory, raw=True)
        self.create_guarded_subscription(
            "joint_states",
            self._on_joint_state,
            on_reject=self._reject_joint_state,
            expected=True,
            expires=lambda: self.core.settings.stale_after,
            every=True,
        )
        self._action = self._create_action()
        if base is not None:
            for name in ("publish_reactions", "estimate_payload", "observe_wrench"):
                if self.get_parameter(name).value:
                    raise ParameterError(name, True, "false with base_imu: it is for a base at rest")
            if self._action is not None:
                raise ParameterError(
                    "controller_action", self.get_parameter("controller_action").value, "empty with base_imu"
                )
            self.create_guarded_subscription(
                "base_imu", lambda message: base.take(message, self.now()), expected=True, every=True
            )
        self.follow([*CHANGEABLE_PARAMETERS, *list_changeable(Settings)], self._prepare_changes, self._apply_changes)
        self._reported_window = 0
        self._accepted: tuple[int, Any] | None = None
        """Arrival of the last accepted joint state by the steady clock, ns, and the message."""
        self._watchdog: Any = None
        self._start_watchdog(stale_after)
        # A clock step that makes every accepted stamp too old.
        self.start(leap=stale_after + self.core.settings.future_tolerance)

    def time_jumped_backward(self) -> None:
        """Start the stream again: no torque spans the jump."""
        self.core.reset()
        self._estimates.reset()
        self._reactions_pace.reset()

    def time_jumped_forward(self) -> None:
        """Stop a running stream, whose samples are stale after a jump of the clock."""
        with self._reacting_to_stop():
            self.core.time_jumped_forward()
        self._estimates.reset()

    def stream_broken(self, where: str) -> None:
        """Stop the stream after an exception."""
        self._stop_stream("exception", f"{where} raised an exception")

    def activated(self) -> None:
        """Begin a new stream."""
        self.time_jumped_backward()
        self._accepted = None

    def deactivated(self) -> None:
        """Stop a running stream, and abort the goals that wait."""
        if self._action is not None:
            self._action.deactivated()
        if self._accepted is not None:
            self._stop_stream("inactive", "the node was deactivated")

    def shutdown(self) -> None:
        """End the goals, hold the machine and send the stop's torque, before all else ends."""
        if self._action is not None:
            self._action.shutdown()
        super().shutdown()
        self._torques.wait_for_controllers()

    @property
    def shutting_down(self) -> bool:
        """True while results of ended goals still have to be sent by the executor."""
        return self._action is not None and self._action.shutting_down

    def reset_stop(self) -> str:
        """End a stop without waiting for good samples; return its description."""
        return self.core.stream.resume()

    def worst_status(self) -> tuple[bytes, str]:
        """Return level and message of the node's diagnostic status: those of the worst problem."""
        core, estimates = self.core, self._estimates
        if core.rates.fault:
            self.log_throttled("rates", core.rates.fault)
        if core.stream.stopped:
            return health.ERROR, f"stopped: {core.stream.status}"
        if core.near_singular:
            measure = core.singularity()
            index = "" if measure is None else f": index {measure:.3g}"
            return health.WARN, f"close to a singularity or the edge of the workspace{index}"
        level, message = super().worst_status()
        if core.rates.fault:
            return health.WARN, core.rates.fault
        if level != health.OK:
            return level, message
        if core.saturations:
            return health.WARN, "an effort exceeded its limit"
        if estimates.touching and not estimates.idle:
            return health.WARN, "contact detected: an external effort is beyond its bound"
        for one in (core.wrenches, core.base):
            if one is not None and one.last_reject:
                return health.WARN, f"last reject: {one.last_reject}"
        if estimates.idle:
            message = "the drives are off or braked: their efforts are ignored"
        return level, message

    def values(self) -> dict[str, object]:
        """Return the values of the node's diagnostic status."""
        core = self.core
        measure = core.singularity()
        values: dict[str, object] = {
            "payload mass": core.robot.payload.mass,
            "effort limit exceeded": core.saturations,
            "older stamps dropped": core.dropped,
            "close to a singularity": core.near_singularities,
            "singularity index": "" if measure is None else f"{measure:.4f}",
            "acceleration delay (samples)": core.differentiator.delay,
            "acceleration window": self._describe_window(),
        }
        if core.robot.friction.presliding.any():
            values["friction unknown before motion"] = " ".join(core.unknown_friction())
        values |= core.stream.counts("joint states", "answered")
        values |= core.trajectories.counts("trajectories", "answered")
        values |= {f"stopped: {k}": v for k, v in core.stream.stops.items()}
        values |= self._estimates.diagnose()
        if core.wrenches is not None:
            values["joint states without a wrench"] = core.wrenches.without
            values |= core.wrenches.stream.counts("wrenches")
        if core.base is not None:
            values |= core.base.stream.counts("messages of base_imu")
        return values

    def _describe_window(self) -> str:
        """Describe the differentiator's window and its errors; log a new length."""
        fit = self.core.differentiator
        if fit.period == 0.0:
            return ""
        length, error = fit.period * (fit.window - 1), 100.0 * fit.sine_error(1.0)
        text = (
            f"{fit.window} samples, {1e3 * length:.3g} ms: error for a sine of 1 Hz {error:.2g} % "
            f"of the peak acceleration; noise of a sample times {fit.noise_gain():.3g}"
        )
        if fit.window != self._reported_window:
            self._reported_window = fit.window
            self.get_logger().info(f"joint states at {1.0 / fit.period:.4g} Hz, window {text}")
        return text

    def _create_action(self) -> Any:
        controller = self.declare(
            "controller_action",
            "",
            "FollowJointTrajectory action of the controller that ~/follow_joint_trajectory forwards to; empty: none",
        )
        hold = self.declare(
            "on_cancel",
            "hold",
            "what happens when a goal ends early: hold sends a hold point with the effort against "
            "gravity, controller leaves the reaction to the controller",
            choices=("hold", "controller"),
        )
        if not controller:
            return None
        try:
            from delta_dynamics.nodes.action import EffortAction
        except ImportError as error:
            raise ParameterError("controller_action", controller, f"empty without control_msgs ({error})") from error
        return EffortAction(
            self,
            controller,
            lambda trajectory: self.core.trajectory_steps(trajectory, self.now()),
            self._read_positions,
            hold == "hold",
            hold_efforts=lambda trajectory: self.core.trajectory_steps(trajectory, self.now(), holding=True),
            max_age=lambda: self.core.settings.stale_after,
            check=self.core.check_shape,
        )

    def _read_positions(self) -> dict[str, float] | None:
        """Return the joint positions by the controller's names and values; None if not measured."""
        pose, stale_after = self.core.pose, self.core.settings.stale_after
        if self._accepted is None or pose is None or pose.age(time.monotonic_ns()) > stale_after:
            return None
        state = self._accepted[1]
        return dict(zip(state.name, map(float, state.position), strict=True))

    def _create_wrench_window(self, settings: Settings) -> WrenchWindow | None:
        wanted = self.declare(
            "use_wrench", False, "include the measured wrench in torques and residual of joint states"
        )
        age = self.declare(
            "max_wrench_age", 0.1, "largest time between a joint state and its wrench", **DURATION_BOUNDS
        )
        policy = self.declare(
            "missing_wrench_policy",
            "ignore",
            "without a fresh wrench: ignore computes without one, stop stops the stream",
            choices=("ignore", "stop"),
        )
        wrench = self.declare_settings(
            WrenchSettings,
            fixed=True,
            max_state_age=age,
            future_tolerance=settings.future_tolerance,
            accept_zero_stamp=settings.accept_zero_stamp,
        )
        self._base_frame = wrench.base_frame
        mounts = declare_mounts(self)
        if not wanted:
            return None
        self.create_guarded_subscription("wrench", self._on_wrench, expected=True, every=True)
        return WrenchWindow(WrenchReader(wrench, mounts), round(age * SECOND), policy, settings.order, settings.window)

    def _on_wrench(self, message: WrenchStamped) -> None:
        wrenches = self.core.wrenches
        if wrenches is not None:
            wrenches.take(message, self.now())

    def _create_reaction_publishers(self, robot: Robot) -> dict[str, Any]:
        wanted = self.declare("publish_reactions", False, "publish ~/reactions/*")
        rate = self.declare("reactions_rate", 50.0, "rate of ~/reactions/*", unit="Hz", low=1e-3, high=1e4)
        self._reactions_pace = Pace(rate)
        if not wanted:
            return {}
        rest = np.zeros((2, len(robot.joint_names)))
        names = reactions(robot, robot.inverse(robot.home()), *rest).names
        return {
            name: self.create_guarded_publisher("~/reactions/<joint>", joint=token)
            for name, token in make_topic_tokens(names).items()
        }

    def _reacting_to_stop(self) -> AbstractContextManager[None]:
        """Log a stop of the stream within the block, and send the command of ``on_stop``."""
        core = self.core

        def send_stop() -> None:
            self.log_throttled("stop", f"stopped: {core.stream.status}")
            stamp, effort = self.now(), core.stop_effort(time.monotonic_ns())
            if effort is not None:
                self._torques.publish(stamp, effort)

        return core.stream.reacting(send_stop)

    def _on_trajectory(self, data: bytes) -> None:
        with self.core.count_rejections(self.core.trajectories):
            self.defer("~/joint_trajectory", self._answer_trajectory(data))

    def _answer_trajectory(self, data: bytes) -> Task:
        """Answer a trajectory in steps, so that the stream is answered meanwhile."""
        with self.core.count_rejections(self.core.trajectories):
            raw = RawTrajectory.decode(data)
        steps = self.core.trajectory_steps(raw.fields, self.now())
        while True:
            yield
            try:
                with self._reacting_to_stop():
                    next(steps)
            except StopIteration as end:
                efforts = end.value
                break
        yield
        self._trajectory.publish(raw.with_effort(efforts))
        if self._action is not None:
            self._action.cancel_hold_points()

    def _reject_joint_state(self, error: MessageError) -> None:
        with self._reacting_to_stop():
            self.core.count_rejection(self.core.stream, error)

    def _on_joint_state(self, message: JointStateView) -> None:
        core, came = self.core, time.monotonic_ns()
        with self._reacting_to_stop():
            torques = core.joint_state(message, self.now(), came)
            if torques is not None:
                # The process may have been suspended since.
                core.check_age(torques, self.now())
            # Only accepted messages reset the watchdog: a rejected one may come from another machine.
            self._accepted = came, message
            if torques is None:
                return
        self._torques.publish(torques.stamp, torques.sent)
        if torques.residual is not None:
            self._residual.publish(torques.stamp, core.robot.controller.controller_efforts(torques.residual))
        self.call_further_outputs("reactions or estimates", torques, self._estimates.update, self._publish_reactions)

    def _publish_reactions(self, torques: Torques) -> None:
        """Publish the wrenches of the joints that rigid-body statics determines, base axes, at the joint.

        Their rate is limited, because each sample needs a dense linear solve.
        """
        if not (self._reactions and self._reactions_pace.due(torques.stamp)):
            return
        self._reactions_pace.answered(torques.stamp)
        result = reactions(self.core.robot, *torques.motion, torques.wrench)
        for k, name in enumerate(result.names):
            if result.determinate[k].all():
                message = make_wrench_message(torques.stamp, self._base_frame, result.wrenches[k])
                self._reactions[name].publish(message)

    def _start_watchdog(self, stale_after: float) -> None:
        if self._watchdog is not None:
            self.destroy_timer(self._watchdog)
        self._watchdog = self.create_guarded_timer(min(0.25 * stale_after, 0.1), self._stop_if_silent)

    def _stop_if_silent(self) -> None:
        """Stop a silent stream; runs on the steady clock."""
        core = self.core
        silent = 0.0 if self._accepted is None else (time.monotonic_ns() - self._accepted[0]) / SECOND
        if not core.stream.stopped and silent > core.settings.stale_after:
            self._stop_stream("stale input", f"no accepted joint state for {silent:.3f} s")

    def _stop_stream(self, reason: str, text: str) -> None:
        with self._reacting_to_stop():
            self.core.stop(reason, text)

    def _prepare_changes(self, values: dict[str, Any]) -> tuple[Robot, Settings]:
        core, own = self.core, {k: v for k, v in values.items() if k in CHANGEABLE_PARAMETERS}
        robot = change_robot(core.robot, own) if own else core.robot
        return robot, with_parameters(core.settings, values)

    def _apply_changes(self, prepared: tuple[Robot, Settings]) -> None:
        (robot, settings), core = prepared, self.core
        before = core.settings
        if robot is not core.robot:
            core.change_robot(robot)
            self._estimates.change_robot(robot)
        core.change_settings(settings)
        if settings.stale_after != before.stale_after:
            self._start_watchdog(settings.stale_after)


NODE = DeltaDynamics
"""The node class, for a process of one or several nodes."""

if __name__ == "__main__":
    sys.exit(run(NODE))
