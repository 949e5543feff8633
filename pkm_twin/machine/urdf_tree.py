# SPDX-License-Identifier: Apache-2.0
"""A description and the single joints of its tree as what the URDF writer takes.

May import: numpy, the URDF writer, the rows.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Final, Protocol

import numpy as np

from pkm_twin.machine.urdf_rows import BASE, Array, axes_of, point_of
from pkm_twin.machine.urdf_write import (
    GROUND,
    PLATFORM,
    UrdfBody,
    UrdfCapsule,
    UrdfClosure,
    UrdfJoint,
    UrdfTree,
)

BAR: Final = 0.01
"""Radius of the bars that stand for bodies, per size of the machine."""
PAYLOAD: Final = "payload"
"""The link of a payload, apart from the platform's."""
KINDS: Final = {"R": "revolute", "P": "prismatic", "": "fixed"}


class SingleJoint(Protocol):
    """One axis of the tree, see :class:`pkm_twin.machine.urdf_rows.Axis`."""

    @property
    def name(self) -> str: ...  # noqa: D102
    @property
    def kind(self) -> str: ...  # noqa: D102
    @property
    def axis(self) -> Array: ...  # noqa: D102
    @property
    def point(self) -> Array: ...  # noqa: D102
    @property
    def inner(self) -> str: ...  # noqa: D102
    @property
    def outer(self) -> str: ...  # noqa: D102
    @property
    def joint(self) -> str: ...  # noqa: D102


def urdf_tree(
    description: Mapping[str, Any],
    axes: Sequence[SingleJoint],
    cut: Iterable[str],
    name: str,
    capsules: Sequence[UrdfCapsule] | None = None,
) -> UrdfTree:
    """What :func:`pkm_twin.machine.urdf_write.write_urdf` takes.

    :param description: limbs written out; a payload becomes a link of its own.
    :param axes: the single joints of the tree; names of links between bodies are free.
    :param cut: joints, and rods at their outer ends, that close the loops.
    :param capsules: bars to look at, by bodies' names; default from joint to joint of each body.
    """
    joints, rods = description["joints"], description.get("rods", {})
    known = [BASE, *description["bodies"], *rods]
    links = _link_names([*known, *(axis.outer for axis in axes)])
    counts = Counter(axis.joint for axis in axes)
    bodies: list[UrdfBody] = []
    singles: list[UrdfJoint] = []
    for axis in axes:
        alone = axis.joint in joints and counts[axis.joint] == 1
        joint = joints[axis.joint] if alone else {}
        limits, friction = joint.get("limits", {}), joint.get("friction", {})
        position = limits.get("position")
        singles.append(
            UrdfJoint(
                axis.name,
                KINDS[axis.kind],
                links[axis.inner],
                links[axis.outer],
                axis.point,
                axis.axis,
                float(joint.get("home", 0.0)),
                None if position is None else (float(position[0]), float(position[1])),
                limits.get("velocity"),
                limits.get("effort"),
                float(friction.get("viscous", 0.0)),
                float(friction.get("coulomb", 0.0)),
                bool(joint.get("actuated", False)),
            )
        )
        if axis.outer in known:
            bodies.append(_body(description, axis.outer, links))
        else:
            bodies.append(UrdfBody(links[axis.outer], 0.0, axis.point, np.zeros((3, 3))))
    platform, origin = str(description["platform"]), _origin(description)
    payload = description.get("payload", {})
    if payload.get("mass", 0.0):
        com = origin + np.array(payload.get("com", [0.0, 0.0, 0.0]), dtype=float)
        bodies.append(UrdfBody(PAYLOAD, payload["mass"], com, _tensor(payload.get("inertia"))))
        singles.append(
            UrdfJoint(f"{PAYLOAD}_frame", "fixed", links[platform], PAYLOAD, com, np.zeros(3))
        )
    if capsules is None:
        capsules = _capsules(description)
    return UrdfTree(
        name,
        tuple(bodies),
        tuple(singles),
        tuple(_closure(description, source, links) for source in cut),
        tuple(UrdfCapsule(links[c.body], c.start, c.end, c.radius) for c in capsules),
        links[platform],
        origin,
    )


def _closure(description: Mapping[str, Any], source: str, links: Mapping[str, str]) -> UrdfClosure:
    rods = description.get("rods", {})
    if source in rods:
        rod = rods[source]
        end = np.array(rod["ends"][1], dtype=float)
        inner, outer = links[source], links[rod["between"][1]]
        return UrdfClosure(f"{source}_end", "spherical", inner, outer, end, np.zeros((0, 3)))
    joint = description["joints"][source]
    inner, outer = (links[body] for body in joint["between"])
    point = point_of(description, joint)
    return UrdfClosure(source, joint["type"], inner, outer, point, axes_of(joint))


def _body(description: Mapping[str, Any], name: str, links: Mapping[str, str]) -> UrdfBody:
    rod = description.get("rods", {}).get(name)
    if rod is None:
        body = description["bodies"][name]
        com = np.array(body.get("com", [0.0, 0.0, 0.0]), dtype=float)
        mass = float(body.get("mass", 0.0))
        return UrdfBody(links[name], mass, com, _tensor(body.get("inertia")))
    start, end = (np.array(end, dtype=float) for end in rod["ends"])
    mass, along = float(rod.get("mass", 0.0)), end - start
    inertia = mass / 12.0 * (along @ along * np.eye(3) - np.outer(along, along))
    return UrdfBody(links[name], mass, (start + end) / 2.0, inertia)


def _capsules(description: Mapping[str, Any]) -> list[UrdfCapsule]:
    """Rods as they are; a body as bars from one of its joints to the others."""
    rods = description.get("rods", {})
    spots: dict[str, list[Array]] = {body: [] for body in description["bodies"]}
    spots[str(description["platform"])].append(_origin(description))
    for joint in description["joints"].values():
        for body in joint["between"]:
            if body in spots and "at" in joint:
                spots[body].append(np.array(joint["at"], dtype=float))
    for rod in rods.values():
        for body, end in zip(rod["between"], rod["ends"], strict=True):
            if body in spots:
                spots[body].append(np.array(end, dtype=float))
    points = [point for found in spots.values() for point in found]
    radius = BAR * float(np.linalg.norm(np.ptp(points, axis=0)))
    bars = [
        UrdfCapsule(body, found[0], point, radius)
        for body, found in spots.items()
        for point in found[1:]
        if float(np.linalg.norm(point - found[0])) > radius
    ]
    for name, rod in rods.items():
        start, end = (np.array(end, dtype=float) for end in rod["ends"])
        bars.append(UrdfCapsule(name, start, end, radius / 2.0))
    return bars


def _link_names(names: Sequence[str]) -> dict[str, str]:
    """A link for each name, apart from those that the file has of its own."""
    links = {BASE: GROUND}
    for name in names:
        link = name
        while name not in links and link in (GROUND, PLATFORM, PAYLOAD, *links.values()):
            link += "_body"
        links.setdefault(name, link)
    return links


def _origin(description: Mapping[str, Any]) -> Array:
    body = description["bodies"][description["platform"]]
    return np.array(description.get("origin", body.get("com", [0.0, 0.0, 0.0])), dtype=float)


def _tensor(inertia: Any) -> Array:
    if inertia is None:
        return np.zeros((3, 3))
    matrix = np.array(inertia, dtype=float)
    return matrix if matrix.ndim == 2 else np.diag(matrix)
