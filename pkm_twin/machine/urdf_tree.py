# SPDX-License-Identifier: Apache-2.0
"""A description of ``mechanism: machine`` as a tree of links with one axis a joint.

Joints of several freedoms become rows of revolute and prismatic joints with massless links
between them, rods become links, what the tree cuts becomes closures. The same rows tell the values
of the URDF's joints from the motions of the bodies.

May import: numpy, the URDF writer.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from pkm_twin.errors import ParameterError
from pkm_twin.machine.urdf_rows import (
    Motion,
    Row,
    axes_of,
    ball_row,
    joint_row,
    point_of,
    rod_motion,
    rod_row,
)
from pkm_twin.machine.urdf_write import (
    GROUND,
    PLATFORM,
    UrdfBody,
    UrdfCapsule,
    UrdfClosure,
    UrdfJoint,
    UrdfTree,
)

Array = NDArray[np.float64]

BASE: Final = "base"
"""The ground's name in a description."""
FREEDOMS: Final = {
    "fixed": 0,
    "revolute": 1,
    "prismatic": 1,
    "cylindrical": 2,
    "universal": 2,
    "spherical": 3,
    "translation": 3,
    "rod": 5,
}
BAR: Final = 0.01
"""Radius of the bars that stand for bodies, per size of the machine."""


@dataclass(frozen=True, eq=False)
class Layout:
    """A machine's rows from the ground outwards; ``cut``: joints and rods whose loops they open.

    ``names``: the single joints, in the order of their rows.
    """

    description: Mapping[str, Any]
    rows: tuple[Row, ...]
    cut: tuple[str, ...]

    @property
    def names(self) -> tuple[str, ...]:
        """The single joints' names, from the ground outwards, the actuated ones among them."""
        return tuple(name for row in self.rows for name in row.names)

    def values(self, motions: Mapping[str, Motion]) -> Array:
        """The single joints' values, shape (..., count), rad and m.

        :param motions: of every body but the ground.
        """
        first = next(iter(motions.values()))
        known: dict[str, Motion] = {
            BASE: (np.broadcast_to(np.eye(3), first[0].shape), np.zeros_like(first[1])),
            **motions,
        }
        rods = self.description.get("rods", {})
        found = []
        for row in self.rows:
            if row.type == "rod":
                known[row.outer] = rod_motion(row, rods[row.source], known)
            found.append(row.values(known[row.inner], known[row.outer]))
        return np.concatenate(found, axis=-1)


def layout(description: Mapping[str, Any], tree: Sequence[str] | None = None) -> Layout:
    """The rows of a description whose limbs are written out.

    :param tree: the joints and rods of the spanning tree; default those of the fewest freedoms,
        the actuated joints first.
    :raises ParameterError: a tree that does not reach a body, or leaves an actuated joint out.
    """
    joints, rods = description["joints"], description.get("rods", {})
    edges = {name: (joint["type"], joint["between"]) for name, joint in joints.items()}
    edges |= {name: ("rod", rod["between"]) for name, rod in rods.items()}
    chosen = _spanning(description, edges) if tree is None else list(tree)
    cut = [name for name in edges if name not in chosen]
    for name in cut:
        if joints.get(name, {}).get("actuated"):
            raise ParameterError(f"joints.{name}", name, "actuated joints in the tree")
    rows: list[Row] = []
    reached, waiting = [BASE], chosen
    for body in reached:
        for name in [n for n in waiting if body in edges[n][1]]:
            waiting = [n for n in waiting if n != name]
            a, b = edges[name][1]
            other = b if a == body else a
            if other in reached:
                raise ParameterError(f"tree.{name}", list(tree or ()), "a tree without loops")
            reached.append(other)
            if name in rods:
                rows.append(rod_row(name, rods[name], body))
                at = np.array(rods[name]["ends"][int(a == body)], dtype=float)
                rows.append(ball_row(name, name, other, at))
            else:
                rows.append(joint_row(description, name, body, other))
    for body in description["bodies"]:
        if body not in reached:
            raise ParameterError(f"bodies.{body}", body, "a body that the tree reaches")
    rows += [rod_row(name, rods[name], rods[name]["between"][0]) for name in cut if name in rods]
    return Layout(description, tuple(rows), tuple(cut))


