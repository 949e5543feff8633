# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Which topics of a bag are a machine's joint states, wrenches and deflections."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final

from pkm_twin.bags.definitions import JOINT_STATE, SEPARATOR, TRAJECTORY, TRANSFORM, WRENCH, parse_definition
from pkm_twin.bags.reader import Bag, TopicInfo
from pkm_twin.errors import BagError, one_line
from pkm_twin.robot.robot import Robot

TABLE_SOURCE: Final = "columns of the table"
"""Source of the joint states that a report names for a table, where a bag has a topic."""

_FIELDS: Final = {
    "std_msgs/Header": ("builtin_interfaces/Time stamp", "string frame_id"),
    "builtin_interfaces/Duration": ("int32 sec", "uint32 nanosec"),
    "geometry_msgs/Vector3": ("float64 x", "float64 y", "float64 z"),
    "geometry_msgs/Quaternion": ("float64 x", "float64 y", "float64 z", "float64 w"),
    "geometry_msgs/Transform": ("Vector3 translation", "Quaternion rotation"),
    "geometry_msgs/Wrench": ("Vector3 force", "Vector3 torque"),
    "trajectory_msgs/JointTrajectoryPoint": (
        "float64[] positions",
        "float64[] velocities",
        "float64[] accelerations",
        "float64[] effort",
        "builtin_interfaces/Duration time_from_start",
    ),
}


def _write_definition(fields: Sequence[str], *held: str) -> str:
    """Return the ros2msg text of a type with a header, fields, and the types that they hold."""
    parts = ["\n".join(["std_msgs/Header header", *fields])]
    parts += ["\n".join([f"MSG: {name}", *_FIELDS[name]]) for name in ("std_msgs/Header", *held)]
    return f"\n{SEPARATOR}\n".join(parts) + "\n"


DEFINITIONS: Final = {
    JOINT_STATE: _write_definition(["string[] name", "float64[] position", "float64[] velocity", "float64[] effort"]),
    WRENCH: _write_definition(["Wrench wrench"], "geometry_msgs/Wrench", "geometry_msgs/Vector3"),
    TRANSFORM: _write_definition(
        ["string child_frame_id", "Transform transform"],
        "geometry_msgs/Transform",
        "geometry_msgs/Vector3",
        "geometry_msgs/Quaternion",
    ),
    TRAJECTORY: _write_definition(
        ["string[] joint_names", "JointTrajectoryPoint[] points"],
        "trajectory_msgs/JointTrajectoryPoint",
        "builtin_interfaces/Duration",
    ),
}
"""Definitions of the types that are read and written."""


@dataclass(frozen=True)
class Topics:
    """The topics that are read, and by name why others of their types are not."""

    joint_states: str
    wrench: str | None = None
    deflection: str | None = None
    left_out: Mapping[str, str] = field(default_factory=dict)
    frame: str = ""
    """Frame of the accepted wrenches."""
    turns: bool = False
    """True if this frame rotates with the platform."""

    def __str__(self) -> str:
        if self.joint_states == TABLE_SOURCE:
            return TABLE_SOURCE
        text = f"joint states {self.joint_states}, wrench {self.wrench or 'none'}"
        text += f" (frame {self.frame})" if self.frame else ""
        text += f", deflection {self.deflection}" if self.deflection else ""
        if self.left_out:
            text += "; left out: " + ", ".join(f"{k} ({v})" for k, v in self.left_out.items())
        return one_line(text, 1000)


def choose_topics(bag: Bag, robot: Robot, wanted: Sequence[str] = (), deflected: bool = False) -> Topics:
    """Find the joint-state topic that carries the robot's joints, and the wrench topic.

    The twin's own outputs, and topics that no sensor publishes, are left out. Of several
    candidates, ``/joint_states``, ``/wrench`` and ``/measured_deflection`` are preferred.

    :param wanted: topics to use instead; if only a joint-state topic is given, no wrench is read.
    :param deflected: also find the topic of measured deflections.
    :raises BagError: a wanted topic is missing or of another type, no topic has the joints, or
        several fit.
    """
    kinds: dict[str, list[str]] = {JOINT_STATE: [], WRENCH: []}
    if deflected:
        kinds[TRANSFORM] = []
    for name in wanted:
        info = bag.report.topics.get(name)
        if info is None or normalise_type(info) not in kinds:
            fit = [n for n, i in bag.report.topics.items() if normalise_type(i) in kinds]
            is_a = "is not in the bag" if info is None else f"is a {info.type}"
            raise _make_topic_error(bag, f"topic {name} {is_a}; topics that fit: {', '.join(fit)}")
        kinds[normalise_type(info)].append(name)
    for kind, names in kinds.items():
        if len(set(names)) > 1:
            raise _make_topic_error(bag, f"{' and '.join(names)} are both {kind}; choose one with --topic")
    left_out: dict[str, str] = {}
    named = _find_candidates(bag, JOINT_STATE, kinds[JOINT_STATE], left_out)
    filled = [name for name in named if bag.report.topics[name].count]
    if not filled:
        aside = "; ".join(f"{name} is there, but {why}" for name, why in left_out.items())
        text = f"no joint states that can be read: {aside}" if aside else "no joint states in the bag"
        plans = [n for n, i in bag.report.topics.items() if normalise_type(i) == TRAJECTORY and i.count]
        if plans and not aside:
            text += (
                f": {plans[0]} is a planned trajectory, which `pkm-twin torques` and `size` take; "
                "record /joint_states while `pkm-twin play` sends it to the machine"
            )
        raise _make_topic_error(bag, text, "no joint states")
    for name in filled:
        require_definition(bag, name)
    # The names in messages are the controller's names of the joints.
    own = robot.controller.names
    seen = _read_joint_names(bag, filled, set(own))
    fit = [name for name in filled if set(own) <= seen[name]]
    for name in filled:
        if name not in fit:
            left_out[name] = f"joints {', '.join(sorted(seen[name])) or 'none'}"
    if not fit:
        name = filled[0]
        missing = next(joint for joint in own if joint not in seen[name])
        raise _make_topic_error(
            bag,
            f"no topic has all joints of {robot.name}: on {name} joint {missing!r} is missing, "
            f"it has {', '.join(sorted(seen[name])) or 'none'}",
            "no joint states",
        )
    joints = _pick_usual(bag, "joint states", fit, "joint_states", left_out) or fit[0]
    wrenches = _find_candidates(bag, WRENCH, kinds[WRENCH], left_out)
    if kinds[JOINT_STATE] and not kinds[WRENCH]:
        left_out.update({name: "not chosen" for name in wrenches})
        wrenches = []
    wrench = _pick_usual(bag, "wrenches", wrenches, "wrench", left_out)
    deflection = None
    if deflected:
        fit = _find_candidates(bag, TRANSFORM, kinds[TRANSFORM], left_out)
        fit = [name for name in fit if bag.report.topics[name].count]
        deflection = _pick_usual(bag, "deflections", fit, "measured_deflection", left_out)
        if deflection is None:
            text = f"no deflection in the bag: a topic of {TRANSFORM} from the platform to the deflected platform"
            raise _make_topic_error(bag, text, "no deflection")
        if wrench is None:
            text = "no wrench in the bag; compliance needs the applied wrench"
            raise _make_topic_error(bag, text, "no wrench")
    for name in filter(None, (joints, wrench, deflection)):
        require_definition(bag, name)
    return Topics(joints, wrench, deflection, left_out)


