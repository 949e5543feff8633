# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Find the actuated joints of a file, and the names and numbers that a controller has for them.

A joint for which the controller has a name or numbers of its own stands twice. The joint of the
tree has the model's numbers. The drive has the controller's name and numbers: a joint with a link
without mass, ``<limit>`` and the joint of ``<ros2_control>``. The joint of the tree follows it
through ``<mimic>``. So whoever reads the controller's joint states, as robot_state_publisher does,
places the machine's links where they are.
"""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

from pkm_twin.errors import ParameterError, UnknownNameError, warn_of_file
from pkm_twin.machine import urdf_xml
from pkm_twin.machine.loop_tree import Fault, Joint
from pkm_twin.machine.strict_yaml import read_yaml
from pkm_twin.machine.urdf_xml import UNLIMITED

MODEL: Final = "_model"
"""Suffix of a joint of the tree whose own name is the controller's name of a drive."""
ACTUATION_MARKS: Final = ("ros2_control", "transmission", "independent", "plugin")
"""What marks actuated joints after a YAML file's name_mot: the first that names any counts."""
ACTUATED_OPTION: Final = "`actuated=[...]` or --actuated"
"""Words of errors for the ways to name the actuated joints."""
UNCOUPLED_JOINTS: Final = "joints without coupling; a base and a platform (--base) can leave them out"
"""What is expected in place of joints that follow others."""


def read_companion_yaml(path: Path) -> dict[str, Any]:
    """Read the YAML file of the same name if it has closures or motors; else return nothing."""
    keys = ("closed_loop", "type", "name_mot", "joint_name", "joint_type")
    for suffix in (".yaml", ".yml"):
        other = path.with_suffix(suffix)
        # An empty file is the target of a conversion that reads this URDF.
        if not other.is_file() or other.stat().st_size == 0:
            continue
        data = read_yaml(other)
        if not any(key in data for key in keys):
            continue
        for key in keys:
            if not isinstance(data.get(key, []), list):
                raise ParameterError(f"{other}: {key}", data[key], "a list")
        return {key: data[key] for key in keys if data.get(key)}
    return {}


def list_marked_joints(top: ET.Element, mark: str) -> list[str]:
    """List the joints that are actuated by one of :data:`ACTUATION_MARKS`, in the order of the file."""
    if mark == "plugin":
        moving = re.compile(r"(ApplyJointForce|Joint(Position|Trajectory|Force)?Controller)$")
        plugins = [plugin for plugin in top.iter("plugin") if moving.search(plugin.get("name") or "")]
        names = [(joint.text or "").strip() for plugin in plugins for joint in plugin.findall("joint_name")]
        return list(dict.fromkeys(names))
    if mark == "independent":
        joints = [
            joint
            for joint in top.findall("joint")
            if urdf_xml.parse_boolean(joint.get("independent", "false"), f"joint.{joint.get('name')}.independent")
        ]
    else:
        joints = [joint for owner in top.iter(mark) for joint in owner.findall("joint")]
    if mark == "ros2_control":
        joints = [joint for joint in joints if joint.find("command_interface") is not None]
    names = [urdf_xml.read_name(joint, ()) for joint in joints]
    # A joint may have several transmissions.
    return list(dict.fromkeys(names)) if mark == "transmission" else names


def find_marked(
    top: ET.Element, beside: Mapping[str, Any], others: Sequence[str] | None = None
) -> tuple[Sequence[str], str, str]:
    """Find the actuated joints of a URDF or an SDF, what marks them, and all possible marks in words.

    :param beside: the YAML file's entries. ``others``: joints of an SDF that have an effort limit, which
        are actuated if nothing is marked.
    """
    ways = (
        "a joint marked by a <command_interface> in <ros2_control>, a <transmission>, "
        'independent="true", a Gazebo plugin that moves it, or name_mot in a YAML file next to it'
    )
    ways += "" if others is None else "; or by an <effort> in its <limit>"
    if names := [str(name) for name in beside.get("name_mot", [])]:
        return names, "name_mot", ways
    for mark in ACTUATION_MARKS:
        if names := list_marked_joints(top, mark):
            return names, mark, ways
    return others or (), "limit.effort", ways


