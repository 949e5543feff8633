# SPDX-License-Identifier: Apache-2.0
"""Nodes whose callbacks cannot end them: what a message or a clock breaks is caught and counted."""

from __future__ import annotations

import inspect
import time
from collections.abc import Callable, Mapping
from typing import Any, ClassVar, Final

from rclpy.clock import Clock, ClockType
from rclpy.duration import Duration
from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.qos_overriding_options import QoSOverridingOptions
from rosgraph_msgs.msg import Clock as ClockMessage

from pkm_twin.errors import MessageError, ParameterError
from pkm_twin.messages.stamps import SECOND
from pkm_twin.ros.health import QOS, RELIABILITY, Health, Misfit
from pkm_twin.ros.parameters import ParameterNode
from pkm_twin.ros.qos import EXPIRY, OVERRIDES, input_qos, latched_qos, output_qos
from pkm_twin.ros.turns import SeldomGroup
from pkm_twin.streams.monitor import TopicStatistics
from pkm_twin.streams.topics import Topic

# The middleware's threads hold its locks while they report an event, and wait there for the lock
# that the executor holds while it takes one or ends: a node could stand still for ever.
NO_HEARD: Final = SubscriptionEventCallbacks(use_default_callbacks=False)
NO_TOLD: Final = PublisherEventCallbacks(use_default_callbacks=False)


class GuardedNode(ParameterNode):
    """A node with guarded subscriptions, publishers and timers.

    A node that is not active takes no message.
    """

    topics: ClassVar[Mapping[str, Topic]]
    """The topics that it can have, and its own services."""

    def __init__(self, name: str) -> None:
        # rclpy subscribes to the clock while it makes the node.
        self.health = Health(self, self.now)
        self.active = False
        self.active_since = 0
        self.seldom = SeldomGroup()
        super().__init__(name)
        self.autostart: bool = self.declare(
            "autostart", True, "configure and activate the node at start", read_only=True
        )
        self.executor_kind: str = self.declare(
            "executor",
            "events",
            "rclpy's executor: single (SingleThreadedExecutor) or events (EventsExecutor)",
            choices=("single", "events"),
            read_only=True,
        )
        self.queue_depth: int = self.declare(
            "queue_depth", 1000, "messages of a topic that can wait for the node",
            low=1, high=100_000, read_only=True,
        )  # fmt: skip
        self.thread_priority: int = self.declare(
            "thread_priority", 0,
            "real-time priority (SCHED_FIFO) of the process, with its memory locked; 0: none",
            low=0, high=99, read_only=True,
        )  # fmt: skip
        # The diagnostics run on the steady clock: they have to tell that the ROS clock stands.
        self.steady = Clock(clock_type=ClockType.STEADY_TIME)

    def stream_broken(self, where: str) -> None:
        """A callback failed: whatever it feeds cannot be trusted now."""

    def caught(self, where: str, error: Exception) -> None:
        """An exception in a callback: the node lives."""
        self.health.caught(where, error)
        self.stream_broken(where)

    def failed(self, where: str, error: Exception) -> None:
        """What a callback raised: a rejected message is no fault of the node."""
        if isinstance(error, MessageError):
            self.log_throttled(error.reason, f"{where}: rejected, {error.reason}: {error}")
        else:
            self.caught(where, error)

    def log_throttled(self, reason: str, text: str) -> None:
        """At most a line a second and reason; the counts are in the diagnostics."""
        self.health.log_throttled(reason, text)

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
        options.setdefault("event_callbacks", NO_HEARD)
        return super().create_subscription(msg_type, topic, callback, *arguments, **options)

    def create_publisher(self, *arguments: Any, **options: Any) -> Any:
        """As rclpy's, without events of the middleware."""
        options.setdefault("event_callbacks", NO_TOLD)
        return super().create_publisher(*arguments, **options)

    def create_guarded_subscription(
        self,
        topic: str,
        callback: Callable[[Any], None],
        *,
        raw: bool = False,
        awaited: bool = False,
        expires: Callable[[], float] | None = None,
        expiry: float | None = None,
    ) -> None:
        """Subscribe to a topic of the node's table, with a callback that cannot end the node.

        QoS overrides are parameters. By default messages may be lost for the newest, and publishers
        of both kinds match. Of a topic that is ``whole`` none is lost, as long messages need it,
        until a best-effort publisher comes: from there on as others.

        :param raw: the callback takes the message's bytes.
        :param awaited: the diagnostics warn until the first message.
        :param expires: how long a message may wait for the node, s; older ones count as lost.
        :param expiry: lifespan and deadline that publishers have to offer, s; None is any.
        """
        if awaited:
            self.health.awaited.append(topic)
        row = self.topics[topic]
        GuardedSubscription(
            self, row.message, topic, callback,
            raw=raw, best_effort=not row.whole, expires=expires, expiry=expiry,
        )  # fmt: skip

    def create_guarded_publisher(
        self, topic: str, expiry: float | None = None, *, joint: str = ""
    ) -> Any:
        """A publisher of a topic of the node's table, with QoS overrides by parameter.

        :param expiry: lifespan and deadline that the topic offers, s; None is none. ``joint``:
            stands for ``<joint>`` in the name.
        :raises ParameterError: an override that would make it never expire.
        """
        row = self.topics[topic]
        topic = topic.replace("<joint>", joint)
        qos = latched_qos() if row.latched else output_qos()
        overrides: tuple[Any, ...] = OVERRIDES
        if expiry is not None:
            qos.lifespan = qos.deadline = Duration(seconds=expiry)
            overrides = (*overrides, *EXPIRY)
            for policy in EXPIRY:
                override = (
                    f"qos_overrides.{self.resolve_topic_name(topic)}.publisher."
                    f"{policy.name.lower()}"
                )
                given = self.given.get(override)
                # The middleware takes zero for no limit.
                if given is not None and not (isinstance(given.value, int) and given.value > 0):
                    raise ParameterError(override, given.value, "1 ns or more")
        self.health.watch(topic)
        return self.create_publisher(
            row.message, topic, qos, qos_overriding_options=QoSOverridingOptions(overrides)
        )

    def create_guarded_timer(self, period: float, callback: Callable[[], None]) -> Any:
        """A timer on the steady clock, with a callback that cannot end the node; period in s."""

        def guarded() -> None:
            try:
                callback()
            except Exception as error:
                self.caught(callback.__name__, error)

        return self.create_timer(period, guarded, clock=self.steady)

    def _checked_clock(self, callback: Callable[[Any], None]) -> Callable[[Any], None]:
        """The callback of rclpy for ``/clock`` raises where the message is no time."""

        def checked(message: Any) -> None:
            sec, nanosec = message.clock.sec, message.clock.nanosec
            if sec >= 0 and nanosec < SECOND:
                callback(message)
                return
            self.health.seen["clock messages rejected"] += 1
            self.log_throttled("clock", f"/clock: rejected, invalid time: {sec} s and {nanosec} ns")

        return checked


