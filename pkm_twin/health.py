# SPDX-License-Identifier: Apache-2.0
"""What every node of the suite shares: start and end, diagnostics, QoS, log throttling."""

from __future__ import annotations

import os
import sys
import time
import traceback
from collections.abc import Callable, Sequence
from typing import Any, Final, TypeVar

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rcl_interfaces.msg import ParameterDescriptor, SetParametersResult
from rclpy.clock import Clock, ClockType, JumpThreshold
from rclpy.duration import Duration
from rclpy.exceptions import InvalidParameterTypeException, ParameterException
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions

from pkm_twin.errors import MessageError, ParameterError, PkmTwinError, UnknownNameError

OK: Final = DiagnosticStatus.OK
WARN: Final = DiagnosticStatus.WARN
ERROR: Final = DiagnosticStatus.ERROR

M = TypeVar("M")


def output_qos() -> QoSProfile:
    """Reliable and volatile: a torque or a compliance is for now, never for a late joiner."""
    return QoSProfile(depth=10, reliability=ReliabilityPolicy.RELIABLE)


def input_qos() -> QoSProfile:
    """As the outputs; a best-effort publisher needs the override ``reliability: best_effort``."""
    return QoSProfile(depth=10, reliability=ReliabilityPolicy.RELIABLE)


class TwinNode(Node):
    """A node with guarded callbacks, diagnostics at 1 Hz and parameters checked at the start."""

    def __init__(self, name: str) -> None:
        super().__init__(name)
        self._logged: dict[str, float] = {}
        self._seen = dict.fromkeys(("messages", "exceptions"), 0)
        self._last_exception = ""
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", output_qos())
        # The diagnostics run on the steady clock: they have to tell that the ROS clock stands.
        self.steady = Clock(clock_type=ClockType.STEADY_TIME)

    def start(self) -> None:
        """Refuse unknown parameters, begin the diagnostics, and say where the node listens."""
        self.refuse_unknown_parameters()
        self.every(1.0, self._publish_diagnostics)
        self.get_clock().create_jump_callback(
            JumpThreshold(
                min_forward=None, min_backward=Duration(nanoseconds=-1), on_clock_change=True
            ),
            post_callback=self._jumped,
        )
        domain = os.environ.get("ROS_DOMAIN_ID", "0")
        reach = os.environ.get("ROS_AUTOMATIC_DISCOVERY_RANGE", "SUBNET")
        self.get_logger().info(f"{self.summary()}; domain {domain}, discovery {reach}")

    def summary(self) -> str:
        """One line that says what the node runs."""
        raise NotImplementedError

    def diagnose(self) -> tuple[bytes, str, dict[str, object]]:
        """Level, message and values of the node's diagnostic status."""
        raise NotImplementedError

    def clock_jumped(self) -> None:
        """The ROS clock went back or changed: forget everything that depends on time."""

    def now(self) -> int:
        """The ROS clock, ns."""
        nanoseconds: int = self.get_clock().now().nanoseconds
        return nanoseconds

    def declare(self, name: str, default: Any, description: str, *, read_only: bool = False) -> Any:
        """Declare a parameter and return its value.

        :raises ParameterError: the given value has another type, naming field and bound.
        """
        descriptor = ParameterDescriptor(description=description, read_only=read_only)
        try:
            return self.declare_parameter(name, default, descriptor).value
        except (InvalidParameterTypeException, ParameterException) as error:
            given = self._parameter_overrides.get(name)
            value = given.value if given is not None else None
            raise ParameterError(name, value, f"a value like {default!r}") from error

    def refuse_unknown_parameters(self) -> None:
        """A parameter that no declaration knows is a misspelling."""
        declared = set(self._parameters)
        for name in self._parameter_overrides:
            if name not in declared:
                raise UnknownNameError(name, name, declared)

    def listen(self, kind: type[M], topic: str, callback: Callable[[M], None]) -> None:
        """Subscribe, with QoS overrides by parameter and a callback that cannot end the node."""

        def guarded(message: M) -> None:
            self._seen["messages"] += 1
            try:
                callback(message)
            except MessageError as error:
                self.log_throttled(error.reason, f"{topic}: rejected, {error.reason}: {error}")
            except Exception as error:
                self.caught(topic, error)

        self.create_subscription(
            kind,
            topic,
            guarded,
            input_qos(),
            qos_overriding_options=QoSOverridingOptions.with_default_policies(),
        )

    def speak(self, kind: type[M], topic: str) -> Any:
        """A publisher with QoS overrides by parameter."""
        return self.create_publisher(
            kind,
            topic,
            output_qos(),
            qos_overriding_options=QoSOverridingOptions.with_default_policies(),
        )

    def every(self, period: float, callback: Callable[[], None]) -> None:
        """A timer on the steady clock, with a callback that cannot end the node; period in s."""

        def guarded() -> None:
            try:
                callback()
            except Exception as error:
                self.caught(callback.__name__, error)

        self.create_timer(period, guarded, clock=self.steady)

    def caught(self, where: str, error: Exception) -> None:
        """An exception in a callback: the node lives; one traceback a kind.

        :raises ExternalShutdownException: it came from a signal in the middle of the callback.
        """
        if not self.context.ok():
            raise ExternalShutdownException from error
        self._seen["exceptions"] += 1
        text = traceback.format_exc()
        if text != self._last_exception:
            self._last_exception = text
            self.get_logger().error(f"{where}: exception in the callback\n{text}")
        self.stream_broken(where)

    def stream_broken(self, where: str) -> None:
        """A callback failed: whatever it feeds cannot be trusted now."""

    def log_throttled(self, reason: str, text: str) -> None:
        """At most a line a second and reason; the counts are in the diagnostics."""
        now = time.monotonic()
        if now - self._logged.get(reason, -1.0) >= 1.0:
            self._logged[reason] = now
            self.get_logger().warning(text)

    def _jumped(self, jump: object) -> None:
        self.clock_jumped()

    def _publish_diagnostics(self) -> None:
        level, message, values = self.diagnose()
        if self.get_parameter("use_sim_time").value and self.now() == 0:
            level, message = max(level, WARN), "use_sim_time is set and no /clock arrives"
        if self._seen["exceptions"]:
            level, message = ERROR, "a callback raised an exception"
        namesakes = [
            1
            for name, space in self.get_node_names_and_namespaces()
            if (name, space) == (self.get_name(), self.get_namespace())
        ]
        if len(namesakes) > 1:
            level, message = max(level, WARN), f"{len(namesakes)} nodes have this name"
        status = DiagnosticStatus(
            level=level, name=self.get_fully_qualified_name(), message=message
        )
        status.hardware_id = str(values.pop("robot", ""))
        status.values = [
            KeyValue(key=key, value=str(value)) for key, value in {**values, **self._seen}.items()
        ]
        array = DiagnosticArray(status=[status])
        array.header.stamp = self.get_clock().now().to_msg()
        self._diagnostics.publish(array)