def list_actuated_joints(
    path: Path,
    types: Mapping[str, str],
    faults: list[Fault],
    chosen: Sequence[str] | None,
    find: Callable[[], tuple[Sequence[str], str, str]],
) -> tuple[tuple[str, ...], str]:
    """List the actuated joints in the order in which the file marks them, and what marks them.

    :param types: of all joints, by name. ``faults``: takes the error of a file that marks none.
    :param chosen: the actuated joints, in place of those that the file marks.
    :param find: returns the joints that the file marks, what marks them, and the possible marks in words.
    :raises ParameterError: a joint that cannot be actuated.
    """
    names, source, ways = find() if chosen is None else (chosen, "actuated", "")
    if chosen is None and not names:
        bound = f"{ways}; or joints that {ACTUATED_OPTION} names"
        faults.append(((), ParameterError(str(path), "no joint is marked as actuated", bound)))
        return (), ""
    if len(set(names)) != len(names) or not names:
        raise ParameterError(source, list(names), "one joint or more, each once")
    for name in names:
        if name not in types:
            raise UnknownNameError(source, name, types)
        if types[name] not in ("revolute", "prismatic", "helical"):
            raise ParameterError(f"{source}.{name}", types[name], "a revolute or prismatic joint")
    return tuple(names), source


def _command_bounds(joint: ET.Element) -> Iterator[tuple[str, ET.Element]]:
    """Iterate over the bounds that a joint of ``<ros2_control>`` has for commands, and their interfaces' names."""
    for interface in joint.findall("command_interface"):
        # As ros2_control: limits may be switched off, of all interfaces or of one.
        off = [part.get("enable", "true") for part in (*joint.findall("limits"), *interface.findall("limits"))]
        if not all(urdf_xml.parse_boolean(text, f"ros2_control.{joint.get('name')}.limits.enable") for text in off):
            continue
        for parameter in interface.findall("param"):
            if parameter.get("name") in ("min", "max"):
                yield interface.get("name", ""), parameter


def limit_commands(path: Path, top: ET.Element, joints: dict[str, Joint]) -> None:
    """Narrow the limits of joints, in place, to the bounds of their command interfaces in ``<ros2_control>``.

    As ros2_control does: the narrower of both counts, and of a velocity or an effort the smaller size.

    :raises ParameterError: a bound that is no number, or bounds that leave no position.
    """
    for element in top.findall(".//ros2_control/joint"):
        name = element.get("name", "")
        stated: dict[str, dict[str, str]] = {}
        for kind, parameter in _command_bounds(element):
            stated.setdefault(kind, {})[parameter.get("name", "")] = (parameter.text or "").strip()
        for kind, bounds in stated.items():
            if kind not in ("position", "velocity", "effort"):
                warn_of_file(
                    path, f"ros2_control.{name}: {', '.join(bounds)} of the command interface {kind} is not read"
                )
                continue
            where = f"ros2_control.{name}.{kind}"
            if name not in joints:
                raise UnknownNameError(f"ros2_control.{name}", name, joints)
            low, high = (
                urdf_xml.parse_limit(bounds.get(key, default), f"{where}.{key}")
                for key, default in (("min", "-inf"), ("max", "inf"))
            )
            limits = dict(joints[name].limits)
            if kind == "position":
                far = UNLIMITED["prismatic" if joints[name].kind == "prismatic" else "revolute"]
                first, last = limits.get(kind, (-far, far))
                first, last = max(first, low), min(last, high)
                if -far < first or last < far:
                    limits[kind] = [first, last]
            else:
                first, last = 0.0, min(abs(low), abs(high), limits.get(kind, UNLIMITED[kind]))
                if last < UNLIMITED[kind]:
                    limits[kind] = last
            if not (low < high and first < last):
                raise ParameterError(where, [low, high], f"a range that leaves some of the joint's {kind}")
            joints[name] = replace(joints[name], limits=limits)


