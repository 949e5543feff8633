# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Report a node's health: counts, log lines at a bounded rate, and its diagnostic status."""

from __future__ import annotations

import math
import time
import traceback
from collections.abc import Callable
from copy import copy
from dataclasses import dataclass
from itertools import product
from typing import Final, NamedTuple

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.lifecycle import LifecycleNode
from rclpy.qos import QoSCompatibility, qos_check_compatible
from rclpy.topic_endpoint_info import TopicEndpointInfo

from pkm_twin.streams.monitor import Backlog, TopicStatistics

OK: Final = DiagnosticStatus.OK
WARN: Final = DiagnosticStatus.WARN
ERROR: Final = DiagnosticStatus.ERROR

MAX_TEXT: Final = 500
"""Largest number of characters of a log line or of a value in the diagnostics."""
MIN_PAUSE: Final = 1.0
MAX_PAUSE: Final = 30.0
"""Smallest and largest pause between lines of one reason, s; a longer silence resets it."""


QOS: Final = "QoS"
RELIABILITY: Final = "reliability"


class Incompatibility(NamedTuple):
    """State why a publisher and a subscriber exchange nothing: a QoS policy, or the types."""

    kind: str
    detail: str

    def __str__(self) -> str:
        return f"{self.kind}: {self.detail}"


@dataclass
class _LogThrottle:
    """Decide when repeated log lines with the same reason are printed."""

    pause: float = 0.0
    due: float = -math.inf
    last: float = -math.inf
    held: int = 0
    """Number of lines suppressed since the last logged one."""

    def begin_line(self, now: float) -> int | None:
        """Return how many lines were held back before this one, or None to hold it back too."""
        if now - self.last > MAX_PAUSE:
            self.pause = 0.0
        self.last = now
        if now < self.due:
            self.held += 1
            return None
        self.pause = min(max(MIN_PAUSE, 2.0 * self.pause), MAX_PAUSE)
        self.due = now + self.pause
        held, self.held = self.held, 0
        return held


