# SPDX-License-Identifier: Apache-2.0
"""What every node of the suite shares: start and end, diagnostics, QoS, log throttling."""

from __future__ import annotations

import gc
import os
import signal
import sys
import time
import traceback
from collections.abc import Callable, Sequence
from typing import Any, Final, TypeVar

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rcl_interfaces.msg import ParameterDescriptor, SetParametersResult
from rclpy.clock import Clock, ClockChange, ClockType, JumpThreshold
from rclpy.duration import Duration
from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.exceptions import InvalidParameterTypeException, ParameterException
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import (
    QoSCompatibility,
    QoSPolicyKind,
    QoSProfile,
    ReliabilityPolicy,
    qos_check_compatible,
    qos_policy_name_from_kind,
)
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.signals import SignalHandlerOptions

from pkm_twin.errors import MessageError, ParameterError, PkmTwinError, UnknownNameError
from pkm_twin.ros.signals import SIGNALS, first_signal, ignore_signals, noted_signals
from pkm_twin.streams.monitor import TopicStatistics
from pkm_twin.threads import one_blas_thread

OK: Final = DiagnosticStatus.OK
WARN: Final = DiagnosticStatus.WARN
ERROR: Final = DiagnosticStatus.ERROR

OVERRIDES: Final = (QoSPolicyKind.HISTORY, QoSPolicyKind.DEPTH, QoSPolicyKind.RELIABILITY)
EXPIRY: Final = (QoSPolicyKind.LIFESPAN, QoSPolicyKind.DEADLINE)
"""QoS policies that parameters may override; the second ones of topics that expire."""
OVERRUN_SHARE: Final = 100
"""One callback in so many may take longer than its period before the diagnostics warn."""

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
        self._last_kind = ""
        self._statistics: dict[str, TopicStatistics] = {}
        self._reported = (0, 0, 0)
        self._unfit: dict[str, str] = {}
        self._incompatible = 0
        self._last_clock = 0
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", output_qos())
        # The diagnostics run on the steady clock: they have to tell that the ROS clock stands.
        self.steady = Clock(clock_type=ClockType.STEADY_TIME)

    def start(self, leap: float | None = None) -> None:
        """Refuse unknown parameters, begin the diagnostics, and say where the node listens.

        :param leap: how far the ROS clock goes forward at once for :meth:`time_jumped_forward`, s.
        """
        self.refuse_unknown_parameters()
        self.create_guarded_timer(1.0, self._publish_diagnostics)
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

    def create_guarded_subscription(
        self,
        kind: type[M],
        topic: str,
        callback: Callable[[M], None],
        expiry: float | None = None,
    ) -> None:
        """Subscribe, with QoS overrides by parameter and a callback that cannot end the node.

        :param expiry: lifespan and deadline that the publisher has to offer, s; None is any.
        """
        qos = input_qos()
        overrides: tuple[Any, ...] = OVERRIDES
        if expiry is not None:
            qos.lifespan = qos.deadline = Duration(seconds=expiry)
            overrides = (*overrides, *EXPIRY)
        statistics = self._statistics[topic] = TopicStatistics()
        name = self.resolve_topic_name(topic)

        def guarded(message: M, info: Any) -> None:
            self._seen["messages"] += 1
            began = time.perf_counter()
            try:
                number, sent = info["publication_sequence_number"], info["source_timestamp"]
                # Two publishers number their messages each: then nothing can be said.
                if statistics.received(number, sent) and self.count_publishers(name) == 1:
                    statistics.count_missed()
                callback(message)
            except MessageError as error:
                self.log_throttled(error.reason, f"{topic}: rejected, {error.reason}: {error}")
            except Exception as error:
                self.caught(topic, error)
            statistics.handled(time.perf_counter() - began)

        self.create_subscription(
            kind,
            topic,
            guarded,
            qos,
            qos_overriding_options=QoSOverridingOptions(overrides),
            event_callbacks=SubscriptionEventCallbacks(
                incompatible_qos=lambda event: self._misfit(topic, event)
            ),
        )

    def create_guarded_publisher(
        self, kind: type[M], topic: str, expiry: float | None = None
    ) -> Any:
        """A publisher with QoS overrides by parameter.

        :param expiry: lifespan and deadline that the topic offers, s; None is none.
        """
        qos = output_qos()
        overrides: tuple[Any, ...] = OVERRIDES
        if expiry is not None:
            qos.lifespan = qos.deadline = Duration(seconds=expiry)
            overrides = (*overrides, *EXPIRY)
        return self.create_publisher(
            kind,
            topic,
            qos,
            qos_overriding_options=QoSOverridingOptions(overrides),
            event_callbacks=PublisherEventCallbacks(
                incompatible_qos=lambda event: self._misfit(topic, event)
            ),
        )

    def create_guarded_timer(self, period: float, callback: Callable[[], None]) -> None:
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
        self._last_kind = f"{where}: {type(error).__name__}: {error}"
        text = traceback.format_exc()
        if text != self._last_exception:
            self._last_exception = text
            self.get_logger().error(f"{where}: exception in the callback\n{text}")
        self.stream_broken(where)

    def farewell(self) -> None:
        """The last thing to do while the topics are still there; see :func:`run`."""

    def stream_broken(self, where: str) -> None:
        """A callback failed: whatever it feeds cannot be trusted now."""

    def log_throttled(self, reason: str, text: str) -> None:
        """At most a line a second and reason; the counts are in the diagnostics."""
        now = time.monotonic()
        if now - self._logged.get(reason, -1.0) >= 1.0:
            self._logged[reason] = now
            self.get_logger().warning(text)

    def _jumped(self, jump: Any) -> None:
        # One is an enumeration of Python, the other may be the binding's.
        same_clock = int(jump.clock_change) == int(ClockChange.ROS_TIME_NO_CHANGE)
        if same_clock and jump.delta.nanoseconds > 0:
            self.time_jumped_forward()
        else:
            self.time_jumped_backward()

    def _misfit(self, topic: str, event: Any) -> None:
        """Another node's QoS on a topic does not fit: nothing comes through between the two."""
        policy = qos_policy_name_from_kind(event.last_policy_kind).lower()
        self._incompatible += event.total_count_change
        self._unfit[topic] = policy
        self.log_throttled(f"qos {topic}", f"{topic}: incompatible QoS of another node: {policy}")

    def _is_unfit(self, topic: str) -> bool:
        """Whether the misfit is still there."""
        name = self.resolve_topic_name(topic)
        speakers = self.get_publishers_info_by_topic(name)
        listeners = self.get_subscriptions_info_by_topic(name)
        return any(
            qos_check_compatible(a.qos_profile, b.qos_profile)[0] == QoSCompatibility.ERROR
            for a in speakers
            for b in listeners
        )

    def _troubles(self) -> list[tuple[bytes, str]]:
        """What is wrong with the node's surroundings, worst first."""
        found: list[tuple[bytes, str]] = []
        if self._seen["exceptions"]:
            found.append((ERROR, f"a callback raised an exception: {self._last_kind}"))
        self._unfit = {topic: p for topic, p in self._unfit.items() if self._is_unfit(topic)}
        found += [
            (WARN, f"incompatible QoS of another node on {topic}: {policy}")
            for topic, policy in self._unfit.items()
        ]
        if self.get_parameter("use_sim_time").value:
            now = self.now()
            if now == 0:
                found.append((WARN, "use_sim_time is set and no /clock arrives"))
            elif now == self._last_clock:
                found.append((WARN, "use_sim_time is set and /clock stands still"))
            self._last_clock = now
        own = (self.get_name(), self.get_namespace())
        namesakes = self.get_node_names_and_namespaces().count(own)
        if namesakes > 1:
            found.append((WARN, f"{namesakes} nodes have this name"))
        taken = self._seen["messages"]
        lost = sum(topic.missed for topic in self._statistics.values())
        overruns = sum(topic.overruns for topic in self._statistics.values())
        before, self._reported = self._reported, (taken, lost, overruns)
        taken, lost, overruns = (a - b for a, b in zip(self._reported, before, strict=True))
        if lost:
            found.append((WARN, f"{lost} messages lost in the last second"))
        # A single late one on a machine that also does other things is no trouble.
        if overruns > taken / OVERRUN_SHARE:
            found.append((WARN, f"{overruns} of {taken} callbacks took longer than their period"))
        return found

    def _publish_diagnostics(self) -> None:
        level, message, values = self.diagnose()
        troubles = self._troubles()
        if level == ERROR:
            troubles.insert(0, (level, message))
        elif level != OK or not troubles:
            troubles.append((level, message))
        status = DiagnosticStatus(
            level=max(level for level, _ in troubles),
            name=self.get_fully_qualified_name(),
            message=troubles[0][1],
        )
        status.hardware_id = str(values.pop("robot", ""))
        values |= self._seen
        # The message is the worst; what else there is stands here.
        values["also"] = "; ".join(text for _, text in troubles[1:])
        values["incompatible QoS"] = self._incompatible
        for topic, statistics in self._statistics.items():
            values[f"lost: {topic}"] = statistics.missed
            values[f"overruns: {topic}"] = statistics.overruns
            values[f"longest callback (ms): {topic}"] = f"{1e3 * statistics.longest:.3f}"
        status.values = [KeyValue(key=key, value=str(value)) for key, value in values.items()]
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