def values_of(changes: Sequence[Parameter]) -> dict[str, Any]:
    """Parameter changes as a mapping of names to values."""
    return {change.name: change.value for change in changes}


def verdict(check: Callable[[], object]) -> SetParametersResult:
    """A set of parameters is taken or refused whole, with the reason."""
    try:
        check()
    except PkmTwinError as error:
        return SetParametersResult(successful=False, reason=str(error))
    return SetParametersResult(successful=True)


def run(factory: Callable[[], TwinNode], arguments: Sequence[str] | None = None) -> int:
    """Run a node until SIGINT or SIGTERM.

    :returns: 0 after a signal, 1 where the node refuses its configuration.
    """
    node: TwinNode | None = None
    begun = False
    try:
        rclpy.init(args=None if arguments is None else list(arguments))
        begun = True
        node = factory()
        executor = SingleThreadedExecutor()
        executor.add_node(node)
        executor.spin()
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    except (PkmTwinError, ParameterException, RuntimeError) as error:
        if begun and not rclpy.ok():
            return 0  # A signal in the middle of a call of the middleware.
        if node is not None:
            raise
        # The middleware's own refusals (arguments, types, QoS overrides) have many lines.
        print(f"refused to start: {' '.join(str(error).split())}", file=sys.stderr)
        return 1
    finally:
        if node is not None:
            node.destroy_node()
        rclpy.try_shutdown()
    return 0
