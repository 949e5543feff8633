# SPDX-License-Identifier: Apache-2.0
"""``pkm-twin monitor-torques``: a subscriber that reports what a controller must notice of torques.

``guard-check`` is its older name.
"""

from __future__ import annotations

import math
import sys
import time
from dataclasses import asdict, dataclass
from typing import Annotated, Any

import typer

from pkm_twin.apps.verdict import Item, Verdict, items_table, judged_item
from pkm_twin.console import print_json, table_console
from pkm_twin.errors import MessageError, ParameterError, PkmTwinError
from pkm_twin.messages.stamps import stamp_of
from pkm_twin.ros.listener import listening_node
from pkm_twin.ros.signals import first_signal
from pkm_twin.streams.arrivals import SECOND, Arrivals

TYPE = "sensor_msgs/msg/JointState"
DEPTH = 1000
"""Deep enough that a stall of this process is no loss of the topic's."""
LOOK = 0.05
"""How often silence, signals and the end of the time are looked for, s."""


@dataclass(frozen=True)
class Offer:
    """What the topic's publishers promise: how many they are, and the weakest promise, s."""

    publishers: int
    deadline: float
    lifespan: float


@dataclass(frozen=True)
class GuardReport:
    """All items; the torques are good where none is bad."""

    topic: str
    items: tuple[Item, ...]
    arrivals: Arrivals

    @property
    def good(self) -> bool:
        """No item is bad."""
        return all(item.verdict is not Verdict.BAD for item in self.items)

    def as_json(self) -> dict[str, Any]:
        """Plain data for a script; times in s."""
        a = self.arrivals
        return {
            "topic": self.topic,
            "good": self.good,
            "messages": a.count,
            "longest_silence_s": a.longest_silence / SECOND,
            "silences_beyond_deadline": a.silences,
            "mean_age_s": a.ages / a.count / SECOND if a.count else None,
            "oldest_s": a.oldest / SECOND,
            "late_messages": a.late,
            "lost_messages": a.topic.missed,
            "faults": dict(a.faults),
            "items": [asdict(item) for item in self.items],
        }


def judge(topic: str, arrivals: Arrivals, offer: Offer) -> GuardReport:
    """The report of what came, against what a controller needs."""
    a = arrivals
    least = f"at most {1e3 * a.deadline:g} ms"
    duration = (a.last - a.first) / SECOND
    rate = f", {a.count / duration:.1f} per second" if duration > 0.0 else ""
    mean = a.ages / max(a.count, 1) / SECOND
    beyond = f", {a.silences} beyond it" if a.silences else ""
    faults = ", ".join(f"{reason}: {count}" for reason, count in a.faults.items())

    def item(what: str, value: str, bound: str, good: bool) -> Item:
        # Nothing is known of torques that never came.
        if not a.count:
            return Item(what, "no message", bound, Verdict.UNKNOWN)
        return judged_item(what, value, bound, good)

    came = Verdict.GOOD if a.count else Verdict.BAD
    items = [
        Item("messages", f"{a.count}{rate}", "1 or more", came),
        item("longest gap", f"{a.longest_silence / 1e6:.1f} ms{beyond}", least, not a.silences),
        item(
            "age on arrival", f"mean {1e3 * mean:.1f}, largest {a.oldest / 1e6:.1f} ms", least,
            not a.late,
        ),
        item("lost messages", str(a.topic.missed), "0", not a.topic.missed),
        item("faults", faults or "none", "none", not a.faults),
        Item("publishers", str(offer.publishers), "1", _one(offer.publishers)),
    ]  # fmt: skip
    if offer.publishers:
        items += [
            Item(f"{what} offered", _seconds(value), least, _promise(value, a.deadline))
            for what, value in (("deadline", offer.deadline), ("lifespan", offer.lifespan))
        ]
    return GuardReport(topic, tuple(items), arrivals)


