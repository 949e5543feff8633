# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""A robot's tree as an MJCF file, byte for byte the same.

The model stands at home as it is: every body's frame is parallel to the base there, ``ref`` of a
joint is its value at home. Loops are ``connect`` and ``weld`` constraints.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from pkm_twin.codegen.arrays import Array
from pkm_twin.machine.loop_tree import Capsule, Hung, Joint, Link, LoopTree, Single, screws, singles
from pkm_twin.machine.urdf_write import GROUND, PLATFORM, number_text

TIMESTEP: Final = 1e-3
"""s."""
SOLREF: Final = (2.0 * TIMESTEP, 1.0)
"""Time constant, s, and damping ratio of the constraints: as stiff as the time step allows."""
SOLIMP: Final = (0.9999, 0.9999, 0.001)
"""Impedance of the constraints: how little they give way."""
SPECK: Final = 1e-12
"""Inertia that is added about every axis, part of the body's."""
LEAST: Final = 3e-14
"""Or this, kg m2: MuJoCo takes 1e-14 for none."""
SPECK_MASS: Final = 1e-12
"""Of a body that has none, kg."""
TYPES: Final = {"revolute": "hinge", "prismatic": "slide"}
HOME: Final = "home"
"""The keyframe's name."""


def write_mjcf(tree: LoopTree, gravity: Array, efforts: Sequence[float] | None = None) -> str:
    """Write the MJCF of a tree.

    Actuators are motors named as their joints, in the robot's order; the site ``platform`` stands
    on the reference point.

    :param gravity: (3,) m/s2.
    :param efforts: of the actuators at the keyframe ``home``, shape (n,), N m or N.
    """
    tree, welds = _split(tree)
    top = ET.Element("mujoco", model=tree.name)
    ET.SubElement(top, "compiler", angle="radian", autolimits="true", inertiafromgeom="false")
    ET.SubElement(top, "option", gravity=number_text(gravity), timestep=number_text([TIMESTEP]), integrator="RK4")
    default = ET.SubElement(top, "default")
    ET.SubElement(default, "geom", contype="0", conaffinity="0", group="1", rgba="0.6 0.65 0.7 1")
    ET.SubElement(default, "equality", solref=number_text(SOLREF), solimp=number_text(SOLIMP))
    elements = {GROUND: ET.SubElement(top, "worldbody")}
    places = {GROUND: np.zeros(3)}
    home: list[float] = []
    parts: list[Single] = []
    for parent, child, row in rows(tree):
        link = tree.links[child]
        place = row[0].joint.at if row else link.frame.position
        elements[child] = _body(elements[parent], link, place, places[parent])
        places[child] = place
        for part in row:
            ET.SubElement(elements[child], "joint", _joint(part, place))
            home.append(part.home)
        parts += row
    for capsule in tree.capsules:
        if capsule.link in elements:
            _capsule(elements[capsule.link], capsule, places[capsule.link])
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
    for slide, turn, factor, offset in screws(parts):
        fit = number_text([offset, factor, 0.0, 0.0, 0.0])
        ET.SubElement(loops, "joint", name=slide, joint1=slide, joint2=turn, polycoef=fit)
    motors = ET.SubElement(top, "actuator")
    for name in tree.actuated:
        ET.SubElement(motors, "motor", name=name, joint=name)
    key = ET.SubElement(ET.SubElement(top, "keyframe"), "key", name=HOME, qpos=number_text(home))
    if efforts is not None:
        key.set("ctrl", number_text(efforts))
    ET.indent(top)
    return ET.tostring(top, encoding="unicode") + "\n"


def rows(tree: LoopTree) -> list[tuple[str, str, list[Single]]]:
    """Bodies depth first, as MuJoCo numbers joints: parent, child, single joints between.

    A link without mass is left out where one joint alone goes on from it, which then has its
    joints too.
    """
    after: dict[str, list[Hung]] = {}
    for one in tree.hung:
        after.setdefault(one.parent, []).append(one)
    held = {end for one in tree.closures for end in (one.inner, one.outer)} | {tree.platform}
    found: list[tuple[str, str, list[Single]]] = []
    todo = [(GROUND, one, list[Single]()) for one in after.get(GROUND, [])[::-1]]
    while todo:
        start, (joint, parent, child), row = todo.pop()
        row = row + [one for one in singles(joint, parent, child, set()) if one.kind != "fixed"]
        link, beyond = tree.links[child], after.get(child, [])
        empty = not link.mass and not link.inertia.any()
        if empty and len(beyond) == 1 and child not in held:
            todo.append((start, beyond[0], row))
            continue
        found.append((start, child, row))
        todo += [(child, one, []) for one in beyond[::-1]]
    return found


def _split(tree: LoopTree) -> tuple[LoopTree, list[tuple[str, str]]]:
    """Make closures tree joints, but balls and fixed ones; return the tree and what to weld.

    Such a joint leads to a part of the outer body, or of the inner one, that is welded to the rest
    of it: mass and inertia are shared out evenly, so that their sums stay.
    """
    kept = [c for c in tree.closures if c.kind in ("spherical", "fixed")]
    cut = [(c, _owner(c, tree)) for c in tree.closures if c not in kept]
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


def _owner(closure: Joint, tree: LoopTree) -> str:
    """Choose the body to split: the outer one, unless only the inner one has a mass."""
    ends = [end for end in (closure.outer, closure.inner) if end != tree.root]
    return max(ends, key=lambda end: tree.links[end].mass > 0.0)


def _body(parent: ET.Element, link: Link, place: Array, before: Array) -> ET.Element:
    """Write a body with some mass, and some inertia about every axis.

    What is added is below the twelfth digit: a thin bar's inertia about itself is none.
    """
    element = ET.SubElement(parent, "body", name=link.name, pos=number_text(place - before))
    inertia = link.inertia + np.eye(3) * max(SPECK * float(np.trace(link.inertia)), LEAST)
    order = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
    ET.SubElement(
        element,
        "inertial",
        pos=number_text(link.com - place),
        mass=f"{link.mass or SPECK_MASS:.15g}",
        fullinertia=" ".join(f"{inertia[i, k]:.15g}" for i, k in order),
    )
    return element


def _joint(part: Single, place: Array) -> dict[str, str]:
    joint, limits = part.joint, part.joint.limits if part.whole else {}
    found = {"name": part.name, "type": TYPES[part.kind], "axis": number_text(part.axis)}
    if part.kind == "revolute":
        found["pos"] = number_text(joint.at - place)
    if part.home:
        found["ref"] = number_text([part.home])
    if "position" in limits:
        found["range"] = number_text(limits["position"])
    if "effort" in limits:
        found["actuatorfrcrange"] = number_text([-limits["effort"], limits["effort"]])
    for key, value in (("damping", joint.viscous), ("frictionloss", joint.coulomb), ("armature", joint.rotor_inertia)):
        if value and part.whole:
            found[key] = number_text([value])
    return found


def _capsule(body: ET.Element, capsule: Capsule, place: Array) -> None:
    ends = number_text([*(capsule.start - place), *(capsule.end - place)])
    size = number_text([capsule.radius])
    if np.linalg.norm(capsule.end - capsule.start) > 0.0:
        ET.SubElement(body, "geom", type="capsule", fromto=ends, size=size)
    else:
        at = number_text(capsule.start - place)
        ET.SubElement(body, "geom", type="sphere", pos=at, size=size)