@dataclass(frozen=True)
class Control:
    """A drive: the controller's position is offset + factor times the position of ``joint``."""

    name: str
    joint: str
    factor: float
    offset: float

    @property
    def matches_model(self) -> bool:
        """True if the controller has the same name and numbers as the model."""
        return self == Control(self.joint, self.joint, factor=1.0, offset=0.0)

    def value(self, key: str, model: float) -> float:
        """Return the controller's number of a parameter of a joint in ``<ros2_control>``."""
        power = {"rotor_inertia": 2, "friction_offset": 1}
        if key in power:
            return model / self.factor ** power[key]
        return self.offset + self.factor * model

    def limits(self, model: Mapping[str, Any], kind: str) -> dict[str, Any]:
        """Convert all limits of a joint to the controller's."""
        size, most = abs(self.factor), UNLIMITED[kind]
        velocity, effort = (model.get(key, UNLIMITED[key]) for key in ("velocity", "effort"))
        ends = [self.value("", end) for end in model.get("position", (-most, most))]
        return {"position": sorted(ends), "velocity": size * velocity, "effort": effort / size}

    def inverse(self) -> Control:
        """Return the conversion from the controller's numbers to the model's."""
        return Control(self.joint, self.name, 1.0 / self.factor, -self.offset / self.factor)


def tree_names(joints: Iterable[str], controls: Iterable[Control]) -> dict[str, str]:
    """Return the names that joints of the tree have in a URDF with these drives."""
    names = list(joints)
    drives = {control.name for control in controls if not control.matches_model}
    taken = drives.union(names)
    return {name: urdf_xml.free_name(name + MODEL, taken, MODEL) if name in drives else name for name in names}


def convert_drives(robot: ET.Element) -> dict[str, dict[str, Any]]:
    """Convert a controller's URDF to the model's numbers, in place; return entries of a joint map.

    Other ``<mimic>`` elements stay.
    """
    joints = {joint.get("name", ""): joint for joint in robot.findall("joint")}
    commanded = list_marked_joints(robot, "ros2_control")
    parents = {_read_end(joint, "parent") for joint in joints.values()}
    links = {link.get("name", ""): link for link in robot.findall("link")}
    followers: dict[str, list[ET.Element]] = {}
    for joint in joints.values():
        if (mimic := joint.find("mimic")) is not None:
            followers.setdefault(mimic.get("joint", ""), []).append(joint)
    found: dict[str, Control] = {}
    for name, drive in joints.items():
        link, (joint, *others) = _read_end(drive, "child"), followers.get(name, [drive])
        alone = link in links and not len(links[link]) and link not in parents
        if joint is drive or others or not alone or name not in commanded:
            continue
        mimic = joint.find("mimic")
        assert mimic is not None  # noqa: S101
        where = f"joint.{joint.get('name')}.mimic"
        back = Control(
            joint.get("name", ""),
            name,
            urdf_xml.parse_number(mimic.get("multiplier", "1"), f"{where}.multiplier"),
            urdf_xml.parse_number(mimic.get("offset", "0"), f"{where}.offset"),
        )
        if not back.factor:
            continue
        robot.remove(drive)
        robot.remove(links[link])
        joint.remove(mimic)
        found[name] = back
    own, taken = dict[str, str](), set(joints) - set(found)
    for name, back in found.items():
        plain = back.name.removesuffix(MODEL)
        own[name] = back.name if plain in taken else plain
        joints[back.name].set("name", own[name])
    for joint in robot.findall("ros2_control/joint"):
        name = joint.get("name", "")
        for kind, parameter in _command_bounds(joint) if name in found else ():
            back, key = found[name], parameter.get("name", "")
            value = urdf_xml.parse_limit((parameter.text or "").strip(), f"ros2_control.{name}.{kind}.{key}")
            made = {"effort": value / back.factor, "velocity": back.factor * value}
            parameter.text = f"{made.get(kind, back.value('', value)):.14g}"
            if back.factor < 0.0:
                parameter.set("name", "min" if key == "max" else "max")
        for parameter in joint.iter("param") if name in found else ():
            key = parameter.get("name", "")
            if key in ("initial_value", "rotor_inertia", "friction_offset"):
                value = urdf_xml.parse_number((parameter.text or "").strip(), f"ros2_control.{name}.{key}")
                parameter.text = f"{found[name].value(key, value):.14g}"
        joint.set("name", own.get(name, name))
    entries = {}
    for name, back in found.items():
        control = back.inverse()
        sign = -1.0 if control.factor < 0.0 else 1.0
        entry = {"sign": sign, "ratio": abs(control.factor), "offset": control.offset + 0.0}
        entries[own[name]] = ({} if own[name] == name else {"name": name}) | entry
    return entries


def _read_end(joint: ET.Element, tag: str) -> str:
    end = joint.find(tag)
    return "" if end is None else end.get("link", "")
