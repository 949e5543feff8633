# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Share between all nodes: life cycle, parameters, guards, diagnostics.

Nothing that happens while a node spins can end it: errors of messages, requests and clocks are
caught, counted and reported.
"""

from __future__ import annotations

import inspect
import math
import os
import threading
import time
from collections import Counter
from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import Any, ClassVar, Final, TypeVar

from diagnostic_msgs.msg import DiagnosticArray
from rcl_interfaces.msg import SetParametersResult
from rcl_interfaces.srv import SetParameters, SetParametersAtomically
from rclpy.clock import Clock, ClockChange, ClockType, JumpThreshold
from rclpy.duration import Duration
from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.lifecycle import LifecycleState, TransitionCallbackReturn
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSPolicyKind, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions
from rosgraph_msgs.msg import Clock as ClockMessage
from std_srvs.srv import Trigger

from pkm_twin.bags.definitions import JOINT_STATE, message_definition
from pkm_twin.codegen.code import slowness
from pkm_twin.errors import MessageError, ParameterError, PkmTwinError
from pkm_twin.messages.fast_decoder import JointStateDecoder
from pkm_twin.messages.stamps import SECOND
from pkm_twin.ros.health import OK, QOS, RELIABILITY, WARN, Health, Incompatibility, shorten
from pkm_twin.ros.parameters import ParameterNode
from pkm_twin.ros.turns import LOW_RATE_PERIOD, LowRateGroup, Task, Tasks
from pkm_twin.streams.monitor import Backlog, TopicStatistics
from pkm_twin.streams.topics import JOINTS, Topic

V = TypeVar("V")

OVERRIDES: Final = (QoSPolicyKind.HISTORY, QoSPolicyKind.DEPTH, QoSPolicyKind.RELIABILITY)
EXPIRY: Final = (QoSPolicyKind.LIFESPAN, QoSPolicyKind.DEADLINE)
"""QoS policies that parameters may override; :data:`EXPIRY` only for topics that expire."""


def output_qos() -> QoSProfile:
    """Return reliable, volatile QoS: a late subscriber must not receive an old torque."""
    return QoSProfile(depth=10, reliability=ReliabilityPolicy.RELIABLE)


def latched_qos() -> QoSProfile:
    """Return transient local QoS for what is constant while a node runs, such as a description."""
    return QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL)


class GuardedNode(ParameterNode):
    """Provide guarded subscriptions, publishers and timers.

    An inactive node takes no message.
    """

    topics: ClassVar[Mapping[str, Topic]]
    """Topics and services that the node can have."""

    def __init__(self, name: str) -> None:
        # Set these first: rclpy's constructor subscribes to /clock, so callbacks may run while the node is created.
        self.health = Health(self, self.now)
        self.active = False
        self.active_since = 0
        self.low_rate = LowRateGroup()
        super().__init__(name)
        self.autostart: bool = self.declare("autostart", True, "configure and activate the node at start")
        self.executor_kind: str = self.declare(
            "executor",
            "events",
            "rclpy's executor: single (SingleThreadedExecutor) or events (EventsExecutor)",
            choices=("single", "events"),
        )
        self.queue_depth: int = self.declare(
            "queue_depth", 1000, "messages of a topic that can wait for the node", low=1, high=100_000
        )
        self.max_wait: float = self.declare(
            "max_wait",
            0.05,
            "longest time that a message of a stream may wait for the node: then waiting messages "
            "are dropped, and counted, until the node has caught up",
            unit="s",
            low=1e-3,
            high=3600.0,
        )
        self.thread_priority: int = self.declare(
            "thread_priority",
            0,
            "real-time priority (SCHED_FIFO) of the process, with its memory locked; 0: none",
            low=0,
            high=99,
        )
        # The diagnostics run on the steady clock: they report a ROS clock that stands still.
        self.steady = Clock(clock_type=ClockType.STEADY_TIME)

    def call_further_outputs(self, what: str, answer: V, *takes: Callable[[V], object]) -> None:
        """Pass a published answer to further outputs; their errors are only logged."""
        for take in takes:
            try:
                take(answer)
            except (PkmTwinError, ValueError) as error:
                # Only the further output fails, for instance near a constraint singularity.
                self.log_throttled("beside", f"no {what}: {error}")

    def stream_broken(self, where: str) -> None:
        """React to an exception in a callback, for instance by stopping its stream."""

    def caught(self, where: str, error: Exception) -> None:
        """Report an exception in a callback; the node keeps running."""
        self.health.caught(where, error)
        self.stream_broken(where)

    def report_failure(self, where: str, error: Exception) -> None:
        """Report an exception of a callback; a rejected message is not a fault of the node."""
        if isinstance(error, MessageError):
            self.log_throttled(error.reason, f"{where}: rejected, {error.labelled}")
        else:
            self.caught(where, error)

    def report_limitation(self, text: str) -> None:
        """Report a setting that is not possible here: in the log, and in the diagnostics for good."""
        self.health.limitations.append(text)
        self.get_logger().warning(text)

    def log_throttled(self, reason: str, text: str) -> None:
        """Log a reason with growing pauses; the diagnostics count every occurrence."""
        self.health.log_throttled(reason, text)

    def now(self) -> int:
        """Return the ROS clock, ns."""
        # Like Clock.now, without its objects: it is called twice per sample.
        nanoseconds: int = self.get_clock().handle.get_now().nanoseconds
        return nanoseconds

    def create_subscription(
        self, msg_type: Any, topic: str, callback: Callable[..., None], *arguments: Any, **options: Any
    ) -> Any:
        """Subscribe as rclpy does; guard its own subscription of ``/clock``, and use no events.

        The middleware's threads hold its locks while they report an event, and wait for the lock
        that the executor holds while it takes an event or ends: a node could deadlock.
        """
        clock_callback = callback

        def take_clock(message: Any) -> None:
            # rclpy raises on invalid times.
            sec, nanosec = message.clock.sec, message.clock.nanosec
            if sec >= 0 and nanosec < SECOND:
                clock_callback(message)
                return
            self.health.seen["clock messages rejected"] += 1
            self.log_throttled("clock", f"/clock: rejected, invalid time: {sec} s and {nanosec} ns")

        if msg_type is ClockMessage:
            callback = take_clock
        options.setdefault("event_callbacks", SubscriptionEventCallbacks(use_default_callbacks=False))
        return super().create_subscription(msg_type, topic, callback, *arguments, **options)

    def create_publisher(self, *arguments: Any, **options: Any) -> Any:
        """Create a publisher as rclpy does, without events, as :meth:`create_subscription`."""
        options.setdefault("event_callbacks", PublisherEventCallbacks(use_default_callbacks=False))
        return super().create_publisher(*arguments, **options)

    def create_guarded_subscription(self, topic: str, callback: Callable[[Any], None], **options: Any) -> None:
        """Subscribe to a topic of the node's table; see :class:`GuardedSubscription`."""
        GuardedSubscription(self, topic, callback, **options)

    def create_guarded_publisher(self, topic: str, expiry: float | None = None, *, joint: str = "") -> Any:
        """Create a publisher of the node's table, with QoS overrides by parameter.

        :param expiry: lifespan and deadline that the topic offers, s; None for none. ``joint``:
            replaces ``<joint>`` in the name.
        :raises ParameterError: an override without expiry.
        """
        row = self.topics[topic]
        topic = topic.replace("<joint>", joint)
        qos = latched_qos() if row.latched else output_qos()
        overrides: tuple[Any, ...] = OVERRIDES
        if expiry is not None:
            qos.lifespan = qos.deadline = Duration(seconds=expiry)
            overrides = (*overrides, *EXPIRY)
            for policy in EXPIRY:
                override = f"qos_overrides.{self.resolve_topic_name(topic)}.publisher.{policy.name.lower()}"
                given = self.given.get(override)
                # The middleware treats zero as no limit.
                if given is not None and not (isinstance(given.value, int) and given.value > 0):
                    raise ParameterError(override, given.value, "1 ns or more")
        self.health.watch(topic)
        return self.create_publisher(row.message, topic, qos, qos_overriding_options=QoSOverridingOptions(overrides))

    def create_trigger(self, name: str, react: Callable[[], str]) -> None:
        """Create a std_srvs/Trigger service that answers with the text of ``react``."""

        def answer(_request: Any, response: Any) -> Any:
            response.success, response.message = True, react()
            return response

        self.create_service(Trigger, name, answer)

    def create_guarded_timer(self, period: float, callback: Callable[[], None]) -> Any:
        """Create a timer on the steady clock, with a guarded callback; period in s."""

        def guarded() -> None:
            try:
                callback()
            except Exception as error:
                self.caught(callback.__name__, error)

        return self.create_timer(period, guarded, clock=self.steady)