def urdf_tree(plan: Layout, name: str) -> UrdfTree:
    """What :func:`pkm_twin.machine.urdf_write.write_urdf` takes, with bars to look at."""
    description = plan.description
    joints, rods = description["joints"], description.get("rods", {})
    links = _link_names([BASE, *description["bodies"], *rods])
    bodies: list[UrdfBody] = []
    singles: list[UrdfJoint] = []
    for row in plan.rows:
        joint = {} if row.type == "rod" or row.source in rods else joints[row.source]
        limits, friction = joint.get("limits", {}), joint.get("friction", {})
        parent = links[row.inner]
        for i, single in enumerate(row.names or (row.source,)):
            last = i + 1 >= len(row.names)
            child = links[row.outer] if last else f"{single}_link"
            if not last:
                bodies.append(UrdfBody(child, 0.0, row.point, np.zeros((3, 3))))
            alone = len(row.names) == 1
            position = limits.get("position") if alone else None
            singles.append(
                UrdfJoint(
                    single,
                    {"R": "revolute", "P": "prismatic", "": "fixed"}[row.kinds[i : i + 1]],
                    parent,
                    child,
                    row.point,
                    row.axes[i] if row.names else np.zeros(3),
                    row.home if i == 0 else 0.0,
                    None if position is None else (float(position[0]), float(position[1])),
                    limits.get("velocity") if alone else None,
                    limits.get("effort") if alone else None,
                    float(friction.get("viscous", 0.0)) if alone else 0.0,
                    float(friction.get("coulomb", 0.0)) if alone else 0.0,
                    bool(joint.get("actuated", False)),
                )
            )
            parent = child
        bodies.append(_body(description, row.outer, links))
    payload = description.get("payload", {})
    origin = _origin(description)
    platform = str(description["platform"])
    if payload.get("mass", 0.0):
        com = origin + np.array(payload.get("com", [0.0, 0.0, 0.0]), dtype=float)
        bodies.append(UrdfBody("payload", payload["mass"], com, _tensor(payload.get("inertia"))))
        at = np.zeros(3)
        singles.append(UrdfJoint("payload_frame", "fixed", links[platform], "payload", com, at))
    closures = []
    for source in plan.cut:
        if source in rods:
            rod = rods[source]
            end = np.array(rod["ends"][1], dtype=float)
            outer = links[rod["between"][1]]
            none = np.zeros((0, 3))
            closures.append(
                UrdfClosure(f"{source}_end", "spherical", links[source], outer, end, none)
            )
        else:
            joint = joints[source]
            a, b = joint["between"]
            point = point_of(description, joint)
            closures.append(
                UrdfClosure(source, joint["type"], links[a], links[b], point, axes_of(joint))
            )
    capsules = _capsules(description, links)
    return UrdfTree(
        name, tuple(bodies), tuple(singles), tuple(closures), capsules, links[platform], origin
    )


def _spanning(
    description: Mapping[str, Any], edges: Mapping[str, tuple[str, Sequence[str]]]
) -> list[str]:
    """Kruskal: actuated joints first, then the fewest freedoms."""
    group = {body: body for body in (BASE, *description["bodies"])}

    def root(body: str) -> str:
        while group[body] != body:
            body = group[body]
        return body

    def rank(name: str) -> tuple[bool, int]:
        actuated = description["joints"].get(name, {}).get("actuated", False)
        return not actuated, FREEDOMS[edges[name][0]]

    chosen = []
    for name in sorted(edges, key=rank):
        a, b = (root(body) for body in edges[name][1])
        if a != b:
            group[a] = b
            chosen.append(name)
    return chosen


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


def _capsules(description: Mapping[str, Any], links: Mapping[str, str]) -> tuple[UrdfCapsule, ...]:
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
        UrdfCapsule(links[body], found[0], point, radius)
        for body, found in spots.items()
        for point in found[1:]
        if float(np.linalg.norm(point - found[0])) > radius
    ]
    for name, rod in rods.items():
        start, end = (np.array(end, dtype=float) for end in rod["ends"])
        bars.append(UrdfCapsule(links[name], start, end, radius / 2.0))
    return tuple(bars)


def _link_names(names: Sequence[str]) -> dict[str, str]:
    """A link for each body, apart from the two names that every file has."""
    links = {BASE: GROUND}
    for name in names:
        link = name
        while name not in links and link in (GROUND, PLATFORM, "payload", *links.values()):
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
