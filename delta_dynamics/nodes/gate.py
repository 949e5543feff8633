# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""The node ``command_gate``: stamped torques in, plain commands of an effort controller out."""

from __future__ import annotations

import sys
import time
from functools import partial

import numpy as np

from delta_dynamics.gate import Gate, GateSettings
from delta_dynamics.nodes.parameters import change_robot, declare_changes
from delta_dynamics.nodes.topics import GATE
from delta_dynamics.torques.virtual_work import inverse_dynamics
from pkm_twin.errors import MessageError
from pkm_twin.messages.fast_decoder import JointStateView
from pkm_twin.messages.stamps import SECOND
from pkm_twin.robot.effort_limits import LimitedEfforts
from pkm_twin.ros import health
from pkm_twin.ros.joints import EffortPublisher
from pkm_twin.ros.node import TwinNode
from pkm_twin.ros.run import run

CHANGEABLE = ("effort_limits", "payload.mass", "payload.com")
"""Parameters that may change while the gate runs."""
TORQUES_TOPIC = "delta_dynamics/joint_torques"
MAX_DEADLINE = 3600.0
"""Longest deadline that a node of the suite promises, s; the middleware's "none" is longer."""


class CommandGate(TwinNode):
    """Forward current torques; without them send zeros or the effort against gravity.

    It has a process of its own, so that it outlives the node whose torques it forwards.
    """

    topics = GATE
    core: Gate

    def __init__(self) -> None:
        super().__init__("command_gate")
        robot = self.declare_robot()
        settings = self.declare_settings(GateSettings, fixed=True)
        self._closed = True
        # With names and a stamp for recordings and plots.
        self._commands = EffortPublisher(self, robot, "~/commands_stamped", "~/commands")
        # Inertia has no effect at rest, and a payload must have none if its mass is set to 0 kg.
        robot = robot.changed(payload={"inertia": [0.0, 0.0, 0.0]})
        robot = change_robot(robot, declare_changes(self, robot, CHANGEABLE))
        if settings.on_stop == "gravity":
            # Compile before the first use; a robot without masses is rejected here.
            zeros = np.zeros(len(robot.joint_names))
            inverse_dynamics(robot, robot.inverse(robot.home()), zeros, zeros)
        self.core = Gate(robot, settings)
        self.create_guarded_subscription(
            TORQUES_TOPIC,
            self._on_torques,
            on_reject=self._reject_torques,
            expected=True,
            expires=lambda: settings.deadline,
            expiry=settings.deadline,
        )
        if settings.on_stop == "gravity":
            self.create_guarded_subscription(
                "joint_states",
                lambda m: self.core.joint_state(m, self.now(), time.monotonic_ns()),
                on_reject=partial(self.core.count_rejection, self.core.states),
                expected=True,
            )
        self.follow(CHANGEABLE, lambda values: change_robot(self.core.robot, values), self.core.change_robot)
        self.create_guarded_timer(min(0.25 * settings.deadline, 0.1), self._repeat_stop_command)
        self.start(leap=settings.deadline + settings.future_tolerance)

    def details(self) -> str:
        """Return the diagnostics' text: what is sent without torques."""
        settings = self.core.settings
        return f", {settings.on_stop} after {settings.deadline:g} s without a torque"

    def time_jumped_backward(self) -> None:
        """Close the gate until torques with stamps of the new clock come."""
        self.core.reset()

    def stream_broken(self, where: str) -> None:
        """Close the gate after an exception."""
        self.core.stream.stop("exception", f"{where} raised an exception")

    def activated(self) -> None:
        """Send a command at once, because the controller may still hold one of an earlier gate."""
        self._send(self.core.stop_command(time.monotonic_ns()))

    def deactivated(self) -> None:
        """Send the closed gate's command last, because the controller holds it indefinitely."""
        self.core.stream.stop("inactive", "the node was deactivated")
        self._log_changes()
        self._send(self.core.stop_command(time.monotonic_ns()))

    def shutdown(self) -> None:
        """Send the last command, and wait until the controller has it."""
        super().shutdown()
        self._commands.wait_for_controllers()

    def reset_stop(self) -> str:
        """Open without waiting for good torques; return the description of the stop."""
        return self.core.stream.resume()

    def worst_status(self) -> tuple[bytes, str]:
        """Return level and message of the node's diagnostic status."""
        stream = self.core.stream
        if stream.stopped:
            return health.ERROR, f"closed: {self._find_longer_deadline() or stream.status}"
        level, message = super().worst_status()
        return level, "open" if level == health.OK else message

    def values(self) -> dict[str, object]:
        """Return the values of the node's diagnostic status."""
        stream = self.core.stream
        return {
            "open": not stream.stopped,
            "controllers": self._commands.controller_count,
            **stream.counts("torques", "forwarded"),
            **self.core.states.counts("joint states"),
            **{f"closed: {k}": v for k, v in stream.stops.items()},
        }

    def _find_longer_deadline(self) -> str:
        """Name a node whose torques the middleware withholds, as it offers a longer deadline."""
        deadline = self.core.settings.deadline
        for publisher in self.get_publishers_info_by_topic(self.resolve_topic_name(TORQUES_TOPIC)):
            promised = publisher.qos_profile.deadline.nanoseconds / SECOND
            if promised > deadline:
                name = health.endpoint_node_name(publisher)
                bound = f"{promised:g} s" if promised < MAX_DEADLINE else "none"
                return (
                    f"{name} offers torques with deadline {bound}, command_gate requests "
                    f"{deadline:g} s, so none arrive: set stale_after of {name} to at most "
                    f"{deadline:g} s"
                )
        return ""

    def _reject_torques(self, error: MessageError) -> None:
        with self.core.stream.reacting(self._repeat_stop_command):
            self.core.count_rejection(self.core.stream, error)

    def _on_torques(self, message: JointStateView) -> None:
        # A closed gate sends its command at once.
        with self.core.stream.reacting(self._repeat_stop_command):
            command = self.core.torques(message, self.now(), time.monotonic_ns())
        if command is not None:
            self._send(command)

    def _repeat_stop_command(self) -> None:
        """Send the closed gate's command repeatedly, because a controller may start later."""
        if not self.active:
            return
        steady = time.monotonic_ns()
        self.core.close_if_silent(steady)
        self._log_changes()
        if self.core.stream.stopped:
            self._send(self.core.stop_command(steady))

    def _log_changes(self) -> None:
        stream = self.core.stream
        if stream.stopped is self._closed:
            return
        self._closed = stream.stopped
        if stream.stopped:
            self.log_throttled("closed", f"closed: {stream.status}")
        else:
            self.log_throttled("open", "open: torques are forwarded")

    def _send(self, command: LimitedEfforts) -> None:
        self._commands.publish(self.now(), command)


NODE = CommandGate
"""The node class, for a process of one or several nodes."""

if __name__ == "__main__":
    sys.exit(run(NODE))
