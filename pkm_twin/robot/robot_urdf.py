# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""A robot as a URDF, MJCF, SDF, and as a ``mechanism: machine`` description."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any, Final

import numpy as np

from pkm_twin.errors import warn_of_file
from pkm_twin.kinematics.passive import rod_axes
from pkm_twin.kinematics.pose import describe_angles
from pkm_twin.machine import schema
from pkm_twin.machine.graph import BASE, POSE
from pkm_twin.machine.graph_description import graph_description
from pkm_twin.machine.graph_file import list_drive_numbers
from pkm_twin.machine.loop_tree import Capsule, Joint, Link, LoopTree
from pkm_twin.machine.mjcf_write import write_mjcf
from pkm_twin.machine.names import joint_labels, plain_name
from pkm_twin.machine.places import has_entry, join_path
from pkm_twin.machine.rotations import Pose
from pkm_twin.machine.sdf_write import write_sdf
from pkm_twin.machine.urdf_control import Control, tree_names
from pkm_twin.machine.urdf_write import GROUND, MOCK_HARDWARE, PLATFORM, write_urdf
from pkm_twin.robot.mechanism import DEFAULT_GRAVITY
from pkm_twin.robot.outline import list_bars
from pkm_twin.robot.robot import Robot

PAYLOAD: Final = "payload"
"""The link of a payload, apart from the platform's."""


def robot_urdf(robot: Robot, hardware: str = MOCK_HARDWARE, prefix: str = "") -> str:
    """Write the robot as a URDF that parsers of trees read, see docs/urdf.md.

    Its joints are ``robot.joint_names`` and ``robot.passive_joints``; with their values the link
    ``platform`` stands where ``robot.platform`` says, and the masses sum to the robot's. Rotors and
    constant friction of the drives are parameters of ros2_control's joints, friction in the joints
    that it cuts stands in ``<constraint>``; rotors in passive joints are left out.

    :param hardware: ros2_control's plugin, by default mock hardware; empty: no ``<ros2_control>``
        element, as for a description that a controller_manager must not make hardware of. With it
        drives have the names and numbers of the robot's ``joint_map``, and the joints of the tree
        follow them, see :mod:`pkm_twin.machine.urdf_control`.
    :param prefix: of the names of all links and joints.
    :raises ParameterError: hardware, and a ``joint_map`` with a ratio that changes with travel.
    """
    _warn_of_losses(robot, "URDF")
    if hardware:
        robot.controller.check_constant_ratios()
    return write_urdf(robot_tree(robot), hardware, prefix, _list_controls(robot))


def joint_names(robot: Robot, hardware: str) -> tuple[str, ...]:
    """Return the names that :func:`robot_urdf` gives actuated and passive joints of the tree."""
    names = (*robot.joint_names, *robot.passive_joints)
    return tuple(tree_names(names, _list_controls(robot) if hardware else ()).values())


def _list_controls(robot: Robot) -> list[Control]:
    controller = robot.controller
    factors, offsets = controller.factors.tolist(), controller.offsets.tolist()
    return list(map(Control, controller.names, robot.joint_names, factors, offsets))


def robot_mjcf(robot: Robot, efforts: Sequence[float] | None = None) -> str:
    """Write the robot as an MJCF file, see docs/simulators.md.

    Its joints are ``robot.joint_names`` and ``robot.passive_joints``, and those that close loops.

    :param efforts: of the actuators in the keyframe ``home``, shape (n,), N m or N.
    """
    _warn_of_losses(robot, "MJCF")
    return write_mjcf(robot_tree(robot), robot.gravity, efforts)


def robot_sdf(robot: Robot) -> str:
    """Write the robot as an SDF model, see docs/simulators.md; gravity is the world's."""
    _warn_of_losses(robot, "SDF")
    return write_sdf(robot_tree(robot))


