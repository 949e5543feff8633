# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Replay a bag onto ROS topics, without rosbag2.

ROS is imported inside the functions, so that a command line can show its help without it.
"""

from __future__ import annotations

import math
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pkm_twin.bags.definitions import message_class, message_definition, parse_definition
from pkm_twin.bags.qos import parse_qos, require_topic
from pkm_twin.bags.reader import Bag, BagMessage, open_bag
from pkm_twin.errors import BagError, ParameterError
from pkm_twin.ros.context import own_node

CLOCK_TOPIC = "/clock"
MAX_CLOCK = 2**31 - 1
"""Largest time that a /clock message can hold, s."""
_SLEEP_OVERSHOOT = 0.002


@dataclass
class _StopFlag:
    """Hold a flag that signals set.

    An event's lock would deadlock a handler that interrupts a handler.
    """

    asked: bool = False

    def wait(self, seconds: float) -> None:
        """Sleep, but no longer than 20 ms, so that signals are checked."""
        time.sleep(min(seconds, 0.02))


@dataclass(frozen=True)
class PlayResult:
    """Report what was played; ``duration`` and ``late_max`` (largest delay of a message) in s."""

    messages: int
    loops: int
    """Completed passes through the bag."""
    duration: float
    late_max: float
    interrupted: bool


def play(
    path: str | Path,
    *,
    rate: float = 1.0,
    loop: bool = False,
    clock: float | None = None,
    topics: Iterable[str] | None = None,
    remap: Mapping[str, str] | None = None,
    wait_for_subscribers: float = 0.0,
    progress: bool = True,
    pace: Callable[[BagMessage], None] | None = None,
) -> PlayResult:
    """Publish a bag's messages in log-time order, as far apart as they were recorded.

    The whole bag is checked first; of a damaged one nothing is published. The schedule is absolute,
    on the monotonic clock: delays do not add up. Messages go out as the recorded bytes, with the
    recorded QoS. SIGINT and SIGTERM end the replay, which then returns as usual.

    :param rate: bag seconds per second.
    :param loop: start again at the end, until interrupted. Bag time jumps back at the seam.
    :param clock: publish bag time (log time) on /clock this many times per second of wall time, and
        once before the first message; None or 0 for no clock. A recorded /clock is then left out.
    :param topics: what to play; by default everything.
    :param remap: recorded topic to topic to publish on.
    :param wait_for_subscribers: wait up to this long (s) until each topic has a subscriber; those
        still missing are named on standard error, and the replay starts.
    :param progress: draw a progress bar on standard error.
    :param pace: play in lockstep instead: called before every message, which goes out when it
        returns, whatever the time is. Clock and signals are then the caller's.
    :raises BagError: the bag is damaged, lacks a topic, or holds a type that is not installed or
        differs from the installed one.
    :raises ParameterError: a number is out of range.
    """
    _check_number("rate", rate, rate > 0, "a finite number above 0")
    _check_number("clock", clock or 0.0, (clock or 0.0) >= 0, "0 or more, Hz")
    _check_number("wait_for_subscribers", wait_for_subscribers, wait_for_subscribers >= 0, "0 or more, s")
    bag = open_bag(path)
    targets = _find_targets(bag, topics, remap or {}, bool(clock))
    stop = _StopFlag()
    with (
        _stop_on_signals(stop) if pace is None else nullcontext(),
        _create_publishers(bag, targets, bool(clock)) as (publishers, clock_publisher),
    ):
        awaited = {**publishers, CLOCK_TOPIC: clock_publisher} if clock else publishers
        give_up = time.monotonic() + wait_for_subscribers
        missing = list(awaited) if wait_for_subscribers else []
        while missing and not stop.asked:
            missing = [name for name in missing if not awaited[name].get_subscription_count()]
            if missing and time.monotonic() >= give_up:
                silent = ", ".join(awaited[name].topic_name for name in missing)
                print(f"no subscriber after {wait_for_subscribers:g} s: {silent}", file=sys.stderr)
                break
            stop.wait(0.02 if missing else 0.0)
        replay = _Replay(bag, publishers, rate, stop, pace, clock_publisher, clock or 0.0)
        with _progress_bar(bag, progress) as update:
            result = replay.run(loop=loop, update=update)
        if not result.interrupted:
            # Reliable subscribers get the last messages before the publishers are gone, within 1 s.
            give_up = time.monotonic() + 1.0
            for publisher in publishers.values():
                _await_acknowledged(publisher, max(0.0, give_up - time.monotonic()))
    return result


def _check_number(name: str, value: float, holds: bool, bound: str) -> None:
    if not (math.isfinite(value) and holds):
        raise ParameterError(name, value, bound)


def _find_targets(bag: Bag, topics: Iterable[str] | None, remap: Mapping[str, str], own_clock: bool) -> dict[str, str]:
    """Return the topic to publish on for each topic to play, after all checks of the bag."""
    path, known = bag.report.path, bag.report.topics
    end = bag.report.start_time * 1e-9 + bag.report.duration
    if own_clock and not end < MAX_CLOCK:
        # Larger times would wrap around in a clock message.
        text = f"log times up to {end:.0f} s do not fit a /clock, which ends at {MAX_CLOCK} s; play without a clock"
        raise BagError(text, path=path, reason="time")
    names = list(known) if topics is None else list(dict.fromkeys(topics))
    for name in names:
        if name not in known:
            raise BagError(f"no topic {name}; topics: {', '.join(known)}", path=path, reason="no_topic")
    names = [name for name in names if not (own_clock and name == CLOCK_TOPIC)]
    for name in names:
        # The recorded bytes are published as they are: subscribers with another definition would misread them.
        info = known[name]
        if info.encoding != "cdr" or info.schema_encoding != "ros2msg":
            text = f"topic {name}, type {info.type}, is encoded as {info.encoding!r} by {info.schema_encoding!r}"
            raise BagError(f"{text}; playable are 'cdr' by 'ros2msg'", path=path, reason="encoding")
        recorded = parse_definition(info.type, info.definition)
        for held, fields in parse_definition(info.type, message_definition(info.type)).items():
            if recorded.get(held) != fields:
                text = f"topic {name}: {held} was recorded with other fields than are installed here"
                raise BagError(text, path=path, reason="type")
    unknown = sorted(remap.keys() - known.keys())
    if unknown:
        text = f"cannot remap {', '.join(unknown)}; topics: {', '.join(known)}"
        raise BagError(text, path=path, reason="no_topic")
    for name in names:
        parse_qos(name, known[name].offered_qos)
    return {name: require_topic(remap.get(name, name)) for name in names}


@contextmanager
def _stop_on_signals(stop: _StopFlag) -> Iterator[None]:
    """Let SIGINT and SIGTERM request a stop; works in the main thread only."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    numbers = (signal.SIGINT, signal.SIGTERM)

    def ask(*_: object) -> None:
        stop.asked = True

    before = [signal.signal(number, ask) for number in numbers]
    try:
        yield
    finally:
        for number, handler in zip(numbers, before, strict=True):
            signal.signal(number, handler)


