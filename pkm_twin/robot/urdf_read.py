# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Read URDF, MJCF, SDF and USD with loop closures as a ``mechanism: machine`` description."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from pkm_twin.codegen.arrays import Array
from pkm_twin.errors import ParameterError, warn_of_file
from pkm_twin.kinematics.linkage import Linkage
from pkm_twin.kinematics.rounding import repair_rounded
from pkm_twin.machine import graph as graphs
from pkm_twin.machine import mjcf_file, sdf_file, urdf_file, urdf_xml, usd_file
from pkm_twin.machine.cut_out import cut_out, find_loop_joints
from pkm_twin.machine.graph import BASE, Graph
from pkm_twin.machine.graph_description import graph_description
from pkm_twin.machine.loop_tree import SINGLE_FREEDOM_TYPES, Joint, Link, LoopTree
from pkm_twin.machine.rotations import Pose
from pkm_twin.machine.urdf_control import convert_drives
from pkm_twin.machine.urdf_file import Visual, read_visuals
from pkm_twin.robot.urdf_home import MAX_LOOP_GAP, MIN_ROUNDING, Assembly, HomeSearch

PLATFORMS: Final = (
    "platform",
    "moving_platform",
    "platform_link",
    "end_effector",
    "endeffector",
    "effector",
    "end_effector_link",
    "ee_link",
    "ee",
    "eff",
    "tool0",
    "tool",
    "tool_link",
    "tcp",
)
"""Names of links that are taken for the platform, the first that is there."""


@dataclass(frozen=True, eq=False)
class UrdfReading:
    """A file as a ``mechanism: machine`` description, and how it was read.

    ``home``: how the home was chosen, in words. ``notes``: changes of the file's machine. ``marked``:
    what marks the actuated joints in the file. ``visuals``: the meshes of its links.
    """

    description: dict[str, Any]
    home: str
    notes: tuple[str, ...]
    marked: str = ""
    visuals: tuple[Visual, ...] = ()


@dataclass(frozen=True)
class UrdfSelection:
    """Which links and joints of a URDF form the machine.

    ``platform``: the link that carries the tool; default: the first of ``PLATFORMS``. ``base``: the
    link that is the ground and gives the base axes; default: the root. ``actuated``: joints with
    motors, in the order of q; default: those that the file marks. ``pose``: names of the pose
    coordinates. ``carry``: keep links attached to moving bodies, rigidly in their drawn position.

    If ``base`` or ``actuated`` is given, only the links and joints between base and platform, and
    the loops through them, are kept.
    """

    platform: str | None = None
    base: str | None = None
    actuated: Sequence[str] | None = None
    pose: Sequence[str] | None = None
    carry: bool = False

    def __post_init__(self) -> None:
        """Check the kinds of names.

        :raises ParameterError: a link's name is not a text, or names are not a list of texts.
        """
        for field in ("platform", "base"):
            name = getattr(self, field)
            if not isinstance(name, str | None):
                raise ParameterError(field, name, "the name of a link")
        for field in ("actuated", "pose"):
            names = getattr(self, field)
            if names is None:
                continue
            listed = isinstance(names, Collection) and not isinstance(names, str)
            if not listed or not all(isinstance(name, str) for name in names):
                raise ParameterError(field, names, "a list of names")

    @property
    def is_partial(self) -> bool:
        """True if some links or joints of the file are left out."""
        return self.base is not None or self.actuated is not None or self.carry


def read_urdf(path: str | Path, **part: Any) -> dict[str, Any]:
    """Read a URDF file as a ``mechanism: machine`` description, vectors in base axes at home.

    As :func:`read_tree`, whose notes are given as warnings.

    :param part: fields of :class:`UrdfSelection`.
    """
    reading = read_tree(path, UrdfSelection(**part))
    for note in reading.notes:
        warn_of_file(path, note)
    return reading.description


