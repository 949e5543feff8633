# SPDX-License-Identifier: Apache-2.0
"""A robot as a URDF, MJCF, SDF, and as a ``mechanism: machine`` description."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from pkm_twin.codegen.arrays import Array
from pkm_twin.errors import warn
from pkm_twin.kinematics.passive import single_joints
from pkm_twin.machine import schema
from pkm_twin.machine.friction import all_keys
from pkm_twin.machine.graph import POSE
from pkm_twin.machine.graph_description import graph_description
from pkm_twin.machine.mjcf_write import write_mjcf
from pkm_twin.machine.places import has_entry
from pkm_twin.machine.sdf_write import write_sdf
from pkm_twin.machine.urdf_control import Control, tree_names
from pkm_twin.machine.urdf_write import MOCK, UrdfBody, UrdfDrive, UrdfTree, write_urdf
from pkm_twin.robot.robot import Robot
from pkm_twin.robot.urdf_tree import urdf_tree


def robot_urdf(robot: Robot, hardware: str = MOCK, prefix: str = "") -> str:
    """The robot as a URDF that parsers of trees read, see docs/urdf.md.

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
    _warn_of_laws(robot, "URDF")
    if hardware:
        robot.controller.check_even()
    return write_urdf(robot_tree(robot), hardware, prefix, _controls(robot))


def joint_names(robot: Robot, hardware: str) -> tuple[str, ...]:
    """What :func:`robot_urdf` calls the actuated and the passive joints of the tree."""
    names = (*robot.joint_names, *robot.passive_joints)
    return tuple(tree_names(names, _controls(robot) if hardware else ()).values())


def _controls(robot: Robot) -> list[Control]:
    controller = robot.controller
    factors, offsets = controller.factors.tolist(), controller.offsets.tolist()
    return list(map(Control, controller.names, robot.joint_names, factors, offsets))


def robot_mjcf(robot: Robot, efforts: Sequence[float] | None = None) -> str:
    """The robot as an MJCF file, see docs/simulators.md.

    Its joints are ``robot.joint_names`` and ``robot.passive_joints``, and those that close loops.

    :param efforts: of the actuators in the keyframe ``home``, shape (n,), N m or N.
    """
    _warn_of_laws(robot, "MJCF")
    tree = robot_tree(robot)
    for name in tree.actuated:
        if robot.friction.offset[tree.actuated.index(name)]:
            warn(name, "MJCF has no constant friction of a drive: it is left out")
    return write_mjcf(tree, robot.gravity, efforts)


def robot_sdf(robot: Robot) -> str:
    """The robot as an SDF model, see docs/simulators.md; gravity is the world's."""
    _warn_of_laws(robot, "SDF")
    tree = robot_tree(robot)
    left_out = [
        f"{what} of {joint.name}"
        for joint in tree.joints
        for what, value in (
            ("the rotor inertia", joint.drive.rotor_inertia),
            ("the constant friction", joint.drive.offset),
        )
        if value
    ]
    if left_out:
        warn(tree.name, f"SDF has no place for {', '.join(left_out)}")
    return write_sdf(tree)


def _warn_of_laws(robot: Robot, where: str) -> None:
    """Of friction that a format has no place for."""
    if robot.laws:
        warn("friction", f"{where} has no {' or '.join(robot.laws)} friction: it is left out")


def robot_tree(robot: Robot) -> UrdfTree:
    """The robot's bodies, single joints and closures with all that description formats tell."""
    engine, load = robot.engine, robot.payload
    return urdf_tree(
        robot.graph,
        single_joints(engine),
        engine.tree.cut,
        robot.name or robot.mechanism,
        drives=_drives(robot),
        payload=UrdfBody("payload", load.mass, load.com, load.inertia),
    )


def robot_description(robot: Robot) -> dict[str, Any]:
    """The robot as a description of ``mechanism: machine``, limits and payload included.

    Members and compliances stay where the robot has them as such a description tells them.
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
    pose = [coordinate.name for coordinate in robot.coordinates]
    # A mechanism may have coordinates of its own.
    if all(name in POSE for name in pose):
        data["pose"] = pose
    load = robot.payload
    if load.mass > 0.0 or load.inertia.any():
        data["payload"] = {
            "mass": load.mass, "com": load.com.tolist(), "inertia": load.inertia.tolist()
        }  # fmt: skip
    for name, gear in zip(robot.joint_names, robot.drives, strict=True):
        if gear is not None:
            own = {key: value for key, value in schema.plain(gear).items() if value is not None}
            data["joints"][name].pop("rotor_inertia", None)
            data["joints"][name]["drive"] = own
    for name, drive in _drives(robot).items():
        joint = data["joints"][name]
        limits: dict[str, Any] = {}
        if drive.position is not None:
            limits["position"] = list(drive.position)
        for key, value in (("velocity", drive.velocity), ("effort", drive.effort)):
            if value is not None:
                limits[key] = value
        if limits:
            joint["limits"] = limits
        k = robot.graph.actuated.index(name)
        more = {key: float(getattr(robot.friction, key)[k]) for key in all_keys()}
        if any(more.values()):
            joint["friction"] = {
                key: value for key, value in more.items() if value or key in ("viscous", "coulomb")
            }
    for key in ("joint_map", "uncertainty"):
        told = {
            name: {field: value for field, value in entry.items() if value is not None}
            for name, entry in schema.plain(getattr(robot, key)).items()
            # Numbers that the graph does not have are unsure no more.
            if key == "joint_map" or has_entry(data, name)
        }
        if told:
            data[key] = told
    return data


def _drives(robot: Robot) -> dict[str, UrdfDrive]:
    """Limits and friction of the actuated joints, by the graph's names."""
    limits, friction = robot.limits, robot.friction

    def one(values: Array | None, k: int) -> float | None:
        return None if values is None or not np.isfinite(values[k]) else float(values[k])

    drives = {}
    for k, name in enumerate(robot.graph.actuated):
        position = None
        if limits.position is not None:
            position = float(limits.position[k][0]), float(limits.position[k][1])
        drives[name] = UrdfDrive(
            position,
            one(limits.velocity, k),
            one(limits.effort, k),
            float(friction.viscous[k]),
            float(friction.coulomb[k]),
            robot.graph.joints[name].rotor_inertia,
            float(friction.offset[k]),
        )
    return drives
