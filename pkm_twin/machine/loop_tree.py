# SPDX-License-Identifier: Apache-2.0
"""A machine as description files have it: links on a tree of joints, and joints that close loops.

URDF, MJCF and SDF are read into this one form; :mod:`pkm_twin.robot.urdf_read` makes a
``mechanism: machine`` description of it.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

from pkm_twin.codegen.arrays import Array
from pkm_twin.machine.urdf_xml import Pose


@dataclass(frozen=True, eq=False)
class Link:
    """A link: ``mass`` (kg), ``com`` (3,) m and ``inertia`` (3, 3) about it, link axes."""

    name: str
    mass: float
    com: Array
    inertia: Array


@dataclass(frozen=True, eq=False)
class Joint:
    """A joint of the tree; ``axes``: unit vectors, shape (count, 3), joint frame.

    ``type``: also ``free``, of a body that closures alone hold. ``limits``: those of position,
    velocity and effort that the file states. ``rotor_inertia``: kg m2 or kg. ``beyond``: the child
    link's frame in the joint's. ``pitch``: of a helical joint, m a rad.
    """

    name: str
    type: str
    parent: str
    child: str
    origin: Pose
    axes: Array
    limits: dict[str, Any]
    viscous: float
    coulomb: float
    rotor_inertia: float = 0.0
    offset: float = 0.0
    beyond: Pose = field(default_factory=Pose)
    pitch: float = 0.0


@dataclass(frozen=True, eq=False)
class Closure:
    """A joint that closes a loop: a frame on either link, an axis in either frame (or none).

    ``viscous``, ``coulomb``: friction of a joint of one freedom. ``cosine``: of the angle between
    the axes of a universal joint.
    """

    name: str
    type: str
    links: tuple[str, str]
    frames: tuple[Pose, Pose]
    axes: tuple[Array, Array] | None
    viscous: float = 0.0
    coulomb: float = 0.0
    cosine: float = 0.0


@dataclass(frozen=True, eq=False)
class LoopTree:
    """A file's content; ``root``: the link that has no parent; ``gravity``: m/s2, if it tells.

    ``initial``: values that ``<ros2_control>`` begins with, of the joints for which it has them.
    ``accuracy``: half of the last digit of its places and directions, m or rad.
    """

    name: str
    root: str
    links: dict[str, Link]
    joints: dict[str, Joint]
    closures: tuple[Closure, ...]
    actuated: tuple[str, ...]
    gravity: list[float] | None = None
    initial: Mapping[str, float] = field(default_factory=dict)
    accuracy: float = 0.0


def ordered(root: str, joints: Iterable[Joint]) -> list[Joint]:
    """The joints from the root outwards, each level in the file's order."""
    hanging: dict[str, list[Joint]] = {}
    for joint in joints:
        hanging.setdefault(joint.parent, []).append(joint)
    order: list[Joint] = []
    level = [root]
    while level:
        found = [joint for link in level for joint in hanging.get(link, [])]
        order += found
        level = [joint.child for joint in found]
    return order


def drawn(root: str, joints: Mapping[str, Joint]) -> dict[str, Pose]:
    """The links' frames in the root's with all joints at zero."""
    places = {root: Pose()}
    for joint in ordered(root, joints.values()):
        places[joint.child] = places[joint.parent] @ joint.origin @ joint.beyond
    return places
