# SPDX-License-Identifier: Apache-2.0
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
from pkm_twin.machine.simulated import hang, row_of
from pkm_twin.machine.urdf_write import (
    GROUND,
    PLATFORM,
    UrdfBody,
    UrdfCapsule,
    UrdfJoint,
    UrdfTree,
    number_text,
    rpy_along,
)

VERSION: Final = "1.9"
SMALL: Final = 1e-6
"""Mass of a link that has none, part of the machine's; inertia added about every axis, part of the
body's. SDF takes no zeros, and simulators nothing much smaller."""
ENDLESS: Final = 1e16
"""A limit that is none."""
MOTOR: Final = {
    "filename": "gz-sim-apply-joint-force-system", "name": "gz::sim::systems::ApplyJointForce"
}  # fmt: skip
"""The plugin that lets a joint be driven, and marks it as actuated."""
ONE: Final = {"revolute": "revolute", "prismatic": "prismatic"}


def write_sdf(tree: UrdfTree) -> str:
    """The SDF of a tree with its closures as joints.

    ``base_link`` is fixed to the world; the frame ``platform`` stands on the reference point.
    """
    return _Writer(tree).text()


class _Writer:
    def __init__(self, tree: UrdfTree) -> None:
        self.tree = tree
        total = sum(body.mass for body in tree.bodies) or 1.0
        size = max(float(np.abs(joint.point - tree.origin).max()) for joint in tree.joints)
        self.least = SMALL * total, SMALL * total * max(size, 1e-3) ** 2
        top = ET.Element("sdf", version=VERSION)
        self.top, self.model = top, ET.SubElement(top, "model", name=tree.name)
        rows = [(link.parent, link.name, link.joints) for link in hang(tree)]
        bodies = {body.name: body for body in tree.bodies}
        self.bodies: dict[str, UrdfBody] = {GROUND: self._empty(GROUND, np.zeros(3))}
        places = {link.name: link.place for link in hang(tree)} | {GROUND: np.zeros(3)}
        self.joints: list[tuple[str, str, str, str, Sequence[UrdfJoint]]] = []
        for parent, name, row in rows:
            self.bodies[name] = bodies[name]
            self._chain(parent, name, row, places)
        for closure in tree.closures:
            ends = closure.parent, closure.child
            if closure.type == "spherical":
                self.joints.append(
                    (closure.name, "ball", *ends, _ball(closure.name, closure.point))
                )
            else:
                self._chain(*ends, row_of(closure, *ends), places, closure.name)
        taken = {name for name, *_ in self.joints} | {PLATFORM}
        self.names = {name: urdf_xml.free_name(name, taken, "_link") for name in self.bodies}
        self.places = places

    def _empty(self, name: str, place: Array) -> UrdfBody:
        return UrdfBody(name, 0.0, place, np.zeros((3, 3)))

    def _chain(
        self, parent: str, child: str, row: Sequence[UrdfJoint], places: dict[str, Array],
        own: str = "",
    ) -> None:  # fmt: skip
        """One joint where SDF has the type, else several with small links between them."""
        kinds = "".join("P" if joint.type == "prismatic" else "R" for joint in row)
        together = all(np.array_equal(joint.point, row[0].point) for joint in row)
        stem = own or (row[0].name.rpartition("_")[0] if len(row) > 1 else "")
        single = {"": "fixed", "RR": "universal", "RRR": "ball"}.get(kinds, "")
        if single == "fixed":
            self.joints.append((own or f"{child}_fixed", "fixed", parent, child, row))
        elif single and together:
            self.joints.append((stem, single, parent, child, row))
        elif any(joint.name == slide for slide, *_ in self.tree.screws for joint in row):
            self.joints.append((row[0].name, "screw", parent, child, row))
        else:
            start = parent
            for joint in row:
                end = joint.child if joint is not row[-1] else child
                if joint is not row[-1]:
                    self.bodies[end] = self._empty(end, joint.point)
                    places[end] = joint.point
                self.joints.append((joint.name, ONE[joint.type], start, end, [joint]))
                start = end

    def text(self) -> str:
        """The file."""
        for name, body in self.bodies.items():
            self._link(name, body)
        frame = ET.SubElement(
            self.model, "frame", name=PLATFORM, attached_to=self.names[self.tree.platform]
        )
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

    def _link(self, name: str, body: UrdfBody) -> None:
        place = self.places[name]
        link = ET.SubElement(self.model, "link", name=self.names[name])
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
        bars = [bar for bar in self.tree.capsules if bar.body == name]
        for k, bar in enumerate(bars):
            _visual(link, f"bar_{k}", bar, place)

    def _joint(
        self, name: str, kind: str, parent: str, child: str, row: Sequence[UrdfJoint]
    ) -> None:
        element = ET.SubElement(self.model, "joint", name=name, type=kind)
        if row:
            _pose(element, row[0].point)
        ET.SubElement(element, "parent").text = self.names[parent]
        ET.SubElement(element, "child").text = self.names[child]
        if kind in ("fixed", "ball"):
            return
        shown = row[:1] if kind == "screw" else row
        for tag, joint in zip(("axis", "axis2"), shown, strict=False):
            _axis(ET.SubElement(element, tag), joint)
        for slide, _, pitch in self.tree.screws:
            if kind == "screw" and slide in [joint.name for joint in row]:
                # rad/m, positive of a left-handed thread.
                ET.SubElement(element, "thread_pitch").text = number_text([-1.0 / pitch])


def _ball(name: str, point: Array) -> list[UrdfJoint]:
    return [UrdfJoint(name, "revolute", "", "", point, np.zeros(3))]


def _pose(parent: ET.Element, place: Array, relative: str = "__model__") -> None:
    pose = ET.SubElement(parent, "pose")
    if relative:
        pose.set("relative_to", relative)
    pose.text = f"{number_text(place)} 0 0 0"


def _axis(axis: ET.Element, joint: UrdfJoint) -> None:
    drive = joint.drive
    ET.SubElement(axis, "xyz").text = number_text(joint.axis)
    limit = ET.SubElement(axis, "limit")
    low, high = drive.position or (-ENDLESS, ENDLESS)
    shift = joint.home if drive.position else 0.0
    ET.SubElement(limit, "lower").text = number_text([low - shift])
    ET.SubElement(limit, "upper").text = number_text([high - shift])
    for tag, value in (("effort", drive.effort), ("velocity", drive.velocity)):
        if value is not None:
            ET.SubElement(limit, tag).text = number_text([value])
    if drive.damping or drive.friction:
        dynamics = ET.SubElement(axis, "dynamics")
        ET.SubElement(dynamics, "damping").text = number_text([drive.damping])
        ET.SubElement(dynamics, "friction").text = number_text([drive.friction])


def _visual(link: ET.Element, name: str, bar: UrdfCapsule, place: Array) -> None:
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
