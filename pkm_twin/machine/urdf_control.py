# SPDX-License-Identifier: Apache-2.0
"""The joints of a controller in a URDF, where it has names or numbers of its own for them.

Such a joint stands twice. The joint of the tree has the model's numbers. The drive has the
controller's name and numbers: a joint with a link without mass, ``<limit>`` and the joint of
``<ros2_control>``. The joint of the tree follows it through ``<mimic>``. So whoever reads the
controller's joint states, as robot_state_publisher does, places the machine's links where they are.
"""

from __future__ import annotations

import copy
import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Final

from pkm_twin.machine import urdf_xml

MODEL: Final = "_model"
"""Behind the name of a joint of the tree whose own name is the controller's of a drive."""
DRIVE: Final = "_drive"
"""Behind the name of a drive: its link."""


@dataclass(frozen=True)
class Control:
    """A drive: the controller's position is offset + factor times the position of ``joint``."""

    name: str
    joint: str
    factor: float
    offset: float

    @property
    def same(self) -> bool:
        """Whether the controller has the model's name and numbers."""
        return self == Control(self.joint, self.joint, factor=1.0, offset=0.0)

    def value(self, key: str, model: float) -> float:
        """The controller's number of a parameter of a joint in ``<ros2_control>``."""
        power = {"rotor_inertia": 2, "friction_offset": 1}
        if key in power:
            return model / self.factor ** power[key]
        return self.offset + self.factor * model

    def inverse(self) -> Control:
        """From the controller's numbers to the model's."""
        return Control(self.joint, self.name, 1.0 / self.factor, -self.offset / self.factor)


def tree_names(joints: Iterable[str], controls: Iterable[Control]) -> dict[str, str]:
    """What the joints of the tree are called in a URDF with these drives."""
    names = list(joints)
    drives = {control.name for control in controls if not control.same}
    taken = drives.union(names)
    return {
        name: urdf_xml.free_name(name + MODEL, taken, MODEL) if name in drives else name
        for name in names
    }


def add_drives(robot: ET.Element, controls: Iterable[Control]) -> None:
    """Take a URDF in the model's numbers to one for a controller, in place.

    Joints whose control has their own name and numbers stay as they are.
    """
    changed = {c.joint: c for c in controls if not c.same}
    joints = {joint.get("name", ""): joint for joint in robot.findall("joint")}
    links = {link.get("name", "") for link in robot.findall("link")}
    _rename(robot, lambda name: changed[name].name if name in changed else name)
    for name, own in tree_names(joints, changed.values()).items():
        joints[name].set("name", own)
    for name, control in changed.items():
        joint = joints[name]
        link = urdf_xml.free_name(control.name + DRIVE, links)
        drive = ET.SubElement(robot, "joint", name=control.name, type=_kind(joint, control))
        parts = {child.tag: copy.deepcopy(child) for child in joint}
        drive.extend(parts[tag] for tag in ("origin", "parent"))
        ET.SubElement(drive, "child", link=link)
        drive.extend(parts[tag] for tag in ("axis", "limit"))
        _scale_limits(parts["limit"], control)
        ET.SubElement(robot, "link", name=link)
        back = control.inverse()
        numbers = {"multiplier": repr(back.factor), "offset": repr(back.offset + 0.0)}
        ET.SubElement(joint, "mimic", {"joint": control.name, **numbers})
    _convert(robot, {c.name: c for c in changed.values()})
    # The element of ros2_control stays the last one.
    for system in robot.findall("ros2_control"):
        robot.remove(system)
        robot.append(system)


def take_drives(robot: ET.Element) -> dict[str, dict[str, Any]]:
    """Take a URDF for a controller to one in the model's numbers, in place; entries of a joint map.

    Other ``<mimic>`` elements stay.
    """
    joints = {joint.get("name", ""): joint for joint in robot.findall("joint")}
    commanded = {
        joint.get("name", "")
        for joint in robot.findall("ros2_control/joint")
        if joint.find("command_interface") is not None
    }
    parents = {_end(joint, "parent") for joint in joints.values()}
    links = {link.get("name", ""): link for link in robot.findall("link")}
    followers: dict[str, list[ET.Element]] = {}
    for joint in joints.values():
        if (mimic := joint.find("mimic")) is not None:
            followers.setdefault(mimic.get("joint", ""), []).append(joint)
    found: dict[str, Control] = {}
    for name, drive in joints.items():
        link, (joint, *others) = _end(drive, "child"), followers.get(name, [drive])
        alone = link in links and not len(links[link]) and link not in parents
        if joint is drive or others or not alone or name not in commanded:
            continue
        mimic = joint.find("mimic")
        assert mimic is not None  # noqa: S101
        where = f"joint.{joint.get('name')}.mimic"
        back = Control(
            joint.get("name", ""),
            name,
            urdf_xml.number(mimic.get("multiplier", "1"), f"{where}.multiplier"),
            urdf_xml.number(mimic.get("offset", "0"), f"{where}.offset"),
        )
        if not back.factor:
            continue
        robot.remove(drive)
        robot.remove(links[link])
        joint.remove(mimic)
        found[name] = back
    _convert(robot, found)
    own = {name: back.name for name, back in found.items()}
    taken = set(joints) - set(found)
    for name, model in own.items():
        plain = model.removesuffix(MODEL)
        if plain not in taken:
            joints[model].set("name", plain)
            own[name] = plain
    _rename(robot, lambda name: own.get(name, name))
    entries = {}
    for name, back in found.items():
        control = back.inverse()
        sign = -1.0 if control.factor < 0.0 else 1.0
        entry = {"sign": sign, "ratio": abs(control.factor), "offset": control.offset + 0.0}
        entries[own[name]] = ({} if own[name] == name else {"name": name}) | entry
    return entries


def _end(joint: ET.Element, tag: str) -> str:
    end = joint.find(tag)
    return "" if end is None else end.get("link", "")


def _kind(joint: ET.Element, control: Control) -> str:
    """A motor that turns, or a slide where the controller counts the metres of one."""
    slides = joint.get("type") == "prismatic" and abs(control.factor) == 1.0
    return "prismatic" if slides else "revolute"


def _rename(robot: ET.Element, name_of: Callable[[str], str]) -> None:
    for joint in robot.findall("ros2_control/joint"):
        joint.set("name", name_of(joint.get("name", "")))


def _convert(robot: ET.Element, controls: Mapping[str, Control]) -> None:
    """Parameters of the joints in ``<ros2_control>``, by the names that these have."""
    for joint in robot.findall("ros2_control/joint"):
        control = controls.get(joint.get("name", ""))
        if control is None:
            continue
        for parameter in joint.iter("param"):
            key = parameter.get("name", "")
            if key in ("initial_value", "rotor_inertia", "friction_offset"):
                where = f"ros2_control.{joint.get('name')}.{key}"
                model = urdf_xml.number((parameter.text or "").strip(), where)
                parameter.text = f"{control.value(key, model):.14g}"


def _scale_limits(limit: ET.Element, control: Control) -> None:
    size = abs(control.factor)
    ends = sorted(control.value("", float(limit.get(end, "0"))) for end in ("lower", "upper"))
    values = {
        "lower": ends[0],
        "upper": ends[1],
        "velocity": size * float(limit.get("velocity", "0")),
        "effort": float(limit.get("effort", "0")) / size,
    }
    for key, value in values.items():
        limit.set(key, f"{value:.14g}")
