# SPDX-License-Identifier: Apache-2.0
"""URDF, MJCF and SDF with loop closures as plain data of a ``mechanism: machine`` description."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from pkm_twin.codegen.arrays import Array
from pkm_twin.errors import ParameterError, warn
from pkm_twin.machine import mjcf_file, sdf_file, urdf_file, urdf_xml
from pkm_twin.machine.assembly import EXACT, Assembly
from pkm_twin.machine.graph import Graph, groups
from pkm_twin.machine.joints import TURN, TYPES
from pkm_twin.machine.loop_tree import Closure, Joint, Link, LoopTree
from pkm_twin.machine.urdf_control import take_drives
from pkm_twin.machine.urdf_visuals import Visual, visuals
from pkm_twin.machine.urdf_xml import Pose
from pkm_twin.robot.urdf_home import Home, HomeSearch

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
SINGLE: Final = tuple(name for name, kind in TYPES.items() if len(kind.steps) == 1)
"""Joint types of one degree of freedom."""
MOST_MOVING: Final = 1000
"""Most joints that are not fixed: assembling takes the cube of their number."""
BALANCED: Final = 1e-6
"""Mass times distance from the axis of a part that is balanced, kg m."""
GROUND: Final = "base"
"""The ground's name in a description."""


@dataclass(frozen=True, eq=False)
class UrdfReading:
    """A file as a ``mechanism: machine`` description, and how it came to be.

    ``home``: how the home was chosen, in words. ``notes``: what was done to the file's machine.
    ``visuals``: the meshes of a URDF's links.
    """

    description: dict[str, Any]
    home: str
    notes: tuple[str, ...]
    visuals: tuple[Visual, ...] = ()


def read_urdf(
    path: str | Path, *, platform: str | None = None, base: str | None = None
) -> dict[str, Any]:
    """A URDF file as a description of ``mechanism: machine``, every vector in base axes at home.

    As :func:`read_tree`, whose notes are given as warnings.
    """
    reading = read_tree(path, platform=platform, base=base)
    for note in reading.notes:
        warn(path, note)
    return reading.description


def read_tree(
    path: str | Path, *, platform: str | None = None, base: str | None = None
) -> UrdfReading:
    """A URDF file as a description of ``mechanism: machine``, every vector in base axes at home.

    A file whose top element is ``<mujoco>`` is read as MJCF, with the mujoco package, and one of
    ``<sdf>`` as SDF.

    Links that fixed joints hold together are one body. Home: see :mod:`pkm_twin.robot.urdf_home`;
    ``home`` of a joint is its value there, so that joint values are the URDF's. Parts that only
    spin about themselves are held, and axes that a rounded file leaves nearly parallel, or nearly
    meeting, are made so where the machine could not move otherwise.

    :param platform: the link that carries the tool; default the first of ``PLATFORMS``.
    :param base: the link that is the ground and gives the base axes; default the root.
    :raises ParameterError: a file, element or name that is refused, by its name.
    """
    path = Path(path)
    top = urdf_xml.elements(path)
    controller = take_drives(top)
    readers = {"mujoco": mjcf_file.read, "sdf": sdf_file.read}
    urdf = readers.get(top.tag, urdf_file.read)(path, top)
    _require_closed(path, urdf)
    tool = _platform(urdf, platform)
    ground = urdf.root if base is None else base
    ground = urdf_xml.known_link("base", ground, urdf.links)
    assembly = Assembly(urdf)
    bodies = _bodies(urdf, assembly.order, tool, ground)
    _require_moving(urdf, bodies, tool)
    home = HomeSearch(assembly, lambda: _description(assembly, bodies, tool, ground)).home()
    assembly.place(home.values)
    data = _description(assembly, bodies, tool, ground, home.values)
    notes = _left_out(urdf)
    if home.miss > EXACT:
        notes.append(f"the loops close within {home.miss:.1g} only (m or rad)")
    if home.graph is not None:
        _take(data, home, home.graph)
        if home.rounding:
            notes.append(
                f"axes and points were moved by up to {home.rounding:.1g} (rad, or parts of the "
                "machine's size), so that the machine can move: the file is rounded"
            )
        if home.held:
            notes.append(f"held, as they only let a part spin about itself: {', '.join(home.held)}")
        heavy = {name: value for name, value in home.held.items() if value > BALANCED}
        if heavy:
            notes.append(
                "efforts depend on the angle at which parts with their mass off the axis are held: "
                + ", ".join(f"{name} ({value:.3g} kg m)" for name, value in heavy.items())
            )
    if controller:
        data["joint_map"] = controller
    view = assembly.links[ground].inverse()
    places = {name: view @ pose for name, pose in assembly.links.items()}
    shown = () if top.tag in readers else visuals(path, top, places, bodies)
    return UrdfReading(data, home.text, tuple(notes), tuple(shown))


