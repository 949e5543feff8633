# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""The node ``command_gate``: stamped torques in, plain commands of an effort controller out."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from typing import Final

import numpy as np

from delta_dynamics.gate import Gate, GateSettings
from delta_dynamics.nodes.parameters import changed, declare_changes
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

CHANGEABLE: Final = ("effort_limits", "payload.mass", "payload.com")
"""Parameters that may change while the gate runs."""
TORQUES = "delta_dynamics/joint_torques"
MAX_DEADLINE = 3600.0
"""Longest deadline that a node of the suite promises, s; the middleware's "none" is longer."""
MAX_ACKNOWLEDGE_TIME = 0.5
"""Longest wait at the end for the controller's acknowledgement of the last command, s."""


class CommandGate(TwinNode):
    """Forwards live torques, and sends zeros or gravity from the start until they come.

    A process of its own: it outlives the node whose torques it forwards.
    """

    topics = GATE

    def __init__(self) -> None:
        super().__init__("command_gate")
        robot = self.declare_robot()
        settings = self.declare_settings(GateSettings, fixed=True)
        self.core = Gate(robot, settings)
        self._closed = True
        # With names and a stamp for recordings and plots.
        self._commands = EffortPublisher(self, robot, "~/commands_stamped", "~/commands")
        self._declare_robot(settings)
        self.create_guarded_subscription(
            TORQUES,
            self._on_torques,
            refuse=self._refuse_torques,
            expected=True,
            expires=lambda: settings.deadline,
            expiry=settings.deadline,
        )
        if settings.on_stop == "gravity":
            self.create_guarded_subscription(
                "joint_states",
                lambda m: self.core.joint_state(m, self.now(), time.monotonic_ns()),
                refuse=partial(self.core.refuse, self.core.states),
                expected=True,
            )
        self.follow(
            CHANGEABLE,
            lambda values: changed(self.core.robot, values),
            self.core.change_robot,
        )
        self.create_guarded_timer(min(0.25 * settings.deadline, 0.1), self._watch)
        self.start(leap=settings.deadline + settings.future_tolerance)

    def details(self) -> str:
        """Return the diagnostics' text: what is sent without torques."""
        settings = self.core.settings
        return f", {settings.on_stop} after {settings.deadline:g} s without a torque"

    def time_jumped_backward(self) -> None:
        """Close the gate until torques with stamps of the new clock come."""
        self.core.reset()

    def stream_broken(self, where: str) -> None:
        """Whatever failed: the gate is closed."""
        self.core.stream.stop("exception", f"{where} raised an exception")

    def activated(self) -> None:
        """At once: the controller may still hold what a gate before this one has sent."""
        self._send(self.core.stop_command(time.monotonic_ns()))

    def deactivated(self) -> None:
        """Send the closed gate's command last, because the controller holds it indefinitely."""
        self.core.stream.stop("inactive", "the node was deactivated")
        self._tell()
        self._send(self.core.stop_command(time.monotonic_ns()))

    def shutdown(self) -> None:
        """Send the last command, and wait until the controller has it."""
        super().shutdown()
        self._commands.wait_for_controllers(MAX_ACKNOWLEDGE_TIME)

    def reset_stop(self) -> str:
        """Open without waiting for good torques."""
        stream = self.core.stream
        return stream.status if stream.resume() else ""

    def judge(self) -> tuple[bytes, str]:
        """Level and message of the node's diagnostic status."""
        stream = self.core.stream
        if stream.stopped:
            return health.ERROR, f"closed: {self._promised_too_late() or stream.status}"
        level, message = super().judge()
        return level, "open" if level == health.OK else message

    def values(self) -> dict[str, object]:
        """Values of the node's diagnostic status."""
        stream = self.core.stream
        return {
            "open": not stream.stopped,
            "controllers": self._commands.controllers,
            **stream.counts("torques", "forwarded"),
            **self.core.states.counts("joint states"),
            **{f"closed: {k}": v for k, v in stream.stops.items()},
        }

    def _promised_too_late(self) -> str:
        """Whose torques the middleware keeps from the gate, as they promise a longer deadline."""
        deadline = self.core.settings.deadline
        for publisher in self.get_publishers_info_by_topic(self.resolve_topic_name(TORQUES)):
            promised = publisher.qos_profile.deadline.nanoseconds / SECOND
            if promised > deadline:
                name = health.node_of(publisher)
                bound = f"{promised:g} s" if promised < MAX_DEADLINE else "none"
                return (
                    f"{name} offers torques with deadline {bound}, command_gate requests "
                    f"{deadline:g} s, so none arrive: set stale_after of {name} to at most "
                    f"{deadline:g} s"
                )
        return ""

    def _declare_robot(self, settings: GateSettings) -> None:
        """Effort limits, and the payload whose weight ``on_stop`` gravity bears."""
        robot = self.core.robot
        # Not every robot's file has a place for what is not given.
        robot = changed(robot, declare_changes(self, robot, CHANGEABLE))
        if settings.on_stop == "gravity":
            # Refused here where the robot has no masses; and compiled before it is needed.
            zeros = np.zeros(len(robot.joint_names))
            inverse_dynamics(robot, robot.inverse(robot.home()), zeros, zeros)
        self.core.change_robot(robot)

    @contextmanager
    def _watching(self) -> Iterator[None]:
        """Send the closed gate's command at once if torques close the gate."""
        running = not self.core.stream.stopped
        try:
            yield
        finally:
            if running and self.core.stream.stopped:
                self._watch()

    def _refuse_torques(self, error: MessageError) -> None:
        with self._watching():
            self.core.refuse(self.core.stream, error)

    def _on_torques(self, message: JointStateView) -> None:
        with self._watching():
            command = self.core.torques(message, self.now(), time.monotonic_ns())
        if command is not None:
            self._send(command)

    def _watch(self) -> None:
        """While the gate is closed its command is repeated: a controller may come late."""
        if not self.active:
            return
        steady = time.monotonic_ns()
        self.core.watch(steady)
        self._tell()
        if self.core.stream.stopped:
            self._send(self.core.stop_command(steady))

    def _tell(self) -> None:
        """Log each opening and closing of the gate."""
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
