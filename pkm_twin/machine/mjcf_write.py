# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Write a robot's tree as an MJCF file; the same tree gives the same bytes.

The model stands at home as it is: every body's frame is parallel to the base there, ``ref`` of a
joint is its value at home. Loops are ``connect`` and ``weld`` constraints.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from pkm_twin.codegen.arrays import Array
from pkm_twin.machine.loop_tree import Link, LoopTree, SingleAxisJoint, TreeJoint, list_screws, split_freedoms
from pkm_twin.machine.urdf_write import GROUND, PLATFORM, number_text


def write_mjcf(tree: LoopTree, gravity: Array, efforts: Sequence[float] | None = None) -> str:
    """Write the MJCF of a tree.

    Actuators are motors named as their joints, in the robot's order; the site ``platform`` stands
    on the reference point.

    :param gravity: (3,) m/s2.
    :param efforts: of the actuators at the keyframe ``home``, shape (n,), N m or N.
    """
    timestep = 1e-3  # s
    tree, welds = _split_bodies(tree)
    top = ET.Element("mujoco", model=tree.name)
    ET.SubElement(top, "compiler", angle="radian", autolimits="true", inertiafromgeom="false")
    ET.SubElement(top, "option", gravity=number_text(gravity), timestep=number_text([timestep]), integrator="RK4")
    default = ET.SubElement(top, "default")
    ET.SubElement(default, "geom", contype="0", conaffinity="0", group="1", rgba="0.6 0.65 0.7 1")
    # Constraints: as stiff as the time step allows, critically damped, and an impedance near 1.
    solref, solimp = number_text([2.0 * timestep, 1.0]), number_text([0.9999, 0.9999, 0.001])
    ET.SubElement(default, "equality", solref=solref, solimp=solimp)
    elements = {GROUND: ET.SubElement(top, "worldbody")}
    places = {GROUND: np.zeros(3)}
    home: list[float] = []
    parts: list[SingleAxisJoint] = []
    for parent, child, row in list_bodies(tree):
        link = tree.links[child]
        place = row[0].joint.at if row else link.frame.position
        elements[child] = _write_body(elements[parent], link, place, places[parent])
        places[child] = place
        for part in row:
            ET.SubElement(elements[child], "joint", _write_joint(part, place))
            home.append(part.home)
        parts += row
    for capsule in tree.capsules:
        if capsule.link in elements:
            element, (start, end) = elements[capsule.link], (capsule.start, capsule.end) - places[capsule.link]
            size = number_text([capsule.radius])
            if np.linalg.norm(capsule.end - capsule.start) > 0.0:
                ET.SubElement(element, "geom", type="capsule", fromto=number_text([*start, *end]), size=size)
            else:
                ET.SubElement(element, "geom", type="sphere", pos=number_text(start), size=size)
    at = number_text(tree.origin - places[tree.platform])
    ET.SubElement(elements[tree.platform], "site", name=PLATFORM, pos=at, size="0.005")
    loops = ET.SubElement(top, "equality")
    for closure in tree.closures:
        ends = {"body1": closure.inner, "body2": closure.outer}
        ends = {key: "world" if name == GROUND else name for key, name in ends.items()}
        if closure.kind == "fixed":
            ET.SubElement(loops, "weld", {"name": closure.name, **ends})
        else:
            at = number_text(closure.at - places[closure.inner])
            ET.SubElement(loops, "connect", {"name": closure.name, **ends, "anchor": at})
    for body, split in welds:
        ET.SubElement(loops, "weld", name=f"{split}_weld", body1=body, body2=split)
    for slide, turn, factor, offset in list_screws(parts):
        fit = number_text([offset, factor, 0.0, 0.0, 0.0])
        ET.SubElement(loops, "joint", name=slide, joint1=slide, joint2=turn, polycoef=fit)
    motors = ET.SubElement(top, "actuator")
    for name in tree.actuated:
        ET.SubElement(motors, "motor", name=name, joint=name)
    key = ET.SubElement(ET.SubElement(top, "keyframe"), "key", name="home", qpos=number_text(home))
    if efforts is not None:
        key.set("ctrl", number_text(efforts))
    ET.indent(top)
    return ET.tostring(top, encoding="unicode") + "\n"


