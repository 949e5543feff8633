# SPDX-License-Identifier: Apache-2.0
"""Which joints of a URDF or an SDF are actuated, and the YAML file next to it that may say so."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from pkm_twin.errors import ParameterError, UnknownNameError
from pkm_twin.machine import urdf_xml
from pkm_twin.machine.strict_yaml import read_yaml

BESIDE: Final = ("closed_loop", "type", "name_mot", "joint_name", "joint_type")
"""What a YAML file beside a description can say."""
DRIVEN: Final = re.compile(r"(ApplyJointForce|Joint(Position|Trajectory|Force)?Controller)$")
"""Names of Gazebo's plugins that move the joints they name."""
WHERE: Final = (
    "command interfaces in a <ros2_control> element, a <transmission>, a Gazebo plugin that moves "
    "a joint, or name_mot in a YAML file next to it"
)


def read_beside(path: Path) -> dict[str, Any]:
    """The YAML file of the same name, if it speaks of closures or motors, else nothing."""
    for suffix in (".yaml", ".yml"):
        other = path.with_suffix(suffix)
        # An empty one is the target of a conversion that reads this very URDF.
        if not other.is_file() or other.stat().st_size == 0:
            continue
        data = read_yaml(other)
        if not any(key in data for key in BESIDE):
            continue
        for key in BESIDE:
            if not isinstance(data.get(key, []), list):
                raise ParameterError(f"{other}: {key}", data[key], "a list")
        return {key: data[key] for key in BESIDE if data.get(key)}
    return {}


def _commanded(top: ET.Element) -> list[str]:
    return [
        urdf_xml.name(joint, ())
        for system in top.iter("ros2_control")
        for joint in system.findall("joint")
        if joint.find("command_interface") is not None
    ]


def _transmitted(top: ET.Element) -> list[str]:
    joints = [joint for one in top.iter("transmission") for joint in one.findall("joint")]
    return list(dict.fromkeys(urdf_xml.name(joint, ()) for joint in joints))


def _independent(top: ET.Element) -> list[str]:
    return [
        urdf_xml.name(joint, ())
        for joint in top.findall("joint")
        if urdf_xml.boolean(
            joint.get("independent", "false"), f"joint.{joint.get('name')}.independent"
        )
    ]


def _moved(top: ET.Element) -> list[str]:
    joints = [
        (joint.text or "").strip()
        for plugin in top.iter("plugin")
        if DRIVEN.search(plugin.get("name") or "")
        for joint in plugin.findall("joint_name")
    ]
    return list(dict.fromkeys(joints))


SOURCES: Final[Mapping[str, Callable[[ET.Element], list[str]]]] = {
    "ros2_control": _commanded,
    "transmission": _transmitted,
    "independent": _independent,
    "plugin": _moved,
}
"""What marks actuated joints after a YAML file's name_mot: the first that names any."""


def actuated_joints(
    path: Path,
    top: ET.Element,
    beside: Mapping[str, Any],
    types: Mapping[str, str],
    others: Sequence[str] = (),
) -> tuple[str, ...]:
    """The actuated joints in the order in which the file marks them.

    :param beside: the YAML file's entries. ``types``: of all joints, by name.
    :param others: joints that are taken where nothing is marked.
    :raises ParameterError: none is marked, or one that cannot be actuated.
    """
    names, source = [str(name) for name in beside.get("name_mot", [])], "name_mot"
    for key, marked in SOURCES.items():
        if not names:
            names, source = marked(top), key
    if not names:
        names, source = list(others), "limit.effort"
    if not names:
        raise ParameterError(str(path), "no actuated joint", WHERE)
    if len(set(names)) != len(names):
        raise ParameterError(source, names, "each joint once")
    for name in names:
        if name not in types:
            raise UnknownNameError(source, name, types)
        if types[name] not in ("revolute", "prismatic", "helical"):
            raise ParameterError(f"{source}.{name}", types[name], "a revolute or prismatic joint")
    return tuple(names)
