# SPDX-License-Identifier: Apache-2.0
"""What every node of the suite shares: life cycle, parameters, guards, diagnostics.

Nothing that runs while a node spins can end it: what a message, a request or a clock breaks is
caught, counted and told.
"""

from __future__ import annotations

import os
import threading
import time
import weakref
from typing import Any, Final

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.clock import ClockChange, JumpThreshold
from rclpy.duration import Duration
from rclpy.lifecycle import LifecycleState, TransitionCallbackReturn
from std_srvs.srv import Trigger

from pkm_twin.ros.guarded import GuardedNode
from pkm_twin.ros.health import WARN
from pkm_twin.ros.qos import output_qos
from pkm_twin.ros.requests import guarded_service
from pkm_twin.ros.turns import SELDOM_PERIOD, Task, Tasks

COMPILING: Final = "compiling the robot's programs; no message is answered yet"
COMPILING_PERIOD: Final = 1.0
"""How often a node that is not ready says so, s."""


class TwinNode(GuardedNode):
    """A life-cycle node with guarded callbacks, diagnostics at 1 Hz and checked parameters.

    Everything is made and every parameter checked before the first state; a node that is not
    active takes no message.
    """

    def __init__(self, name: str) -> None:
        """Declare what all nodes have."""
        super().__init__(name)
        self._tasks = Tasks(self.failed)
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", output_qos())
        self._made = threading.Event()
        # A node that cannot be made has to go: the thread does not hold it.
        told = weakref.ref(self), self._made
        self._maker = threading.Thread(target=_tell_compiling, args=told, daemon=True)
        self._maker.start()

    def start(self, leap: float | None = None) -> None:
        """Refuse unknown parameters, begin the diagnostics, and say where the node listens.

        :param leap: how far the ROS clock goes forward at once for :meth:`time_jumped_forward`, s.
        """
        self.close_declarations()
        self.create_guarded_timer(1.0, self._publish_diagnostics)
        self.create_service(Trigger, "~/reset", self._on_reset)
        for service in self.services:
            service.callback = guarded_service(
                service.srv_type, service.callback, self.health, lambda: len(self.declared)
            )
            service.callback_group = self.seldom
            self.seldom.add_entity(service)
        if self.executor_kind == "single":
            self.create_guarded_timer(SELDOM_PERIOD, self.seldom.open)
        # Kept: the middleware calls the handle without holding it.
        self._jump_handle = self.get_clock().create_jump_callback(
            JumpThreshold(
                min_forward=None if leap is None else Duration(seconds=leap),
                min_backward=Duration(nanoseconds=-1),
                on_clock_change=True,
            ),
            post_callback=self._jumped,
        )
        domain = os.environ.get("ROS_DOMAIN_ID", "0")
        reach = os.environ.get("ROS_AUTOMATIC_DISCOVERY_RANGE", "SUBNET")
        self.get_logger().info(f"{self.summary()}; domain {domain}, discovery {reach}")

    def begin(self) -> None:
        """All nodes of the process are made and the executor is about to run: answer."""
        self._end_compiling()
        if self.autostart:
            self.trigger_configure()
            self.trigger_activate()

    def summary(self) -> str:
        """One line that says what the node runs."""
        raise NotImplementedError

    def diagnose(self) -> tuple[bytes, str, dict[str, object]]:
        """Level, message and values of the node's diagnostic status."""
        raise NotImplementedError

    def time_jumped_backward(self) -> None:
        """The ROS clock went back or changed: forget everything that depends on time."""

    def time_jumped_forward(self) -> None:
        """The ROS clock went forward by more than a stream's messages may be apart."""
        self.time_jumped_backward()

    def publish_compiling(self) -> None:
        """A node that can be seen says why it does not answer."""
        name = self.get_fully_qualified_name()
        array = DiagnosticArray(status=[DiagnosticStatus(level=WARN, name=name, message=COMPILING)])
        array.header.stamp = self.get_clock().now().to_msg()
        self._diagnostics.publish(array)

    def _end_compiling(self) -> None:
        self._made.set()
        self._maker.join()

    def farewell(self) -> None:
        """The end: nothing is answered from here on, while the topics are still there."""
        self._end_compiling()
        self._quit()

    @property
    def parting(self) -> bool:
        """Whether something of the end still waits for turns of the executor."""
        return False

    def activated(self) -> None:
        """Messages are answered from here on."""

    def deactivated(self) -> None:
        """Messages are not answered from here on."""

    def reset_stop(self) -> str:
        """End a stop that is latched; says what was ended, empty where nothing was."""
        return ""

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Begin to answer."""
        self.activated()
        # What came before and waits is not for a node that is active.
        self.active_since = time.time_ns()
        self.active = True
        return super().on_activate(state)

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Answer nothing more; what waits is forgotten."""
        self._quit()
        return super().on_deactivate(state)

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """As deactivated, for good."""
        self._quit()
        return super().on_shutdown(state)

    def _quit(self) -> None:
        if self.active:
            self.active = False
            self._tasks.clear()
            self.deactivated()

    @property
    def busy(self) -> bool:
        """Whether work waits beside the callbacks."""
        return bool(self._tasks)

    def defer(self, where: str, task: Task) -> None:
        """Work in steps between the callbacks, one after the other; the stream goes on meanwhile.

        :raises MessageError: too much waits already.
        """
        self._tasks.add(where, task)

    def turned(self) -> None:
        """A turn of the executor is over: one step of what waits."""
        self.seldom.turned()
        self._tasks.step()

    def _on_reset(self, request: Any, response: Any) -> Any:
        ended = self.reset_stop()
        response.success = True
        response.message = f"reset: {ended}" if ended else "no stop was latched"
        return response

    def _jumped(self, jump: Any) -> None:
        try:
            # One is an enumeration of Python, the other may be the binding's.
            same_clock = int(jump.clock_change) == int(ClockChange.ROS_TIME_NO_CHANGE)
            if same_clock and jump.delta.nanoseconds > 0:
                self.time_jumped_forward()
            else:
                self.time_jumped_backward()
        except Exception as error:
            self.caught("clock", error)

    def _publish_diagnostics(self) -> None:
        level, message, values = self.diagnose()
        self._diagnostics.publish(self.health.report(level, message, values, active=self.active))


def _tell_compiling(node: weakref.ref[TwinNode], made: threading.Event) -> None:
    """Until the executor runs, while the process compiles."""
    while not made.wait(COMPILING_PERIOD):
        told = node()
        if told is None:
            return
        try:
            told.publish_compiling()
        except Exception:
            return  # The middleware has ended.
        del told
