# SPDX-License-Identifier: Apache-2.0
"""The node ``delta_dynamics``: trajectories and joint states in, feedforward torques out."""

from __future__ import annotations

import sys
import time
from array import array
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from geometry_msgs.msg import WrenchStamped
from rclpy.parameter import Parameter
from rclpy.time import Time
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray
from trajectory_msgs.msg import JointTrajectory

from delta_dynamics.feedforward import Feedforward, Settings, Torques, kernels
from delta_dynamics.reactions import reactions
from pkm_twin import load
from pkm_twin.errors import ParameterError, UnknownNameError
from pkm_twin.machine.robot import Robot
from pkm_twin.ros import node as health

CHANGES = {
    "payload.mass": ("payload", "mass"),
    "payload.com": ("payload", "com"),
    "payload.inertia": ("payload", "inertia"),
    "friction.viscous": ("friction", "viscous"),
    "friction.coulomb": ("friction", "coulomb"),
    "gravity": ("gravity", ""),
    "effort_limits": ("limits", "effort"),
}
"""Parameters that may change while the node runs, and the robot's section and key."""


class DeltaDynamics(health.TwinNode):
    """Feedforward torques from the virtual-work model of any robot with masses."""

    def __init__(self) -> None:
        super().__init__("delta_dynamics")
        robot = load(self.declare("mechanism", "delta_cu", "robot: name or path", read_only=True))
        # Before there is a topic to be found by: the first start compiles for many seconds.
        for kernel in kernels(robot):
            kernel.warm_up()
        robot = _changed(robot, self._declare_changes(robot))
        self._feedforward = Feedforward(robot, self._declare_settings())
        commands = self.declare("publish_commands", False, "publish ~/commands", read_only=True)
        if commands and "on_stop" not in self._parameter_overrides:
            # A controller of plain commands holds the last one for ever.
            raise ParameterError(
                "on_stop", None, "nothing, zeros or gravity, by name where publish_commands is true"
            )
        self._trajectory = self.create_guarded_publisher(JointTrajectory, "~/joint_trajectory_ff")
        # A torque is worth nothing once the stream that it answers would be stale.
        stale_after = self._feedforward.settings.stale_after
        self._torques = self.create_guarded_publisher(JointState, "~/joint_torques", stale_after)
        self._residual = self.create_guarded_publisher(JointState, "~/torque_residual")
        self._commands = (
            self.create_guarded_publisher(Float64MultiArray, "~/commands", stale_after)
            if commands
            else None
        )
        self._reactions = self._create_reaction_publishers(robot)
        self._effort = JointState(name=list(robot.joint_names))
        self._pending: Robot | None = None
        self.create_guarded_subscription(JointTrajectory, "~/joint_trajectory", self._on_trajectory)
        self.create_guarded_subscription(JointState, "joint_states", self._on_joint_state)
        self.add_on_set_parameters_callback(self._on_set)
        self.add_post_set_parameters_callback(self._after_set)
        self._last_heard = 0
        self.create_guarded_timer(min(0.25 * stale_after, 0.1), self._watch)
        # A step after which no stamp that was good before is good now.
        self.start(leap=stale_after + self._feedforward.settings.future_tolerance)

    def summary(self) -> str:
        """One line that says what the node runs."""
        robot = self._feedforward.robot
        return f"robot {robot.name} ({robot.mechanism}), joints {', '.join(robot.joint_names)}"

    def time_jumped_backward(self) -> None:
        """No torque across the seam: the stream starts anew."""
        self._feedforward.reset()

    def time_jumped_forward(self) -> None:
        """What was fresh is stale now: a running stream stops."""
        with self._telling_stop():
            self._feedforward.time_jumped_forward()

    def stream_broken(self, where: str) -> None:
        """Whatever failed: the stream is stopped."""
        self._stop("exception", f"{where} raised an exception")

    def diagnose(self) -> tuple[bytes, str, dict[str, object]]:
        """Level, message and values of the node's diagnostic status."""
        core = self._feedforward
        level, message = health.OK, "running"
        measure = core.singularity()
        if core.last_reject or core.saturations or core.near_singular:
            level = health.WARN
            message = "an effort limit was passed"
        if core.last_reject:
            message = f"last reject: {core.last_reject}"
        if core.near_singular:
            message = f"close to a singularity or the edge of reach: measure {measure:.3g}"
        if core.stream.stopped:
            level, message = health.ERROR, f"stopped: {core.stream.reason}: {core.stream.text}"
        values: dict[str, object] = {
            "robot": core.robot.name,
            "payload mass": core.robot.payload.mass,  # type: ignore[attr-defined]
            "joint states answered": core.stream.accepted,
            "trajectories answered": core.trajectories.accepted,
            "effort limit passed": core.saturations,
            "older stamps dropped": core.dropped,
            "close to a singularity": core.near_singularities,
            "distance to singularity": "" if measure is None else f"{measure:.4f}",
            "acceleration delay (samples)": core.differentiator_delay,
        }
        values |= {f"joint states rejected: {k}": v for k, v in core.stream.rejected.items()}
        values |= {f"trajectories rejected: {k}": v for k, v in core.trajectories.rejected.items()}
        values |= {f"stopped: {k}": v for k, v in core.stream.stops.items()}
        return level, message, values

    def _create_reaction_publishers(self, robot: Robot) -> dict[str, Any]:
        """A publisher for each joint's reaction, where the parameter asks for them."""
        wanted = self.declare("publish_reactions", False, "publish ~/reactions/*", read_only=True)
        rate = self.declare("reactions_rate", 50.0, "Hz of ~/reactions/*", read_only=True)
        self._reactions_period = round(1e9 / _within("reactions_rate", rate, 1e-3, 1e4))
        self._reactions_due = 0
        frame = self.declare("base_frame", "base_link", "frame of the reactions", read_only=True)
        self._base_frame = frame
        if not wanted:
            return {}
        return {
            name: self.create_guarded_publisher(
                WrenchStamped, f"~/reactions/{name.replace(' ', '_')}"
            )
            for name in reactions(robot, robot.inverse(robot.home()), *np.zeros((2, 3))).names
        }

    def _declare_changes(self, robot: Robot) -> dict[str, Any]:
        changes = {}
        for name, (section, key) in CHANGES.items():
            value = getattr(robot, section)
            value = getattr(value, key) if key else value
            if value is None:
                value = np.full(3, np.inf)
            default = value.ravel().tolist() if isinstance(value, np.ndarray) else value
            changes[name] = self.declare(name, default, f"robot's {name}, as in its file")
        return changes

    def _declare_settings(self) -> Settings:
        acceleration = self.declare(
            "acceleration", "trajectory", "trajectory | differentiate", read_only=True
        )
        if acceleration not in ("trajectory", "differentiate"):
            raise UnknownNameError("acceleration", acceleration, ("trajectory", "differentiate"))

        def fixed(name: str, default: Any, text: str) -> Any:
            return self.declare(name, default, text, read_only=True)

        def fraction(name: str, default: float, text: str) -> Any:
            return _within(name, fixed(name, default, text), 0.0, 1.0)

        policy = fixed("limit_policy", "warn", "warn | reject | clamp")
        if policy not in ("warn", "reject", "clamp"):
            raise UnknownNameError("limit_policy", policy, ("warn", "reject", "clamp"))
        on_stop = fixed("on_stop", "nothing", "nothing | zeros | gravity: sent once at a stop")
        if on_stop not in ("nothing", "zeros", "gravity"):
            raise UnknownNameError("on_stop", on_stop, ("nothing", "zeros", "gravity"))
        return Settings(
            differentiate=acceleration == "differentiate",
            order=_within("differentiator.order", fixed("differentiator.order", 2, "1 to 4"), 1, 4),
            window=_within(
                "differentiator.window", fixed("differentiator.window", 25, "samples"), 3, 1000
            ),
            limit_policy=policy,
            stale_after=_within("stale_after", fixed("stale_after", 0.1, "s"), 1e-3, 3600.0),
            future_tolerance=_within(
                "future_tolerance", fixed("future_tolerance", 0.1, "s"), 0.0, 3600.0
            ),
            accept_zero_stamp=fixed("accept_zero_stamp", False, "use arrival time"),
            trip_count=_within("trip_count", fixed("trip_count", 5, "rejects to stop"), 1, 10**6),
            recovery_count=_within(
                "recovery_count", fixed("recovery_count", 5, "to go on"), 1, 10**6
            ),
            on_stop=on_stop,
            singularity_warn=fraction("singularity_warn", 0.05, "measure below which to warn"),
            singularity_stop=fraction("singularity_stop", 0.01, "measure below which to stop"),
        )

    @contextmanager
    def _telling_stop(self) -> Iterator[None]:
        """Where the core stops the stream in here: log it, and send what ``on_stop`` says."""
        stream = self._feedforward.stream
        running = not stream.stopped
        try:
            yield
        finally:
            if running and stream.stopped:
                self._send_stop()

    def _on_trajectory(self, message: JointTrajectory) -> None:
        with self._telling_stop():
            efforts = self._feedforward.trajectory(message, self.now())
        for point, effort in zip(message.points, efforts.tolist(), strict=True):
            point.effort = effort
        self._trajectory.publish(message)

    def _on_joint_state(self, message: JointState) -> None:
        core = self._feedforward
        self._last_heard = time.monotonic_ns()
        with self._telling_stop():
            torques = core.joint_state(message, self.now())
        if torques is None:
            return
        stamp = message.header.stamp
        if core.settings.accept_zero_stamp:
            stamp = Time(nanoseconds=torques.stamp).to_msg()
        self._publish_effort(self._torques, stamp, torques.effort)
        if torques.residual is not None:
            self._publish_effort(self._residual, stamp, torques.residual)
        if self._commands is not None:
            self._commands.publish(Float64MultiArray(data=array("d", torques.effort.tobytes())))
        # A dense solve a sample is too much for the stream's own rate.
        if self._reactions and abs(torques.stamp - self._reactions_due) >= self._reactions_period:
            self._reactions_due = torques.stamp
            self._publish_reactions(stamp, torques)

    def _publish_reactions(self, stamp: Any, torques: Torques) -> None:
        """Every joint's wrench that rigid bodies determine, world axes, at the joint's point."""
        result = reactions(self._feedforward.robot, *torques.motion)
        for k, name in enumerate(result.names):
            if not result.determinate[k].all():
                continue
            message = WrenchStamped()
            message.header.stamp = stamp
            message.header.frame_id = self._base_frame
            force, torque = message.wrench.force, message.wrench.torque
            force.x, force.y, force.z, torque.x, torque.y, torque.z = result.wrenches[k].tolist()
            self._reactions[name].publish(message)

    def _publish_effort(self, publisher: Any, stamp: Any, effort: np.ndarray[Any, Any]) -> None:
        # One message for all: publishing copies it.
        message = self._effort
        message.header.stamp = stamp
        message.effort = array("d", effort.tobytes())
        publisher.publish(message)

    def _watch(self) -> None:
        """Stop a stream that has gone silent; runs on the steady clock."""
        core = self._feedforward
        silent = (time.monotonic_ns() - self._last_heard) / 1e9
        if self._last_heard and not core.stream.stopped and silent > core.settings.stale_after:
            self._stop("stale input", f"no joint state for {silent:.3f} s")

    def _stop(self, reason: str, text: str) -> None:
        with self._telling_stop():
            if self._feedforward.stream.stop(reason, text):
                self._feedforward.reset()

    def _send_stop(self) -> None:
        core = self._feedforward
        self.log_throttled("stop", f"stopped: {core.stream.reason}: {core.stream.text}")
        effort = core.stop_effort()
        if effort is None:
            return
        self._publish_effort(self._torques, self.get_clock().now().to_msg(), effort)
        if self._commands is not None:
            self._commands.publish(Float64MultiArray(data=array("d", effort.tobytes())))

    def _on_set(self, changes: list[Parameter]) -> Any:
        values = health.values_of(changes)

        def check() -> None:
            self._pending = _changed(
                self._feedforward.robot, {k: v for k, v in values.items() if k in CHANGES}
            )

        return health.verdict(check)

    def _after_set(self, changes: list[Parameter]) -> None:
        if self._pending is not None:
            self._feedforward.change_robot(self._pending)
            self._pending = None


def _changed(robot: Robot, values: dict[str, Any]) -> Robot:
    sections: dict[str, Any] = {}
    for name, value in values.items():
        section, key = CHANGES[name]
        plain = list(value) if hasattr(value, "__len__") else value
        if name == "payload.inertia" and len(plain) == 9:
            plain = [plain[0:3], plain[3:6], plain[6:9]]
        if key:
            sections.setdefault(section, {})[key] = plain
        else:
            sections[section] = plain
    return robot.changed(**sections)


def _within(name: str, value: Any, low: float, high: float) -> Any:
    if not low <= value <= high:
        raise ParameterError(name, value, f"{low:g} to {high:g}")
    return value


def main() -> None:
    """Entry point of ``ros2 run pkm_twin delta_dynamics``."""
    sys.exit(health.run(DeltaDynamics))


if __name__ == "__main__":
    main()