def _require_closed(path: Path, tree: LoopTree) -> None:
    """Reject what is too large to be assembled, and passive joints that no closure holds.

    :raises ParameterError: by their number, or by name.
    """
    moving = [joint.name for joint in tree.joints.values() if joint.type != "fixed"]
    if len(moving) > MOST_MOVING:
        raise ParameterError(str(path), f"{len(moving)} joints that move", f"at most {MOST_MOVING}")
    idle = [name for name in moving if name not in tree.actuated]
    if idle and not tree.closures:
        raise ParameterError(
            str(path),
            f"no loop closure, and passive joints: {', '.join(idle)}",
            "<constraint> or <loop> elements, or closed_loop in a YAML file next to it",
        )


def _require_moving(tree: LoopTree, bodies: dict[str, str], tool: str) -> None:
    """Reject actuated joints that do not move the platform, before a home is looked for.

    A joint moves it where joints and closures make a circle through it, the platform and the
    ground: then no body stands between them, whose absence would part them.

    :raises ParameterError: such joints, with the joints at which they can be cut out.
    """
    joints = [joint for joint in tree.joints.values() if joint.type != "free"]
    ends = {joint.name: (joint.parent, joint.child) for joint in joints}
    ends |= {closure.name: closure.links for closure in tree.closures}
    pairs = {name: (bodies[a], bodies[b]) for name, (a, b) in ends.items()}
    pairs = {name: pair for name, pair in pairs.items() if pair[0] != pair[1]}
    target = {GROUND, bodies[tool]}
    every = [*pairs.values(), (GROUND, bodies[tool])]
    degree = Counter(body for pair in every for body in pair)
    moving = set(pairs)
    for gone in [body for body, count in degree.items() if count > 2]:
        parts = groups([body for body in degree if body != gone], every)
        own = next(part for part in parts if target - {gone} <= set(part))
        moving = {name for name in moving if set(pairs[name]) - {gone} <= set(own)}
    apart = [name for name in tree.actuated if name not in moving]
    if not apart:
        return
    whole = {end for name in moving for end in pairs[name]} | target
    cuts = [name for name, pair in pairs.items() if name not in moving and whole & set(pair)]
    raise ParameterError(
        "actuated", f"{', '.join(apart)}", f"joints that move the platform {tool!r}: close a "
        f"missing loop, or cut out the other parts at {', '.join(cuts)}, with their motors"
    )  # fmt: skip


def _left_out(tree: LoopTree) -> list[str]:
    """Of friction and rotors in joints that the engine has none for."""
    found = []
    parts: list[Joint | Closure] = [*tree.joints.values(), *tree.closures]
    for part in parts:
        values = {
            "damping": part.viscous,
            "friction": part.coulomb,
            "rotor inertia": getattr(part, "rotor_inertia", 0.0),
        }
        if part.type not in (*SINGLE, "fixed"):
            found += [f"{key} {value:g} of {part.name}" for key, value in values.items() if value]
    if not found:
        return []
    return [f"ignored, because the joint has several degrees of freedom: {', '.join(found)}"]