def watch(
    topic: str,
    deadline: float,
    duration: float,
    wait: float,
    sim_time: bool = False,
) -> GuardReport:
    """Subscribe for a while, or until the first signal.

    :param topic: of sensor_msgs/JointState messages with efforts.
    :param duration: how long, s, from the first message on; ``wait``: how long for that one, s.
    :param sim_time: stamps are by /clock.
    :raises PkmTwinError: no ROS, or a topic of another type.
    """
    for name, value in (("deadline", deadline), ("duration", duration), ("wait", wait)):
        if not 0.0 < value < math.inf:
            raise ParameterError(name, value, "a number of seconds above 0")
    arrivals = Arrivals(deadline)
    offer = Offer(0, math.inf, math.inf)
    with listening_node("guard_check", sim_time) as (node, spin):
        name = node.resolve_topic_name(topic)
        now = node.get_clock().now

        def take(message: Any, info: Any) -> None:
            try:
                stamp = stamp_of(message.header)
            except MessageError:
                stamp = 0
            arrivals.arrived(
                message.name,
                message.effort,
                stamp,
                now().nanoseconds,
                time.monotonic_ns(),
                info["publication_sequence_number"],
                info["source_timestamp"],
            )

        began = time.monotonic()
        subscribed = False
        try:
            with first_signal(KeyboardInterrupt):
                while time.monotonic() - began < wait or arrivals.count:
                    if not subscribed:
                        subscribed = _subscribe(node, name, take)
                    spin(LOOK)
                    offer = _offer(node, name) or offer
                    if arrivals.count and time.monotonic_ns() > arrivals.first + duration * SECOND:
                        break
        except KeyboardInterrupt:
            pass  # What was seen until then is the report.
        arrivals.ended(time.monotonic_ns())
    return judge(name, arrivals, offer)


def _subscribe(node: Any, topic: str, take: Any) -> bool:
    """Subscribe as the topic's publishers offer it; False while there are none.

    :raises PkmTwinError: the topic carries something else.
    """
    from rclpy.qos import QoSProfile, ReliabilityPolicy
    from sensor_msgs.msg import JointState

    infos = node.get_publishers_info_by_topic(topic)
    if not infos:
        return False
    other = {info.topic_type for info in infos} - {TYPE}
    if other:
        raise PkmTwinError(
            f"{topic} carries {', '.join(sorted(other))}; expected a topic of {TYPE}, which has "
            "time stamps, for example delta_dynamics/joint_torques"
        )
    reliable = all(i.qos_profile.reliability == ReliabilityPolicy.RELIABLE for i in infos)
    qos = QoSProfile(
        depth=DEPTH,
        reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
    )
    node.create_subscription(JointState, topic, take, qos)
    return True


def _offer(node: Any, topic: str) -> Offer | None:
    """What the publishers of now promise; None where there are none."""
    profiles = [info.qos_profile for info in node.get_publishers_info_by_topic(topic)]
    if not profiles:
        return None
    return Offer(
        len(profiles),
        max(_duration(profile.deadline) for profile in profiles),
        max(_duration(profile.lifespan) for profile in profiles),
    )


def _duration(duration: Any) -> float:
    """In s; the middleware's largest number means no promise."""
    seconds = float(duration.nanoseconds) / SECOND
    return seconds if 0.0 < seconds < 1e9 else math.inf


def _seconds(value: float) -> str:
    return f"{1e3 * value:g} ms" if math.isfinite(value) else "none"


def _one(publishers: int) -> Verdict:
    """Two that send torques are one too many; none at the end is a publisher that has gone."""
    return Verdict.GOOD if publishers == 1 else Verdict.BAD


def _promise(offered: float, deadline: float) -> Verdict:
    # A hair for what the middleware rounds.
    return Verdict.GOOD if offered <= deadline * (1.0 + 1e-9) else Verdict.BAD


def guard_check(
    topic: Annotated[
        str, typer.Argument(help="topic of stamped torques")
    ] = "delta_dynamics/joint_torques",
    deadline: Annotated[
        float, typer.Option(help="longest gap and greatest age (s) that the controller tolerates")
    ] = 0.1,
    duration: Annotated[
        float, typer.Option(help="how long to watch, s; Ctrl-C ends earlier")
    ] = 10.0,
    wait: Annotated[float, typer.Option(help="longest wait (s) for the first message")] = 5.0,
    sim_time: Annotated[
        bool, typer.Option("--sim-time", help="time stamps are in simulated time, /clock")
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="machine-readable output")] = False,
) -> None:
    """Monitor the torques of a running node as a controller would.

    Checks that torques arrive fresh, that no gap is longer than the deadline, that no message is
    lost, that every message is finite, has one effort per joint and a later stamp than the one
    before, and that there is exactly one publisher, which offers deadline and lifespan. Needs ROS.

    Exit code 0: nothing is bad. 1: an item is bad, or no torques arrived.
    """
    report = watch(topic, deadline, duration, wait, sim_time)
    if as_json:
        print_json(report.as_json())
    else:
        table_console().print(items_table(report.topic, "must be", report.items))
    if not report.good:
        sys.exit(1)
