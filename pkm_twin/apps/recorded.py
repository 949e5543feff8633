# SPDX-License-Identifier: Apache-2.0
"""A recorded robot as arrays: joint states of a bag, its wrenches, and what it says of itself."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from pkm_twin import load, robot_names
from pkm_twin.bags.definitions import parse_definition
from pkm_twin.bags.reader import Bag, open_bag
from pkm_twin.console import parse_numbers
from pkm_twin.errors import BagError, MessageError, ParameterError, one_line
from pkm_twin.machine.robot import Robot
from pkm_twin.ros.messages import JointReader, JointSample, StampRules, read_wrench, stamp_of

Array = NDArray[np.float64]

JOINT_STATE: Final = "sensor_msgs/msg/JointState"
TRANSFORM: Final = "geometry_msgs/msg/TransformStamped"
WRENCH: Final = "geometry_msgs/msg/WrenchStamped"
BASE_FRAME: Final = "base_link"
PLATFORM_FRAME: Final = "platform"
TWIN_OUTPUTS: Final = (
    "joint_torques",
    "torque_residual",
    "reactions",
    "machine_state",
    "commands_stamped",
    "compliance_stamped",
    "strain_energy_stamped",
    "natural_frequencies_stamped",
)
"""Last names of the twin's own topics of these two types, or a name before the last."""

_STAMPED = "std_msgs/Header header\n"
_HEADER = """
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
"""
_VECTOR3 = """================================================================================
MSG: geometry_msgs/Vector3
float64 x
float64 y
float64 z
"""
_DEFINITIONS: Final = {
    JOINT_STATE: _STAMPED
    + "string[] name\nfloat64[] position\nfloat64[] velocity\nfloat64[] effort"
    + _HEADER,
    WRENCH: _STAMPED
    + "Wrench wrench"
    + _HEADER
    + """
================================================================================
MSG: geometry_msgs/Wrench
Vector3 force
Vector3 torque
"""
    + _VECTOR3,
    TRANSFORM: _STAMPED
    + "string child_frame_id\nTransform transform"
    + _HEADER
    + """
================================================================================
MSG: geometry_msgs/Transform
Vector3 translation
Quaternion rotation
"""
    + _VECTOR3
    + """================================================================================
MSG: geometry_msgs/Quaternion
float64 x
float64 y
float64 z
float64 w
""",
}
# How many messages of a topic are looked at for the robot's joints.
_LOOK = 50


@dataclass(frozen=True)
class Load:
    """A payload that is no part of the robot's file, and when it is on the platform.

    mass in kg, com in m from the platform's reference point; times in s since the first joint
    state, empty where it is there all the time. ``source`` says who tells: ``bag`` or ``option``.
    """

    mass: float
    com: tuple[float, float, float] | None = None
    times: tuple[tuple[float, float], ...] = ()
    source: str = "option"

    def held(self, time: Array) -> NDArray[np.bool_]:
        """When it is on the platform, shape (n,)."""
        if not self.times:
            return np.ones(len(time), np.bool_)
        spans = [(time >= begin) & (time <= end) for begin, end in self.times]
        return np.asarray(np.logical_or.reduce(spans), np.bool_)

    def near_change(self, time: Array, within: float) -> NDArray[np.bool_]:
        """Where a pick or release is less than ``within`` seconds away, shape (n,)."""
        edges = [edge for span in self.times for edge in span]
        if not edges:
            return np.zeros(len(time), np.bool_)
        near = [np.abs(time - edge) < within for edge in edges]
        return np.asarray(np.logical_or.reduce(near), np.bool_)

    def on(self, robot: Robot) -> Robot:
        """The robot with this payload.

        :raises ParameterError: the robot takes none, or not such a one.
        """
        changes: dict[str, Any] = {"mass": self.mass}
        if self.com is not None:
            changes["com"] = list(self.com)
        return robot.changed(payload=changes)

    def as_json(self) -> dict[str, Any]:
        """Plain data, units in the keys; no times where it is held all the time."""
        return {
            "mass_kg": self.mass,
            "com_m": None if self.com is None else list(self.com),
            "held_s": [list(span) for span in self.times] or None,
            "source": self.source,
        }

    def __str__(self) -> str:
        at = "" if self.com is None else " at " + ", ".join(f"{v:g}" for v in self.com) + " m"
        spans = ", ".join(f"{begin:g} to {end:g} s" for begin, end in self.times) or "all the time"
        told = "as the bag tells" if self.source == "bag" else "as asked for"
        return f"{self.mass:g} kg{at}, {spans}, {told}"


@dataclass(frozen=True)
class Topics:
    """The topics that are read, and by name why others of their types are not."""

    joint_states: str
    wrench: str | None = None
    left_out: Mapping[str, str] = field(default_factory=dict)

    def __str__(self) -> str:
        text = f"joint states {self.joint_states}, wrench {self.wrench or 'none'}"
        if self.left_out:
            text += "; left out: " + ", ".join(f"{k} ({v})" for k, v in self.left_out.items())
        return one_line(text, 1000)


