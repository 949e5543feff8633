# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Write a robot's tree and its loops as an SDF model; the same tree gives the same bytes.

SDF has graphs of joints, so that ordinary joints close loops. The model stands at home: every frame
is parallel to the base there, and a joint's position counts from home.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Sequence
from typing import Final

import numpy as np

from pkm_twin.codegen.arrays import Array
from pkm_twin.machine import urdf_xml
from pkm_twin.machine.loop_tree import Capsule, Link, LoopTree, SingleAxisJoint, split_freedoms
from pkm_twin.machine.rotations import Pose
from pkm_twin.machine.urdf_write import GROUND, PLATFORM, number_text, rpy_along

MIN_RELATIVE_MASS: Final = 1e-6
"""Mass of a link that has none, relative to the machine's; inertia added about every axis, relative to
the body's. SDF takes no zeros, and simulators nothing much smaller."""
KINDS: Final = {
    "fixed": "fixed",
    "revolute": "revolute",
    "prismatic": "prismatic",
    "universal": "universal",
    "spherical": "ball",
    "helical": "screw",
}
"""Types of joints that SDF has; other types are written as several joints with small links between."""


def write_sdf(tree: LoopTree) -> str:
    """Write the SDF of a tree with its closures as joints.

    ``base_link`` is fixed to the world; the frame ``platform`` stands on the reference point.
    """
    top = ET.Element("sdf", version="1.9")
    model = ET.SubElement(top, "model", name=tree.name)
    links, joints = dict(tree.links), [*tree.joints.values(), *tree.closures]
    ends = {one.joint.name: one[1:] for one in tree.tree_joints}
    rows: list[tuple[str, str, str, str, Array, Sequence[SingleAxisJoint]]] = []
    for joint in joints:
        parent, child = ends.get(joint.name, (joint.inner, joint.outer))
        row = split_freedoms(joint, parent, child, {PLATFORM, *links})
        if joint.kind in KINDS:
            rows.append((joint.name, KINDS[joint.kind], parent, child, joint.at, row))
            continue
        for part in row:
            links.setdefault(part.child, Link(part.child, Pose(position=joint.at), com=joint.at))
            rows.append((part.name, part.kind, part.parent, part.child, joint.at, [part]))
    taken = {name for name, *_ in rows} | {PLATFORM}
    names = {name: urdf_xml.free_name(name, taken, "_link") for name in links}
    mass = MIN_RELATIVE_MASS * (sum(link.mass for link in tree.links.values()) or 1.0)
    inertia = mass * max(1e-3, *(float(np.abs(joint.at - tree.origin).max()) for joint in joints)) ** 2
    for link in links.values():
        bars = [bar for bar in tree.capsules if bar.link == link.name]
        _write_link(ET.SubElement(model, "link", name=names[link.name]), link, bars, mass, inertia)
    frame = ET.SubElement(model, "frame", name=PLATFORM, attached_to=names[tree.platform])
    _write_pose(frame, tree.origin)
    hold = ET.SubElement(model, "joint", name="world_fixed", type="fixed")
    ET.SubElement(hold, "parent").text = "world"
    ET.SubElement(hold, "child").text = names[GROUND]
    for name, kind, parent, child, at, parts in rows:
        element = ET.SubElement(model, "joint", name=name, type=kind)
        _write_pose(element, at)
        ET.SubElement(element, "parent").text = names[parent]
        ET.SubElement(element, "child").text = names[child]
        count = 0 if kind in ("fixed", "ball") else 1 if kind == "screw" else len(parts)
        for tag, part in zip(("axis", "axis2"), parts[:count], strict=False):
            axis, joint = ET.SubElement(element, tag), part.joint
            limits = joint.limits if part.is_only_freedom else {}
            ET.SubElement(axis, "xyz").text = number_text(part.axis)
            limit = ET.SubElement(axis, "limit")
            # SDF's number for no limit; positions count from home.
            low, high = limits.get("position", (-1e16, 1e16))
            shift = part.home if "position" in limits else 0.0
            ET.SubElement(limit, "lower").text = number_text([low - shift])
            ET.SubElement(limit, "upper").text = number_text([high - shift])
            for key in ("effort", "velocity"):
                if key in limits:
                    ET.SubElement(limit, key).text = number_text([limits[key]])
            if part.is_only_freedom and (joint.viscous or joint.coulomb):
                dynamics = ET.SubElement(axis, "dynamics")
                ET.SubElement(dynamics, "damping").text = number_text([joint.viscous])
                ET.SubElement(dynamics, "friction").text = number_text([joint.coulomb])
        if kind == "screw":
            # rad/m, positive for a left-handed thread.
            ET.SubElement(element, "thread_pitch").text = number_text([-1.0 / parts[0].joint.pitch])
    for name in tree.actuated:
        # The plugin that lets a joint be driven, and marks it as actuated.
        plugin = {"filename": "gz-sim-apply-joint-force-system", "name": "gz::sim::systems::ApplyJointForce"}
        ET.SubElement(ET.SubElement(model, "plugin", plugin), "joint_name").text = name
    ET.indent(top)
    return f'<?xml version="1.0"?>\n{ET.tostring(top, encoding="unicode")}\n'


def _write_link(link: ET.Element, body: Link, bars: Sequence[Capsule], mass: float, least: float) -> None:
    """Write inertia and bars; ``mass``, ``least``: mass and inertia of a link without any."""
    place = body.frame.position
    _write_pose(link, place)
    inertia = body.inertia + np.eye(3) * (MIN_RELATIVE_MASS * float(np.trace(body.inertia)) or least)
    inertial = ET.SubElement(link, "inertial")
    _write_pose(inertial, body.com - place, "")
    ET.SubElement(inertial, "mass").text = f"{body.mass or mass:.15g}"
    matrix = ET.SubElement(inertial, "inertia")
    for i, k in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)):
        ET.SubElement(matrix, f"i{'xyz'[i]}{'xyz'[k]}").text = number_text([inertia[i, k]], 1e-18)
    for number, bar in enumerate(bars):
        visual = ET.SubElement(link, "visual", name=f"bar_{number}")
        along = bar.end - bar.start
        length = float(np.linalg.norm(along))
        middle = number_text((bar.start + bar.end) / 2 - place)
        geometry = ET.SubElement(visual, "geometry")
        turn = rpy_along(along / length) if length > 0.0 else "0 0 0"
        ET.SubElement(visual, "pose").text = f"{middle} {turn}"
        shape = ET.SubElement(geometry, "capsule" if length > 0.0 else "sphere")
        if length > 0.0:
            ET.SubElement(shape, "length").text = number_text([length])
        ET.SubElement(shape, "radius").text = number_text([bar.radius])


def _write_pose(parent: ET.Element, place: Array, relative: str = "__model__") -> None:
    pose = ET.SubElement(parent, "pose", {"relative_to": relative} if relative else {})
    pose.text = f"{number_text(place)} 0 0 0"
