# SPDX-License-Identifier: Apache-2.0
"""What every node of the suite shares: life cycle, parameters, guards, diagnostics.

Nothing that runs while a node spins can end it: what a message, a request or a clock breaks is
caught, counted and told.
"""

from __future__ import annotations

import inspect
import os
import time
import traceback
from collections import Counter, deque
from collections.abc import Callable, Generator
from typing import Any, Final, TypeVar

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rcl_interfaces.msg import (
    SetParametersResult,
)
from rcl_interfaces.srv import SetParameters, SetParametersAtomically
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.clock import Clock, ClockChange, ClockType, JumpThreshold
from rclpy.duration import Duration
from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.lifecycle import LifecycleState, TransitionCallbackReturn
from rclpy.qos import (
    QoSCompatibility,
    qos_check_compatible,
    qos_policy_name_from_kind,
)
from rclpy.qos_overriding_options import QoSOverridingOptions
from rosgraph_msgs.msg import Clock as ClockMessage
from std_srvs.srv import Trigger

from pkm_twin.errors import MessageError, ParameterError
from pkm_twin.ros.messages import SECOND
from pkm_twin.ros.parameters import ParameterNode
from pkm_twin.ros.qos import EXPIRY, OVERRIDES, input_qos, latched_qos, output_qos
from pkm_twin.streams.monitor import TopicStatistics

OK: Final = DiagnosticStatus.OK
WARN: Final = DiagnosticStatus.WARN
ERROR: Final = DiagnosticStatus.ERROR

OVERRUN_SHARE: Final = 100
"""One callback in so many may take longer than its period before the diagnostics warn."""
MAX_TEXT: Final = 500
"""Characters of a line in the log or of a value in the diagnostics."""
MAX_TASKS: Final = 10
"""How much work may wait beside the callbacks."""
MAX_ASKED: Final = 1000
"""Entries of a request that only asks; one that sets has at most as many as the node has
parameters. More take the stream's time."""

SELDOM_PERIOD: Final = 0.1
SELDOM_TURNS: Final = 3
"""How often requests and events are looked for, s, and how many at a time at least."""

M = TypeVar("M")
Task = Generator[None, None, None]


class SeldomGroup(MutuallyExclusiveCallbackGroup):
    """What is not asked for a thousand times a second: requests, and the middleware's events.

    rclpy makes a wait set anew for every message, and each entity in it has its price; these are
    in it now and then only. The events executor has no wait set and does not ask.
    """

    def __init__(self) -> None:
        super().__init__()
        self._turns = 0

    def open(self) -> None:
        """Let the next turns of the executor look at them."""
        self._turns = SELDOM_TURNS

    def turned(self) -> None:
        """A turn of the executor is over."""
        if self._turns:
            self._turns -= 1

    def can_execute(self, entity: Any) -> bool:
        """Whether the executor looks at it."""
        return self._turns > 0 and bool(super().can_execute(entity))