def read_tree(path: str | Path, part: UrdfSelection = UrdfSelection()) -> UrdfReading:
    """Read a URDF file as a ``mechanism: machine`` description, vectors in base axes at home.

    A file whose top element is ``<mujoco>`` is read as MJCF, with the mujoco package, and one of
    ``<sdf>`` as SDF; a file whose name ends in .usd, .usda or .usdc as USD, with usd-core.

    Links that fixed joints hold together are one body. Home: see :mod:`pkm_twin.robot.urdf_home`;
    ``home`` of a joint is its value there, so that joint values are the URDF's. Parts that only
    spin about themselves are held, and axes that a rounded file leaves nearly parallel, or nearly
    meeting, are made so where the machine could not move otherwise.

    :raises ParameterError: a file, element or name that is refused, by its name.
    """
    path = Path(path)
    controller, top = {}, None
    if path.suffix in usd_file.SUFFIXES:
        tree = usd_file.read(path, part.actuated)
    else:
        top = urdf_xml.parse_xml(path)
        controller = convert_drives(top)
        readers = {"mujoco": mjcf_file.read, "sdf": sdf_file.read}
        tree = readers.get(top.tag, urdf_file.read)(path, top, part.actuated)
    tool = _find_platform(tree, part.platform)
    ground = tree.root if part.base is None else part.base
    ground = urdf_xml.find_link("base", ground, tree.links)
    notes, carried = list[str](), tuple[Link, ...]()
    if part.is_partial:
        cut = cut_out(tree, ground, tool, carry=part.carry)
        _require_motors(part, tree, cut.tree, ground, tool)
        tree, carried = cut.tree, cut.carried
        notes += cut.notes
    # Reject joints that follow others, if one of both belongs to the machine, and a lack of motors.
    own = {*tree.joints, *(joint.name for joint in tree.closures)}
    for names, error in tree.faults:
        if own.intersection(names) or not (names or tree.actuated):
            raise error
    _require_closed(path, tree)
    bodies = _map_bodies(tree, tool, ground)
    _reject_fully_actuated_loops(tree, bodies, tool, ground)
    assembly = Assembly(tree)
    _require_moving(tree, bodies, tool)
    home = HomeSearch(assembly, lambda: _build_graph(assembly, bodies, tool, ground)).home()
    assembly.place(home.values)
    graph = home.graph or _build_graph(assembly, bodies, tool, ground)
    data = _describe_graph(assembly, graph, ground)
    if carried:
        move = _find_link_transforms(assembly, ground)[tool]
        mass, com, inertia = _sum_masses([link.moved(move) for link in carried])
        com = _round_vector(com - graph.origin).tolist()
        data["payload"] = {"mass": mass, "com": com, "inertia": inertia.tolist()}
    if part.pose is not None:
        data["pose"] = list(part.pose)
    ignored = [
        f"{key} {value:g} of {one.name}"
        for one in (*tree.joints.values(), *tree.closures)
        for key, value in (("damping", one.viscous), ("friction", one.coulomb), ("rotor inertia", one.rotor_inertia))
        if value and one.kind not in (*SINGLE_FREEDOM_TYPES, "fixed")
    ]
    if ignored:
        notes.append(f"ignored, because the joint has several degrees of freedom: {', '.join(ignored)}")
    if home.miss > MAX_LOOP_GAP:
        notes.append(f"the loops close within {home.miss:.1g} only (m or rad)")
    if home.others:
        notes.append(
            f"home is not as drawn: of {home.others + 1} assemblies the best conditioned one, passive joints up to "
            f"{np.abs(home.values).max():.3g} rad or m from zero"
        )
    if home.repair and home.repair.moves:
        notes.append(home.repair.text)
    if home.held:
        notes.append(f"held, as they only let a part spin about itself: {', '.join(home.held)}")
    # Report held joints whose bodies have a static unbalance (mass times distance from the axis) above 1e-6 kg m.
    heavy = {name: value for name, value in home.held.items() if value > 1e-6}
    if heavy:
        notes.append(
            "efforts depend on the angle at which parts with their mass off the axis are held: "
            + ", ".join(f"{name} ({value:.3g} kg m)" for name, value in heavy.items())
        )
    if controller:
        data["joint_map"] = controller
    frames = {name: move @ tree.links[name].frame for name, move in _find_link_transforms(assembly, ground).items()}
    shown = list[Visual]()
    if top is not None and top.tag == "robot":
        shown += read_visuals(path, top, frames, bodies)
    return UrdfReading(data, home.text, tuple(notes), tree.marked, tuple(shown))


def _require_closed(path: Path, tree: LoopTree) -> None:
    """Reject too many joints to be assembled, links without connection, and passive joints without a closure.

    :raises ParameterError: their number, or their names.
    """
    moving = [joint.name for joint in tree.joints.values() if joint.kind != "fixed"]
    # The time to close the loops grows with the cube of this number.
    if len(moving) > 1000:
        raise ParameterError(str(path), f"{len(moving)} joints that move", "at most 1000")
    ends = [(one.inner, one.outer) for one in (*tree.joints.values(), *tree.closures) if one.kind != "free"]
    for part in graphs.group_connected(tree.links, ends):
        if tree.root not in part:
            bound = "a joint or closure that connects it; a base and a platform (--base) can leave it out"
            raise ParameterError(f"link.{part[0]}", "not connected", bound)
    idle = [name for name in moving if name not in tree.actuated]
    if idle and not tree.closures:
        raise ParameterError(
            str(path),
            f"no loop closure, and passive joints: {', '.join(idle)}",
            "<constraint> or <loop> elements, or closed_loop in a YAML file next to it",
        )


