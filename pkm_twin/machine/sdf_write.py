# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""A robot's tree and its loops as an SDF model, byte for byte the same.

SDF has graphs of joints, so that a loop is closed by a joint as any other. The model stands at
home: every frame is parallel to the base there, and a joint's position counts from home.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Sequence
from typing import Final

import numpy as np

from pkm_twin.codegen.arrays import Array
from pkm_twin.machine import urdf_xml
from pkm_twin.machine.loop_tree import Capsule, Joint, Link, LoopTree, Single, singles
from pkm_twin.machine.rotations import Pose
from pkm_twin.machine.urdf_write import GROUND, PLATFORM, number_text, rpy_along

VERSION: Final = "1.9"
SMALL: Final = 1e-6
"""Mass of a link that has none, part of the machine's; inertia added about every axis, part of the
body's. SDF takes no zeros, and simulators nothing much smaller."""
ENDLESS: Final = 1e16
"""A limit that is none."""
MOTOR: Final = {"filename": "gz-sim-apply-joint-force-system", "name": "gz::sim::systems::ApplyJointForce"}
"""The plugin that lets a joint be driven, and marks it as actuated."""
KINDS: Final = {
    "fixed": "fixed",
    "revolute": "revolute",
    "prismatic": "prismatic",
    "universal": "universal",
    "spherical": "ball",
    "helical": "screw",
}
"""Types of joints that SDF has; the others are several, with small links between them."""


def write_sdf(tree: LoopTree) -> str:
    """Write the SDF of a tree with its closures as joints.

    ``base_link`` is fixed to the world; the frame ``platform`` stands on the reference point.
    """
    return _Writer(tree).text()


class _Writer:
    def __init__(self, tree: LoopTree) -> None:
        self.tree, self.links = tree, dict(tree.links)
        joints = [*tree.joints.values(), *tree.closures]
        total = sum(link.mass for link in tree.links.values()) or 1.0
        size = max(float(np.abs(joint.at - tree.origin).max()) for joint in joints)
        self.least = SMALL * total, SMALL * total * max(size, 1e-3) ** 2
        self.top = ET.Element("sdf", version=VERSION)
        self.model = ET.SubElement(self.top, "model", name=tree.name)
        self.joints: list[tuple[str, str, str, str, Array, Sequence[Single]]] = []
        ends = {one.joint.name: one[1:] for one in tree.hung}
        for joint in joints:
            self._add(joint, *ends.get(joint.name, (joint.inner, joint.outer)))
        taken = {name for name, *_ in self.joints} | {PLATFORM}
        self.names = {name: urdf_xml.free_name(name, taken, "_link") for name in self.links}

    def _add(self, joint: Joint, parent: str, child: str) -> None:
        """One joint where SDF has the type, else several with small links between them."""
        row = singles(joint, parent, child, {PLATFORM, *self.links})
        if joint.kind in KINDS:
            self.joints.append((joint.name, KINDS[joint.kind], parent, child, joint.at, row))
            return
        for part in row:
            self.links.setdefault(part.child, Link(part.child, Pose(position=joint.at), com=joint.at))
            self.joints.append((part.name, part.kind, *part[3:5], joint.at, [part]))

    def text(self) -> str:
        """Return the file's text."""
        for link in self.links.values():
            self._link(link)
        frame = ET.SubElement(self.model, "frame", name=PLATFORM, attached_to=self.names[self.tree.platform])
        _pose(frame, self.tree.origin)
        hold = ET.SubElement(self.model, "joint", name="world_fixed", type="fixed")
        ET.SubElement(hold, "parent").text = "world"
        ET.SubElement(hold, "child").text = self.names[GROUND]
        for joint in self.joints:
            self._joint(*joint)
        for name in self.tree.actuated:
            motor = ET.SubElement(self.model, "plugin", MOTOR)
            ET.SubElement(motor, "joint_name").text = name
        ET.indent(self.top)
        text = ET.tostring(self.top, encoding="unicode")
        return f'<?xml version="1.0"?>\n{text}\n'

    def _link(self, body: Link) -> None:
        place = body.frame.position
        link = ET.SubElement(self.model, "link", name=self.names[body.name])
        _pose(link, place)
        mass, least = self.least
        inertia = body.inertia + np.eye(3) * (SMALL * float(np.trace(body.inertia)) or least)
        inertial = ET.SubElement(link, "inertial")
        _pose(inertial, body.com - place, "")
        ET.SubElement(inertial, "mass").text = f"{body.mass or mass:.15g}"
        matrix = ET.SubElement(inertial, "inertia")
        for i, k in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)):
            value = number_text([inertia[i, k]], 1e-18)
            ET.SubElement(matrix, f"i{'xyz'[i]}{'xyz'[k]}").text = value
        bars = [bar for bar in self.tree.capsules if bar.link == body.name]
        for k, bar in enumerate(bars):
            _visual(link, f"bar_{k}", bar, place)

    def _joint(self, name: str, kind: str, parent: str, child: str, at: Array, row: Sequence[Single]) -> None:
        element = ET.SubElement(self.model, "joint", name=name, type=kind)
        _pose(element, at)
        ET.SubElement(element, "parent").text = self.names[parent]
        ET.SubElement(element, "child").text = self.names[child]
        if kind in ("fixed", "ball"):
            return
        for tag, part in zip(("axis", "axis2"), row[:1] if kind == "screw" else row, strict=False):
            _axis(ET.SubElement(element, tag), part)
        if kind == "screw":
            # rad/m, positive of a left-handed thread.
            pitch = number_text([-1.0 / row[0].joint.pitch])
            ET.SubElement(element, "thread_pitch").text = pitch


def _pose(parent: ET.Element, place: Array, relative: str = "__model__") -> None:
    pose = ET.SubElement(parent, "pose")
    if relative:
        pose.set("relative_to", relative)
    pose.text = f"{number_text(place)} 0 0 0"


def _axis(axis: ET.Element, part: Single) -> None:
    joint, limits = part.joint, part.joint.limits if part.whole else {}
    ET.SubElement(axis, "xyz").text = number_text(part.axis)
    limit = ET.SubElement(axis, "limit")
    low, high = limits.get("position", (-ENDLESS, ENDLESS))
    shift = part.home if "position" in limits else 0.0
    ET.SubElement(limit, "lower").text = number_text([low - shift])
    ET.SubElement(limit, "upper").text = number_text([high - shift])
    for tag in ("effort", "velocity"):
        if tag in limits:
            ET.SubElement(limit, tag).text = number_text([limits[tag]])
    if part.whole and (joint.viscous or joint.coulomb):
        dynamics = ET.SubElement(axis, "dynamics")
        ET.SubElement(dynamics, "damping").text = number_text([joint.viscous])
        ET.SubElement(dynamics, "friction").text = number_text([joint.coulomb])


def _visual(link: ET.Element, name: str, bar: Capsule, place: Array) -> None:
    visual = ET.SubElement(link, "visual", name=name)
    along = bar.end - bar.start
    length = float(np.linalg.norm(along))
    middle = number_text((bar.start + bar.end) / 2 - place)
    geometry = ET.SubElement(visual, "geometry")
    if length > 0.0:
        ET.SubElement(visual, "pose").text = f"{middle} {rpy_along(along / length)}"
        shape = ET.SubElement(geometry, "capsule")
        ET.SubElement(shape, "length").text = number_text([length])
    else:
        ET.SubElement(visual, "pose").text = f"{middle} 0 0 0"
        shape = ET.SubElement(geometry, "sphere")
    ET.SubElement(shape, "radius").text = number_text([bar.radius])