class TwinNode(ParameterNode):
    """A life-cycle node with guarded callbacks, diagnostics at 1 Hz and checked parameters.

    Everything is made and every parameter checked before the first state; a node that is not
    active takes no message.
    """

    def __init__(self, name: str, *, executor: str = "single") -> None:
        """Declare what all nodes have.

        :param executor: the default of the parameter of that name.
        """
        self._logged: dict[str, float] = {}
        self._seen = dict.fromkeys(
            ("messages", "exceptions", "requests refused", "clock messages refused"), 0
        )
        self._last_exception = ""
        self._last_kind = ""
        self._statistics: dict[str, TopicStatistics] = {}
        self._awaited: list[str] = []
        self._tasks: deque[tuple[str, Task]] = deque()
        self._soon: list[Callable[[], None]] = []
        """What is done once the present callback is over."""
        self._reported = (0, 0, 0, 0)
        self._unfit: dict[str, str] = {}
        self._incompatible = 0
        self._last_clock = 0
        self.active = False
        self._active_since = 0
        self.seldom = SeldomGroup()
        super().__init__(name)
        self._autostart = self.declare(
            "autostart", True, "configure and activate the node at start", read_only=True
        )
        self.executor_kind: str = self.declare(
            "executor",
            executor,
            "rclpy's executor: single (SingleThreadedExecutor) or events (EventsExecutor)",
            choices=("single", "events"),
            read_only=True,
        )
        self._queue_depth = self.declare(
            "queue_depth", 1000, "messages of a topic that can wait for the node",
            low=1, high=100_000, read_only=True,
        )  # fmt: skip
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", output_qos())
        # The diagnostics run on the steady clock: they have to tell that the ROS clock stands.
        self.steady = Clock(clock_type=ClockType.STEADY_TIME)

    def start(self, leap: float | None = None) -> None:
        """Refuse unknown parameters, begin the diagnostics, and say where the node listens.

        :param leap: how far the ROS clock goes forward at once for :meth:`time_jumped_forward`, s.
        """
        self.close_declarations()
        self.create_guarded_timer(1.0, self._publish_diagnostics)
        self.create_service(Trigger, "~/reset", self._on_reset)
        for service in self.services:
            service.callback = self._guarded_service(service.srv_type, service.callback)
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
        if self._autostart:
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

    def farewell(self) -> None:
        """The end: nothing is answered from here on, while the topics are still there."""
        self._quit()

    @property
    def parting(self) -> bool:
        """Whether something of the end still waits for turns of the executor."""
        return False

    def stream_broken(self, where: str) -> None:
        """A callback failed: whatever it feeds cannot be trusted now."""

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
        self._active_since = time.time_ns()
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

    def now(self) -> int:
        """The ROS clock, ns."""
        # As Clock.now, without its objects: it is asked twice a sample.
        nanoseconds: int = self.get_clock().handle.get_now().nanoseconds
        return nanoseconds

    def create_subscription(
        self,
        msg_type: Any,
        topic: str,
        callback: Callable[..., None],
        *arguments: Any,
        **options: Any,
    ) -> Any:
        """As rclpy's, which makes its own one of ``/clock`` by it: that is checked here."""
        if msg_type is ClockMessage:
            callback = self._checked_clock(callback)
        return super().create_subscription(msg_type, topic, callback, *arguments, **options)

    def create_guarded_subscription(
        self,
        kind: type[M],
        topic: str,
        callback: Callable[[Any], None],
        *,
        raw: bool = False,
        best_effort: bool = True,
        awaited: bool = False,
        expires: Callable[[], float] | None = None,
        expiry: float | None = None,
    ) -> None:
        """Subscribe, with QoS overrides by parameter and a callback that cannot end the node.

        :param raw: the callback takes the message's bytes.
        :param best_effort: messages may be lost for the newest, and publishers of both kinds
            match. Otherwise none is lost, as long messages need it, until a best-effort publisher
            comes: from there on as if true.
        :param awaited: the diagnostics warn until the first message.
        :param expires: how long a message may wait for the node, s; older ones count as lost.
        :param expiry: lifespan and deadline that publishers have to offer, s; None is any.
        """
        statistics = self._statistics[topic] = TopicStatistics()
        name = self.resolve_topic_name(topic)
        if awaited:
            self._awaited.append(topic)

        def guarded(*arguments: Any) -> None:
            # The events executor gives both in one.
            message, info = arguments if len(arguments) == 2 else arguments[0]
            began = time.perf_counter()
            try:
                number, sent = info["publication_sequence_number"], info["source_timestamp"]
                # Two publishers number their messages each: then nothing can be said.
                if statistics.received(number, sent) and self.count_publishers(name) == 1:
                    statistics.count_missed()
                # Not every middleware tells when it came; 0 then.
                came = info["received_timestamp"]
                if not self.active or 0 < came < self._active_since:
                    return
                if expires is not None and came:
                    waited = time.time_ns() - came
                    if waited > expires() * SECOND:
                        # More comes than can be answered: the newest are.
                        statistics.missed += 1
                        return
                self._seen["messages"] += 1
                callback(message)
            except MessageError as error:
                self.log_throttled(error.reason, f"{topic}: rejected, {error.reason}: {error}")
            except Exception as error:
                self.caught(topic, error)
            statistics.handled(time.perf_counter() - began)

        given = f"qos_overrides.{name}.subscription.reliability" in self._parameter_overrides
        relaxed = False
        subscription: Any = None

        def subscribe() -> Any:
            def heard(*arguments: Any, of: bool = relaxed) -> None:
                if of == relaxed:
                    guarded(*arguments)

            callback = guarded if best_effort else heard
            # By its signature rclpy knows that the information is wanted.
            callback.__signature__ = inspect.signature(  # type: ignore[attr-defined]
                lambda message, info: None
            )
            made = self.create_subscription(
                kind,
                topic,
                callback,
                input_qos(self._queue_depth, best_effort=best_effort or relaxed, expiry=expiry),
                raw=raw,
                qos_overriding_options=QoSOverridingOptions(
                    OVERRIDES[:-1] if relaxed else OVERRIDES
                ),
                event_callbacks=SubscriptionEventCallbacks(incompatible_qos=misfit),
            )
            for handler in made.event_handlers:
                handler.callback_group = self.seldom
                self.seldom.add_entity(handler)
            return made

        def misfit(event: Any) -> None:
            if self._misfit(topic, event) == "reliability" and not (best_effort or given):
                # Told once a publisher: neither other work nor the life cycle may lose it.
                self._soon.append(relax)

        def relax() -> None:
            """Take publishers of both kinds; not within a callback of the old subscription."""
            nonlocal subscription, relaxed
            if not relaxed:
                relaxed = True
                # The events executor does not survive the end of a subscription with events.
                if self.executor_kind != "events":
                    self.destroy_subscription(subscription)
                subscription = subscribe()
                self.log_throttled(
                    "qos", f"{topic}: best effort from now on, as its publisher offers it"
                )

        subscription = subscribe()

    def create_guarded_publisher(
        self, kind: type[M], topic: str, expiry: float | None = None, *, latched: bool = False
    ) -> Any:
        """A publisher with QoS overrides by parameter.

        :param expiry: lifespan and deadline that the topic offers, s; None is none. ``latched``:
            late joiners get the last message.
        :raises ParameterError: an override that would make it never expire.
        """
        qos = latched_qos() if latched else output_qos()
        overrides: tuple[Any, ...] = OVERRIDES
        if expiry is not None:
            qos.lifespan = qos.deadline = Duration(seconds=expiry)
            overrides = (*overrides, *EXPIRY)
            for policy in EXPIRY:
                override = (
                    f"qos_overrides.{self.resolve_topic_name(topic)}.publisher."
                    f"{policy.name.lower()}"
                )
                given = self._parameter_overrides.get(override)
                # The middleware takes zero for no limit.
                if given is not None and not (isinstance(given.value, int) and given.value > 0):
                    raise ParameterError(override, given.value, "1 ns or more")
        return self.create_publisher(
            kind,
            topic,
            qos,
            qos_overriding_options=QoSOverridingOptions(overrides),
            callback_group=self.seldom,
            event_callbacks=PublisherEventCallbacks(
                incompatible_qos=lambda event: self._misfit(topic, event)
            ),
        )

    def create_guarded_timer(self, period: float, callback: Callable[[], None]) -> Any:
        """A timer on the steady clock, with a callback that cannot end the node; period in s."""

        def guarded() -> None:
            try:
                callback()
            except Exception as error:
                self.caught(callback.__name__, error)

        return self.create_timer(period, guarded, clock=self.steady)

    @property
    def busy(self) -> bool:
        """Whether work waits beside the callbacks."""
        return bool(self._tasks)

    def defer(self, where: str, task: Task) -> None:
        """Work in steps between the callbacks, one after the other; the stream goes on meanwhile.

        :raises MessageError: too much waits already.
        """
        if len(self._tasks) >= MAX_TASKS:
            raise MessageError("busy", f"{MAX_TASKS} requests are waiting already")
        self._tasks.append((where, task))

    def turned(self) -> None:
        """A turn of the executor is over: one step of what waits."""
        self.seldom.turned()
        while self._soon:
            self._soon.pop()()
        if self._tasks:
            self._work()

    def _work(self) -> None:
        entry = where, task = self._tasks[0]
        try:
            next(task)
            return
        except StopIteration:
            pass
        except MessageError as error:
            self.log_throttled(error.reason, f"{where}: rejected, {error.reason}: {error}")
        except Exception as error:
            self.caught(where, error)
        if self._tasks and self._tasks[0] is entry:
            self._tasks.popleft()

    def caught(self, where: str, error: Exception) -> None:
        """An exception in a callback: the node lives; one traceback a kind."""
        self._seen["exceptions"] += 1
        self._last_kind = _cut(f"{where}: {type(error).__name__}: {error}")
        text = traceback.format_exc()
        if text != self._last_exception:
            self._last_exception = text
            self.get_logger().error(f"{where}: exception in the callback\n{text[-10 * MAX_TEXT :]}")
        self.stream_broken(where)

    def log_throttled(self, reason: str, text: str) -> None:
        """At most a line a second and reason; the counts are in the diagnostics."""
        now = time.monotonic()
        if now - self._logged.get(reason, -1.0) >= 1.0:
            self._logged[reason] = now
            self.get_logger().warning(_cut(text))

    def _checked_clock(self, callback: Callable[[Any], None]) -> Callable[[Any], None]:
        """The callback of rclpy for ``/clock`` raises where the message is no time."""

        def checked(message: Any) -> None:
            sec, nanosec = message.clock.sec, message.clock.nanosec
            if sec >= 0 and nanosec < SECOND:
                callback(message)
                return
            self._seen["clock messages refused"] += 1
            self.log_throttled("clock", f"/clock: rejected, invalid time: {sec} s and {nanosec} ns")

        return checked

    def _guarded_service(self, kind: Any, callback: Callable[[Any, Any], Any]) -> Any:
        """A service callback, rclpy's own ones too, that refuses what it cannot take."""

        def guarded(request: Any, response: Any) -> Any:
            try:
                self._check_size(request)
                if kind is SetParameters and len(request.parameters) > 1:
                    # Each for itself, as rclpy does: what is refused does not hide what was set.
                    for parameter in request.parameters:
                        one = guarded(kind.Request(parameters=[parameter]), kind.Response())
                        response.results.extend(one.results)
                    return response
                return callback(request, response)
            except Exception as error:
                self._seen["requests refused"] += 1
                text = _cut(f"{type(error).__name__}: {error}")
                self.log_throttled("request", f"{kind.__name__}: rejected, {text}")
            response = kind.Response()
            refusal = SetParametersResult(successful=False, reason=text)
            if kind is SetParameters:
                response.results = [refusal]
            elif kind is SetParametersAtomically:
                response.result = refusal
            return response

        return guarded

    def _check_size(self, request: Any) -> None:
        """Refuse a request that would hold up the stream by its length.

        :raises ParameterError: it has too many entries.
        """
        for field in ("parameters", "names", "prefixes"):
            entries = len(getattr(request, field, ()))
            most = len(self._parameters) if field == "parameters" else MAX_ASKED
            if entries > most:
                raise ParameterError(field, entries, f"at most {most} in a request")
        named = Counter(parameter.name for parameter in getattr(request, "parameters", ()))
        for name, times in named.items():
            if times > 1:
                raise ParameterError(name, times, "once in a request")

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

    def _misfit(self, topic: str, event: Any) -> str:
        """Another node's QoS on a topic does not fit: nothing comes through between the two."""
        policy: str = qos_policy_name_from_kind(event.last_policy_kind).lower()
        self._incompatible += event.total_count_change
        self._unfit[topic] = policy
        self.log_throttled(
            f"qos {topic}", f"{topic}: another node has an incompatible QoS: {policy}"
        )
        return policy

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
            (WARN, f"another node on {topic} has an incompatible QoS: {policy}")
            for topic, policy in self._unfit.items()
        ]
        if self.get_parameter("use_sim_time").value:
            now = self.now()
            if now == 0:
                found.append((WARN, "use_sim_time is set and no /clock arrives"))
            elif now == self._last_clock:
                found.append((WARN, "use_sim_time is set and /clock stands still"))
            self._last_clock = now
        # Every node has one; of the list of names, an ended node's last words may bring it back.
        own = (self.get_name(), self.get_namespace())
        publishers = self.get_publishers_info_by_topic("/parameter_events")
        namesakes = sum((p.node_name, p.node_namespace) == own for p in publishers)
        if namesakes > 1:
            found.append((WARN, f"{namesakes} nodes have this name"))
        taken, clocks = self._seen["messages"], self._seen["clock messages refused"]
        lost = sum(topic.missed for topic in self._statistics.values())
        overruns = sum(topic.overruns for topic in self._statistics.values())
        before, self._reported = self._reported, (taken, lost, overruns, clocks)
        taken, lost, overruns, clocks = (a - b for a, b in zip(self._reported, before, strict=True))
        if clocks:
            found.append(
                (WARN, f"{clocks} messages of /clock had an invalid time in the last second")
            )
        if lost:
            found.append((WARN, f"{lost} messages lost in the last second"))
        # A single late one on a machine that also does other things is no trouble.
        if overruns > taken / OVERRUN_SHARE:
            found.append((WARN, f"{overruns} of {taken} callbacks took longer than their period"))
        return found

    def _publish_diagnostics(self) -> None:
        level, message, values = self.diagnose()
        waiting = [topic for topic in self._awaited if not self._statistics[topic].messages]
        if not self.active:
            level, message = OK, "inactive"
        elif level == OK and waiting:
            level, message = WARN, f"waiting for {', '.join(waiting)}"
        troubles = self._troubles()
        if level == ERROR:
            troubles.insert(0, (level, message))
        elif level != OK or not troubles or not self.active:
            troubles.append((level, message))
        status = DiagnosticStatus(
            level=max(level for level, _ in troubles),
            name=self.get_fully_qualified_name(),
            message=_cut(troubles[0][1]),
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
        status.values = [KeyValue(key=key, value=_cut(str(value))) for key, value in values.items()]
        array = DiagnosticArray(status=[status])
        array.header.stamp = self.get_clock().now().to_msg()
        self._diagnostics.publish(array)


def _cut(text: str) -> str:
    """A text that strangers may have made long."""
    return text if len(text) <= MAX_TEXT else f"{text[:MAX_TEXT]}... ({len(text)} characters)"
