# SPDX-License-Identifier: Apache-2.0
"""What every node of the suite shares: start and end, life cycle, parameters, guards, diagnostics.

Nothing that runs while a node spins can end it: what a message, a request or a clock breaks is
caught, counted and told.
"""

from __future__ import annotations

import difflib
import gc
import inspect
import os
import signal
import sys
import time
import traceback
from collections import Counter, deque
from collections.abc import Callable, Generator, Iterable, Sequence
from typing import Any, Final, TypeVar

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    SetParametersResult,
)
from rcl_interfaces.srv import SetParameters, SetParametersAtomically
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.clock import Clock, ClockChange, ClockType, JumpThreshold
from rclpy.duration import Duration
from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.exceptions import (
    InvalidHandle,
    InvalidParameterTypeException,
    InvalidParameterValueException,
    ParameterException,
)
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.experimental import EventsExecutor
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.parameter import Parameter
from rclpy.qos import (
    DurabilityPolicy,
    QoSCompatibility,
    QoSPolicyKind,
    QoSProfile,
    ReliabilityPolicy,
    qos_check_compatible,
    qos_policy_name_from_kind,
)
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.signals import SignalHandlerGuardCondition, SignalHandlerOptions
from rosgraph_msgs.msg import Clock as ClockMessage
from std_srvs.srv import Trigger

from pkm_twin.errors import MessageError, ParameterError, PkmTwinError, UnknownNameError
from pkm_twin.ros.context import middleware_arguments
from pkm_twin.ros.messages import SECOND
from pkm_twin.ros.signals import (
    SIGNALS,
    first_signal,
    ignore_signals,
    noted_signals,
    nothing_raised,
)
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
LOOK: Final = 0.5
"""How often the events executor looks whether the context has ended, s."""

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


class UnknownParametersError(PkmTwinError):
    """Parameters that no declaration knows: one line each, what is closest first."""

    def __init__(self, unknown: Iterable[str], valid: Iterable[str]) -> None:
        names = sorted(valid)
        self.lines = []
        for name in unknown:
            close = difflib.get_close_matches(name, names, n=3, cutoff=0.5)
            hint = f"did you mean {close[0]!r}? " if close else ""
            rest = [n for n in names if n not in close and not n.startswith("qos_overrides.")]
            self.lines.append(f"unknown parameter {name!r}; {hint}valid: {', '.join(close + rest)}")
        super().__init__("; ".join(self.lines))


def output_qos() -> QoSProfile:
    """Reliable and volatile: a torque or a compliance is for now, never for a late joiner."""
    return QoSProfile(depth=10, reliability=ReliabilityPolicy.RELIABLE)


def latched_qos() -> QoSProfile:
    """What does not change while a node runs, such as a description: late joiners get it too."""
    return QoSProfile(
        depth=1,
        reliability=ReliabilityPolicy.RELIABLE,
        durability=DurabilityPolicy.TRANSIENT_LOCAL,
    )


def input_qos(depth: int, *, best_effort: bool, expiry: float | None = None) -> QoSProfile:
    """Best effort takes what publishers of both kinds send; reliable only what reliable ones do.

    :param expiry: lifespan and deadline that they have to offer, s; None is any.
    """
    kind = ReliabilityPolicy.BEST_EFFORT if best_effort else ReliabilityPolicy.RELIABLE
    qos = QoSProfile(depth=depth, reliability=kind)
    if expiry is not None:
        qos.lifespan = qos.deadline = Duration(seconds=expiry)
    return qos


