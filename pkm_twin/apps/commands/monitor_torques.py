# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""``pkm-twin monitor-torques``: a subscriber that judges torques as a controller would."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass
from typing import Any

from pkm_twin.apps.frame import command
from pkm_twin.bags.definitions import JOINT_STATE
from pkm_twin.errors import MessageError, PkmTwinError
from pkm_twin.messages.stamps import SECOND, stamp_of
from pkm_twin.report import Fact, Report, Verdict, make_judged_fact
from pkm_twin.ros.context import listening_node
from pkm_twin.ros.signals import first_signal
from pkm_twin.settings import setting
from pkm_twin.streams.arrivals import Arrivals


@dataclass(frozen=True, kw_only=True)
class MonitorTorques:
    """Monitor the torques of a running node as a controller would.

    Checks that torques arrive fresh, that no gap is longer than the deadline, that no message is
    lost, that every message is finite, has one effort per joint and a later stamp than the one
    before, and that there is exactly one publisher, which offers deadline and lifespan. Needs ROS.

    Exit code 0: nothing is bad. 1: an item is bad, or no torques arrived.
    """

    topic: str = setting("delta_dynamics/joint_torques", "topic of stamped torques", argument=True)
    deadline: float = setting(
        0.1, "longest gap and greatest age that the controller tolerates, s", low=1e-6, high=3600.0
    )
    duration: float = setting(10.0, "how long to watch, s; Ctrl-C ends earlier", low=1e-3, high=1e7)
    wait: float = setting(5.0, "longest wait (s) for the first message", low=1e-3, high=1e7)
    sim_time: bool = setting(False, "time stamps are in simulated time, /clock")


@dataclass(frozen=True)
class Offer:
    """Hold the number of a topic's publishers, and the longest deadline and lifespan offered, s."""

    publishers: int = 0
    deadline: float = math.inf
    lifespan: float = math.inf


def judge(topic: str, arrivals: Arrivals, offer: Offer) -> Report:
    """Judge the received messages by what a controller needs."""
    a, count = arrivals, arrivals.count
    most = f"at most {1e3 * a.deadline:g} ms"
    duration = (a.last - a.first) / SECOND
    rate = f", {count / duration:.1f} per second" if duration > 0.0 else ""
    silence, oldest = a.longest_silence / SECOND, a.oldest / SECOND
    mean = a.ages / count / SECOND if count else None
    beyond = f", {a.silences} beyond it" if a.silences else ""

    def fact(name: str, value: Any, unit: str, text: str, words: str, bound: str, good: bool) -> Fact:
        # Without a message the property is unknown.
        verdict = Verdict.UNKNOWN if not count else Verdict.GOOD if good else Verdict.BAD
        return Fact(name, value, unit, text, words if count else "no message", bound, verdict)

    faults = ", ".join(f"{reason}: {number}" for reason, number in a.faults.items()) or "none"
    ages = f"mean {1e3 * (mean or 0.0):.1f}, largest {1e3 * oldest:.1f} ms"
    lost = a.topic.missed
    items = [
        Fact(
            "messages",
            count,
            text="messages",
            shown=f"{count}{rate}",
            bound="1 or more",
            verdict=Verdict.GOOD if count else Verdict.BAD,
        ),
        fact("longest_silence_s", silence, "s", "longest gap", f"{1e3 * silence:.1f} ms{beyond}", most, not a.silences),
        fact("oldest_s", oldest, "s", "age on arrival", ages, most, not a.late),
        fact("lost_messages", lost, "", "lost messages", str(lost), "0", not lost),
        fact("faults", dict(a.faults), "", "faults", faults, "none", not a.faults),
        make_judged_fact("publishers", str(offer.publishers), "1", offer.publishers == 1),
    ]
    for what, value in (("deadline", offer.deadline), ("lifespan", offer.lifespan)):
        if offer.publishers:
            # Allow for the rounding of times to nanoseconds in the middleware.
            good = value <= a.deadline * (1.0 + 1e-9)
            words = f"{1e3 * value:g} ms" if math.isfinite(value) else "none"
            items.append(make_judged_fact(f"{what} offered", words, most, good))
    bad = [fact.text or "" for fact in items if fact.verdict is Verdict.BAD]
    facts = [
        Fact("topic", topic),
        Fact("good", not bad),
        Fact("mean_age_s", mean, "s"),
        Fact("silences_beyond_deadline", a.silences),
        Fact("late_messages", a.late),
    ]
    answer = f"{topic}: bad: {', '.join(bad)}" if bad else f"{topic}: good, {count} messages"
    return Report(answer, [*facts, *items], verdict=Verdict.BAD if bad else Verdict.GOOD)