@contextmanager
def _create_publishers(bag: Bag, targets: Mapping[str, str], with_clock: bool) -> Iterator[tuple[dict[str, Any], Any]]:
    """Yield a publisher for each recorded topic, and one for the clock or None.

    Deadline, lifespan and liveliness of the recorded offers are left out: a replay cannot guarantee
    them.
    """
    with own_node("pkm_twin_player", "playing") as node:
        from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

        publishers = {}
        for name, target in targets.items():
            offer = parse_qos(name, bag.report.topics[name].offered_qos)
            latched = offer.transient_local
            qos = QoSProfile(
                # One second at 1 kHz, the delay of a subscriber up to which nothing is lost.
                depth=max(offer.depth, 1 if latched else 1000),
                reliability=ReliabilityPolicy.RELIABLE if offer.reliable else ReliabilityPolicy.BEST_EFFORT,
                durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
            )
            publishers[name] = node.create_publisher(message_class(bag.report.topics[name].type), target, qos)
        clock = None
        if with_clock:
            kind = message_class("rosgraph_msgs/msg/Clock")
            clock = node.create_publisher(kind, CLOCK_TOPIC, QoSProfile(depth=10))
        yield publishers, clock


def _await_acknowledged(publisher: Any, seconds: float) -> None:
    from rclpy.duration import Duration

    publisher.wait_for_all_acked(Duration(seconds=seconds))