class TwinNode(LifecycleNode):
    """A life-cycle node with guarded callbacks, diagnostics at 1 Hz and checked parameters.

    Everything is made and every parameter checked before the first state; a node that is not
    active takes no message.
    """

    def __init__(self, name: str) -> None:
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
        self.followed: set[str] = set()
        """Parameters whose changes are taken while the node runs."""
        self._changeable: set[str] = set()
        self._active_since = 0
        self.seldom = SeldomGroup()
        super().__init__(name)
        self._autostart = self.declare(
            "autostart", True, "configure and activate at the start", read_only=True
        )
        self.executor_kind: str = self.declare(
            "executor",
            "single",
            "rclpy's executor: single (SingleThreadedExecutor) or events (EventsExecutor)",
            choices=("single", "events"),
            read_only=True,
        )
        self._queue_depth = self.declare(
            "queue_depth", 1000, "messages that wait for the node, a topic",
            low=1, high=100_000, read_only=True,
        )  # fmt: skip
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", output_qos())
        # The diagnostics run on the steady clock: they have to tell that the ROS clock stands.
        self.steady = Clock(clock_type=ClockType.STEADY_TIME)

    def start(self, leap: float | None = None) -> None:
        """Refuse unknown parameters, begin the diagnostics, and say where the node listens.

        :param leap: how far the ROS clock goes forward at once for :meth:`time_jumped_forward`, s.
        """
        self.refuse_unknown_parameters()
        deaf = sorted(self._changeable - self.followed)
        if deaf:
            # A set of it would be answered as taken.
            raise NotImplementedError(f"nothing follows a change of {', '.join(deaf)}")
        self.add_pre_set_parameters_callback(self._with_floats)
        self.add_on_set_parameters_callback(_refuse_nameless)
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
        """The last thing to do while the topics are still there; see :func:`run`."""

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

    def declare(
        self,
        name: str,
        default: Any,
        description: str,
        *,
        unit: str = "",
        low: float | None = None,
        high: float | None = None,
        choices: Sequence[str] = (),
        read_only: bool = False,
    ) -> Any:
        """Declare a parameter and return its value; a whole number is taken for a float.

        :param low: least value, ``high``: greatest; ``choices``: the words that are allowed.
        :raises ParameterError: the given value has another type or is out of range, naming both.
        """
        constraints = f"one of {', '.join(choices)}" if choices else ""
        descriptor = ParameterDescriptor(
            description=description + (f"; {unit}" if unit else ""),
            additional_constraints=constraints,
            read_only=read_only,
        )
        if low is not None and high is not None:
            if isinstance(default, float):
                descriptor.floating_point_range = [
                    FloatingPointRange(from_value=float(low), to_value=float(high))
                ]
            else:
                descriptor.integer_range = [IntegerRange(from_value=int(low), to_value=int(high))]
            constraints = f"{low:g} to {high:g} {unit}".strip()
        given = self._parameter_overrides.get(name)
        if given is not None:
            given = self._parameter_overrides[name] = _as_float(given, default)
        try:
            value = self.declare_parameter(name, default, descriptor).value
        except (InvalidParameterTypeException, InvalidParameterValueException) as error:
            value = given.value if given is not None else None
            raise ParameterError(name, value, constraints or f"a value like {default!r}") from error
        self.check_parameter(name, value)
        if not read_only:
            self._changeable.add(name)
        return value

    def check_parameter(self, name: str, value: Any) -> None:
        """Refuse what a parameter's declaration does not allow.

        :raises ParameterError: out of range, not a number, or not one of the words.
        """
        descriptor = self.describe_parameter(name)
        for limits in (*descriptor.floating_point_range, *descriptor.integer_range):
            # rclpy lets a value that is not a number pass.
            if not limits.from_value <= value <= limits.to_value:
                raise ParameterError(name, value, f"{limits.from_value:g} to {limits.to_value:g}")
        words = descriptor.additional_constraints.removeprefix("one of ").split(", ")
        if words != [""] and value not in words:
            raise UnknownNameError(name, value, words)

    def refuse_unknown_parameters(self) -> None:
        """A parameter that no declaration knows is a misspelling.

        :raises UnknownParametersError: naming each.
        """
        unknown = [name for name in self._parameter_overrides if name not in self._parameters]
        if unknown:
            raise UnknownParametersError(unknown, self._parameters)

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
            comes: from there on as if true (not with the events executor).
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

        # By its signature rclpy knows that the information is wanted.
        guarded.__signature__ = inspect.signature(  # type: ignore[attr-defined]
            lambda message, info: None
        )
        # The events executor does not survive the end of a subscription with events.
        given = self.executor_kind == "events" or (
            f"qos_overrides.{name}.subscription.reliability" in self._parameter_overrides
        )
        relaxed = False
        subscription: Any = None

        def subscribe() -> Any:
            made = self.create_subscription(
                kind,
                topic,
                guarded,
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
                self.destroy_subscription(subscription)
                subscription = subscribe()
                self.log_throttled("qos", f"{topic}: best effort from here on, as its publisher")

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
            raise MessageError("busy", f"{MAX_TASKS} wait to be answered already")
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
        """An exception in a callback: the node lives; one traceback a kind.

        :raises ExternalShutdownException: it came from a signal in the middle of the callback.
        """
        if not self.context.ok():
            raise ExternalShutdownException from error
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
            self.log_throttled("clock", f"/clock: refused, {sec} s and {nanosec} ns is no time")

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
                if not self.context.ok():
                    raise ExternalShutdownException from error
                self._seen["requests refused"] += 1
                text = _cut(f"{type(error).__name__}: {error}")
                self.log_throttled("request", f"{kind.__name__}: refused, {text}")
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
        response.message = f"ended: {ended}" if ended else "no stop was latched"
        return response

    def _with_floats(self, changes: list[Parameter]) -> list[Parameter]:
        """Whole numbers for floats where the declaration has floats."""
        return [
            _as_float(change, self._parameters[change.name].value)
            if change.name in self._parameters
            else change
            for change in changes
        ]

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
        self.log_throttled(f"qos {topic}", f"{topic}: incompatible QoS of another node: {policy}")
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
            found.append((WARN, f"{clocks} messages of /clock were no time in the last second"))
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


def _refuse_nameless(changes: list[Parameter]) -> SetParametersResult:
    """Refuse what rclpy would declare by the way."""
    good = all(change.name for change in changes)
    return SetParametersResult(successful=good, reason="" if good else "a parameter without a name")


def _as_float(given: Parameter, like: Any) -> Parameter:
    """A parameter of whole numbers as one of floats, where what it is for is one of floats."""
    if isinstance(like, float) and given.type_ == Parameter.Type.INTEGER:
        return Parameter(given.name, value=float(given.value))
    many = not isinstance(like, str) and hasattr(like, "__len__")
    if (
        many
        and len(like)
        and isinstance(like[0], float)
        and given.type_ == Parameter.Type.INTEGER_ARRAY
    ):
        return Parameter(given.name, value=[float(value) for value in given.value])
    return given


class _NeverMade:
    """For the handle of a guard that a signal keeps from being made: its end is quiet then."""

    def __enter__(self) -> None:
        raise InvalidHandle("never made")

    def __exit__(self, *_: object) -> None:
        """Nothing was entered."""


SignalHandlerGuardCondition._GuardCondition__gc = _NeverMade()


class _Executor(SingleThreadedExecutor):
    """One whose making a signal may interrupt: rclpy's own end asks for what is not there then."""

    _sigint_gc = None


def spin(node: TwinNode, ended: Callable[[], bool] = lambda: False) -> None:
    """Run callbacks, and between them a step of what waits, until the context ends.

    :param ended: asked between two callbacks; true ends it too.
    """
    if not node.context.ok():
        return  # A signal has come before: rclpy cannot make an executor any more, and prints so.
    events = node.executor_kind == "events"
    executor = EventsExecutor() if events else _Executor()
    executor.add_node(node)
    # Without a bound the one waits for ever; with one the other makes a timer a message.
    patience = LOOK if events else None
    going, turn = node.context.ok, executor.spin_once
    while going() and not ended():
        try:
            turn(0.0 if node.busy else patience)
            node.turned()
        except (KeyboardInterrupt, ExternalShutdownException):
            raise
        except Exception as error:
            # The last line of defence: rclpy's own code, on the way to a callback or back.
            node.caught("rclpy", error)


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
        # Until it spins: the middleware's handler for SIGINT calls this one, that for SIGTERM none.
        with first_signal(KeyboardInterrupt, SIGNALS if farewell else (signal.SIGINT,)):
            rclpy.init(
                args=middleware_arguments(sys.argv if arguments is None else arguments),
                signal_handler_options=SignalHandlerOptions.NO if farewell else None,
            )
            begun = True
            node = factory()
            one_blas_thread()
            # What is loaded by now stays: the collector need not look at it again.
            gc.collect()
            gc.freeze()
            if not farewell:
                # The middleware's handler ends its context, and with it the loop.
                with nothing_raised():
                    spin(node)
                return 0
            with noted_signals() as asked:
                spin(node, asked)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    except (PkmTwinError, ParameterException, RuntimeError) as error:
        if begun and not rclpy.ok():
            return 0  # A signal in the middle of a call of the middleware.
        if node is not None:
            raise
        # The middleware's own refusals (arguments, types, QoS overrides) have many lines.
        lines = error.lines if isinstance(error, UnknownParametersError) else [str(error)]
        for line in lines:
            print(f"refused to start: {' '.join(line.split())}", file=sys.stderr)
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