@command("Recordings")
def monitor_torques(given: MonitorTorques) -> Report:
    """Judge the torques that arrive in a time span, or until the first signal.

    :raises PkmTwinError: no ROS, or a topic of another type.
    """
    arrivals, offer, subscribed = Arrivals(given.deadline), Offer(), False
    with listening_node("monitor_torques", given.sim_time) as (node, spin):
        name = node.resolve_topic_name(given.topic)
        now = node.get_clock().now

        def record_message(message: Any, info: Any) -> None:
            try:
                stamp = stamp_of(message.header)
            except MessageError:
                stamp = 0
            arrivals.count_message(
                message.name,
                message.effort,
                stamp,
                now().nanoseconds,
                time.monotonic_ns(),
                info["publication_sequence_number"],
                info["source_timestamp"],
            )

        began = time.monotonic()
        try:
            with first_signal(KeyboardInterrupt):
                while time.monotonic() - began < given.wait or arrivals.count:
                    subscribed = subscribed or _subscribe(node, name, record_message)
                    spin(0.05)
                    # Read the QoS that the present publishers offer.
                    profiles = [info.qos_profile for info in node.get_publishers_info_by_topic(name)]

                    def find_longest(promises: tuple[Any, ...]) -> float:
                        """Return the longest promised time, s; infinite if one publisher promises none.

                        The middleware states no promise as 0 or as its largest number.
                        """
                        seconds = [promise.nanoseconds / SECOND for promise in promises]
                        return max(one if 0.0 < one < 1e9 else math.inf for one in seconds)

                    if not profiles:
                        offered = None
                    else:
                        deadline, lifespan = zip(*((one.deadline, one.lifespan) for one in profiles), strict=True)
                        offered = Offer(len(profiles), find_longest(deadline), find_longest(lifespan))
                    offer = offered or offer
                    end = arrivals.first + given.duration * SECOND
                    if arrivals.count and time.monotonic_ns() > end:
                        break
        except KeyboardInterrupt:
            pass  # Report the messages received so far.
        arrivals.end_count(time.monotonic_ns())
    return judge(name, arrivals, offer)


def _subscribe(node: Any, topic: str, take: Any) -> bool:
    """Subscribe with the QoS that the publishers offer; return False if there is none yet.

    :raises PkmTwinError: the topic carries something else.
    """
    from rclpy.qos import QoSProfile, ReliabilityPolicy
    from sensor_msgs.msg import JointState

    infos = node.get_publishers_info_by_topic(topic)
    if not infos:
        return False
    other = {info.topic_type for info in infos} - {JOINT_STATE}
    if other:
        raise PkmTwinError(
            f"{topic} carries {', '.join(sorted(other))}; expected a topic of {JOINT_STATE}, which has "
            "time stamps, for example delta_dynamics/joint_torques"
        )
    reliable, best_effort = ReliabilityPolicy.RELIABLE, ReliabilityPolicy.BEST_EFFORT
    all_reliable = all(info.qos_profile.reliability == reliable for info in infos)
    # Use a deep queue, so that a stall of this process does not count as lost messages.
    qos = QoSProfile(depth=1000, reliability=reliable if all_reliable else best_effort)
    node.create_subscription(JointState, topic, take, qos)
    return True
