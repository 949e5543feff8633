# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Elements of URDF and SDF that act in a simulator and are not read, with those of Gazebo, Drake, Isaac Sim."""

from __future__ import annotations

import math
import re
import xml.etree.ElementTree as ET
from collections.abc import Iterable, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Final

from pkm_twin.errors import ParameterError, warn_of_file
from pkm_twin.machine import urdf_xml
from pkm_twin.machine.graph import group_connected
from pkm_twin.machine.loop_tree import Fault, Joint, Link

IGNORED: Final = {
    "spring_stiffness": "the spring",
    "springStiffness": "the spring",
    "velocity_decay": "damping by the link's velocity",
    "dampingFactor": "damping by velocity",
    "enable_wind": "wind",
    "drake:rotor_inertia": "the rotor inertia",
    "drake:gear_ratio": "the gear of the rotor",
}
"""Elements that are ignored with a warning unless they are zero or false, and their meaning."""
REJECTED: Final = {
    "kinematic": "links that forces move",
    "robot": "one <robot>",
    "world": "one <world> around the <model>",
    "coupling": "a machine without coupled joints",
    "force_element": "a machine without springs and dampers beside its joints",
    "gearbox_ratio": "joints without coupling",
    "mimic": "joints without coupling",
    "drake:mimic": "joints without coupling",
    "drake:joint": "joints and closures of the format alone",
    "drake:ball_constraint": "joints and closures of the format alone",
    "drake:distance_constraint": "joints and closures of the format alone",
    "drake:linear_bushing_rpy": "joints and closures of the format alone",
}
"""Elements that change the machine, and what is expected in their place."""


def check_elements(
    path: Path, parts: Iterable[ET.Element], owner: str = "", joints: Mapping[ET.Element, str] = MappingProxyType({})
) -> list[Fault]:
    """Reject elements that change the machine, or warn of those that are ignored, recursively.

    :param owner: path of the parent element, for the error.
    :param joints: names of joints by their elements. An error inside a joint is returned with the
        joints that it couples, because it does not concern a machine without them.
    :raises ParameterError: an element of :data:`REJECTED`, by name.
    """
    faults: list[Fault] = []
    for part in parts:
        tag, name = str(part.tag), part.get("name") or part.get("reference")
        if tag in ("visual", "collision"):
            continue
        where = ".".join(filter(None, (owner, tag, name)))
        if tag in REJECTED and _is_effective(part):
            raise ParameterError(where, f"<{tag}>", REJECTED[tag])
        if tag in IGNORED and _is_effective(part):
            warn_of_file(path, f"{where}: {IGNORED[tag]} is ignored")
        elif tag.partition(":")[0] in ("drake", "isaac") and owner:
            warn_of_file(path, f"{where} is not read")
        if tag == "plugin":
            plugin = f"{part.get('name', '')} {part.get('filename', '')}".strip()
            if "mimic" in plugin.lower():
                raise ParameterError("plugin", plugin, "joints without coupling")
            if re.search("Buoyancy|Hydrodynamics|LiftDrag|Thruster|Wind|Spring|GravityComp", plugin):
                warn_of_file(path, f"forces of the plugin {plugin} are ignored")
        try:
            faults += check_elements(path, part, f"{tag}.{name}" if name else owner, joints)
        except ParameterError as error:
            if part not in joints:
                raise
            scope = joints[part].removesuffix(str(name))
            leaders = [scope + one.get("joint", "") for one in part.iter() if "mimic" in str(one.tag).lower()]
            faults.append(((joints[part], *leaders), error))
    return faults


def _is_effective(part: ET.Element) -> bool:
    """Return whether an element states anything but zero or false."""
    stated = [part.text, *part.attrib.values(), *(e.text for e in part.iter() if e is not part)]
    words = [word for text in stated for word in (text or "").split()]
    for word in words:
        try:
            if float(word) != 0.0 or math.isnan(float(word)):
                return True
        except ValueError:
            if word.lower() != "false":
                return True
    return not words


def read_gravity(
    path: Path,
    weight: Mapping[str, bool],
    links: Mapping[str, Link],
    root: str,
    joints: Iterable[Joint],
    stated: list[float] | None,
) -> list[float] | None:
    """Return the stated gravity, or zero if it is switched off on every link that can move.

    :param weight: by link whether gravity acts on it. ``root``: the ground.
    :raises ParameterError: gravity is switched off on only some of these links.
    """
    bolts = [(joint.inner, joint.outer) for joint in joints if joint.kind == "fixed"]
    held = group_connected(dict.fromkeys([root, *weight]), bolts)[0]
    moving = [name for name in weight if name not in held and links[name].mass > 0.0]
    off = [name for name in moving if not weight[name]]
    if off and len(off) < len(moving):
        raise ParameterError(f"link.{off[0]}.gravity", "false", "all moving links alike")
    if not off:
        return stated
    warn_of_file(path, "gravity is switched off on every link that can move")
    return [0.0, 0.0, 0.0]


def read_flag(element: ET.Element, tag: str, default: bool) -> bool:
    """Read a boolean from a child element."""
    text = element.findtext(tag)
    where = element.get("name") or element.get("reference")
    return default if text is None else urdf_xml.parse_boolean(text, f"{where}.{tag}")