def _description(
    assembly: Assembly, bodies: dict[str, str], tool: str, ground: str, values: Array | None = None
) -> dict[str, Any]:
    """The machine at the placed values.

    :param values: of the joints, shape (steps,); without them all are zero.
    """
    urdf = assembly.urdf
    view = assembly.links[ground].inverse()
    at = np.zeros(len(assembly.steps)) if values is None else values
    home = dict(zip(assembly.steps, at.tolist(), strict=True))
    axes: dict[str, list[Array]] = {}
    for name, axis in zip(assembly.steps, assembly.axes, strict=True):
        axes.setdefault(name, []).append(view.rotation @ axis)
    places = {name: view @ pose for name, pose in assembly.links.items()}
    joints: dict[str, Any] = {}
    passive = [n for n, j in urdf.joints.items() if j.type != "fixed" and n not in urdf.actuated]
    for name in (*urdf.actuated, *passive):
        joint = urdf.joints[name]
        if joint.type == "free":
            continue
        joints[name] = _joint(joint, bodies, places, axes[name], home[name], name in urdf.actuated)
    for closure in urdf.closures:
        if bodies[closure.links[0]] != bodies[closure.links[1]]:
            joints[closure.name] = _closure(closure, bodies, view @ assembly.frame(closure, 0))
            if closure.axes is not None and closure.type == "universal":
                second = view @ assembly.frame(closure, 1)
                joints[closure.name]["axes"][1] = _snapped(second.rotation @ closure.axes[1])
    gravity = {}
    if urdf.gravity is not None:
        gravity = {"gravity": _snapped(view.rotation @ urdf.gravity)}
    return {
        "mechanism": "machine",
        **gravity,
        "platform": bodies[tool],
        "origin": _snapped(places[tool].position),
        "bodies": _masses(urdf, bodies, places),
        "joints": joints,
    }


def _take(data: dict[str, Any], home: Home, graph: Graph) -> None:
    """Write the idealised places and axes of a home into a description, and what holds spins."""
    for name, joint in data["joints"].items():
        ideal = graph.joints[name]
        if name in home.held:
            joint = data["joints"][name] = {
                "type": ideal.kind, **{k: joint[k] for k in ("between", "at")}
            }  # fmt: skip
        if home.rounding:
            joint["at"] = _snapped(ideal.at)
        if home.rounding or name in home.held:
            axes = [_snapped(axis) for axis in ideal.axes]
            if ideal.kind == "universal":
                joint["axes"] = axes
            elif axes:
                joint["axis"] = axes[0]


def _platform(urdf: LoopTree, asked: str | None) -> str:
    if asked is not None:
        return urdf_xml.known_link("platform", asked, urdf.links)
    lower = {name.lower(): name for name in urdf.links}
    for name in PLATFORMS:
        if name in lower:
            return lower[name]
    raise ParameterError(
        "platform", None, f"the link that carries the tool, one of {', '.join(sorted(urdf.links))}"
    )


def _bodies(urdf: LoopTree, order: list[Joint], tool: str, ground: str) -> dict[str, str]:
    """Each link's body, named by its link nearest to the root; the tool's is named by the tool.

    :raises ParameterError: the tool is fixed to the ground.
    """
    group = {name: name for name in urdf.links}
    for joint in order:
        if joint.type == "fixed":
            group[joint.child] = group[joint.parent]
    if group[tool] == group[ground]:
        raise ParameterError("platform", tool, "a link that can move")
    names, taken = {group[ground]: GROUND}, {GROUND}
    for first, wanted in ((group[tool], tool), *((first, first) for first in group.values())):
        if first in names:
            continue
        names[first] = urdf_xml.free_name(wanted, taken)
    return {link: names[first] for link, first in group.items()}