class GuardedSubscription:
    """Subscribe with a callback that cannot end the node.

    QoS overrides are parameters. By default messages may be lost in favour of newer ones, and
    publishers of both reliabilities match. A ``whole`` topic, for long messages, is reliable until
    a best-effort publisher appears. Joint states are decoded from their bytes.

    :param on_reject: called with the error of bytes that are not a joint state.
    :param raw: the callback takes the message's bytes.
    :param expected: the diagnostics warn until the first message.
    :param expires: how long a message may wait for the node, s, if less than ``max_wait``.
    :param every: the messages are differentiated: see :class:`Backlog`. ``droppable``: messages
        are dropped if the node cannot keep up; never those of a ``whole`` topic.
    :param expiry: lifespan and deadline that publishers must offer, s; None for any.
    """

    def __init__(
        self,
        node: GuardedNode,
        topic: str,
        callback: Callable[[Any], None],
        *,
        on_reject: Callable[[MessageError], None] | None = None,
        raw: bool = False,
        expected: bool = False,
        expires: Callable[[], float] = lambda: math.inf,
        every: bool = False,
        droppable: bool = True,
        expiry: float | None = None,
    ) -> None:
        row = node.topics[topic]
        if expected:
            node.health.expected.append(topic)
        self._node, self._kind, self._topic, self._callback = node, row.message, topic, callback
        self._on_reject, self._decode = on_reject, None
        if row.kind == JOINTS:
            self._decode = JointStateDecoder(message_definition(JOINT_STATE))
        self._raw, self._best_effort = raw or self._decode is not None, not row.whole
        self._expires, self._expiry = expires, expiry
        self._statistics = node.health.statistics[topic] = TopicStatistics()
        self._backlog = node.health.backlogs[topic] = Backlog(every)
        self._droppable = droppable and not row.whole
        self._name = node.resolve_topic_name(topic)
        self._given = f"qos_overrides.{self._name}.subscription.reliability" in node.given
        self._relaxed = False
        self._subscription = self._subscribe()
        node.health.watch(topic, self._relax_reliability)

    def _subscribe(self) -> Any:
        # Best effort matches all publishers, reliable only reliable ones.
        relaxed, node = self._relaxed, self._node
        kind = ReliabilityPolicy.BEST_EFFORT if self._best_effort or relaxed else ReliabilityPolicy.RELIABLE
        qos = QoSProfile(depth=node.queue_depth, reliability=kind)
        if self._expiry is not None:
            qos.lifespan = qos.deadline = Duration(seconds=self._expiry)

        def heard(*arguments: Any) -> None:
            # The events executor passes both as one tuple.
            message, info = arguments if len(arguments) == 2 else arguments[0]
            # A replaced subscription may still deliver; its messages arrive twice.
            if relaxed == self._relaxed:
                self._handle_message(message, info)

        # rclpy passes the message information if the signature has two parameters.
        heard.__signature__ = inspect.signature(  # type: ignore[attr-defined]
            lambda message, info: None
        )
        return node.create_subscription(
            self._kind,
            self._topic,
            heard,
            qos,
            raw=self._raw,
            qos_overriding_options=QoSOverridingOptions(OVERRIDES[:-1] if relaxed else OVERRIDES),
        )

    def _handle_message(self, message: Any, info: Any) -> None:
        node, statistics = self._node, self._statistics
        began = time.perf_counter()
        try:
            number, sent = info["publication_sequence_number"], info["source_timestamp"]
            # Several publishers have independent sequence numbers.
            if statistics.record_message(number, sent) and node.count_publishers(self._name) == 1:
                statistics.count_missed()
            # 0 if the middleware does not report the time of reception.
            came = info["received_timestamp"]
            if not node.active or 0 < came < node.active_since:
                return
            if self._droppable and came:
                waited = (time.time_ns() - came) / SECOND
                if self._backlog.should_drop(waited, min(node.max_wait, self._expires()), began):
                    return
            node.health.seen["messages"] += 1
            if self._decode is not None:
                try:
                    message = self._decode(message)
                except MessageError as error:
                    if self._on_reject is not None:
                        self._on_reject(error)
                    raise
            self._callback(message)
        except Exception as error:
            node.report_failure(self._topic, error)
        statistics.record_duration(time.perf_counter() - began)

    def _relax_reliability(self, what: Incompatibility) -> None:
        """Accept best-effort publishers from now on, unless a parameter says otherwise."""
        if what != (QOS, RELIABILITY) or self._best_effort or self._given or self._relaxed:
            return
        self._relaxed, node = True, self._node
        node.destroy_subscription(self._subscription)
        self._subscription = self._subscribe()
        node.log_throttled("qos", f"{self._topic}: best effort from now on, as its publisher offers it")