@dataclass(frozen=True)
class Recording:
    """Accepted joint states on a common time axis, of n joints.

    stamps (samples,) in ns; time (samples,) in s since the first stamp; q, qd, effort (samples, n),
    None where the bag has none; wrench (samples, 6) in fixed axes at the platform's origin, the one
    nearest in time, None without a wrench topic. ``rejected`` counts refused messages by reason.
    """

    robot: Robot
    bag: Bag
    topics: Topics
    load: Load | None
    stamps: NDArray[np.int64]
    time: Array
    q: Array
    qd: Array | None
    effort: Array | None
    wrench: Array | None
    rejected: Counter[str]
    first_reject: str

    @property
    def message_count(self) -> int:
        """How many messages the chosen topics have."""
        names = (self.topics.joint_states, self.topics.wrench)
        return sum(self.bag.report.topics[name].count for name in names if name is not None)


def robot_of(bag: Bag, name: str | Robot | None) -> Robot:
    """The robot, by name too, or the one that the bag's metadata names.

    :raises BagError: neither is given, or the bag names one that is not in ``config/``.
    """
    if name is not None:
        return name if isinstance(name, Robot) else load(name)
    recorded = bag.report.metadata.get("pkm_twin", {}).get("robot")
    if recorded is None:
        raise BagError(
            "the bag names no robot; give it with --robot", path=bag.report.path, reason="no robot"
        )
    # Not a path: a bag does not choose which files are opened.
    if recorded not in robot_names():
        raise _metadata_error(
            bag, "robot", recorded, f"one of {', '.join(robot_names())}; or give --robot"
        )
    return load(recorded)


def told_load(bag: Bag) -> Load | None:
    """The payload that the bag's metadata tell of.

    :raises BagError: a value is missing or no number.
    """
    facts = bag.report.metadata.get("pkm_twin", {})
    if "payload_picked_s" not in facts:
        return None
    names = ("payload_mass_kg", "payload_picked_s", "payload_released_s")
    mass, picked, released = (_fact(bag, facts, name) for name in names)
    if mass < 0:
        raise _metadata_error(bag, names[0], facts[names[0]], "0 or more")
    if released < picked:
        raise _metadata_error(bag, names[2], facts[names[2]], f"{names[1]}, {picked:g}, or later")
    return Load(mass, None, ((picked, released),), "bag")


def _fact(bag: Bag, facts: Mapping[str, str], name: str) -> float:
    try:
        value = float(facts[name])
    except (KeyError, ValueError):
        value = math.nan
    if not math.isfinite(value):
        raise _metadata_error(bag, name, facts.get(name), "a finite number")
    return value


def _metadata_error(bag: Bag, name: str, value: str | None, expected: str) -> BagError:
    return BagError(
        f"metadata 'pkm_twin': {name} is {value!r}; expected {expected}",
        path=bag.report.path,
        reason="metadata",
    )


def parse_payload(text: str) -> tuple[float, tuple[float, float, float] | None]:
    """Mass (kg) and, where given, centre (m) of ``MASS[,x,y,z]``.

    :raises ParameterError: it is not 1 or 4 finite numbers, or the mass is negative.
    """
    numbers = parse_numbers(text)
    if len(numbers) not in (1, 4) or numbers[0] < 0:
        raise ParameterError("payload", text, "MASS or MASS,x,y,z: kg, 0 or more, and m")
    return numbers[0], (numbers[1], numbers[2], numbers[3]) if len(numbers) == 4 else None


def parse_times(text: str) -> tuple[tuple[float, float], ...]:
    """Spans of ``FROM,TO[,FROM,TO...]``, s.

    :raises ParameterError: the numbers are not pairs, finite and rising.
    """
    numbers = parse_numbers(text)
    rising = all(one < other for one, other in pairwise(numbers))
    if not numbers or len(numbers) % 2 or not rising:
        raise ParameterError("load-times", text, "FROM,TO[,FROM,TO...] in s, rising")
    return tuple(zip(numbers[::2], numbers[1::2], strict=True))