@contextmanager
def _progress_bar(bag: Bag, shown: bool) -> Iterator[Callable[[float, int], None]]:
    """Yield a function that takes bag time since the start (s) and messages so far."""
    if not shown:
        yield lambda _seconds, _messages: None
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn

    total = bag.report.duration
    columns = (
        TextColumn(bag.report.path.name),
        BarColumn(),
        TextColumn("{task.completed:.1f} of {task.total:.1f} s, {task.fields[speed]:.0f} messages/s"),
    )
    with Progress(*columns, console=Console(stderr=True)) as drawing:
        task = drawing.add_task("", total=total, speed=0.0)
        begin = time.monotonic()

        def update(seconds: float, messages: int) -> None:
            speed = messages / max(time.monotonic() - begin, 1e-3)
            drawing.update(task, completed=min(seconds, total), speed=speed)

        yield update


class _Replay:
    """Publish passes of a bag on an absolute schedule, or in lockstep."""

    def __init__(
        self,
        bag: Bag,
        publishers: Mapping[str, Any],
        rate: float,
        stop: _StopFlag,
        pace: Callable[[BagMessage], None] | None,
        clock: Any = None,
        clock_rate: float = 0.0,
    ) -> None:
        self._bag, self._publishers = bag, publishers
        self._rate, self._stop, self._pace = rate, stop, pace
        self._clock = clock
        self._clock_period = 1 / clock_rate if clock_rate else math.inf
        self._messages = 0
        self._late = 0.0
        # A subscriber that has not discovered its publisher receives the first messages after
        # later ones of other topics.
        self._unmatched = set(publishers if pace is not None else ())

    def run(self, *, loop: bool, update: Callable[[float, int], None]) -> PlayResult:
        begin = time.monotonic()
        loops = 0
        while not self._stop.asked:
            self._play_once(update)
            loops += not self._stop.asked
            if not loop or not self._publishers:
                break
        return PlayResult(
            messages=self._messages,
            loops=loops,
            duration=time.monotonic() - begin,
            late_max=self._late,
            interrupted=self._stop.asked,
        )

    def _play_once(self, update: Callable[[float, int], None]) -> None:
        """Play the bag once."""
        first = self._bag.report.start_time
        begin = time.monotonic()
        tick = begin
        drawn = -math.inf
        for message in self._bag.messages(self._publishers):
            due = begin + (message.log_time - first) * 1e-9 / self._rate
            while self._clock and tick <= due:
                if not self._sleep_until(tick):
                    return
                time_message = self._clock.msg_type()
                now = first + round((tick - begin) * self._rate * 1e9)
                time_message.clock.sec, time_message.clock.nanosec = divmod(now, 10**9)
                self._clock.publish(time_message)
                tick += self._clock_period
            if self._pace is not None:
                self._pace(message)
            elif not self._sleep_until(due):
                return
            publisher = self._publishers[message.topic]
            publisher.publish(message.data)
            if message.topic in self._unmatched:
                self._unmatched.discard(message.topic)
                _await_acknowledged(publisher, 60.0)
            sent = time.monotonic()
            self._messages += 1
            self._late = max(self._late, sent - due)
            if sent - drawn > 0.1:
                drawn = sent
                update((message.log_time - first) * 1e-9, self._messages)
        update(self._bag.report.duration, self._messages)

    def _sleep_until(self, due: float) -> bool:
        """Sleep until a time; return whether to continue."""
        while (left := due - time.monotonic()) > 0:
            if self._stop.asked:
                return False
            if left > _SLEEP_OVERSHOOT:
                self._stop.wait(left - _SLEEP_OVERSHOOT / 2)
            else:
                time.sleep(min(left, 0.0001))
        return not self._stop.asked