class Health:
    """Count a node's events, and find problems of its surroundings.

    :param now: the ROS clock, ns.
    """

    def __init__(self, node: LifecycleNode, now: Callable[[], int]) -> None:
        """Store the node, which is not constructed yet and must not be used here."""
        self._node, self._now = node, now
        self.seen = dict.fromkeys(("messages", "exceptions", "requests rejected", "clock messages rejected"), 0)
        self.statistics: dict[str, TopicStatistics] = {}
        self.backlogs: dict[str, Backlog] = {}
        self.expected: list[str] = []
        """Topics for which the diagnostics warn until the first message."""
        self.limitations: list[str] = []
        """Settings that the node was started with and that are not possible here."""
        self._logged: dict[str, _LogThrottle] = {}
        self._last_exception = ""
        self._last_kind = ""
        self._reported = (0, 0, 0, 0, 0)
        self._watched_topics: dict[str, list[Callable[[Incompatibility], None]]] = {}
        self._incompatible_ends: dict[str, dict[bytes, Incompatibility]] = {}
        self._incompatible = 0
        self._last_clock = 0

    def caught(self, where: str, error: Exception) -> None:
        """Count an exception in a callback; log one traceback per kind."""
        self.seen["exceptions"] += 1
        self._last_kind = shorten(f"{where}: {type(error).__name__}: {error}")
        text = traceback.format_exc()
        if text != self._last_exception:
            self._last_exception = text
            self._node.get_logger().error(f"{where}: exception in the callback\n{text[-10 * MAX_TEXT :]}")

    def log_throttled(self, reason: str, text: str) -> None:
        """Log a line of a reason; the pauses between lines of a reason double."""
        held = self._logged.setdefault(reason, _LogThrottle()).begin_line(time.monotonic())
        if held is not None:
            more = f" ({held} more since the last line)" if held else ""
            self._node.get_logger().warning(shorten(text) + more)

    def watch(self, topic: str, tell: Callable[[Incompatibility], None] | None = None) -> None:
        """Report other nodes with which this one cannot exchange messages on a topic.

        :param tell: called with the incompatibility, once per publisher or subscriber.
        """
        self._watched_topics.setdefault(topic, []).extend([tell] if tell else [])

    def _find_incompatible_ends(self) -> None:
        """Find incompatible nodes in the graph; this costs less than the middleware's events."""
        for topic, tells in self._watched_topics.items():
            # Both calls expect the name before remapping.
            speakers = self._node.get_publishers_info_by_topic(topic)
            listeners = self._node.get_subscriptions_info_by_topic(topic)
            speaking, listening = ([*filter(self._is_own, ends)] for ends in (speakers, listeners))
            strangers = [end for end in speakers if not self._is_own(end)]
            # A node has few endpoints of its own, so that each foreign endpoint is checked about once.
            pairs = [(s, r, r) for s, r in product(speaking, listeners)]
            pairs += [(s, r, s) for s, r in product(strangers, listening)]
            found = {bytes(end.endpoint_gid): find_incompatibility(s, r) for s, r, end in pairs}
            before = self._incompatible_ends.get(topic, {})
            now = self._incompatible_ends[topic] = {end: what for end, what in found.items() if what}
            for end in now.keys() - before.keys():
                self._incompatible += now[end].kind == QOS
                self.log_throttled(f"{topic} {now[end]}", f"another node on {topic} has an incompatible {now[end]}")
                for tell in tells:
                    tell(now[end])

    def _is_own(self, end: TopicEndpointInfo) -> bool:
        node = self._node
        return (end.node_name, end.node_namespace) == (node.get_name(), node.get_namespace())

    def _find_problems(self) -> list[tuple[bytes, str]]:
        """Return the problems of the node and its surroundings, worst first."""
        found: list[tuple[bytes, str]] = []
        if self.seen["exceptions"]:
            found.append((ERROR, f"a callback raised an exception: {self._last_kind}"))
        found += [(WARN, text) for text in self.limitations]
        self._find_incompatible_ends()
        found += [
            (WARN, f"another node on {topic} has an incompatible {text}")
            for topic, unfit in self._incompatible_ends.items()
            for text in sorted(map(str, set(unfit.values())))
        ]
        if self._node.get_parameter("use_sim_time").value:
            now = self._now()
            if now == 0:
                found.append((WARN, "use_sim_time is set and no /clock arrives"))
            elif now == self._last_clock:
                found.append((WARN, "use_sim_time is set and /clock stands still"))
            self._last_clock = now
        # Every node publishes it; the list of node names may still contain ended nodes.
        publishers = self._node.get_publishers_info_by_topic("/parameter_events")
        namesakes = sum(map(self._is_own, publishers))
        if namesakes > 1:
            found.append((WARN, f"{namesakes} nodes have this name"))
        taken, clocks = self.seen["messages"], self.seen["clock messages rejected"]
        lost = sum(topic.missed for topic in self.statistics.values())
        overruns = sum(topic.overruns for topic in self.statistics.values())
        dropped = sum(backlog.dropped for backlog in self.backlogs.values())
        before, self._reported = self._reported, (taken, lost, overruns, clocks, dropped)
        taken, lost, overruns, clocks, dropped = (a - b for a, b in zip(self._reported, before, strict=True))
        if dropped:
            found.append((WARN, f"the node is overloaded: {dropped} messages dropped in the last second"))
            self.log_throttled("overloaded", found[-1][1])
        if clocks:
            found.append((WARN, f"{clocks} messages of /clock had an invalid time in the last second"))
        if lost:
            found.append((WARN, f"{lost} messages lost in the last second"))
        # One late callback in a hundred is normal on a machine that runs other programs too.
        if overruns > taken / 100:
            found.append((WARN, f"{overruns} of {taken} callbacks took longer than their period"))
        return found

    def report(self, level: bytes, message: str, values: dict[str, object], *, active: bool) -> DiagnosticArray:
        """Return the diagnostics of the last second.

        :param values: the node's values, which are extended.
        """
        waiting = [topic for topic in self.expected if not self.statistics[topic].messages]
        if not active:
            level, message = OK, "inactive"
        elif level == OK and waiting:
            level, message = WARN, f"waiting for {', '.join(waiting)}"
        troubles = self._find_problems()
        if level == ERROR:
            troubles.insert(0, (level, message))
        elif level != OK or not troubles or not active:
            troubles.append((level, message))
        values |= self.seen
        # The message names the worst problem; this value lists the others.
        values["other problems"] = "; ".join(text for _, text in troubles[1:])
        values["incompatible QoS"] = self._incompatible
        for topic, statistics in self.statistics.items():
            values[f"lost: {topic}"] = statistics.missed
            values[f"dropped by overload: {topic}"] = self.backlogs[topic].dropped
            values[f"behind (ms): {topic}"] = f"{1e3 * self.backlogs[topic].take_longest():.3f}"
            values[f"overruns: {topic}"] = statistics.overruns
            values[f"longest callback (ms): {topic}"] = f"{1e3 * statistics.longest:.3f}"
        return self.array(max(level for level, _ in troubles), troubles[0][1], **values)

    def array(self, level: bytes, message: str, *, robot: object = "", **values: object) -> DiagnosticArray:
        """Return the node's status as a message, stamped now; ``robot`` is its hardware."""
        status = DiagnosticStatus(
            level=level,
            name=self._node.get_fully_qualified_name(),
            message=shorten(message),
            hardware_id=str(robot),
            values=[KeyValue(key=key, value=shorten(str(value))) for key, value in values.items()],
        )
        array = DiagnosticArray(status=[status])
        array.header.stamp = self._node.get_clock().now().to_msg()
        return array


def find_incompatibility(speaker: TopicEndpointInfo, listener: TopicEndpointInfo) -> Incompatibility | None:
    """Return why a publisher's messages do not reach a subscriber; None if they do."""
    if speaker.topic_type != listener.topic_type:
        return Incompatibility("message type", f"{speaker.topic_type} for {listener.topic_type}")
    offered, requested = speaker.qos_profile, listener.qos_profile
    if qos_check_compatible(offered, requested)[0] != QoSCompatibility.ERROR:
        return None
    for policy in (RELIABILITY, "durability", "deadline"):
        alike = copy(offered)
        setattr(alike, policy, getattr(requested, policy))
        if qos_check_compatible(offered, alike)[0] == QoSCompatibility.ERROR:
            return Incompatibility(QOS, policy)
    return Incompatibility(QOS, "liveliness")


def endpoint_node_name(end: TopicEndpointInfo) -> str:
    """Return the full name of an endpoint's node, which rmw may not know yet."""
    if end.node_name == "_NODE_NAME_UNKNOWN_":
        return "a node whose name is not known yet"
    return f"{end.node_namespace.rstrip('/')}/{end.node_name}"


def shorten(text: str) -> str:
    """Shorten a text from outside to :data:`MAX_TEXT`."""
    return text if len(text) <= MAX_TEXT else f"{text[:MAX_TEXT]}... ({len(text)} characters)"