def choose_topics(bag: Bag, robot: Robot, wanted: Sequence[str] = ()) -> Topics:
    """The joint-state topic that carries the robot's joints, and the wrench topic.

    The twin's own outputs are left out. Of several that fit, ``/joint_states`` and ``/wrench`` are
    taken; ``wanted`` names them otherwise.

    :raises BagError: a wanted topic is missing or of another type, no topic has the joints, or
        several fit.
    """
    kinds: dict[str, list[str]] = {JOINT_STATE: [], WRENCH: []}
    for name in wanted:
        info = bag.report.topics.get(name)
        if info is None or info.type not in kinds:
            fit = [n for n, i in bag.report.topics.items() if i.type in kinds]
            is_a = "is not in the bag" if info is None else f"is a {info.type}"
            raise _choice_error(bag, f"topic {name} {is_a}; topics that fit: {', '.join(fit)}")
        kinds[info.type].append(name)
    for kind, names in kinds.items():
        if len(set(names)) > 1:
            raise _choice_error(bag, f"{' and '.join(names)} are both {kind}; choose one")
    left_out: dict[str, str] = {}
    joints = _choose_joints(bag, robot, kinds[JOINT_STATE], left_out)
    wrench = _choose_wrench(bag, kinds[WRENCH], bool(wanted), left_out)
    for name in filter(None, (joints, wrench)):
        require_definition(bag, name)
    return Topics(joints, wrench, left_out)


def _choose_joints(bag: Bag, robot: Robot, wanted: list[str], left_out: dict[str, str]) -> str:
    named = _candidates(bag, JOINT_STATE, wanted, left_out)
    filled = [name for name in named if bag.report.topics[name].count]
    if not filled:
        aside = "".join(f"; {name}: {why}" for name, why in left_out.items())
        raise _choice_error(bag, f"no joint states in the bag{aside}", "no joint states")
    for name in filled:
        require_definition(bag, name)
    # As the controller calls them, which recorded them.
    joints = robot.controller.names
    seen = _names_on(bag, filled, set(joints))
    fit = [name for name in filled if set(joints) <= seen[name]]
    for name in filled:
        if name not in fit:
            left_out[name] = f"joints {', '.join(sorted(seen[name])) or 'none'}"
    if not fit:
        name = filled[0]
        missing = next(joint for joint in joints if joint not in seen[name])
        raise _choice_error(
            bag,
            f"no topic has all joints of {robot.name}: on {name} joint {missing!r} is missing, "
            f"it has {', '.join(sorted(seen[name])) or 'none'}",
            "no joint states",
        )
    return _only(bag, "joint states", fit, "joint_states", left_out)


def _choose_wrench(
    bag: Bag, wanted: list[str], chosen: bool, left_out: dict[str, str]
) -> str | None:
    fit = _candidates(bag, WRENCH, wanted, left_out)
    if not fit:
        return None
    if chosen and not wanted and len(fit) > 1:
        # Who names the joint states alone, and there is no telling which wrench, wants none.
        left_out.update({name: "not chosen" for name in fit})
        return None
    return _only(bag, "wrenches", fit, "wrench", left_out)


def _candidates(bag: Bag, kind: str, wanted: list[str], left_out: dict[str, str]) -> list[str]:
    """Topics of a type: the wanted ones, else all but the twin's own."""
    fit = []
    for name in (name for name, info in bag.report.topics.items() if info.type == kind):
        if wanted and name not in wanted:
            left_out[name] = "not chosen"
        elif not wanted and any(part in TWIN_OUTPUTS for part in name.split("/")[-2:]):
            left_out[name] = "the twin's own"
        else:
            fit.append(name)
    return fit


def _only(bag: Bag, what: str, fit: list[str], usual: str, left_out: dict[str, str]) -> str:
    preferred = [name for name in fit if name.split("/")[-1] == usual]
    if len(fit) > 1 and len(preferred) != 1:
        raise _choice_error(bag, f"{what} on {', '.join(fit)}; choose one with --topic")
    chosen = preferred[0] if preferred else fit[0]
    left_out.update({name: f"{chosen} is taken" for name in fit if name != chosen})
    return chosen


def _names_on(bag: Bag, topics: list[str], joints: set[str]) -> dict[str, set[str]]:
    """Joint names of the first message of each topic, or of one soon after that has all joints."""
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
        if joints <= names or count[message.topic] >= _LOOK:
            open_topics.discard(message.topic)
            if not open_topics:
                break
    return seen


def require_definition(bag: Bag, topic: str) -> None:
    """Refuse a type whose recorded fields are not the ones that are read.

    :raises BagError: naming the field.
    """
    info = bag.report.topics[topic]
    if info.encoding != "cdr" or info.schema_encoding != "ros2msg":
        return  # the first message's decoding tells
    try:
        recorded = parse_definition(info.type, info.definition)
    except BagError as error:
        raise _choice_error(bag, f"topic {topic}: {error}", error.reason) from None
    for held, fields in parse_definition(info.type, _DEFINITIONS[info.type]).items():
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


def _choice_error(bag: Bag, text: str, reason: str = "topic") -> BagError:
    return BagError(text, path=bag.report.path, reason=reason)