def run(
    factory: Callable[[], TwinNode],
    arguments: Sequence[str] | None = None,
    *,
    farewell: bool = False,
) -> int:
    """Run a node until SIGINT or SIGTERM.

    :param farewell: call :meth:`TwinNode.farewell` at the end. Signals are then not the
        middleware's, which would close the topics at once, and end the node at its next event.
    :returns: 0 after a signal, 1 where the node refuses its configuration.
    """
    node: TwinNode | None = None
    begun = False
    try:
        # The middleware's handler for SIGINT calls this one; SIGTERM is the middleware's alone.
        with first_signal(KeyboardInterrupt, SIGNALS if farewell else (signal.SIGINT,)):
            rclpy.init(
                args=None if arguments is None else list(arguments),
                signal_handler_options=SignalHandlerOptions.NO if farewell else None,
            )
            begun = True
            executor = SingleThreadedExecutor()
            node = factory()
            executor.add_node(node)
            one_blas_thread()
            # What is loaded by now stays: the collector need not look at it again.
            gc.collect()
            gc.freeze()
            if not farewell:
                executor.spin()
                return 0
            with noted_signals() as asked:
                while not asked():
                    executor.spin_once()
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
        ignore_signals()
        if node is not None:
            if farewell:
                node.farewell()
            node.destroy_node()
        # rclpy.try_shutdown would bring the old signal handlers back.
        rclpy.get_default_context().try_shutdown()
    return 0