def _require_motors(part: UrdfSelection, whole: LoopTree, tree: LoopTree, base: str, tool: str) -> None:
    """Reject a linkage without motors, and motors outside it.

    :raises ParameterError: the motors outside, and the joints that can be driven.
    """
    way = f"joints between base {base!r} and platform {tool!r}"
    drivable = [n for n, j in tree.joints.items() if j.kind in ("revolute", "prismatic", "helical")]
    away = [name for name in whole.actuated if name not in tree.joints]
    if not tree.actuated or (part.actuated is not None and away):
        raise ParameterError(
            "actuated", ", ".join(away) or None, f"{way}, of which these can be driven: {', '.join(drivable)}"
        )


def _reject_fully_actuated_loops(tree: LoopTree, bodies: dict[str, str], tool: str, ground: str) -> None:
    """Reject a loop in which all joints are actuated: the joint that closes the loop must be passive.

    :raises ParameterError: the actuated joints and the degrees of freedom.
    """
    if all(joint.name not in tree.actuated for joint in tree.closures):
        return
    graph = _build_graph(Assembly(replace(tree, actuated=())), bodies, tool, ground)
    repaired = repair_rounded(graph, tree.rounding, MIN_ROUNDING)
    freedoms = Linkage(graph if repaired is None else repaired.graph).mobility.freedoms
    raise ParameterError(
        tree.marked,
        f"{len(tree.actuated)} actuated joints: {', '.join(tree.actuated)}",
        f"at most one a degree of freedom ({freedoms}), and in every loop a joint without a motor; "
        "which of these are motors?",
    )


def _require_moving(tree: LoopTree, bodies: dict[str, str], tool: str) -> None:
    """Reject actuated joints that do not move the platform, before the search for a home.

    :raises ParameterError: such joints, with the joints at which they can be cut out.
    """
    joints = [joint for joint in tree.joints.values() if joint.kind != "free"]
    joints += tree.closures
    pairs = {joint.name: (bodies[joint.inner], bodies[joint.outer]) for joint in joints}
    pairs = {name: pair for name, pair in pairs.items() if pair[0] != pair[1]}
    moving, target = find_loop_joints(pairs, BASE, bodies[tool]), {BASE, bodies[tool]}
    apart = [name for name in tree.actuated if name not in moving]
    if not apart:
        return
    whole = {end for name in moving for end in pairs[name]} | target
    cuts = [name for name, pair in pairs.items() if name not in moving and whole & set(pair)]
    raise ParameterError(
        "actuated",
        f"{', '.join(apart)}",
        f"joints that move the platform {tool!r}: close a "
        f"missing loop, or leave out the other parts, at {', '.join(cuts)}, with their motors "
        "(`base=LINK` or --base)",
    )


def _find_link_transforms(assembly: Assembly, ground: str) -> dict[str, Pose]:
    """Return the transform of each link from its drawn pose to its pose in the assembled machine, base axes."""
    view = (assembly.move(ground) @ assembly.tree.links[ground].frame).inverse()
    return {name: view @ assembly.move(name) for name in assembly.tree.links}


def _describe_graph(assembly: Assembly, graph: Graph, ground: str) -> dict[str, Any]:
    """Describe the placed machine's graph, with the file's gravity, limits and friction."""
    tree = assembly.tree
    data = graph_description(graph)
    if tree.gravity is not None:
        gravity = _find_link_transforms(assembly, ground)[tree.root].rotation @ tree.gravity
        data["gravity"] = _round_vector(gravity).tolist()
    for name, entry in data["joints"].items():
        ends = tree.joints[name].limits.get("position") if name in tree.joints else None
        if ends is not None and np.isfinite(ends).any() and entry["type"] in SINGLE_FREEDOM_TYPES:
            entry["limits"] = {"position": ends}
    for name in tree.actuated:
        joint, entry = tree.joints[name], data["joints"][name]
        if joint.limits:
            entry["limits"] = joint.limits
        if joint.offset:
            entry["friction"] = {"viscous": 0.0, "coulomb": 0.0, **entry.get("friction", {})}
            entry["friction"]["offset"] = joint.offset
    return data


