# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""``pkm-twin anonymise``: a recording without names, dates and other topics."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, Final

from pkm_twin.apps.frame import command
from pkm_twin.apps.options import OfRecordedRobot, Overwrites
from pkm_twin.bags.reader import Bag, BagWriter, open_bag
from pkm_twin.errors import BagError, ParameterError
from pkm_twin.messages.stamps import SECOND
from pkm_twin.recordings.topics import DEFINITIONS, JOINT_STATE, TRAJECTORY, WRENCH, is_output
from pkm_twin.report import Fact, Report
from pkm_twin.robot.robot import Robot
from pkm_twin.settings import setting
from pkm_twin.streams.wrench import PLATFORM, WrenchSettings

KEPT: Final = {
    JOINT_STATE: "/joint_states", WRENCH: "/wrench", TRAJECTORY: "/joint_trajectory",
}  # fmt: skip
"""Types of topics that stay in an anonymised bag, and their neutral topics."""
NAMES: Final = {JOINT_STATE: "name", TRAJECTORY: "joint_names"}
"""Where their joints' names are."""
ONE_CLOCK: Final = 60 * SECOND
"""Stamps and log times that begin further apart are of two clocks, ns."""
DAY: Final = 86_400 * SECOND
"""Times further apart are of two clocks, as before and after a clock was set, ns."""
FRAMES: Final = ("", WrenchSettings.base_frame, PLATFORM)
"""Frames that keep their names: readers depend on them."""


@dataclass(frozen=True, kw_only=True)
class Anonymise(OfRecordedRobot, Overwrites):
    """Remove names and dates from a recording, so that it can be published.

    Writes a bag with only joint states, wrenches and trajectories: joints are joint_1, joint_2,
    ..., topics and frames have neutral names, time begins at zero, and metadata, definitions and
    QoS are written by pkm-twin. Topics that are left out are listed. With --robot only the joints
    of this robot are kept.
    """

    bag: Path = setting(..., "a bag: an MCAP file or a rosbag2 folder", argument=True)
    robot: str | None = setting(None, "keep only the joints of this robot, in its order")
    out: Path = setting(..., "the new bag, FILE.mcap", writes=True, endings=(".mcap",))
    keep_names: bool = setting(False, "keep names of joints and topics")


def anonymise(given: Anonymise) -> Report:
    """Write a bag without names, dates and other topics.

    :raises BagError: no joints to keep, or a type whose fields are others.
    """
    from pkm_twin import load, robot_names

    if given.out.resolve().is_relative_to(given.bag.resolve()):
        raise ParameterError("out", str(given.out), "another file than the recording's")
    machine = None if given.robot is None else load(given.robot, platform=given.platform)
    metadata = {"anonymised": "names and dates removed by pkm-twin anonymise"}
    if given.keep_names and machine is not None and given.robot in robot_names():
        metadata["robot"] = machine.name
    bag, dropped = open_bag(given.bag), dict[str, str]()
    topics = _topics(bag, machine, given.keep_names, dropped)
    counts = _written(bag, topics, machine, given, metadata)
    return Report(
        answer=f"{given.out}: {sum(counts.values())} messages without names and dates",
        facts=[Fact("messages", counts), Fact("left_out", dropped)],
        notes=[
            *(f"{topic}: {count} messages" for topic, count in counts.items()),
            *(f"left out: {topic} ({why})" for topic, why in dropped.items()),
            "before you publish it, check that its numbers do not identify the product",
        ],
        files={"out": given.out},
    )


def _topics(
    bag: Bag, robot: Robot | None, keep_names: bool, dropped: dict[str, str]
) -> dict[str, str]:
    """New names of the topics that are kept; the others and the reasons go to ``dropped``.

    :raises BagError: nothing is left.
    """
    topics: dict[str, str] = {}
    kept = [name for name, info in bag.report.topics.items() if info.type in NAMES and info.count]
    seen: dict[str, set[str]] = {name: set() for name in kept}
    for message in bag.messages(kept):
        seen[message.topic].update(getattr(message.message, NAMES[message.type]))
    own = set() if robot is None else set(robot.controller.names)
    for name, info in bag.report.topics.items():
        if info.type not in KEPT:
            dropped[name] = info.type
        elif is_output(name):
            dropped[name] = "published by pkm_twin"
        elif not info.count:
            dropped[name] = "no messages"
        elif own and name in seen and not seen[name] & own:
            dropped[name] = f"joints {', '.join(sorted(seen[name])) or 'none'}"
        else:
            neutral = KEPT[info.type]
            number = 1 + sum(new.startswith(neutral) for new in topics.values())
            topics[name] = name if keep_names else neutral + (f"_{number}" if number > 1 else "")
    if not set(topics) & set(seen):
        text = "no joint states or trajectories to keep"
        raise BagError(text, path=bag.report.path, reason="no joint states")
    return topics