class GuardedSubscription:
    """A subscription of :meth:`GuardedNode.create_guarded_subscription`, which has the arguments.

    It lives with its node, which holds its callbacks.
    """

    def __init__(
        self,
        node: GuardedNode,
        kind: type[Any],
        topic: str,
        callback: Callable[[Any], None],
        *,
        raw: bool,
        best_effort: bool,
        expires: Callable[[], float] | None,
        expiry: float | None,
    ) -> None:
        self._node, self._kind, self._topic, self._callback = node, kind, topic, callback
        self._raw, self._best_effort = raw, best_effort
        self._expires, self._expiry = expires, expiry
        self._statistics = node.health.statistics[topic] = TopicStatistics()
        self._name = node.resolve_topic_name(topic)
        self._given = f"qos_overrides.{self._name}.subscription.reliability" in node.given
        self._relaxed = False
        self._subscription = self._subscribe()
        node.health.watch(topic, self._misfit)

    def _subscribe(self) -> Any:
        relaxed, best_effort = self._relaxed, self._best_effort or self._relaxed

        def heard(*arguments: Any) -> None:
            # The events executor gives both in one.
            message, info = arguments if len(arguments) == 2 else arguments[0]
            # What the one before has left, which may live on, came twice.
            if relaxed == self._relaxed:
                self._take(message, info)

        # By its signature rclpy knows that the information is wanted.
        heard.__signature__ = inspect.signature(  # type: ignore[attr-defined]
            lambda message, info: None
        )
        node = self._node
        return node.create_subscription(
            self._kind,
            self._topic,
            heard,
            input_qos(node.queue_depth, best_effort=best_effort, expiry=self._expiry),
            raw=self._raw,
            qos_overriding_options=QoSOverridingOptions(OVERRIDES[:-1] if relaxed else OVERRIDES),
        )

    def _take(self, message: Any, info: Any) -> None:
        node, statistics = self._node, self._statistics
        began = time.perf_counter()
        try:
            number, sent = info["publication_sequence_number"], info["source_timestamp"]
            # Two publishers number their messages each: then nothing can be said.
            if statistics.received(number, sent) and node.count_publishers(self._name) == 1:
                statistics.count_missed()
            # Not every middleware tells when it came; 0 then.
            came = info["received_timestamp"]
            if not node.active or 0 < came < node.active_since:
                return
            if self._expires is not None and came:
                waited = time.time_ns() - came
                if waited > self._expires() * SECOND:
                    # More comes than can be answered: the newest are.
                    statistics.missed += 1
                    return
            node.health.seen["messages"] += 1
            self._callback(message)
        except Exception as error:
            node.failed(self._topic, error)
        statistics.handled(time.perf_counter() - began)

    def _misfit(self, what: Misfit) -> None:
        """From there on publishers of both kinds are taken."""
        if what != (QOS, RELIABILITY) or self._best_effort or self._given or self._relaxed:
            return
        self._relaxed, node = True, self._node
        node.destroy_subscription(self._subscription)
        self._subscription = self._subscribe()
        node.log_throttled(
            "qos", f"{self._topic}: best effort from now on, as its publisher offers it"
        )