def _build_graph(assembly: Assembly, bodies: dict[str, str], tool: str, ground: str) -> Graph:
    """Return the graph of the machine at the placed values."""
    tree, moves = assembly.tree, _find_link_transforms(assembly, ground)
    home = dict(zip(assembly.steps, assembly.values.tolist(), strict=True))
    passive = [n for n, j in tree.joints.items() if j.kind != "fixed" and n not in tree.actuated]
    joints = [tree.joints[name] for name in (*tree.actuated, *passive)]
    joints += [one for one in tree.closures if bodies[one.inner] != bodies[one.outer]]

    def make_joint(joint: Joint) -> graphs.Joint:
        ends = moves[joint.inner], moves[joint.outer]
        axes = [e.rotation @ axis for e, axis in zip(ends, joint.axes, strict=False)]
        axes = axes[: joint.type.count]
        own = {}
        if joint.kind in SINGLE_FREEDOM_TYPES:
            value = round(home.get(joint.name, 0.0) + joint.drawn, 14) + 0.0
            own = {key: getattr(joint, key) for key in ("viscous", "coulomb", "rotor_inertia")}
            own |= {"home": value, "pitch": joint.pitch}
        return graphs.Joint(
            joint.name,
            joint.kind,
            bodies[joint.inner],
            bodies[joint.outer],
            _round_vector(ends[0].point(joint.at)),
            np.reshape([_round_vector(a) for a in axes], (-1, 3)),
            joint.name in tree.actuated,
            **own,
        )

    masses: dict[str, graphs.Body] = {}
    for body in dict.fromkeys(body for body in bodies.values() if body != BASE):
        links = [link.moved(moves[name]) for name, link in tree.links.items() if bodies[name] == body]
        mass, com, inertia = _sum_masses(links)
        masses[body] = graphs.Body(body, mass, _round_vector(com), inertia)
    return Graph(
        masses,
        {joint.name: make_joint(joint) for joint in joints if joint.kind != "free"},
        {},
        bodies[tool],
        _round_vector(moves[tool].point(tree.links[tool].frame.position)),
    )


def _find_platform(tree: LoopTree, asked: str | None) -> str:
    if asked is not None:
        return urdf_xml.find_link("platform", asked, tree.links)
    lower = {name.lower(): name for name in tree.links}
    for name in PLATFORMS:
        if name in lower:
            return lower[name]
    raise ParameterError("platform", None, f"the link that carries the tool, one of {', '.join(sorted(tree.links))}")


def _map_bodies(tree: LoopTree, tool: str, ground: str) -> dict[str, str]:
    """Return the body of each link, named by its link nearest to the root; the tool's by the tool.

    :raises ParameterError: the tool is fixed to the ground.
    """
    group = {name: name for name in tree.links}
    for joint, parent, child in tree.tree_joints:
        if joint.kind == "fixed":
            group[child] = group[parent]
    if group[tool] == group[ground]:
        raise ParameterError("platform", tool, "a link that can move")
    names, taken = {group[ground]: BASE}, {BASE}
    for first, wanted in ((group[tool], tool), *((first, first) for first in group.values())):
        if first in names:
            continue
        names[first] = urdf_xml.free_name(wanted, taken)
    return {link: names[first] for link, first in group.items()}


def _sum_masses(links: Sequence[Link]) -> tuple[float, Array, Array]:
    """Return the mass, kg, centre, m, and inertia about it, kg m2, of links together."""
    mass = sum(link.mass for link in links)
    com = links[0].com
    if mass > 0.0:
        com = sum((link.mass / mass * link.com for link in links), np.zeros(3))
    inertia = np.zeros((3, 3))
    for link in links:
        arm = link.com - com
        inertia += link.inertia
        inertia += link.mass * (arm @ arm * np.eye(3) - np.outer(arm, arm))
    # Remove the rounding of rotations.
    inertia = (inertia + inertia.T) / 2
    clean = np.where(np.abs(inertia) > 1e-14 * float(np.abs(inertia).max()), inertia, 0.0)
    return mass, com, np.array([[float(f"{x:.15g}") for x in row] for row in clean.tolist()])


def _round_vector(vector: Array) -> Array:
    """Round a vector to 14 decimals, which removes the rounding of rotations."""
    return np.array([round(float(x), 14) + 0.0 for x in vector])