def _written(
    bag: Bag, topics: dict[str, str], robot: Robot | None, given: Anonymise,
    metadata: dict[str, str],
) -> dict[str, int]:  # fmt: skip
    """Write the bag; how many messages there are by topic."""
    own = () if robot is None else robot.controller.names
    joints: dict[str, str] = {}
    for name in own:
        _neutral(joints, "joint", name)
    frames: dict[str, str] = {}
    log, stamps = _beginnings(bag, topics)
    counts = dict.fromkeys(topics.values(), 0)
    with BagWriter(
        given.out, overwrite=given.overwrite, metadata={"pkm_twin": metadata}, flush_period=None
    ) as writer:
        for name, new in topics.items():
            kind = bag.report.topics[name].type
            writer.add_topic(new, kind, definition=DEFINITIONS[kind])
        for message in bag.messages(list(topics)):
            content, new = message.message, topics[message.topic]
            time = _time(content.header.stamp)
            sec, nanosec = divmod(_since(stamps, time) if time else 0, SECOND)
            frame = ""
            if message.type == WRENCH:
                frame = content.header.frame_id
                frame = frame if frame in FRAMES else _neutral(frames, "frame", frame)
                body: dict[str, Any] = {"wrench": content.wrench}
            else:
                body = _joints(content, message.type, own, None if given.keep_names else joints)
            header = {"stamp": {"sec": sec, "nanosec": nanosec}, "frame_id": frame}
            counts[new] += 1
            # Its publish time may be of a clock that has the date.
            writer.write(new, {"header": header} | body, _since(log, message.log_time))
    return counts


def _neutral(found: dict[str, str], word: str, name: str) -> str:
    """A neutral name, in the order in which names are asked for."""
    return found.setdefault(name, f"{word}_{len(found) + 1}")


def _joints(
    message: Any, kind: str, own: Sequence[str], joints: dict[str, str] | None
) -> dict[str, Any]:
    """The fields of joint states or a trajectory with other names, and the robot's joints alone."""
    names = list(getattr(message, NAMES[kind]))
    kept = [names.index(name) for name in own if name in names] if own else range(len(names))
    new = [names[k] if joints is None else _neutral(joints, "joint", names[k]) for k in kept]

    def of(values: Any) -> list[float]:
        # A field is empty, or has one number for each joint.
        return [values[k] for k in kept if k < len(values)]

    if kind == JOINT_STATE:
        words = ("position", "velocity", "effort")
        return {"name": new} | {word: of(getattr(message, word)) for word in words}
    fields = ("positions", "velocities", "accelerations", "effort")
    points = [
        {field: of(getattr(point, field)) for field in fields}
        | {"time_from_start": point.time_from_start}
        for point in message.points
    ]
    return {"joint_names": new, "points": points}


def _beginnings(bag: Bag, topics: dict[str, str]) -> tuple[list[int], list[int]]:
    """When the clocks of log times and of stamps begin, ns; the same where they are one clock."""
    messages = [(m.log_time, _time(m.message.header.stamp)) for m in bag.messages(list(topics))]
    log = [time for time, _ in messages]
    stamps = [stamp for _, stamp in messages if stamp] or log
    if abs(min(log) - min(stamps)) < ONE_CLOCK:
        log = stamps = log + stamps
    both = (sorted(times) for times in (log, stamps))
    first, second = ([times[0], *(b for a, b in pairwise(times) if b - a > DAY)] for times in both)
    return first, second


def _since(begins: Sequence[int], time: int) -> int:
    """Time since its clock's beginning, ns, from 1: a stamp of zero means no stamp."""
    return time - begins[bisect_right(begins, time) - 1] + 1


def _time(stamp: Any) -> int:
    return int(stamp.sec) * SECOND + int(stamp.nanosec)


COMMAND = command(anonymise, "Recordings")
