# SPDX-License-Identifier: Apache-2.0
"""A graph and the single joints of its spanning tree as what the URDF writer takes."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Final

import numpy as np

from pkm_twin.kinematics.passive import Axis
from pkm_twin.machine.graph import BASE, Graph, Joint
from pkm_twin.machine.urdf_write import (
    GROUND,
    PLATFORM,
    UrdfBody,
    UrdfCapsule,
    UrdfClosure,
    UrdfDrive,
    UrdfJoint,
    UrdfTree,
)
from pkm_twin.machine.urdf_xml import plain_name
from pkm_twin.robot.outline import bars

PAYLOAD: Final = "payload"
"""The link of a payload, apart from the platform's."""
KINDS: Final = {"R": "revolute", "P": "prismatic", "": "fixed"}
"""Kinds of single joints in a URDF's words."""


def urdf_tree(
    graph: Graph,
    axes: Sequence[Axis],
    cut: Iterable[str],
    name: str,
    *,
    drives: Mapping[str, UrdfDrive] | None = None,
    payload: UrdfBody | None = None,
) -> UrdfTree:
    """What :func:`pkm_twin.machine.urdf_write.write_urdf` takes, with bars to look at.

    :param axes: single joints from the ground outwards, fixed ones of the kind ""; names of links
        between bodies are theirs.
    :param cut: joints that the tree leaves out.
    :param drives: limits and friction of the actuated joints.
    :param payload: with its centre from the platform's reference point.
    """
    known = [BASE, *graph.bodies, *graph.rods]
    links = _link_names([*known, *(axis.outer for axis in axes)])
    bodies: list[UrdfBody] = []
    singles: list[UrdfJoint] = []
    for axis in axes:
        # Of several axes of one joint, one at most has its name, its number at home and its drive.
        joint = graph.joints.get(axis.joint) if axis.name == axis.joint else None
        drive = UrdfDrive()
        if joint is not None:
            drive = (drives or {}).get(joint.name, _resistance(joint))
        singles.append(
            UrdfJoint(
                axis.name,
                KINDS[axis.kind],
                links[axis.inner],
                links[axis.outer],
                axis.point,
                axis.axis,
                0.0 if joint is None else joint.home,
                drive,
            )
        )
        bodies.append(_body(graph, axis, links[axis.outer]))
    if payload is not None and payload.mass > 0.0:
        com = graph.origin + payload.com
        bodies.append(UrdfBody(PAYLOAD, payload.mass, com, payload.inertia))
        at = links[graph.platform]
        singles.append(UrdfJoint(f"{PAYLOAD}_frame", "fixed", at, PAYLOAD, com, np.zeros(3)))
    closures = []
    for source in cut:
        joint = graph.joints[source]
        ends = links[joint.inner], links[joint.outer]
        closures.append(
            UrdfClosure(
                source, joint.kind, *ends, joint.at, joint.axes, joint.home, _resistance(joint)
            )
        )
    for rod in graph.rods.values():
        ends = links[rod.name], links[rod.outer]
        nothing = np.zeros((0, 3))
        closures.append(UrdfClosure(f"{rod.name}_end", "spherical", *ends, rod.ends[1], nothing))
    return UrdfTree(
        name,
        tuple(bodies),
        tuple(singles),
        tuple(closures),
        tuple(_capsules(graph, links)),
        graph.actuated,
        links[graph.platform],
        graph.origin,
        tuple(
            (f"{name}_slide", name, joint.pitch)
            for name, joint in graph.joints.items()
            if joint.type.threaded()
        ),
    )


def _resistance(joint: Joint) -> UrdfDrive:
    return UrdfDrive(
        damping=joint.viscous, friction=joint.coulomb, rotor_inertia=joint.rotor_inertia
    )


def _body(graph: Graph, axis: Axis, link: str) -> UrdfBody:
    """The link that a single joint leads to; between the axes of one joint it has no mass."""
    if axis.outer in graph.bodies:
        body = graph.bodies[axis.outer]
        return UrdfBody(link, body.mass, body.com, body.inertia)
    if axis.outer in graph.rods:
        rod = graph.rods[axis.outer]
        along = rod.ends[1] - rod.ends[0]
        inertia = rod.mass / 12.0 * (along @ along * np.eye(3) - np.outer(along, along))
        return UrdfBody(link, rod.mass, (rod.ends[0] + rod.ends[1]) / 2.0, inertia)
    return UrdfBody(link, 0.0, axis.point, np.zeros((3, 3)))


def _capsules(graph: Graph, links: Mapping[str, str]) -> list[UrdfCapsule]:
    return [
        UrdfCapsule(links[bar.part], bar.start[1], bar.end[1], bar.radius) for bar in bars(graph)
    ]


def _link_names(names: Sequence[str]) -> dict[str, str]:
    """A link for each name, apart from those that the file has of its own."""
    links = {BASE: GROUND}
    # What needs no change keeps its name, whatever else would come to have it.
    for name in sorted(names, key=lambda name: plain_name(name) != name):
        link = plain_name(name)
        while name not in links and link in (GROUND, PLATFORM, PAYLOAD, *links.values()):
            link += "_body"
        links.setdefault(name, link)
    return links