COMPILING: Final = "loading or compiling the robot's programs: the node does not answer yet"


class TwinNode(GuardedNode):
    """Provide life cycle, guarded callbacks, diagnostics at 1 Hz and checked parameters.

    Everything is created and every parameter checked before the first state. While a node is
    created, which may compile programs, its diagnostics say so.
    """

    core: Any
    """Core that answers messages: a :class:`~pkm_twin.streams.monitor.Core` with its robot."""

    def __init__(self, name: str) -> None:
        """Declare the parameters that all nodes have."""
        super().__init__(name)
        self._tasks = Tasks(self.report_failure)
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", output_qos())
        self._cached = threading.Event()
        threading.Thread(target=self._report_start, daemon=True).start()

    def _report_start(self) -> None:
        """Report that the node starts, repeatedly until it is created."""
        logger = self.get_logger()
        # If a constructor fails, the context ends meanwhile. Stored programs load within half a second.
        with suppress(Exception):
            while not self._cached.wait(0.5) and self.context.ok():
                logger.info(COMPILING, once=True)
                self._diagnostics.publish(self.health.array(WARN, COMPILING))

    def start(self, leap: float | None = None) -> None:
        """Finish the start: reject unknown parameters, begin diagnostics, log a summary.

        :param leap: forward step of the ROS clock that calls :meth:`time_jumped_forward`, s.
        """
        self.close_declarations()
        self._cached.set()
        self.create_guarded_timer(1.0, self._publish_diagnostics)
        self.create_trigger("~/reset", self._reset)
        for service in self.services:
            service.callback = guarded_service(service.srv_type, service.callback, self.health, lambda: self.declared)
            service.callback_group = self.low_rate
            self.low_rate.add_entity(service)
        if self.executor_kind == "single":
            self.create_guarded_timer(LOW_RATE_PERIOD, self.low_rate.enable)
        # The middleware holds no reference of the handle.
        self._jump_handle = self.get_clock().create_jump_callback(
            JumpThreshold(
                min_forward=None if leap is None else Duration(seconds=leap),
                min_backward=Duration(nanoseconds=-1),
                on_clock_change=True,
            ),
            post_callback=self._on_clock_jump,
        )
        domain = os.environ.get("ROS_DOMAIN_ID", "0")
        reach = os.environ.get("ROS_AUTOMATIC_DISCOVERY_RANGE", "SUBNET")
        self.get_logger().info(f"{self.summary()}; domain {domain}, discovery {reach}")
        if slowness():
            self.report_limitation(slowness())
        if self.autostart:
            self.trigger_configure()
            self.trigger_activate()

    def details(self) -> str:
        """Return what the summary adds about the node."""
        return ""

    def summary(self) -> str:
        """Return one line that describes what the node runs."""
        robot = self.core.robot
        joints = ", ".join(robot.joint_names)
        return f"robot {robot.name} ({robot.mechanism}), joints {joints}{self.details()}"

    def worst_status(self) -> tuple[bytes, str]:
        """Return level and message of the node's diagnostic status."""
        rejected = self.core.last_reject
        return (WARN, f"last reject: {rejected}") if rejected else (OK, "running")

    def values(self) -> dict[str, object]:
        """Return the values of the node's diagnostic status."""
        raise NotImplementedError

    def diagnose(self) -> tuple[bytes, str, dict[str, object]]:
        """Return level, message and values of the node's diagnostic status."""
        return (*self.worst_status(), {"robot": self.core.robot.name, **self.values()})

    def time_jumped_backward(self) -> None:
        """Discard everything that depends on time: the ROS clock went back or changed."""

    def time_jumped_forward(self) -> None:
        """React to a forward step of the ROS clock beyond the allowed gap of a stream."""
        self.time_jumped_backward()

    def shutdown(self) -> None:
        """Stop answering, while the topics still exist."""
        self._stop_answering()

    @property
    def shutting_down(self) -> bool:
        """True while the shutdown needs turns of the executor."""
        return False

    def activated(self) -> None:
        """React to the activation: messages are answered from now on."""

    def deactivated(self) -> None:
        """React to the deactivation: messages are not answered from now on."""

    def reset_stop(self) -> str:
        """End a latched stop; return its description, or an empty text."""
        return ""

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Begin to answer messages."""
        self.activated()
        # Messages received before the activation are not answered.
        self.active_since = time.time_ns()
        self.active = True
        return super().on_activate(state)

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stop answering, and discard waiting tasks."""
        self._stop_answering()
        return super().on_deactivate(state)

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stop answering for good."""
        self._stop_answering()
        return super().on_shutdown(state)

    def _stop_answering(self) -> None:
        if self.active:
            self.active = False
            self._tasks.clear()
            self.deactivated()

    @property
    def busy(self) -> bool:
        """True while tasks wait between the callbacks."""
        return bool(self._tasks)

    def defer(self, where: str, task: Task) -> None:
        """Run a task in steps between the callbacks, so that the stream continues.

        :raises MessageError: too many tasks are waiting.
        """
        self._tasks.add(where, task)

    def end_turn(self) -> None:
        """Run one step of the waiting tasks after a turn of the executor."""
        self.low_rate.end_turn()
        self._tasks.step()

    def _reset(self) -> str:
        ended = self.reset_stop()
        return f"reset: {ended}" if ended else "no stop was latched"

    def _on_clock_jump(self, jump: Any) -> None:
        try:
            # One is a Python enumeration, the other may be the binding's.
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


def guarded_service(
    kind: Any, callback: Callable[[Any, Any], Any], health: Health, declared: Callable[[], Mapping[str, Parameter]]
) -> Any:
    """Wrap a service callback, also rclpy's own, so that it rejects invalid requests.

    A read-only parameter may be set to its current value, so that a node accepts its own dump.

    :param declared: the node's parameters by name.
    """

    def guarded(request: Any, response: Any) -> Any:
        try:
            _check_size(request, len(declared()))
            if kind is SetParameters and len(request.parameters) > 1:
                # One by one, as rclpy does: a rejected one does not affect the others.
                for parameter in request.parameters:
                    one = guarded(kind.Request(parameters=[parameter]), kind.Response())
                    response.results.extend(one.results)
                return response
            if kind in (SetParameters, SetParametersAtomically):
                known = declared()
                request.parameters = [
                    one
                    for one in request.parameters
                    if one.name not in known or known[one.name].get_parameter_value() != one.value
                ]
                if not request.parameters:
                    good = SetParametersResult(successful=True)
                    one = kind is SetParametersAtomically
                    return kind.Response(result=good) if one else kind.Response(results=[good])
            return callback(request, response)
        except Exception as error:
            health.seen["requests rejected"] += 1
            text = shorten(f"{type(error).__name__}: {error}")
            health.log_throttled("request", f"{kind.__name__}: rejected, {text}")
        response = kind.Response()
        refusal = SetParametersResult(successful=False, reason=text)
        if kind is SetParameters:
            response.results = [refusal]
        elif kind is SetParametersAtomically:
            response.result = refusal
        return response

    return guarded


def _check_size(request: Any, parameters: int) -> None:
    """Reject a request that is so long that it would delay the stream: beyond 1000 entries.

    :raises ParameterError: the request has too many entries; one that sets, more than parameters.
    """
    for field in ("parameters", "names", "prefixes"):
        entries = len(getattr(request, field, ()))
        most = parameters if field == "parameters" else 1000
        if entries > most:
            raise ParameterError(field, entries, f"at most {most} in a request")
    named = Counter(parameter.name for parameter in getattr(request, "parameters", ()))
    for name, times in named.items():
        if times > 1:
            raise ParameterError(name, times, "once in a request")