def _warn_of_losses(robot: Robot, where: str) -> None:
    """Warn of numbers that efforts depend on and that a format cannot state."""
    lost = [f"{law} friction" for law in robot.laws]
    if where != "MJCF":
        lost += [
            f"the rotor inertia of {joint.name}"
            for joint in robot.graph.joints.values()
            if joint.rotor_inertia and not (where == "URDF" and joint.actuated)
        ]
        if tuple(robot.gravity) != DEFAULT_GRAVITY:
            lost.append(f"gravity {robot.gravity.tolist()}: it becomes {list(DEFAULT_GRAVITY)}")
    if where != "URDF":
        constant = zip(robot.joint_names, robot.friction.offset, strict=True)
        lost += [f"the constant friction of {name}" for name, offset in constant if offset]
    if np.any(robot.sharing_entries().get("redundancy", {}).get("preload", 0.0)):
        lost.append("redundancy.preload")
    if lost:
        warn_of_file(robot.name or robot.mechanism, f"{where} has no place for {', '.join(lost)}")


def robot_tree(robot: Robot) -> LoopTree:
    """Return the robot in the form of description files, drawn at home, with bars for pictures."""
    graph, tree, load = robot.graph, robot.engine.tree, robot.payload
    names = _choose_link_names([*graph.bodies, *graph.rods])
    labels = joint_labels(tree)
    links, joints = {GROUND: Link(GROUND)}, dict[str, Joint]()

    def make_joint(source: str) -> Joint:
        one, at = graph.joints[source], Pose(position=graph.joints[source].at)
        rub = {"viscous": one.viscous, "coulomb": one.coulomb, "offset": 0.0}
        limits: dict[str, Any] = {}
        if one.actuated:
            k = graph.actuated.index(source)
            rub, limits = list_drive_numbers(robot.friction, robot.limits, k)
        return Joint(
            labels["joints", source],
            one.kind,
            names[one.inner],
            names[one.outer],
            (at, at),
            one.axes,
            one.home,
            limits,
            rub["viscous"],
            rub["coulomb"],
            one.rotor_inertia,
            rub["offset"],
            one.pitch,
        )

    for link in tree.links.values():
        body, at = graph.bodies[link.body], Pose(position=link.at)
        own = names[link.body]
        links[own] = Link(own, at, body.mass, body.com, body.inertia)
        if link.joint is None:
            label = labels["bodies", link.body]
            joints[label] = Joint(label, "free", names[link.parent], own, (at, at))
        else:
            joint = make_joint(link.joint)
            joints[joint.name] = joint
    closures = [make_joint(source) for source in tree.cut]
    for rod in graph.rods.values():
        start, end = (Pose(position=place) for place in rod.ends)
        along = end.position - start.position
        inertia = rod.mass / 12.0 * (along @ along * np.eye(3) - np.outer(along, along))
        own, middle = names[rod.name], (start.position + end.position) / 2.0
        links[own] = Link(own, start, rod.mass, middle, inertia)
        axes = np.array(rod_axes(rod))
        inner, outer, label = names[rod.inner], names[rod.outer], labels["rods", rod.name]
        joints[label] = Joint(label, "universal", inner, own, (start, start), axes)
        closures.append(Joint(f"{label}_end", "spherical", own, outer, (end, end)))
    platform = names[graph.platform]
    if load.mass > 0.0 or load.inertia.any():
        at = Pose(position=graph.origin + load.com)
        links[PAYLOAD] = Link(PAYLOAD, at, load.mass, at.position, load.inertia)
        label = f"{PAYLOAD}_frame"
        joints[label] = Joint(label, "fixed", platform, PAYLOAD, (at, at))
    capsules = (Capsule(names[bar.part], bar.start[1], bar.end[1], bar.radius) for bar in list_bars(graph))
    return LoopTree(
        robot.name or robot.mechanism,
        GROUND,
        links,
        joints,
        tuple(closures),
        graph.actuated,
        capsules=tuple(capsules),
        platform=platform,
        origin=graph.origin,
    )


