# SPDX-License-Identifier: Apache-2.0
"""What closes a URDF's loops, in the three ways that people write it.

``<constraint>`` elements (urdfdom pull request 264), ``<loop>`` elements (Chignoli, Slotine,
Wensing, Kim 2024, URDF+, arXiv:2411.19753), pairs of frames in a YAML file (Batto, De Matteis,
Mansard 2025, Extended URDF, arXiv:2504.04767).
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from collections import ChainMap
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from typing import Any, Final

from pkm_twin.codegen.arrays import Array
from pkm_twin.errors import ParameterError, UnknownNameError
from pkm_twin.machine import urdf_xml
from pkm_twin.machine.joints import TYPES
from pkm_twin.machine.loop_tree import Closure
from pkm_twin.machine.urdf_xml import Pose

CONSTRAINTS: Final = {
    **{name: name for name, kind in TYPES.items() if not kind.threaded()},
    "continuous": "revolute",
    "link": "fixed",  # a link that was cut in two
}
PARTS: Final = (
    "parent",
    "parent_origin",
    "parent_axis",
    "child",
    "child_origin",
    "child_axis",
    "dynamics",
)
LOOPS: Final = {
    name: CONSTRAINTS[name]
    for name in ("revolute", "continuous", "prismatic", "fixed", "spherical")
}


def closures(
    robot: ET.Element, beside: Mapping[str, Any], links: Collection[str], joints: Mapping[str, str]
) -> dict[str, Closure]:
    """All closures of a robot by name.

    :param beside: the YAML file's entries.
    :param joints: the joints' names, each with its child link.
    :raises ParameterError: an element that is refused, by name.
    """
    found: dict[str, Closure] = {}
    taken = ChainMap[str, Any](found, dict(joints))
    for element in robot.findall("constraint"):
        name = urdf_xml.name(element, taken)
        found[name] = _constraint(element, name, links)
    for element in robot.findall("loop"):
        name = urdf_xml.name(element, taken)
        found[name] = _loop(element, name, links)
    for closure in _pairs(beside, links, joints):
        if closure.name in joints or closure.name in found:
            raise ParameterError("closed_loop", closure.name, "each pair once")
        found[closure.name] = closure
    return found


def _constraint(element: ET.Element, name: str, links: Collection[str]) -> Closure:
    where = f"constraint.{name}"
    kind = (element.get("type") or "").removesuffix("_joint")
    if kind not in CONSTRAINTS:
        raise UnknownNameError(f"{where}.type", element.get("type"), CONSTRAINTS)
    urdf_xml.only(element, where, PARTS)
    for end in ("parent", "child"):
        urdf_xml.only(urdf_xml.single(element, end, where), f"{where}.{end}", ())
    ends = tuple(
        urdf_xml.reference(element.find(e), f"{where}.{e}", links) for e in ("parent", "child")
    )
    frames = tuple(
        urdf_xml.origin(urdf_xml.single(element, f"{e}_origin", where), f"{where}.{e}_origin")
        for e in ("parent", "child")
    )
    parent = urdf_xml.axis(element, "parent_axis", where)
    # The child's axis is the parent's where the two frames meet, unless it is given.
    alone = kind != "universal" and element.find("child_axis") is None
    child = parent if alone else urdf_xml.axis(element, "child_axis", where)
    viscous, coulomb = urdf_xml.friction(element, where)
    closure = _closure(name, CONSTRAINTS[kind], ends, frames, (parent, child))
    angle = urdf_xml.number(element.get("angle", repr(math.pi / 2)), f"{where}.angle")
    cosine = math.cos(angle) if "angle" in element.attrib and kind == "universal" else 0.0
    return replace(closure, viscous=viscous, coulomb=coulomb, cosine=cosine)


def _loop(element: ET.Element, name: str, links: Collection[str]) -> Closure:
    where = f"loop.{name}"
    kind = element.get("type")
    if kind not in LOOPS:
        raise UnknownNameError(f"{where}.type", kind, LOOPS)
    urdf_xml.only(element, where, ("predecessor", "successor", "sucessor", "axis"))
    ends, frames = [], []
    for tags in (("predecessor",), ("successor", "sucessor")):
        stated = [e for tag in tags if (e := urdf_xml.single(element, tag, where)) is not None]
        if len(stated) > 1:
            raise ParameterError(f"{where}.{tags[0]}", f"{len(stated)} elements", "one")
        end = stated[0] if stated else None
        urdf_xml.only(end, f"{where}.{tags[0]}", ("origin",))
        ends.append(urdf_xml.reference(end, f"{where}.{tags[0]}", links))
        origin = None if end is None else urdf_xml.single(end, "origin", f"{where}.{tags[0]}")
        frames.append(urdf_xml.origin(origin, f"{where}.{tags[0]}"))
    axis = urdf_xml.axis(element, "axis", where)
    return _closure(name, LOOPS[kind], ends, frames, (axis, axis))


def _pairs(
    beside: Mapping[str, Any], links: Collection[str], joints: Mapping[str, str]
) -> list[Closure]:
    """The closures of the YAML file: two frames that meet whole (6d) or in their origins (3d)."""
    pairs = beside.get("closed_loop", [])
    kinds = beside.get("type", ["6d"] * len(pairs))
    if len(kinds) != len(pairs):
        raise ParameterError("type", kinds, f"{len(pairs)}, one per pair in closed_loop")
    closures = []
    for i, (pair, kind) in enumerate(zip(pairs, kinds, strict=True)):
        if not isinstance(pair, list) or len(pair) != 2:
            raise ParameterError(f"closed_loop[{i}]", pair, "a pair of frame names")
        types = {"6d": "fixed", "3d": "spherical"}
        if str(kind).lower() not in types:
            raise UnknownNameError(f"type[{i}]", kind, types)
        # A joint's frame moves with its child, so that the child link's frame is the same.
        known = [*links, *joints]
        found = [urdf_xml.known_link(f"closed_loop[{i}]", name, known) for name in pair]
        ends = [joints.get(name, name) for name in found]
        closures.append(
            _closure("_".join(pair), types[str(kind).lower()], ends, (Pose(), Pose()), None)
        )
    return closures


def _closure(
    name: str,
    kind: str,
    links: Sequence[str],
    frames: Sequence[Pose],
    axes: tuple[Array, Array] | None,
) -> Closure:
    if links[0] == links[1]:
        raise ParameterError(name, links[0], "a closure between two links")
    axes = axes if TYPES[kind].count else None
    return Closure(name, kind, (links[0], links[1]), (frames[0], frames[1]), axes)