def read_recording(
    path: str | Path,
    robot: str | Robot | None = None,
    progress: Callable[[int], None] | None = None,
    *,
    topics: Sequence[str] = (),
    carried: Load | None = None,
    limited: bool = True,
) -> Recording:
    """Read a bag's joint states and wrenches, every message checked as the nodes check it.

    :param progress: called with the number of messages read so far.
    :param topics: what to read, where names and joints do not tell.
    :param carried: the payload; by default the one that the bag tells of.
    :param limited: refuse what is beyond the robot's limits, as a node does.
    :raises BagError: the bag is damaged, names no robot, or has no usable joint state.
    """
    bag = open_bag(path)
    machine = robot_of(bag, robot)
    chosen = choose_topics(bag, machine, topics)
    carried = carried or told_load(bag)
    reader, rules = JointReader(machine, limited=limited), StampRules(future_tolerance=2**62)
    samples: list[JointSample] = []
    wrenches: list[tuple[int, str, Array]] = []
    rejected: Counter[str] = Counter()
    first = ""
    names = [name for name in (chosen.joint_states, chosen.wrench) if name is not None]
    for i, message in enumerate(bag.messages(names)):
        if progress is not None:
            progress(i + 1)
        try:
            if message.type == JOINT_STATE:
                sample = reader.joint_state(message.message, message.log_time, rules)
                if samples and sample.stamp <= samples[-1].stamp:
                    raise MessageError("stamp order", f"stamp {sample.stamp} is not after the last")
                samples.append(sample)
            else:
                wrenches.append(recorded_wrench(message.message, message.log_time, rules))
        except MessageError as error:
            rejected[error.reason] += 1
            first = first or one_line(f"{message.topic}: {error}")
    if not samples:
        raise BagError(
            f"no usable joint state for {machine.name}: {first}",
            path=bag.report.path,
            reason="no joint states",
        )
    stamps = np.array([s.stamp for s in samples], np.int64)
    return Recording(
        robot=machine,
        bag=bag,
        topics=chosen,
        load=carried,
        stamps=stamps,
        time=(stamps - stamps[0]) / 1e9,
        q=np.array([s.q for s in samples]),
        qd=_stacked([s.qd for s in samples]),
        effort=_stacked([s.effort for s in samples]),
        wrench=_fixed(machine, stamps, samples, wrenches),
        rejected=rejected,
        first_reject=first,
    )


def why_no_torques(robot: Robot) -> str:
    """Why the model has no torques for this robot; empty where it has."""
    try:
        robot.massive()
    except ParameterError as error:
        return str(error)
    return ""


def by_load(
    robot: Robot, carried: Load | None, time: Array, longest: int
) -> Iterator[tuple[Robot, slice]]:
    """The robot as it is loaded, and the samples in a row (at most ``longest``) for which."""
    held = np.zeros(len(time), np.bool_) if carried is None else carried.held(time)
    loaded = robot if carried is None else carried.on(robot)
    edges = [0, *(np.flatnonzero(np.diff(held)) + 1).tolist(), len(time)]
    for begin, end in pairwise(edges):
        for start in range(begin, end, longest):
            stop = min(start + longest, end)
            yield (loaded if held[start] else robot), slice(start, stop)


def recorded_wrench(message: Any, now: int, rules: StampRules) -> tuple[int, str, Array]:
    """Stamp (ns), frame and values (6,) of a geometry_msgs/WrenchStamped.

    :raises MessageError: it is refused.
    """
    # Any frame that has a name: all but the base frame turn with the platform.
    frame = message.header.frame_id or PLATFORM_FRAME
    sample = read_wrench(message, now, rules, frame, accept_empty=False)
    return stamp_of(message.header), sample.frame, sample.wrench


def _stacked(values: list[Array | None]) -> Array | None:
    present = [v for v in values if v is not None]
    return np.array(present) if len(present) == len(values) else None


def _fixed(
    robot: Robot, stamps: NDArray[np.int64], samples: list[JointSample], wrenches: list[Any]
) -> Array | None:
    """The wrench nearest to each joint state, rotated into fixed axes, shape (samples, 6)."""
    if not wrenches:
        return None
    wrenches.sort(key=lambda wrench: wrench[0])
    at = np.array([w[0] for w in wrenches], np.int64)
    right = np.clip(np.searchsorted(at, stamps), 1, max(1, len(at) - 1))
    right = np.minimum(right, len(at) - 1)
    left = np.maximum(right - 1, 0)
    nearest = np.where(np.abs(at[left] - stamps) <= np.abs(at[right] - stamps), left, right)
    values = np.array([w[2] for w in wrenches])[nearest]
    rotation = robot.rotation(robot.forward(np.array([s.q for s in samples])))
    moving = np.array([w[1] != BASE_FRAME for w in wrenches])[nearest]
    rotation = np.where(moving[:, None, None], rotation, np.eye(3))
    return np.concatenate(
        [np.einsum("nij,nj->ni", rotation, values[:, k : k + 3]) for k in (0, 3)], axis=1
    )