def list_bodies(tree: LoopTree) -> list[tuple[str, str, list[SingleAxisJoint]]]:
    """List bodies depth first, as MuJoCo numbers joints: parent, child, single joints between.

    A link without mass is left out where one joint alone goes on from it: its joints then belong to
    the next body.
    """
    after: dict[str, list[TreeJoint]] = {}
    for one in tree.tree_joints:
        after.setdefault(one.parent, []).append(one)
    held = {end for one in tree.closures for end in (one.inner, one.outer)} | {tree.platform}
    found: list[tuple[str, str, list[SingleAxisJoint]]] = []
    todo = [(GROUND, one, list[SingleAxisJoint]()) for one in after.get(GROUND, [])[::-1]]
    while todo:
        start, (joint, parent, child), row = todo.pop()
        row = row + [one for one in split_freedoms(joint, parent, child, set()) if one.kind != "fixed"]
        link, beyond = tree.links[child], after.get(child, [])
        empty = not link.mass and not link.inertia.any()
        if empty and len(beyond) == 1 and child not in held:
            todo.append((start, beyond[0], row))
            continue
        found.append((start, child, row))
        todo += [(child, one, []) for one in beyond[::-1]]
    return found


def _split_bodies(tree: LoopTree) -> tuple[LoopTree, list[tuple[str, str]]]:
    """Cut a body at each closure that is neither a ball nor fixed; return the tree and the welds.

    The joint then leads to a part of the outer body, or of the inner one if only that has mass, and
    the part is welded to the rest. Parts have equal mass and inertia, so that their sums stay.
    """
    kept = [c for c in tree.closures if c.kind in ("spherical", "fixed")]
    cut = []
    for closure in [c for c in tree.closures if c not in kept]:
        ends = [end for end in (closure.outer, closure.inner) if end != tree.root]
        cut.append((closure, max(ends, key=lambda end: tree.links[end].mass > 0.0)))
    shares = dict.fromkeys(tree.links, 1)
    for _, owner in cut:
        shares[owner] += 1
    links = {
        name: replace(link, mass=link.mass / shares[name], inertia=link.inertia / shares[name])
        for name, link in tree.links.items()
    }
    joints, welds = dict(tree.joints), []
    for closure, owner in cut:
        part = f"{closure.name}_part"
        links[part] = replace(links[owner], name=part)
        inner, outer = (part if end == owner else end for end in (closure.inner, closure.outer))
        joints[closure.name] = replace(closure, inner=inner, outer=outer)
        welds.append((owner, part))
    return replace(tree, links=links, joints=joints, closures=tuple(kept)), welds


def _write_body(parent: ET.Element, link: Link, place: Array, before: Array) -> ET.Element:
    """Write a body; MuJoCo rejects a body without mass, or without inertia about an axis.

    The mass and inertia added instead are below the twelfth digit. MuJoCo takes an inertia of 1e-14 kg m2 for none.
    """
    element = ET.SubElement(parent, "body", name=link.name, pos=number_text(place - before))
    inertia = link.inertia + np.eye(3) * max(1e-12 * float(np.trace(link.inertia)), 3e-14)
    order = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
    ET.SubElement(
        element,
        "inertial",
        pos=number_text(link.com - place),
        mass=f"{link.mass or 1e-12:.15g}",
        fullinertia=" ".join(f"{inertia[i, k]:.15g}" for i, k in order),
    )
    return element


def _write_joint(part: SingleAxisJoint, place: Array) -> dict[str, str]:
    joint, limits = part.joint, part.joint.limits if part.is_only_freedom else {}
    found = {
        "name": part.name,
        "type": {"revolute": "hinge", "prismatic": "slide"}[part.kind],
        "axis": number_text(part.axis),
    }
    if part.kind == "revolute":
        found["pos"] = number_text(joint.at - place)
    if part.home:
        found["ref"] = number_text([part.home])
    if "position" in limits:
        found["range"] = number_text(limits["position"])
    if "effort" in limits:
        found["actuatorfrcrange"] = number_text([-limits["effort"], limits["effort"]])
    for key, value in (("damping", joint.viscous), ("frictionloss", joint.coulomb), ("armature", joint.rotor_inertia)):
        if value and part.is_only_freedom:
            found[key] = number_text([value])
    return found