def normalise_type(info: TopicInfo) -> str:
    """Return a topic's type as ROS 2 writes it; some libraries leave the ``msg`` out."""
    package, _, name = info.type.partition("/")
    return info.type if "/" in name or not name else f"{package}/msg/{name}"


def _find_candidates(bag: Bag, kind: str, wanted: list[str], left_out: dict[str, str]) -> list[str]:
    """Find topics of a type: the wanted, else all but the twin's and a simulation's own."""
    outputs = {"joint_torques", "torque_residual", "reactions", "machine_state", "commands_stamped"}
    outputs |= {"compliance_stamped", "strain_energy_stamped", "natural_frequencies_stamped"}
    fit = []
    for name, info in bag.report.topics.items():
        if normalise_type(info) != kind:
            continue
        last = name.split("/")[-2:]
        if info.encoding != "cdr":
            left_out[name] = f"its encoding is {info.encoding}; expected cdr"
        elif wanted and name not in wanted:
            left_out[name] = "not chosen"
        elif not wanted and any(part in ("ground_truth", "groundtruth") for part in name.split("/")):
            left_out[name] = "no sensor's; --topic uses it"
        elif not wanted and (last == ["stiffness_monitor", "deflection"] or outputs & {*last}):
            left_out[name] = "published by pkm_twin"
        else:
            fit.append(name)
    return fit


def _pick_usual(bag: Bag, what: str, fit: list[str], usual: str, left_out: dict[str, str]) -> str | None:
    """Return the topic with the usual name among several, None without any."""
    if not fit:
        return None
    preferred = [name for name in fit if name.split("/")[-1] == usual]
    if len(fit) > 1 and len(preferred) != 1:
        raise _make_topic_error(bag, f"{what} on {', '.join(fit)}; choose one with --topic")
    chosen = preferred[0] if preferred else fit[0]
    left_out.update({name: f"{chosen} is used" for name in fit if name != chosen})
    return chosen


def _read_joint_names(bag: Bag, topics: list[str], joints: set[str]) -> dict[str, set[str]]:
    """Read joint names of each topic's first message, or of an early one that has all joints."""
    seen: dict[str, set[str]] = {}
    count: Counter[str] = Counter()
    open_topics = set(topics)
    for message in bag.messages(topics, order="file"):
        if message.topic not in open_topics:
            continue
        names = set(message.message.name)
        count[message.topic] += 1
        if message.topic not in seen or joints <= names:
            seen[message.topic] = names
        if joints <= names or count[message.topic] >= 50:
            open_topics.discard(message.topic)
            if not open_topics:
                break
    return seen


def require_definition(bag: Bag, topic: str) -> None:
    """Reject a type whose recorded fields differ from the expected ones.

    :raises BagError: naming the field.
    """
    info = bag.report.topics[topic]
    if info.schema_encoding != "ros2msg":
        return  # decoding the first message reports the fault
    try:
        recorded = parse_definition(info.type, info.definition)
    except BagError as error:
        raise _make_topic_error(bag, f"topic {topic}: {error}", error.reason) from None
    for held, fields in parse_definition(info.type, DEFINITIONS[info.type]).items():
        found = recorded.get(held, ())
        if found == fields:
            continue
        wrong = next((f for f, g in zip(fields, found, strict=False) if f != g), None)
        name = wrong.name if wrong else [*fields, *found][min(len(fields), len(found))].name
        raise BagError(
            f"topic {topic}: the bag's definition of {held} differs at the field {name!r} from "
            f"{', '.join(f.name for f in fields)}",
            path=bag.report.path,
            reason="type",
        )


def _make_topic_error(bag: Bag, text: str, reason: str = "topic") -> BagError:
    return BagError(text, path=bag.report.path, reason=reason)