def _choose_link_names(names: Sequence[str]) -> dict[str, str]:
    """Return a link's name for each body and rod, and the ground; none is a link of the file itself."""
    links = {BASE: GROUND}
    # Names that need no change come first and stay.
    for name in sorted(names, key=lambda name: plain_name(name) != name):
        link = plain_name(name)
        while link in (GROUND, PLATFORM, PAYLOAD, *links.values()):
            link += "_body"
        links[name] = link
    return links


def robot_description(robot: Robot) -> dict[str, Any]:
    """Return the robot as a description of ``mechanism: machine``, with limits and payload.

    Members and compliances are included if the robot's file states them in the same form.
    """
    data = graph_description(robot.graph)
    elastic = robot.elastic_entries()
    for kind, entries in elastic.items():
        for name, entry in entries.items():
            data[kind][name] |= entry
    for kind, entries in robot.passive_entries().items():
        for name, entry in entries.items():
            data[kind][name] |= entry
    if elastic and robot.element_compliance:
        data["element_compliance"] = dict(robot.element_compliance)
    if elastic and robot.modal_damping.size:
        data["modal_damping"] = robot.modal_damping.tolist()
    data["gravity"] = robot.gravity.tolist()
    data["pose"] = list(robot.pose_names)
    if not set(robot.pose_names) <= set(POSE):
        data["angles"] = describe_angles(robot.coordinates)
    data |= robot.sharing_entries()
    load = robot.payload
    if load.mass > 0.0 or load.inertia.any():
        data["payload"] = {"mass": load.mass, "com": load.com.tolist(), "inertia": load.inertia.tolist()}
    for name, gear in zip(robot.joint_names, robot.drives, strict=True):
        if gear is not None:
            own = {key: value for key, value in schema.plain(gear).items() if value is not None}
            data["joints"][name].pop("rotor_inertia", None)
            data["joints"][name]["drive"] = own
    for k, name in enumerate(robot.graph.actuated):
        rub, limits = list_drive_numbers(robot.friction, robot.limits, k)
        if limits:
            data["joints"][name]["limits"] = limits
        if any(rub.values()):
            data["joints"][name]["friction"] = {
                key: value for key, value in rub.items() if value or key in ("viscous", "coulomb")
            }
    for key in ("joint_map", "uncertainty", "tolerances"):
        told = {
            name: {field: value for field, value in entry.items() if value is not None}
            for name, entry in schema.plain(getattr(robot, key)).items()
            # The uncertainty of numbers that the description does not have is dropped.
            if key == "joint_map"
            or has_entry(data, name)
            or (key == "tolerances" and name.partition(".")[0] in ("bodies", "joints", "rods"))
        }
        if told:
            data[key] = told
    told = {
        path: {field: value for field, value in entry.items() if value is not None}
        for name, paths in expand_tolerances(robot).items()
        for entry in [schema.plain(robot.tolerances[name])]
        for path in paths
    }
    return data | ({"tolerances": data.get("tolerances", {}) | told} if told else {})


def expand_tolerances(robot: Robot) -> dict[str, list[str]]:
    """Return the paths in all copies of a limb's parts, by names of ``tolerances``: they share one error.

    Errors along axes are left out, because the copies are rotated.
    """
    copies: dict[str, list[str]] = {}
    for (kind, name), source in getattr(robot, "sources", {}).items():
        drive = kind == "joints" and robot.graph.joints[name].actuated
        for end in ("offset", "backlash") if drive else ("length",) if kind != "joints" else ():
            if source.path[0] == "limbs":
                copies.setdefault(join_path([*source.path, end]), []).append(f"{kind}.{name}.{end}")
    found: dict[str, list[str]] = {}
    for name in robot.tolerances:
        fits = re.compile(".*".join(map(re.escape, name.split("*")))).fullmatch
        for path, own in copies.items():
            # Not every body has a length.
            if fits(path) and not ("*" in name and own[0].startswith("bodies")):
                found.setdefault(name, []).append(",".join(own))
    return found