def _joint(
    joint: Joint,
    bodies: dict[str, str],
    places: dict[str, Pose],
    axes: list[Array],
    home: float,
    actuated: bool,
) -> dict[str, Any]:
    data: dict[str, Any] = {
        "type": joint.type,
        "between": [bodies[joint.parent], bodies[joint.child]],
        "at": _snapped((places[joint.parent] @ joint.origin).position),
    }
    if joint.type == "universal":
        data["axes"] = [_snapped(axis) for axis in axes]
    elif joint.type != "spherical":
        data["axis"] = _snapped(axes[0])
        if joint.pitch:
            data["lead"] = joint.pitch * TURN
        if actuated:
            data["actuated"] = True
        value = round(home, 14) + 0.0
        if value != 0.0 or (actuated and joint.type == "prismatic"):
            data["home"] = value
    if actuated and joint.limits:
        data["limits"] = joint.limits
    data |= _friction(joint, data)
    if actuated and joint.offset:
        data["friction"] = {"viscous": 0.0, "coulomb": 0.0, **data.get("friction", {})}
        data["friction"]["offset"] = joint.offset
    if "axis" in data and joint.rotor_inertia > 0.0:
        data["rotor_inertia"] = joint.rotor_inertia
    return data


def _friction(part: Joint | Closure, data: dict[str, Any]) -> dict[str, Any]:
    """The entry of a joint of one freedom that has friction."""
    if data["type"] in SINGLE and (part.viscous > 0.0 or part.coulomb > 0.0):
        return {"friction": {"viscous": part.viscous, "coulomb": part.coulomb}}
    return {}


def _closure(closure: Closure, bodies: dict[str, str], place: Pose) -> dict[str, Any]:
    data: dict[str, Any] = {
        "type": closure.type,
        "between": [bodies[link] for link in closure.links],
        "at": _snapped(place.position),
    }
    if closure.axes is not None:
        first = _snapped(place.rotation @ closure.axes[0])
        if closure.type == "universal":
            data["axes"] = [first, first]
        else:
            data["axis"] = first
    return data | _friction(closure, data)


def _masses(
    urdf: LoopTree, bodies: dict[str, str], places: dict[str, Pose]
) -> dict[str, dict[str, Any]]:
    """Masses, centres (m) and inertias about them of all bodies but the ground, base axes."""
    result: dict[str, dict[str, Any]] = {}
    members: dict[str, list[Link]] = {body: [] for body in bodies.values() if body != GROUND}
    for link in urdf.links.values():
        if bodies[link.name] != GROUND:
            members[bodies[link.name]].append(link)
    for body, links in members.items():
        centres = [
            places[link.name].rotation @ link.com + places[link.name].position for link in links
        ]
        mass = sum(link.mass for link in links)
        com = centres[0]
        if mass > 0.0:
            com = sum(
                (link.mass / mass * c for link, c in zip(links, centres, strict=True)), np.zeros(3)
            )
        inertia = np.zeros((3, 3))
        for link, centre in zip(links, centres, strict=True):
            rotation, arm = places[link.name].rotation, centre - com
            inertia += rotation @ link.inertia @ rotation.T
            inertia += link.mass * (arm @ arm * np.eye(3) - np.outer(arm, arm))
        result[body] = {"mass": mass, "com": _snapped(com), "inertia": _moments(inertia)}
    return result


def _moments(inertia: Array) -> list[Any]:
    """A diagonal as three numbers, else the matrix; rounding left over by rotations is dropped."""
    inertia = (inertia + inertia.T) / 2
    scale = float(np.abs(inertia).max())
    clean = np.where(np.abs(inertia) > 1e-14 * scale, inertia, 0.0)
    short = [[float(f"{x:.15g}") for x in row] for row in clean.tolist()]
    if np.count_nonzero(clean - np.diag(np.diag(clean))) == 0:
        return [short[i][i] for i in range(3)]
    return short


def _snapped(vector: Array) -> list[float]:
    """A vector as a list without what rotations leave in the sixteenth digit."""
    return [round(float(x), 14) + 0.0 for x in vector]
